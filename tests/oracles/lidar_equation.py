"""Closed-form echoes of a co-located lidar over a level sea.

Single scattering only: light that scatters once in the water, at the bottom or at the surface returns along the
incident ray. Energies are in J for the system's energy; depths in m, positive downwards; angles in rad. Every function
takes rays at any angle `theta` from the vertical; `beam_average` integrates them over a Gaussian beam.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, fresnel, snell
from mitransient_lidar.physics.water.layers import WaterColumn

Attenuation = Literal["c", "a+bb"]
"""'c': every scattered photon is lost, a lower bound. 'a+bb': forward-scattered light is not lost, an estimate."""


def cos_water(system: LidarSystem, theta: npt.ArrayLike) -> FloatArray:
    """Cosine of the refracted angle of rays at `theta` [rad] in air."""
    return np.asarray(np.cos(snell(theta, system.refractive_index)))


def surface_energy(
    system: LidarSystem, slope_variance: tuple[float, float], theta: npt.ArrayLike, azimuth: npt.ArrayLike = 0.0
) -> FloatArray:
    """Energy [J] of the specular echo of Gaussian surface slopes: E rho_F(0) p(slope) A/(4 cos^3(theta) H^2).

    `slope_variance` holds the variances along x and y [1], `azimuth` the horizontal direction of the ray from +x; the
    slope is tan(theta) towards the lidar. Glint radiance of Cox and Munk (1954), doi:10.1364/JOSA.44.000838.
    """
    along, across = slope_variance
    steepness = np.tan(theta)
    exponent = (steepness * np.cos(azimuth)) ** 2 / along + (steepness * np.sin(azimuth)) ** 2 / across
    density = np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(along * across))
    reflectance, _ = fresnel(0.0, system.refractive_index)
    geometry = system.aperture_area / (4 * np.cos(theta) ** 3 * system.height**2)
    return np.asarray(system.energy * reflectance * density * geometry)


def bottom_energy(
    system: LidarSystem,
    water: WaterColumn,
    depth: float,
    reflectance: float,
    theta: npt.ArrayLike,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Energy [J] of the echo of a level Lambertian bottom: gain(D) (rho/pi) cos(phi) exp(-2 tau(D)/cos(phi))."""
    cosine = cos_water(system, theta)
    loss = np.exp(-2 * _attenuating(water, attenuation).cumulative(depth) / cosine)
    return np.asarray(system.water_gain(depth, theta) * reflectance / np.pi * cosine * loss)


def column_power(
    system: LidarSystem,
    water: WaterColumn,
    backward_phase: npt.ArrayLike,
    depth: npt.ArrayLike,
    theta: npt.ArrayLike,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Power [W] scattered back by the water at a depth, for an infinitely short pulse.

    (c0/2 n_g) b p(pi) gain(D) exp(-2 tau(D)/cos(phi)), with the phase function at 180 degrees [1/sr] `backward_phase`,
    one value for all layers or one per layer.
    """
    backscatter = water.scattering * np.broadcast_to(backward_phase, water.count)
    loss = np.exp(-2 * _attenuating(water, attenuation).cumulative(depth) / cos_water(system, theta))
    speed = C0 / (2 * system.group_index)
    return np.asarray(speed * backscatter[water.layer_at(depth)] * system.water_gain(depth, theta) * loss)


def column_energy(
    system: LidarSystem,
    water: WaterColumn,
    backward_phase: npt.ArrayLike,
    top: npt.ArrayLike,
    bottom: npt.ArrayLike,
    theta: npt.ArrayLike,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Energy [J] scattered back by the water between two depths [m], 0 where bottom <= top.

    Integral of `column_power` over time, by 12-point Gauss-Legendre quadrature in every layer.
    """
    nodes, weights = np.polynomial.legendre.leggauss(12)
    upper, lower, angle = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (top, bottom, theta)))
    backscatter = water.scattering * np.broadcast_to(backward_phase, water.count)
    loss_column = _attenuating(water, attenuation)
    cosines = cos_water(system, angle)
    energy = np.zeros(upper.shape)
    for layer, edge in enumerate(water.layer_tops):
        end = water.layer_tops[layer + 1] if layer + 1 < water.count else np.inf
        start = np.maximum(upper, edge)
        thickness = np.maximum(np.minimum(lower, end) - start, 0)
        hit = thickness > 0
        half = thickness[hit][:, None] / 2
        z = start[hit][:, None] + half * (1 + nodes)
        cosine, ray = cosines[hit][:, None], angle[hit][:, None]
        integrand = system.water_gain(z, ray) * np.exp(-2 * loss_column.cumulative(z) / cosine) / cosine
        energy[hit] += backscatter[layer] * np.sum(integrand * half * weights, axis=-1)
    return energy


def _attenuating(water: WaterColumn, attenuation: Attenuation) -> WaterColumn:
    """Water with the chosen attenuation coefficient."""
    if attenuation == "c":
        return water
    return WaterColumn(
        water.layer_tops, water.absorption + water.backscattering, water.backscattering, water.backscattering
    )
