"""Segments of paths in the water, and points at equal distances along them."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.contribution import Contribution
from mitransient_lidar.transport.opaque import opaque, opaque_index
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.perturbations import SumStore
from mitransient_lidar.transport.random_walk import RandomWalkPath
from mitransient_lidar.transport.rng import Lanes, Shots
from mitransient_lidar.transport.scene import LidarScene

#: Numbers that tell the points of a path apart; those of paths with more points may be those of other paths.
_KEYS_PER_PATH = 1021

#: Memory of a path, of a segment, of a point, of light in a cell, of a hit of a solid, and of four of the sums of
#: perturbations of any of these [bytes].
_BYTES_PER_PATH, _BYTES_PER_SEGMENT, _BYTES_PER_POINT = 32, 60, 14
_BYTES_IN_CELL, _BYTES_PER_HIT, _BYTES_PER_SUMS = 26, 64, 16


def memory_of_path(segments: float, points: float, perturbations: int, hits: float | None = None) -> float:
    """Return the memory of a path with a number of segments and points [bytes]; light has `hits` on solids, too."""
    sums = _BYTES_PER_SUMS * -(-perturbations // 4)
    size = _BYTES_PER_PATH + segments * (_BYTES_PER_SEGMENT + sums) + points * _BYTES_PER_POINT
    return size if hits is None else size + points * (_BYTES_IN_CELL + sums) + hits * (_BYTES_PER_HIT + sums)


@dataclass(frozen=True)
class SegmentPoints:
    """Points along segments, one a lane.

    Attributes
    ----------
    point
        Position [m].
    direction
        Unit direction of the segment.
    length
        Optical length of the path up to the point [m].
    contribution
        What the path carries up to the point, with its throughput times the track length of the point [m].
    mis_partial_sum
        As in `RandomWalkPath`.
    inverse_density
        Reciprocal of the density, per volume, with which the last scattering event sends paths to the point [m^3]:
        1 / (b p) times the squared distance from it over the transmittance of scattering on the way; 0 if the segment
        starts elsewhere.
    label
        Label of the path, with its scattering events and reversals so far (`PathClasses.pack`).
    surface_length
        As of the path [m].
    """

    point: mi.Point3f
    direction: mi.Vector3f
    length: mi.Float
    contribution: Contribution
    mis_partial_sum: mi.Float
    inverse_density: mi.Float
    label: mi.UInt32
    surface_length: mi.Float

    @property
    def unscattered(self) -> mi.Bool:
        """Whether no event in the water has scattered the path: its sum has no terms."""
        return self.mis_partial_sum == 0


@dataclass(frozen=True)
class _Segment:
    """A stored segment: its start [m], and the path's properties there as in `RandomWalkPath`."""

    start: mi.Point3f
    offset: mi.Float
    direction: mi.Vector3f
    length: mi.Float
    contribution: Contribution
    mis_partial_sum: mi.Float
    inverse_scattering_density: mi.Float
    surface_length: mi.Float
    label: mi.UInt32


class _SegmentStore:
    """Stored segments.

    Each is three packets of four numbers that are read together, a label, and sums of perturbations:

    ==============  ==============================================================================================
    ``_start``      x, y and z of the start, offset of the first point
    ``_direction``  x, y and z of the direction, length
    ``_factors``    `Contribution.packed`, ``mis_partial_sum``, ``inverse_scattering_density``, ``surface_length``
    ==============  ==============================================================================================
    """

    def __init__(self, size: int, perturbations: int) -> None:
        self._start, self._direction, self._factors = (dr.empty(mi.Float, 4 * size) for _ in range(3))
        self._label = dr.empty(mi.UInt32, size)
        self._sums = SumStore(size, perturbations)

    def write(self, path: RandomWalkPath, label: mi.UInt32, place: mi.UInt32, active: mi.Bool) -> None:
        """Store the next segment of each path."""
        start, direction = path.point, path.direction
        factors = path.packed(), path.mis_partial_sum, path.inverse_scattering_density, path.surface_length
        dr.scatter(self._label, label, place, active)
        dr.scatter(self._start, mi.Vector4f(start.x, start.y, start.z, path.offset), place, active)
        dr.scatter(self._direction, mi.Vector4f(direction.x, direction.y, direction.z, path.length), place, active)
        dr.scatter(self._factors, mi.Vector4f(*factors), place, active)
        self._sums.write(path.sums, place, active)

    def read(self, place: mi.UInt32) -> _Segment:
        """Return segments."""
        x, y, z, offset = dr.gather(mi.Vector4f, self._start, place)
        dx, dy, dz, length = dr.gather(mi.Vector4f, self._direction, place)
        packed, mis_partial_sum, inverse, surface_length = dr.gather(mi.Vector4f, self._factors, place)
        carried = Contribution.unpacked(packed, self._sums.read(place))
        label = dr.gather(mi.UInt32, self._label, place)
        return _Segment(
            mi.Point3f(x, y, z),
            offset,
            mi.Vector3f(dx, dy, dz),
            length,
            carried,
            mis_partial_sum,
            inverse,
            surface_length,
            label,
        )

    def evaluate(self) -> None:
        """Compute what is stored."""
        dr.eval(self._label, self._start, self._direction, self._factors, self._sums.packets)


class SegmentBuffer:
    """Segments in the water of `paths` paths of each shot, with points at equal distances `spacing` [m] along them.

    At most `capacity` segments are stored, in any order, but all are counted. Points are numbered path by path.
    """

    def __init__(
        self, scene: LidarScene, classes: PathClasses, spacing: float, paths: int, capacity: int, shots: int = 1
    ) -> None:
        self._water, self._perturbations, self._classes = scene.required_water, scene.perturbations, classes
        self.paths, self._shots = paths, shots
        self.spacing = opaque(spacing)
        self.capacity, self._capacity = capacity, opaque_index(capacity)
        self._stored = dr.zeros(mi.UInt32, 1)
        self._of_path = dr.zeros(mi.UInt32, shots * paths)
        self._place = dr.zeros(mi.UInt32, 2 * capacity)
        self._segments = _SegmentStore(capacity, self._perturbations.count)
        self._end = mi.UInt32()
        self._first = mi.UInt32()
        self._slot = mi.UInt32()

    def add(self, path: RandomWalkPath, length: mi.Float, label: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Store the next segment of each path, of a length [m]; return the offset of the first point beyond it [m]."""
        number = mi.UInt32(dr.maximum(dr.ceil((length - path.offset) * (1 / self.spacing)), 0))
        number = dr.select(active, number, 0)
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), number > 0)
        keep = (number > 0) & (slot < self._capacity)
        dr.scatter(self._place, mi.Point2u(path.lane, path.points), slot, keep)
        self._segments.write(path, self._classes.pack(label, path.scatterings, path.reversals), slot, keep)
        path.points += number
        dr.scatter(self._of_path, path.points, path.lane, number > 0)
        return dr.select(active, dr.fma(mi.Float(number), self.spacing, path.offset - length), path.offset)

    def finalize(self) -> tuple[int, int]:
        """Assign numbers to the points; return their number and that of the segments, stored or not."""
        dr.eval(self._stored, self._of_path, self._place)
        self._segments.evaluate()
        self._end = dr.cumsum(self._of_path)
        count, wanted = int(self._end[self._shots * self.paths - 1]), int(self._stored[0])
        if wanted > self.capacity or count == 0:
            return count, wanted
        slot = dr.arange(mi.UInt32, wanted)
        lane, before = dr.gather(mi.Point2u, self._place, slot)
        first = dr.gather(mi.UInt32, self._end, lane) - dr.gather(mi.UInt32, self._of_path, lane) + before
        begins, self._slot = dr.zeros(mi.UInt32, count), dr.empty(mi.UInt32, count)
        dr.scatter(begins, first, first)
        dr.scatter(self._slot, slot, first)
        # Every point belongs to the last segment that begins at or before it.
        self._first = dr.prefix_reduce(dr.ReduceOp.Max, begins, exclusive=False)
        dr.eval(self._first, self._slot)
        return count, wanted

    def lanes(self, index: mi.UInt32) -> Lanes:
        """Return the lanes of points by number: shots, and paths within them."""
        segment = dr.gather(mi.UInt32, self._slot, dr.gather(mi.UInt32, self._first, index))
        return Lanes.of_paths(dr.gather(mi.UInt32, self._place, 2 * segment), self._shots, self.paths)

    def pick(self, path: mi.UInt32, u: mi.Float) -> tuple[mi.UInt32, mi.UInt32]:
        """Return one of the points of each path by uniform random numbers, and how many points the path has."""
        count = dr.gather(mi.UInt32, self._of_path, path)
        within = dr.minimum(mi.UInt32(u * mi.Float(count)), dr.maximum(count, 1) - 1)
        return dr.gather(mi.UInt32, self._end, path) - count + within, count

    def random(self, index: mi.UInt32, shots: Shots) -> mi.Float:
        """Return uniform random numbers of points by number, which points of other paths do not change."""
        first = dr.gather(mi.UInt32, self._first, index)
        lane, before = dr.gather(mi.Point2u, self._place, dr.gather(mi.UInt32, self._slot, first))
        lanes = Lanes.of_paths(lane, self._shots, self.paths)
        key = lanes.number * _KEYS_PER_PATH + before + index - first
        return mi.sample_tea_float32(key, shots.keys(lanes))

    def points(self, index: mi.UInt32) -> SegmentPoints:
        """Return points by number."""
        first = dr.gather(mi.UInt32, self._first, index)
        segment = self._segments.read(dr.gather(mi.UInt32, self._slot, first))
        along = dr.fma(mi.Float(index - first), self.spacing, segment.offset)
        depth, downward = -segment.start.z, -segment.direction.z
        absorption = self._water.absorption_flight.optical_depth(depth, downward, along)
        scattering = self._water.scattering_flight.optical_depth(depth, downward, along)
        inverse, carried = segment.inverse_scattering_density, segment.contribution
        inverse_density = dr.select(inverse > 0, inverse * dr.square(along) * dr.exp(scattering), 0)
        # A segment lies in one index layer, and may begin on its boundary.
        layers = self._water.index_layers
        group = layers.group(layers.at(depth + 0.5 * downward * along))
        throughput = carried.throughput * dr.exp(-absorption) * self.spacing
        sums = self._perturbations.along(carried.sums, depth, downward, along)
        return SegmentPoints(
            segment.start + segment.direction * along,
            segment.direction,
            segment.length + along * group,
            Contribution(throughput, carried.lost, sums),
            segment.mis_partial_sum,
            inverse_density,
            segment.label,
            segment.surface_length,
        )
