"""The intercomparison: its table against its scenes, the score's arithmetic, and single scattering in closed form."""

import importlib.util
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin
from oracles.phase import henyey_greenstein
from rows import each_row

from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters

FOLDER = Path(__file__).parents[3] / "docs" / "intercomparison"


def script(name):
    spec = importlib.util.spec_from_file_location(f"intercomparison_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


score, single_scattering = script("score"), script("single_scattering")
CASES = single_scattering.read_cases()
EMITTER = ("altitude", "off_nadir_deg", "beam_profile", "divergence_mrad", "pulse_energy_mj")
RECEIVER = ("altitude", "off_nadir_deg", "field_of_view_mrad", "aperture_area")
GATES = ("time_start_ns", "bin_width_ns", "bin_count")
WATER = (
    *("layer_tops", "attenuation", "scattering", "backscattering", "phase_function", "phase_g"),
    *("refractive_index", "group_index"),
)


def values(element):
    return {child.get("name"): child.get("value") for child in element if child.get("value") is not None}


def solid(element):
    """Return half side, x, depth and reflectance of a rectangle."""
    scale, move = element.find("transform/scale"), element.find("transform/translate")
    reflectance = next(element.iter("spectrum")).get("value")
    return float(scale.get("value")), float(move.get("x", 0)), -float(move.get("z")), reflectance


def test_every_case_has_a_scene_and_results_have_its_gates():
    assert {path.stem for path in (FOLDER / "cases").iterdir()} == set(CASES)
    results = list((FOLDER / "results").glob("*/*.csv"))
    assert {path.parent.name for path in results} >= {"lidar_merging", "lidar_volpath"}
    for path in results:
        case, found = CASES[path.stem], score.read(path)
        expected = float(case["time_start_ns"]) + float(case["bin_width_ns"]) * np.arange(int(case["bin_count"]) + 1)
        np.testing.assert_allclose(found.start, expected[:-1], rtol=1e-8)
        np.testing.assert_allclose(found.end, expected[1:], rtol=1e-8)


@each_row(*CASES)
def test_scene_has_the_values_of_the_table(name):
    case, root = CASES[name], ET.parse(FOLDER / "cases" / f"{name}.xml").getroot()
    receiver, surface = root.find("sensor"), root.find("shape[@type='ocean_surface']")
    found = [
        (values(root.find("emitter")), EMITTER),
        (values(receiver), RECEIVER),
        (values(receiver.find("film")), GATES),
        (values(surface.find("medium")), WATER),
        (values(surface), ("slope_variance", "wind_speed")),
    ]
    for element, keys in found:
        assert {key: element.get(key) for key in keys} == {key: case.get(key) for key in keys}
    assert values(surface)["spectrum"] == {"level": "flat", "waves": "elfouhaily"}[case["surface"]]
    for lossless in (values(root.find("emitter"))["optical_efficiency"], values(receiver)["optical_efficiency"]):
        assert float(lossless) == 1
    assert float(values(receiver)["two_way_atmospheric_transmittance"]) == 1
    solids = {element.get("id"): solid(element) for element in root.findall("shape[@type='rectangle']")}
    assert set(solids) == {part for part in ("bottom", "target") if f"{part}_depth" in case}
    if "bottom" in solids:
        assert solids["bottom"][1:] == (0, float(case["bottom_depth"]), case["bottom_reflectance"])
    if "target" in solids:
        x, depth, side = (float(case[f"target_{key}"]) for key in ("x", "depth", "size"))
        assert solids["target"] == (side / 2, x, depth, case["target_reflectance"])


def result(energy, stderr, start=0.0):
    start = start + np.arange(len(energy), dtype=float)
    return score.Result(start, start + 1, np.array(energy, float), np.array(stderr, float))


def test_score_of_known_differences():
    """Relative differences 0.1, 0 and -0.2; 1, 0 and -4 standard errors of 3, 4, 5 triangles; one gate is not known."""
    reference = result([100, 200, 50, 10], [3, 4, 1.5, 5])
    found = score.score(result([105, 200, 40, 1000], [4, 3, 2, 1]), reference)
    assert (found.gates, found.all_gates) == (3, 4)
    assert found.rms == pytest.approx(np.sqrt((0.05**2 + 0.2**2) / 3))
    assert found.bias == pytest.approx(-5 / 350)
    assert found.bias_bound == pytest.approx(np.hypot(9, 8.5) / 350)
    assert found.chi_squared == pytest.approx((1 + 16) / 3)
    assert (found.worst_gate, found.worst_z) == (2, pytest.approx(-4))
    assert found.agrees
    assert not score.score(result([105, 200, 37, 10], [4, 3, 2, 1]), reference).agrees


@each_row(
    ("gate_start_ns,gate_end_ns,energy_j\n0,1,2\n", "no stderr_j"),
    ("gate_start_ns,gate_end_ns,energy_j,stderr_j\n0,1,nan,0\n", "must be finite"),
    ("gate_start_ns,gate_end_ns,energy_j,stderr_j\n0,1,1,-1\n", "stderr_j at least 0"),
    ("gate_start_ns,gate_end_ns,energy_j,stderr_j\n0,1,word,1\n", "word"),
    ("gate_start_ns,gate_end_ns,energy_j,stderr_j\n0,1,1,1\n", "gates must be those of cases.csv"),
)
def test_a_wrong_submission_is_refused_in_one_sentence(text, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "single_scattering.csv").write_text(text)
    monkeypatch.setattr(sys, "argv", ["score.py", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        score.main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out, len(err.splitlines())) == (2, "", 1)
    assert err.startswith("error: ")
    assert message in err
    assert not (tmp_path / "score.png").exists()


@pytest.mark.parametrize("name", ["layers", "mast"])
def test_single_scattering_is_that_of_the_oracle(name):
    """Another grid of rays over the beam, which times the bottom's echo in steps: sums agree to a thousandth."""
    case = CASES[name]
    numbers = single_scattering.numbers
    names = ("altitude", "off_nadir_deg", "refractive_index", "group_index", "divergence_mrad", "field_of_view_mrad")
    height, angle, index, group, beam, view = (float(case[key]) for key in names)
    system = LidarSystem(height, np.radians(angle), index, group, energy=1.0, aperture_area=1.0)
    layers = [numbers(case[key]) for key in ("layer_tops", "attenuation", "scattering", "backscattering")]
    ratio = layers[3][0] / layers[2][0]
    phase = case["phase_function"] == "hg"
    back = henyey_greenstein(np.pi, 0.0) if phase else fournier_forand(np.pi, *fournier_forand_parameters(ratio))
    width = float(case["bin_width_ns"])
    edges = float(case["time_start_ns"]) + width * np.arange(int(case["bin_count"]) + 1)
    depth = float(case.get("bottom_depth", 1e3))
    beam_and_view = system, 0.5e-3 * beam, WaterColumn(*layers)
    seen = lambda x, y: np.hypot(x, y) < 0.5e-3 * view  # noqa: E731
    expected = column_energy_per_bin(edges, *beam_and_view, [float(back)] * len(layers[0]), depth, seen)
    if "bottom_depth" in case:
        expected = expected + bottom_energy_per_bin(
            edges, *beam_and_view, depth, float(case["bottom_reflectance"]), seen
        )
    found = single_scattering.energies(case)
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)
    lit = expected > 1e-4 * expected.max()
    edge = 3e-3 * expected.max() if "bottom_depth" in case else 0.0
    np.testing.assert_allclose(found[lit], expected[lit], rtol=5e-3, atol=edge)
