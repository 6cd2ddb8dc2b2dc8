"""Passes that look up the light of the beam in maps at several depths, instead of following it through the water.

Rays of the beam are refracted by waves and ripples and added to maps of horizontal planes: energy and mean length.
Rays of the view are refracted in the same way. At each depth, and where they meet the bottom, they look up the light
that has come down there, displaced and delayed by a path of `TwoWaySpread`: scattering on both ways at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.refraction import refract_level
from mitransient_lidar.physics.water.two_way_spread import TwoWaySpread
from mitransient_lidar.transport.light_maps.heights import HeightFields
from mitransient_lidar.transport.medium.water_phases import table_of
from mitransient_lidar.transport.opaque import aligned, changed, opaque
from mitransient_lidar.transport.paths.passes import PassRenderer, ReceivedLight
from mitransient_lidar.transport.paths.path_classes import PathClasses
from mitransient_lidar.transport.paths.refracted_connection import StraightConnection
from mitransient_lidar.transport.paths.ripple_focusing import Echo
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.rng import Lanes, Shots, unit_points
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import met_shape

#: Numbers of the random streams within a pass.
_BEAM_STREAM, _VIEW_STREAM, _DEPTH_STREAM, _BOTTOM_STREAM = 0, 2, 4, 5

#: Rays of the view in a pass, and of the beam for each of them.
_RAYS, _BEAM_PER_VIEW = 512, 2

#: Planes of maps, cells on each side of a map, and its half width over the standard deviation of the beam.
_PLANES, _CELLS, _SPREADS = 16, 96, 4.0

#: Half width of a map for refraction by waves, over the depth.
_WIDTH_PER_DEPTH = 0.15

#: Depths at which each ray looks up the light of the water, over the planes; displaced paths of each at the bottom.
_DEPTHS_PER_PLANE, _PATHS_AT_BOTTOM = 2, 12

#: Paths of `TwoWaySpread`.
_SPREAD_PATHS = 2**16

#: Units of energies and lengths in maps: 2^-28 of the beam's energy, and 2^-18 m of that.
_ENERGY_UNITS, _LENGTH_UNITS = 2.0**26, 2.0**20

#: Largest optical depth one way of light in maps.
_DARK = 30.0


@dataclass
class _Rays:
    """Rays in the water, and what they carry there.

    Attributes
    ----------
    point, direction
        Where they enter the water [m], and unit direction.
    length
        Optical length up to there, relative to the reference point [m].
    weight
        Energy [J], or received energy per radiance [m^2 sr].
    active
        Whether they are in the water.
    """

    point: mi.Point3f
    direction: mi.Vector3f
    length: mi.Float
    weight: mi.Float
    active: mi.Bool

    def at_depth(self, depth: mi.Float) -> tuple[mi.Float, mi.Point3f]:
        """Return the distance to a depth below the mean sea level [m], and the place there."""
        distance = (-depth - self.point.z) / self.direction.z
        return distance, self.point + self.direction * distance

    def gathered(self, index: mi.UInt32) -> _Rays:
        """Return some of the rays."""
        return dr.gather(_Rays, self, index)


class LightMapRenderer(PassRenderer):
    """Renders passes of a lidar above a sea with waves, water of one refractive index and bottoms.

    Raises
    ------
    UserError
        If the scene has what maps lack.
    """

    def __init__(self, scene: LidarScene, classes: PathClasses, rays: int = 0) -> None:
        super().__init__(scene, classes, rays or _RAYS)
        check(scene)
        water, pose = scene.required_water, scene.receiver.pose
        axis = refract_level(pose.axis, scene.refractive_index)
        cos_water = -float(axis[2])
        deepest = _deepest(scene, cos_water)
        self._depths = deepest * (np.arange(_PLANES) + 1) / _PLANES
        column = water.column
        phases = [table_of(phase) for phase in water.phases.phases[: column.count]]
        spread = TwoWaySpread.of_column(
            column, phases, self._depths, cos_water, _SPREAD_PATHS, np.random.default_rng(0)
        )
        #: Paths of the spread by plane, one after the other.
        self._spread = [
            aligned(mi.Float, values.astype(np.float32).ravel())
            for values in (spread.shift_x, spread.shift_y, spread.excess, spread.of_bottom, spread.of_water)
        ]
        self._events = aligned(mi.UInt32, spread.events.astype(np.uint32).ravel())
        # Light that one event turns by 180 degrees [1/(m sr)].
        turned = [b * float(phase.eval_s(1.0)) for b, phase in zip(column.scattering, phases, strict=True)]
        self._turned = aligned(mi.Float, np.array(turned, np.float32))
        sigma = scene.transmitter.widest_angular_spread * pose.ground_range / -float(pose.axis[2])
        half = _SPREADS * sigma + _WIDTH_PER_DEPTH * np.append(0, self._depths)
        self._half = aligned(mi.Float, half.astype(np.float32))
        self._ripples, self._fields = scene.seas[0].bsdf(), None

    @property
    def path_count(self) -> int:
        """Number of paths of a pass from either end, as heavy as those of other renderers."""
        return self.paths * (1 + _BEAM_PER_VIEW)

    def over(self, scene: LidarScene, sea: HeightFields) -> LightMapRenderer:
        """Return a renderer of shots that meet a scene in parts, over heights of the sea."""
        return changed(self, scene=scene, _fields=sea)

    def trace(self, received: ReceivedLight, shots: Shots, paths: int) -> None:
        """Look up the light of one pass for each shot, with a number of rays of the view."""
        maps = self._light_maps(shots, _BEAM_PER_VIEW * paths)
        self._look(received, shots, paths, maps)

    def _enter(
        self, scene: LidarScene, sea: HeightFields, pose: KernelPose, angles: mi.Point2f, weight: mi.Float, mode: mi.TransportMode,
        u: tuple[mi.Float, mi.Point2f],
    ) -> tuple[_Rays, mi.SurfaceInteraction3f, mi.Float]:
        """Return rays refracted by the sea, what they meet first, and their relative length there [m]."""
        direction = pose.direction(angles.x, angles.y)
        start, length = scene.first_points(pose, angles, direction)
        at_sea = (weight > 0) & (direction.z < -0.1)
        si = sea.meet(start, direction, at_sea)
        length = length + si.t
        bs, value = self._ripples.sample(mi.BSDFContext(mode), si, *u, at_sea)
        below = si.to_world(bs.wo)
        wet = at_sea & (bs.wo.z < 0) & (below.z < -0.1) & (value[0] > 0)
        rays = _Rays(si.p, below, length, dr.select(wet, weight * value[0], 0), wet)
        return rays, si, length

    def _light_maps(self, shots: Shots, count: int) -> _Maps:
        """Return the maps of the beam of each shot."""
        scene, water = self.scene, self.scene.required_water
        lanes = shots.paths(count)
        moved, rng = lanes.pick(scene), shots.streams(_BEAM_STREAM, lanes)
        points, shift = unit_points(count, lanes.number), [lanes.pick(u) for u in shots.uniform(_BEAM_STREAM, 2)]
        u = mi.Point2f(*(v + s - dr.floor(v + s) for v, s in zip(points, shift, strict=True)))
        angles = mi.Point2f(*scene.transmitter.sample_tangent(dr.minimum(u, 1 - 2**-24)))
        ripple = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        energy = dr.full(mi.Float, 1 / count, dr.width(lanes.number))
        rays, _, _ = self._enter(moved, lanes.pick(self._fields), moved.transmitter_pose, angles, energy, mi.TransportMode.Importance, ripple)
        dr.eval(rays)
        planes = _PLANES + 1
        index = dr.arange(mi.UInt32, shots.count * count * planes)
        ray, plane = index // planes, index % planes
        here = rays.gathered(ray)
        own = Lanes.of_paths(index, shots.count, count * planes)
        maps = _Maps(self, shots)
        depth = maps.depth_of(plane)
        distance, place = here.at_depth(depth)
        start, down = -here.point.z, -here.direction.z
        absorbed = water.absorption_flight.optical_depth(start, down, distance)
        scattered = water.scattering_flight.optical_depth(start, down, distance)
        length = here.length + opaque(scene.group_index) * distance
        kept = dr.exp(-absorbed + maps.absorbed_to(plane))
        clear = dr.exp(-scattered + maps.scattered_to(plane))
        inside = here.active & ((distance > 0) | (plane == 0))
        maps.add(own, plane, place, here.weight * kept, clear, length, inside)
        return maps

    def _look(self, received: ReceivedLight, shots: Shots, count: int, maps: _Maps) -> None:
        """Add the light that rays of the view see."""
        scene, water = self.scene, self.scene.required_water
        lanes = shots.paths(count)
        rng = shots.streams(_VIEW_STREAM, lanes)
        sample = self.sampler.sample_shots(lanes, count, rng)
        moved = lanes.pick(scene)
        pose = moved.receiver_pose
        ripple = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        rays, si, _ = self._enter(moved, lanes.pick(self._fields), pose, sample.angles, sample.weight, mi.TransportMode.Radiance, ripple)
        by_surface = rays.length + moved.relative(moved.transmitter_pose).distance(si.p)
        line = StraightConnection.to_laser(moved, si.p)
        glint = self._ripples.eval(mi.BSDFContext(), si, si.to_local(line.direction), sample.weight > 0)[0]
        glint *= line.irradiance * sample.weight
        zero, once = mi.UInt32(0), mi.UInt32(1)
        received.receive(sample.pixel, zero, once, zero, rays.length + line.length, glint, glint > 0)
        bed = moved.ray_intersect(mi.Ray3f(si.p, rays.direction), rays.active)
        on_bed = rays.active & bed.is_valid()
        distance = dr.select(on_bed, bed.t, 1e4)
        context, bed_bsdf = mi.BSDFContext(), bed.bsdf()
        value = bed_bsdf.eval(context, moved.on_shapes(bed), bed.wi, on_bed)[0]
        slope = mi.Vector2f(-bed.n.x / bed.n.z, -bed.n.y / bed.n.z)
        turned_by = dr.select(on_bed, value / -rays.direction.z, 0)
        number = self.classes.solid(met_shape(bed))
        pixel = mi.UInt32(sample.pixel)
        dr.eval(rays, distance, bed.p, slope, turned_by, number, pixel, by_surface)
        factor = opaque(scene.transmitter.energy)
        columns = _DEPTHS_PER_PLANE * _PLANES

        def look_up(per_ray: int, stream: int, of_bed: bool) -> None:
            index = dr.arange(mi.UInt32, shots.count * count * per_ray)
            ray, part = index // per_ray, index % per_ray
            own = Lanes.of_paths(index, shots.count, count * per_ray)
            rng = shots.streams(stream, own)
            here = rays.gathered(ray)
            end = dr.gather(mi.Float, distance, ray)
            u, pick, path = rng.next_float32(), rng.next_float32(), rng.next_float32()
            if of_bed:
                along = end
                place = dr.gather(mi.Point3f, bed.p, ray)
                depth, active = -place.z, here.active & (end < 1e3)
            else:
                depth = opaque(self._depths[-1] / columns) * (mi.Float(part) + u)
                along, place = here.at_depth(depth)
                active = here.active & (along > 0) & (along < end)
            down = -here.direction.z
            absorbed = water.absorption_flight.optical_depth(-here.point.z, down, along)
            scattered = water.scattering_flight.optical_depth(-here.point.z, down, along)
            seen = here.weight * dr.exp(-absorbed)
            if of_bed:
                seen *= dr.gather(mi.Float, turned_by, ray)
            else:
                layer = water.scattering_flight.layer_at(depth)
                turn = self._turned[0] if water.column.count == 1 else dr.gather(mi.Float, self._turned, layer)
                seen *= turn * opaque(self._depths[-1] / columns) / dr.square(down)
            length = here.length + opaque(scene.group_index) * along
            echo = Echo(dr.gather(mi.Float, by_surface, ray), of_bed)
            own_pixel = dr.gather(mi.UInt32, pixel, ray)
            own_solid = dr.gather(mi.UInt32, number, ray) if of_bed else mi.UInt32(0)
            turned = 0 if of_bed else 1
            # Without scattering, once for each ray and depth.
            clear, of_light = maps.look_up(own, place, depth, pick, scattered=False)
            once_only = active & (part == 0) if of_bed else active
            energy = factor * seen * dr.exp(-scattered) * clear
            received.receive(
                own_pixel, mi.UInt32(turned), once, own_solid, length + of_light, energy, once_only & (energy > 0), echo
            )
            # Scattered on one of the ways or both.
            plane, scale = maps.plane_at(depth, pick)
            entry = (dr.maximum(plane, 1) - 1) * _SPREAD_PATHS + dr.minimum(
                mi.UInt32(path * _SPREAD_PATHS), _SPREAD_PATHS - 1
            )
            dx, dy, excess, weight_b, weight_w = (dr.gather(mi.Float, one, entry) for one in self._spread)
            events = dr.gather(mi.UInt32, self._events, entry)
            x, y, excess = dx * scale, dy * scale, excess * scale
            shifted = mi.Point3f(place.x + x, place.y + y, place.z)
            at = mi.Float(depth)
            if of_bed:
                tilt = dr.gather(mi.Vector2f, slope, ray)
                at = depth - 0.5 * (tilt.x * x + tilt.y * y)
            lit, of_light = maps.look_up(own, shifted, depth, pick, scattered=True)
            share = 1 - dr.exp(-2 * scattered)
            energy = factor * seen * share * lit * (weight_b / (_PATHS_AT_BOTTOM) if of_bed else weight_w)
            total = length + of_light + opaque(scene.group_index) * (excess + 2 * (at - depth) / down)
            received.receive(
                own_pixel, events + turned, once, own_solid, total, energy, active & (energy > 0), echo
            )

        look_up(columns, _DEPTH_STREAM, False)
        if scene.solids:
            look_up(_PATHS_AT_BOTTOM, _BOTTOM_STREAM, True)


class _Maps:
    """Energy and length of the beam of each shot in cells of planes.

    The planes lie at equal depths, the first at the mean sea level; cells are counted from where the axis of each shot,
    refracted by a level sea, meets the plane. Energies are relative to the absorption along that axis.
    """

    def __init__(self, renderer: LightMapRenderer, shots: Shots) -> None:
        scene = renderer.scene
        self._half, self._planes = renderer._half, _PLANES + 1
        self._step = opaque(float(renderer._depths[0]))
        poses, index = scene.transmitter_poses or scene.transmitter.pose, scene.refractive_index
        axes = np.broadcast_to(poses.axis, (shots.count, 3))
        origin = np.broadcast_to(poses.origin, (shots.count, 3))
        entry = origin[:, :2] - axes[:, :2] * (origin[:, 2] / axes[:, 2])[:, None]
        below = np.array([refract_level(axis, index) for axis in axes])
        tilt = below[:, :2] / -below[:, 2:]
        self._entry, self._tilt = (
            mi.Vector2f(*(aligned(mi.Float, column.astype(np.float32)) for column in each.T)) for each in (entry, tilt)
        )
        down = -float(below[0, 2])
        column = scene.required_water.column
        nodes = np.append(0, renderer._depths)
        ends = np.clip(nodes[:, None], column.layer_tops, np.append(column.layer_tops[1:], np.inf)) - column.layer_tops
        self._absorbed, self._scattered = (
            aligned(mi.Float, (ends @ values / down).astype(np.float32))
            for values in (column.absorption, column.scattering)
        )
        # Lengths by the axis of each shot, to which those of rays are relative.
        point = np.concatenate([entry, np.zeros((shots.count, 1))], axis=1)
        reference = np.linalg.norm(scene.receiver.pose.nearby_point() - origin, axis=1) - poses.delay
        to_entry = np.linalg.norm(point - origin, axis=1) - reference
        self._to_entry = aligned(mi.Float, to_entry.astype(np.float32))
        self._per_depth = opaque(scene.group_index / down)
        size = shots.count * self._planes * _CELLS * _CELLS
        self._energy, self._clear, self._length = (
            dr.zeros(mi.UInt32, size), dr.zeros(mi.UInt32, size), dr.zeros(mi.Int32, size)
        )

    def depth_of(self, plane: mi.UInt32) -> mi.Float:
        """Return the depth of planes [m]."""
        return mi.Float(plane) * self._step

    def absorbed_to(self, plane: mi.UInt32) -> mi.Float:
        """Return the optical depth of absorption along the axis to a plane."""
        return dr.gather(mi.Float, self._absorbed, plane)

    def scattered_to(self, plane: mi.UInt32) -> mi.Float:
        """Return the optical depth of scattering along the axis to a plane."""
        return dr.gather(mi.Float, self._scattered, plane)

    def plane_at(self, depth: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return one of the two planes about a depth, in proportion, and the depth over that of the first or later."""
        place = dr.clip(depth / self._step, 0, self._planes - 1)
        plane = dr.minimum(mi.UInt32(place + u), self._planes - 1)
        return plane, depth / self.depth_of(dr.maximum(plane, 1))

    def _cell(self, lanes: Lanes, plane: mi.UInt32, place: mi.Point3f, depth: mi.Float) -> tuple[mi.UInt32, mi.Bool]:
        """Return the cell of a place [m] relative to the axis at its depth, and whether it is inside the map."""
        entry, tilt = lanes.pick(self._entry), lanes.pick(self._tilt)
        half = dr.gather(mi.Float, self._half, plane)
        per_metre = (0.5 * _CELLS) / half
        i = (place.x - entry.x - tilt.x * depth) * per_metre + 0.5 * _CELLS
        j = (place.y - entry.y - tilt.y * depth) * per_metre + 0.5 * _CELLS
        inside = (i >= 0) & (j >= 0) & (i < _CELLS) & (j < _CELLS)
        index = mi.UInt32(dr.select(inside, j, 0)) * _CELLS + mi.UInt32(dr.select(inside, i, 0))
        return (lanes.shot * self._planes + plane) * (_CELLS * _CELLS) + index, inside

    def add(
        self, lanes: Lanes, plane: mi.UInt32, place: mi.Point3f, energy: mi.Float, clear: mi.Float, length: mi.Float,
        active: mi.Bool,
    ) -> None:
        """Add energies and optical lengths [m] of rays; `clear` is the share of the energy without scattering."""
        cell, inside = self._cell(lanes, plane, place, self.depth_of(plane))
        active &= inside
        later = length - lanes.pick(self._to_entry) - self._per_depth * self.depth_of(plane)
        units = energy * _ENERGY_UNITS
        dr.scatter_add(self._energy, mi.UInt32(units), cell, active)
        dr.scatter_add(self._clear, mi.UInt32(units * clear), cell, active)
        dr.scatter_add(self._length, mi.Int32(energy * clear * later * _LENGTH_UNITS), cell, active)

    def look_up(
        self, lanes: Lanes, place: mi.Point3f, depth: mi.Float, u: mi.Float, *, scattered: bool
    ) -> tuple[mi.Float, mi.Float]:
        """Return energy per horizontal area of the beam at places, over that emitted [1/m^2], and its length [m].

        Without scattering, or else with absorption alone.
        """
        plane, _ = self.plane_at(depth, u)
        cell, inside = self._cell(lanes, plane, place, depth)
        energy, clear = (mi.Float(dr.gather(mi.UInt32, each, cell, inside)) for each in (self._energy, self._clear))
        moment = mi.Float(dr.gather(mi.Int32, self._length, cell, inside))
        later = dr.select(clear > 0, moment / dr.maximum(clear, 1) * (_ENERGY_UNITS / _LENGTH_UNITS), 0)
        half = dr.gather(mi.Float, self._half, plane)
        density = (0.5 * _CELLS) ** 2 / dr.square(half) / _ENERGY_UNITS
        # The optical depth of the axis at the depth itself.
        at = dr.minimum(depth / self._step, self._planes - 1)
        low = dr.minimum(mi.UInt32(at), self._planes - 2)

        def between(values: mi.Float) -> mi.Float:
            first, second = (dr.gather(mi.Float, values, low + more) for more in (0, 1))
            return dr.lerp(first, second, at - mi.Float(low))

        lost = between(self._absorbed) if scattered else between(self._absorbed) + between(self._scattered)
        found = (energy if scattered else clear) * density * dr.exp(-lost)
        length = later + lanes.pick(self._to_entry) + self._per_depth * depth
        return dr.select(inside, found, 0), length


def check(scene: LidarScene) -> None:
    """Raise `UserError` if maps of light are not for a scene."""
    if scene.submerged or scene.water is None:
        raise UserError("light maps need a lidar above water")
    if len(scene.water.index_layers.boundaries):
        raise UserError("the layers of the water have different indices: light maps need one refractive index")
    if scene.water.plume is not None:
        raise UserError("the scene has bubbles, which light maps lack")


def _deepest(scene: LidarScene, cos_water: float) -> float:
    """Return the largest depth of light [m]."""
    poses = scene.transmitter.pose, scene.receiver.pose
    air = sum(float(np.linalg.norm(pose.ground_point() - pose.origin)) for pose in poses)
    deepest = max((scene.axis.path_end - air) / (2 * scene.group_index), 0.1) * cos_water
    lowest = min((float(solid.bbox().min.z) for solid in scene.bottoms), default=-deepest)
    return float(min(deepest, max(-lowest, 0.1)) * 1.02)
