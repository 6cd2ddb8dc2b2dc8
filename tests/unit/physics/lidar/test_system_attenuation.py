"""System attenuation against the limits of Gordon (1982) and numbers worked out by hand."""

import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.system_attenuation import system_attenuation


def test_narrow_spot_decays_with_c():
    assert system_attenuation(0.3, 0.17, 0.0) == pytest.approx(0.3, rel=1e-15)


def test_wide_spot_decays_with_kd():
    # Gordon: Kd beyond c R of 5 to 6. Here c R = 5, D = 2 R: exp(-8.5) = 2.0e-4 of c - Kd is left.
    excess = system_attenuation(0.5, 0.1, 20.0) - 0.1
    assert excess == pytest.approx(0.4 * 2.035e-4, rel=1e-3)


def test_diffuse_light_decays_no_faster_than_the_beam():
    with pytest.raises(UserError, match=r"kd = 0\.2 must not exceed attenuation = 0\.1"):
        system_attenuation(0.1, [0.05, 0.2], 1)
