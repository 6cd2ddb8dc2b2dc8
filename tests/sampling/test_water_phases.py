"""Phase functions of layers: water and particles mixed, and many functions in one table."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from rows import each_case, each_row
from significance import largest_z

from mitransient_lidar.physics.water import phase as closed_form
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.physics.water.water_types import water_of
from mitransient_lidar.transport.medium.tabulated_phase import NumberedPhase

THETA = np.radians([0.1, 1.0, 5.0, 30.0, 60.0, 90.0, 120.0, 150.0, 180.0])


def values(phase, theta=THETA):
    mei = dr.zeros(mi.MediumInteraction3f, len(theta))
    mei.wi = mi.Vector3f(0, 0, -1)
    mei.sh_frame = mi.Frame3f(mei.wi)
    wo = mi.Vector3f(mi.Float(np.sin(theta)), 0, mi.Float(np.cos(theta)))
    return np.array(phase.eval_pdf(mi.PhaseFunctionContext(), mei, wo)[1])


def particles(ratio):
    return closed_form.fournier_forand(THETA, *closed_form.fournier_forand_parameters(ratio))


def test_water_and_particles_are_mixed_by_their_scattering():
    """A share taken of the backscattering, or water added to b instead of being part of it, shows at 90 degrees."""
    water = mi.load_dict(
        {"type": "layered_water", "scattering": 0.05, "backscattering": 0.0016, "water_scattering": 0.002}
    ).water
    expected = (0.048 * particles(0.0006 / 0.048) + 0.002 * water_phase_function(THETA)) / 0.05
    np.testing.assert_allclose(values(water.phases.at(mi.UInt32(0))), expected, rtol=2e-3)


NAMED = [("jerlov", "I"), ("jerlov", "1C"), ("chlorophyll", "0.1"), ("kd", "0.06"), ("secchi", "25")]


@each_row(*NAMED)
def test_waters_by_name_have_molecules_and_particles(kind, value):
    """Zhang's molecules [1/m] at 532 nm, and particles with the rest of b and of bb."""
    found, molecules = water_of(kind, value), 0.001962
    scattered = found.scattering - molecules
    ratio = (found.backscattering - molecules / 2) / scattered
    expected = (scattered * particles(ratio) + molecules * water_phase_function(THETA)) / found.scattering
    water = mi.load_dict({"type": "layered_water", kind: value}).water
    np.testing.assert_allclose(values(water.phases.at(mi.UInt32(0))), expected, rtol=3e-3)
    assert water.phases.phases[0].backscatter_ratio == pytest.approx(found.backscatter_ratio, rel=3e-3)


@each_row(*NAMED)
@each_row({"phase_function": "petzold"}, {"phase": {"type": "petzold"}})
def test_given_phase_functions_include_the_molecules_of_waters_by_name(own, kind, value):
    water = mi.load_dict({"type": "layered_water", kind: value, **own}).water
    plain = values(mi.load_dict({"type": "petzold"}))
    np.testing.assert_allclose(values(water.phases.at(mi.UInt32(0))), plain, rtol=1e-6)


def test_molecules_of_layers_by_name_follow_their_wavelength():
    texts = {"layer_tops": "0, 4", "chlorophyll": "0.1, 3", "wavelength_nm": 450}
    water = mi.load_dict({"type": "layered_water", **texts}).water
    for layer, concentration in enumerate(("0.1", "3")):
        found = water_of("chlorophyll", concentration, 450)
        part = found.water_scattering / found.scattering
        assert found.water_scattering == pytest.approx(0.001962 * (532 / 450) ** 4.3, rel=0.03)
        expected = (1 - part) * particles(found.particle_backscatter_ratio) + part * water_phase_function(THETA)
        one = water.phases.at(mi.UInt32([layer] * len(THETA)))
        np.testing.assert_allclose(values(one), expected, rtol=2e-3)


@each_case({}, {"phase_function": "petzold"}, {"phase_function": "hg"}, {"phase": {"type": "rayleigh"}})
def test_chi_changes_what_is_near_180_degrees(own):
    plain, changed = (mi.load_dict({"type": "layered_water", **own, **chi}).water for chi in ({}, {"chi_p": 0.5}))
    before, after = (values(water.phases.at(mi.UInt32(0))) for water in (plain, changed))
    # Up to 150 degrees all but unchanged; at 180 degrees bb/(2 pi chi).
    np.testing.assert_allclose(after[:6], before[:6], rtol=3e-3)
    np.testing.assert_allclose(after[6:8], before[6:8], rtol=1e-2)
    ratio = changed.phases.phases[0].backscatter_ratio
    assert after[-1] == pytest.approx(ratio / (2 * np.pi * 0.5), rel=2e-3)
    theta = np.linspace(np.pi / 2, np.pi, 4001)
    area = (
        2 * np.pi * np.trapezoid(values(one.phases.at(mi.UInt32(0)), theta) * np.sin(theta), theta)
        for one in (plain, changed)
    )
    assert ratio == pytest.approx(next(area), rel=3e-3)
    assert ratio == pytest.approx(next(area), rel=3e-3)


def test_chi_is_that_of_particles_in_each_layer():
    parts = {"layer_tops": "0, 2", "chi_p": "0.4, 2", "water_scattering": 0.002}
    water = mi.load_dict({"type": "layered_water", **parts}).water
    for layer, chi in enumerate((0.4, 2.0)):
        one = water.phases.at(mi.UInt32([layer] * len(THETA)))
        # bb = 0.006 and b = 0.15 1/m, of which molecules have 0.001 and 0.002.
        expected = (0.005 / (2 * np.pi * chi) + 0.002 * water_phase_function(np.pi)) / 0.15
        assert values(one)[-1] == pytest.approx(expected, rel=2e-3)


def test_samples_follow_chi():
    """Those beyond 170 degrees, by z-test: their share, and the mean of 1 / density over their solid angle."""
    count, edge = 2**21, np.radians(170)
    phase = mi.load_dict({"type": "layered_water", "chi_p": 0.2, "backscattering": 0.03}).water.phases.at(mi.UInt32(0))
    rng = mi.PCG32(count, initstate=11 + significance.seed_shift)
    mei = dr.zeros(mi.MediumInteraction3f, count)
    mei.wi = mi.Vector3f(0, 0, -1)
    pair = mi.Point2f(rng.next_float32(), rng.next_float32())
    wo, _, pdf = phase.sample(mi.PhaseFunctionContext(), mei, rng.next_float32(), pair)
    is_near = np.array(wo.z) < np.cos(edge)
    theta = np.linspace(edge, np.pi, 4001)
    expected = 2 * np.pi * np.trapezoid(values(phase, theta) * np.sin(theta), theta)
    assert expected > 1.8 * 0.2 * (1 + np.cos(edge))  # an even distribution of bb/b = 0.2, and a peak
    error = np.sqrt(expected / count)
    assert abs(is_near.mean() - expected) < largest_z(count, 2) * error + 1e-3 * expected
    inverse = np.where(is_near, 1 / np.array(pdf), 0)
    solid_angle = 2 * np.pi * (1 + np.cos(edge))
    assert abs(inverse.mean() - solid_angle) < largest_z(count, 2) * inverse.std() / np.sqrt(count)


@pytest.mark.parametrize("nested", [{"type": "hg", "g": 0.9}, {"type": "petzold"}])
def test_any_phase_function_is_mixed_with_the_water(nested):
    plain = values(mi.load_dict(nested))
    water = mi.load_dict({"type": "layered_water", "scattering": 0.1, "water_scattering": 0.02, "phase": nested}).water
    expected = 0.8 * plain + 0.2 * water_phase_function(THETA)
    np.testing.assert_allclose(values(water.phases.at(mi.UInt32(0))), expected, rtol=2e-3)


def test_water_without_particles_scatters_as_water():
    pure = {"scattering": 0.002, "backscattering": 0.001, "water_scattering": 0.002}
    water = mi.load_dict({"type": "layered_water", **pure}).water
    np.testing.assert_allclose(values(water.phases.at(mi.UInt32(0))), water_phase_function(THETA), rtol=1e-3)


def test_each_layer_has_its_function_in_the_table():
    water = mi.load_dict(
        {"type": "layered_water", "layer_tops": "0, 1, 2", "backscattering": "0.006, 0.003, 0.006"}
    ).water
    many = water.phases.at(mi.UInt32([0, 1, 2]))
    assert isinstance(many, NumberedPhase)
    assert many.functions.count == 2
    for layer, ratio in enumerate((0.04, 0.02, 0.04)):
        one = water.phases.at(mi.UInt32([layer] * len(THETA)))
        np.testing.assert_allclose(values(one), particles(ratio), rtol=2e-3)


def test_samples_of_the_table_follow_each_function():
    """Backscatter ratio and value by z-test: a wrong offset into the table would take a neighbour's segments."""
    ratios = (0.04, 0.01, 0.02)
    backscattering = ", ".join(str(0.15 * ratio) for ratio in ratios)
    water = mi.load_dict({"type": "layered_water", "layer_tops": "0, 1, 2", "backscattering": backscattering}).water
    count = 2**20
    for layer, ratio in enumerate(ratios):
        rng = mi.PCG32(count, initstate=3 + significance.seed_shift)
        mei = dr.zeros(mi.MediumInteraction3f, count)
        mei.wi = mi.Vector3f(0, 0, -1)
        phase = water.phases.at(dr.full(mi.UInt32, layer, count))
        pair = mi.Point2f(rng.next_float32(), rng.next_float32())
        wo, _, pdf = phase.sample(mi.PhaseFunctionContext(), mei, rng.next_float32(), pair)
        back = np.mean(np.array(wo.z) < 0)
        assert abs(back - ratio) < largest_z(count, 2) * np.sqrt(ratio / count)
        # The mean of 1 / density over a hemisphere's samples is its solid angle.
        inverse = np.where(np.array(wo.z) < 0, 1 / np.array(pdf), 0)
        assert abs(inverse.mean() - 2 * np.pi) < largest_z(count, 2) * inverse.std() / np.sqrt(count)


@each_row(
    ({"water_scattering": 0.2}, "water_scattering = 0.2 must be at least 0 and at most scattering = 0.15"),
    ({"water_scattering": "0.1, 0.1"}, "water_scattering has 2 values but must have 1 or 1"),
    ({"water_scattering": 0.0022, "backscattering": 0.001}, "backscattering = 0.001 must be at least half of"),
    ({"chi_p": "1, 1"}, "chi_p has 2 values but must have 1 or 1"),
    ({"backscattering": 0.0}, "backscatter_ratio = 0 must lie between"),
    ({"refractive_index": "1.3, 1.4"}, "refractive_index has 2 values but must have 1 or 1"),
)
def test_errors(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "layered_water", **parameters})
