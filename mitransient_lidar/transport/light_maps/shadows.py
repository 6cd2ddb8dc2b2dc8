"""Targets in images by light maps: their shadows, and the pixels that receive their scattered light."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.physics.water.two_way_spread import TwoWaySpread
from mitransient_lidar.transport.opaque import aligned, opaque_index, shape_number
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import met_shape

#: Faces of targets behind each other on a ray that goes on to the bottom, and distance between a face and the ray [m].
_FACES, _BEYOND = 6, 1e-4

#: Distance before the end of a line at which it no longer meets what it ends on [m].
_BEFORE = 1e-3

#: Angle over which places of rays are taken as linear [rad].
_ANGLE = 1e-3


class Targets:
    """A scene's targets, and the ways of scattered light past them or to them.

    A way is straight down to its first scattering event, and from there to its end. The `solids` are the scene of them,
    or one in parts for shots.
    """

    def __init__(self, scene: LidarScene, spread: TwoWaySpread) -> None:
        self._numbers = [opaque_index(shape_number(target)) for target in scene.targets]
        pose = scene.receiver.pose
        directions = pose.directions(_ANGLE * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]))
        rays = np.broadcast_to(directions[:, None], (4, spread.depths.size, 3))
        places = scene.level_sea.at_height(pose.origin, rays, -spread.depths)
        per_angle = np.stack([places[0] - places[1], places[2] - places[3]], axis=-1) / (2 * _ANGLE)
        aside = np.einsum("dij,jdp->idp", np.linalg.inv(per_angle), np.stack([spread.up_x, spread.up_y]))
        self._ways = [
            aligned(mi.Float, values.astype(np.float32))
            for values in (spread.up_x, spread.up_y, *aside, spread.straight_down, spread.straight_up)
        ]

    def are_at(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Return whether intersections are on targets."""
        met, found = dr.reinterpret_array(mi.UInt32, met_shape(si)), mi.Bool(False)
        for number in self._numbers:
            found |= met == number
        return found & si.is_valid()

    def distance(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """Return the distances of first intersections on targets [m], infinite for others."""
        return dr.select(self.are_at(si), si.t, math.inf)

    def behind(
        self, solids: mi.Scene | LidarScene, ray: mi.Ray3f, si: mi.SurfaceInteraction3f
    ) -> mi.SurfaceInteraction3f:
        """Return the first intersections of rays with a bottom, from their first intersections with any solid."""
        found = mi.SurfaceInteraction3f(si)
        for _ in range(_FACES):
            passed = self.are_at(found)
            start = found.t + _BEYOND
            further = solids.ray_intersect(mi.Ray3f(ray(start), ray.d), passed)
            further.t += start
            found = dr.select(passed, further, found)
        return found

    def ways(
        self,
        solids: mi.Scene | LidarScene,
        ray: mi.Ray3f,
        along: mi.Float,
        shift: mi.Vector3f,
        on_target: mi.Bool,
        path: mi.UInt32,
        scale: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Vector3f, mi.Vector2f, mi.Bool]:
        """Return by how much ways are displaced, and which of them pass the targets.

        Parameters
        ----------
        solids
            As of the class.
        ray, along
            Ray of the view in the water, and distance of the place on it that light has turned at, or beside it [m].
        shift
            Displacement of the straight way down from the ray [m].
        on_target
            Where light has turned on a target at the place itself; elsewhere the way up ends beside it.
        path, scale
            Number of the path in the spread, and length of its displacements over those there.
        active
            Which paths there are.

        Returns
        -------
        displacement, angles
            Displacement of the view from the ray to another one that sees the target's place [m], the opposite of the
            straight way's, and by how much its angles are less [rad]; the first is 0 if light has not turned on a
            target.
        passes
            Which of the active ways no target blocks.
        """
        up_x, up_y, aside_x, aside_y, *straight = (dr.gather(mi.Float, one, path) for one in self._ways)
        up = mi.Vector3f(up_x, up_y, 0) * scale
        moved = dr.select(on_target, up, 0)
        passes = mi.Bool(active)
        for start, share in zip((ray.o + shift - moved, ray.o - moved), straight, strict=True):
            turn = start + ray.d * (share * along)
            for one, other in ((start, turn), (turn, ray(along) + up - moved)):
                passes &= ~self._block(solids, one, other, passes)
        return moved, mi.Vector2f(aside_x, aside_y) * scale, passes

    def _block(self, solids: mi.Scene | LidarScene, start: mi.Point3f, end: mi.Point3f, active: mi.Bool) -> mi.Bool:
        """Return whether a target is between two points [m], of which the second may be on one."""
        length = dr.norm(end - start)
        ray = mi.Ray3f(start, (end - start) / dr.maximum(length, _BEYOND))
        ray.maxt = length - _BEFORE
        return self.are_at(solids.ray_intersect(ray, active & (length > _BEFORE)))
