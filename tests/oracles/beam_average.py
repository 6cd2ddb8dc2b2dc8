"""Closed-form echoes averaged over a Gaussian beam, inside a field of view, in total and by time bin.

The beam is Gaussian in the tangent plane about the axis: the ray through (angle_x, angle_y) has the direction axis +
angle_x ex + angle_y ey with axis = (sin th0, 0, -cos th0), ex = (cos th0, 0, sin th0), ey = +y. In single scattering by
a co-located lidar light returns along its own direction, so that a field of view selects rays. Rays are those of a
midpoint grid over six standard deviations each way, whose error for smooth integrands is far below the beam's own
truncation; edges of the field of view are accurate to 1e-4 of the energy or better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray, finite_array, positive
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, surface_time_ns
from mitransient_lidar.physics.water.layers import WaterColumn
from oracles.echo_times import bottom_time_ns
from oracles.lidar_equation import Attenuation, bottom_energy, column_energy, cos_water, surface_energy

FieldOfView = Callable[[FloatArray, FloatArray], npt.NDArray[np.bool_]]
"""True for directions (angle_x, angle_y) [rad] inside the field; angle_x points away from nadir, angle_y to +y."""

_REACH = 6.0  # half width of the grid in standard deviations
_CELLS = 480  # per side: 40 to the standard deviation, so that edges at its multiples fall between cells
_ANGLES = 384  # groups of equal angle to the vertical


class EchoEnergies(NamedTuple):
    """Energies [J] of the surface, the water above the bottom, and the bottom."""

    surface: float
    column: float
    bottom: float


@dataclass(frozen=True, eq=False)
class _Rays:
    """Part of the beam inside a field of view, by grid cell; times are spread over a cell's extent."""

    theta: FloatArray
    azimuth: FloatArray
    weight: FloatArray
    theta_extent: FloatArray


def echo_energies(
    system: LidarSystem,
    sigma: float,
    water: WaterColumn,
    backward_phase: npt.ArrayLike,
    bottom_depth: float,
    reflectance: float,
    slope_variance: tuple[float, float],
    field_of_view: FieldOfView | None = None,
    attenuation: Attenuation = "c",
) -> EchoEnergies:
    """Energies of the three echoes of a Gaussian beam.

    Parameters
    ----------
    system : LidarSystem
        The lidar.
    sigma : float
        Standard deviation of the beam [rad]: half the full angle between the e^-1/2 points of the irradiance.
    water : WaterColumn
        The water.
    backward_phase : array_like
        Phase function at 180 degrees [1/sr], one for all layers or one per layer.
    bottom_depth : float
        Depth of the bottom [m].
    reflectance : float
        Lambertian reflectance of the bottom, 0 to 1.
    slope_variance : (float, float)
        Variances of the surface slopes along x and y [1].
    field_of_view : callable, optional
        Predicate on (angle_x, angle_y); True everywhere by default.
    attenuation : {'c', 'a+bb'}
        Attenuation coefficient of the water.

    Raises
    ------
    ValueError
        If a parameter lies outside its range.
    """
    rays = _trace(system, sigma, field_of_view)
    theta, weight = _by_angle(rays)
    column = column_energy(system, water, backward_phase, 0.0, bottom_depth, theta, attenuation)
    bottom = bottom_energy(system, water, bottom_depth, reflectance, theta, attenuation)
    surface = surface_energy(system, slope_variance, rays.theta, rays.azimuth)
    return EchoEnergies(float(surface @ rays.weight), float(column @ weight), float(bottom @ weight))


def surface_energy_per_bin(
    edges_ns: npt.ArrayLike,
    system: LidarSystem,
    sigma: float,
    slope_variance: tuple[float, float],
    field_of_view: FieldOfView | None = None,
) -> FloatArray:
    """Energy of the surface echo in each time bin, for an infinitely short pulse.

    Parameters
    ----------
    edges_ns : array_like, shape (T + 1,)
        Increasing edges of the time bins [ns] after the light leaves the transmitter.
    system, sigma, slope_variance, field_of_view
        As for `echo_energies`.

    Returns
    -------
    ndarray, shape (T,)
        Energy [J].
    """
    rays = _trace(system, sigma, field_of_view)
    energy = surface_energy(system, slope_variance, rays.theta, rays.azimuth) * rays.weight
    return _histogram(edges_ns, rays, energy, lambda theta: surface_time_ns(system.height, theta))


def bottom_energy_per_bin(
    edges_ns: npt.ArrayLike,
    system: LidarSystem,
    sigma: float,
    water: WaterColumn,
    bottom_depth: float,
    reflectance: float,
    field_of_view: FieldOfView | None = None,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Energy [J] of the bottom echo in each time bin, shape (T,); parameters as for the functions above."""
    rays = _trace(system, sigma, field_of_view)
    energy = bottom_energy(system, water, bottom_depth, reflectance, rays.theta, attenuation) * rays.weight
    n, group = system.refractive_index, system.group_index
    return _histogram(
        edges_ns, rays, energy, lambda theta: bottom_time_ns(system.height, bottom_depth, theta, n, group)
    )


def column_energy_per_bin(
    edges_ns: npt.ArrayLike,
    system: LidarSystem,
    sigma: float,
    water: WaterColumn,
    backward_phase: npt.ArrayLike,
    bottom_depth: float,
    field_of_view: FieldOfView | None = None,
    attenuation: Attenuation = "c",
) -> FloatArray:
    """Energy [J] scattered back by the water in each time bin, shape (T,); parameters as for the functions above."""
    edges = _edges(edges_ns)
    theta, weight = _by_angle(_trace(system, sigma, field_of_view))
    delay = edges - surface_time_ns(system.height, theta)[:, None]
    depth = delay * 1e-9 * C0 / (2 * system.group_index) * cos_water(system, theta)[:, None]
    depth = np.clip(depth, 0, positive("bottom_depth", bottom_depth))
    energy = column_energy(system, water, backward_phase, depth[:, :-1], depth[:, 1:], theta[:, None], attenuation)
    return np.asarray(weight @ energy)


def _trace(system: LidarSystem, sigma: float, field_of_view: FieldOfView | None) -> _Rays:
    """Rays of the beam's grid and their weights."""
    positive("sigma", sigma)
    # The flattest ray must still reach the sea.
    if system.off_nadir + np.arctan(_REACH * np.sqrt(2) * sigma) >= np.pi / 2:
        raise ValueError(f"sigma = {sigma:g} must keep the beam below the horizon")
    step = 2 * _REACH * sigma / _CELLS
    line = (np.arange(_CELLS) - (_CELLS - 1) / 2) * step
    angle_x, angle_y = (g.ravel() for g in np.meshgrid(line, line, indexing="ij"))
    sin, cos = np.sin(system.off_nadir), np.cos(system.off_nadir)
    down, forward = cos - angle_x * sin, sin + angle_x * cos
    horizontal = np.hypot(forward, angle_y)
    theta, azimuth = np.arctan2(horizontal, down), np.arctan2(angle_y, forward)
    density = np.exp(-0.5 * (angle_x**2 + angle_y**2) / sigma**2)
    weight = density / density.sum()
    if field_of_view is not None:
        weight = weight * np.asarray(field_of_view(angle_x, angle_y), dtype=bool)
    # Along each grid axis: d(theta) = (down d(horizontal) - horizontal d(down)) / (down^2 + horizontal^2)
    scale = step / ((down**2 + horizontal**2) * np.maximum(horizontal, step))
    extent = (np.abs(down * forward * cos + horizontal**2 * sin) + np.abs(down * angle_y)) * scale
    return _Rays(theta, azimuth, weight, extent)


def _by_angle(rays: _Rays) -> tuple[FloatArray, FloatArray]:
    """Mean angle and summed weight of groups of rays, which determine the echoes of level targets."""
    low, high = rays.theta.min(), rays.theta.max()
    group = np.minimum(((rays.theta - low) / (high - low) * _ANGLES).astype(np.intp), _ANGLES - 1)
    weight = np.asarray(np.bincount(group, rays.weight, _ANGLES), dtype=np.float64)
    moment = np.asarray(np.bincount(group, rays.weight * rays.theta, _ANGLES), dtype=np.float64)
    seen = weight > 0
    return moment[seen] / weight[seen], weight[seen]


def _histogram(
    edges_ns: npt.ArrayLike, rays: _Rays, energy: FloatArray, time_ns: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Sum energies by arrival time, each spread evenly between the times of its cell's nearest and farthest angle."""
    edges = _edges(edges_ns)
    seen = energy > 0
    theta, half, amount = rays.theta[seen], rays.theta_extent[seen] / 2, energy[seen]
    early = time_ns(np.maximum(theta - half, 0))
    late = np.maximum(time_ns(theta + half), early + 1e-9)
    first = np.searchsorted(edges, early, side="right") - 1
    last = np.searchsorted(edges, late, side="left") - 1
    padded = np.concatenate(([-np.inf], edges, [np.inf]))
    total = np.zeros(edges.size + 1)  # with one bin before the record and one after it
    for lag in range(int(np.max(last - first, initial=0)) + 1):
        k = np.minimum(first + lag, edges.size - 1)
        overlap = np.minimum(padded[k + 2], late) - np.maximum(padded[k + 1], early)
        fraction = np.where(first + lag <= last, np.maximum(overlap, 0) / (late - early), 0)
        total += np.bincount(k + 1, amount * fraction, edges.size + 1)
    return total[1:-1]


def _edges(edges_ns: npt.ArrayLike) -> FloatArray:
    edges = finite_array("edges_ns", edges_ns)
    if edges.ndim != 1 or edges.size < 2 or np.any(np.diff(edges) <= 0):
        raise ValueError(f"edges_ns of shape {edges.shape} must be a strictly increasing list of at least 2 times")
    return edges
