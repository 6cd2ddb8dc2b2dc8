"""Elevation and slopes of a sea over the footprint of the beam, and places of given slopes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.sea.height_maps import HeightMap

if TYPE_CHECKING:
    import mitsuba as mi

    from mitransient_lidar.transport.plugin_types import Transmitter

#: Slopes along and across the lidar's azimuth of each kind of shot, in units of `slope_sigmas` standard deviations.
SLOPE_KINDS = {"towards": (1.0, 0.0), "level": (0.0, 0.0), "away": (-1.0, 0.0), "sideways": (0.0, 1.0)}

#: Longest side of the sea that is searched [m].
_LARGEST_SEARCH = 512.0

#: Largest difference of the nearest place from the slopes wanted, in standard deviations of the slopes.
_NEAREST = 1.0


@dataclass(frozen=True)
class Shot:
    """Intersection of the beam's axis with the mean sea level.

    `x` and `y` are the values of ``aim_x`` and ``aim_y`` [m], `along` and `across` the mean slopes over the beam's
    footprint along the lidar's azimuth, positive for a face towards the lidar, and to its left [1].
    """

    kind: str
    x: float
    y: float
    along: float
    across: float


@dataclass(frozen=True)
class SeaMap:
    """Elevation of a sea [m] on grid lines [m], shape (len(y), len(x)), and its slopes averaged over the footprint.

    Slopes are along the lidar's azimuth and to its left [1], as in `Shot`.
    """

    x: FloatArray
    y: FloatArray
    heights: FloatArray
    along: FloatArray
    across: FloatArray

    @classmethod
    def of_scene(cls, scene: mi.Scene) -> SeaMap:
        """Return the map of a scene; reject one without waves."""
        from scipy.ndimage import gaussian_filter

        from mitransient_lidar.transport.scene_parts import seas_of

        sea = next((found.sea for found in seas_of(scene)), None)
        if sea is None or (sea.waves is None and sea.wake is None):
            raise UserError("the scene has no ocean_surface with waves: every shot on a flat sea is the same")
        transmitter = transmitter_of(scene)
        transmitter.pose.require_above_sea()
        # Of a sea of several grids the coarsest.
        grid = None if isinstance(sea.waves, HeightMap) else sea.waves
        cell, cells = (sea.cell_size, int(sea.size / sea.cell_size)) if grid is None else (grid.cell_size, grid.cells)
        count = min(cells, int(_LARGEST_SEARCH / cell)) // 2
        # About the origin of the scene, or about the frame of a lidar that is far from it.
        middle = [round(float(place) / cell) for place in transmitter.pose.frame_origin[:2]]
        x, y = (np.asarray((np.arange(-count, count) + place) * cell, dtype=np.float64) for place in middle)
        heights = sea.heights(x, y)
        azimuth, spread_along, spread_across = footprint(transmitter)
        # A circle of the same area replaces the elliptical footprint.
        sigma = math.sqrt(spread_along * spread_across) / cell
        # The sea of a spectrum is periodic; a height map ends at its edges.
        smooth = gaussian_filter(heights, sigma, mode="wrap" if sea.spectrum != "height_map" else "nearest")
        up, right = np.gradient(smooth, cell)
        cos, sin = math.cos(azimuth), math.sin(azimuth)
        return cls(x, y, heights, cos * right + sin * up, cos * up - sin * right)

    def slope_at(self, x: float, y: float) -> tuple[float, float]:
        """Return the mean slopes (along, across) [1] over a footprint at a place [m] of the periodic sea."""
        spacing = self.x[1] - self.x[0]
        pairs = ((x, self.x), (y, self.y))
        i, j = (round((value - lines[0]) / spacing) % len(lines) for value, lines in pairs)
        return float(self.along[j, i]), float(self.across[j, i])

    def find(self, kind: str, slope_sigmas: float, count: int, apart: float) -> list[Shot]:
        """Return the places with the slopes nearest to those of a kind, at least `apart` metres from each other."""
        spread = np.sqrt([np.mean(self.along**2), np.mean(self.across**2)])
        wanted = slope_sigmas * np.array(SLOPE_KINDS[kind]) * spread
        distance = np.hypot((self.along - wanted[0]) / spread[0], (self.across - wanted[1]) / spread[1])
        if not (nearest := float(np.min(distance, initial=np.inf))) <= _NEAREST:
            raise UserError(
                f"slope_sigmas = {slope_sigmas:g}: the sea has no place of the kind {kind} with such a slope; the "
                f"nearest one differs by {nearest:.1f} standard deviations, and at most {_NEAREST:g} are allowed"
            )
        return self._nearest(kind, distance, count, apart)

    def near(self, slopes: tuple[float, float], count: int, apart: float) -> list[Shot]:
        """Return the places whose slopes (along, across) [1] are nearest to given ones, `apart` metres or more apart.

        A small sea may have fewer than `count` places.
        """
        distance = np.hypot(self.along - slopes[0], self.across - slopes[1])
        return self._nearest("near", distance, count, apart)

    def _nearest(self, kind: str, distance: FloatArray, count: int, apart: float) -> list[Shot]:
        """Return places in the order of a distance of their slopes, shape of the map."""
        shots: list[Shot] = []
        for index in np.argsort(distance, axis=None):
            j, i = np.unravel_index(index, distance.shape)
            x, y = float(self.x[i]), float(self.y[j])
            if all(math.hypot(x - shot.x, y - shot.y) >= apart for shot in shots):
                shots.append(Shot(kind, x, y, float(self.along[j, i]), float(self.across[j, i])))
            if len(shots) == count:
                break
        return shots


def transmitter_of(scene: mi.Scene) -> Transmitter:
    """Return the transmitter of a scene; raise UserError without one."""
    from mitransient_lidar.transport.plugin_types import Transmitter

    transmitter = next((emitter for emitter in scene.emitters() if isinstance(emitter, Transmitter)), None)
    if transmitter is None:
        raise UserError("the scene needs a lidar_transmitter and a multipixel_receiver to find shots for")
    return transmitter


def footprint(transmitter: Transmitter) -> tuple[float, float, float]:
    """Return the beam's azimuth [rad], and its spread on the mean sea level along and across it [m]."""
    pose = transmitter.pose
    across = transmitter.widest_angular_spread * pose.ground_range
    return float(pose.azimuth), across / max(-float(pose.axis[2]), 1e-3), across
