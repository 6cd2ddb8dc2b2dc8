"""The scene that the documentation writes from an empty file: it renders as it is, and its text quotes it."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import run

import mitransient_lidar

DOCS = Path(__file__).parents[2] / "docs" / "guide"
SCENE = DOCS / "survey_lidar.xml"


def words(text):
    """XML without comments and differences of white space."""
    return " ".join(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL).split())


def test_every_line_of_the_text_is_in_the_scene():
    text, scene = (DOCS / "scene_from_scratch.md").read_text("utf-8"), words(SCENE.read_text("utf-8"))
    snippets = re.findall(r"```xml\n(.*?)```", text, flags=re.DOTALL)
    assert len(snippets) == 6
    for line in (words(line) for snippet in snippets for line in snippet.splitlines()):
        assert line in scene
    commands = re.findall(r"^mitransient-lidar (\S+)", text, flags=re.MULTILINE)
    assert commands == ["render", "waveforms", "render", "shots", "retrieve"]


@pytest.mark.slow
def test_scene_loads_and_renders_without_warnings():
    few = {"type": "lidar_merging", "paths_per_pass": 1024, "photons_per_pass": 1024}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shot = mitransient_lidar.render(SCENE, params={"spectrum": "flat"}, passes=2, seed=1, integrator=few)
    assert shot.sizes["pixel"] == 7
    # The highest powers of the second half of the record are those of the bottom at 9 m.
    late = shot["waveform"].sel(time=slice(2120, None)).sum("pixel")
    assert float(late.idxmax("time")) == pytest.approx(600 / (0.299792458 * np.cos(np.radians(15))) + 9 * 9.274, abs=2)


@pytest.mark.slow
def test_commands_measure_its_bottom(tmp_path):
    done = run("render", SCENE, "-D", "spectrum=flat", "--passes", 2, "--seed", 3, "-o", tmp_path)
    assert done.exit_code == 0, done.output
    assert "warning" not in done.output.lower()
    table = run("waveforms", tmp_path / "survey_lidar.nc")
    assert len(re.findall("bottom", table.output)) == 7
    done = run("retrieve", tmp_path / "survey_lidar.nc")
    assert done.exit_code == 0, done.output
    # The efficiencies are no parameters of this scene.
    assert float(re.search(r"reflectance: level ([0-9.]+)", done.output)[1]) == pytest.approx(0.15, rel=0.3)
