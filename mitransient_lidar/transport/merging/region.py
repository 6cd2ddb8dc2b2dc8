"""The sea's part that is lit or seen, and the surface and solid heights there."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.transport.opaque import aligned, is_one_of, opaque, opaque_vector
from mitransient_lidar.transport.probe import PROBE_RAYS, Probe, Rays
from mitransient_lidar.transport.rng import Lanes, starts, unit_points
from mitransient_lidar.transport.scene import LidarScene

_ENTRY_RAYS = 64  #: Number of rays that find where each shot's beam meets the sea.

#: Share of rays that may fall outside the region on either side, and margin over its size.
_REGION_TAIL, _REGION_MARGIN = 0.002, 0.15

_LEAST_MARGIN = 1.0  #: Least margin of a region under water [m].

#: Distance beside the view within which light counts, over the view size and over the longest way in the water: height
#: tables below a whole very wide beam would not resolve its waves.
_BESIDE_PER_VIEW, _BESIDE_PER_LENGTH = 2.0, 2.0

_SPREAD_PER_DEPTH = 0.25  #: Distance beside the beam within which light spreads, over the depth.

#: Cells per side of the height tables, for a single shot and for each of several.
_HEIGHT_CELLS, _HEIGHT_CELLS_OF_SHOTS = 512, 64

_MOST_CROSSINGS = 4  #: Largest number of times that a line through the mean sea level crosses the waves.
_MARGIN_BELOW_SEA = 1.0  #: Largest distance below the sea at which vertical rays to solids start [m].
_NO_BED = -1e9  #: Bed height in columns without a solid below [m].


@dataclass(frozen=True)
class Region:
    """Rectangle of the sea that is lit or seen, as far as paths to the receiver reach: corners (x, y) [m]."""

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def of_probe(cls, probe: Probe) -> Region:
        """Find the region with rays in the beam and in the field of view; raise UserError if none goes down."""
        places = [rays.sea_places for rays in (probe.view, probe.beam)]
        places = [place[np.isfinite(place[:, 0]), :2] for place in places]
        ends = [np.quantile(place, [_REGION_TAIL, 1 - _REGION_TAIL], axis=0) for place in places if len(place)]
        if not ends:
            raise UserError("laser and receiver look above the horizon: at least one must look down at the sea")
        low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
        if len(places[0]):
            beside = _BESIDE_PER_VIEW * np.ptp(ends[0], axis=0) + _BESIDE_PER_LENGTH * _longest_way(probe.scene)
            low, high = np.maximum(low, ends[0][0] - beside), np.minimum(high, ends[0][1] + beside)
        return cls.between(low, high, _REGION_MARGIN * (high - low))

    @classmethod
    def between(cls, low: FloatArray, high: FloatArray, margin: FloatArray | float) -> Region:
        """Return the region between corners, shape (2,), with a margin on all sides [m]."""
        x, y = zip((low - margin).tolist(), (high + margin).tolist(), strict=True)
        return cls((x[0], y[0]), (x[1], y[1]))

    @property
    def size(self) -> tuple[float, float]:
        """Sides along x and y [m]."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def below(self, scene: LidarScene, depth: float) -> Region:
        """Return the region that holds light and view down to a depth [m], along their axes in level water."""
        poses = scene.transmitter.pose, scene.receiver.pose
        axes = [refract_level(pose.axis, scene.refractive_index) for pose in poses]
        shifts = [np.zeros(2), *(depth * axis[:2] / -axis[2] for axis in axes)]
        low, high = np.array(self.low) + np.min(shifts, axis=0), np.array(self.high) + np.max(shifts, axis=0)
        return Region.between(low, high, _SPREAD_PER_DEPTH * depth)

    def probe_points(self, index: mi.UInt32 | None = None) -> tuple[mi.Float, mi.Float]:
        """Return points (x, y) in the region [m] by number, by default all 4096, evenly distributed."""
        x, y = unit_points(PROBE_RAYS, index)
        return dr.lerp(opaque(self.low[0]), opaque(self.high[0]), x), dr.lerp(
            opaque(self.low[1]), opaque(self.high[1]), y
        )

    def track_length(self, scene: LidarScene) -> float:
        """Return the mean distance in the water along the axis to a solid, or to the depth of the record's end [m]."""
        down = refract_level(scene.transmitter.pose.axis, scene.refractive_index)
        # From the mean sea level: below the deepest trough, which lies anywhere, may be below a shallow bottom here.
        ray = mi.Ray3f(mi.Point3f(*self.probe_points(), opaque(0.0)), opaque_vector(down))
        length, at_sea = dr.zeros(mi.Float, PROBE_RAYS), dr.full(mi.Bool, True, PROBE_RAYS)
        met = mi.Bool(False)
        for _ in range(_MOST_CROSSINGS):
            si = scene.ray_intersect(ray, at_sea)
            length += dr.select(at_sea, dr.select(si.is_valid(), si.t, dr.inf), 0)
            met |= at_sea & si.is_valid() & ~scene.is_surface(si.shape)
            at_sea &= si.is_valid() & scene.is_surface(si.shape)
            ray = si.spawn_ray(ray.d)
        length = dr.minimum(length, opaque(_longest_way(scene)))
        # Without solids below land.
        above = scene.ray_intersect(mi.Ray3f(mi.Point3f(*self.probe_points(), opaque(0.0)), mi.Vector3f(0, 0, 1)))
        wet = ~above.is_valid() | scene.is_surface(above.shape) | met
        count = int(dr.count(wet)[0])
        if count in (0, PROBE_RAYS):
            return float(dr.mean(length)[0])
        return float(dr.sum(dr.select(wet, length, 0))[0]) / count

    def is_below(self, box: mi.ScalarBoundingBox3f, scene: LidarScene) -> bool:
        """Return whether a bounding box extends beyond light and view at its depth, by their size on every side."""
        below = self.below(scene, max(-float(box.min.z), 0.0))
        return all(
            float(box.min[axis]) < below.low[axis] - below.size[axis]
            and float(box.max[axis]) > below.high[axis] + below.size[axis]
            for axis in (0, 1)
        )


def reach_under_water(probe: Probe) -> tuple[Region, float, float]:
    """Return the region of beam and view, the beam rays' mean length [m], and the shortest ray length to solids.

    Rays end at the first surface, or where their light returns at the end of the record.
    """
    scene = probe.scene
    shortest = longest = max(scene.axis.path_end / (2 * scene.group_index), 0.1)
    places = []
    for rays in (probe.view, probe.beam):
        lengths = np.minimum(rays.ranges, longest)
        shortest = min(shortest, float(lengths[rays.on_solid].min(initial=longest)))
        places += [rays.pose.origin[:2], (rays.pose.origin + rays.directions * lengths[:, None])[:, :2]]
    points = np.vstack(places)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = np.maximum(_REGION_MARGIN * (high - low), _LEAST_MARGIN)
    return Region.between(low, high, margin), float(lengths.mean()), shortest


def _longest_way(scene: LidarScene) -> float:
    """Return the distance in the water along the axis to the depth of the record's end, at least 0.1 m [m]."""
    transmitter, receiver = scene.transmitter.pose, scene.receiver.pose
    spot = transmitter.ground_point()
    air = sum(float(np.linalg.norm(spot - pose.origin)) for pose in (transmitter, receiver))
    return max((scene.axis.path_end - air) / (2 * scene.group_index), 0.1)


def beam_entries(scene: LidarScene, shots: int = 1) -> FloatArray:
    """Return where the beam of each shot meets the sea, relative to where it meets its mean level [m].

    Means over the beam, shape (shots, 3).
    """
    lanes = Lanes.of_paths(dr.arange(mi.UInt32, shots * _ENTRY_RAYS), shots, _ENTRY_RAYS)
    moved = lanes.pick(scene)
    pose = moved.transmitter_pose
    angles = mi.Point2f(scene.transmitter.sample_tangent(unit_points(_ENTRY_RAYS, lanes.number)))
    rays = Rays(moved, pose, angles, pose.direction(*angles), mi.Bool(True))
    height, direction = rays.sea_places[:, 2], rays.directions
    offset = np.where(np.isfinite(height), height / direction[:, 2], 0.0)[:, None] * direction
    found: FloatArray = offset.reshape(shots, -1, 3).mean(axis=1)
    if scene.transmitter_poses is None:
        return found
    return np.asarray(found + scene.transmitter_poses.ground_point() - scene.transmitter.pose.ground_point())


@dataclass(frozen=True)
class _Grid:
    """Grids with equal cells over a region, one per shot location, and values in their cells."""

    OF_SHOTS = ("low", "start")

    #: Values in all cells, and their type.
    values: mi.Float
    kind: type[mi.Float] | type[mi.UInt32]
    #: Grid corner for each shot [m], and inverse cell sides [1/m].
    low: mi.Point2f
    per_metre: mi.Point2f
    cells: int  #: Cells per side.
    start: mi.UInt32  #: First cell number for each shot.

    def at(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float | mi.UInt32, mi.Float, mi.Float]:
        """Return values at (x, y) [m], or at the nearest point; and offsets from the cell centres [m]."""
        along, across = (x - self.low.x) * self.per_metre.x, (y - self.low.y) * self.per_metre.y
        i, j = (dr.clip(mi.Int32(dr.floor(number)), 0, self.cells - 1) for number in (along, across))
        values = dr.gather(self.kind, self.values, self.start + mi.UInt32(j * self.cells + i))
        dx, dy = (dr.clip(u - mi.Float(k) - 0.5, -0.5, 0.5) for u, k in ((along, i), (across, j)))
        return values, dx / self.per_metre.x, dy / self.per_metre.y


class SurfaceHeights:
    """Sea surface heights where it is lit or seen, and heights of the first solids below the surface there.

    `region`: sea region. `depth`: largest depth of light [m]: solids are also found beside the region, where light at
    that depth is. `moves`: region displacements (x, y) per shot [m], shape (shots, 2).
    """

    OF_SHOTS = ("_surface", "_bed", "_veil")

    def __init__(self, scene: LidarScene, region: Region, depth: float, moves: FloatArray | None = None) -> None:
        moves = np.zeros((1, 2)) if moves is None else moves
        self._surface = self._look_down(scene, region, moves, solids=False)
        below = region.below(scene, depth)
        self._bed = self._look_down(scene, below, moves, solids=True)
        #: Whether there are heights of veils: solids that let a part of the light pass unchanged.
        self.has_veils = scene.has_veils
        self._veil = self._look_down(scene, below, moves, solids=True, veils=True) if self.has_veils else self._bed

    def _look_down(
        self, scene: LidarScene, region: Region, moves: FloatArray, *, solids: bool, veils: bool = False
    ) -> _Grid:
        """Return surface heights and slopes, or heights of solids under water, found with vertical rays.

        Solids are those that let no light pass unchanged, or the `veils`, which let a part pass.
        """
        shots = len(moves)
        n = _HEIGHT_CELLS if shots == 1 else _HEIGHT_CELLS_OF_SHOTS
        corner = (moves + np.array(region.low)).astype(np.float32)
        low = mi.Point2f(*(aligned(mi.Float, column) for column in corner.T))
        per_metre = mi.Point2f(*(opaque(n / size) for size in region.size))
        lanes = Lanes.of_paths(dr.arange(mi.UInt32, shots * n * n), shots, n * n)
        index, scene = lanes.number, lanes.pick(scene)
        x = (mi.Float(index % n) + 0.5) / per_metre.x + lanes.pick(low.x)
        y = (mi.Float(index // n) + 0.5) / per_metre.y + lanes.pick(low.y)
        assert scene.sea_heights is not None
        lowest = scene.sea_heights[0]
        top = scene.sea_heights[1] + 1.0
        under_water = False
        if scene.parts:
            highest_solid, lowest_sea = scene.empty_heights
            under_water = solids and highest_solid < lowest_sea
            if under_water:
                # Between the solids and the sea, which these rays need not meet.
                top = lowest_sea - min(0.5 * (lowest_sea - highest_solid), _MARGIN_BELOW_SEA)
            if under_water or not solids:
                scene = scene.with_parts_of(scene.solids if solids else scene.surfaces)
        start = opaque(top)
        land = [solid for solid in scene.solids if solid.bbox().min.z < lowest < solid.bbox().max.z and solids]

        def look_down(
            ray: mi.Ray3f, found: mi.Vector4f, wet: mi.Bool, active: mi.Bool
        ) -> tuple[mi.Ray3f, mi.Vector4f, mi.Bool, mi.Bool]:
            si = scene.ray_intersect(ray, active)
            active &= si.is_valid()
            at_sea = scene.is_surface(si.shape)
            wanted = wet & ~at_sea if solids else at_sea
            if land:
                # Where no solid is below the sea, one that begins in the air is its bed.
                dry = active & ~wet & is_one_of(si.shape, land) & (found.x == _NO_BED)
                found.x = dr.select(dry, si.p.z, found.x)
            passes = mi.Bool(False)
            if solids and scene.has_veils:
                share = si.bsdf().eval_null_transmission(scene.on_shapes(si), active & wanted)[0]
                passes = wanted & (((share == 0) | (share == 1)) if veils else (share > 0))
                wanted &= ~passes
            found = dr.select(active & wanted, mi.Vector4f(si.p.z, -si.n.x / si.n.z, -si.n.y / si.n.z, 0), found)
            active &= ~wanted & (at_sea | ~wet | passes)
            wet |= active & at_sea
            return dr.select(active, si.spawn_ray(ray.d), ray), found, wet, active

        count = shots * n * n
        found = dr.zeros(mi.Vector4f, count)
        found.x = _NO_BED if solids else 0.0
        state = (
            mi.Ray3f(mi.Point3f(x, y, start), mi.Vector3f(0, 0, -1)),
            *(found, dr.full(mi.Bool, under_water, count), dr.full(mi.Bool, True, count)),
        )
        _, found, _, _ = dr.while_loop(state, lambda *state: state[-1], look_down, label="heights")
        values = found.x if solids else dr.ravel(found)
        dr.eval(values)
        return _Grid(values, mi.Float if solids else mi.Vector4f, low, per_metre, n, starts(shots, n * n))

    def surface_at(self, x: mi.Float, y: mi.Float) -> tuple[mi.Float, mi.Vector2f]:
        """Return height [m] and slopes of the surface at (x, y) [m]: outside the region, level at the edge's height."""
        (height, slope_x, slope_y, _), dx, dy = self._surface.at(x, y)
        inside = (dr.abs(dx) * self._surface.per_metre.x < 0.5) & (dr.abs(dy) * self._surface.per_metre.y < 0.5)
        slope = dr.select(inside, mi.Vector2f(slope_x, slope_y), 0)
        return height + slope.x * dx + slope.y * dy, slope

    def bed_at(self, x: mi.Float, y: mi.Float) -> mi.Float:
        """Return the height of the first solid below the surface at (x, y) [m], -1e9 where there is none."""
        height, _, _ = self._bed.at(x, y)
        return height

    def veil_at(self, x: mi.Float, y: mi.Float) -> mi.Float:
        """Return the height of the first veil below the surface at (x, y) [m], -1e9 where there is none."""
        height, _, _ = self._veil.at(x, y)
        return height
