"""Pixel lines of sight over a level sea."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.results.geometry import LinesOfSight
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.scene import LidarScene

#: Lattice points for lines of sight: the fewest, those per pixel, and the most.
_POINTS, _POINTS_PER_PIXEL, _MOST_POINTS = 2**14, 8, 2**20

#: Depth at which the depth scale is taken, relative to the lower instrument's height, and its limit [m].
_RELATIVE_DEPTH, _DEEPEST = 0.05, 10.0


def lines_of_sight(scene: LidarScene, turn_deg: float = 0.0) -> LinesOfSight:
    """Return the pixels' lines of sight over a level sea at z = 0, weighted with the beam.

    The lidar may be turned about the receiver's axis, from far to left [deg]; angles refer to the unturned lidar.

    Under water they are straight, and ``surface_time`` is where depths on their scale are 0, before the pulse is
    emitted if the lidar looks down.

    Each pixel uses the better sampled one of two point sets: beam points that are in the pixel, and points in the pixel
    with the beam's density. A pixel without either has the line of sight at its centre and no share.
    """
    pixels = scene.receiver.pixels
    depths = _depths_of_scale(scene)
    poses = _turned(scene, turn_deg)
    surface, below = (_mean_sight(scene, poses, at) for at in depths)
    centres = pixels.centres()
    lit = (surface.share > 0) & (below.share > 0)
    seen = np.where(lit[:, np.newaxis], surface.angles, centres)
    time, deep = (
        np.where(lit, sight.time, _two_way(scene, *poses, centres, at)[0])
        for sight, at in zip((surface, below), depths, strict=True)
    )
    directions = poses[0].directions(seen)
    off_nadir = np.arccos(np.clip(-directions[:, 2], -1, 1))
    x, y = seen.T if turn_deg == 0 else scene.receiver.pose.angles_of(directions).T
    spread, share = (np.where(lit, values, 0.0) for values in (surface.spread, surface.share))
    depth_per_ns = (depths[1] - depths[0]) / (deep - time)
    return LinesOfSight(x, y, off_nadir, time - depths[0] / depth_per_ns, spread, depth_per_ns, share)


def _turned(scene: LidarScene, turn_deg: float) -> tuple[Pose, Pose]:
    """Return the poses of receiver and transmitter, turned about the receiver's axis from far to left [deg]."""
    own, other = scene.receiver.pose, scene.transmitter.pose
    if turn_deg == 0:
        return own, other
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]])
    rotation = (turn @ own.frame).T @ own.frame
    shift = own.origin - rotation @ own.origin
    return own.moved(rotation, shift), other.moved(rotation, shift)


def _depths_of_scale(scene: LidarScene) -> tuple[float, float]:
    """Return two depths between which the depth scale is taken [m]; under water ahead of both poses."""
    heights = [float(pose.origin[2]) for pose in (scene.receiver.pose, scene.transmitter.pose)]
    if not scene.submerged:
        return 0.0, min(_RELATIVE_DEPTH * min(heights), _DEEPEST)
    if scene.receiver.pose.axis[2] > 0:
        return -0.5 * max(heights), 0.0
    return _DEEPEST - min(heights), 2 * _DEEPEST - min(heights)


@dataclass(frozen=True)
class _Sight:
    """Beam-weighted pixel means: time and its spread [ns], angles [rad], and beam share; (pixels,)."""

    time: FloatArray
    spread: FloatArray
    angles: FloatArray
    share: FloatArray
    points: FloatArray  #: Effective number of points.


def _mean_sight(scene: LidarScene, poses: tuple[Pose, Pose], depth: float) -> _Sight:
    """Return the means over the beam light that pixels see at a depth [m], for poses of receiver and laser."""
    pixels, transmitter = scene.receiver.pixels, scene.transmitter

    # Beam points with equal energy. One of several pixels at a point represents them all.
    angle_x, angle_y = transmitter.sample_tangent(_lattice(_POINTS))
    time, angles = _two_way(scene, *poses[::-1], np.stack([np.array(angle_x), np.array(angle_y)], axis=1), depth)
    seen_x, seen_y = (aligned(mi.Float, axis) for axis in angles.T)
    pixel, inside = pixels.pixel_at(seen_x, seen_y, _choices(_POINTS))
    share = np.where(np.isfinite(time), np.array(inside, dtype=np.float64) / _POINTS, 0.0)
    by_beam = _means(time, angles, np.array(pixel), share, pixels.count)

    # Pixel points, weighted with the beam's density.
    count = int(np.clip(_POINTS_PER_PIXEL * pixels.count, _POINTS, _MOST_POINTS))
    angle_x, angle_y = pixels.sample(_lattice(count))
    pixel, inside = pixels.pixel_at(angle_x, angle_y, _choices(count))
    angles = np.stack([np.array(angle_x), np.array(angle_y)], axis=1).astype(np.float64)
    time, at_laser = _two_way(scene, *poses, angles, depth)
    density = np.array(transmitter.tangent_density(*(aligned(mi.Float, axis) for axis in at_laser.T)), dtype=np.float64)
    weight = np.where((np.array(inside) > 0) & np.isfinite(time), density, 0) * (pixels.area / count)
    by_pixel = _means(time, angles, np.array(pixel), weight, pixels.count)

    better = by_beam.points >= by_pixel.points
    return _Sight(
        *(
            np.where(better if one.ndim == 1 else better[:, np.newaxis], one, other)
            for one, other in zip(vars(by_beam).values(), vars(by_pixel).values(), strict=True)
        )
    )


def _means(time: FloatArray, angles: FloatArray, pixel: NDArray[np.integer], weight: FloatArray, count: int) -> _Sight:
    """Return weighted means over each pixel's points."""
    total, squares = (np.asarray(np.bincount(pixel, one, count), dtype=np.float64) for one in (weight, weight**2))
    safe = np.where(total > 0, total, 1.0)
    first = float(np.nanmin(time)) if np.isfinite(time).any() else 0.0

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(pixel, weight * np.where(weight > 0, values, 0), count) / safe)

    delay = mean(time - first)
    spread = np.sqrt(np.maximum(mean((time - first) ** 2) - delay**2, 0))
    points = total**2 / np.where(squares > 0, squares, 1.0)
    return _Sight(first + delay, spread, np.stack([mean(axis) for axis in angles.T], axis=1), total, points)


def _lattice(count: int) -> mi.Point2f:
    """Return the points of a rank-1 lattice in the unit square, computed in 64 bits."""
    index = np.arange(count)
    return mi.Point2f(*(aligned(mi.Float, u) for u in ((index + 0.5) / count, (index * 0.6180339887498949) % 1)))


def _choices(count: int) -> mi.Float:
    """Return evenly distributed numbers from 0 to 1, independent of the `_lattice` points."""
    return aligned(mi.Float, (np.arange(count) * 0.4142135623730951) % 1)


def _two_way(
    scene: LidarScene, start: Pose, end: Pose, angles: FloatArray, depth: float
) -> tuple[FloatArray, FloatArray]:
    """Return the times [ns] of paths from one pose at angles [rad], shape (n, 2), by a depth to another, and their end.

    The ends are angles about the other pose. Paths that do not meet the sea, or end behind the pose, are NaN.
    """
    group = scene.group_index
    direction = start.directions(angles)
    if scene.submerged:
        distance = (-depth - start.origin[2]) / np.where(direction[:, 2] != 0, direction[:, 2], np.nan)
        distance = np.where(distance > 0, distance, np.nan)
        offset = start.origin + direction * distance[:, np.newaxis] - end.origin
        way_back = np.linalg.norm(offset, axis=1)
        return 1e9 / C0 * group * (distance + way_back), _tangent(end, offset)
    # The depth scale belongs to the top index layer.
    sea = LevelSea((scene.refractive_index,), group_index=(group,))
    down = np.where(direction[:, 2] < 0, -direction[:, 2], np.nan)
    one_way = start.origin[2] / down + sea.lengths(depth, np.hypot(*direction[:, :2].T))[0]
    if np.all(start.origin == end.origin):
        return 2e9 / C0 * one_way, _tangent(end, direction)
    places = sea.at_height(start.origin, direction, -depth)
    known = np.isfinite(places[:, 0])
    points = np.column_stack([np.where(known[:, np.newaxis], places, 0.0), np.full(len(places), -depth)])
    arriving = np.pad(sea.crossing(end.origin, points), ((0, 0), (0, 1))) - end.origin
    air = np.linalg.norm(arriving, axis=1)
    back = air + sea.lengths(depth, np.hypot(*arriving[:, :2].T) / air)[0]
    return 1e9 / C0 * np.where(known, one_way + back, np.nan), _tangent(end, arriving)


def _tangent(pose: Pose, directions: FloatArray) -> FloatArray:
    """Return the tangent-plane angles [rad] of directions, NaN behind the pose; shape (n, 2)."""
    ahead = np.where(directions @ pose.axis > 0, 1.0, np.nan)
    return pose.angles_of(directions * ahead[:, np.newaxis])
