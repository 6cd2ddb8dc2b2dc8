"""Path segments in the water with points at equal distances, and the store of numbers for many points."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.opaque import opaque, opaque_index
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.paths.path import PathPoint
from mitransient_lidar.transport.paths.random_walk import RandomWalkPath
from mitransient_lidar.transport.rng import Lanes, Shots
from mitransient_lidar.transport.scene import LidarScene

#: Numbers that tell a path's points apart; paths with more points may share numbers with other paths.
_KEYS_PER_PATH = 1021

#: Memory per path, segment, point, light in a cell and solid hit, and per four perturbation sums for any of these
#: [bytes].
_BYTES_PER_PATH, _BYTES_PER_SEGMENT, _BYTES_PER_POINT = 32, 60, 14
_BYTES_IN_CELL, _BYTES_PER_HIT, _BYTES_PER_SUMS = 26, 64, 16


def memory_of_path(segments: float, points: float, perturbations: int, hits: float | None = None) -> float:
    """Return a path's memory with a number of segments and points [bytes]; light has `hits` on solids, too."""
    sums = _BYTES_PER_SUMS * -(-perturbations // 4)
    size = _BYTES_PER_PATH + segments * (_BYTES_PER_SEGMENT + sums) + points * _BYTES_PER_POINT
    return size if hits is None else size + points * (_BYTES_IN_CELL + sums) + hits * (_BYTES_PER_HIT + sums)


#: Stored segment: its start [m], and the path there (`RandomWalkPath`).
_FIELDS = {
    **{"point": "Point3f", "offset": "Float"},
    **{"direction": "Vector3f", "length": "Float"},
    **{"throughput|lost": "Float", "mis_partial_sum": "Float"},
    **{"inverse_scattering_density": "Float", "surface_length": "Float"},
    "label": "UInt32",
}


PATHS_OF_GROUP = 4  #: Neighbouring paths that are stored together: the sets of the receiver's samples take turns.


class SegmentBuffer:
    """Segments in the water from `paths` paths per shot, with points at equal distances `spacing` [m] along them.

    At most `capacity` segments are stored, in any order, but all are counted. Points are numbered path by path. Of each
    `every` neighbouring path groups, group number `turn` is stored, and represents them all.
    """

    def __init__(
        self,
        scene: LidarScene,
        classes: PathClasses,
        spacing: float,
        paths: int,
        capacity: int,
        shots: int = 1,
        every: int = 1,
        turn: mi.UInt32 | None = None,
    ) -> None:
        self._water, self._perturbations, self._classes = scene.required_water, scene.perturbations, classes
        self.paths, self._shots, self._every, self._turn = paths // every, shots, every, turn
        self.spacing = opaque(spacing)
        self.capacity, self._capacity = capacity, opaque_index(capacity)
        self._stored = dr.zeros(mi.UInt32, 1)
        self._of_path = dr.zeros(mi.UInt32, shots * self.paths)
        self._place = dr.zeros(mi.UInt32, 2 * capacity)
        self._segments = PackedStore(capacity, {**_FIELDS, "sums": self._perturbations.count})
        self._end = mi.UInt32()
        self._first = mi.UInt32()
        self._slot = mi.UInt32()

    def add(self, path: RandomWalkPath, length: mi.Float, active: mi.Bool) -> mi.Float:
        """Store each path's next segment, with a length [m]; return the offset to the first point beyond it [m]."""
        number = mi.UInt32(dr.maximum(dr.ceil((length - path.offset) * (1 / self.spacing)), 0))
        lane, throughput = path.lane, mi.Float(path.throughput)
        if self._every > 1:
            group = path.lane // PATHS_OF_GROUP
            active &= group % self._every == self._turn
            lane = group // self._every * PATHS_OF_GROUP + path.lane % PATHS_OF_GROUP
            throughput *= self._every
        number = dr.select(active, number, 0)
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), number > 0)
        keep = (number > 0) & (slot < self._capacity)
        dr.scatter(self._place, mi.Point2u(lane, path.points), slot, keep)
        values = {**vars(path), "throughput": throughput, "label": self._classes.pack(path)}
        self._segments.write(values, slot, keep)
        path.points += number
        dr.scatter(self._of_path, path.points, lane, number > 0)
        return dr.select(active, dr.fma(mi.Float(number), self.spacing, path.offset - length), path.offset)

    def finalize(self) -> tuple[int, int]:
        """Assign numbers to the points; return how many points and segments there are, stored or not."""
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
        """Return one point on each path by uniform random numbers, and how many points the path has."""
        count = dr.gather(mi.UInt32, self._of_path, path)
        within = dr.minimum(mi.UInt32(u * mi.Float(count)), dr.maximum(count, 1) - 1)
        return dr.gather(mi.UInt32, self._end, path) - count + within, count

    def random(self, index: mi.UInt32, shots: Shots) -> mi.Float:
        """Return uniform random numbers for points by number, which points on other paths do not change."""
        first = dr.gather(mi.UInt32, self._first, index)
        lane, before = dr.gather(mi.Point2u, self._place, dr.gather(mi.UInt32, self._slot, first))
        lanes = Lanes.of_paths(lane, self._shots, self.paths)
        key = lanes.number * _KEYS_PER_PATH + before + index - first
        return mi.sample_tea_float32(key, shots.keys(lanes))

    def points(self, index: mi.UInt32) -> PathPoint:
        """Return points by number."""
        first = dr.gather(mi.UInt32, self._first, index)
        start = SimpleNamespace(**self._segments.read(dr.gather(mi.UInt32, self._slot, first)))
        along = dr.fma(mi.Float(index - first), self.spacing, start.offset)
        depth, downward = -start.point.z, -start.direction.z
        absorption = self._water.absorption_flight.optical_depth(depth, downward, along)
        scattering = self._water.scattering_flight.optical_depth(depth, downward, along)
        inverse = start.inverse_scattering_density
        # A segment lies in one index layer, and may begin on its boundary.
        layers = self._water.index_layers
        group = layers.group(layers.at(depth + 0.5 * downward * along))
        return PathPoint(
            point=start.point + start.direction * along,
            direction=start.direction,
            length=start.length + along * group,
            throughput=start.throughput * dr.exp(-absorption) * self.spacing,
            lost=start.lost,
            sums=self._perturbations.along(start.sums, depth, downward, along),
            surface_length=start.surface_length,
            mis_partial_sum=start.mis_partial_sum,
            inverse_density=dr.select(inverse > 0, inverse * dr.square(along) * dr.exp(scattering), 0),
            **self._classes.unpack(start.label),
        )


_PACKET = 4  #: Numbers in a packet.
_SIGN, _MAGNITUDE = 1 << 31, (1 << 31) - 1  #: Sign bit of a number, and all other bits.


class PackedStore:
    """Stored numbers for points, one entry per point.

    `size`: number of entries. `fields`: stored fields, in the order of their packets with four numbers: by name a
    Mitsuba type, or a number list's length. ``number|flag`` are a number, 0 or more, and a flag in its sign bit.
    """

    def __init__(self, size: int, fields: Mapping[str, str | int]) -> None:
        self._fields = [(name.partition("|")[0], name.partition("|")[2], kind) for name, kind in fields.items()]
        rest = sum(map(_count, fields.values()))
        # An array for each packet: a second write to the same one would compute all that is stored again.
        self._packets = []
        while rest > 0:
            width = _PACKET if rest > 2 else rest
            self._packets.append((dr.empty(mi.Float, width * size), width))
            rest -= width

    def write(self, values: Mapping[str, Any], place: mi.UInt32, active: mi.Bool) -> None:
        """Store the values of all fields and flags, by name."""
        numbers = []
        for name, flag, kind in self._fields:
            stored = [*values[name]] if _count(kind) > 1 or isinstance(kind, int) else [values[name]]
            if flag:
                # NaN may have its own sign.
                bits = dr.reinterpret_array(mi.UInt32, stored[0]) & _MAGNITUDE
                stored = [bits | dr.select(values[flag], mi.UInt32(_SIGN), 0)]
            numbers += [dr.reinterpret_array(mi.Float, number) for number in stored]
        numbers += [mi.Float(0)] * (-len(numbers) % _PACKET)
        for index, (packet, width) in enumerate(self._packets):
            first = _PACKET * index
            dr.scatter(packet, _packet_type(width)(*numbers[first : first + width]), place, active)

    def read(self, place: mi.UInt32, active: mi.Bool | bool = True) -> dict[str, Any]:
        """Return values by the names of fields and flags; 0 where inactive."""
        numbers: list[mi.Float] = []
        for packet, width in self._packets:
            found = dr.gather(_packet_type(width), packet, place, active)
            numbers += [found] if width == 1 else [*found]
        values: dict[str, Any] = {}
        for name, flag, kind in self._fields:
            count = _count(kind)
            stored, numbers = numbers[:count], numbers[count:]
            if flag:
                bits = dr.reinterpret_array(mi.UInt32, stored[0])
                values[flag] = (bits & _SIGN) != 0
                stored = [dr.reinterpret_array(mi.Float, bits & _MAGNITUDE)]
            if kind == "UInt32":
                values[name] = dr.reinterpret_array(mi.UInt32, stored[0])
            else:
                values[name] = stored if isinstance(kind, int) else getattr(mi, kind)(*stored)
        return values

    def evaluate(self) -> None:
        """Compute the stored values."""
        dr.eval([packet for packet, _ in self._packets])


def _count(kind: str | int) -> int:
    """Return how many numbers a field has."""
    return kind if isinstance(kind, int) else {"Float": 1, "UInt32": 1}.get(kind, 3)


def _packet_type(width: int) -> Any:
    return {1: mi.Float, 2: mi.Vector2f, _PACKET: mi.Vector4f}[width]
