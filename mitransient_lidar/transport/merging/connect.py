"""Connection of paths from the receiver with light from the laser by straight segments in the water.

Scattered light that reaches a narrow beam from far outside it rarely meets one of its cells. A connection estimates the
same path from two points that lie far apart (vertex connection and merging: Georgiev et al. 2012,
doi:10.1145/2366145.2366211). The balance heuristic weights each connection with all other connections and merges that
make its path.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.cells import WaterCells
from mitransient_lidar.transport.merging.merge import receive
from mitransient_lidar.transport.merging.patches import SolidPatches, foreshortening
from mitransient_lidar.transport.merging.photon_map import PhotonBuffer
from mitransient_lidar.transport.merging.segments import SegmentBuffer
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells
from mitransient_lidar.transport.opaque import opaque, opaque_index
from mitransient_lidar.transport.paths.passes import ReceivedLight
from mitransient_lidar.transport.paths.path import PathPoint, interaction_at
from mitransient_lidar.transport.perturbations import joined
from mitransient_lidar.transport.rng import Lanes, Shots
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import met_shape

#: Points of the receiver's paths for each one that is connected.
_POINTS_PER_CONNECTION = 4

#: Distance between the place of a photon and where a ray meets its solid, absolute [m] and over the ray's length.
_TOLERANCE, _RELATIVE_TOLERANCE = 1e-3, 1e-4


@dataclass(frozen=True)
class ConnectionRates:
    """Rates at which merges and connections in a pass find the same path.

    Attributes
    ----------
    cells
        Cells, whose volumes are the merge rates.
    in_water, on_solids
        Share of point pairs, and of pairs of points and photons on solids, that are connected.
    per_path
        Number of connections per receiver path, with points and with photons on solids; 0 for none.
    """

    OF_SHOTS = ("cells",)

    cells: WaterCells | SphericalCells
    in_water: mi.Float
    on_solids: mi.Float
    per_path: int

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

        Returns
        -------
        lanes
            Lanes of the pairs, which their numbers count.
        point, partner
            The points, and their partners' numbers.
        weight
            Reciprocal of the expected number of pairs with the same point and partner; 0 where one does not exist.
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
