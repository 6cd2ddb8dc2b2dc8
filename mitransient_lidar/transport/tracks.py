"""Legs in the water, from the laser and from the receiver, and points at equal distances along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.path import optical_length
from mitransient_lidar.transport.system import LidarScene

if TYPE_CHECKING:
    from mitransient_lidar.transport.walk import WalkPath


@dataclass(frozen=True)
class TrackPoints:
    """Points along legs, one a lane.

    Attributes
    ----------
    point
        Where [m].
    direction
        Unit direction of the leg.
    length
        Optical length of the path up to here [m].
    weight
        Throughput of the path up to here times the track length that the point stands for [m], negative for virtual
        paths.
    competition
        The path's, see :class:`~mitransient_lidar.transport.walk.WalkPath`.
    label
        The path's: its pixel, and where light is sorted its events and turns so far (`sorting.Sorting.pack`).
    """

    point: mi.Point3f
    direction: mi.Vector3f
    length: mi.Float
    weight: mi.Float
    competition: mi.Float
    label: mi.UInt32


class Tracks:
    """Legs in the water of many paths, in any order, and points at equal distances along each path.

    Parameters
    ----------
    system
        The lidar scene.
    spacing
        Distance between points along a path [m].
    capacity
        Number of legs for which there is room; more are counted, and left out.
    """

    def __init__(self, system: LidarScene, spacing: float, capacity: int) -> None:
        self.system = system
        self._water: Any = system.water
        self.spacing = opaque(spacing)
        self.capacity = capacity
        self._stored = dr.zeros(mi.UInt32, 1)
        self._number = dr.zeros(mi.UInt32, capacity)
        self._label = dr.empty(mi.UInt32, capacity)
        self._start = dr.empty(mi.Float, 4 * capacity)
        self._course = dr.empty(mi.Float, 4 * capacity)
        self._worth = dr.empty(mi.Float, 2 * capacity)
        self._end = mi.UInt32()
        self._leg = mi.UInt32()

    def add(self, path: WalkPath, length: mi.Float, label: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Store the next leg of each path, and return the offset of the first point beyond its end [m].

        Parameters
        ----------
        path
            Paths at the start of the leg.
        length
            Length of the leg [m].
        label
            What to remember with it.
        active
            Which lanes have a leg to store.
        """
        number = mi.UInt32(dr.maximum(dr.ceil((length - path.offset) * (1 / self.spacing)), 0))
        number = dr.select(active, number, 0)
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), number > 0)
        keep = (number > 0) & (slot < self.capacity)
        dr.scatter(self._number, number, slot, keep)
        if self.system.sorting is not None:
            label = self.system.sorting.pack(label, path)
        dr.scatter(self._label, label, slot, keep)
        dr.scatter(self._start, mi.Vector4f(path.point.x, path.point.y, path.point.z, path.offset), slot, keep)
        course = mi.Vector4f(path.direction.x, path.direction.y, path.direction.z, path.length)
        dr.scatter(self._course, course, slot, keep)
        dr.scatter(self._worth, mi.Vector2f(path.weight, path.competition), slot, keep)
        return dr.select(active, dr.fma(mi.Float(number), self.spacing, path.offset - length), path.offset)

    def close(self) -> tuple[int, int]:
        """Give all points their numbers; return how many there are, and how many legs were to be stored."""
        dr.eval(self._stored, self._number, self._label, self._start, self._course, self._worth)
        self._end = dr.cumsum(self._number)
        count = int(self._end[self.capacity - 1])
        leg = dr.zeros(mi.UInt32, max(count, 1))
        dr.scatter(leg, dr.arange(mi.UInt32, self.capacity), self._end - self._number, self._number > 0)
        # Every point belongs to the last leg that begins at or before it.
        self._leg = dr.prefix_reduce(dr.ReduceOp.Max, leg, exclusive=False)
        dr.eval(self._leg)
        return count, int(self._stored[0])

    def points(self, index: mi.UInt32) -> TrackPoints:
        """Return points by number."""
        leg = dr.gather(mi.UInt32, self._leg, index)
        x, y, z, offset = dr.gather(mi.Vector4f, self._start, leg)
        dx, dy, dz, length = dr.gather(mi.Vector4f, self._course, leg)
        throughput, competition = dr.gather(mi.Vector2f, self._worth, leg)
        first = dr.gather(mi.UInt32, self._end, leg) - dr.gather(mi.UInt32, self._number, leg)
        along = dr.fma(mi.Float(index - first), self.spacing, offset)
        direction = mi.Vector3f(dx, dy, dz)
        absorbed = self._water.absorption_flight.optical_depth(-z, -dz, along)
        # A leg runs in one stratum, and may begin on its edge.
        stratum = self._water.strata.at(-z - 0.5 * dz * along)
        return TrackPoints(
            mi.Point3f(x, y, z) + direction * along,
            direction,
            length + optical_length(self.system, along, True, stratum),
            throughput * dr.exp(-absorbed) * self.spacing,
            competition,
            dr.gather(mi.UInt32, self._label, leg),
        )
