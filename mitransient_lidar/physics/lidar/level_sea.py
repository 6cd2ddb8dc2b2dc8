"""Lines of sight refracted by a level sea: where they meet a depth, and where they cross the sea level."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, finite_array

#: Steps of Newton's method, and the relative change at which it ends.
_STEPS, _CHANGE = 60, 4e-16

#: Directions nearer to the horizon than this sine are taken as horizontal.
_SMALLEST_DESCENT = 1e-9


@dataclass(frozen=True)
class LevelSea:
    """Water below the mean sea level z = 0, in layers of one refractive index each.

    Parameters
    ----------
    refractive_index
        Indices relative to air from the top down, at least 1, shape (layers,).
    boundaries
        Depths of the boundaries between the layers [m], increasing, shape (layers - 1,).
    group_index
        Group indices of the layers; by default the refractive indices.
    """

    refractive_index: tuple[float, ...]
    boundaries: tuple[float, ...] = ()
    group_index: tuple[float, ...] | None = None

    def lengths(self, depth: npt.ArrayLike, sine: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the optical length of rays from the sea level to depths, and the horizontal one over the sine [m].

        Depths [m] and sines of the angles from the vertical in the air broadcast; lengths to points in the air are 0.
        """
        depth, sine = np.asarray(depth, dtype=np.float64), np.asarray(sine, dtype=np.float64)
        optical = horizontal = np.zeros(np.broadcast_shapes(depth.shape, sine.shape))
        groups = self.group_index or self.refractive_index
        for index, group, thickness in zip(self.refractive_index, groups, self._thickness(depth), strict=True):
            length = thickness / np.sqrt(index**2 - sine**2)
            optical, horizontal = optical + group * index * length, horizontal + length
        return optical, horizontal

    def at_height(self, origin: FloatArray, directions: npt.ArrayLike, z: npt.ArrayLike) -> FloatArray:
        """Return where rays from points in the air meet a height, in the air or in the water.

        Parameters
        ----------
        origin
            Point in the air, x, y, z [m], or one for each ray, shape (..., 3).
        directions
            Ray directions in the air, of any length, shape (..., 3).
        z
            Heights [m], below the origin, shape (...).

        Returns
        -------
        ndarray
            x, y [m], shape (..., 2); NaN for rays that do not go down.
        """
        rays = finite_array("directions", directions)
        level = np.broadcast_to(finite_array("z", z), rays.shape[:-1])
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        sine = np.hypot(rays[..., 0], rays[..., 1])
        down = np.where(rays[..., 2] < -_SMALLEST_DESCENT, -rays[..., 2], np.nan)
        distance = (origin[..., 2] - np.maximum(level, 0)) / down + self.lengths(-level, sine)[1]
        return np.asarray(origin[..., :2] + rays[..., :2] * distance[..., None])

    def crossing(self, origin: FloatArray, points: npt.ArrayLike) -> FloatArray:
        """Return where lines of sight from a point in the air to points cross the sea level.

        Lines to points in the air are prolonged straight to the sea level.

        Parameters
        ----------
        origin
            Point in the air, x, y, z [m].
        points
            Points x, y, z [m], shape (..., 3).

        Returns
        -------
        ndarray
            x, y [m], shape (..., 2); NaN for points in the air that are not below the origin.
        """
        points = finite_array("points", points)
        offset, height = points[..., :2] - origin[:2], float(origin[2])
        target = np.linalg.norm(offset, axis=-1)
        in_water = height * self._tangents(target, height, -points[..., 2]) / np.where(target > 0, target, 1)
        drop = np.where(points[..., 2] < height, height - points[..., 2], np.nan)
        share = np.where(points[..., 2] > 0, height / drop, np.where(target > 0, in_water, 0))
        return np.asarray(origin[:2] + offset * share[..., None])

    def _tangents(self, distance: FloatArray, height: float, depth: FloatArray) -> FloatArray:
        """Return the tangents of ray angles from the vertical in air, between points in air and in the water.

        The points are a horizontal distance [m] apart; the height is above the sea level, positive [m].
        """
        # The distance is a concave, increasing function of the tangent: Newton's method from 0 cannot overshoot.
        t, layers = np.zeros_like(distance), list(zip(self.refractive_index, self._thickness(depth), strict=True))
        for _ in range(_STEPS):
            missing, rise = distance - height * t, np.full_like(t, height)
            for n, thickness in layers:
                root = np.sqrt(n**2 + (n**2 - 1) * t**2)
                missing, rise = missing - thickness * t / root, rise + thickness * n**2 / root**3
            change = missing / rise
            t = t + change
            if np.all(np.abs(change) <= _CHANGE * t):
                break
        return np.asarray(t)

    def _thickness(self, depth: FloatArray) -> list[FloatArray]:
        """Return each layer's thickness above depths [m]."""
        edges = [0.0, *self.boundaries, np.inf]
        return [np.clip(depth - top, 0, bottom - top) for top, bottom in itertools.pairwise(edges)]
