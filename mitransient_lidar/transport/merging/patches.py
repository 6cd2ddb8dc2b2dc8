"""Patches of solids on which light from the laser is merged with paths from the receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import BoolArray
from mitransient_lidar.transport.merging.cells import ORIGIN, low_bits
from mitransient_lidar.transport.merging.region import Region
from mitransient_lidar.transport.merging.rings import BeamRings, RingSector
from mitransient_lidar.transport.opaque import aligned, changed, opaque, opaque_index, shape_number
from mitransient_lidar.transport.paths.refracted_connection import RefractedLaserSampler
from mitransient_lidar.transport.probe import PROBE_RAYS
from mitransient_lidar.transport.rng import Lanes, starts
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import box_of, met_shape

MOST_SIDE_BITS = 9  #: Base-2 logarithm of the largest number of buckets per shot along one side.
_LEVEL_WIDTHS = 8  #: Level height in the patches of bounded solids, over the patch width.

#: Component of a normal along the beam, over the larger horizontal one, below which a surface counts as steep.
_STEEP = 0.3

#: Least foreshortening of surfaces: below it, light is not evened out between points in a patch.
_LEAST_FORESHORTENING = 0.02

_PROBE_RAYS_OF_SHOTS = 512  #: Number of rays at each of several locations that find solids with several levels.

_MOST_LEVELS = 8  #: Largest number of hits per vertical ray in the search for solids with several levels.

#: Distance before a point at which rays to it end [m], and the same over its largest coordinate: half the distance by
#: which coincident faces are moved apart.
_JUST_BEFORE, _JUST_BEFORE_ROUNDING = 5e-5, 2.0**-21

#: Margin of the probes beyond a level, and of their steps beyond a surface, over the level height.
_PROBE_MARGIN = 1e-3

#: Largest patch growth with depth, relative to unscattered light below ripples: in wider ones, narrow beams and views
#: blur.
_MOST_GROWTH = 2.0

#: Largest number of coverage samples: rounding may hide a sliver of a patch from all of them.
_MOST_COVERAGE_SAMPLES = 1000


@dataclass(frozen=True)
class SolidPatch:
    """Piece of a solid's surface."""

    #: Bucket of its photons; patches in one bucket differ in tag.
    bucket: mi.UInt32
    tag: mi.UInt32
    area: mi.Float  #: Surface area over the patch's projection, if it covers all of it [m^2].
    #: Corner of that square, and start of the level over it, in the projection's coordinates (u, v, w) [m]. Along the
    #: beam, w is z.
    corner: mi.Point3f
    height: mi.Float  #: Level height [m].
    sector: RingSector  #: Ring sector that replaces the square in projections along the beam.
    axis: mi.UInt32  #: Projection direction: 0, 1 or 2 for x, y or the beam.
    faces: mi.Float  #: Sign of the normal's component against that direction.
    cosine: mi.Float  #: Size of that component.


def foreshortening(light: mi.Float, projection: mi.Float) -> mi.Float:
    """Return a surface's area across light over its area across its patch's projection, from both cosines.

    The result is at least 0.02. Light is stored divided by this number at its own point, and merged times the number at
    another point in the patch. The light on curved surfaces is then right.
    """
    return dr.maximum(light / projection, _LEAST_FORESHORTENING)


def _just_before(point: mi.Point3f) -> mi.Float:
    """Return the distance from points at which rays to them end [m]."""
    return dr.maximum(_JUST_BEFORE, _JUST_BEFORE_ROUNDING * dr.max(dr.abs(point)))


def solids_of_several_levels(scene: LidarScene, region: Region, shots: int = 1) -> list[mi.Shape]:
    """Return solids with parts above each other, or in the air, in the region of any shot, found with vertical rays."""
    rays = PROBE_RAYS if shots == 1 else _PROBE_RAYS_OF_SHOTS
    lanes = Lanes.of_paths(dr.arange(mi.UInt32, shots * rays), shots, rays)
    scene, (x, y) = lanes.pick(scene.with_parts_of(scene.solids)), region.probe_points(lanes.number)
    top = max((float(shape.bbox().max.z) for shape in scene.mitsuba_scene.shapes()), default=0.0)
    ray = mi.Ray3f(mi.Point3f(x, y, opaque(top + 1.0)), mi.Vector3f(0, 0, -1))
    looking = dr.full(mi.Bool, True, shots * rays)
    lowest, _ = scene.sea_heights or (np.inf, np.inf)
    met, dry = [], mi.UInt32(0)
    for level in range(_MOST_LEVELS):
        si = scene.ray_intersect(ray, looking)
        looking &= si.is_valid()
        met.append(dr.select(looking, dr.reinterpret_array(mi.UInt32, met_shape(si)), 0))
        dry = dr.select(looking & (si.p.z > opaque(lowest)), met[0], 0) if level == 0 else dry
        ray = si.spawn_ray(ray.d)
    dr.eval(met, dry)
    levels = np.sort([np.array(numbers) for numbers in met], axis=0)
    uneven = {*levels[1:][levels[1:] == levels[:-1]].tolist(), *np.unique(np.array(dry)).tolist()}
    return [solid for solid in scene.solids if shape_number(solid) in uneven]


@dataclass(eq=False)
class SolidPatches:
    """Patches in projection along the beam, or along x or y where steep.

    In projection along the refracted beam, patches are sectors of rings about it, whatever their depth. Along x or y
    they are squares. Light from one direction is even over areas across that direction, however curved the surface is
    (`foreshortening`).
    """

    OF_SHOTS = ("scene", "rings", "_shift", "_start")

    scene: LidarScene  #: Scene with the solids.
    region: Region  #: Region that is lit or seen.
    rings: BeamRings  #: Rings about the beam.
    depth: float  #: Depth of the plane in which rings are cut [m], and the largest at which their core is taken.
    width: float  #: Side of a square, and of a sector on the axis at the surface [m].
    uneven: Sequence[mi.Shape] = ()  #: Solids that `solids_of_several_levels` found.
    side_bits: int = MOST_SIDE_BITS  #: Base-2 logarithm of the number of buckets per shot along one side.
    least: float = 0.0  #: Least side of squares, and of sectors on the solids [m].
    #: Growth of unscattered light with depth by ripples [1/m]; None for patches that grow as the rings.
    growth: float | None = None
    widening: float = 1.0  #: Largest further growth with depth of sectors that a narrow view limits at the surface.

    def __post_init__(self) -> None:
        self._shift, self._start = mi.Point2f(0), mi.UInt32(0)
        self._side, self._plane = opaque(max(self.width, self.least)), opaque(self.depth)
        # Sizes suit the light at the middle of a solid.
        solids = self.scene.solids
        numbers = [shape_number(solid) for solid in solids]
        depths = np.zeros(max(numbers, default=0) + 1)
        for number, solid in zip(numbers, solids, strict=True):
            depths[number] = np.clip(-float(solid.bbox().center().z), 0, self.depth)
        core = self.rings.core(mi.Float(0))
        growths = np.hypot(1, (self.growth or 0.0) * depths)
        ring_widths = opaque(self.width) * aligned(mi.Float, np.minimum(growths, self.widening)) / core
        cores = self.rings.core(aligned(mi.Float, depths))
        if self.growth is not None:
            cores = dr.minimum(cores, _MOST_GROWTH * core * aligned(mi.Float, growths))
        cores = dr.maximum(cores, opaque(self.least) / ring_widths)
        # For each solid: core radius, and ring width over it.
        self._sizes = dr.ravel(mi.Point2f(cores, ring_widths))
        # For each solid: whether others may cover it closely, and whether an edge may cut its patches.
        near, cut = np.zeros((2, depths.size), bool)
        near[numbers] = self._near_others(solids)
        cut[numbers] = [
            not self.region.is_below(solid.bbox(), self.scene) or any(solid is other for other in self.uneven)
            for solid in solids
        ]
        # Land and other solids that rise through the sea here shade their surroundings.
        lowest, _ = self.scene.sea_heights or (np.inf, np.inf)
        self._has_shades = any(float(solid.bbox().max.z) > lowest for solid in self.uneven)
        cut[numbers] |= self._has_shades
        self._any_near, self._any_cut = bool(near.any()), bool((near | cut).any())
        self._near, self._cut = (aligned(mi.UInt32, one.astype(np.uint32)) for one in (near, near | cut))

    def of_pass(self, scene: LidarScene, shift: mi.Point2f) -> SolidPatches:
        """Return the patches in a pass over a scene, shifted by two uniform random numbers per shot."""
        return changed(self, scene=scene, _shift=shift, _start=starts(dr.width(shift), self.buckets))

    @property
    def buckets(self) -> int:
        """Number of buckets per shot."""
        return 1 << (2 * self.side_bits)

    def locate(self, si: mi.SurfaceInteraction3f) -> SolidPatch:
        """Return the patches that contain points on solids."""
        axis, normal = self._projection(si)
        along_x, along_y = axis == 0, axis == 1
        u = dr.select(along_x, si.p.y, si.p.x)
        v = dr.select(along_x | along_y, si.p.z, si.p.y)
        w = dr.select(along_x, si.p.x, dr.select(along_y, si.p.y, si.p.z))
        cu, cv = dr.floor(u / self._side + self._shift.x), dr.floor(v / self._side + self._shift.y)
        i, j = mi.UInt32(mi.Int32(cu) + ORIGIN), mi.UInt32(mi.Int32(cv) + ORIGIN)
        along, across, (core, ring_width) = self._offset(si)
        sector = self.rings.sector(along, across, core, ring_width, self._shift)
        level_patch = axis == 2
        i, j = dr.select(level_patch, sector.ring, i), dr.select(level_patch, sector.number, j)
        projected = dr.select(level_patch, self.rings.area(sector), self._side * self._side)
        bits = self.side_bits
        side = 2 * axis + dr.select(normal > 0, mi.UInt32(1), 0)
        shape = dr.reinterpret_array(mi.UInt32, met_shape(si))
        # Solids with overhangs have several levels over one square. Sectors far from the beam are wide, and so high.
        height = _LEVEL_WIDTHS * dr.select(level_patch, sector.outer - sector.inner, self._side)
        start = dr.floor(w / height + self._shift.x)
        level = dr.select(self._is(self._cut, met_shape(si)), mi.UInt32(mi.Int32(start) + ORIGIN), 0)
        corner = mi.Point3f(
            (cu - self._shift.x) * self._side, (cv - self._shift.y) * self._side, (start - self._shift.x) * height
        )
        faces = dr.sign(normal)
        hidden = self._is_hidden(si, axis, faces, height)
        return SolidPatch(
            bucket=self._start + (low_bits(i, bits) | (low_bits(j, bits) << bits)),
            tag=low_bits(i >> bits, 6)
            | (low_bits(j >> bits, 6) << 6)
            | (low_bits(level, 7) << 12)
            | dr.select(hidden, mi.UInt32(1 << 19), 0)
            | (side << 20)
            | (low_bits(shape, 9) << 23),
            area=projected / dr.abs(normal),
            cosine=dr.abs(normal),
            corner=corner,
            height=height,
            sector=sector,
            axis=axis,
            faces=faces,
        )

    def typical_area(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """Return the approximate area of the patches at points on solids, a smooth function on each face [m^2]."""
        axis, normal = self._projection(si)
        along, across, (core, ring_width) = self._offset(si)
        scale = dr.square(core) + along * along + across * across
        sector = dr.square(ring_width) * scale / self.rings.cosine
        return dr.select(axis == 2, sector, self._side * self._side) / dr.abs(normal)

    def cosine(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """Return the size of the normal's component against the projection at points on solids."""
        return dr.abs(self._projection(si)[1])

    def _projection(self, si: mi.SurfaceInteraction3f) -> tuple[mi.UInt32, mi.Float]:
        """Return the direction of projection at points on solids, and the normal's component against it."""
        x, y = self.rings.slant
        against = si.n.z - x * si.n.x - y * si.n.y
        size = mi.Vector3f(dr.abs(si.n.x), dr.abs(si.n.y), dr.abs(against) * dr.rsqrt(1 + x * x + y * y))
        along_x = (size.x > size.y) & (_STEEP * size.x > size.z)
        along_y = (size.x <= size.y) & (_STEEP * size.y > size.z)
        axis = dr.select(along_x, mi.UInt32(0), dr.select(along_y, mi.UInt32(1), mi.UInt32(2)))
        return axis, dr.select(along_x, si.n.x, dr.select(along_y, si.n.y, against))

    def _offset(self, si: mi.SurfaceInteraction3f) -> tuple[mi.Float, mi.Float, mi.Point2f]:
        """Return offsets from the beam to points on solids [m], and their solid's core radius [m] and ring width."""
        x, y = self.rings.slant
        below = -si.p.z - self._plane
        along, across = self.rings.offset(si.p.x - x * below, si.p.y - y * below, self.rings.depth_at(-self._plane))
        return along, across, dr.gather(mi.Point2f, self._sizes, self._number(met_shape(si)))

    def _number(self, shape: mi.ShapePtr) -> mi.UInt32:
        """Return the solids' numbers; one of them for other shapes."""
        return dr.minimum(dr.reinterpret_array(mi.UInt32, shape), opaque_index(dr.width(self._near) - 1))

    def _is(self, marks: mi.UInt32, shape: mi.ShapePtr) -> mi.Bool:
        """Return whether solids have a mark."""
        return dr.gather(mi.UInt32, marks, self._number(shape)) > 0

    def _near_others(self, solids: Sequence[mi.Shape]) -> BoolArray:
        """Return which solids others may cover closely: boxes about both are less than a level apart."""
        boxes = np.reshape([box_of(solid) for solid in solids], (-1, 2, 3))
        distance = 0.5 * _LEVEL_WIDTHS * max(self.width * self.widening, self.least)
        low, high = boxes[:, 0] - distance, boxes[:, 1] + distance
        meets = np.all((low[:, None] < high) & (low < high[:, None]), axis=-1)
        return np.asarray(meets.sum(axis=0) > 1)

    def _is_hidden(self, si: mi.SurfaceInteraction3f, axis: mi.UInt32, faces: mi.Float, height: mi.Float) -> mi.Bool:
        """Return whether another solid lies before points, in projection, within the height of a level [m].

        Light that such a solid stops is not spread over hidden parts, nor over shades of solids that rise through the
        sea.
        """
        shaded = (axis == 2) & self._is_shaded(si) if self._has_shades else mi.Bool(False)
        if not self._any_near:
            return shaded
        inwards = self._inwards(axis, faces)
        ray = mi.Ray3f(si.p - inwards * height, inwards)
        ray.maxt = height - _just_before(si.p)
        before = self.scene.ray_intersect(ray, self._is(self._near, met_shape(si)) & (ray.maxt > 0))
        return shaded | (before.is_valid() & ~self.scene.is_surface(before.shape))

    def _is_shaded(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Return whether a solid stands between points and the laser, which they see through a level sea."""
        scene, valid = self.scene, si.is_valid()
        laser = RefractedLaserSampler(scene).direction_from(si.p)
        above = scene.ray_intersect(scene.spawn_ray(si, laser.in_water), valid)
        at_sea = above.is_valid() & scene.is_surface(above.shape)
        in_air = scene.ray_test(scene.spawn_ray(above, laser.in_air), at_sea)
        return (above.is_valid() & ~at_sea) | in_air

    def _is_wet(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Return whether points on solids lie below the sea surface, as all places of light on patches."""
        lowest, highest = self.scene.sea_heights or (np.inf, np.inf)
        if self.scene.empty_heights[0] <= lowest:
            return mi.Bool(True)
        near = active & si.is_valid() & (si.p.z > opaque(lowest))
        above = self.scene.ray_intersect(
            self.scene.spawn_ray(si, mi.Vector3f(0, 0, 1)), near & (si.p.z < opaque(highest))
        )
        return ~near | (above.is_valid() & self.scene.is_surface(above.shape))

    def _inwards(self, axis: mi.UInt32, faces: mi.Float) -> mi.Vector3f:
        """Return the direction of a projection towards faces, with length 1 along x, y or z."""
        x, y = self.rings.slant
        is_x, is_y, is_z = (axis == number for number in range(3))
        return -faces * mi.Vector3f(
            dr.select(is_x, 1, dr.select(is_z, -x, 0)),
            dr.select(is_y, 1, dr.select(is_z, -y, 0)),
            dr.select(is_z, 1, 0),
        )

    def inverse_share(self, patch: SolidPatch, shape: mi.ShapePtr, rng: mi.PCG32, active: mi.Bool) -> mi.Float:
        """Return an estimate of 1 / (covered share of the patch's square), for patches cut by edges.

        The mean number of random points in the square up to the first one on the patch (Booth 2007, Nucl. Sci. Eng.
        156, 403).
        """
        if not self._any_cut:
            return mi.Float(1)
        margin = _PROBE_MARGIN * patch.height
        # From the side that the patch faces to the other side of its level.
        first = patch.corner.z - margin + dr.select(patch.faces > 0, patch.height + 2 * margin, 0)
        is_x, is_y, is_z = (patch.axis == axis for axis in range(3))
        slant = mi.Vector2f(*self.rings.slant)
        inwards = self._inwards(patch.axis, patch.faces)

        def probe(
            samples: mi.Float, rng: mi.PCG32, searching: mi.Bool, uvw: mi.Point3f, fresh: mi.Bool
        ) -> tuple[mi.Float, mi.PCG32, mi.Bool, mi.Point3f, mi.Bool]:
            along, across = rng.next_float32(fresh), rng.next_float32(fresh)
            u, v = patch.corner.x + self._side * along, patch.corner.y + self._side * across
            drawn = self.rings.draw(patch.sector, self._shift, along, across)
            x, y = self.rings.point(*drawn, self.rings.depth_at(-self._plane))
            uvw = dr.select(fresh, mi.Point3f(dr.select(is_z, x, u), dr.select(is_z, y, v), first), uvw)
            u, v, w = uvw
            below = dr.select(is_z, -w - self._plane, 0)
            u, v = u + slant.x * below, v + slant.y * below
            origin = mi.Point3f(dr.select(is_x, w, u), dr.select(is_x, u, dr.select(is_y, w, v)), dr.select(is_z, w, v))
            ray = mi.Ray3f(origin, inwards)
            ray.maxt = patch.height + 2 * margin - dr.abs(w - first)
            si = self.scene.ray_intersect(ray, searching)
            found = si.is_valid() & (self.locate(si).tag == patch.tag) & self._is_wet(si, searching)
            # Other surfaces may lie before the patch; the sea lies close to it at the water line.
            fresh = ~si.is_valid()
            step = dr.select(self.scene.is_surface(si.shape), _just_before(si.p), margin)
            uvw.z = w - patch.faces * (si.t + step)
            searching &= ~found & (samples < _MOST_COVERAGE_SAMPLES)
            return samples + dr.select(searching & fresh, mi.Float(1), 0), rng, searching, uvw, fresh

        state = mi.Float(1), mi.PCG32(rng), active & self._is(self._cut, shape), mi.Point3f(0), mi.Bool(True)
        samples, advanced, *_ = dr.while_loop(state, lambda *state: state[2], probe, label="coverage")
        rng.state = advanced.state
        return samples
