"""Two-way echo times [ns] of a lidar over a level sea; `theta` is the angle of the ray in air [rad]."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import snell, surface_time_ns


def bottom_time_ns(
    height: npt.ArrayLike, depth: npt.ArrayLike, theta: npt.ArrayLike, n: float, group_index: float
) -> FloatArray:
    """Time to a `depth` [m] in water of refractive index `n` from a `height` [m] above the surface."""
    path = np.asarray(depth, dtype=np.float64) / np.cos(snell(theta, n))
    return np.asarray(surface_time_ns(height, theta) + 2e9 * group_index * path / C0)


def layered_time_ns(
    height: float, thicknesses: list[float], theta: npt.ArrayLike, indices: list[float], group_indices: list[float]
) -> FloatArray:
    """Time to the lower edge of the last of several index layers, each with sin(theta) = n sin(phi)."""
    time = surface_time_ns(height, theta)
    for thickness, n, group_index in zip(thicknesses, indices, group_indices, strict=True):
        time = time + 2e9 * group_index * thickness / (C0 * np.cos(snell(theta, n)))
    return time
