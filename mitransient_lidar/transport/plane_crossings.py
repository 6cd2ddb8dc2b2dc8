"""Crossings of horizontal planes by light in the water: place, time and energy."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.transport.laser import BeamSampler
from mitransient_lidar.transport.medium.water import Water
from mitransient_lidar.transport.merging.segments import PackedStore
from mitransient_lidar.transport.opaque import aligned, opaque
from mitransient_lidar.transport.paths.random_walk import RandomWalk, RandomWalkPath
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene import LidarScene

#: Paths end after this multiple of the distance to the deepest plane, or when absorption leaves this share of light.
_LONGEST_WAY, _SMALLEST_REST = 50.0, 1e-6

#: Initial segment capacity per photon, and capacity over the last pass's need.
_SEGMENTS, _CAPACITY_MARGIN = 2.5, 1.25


#: Stored segment: planes before and after it, start, direction and length, and its path's entry.
_PACKETS = (("point", "length"), ("direction", "longest"), ("entry", "entry_length"), ("entry_direction", "throughput"))
_FIELDS = dict.fromkeys(("before", "passed", "scatterings", "index_layer"), "UInt32") | {
    name: kind for packet in _PACKETS for name, kind in zip(packet, ("Vector3f", "Float"), strict=True)
}


@dataclass(kw_only=True)
class CrossingPath(RandomWalkPath):
    """A path with its entry into the water, and its side of each plane."""

    #: Start of its first segment in the water [m], unit direction, and optical length up to there [m].
    entry: mi.Point3f = field(default_factory=lambda: mi.Point3f(0))
    entry_direction: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    entry_length: mi.Float = field(default_factory=lambda: mi.Float(0))
    entered: mi.Bool = field(default_factory=lambda: mi.Bool(False))  #: Whether it has entered the water.
    submerged: mi.Bool = field(default_factory=lambda: mi.Bool(False))  #: Whether its last segment lies in water.
    #: Number of planes at or above it, stored because rounding could lose or repeat crossings if it were recomputed.
    passed: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))


@dataclass(frozen=True)
class PlaneCrossings:
    """Plane crossings, one per element."""

    plane: NDArray[np.int64]  #: Plane number.
    downward: NDArray[np.bool_]  #: Whether it is crossed downwards.
    #: Position [m].
    x: FloatArray
    y: FloatArray
    weight: FloatArray  #: Light energy [J].
    length: FloatArray  #: Optical path length up to the crossing [m].
    scatterings: NDArray[np.int64]  #: Number of scattering events before.
    #: Horizontal distance from its crossing without scattering in the water [m].
    shift_x: FloatArray
    shift_y: FloatArray
    delay: FloatArray  #: Delay against that crossing [s].

    def select(self, which: NDArray[np.bool_]) -> PlaneCrossings:
        """Return the crossings where `which` is true."""
        return PlaneCrossings(**{name: values[which] for name, values in vars(self).items()})


class Crossings:
    """Segments that cross horizontal planes, stored in place of a `SegmentBuffer` by walks along a `CrossingPath`.

    Light counts before its first solid, and inside the surface mesh. At most `capacity` segments are stored, but all
    are counted; `longest` is the optical length in the water after which paths end [m].
    """

    def __init__(self, water: Water, depths: FloatArray, capacity: int, longest: float = np.inf) -> None:
        self.capacity = capacity
        self._water = water
        self._longest = opaque(longest)
        self._depths = aligned(mi.Float, np.append(depths, np.inf))
        self._planes = len(depths)
        self._stored = dr.zeros(mi.UInt32, 1)
        self._segments = PackedStore(capacity, _FIELDS)

    def _planes_above(self, depth: mi.Float) -> mi.UInt32:
        return mi.UInt32(dr.binary_search(0, self._planes, lambda i: dr.gather(mi.Float, self._depths, i) <= depth))

    def add(self, path: CrossingPath, length: mi.Float, active: mi.Bool) -> mi.Float:
        """Store the next segment of each path that crosses a plane, and return the paths' offset unchanged.

        Inactive lanes are stored, too: light that never ends its segment in clear water is inactive but crosses planes.
        """
        wet = path.in_water & path.before_first_solid & ~path.lost
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
        self._segments.write({**vars(path), "before": before, "longest": length}, slot, keep)
        path.active &= ~path.entered | (path.length - path.entry_length < self._longest)
        return path.offset

    def finalize(self) -> tuple[PlaneCrossings, int]:
        """Return the crossings, and the number of segments, stored or not."""
        self._segments.evaluate()
        dr.eval(self._stored)
        wanted = int(self._stored[0])
        count = min(wanted, self.capacity)
        stored = self._segments.read(dr.arange(mi.UInt32, count))
        before, after, scatterings, layer = (
            np.array(stored[name]).astype(np.int64) for name in ("before", "passed", "scatterings", "index_layer")
        )
        start, direction, entry, entry_direction = (
            np.column_stack([np.array(stored[name]).T, np.array(stored[more])]) for name, more in _PACKETS
        )
        number = np.abs(after - before)
        segment = np.repeat(np.arange(count), number)
        rank = np.arange(len(segment)) - np.repeat(np.cumsum(number) - number, number)
        plane = np.minimum(before, after)[segment] + rank
        depth = np.array(self._depths, dtype=np.float64)[plane]
        x, y, z, length = start[segment].astype(np.float64).T
        dx, dy, dz, longest = direction[segment].astype(np.float64).T
        # To rounding, a crossing may lie just outside the segment.
        along = np.clip((-z - depth) / dz, 0, longest)
        absorption = self._water.absorption_flight.column
        straight = entry[segment].astype(np.float64), entry_direction[segment].astype(np.float64)
        x0, y0, length0 = self._unscattered(*straight, depth)
        unscattered = scatterings[segment] == 0
        x, y = x + along * dx, y + along * dy
        length = length + along * self._water.index_layers.group_index[layer[segment]]
        return PlaneCrossings(
            plane,
            (after > before)[segment],
            x,
            y,
            straight[1][:, 3] * np.exp(-absorption.optical_depth(-z, -z - along * dz, along)),
            length,
            scatterings[segment],
            np.where(unscattered, 0, x - x0),
            np.where(unscattered, 0, y - y0),
            np.where(unscattered, 0, (length - length0) / C0),
        ), wanted

    def _unscattered(
        self, entry: FloatArray, direction: FloatArray, depth: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where rays that enter the water meet planes without scattering, and their optical lengths [m]."""
        layers = self._water.index_layers
        x, y, length = entry[:, 0], entry[:, 1], entry[:, 3]
        top = -entry[:, 2]
        edges = [*layers.boundaries, np.inf]
        for index, group, bottom in zip(layers.refractive_index, layers.group_index, edges, strict=True):
            # The horizontal part of index times direction is the same in all index layers.
            ratio = layers.refractive_index[0] / index
            ux, uy = ratio * direction[:, 0], ratio * direction[:, 1]
            # The ray in the top index layer also reaches planes above the trough of a wave.
            drop = np.minimum(depth, bottom) - top
            distance = np.where(bottom == edges[0], drop, np.maximum(drop, 0)) / np.sqrt(1 - ux**2 - uy**2)
            x, y, length = x + distance * ux, y + distance * uy, length + distance * group
            top = np.full_like(top, bottom)
        return x, y, length


class CrossingTracer:
    """Traces light from the laser to its first solid, and finds where it crosses planes.

    `scene`: lidar scene with water. `depths`: plane depths below the mean sea level [m], increasing, shape (planes,).
    `photons`: light paths per pass.
    """

    def __init__(self, scene: LidarScene, depths: FloatArray, photons: int) -> None:
        self._scene = scene
        self._depths, self._photons = depths, photons
        self._beam = BeamSampler(scene.transmitter, scene.receiver)
        self._segments = _SEGMENTS
        down = -refract_level(scene.transmitter.pose.axis, scene.refractive_index)[2]
        longest = _LONGEST_WAY * depths[-1] / down
        absorption = scene.required_water.column.absorption.min()
        if absorption > 0:
            longest = min(longest, -np.log(_SMALLEST_REST) / absorption)
        self._longest = float(longest * scene.required_water.index_layers.group_index.max())

    def trace(self, seed: int, number: int) -> tuple[PlaneCrossings, float]:
        """Return the crossings in a pass, and the share of the energy that passes outside the surface mesh."""
        scene, pose, count = self._scene, self._scene.transmitter.pose, self._photons
        while True:
            rng = pass_streams(seed, number, count)
            segments = Crossings(scene.required_water, self._depths, int(self._segments * count), self._longest)
            angles, energy = self._beam.sample(dr.arange(mi.UInt32, count), count, rng)
            sent = np.broadcast_to(np.array(energy, dtype=np.float64), count)
            path = CrossingPath.walking(scene, pose, angles, energy, mi.Float(0))
            # Infinite length: no record ends the paths.
            walk = RandomWalk(scene, mi.TransportMode.Importance, scene.receiver.pose, np.inf)
            end = walk.run(path, rng, segments, on_solid=lambda *_: None, past_solids=False)
            outside = sent[np.array(end.lost)].sum()
            crossings, wanted = segments.finalize()
            if wanted <= segments.capacity:
                absolute = crossings.length + scene.relative(pose).range
                return replace(crossings, length=absolute), float(outside / scene.transmitter.energy)
            self._segments = _CAPACITY_MARGIN * wanted / count
