"""The command that cuts gates: files, their names, and sentences."""

import sys

import command_line
import numpy as np
import pytest
from figure_inputs import result
from PIL import Image

from mitransient_lidar import results

TRAIN = ("--start-ns", 1480, "--width-ns", 5, "--count", 6)


@pytest.fixture
def stored(tmp_path):
    dataset = result(12, (3, 4), pulse_fwhm_ns=4.0)
    results.save(dataset, tmp_path / "scene.nc")
    return tmp_path / "scene.nc", dataset


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
    done = run(path, *TRAIN)
    assert done.exit_code == 0, done.output
    names = ["scene_gates.exr", "scene_gates.png", "scene_depth.png"]
    assert done.stdout.split() == [str(path.with_name(name)) for name in names]
    for name in names[1:]:
        with Image.open(path.with_name(name)) as picture:
            assert (picture.format, picture.width) == ("PNG", 1536)
    stack = results.open(path.with_name("scene_gates.exr"))
    # Bins 150 to 159 make up gate 0; EXR files hold 32 bits.
    expected = dataset["waveform"][:, :, 150:160].sum("time") * 0.5e-9
    np.testing.assert_allclose(stack["gate_energy"][:, :, 0], expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("no_ffmpeg")
def test_all_kinds_of_files_in_a_new_folder(stored, tmp_path):
    path, _ = stored
    folder = tmp_path / "new" / "folder"
    done = run(path, *TRAIN, "--output", folder, "--no-plot", "--sequence", "--gif", "--html", "--quiet")
    assert done.exit_code == 0, done.output
    numbered = [f"scene_gate{gate:03d}.exr" for gate in range(6)]
    names = ["scene_gates.exr", "scene_gates.gif", "scene_gates.html", *numbered]
    assert done.stdout.split() == [str(folder / name) for name in names]
    assert sorted(file.name for file in folder.iterdir()) == sorted(names)


def test_a_stack_of_gates_has_no_histogram(stored):
    path, _ = stored
    run(path, *TRAIN, "--no-plot")
    done = run(path.with_name("scene_gates.exr"), *TRAIN)
    assert done.exit_code == 2
    assert "dataset holds a gate stack, but must have waveforms over time" in done.stderr


@pytest.mark.usefixtures("no_ffmpeg")
def test_a_movie_that_cannot_be_leaves_no_files_and_is_refused_before_the_render(stored, tmp_path, monkeypatch):
    command_line.stub(monkeypatch, "render", lambda *_, **__: pytest.fail("rendered"))
    for command in (["gates", stored[0], *TRAIN], ["render", "gated_waves"]):
        done = command_line.run(*command, "-o", tmp_path / "out", "--mp4")
        sentence = ".mp4 needs the program ffmpeg, which pip install 'mitransient-lidar[movie]' brings"
        command_line.assert_refused(done, sentence)
        assert not (tmp_path / "out").exists()
