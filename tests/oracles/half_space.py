"""Exact radiative transfer in a half-space: Chandrasekhar's H function for isotropic scattering, discrete ordinates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import leggauss, legvander
from scipy.special import roots_legendre

from mitransient_lidar.core.validation import FloatArray, finite_array, in_range
from mitransient_lidar.physics.lidar.level_sea import fresnel

# Trapezoid rule of the double exponential quadrature; halving the step changes H by less than 1e-11.
_ABSCISSAE = np.linspace(-3.4, 3.4, 137)


def chandrasekhar_h(mu: npt.ArrayLike, albedo: float) -> FloatArray:
    """H function of a homogeneous half-space that scatters isotropically, without an interface on top.

    Parameters
    ----------
    mu : array_like
        Cosine of the angle from the normal, 0 to 1.
    albedo : float
        Single-scattering albedo omega = b/c, 0 to 1.

    Returns
    -------
    ndarray
        H(mu), of the shape of `mu`: from 1 (mu = 0 or omega = 0) to 2.9078 (mu = omega = 1), accurate to 1e-10.

    Raises
    ------
    ValueError
        If a cosine or the albedo lies outside 0 to 1.

    Notes
    -----
    Chandrasekhar (1960), Radiative Transfer, Dover: H(mu) = 1 + (omega/2) mu H(mu) int_0^1 H(m)/(mu + m) dm, and the
    radiance of the half-space under a beam along mu0 is omega F/(4 pi) mu0/(mu + mu0) H(mu) H(mu0), where F is the
    beam's irradiance normal to it. Light from a half-space illuminated and viewed along the same ray therefore exceeds
    single scattering by H(mu)^2. The closed form

        ln H(mu) = -(mu/pi) int_0^(pi/2) ln(1 - omega t cot t)/(cos^2 t + mu^2 sin^2 t) dt

    of Stibbs and Weir (1959), Mon. Not. R. Astron. Soc. 119, 512, doi:10.1093/mnras/119.5.512, is evaluated by double
    exponential quadrature, which remains accurate at mu near 0 and omega = 1, where the integrand is singular at an
    end.
    """
    cosine = finite_array("mu", mu)
    for value in cosine.flat:
        in_range("mu", value, 0, 1)
    omega = in_range("albedo", albedo, 0, 1)

    # t from 0 and s = pi/2 - t from the other end, so that small values of both keep their digits.
    steep = np.pi * np.sinh(_ABSCISSAE)
    t = np.pi / 2 / (1 + np.exp(-steep))
    s = np.pi / 2 / (1 + np.exp(steep))
    weight = t * s * 2 * np.cosh(_ABSCISSAE) * (_ABSCISSAE[1] - _ABSCISSAE[0])

    # 1 - t cot t, by its series where the difference would cancel.
    one_minus_t_cot_t = np.where(t < 0.01, t**2 / 3 + t**4 / 45, 1 - t * np.tan(s))
    logarithm = np.log((1 - omega) + omega * one_minus_t_cot_t)
    slant = cosine[..., None]
    kernel = slant / (np.sin(s) ** 2 + (slant * np.cos(s)) ** 2)
    return np.asarray(np.exp(-np.sum(kernel * logarithm * weight, axis=-1) / np.pi))


def phase_moments(phase: Callable[[FloatArray], FloatArray], count: int) -> FloatArray:
    """Legendre moments of a phase function [1/sr], the first of which is 1.

    Parameters
    ----------
    phase : callable
        Value by scattering angle [rad]; it may have a forward peak that can be integrated.
    count : int
        Number of moments; 2000 nodes of the angle resolve some hundreds.

    Returns
    -------
    ndarray
        Means of the Legendre polynomials of the cosine, shape (count,), by Gauss's rule in the logarithm of the angle
        up to 0.05 rad and in the angle beyond.
    """
    x, w = roots_legendre(2000)
    low, middle = np.log(1e-9), 0.05
    small = np.exp(low + (np.log(middle) - low) * (x + 1) / 2)
    large = middle + (np.pi - middle) * (x + 1) / 2
    angle = np.concatenate([small, large])
    weight = np.concatenate([w * small * (np.log(middle) - low) / 2, w * (np.pi - middle) / 2])
    density = weight * np.sin(angle) * phase(angle)
    moments = density @ legvander(np.cos(angle), count - 1)
    return np.asarray(moments / moments[0])


def water_leaving_reflectance(
    albedo: float, moments: npt.ArrayLike, refractive_index: float, zenith: npt.ArrayLike = 0.0
) -> FloatArray:
    """Water-leaving radiance over the irradiance of an even sky above a level sea on a half-space [1/sr].

    Parameters
    ----------
    albedo : float
        Single-scattering albedo b/c of the water, above 0 and below 1.
    moments : array_like
        An odd number 2 n + 1 of Legendre moments of the phase function: 2 n of them, for 2 n directions down and as
        many up, and one that tells how much light is scattered closer forward than they resolve.
    refractive_index : float
        Of the water, above 1.
    zenith : array_like
        Angles of the radiance from the zenith, in air [rad].

    Returns
    -------
    ndarray
        Reflectances [1/sr], of the shape of `zenith`, without the light that the surface reflects.

    Notes
    -----
    The mean over azimuth of the radiance follows the discrete ordinates of Stamnes, Tsay, Wiscombe and Jayaweera
    (1988, doi:10.1364/AO.27.002502), here of a half-space: the solutions that decay with depth, of which the radiance
    upwards follows from that downwards. Gauss's rule is split at the critical angle, as in Jin and Stamnes (1994,
    doi:10.1364/AO.33.000431), and the forward peak of the phase function is taken out as in Wiscombe (1977,
    doi:10.1175/1520-0469(1977)034<1408:TDMRYA>2.0.CO;2). Nothing in it is random.
    """
    chi = np.asarray(moments, dtype=np.float64)
    half = (len(chi) - 1) // 2
    peak = chi[-1]
    scattered = (2 * np.arange(2 * half) + 1) * (chi[:-1] - peak) / (1 - peak)
    omega = albedo * (1 - peak) / (1 - albedo * peak)

    # Directions of the rule, and those that are asked for, with the weight 0.
    x, w = leggauss(half)
    critical = np.sqrt(1 - refractive_index**-2)
    asked = np.cos(np.arcsin(np.sin(np.ravel(np.asarray(zenith, dtype=np.float64))) / refractive_index))
    mu = np.concatenate([critical * (x + 1) / 2, critical + (1 - critical) * (x + 1) / 2, asked])
    weight = np.concatenate([w * critical / 2, w * (1 - critical) / 2, np.zeros_like(asked)])

    polynomials = legvander(mu, 2 * half - 1).T
    onwards = polynomials.T @ (scattered[:, None] * polynomials)
    backwards = polynomials.T @ ((scattered * (-1.0) ** np.arange(2 * half))[:, None] * polynomials)
    returned = _returned(mu, refractive_index)
    upwards = _upwards(omega, mu, weight, onwards, backwards, returned, refractive_index)
    leaving = upwards * (1 - returned) / refractive_index**2
    return np.asarray(leaving[2 * half :].reshape(np.shape(zenith)))


def banded_reflectance(
    albedo: float, moments: npt.ArrayLike, refractive_index: float, edges_deg: npt.ArrayLike
) -> float:
    """Return `water_leaving_reflectance` at the zenith, by radiances that are constant in bands of directions [1/sr].

    Parameters
    ----------
    albedo, refractive_index
        As for `water_leaving_reflectance`.
    moments : array_like
        Legendre moments of the phase function, some hundreds or more; the last one is that of the forward peak.
    edges_deg : array_like
        Edges of the bands, from 0 to 90 degrees from the vertical, increasing. Those of HydroLight are 5, 15, ..., 85
        degrees; it uses means of the phase function over pairs of bands, and the mean cosine of each (Mobley 1994,
        Light and Water), as is done here.
    """
    chi = np.asarray(moments, dtype=np.float64)
    count, peak = len(chi) - 1, chi[-1]
    edges = np.cos(np.radians(np.asarray(edges_deg, dtype=np.float64)))[::-1]
    width, mu = np.diff(edges), (edges[:-1] + edges[1:]) / 2
    # Means of the polynomials, from their integrals (P_(l+1) - P_(l-1))/(2 l + 1).
    polynomials = legvander(edges, count).T
    degrees = np.arange(1, count)
    integrals = np.vstack([edges, (polynomials[2:] - polynomials[:-2]) / (2 * degrees[:, None] + 1)])
    means = np.diff(integrals, axis=1) / width
    scattered = (2 * np.arange(count) + 1) * (chi[:-1] - peak)
    onwards = means.T @ (scattered[:, None] * means) + 2 * peak * np.diag(1 / width)
    backwards = means.T @ ((scattered * (-1.0) ** np.arange(count))[:, None] * means)
    inside = edges[:-1] + width * (np.arange(1000)[:, None] + 0.5) / 1000
    returned = np.average(_returned(inside, refractive_index), axis=0, weights=inside)
    upwards = _upwards(albedo, mu, width, onwards, backwards, returned, refractive_index)
    return float(upwards[-1] * fresnel(0.0, refractive_index)[1] / refractive_index**2)


def _returned(mu: FloatArray, refractive_index: float) -> FloatArray:
    """Return the share of light that the surface returns downwards, by the cosine in water."""
    sine = refractive_index * np.sqrt(1 - mu**2)
    returned = np.where(sine < 1, fresnel(np.arcsin(np.minimum(sine, 1.0)), refractive_index)[0], 1.0)
    return np.asarray(returned)


def _upwards(
    omega: float,
    mu: FloatArray,
    weight: FloatArray,
    onwards: FloatArray,
    backwards: FloatArray,
    returned: FloatArray,
    refractive_index: float,
) -> FloatArray:
    """Return radiances upwards below the surface, under an even sky of irradiance 1.

    `onwards` and `backwards` are means over azimuth of the phase function, of mean 1, between directions of the cosines
    `mu` with the solid angles 2 pi `weight`.
    """
    same = (0.5 * omega * onwards * weight - np.eye(len(mu))) / mu[:, None]
    other = 0.5 * omega * backwards * weight / mu[:, None]
    rates, modes = np.linalg.eig(np.block([[same, other], [-other, -same]]))
    decaying = modes[:, np.argsort(rates.real)[: len(mu)]].real
    reflection = decaying[len(mu) :] @ np.linalg.inv(decaying[: len(mu)])
    sky = (1 - returned) * refractive_index**2 / np.pi
    return np.asarray(np.linalg.solve(np.eye(len(mu)) - reflection * returned, reflection @ sky))
