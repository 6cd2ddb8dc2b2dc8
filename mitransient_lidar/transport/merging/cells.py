"""Cells of water in which light from the laser is merged with paths from the receiver."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.merging.rings import BeamRings
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.pose import Pose
from mitransient_lidar.transport.rng import Lanes, pass_streams, unit_points
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler

#: Cells on each side of the table of surface heights, of a single shot and of each of several.
_HEIGHT_CELLS, _HEIGHT_CELLS_OF_SHOTS = 512, 64

#: Depth of columns without a solid below [m].
_NO_BED = 1e9

#: Number of rays that find the region and the solids below it.
PROBE_RAYS = 4096

#: Share of rays that may fall outside the region on either side, and margin over its size.
_REGION_TAIL, _REGION_MARGIN = 0.002, 0.15

#: Logarithm to base 2 of the largest number of buckets of a shot.
MOST_BUCKET_BITS = 20

#: Largest growth of the width of cells with depth.
_MOST_GROWTH = 4.0

#: Added to cell numbers so that they are positive.
ORIGIN = 1 << 20


@dataclass(frozen=True)
class Region:
    """Rectangle of the mean sea level that is lit or seen: corners (x, y) [m]."""

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def of_scene(cls, scene: LidarScene, sampler: SensorSampler) -> Region:
        """Find the region with rays of the beam and of the field of view; raise UserError if none goes down."""
        seen = sampler.sample(dr.arange(mi.UInt32, PROBE_RAYS), PROBE_RAYS, pass_streams(0, 0, PROBE_RAYS))
        tangent = scene.transmitter.sample_tangent(unit_points(PROBE_RAYS))
        beam = scene.transmitter.pose.direction(*tangent)
        places = [
            _at_sea_level(scene.receiver.pose, np.array(seen.direction).T[np.array(seen.weight) > 0]),
            _at_sea_level(scene.transmitter.pose, np.array(beam).T),
        ]
        ends = [np.quantile(place, [_REGION_TAIL, 1 - _REGION_TAIL], axis=0) for place in places if len(place)]
        if not ends:
            raise UserError("laser and receiver look above the horizon: at least one must look down at the sea")
        low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
        margin = _REGION_MARGIN * (high - low)
        x, y = zip((low - margin).tolist(), (high + margin).tolist(), strict=True)
        return cls((x[0], y[0]), (x[1], y[1]))

    @property
    def size(self) -> tuple[float, float]:
        """Sides along x and y [m]."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def probe_points(self, index: mi.UInt32 | None = None) -> tuple[mi.Float, mi.Float]:
        """Return points (x, y) of the region [m] by number, by default all of 4096, evenly distributed."""
        x, y = unit_points(PROBE_RAYS, index)
        return dr.lerp(opaque(self.low[0]), opaque(self.high[0]), x), dr.lerp(
            opaque(self.low[1]), opaque(self.high[1]), y
        )

    def track_length(self, scene: LidarScene) -> float:
        """Return the mean distance in the water along the axis to a solid, or to the depth of the record's end [m]."""
        transmitter, receiver = scene.transmitter.pose, scene.receiver.pose
        spot = transmitter.ground_point()
        sine = transmitter.axis[:2] / scene.refractive_index
        down = np.append(sine, -np.sqrt(1 - sine @ sine))
        air = sum(float(np.linalg.norm(spot - pose.origin)) for pose in (transmitter, receiver))
        longest = (scene.axis.path_end - air) / (2 * scene.group_index)
        x, y = self.probe_points()
        lowest = min(float(surface.bbox().min.z) for surface in scene.surfaces)
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, opaque(lowest - 1e-3)), mi.Vector3f(down.tolist())))
        length = dr.mean(dr.minimum(dr.select(si.is_valid(), si.t, dr.inf), max(longest, 0.1)))
        return float(length[0])

    def within(self, box: mi.ScalarBoundingBox3f) -> bool:
        """Return whether a bounding box covers the region with a margin of its size on every side."""
        return all(
            float(box.min[axis]) < self.low[axis] - self.size[axis]
            and float(box.max[axis]) > self.high[axis] + self.size[axis]
            for axis in (0, 1)
        )


def _at_sea_level(pose: Pose, directions: np.ndarray) -> np.ndarray:
    """Return where rays from a pose meet z = 0, (x, y) [m], without those that do not."""
    down = directions[directions[:, 2] < 0]
    return np.asarray(pose.origin[:2] - down[:, :2] * (pose.origin[2] / down[:, 2:]))


class SurfaceHeights:
    """Heights of the sea surface over a region, and of the first solid below it.

    Tables for each place of shots, of which there are `copies`.
    """

    def __init__(self, scene: LidarScene, region: Region, shots: int = 1, copies: int = 1) -> None:
        n = self._cells = _HEIGHT_CELLS if shots == 1 else _HEIGHT_CELLS_OF_SHOTS
        self._copies, places = dr.opaque(mi.UInt32, copies), shots // copies
        self._low = [opaque(low) for low in region.low]
        self._per_metre = [opaque(n / size) for size in region.size]
        lanes = Lanes.of_paths(dr.arange(mi.UInt32, places * n * n), places, n * n)
        index = lanes.number
        scene = scene.of(Lanes(shots, lanes.shot * self._copies, index))
        self._start = mi.UInt32(0)
        x = (mi.Float(index % n) + 0.5) / self._per_metre[0] + self._low[0]
        y = (mi.Float(index // n) + 0.5) / self._per_metre[1] + self._low[1]
        top = opaque(max(float(surface.bbox().max.z) for surface in scene.surfaces) + 1.0)

        def look_down(
            ray: mi.Ray3f, height: mi.Float, bed: mi.Float, wet: mi.Bool, active: mi.Bool
        ) -> tuple[mi.Ray3f, mi.Float, mi.Float, mi.Bool, mi.Bool]:
            si = scene.ray_intersect(ray, active)
            active &= si.is_valid()
            at_sea = scene.is_surface(si.shape)
            height = dr.select(active & at_sea, si.p.z, height)
            bed = dr.select(active & wet & ~at_sea, si.p.z, bed)
            # Continue below solids above the sea.
            active &= at_sea | ~wet
            wet |= active & at_sea
            return dr.select(active, si.spawn_ray(ray.d), ray), height, bed, wet, active

        count = places * n * n
        state = (
            mi.Ray3f(mi.Point3f(x, y, top), mi.Vector3f(0, 0, -1)),
            *(dr.zeros(mi.Float, count), dr.full(mi.Float, -_NO_BED, count)),
            *(dr.zeros(mi.Bool, count), dr.full(mi.Bool, True, count)),
        )
        _, height, bed, _, _ = dr.while_loop(state, lambda *state: state[-1], look_down, label="heights")
        self._table = dr.ravel(mi.Point2f(height, bed))
        dr.eval(self._table)

    def of(self, lanes: Lanes) -> SurfaceHeights:
        """Return the heights of each lane's shot."""
        if lanes.shots == 1:
            return self
        heights = copy.copy(self)
        heights._start = (lanes.shot // self._copies) * (self._cells * self._cells)
        return heights

    def at(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return the heights of surface and solid at (x, y) [m]; outside the region, those of its nearest point."""
        n = self._cells
        i = dr.clip(mi.Int32((x - self._low[0]) * self._per_metre[0]), 0, n - 1)
        j = dr.clip(mi.Int32((y - self._low[1]) * self._per_metre[1]), 0, n - 1)
        height, bed = dr.gather(mi.Point2f, self._table, self._start + mi.UInt32(j * n + i))
        return height, bed


class WaterGrid:
    """Layout of cells that follow the sea surface and are arranged about the refracted beam.

    Cells are sectors of rings in layers of the depth below the surface, so that the surface cuts none. The lowest one
    above a solid ends there. They are sheared along the beam in still water, so that its light stays in one column of
    cells.

    Parameters
    ----------
    width
        Horizontal side of a cell on the axis at the surface, over the core radius of the rings.
    growth
        Growth of the width with depth [m/m], as light patterns of the waves blur with depth.
    thickness
        Thickness of a cell [m].
    depth
        Depth within which different layers have different buckets [m].
    bits
        Logarithm to base 2 of the number of buckets of a shot.
    """

    def __init__(
        self,
        rings: BeamRings,
        heights: SurfaceHeights,
        width: float,
        growth: float,
        thickness: float,
        depth: float,
        bits: int = MOST_BUCKET_BITS,
    ) -> None:
        self.heights, self.rings, self.bits = heights, rings, bits
        self.width, self.growth, self.thickness = opaque(width), opaque(growth), opaque(thickness)
        self.bits_z = int(np.clip(math.ceil(math.log2(depth / thickness + 1)), 2, 8))

    def of_shots(self, heights: SurfaceHeights, wider: float, bits: int) -> WaterGrid:
        """Return the grid of shots with heights of their own, cells wider by a factor, and buckets for each shot."""
        grid = copy.copy(self)
        grid.heights, grid.width, grid.bits = heights, self.width * opaque(wider), bits
        return grid

    @property
    def bits_ring(self) -> int:
        """Bits of the number of the ring in that of the bucket."""
        return (self.bits - self.bits_z) // 2

    @property
    def bits_sector(self) -> int:
        """Bits of the number of the sector in that of the bucket."""
        return self.bits - self.bits_z - self.bits_ring

    def widths(self, depth: mi.Float) -> mi.Float:
        """Return the widths of rings over the core radius at a depth [m]."""
        return self.width * dr.minimum(dr.fma(depth, self.growth, 1), _MOST_GROWTH)

    def volume(self, point: mi.Point3f, depth: mi.Float) -> mi.Float:
        """Return the approximate volume of the cells at points at a depth, a smooth function [m^3]."""
        along, across = self.rings.offset(point.x, point.y, depth)
        scale = dr.square(self.rings.core(depth)) + along * along + across * across
        return self.thickness * dr.square(self.widths(depth)) * scale / self.rings.cosine

    def cells(self, shift: mi.Point3f) -> WaterCells:
        """Return the cells of a pass, shifted by three uniform random numbers of each shot."""
        return WaterCells(self, shift)


class WaterCells:
    """The cells of one pass: a `WaterGrid` shifted by three uniform random numbers of each shot."""

    def __init__(self, grid: WaterGrid, shift: mi.Point3f) -> None:
        self.grid, self.heights = grid, grid.heights
        self._shift = mi.Point2f(shift.x, shift.y)
        # Thickness of the uppermost layer.
        self._top = grid.thickness * (0.5 + shift.z)
        self._start = mi.UInt32(0)

    def of(self, lanes: Lanes) -> WaterCells:
        """Return the cells of each lane's shot."""
        if lanes.shots == 1:
            return self
        cells = copy.copy(self)
        cells.heights = self.heights.of(lanes)
        cells._shift, cells._top = lanes.pick(self._shift), lanes.pick(self._top)
        cells._start = lanes.shot << self.grid.bits
        return cells

    def typical_volume(self, point: mi.Point3f) -> mi.Float:
        """Return the approximate volume of cells at points, a smooth function, for the weights of merges [m^3]."""
        height, _ = self.heights.at(point.x, point.y)
        return self.grid.volume(point, dr.maximum(height - point.z, 0))

    def locate(self, point: mi.Point3f) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Return bucket, tag and volume [m^3] of the cells of points; cells of one bucket differ in tag."""
        grid, rings = self.grid, self.grid.rings
        height, bed = self.heights.at(point.x, point.y)
        depth, end = height - point.z, height - bed
        # The table of heights is approximate: points above it are just below the surface.
        layer = dr.maximum(dr.floor((depth - self._top) * (1 / grid.thickness)) + 1, 0)
        # A part of a cell above a solid that is less than half as thick belongs to the cell above.
        lowest = dr.maximum(dr.floor((end - self._top) * (1 / grid.thickness) - 0.5) + 1, 0)
        is_lowest = (layer >= lowest) & (depth < end + 0.5 * grid.thickness)
        layer = dr.select(is_lowest, lowest, layer)
        along, across = rings.offset(point.x, point.y, depth)
        upper = layer * grid.thickness
        sector = rings.sector(along, across, rings.core(upper), grid.widths(upper), self._shift)
        i, j, k = sector.ring, sector.number, mi.UInt32(layer)
        of_ring, of_sector, z = grid.bits_ring, grid.bits_sector, grid.bits_z
        bucket = (
            low_bits(j, of_sector) | (low_bits(i, of_ring) << of_sector) | (low_bits(k, z) << (of_sector + of_ring))
        )
        tag = low_bits(i >> of_ring, 12) | (low_bits(j >> of_sector, 12) << 12) | (low_bits(k >> z, 8) << 24)
        above = dr.select(k == 0, 0, self._top + (layer - 1) * grid.thickness)
        below = dr.select(is_lowest, end, self._top + layer * grid.thickness)
        thickness = dr.maximum(below - above, 0.25 * grid.thickness)
        return self._start + bucket, tag, thickness * rings.area(sector)


def low_bits(number: mi.UInt32, bits: int) -> mi.UInt32:
    """Return the lowest bits of a number."""
    return number & ((1 << bits) - 1)
