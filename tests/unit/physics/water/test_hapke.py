"""Reflection by sediment: Hapke's model against Chandrasekhar's exact reflectance, and sampled integrals."""

import numpy as np
import pytest
from rows import each_row, refuses
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.water.sediments import BOTTOMS, HapkeSurface, bottom_reflectance

#: Lobes towards the source and away from it, narrow and wide opposition effects.
SURFACES = [HapkeSurface(0.7), HapkeSurface(0.5, 0.5, 0.8, 1.0, 0.02), HapkeSurface(0.9, 0.4, 0.2, 0.0, 0.1)]


def exact_h(albedo, cosine):
    """Return Chandrasekhar's H function of even scattering: 1/H = gamma + w/2 int x H(x)/(x + mu) dx by iteration."""
    x, weights = np.polynomial.legendre.leggauss(64)
    x, weights = 0.5 * (1 + x), 0.5 * weights
    gamma, h = np.sqrt(1 - albedo), np.ones_like(x)
    for _ in range(400):
        h = 1 / (gamma + 0.5 * albedo * np.sum(weights * x * h / (x[:, None] + x), axis=1))
    return 1 / (gamma + 0.5 * albedo * np.sum(weights * x * h / (cosine + x)))


@each_row(0.3, 0.6, 0.9, 0.99)
@each_row(1.0, 0.6, 0.2)
def test_reflectance_of_even_scattering_is_that_of_chandrasekhar(cosine, albedo):
    """1 - gamma H, within the 1 % of Hapke's H function for each of two directions."""
    exact = 1 - np.sqrt(1 - albedo) * exact_h(albedo, cosine)
    surface = HapkeSurface(albedo, opposition_amplitude=0.0)
    assert surface.h_function(cosine) == pytest.approx(exact_h(albedo, cosine), rel=0.01)
    assert surface.reflectance(cosine) == pytest.approx(exact, rel=0.02)


@each_row(*SURFACES)
@each_row(1.0, 0.7, 0.2, 0.03)
def test_reflectance_is_the_mean_over_sampled_directions(cosine, surface):
    """Directions drawn by their cosine, against the quadrature about the peak, which is known to 0.2 %."""
    rng = np.random.default_rng(11)
    cos_out, azimuth = np.sqrt(rng.random(400_000)), 2 * np.pi * rng.random(400_000)
    between = cosine * cos_out + np.sqrt((1 - cosine**2) * (1 - cos_out**2)) * np.cos(azimuth)
    weight = np.pi * surface.brdf(cosine, cos_out, np.arccos(np.clip(between, -1, 1)))
    error = weight.std() / np.sqrt(weight.size)
    assert abs(surface.reflectance(cosine) - weight.mean()) < largest_z(weight.size) * error + 2e-3 * weight.mean()


@pytest.mark.parametrize("surface", SURFACES)
def test_particles_scatter_all_light_once_apart_from_the_opposition_effect(surface):
    """Mean of p over the sphere is 1: even steps of sin^2(g/2), as of solid angle."""
    s = (np.arange(200_000) + 0.5) / 200_000
    phase = HapkeSurface(surface.albedo, surface.lobe_asymmetry, surface.backward_share, 0.0).single_scattering(s)
    assert phase.mean() == pytest.approx(1, rel=1e-6)
    mean_cosine = np.mean(phase * (1 - 2 * s))  # of the phase angle
    assert mean_cosine == pytest.approx(surface.lobe_asymmetry * (2 * surface.backward_share - 1), abs=1e-6)


def test_opposition_effect_doubles_single_scattering_and_falls_to_half_its_height_at_its_width():
    narrow = HapkeSurface(0.1, opposition_width=0.02)
    angles = np.array([0.0, 2 * np.arctan(0.02), 1.0])
    surge = narrow.single_scattering(np.sin(angles / 2) ** 2) - 1
    np.testing.assert_allclose(surge, [1.0, 0.5, 0.02 / (0.02 + np.tan(0.5))], rtol=1e-12)


@each_row(0.0, 0.05, 0.1, 0.43, 0.8)
def test_albedo_follows_from_the_reflectance_which_is_reciprocal(wanted):
    assert SURFACES[1].brdf(0.9, 0.3, 1.0) == pytest.approx(SURFACES[1].brdf(0.3, 0.9, 1.0), rel=1e-14)
    found = HapkeSurface(0.0, 0.3, 0.6, 0.8, 0.05).of_reflectance("reflectance", wanted)
    assert found.reflectance() == pytest.approx(wanted, abs=1e-9)


def test_more_light_than_arrives_is_refused():
    with pytest.raises(UserError, match=r"reflectance = 0\.95 must be at most 0\.846 with these particles"):
        HapkeSurface(0.0, 0.8, 0.0, 0.0).of_reflectance("reflectance", 0.95)
    with pytest.raises(UserError, match=r"they would reflect 1\.\d+ of the light that arrives at"):
        HapkeSurface(0.0).of_albedo("single_scattering_albedo", 1.0)


def test_bottoms_by_name_have_the_values_of_the_table():
    """At 530 nm, and between it and 540 nm (Maritorena et al. 1994, fig. 6); land at 532 and 1064 nm (splib07a)."""
    assert [bottom_reflectance("reflectance", name, 530.0) for name in BOTTOMS[:4]] == [0.429, 0.246, 0.044, 0.075]
    land = {
        **{"sand": (0.2048, 0.32), "wet_sand": (0.1094, 0.1536), "asphalt": (0.0816, 0.1435)},
        **{"concrete": (0.2743, 0.31), "basalt": (0.1228, 0.1575), "limestone": (0.1844, 0.2731)},
        **{"grass": (0.0905, 0.6994), "rush": (0.1015, 0.7129)},
    }
    found = {name: [bottom_reflectance("reflectance", name, nm) for nm in (532.0, 1064.0)] for name in BOTTOMS[4:]}
    assert found == {name: pytest.approx(values, abs=1.5e-3) for name, values in land.items()}
    assert bottom_reflectance("reflectance", "coral_sand") == pytest.approx(0.8 * 0.429 + 0.2 * 0.442)


@refuses(
    ("mud", 532.0, "bottom_reflectance = 'mud' must be a number from 0 to 1, or one of coral_sand, green_algae"),
    (1.5, 532.0, "bottom_reflectance = 1.5 must lie between 0 and 1"),
    ("nan", 532.0, "bottom_reflectance = nan must be finite"),
    ("coral_sand", 1064.0, "wavelength_nm = 1064 must lie between 400 and 700"),
)
def test_other_bottoms_are_refused(value, wavelength):
    bottom_reflectance("bottom_reflectance", value, wavelength)
