"""Downwelling irradiance in homogeneous water by a Monte Carlo that shares nothing with the renderer.

Photons with weights enter infinitely deep water through a level surface. Every flight that crosses a level downward
adds its weight to the irradiance there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.phase import fournier_forand_cdf, fournier_forand_parameters
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.physics.water.water_types import InherentProperties

Sampler = Callable[[FloatArray], FloatArray]
"""Maps uniform numbers to scattering angles [rad]."""

_INDEX = 1.34
_LEVELS = 100  # between the surface and the depth of a tenth of the irradiance by absorption alone
_LOW, _SURVIVAL = 0.01, 0.1  # roulette: weights below, and their chance


def sampler(phase_function: Callable[[FloatArray], FloatArray]) -> Sampler:
    """Return a sampler of a phase function of the angle [rad], from its integral by trapezia."""
    theta = np.concatenate([[0.0], np.geomspace(1e-6, np.pi, 40_001)])
    density = np.concatenate([[0.0], phase_function(theta[1:]) * np.sin(theta[1:])])
    below = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) * np.diff(theta))])
    return lambda u: np.interp(u, below / below[-1], theta)


def fournier_forand_sampler(backscatter_ratio: float) -> Sampler:
    """Return a sampler of the Fournier-Forand function of a bb/b, from its closed-form distribution."""
    theta = np.concatenate([[0.0], np.geomspace(1e-7, np.pi, 20_001)])
    below = np.append(0.0, fournier_forand_cdf(theta[1:], *fournier_forand_parameters(backscatter_ratio)))
    return lambda u: np.interp(u, below / below[-1], theta)


def downwelling(
    absorption: float,
    scattering: float,
    share: float,
    samplers: tuple[Sampler, Sampler],
    rng: np.random.Generator,
    *,
    photons: int,
    cosine: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Return depths [m] and the downwelling irradiance there over that of the light that enters.

    `share` of the scattering [1/m] follows the second sampler, the rest the first. The light enters with a `cosine` to
    the vertical, in the water.
    """
    deepest = np.log(10) / absorption
    depth, mu, weight = np.zeros(photons), np.full(photons, cosine), np.ones(photons)
    tally = np.zeros(_LEVELS + 2)
    tally[0] = photons
    tally[1] = -photons

    def cross(first: FloatArray, last: FloatArray, weights: FloatArray, *, with_surface: bool) -> None:
        """Add flights downward as steps: a running sum gives the weight that has crossed each level."""
        begin, end = (np.clip(each / deepest * _LEVELS, 0, _LEVELS).astype(int) + 1 for each in (first, last))
        begin = np.zeros_like(begin) if with_surface else begin
        for levels, sign in ((begin, 1), (end, -1)):
            tally[:] += sign * np.bincount(levels, weights, _LEVELS + 2)

    while depth.size:
        end = depth + mu * rng.exponential(1 / (absorption + scattering), depth.size)
        down = mu > 0
        cross(depth[down], end[down], weight[down], with_surface=False)
        up = end < 0
        weight[up] *= _reflectance(-mu[up])
        end[up], mu[up] = -end[up], -mu[up]
        cross(np.zeros(up.sum()), end[up], weight[up], with_surface=True)
        depth, weight = end, weight * (scattering / (absorption + scattering))
        second, u = rng.random(depth.size) < share, rng.random(depth.size)
        theta, azimuth = np.where(second, samplers[1](u), samplers[0](u)), 2 * np.pi * rng.random(depth.size)
        sideways = np.sqrt(np.maximum(1 - mu**2, 0)) * np.sin(theta) * np.cos(azimuth)
        mu = np.clip(mu * np.cos(theta) + sideways, -1, 1)
        low = weight < _LOW
        weight = np.where(low, weight / _SURVIVAL, weight)
        # Light from below 1.6 times the deepest level hardly comes back to it.
        kept = (~low | (rng.random(depth.size) < _SURVIVAL)) & (depth < 1.6 * deepest)
        depth, mu, weight = depth[kept], mu[kept], weight[kept]
    return np.linspace(0, deepest, _LEVELS + 1), np.cumsum(tally)[:-1] / photons


def diffuse_attenuation(water: InherentProperties, rng: np.random.Generator, photons: int) -> float:
    """Return Kd [1/m] down to a tenth of the irradiance just below the surface, with the sun at the zenith."""
    samplers = fournier_forand_sampler(water.particle_backscatter_ratio), sampler(water_phase_function)
    share = water.water_scattering / water.scattering
    depth, irradiance = downwelling(water.absorption, water.scattering, share, samplers, rng, photons=photons)
    fallen = np.log(irradiance[0] / irradiance)
    return float(np.log(10) / np.interp(np.log(10), fallen, depth))


def _reflectance(cosine: FloatArray) -> FloatArray:
    """Return Fresnel's reflectance of unpolarised light from below."""
    sine = _INDEX * np.sqrt(np.maximum(1 - cosine**2, 0))
    outside = np.sqrt(np.maximum(1 - sine**2, 0))
    across = (_INDEX * cosine - outside) / (_INDEX * cosine + outside)
    along = (cosine - _INDEX * outside) / (cosine + _INDEX * outside)
    return np.where(sine >= 1, 1.0, 0.5 * (across**2 + along**2))
