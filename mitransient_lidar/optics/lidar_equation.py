"""Closed-form echoes of a co-located lidar over a level sea: the reference that simulations are compared with.

Single scattering only: light that scatters once in the water, off the bottom, or off the surface returns along the ray
it came by. Energies are in J for the system's energy; depths in m, positive downwards; angles in rad. Every function
takes rays at any angle `theta` from the vertical; `beam_average` adds them up over a Gaussian beam.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, in_range, non_negative, positive
from .refraction import fresnel, snell, solid_angle_per_area
from .water import C0, WaterColumn

Attenuation = Literal["c", "a+bb"]
"""'c': every scattered photon is lost, a lower bound. 'a+bb': forward-scattered light stays in, an estimate."""


@dataclass(frozen=True)
class LidarSystem:
    """Transmitter and receiver at one place, seen as numbers of the lidar equation.

    Parameters
    ----------
    height : float
        Height above the mean sea level [m].
    off_nadir : float
        Angle of the axis from the vertical [rad], 0 to below pi/2.
    energy : float
        Pulse energy times the efficiencies of both optics and the two-way transmission of the atmosphere [J].
    aperture_area : float
        Area of the receiver normal to the ray [m^2].
    refractive_index : float
        Index of the water, which bends rays, at least 1.
    group_index : float
        Group index of the water, which times them, at least 1.

    Raises
    ------
    ValueError
        If a parameter lies outside its range.
    """

    height: float
    off_nadir: float
    energy: float
    aperture_area: float
    refractive_index: float = 1.34
    group_index: float = 1.34

    def __post_init__(self) -> None:
        for name in ("height", "energy", "aperture_area"):
            positive(name, getattr(self, name))
        if not 0 <= self.off_nadir < np.pi / 2:
            raise ValueError(f"off_nadir = {self.off_nadir:g} must be at least 0 and below pi/2")
        for name in ("refractive_index", "group_index"):
            in_range(name, getattr(self, name), 1, np.inf)

    def water_gain(self, depth: npt.ArrayLike, theta: npt.ArrayLike) -> FloatArray:
        """Received energy [J] per unit of backscatter [1/sr] at `depth`, without attenuation in the water."""
        _, transmittance = fresnel(theta, self.refractive_index)
        solid_angle = solid_angle_per_area(self.height, depth, theta, self.refractive_index)
        return np.asarray(self.energy * self.aperture_area * transmittance**2 * solid_angle)

    def cos_water(self, theta: npt.ArrayLike) -> FloatArray:
        """Cosine of the refracted angle for rays at `theta` [rad] in air."""
        return np.asarray(np.cos(snell(theta, self.refractive_index)))


def surface_energy(
    system: LidarSystem, slope_variance: tuple[float, float], theta: npt.ArrayLike, azimuth: npt.ArrayLike = 0.0
) -> FloatArray:
    """Echo of Gaussian surface slopes by specular reflection.

    Parameters
    ----------
    system : LidarSystem
        The lidar.
    slope_variance : (float, float)
        Variances of the slopes along x and y [1], positive.
    theta, azimuth : array_like
        Angle of the ray from the vertical and azimuth of its horizontal direction from +x [rad].

    Returns
    -------
    ndarray
        Energy [J]: E rho_F(0) p(slope) A/(4 cos^3(theta) H^2), the slope being tan(theta) towards the lidar.

    Notes
    -----
    Glint radiance of Cox and Munk (1954), doi:10.1364/JOSA.44.000838, in the monostatic direction.
    """
    along, across = (positive("slope_variance", v) for v in slope_variance)
    angle = finite_array("theta", theta)
    steepness = np.tan(angle)
    exponent = (steepness * np.cos(azimuth)) ** 2 / along + (steepness * np.sin(azimuth)) ** 2 / across
    density = np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(along * across))
    reflectance, _ = fresnel(0.0, system.refractive_index)
    geometry = system.aperture_area / (4 * np.cos(angle) ** 3 * system.height**2)
    return np.asarray(system.energy * reflectance * density * geometry)


def bottom_energy(
    system: LidarSystem,
    water: WaterColumn,
    depth: float,
    reflectance: float,
    theta: npt.ArrayLike,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Echo of a level Lambertian bottom.

    Parameters
    ----------
    system : LidarSystem
        The lidar.
    water : WaterColumn
        Water above the bottom.
    depth : float
        Depth of the bottom [m], at least 0.
    reflectance : float
        Bottom reflectance rho, 0 to 1.
    theta : array_like
        Angle of the ray in air [rad].
    attenuation : {'c', 'a+bb'}
        What light loses on its way.

    Returns
    -------
    ndarray
        Energy [J]: gain(D) (rho/pi) cos(phi) exp(-2 tau(D)/cos(phi)).
    """
    rho = in_range("reflectance", reflectance, 0, 1)
    cos_water = system.cos_water(theta)
    loss = np.exp(-2 * _attenuating(water, attenuation).cumulative(non_negative("depth", depth)) / cos_water)
    return np.asarray(system.water_gain(depth, theta) * rho / np.pi * cos_water * loss)


def column_power(
    system: LidarSystem,
    water: WaterColumn,
    backward_phase: npt.ArrayLike,
    depth: npt.ArrayLike,
    theta: npt.ArrayLike,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Power scattered back by the water, for an infinitely short pulse.

    Parameters
    ----------
    system : LidarSystem
        The lidar.
    water : WaterColumn
        The water.
    backward_phase : array_like
        Phase function at 180 degrees [1/sr], one for all layers or one per layer.
    depth : array_like
        Depth that the power comes from [m], at least 0.
    theta : array_like
        Angle of the ray in air [rad].
    attenuation : {'c', 'a+bb'}
        What light loses on its way.

    Returns
    -------
    ndarray
        Power [W]: (c0/2 n_g) b p(pi) gain(D) exp(-2 tau(D)/cos(phi)).
    """
    backscatter = water.scattering * _per_layer(water, backward_phase)
    loss = np.exp(-2 * _attenuating(water, attenuation).cumulative(depth) / system.cos_water(theta))
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
    """Energy scattered back by the water between two depths.

    Parameters
    ----------
    system, water, backward_phase, theta, attenuation
        As for `column_power`.
    top, bottom : array_like
        Depths [m], 0 <= top; nothing comes back where bottom <= top. They broadcast with `theta`.

    Returns
    -------
    ndarray
        Energy [J], by 12-point Gauss-Legendre quadrature in every layer.
    """
    nodes, weights = np.polynomial.legendre.leggauss(12)
    upper, lower, angle = np.broadcast_arrays(
        finite_array("top", top), finite_array("bottom", bottom), finite_array("theta", theta)
    )
    backscatter = water.scattering * _per_layer(water, backward_phase)
    loss_column = _attenuating(water, attenuation)
    cos_water = system.cos_water(angle)
    energy = np.zeros(upper.shape)
    for layer, edge in enumerate(water.tops):
        end = water.tops[layer + 1] if layer + 1 < water.count else np.inf
        start = np.maximum(upper, edge)
        thickness = np.maximum(np.minimum(lower, end) - start, 0)
        hit = thickness > 0
        half = thickness[hit][:, None] / 2
        z = start[hit][:, None] + half * (1 + nodes)
        cosine, ray = cos_water[hit][:, None], angle[hit][:, None]
        integrand = system.water_gain(z, ray) * np.exp(-2 * loss_column.cumulative(z) / cosine) / cosine
        energy[hit] += backscatter[layer] * np.sum(integrand * half * weights, axis=-1)
    return energy


def _attenuating(water: WaterColumn, attenuation: Attenuation) -> WaterColumn:
    """Water whose attenuation coefficient is the chosen one."""
    if attenuation == "c":
        return water
    if attenuation == "a+bb":
        return WaterColumn(
            water.tops, water.absorption + water.backscattering, water.backscattering, water.backscattering
        )
    raise ValueError(f"attenuation = {attenuation!r} must be 'c' or 'a+bb'")


def _per_layer(water: WaterColumn, backward_phase: npt.ArrayLike) -> FloatArray:
    values = finite_array("backward_phase", backward_phase)
    if values.ndim > 1 or values.size not in (1, water.count):
        raise ValueError(f"backward_phase has {values.size} values but there are {water.count} layers")
    if np.any(values < 0):
        raise ValueError(f"backward_phase = {values.min():g} must not be negative")
    return np.broadcast_to(values, water.count)
