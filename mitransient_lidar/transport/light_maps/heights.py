"""Heights of the sea about the places of shots, and where rays from the air meet them, without a tree of triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import aligned, opaque, opaque_index, opaque_vector
from mitransient_lidar.transport.rng import starts
from mitransient_lidar.transport.scene import LidarScene, ScenePart

#: Steps towards the point where a ray meets the sea: each shortens the distance by slope times tangent of the angle.
_STEPS = 6


@dataclass(frozen=True)
class HeightFields:
    """Heights of the sea on square cells about the place of each shot; beyond them the sea is as at their edge.

    Attributes
    ----------
    values
        Heights of all shots [m], one shot and then one line along x after the other.
    lines
        Number of lines on each side.
    per_metre
        Cells per metre [1/m].
    wind
        Direction of the first axis of the ripples among the shapes, unit vector (x, y).
    low, displacement, turn
        First x and y of each shot's cells among the shapes [m], and its displacement and turn as of `ScenePart`.
    start
        Number of the first height of each shot.
    """

    OF_SHOTS = ("low", "displacement", "turn", "start")

    values: mi.Float
    lines: mi.UInt32
    per_metre: mi.Float
    wind: tuple[mi.Float, mi.Float]
    low: mi.Vector2f
    displacement: mi.Vector3f
    turn: mi.Vector2f
    start: mi.UInt32

    @classmethod
    def of_patches(
        cls,
        heights: FloatArray,
        corners: FloatArray,
        cell: float,
        wind_direction: float,
        part: ScenePart,
        copies: int = 1,
    ) -> Self:
        """Return the fields of patches.

        Parameters
        ----------
        heights, corners
            As of `physics.sea.sea_surface.SeaSurface.height_patches`, in the frame of the shapes.
        cell
            Side of a cell [m].
        wind_direction
            Direction of the first axis of the ripples [rad].
        part
            Displacement and turn of each shot.
        copies
            Shots in turn that share a patch.
        """
        shots, lines, _ = heights.shape
        low = mi.Vector2f(
            *(aligned(mi.Float, column.astype(np.float32)) for column in np.repeat(corners, copies, axis=0).T)
        )
        wind = opaque(float(np.cos(wind_direction))), opaque(float(np.sin(wind_direction)))
        values = aligned(mi.Float, heights.astype(np.float32))
        sizes = opaque_index(lines), opaque(1 / cell)
        turn = mi.Vector2f(1, 0) if part.turn is None else part.turn
        return cls(values, *sizes, wind, low, part.displacement, turn, starts(shots, lines * lines, copies))

    @classmethod
    def about(cls, scene: LidarScene, *, level: bool = False) -> Self:
        """Return the field about the place of a scene's own shot, or one of a level sea there."""
        (sea,), pose = scene.seas, scene.receiver.pose
        place = pose.in_scene(pose.ground_point())[None, :2]
        heights, corners = sea.sea.height_patches(place, sea.footprint_size, [sea.sea])
        heights = np.zeros((1, 3, 3)) if level else heights
        part = ScenePart(scene.mitsuba_scene, opaque_vector(scene.frame_origin))
        return cls.of_patches(heights, corners, sea.sea.line_distance, sea.sea.wind_direction, part)

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
        """Return height [m] and slopes of the faces at places in cells; beyond the edge those of the edge."""
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
