"""Cells of water and patches of solids in which light from the laser meets paths from the receiver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import is_one_of, opaque
from mitransient_lidar.transport.pose import Pose
from mitransient_lidar.transport.receiving import ViewSampler
from mitransient_lidar.transport.streams import pass_streams, unit_points
from mitransient_lidar.transport.system import LidarScene

#: Texels a side of the table of surface heights.
_HEIGHT_TEXELS = 512

#: Rays that find the region, and what lies below it.
_RAYS = 4096

#: Share of rays that may fall outside the lit and seen region on either side, and by how much it is widened.
_REGION_TAIL, _REGION_MARGIN = 0.002, 0.15

#: Logarithms to base 2 of the numbers of buckets of water cells and of patches, along one side.
_WATER_BITS, _PATCH_BITS = 20, 9

#: Height of the floors into which patches of bounded solids are cut, in widths of a patch.
_FLOOR_WIDTHS = 8

#: Surfaces that a vertical ray may meet where levels of one solid are looked for.
_MOST_LEVELS = 8

#: A patch that is filled less than once in this many tries is a sliver that rounding may hide for ever.
_MOST_TRIES = 1000

#: Added to cell numbers so that they are positive.
_ORIGIN = 1 << 20


@dataclass(frozen=True)
class Region:
    """Rectangle of the mean sea level that is lit or seen: corners (x, y) [m]."""

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def of_system(cls, system: LidarScene, view: ViewSampler) -> Region:
        """Find it with rays of the beam and of the field of view."""
        seen = view.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
        tangent = system.transmitter.sample_tangent(unit_points(_RAYS))
        beam = system.transmitter.pose.direction(*tangent)
        places = [
            _at_sea_level(system.receiver.pose, np.array(seen.direction).T[np.array(seen.weight) > 0]),
            _at_sea_level(system.transmitter.pose, np.array(beam).T),
        ]
        ends = [np.quantile(place, [_REGION_TAIL, 1 - _REGION_TAIL], axis=0) for place in places if len(place)]
        low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
        margin = _REGION_MARGIN * (high - low)
        x, y = zip((low - margin).tolist(), (high + margin).tolist(), strict=True)
        return cls((x[0], y[0]), (x[1], y[1]))

    @property
    def size(self) -> tuple[float, float]:
        """Sides along x and y [m]."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def track_length(self, system: LidarScene) -> float:
        """Return how far light goes in the water until it meets a solid, or until its echo comes after the record [m].

        The mean over rays along the refracted axis.
        """
        transmitter, receiver = system.transmitter.pose, system.receiver.pose
        spot = transmitter.ground_point()
        sine = transmitter.axis[:2] / system.refractive_index
        down = np.append(sine, -np.sqrt(1 - sine @ sine))
        air = sum(float(np.linalg.norm(spot - pose.origin)) for pose in (transmitter, receiver))
        longest = (system.film.path_end - air) / (2 * system.group_index)
        u = unit_points(_RAYS)
        x, y = (
            dr.lerp(opaque(low), opaque(high), part) for low, high, part in zip(self.low, self.high, u, strict=True)
        )
        lowest = min(float(surface.bbox().min.z) for surface in system.surfaces)
        si = system.scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, opaque(lowest - 1e-3)), mi.Vector3f(down.tolist())))
        length = dr.mean(dr.minimum(dr.select(si.is_valid(), si.t, dr.inf), max(longest, 0.1)))
        return float(length[0])

    def within(self, box: mi.ScalarBoundingBox3f) -> bool:
        """Return whether a bounding box covers the region with as much room on every side as the region is wide."""
        return all(
            float(box.min[axis]) < self.low[axis] - self.size[axis]
            and float(box.max[axis]) > self.high[axis] + self.size[axis]
            for axis in (0, 1)
        )


def _at_sea_level(pose: Pose, directions: np.ndarray) -> np.ndarray:
    """Return where rays from a pose meet z = 0 (x, y) [m]; those that do not are left out."""
    down = directions[directions[:, 2] < 0]
    return np.asarray(pose.origin[:2] - down[:, :2] * (pose.origin[2] / down[:, 2:]))


class SurfaceHeights:
    """Height of the sea surface over a region, as a table."""

    def __init__(self, system: LidarScene, region: Region) -> None:
        n = _HEIGHT_TEXELS
        self._low = [opaque(low) for low in region.low]
        self._per_metre = [opaque(n / size) for size in region.size]
        index = dr.arange(mi.UInt32, n * n)
        x = (mi.Float(index % n) + 0.5) / self._per_metre[0] + self._low[0]
        y = (mi.Float(index // n) + 0.5) / self._per_metre[1] + self._low[1]
        top = opaque(max(float(surface.bbox().max.z) for surface in system.surfaces) + 1.0)

        def look_down(ray: mi.Ray3f, height: mi.Float, active: mi.Bool) -> tuple[mi.Ray3f, mi.Float, mi.Bool]:
            si = system.scene.ray_intersect(ray, active)
            at_sea = si.is_valid() & system.is_surface(si.shape)
            height = dr.select(active & at_sea, si.p.z, height)
            # Something floats or stands above the sea: look on beneath it.
            active &= si.is_valid() & ~at_sea
            return dr.select(active, si.spawn_ray(ray.d), ray), height, active

        state = (
            mi.Ray3f(mi.Point3f(x, y, top), mi.Vector3f(0, 0, -1)),
            dr.zeros(mi.Float, n * n),
            dr.full(mi.Bool, True, n * n),
        )
        _, self._height, _ = dr.while_loop(state, lambda ray, height, active: active, look_down, label="heights")
        dr.eval(self._height)

    def at(self, x: mi.Float, y: mi.Float) -> mi.Float:
        """Return the height at (x, y) [m], outside the region that of its nearest point."""
        i = dr.clip(mi.Int32((x - self._low[0]) * self._per_metre[0]), 0, _HEIGHT_TEXELS - 1)
        j = dr.clip(mi.Int32((y - self._low[1]) * self._per_metre[1]), 0, _HEIGHT_TEXELS - 1)
        return dr.gather(mi.Float, self._height, mi.UInt32(j * _HEIGHT_TEXELS + i))


class WaterGrid:
    """Layout of cells that follow the sea surface and lean along the refracted beam.

    Cells are squares in the horizontal, and layers of the depth below the surface above them. They lean as the beam
    does in still water, so that light which runs along the beam stays in one column of cells. As they begin at the
    surface, none is cut by it.

    Parameters
    ----------
    system
        The lidar scene.
    heights
        Heights of its surface.
    width, thickness
        Horizontal side of a cell at the surface, and its depth [m].
    growth
        Growth of the width with depth [m/m]: light patterns of the waves blur with depth.
    depth
        Depth for which different layers should have different buckets [m].
    """

    def __init__(
        self,
        system: LidarScene,
        heights: SurfaceHeights,
        width: float,
        growth: float,
        thickness: float,
        depth: float,
    ) -> None:
        self.heights = heights
        self.width, self.growth, self.thickness = opaque(width), opaque(growth), opaque(thickness)
        sine = system.transmitter.pose.axis[:2] / system.refractive_index
        self.lean = (sine / np.sqrt(1 - sine @ sine)).tolist()
        self.bits_z = int(np.clip(math.ceil(math.log2(depth / thickness + 1)), 2, 8))
        self.bits_xy = (_WATER_BITS - self.bits_z) // 2

    @property
    def buckets(self) -> int:
        """Number of buckets."""
        return 1 << (2 * self.bits_xy + self.bits_z)


class WaterCells:
    """The cells of one pass: a `WaterGrid` shifted at random.

    Parameters
    ----------
    grid
        The layout.
    shift
        Three uniform random numbers. The uppermost layer is between half and one and a half layers thick.
    """

    def __init__(self, grid: WaterGrid, shift: mi.Point3f) -> None:
        self.grid = grid
        self._shift = mi.Point2f(shift.x, shift.y)
        self._top = grid.thickness * (0.5 + shift.z)

    def locate(self, point: mi.Point3f) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Return bucket, tag and volume [m^3] of the cell that holds a point; cells of a bucket differ in tag."""
        grid = self.grid
        depth = grid.heights.at(point.x, point.y) - point.z
        # The table of heights is a little off here and there: what it places above the surface is just below.
        layer = dr.maximum(dr.floor((depth - self._top) * (1 / grid.thickness)) + 1, 0)
        width = dr.fma(layer, grid.growth * grid.thickness, grid.width)
        u = (point.x - grid.lean[0] * depth) / width + self._shift.x
        v = (point.y - grid.lean[1] * depth) / width + self._shift.y
        i, j = mi.UInt32(mi.Int32(dr.floor(u)) + _ORIGIN), mi.UInt32(mi.Int32(dr.floor(v)) + _ORIGIN)
        k = mi.UInt32(layer)
        xy, z = grid.bits_xy, grid.bits_z
        bucket = _low_bits(i, xy) | (_low_bits(j, xy) << xy) | (_low_bits(k, z) << (2 * xy))
        tag = _low_bits(i >> xy, 12) | (_low_bits(j >> xy, 12) << 12) | (_low_bits(k >> z, 8) << 24)
        thickness = dr.select(k == 0, self._top, grid.thickness)
        return bucket, tag, thickness * width * width


@dataclass(frozen=True)
class Patch:
    """Piece of a solid's surface.

    Attributes
    ----------
    bucket, tag
        Where its photons are; patches of one bucket differ in tag.
    area
        Area of the surface over the square that the patch fills in projection, if it fills it [m^2].
    corner
        Corner of that square, and height over it, in the coordinates (u, v, w) of the projection [m].
    axis
        Axis of the projection: 0, 1 or 2 for x, y or z.
    faces
        Sign of the normal's component along that axis.
    """

    bucket: mi.UInt32
    tag: mi.UInt32
    area: mi.Float
    corner: mi.Point3f
    axis: mi.UInt32
    faces: mi.Float


def solids_of_several_levels(system: LidarScene, region: Region) -> list[mi.Shape]:
    """Return solids of which one part lies above another somewhere in the region, found with vertical rays."""
    u = unit_points(_RAYS)
    x, y = (
        dr.lerp(opaque(low), opaque(high), part) for low, high, part in zip(region.low, region.high, u, strict=True)
    )
    top = max((float(shape.bbox().max.z) for shape in system.scene.shapes()), default=0.0)
    ray = mi.Ray3f(mi.Point3f(x, y, opaque(top + 1.0)), mi.Vector3f(0, 0, -1))
    looking = dr.full(mi.Bool, True, _RAYS)
    met = [mi.UInt32(0) for _ in system.solids]
    for _ in range(_MOST_LEVELS):
        si = system.scene.ray_intersect(ray, looking)
        looking &= si.is_valid()
        for i, solid in enumerate(system.solids):
            met[i] += dr.select(looking & (si.shape == mi.ShapePtr(solid)), mi.UInt32(1), 0)
        ray = si.spawn_ray(ray.d)
    return [solid for solid, count in zip(system.solids, met, strict=True) if bool(dr.any(count > 1)[0])]


class SolidPatches:
    """The patches of one pass: squares seen along the axis that is nearest to the normal, shifted at random.

    Parameters
    ----------
    system
        The lidar scene.
    region
        What is lit or seen.
    width
        Side of a square [m].
    shift
        Two uniform random numbers.
    uneven
        What `solids_of_several_levels` has found.
    """

    #: Number of buckets.
    buckets = 1 << (2 * _PATCH_BITS)

    def __init__(
        self,
        system: LidarScene,
        region: Region,
        width: float,
        shift: mi.Point2f,
        uneven: Sequence[mi.Shape] = (),
    ) -> None:
        self.system = system
        self.width = opaque(width)
        self._shift = shift
        self._bounded = [
            solid
            for solid in system.solids
            if not region.within(solid.bbox()) or any(solid is other for other in uneven)
        ]

    def locate(self, si: mi.SurfaceInteraction3f) -> Patch:
        """Return the patch that holds a point of a solid."""
        size = dr.abs(si.n)
        along_x = (size.x > size.y) & (size.x > size.z)
        along_y = ~along_x & (size.y > size.z)
        axis = dr.select(along_x, mi.UInt32(0), dr.select(along_y, mi.UInt32(1), mi.UInt32(2)))
        normal = dr.select(along_x, si.n.x, dr.select(along_y, si.n.y, si.n.z))
        u = dr.select(along_x, si.p.y, si.p.x)
        v = dr.select(along_x | along_y, si.p.z, si.p.y)
        w = dr.select(along_x, si.p.x, dr.select(along_y, si.p.y, si.p.z))
        cu, cv = dr.floor(u / self.width + self._shift.x), dr.floor(v / self.width + self._shift.y)
        i, j = mi.UInt32(mi.Int32(cu) + _ORIGIN), mi.UInt32(mi.Int32(cv) + _ORIGIN)
        bits = _PATCH_BITS
        side = 2 * axis + dr.select(normal > 0, mi.UInt32(1), 0)
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        # Solids with overhangs have several floors over one square.
        floor = mi.UInt32(mi.Int32(dr.floor(w / (_FLOOR_WIDTHS * self.width))) + _ORIGIN)
        floor = dr.select(self._is_bounded(si.shape), floor, 0)
        return Patch(
            bucket=_low_bits(i, bits) | (_low_bits(j, bits) << bits),
            tag=_low_bits(i >> bits, 6)
            | (_low_bits(j >> bits, 6) << 6)
            | (_low_bits(floor, 8) << 12)
            | (side << 20)
            | (_low_bits(shape, 9) << 23),
            area=self.width * self.width / dr.abs(normal),
            corner=mi.Point3f((cu - self._shift.x) * self.width, (cv - self._shift.y) * self.width, w),
            axis=axis,
            faces=dr.sign(normal),
        )

    def _is_bounded(self, shape: mi.ShapePtr) -> mi.Bool:
        """Return whether a solid may end inside the region."""
        return is_one_of(shape, self._bounded)

    def inverse_share(self, patch: Patch, shape: mi.ShapePtr, rng: mi.PCG32, active: mi.Bool) -> mi.Float:
        """Return an estimate of 1 / (share of the patch's square that the solid fills): edges cut some patches.

        The number of random points in the square until one has the patch beneath it has that mean (Booth 2007,
        doi:10.1080/2151237X.2007.10129248).
        """
        if not self._bounded:
            return mi.Float(1)
        reach = 2 * self.width

        def look(tries: mi.Float, rng: mi.PCG32, looking: mi.Bool) -> tuple[mi.Float, mi.PCG32, mi.Bool]:
            u = patch.corner.x + self.width * rng.next_float32()
            v = patch.corner.y + self.width * rng.next_float32()
            w = patch.corner.z + reach * patch.faces
            is_x, is_y = patch.axis == 0, patch.axis == 1
            origin = mi.Point3f(
                dr.select(is_x, w, u), dr.select(is_x, u, dr.select(is_y, w, v)), dr.select(is_x | is_y, v, w)
            )
            down = mi.Vector3f(
                dr.select(is_x, -patch.faces, 0),
                dr.select(is_y, -patch.faces, 0),
                dr.select(is_x | is_y, 0, -patch.faces),
            )
            ray = mi.Ray3f(origin, down)
            ray.maxt = 2 * reach
            si = self.system.scene.ray_intersect(ray, looking)
            found = si.is_valid() & (self.locate(si).tag == patch.tag)
            looking &= ~found & (tries < _MOST_TRIES)
            return tries + dr.select(looking, mi.Float(1), 0), rng, looking

        state = mi.Float(1), mi.PCG32(rng), active & self._is_bounded(shape)
        tries, advanced, _ = dr.while_loop(state, lambda tries, rng, looking: looking, look, label="share of the patch")
        rng.state = advanced.state
        return tries


def _low_bits(number: mi.UInt32, bits: int) -> mi.UInt32:
    return number & ((1 << bits) - 1)
