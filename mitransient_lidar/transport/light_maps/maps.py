"""Maps for each shot with the beam's light on horizontal planes below the sea; sea and bottom heights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract_level
from mitransient_lidar.transport.opaque import aligned, opaque, opaque_index, opaque_vector
from mitransient_lidar.transport.rng import Lanes, starts
from mitransient_lidar.transport.scene import LidarScene, ScenePart

#: Steps towards the point where a ray meets the sea: each shortens the distance by slope times tangent of the angle.
_STEPS = 6


@dataclass(frozen=True)
class HeightFields:
    """Sea heights on square cells about each shot's place; beyond them the sea is as at their edge."""

    OF_SHOTS = ("low", "displacement", "turn", "start")

    values: mi.Float  #: Heights of all shots [m], one shot and then one line along x after the other.
    lines: mi.UInt32  #: Number of lines on each side.
    per_metre: mi.Float  #: Cells per metre [1/m].
    wind: tuple[mi.Float, mi.Float]  #: Direction of the first axis of the ripples among the shapes, unit vector (x, y).
    #: First x and y of each shot's cells among the shapes [m], and its displacement and turn as of `ScenePart`.
    low: mi.Vector2f
    displacement: mi.Vector3f
    turn: mi.Vector2f
    start: mi.UInt32  #: Number of the first height of each shot.

    @classmethod
    def of_patches(
        cls,
        values: mi.Float,
        corners: FloatArray,
        cell: float,
        wind_direction: float,
        part: ScenePart,
        copies: int = 1,
    ) -> Self:
        """Return the fields of patches.

        Parameters
        ----------
        values, corners
            As in `physics.sea.sea_surface.SeaSurface.height_patches`, in the shapes' frame.
        cell
            Side of a cell [m].
        wind_direction
            Direction of the ripples' first axis [rad].
        part
            Displacement and turn of each shot.
        copies
            Shots in turn that share a patch.
        """
        shots = len(corners)
        lines = math.isqrt(dr.width(values) // shots)
        low = mi.Vector2f(
            *(aligned(mi.Float, column.astype(np.float32)) for column in np.repeat(corners, copies, axis=0).T)
        )
        wind = opaque(float(np.cos(wind_direction))), opaque(float(np.sin(wind_direction)))
        sizes = opaque_index(lines), opaque(1 / cell)
        turn = mi.Vector2f(1, 0) if part.turn is None else part.turn
        return cls(values, *sizes, wind, low, part.displacement, turn, starts(shots, lines * lines, copies))

    @classmethod
    def about(cls, scene: LidarScene, *, level: bool = False) -> Self:
        """Return the field about the place of a scene's own shot, or a level sea's there."""
        (sea,), pose = scene.seas, scene.receiver.pose
        place = pose.in_scene(pose.ground_point())[None, :2]
        level_sea = np.zeros((1, 3, 3)), place
        heights, corners = level_sea if level else sea.sea.height_patches(place, sea.met_size, [sea.sea])
        part = ScenePart(scene.mitsuba_scene, opaque_vector(scene.frame_origin))
        return cls.of_patches(aligned(mi.Float, heights), corners, sea.sea.line_distance, sea.sea.wind_direction, part)

    def meet(self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """Return where rays that go down meet the sea, on the faces that its mesh has; `active` in valid ones."""
        cos, sin = self.turn.x, self.turn.y
        # Along the ray, from the mean sea level.
        to_level = -origin.z / direction.z
        x, y = (dr.fma(direction[axis], to_level, origin[axis]) for axis in (0, 1))
        u = (cos * x - sin * y + self.displacement.x - self.low.x) * self.per_metre
        v = (sin * x + cos * y + self.displacement.y - self.low.y) * self.per_metre
        per_height = self.per_metre / direction.z
        du, dv = (
            (cos * direction.x - sin * direction.y) * per_height,
            (sin * direction.x + cos * direction.y) * per_height,
        )
        height, slope = mi.Float(0), mi.Vector2f(0)
        for _ in range(_STEPS):
            height, slope = self._at(u + du * height, v + dv * height)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        si.t = dr.select(active, to_level + height / direction.z, dr.inf)
        si.p = mi.Point3f(x + direction.x * height / direction.z, y + direction.y * height / direction.z, height)
        slope_x, slope_y = cos * slope.x + sin * slope.y, cos * slope.y - sin * slope.x
        si.n = mi.Normal3f(dr.normalize(mi.Vector3f(-slope_x, -slope_y, 1)))
        # Along the wind on the face, as the mesh's texture coordinates are.
        wind_x, wind_y = cos * self.wind[0] + sin * self.wind[1], cos * self.wind[1] - sin * self.wind[0]
        s = dr.normalize(mi.Vector3f(wind_x, wind_y, slope_x * wind_x + slope_y * wind_y))
        si.sh_frame = mi.Frame3f(s, dr.cross(si.n, s), si.n)
        si.wi = si.to_local(-direction)
        return si

    def _at(self, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Vector2f]:
        """Return the faces' height [m] and slopes at places in cells; beyond the edge the edge's."""
        most = mi.Float(self.lines) - 2
        i, j = dr.clip(dr.floor(u), 0, most), dr.clip(dr.floor(v), 0, most)
        x, y = dr.clip(u - i, 0, 1), dr.clip(v - j, 0, 1)
        first = self.start + mi.UInt32(j) * self.lines + mi.UInt32(i)
        # Cells are split along the diagonal from (i + 1, j) to (i, j + 1), as `physics.sea.sea_mesh.triangulate` does.
        is_far = x + y > 1
        east, north = (dr.gather(mi.Float, self.values, first + more) for more in (mi.UInt32(1), self.lines))
        corner = dr.gather(mi.Float, self.values, first + dr.select(is_far, self.lines + 1, 0))
        along = dr.select(is_far, corner - north, east - corner)
        across = dr.select(is_far, corner - east, north - corner)
        at = dr.select(is_far, corner - along * (1 - x) - across * (1 - y), corner + along * x + across * y)
        return at, mi.Vector2f(along, across) * self.per_metre


#: Half width of a map over the standard deviation of the beam.
_SPREADS = 4.0

#: Half width of a map for refraction by waves, over the depth.
_WIDTH_PER_DEPTH = 0.15

#: Units of energy [1 over that emitted] in the integer sums of a map for each ray, and the limits of their number; over
#: them the units of energy times length [1/m].
_UNITS_PER_RAY, _FEWEST_UNITS, _MOST_UNITS, _LENGTH_UNITS = 2**16, 2**26, 2**30, 0.25

#: Cells on each side of a map with the fewest rays.
FEWEST_CELLS = 48


@dataclass(frozen=True)
class Planes:
    """Horizontal planes at equal distances, the first at the mean sea level, and the maps on them."""

    depths: FloatArray  #: Depths [m], 0 first.
    half: FloatArray  #: Half widths of the maps [m].
    #: Optical depths of absorption and scattering along the receiver's axis [1].
    absorbed: FloatArray
    scattered: FloatArray
    cells: int = FEWEST_CELLS  #: Cells on each side of the maps.

    @classmethod
    def of_scene(cls, scene: LidarScene, deepest: float, count: int) -> Planes:
        """Return planes down to a depth [m], with the fewest cells."""
        depths, pose = np.linspace(0, deepest, count), scene.receiver.pose
        slant = -float(pose.axis[2])
        spread = scene.transmitter.widest_angular_spread * pose.ground_range / slant
        column, down = scene.required_water.column, -float(refract_level(pose.axis, scene.refractive_index)[2])
        ends = np.append(column.layer_tops[1:], np.inf)
        lengths = (np.clip(depths[:, None], column.layer_tops, ends) - column.layer_tops) / down
        optical = lengths @ column.absorption, lengths @ column.scattering
        return cls(depths, _SPREADS * spread + _WIDTH_PER_DEPTH * depths, *optical)

    def cell(self, depth: FloatArray) -> FloatArray:
        """Return the side of cells at depths [m]."""
        return np.asarray(2 / self.cells * np.interp(depth, self.depths, self.half))


class LightMaps:
    """Energy and optical length for each shot's beam in the planes' cells.

    Cells are counted from where the transmitter's axis, refracted by a level sea, meets the plane. Energies are kept
    relative to the absorption along the receiver's axis, with and without those that scattering turns.

    `scene`: scene of one or several shots. `rays`: number of rays for each beam.
    """

    def __init__(self, scene: LidarScene, planes: Planes, shots: int, rays: int) -> None:
        self.count, self._cells = planes.depths.size, planes.cells
        self._units = float(np.clip(_UNITS_PER_RAY * rays, _FEWEST_UNITS, _MOST_UNITS))
        self.step = opaque(float(planes.depths[1]))  #: Distance of planes [m].
        self._half, self._absorbed, self._scattered = (
            aligned(mi.Float, each.astype(np.float32)) for each in (planes.half, planes.absorbed, planes.scattered)
        )
        pose = scene.transmitter_poses or scene.transmitter.pose
        axes, origins = (np.broadcast_to(each, (shots, 3)) for each in (pose.axis, pose.origin))
        entries = origins - axes * (origins[:, 2] / axes[:, 2])[:, None]
        below = np.array([refract_level(axis, scene.refractive_index) for axis in axes])
        tilts = below[:, :2] / -below[:, 2:]
        # Along level water light is later by the horizontal part of the axis in the air [1].
        self._entry, self._tilt, self._later = (
            mi.Vector2f(*(aligned(mi.Float, column.astype(np.float32)) for column in each.T))
            for each in (entries[:, :2], tilts, axes[:, :2])
        )
        # Relative lengths, as of `RelativePose`.
        ranges = np.linalg.norm(scene.receiver.pose.nearby_point() - origins, axis=1) - pose.delay
        to_entry = np.linalg.norm(entries - origins, axis=1) - ranges
        self._to_entry = aligned(mi.Float, to_entry.astype(np.float32))
        self._per_depth = aligned(mi.Float, (scene.group_index / -below[:, 2]).astype(np.float32))
        size = shots * self.count * self._cells**2
        self._energy, self._clear = (dr.zeros(mi.UInt32, size) for _ in range(2))
        self._length = dr.zeros(mi.Int32, size)

    def depth_of(self, plane: mi.UInt32) -> mi.Float:
        """Return the depth of planes [m]."""
        return mi.Float(plane) * self.step

    def plane_at(self, depth: mi.Float, u: mi.Float) -> mi.UInt32:
        """Return one of the two planes about a depth [m], in proportion to the distances, by uniform numbers."""
        return dr.minimum(mi.UInt32(dr.maximum(depth / self.step, 0) + u), self.count - 1)

    def _cell(
        self, lanes: Lanes, plane: mi.UInt32, place: mi.Point3f, depth: mi.Float
    ) -> tuple[mi.UInt32, mi.Bool, mi.Float]:
        """Return the cell of a place [m] at a depth [m], whether a map has it, and its relative length in level water.

        The place is seen from the axis at its depth.
        """
        beside, cells = mi.Vector2f(place.x, place.y) - lanes.pick(self._entry), self._cells
        beside -= lanes.pick(self._tilt) * depth
        per_metre = 0.5 * cells / dr.gather(mi.Float, self._half, plane)
        i, j = beside.x * per_metre + 0.5 * cells, beside.y * per_metre + 0.5 * cells
        inside = (i >= 0) & (j >= 0) & (i < cells) & (j < cells)
        cell = mi.UInt32(dr.select(inside, j, 0)) * cells + mi.UInt32(dr.select(inside, i, 0))
        level = (
            lanes.pick(self._to_entry) + lanes.pick(self._per_depth) * depth + dr.dot(beside, lanes.pick(self._later))
        )
        return (lanes.shot * self.count + plane) * cells**2 + cell, inside, level

    def add(
        self,
        lanes: Lanes,
        plane: mi.UInt32,
        place: mi.Point3f,
        energy: mi.Float,
        depths: tuple[mi.Float, mi.Float],
        length: mi.Float,
        active: mi.Bool,
        lit: mi.Bool | None = None,
    ) -> None:
        """Add rays of the beam to planes.

        Parameters
        ----------
        lanes, plane, place
            Lanes, numbers of planes, and where rays meet them [m].
        energy
            Energies over that emitted, before the water.
        depths
            Optical depths of absorption and scattering up to there.
        length
            Relative optical lengths up to there [m].
        active
            Which rays there are.
        lit
            Which rays no target has met up to there, by default all.
        """
        cell, inside, level = self._cell(lanes, plane, place, self.depth_of(plane))
        own = (dr.gather(mi.Float, each, plane) for each in (self._absorbed, self._scattered))
        absorbed, scattered = (before - after for before, after in zip(own, depths, strict=True))
        kept = energy * dr.exp(absorbed)
        clear = kept * dr.exp(scattered)
        active &= inside
        dr.scatter_add(self._energy, mi.UInt32(kept * self._units), cell, active)
        active = active if lit is None else active & lit
        dr.scatter_add(self._clear, mi.UInt32(clear * self._units), cell, active)
        dr.scatter_add(self._length, mi.Int32(clear * (length - level) * (_LENGTH_UNITS * self._units)), cell, active)

    def look_up(
        self, lanes: Lanes, place: mi.Point3f, depth: mi.Float, u: mi.Float, *, scattered: bool
    ) -> tuple[mi.Float, mi.Float]:
        """Return the beam's light at places and depths [m], in one of the two planes about them.

        Returns
        -------
        energy
            Energy through a horizontal area over that emitted [1/m^2]: of light that no event has turned, or with
            `scattered` as if none turned it and no target were there.
        length
            Mean relative optical length of unscattered light [m].
        """
        plane = self.plane_at(depth, u)
        cell, inside, level = self._cell(lanes, plane, place, depth)
        clear = mi.Float(dr.gather(mi.UInt32, self._clear, cell, inside))
        moment = mi.Float(dr.gather(mi.Int32, self._length, cell, inside))
        later = moment / dr.maximum(clear, 1) * (1 / _LENGTH_UNITS)
        energy = mi.Float(dr.gather(mi.UInt32, self._energy, cell, inside)) if scattered else clear
        density = (0.5 * self._cells) ** 2 / self._units / dr.square(dr.gather(mi.Float, self._half, plane))
        # Optical depths of the axis at the depth itself, above the mean sea level continued.
        at = dr.minimum(depth / self.step, self.count - 1)
        low = dr.minimum(mi.UInt32(dr.maximum(at, 0)), self.count - 2)

        def between(values: mi.Float) -> mi.Float:
            first, second = (dr.gather(mi.Float, values, low + more) for more in (0, 1))
            return dr.lerp(first, second, at - mi.Float(low))

        lost = between(self._absorbed) if scattered else between(self._absorbed) + between(self._scattered)
        return dr.select(inside, energy * density * dr.exp(-lost), 0), level + later
