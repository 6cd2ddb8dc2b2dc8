"""One look ahead: where the rays of a view and a beam meet the sea, the solids or a height, and when echoes come."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.transport.medium.water import refract
from mitransient_lidar.transport.opaque import aligned, opaque, opaque_point, shape_number
from mitransient_lidar.transport.plugin_types import Transmitter
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.rng import Lanes, pass_streams, unit_points
from mitransient_lidar.transport.scene import LidarScene, WaterScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler
from mitransient_lidar.transport.solids import box_of, met_numbers, scene_of_shapes

_ASIDE = (1e-4, 0.7e-4, 0.0)  #: Displacement of rays that pass between faces [m].
PROBE_RAYS = 4096  #: Rays in a view and in a beam; Gaussian beam rays reach 4.2 standard deviations.

#: Distance outside view or beam within which waves and scattering still light a shape, over its depth.
_REACH_PER_DEPTH = 0.3

#: Number of rays that find echoes, and share of the beam excluded at either end of an echo.
_ECHO_RAYS, _TAIL = 2**16, 0.05

_LAND_RAYS = 256  #: Rays for each pixel of a shot that find land.

#: Largest number of pixels; with more, each would get too few rays, and the receiver is treated as one pixel.
_MOST_PIXELS = 1024


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in a view or in a beam."""

    #: Scene, and pose from which the rays start.
    scene: WaterScene
    pose: KernelPose
    #: Tangent-plane angles and unit directions.
    angles: mi.Point2f
    direction: mi.Vector3f
    seen: mi.Bool  #: Which rays count: in a view the rays that pixels see, in a beam all.

    @classmethod
    def of_view(cls, scene: WaterScene, sampler: SensorSampler) -> Rays:
        """Return rays in the field of view."""
        start = sampler.sample(dr.arange(mi.UInt32, PROBE_RAYS), PROBE_RAYS, pass_streams(0, 0, PROBE_RAYS))
        seen = start.weight > 0
        dr.eval(start, seen)
        return cls(scene, scene.receiver.pose, start.angles, start.direction, seen)

    @classmethod
    def of_beam(cls, scene: WaterScene, transmitter: Transmitter) -> Rays:
        """Return laser rays with equal energy."""
        angles, pose = mi.Point2f(transmitter.sample_tangent(unit_points(PROBE_RAYS))), transmitter.pose
        return cls(scene, pose, angles, pose.direction(*angles), mi.Bool(True))

    @cached_property
    def first(self) -> mi.SurfaceInteraction3f:
        """First intersections; none for rays that do not count."""
        start, _ = self.scene.first_points(self.pose, self.angles, self.direction)
        return self.scene.ray_intersect(mi.Ray3f(start, self.direction), self.seen)

    @cached_property
    def on_sea(self) -> mi.Bool:
        """Whether that is the sea."""
        return self.first.is_valid() & self.scene.is_surface(self.first.shape)

    @cached_property
    def below(self) -> mi.SurfaceInteraction3f:
        """Intersections after refraction by the sea's facets, without ripples."""
        down = -dr.normalize(refract(-self.direction, self.first.n, 1 / self.scene.refractive_index))
        return self.scene.ray_intersect(self.scene.spawn_ray(self.first, down), self.on_sea)

    @cached_property
    def on_solid(self) -> BoolArray:
        """Whether the rays that count meet a solid first, shape (n,)."""
        return self._counted(self.first.is_valid() & ~self.on_sea) > 0

    @cached_property
    def ranges(self) -> FloatArray:
        """Distances of counting rays to their first intersections [m], infinite without one."""
        return self._counted(dr.select(self.first.is_valid(), self.first.t, dr.inf))

    @cached_property
    def directions(self) -> FloatArray:
        """Unit directions of the rays that count, shape (n, 3)."""
        return self._counted(self.direction)

    @cached_property
    def sea_places(self) -> FloatArray:
        """Where the rays that count meet the sea, or else its level [m], shape (n, 3); NaN if they do not go down."""
        start, _ = self.scene.first_points(self.pose, self.angles, self.direction)
        level = start - self.direction * (start.z / self.direction.z)
        point = dr.select(self.on_sea, self.first.p, level)
        return np.where(self.directions[:, 2:] < 0, self._counted(point), np.nan)

    def _counted(self, values: mi.Float | mi.Vector3f) -> FloatArray:
        """Return the values for rays that count, rays first."""
        array = np.array(values, dtype=np.float64).T
        return np.asarray(array[np.broadcast_to(np.array(self.seen), len(array))])

    def at_height(self, z: float) -> FloatArray:
        """Return where the rays meet a height after refraction by a level sea, x, y [m], without those that do not."""
        places = self.scene.level_sea.at_height(self.pose.origin, self.directions, z)
        return places[np.isfinite(places).all(axis=1)]

    def axis_at_height(self, z: float | FloatArray) -> FloatArray:
        """Return where the axis meets heights after refraction by a level sea, x, y [m]; NaN if it does not."""
        axes = np.broadcast_to(self.pose.axis, (*np.shape(z), 3))
        return self.scene.level_sea.at_height(self.pose.origin, axes, z)

    def middle_height(self, shape: mi.Shape) -> float:
        """Return the mean height of a shape's bounding box, at most half the pose's height [m]."""
        return float(min(0.5 * (shape.bbox().min.z + shape.bbox().max.z), 0.5 * self.pose.origin[2]))

    def covered_by(self, shape: mi.Shape) -> bool:
        """Return whether all rays meet the bounding box of a shape at its mean height."""
        places = self.at_height(self.middle_height(shape))
        return len(places) == len(self.directions) and not gaps(places, shape).any()

    def meets(self, shape: mi.Shape) -> bool:
        """Return whether rays, or light that waves or scattering deflect, may meet a shape's box at three heights."""
        low, high = box_of(shape)
        heights = np.minimum([low[2], 0.5 * (low[2] + high[2]), high[2]], 0.5 * self.pose.origin[2])
        found = (gaps(places, shape) for z in heights if len(places := self.at_height(z)))
        nearest = min((float(each.min()) for each in found), default=np.inf)
        return nearest <= _REACH_PER_DEPTH * max(-float(low[2]), 0.0)


def gaps(places: FloatArray, shape: mi.Shape) -> FloatArray:
    """Return the horizontal distances between points (x, y), shape (n, 2), and a shape's bounding box [m]."""
    low, high = box_of(shape)
    outside = np.maximum(np.maximum(low[:2] - places, places - high[:2]), 0)
    return np.asarray(np.hypot(*outside.T))


@dataclass(frozen=True)
class SolidEcho:
    """Mean and latest arrival of a solid's direct echo over all pixels [ns]."""

    shape: mi.Shape
    mean_ns: float
    latest_ns: float


@dataclass(frozen=True)
class Echoes:
    """Expected echo arrival, weighted by the laser beam."""

    #: Earliest and mean arrival of the surface echo, and mean and latest arrival of the echo from the first solid under
    #: water [ns], shape (pixels, 2) each; NaN without one.
    surface_ns: FloatArray
    bottom_ns: FloatArray
    #: Share of the beam inside the field of view that passes outside the surface mesh, without light that solids in the
    #: air intercept.
    missed_beam: float
    #: Earliest and latest arrival of the echo from land and other solids in the air [ns], shape (pixels, 2).
    dry_ns: FloatArray
    on_land: float  #: Share of the beam inside the field of view that meets them.
    pierced: list[mi.Shape]  #: Solids visible in the air that reach below the crests of the sea.
    solids: list[SolidEcho]  #: Echoes from the solids that rays in beam and view meet, in the air and under water.


class Probe:
    """Look ahead of a lidar, made once for a scene: with several shots the first one's."""

    def __init__(self, scene: LidarScene) -> None:
        self.scene, self.sampler = scene, SensorSampler(scene.receiver, scene.transmitter)  #: Sampler of its view.

    @cached_property
    def view(self) -> Rays:
        """View rays."""
        return Rays.of_view(self.scene, self.sampler)

    @cached_property
    def beam(self) -> Rays:
        """Beam rays."""
        return Rays.of_beam(self.scene, self.scene.transmitter)

    @cached_property
    def echoes(self) -> Echoes:
        """Expected echoes, found with rays through the facets of the surface, without ripples and scattering."""
        scene, transmitter = self.scene, self.scene.transmitter
        start = self.sampler.sample(dr.arange(mi.UInt32, _ECHO_RAYS), _ECHO_RAYS, pass_streams(0, 0, _ECHO_RAYS))
        rays = Rays(scene, scene.receiver.pose, start.angles, start.direction, start.weight > 0)
        laser, receiver = (scene.relative(each.pose) for each in (transmitter, scene.receiver))
        first, below, on_sea = rays.first, rays.below, rays.on_sea
        at_one_place = bool(np.all(transmitter.pose.origin == scene.receiver.pose.origin))
        of_laser = transmitter.pose.tangent(start.direction) if at_one_place else laser.tangent(first.p)
        beam = start.weight * transmitter.intensity_at(*of_laser)
        # Relative to the reference length, as all lengths here.
        length = laser.distance(first.p) + receiver.distance(first.p)
        solid = on_sea & below.is_valid() & ~scene.is_surface(below.shape)
        water = 2 * below.t * opaque(scene.group_index)
        if scene.submerged:
            # A ray's first intersection is an echo from the sea or a solid.
            places = [opaque_point(each.pose.origin) for each in (transmitter, scene.receiver)]
            length += opaque(scene.group_index - 1) * (dr.norm(first.p - places[0]) + dr.norm(first.p - places[1]))
            below, solid, water = first, first.is_valid() & ~on_sea, mi.Float(0)
        # At once: each array that is read alone would trace all rays again.
        dr.eval(start, beam, first, below, on_sea, solid, length, water)

        def time_ns(length: mi.Float) -> FloatArray:
            return np.asarray((np.array(length, dtype=np.float64) + scene.reference_length) * 1e9 / C0)

        weight, pixels = np.array(beam, dtype=np.float64), scene.receiver.pixels.count
        count = pixels if pixels <= _MOST_PIXELS else 1
        pixel = np.array(start.pixel) if count > 1 else np.zeros(_ECHO_RAYS, dtype=np.int64)
        surface, under_water = np.array(on_sea), np.array(solid)
        times, later = time_ns(length), time_ns(length + water)
        surface_ns = _quantiles(times, weight * surface, pixel, count, (_TAIL, None))
        bottom_ns = _quantiles(later, weight * under_water, pixel, count, (None, 1 - _TAIL))
        lowest, crest = scene.sea_heights or (0.0, -np.inf)
        dry = np.array(first.is_valid() & ~on_sea)
        # Solids visible outside a small surface mesh lie lower.
        in_air = dry & np.array(first.p.z > lowest)
        outside = ~surface & ~in_air if scene.surfaces and not scene.submerged else np.zeros_like(surface)
        missed = float(weight[outside].sum() / weight.sum()) if weight.sum() > 0 else 1.0
        land = dry & (in_air if scene.surfaces else True) & (not scene.submerged)
        dry_ns = _quantiles(times, weight * land, pixel, count, (_TAIL, 1 - _TAIL))
        on_land = float(weight[land].sum() / weight.sum()) if weight.sum() > 0 else 0.0
        numbers = [met_numbers(hit) for hit in (first, below)]
        pierced, solids = [], []
        met_by_any = {*np.unique(numbers).tolist()}
        for shape in scene.solids:
            if (own := shape_number(shape)) not in met_by_any:
                continue
            is_first, is_below = (each == own for each in numbers)
            met = np.where(under_water, is_below, dry & is_first)
            arrivals = _quantiles(np.where(under_water, later, times), weight * met, 0 * pixel, 1, (None, 1 - _TAIL))
            if np.isfinite(arrivals[0, 0]):
                solids.append(SolidEcho(shape, *arrivals[0].tolist()))
            if float(shape.bbox().min.z) <= crest and np.any(in_air & is_first):
                pierced.append(shape)
        surface_ns, bottom_ns, dry_ns = (np.broadcast_to(each, (pixels, 2)) for each in (surface_ns, bottom_ns, dry_ns))
        return Echoes(surface_ns, bottom_ns, missed, dry_ns, on_land, pierced, solids)


def land_of_shots(scene: LidarScene, shots: int) -> tuple[FloatArray, BoolArray]:
    """Return when the echo of land and other solids in the air comes in shots, and whether a pixel sees such alone.

    The scene is in parts, as a number of shots meet it.

    Returns `dry_ns`: earliest and latest arrival [ns], shape (shots x pixels, 2); NaN without one. `alone`: whether all
    that a pixel sees of the beam are solids in the air, shape (shots x pixels,).
    """
    pixels = scene.receiver.pixels
    count, slots = int(np.clip(_LAND_RAYS * pixels.count, _LAND_RAYS, PROBE_RAYS)), shots * pixels.count
    lowest, _ = scene.sea_heights or (-np.inf, np.inf)
    lanes = Lanes.of_paths(dr.arange(mi.UInt32, shots * count), shots, count)
    moved = lanes.pick(scene)
    pose, u = moved.transmitter_pose, unit_points(count, lanes.number)
    angles = mi.Point2f(scene.transmitter.sample_tangent(u))
    rays = Rays(moved, pose, angles, pose.direction(*angles), mi.Bool(True))
    first, receiver = rays.first, moved.relative(moved.receiver_pose)
    angle_x, angle_y, ahead = receiver.tangent(first.p)
    pixel, inside = pixels.pixel_at(angle_x, angle_y, count * u.y - dr.floor(count * u.y))
    length = moved.relative(pose).distance(first.p) + receiver.distance(first.p)
    seen = first.is_valid() & (inside > 0) & (ahead > 0)
    dry = seen & ~rays.on_sea & (first.p.z > opaque(lowest))
    slot = lanes.shot * pixels.count + pixel
    dr.eval(length, seen, dry, slot)
    is_seen, is_dry, slot = (np.broadcast_to(np.array(one), shots * count) for one in (seen, dry, slot))
    time_ns = (np.array(length, dtype=np.float64) + scene.reference_length) * 1e9 / C0
    found = _quantiles(time_ns, is_dry.astype(np.float64), slot, slots, (_TAIL, 1 - _TAIL))
    return found, np.isfinite(found[:, 0]) & (np.bincount(slot, is_seen & ~is_dry, slots) == 0)


def _quantiles(
    values: NDArray[np.floating],
    weight: NDArray[np.float64],
    pixel: NDArray[np.integer],
    count: int,
    wanted: tuple[float | None, float | None],
) -> NDArray[np.float64]:
    """Return weighted quantiles (None: the mean) for each pixel, shape (pixels, 2)."""
    result = np.full((count, 2), np.nan)
    seen = weight > 0
    order = np.lexsort((values[seen], pixel[seen]))
    values, weight, pixel = values[seen][order], weight[seen][order], pixel[seen][order]
    edges = np.searchsorted(pixel, np.arange(count + 1))
    for index in np.flatnonzero(np.diff(edges)):
        part = slice(edges[index], edges[index + 1])
        cumulative = np.cumsum(weight[part])
        for column, share in enumerate(wanted):
            if share is None:
                result[index, column] = np.average(values[part], weights=weight[part])
            else:
                result[index, column] = values[part][np.searchsorted(cumulative, share * cumulative[-1])]
    return result


def axis_on_bottom(scene: WaterScene, origins: FloatArray, axes: FloatArray) -> FloatArray:
    """Return where axes, refracted by a level sea, first meet a bottom (`WaterScene.bottoms`).

    Returns points x, y, z in the scene as it is given [m], shape (n, 3); NaN where an axis meets no bottom.

    `origins`, `axes`: points in the scene's frame from which the axes start [m], and their directions, shape (n, 3), or
    (3,) of all axes.
    """
    sea, bottoms = scene.level_sea, scene.bottoms
    if not bottoms or np.any(axes[..., 2] >= 0):
        return np.full(origins.shape, np.nan)
    # Corners: start, sea level, boundaries of the index layers, and a point below everything.
    lowest = min(float(solid.bbox().min.z) for solid in bottoms) - 1.0
    heights = [0.0, *(-boundary for boundary in sea.boundaries if -boundary > lowest), min(lowest, -1.0)]
    directions = np.broadcast_to(axes, origins.shape)
    corners = [np.insert(sea.at_height(origins, directions, z), 2, z, axis=1) for z in heights]
    return _first_along(scene.bottoms_alone, [origins, *corners]) + scene.frame_origin


def first_along(
    scene: WaterScene, corners: Sequence[FloatArray], shapes: Sequence[mi.Shape] | None = None
) -> FloatArray:
    """Return where lines through corners in the frame [m], shape (n, 3) each, first meet one of some shapes, or NaN.

    The shapes are by default all solids.
    """
    some = scene.solids_alone if shapes is None else scene_of_shapes(shapes, scene.groups) if shapes else None
    return np.full(corners[0].shape, np.nan) if some is None else _first_along(some, corners)


def _first_along(some: mi.Scene, corners: Sequence[FloatArray]) -> FloatArray:
    """Return where lines first meet a shape of a scene, as `first_along`."""
    found = _met_along(some, corners)
    # Rays in single precision may pass between two triangles where they meet an edge: those beside them do not.
    if (missed := np.isnan(found[:, 2])).any():
        found[missed] = _met_along(some, [corner[missed] + _ASIDE for corner in corners])
    return found


def _met_along(some: mi.Scene, corners: Sequence[FloatArray]) -> FloatArray:
    """Return where lines first meet a face of a scene, as `first_along`."""
    found = np.full(corners[0].shape, np.nan)
    active = aligned(mi.Bool, np.ones(len(found), dtype=bool))
    for start, end in itertools.pairwise(corners):
        origin, leg = (mi.Vector3f(*(aligned(mi.Float, column) for column in each.T)) for each in (start, end - start))
        ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(leg))
        ray.maxt = dr.norm(leg)
        hit = some.ray_intersect(ray, active)
        ends = active & hit.is_valid()
        at_end = np.array(ends)
        found[at_end] = np.array(hit.p, dtype=np.float64).T[at_end]
        active &= ~ends
    return found
