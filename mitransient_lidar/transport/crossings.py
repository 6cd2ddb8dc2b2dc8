"""Where and when light in the water crosses horizontal planes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.optics.water import C0
from mitransient_lidar.transport.beam import BeamSampler
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.streams import pass_streams
from mitransient_lidar.transport.system import LidarScene
from mitransient_lidar.transport.walk import Walk, WalkPath, start_walk

FloatArray = NDArray[np.float64]

#: Light is given up after so many times the way to the deepest plane, or where absorption has left so little of it.
_LONGEST_WAY, _SMALLEST_REST = 50.0, 1e-6

#: Legs for which there is room at first, for each photon, and room beyond what the last pass took.
_LEGS, _ROOM = 2.5, 1.25


@dataclass(kw_only=True)
class CrossingPath(WalkPath):
    """A path that remembers how it entered the water, and on which side of the planes it is.

    Attributes
    ----------
    entry, entry_direction, entry_length
        Where its first leg in the water begins [m], its unit direction, and the optical length up to there [m].
    entered
        Whether it has entered the water.
    submerged
        Whether its last leg ran in water.
    passed
        Number of planes at or above it. It is carried along: computed anew at each vertex, rounding could lose a
        crossing or count it twice.
    """

    entry: mi.Point3f
    entry_direction: mi.Vector3f
    entry_length: mi.Float
    entered: mi.Bool
    submerged: mi.Bool
    passed: mi.UInt32

    @classmethod
    def of(cls, path: WalkPath) -> CrossingPath:
        """Return paths at their start."""
        return cls(
            **vars(path),
            entry=mi.Point3f(0),
            entry_direction=mi.Vector3f(0),
            entry_length=mi.Float(0),
            entered=mi.Bool(False),
            submerged=mi.Bool(False),
            passed=mi.UInt32(0),
        )


@dataclass(frozen=True)
class PlaneCrossings:
    """Crossings of planes, one an element.

    Attributes
    ----------
    plane
        Number of the plane.
    downward
        Whether it is crossed downwards.
    x, y
        Where [m].
    weight
        Energy of the light [J].
    length
        Optical length of its path up to here [m].
    scatterings
        How often it has been scattered.
    shift_x, shift_y
        How far it is from where it would cross the plane had it not been scattered since it entered the water [m].
    delay
        How much later it crosses than it would have done there [s].
    """

    plane: NDArray[np.int64]
    downward: NDArray[np.bool_]
    x: FloatArray
    y: FloatArray
    weight: FloatArray
    length: FloatArray
    scatterings: NDArray[np.int64]
    shift_x: FloatArray
    shift_y: FloatArray
    delay: FloatArray

    def select(self, which: NDArray[np.bool_]) -> PlaneCrossings:
        """Return some of the crossings."""
        return PlaneCrossings(**{name: values[which] for name, values in vars(self).items()})


class Crossings:
    """Legs in the water that cross horizontal planes; it takes the place of `Tracks` in a walk of `CrossingPath`.

    Light before its first solid counts. Light that passes beside the surface patch does not.

    Parameters
    ----------
    system
        The lidar scene; it has water.
    depths
        Depths of the planes below the mean sea level [m], increasing, shape (planes,).
    capacity
        Number of legs for which there is room; more are counted, and left out.
    longest
        Optical length in the water after which paths are given up [m].
    """

    def __init__(self, system: LidarScene, depths: FloatArray, capacity: int, longest: float = np.inf) -> None:
        self.capacity = capacity
        self._water: Any = system.water
        self._longest = opaque(longest)
        self._depths = mi.Float(np.append(depths, np.inf))
        self._planes = len(depths)
        self._stored = dr.zeros(mi.UInt32, 1)
        self._first = dr.empty(mi.UInt32, 4 * capacity)
        self._start = dr.empty(mi.Float, 4 * capacity)
        self._course = dr.empty(mi.Float, 4 * capacity)
        self._entry = dr.empty(mi.Float, 4 * capacity)
        self._entry_course = dr.empty(mi.Float, 4 * capacity)

    def _planes_above(self, depth: mi.Float) -> mi.UInt32:
        return mi.UInt32(dr.binary_search(0, self._planes, lambda i: dr.gather(mi.Float, self._depths, i) <= depth))

    def add(self, path: CrossingPath, length: mi.Float, label: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Store the next leg of each path that crosses a plane, and return the paths' offset unchanged.

        Parameters
        ----------
        path
            Paths at the start of the leg.
        length
            Length of the leg [m], infinite where it never ends.
        label, active
            As for `Tracks`, not used: light that leaves through clear water for ever is not active any more but crosses
            planes, too. Every lane that the walk's loop still runs has a leg.
        """
        wet = path.in_water & path.pristine & ~path.virtual
        enters = wet & ~path.entered
        path.entry = dr.select(enters, path.point, path.entry)
        path.entry_direction = dr.select(enters, path.direction, path.entry_direction)
        path.entry_length = dr.select(enters, path.length, path.entry_length)
        path.entered |= enters
        before = dr.select(path.submerged, path.passed, self._planes_above(path.depth))
        fall = dr.select(path.downward == 0, 0, path.downward * length)
        path.passed = self._planes_above(path.depth + fall)
        path.submerged = mi.Bool(path.in_water)
        crosses = wet & (path.passed != before)
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), crosses)
        keep = crosses & (slot < self.capacity)
        dr.scatter(self._first, mi.Vector4u(before, path.passed, path.scatterings, path.stratum), slot, keep)
        dr.scatter(self._start, mi.Vector4f(path.point.x, path.point.y, path.point.z, path.length), slot, keep)
        along, into = path.direction, path.entry_direction
        dr.scatter(self._course, mi.Vector4f(along.x, along.y, along.z, length), slot, keep)
        entry = mi.Vector4f(path.entry.x, path.entry.y, path.entry.z, path.entry_length)
        dr.scatter(self._entry, entry, slot, keep)
        dr.scatter(self._entry_course, mi.Vector4f(into.x, into.y, into.z, path.weight), slot, keep)
        path.active &= ~path.entered | (path.length - path.entry_length < self._longest)
        return path.offset

    def close(self) -> tuple[PlaneCrossings, int]:
        """Return the crossings, and how many legs were to be stored."""
        arrays = (self._first, self._start, self._course, self._entry, self._entry_course)
        dr.eval(self._stored, *arrays)
        wanted = int(self._stored[0])
        count = min(wanted, self.capacity)
        counts, start, course, entry, entry_course = (np.array(array).reshape(-1, 4)[:count] for array in arrays)
        before, after, scatterings, stratum = counts.astype(np.int64).T
        number = np.abs(after - before)
        leg = np.repeat(np.arange(count), number)
        rank = np.arange(len(leg)) - np.repeat(np.cumsum(number) - number, number)
        plane = np.minimum(before, after)[leg] + rank
        depth = np.array(self._depths, dtype=np.float64)[plane]
        x, y, z, length = start[leg].astype(np.float64).T
        dx, dy, dz, longest = course[leg].astype(np.float64).T
        # To rounding, a crossing may lie a little beside the leg.
        along = np.clip((-z - depth) / dz, 0, longest)
        absorption = self._water.absorption_flight.column
        straight = entry[leg].astype(np.float64), entry_course[leg].astype(np.float64)
        x0, y0, length0 = self._unscattered(*straight, depth)
        unscattered = scatterings[leg] == 0
        x, y = x + along * dx, y + along * dy
        length = length + along * self._water.strata.group_index[stratum[leg]]
        return PlaneCrossings(
            plane,
            (after > before)[leg],
            x,
            y,
            straight[1][:, 3] * np.exp(-absorption.optical_depth(-z, -z - along * dz, along)),
            length,
            scatterings[leg],
            np.where(unscattered, 0, x - x0),
            np.where(unscattered, 0, y - y0),
            np.where(unscattered, 0, (length - length0) / C0),
        ), wanted

    def _unscattered(
        self, entry: FloatArray, course: FloatArray, depth: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where rays that enter the water meet planes, and their optical lengths up to there [m].

        The horizontal part of index times direction stays as it is from stratum to stratum.
        """
        strata = self._water.strata
        x, y, length = entry[:, 0], entry[:, 1], entry[:, 3]
        top = -entry[:, 2]
        edges = [*strata.edges, np.inf]
        for index, group, bottom in zip(strata.refractive_index, strata.group_index, edges, strict=True):
            ratio = strata.refractive_index[0] / index
            ux, uy = ratio * course[:, 0], ratio * course[:, 1]
            # The first stratum's ray also goes back up to planes above the trough of a wave.
            drop = np.minimum(depth, bottom) - top
            leg = np.where(bottom == edges[0], drop, np.maximum(drop, 0)) / np.sqrt(1 - ux**2 - uy**2)
            x, y, length = x + leg * ux, y + leg * uy, length + leg * group
            top = np.full_like(top, bottom)
        return x, y, length


class CrossingTracer:
    """Traces light from the laser until it meets a solid, and finds where it crosses planes.

    Parameters
    ----------
    system
        The lidar scene; it has water.
    depths
        Depths of the planes [m], increasing, shape (planes,).
    photons
        Paths of light in a pass.
    """

    def __init__(self, system: LidarScene, depths: FloatArray, photons: int) -> None:
        water: Any = system.water
        # The walk gives up what is late for the record; here nothing is.
        self._system = replace(system, film=cast(mi.Film, SimpleNamespace(path_end=np.inf)))
        self._depths, self._photons = depths, photons
        self._beam = BeamSampler(system.transmitter, system.receiver)
        self._legs = _LEGS
        sine = np.sqrt(1 - system.transmitter.pose.axis[2] ** 2) / system.refractive_index
        longest = _LONGEST_WAY * depths[-1] / np.sqrt(1 - sine**2)
        absorption = water.column.absorption.min()
        if absorption > 0:
            longest = min(longest, -np.log(_SMALLEST_REST) / absorption)
        self._longest = float(longest * water.strata.group_index.max())

    def trace(self, seed: int, number: int) -> tuple[PlaneCrossings, float]:
        """Return the crossings of a pass, and the share of the energy that has passed beside the surface patch."""
        system, count = self._system, self._photons
        while True:
            rng = pass_streams(seed, number, count)
            legs: Any = Crossings(system, self._depths, int(self._legs * count), self._longest)
            direction, energy = self._beam.sample(dr.arange(mi.UInt32, count), count, rng)
            sent = np.broadcast_to(np.array(energy, dtype=np.float64), count)
            path = CrossingPath.of(start_walk(system.transmitter.pose, direction, energy, mi.Float(0)))
            walk = Walk(system, mi.TransportMode.Importance, system.receiver.pose)
            end = walk.run(path, rng, mi.UInt32(0), legs, at_solid=lambda *_: None, past_solids=False)
            beside = sent[np.array(end.virtual)].sum()
            crossings, wanted = legs.close()
            if wanted <= legs.capacity:
                return crossings, float(beside / system.transmitter.energy)
            self._legs = _ROOM * wanted / count
