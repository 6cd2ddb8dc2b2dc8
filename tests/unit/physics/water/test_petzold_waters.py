"""Petzold's waters against numbers printed in his report: sums, medians, normalised values."""

import numpy as np
import pytest
from scipy.integrate import simpson

from mitransient_lidar.physics.water.phase import PETZOLD_WATERS, petzold_water

# Summary pages of SIO Ref. 72-78: c and bb/b; median angle [deg]; fraction of b and power below 0.1 degree;
# p at 20, 40, 45 and 90 degrees [1/sr].
REPORT = {
    "clear": (0.151, 0.044, 6.252, 0.033751, -1.191, (0.29474, 0.050931, 0.036785, 0.0065953)),
    "coastal": (0.398, 0.013, 2.534, 0.12541, -1.545, (0.20184, 0.027421, 0.018892, 0.0023897)),
    "turbid": (2.190, 0.020, 4.680, 0.052323, -1.346, (0.24405, 0.043377, 0.032108, 0.0046105)),
    "autec_7": (0.199, 0.025, 2.815, None, -1.599, None),
    "autec_9": (0.165, 0.038, 5.203, None, -1.248, None),
    "haoce_5": (0.470, 0.014, 2.152, None, -1.546, None),
    "nuc_2200": (1.920, 0.019, 4.497, None, -1.249, None),
    "nuc_2240": (1.330, 0.018, 4.682, None, -1.442, None),
}
# The tables' volume scattering functions [1/(m sr)] at 0.1, 1, 10 and 180 degrees.
PRINTED = {
    "clear": (53.182, 2.4976, 0.041620, 5.0190e-4),
    "coastal": (653.29, 16.623, 0.21554, 1.0302e-3),
    "turbid": (3262.0, 132.88, 2.1107, 5.6857e-3),
    "autec_7": (355.78, 7.7116, 0.099396, 8.1475e-4),
    "autec_9": (75.181, 2.9964, 0.044602, 5.0708e-4),
    "haoce_5": (871.25, 22.014, 0.24154, 1.4616e-3),
    "nuc_2200": (2689.7, 120.98, 1.7321, 6.2107e-3),
    "nuc_2240": (2215.3, 80.269, 1.4749, 3.5956e-3),
}

WATERS = pytest.mark.parametrize("name", REPORT)


def fraction(p, low, high):
    """Share of the light scattered between two angles [rad], by Simpson's rule in ln(theta)."""
    x = np.linspace(np.log(low), np.log(high), 100_001)
    theta = np.exp(x)
    return simpson(2 * np.pi * p(theta) * np.sin(theta) * theta, x=x)


@WATERS
def test_normalised_and_divided_as_the_report_says(name):
    p = petzold_water(name)
    _, ratio, median, below, _, _ = REPORT[name]
    # The cone below 1e-12 rad contains 3e-5 of the light of the steepest.
    assert fraction(p, 1e-12, np.pi) == pytest.approx(1, abs=4e-5)
    assert fraction(p, np.pi / 2, np.pi) == pytest.approx(ratio, abs=5e-4)
    assert fraction(p, 1e-12, np.radians(median)) == pytest.approx(0.5, abs=1.2e-3)
    if below is not None:
        assert fraction(p, 1e-12, np.radians(0.1)) == pytest.approx(below, rel=1.2e-2)


@WATERS
def test_values_are_the_printed_ones(name):
    p = petzold_water(name)
    if REPORT[name][-1] is not None:
        np.testing.assert_allclose(p(np.radians([20, 40, 45, 90])), REPORT[name][-1], rtol=4e-3)
    theta = np.radians([0.1, 1, 10, 180])
    np.testing.assert_allclose(p(theta) / p(np.pi), np.divide(PRINTED[name], PRINTED[name][-1]), rtol=1e-12)
    # Times b, which the report gives to 1e-3 1/m, they are the volume scattering function.
    _, b = PETZOLD_WATERS[name]
    np.testing.assert_allclose(b * p(theta), PRINTED[name], rtol=3e-3 + 5e-4 / b)


@WATERS
def test_between_angles_and_below_the_first_it_is_a_power(name):
    p = petzold_water(name)
    # 15 and 20 degrees are neighbours in the table.
    assert p(np.radians(np.sqrt(15 * 20))) == pytest.approx(np.sqrt(p(np.radians(15)) * p(np.radians(20))), rel=1e-12)
    power = np.log10(p(1e-5) / p(1e-6))
    assert power == pytest.approx(REPORT[name][4], abs=0.012)
    assert power == pytest.approx(np.log10(p(np.radians(0.1)) / p(np.radians(0.01))), rel=1e-9)
    # From theta^-2 on the integral would diverge.
    assert power > -2
    assert p(0.0) == np.inf


def test_absorption_and_scattering_add_up_to_the_attenuation():
    assert PETZOLD_WATERS.keys() == REPORT.keys()
    for name, (absorption, scattering) in PETZOLD_WATERS.items():
        assert absorption + scattering == pytest.approx(REPORT[name][0], abs=1e-12)
