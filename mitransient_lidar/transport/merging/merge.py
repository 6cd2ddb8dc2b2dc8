"""Merging laser light with receiver paths, in water cells and on solids' patches, and their connection.

Scattered light that reaches a narrow beam from far outside it rarely meets one of its cells. A connection estimates the
same path from two points that lie far apart. A straight segment in the water joins them (vertex connection and merging:
Georgiev et al. 2012, doi:10.1145/2366145.2366211). The balance heuristic weights each connection with all other
connections and merges that make its path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.cells import SphericalCells, WaterCells
from mitransient_lidar.transport.merging.patches import SolidPatches, foreshortening
from mitransient_lidar.transport.merging.photon_map import PhotonBuffer, PhotonMap
from mitransient_lidar.transport.merging.segments import SegmentBuffer
from mitransient_lidar.transport.opaque import opaque, opaque_index
from mitransient_lidar.transport.paths.passes import ReceivedLight
from mitransient_lidar.transport.paths.path import PathPoint, interaction_at
from mitransient_lidar.transport.paths.random_walk import Action, RandomWalkPath
from mitransient_lidar.transport.paths.ripple_focusing import Echo
from mitransient_lidar.transport.perturbations import Sums, joined
from mitransient_lidar.transport.rng import Lanes, Shots
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import met_shape


def merge_in_water(
    scene: LidarScene,
    received: ReceivedLight,
    points: PathPoint,
    cells: WaterCells | SphericalCells,
    photons: PhotonMap,
    connections: mi.Float,
) -> None:
    """Merge points on the receiver's paths with the light in their cells.

    A point represents a track with length s and throughput beta, a photon one with length s' and energy w. With the
    cell's volume V each pair adds beta s w s' / V times scattering coefficient and phase function. The weight is among
    all merges and `connections`, a share of all pairs, that make the same path. Water and bubbles make different paths.
    """
    water, perturbations = scene.required_water, scene.perturbations
    cell = cells.locate(points.point)
    mei = interaction_at(points.point, points.direction)
    layer = water.flight.layer_at(-points.point.z)
    scatterers = [(water.phases.at(layer), water.scattering_flight.coefficient(layer))]
    if water.plume is not None:
        scatterers.append((water.plume_phase, water.plume.scattering_at(points.point)))
    absorption = water.absorption_flight.coefficient(layer)
    group = water.index_layers.group(water.index_layers.at(-points.point.z))
    first, end = photons.find(cell.bucket, mi.Bool(True))
    typical = cells.typical_volume(points.point)
    weight = points.throughput * typical / cell.volume
    weight_of_unscattered = points.throughput * typical / cell.volume_of_unscattered

    def merge(index: mi.UInt32) -> tuple[mi.UInt32]:
        active = index < end
        photon, tag, position = photons.photon(index, active)
        active &= tag == cell.tag
        shared, shares = mi.Float(0), []
        for phase, scattering in scatterers:
            value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, -photon.direction, active)
            own = (typical + connections * (points.inverse_density + photon.inverse_density)) / (scattering * value[0])
            shares.append(dr.rcp(own + points.mis_partial_sum + photon.mis_partial_sum))
            shared += shares[-1]
        # The photon continues to the plane through the point normal to its direction, so that times do not blur.
        beyond = dr.dot(points.point, photon.direction) - position
        factor = dr.select(photon.unscattered, weight_of_unscattered, weight)
        energy = factor * photon.throughput * shared * dr.exp(-absorption * beyond)
        length = points.length + photon.length + beyond * group
        by_water = None if len(scatterers) == 1 else shares[0] / shared
        depth, light = -points.point.z, -photon.direction
        sums = perturbations.about(joined(points.sums, photon.sums), depth, beyond)
        sums = perturbations.at_event(sums, depth, points.direction, light, by_water)
        receive(received, points, photon, 1, length, energy, active, sums)
        return (index + 1,)

    dr.while_loop((first,), lambda index: index < end, merge, label="merge in the water")


def merge_on_solids(
    patches: SolidPatches, received: ReceivedLight, photons: PhotonMap | None, connections: mi.Float, rng: mi.PCG32
) -> Action:
    """Return the action that merges the receiver's paths with the light on the solids that they meet.

    A path with throughput beta and a photon with energy w on a patch with area A add beta w / A times the BSDF. This is
    multiplied by the foreshortening ratio between both points. They are weighted against `connections`, a share of all
    pairs, that make the same path.
    """

    def merge(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        if photons is None:
            return
        patch, random = patches.locate(si), mi.PCG32(rng)
        first, end = photons.find(patch.bucket, active)
        shape = met_shape(si)
        solid, sums = received.classes.solid(shape), received.histogram.perturbations.at_solid(path.sums, shape)
        covered = patches.inverse_share(patch, shape, random, active & (first < end))
        weight = path.throughput * covered / patch.area
        typical, at_place = patches.typical_area(si), patches.scene.on_shapes(si)
        connection = connections * path.inverse_density / dr.abs(dr.dot(si.n, path.direction))

        def add(index: mi.UInt32) -> tuple[mi.UInt32]:
            within = index < end
            photon, tag, connectable = photons.photon(index, within)
            within &= tag == patch.tag
            outgoing = si.to_local(-photon.direction)
            # Mitsuba's BSDFs include the cosine to the shading normal. The photon's energy per area includes the true
            # surface's cosine, which is divided out.
            cosine = dr.abs(dr.dot(si.n, photon.direction))
            bsdf = si.bsdf().eval(mi.BSDFContext(), at_place, outgoing, within)[0] / cosine
            connected = dr.select(connectable > 0, connection, 0)
            share = typical / (connected + typical)
            energy = weight * photon.throughput * foreshortening(cosine, patch.cosine) * bsdf * share
            lit, length = within & (bsdf > 0), path.length + photon.length
            receive(received, path, photon, 0, length, energy, lit, joined(sums, photon.sums), solid)
            return (index + 1,)

        dr.while_loop((first,), lambda index: index < end, add, label="merge on solids")

    return merge


def receive(
    received: ReceivedLight,
    point: PathPoint,
    light: PathPoint,
    events: int,
    length: mi.Float,
    energy: mi.Float,
    active: mi.Bool,
    sums: Sums,
    solid: mi.UInt32 | None = None,
    between: Sequence[mi.Vector3f] = (),
) -> None:
    """Add the light on complete paths, each from a receiver part up to a point and a laser part.

    The parts meet with a number of scattering `events`, or on the `solid` with a number; `between` are the directions
    of segments between them. `sums` are the perturbation sums of the complete paths. Paths with a lost part are lost.
    """
    lost = point.lost | light.lost
    order, reversals = point.scatterings + events + light.scatterings, point.reversals
    if received.classes.by_order:
        # Light continues against the directions of the receiver's part.
        course = [point.direction.z, *(direction.z for direction in between), -light.direction.z]
        for here, following in pairwise(course):
            reversals = reversals + dr.select(here * following < 0, mi.UInt32(1), 0)
        reversals = reversals + light.reversals
    echo, number = Echo(point.surface_length, solid is not None), mi.UInt32(0) if solid is None else solid
    received.receive(point.pixel, order, reversals, number, length, energy, active & ~lost, echo, sums)
    received.histogram.lose(energy, active & lost)


_POINTS_PER_CONNECTION = 4  #: Points of the receiver's paths for each one that is connected.

#: Distance between the place of a photon and where a ray meets its solid, absolute [m] and over the ray's length.
_TOLERANCE, _RELATIVE_TOLERANCE = 1e-3, 1e-4


@dataclass(frozen=True)
class ConnectionRates:
    """Rates at which merges and connections in a pass find the same path."""

    OF_SHOTS = ("cells",)

    cells: WaterCells | SphericalCells  #: Cells, whose volumes are the merge rates.
    #: Share of point pairs, and of pairs of points and photons on solids, that are connected.
    in_water: mi.Float
    on_solids: mi.Float
    per_path: int  #: Number of connections per receiver path, with points and with photons on solids; 0 for none.

    @classmethod
    def of_pass(
        cls, scene: LidarScene, cells: WaterCells | SphericalCells, photons: int, points_per_path: float, wanted: bool
    ) -> ConnectionRates:
        """Return the rates for a number of photons, each with an expected number of points.

        There are connections if they are `wanted`, but not in water with bubbles or several refractive indices, nor for
        lidars under water.
        """
        water = scene.required_water
        connected = wanted and water.plume is None and water.index_layers.count == 1 and not scene.submerged
        rate = 1 / (_POINTS_PER_CONNECTION * photons) if connected else 0.0
        per_path = max(round(points_per_path / _POINTS_PER_CONNECTION), 1) if connected else 0
        return cls(cells, opaque(rate / points_per_path), opaque(rate), per_path)

    def volume(self, point: mi.Point3f) -> mi.Float:
        """Return the merge rate at scattering events [m^3]."""
        return self.cells.typical_volume(point)


class WaterConnections:
    """Connections of a scene's pass with independent random numbers for each pass and shot."""

    def __init__(
        self, scene: LidarScene, received: ReceivedLight, rates: ConnectionRates, points: SegmentBuffer, shots: Shots
    ) -> None:
        self.scene, self.received, self.rates = scene, received, rates
        self._water, self._points, self._shots = scene.required_water, points, shots
        self._group = self._water.index_layers.group(mi.UInt32(0))

    def _pairs(self, light: SegmentBuffer | int, stream: int) -> tuple[Lanes, PathPoint, mi.UInt32, mi.Float]:
        """Draw points on the receiver's paths, and random partners among the light of their shots.

        Path and point are drawn one after the other. Paths with other points, in a scene that differs a little, then
        change no other pairs. Partners are points on light paths, or photon numbers in a shot.

        Returns `lanes`: lanes of the pairs, which their numbers count. `point`, `partner`: the points, and their
        partners' numbers. `weight`: reciprocal of the expected number of pairs with the same point and partner; 0 where
        one does not exist.
        """
        points = self._points
        lanes = self._shots.paths(points.paths * self.rates.per_path)
        rng = self._shots.streams(stream, lanes)
        # Read from memory, so that scenes share a kernel.
        counts = self.rates.per_path, points.paths, light if isinstance(light, int) else light.paths
        per_path, paths, photons = (opaque_index(count) for count in counts)
        path = lanes.number // per_path
        stratum = (mi.Float(lanes.number - path * per_path) + rng.next_float32()) / mi.Float(per_path)
        index, count = points.pick(lanes.shot * paths + path, stratum)
        partner = lanes.shot * photons + mi.UInt32((mi.UInt64(rng.next_uint32()) * mi.UInt64(photons)) >> 32)
        weight = mi.Float(count) * mi.Float(photons) / mi.Float(per_path)
        if not isinstance(light, int):
            partner, others = light.pick(partner, rng.next_float32())
            weight *= mi.Float(others)
        exists = weight > 0
        return lanes, points.points(dr.select(exists, index, 0)), dr.select(exists, partner, 0), weight

    def to_light(self, light: SegmentBuffer, stream: int) -> None:
        """Connect some receiver points with some light points."""
        lanes, point, partner, weight = self._pairs(light, stream)
        other, exists = light.points(partner), weight > 0
        scene, rates = lanes.pick((self.scene, self.rates))
        direction, distance, transmittance, pending = self._segment(point, other.point)
        x = self._inverse_scattering_density(point.point, point.direction, direction, exists)
        y = self._inverse_scattering_density(other.point, other.direction, -direction, exists)
        total = point.mis_partial_sum + other.mis_partial_sum
        total += x * (rates.volume(point.point) + rates.in_water * point.inverse_density)
        total += y * (rates.volume(other.point) + rates.in_water * other.inverse_density)
        total += rates.in_water * x * y * pending
        scale = rates.in_water * weight
        energy = scale * point.throughput * other.throughput * transmittance / total
        active = exists & (distance > 0) & dr.isfinite(total)
        ray = mi.Ray3f(point.point, direction)
        ray.maxt = distance
        empty = scene.is_empty(point.point.z) & scene.is_empty(other.point.z)
        active &= ~scene.ray_test(ray, active & ~empty)
        depth, perturbed = point.depth, scene.perturbations
        sums = perturbed.along(joined(point.sums, other.sums), depth, -direction.z, distance)
        sums = perturbed.at_event(sums, depth, point.direction, direction)
        sums = perturbed.at_event(sums, other.depth, other.direction, -direction)
        length = point.length + other.length + distance * self._group
        receive(self.received, point, other, 2, length, energy, active, sums, between=[direction])

    def to_solids(self, light: PhotonBuffer, patches: SolidPatches, stream: int) -> None:
        """Connect some receiver points with some photons on solids."""
        lanes, point, partner, weight = self._pairs(light.photons, stream)
        scene, patches = lanes.pick((self.scene, patches))
        photon = light.connectable(partner)
        exists = (weight > 0) & (photon.throughput != 0)
        direction, distance, transmittance, pending = self._segment(point, photon.point)
        tolerance = _TOLERANCE + _RELATIVE_TOLERANCE * distance
        ray = mi.Ray3f(point.point, direction)
        ray.maxt = distance + tolerance
        si = scene.ray_intersect(ray, exists)
        active = exists & si.is_valid() & (dr.abs(si.t - distance) < tolerance)
        outgoing = si.to_local(-photon.direction)
        cosine = dr.abs(dr.dot(si.n, photon.direction))
        bsdf = si.bsdf().eval(mi.BSDFContext(), scene.on_shapes(si), outgoing, active)[0] / cosine
        x = self._inverse_scattering_density(point.point, point.direction, direction, active)
        connection = self.rates.on_solids * x * pending / dr.abs(dr.dot(si.n, direction))
        total = patches.typical_area(si) + connection
        scale = self.rates.on_solids * weight
        energy = scale * point.throughput * photon.throughput * bsdf * transmittance / total
        energy *= foreshortening(cosine, patches.cosine(si))
        active &= (bsdf > 0) & dr.isfinite(total)
        depth, perturbed = point.depth, self.scene.perturbations
        sums = perturbed.along(joined(point.sums, photon.sums), depth, -direction.z, distance)
        sums = perturbed.at_event(sums, depth, point.direction, direction)
        sums = perturbed.at_solid(sums, met_shape(si))
        solid = self.received.classes.solid(met_shape(si))
        length = point.length + photon.length + distance * self._group
        receive(self.received, point, photon, 1, length, energy, active, sums, solid, [direction])

    def _segment(self, point: PathPoint, place: mi.Point3f) -> tuple[mi.Vector3f, mi.Float, mi.Float, mi.Float]:
        """Return segment direction, length [m] and absorption, and length^2 / transmittance by scattering."""
        offset = place - point.point
        distance = dr.norm(offset)
        direction = offset / distance
        depth, downward = point.depth, -direction.z
        absorption = self._water.absorption_flight.optical_depth(depth, downward, distance)
        scattering = self._water.scattering_flight.optical_depth(depth, downward, distance)
        return direction, distance, dr.exp(-absorption), dr.square(distance) * dr.exp(scattering)

    def _inverse_scattering_density(
        self, point: mi.Point3f, before: mi.Vector3f, after: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """Return 1 / (b p) of scattering events from one direction to another."""
        water = self._water
        layer, mei = water.flight.layer_at(-point.z), interaction_at(point, before)
        value, _ = water.phases.at(layer).eval_pdf(mi.PhaseFunctionContext(), mei, after, active)
        return dr.rcp(water.scattering_flight.coefficient(layer) * value[0])
