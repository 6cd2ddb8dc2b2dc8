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

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import TwoWaySpread
from mitransient_lidar.transport.light_maps.maps import FEWEST_CELLS, HeightFields, LightMaps, Planes
from mitransient_lidar.transport.light_maps.shadows import Targets
from mitransient_lidar.transport.light_maps.suitability import REACH_THE_SURFACE, UnsuitedError, unsuited
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.opaque import aligned, changed, opaque, opaque_index
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses, ReceivedLight
from mitransient_lidar.transport.paths.refracted_connection import StraightConnection
from mitransient_lidar.transport.paths.ripple_focusing import Echo
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.rng import Lanes, Shots
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import SensorSample
from mitransient_lidar.transport.solids import met_shape

#: Numbers of the random sequences within a pass.
_BEAM, _VIEW, _WATER, _BOTTOM, _GLINTS, _BEHIND, _TARGETS = range(7)

#: Planes of maps below the mean sea level, and paths of scattered light at each depth.
_PLANES, _PATHS = 16, 2**12

#: Least downward component of rays in the air and in the water.
_LEAST_DOWN = 0.1

#: Spreads of waters that were drawn before, and their largest number; step of their angles [deg].
_SPREADS: dict[tuple[Any, ...], TwoWaySpread] = {}
_MOST_SPREADS, _ANGLE_STEP = 16, 2.0

#: Step of the depths of the lowest planes, which lidars of a flight share [m].
_DEPTH_STEP = 0.5

#: Largest slope of a bottom on which displaced light arrives at another depth: steeper ones are sides.
_STEEPEST = 1.0

#: Rays of the view for each pixel of an image, and their limits.
_RAYS_PER_PIXEL, _FEWEST_RAYS, _MOST_RAYS = 16, 2**15, 2**21

#: Cells of an image's maps in the shortest wave of its sea, their largest number along a side, and rays of the beam for
#: each.
_CELLS_PER_WAVE, _MOST_CELLS, _BEAM_PER_CELL = 2.5, 480, 4

#: Memory of a cell of the maps, and of a ray of the beam and the view [bytes].
_BYTES_PER_CELL, _BYTES_PER_BEAM, _BYTES_PER_RAY = 12, 60, 128

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
    #: Distance to the first target and, behind targets, to the bottom [m].
    to_target: mi.Float
    to_bottom: mi.Float


class LightMapRenderer(PassRenderer):
    """Renders passes over waves, water of one refractive index and a bottom; see `unsuited`.

    Paths that change more than once between down and up are left out. Of `image` and `level`, targets have shadows.

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
        self._kept: tuple[Any, LightMaps] | None = None
        self._solids = scene.solids_alone
        # Ripples rise and fall by half their height at most, however steep they are.
        heights = [height for solid in scene.bottoms for height in (solid.bbox().min.z, solid.bbox().max.z)]
        self._relief = opaque(0.5 * (max(heights, default=0) - min(heights, default=0)))
        self._targets = Targets(scene, spread) if (image or level) and scene.targets else None

    @property
    def path_count(self) -> int:
        """Number of rays in a pass from either end."""
        return round(self.paths * (1 + self._sampling.beam))

    @property
    def memory(self) -> tuple[float, float]:
        """Memory of maps, and of rays for each received pixel [bytes]."""
        beams, of_maps = self.paths * self._sampling.beam, self._planes.depths.size * self._planes.cells**2
        of_ray = _BYTES_PER_RAY * (1 if self._targets is None else 2)
        return (
            _BYTES_PER_CELL * of_maps + _BYTES_PER_BEAM * beams,
            of_ray * self.paths / self.scene.receiver.pixels.count,
        )

    @property
    def used_values(self) -> dict[str, float]:
        """No integrator parameter values."""
        return {}

    def over(self, scene: LidarScene, sea: HeightFields) -> LightMapRenderer:
        """Return a renderer for shots that meet a scene in parts and sea heights."""
        return changed(self, scene=scene, _sea=sea)

    def trace(self, received: ReceivedLight, shots: Shots, paths: int) -> None:
        """Look up the light of one pass for each shot, with a number of rays of the view."""
        maps = self._maps(shots, max(round(self._sampling.beam * paths), 1), keep=received.tile is not None)
        self._reflect(received, shots, self._sampling.glints * paths)
        lanes, sample = self._sample(received, shots, paths, _VIEW)
        if dr.width(lanes.number) == 0:
            return
        seen, *behind = self._view(shots, lanes, sample)
        for origin in (_WATER, _BOTTOM) if self.scene.solids else (_WATER,):
            self._return(received, shots, paths, maps, seen, lanes, origin)
        for one in behind:
            self._return(received, shots, paths, maps, one, lanes, _BEHIND)
            self._return(received, shots, paths, maps, seen, lanes, _TARGETS)

    def _sample(self, received: ReceivedLight, shots: Shots, count: int, purpose: int) -> tuple[Lanes, SensorSample]:
        """Return `count` rays of the view, or those of the tile's pixels."""
        lanes = shots.paths(count)
        sample = self.sampler.sample_shots(lanes, count, shots.streams(purpose, lanes))
        if received.tile is None:
            return lanes, sample
        first, size = map(opaque_index, (received.tile.start, len(received.tile)))
        own = dr.compress((sample.weight > 0) & (sample.pixel - first < size))
        lanes = replace(lanes, number=own)
        return lanes, self.sampler.sample_shots(lanes, count, shots.streams(purpose, lanes))

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

    def _maps(self, shots: Shots, count: int, *, keep: bool = False) -> LightMaps:
        """Return the maps of the beams, of a number of rays each; the last ones if they are kept."""
        if keep and self._kept is not None and self._kept[0] == (shots.seeds, count):
            return self._kept[1]
        maps = self._add_beams(shots, count)
        self._kept = ((shots.seeds, count), maps) if keep else None
        return maps

    def _add_beams(self, shots: Shots, count: int) -> LightMaps:
        """Return new maps of the beams, of a number of rays each."""
        scene, water = self.scene, self.scene.required_water
        lanes = shots.paths(count)
        moved, (x, y, *ripple) = lanes.pick(scene), _spaced(shots, lanes, _BEAM, 5)
        angles = mi.Point2f(*scene.transmitter.sample_tangent(mi.Point2f(x, y)))
        si, length = self._meet_sea(moved, lanes, moved.transmitter_pose, angles, mi.Bool(True))
        share = dr.full(mi.Float, 1 / count, dr.width(lanes.number))
        rays = self._enter(si, length, share, mi.TransportMode.Importance, ripple)
        lit = mi.Float(math.inf)
        if self._targets is not None:
            ray = mi.Ray3f(rays.point, rays.direction)
            lit = self._targets.distance(self._solids_of(moved).ray_intersect(ray, rays.active))
        dr.eval(rays, lit)
        maps = LightMaps(scene, self._planes, shots.count, count)
        # Plane after plane, so that the lanes of a packet add to one map. Planes above troughs serve places below them.
        own, of_map = shots.paths(count * maps.count), opaque_index(count)
        plane = own.number // of_map
        ray_of = own.shot * of_map + own.number - plane * of_map
        rays = dr.gather(_Rays, rays, ray_of)
        distance = (-maps.depth_of(plane) - rays.point.z) / rays.direction.z
        start, down = -rays.point.z, -rays.direction.z
        absorbed, scattered = (
            flight.optical_depth(start, down, distance) for flight in (water.absorption_flight, water.scattering_flight)
        )
        length = rays.length + opaque(scene.group_index) * distance
        place = rays.point + rays.direction * distance
        is_lit = None if self._targets is None else distance < dr.gather(mi.Float, lit, ray_of)
        maps.add(own, plane, place, rays.weight, (absorbed, scattered), length, rays.active, is_lit)
        return maps

    def _solids_of(self, moved: LidarScene) -> mi.Scene | LidarScene:
        """Return what rays under water meet: shots have the solids as parts of their own."""
        return moved if moved.parts or self._solids is None else self._solids

    def _reflect(self, received: ReceivedLight, shots: Shots, count: int) -> None:
        """Add the light that the sea reflects to rays of the view."""
        lanes, sample = self._sample(received, shots, count, _GLINTS)
        if dr.width(lanes.number) == 0:
            return
        moved = lanes.pick(self.scene)
        si, length = self._meet_sea(moved, lanes, moved.receiver_pose, sample.angles, sample.weight > 0)
        line, seen = StraightConnection.to_laser(moved, si.p), si.is_valid()
        glint = self._ripples.eval(mi.BSDFContext(), si, si.to_local(line.direction), seen)[0]
        energy, none = glint * line.irradiance * sample.weight, mi.UInt32(0)
        received.receive(sample.pixel, none, mi.UInt32(1), none, length + line.length, energy, seen & (energy > 0))

    def _view(self, shots: Shots, lanes: Lanes, sample: SensorSample) -> list[_Seen]:
        """Return rays of the view in the water, and what they meet; if there are targets, again with what is behind."""
        moved = lanes.pick(self.scene)
        si, length = self._meet_sea(moved, lanes, moved.receiver_pose, sample.angles, sample.weight > 0)
        ripple = _spaced(shots, lanes, _VIEW, 3)
        rays = self._enter(si, length, sample.weight, mi.TransportMode.Radiance, ripple)
        by_surface = length + moved.relative(moved.transmitter_pose).distance(si.p)
        solids, ray = self._solids_of(moved), mi.Ray3f(si.p, rays.direction)
        bed = solids.ray_intersect(ray, rays.active & (self._solids is not None))
        if self._targets is None:
            none = mi.Float(math.inf)
            found = [self._seen(moved, rays, sample, by_surface, bed, none, bed.t)]
        else:
            to_target, bottom = self._targets.distance(bed), self._targets.behind(solids, ray, bed)
            found = [self._seen(moved, rays, sample, by_surface, one, to_target, bottom.t) for one in (bed, bottom)]
            found[1].rays = replace(rays, active=rays.active & (to_target < math.inf))
        dr.eval(found)
        return found

    def _seen(
        self,
        moved: LidarScene,
        rays: _Rays,
        sample: SensorSample,
        by_surface: mi.Float,
        bed: mi.SurfaceInteraction3f,
        to_target: mi.Float,
        to_bottom: mi.Float,
    ) -> _Seen:
        """Return rays of the view that meet solids."""
        on_bed = rays.active & bed.is_valid()
        # Light comes down along the ray: the bottom turns what passes a horizontal area by its cosine over this one's.
        value = bed.bsdf().eval(mi.BSDFContext(), moved.on_shapes(bed), bed.wi, on_bed)[0]
        slope = mi.Vector2f(-bed.n.x / bed.n.z, -bed.n.y / bed.n.z)
        return _Seen(
            rays,
            mi.UInt32(sample.pixel),
            by_surface,
            dr.select(on_bed, bed.t, _NO_BED),
            bed.p,
            self.classes.solid(met_shape(bed)),
            dr.select(dr.norm(slope) <= _STEEPEST, slope, 0),
            dr.select(on_bed, value / -rays.direction.z, 0),
            to_target,
            dr.select(rays.active & (to_bottom < math.inf), to_bottom, _NO_BED),
        )

    def _return(
        self,
        received: ReceivedLight,
        shots: Shots,
        count: int,
        maps: LightMaps,
        seen: _Seen,
        own: Lanes,
        origin: int,
    ) -> None:
        """Add the light that returns from the water or the bottom to rays of the view, `own` of the `count`.

        From a bottom behind targets, and from targets, comes scattered light alone. A target meets the ways up to a
        depth of its own, so that its light arrives in all pixels.
        """
        scene, water, from_bed, targets = self.scene, self.scene.required_water, origin != _WATER, self._targets
        per_ray, each = (
            self._sampling.at_bottom if from_bed else self._sampling.depths,
            dr.width(own.number) // shots.count,
        )
        of_shot = opaque_index(each)
        # Depth after depth: neighbours in a packet read neighbours in maps.
        lanes = shots.paths(each * per_ray)
        part = lanes.number // of_shot
        ray = lanes.number - part * of_shot
        seen = dr.gather(_Seen, seen, lanes.shot * of_shot + ray)
        if received.tile is not None:
            # Random numbers as of all rays.
            lanes = replace(lanes, number=part * opaque_index(count) + dr.gather(mi.UInt32, own.number, ray))
        u, pick, path = _spaced(shots, lanes, origin, 3)
        rays, thickness = seen.rays, opaque(float(self._planes.depths[-1]) / self._sampling.depths)
        # Before all light is received: a new number in memory ends the kernel.
        down, group_index = -rays.direction.z, opaque(scene.group_index)
        line, part_of = mi.Ray3f(rays.point, rays.direction), (mi.Float(part) + path) / per_ray
        if origin == _TARGETS and targets is not None:
            active, path, target, along = rays.active, part_of, *targets.draw(rays.point, down, u)
        elif from_bed:
            along, place, path = seen.to_bed, seen.bed, part_of
            active, turned, solid = rays.active & (along < _NO_BED), seen.turned, seen.solid
        else:
            along = thickness * (mi.Float(part) + u) / down
            place = line(along)
            active, layer = rays.active & (along < seen.to_bottom), water.scattering_flight.layer_at(-place.z)
            turned, solid = dr.gather(mi.Float, self._turned, layer) * thickness / dr.square(down), mi.UInt32(0)
        # Scattering, from the next plane's paths.
        plane = dr.maximum(maps.plane_at(along * down, pick), 1)
        entry = (plane - 1) * _PATHS + dr.minimum(mi.UInt32(path * _PATHS), _PATHS - 1)
        scale = along * down / maps.depth_of(plane)
        x, y, excess, of_bed, of_water = (dr.gather(mi.Float, one, entry) for one in self._spread)
        shift, excess, above, passes = mi.Vector3f(x, y, 0) * scale, excess * scale, pick, active
        if targets is not None:
            moved = lanes.pick(scene)
            solids, (up, of_down, of_up) = self._solids_of(moved), targets.ways(entry, scale)
            if origin == _TARGETS:
                met = targets.meet(solids, line, along, up, of_up, target, active)
                place, active, solid = met.p, active & met.is_valid(), self.classes.solid(met_shape(met))
                value = met.bsdf().eval(mi.BSDFContext(), moved.on_shapes(met), met.to_local(-line.d), active)[0]
                turned, along, shift = targets.count * value / down, (line.o.z - place.z) / down, shift - up
                ends, passes = [(place - line.d * along + shift, of_down, place)], active
            else:
                # The plane below a target is in its shadow.
                above = dr.select(along + maps.step / down > seen.to_target, 0, pick)
                end = place + up
                ends = [(line.o, of_up, end), (line.o + shift, of_down, end)]
                passes = active & ~(from_bed & (along == seen.to_target))
            passes = targets.let_pass(solids, line.d * along, ends, passes)
        absorbed, scattered = (
            flight.optical_depth(-rays.point.z, down, along)
            for flight in (water.absorption_flight, water.scattering_flight)
        )
        kept = opaque(scene.transmitter.energy) * rays.weight * dr.exp(-absorbed) * turned
        length, depth = rays.length + group_index * along, -place.z
        turns = mi.UInt32(0 if from_bed else 1)

        def receive(events: mi.UInt32, length: mi.Float, energy: mi.Float, active: mi.Bool) -> None:
            echo = Echo(seen.surface_length, from_bed)
            received.receive(
                seen.pixel, turns + events, mi.UInt32(1), solid, length, energy, active & (energy > 0), echo
            )

        # Light without scattering, at the bottom once for each ray.
        if origin in (_WATER, _BOTTOM):
            lit, way = maps.look_up(lanes, place, depth, above, scattered=False)
            once = active & (part == 0) if from_bed else active & (along < seen.to_bed)
            receive(mi.UInt32(0), length + way, kept * dr.exp(-scattered) * lit, once)
        # Light that has scattered on one of the ways or both.
        lit, way = maps.look_up(lanes, place + shift, depth, pick, scattered=True)
        share = (1 - dr.exp(-2 * scattered)) * (of_bed / per_ray if from_bed else of_water)
        if origin in (_BOTTOM, _BEHIND):
            # Half of the displacement lies on the way up.
            lower = -seen.slope.x * shift.x - seen.slope.y * shift.y
            excess += dr.clip(lower, -self._relief, self._relief) / down
        energy = kept * share * lit
        receive(dr.gather(mi.UInt32, self._events, entry), length + way + group_index * excess, energy, passes)


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


def _far_apart(depths: FloatArray) -> FloatArray:
    """Return a distance at which waves enhance no light [m]."""
    return np.full(depths.shape, _FAR)


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
