"""Sea water, and the waters that Petzold measured."""

import numpy as np
import pytest
from rows import each_row
from scipy.integrate import simpson

from mitransient_lidar.physics.water.phase import PETZOLD_WATERS, petzold_water
from mitransient_lidar.physics.water.seawater import (
    group_index,
    refractive_index,
    water_absorption,
    water_phase_function,
    water_scattering,
)


def test_indices_are_quan_and_fry_relative_to_air():
    n = refractive_index(532, [20, 20, 10, 10], [0, 35, 35, 7])
    np.testing.assert_allclose(n, [1.335035, 1.341510, 1.342395, 1.337056], rtol=0, atol=1e-6)
    np.testing.assert_allclose(group_index(532, [20, 10], [35, 7]), [1.363796, 1.358813], rtol=0, atol=1e-6)
    # Pure water at 20 degrees C and 589.3 nm has 1.33299 relative to air; relative to vacuum it would be 1.33336.
    assert refractive_index(589.3, 20, 0) == pytest.approx(1.33299, abs=5e-5)


@each_row(410, 532, 690, 710, 1064)
@each_row((0, 0), (5, 38), (30, 7))
def test_group_index_is_the_derivative_of_the_index(temperature, salinity, wavelength):
    step = 0.01
    up, down = (refractive_index(wavelength + s, temperature, salinity) for s in (step, -step))
    expected = refractive_index(wavelength, temperature, salinity) - wavelength * (up - down) / (2 * step)
    assert group_index(wavelength, temperature, salinity) == pytest.approx(float(expected), abs=2e-9)


def test_absorption_is_pope_and_fry():
    found = water_absorption([400, 525, 527.5, 530, 532.5, 535, 600, 700])
    np.testing.assert_array_equal(found, [0.00663, 0.0417, 0.0428, 0.0434, 0.0447, 0.0452, 0.2224, 0.624])
    assert water_absorption(532) == pytest.approx(0.04444, abs=1e-8)


@each_row((1064, 1.21925e-6, 0.005), (1000, 3.19106e-6, 0.02))
def test_near_infrared_agrees_with_kedenburg(wavelength, extinction, tolerance):
    """Absorption 4 pi k / wavelength, and index of water at 20 degrees C, by Kedenburg et al. 2012 (other cells)."""
    assert water_absorption(wavelength) == pytest.approx(4e9 * np.pi * extinction / wavelength, rel=tolerance)

    def index(lam):
        square = (1e-3 * lam) ** 2
        return np.sqrt(1 + 0.75831 * square / (square - 0.01007) + 0.08495 * square / (square - 8.91377)) / 1.000274

    assert refractive_index(wavelength, 20, 0) == pytest.approx(index(wavelength), abs=1e-3)
    group = index(wavelength) - wavelength * (index(wavelength + 1) - index(wavelength - 1)) / 2
    assert group_index(wavelength, 20, 0) == pytest.approx(group, abs=2e-3)
    # The formula for the visible is 0.0049 lower at 1064 nm.
    assert refractive_index(wavelength) - refractive_index(wavelength, 20, 0) == pytest.approx(0.0061, abs=1e-4)


def test_nothing_jumps_at_700_nm():
    for of, most in ((refractive_index, 5e-5), (group_index, 3e-4), (water_absorption, 1e-3), (water_scattering, 1e-6)):
        assert of(700.001) == pytest.approx(of(700), abs=most)


def test_scattering_is_zhang_hu_and_he():
    b = water_scattering(532, [20, 10, 10, 20], [35, 35, 7, 0])
    np.testing.assert_allclose(b, [0.001962, 0.002004, 0.001633, 0.001510], rtol=0, atol=6e-7)
    beta = water_scattering(532) * water_phase_function(np.radians([90, 180]))
    np.testing.assert_allclose(beta, [1.1936e-4, 2.2975e-4], rtol=1e-4)


def test_scattering_agrees_with_morels_measurements():
    # Morel (1974) has 0.00288 1/m at 500 nm and 38.4 per mille, made with a depolarisation of 0.09; his data fall with
    # the power -4.32 by himself and -4.24 by Jonasz and Fournier. The fourth power alone would give -4.
    b = water_scattering([450, 500, 550], 20, 38.4, 0.09)
    assert b[1] == pytest.approx(0.00288, rel=0.02)
    assert np.log(b[2] / b[0]) / np.log(550 / 450) == pytest.approx(-4.24, abs=0.05)


def test_depolarisation_raises_scattering_by_the_cabannes_factor():
    # (6 + 6 d)/(6 - 7 d) (2 + d)/(1 + d) at 0.09 over 0
    ratio = water_scattering(532, depolarisation=0.09) / water_scattering(532, depolarisation=0)
    assert ratio == pytest.approx((6 * 2.09) / (6 - 0.63) / 2, rel=1e-12)


@each_row(0.0, 0.039, 0.09)
def test_phase_function_is_normalised_and_symmetric(depolarisation):
    nodes, weights = np.polynomial.legendre.leggauss(4)
    values = water_phase_function(np.arccos(nodes), depolarisation)
    assert 2 * np.pi * np.sum(weights * values) == pytest.approx(1, rel=1e-13)
    np.testing.assert_allclose(values, values[::-1], rtol=1e-13)


def test_phase_function_is_rayleigh_without_depolarisation_and_morel_with_his():
    assert water_phase_function(np.pi, 0) == pytest.approx(0.119366, abs=1e-6)
    assert water_phase_function(np.pi / 2, 0.09) == pytest.approx(0.06225, abs=5e-6)
    assert water_phase_function(0, 0.09) == pytest.approx(0.06225 * 1.835, rel=1e-4)


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
