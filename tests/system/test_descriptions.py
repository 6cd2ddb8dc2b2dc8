"""Units and descriptions of all that commands write; those of campaigns are tested with these."""

import pytest
from descriptions import assert_described
from few_paths import few_paths

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
