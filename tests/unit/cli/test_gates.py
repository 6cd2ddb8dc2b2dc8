"""The command that cuts gates: files, their names, and sentences."""

import sys

import command_line
import numpy as np
import pytest
from PIL import Image

from mitransient_lidar import results
from mitransient_lidar.physics.lidar.time_axis import TimeAxis

TRAIN = ("--start-ns", 1410, "--width-ns", 5, "--count", 6)


@pytest.fixture
def stored(tmp_path):
    """A small imager's result, in a file."""
    rng = np.random.default_rng(1)
    time = 1400 + 0.5 * (np.arange(120) + 0.5)
    power = 1e-5 * (np.exp(-0.5 * ((time - 1415) / 2) ** 2) + np.where(time > 1415, np.exp(-(time - 1415) / 10), 0))
    waveform = rng.uniform(0.5, 1.5, (12, 1)) * power
    energy = waveform * 0.5e-9
    dataset = results.build(
        energy,
        0.05 * energy,
        waveform,
        0.05 * waveform,
        time=TimeAxis(1400.0, 0.5, waveform.shape[1]),
        pixel_names=[],
        pixel_centres_mrad=np.stack(np.meshgrid([2.0, 1, 0, -1], [1.0, 0, -1]), -1).reshape(-1, 2)[:, ::-1],
        grid=(3, 4),
        attributes={
            "scene": "gated",
            "altitude": 199.0,
            "surface_time_ns": 1415.0,
            "refractive_index": 1.34,
            "group_index": 1.34,
            "off_nadir_deg": 20.0,
            "pulse_fwhm_ns": 4.0,
        },
    )
    path = tmp_path / "scene.nc"
    results.save(dataset, path)
    return path, dataset


@pytest.fixture
def no_ffmpeg(tmp_path, monkeypatch):
    """Hide the programs of the system and the extra ``movie``."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)


def run(*arguments):
    return command_line.run("gates", *arguments)


@pytest.mark.slow
def test_files_beside_the_result(stored):
    path, dataset = stored
    result = run(path, *TRAIN)
    assert result.exit_code == 0, result.output
    names = ["scene_gates.exr", "scene_gates.png", "scene_depth.png"]
    assert result.stdout.split() == [str(path.with_name(name)) for name in names]
    for name in names[1:]:
        with Image.open(path.with_name(name)) as picture:
            assert (picture.format, picture.width) == ("PNG", 1536)
    stack = results.open(path.with_name("scene_gates.exr"))
    # Bins 20 to 29 make up gate 0; EXR files hold 32 bits.
    expected = dataset["waveform"][:, :, 20:30].sum("time") * 0.5e-9
    np.testing.assert_allclose(stack["gate_energy"][:, :, 0], expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("no_ffmpeg")
def test_all_kinds_of_files_in_a_new_folder(stored, tmp_path):
    path, _ = stored
    folder = tmp_path / "new" / "folder"
    result = run(path, *TRAIN, "--output", folder, "--no-plot", "--sequence", "--gif", "--html", "--quiet")
    assert result.exit_code == 0, result.output
    numbered = [f"scene_gate{gate:03d}.exr" for gate in range(6)]
    names = ["scene_gates.exr", "scene_gates.gif", "scene_gates.html", *numbered]
    assert result.stdout.split() == [str(folder / name) for name in names]
    assert sorted(file.name for file in folder.iterdir()) == sorted(names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ((), "one start"),
        (("--start-ns", 1410), "one shape"),
        (("--start-ns", 1401, "--width-ns", 5), "gate train before the surface"),
        (("--start-ns", 1450, "--width-ns", 5, "--count", 3), "within the record"),
    ],
)
def test_sentences(stored, arguments, part):
    result = run(stored[0], *arguments)
    assert result.exit_code == 2, result.output
    assert part in result.stderr
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_stack_of_gates_has_no_histogram(stored):
    path, _ = stored
    run(path, *TRAIN, "--no-plot")
    result = run(path.with_name("scene_gates.exr"), *TRAIN)
    assert result.exit_code == 2
    assert "dataset holds a gate stack, but must have waveforms over time" in result.stderr


def assert_no_movie(result, folder):
    assert result.exit_code == 2
    assert result.stdout == ""
    assert ".mp4 needs the program ffmpeg, which pip install 'mitransient-lidar[movie]' brings" in result.stderr
    assert not folder.exists()


@pytest.mark.usefixtures("no_ffmpeg")
def test_a_movie_that_cannot_be_leaves_no_files(stored, tmp_path):
    path, _ = stored
    assert_no_movie(run(path, *TRAIN, "-o", tmp_path / "out", "--mp4"), tmp_path / "out")


@pytest.mark.usefixtures("no_ffmpeg")
def test_a_movie_that_cannot_be_is_refused_before_the_render(tmp_path, monkeypatch):
    command_line.stub(monkeypatch, "render", lambda *_, **__: pytest.fail("rendered"))
    result = command_line.run("render", "gated_waves", "-o", tmp_path / "out", "--mp4")
    assert_no_movie(result, tmp_path / "out")
