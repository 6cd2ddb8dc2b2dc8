"""H function against an independent discrete-ordinate table, Chandrasekhar's own numbers and its integral equation;
discrete ordinates against the H function, and where nothing absorbs.
"""

import numpy as np
import pytest
from oracles.half_space import banded_reflectance, chandrasekhar_h, phase_moments, water_leaving_reflectance
from scipy.integrate import quad

from mitransient_lidar.physics.lidar.refraction import fresnel
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters

DEGREES = [0, 20, 40, 60]


@pytest.mark.parametrize(
    ("albedo", "squares"),
    [
        (0.5, [1.56565, 1.55159, 1.50525, 1.41071]),
        (0.9, [3.42286, 3.31538, 2.98683, 2.42124]),
        (0.99, [6.1147, 5.77632, 4.81929, 3.41733]),
    ],
)
def test_monostatic_enhancement(albedo, squares):
    assert chandrasekhar_h(np.cos(np.radians(DEGREES)), albedo) ** 2 == pytest.approx(squares, abs=6e-6)


def test_conservative_half_space():
    # Chandrasekhar (1960), table of H for isotropic scattering: H(1) = 2.9078.
    assert chandrasekhar_h(1.0, 1.0) == pytest.approx(2.9078, abs=5e-5)


@pytest.mark.parametrize("albedo", [0.05, 0.5, 0.9, 0.999, 1.0])
def test_integral_equation(albedo):
    # m = u^4 takes the logarithm at m = 0 out of Gauss-Legendre's way.
    nodes, weights = np.polynomial.legendre.leggauss(80)
    u = (1 + nodes) / 2
    m, dm = u**4, 2 * u**3 * weights
    mu = np.array([0.0, 1e-4, 0.01, 0.3, 1.0])
    integral = np.sum(chandrasekhar_h(m, albedo) / (mu[:, None] + m) * dm, axis=1, where=mu[:, None] > 0)
    h = chandrasekhar_h(mu, albedo)
    assert h == pytest.approx(1 + albedo / 2 * mu * h * integral, rel=1e-7)


@pytest.mark.parametrize("albedo", [0.3, 0.9, 1.0])
def test_zeroth_moment(albedo):
    nodes, weights = np.polynomial.legendre.leggauss(80)
    u = (1 + nodes) / 2
    moment = np.sum(chandrasekhar_h(u**4, albedo) * 2 * u**3 * weights)
    assert moment == pytest.approx(2 / albedo * (1 - np.sqrt(1 - albedo)), rel=1e-9)


def test_no_scattering_and_grazing():
    assert np.array_equal(chandrasekhar_h([[0.0, 0.5, 1.0]], 0.0), [[1, 1, 1]])
    assert chandrasekhar_h(0.0, 1.0) == 1


@pytest.mark.parametrize(
    ("mu", "albedo", "message"),
    [
        ([0.5, 1.1], 0.5, "mu = 1.1 must lie between 0 and 1"),
        (0.5, 1.01, "albedo = 1.01 must lie between 0 and 1"),
        (np.nan, 0.5, "mu holds nan but every value must be finite"),
    ],
)
def test_rejections(mu, albedo, message):
    with pytest.raises(ValueError, match=message):
        chandrasekhar_h(mu, albedo)


@pytest.mark.parametrize("albedo", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("zenith", [0.0, 1.0])
def test_discrete_ordinates_of_isotropic_scattering(albedo, zenith):
    """Below an even sky of radiance 1/pi: omega/(2 pi) H(m) times the integral over u of u H(u)/(u + m)."""
    mu = np.cos(zenith)
    integral = quad(lambda u: u * chandrasekhar_h(u, albedo) / (u + mu), 0, 1)[0]
    expected = albedo / (2 * np.pi) * chandrasekhar_h(mu, albedo) * integral
    found = water_leaving_reflectance(albedo, np.eye(1, 65)[0], 1 + 1e-9, zenith)
    assert found == pytest.approx(expected, rel=1e-7)


def test_discrete_ordinates_below_a_surface():
    """Where nothing absorbs, what leaves and what the surface reflects are as bright as the sky."""
    zenith = [0.0, 0.8, 1.4]
    found = water_leaving_reflectance(1 - 1e-10, np.eye(1, 65)[0], 1.34, zenith)
    assert np.pi * found == pytest.approx(fresnel(zenith, 1.34)[1], rel=1e-4)


def test_discrete_ordinates_converge_for_forward_scattering():
    parameters = fournier_forand_parameters(0.0183)
    moments = phase_moments(lambda angle: fournier_forand(angle, *parameters), 401)
    coarse, fine = (water_leaving_reflectance(0.9, moments[: 2 * half + 1], 1.34) for half in (32, 64))
    assert coarse == pytest.approx(fine, rel=3e-4)
    # Within bands of 10 degrees, light that is scattered forwards comes closer to the direction of any other light.
    wide, narrow = (banded_reflectance(0.9, moments, 1.34, np.linspace(0, 90, n)) for n in (10, 91))
    assert narrow == pytest.approx(fine, rel=1e-3)
    assert 1.01 < wide / fine < 1.1
