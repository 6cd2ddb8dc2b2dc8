"""Views of results: files of the command, and frames of notebooks."""

import os
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_refused, run

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.time_axis import TimeAxis


@pytest.fixture
def result():
    power = np.random.default_rng(1).uniform(1, 2, (2, 20))
    return results.build(
        *(power, 0.1 * power, power, 0.1 * power),
        time=TimeAxis(1400.0, 1.0, 20),
        pixel_names=["near", "far"],
        pixel_centres_mrad=[[-1.0, 0.0], [1.0, 0.0]],
        attributes={"scene": 'a "quoted" scene'},
    )


@pytest.fixture
def opened(monkeypatch, tmp_path):
    """Addresses that a browser was asked to open, of which there is one if the list is empty."""
    addresses = []
    monkeypatch.setattr(webbrowser, "open", lambda address: addresses.append(address) or len(addresses) == 1)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return addresses


def test_the_command_opens_a_page(result, opened, tmp_path):
    results.save(result, tmp_path / "shot.nc")
    done = run("view", tmp_path / "shot.nc")
    assert (done.exit_code, done.stderr) == (0, "")
    path = Path(done.stdout.strip())
    assert opened == [path.as_uri()]
    assert "<title>a &quot;quoted&quot; scene · waveforms</title>" in path.read_text(encoding="utf-8")
    # Without a browser.
    done = run("view", tmp_path / "shot.nc", "-o", tmp_path / "new" / "shot.html")
    assert done.exit_code == 0
    assert done.stdout == f"{tmp_path / 'new' / 'shot.html'}\n"
    assert done.stderr == "no browser was found: open the page in one.\n"
    done = run("view", tmp_path / "shot.nc", "-o", tmp_path / "shot.html", "--no-browser")
    assert (done.exit_code, done.stderr, len(opened)) == (0, "", 2)


def test_the_command_refuses_what_it_cannot_show(result, opened, tmp_path):
    results.save(result, tmp_path / "shot.nc")
    assert_refused(
        run("view", tmp_path / "shot.nc", "-o", tmp_path / "shot.txt"), "must end in .png, .pdf or .svg, or .html"
    )
    assert_refused(run("view", tmp_path / "shot.nc", "--shot", 2), "--shot 2 needs a series of shots")
    result.drop_vars(list(result.data_vars)).to_netcdf(tmp_path / "empty.nc", engine="h5netcdf")
    assert_refused(run("view", tmp_path / "empty.nc"), "empty.nc")
    assert opened == []
    assert {path.name for path in tmp_path.iterdir()} == {"shot.nc", "empty.nc"}


def test_temporary_pages_of_former_calls_are_removed(result, opened, tmp_path):
    paths = [Path(run("view", file).stdout.strip()) for file in [saved(result, tmp_path)] * 2]
    assert all(path.is_file() for path in paths)
    old = paths[0].stat().st_mtime - 3700
    os.utime(paths[0].parent, (old, old))
    (tmp_path / "mine").mkdir()
    link = tmp_path / "mitransient-lidar-view-link"
    link.symlink_to(tmp_path / "mine")
    os.utime(link, (old, old), follow_symlinks=False)
    paths.append(Path(run("view", tmp_path / "shot.nc").stdout.strip()))
    assert [path.parent.exists() for path in paths] == [False, True, True]
    assert (tmp_path / "mine").is_dir()


def saved(result, folder):
    results.save(result, folder / "shot.nc")
    return folder / "shot.nc"
