"""Every command once, with files, on a scene of few paths; scenes, options and results have tests of their own."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import COMMANDS, assert_refused, run

import mitransient_lidar
from mitransient_lidar.loading import catalogue

#: The reference compiles one kernel, merging three.
FAST = '<integrator type="lidar_volpath"><integer name="paths_per_pass" value="4096"/></integrator>'
FLAT = ["-D", "spectrum=flat", "-D", "surface_size=60", "-D", "bin_width_ns=2", "-D", "bin_count=95"]
#: Only these ask for waves.
WAVES = ["-D", "surface_size=60", "-D", "surface_cell_size=0.25", *FLAT[4:]]
SEA_COMMANDS = ("find-shots",)
#: Those that take most time.
SLOW = {"detect", "passive"}
SLOW |= {"echoes", "frames", "scattering", "bounds", "figures", "forecast"}

#: Arguments of each command, after the scene or the result if it takes one.
SCENE_COMMANDS = {
    "find-shots": ["--no-waveforms"],
    "detect": ["--passes", 16, "--shots", 1000, "--renders", 3],
    "bounds": ["--free", "attenuation,bottom_reflectance", "--over", "layout=1x1,2x2", "--renders", 2, "--passes", 2],
    "scattering": ["--passes", 2, "--orders", 2],
}
RESULT_COMMANDS = {
    "view": ["--plot"],
    "echoes": ["--table"],
    "retrieve": [],
    "record": ["--gain", "auto"],
    "gates": ["--start-depth", 5, "--width-ns", 5, "--step-ns", 5, "--count", 4],
}
OTHER_COMMANDS = {
    "scenes water": ["jerlov", "II"],
    "info": [],
    "scenes instruments": ["teledyne_czmil"],
    "figures": ["fig06", "fig08"],
    "forecast": ["riegl_vq840g", "2:3", "--shots", 2],
    "frames": ["gated_waves", "-D", "layout=2x2", "-D", "wind_speed=0", "--passes", 2, "--pass-share", 0.01],
    "passive": ["passive_sea", "-D", "layout=4x4", "-D", "surface_cell_size=2", "--passes", 2],
}


def commands(arguments):
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in arguments]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "small.xml"
    text = catalogue.scene_text("fig13_2x2")
    integrator = '<integrator type="lidar_merging"/>'
    assert integrator in text
    path.write_text(text.replace(integrator, FAST))
    return path


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("result")
    done = run("render", scene, *FLAT, "--passes", 2, "-o", folder, "-q")
    assert done.exit_code == 0, done.stderr
    assert sorted(path.suffix for path in folder.iterdir()) == [".exr", ".nc", ".png", ".png"]
    return folder / "small.nc"


def check(done, *, writes=True):
    """Check that a command has succeeded, and that the files that it names are there."""
    assert done.exit_code == 0, done.stderr
    named = [Path(line) for line in done.stdout.splitlines() if re.fullmatch(r"\S+\.(nc|exr|png|csv|html|zarr)", line)]
    assert all(path.stat().st_size > 0 for path in named)
    assert bool(named) == writes, done.stdout
    assert done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("command", commands(SCENE_COMMANDS))
def test_command_of_a_scene(command, scene, tmp_path):
    options = SCENE_COMMANDS[command]
    done = run(command, scene, *(WAVES if command in SEA_COMMANDS else FLAT), *options, "-o", tmp_path / "figure.png")
    check(done)
    assert (tmp_path / "figure.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("command", commands(RESULT_COMMANDS))
def test_command_of_a_result(command, result, tmp_path):
    done = run(command, result, *RESULT_COMMANDS[command])
    check(done, writes=command not in ("echoes", "retrieve"))
    if command in ("gates", "record", "retrieve", "echoes"):
        # A result of another scene is seen.
        assert f"{result}: scene small, integrator lidar_volpath" in done.stderr.splitlines()


@pytest.mark.slow
def test_corrected_depths_of_an_instrument_from_end_to_end(tmp_path):
    """A table, a render, its record with the receiver of the instrument, and its depths, each from the files before."""
    made, csv = tmp_path / "table.nc", tmp_path / "echoes.csv"
    few = ["--winds", "0", "--ripples", 5, "--waters", "IB", "--angles", "20", "--shots", 8, "--records", 4]
    check(run("depth-bias", "riegl_vq840g", *few, "--depths", "3,6", "-o", made, "-q"))
    again = run("depth-bias", "riegl_vq840g", *few, "--depths", 5, "--seed", 2, "--corrections", made, "-o", csv, "-q")
    assert_refused(again, "--output")
    options = [*few, "--depths", 5, "--seed", 2, "--corrections", made, "-o", tmp_path / "again.nc", "-q"]
    lines = run("depth-bias", "riegl_vq840g", *options).stdout.splitlines()
    # Angle, wind, ripples, water, depth, channel, SNR, four shares, bias, spread, error, z, wrong, bias after it.
    names, cells = lines[-2].split(), lines[-1].replace(" %", "").split()
    assert cells[:6] == ["20.0", "0", "5", "IB", "5", "single"]
    assert float(cells[names.index("found")]) == float(cells[names.index(">10")]) == 100
    first = names.index("bias")
    before, after = float(cells[first]), float(cells[names.index("bias", first + 1)])
    assert abs(before) < 4
    assert abs(after) < min(abs(before), 1)
    scene = ["-D", "jerlov=IB", "-D", "spectrum=flat", "-D", "wind_speed=5", "-D", "bottom_depth=5"]
    done = run("render", "table1", "--instrument", "riegl_vq840g", *scene, "--passes", 4, "-o", tmp_path, "-q")
    check(done)
    check(run("record", tmp_path / "table1.nc", "--shots", 8, "-q"))
    recorded = tmp_path / "table1_recorded.nc"
    check(run("echoes", recorded, "--correct", made, "--csv", csv))
    found = [line.split(",") for line in csv.read_text().splitlines()]
    place = {name: number for number, name in enumerate(found[0])}
    bottoms = [line for line in found[1:] if line[place["echo"]] == "bottom"]
    assert len(bottoms) == 8
    assert np.mean([float(line[place["depth_m"]]) for line in bottoms]) == pytest.approx(5, abs=0.02)
    assert_refused(run("echoes", recorded, "--correct", made, "--mean-surface"), "are alternatives")
    assert_refused(run("echoes", recorded, "--wind-speed", 3), "--wind-speed 3 needs --correct")


@pytest.mark.slow
def test_derivatives_and_a_fit(scene, tmp_path):
    options = [*FLAT, "--passes", 4, "--derivatives", "bottom_reflectance", "--derivatives", "target_depth"]
    check(run("render", scene, *options, "-o", tmp_path, "-q"))
    assert (tmp_path / "small_derivatives.png").stat().st_size > 0
    assert_refused(run("render", scene, "--derivatives", "target_dept"), "did you mean target_depth?")
    check(run("fit", tmp_path / "small.nc", "--free", "bottom_reflectance", "--passes", 8, "-o", tmp_path, "-q"))
    assert {"fit.nc", "fit.csv", "fit.png"} <= {path.name for path in tmp_path.iterdir()}
    name, _, value, stderr, *_ = (tmp_path / "fit.csv").read_text().splitlines()[1].split(",")
    assert name == "bottom_reflectance"
    assert float(value) == pytest.approx(0.1, abs=6 * float(stderr))


@pytest.mark.slow
def test_comparison_of_a_result_with_itself(result):
    done = run("compare", result, result)
    assert done.exit_code == 0, done.stderr
    found = json.loads(run("compare", result, result, "--json").stdout)
    assert found["agrees"]
    assert found["energy_ratio"] == 1
    assert f"{found['bin_count']} bins" in done.stdout
    assert json.loads(run("info", result, "--json").stdout)["passes"] == mitransient_lidar.open(result).attrs["passes"]


def test_facts_for_programs():
    facts = json.loads(run("scenes", "instruments", "riegl_vq840g", "--json").stdout)
    assert facts["parameters"]["wavelength_nm"]["value"] == "532"
    assert facts["channels"]
    assert facts["title"] == json.loads(run("scenes", "instruments", "--json").stdout)["riegl_vq840g"]
    assert json.loads(run("info", "--json").stdout)["mitransient-lidar"] == mitransient_lidar.__version__


@pytest.mark.parametrize("command", commands(OTHER_COMMANDS))
def test_command_without_a_result(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check(run(command, *OTHER_COMMANDS[command]), writes=command in ("figures", "forecast", "frames", "passive"))


def test_every_command_is_run():
    tested = {*SCENE_COMMANDS, *RESULT_COMMANDS, *OTHER_COMMANDS, "render", "shots", "compare"}
    tested |= {"depth-bias", "tpu", "fit"}
    # The benchmark measures for minutes; its tests replace the renders. tests/system runs campaigns and flights.
    assert set(COMMANDS) == tested | {"bench", "campaign", "fly", "scenes list", "scenes show", "scenes copy"}
