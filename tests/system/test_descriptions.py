"""Units and descriptions of all that commands write, and studies of scattered light and targets."""

import re

import pytest
import xarray as xr
from command_line import assert_refused, run
from descriptions import assert_described
from few_paths import few_paths
from rows import each_case

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms.echo_table import ESTIMATORS, extract
from mitransient_lidar.physics.lidar.gate_train import GateTrain
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.results import open as open_stack
from mitransient_lidar.results import save as save_stack

FLAT = {"spectrum": "flat", "wind_speed": 5}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return few_paths("table1", tmp_path_factory.mktemp("scene"))


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["2x2", "5x5"])
def test_render_record_echoes_and_gates(scene, tmp_path, layout):
    result = mitransient_lidar.render(scene, params={**FLAT, "layout": layout}, passes=2, components=True)
    assert ("row" in result.dims) == (layout == "5x5")
    results.save(result, tmp_path / "result.nc")
    read = results.open(tmp_path / "result.nc")
    recorded = detect_waveforms(read, "apd", shots=2, optical_density="auto")
    gates = cut_gates(read, GateTrain(read.attrs["surface_time_ns"] + 20, 5.0, 5.0, 3))
    save_stack(gates, tmp_path / "gates.exr")
    for dataset in (read, recorded, gates, open_stack(tmp_path / "gates.exr")):
        assert_described(dataset)
    for dataset in (read, recorded):
        assert_described(extract(dataset, ESTIMATORS, layers=1))


@pytest.mark.slow
def test_shots_their_record_and_echoes(scene):
    shots = render_shots(scene, FLAT, positions=[(0, 0), (5, 2)], passes=2, components=True)
    recorded = detect_waveforms(shots, "apd", shots=3, optical_density="auto")
    echoes = extract(recorded)
    assert "true_kd" in echoes.coords
    for dataset in (shots, recorded, echoes):
        assert_described(dataset)


NEAR = ["-D", "surface_size=60", "-D", "bin_width_ns=2", "-D", "bin_count=85"]


@pytest.fixture
def target_scene(tmp_path):
    """File of a target_scene with a target, of few paths a pass."""
    return few_paths("fig13_2x2", tmp_path)


def texts(plot):
    """Return the texts of an SVG figure, which matplotlib adds as comments."""
    return set(re.findall(r"<!-- (.*?) -->", plot.read_text(encoding="utf-8")))


@pytest.mark.slow
def test_signal_without_a_receiver(target_scene, tmp_path):
    """A map of 2x2 places, whose sums are the signals of these places alone."""
    few = [*NEAR, "--receiver", "none", "--passes", 16, "-q", "-o"]
    done = run("detect", target_scene, "--grid", 2, "--max-offset", 0.5, *few, tmp_path / "map.png")
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[2].split()[:2] == ["target_x", "target_y"]
    at_place = ["-D", "target_x=0.5", "-D", "target_y=-0.5"]
    assert run("detect", target_scene, *at_place, *few, tmp_path / "place.png").exit_code == 0
    with (
        xr.open_dataset(tmp_path / "map.nc", engine="h5netcdf") as found,
        xr.open_dataset(tmp_path / "place.nc", engine="h5netcdf") as own,
    ):
        place = found["combined_echo"].sel(target_x=0.5, target_y=-0.5)
        assert place.sel(combination="sum") == own["combined_echo"].sel(combination="sum")


@pytest.mark.slow
@each_case(
    (["--depths", "2,5"], ["2", "5"], "distance from the centroid (m)"),
    (["--fov-mrad", "20,35", "--passes", 8], ["20", "35"], "field of view (mrad)"),
)
def test_other_scattering(words, heads, drawn, target_scene, tmp_path):
    plot = tmp_path / "light.svg"
    done = run("scattering", target_scene, *NEAR, *words, "-o", plot, "-q")
    assert done.exit_code == 0, done.stderr
    firsts = [line.split()[0] for line in done.stdout.splitlines()[3:]]
    assert [first for first in firsts if first in heads] == heads
    assert drawn in texts(plot)
    assert_refused(run("scattering", target_scene, *words, "--orders", 2), "orders = 2 and ", "are alternatives")
    other = "--min-depth" if "--depths" in words else "--photons"
    assert_refused(run("scattering", target_scene, *words, other, 2000), f"{other} = 2000", " needs ")
    assert_refused(run("scattering", target_scene, "--fov-mrad", 20, "--passes", 3), "passes = 3 must")
