"""Gain of the lidar equation."""

import numpy as np
import pytest

from mitransient_lidar.physics.lidar.level_sea import LidarGeometry, LidarSystem


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
