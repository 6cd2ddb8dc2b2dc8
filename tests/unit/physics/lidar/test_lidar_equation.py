"""Gain of the lidar equation."""

import numpy as np
import pytest

from mitransient_lidar.physics.lidar.lidar_equation import LidarSystem


def test_gain_at_nadir():
    # E A T^2 / (n H + D)^2 with the normal-incidence transmittance 1 - ((n - 1)/(n + 1))^2
    system = LidarSystem(height=200, off_nadir=0, energy=2, aperture_area=0.025)
    transmittance = 1 - (0.34 / 2.34) ** 2
    assert system.water_gain(8, 0) == pytest.approx(2 * 0.025 * transmittance**2 / (1.34 * 200 + 8) ** 2, rel=1e-12)
    assert system.water_gain(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"height": 0}, "height = 0 must be greater than 0"),
        ({"off_nadir": 1.6}, "off_nadir = 1.6 must be at least 0 and below pi/2"),
        ({"refractive_index": 0.9}, "refractive_index = 0.9 must be at least 1"),
        ({"group_index": 0.9}, "group_index = 0.9 must be at least 1"),
    ],
)
def test_invalid_systems_are_rejected(parameters, message):
    with pytest.raises(ValueError, match=message):
        LidarSystem(**({"height": 200, "off_nadir": 0.3, "energy": 1, "aperture_area": 1} | parameters))
