"""Waters by Jerlov type, chlorophyll, Kd and Secchi depth, against published values."""

import numpy as np
import pytest
import significance
from oracles.diffuse_attenuation import diffuse_attenuation
from rows import each_case, each_row, must_refuse

from mitransient_lidar.physics.water.seawater import water_absorption
from mitransient_lidar.physics.water.water_types import (
    InherentProperties,
    chlorophyll,
    from_kd,
    from_secchi,
    jerlov,
    near_infrared,
    pure_seawater,
    water_of,
)

JERLOV_KD = {"I": 0.0486, "IA": 0.0533, "IB": 0.0590, "II": 0.0796, "III": 0.1171}
JERLOV_KD |= {"1C": 0.1272, "3C": 0.1972, "5C": 0.3072, "7C": 0.4816, "9C": 0.738}


def test_derived_properties():
    water = InherentProperties(0.1, 0.3, 0.006)
    assert water.attenuation == pytest.approx(0.4)
    assert water.albedo == pytest.approx(0.75)
    assert water.backscatter_ratio == pytest.approx(0.02)
    # Square root of 0.01 + 4.10 * 0.1^0.934 * 0.006^0.849 * 0.3^0.217, and with 0.002 of the scattering by molecules.
    assert water.kd == pytest.approx(0.1215523, abs=1e-7)
    mixed = InherentProperties(0.1, 0.302, 0.007, 0.002)
    assert mixed.kd**2 - water.kd**2 == pytest.approx(1.6 * 0.1 * 0.002, rel=1e-9)
    assert mixed.particle_backscatter_ratio == pytest.approx(0.02)


def test_pure_seawater_at_532_and_nothing_in_the_water():
    water, empty = pure_seawater(), InherentProperties(0, 0, 0)
    assert (water.absorption, water.scattering) == pytest.approx((0.04444, 0.001962), abs=1e-6)
    assert water.backscatter_ratio == 0.5
    assert (empty.albedo, empty.backscatter_ratio, empty.kd) == (0, 0, 0)


@each_row(("jerlov", "9C"), ("chlorophyll", "1"), ("kd", "0.1"), ("secchi", "3"), ("petzold", "turbid"))
def test_waters_with_particles_in_the_near_infrared(kind, value):
    """Pure water absorbs; half of the particles' scattering at 532 nm is left, and 6e-4 of the dissolved matter's."""
    green, found = water_of(kind, value), water_of(kind, value, 1064.0)
    other = green.absorption - water_absorption(532)
    assert found.absorption - water_absorption(1064) == pytest.approx(np.exp(-0.014 * 532) * other, rel=1e-6)
    assert found.scattering - found.water_scattering == pytest.approx(0.5 * (green.scattering - green.water_scattering))
    if kind != "petzold":
        assert found.particle_backscatter_ratio == pytest.approx(green.particle_backscatter_ratio)
        assert found.water_scattering == water_of("pure", None, 1064.0).scattering


def test_particles_of_no_molecules_stay_without():
    assert near_infrared(InherentProperties(0.15, 0.15, 0.006), 1064.0).water_scattering == 0
    must_refuse("wavelength_nm = 690 must lie between 700 and 1100", lambda: near_infrared(jerlov("II"), 690.0))


@each_row(*JERLOV_KD.items())
def test_jerlov_types_have_jerlovs_kd_and_agree_with_lees_formula(water_type, kd):
    """Lee, Du and Arnone (2005), which is linear in bb: too much where that is more than a tenth of a."""
    water, inverse = jerlov(water_type), from_kd(kd)
    assert water.kd == pytest.approx(kd, rel=1e-9)
    for name in ("absorption", "scattering", "backscattering"):
        assert getattr(inverse, name) == pytest.approx(getattr(water, name), rel=1e-9)
    lee = water.absorption + 4.18 * (1 - 0.52 * np.exp(-10.8 * water.absorption)) * water.backscattering
    assert lee == pytest.approx(water.kd, rel=0.025 if water.kd < 0.3 else 0.07)


@each_row(
    *(("IB", 0.124, 0.010), ("II", 0.179, 0.010), ("III", 0.290, 0.010), ("1C", 0.432, 0.0183)),
    *(("3C", 0.651, 0.0183), ("5C", 1.21, 0.0183), ("7C", 2.49, 0.0183), ("9C", 3.31, 0.0183)),
)
def test_jerlov_types_have_the_published_properties(water_type, scattering, ratio):
    water = jerlov(water_type)
    assert water.scattering == scattering
    assert (water.backscattering - 0.001962 / 2) / (scattering - 0.001962) == pytest.approx(ratio, rel=1e-3)


@each_row((0.1, 0.0558), (0.3, 0.0670), (1, 0.0936), (3, 0.1457), (10, 0.2696))
def test_chlorophyll_has_the_published_kd(concentration, kd):
    # The reference interpolates chi and e from 525 to 550 nm, the table here from 530 to 535 nm: up to 0.9 %.
    assert chlorophyll(concentration).kd == pytest.approx(kd, rel=0.01)


def test_chlorophyll_at_a_node_of_the_table():
    # Kd(550) = 0.0565 + bw/2 + 0.04111 C^0.64927
    water = pure_seawater(550)
    expected = 0.0565 + water.backscattering + 0.04111 * 2**0.64927
    assert chlorophyll(2, 550).kd == pytest.approx(expected, rel=1e-9)


def test_particle_scattering():
    """At 550 nm, and in the blue: v = (lg 0.1 - 0.3)/2 = -0.65 below 2 mg/m^3, 0 from there on."""
    particles = 0.416 * 0.1**0.766
    for wavelength, factor in ((550, 1.0), (440, 0.8**-0.65)):
        water, sea = chlorophyll(0.1, wavelength), pure_seawater(wavelength)
        assert water.scattering - sea.scattering == pytest.approx(particles * factor, rel=1e-12)
        expected = (0.002 + 0.0075 * factor) * particles
        assert water.backscattering - sea.backscattering == pytest.approx(expected, rel=1e-12)
    assert chlorophyll(5, 440).scattering - pure_seawater(440).scattering == pytest.approx(0.416 * 5**0.766, rel=1e-12)


@each_row(0.0486, 0.05, 0.1, 0.6)
def test_water_from_kd_has_that_kd(kd):
    water = from_kd(kd)
    assert water.kd == pytest.approx(kd, rel=1e-9)
    assert water.absorption > water_absorption(532)


@pytest.mark.parametrize("depth", [0.5, 5, 25])
def test_water_from_secchi_depth_satisfies_both_rules(depth):
    water = from_secchi(depth)
    assert water.kd * depth == pytest.approx(1.7, rel=1e-9)
    assert (water.attenuation + water.kd) * depth == pytest.approx(8.7, rel=1e-9)
    assert water.particle_backscatter_ratio == pytest.approx(0.0183, rel=1e-9)
    assert water.absorption > water_absorption(532)


def generators():
    return [np.random.default_rng([number, significance.seed_shift]) for number in range(16)]


WATERS = [*(f"jerlov {name}" for name in ("I", "II", "III", "1C", "5C", "9C")), "chlorophyll 1", "kd 0.15", "secchi 6"]


@each_case(
    *zip(
        [
            pytest.param(name, marks=pytest.mark.slow if "1C" in name or "kd" in name else pytest.mark.long)
            for name in WATERS
        ]
    )
)
def test_diffuse_attenuation_by_monte_carlo(name):
    """Kd of each kind of water within the 0.6 % of the fit, in water with the functions that are rendered."""
    water = water_of(*name.split())
    found = [[diffuse_attenuation(water, rng, 6000)] for rng in generators()]
    significance.assert_equal(found, [water.kd], error=0.003, bias=0.006)
