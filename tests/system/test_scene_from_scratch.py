"""The scenes that the documentation writes from an empty file: they render as they are, and its text quotes them."""

import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from oracles.refracted_path import refracted_path

import mitransient_lidar
from mitransient_lidar.core.constants import C0

ROOT = Path(__file__).parents[2]
FILES = ROOT / "scenes" / "examples"
SCENE, GATED, MESH = (FILES / name for name in ("survey_lidar.xml", "gated_target.xml", "pyramid.ply"))


def words(text):
    """XML without comments and differences of white space."""
    return " ".join(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL).split())


def test_every_line_of_the_text_is_in_the_scenes():
    text = (ROOT / "docs" / "guide" / "scene_from_scratch.md").read_text("utf-8")
    snippets = re.findall(r"```(?:xml|text)\n(.*?)```", text, flags=re.DOTALL)
    files = [SCENE] * 6 + [MESH] + [GATED] * 3
    assert len(snippets) == len(files)
    for snippet, path in zip(snippets, files, strict=True):
        quoted = words(path.read_text("utf-8"))
        for line in map(words, snippet.splitlines()):
            assert line in quoted
    commands = re.findall(r"^mitransient-lidar (\S+)", text, flags=re.MULTILINE)
    first = ["scenes", "render", "echoes", "render", "shots", "retrieve", "record", "echoes"]
    assert commands == [*first, "scenes", "render", "gates", "frames", "render", "render", "render"]


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
    table = run("echoes", tmp_path / "survey_lidar.nc")
    assert sum(line.split()[1:2] == ["bottom"] for line in table.output.splitlines()) == 7
    done = run("retrieve", tmp_path / "survey_lidar.nc")
    assert done.exit_code == 0, done.output
    # The efficiencies are no parameters of this scene.
    assert float(re.search(r"reflectance: level ([0-9.]+)", done.output)[1]) == pytest.approx(0.15, rel=0.3)


@pytest.mark.slow
def test_gates_show_the_pyramid():
    few = {"type": "lidar_merging", "paths_per_pass": 16384, "photons_per_pass": 16384}
    shot = mitransient_lidar.render(GATED, params={"wind_speed": 0}, passes=4, seed=1, integrator=few, components=True)
    assert dict(shot["gate_energy"].sizes) == {"row": 32, "column": 32, "gate": 18}
    (target,) = json.loads(shot.attrs["target_outlines"])
    x, y = np.reshape(target["line"], (-1, 2)).T
    corners = [x.min(), x.max(), y.min(), y.max(), *target["z"]]
    assert corners == pytest.approx([0.8, 2.8, -1, 1, -9, -7.5], abs=1e-3)
    # Over a level sea no light arrives before that of the tip along the refracted ray, and the first soon after it.
    height, depth, group_index = 300.0, 7.5, shot.attrs["group_index"]
    along = 1.8 + height * np.tan(np.radians(15))
    angles = refracted_path(along, height, depth, shot.attrs["refractive_index"])
    lengths = height / np.cos(angles[0]) + group_index * depth / np.cos(angles[1])
    tip = 1e9 * 2 * lengths / C0
    energy = shot["impulse_response_by_origin"].sel(origin="target").sum(("row", "column"))
    assert float(energy.sel(time=slice(None, tip - 0.3)).sum()) == 0
    assert float(energy.sel(time=slice(tip - 0.3, tip + 2.5)).sum()) > 0
    # Its base is 1.5 m deeper, or 14 ns later: most of its light arrives before.
    assert float(energy.sel(time=slice(None, tip + 16)).sum()) > 0.9 * float(energy.sum())
