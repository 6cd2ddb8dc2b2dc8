"""Beam and pixels of a loaded scene as bundles of rays, from the lidar to what they meet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.transport.plugin_types import Transmitter
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.probe import first_along
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.sensor.outlines import pixel_outlines
from mitransient_lidar.transport.sensor.pixels import PixelArray

#: Largest number of pixels that are bundles of their own, and of lines of an imager's pixels along a side.
_MOST_PIXELS, _MOST_LINES = 64, 17

#: Length of rays that meet nothing under water, and depth of those from the air in a scene without solids [m].
_REACH, _DEPTH = 20.0, 10.0

#: Smallest sine below the horizon of rays that are followed, and displacement of those that meet edges [m].
_SMALLEST_DESCENT, _ASIDE = 1e-3, (1e-4, 0.7e-4, 0.0)


@dataclass(frozen=True, eq=False)
class Bundle:
    """Rays along the outlines of a beam or a pixel, refracted as by a level sea.

    Attributes
    ----------
    name
        What the outline is of.
    kind
        ``beam``, ``pixel``, or ``lines`` between the pixels of an imager.
    azimuth
        Direction of the axis of the lidar, from +x to +y [rad].
    angles
        Full angles along angle_x and angle_y [rad].
    loops
        Points x, y, z of each outline in the scene [m], shape (levels, n, 3): the lidar, the sea surface, boundaries of
        index layers, and the solid that the ray meets first, or the depth at which it ends.
    """

    name: str
    kind: str
    azimuth: float
    angles: tuple[float, float]
    loops: list[FloatArray]

    def size(self, level: int) -> tuple[float, float]:
        """Return the lengths of the footprint at a level along and across the lidar's azimuth [m]."""
        points = np.concatenate([loop[level, :, :2] for loop in self.loops])
        cos, sin = np.cos(self.azimuth), np.sin(self.azimuth)
        return float(np.ptp(points @ (cos, sin))), float(np.ptp(points @ (-sin, cos)))


def bundles_of(scene: WaterScene, transmitter: Transmitter | None) -> list[Bundle]:
    """Return the bundles of all pixels, or of an imager its view and lines between its pixels, and of the beam.

    Rays that do not go down from a lidar in the air are left out, and bundles of such rays alone.
    """
    pose, pixels = scene.receiver.pose, scene.receiver.pixels
    outlines = [("pixel", name, pose, lines) for name, lines in _regions(pixels)]
    if pixels.grid is not None and pixels.sides is not None:
        blocks = " × ".join(str(_step(count)) for count in pixels.grid)
        radius = 0.5 * pixels.field_of_view if pixels.field_of_view_shape == "circle" else np.inf
        outlines.append(
            ("lines", f"lines between blocks of {blocks} pixels", pose, _lines(pixels.grid, pixels.sides, radius))
        )
    if transmitter is not None:
        for share, lines in transmitter.profile.outlines():
            name = "rim of the beam" if share == 1 else f"beam, {100 * share:.0f} % of its peak irradiance"
            outlines.append(("beam", name, transmitter.pose, lines))
    found = []
    for kind, name, origin, lines in outlines:
        # All at once: each call loads shapes and compiles kernels.
        points = traced(scene, origin, np.concatenate(lines))
        parts = np.split(points, np.cumsum([len(line) for line in lines])[:-1], axis=1)
        loops = [part[:, np.isfinite(part[-1, :, 0])] for part in parts]
        if loops := [loop for loop in loops if loop.shape[1]]:
            angles = np.ptp(np.concatenate(lines), axis=0)
            found.append(Bundle(name, kind, float(pose.azimuth), (float(angles[0]), float(angles[1])), loops))
    return found


def _regions(pixels: PixelArray) -> Iterator[tuple[str, list[FloatArray]]]:
    """Yield names and outlines (angle_x, angle_y) [rad] of the pixels, or of the field of view of many."""
    if pixels.grid is None and pixels.count <= _MOST_PIXELS:
        yield from zip((f"pixel {name}" for name in pixels.names), pixel_outlines(pixels), strict=True)
        return
    azimuth = np.linspace(0, 2 * np.pi, 185)  # with the corners of a square
    angles = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if pixels.field_of_view_shape in ("square", "rectangle"):
        angles /= np.abs(angles).max(axis=1, keepdims=True)
    sides = np.array(pixels.sides or (pixels.field_of_view,) * 2)
    yield f"field of view of {pixels.count} pixels", [0.5 * sides * angles]


def _step(count: int) -> int:
    """Return the number of rows or columns of pixels between two lines."""
    return -(-count // (_MOST_LINES - 1))


def _lines(grid: tuple[int, int], sides: tuple[float, float], radius: float) -> list[FloatArray]:
    """Return evenly chosen lines between the rows and the columns of an imager within a radius [rad]."""
    edges = [
        side * (np.unique([*range(0, count, _step(count)), count]) / count - 0.5)
        for count, side in zip(grid, sides, strict=True)
    ]
    found = []
    for axis in (0, 1):
        along = np.linspace(edges[1 - axis][0], edges[1 - axis][-1], 65)
        for place in edges[axis]:
            line = np.stack([np.full_like(along, place), along][:: 1 - 2 * axis], axis=-1)
            line = line[np.hypot(*line.T) <= radius]
            found += [line] * (len(line) > 1)
    return found


def traced(scene: WaterScene, pose: KernelPose, angles: FloatArray) -> FloatArray:
    """Follow rays from a pose at tangent-plane angles [rad], shape (n, 2): points as of `Bundle.loops`.

    They meet the sea at its waves, which do not turn them: they are refracted as by a level sea. Points are NaN of rays
    that do not go down from a pose in the air.
    """
    rays = pose.directions(angles)
    if pose.submerged:
        start = np.broadcast_to(pose.origin, rays.shape)
        ends = first_along(scene, [*scene.solids, *scene.surfaces], [start, start + _REACH * rays])
        ends = np.where(np.isfinite(ends), ends, start + _REACH * rays)
        return np.asarray(np.stack([start, start, ends]) + scene.frame_origin)
    falls = rays[:, 2] < -_SMALLEST_DESCENT
    rays = np.where(falls[:, None], rays, [0.0, 0.0, -1.0])
    start = np.broadcast_to(pose.origin, rays.shape)
    sea, bottoms = scene.level_sea, [float(solid.bbox().min.z) - 1.0 for solid in scene.solids]
    trough = scene.sea_heights[0] - 0.01 if scene.sea_heights else 0.0
    lowest = min(bottoms, default=trough - _DEPTH)
    levels = [0.0, *(-boundary for boundary in sea.boundaries if -boundary > lowest), min(lowest, -0.01)]

    def at(water: LevelSea, z: float) -> FloatArray:
        return np.insert(water.at_height(pose.origin, rays, z), 2, z, axis=1)

    corners = [start, *(at(sea, z) for z in levels)]
    ends = first_along(scene, scene.solids, corners)
    # Rays in single precision may pass between two triangles where they meet an edge: those beside them do not.
    if (missed := np.isnan(ends[:, 0])).any():
        ends[missed] = first_along(scene, scene.solids, [corner[missed] + _ASIDE for corner in corners])
    ends = np.where(np.isfinite(ends), ends, corners[-1])
    on_sea = first_along(scene, scene.surfaces, [start, at(LevelSea((1.0,)), trough)])
    corners[1], corners[-1] = np.where(np.isfinite(on_sea), on_sea, corners[1]), ends
    # Where a ray has met a solid it stays.
    corners[1:] = [np.where(corner[:, 2:] < ends[:, 2:], ends, corner) for corner in corners[1:]]
    return np.where(falls[:, None], np.stack(corners) + scene.frame_origin, np.nan)
