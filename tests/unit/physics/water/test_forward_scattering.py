"""Displacements by forward scattering, against their moments."""

import numpy as np
import pytest
import significance
from oracles.phase import henyey_greenstein

from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import displacements

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
