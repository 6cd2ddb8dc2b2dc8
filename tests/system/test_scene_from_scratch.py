"""The scenes that the documentation writes from an empty file: they render as they are, and its text quotes them."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import run

import mitransient_lidar

DOCS = Path(__file__).parents[2] / "docs" / "guide"
SCENE, GATED, MESH = (DOCS / name for name in ("survey_lidar.xml", "gated_target.xml", "pyramid.ply"))


def words(text):
    """XML without comments and differences of white space."""
    return " ".join(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL).split())


def test_every_line_of_the_text_is_in_the_scenes():
    text = (DOCS / "scene_from_scratch.md").read_text("utf-8")
    snippets = re.findall(r"```(?:xml|text)\n(.*?)```", text, flags=re.DOTALL)
    files = [SCENE] * 6 + [MESH] + [GATED] * 2
    assert len(snippets) == len(files)
    for snippet, path in zip(snippets, files, strict=True):
        quoted = words(path.read_text("utf-8"))
        for line in map(words, snippet.splitlines()):
            assert line in quoted
    commands = re.findall(r"^mitransient-lidar (\S+)", text, flags=re.MULTILINE)
    assert commands == ["render", "waveforms", "render", "shots", "retrieve", "record", "waveforms", "render", "gates"]


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


@pytest.mark.slow
def test_gates_show_the_pyramid():
    few = {"type": "lidar_merging", "paths_per_pass": 16384, "photons_per_pass": 16384}
    shot = mitransient_lidar.render(GATED, params={"wind_speed": 0}, passes=8, seed=1, integrator=few, components=True)
    image = shot["waveform_by_origin"].sel(origin="target").sum("time")
    # The pyramid is symmetric across the line of sight, and its middle is 1.8 m behind the axis on the sea.
    left, right = (float(image.isel(column=part).sum()) for part in (slice(0, 16), slice(16, 32)))
    assert left == pytest.approx(right, rel=0.1)
    where = image.where(image > 0.05 * image.max())
    assert where.notnull().sum("column").max() >= 12
    # Its light begins at the apex, 7.5 m deep, and ends at the base, 9 m.
    light = shot["waveform_by_origin"].sel(origin="target").sum(("row", "column"))
    depth = (light["time"] - shot.attrs["surface_time_ns"]) * float(shot["depth_per_ns"].mean())
    bright = depth.values[light.values > 0.1 * float(light.max())]
    assert bright[0] == pytest.approx(7.5, abs=0.3)
    assert bright[-1] == pytest.approx(9.0, abs=0.3)
