"""Exact radiative transfer in a half-space: Chandrasekhar's H function for isotropic scattering."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, finite_array, in_range

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
