"""Distribution of scattered light over radius and delay in the small-angle model of `small_angle.BeamSpread`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import gamma, gammaln, kv

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.small_angle import BeamSpread


def radius_rms(beam: BeamSpread) -> float:
    """Root-mean-square radius of all light in the plane without absorption [m]: sqrt(b <Theta^2> z^3/3)."""
    return float(np.sqrt(beam.scattering * beam.mean_square_angle * beam.depth**3 / 3))


def delay_density(beam: BeamSpread, tau: npt.ArrayLike) -> FloatArray:
    """Probability density G [1/s] of the delay `tau` [s], before absorption; 0 for tau <= 0.

    beta^k tau^(k-1) exp(-beta tau)/Gamma(k) with k = mean^2/variance and beta = mean/variance.
    """
    shape, rate = _gamma(beam)
    delay = np.asarray(tau, dtype=np.float64)
    # In units of 1/beta, so that no power of nanoseconds underflows.
    scaled = np.where(delay > 0, rate * delay, 1.0)
    density = rate * np.exp((shape - 1) * np.log(scaled) - scaled - gammaln(shape))
    return np.asarray(np.where(delay > 0, density, 0.0))


def irradiance(beam: BeamSpread, radius: npt.ArrayLike, tau: npt.ArrayLike) -> FloatArray:
    """Irradiance [1/(m^2 s)] of the scattered light per unit energy, at a radius [m] and a delay [s]."""
    r, delay = np.asarray(radius, dtype=np.float64), np.asarray(tau, dtype=np.float64)
    stretch = beam.speed * np.where(delay > 0, delay, 1.0)
    spot = 3 / (4 * np.pi * stretch * beam.depth) * np.exp(-3 * r**2 / (4 * stretch * beam.depth))
    loss = -np.expm1(-beam.scattering * beam.depth) * np.exp(-beam.absorption * (beam.depth + stretch))
    return np.asarray(loss * delay_density(beam, delay) * spot)


def fluence(beam: BeamSpread, radius: float) -> float:
    """Irradiance integrated over all delays [1/m^2] at a radius [m]; infinite on the axis if k <= 1.

    T p 3/(4 pi v z) 2 (x/2)^(k-1) K_(k-1)(x)/Gamma(k) with the transmittance T, p = beta + a v, x = r sqrt(3 p/(v z))
    and a modified Bessel function K.
    """
    shape, rate = _gamma(beam)
    if radius == 0 and shape <= 1:
        return np.inf
    decay = rate + beam.absorption * beam.speed
    half = max(radius * np.sqrt(3 * decay / (beam.speed * beam.depth)), 1e-100) / 2
    tail = 2 * half ** (shape - 1) * kv(shape - 1, 2 * half) / gamma(shape)
    return float(beam.transmittance * decay * 3 / (4 * np.pi * beam.speed * beam.depth) * tail)


def delay_laplace(beam: BeamSpread, rate: npt.ArrayLike) -> FloatArray:
    """Laplace transform of the delays at rates s [1/s] in the limit of many weak scatterings, exact for small angles.

    E[exp(-s tau)] = sech(z sqrt(s b <Theta^2>/(2 v))): the direction is a plane Brownian motion along z, the detour
    half its squared length integrated along z, and each axis contributes the root of 1/cosh (Cameron and Martin).
    """
    diffusion = beam.scattering * beam.mean_square_angle / (2 * beam.speed)
    return np.asarray(1 / np.cosh(beam.depth * np.sqrt(np.asarray(rate) * diffusion)))


def _gamma(beam: BeamSpread) -> tuple[float, float]:
    """Shape k and rate beta [1/s] of the gamma density."""
    return beam.mean_delay**2 / beam.delay_variance, beam.mean_delay / beam.delay_variance
