"""Connection of paths from the receiver with light from the laser by straight segments in the water.

Scattered light that reaches a narrow beam from far outside it rarely meets one of its cells. A connection estimates the
same path from two points that lie far apart (vertex connection and merging: Georgiev et al. 2012,
doi:10.1145/2366145.2366211). The balance heuristic weights each connection with all other connections and merges that
make its path.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.cells import WaterCells
from mitransient_lidar.transport.merging.merge import SensorSubpath
from mitransient_lidar.transport.merging.patches import SolidPatches
from mitransient_lidar.transport.merging.photon_map import Photon, PhotonBuffer
from mitransient_lidar.transport.merging.segments import SegmentBuffer, SegmentPoints
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.passes import PassRecord
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene import LidarScene

#: Points of the receiver's paths for each one that is connected.
_POINTS_PER_CONNECTION = 4

#: Distance between the place of a photon and where a ray meets its solid, absolute [m] and over the ray's length.
_TOLERANCE, _RELATIVE_TOLERANCE = 1e-3, 1e-4


@dataclass(frozen=True)
class ConnectionRates:
    """Rates with which merges and connections of a pass find the same path.

    Attributes
    ----------
    cells
        Cells, whose volumes are the rates of merges.
    in_water, on_solids
        Share of the pairs of points, and of points and photons on solids, that are connected.
    connected
        Whether there are connections at all.
    """

    cells: WaterCells | SphericalCells
    in_water: mi.Float
    on_solids: mi.Float
    connected: bool

    @classmethod
    def of_pass(
        cls, scene: LidarScene, cells: WaterCells | SphericalCells, photons: int, points_per_path: float, wanted: bool
    ) -> ConnectionRates:
        """Return the rates for a number of photons, each with an expected number of points.

        There are connections if they are `wanted`, but not in water with bubbles or several refractive indices, nor for
        lidars under water.
        """
        water = scene.water
        connected = wanted and water.plume is None and water.index_layers.count == 1 and not scene.submerged
        rate = 1 / (_POINTS_PER_CONNECTION * photons) if connected else 0.0
        return cls(cells, opaque(rate / points_per_path), opaque(rate), connected)

    def volume(self, point: mi.Point3f) -> mi.Float:
        """Return the rate of merges at scattering events [m^3]."""
        return self.cells.typical_volume(point)


class WaterConnections:
    """Connections of a scene's pass with independent random numbers for each pass."""

    def __init__(self, scene: LidarScene, record: PassRecord, rates: ConnectionRates, points: SegmentBuffer) -> None:
        self.scene, self.record, self.rates = scene, record, rates
        self._water, self._points = scene.water, points

    def _pairs(self, count: int, partners: int, seed: int, stream: int) -> tuple[SegmentPoints, mi.UInt32, mi.Bool]:
        """Return some of `count` points, numbers of random partners, and which points exist."""
        lanes = -(-count // _POINTS_PER_CONNECTION)
        rng = pass_streams(seed, stream, lanes)
        index = dr.arange(mi.UInt32, lanes) * _POINTS_PER_CONNECTION + rng.next_uint32() % _POINTS_PER_CONNECTION
        # Opaque, as these numbers differ between passes, which share a kernel.
        found, others = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt64, partners)
        partner = mi.UInt32((mi.UInt64(rng.next_uint32()) * others) >> 32)
        return self._points.points(dr.minimum(index, found - 1)), partner, index < found

    def to_light(self, count: int, light: SegmentBuffer, partners: int, seed: int, stream: int) -> None:
        """Connect some of `count` points of the receiver's paths with some of `partners` points of light paths."""
        point, partner, exists = self._pairs(count, partners, seed, stream)
        other, rates = light.points(partner), self.rates
        direction, distance, transmittance, pending = self._segment(point, other.point)
        x = self._inverse(point.point, point.direction, direction, exists)
        y = self._inverse(other.point, other.direction, -direction, exists)
        total = point.mis_partial_sum + other.mis_partial_sum
        total += x * (rates.volume(point.point) + rates.in_water * point.edge)
        total += y * (rates.volume(other.point) + rates.in_water * other.edge)
        total += rates.in_water * x * y * pending
        scale = rates.in_water * opaque(float(partners) * _POINTS_PER_CONNECTION)
        energy = scale * point.weight * other.weight * transmittance / total
        active = exists & (distance > 0) & dr.isfinite(total)
        ray = mi.Ray3f(point.point, direction)
        ray.maxt = distance
        clear = self.scene.is_clear(point.point.z) & self.scene.is_clear(other.point.z)
        active &= ~self.scene.ray_test(ray, active & ~clear)
        length = point.length + other.length
        self._receive(point, other, mi.UInt32(0), direction, 2, length, distance, energy, active)

    def to_solids(self, count: int, light: PhotonBuffer, patches: SolidPatches, seed: int, stream: int) -> None:
        """Connect some of `count` points of the receiver's paths with some photons on solids."""
        point, partner, exists = self._pairs(count, light.photons, seed, stream)
        place, photon = light.connectable(partner)
        exists &= photon.weight != 0
        direction, distance, transmittance, pending = self._segment(point, place)
        tolerance = _TOLERANCE + _RELATIVE_TOLERANCE * distance
        ray = mi.Ray3f(point.point, direction)
        ray.maxt = distance + tolerance
        si = self.scene.ray_intersect(ray, exists)
        active = exists & si.is_valid() & (dr.abs(si.t - distance) < tolerance)
        outgoing = si.to_local(-photon.direction)
        bsdf = si.bsdf().eval(mi.BSDFContext(), si, outgoing, active)[0] / dr.abs(dr.dot(si.n, photon.direction))
        x = self._inverse(point.point, point.direction, direction, active)
        connection = self.rates.on_solids * x * pending / dr.abs(dr.dot(si.n, direction))
        total = patches.typical_area(si) + connection
        scale = self.rates.on_solids * opaque(float(light.photons) * _POINTS_PER_CONNECTION)
        energy = scale * point.weight * photon.weight * bsdf * transmittance / total
        active &= (bsdf > 0) & dr.isfinite(total)
        solid, length = self.record.classes.solid(si.shape), point.length + photon.length
        self._receive(point, photon, solid, direction, 1, length, distance, energy, active)

    def _segment(self, point: SegmentPoints, place: mi.Point3f) -> tuple[mi.Vector3f, mi.Float, mi.Float, mi.Float]:
        """Return direction, length [m] and absorption of segments, and their length^2 / transmittance of scattering."""
        offset = place - point.point
        distance = dr.norm(offset)
        direction = offset / distance
        depth, downward = -point.point.z, -direction.z
        absorption = self._water.absorption_flight.optical_depth(depth, downward, distance)
        scattering = self._water.scattering_flight.optical_depth(depth, downward, distance)
        return direction, distance, dr.exp(-absorption), dr.square(distance) * dr.exp(scattering)

    def _inverse(self, point: mi.Point3f, before: mi.Vector3f, after: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Return 1 / (b p) of scattering events from one direction to another."""
        water = self._water
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.p, mei.wi = point, -before
        mei.sh_frame = mi.Frame3f(mei.wi)
        layer = water.flight.layer_at(-point.z)
        value, _ = water.phases.at(layer).eval_pdf(mi.PhaseFunctionContext(), mei, after, active)
        return dr.rcp(water.scattering_flight.attenuation(layer) * value[0])

    def _receive(
        self,
        point: SegmentPoints,
        light: SegmentPoints | Photon,
        solid: mi.UInt32,
        direction: mi.Vector3f,
        events: int,
        length: mi.Float,
        distance: mi.Float,
        energy: mi.Float,
        active: mi.Bool,
    ) -> None:
        """Add the energy of connected paths to the record."""
        subpath = SensorSubpath(*self.record.classes.unpack(point.label), solid, point.direction, point.weight)
        group: Any = self._water.index_layers.group(mi.UInt32(0))
        subpath.add(self.record, light, events, length + distance * group, energy, active, [direction])
