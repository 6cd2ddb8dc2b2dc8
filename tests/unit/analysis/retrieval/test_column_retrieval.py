"""Water and bottom from columns, against closed forms."""

import math

import numpy as np
import pytest
from oracles.lidar_equation import bottom_energy, column_power, cos_water
from rows import each_row

from mitransient_lidar.analysis.retrieval.column_retrieval import bottom_class, bottom_reflectance, water_of_column
from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.water_types import water_of

THETA = math.radians(20)
SYSTEM = LidarSystem(200, THETA, 1.34, 1.364, energy=3.645e-3, aperture_area=0.025)
A, BB = np.array([0.05, 0.15, 0.4]), np.array([0.002, 0.006, 0.03])
KD = A + 4.18 * (1 - 0.52 * np.exp(-10.8 * A)) * BB  # Lee, Du and Arnone (2005)


def test_level_of_the_lidar_equation():
    water = WaterColumn([0], [0.3], [0.15], [0.006])
    power = column_power(SYSTEM, water, 1.7e-3, 0.0, THETA)
    assert power / SYSTEM.column_gain == pytest.approx(0.15 * 1.7e-3, rel=1e-12)


def test_water_of_its_own_level_and_decay():
    found = water_of_column(A + 0.02, 1.13 * BB / (2 * np.pi), excess=0.02, level=1.13)
    np.testing.assert_allclose(found.absorption, A, rtol=1e-6)
    np.testing.assert_allclose(found.backscattering, BB, rtol=1e-6)
    np.testing.assert_allclose(found.kd, KD, rtol=1e-6)
    # Molecules scatter 0.0019623 1/m (Zhang, Hu and He 2009), a half of it backwards; the rest is by particles.
    for values, ratio in ((found.attenuation, 0.0183), (found.attenuation_low, 0.05), (found.attenuation_high, 0.003)):
        np.testing.assert_allclose(values, A + 0.0019623 + (BB - 0.0019623 / 2) / ratio, rtol=1e-4)


@each_row("jerlov I", "jerlov 9C", "chlorophyll 0.01", "chlorophyll 30", "petzold turbid")
def test_bounds_of_attenuation_include_waters_by_name(name):
    water = water_of(*name.split())
    found = water_of_column(water.absorption, water.backscattering / (2 * np.pi), 0.0, 1.0)
    assert found.attenuation_low < water.attenuation < found.attenuation_high


def test_columns_that_no_water_makes_are_nan():
    found = water_of_column([0.05, np.nan, -0.1, 0.1, 0.1], [1e-3, 1e-3, 1e-3, np.nan, -1e-3], 0.06, 1.0)
    assert np.isnan(found.kd).all()


def test_kd_is_near_that_of_an_independent_study():
    """Kirk (1984), doi:10.4319/lo.1984.29.2.0350, for the sun at the zenith and a phase function of Petzold."""
    waters = (0.0532, 0.124, 0.00196), (0.179, 0.219, 0.00293), (0.0951, 0.432, 0.00944)
    for absorption, scattering, backscattering in waters:
        found = water_of_column(absorption, backscattering / (2 * math.pi), 0.0, 1.0)
        assert 0.87 < float(found.kd) / math.sqrt(absorption**2 + 0.235 * absorption * scattering) < 0.98


def test_reflectance_is_the_ratio_of_bottom_and_column():
    """Both from the lidar equation, single scattering: what lies above cancels, at any depth."""
    water = WaterColumn([0], [0.3], [0.15], [0.006])
    for depth in (2.0, 8.0, 15.0):
        energy = bottom_energy(SYSTEM, water, depth, 0.23, THETA)
        power = column_power(SYSTEM, water, 1.7e-3, depth, THETA)
        found = bottom_reflectance(energy, power, 0.15 * 1.7e-3, cos_water(SYSTEM, THETA), 1.364)
        assert found == pytest.approx(0.23, rel=1e-12)
    assert np.isnan(bottom_reflectance(1.0, 0.0, 1e-3, 1.0, 1.364))
    assert bottom_reflectance(1e-12, 1e-4, 1e-3, 1.0, 1.0) == pytest.approx(math.pi * C0 / 2 * 1e-3 * 1e-8)


def test_classes():
    share = bottom_class([0.05, 0.1, 0.3, np.nan], [0.05, 0.02, 0.0, 0.1])
    # Normal distribution function at 1 and 3, and at 0 and 5.
    np.testing.assert_allclose(share[0], [0.8413447, 0.9986501 - 0.8413447, 1 - 0.9986501], atol=1e-6)
    np.testing.assert_allclose(share[1], [0.5, 0.5, 2.9e-7], atol=1e-6)
    assert share[2].tolist() == [0, 0, 1]
    assert np.isnan(share[3]).all()
