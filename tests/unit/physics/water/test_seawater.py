"""Pure sea water against published formulas and measurements."""

import numpy as np
import pytest
from rows import each_row

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
