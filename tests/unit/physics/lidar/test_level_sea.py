"""Rays through a level sea, and the gain of the lidar equation."""

import numpy as np
import pytest
from oracles.refracted_path import refracted_path

from mitransient_lidar.physics.lidar.level_sea import LevelSea, LidarGeometry, LidarSystem, snell

HEIGHT, N = 200.0, 1.34
ORIGIN = np.array([3.0, -2.0, HEIGHT])
LAYERED = LevelSea((1.33, 1.34, 1.36), (2.0, 5.0))


def rays(theta, azimuth):
    return np.stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), -np.cos(theta)], axis=-1)


@pytest.mark.parametrize("z", [-8.0, -0.5, 0.0, 3.0])
def test_points_at_a_height(z):
    theta, azimuth = np.radians([0, 5, 20, 60, 84.6]), np.radians([0, 30, 120, 200, 300])
    distance = (HEIGHT - max(z, 0)) * np.tan(theta) + max(-z, 0) * np.tan(snell(theta, N))
    expected = ORIGIN[:2] + distance[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    np.testing.assert_allclose(LevelSea((N,)).at_height(ORIGIN, 7 * rays(theta, azimuth), z), expected, rtol=1e-12)


def test_index_layers_refract_in_turn():
    theta = np.radians(40)
    thicknesses = {1.33: 2.0, 1.34: 3.0, 1.36: 4.0}
    expected = HEIGHT * np.tan(theta) + sum(d * np.tan(snell(theta, n)) for n, d in thicknesses.items())
    (found,) = LAYERED.at_height(ORIGIN, rays(np.array([theta]), 0.0), -9.0)
    np.testing.assert_allclose(found - ORIGIN[:2], [expected, 0], rtol=1e-12, atol=1e-12)


def test_rays_above_the_horizon_meet_nothing():
    assert np.isnan(LAYERED.at_height(ORIGIN, [[1.0, 0, 0], [1, 0, 0.1]], -1.0)).all()
    assert np.isnan(LAYERED.crossing(ORIGIN, [[1.0, 0, HEIGHT]])).all()


def test_crossing_closes_over_all_scales():
    """With the tangents of Snell's angles on both sides of the crossing, and with that of bisection."""
    rng = np.random.default_rng(3)
    for rho, height, depth in 10 ** rng.uniform(-6, 4, (100, 3)):
        x, y = LevelSea((N,)).crossing(np.array([0, 0, height]), [rho, 0, -depth])
        theta = np.arctan2(x, height)
        assert height * np.tan(theta) + depth * np.tan(snell(theta, N)) == pytest.approx(rho, rel=1e-6)
        assert (theta, y) == (pytest.approx(refracted_path(rho, height, depth, N)[0], abs=1e-12), 0)


def test_crossing_inverts_points_at_a_height():
    z = np.array([-9.0, -3.0, -1.0, -30.0, 0.0, 5.0, -4.0])
    directions = rays(np.radians([0, 1, 20, 60, 45, 30, 89]), np.radians([0, 10, 100, 190, 280, 300, 20]))
    points = np.column_stack([LAYERED.at_height(ORIGIN, directions, z), z])
    np.testing.assert_allclose(LAYERED.crossing(ORIGIN, points), LAYERED.at_height(ORIGIN, directions, 0.0), atol=1e-6)


def test_gain_at_nadir():
    # E A T^2 / (n H + D)^2 with the normal-incidence transmittance 1 - ((n - 1)/(n + 1))^2
    system = LidarSystem(200, 0, 1.34, 1.34, energy=2, aperture_area=0.025)
    transmittance = 1 - (0.34 / 2.34) ** 2
    assert system.water_gain(8, 0) == pytest.approx(2 * 0.025 * transmittance**2 / (1.34 * 200 + 8) ** 2, rel=1e-12)
    assert system.water_gain(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3)


def test_depth_and_time():
    # 8 m of water under n_g = 1.364, axis at 14.8 degrees in the water: 2 * 1.364 * 8 / cos / c0 = 75.29 ns.
    geometry = LidarGeometry(200.0, np.arcsin(1.34 * np.sin(np.radians(14.8))), 1.34, 1.364, surface_time_ns=1420.0)
    assert float(geometry.time_of_depth(8.0)) == pytest.approx(1420 + 75.295, abs=2e-3)
    depths = np.array([-1.0, 0, 3, 20])
    np.testing.assert_allclose(geometry.depth_of_time(geometry.time_of_depth(depths)), depths, atol=1e-9)
    with pytest.raises(ValueError, match="time_ns holds nan"):
        geometry.depth_of_time([1.0, np.nan])
