"""Light spread by forward scattering on one way and on both, against moments of small angles."""

import numpy as np
import pytest
import significance
from oracles.phase import henyey_greenstein

from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import TwoWaySpread, displacements

DEPTHS = np.array([2.0, 4.0])
#: Angle of the peak of phase functions [rad].
NARROW = 0.02


def gaussian(width):
    """Return a phase function exp(-theta^2 / 2 width^2), whose mean square angle is 2 width^2."""
    return PowerLawTable.from_function(lambda theta: np.exp(-0.5 * (theta / width) ** 2) + 1e-12)


def spreads(column, phases, cos_water=1.0, paths=256, count=8):
    seeds = significance.seed_shift + np.arange(count)
    return [TwoWaySpread.of_column(column, phases, DEPTHS, cos_water, paths, int(seed)) for seed in seeds]


def share(column, cos_water=1.0):
    """Return the share of the light that scatters on either way, at each depth."""
    return -np.expm1(-2 * column.optical_depth_of_scattering(DEPTHS) / cos_water)


def test_displacement_and_delay_of_small_angles():
    """Fermi and Eyges: b <theta^2> z^3 / 3 one way; the excess length is b <theta^2> z^2 / 4 one way."""
    b = 0.3
    column, square = WaterColumn.from_text(0.0, 0.3, b, 1e-6), 2 * NARROW**2
    found = spreads(column, [gaussian(NARROW)], paths=512)
    moved = [share(column) * (each.shift_x**2 + each.shift_y**2).mean(axis=1) for each in found]
    significance.assert_equal(moved, 2 * b * square * DEPTHS**3 / 3, error=0.03, bias=2e-3)
    late = [share(column) * each.excess.mean(axis=1) for each in found]
    significance.assert_equal(late, 2 * b * square * DEPTHS**2 / 4, error=0.02, bias=2e-3)


def test_layers_that_scatter_below_move_light_less():
    """Only the lower half scatters: b <theta^2> (z/2)^3 / 3 one way at the last depth, nothing at the first."""
    b = 0.6
    column = WaterColumn.from_text("0, 2", "0.1, 0.7", f"0, {b}", "0, 1e-6")
    found = spreads(column, [gaussian(NARROW)] * 2, paths=1024)
    assert all(each.of_bottom[0].max() < 1e-6 for each in found)
    moved = [share(column)[1:] * (each.shift_x**2 + each.shift_y**2).mean(axis=1)[1:] for each in found]
    significance.assert_equal(moved, [2 * b * 2 * NARROW**2 * 2.0**3 / 3], error=0.03, bias=2e-3)


def test_forward_scattering_loses_no_light():
    """Without absorption all light of a forward peak comes down and back; absorption is that of the longer path."""
    found = spreads(WaterColumn.from_text(0.0, 0.5, 0.5, 1e-6), [gaussian(NARROW)])
    tilted = spreads(WaterColumn.from_text(0.0, 0.5, 0.5, 1e-6), [gaussian(NARROW)], 0.9)
    np.testing.assert_allclose([each.of_bottom.mean(axis=1) for each in (*found, *tilted)], 1, atol=1e-3)
    absorbing = spreads(WaterColumn.from_text(0.0, 2.5, 0.5, 1e-6), [gaussian(NARROW)])
    for clear, dark in zip(found, absorbing, strict=True):
        np.testing.assert_allclose(dark.of_bottom.mean(axis=1), np.exp(-2 * clear.excess).mean(axis=1), atol=3e-3)


def test_isotropic_scattering_loses_what_turns_back():
    """Of light that scatters once by any angle, half goes on down: 1 - b z / 2 one way in the limit of few events."""
    b = 0.01
    column = WaterColumn.from_text(0.0, b, b, b / 2)
    isotropic = PowerLawTable.from_function(lambda theta: np.ones_like(theta))
    found = spreads(column, [isotropic], paths=1024)
    # Events are at even places, and level directions do not come down.
    kept = [each.of_bottom.mean(axis=1) for each in found]
    significance.assert_equal(kept, np.full(2, 0.5), error=0.02, bias=0.02)


THETA = np.linspace(0, np.radians(80), 100_001)


def mean_square_tangent(g):
    density = 2 * np.pi * henyey_greenstein(THETA, g) * np.sin(THETA)
    return np.trapezoid(density * np.tan(THETA) ** 2, THETA) / np.trapezoid(density, THETA)


def table(g):
    return PowerLawTable.from_function(lambda theta: henyey_greenstein(theta, g))


def mean_squares(column, phases, depths, most):
    """Return mean squares of the displacements that are not lost, of 16 parts."""
    found = []
    for number in range(16):
        rng = np.random.default_rng([number, significance.seed_shift])
        moved = np.abs(displacements(column, phases, depths, most, 20_000, rng))
        found.append(np.mean(moved**2, axis=-1, where=moved < 1e5))
    return np.array(found)


def test_mean_squares_by_number_of_events():
    """Independent events at uniform depths: <tan^2> z^2 / 3 each."""
    depths = np.array([2.0, 6.0])
    found = mean_squares(WaterColumn([0.0], [0.3], [0.2], [1e-3]), [table(0.995)], depths, 3)
    wanted = mean_square_tangent(0.995) * depths[:, None] ** 2 / 3 * np.arange(4)
    assert np.all(found[:, :, 0] == 0)
    significance.assert_equal(found[:, :, 1:], wanted[:, 1:], error=0.08, bias=2e-3)


def test_layers_scatter_by_their_optical_depth():
    """All events in the second layer, from 3 to 4 m, of another function: <tan^2> (7^3 - 6^3)/3 at 10 m."""
    column = WaterColumn([0.0, 3.0, 4.0], [0.2, 0.5, 0.2], [1e-12, 0.4, 1e-12], [1e-14, 1e-3, 1e-14])
    found = mean_squares(column, [table(0.9), table(0.995), table(0.9)], np.array([10.0]), 1)
    wanted = mean_square_tangent(0.995) * (7.0**3 - 6.0**3) / 3
    significance.assert_equal(found[:, 0, 1], wanted, error=0.08, bias=2e-3)


def test_depth_above_all_scattering():
    column = WaterColumn([0.0, 3.0], [0.2, 0.5], [0.0, 0.4], [0.0, 1e-3])
    moved = displacements(column, [table(0.9)] * 2, np.array([2.0]), 2, 100, np.random.default_rng(1))
    assert np.all(np.isfinite(moved))
    assert moved.shape == (1, 3, 100)
    assert np.abs(moved[0, 0]).max() == pytest.approx(0)
