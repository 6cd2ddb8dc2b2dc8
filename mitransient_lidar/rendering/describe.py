"""Result attributes that describe lidar, sea, and pixel, beam and target layout; pixel lines of sight."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.rendering.accuracy import ErrorWindow
from mitransient_lidar.results.geometry import LinesOfSight
from mitransient_lidar.transport.opaque import aligned, aligned_ray
from mitransient_lidar.transport.paths.ripple_focusing import RippleFocusing
from mitransient_lidar.transport.probe import Probe, axis_on_bottom
from mitransient_lidar.transport.scene import LidarScene, WaterScene
from mitransient_lidar.transport.sensor.outlines import pixel_outlines, simplified
from mitransient_lidar.transport.solids import box_rays, scene_of_shapes

_MOST_PIXELS = 256  #: Largest number of pixels whose outlines are stored.
_LONGEST_TEXT = 60_000  #: Longest attribute text; NetCDF files limit it to 64 KiB.
_TOLERANCE = 5e-4  #: Largest distance of simplified outlines from their points, relative to the size.
_MOST_SAMPLES = 1000  #: Most samples of a pulse.

#: Shapes with points that Mitsuba samples; rays find those of others. Numbers of both along each side.
_SAMPLED, SAMPLED_TICKS = ("Sphere", "Disk", "Cylinder", "Rectangle"), 64


def with_lines_of_sight(dataset: xr.Dataset, lidar: LidarScene) -> xr.Dataset:
    """Return a result with the pixels' lines of sight as coordinates, unless the scene has no surface."""
    if not lidar.surfaces:
        return dataset
    pixels = lidar.receiver.pixels
    dims = ("pixel",) if pixels.grid is None else ("row", "column")
    return dataset.assign_coords(lines_of_sight(lidar).coordinates(dims, pixels.grid or (pixels.count,)))


def describe_scene(probe: Probe, window: ErrorWindow, focusing: RippleFocusing | None) -> dict[str, Any]:
    """Return the result attributes that describe lidar, sea and expected echoes."""
    heights = probe.scene.sea_heights
    # Depths are relative to the mean arrival of the surface echo over all pixels.
    arrivals = probe.echoes.surface_ns[:, 1]
    surface = {"surface_time_ns": float(np.nanmean(arrivals))} if np.isfinite(arrivals).any() else {}
    return {
        "beam_outside_surface": probe.echoes.missed_beam,
        **({"beam_on_land": probe.echoes.on_land} if probe.echoes.on_land else {}),
        **describe_lidar(probe),
        **surface,
        **({} if heights is None else {"surface_heights_m": list(heights)}),
        **({} if focusing is None else focusing.describe()),
        "window_start_ns": float(window.start_ns.min()),
        "window_end_ns": float(window.end_ns.max()),
    }


def describe_lidar(probe: Probe) -> dict[str, Any]:
    """Return the result attributes that describe lidar, refractive indices, and layout."""
    scene = probe.scene
    transmitter, receiver = scene.transmitter, scene.receiver
    pixels, optics, profile = receiver.pixels, receiver.optics, transmitter.profile
    return {
        "layout": pixels.layout,
        "field_of_view_mrad": 1e3 * pixels.field_of_view,
        "field_of_view_sides_mrad": [1e3 * side for side in pixels.sides or ()],
        "field_of_view_shape": pixels.field_of_view_shape,
        "aperture_area": optics.aperture_area,
        "obscuration": optics.obscuration,
        "response_time_ns": optics.response_time_ns,
        "pulse_energy_mj": 1e3 * transmitter.pulse_energy,
        "two_way_efficiency": (
            transmitter.optical_efficiency * optics.optical_efficiency * optics.two_way_atmospheric_transmittance
        ),
        "pulse_fwhm_ns": transmitter.pulse.fwhm_ns,
        **_describe_pulse(transmitter.pulse),
        "beam_profile": transmitter.beam_profile,
        "divergence_mrad": 1e3 * profile.divergence[0],
        "divergence_across_mrad": 1e3 * profile.divergence[1],
        "ellipse_deg": float(np.degrees(profile.rotation)),
        "wavelength_nm": transmitter.wavelength_nm,
        "altitude": float(transmitter.pose.origin[2]),
        "off_nadir_deg": transmitter.pose.off_nadir_deg,
        "refractive_index": scene.refractive_index,
        "group_index": scene.group_index,
        "surface_slope_variance": scene.slope_variance,
        **describe_layout(probe),
    }


def _describe_pulse(pulse: Pulse) -> dict[str, list[float]]:
    """Return times [ns] and power [1/ns] for a pulse that is not Gaussian, as lists with at most 1000 samples."""
    if pulse.shape == "gaussian":
        return {}
    times = pulse.times_ns
    if times.size > _MOST_SAMPLES:
        times = np.linspace(times[0], times[-1], _MOST_SAMPLES)
    power = np.interp(times, pulse.times_ns, pulse.power)
    return {"pulse_times_ns": times.tolist(), "pulse_power": power.tolist()}


def describe_layout(probe: Probe) -> dict[str, Any]:
    """Return the result attributes that `plot_layout` draws.

    ``receiver_pose`` and ``transmitter_pose`` are origin [m], axis, far and left, 12 numbers each. ``bottom_point`` is
    the point x, y, z [m] where the receiver's axis, refracted by a level sea, meets the bottom (`WaterScene.bottoms`);
    missing without one. Water with several index layers has ``index_layers``, their refractive indices, and
    ``index_boundaries``, the depths between them [m].

    JSON texts are ``beam_outlines`` (peak share, and lines), ``pixel_outlines`` (each pixel's lines; not for imagers)
    and ``target_outlines``, for each target that the view may see (`Rays.meets`). A target has an ``id``, ``z`` (lowest
    and highest point [m]) and ``line`` (its vertical projection). ``seen`` is its outline on the sea level along the
    receiver's refracted lines of sight. With a ``bottom_point`` it also has a ``shadow`` (its shadow's outline in the
    laser light at this point's height). A line is closed, with its points' coordinates angle_x, angle_y [mrad], or x, y
    [m] for targets. Texts above the limit are omitted.
    """
    scene = probe.scene
    transmitter, receiver = scene.transmitter, scene.receiver
    targets = [solid for solid in scene.targets if probe.view.meets(solid)]
    found = axis_on_bottom(scene, receiver.pose.origin[None], receiver.pose.axis)[0]
    bottom = found if np.isfinite(found).all() else None
    texts: dict[str, list[Any]] = {
        "target_outlines": [_describe_target(scene, target, bottom) for target in targets],
        "beam_outlines": [],
    }
    for share, lines in transmitter.profile.outlines():
        short = [_flat(simplified(1e3 * line, 1e3 * _TOLERANCE * float(np.ptp(line)))) for line in lines]
        texts["beam_outlines"].append({"share": round(share, 4), "lines": short})
    if receiver.pixels.grid is None and receiver.pixels.count <= _MOST_PIXELS:
        texts["pixel_outlines"] = [[_flat(1e3 * line) for line in lines] for lines in pixel_outlines(receiver.pixels)]
    described: dict[str, Any] = {
        f"{name}_pose": [*pose.in_scene(pose.origin).tolist(), *pose.frame.ravel().tolist()]
        for name, pose in (("transmitter", transmitter.pose), ("receiver", receiver.pose))
    }
    if bottom is not None:
        described["bottom_point"] = bottom.tolist()
    if scene.level_sea.boundaries:
        described["index_layers"] = list(scene.level_sea.refractive_index)
        described["index_boundaries"] = list(scene.level_sea.boundaries)
    for name, value in texts.items():
        text = json.dumps(value, separators=(",", ":"))
        if value and len(text) <= _LONGEST_TEXT:
            described[name] = text
    return described


def _describe_target(scene: LidarScene, target: mi.Shape, bottom: FloatArray | None) -> dict[str, Any]:
    """Return a target's name, heights and outlines."""
    sea, points, at = scene.level_sea, surface_points(scene, target), scene.frame_origin[:2]
    seen = sea.crossing(scene.receiver.pose.origin, points)
    found = {
        "id": target.id(),
        "z": [round(float(z), 4) for z in (target.bbox().min.z, target.bbox().max.z)],
        "line": _outline(points[:, :2] + at),
        "seen": _outline(seen + at),
    }
    if bottom is not None and (points[:, 2] > bottom[2]).any():
        laser = scene.transmitter.pose.origin
        above = points[points[:, 2] > bottom[2]]
        entries = np.pad(sea.crossing(laser, above), ((0, 0), (0, 1)))
        found["shadow"] = _outline(sea.at_height(laser, entries - laser, bottom[2]) + at)
    return found


def surface_points(scene: WaterScene, solid: mi.Shape) -> FloatArray:
    """Return a mesh's corners, or points all over another shape [m], shape (n, 3)."""
    known = mi.traverse(solid)
    if "vertex_positions" in known:
        return np.array(known["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    if solid.class_name() not in _SAMPLED:
        box = solid.bbox()
        origins, directions = box_rays(np.array(box.min), np.array(box.max), SAMPLED_TICKS)
        rays = aligned_ray(origins, directions, np.full(len(origins), np.inf))
        hit = scene_of_shapes([solid], scene.groups).ray_intersect(rays)
        points: FloatArray = np.array(hit.p, dtype=np.float64).T[np.array(hit.is_valid())]
        return points
    ticks = np.linspace(0, 1, SAMPLED_TICKS + 1)
    u, v = (mi.Float(g.ravel()) for g in np.meshgrid(ticks, ticks))
    return np.array(solid.sample_position(0.0, mi.Point2f(u, v)).p, dtype=np.float64).T


def _outline(points: FloatArray) -> list[float]:
    """Return the convex outline of points (x, y), a closed line, as rounded coordinates."""
    from scipy.spatial import ConvexHull, QhullError

    flat = np.unique(points[np.isfinite(points).all(axis=1)], axis=0)
    if len(flat) == 0:
        return []
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:
        hull = flat[[0, -1]]  # the points lie on a line
    closed = np.concatenate([hull, hull[:1]])
    size = float(np.ptp(closed, axis=0).max())
    return _flat(simplified(closed, _TOLERANCE * size), size)


def _flat(line: FloatArray, size: float | None = None) -> list[float]:
    """Return a line's rounded coordinates, with errors about 1/5000 of a size, by default the largest."""
    size = float(np.abs(line).max()) if size is None else size
    digits = max(0, 3 - math.floor(math.log10(max(size, 1e-6))))
    return np.round(line, digits).ravel().tolist()


#: Lattice points for lines of sight: the fewest, those per pixel, and the most.
_POINTS, _POINTS_PER_PIXEL, _MOST_POINTS = 2**14, 8, 2**20

#: Depth at which the depth scale is taken, relative to the lower instrument's height, and its limit [m].
_RELATIVE_DEPTH, _DEEPEST = 0.05, 10.0


def lines_of_sight(scene: LidarScene, turn_deg: float = 0.0) -> LinesOfSight:
    """Return the pixels' lines of sight over a level sea at z = 0, weighted with the beam.

    The lidar may be turned about the receiver's axis, from far to left [deg]; angles refer to the unturned lidar.

    Under water they are straight, and ``surface_time`` is where depths on their scale are 0. This is before the pulse
    is emitted if the lidar looks down.

    Each pixel uses the better sampled of two point sets: beam points in the pixel, and points in the pixel with the
    beam's density. A pixel without either has the line of sight at its centre and no share.
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
    """Return receiver and transmitter poses, turned about the receiver's axis from far to left [deg]."""
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
    """Return times [ns] for paths from one pose at angles [rad], shape (n, 2), by a depth to another, and their end.

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
