"""Passes that look up the beam's light in maps, instead of following it through the water.

Beam rays are refracted by waves and ripples and added to maps on horizontal planes. Rays of the view are refracted in
the same way. At each depth, and where they meet the bottom, they look up the light that has come down there. It is
displaced and delayed by scattering on both ways at once (`physics.water.two_way_spread`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.physics.sea.shoaling import ShoalingHeights
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import TwoWaySpread
from mitransient_lidar.transport.light_maps.maps import FEWEST_CELLS, HeightFields, LightMaps, Planes
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.opaque import aligned, changed, opaque, opaque_index
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses, ReceivedLight
from mitransient_lidar.transport.paths.refracted_connection import StraightConnection
from mitransient_lidar.transport.paths.ripple_focusing import Echo
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.probe import Rays, first_along
from mitransient_lidar.transport.rng import Lanes, Shots
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import box_of, met_shape

#: Numbers of the random sequences within a pass.
_BEAM, _VIEW, _WATER, _BOTTOM, _GLINTS = range(5)

#: Planes of maps below the mean sea level, and paths of scattered light at each depth.
_PLANES, _PATHS = 16, 2**12

#: Least downward component of rays in the air and in the water, and largest angle of the receiver from nadir [deg].
_LEAST_DOWN, _LARGEST_ANGLE = 0.1, 45.0

#: Spreads of waters that were drawn before, and their largest number; step of their angles [deg].
_SPREADS: dict[tuple[Any, ...], TwoWaySpread] = {}
_MOST_SPREADS, _ANGLE_STEP = 16, 2.0

#: Step of the depths of the lowest planes, which lidars of a flight share [m].
_DEPTH_STEP = 0.5

#: Largest distance of laser and receiver over their range, and angle between their axes [rad].
_APART = 0.05

#: Largest mean number of scattering events on one way to the bottom, beyond which light arrives too late.
_MOST_EVENTS = 8.0

#: Largest share of a pixel's light that meets a target whose shadow is left out, and deflection by waves over depth.
_SHADOWED, _DEFLECTED = 0.1, 0.05

#: Largest slope of a bottom on which displaced light arrives at another depth: steeper ones are sides.
_STEEPEST = 1.0

#: Least depth of the bottom below a beam [m], and rays of the beam that must reach it.
_LEAST_DEPTH, _RAYS_TO_BED = 0.05, 64

#: Reason against the light of shots over land, or over solids near the surface.
REACH_THE_SURFACE = "solids reach the surface"

#: Rays of the view for each pixel of an image, and their limits.
_RAYS_PER_PIXEL, _FEWEST_RAYS, _MOST_RAYS = 16, 2**15, 2**21

#: Cells of an image's maps in the shortest wave of its sea, their largest number along a side, and rays of the beam for
#: each.
_CELLS_PER_WAVE, _MOST_CELLS, _BEAM_PER_CELL = 2.5, 480, 4

#: Distance beyond all waves that focus light [m].
_FAR = 1e3

#: Distance to the bottom of rays that meet none [m].
_NO_BED = 1e6


@dataclass(frozen=True)
class Sampling:
    """Numbers of rays in a pass, and of their look-ups."""

    rays: int  #: Rays of the view.
    #: Rays of the beam, and those that look for glints, for each of them.
    beam: float = 2.0
    glints: int = 8
    #: Depths at which each ray of the view looks up light, and paths of scattered light at the bottom.
    depths: int = 16
    at_bottom: int = 48
    cells: int = FEWEST_CELLS  #: Cells on each side of the maps.

    @classmethod
    def of_image(cls, scene: LidarScene, planes: Planes) -> Sampling:
        """Return the numbers for an image: many rays with few looks each, and cells finer than the waves."""
        sea = scene.seas[0].sea
        finest = sea.shortest_wave / _CELLS_PER_WAVE or sea.line_distance
        wanted = 2 * float(planes.half[-1]) / finest / FEWEST_CELLS
        cells = FEWEST_CELLS * int(np.clip(math.ceil(wanted), 1, _MOST_CELLS // FEWEST_CELLS))
        rays = int(np.clip(_RAYS_PER_PIXEL * scene.receiver.pixels.count, _FEWEST_RAYS, _MOST_RAYS))
        return cls(rays, max(_BEAM_PER_CELL * cells**2, _FEWEST_RAYS) / rays, 1, 4, 4, cells)


@dataclass
class _Rays:
    """Rays in the water: start [m], direction, relative length there [m], weight, and whether they are in the water.

    Weights are energies over that emitted, of rays of the view received energies per radiance [m^2 sr].
    """

    point: mi.Point3f
    direction: mi.Vector3f
    length: mi.Float
    weight: mi.Float
    active: mi.Bool


@dataclass
class _Seen:
    """Rays of the view in the water, and what they meet there."""

    #: The rays, and the pixel of each.
    rays: _Rays
    pixel: mi.UInt32
    surface_length: mi.Float  #: Relative optical length by the point of the sea to the transmitter [m].
    #: Distance to the bottom [m], place there, and number of the solid.
    to_bed: mi.Float
    bed: mi.Point3f
    solid: mi.UInt32
    slope: mi.Vector2f  #: Slopes of the bottom along x and y, 0 on steep sides.
    turned: mi.Float  #: Reflected radiance over the energy through a horizontal area [1/sr].


class UnsuitedError(UserError):
    """A scene that light maps are not for, for a reason."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"light maps do not suit the scene: {reason}; use light = 'merging'")


class LightMapRenderer(PassRenderer):
    """Renders passes over waves, water of one refractive index and a bottom; see `unsuited`.

    Paths that change more than once between down and up are left out, and the shadows of solids in the beam.

    `level`: whether the sea is level, with all of its slopes as ripples, as the mean over seas, enhanced by the
    focusing of all waves (`physics.sea.double_passage`). `image`: whether a pass is one of few for a render, instead of
    one for a shot among many.

    Raises
    ------
    UnsuitedError
        If the scene is not suited.
    """

    def __init__(self, scene: LidarScene, classes: PathClasses, *, level: bool = False, image: bool = False) -> None:
        reason = unsuited(scene) or ((level or image) and scene.has_dry_solids and REACH_THE_SURFACE)
        if reason:
            raise UnsuitedError(reason)
        water, axis = scene.required_water, scene.receiver.pose.axis
        cos_water = -float(refract_level(axis, scene.refractive_index)[2])
        planes = Planes.of_scene(scene, _deepest(scene, cos_water), _PLANES + 1)
        self._sampling = Sampling.of_image(scene, planes) if image else Sampling(1024 if level else 512)
        self._planes = replace(planes, cells=self._sampling.cells)
        # Waves of the mesh enhance what cells average less than what meets at points.
        super().__init__(scene, classes, self._sampling.rays, _far_apart if level else self._planes.cell)
        column = water.column
        phases = [table_of(phase) for phase in water.phases.phases[: column.count]]
        spread = _spread_of(column, phases, self._planes.depths[1:], cos_water)
        self._spread = [
            aligned(mi.Float, values.astype(np.float32))
            for values in (spread.shift_x, spread.shift_y, spread.excess, spread.of_bottom, spread.of_water)
        ]
        self._events = aligned(mi.UInt32, spread.events.astype(np.uint32))
        # Light that one event turns by 180 degrees [1/(m sr)].
        turned = [b * float(phase.eval_s(1.0)) for b, phase in zip(column.scattering, phases, strict=True)]
        self._turned = aligned(mi.Float, np.array(turned, np.float32))
        self._ripples = scene.seas[0].rippled(scene.refractive_index) if level else scene.surfaces[0].bsdf()
        self._sea = HeightFields.about(scene, level=level)
        self._solids = scene.solids_alone

    @property
    def path_count(self) -> int:
        """Number of rays in a pass from either end."""
        return round(self.paths * (1 + self._sampling.beam))

    @property
    def used_values(self) -> dict[str, float]:
        """No integrator parameter values."""
        return {}

    def over(self, scene: LidarScene, sea: HeightFields) -> LightMapRenderer:
        """Return a renderer for shots that meet a scene in parts and sea heights."""
        return changed(self, scene=scene, _sea=sea)

    def trace(self, received: ReceivedLight, shots: Shots, paths: int) -> None:
        """Look up one pass's light for each shot, with a number of view rays."""
        maps = self._maps(shots, max(round(self._sampling.beam * paths), 1))
        self._reflect(received, shots, self._sampling.glints * paths)
        seen = self._view(shots, paths)
        self._return(received, shots, paths, maps, seen, _WATER)
        if self.scene.solids:
            self._return(received, shots, paths, maps, seen, _BOTTOM)

    def _meet_sea(
        self, scene: LidarScene, lanes: Lanes, pose: KernelPose, angles: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Float]:
        """Return where rays at tangent-plane angles meet the sea, and their relative lengths there [m]."""
        direction = pose.direction(angles.x, angles.y)
        start, length = scene.first_points(pose, angles, direction)
        si = lanes.pick(self._sea).meet(start, direction, active & (direction.z < -_LEAST_DOWN))
        return si, length + si.t

    def _enter(
        self, si: mi.SurfaceInteraction3f, length: mi.Float, weight: mi.Float, mode: mi.TransportMode, u: list[mi.Float]
    ) -> _Rays:
        """Return rays refracted by facets and ripples, drawn by three uniform numbers."""
        active = si.is_valid() & (weight > 0)
        bs, value = self._ripples.sample(mi.BSDFContext(mode), si, u[2], mi.Point2f(u[0], u[1]), active)
        direction = si.to_world(bs.wo)
        wet = active & (bs.wo.z < 0) & (direction.z < -_LEAST_DOWN) & (value[0] > 0)
        return _Rays(si.p, direction, length, dr.select(wet, weight * value[0], 0), wet)

    def _maps(self, shots: Shots, count: int) -> LightMaps:
        """Return the beams' maps, each with a number of rays."""
        scene, water = self.scene, self.scene.required_water
        lanes = shots.paths(count)
        moved, (x, y, *ripple) = lanes.pick(scene), _spaced(shots, lanes, _BEAM, 5)
        angles = mi.Point2f(*scene.transmitter.sample_tangent(mi.Point2f(x, y)))
        si, length = self._meet_sea(moved, lanes, moved.transmitter_pose, angles, mi.Bool(True))
        share = dr.full(mi.Float, 1 / count, dr.width(lanes.number))
        rays = self._enter(si, length, share, mi.TransportMode.Importance, ripple)
        dr.eval(rays)
        maps = LightMaps(scene, self._planes, shots.count, count)
        # Plane after plane, so that the lanes of a packet add to one map. Planes above troughs serve places below them.
        own, of_map = shots.paths(count * maps.count), opaque_index(count)
        plane = own.number // of_map
        rays = dr.gather(_Rays, rays, own.shot * of_map + own.number - plane * of_map)
        distance = (-maps.depth_of(plane) - rays.point.z) / rays.direction.z
        start, down = -rays.point.z, -rays.direction.z
        absorbed, scattered = (
            flight.optical_depth(start, down, distance) for flight in (water.absorption_flight, water.scattering_flight)
        )
        length = rays.length + opaque(scene.group_index) * distance
        place = rays.point + rays.direction * distance
        maps.add(own, plane, place, rays.weight, (absorbed, scattered), length, rays.active)
        return maps

    def _reflect(self, received: ReceivedLight, shots: Shots, count: int) -> None:
        """Add the light that the sea reflects to rays of the view."""
        lanes = shots.paths(count)
        sample = self.sampler.sample_shots(lanes, count, shots.streams(_GLINTS, lanes))
        moved = lanes.pick(self.scene)
        si, length = self._meet_sea(moved, lanes, moved.receiver_pose, sample.angles, sample.weight > 0)
        line, seen = StraightConnection.to_laser(moved, si.p), si.is_valid()
        glint = self._ripples.eval(mi.BSDFContext(), si, si.to_local(line.direction), seen)[0]
        energy, none = glint * line.irradiance * sample.weight, mi.UInt32(0)
        received.receive(sample.pixel, none, mi.UInt32(1), none, length + line.length, energy, seen & (energy > 0))

    def _view(self, shots: Shots, count: int) -> _Seen:
        """Return the rays of the view in the water, and what they meet."""
        lanes = shots.paths(count)
        sample = self.sampler.sample_shots(lanes, count, shots.streams(_VIEW, lanes))
        moved = lanes.pick(self.scene)
        si, length = self._meet_sea(moved, lanes, moved.receiver_pose, sample.angles, sample.weight > 0)
        ripple = _spaced(shots, lanes, _VIEW, 3)
        rays = self._enter(si, length, sample.weight, mi.TransportMode.Radiance, ripple)
        by_surface = length + moved.relative(moved.transmitter_pose).distance(si.p)
        # Shots have the solids as parts of their own.
        solids = moved if moved.parts or self._solids is None else self._solids
        bed = solids.ray_intersect(mi.Ray3f(si.p, rays.direction), rays.active & (self._solids is not None))
        on_bed = rays.active & bed.is_valid()
        # Light comes down along the ray: the bottom turns what passes a horizontal area by its cosine over this one's.
        value = bed.bsdf().eval(mi.BSDFContext(), moved.on_shapes(bed), bed.wi, on_bed)[0]
        slope = mi.Vector2f(-bed.n.x / bed.n.z, -bed.n.y / bed.n.z)
        seen = _Seen(
            rays,
            mi.UInt32(sample.pixel),
            by_surface,
            dr.select(on_bed, bed.t, _NO_BED),
            bed.p,
            self.classes.solid(met_shape(bed)),
            dr.select(dr.norm(slope) <= _STEEPEST, slope, 0),
            dr.select(on_bed, value / -rays.direction.z, 0),
        )
        dr.eval(seen)
        return seen

    def _return(
        self, received: ReceivedLight, shots: Shots, count: int, maps: LightMaps, seen: _Seen, origin: int
    ) -> None:
        """Add the light that returns from the water, or from the bottom, to rays of the view."""
        scene, water, from_bed = self.scene, self.scene.required_water, origin == _BOTTOM
        per_ray, of_shot = self._sampling.at_bottom if from_bed else self._sampling.depths, opaque_index(count)
        # Depth after depth: neighbours in a packet read neighbours in maps.
        lanes = shots.paths(count * per_ray)
        part = lanes.number // of_shot
        seen = dr.gather(_Seen, seen, lanes.shot * of_shot + lanes.number - part * of_shot)
        u, pick, path = _spaced(shots, lanes, origin, 3)
        rays, thickness = seen.rays, opaque(float(self._planes.depths[-1]) / self._sampling.depths)
        # Before all light is received: a new number in memory ends the kernel.
        down, group_index = -rays.direction.z, opaque(scene.group_index)
        if from_bed:
            along, place, path = seen.to_bed, seen.bed, (mi.Float(part) + path) / per_ray
            active, turned = rays.active & (along < _NO_BED), seen.turned
        else:
            along = thickness * (mi.Float(part) + u) / down
            place = rays.point + rays.direction * along
            active, layer = rays.active & (along < seen.to_bed), water.scattering_flight.layer_at(-place.z)
            turned = dr.gather(mi.Float, self._turned, layer) * thickness / dr.square(down)
        absorbed, scattered = (
            flight.optical_depth(-rays.point.z, down, along)
            for flight in (water.absorption_flight, water.scattering_flight)
        )
        kept = opaque(scene.transmitter.energy) * rays.weight * dr.exp(-absorbed) * turned
        length, depth = rays.length + group_index * along, -place.z
        turns, solid = mi.UInt32(0 if from_bed else 1), seen.solid if from_bed else mi.UInt32(0)

        def receive(events: mi.UInt32, length: mi.Float, energy: mi.Float, active: mi.Bool) -> None:
            echo = Echo(seen.surface_length, from_bed)
            received.receive(
                seen.pixel, turns + events, mi.UInt32(1), solid, length, energy, active & (energy > 0), echo
            )

        # Light without scattering, at the bottom once for each ray.
        lit, way = maps.look_up(lanes, place, depth, pick, scattered=False)
        once = active & (part == 0) if from_bed else active
        receive(mi.UInt32(0), length + way, kept * dr.exp(-scattered) * lit, once)
        # Light that has scattered on one of the ways or both, along a path from the next plane.
        plane = dr.maximum(maps.plane_at(along * down, pick), 1)
        entry = (plane - 1) * _PATHS + dr.minimum(mi.UInt32(path * _PATHS), _PATHS - 1)
        scale = along * down / maps.depth_of(plane)
        x, y, excess, of_bed, of_water = (dr.gather(mi.Float, one, entry) for one in self._spread)
        x, y, excess = x * scale, y * scale, excess * scale
        lit, way = maps.look_up(lanes, mi.Point3f(place.x + x, place.y + y, place.z), depth, pick, scattered=True)
        share = (1 - dr.exp(-2 * scattered)) * (of_bed / per_ray if from_bed else of_water)
        if from_bed:
            # Half of the displacement lies on the way up.
            excess -= (seen.slope.x * x + seen.slope.y * y) / down
        energy = kept * share * lit
        receive(dr.gather(mi.UInt32, self._events, entry), length + way + group_index * excess, energy, active)


def _spread_of(
    column: WaterColumn, phases: Sequence[PowerLawTable], depths: FloatArray, cos_water: float
) -> TwoWaySpread:
    """Return the spread in a water along an axis, whose angle is rounded: it serves the lidars of a flight."""
    angle = _ANGLE_STEP * round(float(np.degrees(np.arccos(min(cos_water, 1.0)))) / _ANGLE_STEP)
    arrays = column.layer_tops, column.attenuation, column.scattering, depths, *(phase.value for phase in phases)
    key = angle, *(values.tobytes() for values in arrays)
    if key not in _SPREADS:
        while len(_SPREADS) >= _MOST_SPREADS:
            _SPREADS.popitem()
        _SPREADS[key] = TwoWaySpread.of_column(column, phases, depths, float(np.cos(np.radians(angle))), _PATHS)
    return _SPREADS[key]


def unsuited(scene: LidarScene) -> str | None:
    """Return why light maps are not for a scene, or None. Shots must also be `over_water`."""
    if scene.submerged:
        return "the lidar is under water"
    if scene.water is None or len(scene.surfaces) != 1 or len(scene.seas) != 1:
        return "it needs water below one ocean_surface"
    sea, axis = scene.seas[0], scene.receiver.pose.axis
    if np.degrees(np.arccos(np.clip(-float(axis[2]), -1, 1))) > _LARGEST_ANGLE:
        return f"the receiver looks more than {_LARGEST_ANGLE:g} degrees from nadir"
    if not sea.has_ripples or sea.sea.has_foam:
        return "its sea has a BSDF of its own, or foam"
    if len(scene.water.index_layers.boundaries):
        return "its water has several refractive indices"
    if scene.water.plume is not None:
        return "its water has bubbles"
    if scene.perturbations.count:
        return "derivatives need paths"
    if scene.has_veils or scene.has_shared_gaps or scene.has_specular_solids:
        return "solids are transparent or mirror-like"
    events = _events(scene)
    apart = (
        np.linalg.norm(scene.receiver.pose.origin - scene.transmitter.pose.origin) / scene.receiver.pose.ground_range
    )
    if max(apart, np.linalg.norm(axis - scene.transmitter.pose.axis)) > _APART:
        return "laser and receiver look from different places, or along different axes"
    if events > _MOST_EVENTS:
        return f"light scatters {events:.2g} times on its way to the bottom, more than {_MOST_EVENTS:g}"
    return None


def over_water(scene: LidarScene, places: FloatArray, turns: FloatArray | None) -> BoolArray:
    """Return which shots have solids below the sea alone in their beam, shape (shots,); arguments as `light_faintly`.

    Beam rays, the outermost among them, pass the sea without meeting a solid: down to 0.05 m or, where waves do not
    follow the bottom, to the lowest trough.
    """
    wet = np.ones(len(places), dtype=bool)
    if not scene.has_dry_solids:
        return wet
    follows = isinstance(scene.seas[0].sea.waves, ShoalingHeights)
    lowest = 0.0 if follows or scene.sea_heights is None else scene.sea_heights[0]
    rays, pose = Rays.of_beam(scene, scene.transmitter), scene.transmitter.pose
    start, end = (
        (pose.origin + rays.directions * ((z - pose.origin[2]) / rays.directions[:, 2:]) - pose.ground_point())
        for z in (pose.origin[2], min(lowest, -_LEAST_DEPTH))
    )
    outermost = np.argsort(-np.linalg.norm(end - end.mean(axis=0), axis=1))[: _RAYS_TO_BED // 2]
    some = np.concatenate([outermost, np.linspace(0, len(end) - 1, _RAYS_TO_BED // 2).astype(np.intp)])
    turned = np.ones(len(places), dtype=complex) if turns is None else turns @ [1, 1j]

    def among_solids(points: FloatArray) -> FloatArray:
        away = np.multiply.outer(turned, points[some, :2] @ [1, 1j])
        level = np.stack([away.real, away.imag], axis=-1) + places[:, np.newaxis]
        return np.insert(level.reshape(-1, 2), 2, np.tile(points[some, 2], len(places)), axis=1)

    met = first_along(scene, [among_solids(start), among_solids(end)])[:, 2]
    return np.asarray(np.isnan(met).reshape(len(places), -1).all(axis=1))


def light_faintly(scene: LidarScene, target: mi.Shape, places: FloatArray, turns: FloatArray | None) -> BoolArray:
    """Return which shots light a target so faintly that its shadow needs no merging, shape (shots,).

    In each pixel at most the share `_SHADOWED` of the beam over a level sea meets the target's box, widened as waves
    deflect the light.

    `scene`, `target`: the lidar's scene, and a target of it. `places`: points (x, y) of the shots among the shapes [m],
    shape (shots, 2). `turns`: cosine and sine of their rotations about the vertical, shape (shots, 2); None without
    any.
    """
    low, high = box_of(target)
    rays = Rays.of_beam(scene, scene.transmitter)
    pixel, seen = scene.receiver.pixels.pixel_at(rays.angles.x, rays.angles.y, mi.Float(0.5))
    pixel, counted = np.array(pixel), np.array(seen) > 0
    pose, height = scene.transmitter.pose, 0.5 * (low[2] + high[2])
    lit = scene.level_sea.at_height(pose.origin, rays.directions, height) - pose.ground_point()[:2]
    counted &= np.isfinite(lit).all(axis=1)
    lit, pixel = lit[counted] @ [1, 1j], pixel[counted]
    whole = np.maximum(np.bincount(pixel, minlength=scene.receiver.pixels.count), 1)
    # A ray that meets the box below or above its middle height does so beside it.
    axis = np.abs(refract_level(pose.axis, scene.refractive_index))
    wider = _DEFLECTED * max(-float(low[2]), 0.0) + 0.5 * (high[2] - low[2]) * np.hypot(*axis[:2]) / axis[2]
    centre, half = (0.5 * (low + high)[:2]), 0.5 * (high - low)[:2] + wider
    faint = np.ones(len(places), dtype=bool)
    farthest = float(np.abs(lit).max(initial=0.0))
    for shot in np.flatnonzero(np.all(np.abs(places - centre) <= half + farthest, axis=1)):
        turned = lit if turns is None else lit * complex(*turns[shot])
        beside = np.abs(np.stack([turned.real, turned.imag], axis=-1) + places[shot] - centre)
        met = np.bincount(pixel[np.all(beside <= half, axis=1)], minlength=whole.size)
        faint[shot] = np.all(met <= _SHADOWED * whole)
    return faint


def reach_of_scattering(scene: LidarScene) -> float:
    """Return the depth to which light of a scene scatters rarely enough for light maps [m], at most 1 km."""
    down = -float(refract_level(scene.receiver.pose.axis, scene.refractive_index)[2])
    depths = np.linspace(0, 1e3, 10_001)
    events = scene.required_water.column.optical_depth_of_scattering(depths) / down
    return float(depths[np.searchsorted(events, _MOST_EVENTS) - 1])


def _far_apart(depths: FloatArray) -> FloatArray:
    """Return a distance at which waves enhance no light [m]."""
    return np.full(depths.shape, _FAR)


def _events(scene: LidarScene) -> float:
    """Return the mean number of scattering events on the way to the lowest bottom."""
    lowest = min((float(solid.bbox().min.z) for solid in scene.bottoms), default=0.0)
    down = -float(refract_level(scene.receiver.pose.axis, scene.refractive_index)[2])
    return float(scene.required_water.column.optical_depth_of_scattering(max(-lowest, 0.0))) / down


def _deepest(scene: LidarScene, cos_water: float) -> float:
    """Return the largest depth of light below crests [m]."""
    air = sum(
        float(np.linalg.norm(pose.ground_point() - pose.origin))
        for pose in (scene.transmitter.pose, scene.receiver.pose)
    )
    deepest = max((scene.axis.path_end - air) / (2 * scene.group_index), 0.1) * cos_water
    lowest = min((float(solid.bbox().min.z) for solid in scene.bottoms), default=-deepest)
    crest = max(scene.sea_heights[1], 0.0) if scene.sea_heights else 0.0
    return _DEPTH_STEP * math.ceil((min(deepest, max(-lowest, 0.1)) + crest) / _DEPTH_STEP)


def _spaced(shots: Shots, lanes: Lanes, purpose: int, count: int) -> list[mi.Float]:
    """Return `count` uniform numbers of each lane that fill the cube evenly, shifted at random for each shot.

    Kronecker sequence by powers of the root of x^(d+1) = x + 1 in d dimensions, the golden ratio for d = 1.
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (count + 1))
    found = []
    for power, shift in enumerate(shots.uniform(purpose, count), 1):
        step = mi.UInt32(round(root**-power * 2**32))
        bits = lanes.number * step + (mi.UInt32(lanes.pick(shift) * 2**24) << 8)
        found.append(mi.Float(bits >> 8) * 2**-24)
    return found
