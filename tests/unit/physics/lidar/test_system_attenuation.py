"""System attenuation against the limits of Gordon (1982) and numbers worked out by hand."""

import pytest
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.axis_limits import system_attenuation


@each_row(
    (0.3, 0.17, 0.0, 0.3, 1e-15),
    # Gordon: Kd beyond c R of 5 to 6. Here c R = 5, D = 2 R: exp(-8.5) = 2.0e-4 of c - Kd is left.
    (0.5, 0.1, 20.0, 0.1 + 0.4 * 2.035e-4, 1e-6),
    # c D = 1: exp(-0.85) = 0.42741; with the radius in place of the diameter it would be exp(-0.425) = 0.65377.
    (0.25, 0.05, 4.0, 0.05 + 0.2 * 0.42741, 1e-5),
)
def test_from_c_for_narrow_spots_to_kd_for_wide_ones(attenuation, kd, spot, expected, tolerance):
    assert system_attenuation(attenuation, kd, spot) == pytest.approx(expected, rel=tolerance)
    with pytest.raises(UserError, match=r"kd = 0\.6 must not exceed attenuation = "):
        system_attenuation(attenuation, [0.05, 0.6], 1)
