"""System attenuation against the limits of Gordon (1982) and numbers worked out by hand."""

import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.axis_limits import system_attenuation


def test_narrow_spot_decays_with_c():
    assert system_attenuation(0.3, 0.17, 0.0) == pytest.approx(0.3, rel=1e-15)


def test_wide_spot_decays_with_kd():
    # Gordon: Kd beyond c R of 5 to 6. Here c R = 5, D = 2 R: exp(-8.5) = 2.0e-4 of c - Kd is left.
    excess = system_attenuation(0.5, 0.1, 20.0) - 0.1
    assert excess == pytest.approx(0.4 * 2.035e-4, rel=1e-3)


def test_between_the_limits():
    # c D = 1: exp(-0.85) = 0.42741; with the radius in place of the diameter it would be exp(-0.425) = 0.65377.
    assert system_attenuation(0.25, 0.05, 4.0) == pytest.approx(0.05 + 0.2 * 0.42741, rel=1e-5)


def test_diffuse_light_decays_no_faster_than_the_beam():
    with pytest.raises(UserError, match=r"kd = 0\.2 must not exceed attenuation = 0\.1"):
        system_attenuation(0.1, [0.05, 0.2], 1)
