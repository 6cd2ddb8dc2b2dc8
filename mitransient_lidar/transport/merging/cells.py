"""Cells of water in which light from the laser is merged with paths from the receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.merging.region import SurfaceHeights
from mitransient_lidar.transport.merging.rings import BeamRings
from mitransient_lidar.transport.opaque import changed, opaque, opaque_point
from mitransient_lidar.transport.rng import starts
from mitransient_lidar.transport.scene import LidarScene

MOST_BUCKET_BITS = 20  #: Base-2 logarithm of the largest number of buckets per shot.
_MOST_GROWTH = 4.0  #: Largest growth of cell width with depth.

#: Growth of layer thickness with depth, up to the final one: facets focus light in patterns that change with depth, and
#: twice this growth loses 3 % of the column below 15 cm waves.
_THICKNESS_PER_DEPTH = 0.25

_LEAST_THICKNESS = 0.01  #: Least thickness of the uppermost layer, over the final one.
_LEAST_DESCENT = 0.5  #: Least vertical component of the directions along which points move to their layer's plane.

#: Least thickness of a cell that a solid cuts relative to a whole one, and in water that is no deeper than one cell.
_LEAST_CUT, _LEAST_WEDGE = 0.25, 0.01

#: Steps to the surface above a point along the beam, and least volume below a slope over that below level water.
_SURFACE_STEPS, _LEAST_STRETCH = 2, 0.1

_LEAST_SLOPE = 1e-9  #: Least sea slope, against division by zero.

#: Halo of the unscattered light's profile relative to its core, and squared distance from the axis, in standard
#: deviations, that parts both.
_HALO, _SQUARES_INSIDE = 0.02, 25.0

#: Step of the planes' places from one layer to the next, which distributes them evenly: the golden ratio.
_PLANE_STEP = 0.618034

ORIGIN = 1 << 20  #: Added to cell numbers so that they are positive.


@dataclass(frozen=True)
class Cell:
    """Cells that contain points."""

    #: Bucket number, and the tag that tells its cells apart.
    bucket: mi.UInt32
    tag: mi.UInt32
    #: Volume [m^3], and the volume that divides unscattered light.
    volume: mi.Float
    volume_of_unscattered: mi.Float


class RefractedProfile:
    """Approximate profile of the beam's unscattered light: a Gaussian function that ripples widen, and a halo.

    `spreads`: standard deviations of the beam on the sea along and across its azimuth, both normal to the axis [m].
    """

    def __init__(self, scene: LidarScene, spreads: tuple[float, float]) -> None:
        index, down = scene.refractive_index, max(-float(scene.transmitter.pose.axis[2]), _LEAST_DESCENT)
        cosine = math.sqrt(1 - (1 - down * down) / index**2)
        # The direction in water turns by so much for each radian by which the surface tilts.
        turn = max(abs(1 - down / (index * cosine)), _LEAST_SLOPE)
        # Displacement per metre of depth and unit slope, along and across the beam's azimuth, with the scale of
        # `BeamRings.offset`.
        shifts = turn / cosine**2 * down, turn / cosine
        ripples = 0.5 * max((sum(sea.sea.ripple_variance) for sea in scene.seas), default=0.0)
        self._own = [(spread, shift * math.sqrt(ripples)) for spread, shift in zip(spreads, shifts, strict=True)]
        self._spreads, self._shifts = ([opaque(value) for value in values] for values in (spreads, shifts))
        self._growths = [opaque(growth) for _, growth in self._own]
        #: Depth at which the sea's slopes double the variance [m].
        slopes = max(math.sqrt(0.5 * scene.slope_variance), _LEAST_SLOPE)
        self.depth = min(spread / (shift * slopes) for spread, shift in zip(spreads, shifts, strict=True))
        #: Displacement per metre of depth by facet slopes.
        of_facets = max(0.5 * scene.slope_variance - ripples, 0.0)
        self.shift_by_facets = max(max(shifts) * math.sqrt(of_facets), _LEAST_SLOPE)

    @classmethod
    def of_scene(cls, scene: LidarScene, footprint: float) -> RefractedProfile:
        """Return the beam profile in a scene, from its standard deviation on the sea [m]."""
        beam = scene.transmitter.profile
        squares = np.square([np.cos(beam.rotation), np.sin(beam.rotation)])
        spreads = np.sqrt([squares @ np.square(beam.spreads), squares[::-1] @ np.square(beam.spreads)])
        along, across = (spreads * footprint / scene.transmitter.angular_spread).tolist()
        return cls(scene, (along, across))

    def growth(self, most: float) -> float:
        """Return how much ripples widen the beam's light or, if less, a deviation `most`, per metre."""
        return min(growth / min(spread, most) for spread, growth in self._own)

    @property
    def blur(self) -> float:
        """Standard deviation by which ripples displace light per metre of depth, the larger of both axes."""
        return max(growth for _, growth in self._own)

    def _axes(
        self, offset: tuple[mi.Float, mi.Float], depth: mi.Float, slopes: tuple[mi.Float, mi.Float]
    ) -> list[tuple[mi.Float, mi.Float]]:
        """Return offset from the refracted axis, and standard deviation [m], along and across it."""
        axes = zip(self._spreads, self._shifts, self._growths, offset, slopes, strict=True)
        return [
            (place - shift * slope * depth, dr.sqrt(dr.square(spread) + dr.square(growth * depth)))
            for spread, shift, growth, place, slope in axes
        ]

    def at(self, offset: tuple[mi.Float, mi.Float], depth: mi.Float, slopes: tuple[mi.Float, mi.Float]) -> mi.Float:
        """Return the light at offsets from the axis and a depth [m], under slopes along and across it, unscaled."""
        (along, long), (across, wide) = self._axes(offset, depth, slopes)
        squares = dr.square(along / long) + dr.square(across / wide)
        return dr.fma(_HALO, dr.rcp(1 + squares), dr.exp(-0.5 * squares)) / (long * wide)

    def spread(
        self, offset: tuple[mi.Float, mi.Float], depth: mi.Float, other: mi.Float, slopes: tuple[mi.Float, mi.Float]
    ) -> tuple[mi.Float, mi.Float]:
        """Return by how much offsets grow from a depth to another one as the beam does, close to its axis [m]."""
        here, there = (self._axes(offset, each, slopes) for each in (depth, other))
        squares = sum(dr.square(place / spread) for place, spread in here)
        inside = dr.rcp(1 + dr.square(squares / _SQUARES_INSIDE))
        along, across = (
            inside * place * (after / before - 1) for (place, before), (_, after) in zip(here, there, strict=True)
        )
        return along, across


class WaterCells:
    """Cells that follow the sea surface and are arranged about the refracted beam, for a scene or for one pass.

    Cells are ring sectors in layers of the depth below the surface, so that the surface cuts none. The lowest one above
    a solid ends there, and the first one behind a veil begins there. They are sheared along the beam in still water, so
    that its light stays in one column of cells. Within a layer, light is counted on a common plane. A point's look-up
    goes to where its light would cross this plane along the beam, refracted and spread. Narrow beams do not blur,
    however they are refracted.

    `profile`: beam profile, for changes between points and the plane. `width`: horizontal side of a cell on the axis at
    the surface, over the rings' core radius. `growth`: growth of the width with depth [1/m], as the waves' light
    patterns blur with depth. `thickness`, `uppermost`: thickness of a cell, and of the uppermost ones, which may be
    thinner [m]: narrow beams spread fast there. `depth`: depth within which different layers have different buckets
    [m]. `bits`: base-2 logarithm of the number of buckets per shot. `view_growth`, `widening`: further growth with
    depth [1/m], as ripples widen the visible light, for cells that a narrow view limits at the surface; and the largest
    width that it reaches relative to the surface.
    """

    OF_SHOTS = ("heights", "rings", "_shift", "_start")

    def __init__(
        self,
        rings: BeamRings,
        heights: SurfaceHeights,
        profile: RefractedProfile,
        width: float,
        growth: float,
        thickness: float,
        uppermost: float,
        depth: float,
        bits: int = MOST_BUCKET_BITS,
        view_growth: float = 0.0,
        widening: float = 1.0,
    ) -> None:
        self.heights, self.rings, self.profile, self.bits = heights, rings, profile, bits
        self._shift, self._start = mi.Point4f(0), mi.UInt32(0)
        uppermost = min(max(uppermost, _LEAST_THICKNESS * thickness), thickness)
        layers = math.log(thickness / uppermost) / _THICKNESS_PER_DEPTH
        self.width, self.growth, self.thickness = opaque(width), opaque(growth), opaque(thickness)
        self._view_growth, self._widening = opaque(view_growth), opaque(widening)
        # Depth below which layers have their final thickness, and the number of those above it.
        self._even, self._layers = opaque((thickness - uppermost) / _THICKNESS_PER_DEPTH), opaque(layers)
        self._uppermost = opaque(uppermost)
        self.bits_z = int(np.clip(math.ceil(math.log2(layers + depth / thickness + 1)), 2, 8))

    def of_shots(self, heights: SurfaceHeights, rings: BeamRings, wider: float, bits: int) -> WaterCells:
        """Return cells for shots with their own heights and axes.

        Cells are wider by a factor, and there are buckets for each shot.
        """
        return changed(self, heights=heights, rings=rings, width=self.width * opaque(wider), bits=bits)

    def moved(self, heights: SurfaceHeights, rings: BeamRings) -> WaterCells:
        """Return the cells below another sea surface and about other axes."""
        return changed(self, heights=heights, rings=rings)

    def of_even_width(self, wider: float) -> WaterCells:
        """Return the cells of cells that are wider by a factor than those at the surface, at all depths."""
        return changed(self, width=self.width * opaque(wider), growth=opaque(0.0))

    @property
    def bits_ring(self) -> int:
        """Bits for the ring's number in the bucket's number."""
        return (self.bits - self.bits_z) // 2

    @property
    def bits_sector(self) -> int:
        """Bits for the sector's number in the bucket's number."""
        return self.bits - self.bits_z - self.bits_ring

    def widths(self, depth: mi.Float) -> mi.Float:
        """Return the widths of rings over the core radius in layers that begin at a depth [m]."""
        middle = dr.fma(0.5, self.thickness_at(depth), depth)
        width = self.width * dr.minimum(dr.fma(middle, self._view_growth, 1), self._widening)
        return width * dr.minimum(dr.fma(depth, self.growth, 1), _MOST_GROWTH)

    def thickness_at(self, depth: mi.Float) -> mi.Float:
        """Return the layer thickness at a depth of at least 0 [m]."""
        return dr.minimum(dr.fma(depth, _THICKNESS_PER_DEPTH, self._uppermost), self.thickness)

    def layer_at(self, depth: mi.Float) -> mi.Float:
        """Return the number of layers, with fractions, above a depth from 0 up [m]."""
        thin = dr.fma(dr.minimum(depth, self._even), _THICKNESS_PER_DEPTH / self._uppermost, 1)
        return dr.log(thin) / _THICKNESS_PER_DEPTH + dr.maximum(depth - self._even, 0) / self.thickness

    def depth_of(self, layers: mi.Float) -> mi.Float:
        """Return the depth [m] below a number of layers, the inverse of `layer_at`; 0 for negative numbers."""
        layers = dr.maximum(layers, 0)
        thin = dr.exp(dr.minimum(layers, self._layers) * _THICKNESS_PER_DEPTH) - 1
        even = dr.maximum(layers - self._layers, 0) * self.thickness
        return dr.fma(thin, self._uppermost / _THICKNESS_PER_DEPTH, even)

    def sides(self, depths: FloatArray) -> FloatArray:
        """Return the sides of cells [m], rms over the beam, in which light and view meet at depths [m], shape (n,)."""
        depth = mi.Float(depths.astype(np.float32))
        above = dr.maximum(dr.fma(-0.5, self.thickness_at(depth), depth), 0)
        side = self.widths(above) * dr.sqrt(dr.square(self.rings.core(above)) + 2 * dr.square(self.rings.spread))
        return np.asarray(side.numpy(), np.float64)

    def of_pass(self, shift: mi.Point4f) -> WaterCells:
        """Return the cells of a pass, shifted by four uniform random numbers per shot."""
        return changed(self, _shift=shift, _start=starts(dr.width(shift), 1 << self.bits))

    def typical_volume(self, point: mi.Point3f) -> mi.Float:
        """Return the approximate cell volume at points, a smooth function, for merge weights [m^3]."""
        rings = self.rings
        depth = dr.maximum(rings.depth_at(point.z), 0)
        along, across = rings.offset(point.x, point.y, depth)
        scale = dr.square(rings.core(depth)) + along * along + across * across
        return self.thickness_at(depth) * dr.square(self.widths(depth)) * scale / rings.cosine

    def _depth_along_beam(self, point: mi.Point3f) -> tuple[mi.Float, mi.Vector2f, mi.Float]:
        """Return the depth of points below where the beam's direction leads up to the surface [m], and slopes there.

        The last value is the cell volume there relative to below a level surface. It is 1 + s . g with the slope g and
        the beam's horizontal displacement s per metre of depth. Newton's method, exact below a single facet.
        """
        shear = mi.Vector2f(*self.rings.shear)
        depth = dr.maximum(self.rings.depth_at(point.z), 0)
        slope, stretch = mi.Vector2f(0), mi.Float(1)
        for _ in range(_SURFACE_STEPS):
            height, slope = self.heights.surface_at(point.x - shear.x * depth, point.y - shear.y * depth)
            stretch = dr.maximum(1 + dr.dot(shear, slope), _LEAST_STRETCH)
            depth += (height - point.z - depth) / stretch
        return depth, slope, stretch

    def locate(
        self, point: mi.Point3f, direction: mi.Vector3f | None = None, unscattered: mi.Bool | None = None
    ) -> Cell:
        """Return the cells that contain points.

        Points of unscattered light move to their layer's plane along their lines in a `direction`, all others along the
        beam as it is refracted there. The volume for unscattered light represents light at the point. It is corrected
        by the beam profile on the plane divided by the profile at the point.
        """
        rings = self.rings
        depth, slope, stretch = self._depth_along_beam(point)
        line, looks_up = rings.refracted(slope), direction is None
        if not looks_up:
            line = dr.select(unscattered, direction, line)
        end, veiled = dr.maximum(depth + point.z - self.heights.bed_at(point.x, point.y), 0), self.heights.has_veils
        if veiled:
            veil = dr.maximum(depth + point.z - self.heights.veil_at(point.x, point.y), 0)
            behind = depth > veil
            end = dr.select(behind, end, dr.minimum(end, veil))
        # Points above the approximate surface are just below it.
        depth = dr.maximum(depth, 0)
        # The uppermost layer ends here.
        top = 0.5 + self._shift.z
        layer = dr.maximum(dr.floor(self.layer_at(depth) - top) + 1, 0)
        # A part of a cell above a solid that is less than half as thick belongs to the cell above.
        lowest = dr.maximum(dr.floor(self.layer_at(end) - top - 0.5) + 1, 0)
        is_lowest = (layer >= lowest) & (depth < end + 0.5 * self.thickness)
        layer = dr.select(is_lowest, lowest, layer)
        if veiled:
            # Behind a veil cells begin there: the first one has a larger number than those that end there.
            highest = dr.maximum(dr.floor(self.layer_at(veil) - top + 0.5) + 1, 0)
            is_highest = behind & (layer <= highest)
            layer = dr.select(is_highest, highest, layer)
        above = dr.select(layer == 0, 0, self.depth_of(top + (layer - 1)))
        if veiled:
            above = dr.select(is_highest, veil, above)
        below = dr.select(is_lowest, end, self.depth_of(top + layer))
        place = dr.fma(_PLANE_STEP, layer, self._shift.w)
        plane = dr.lerp(above, below, place - dr.floor(place))
        # Change of this depth for each metre along the line, at least so large that level lines stay near.
        descent = (slope.x * line.x + slope.y * line.y - line.z) / stretch
        distance = (plane - depth) / dr.copysign(dr.maximum(dr.abs(descent), _LEAST_DESCENT), descent)
        x, y = dr.fma(distance, line.x, point.x), dr.fma(distance, line.y, point.y)
        moved = dr.fma(distance, descent, depth)
        along, across = rings.offset(x, y, moved)
        # Offsets are from the axis that the mean slope refracts.
        slopes, start = rings.along_and_across(slope - mi.Vector2f(*rings.tilt)), rings.offset(point.x, point.y, depth)
        if looks_up:
            more = self.profile.spread(start, depth, moved, slopes)
            along, across = along + more[0], across + more[1]
        sector = rings.sector(along, across, rings.core(above), self.widths(above), mi.Point2f(self._shift.xy))
        there, here = self.profile.at((along, across), moved, slopes), self.profile.at(start, depth, slopes)
        i, j, k = sector.ring, sector.number, mi.UInt32(layer)
        of_ring, of_sector, z = self.bits_ring, self.bits_sector, self.bits_z
        bucket = (
            low_bits(j, of_sector) | (low_bits(i, of_ring) << of_sector) | (low_bits(k, z) << (of_sector + of_ring))
        )
        tag = low_bits(i >> of_ring, 12) | (low_bits(j >> of_sector, 12) << 12) | (low_bits(k >> z, 8) << 24)
        # Thinner where the bottom rises to the surface, and the cell is the only one.
        least = dr.select(is_lowest & (layer == 0), _LEAST_WEDGE, _LEAST_CUT) * self.thickness_at(above)
        thickness = dr.maximum(below - above, least)
        volume = thickness * stretch * rings.area(sector)
        return Cell(self._start + bucket, tag, volume, volume * there / here)


def low_bits(number: mi.UInt32, bits: int) -> mi.UInt32:
    """Return a number's lowest bits."""
    return number & ((1 << bits) - 1)


#: Angular ring width, over the beam's standard deviation within two of them, and over the angle farther outside.
_RING_PER_SPREAD, _CORE_SPREADS = 0.1, 2.0

_THICKNESS_PER_RADIUS = 0.04  #: Largest thickness of a shell over its radius: the light decreases by its square.

_SMALLEST_RADIUS = 1e-3  #: Smallest shell radius [m].

#: Base-2 logarithm of the number of buckets, and bits for the numbers of ring and sector.
_BUCKET_BITS, _RING_BITS, _SECTOR_BITS = 20, 11, 9


class SphericalCells:
    """Cells about the laser, small where its light is concentrated, for a scene or for one pass.

    Angles from the axis are measured by the tangent of their half, up to the opposite direction. Rings are of equal
    width in asinh(tan(theta / 2) / core). Shells are of equal width in log(r), up to the radius where they have their
    final thickness.

    `scene`: scene with laser and receiver under water. `thickness`: largest shell thickness [m].
    """

    OF_SHOTS = ("_shift", "_start")

    #: Base-2 logarithm of the number of buckets per shot.
    bits = _BUCKET_BITS

    def __init__(self, scene: LidarScene, thickness: float) -> None:
        self._shift, self._start = mi.Point4f(0), mi.UInt32(0)
        pose, spread = scene.transmitter.pose, float(scene.transmitter.angular_spread)
        self.origin = opaque_point(pose.origin)
        self.sides = [mi.Vector3f(opaque_point(side)) for side in (pose.far, pose.left, pose.axis)]
        core = min(np.tan(0.5 * _CORE_SPREADS * spread), 1.0)
        self.core, self.ring = opaque(core), opaque(min(0.5 * _RING_PER_SPREAD * spread / core, 0.1))
        self.thickness = opaque(thickness)
        self.even = opaque(thickness / _THICKNESS_PER_RADIUS)

    def of_pass(self, shift: mi.Point4f) -> SphericalCells:
        """Return the cells in a pass, shifted by the first three of four uniform random numbers per shot."""
        return changed(self, _shift=shift, _start=starts(dr.width(shift), 1 << _BUCKET_BITS))

    def typical_volume(self, point: mi.Point3f) -> mi.Float:
        """Return the cell volume [m^3] for the weights of merges, which are rare in small cells."""
        return self.locate(point).volume

    def locate(
        self, point: mi.Point3f, direction: mi.Vector3f | None = None, unscattered: mi.Bool | None = None
    ) -> Cell:
        """Return the cells that contain points; they do not depend on the directions of their lines."""
        offset = point - self.origin
        radius = dr.maximum(dr.norm(offset), _SMALLEST_RADIUS)
        x, y, along = (dr.dot(offset, side) for side in self.sides)
        across = dr.sqrt(x * x + y * y)
        tangent = across / dr.maximum(radius + along, 1e-6 * radius)
        # Rings: the innermost one is a disc.
        ring = dr.floor(dr.asinh(tangent / self.core) / self.ring + self._shift.x)
        inner, outer = (self.core * dr.sinh(dr.maximum(ring + k - self._shift.x, 0) * self.ring) for k in (0, 1))
        sectors = dr.round(np.pi * (outer + inner) / (outer - inner))
        turn = dr.atan2(y, x) * dr.inv_two_pi + 1 + self._shift.y
        sector = dr.minimum(dr.floor((turn - dr.floor(turn)) * sectors), sectors - 1)
        solid_angle = 4 * np.pi * (outer * outer - inner * inner)
        solid_angle /= (1 + inner * inner) * (1 + outer * outer) * sectors
        # Shells.
        shell = dr.floor(self._shell_at(radius) + self._shift.z)
        low, high = (self._radius_of(shell + k - self._shift.z) for k in (0, 1))
        volume = solid_angle * (high - low) * (high * high + high * low + low * low) / 3
        tag = mi.UInt32(mi.Int32(shell) + (1 << 10)) << (_RING_BITS + _SECTOR_BITS)
        tag |= (mi.UInt32(ring) << _SECTOR_BITS) | mi.UInt32(sector)
        # Fibonacci hashing (Knuth 1998, The Art of Computer Programming 3, section 6.4).
        return Cell(self._start + ((tag * 2654435769) >> (32 - _BUCKET_BITS)), tag, volume, volume)

    def _shell_at(self, radius: mi.Float) -> mi.Float:
        """Return the shell coordinate at a radius [m]."""
        ratio = radius / self.even
        return dr.select(ratio < 1, dr.log(ratio), ratio - 1) / _THICKNESS_PER_RADIUS

    def _radius_of(self, shell: mi.Float) -> mi.Float:
        """Return the radius [m] at a shell coordinate."""
        along = shell * _THICKNESS_PER_RADIUS
        return self.even * dr.select(along < 0, dr.exp(along), 1 + along)
