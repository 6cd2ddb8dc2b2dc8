"""Targets in images by light maps: their shadows, and the pixels that receive their scattered light."""

from __future__ import annotations

import math
from collections.abc import Sequence

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


class Targets:
    """A scene's targets, and the ways of scattered light past them or to them.

    A way is straight down to its first scattering event, and from there to its end. The `solids` are the scene of them,
    or one in parts for shots.
    """

    def __init__(self, scene: LidarScene, spread: TwoWaySpread) -> None:
        self.count = len(scene.targets)  #: Number of targets.
        self._numbers = [opaque_index(shape_number(target)) for target in scene.targets]
        heights = np.array([float(target.bbox().center().z) for target in scene.targets])
        self._heights = aligned(mi.Float, heights.astype(np.float32))
        self._ways = [
            aligned(mi.Float, values.astype(np.float32))
            for values in (spread.up_x, spread.up_y, spread.straight_down, spread.straight_up)
        ]

    def draw(self, point: mi.Point3f, down: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return numbers of targets by uniform numbers, and distances to their middle heights [m].

        `point`, `down`: start of rays [m], and the downward component of their directions.
        """
        number = dr.minimum(mi.UInt32(u * self.count), self.count - 1)
        return number, dr.maximum(point.z - dr.gather(mi.Float, self._heights, number), _BEYOND) / down

    def ways(self, path: mi.UInt32, scale: mi.Float) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Return displacements of ways up [m], and the straight shares of the ways down and up.

        `path`, `scale`: number of the path in the spread, and length of its displacements over those there.
        """
        x, y, down, up = (dr.gather(mi.Float, one, path) for one in self._ways)
        return mi.Vector3f(x, y, 0) * scale, down, up

    def meet(
        self,
        solids: mi.Scene | LidarScene,
        ray: mi.Ray3f,
        along: mi.Float,
        up: mi.Vector3f,
        straight: mi.Float,
        number: mi.UInt32,
        active: mi.Bool,
    ) -> mi.SurfaceInteraction3f:
        """Return where ways up meet the targets with some numbers first; not valid for others.

        `ray`, `along`: ray of the view, and length of the straight way [m]. `up`, `straight`: as of `ways`.
        """
        turn = ray(straight * along)
        chord = ray(along) + up - turn
        onward = dr.select(dr.norm(chord) > _BEYOND, dr.normalize(chord), ray.d)
        first = mi.Ray3f(ray.o, ray.d)
        first.maxt = straight * along
        met = solids.ray_intersect(first, active)
        met = dr.select(met.is_valid(), met, solids.ray_intersect(mi.Ray3f(turn, onward), active & ~met.is_valid()))
        shape, wanted = dr.reinterpret_array(mi.UInt32, met_shape(met)), mi.UInt32(0)
        for index, own in enumerate(self._numbers):
            wanted = dr.select(number == index, own, wanted)
        met.t = dr.select(met.is_valid() & (shape == wanted), met.t, math.inf)
        return met

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

    def let_pass(
        self,
        solids: mi.Scene | LidarScene,
        whole: mi.Vector3f,
        ways: Sequence[tuple[mi.Point3f, mi.Float, mi.Point3f]],
        active: mi.Bool,
    ) -> mi.Bool:
        """Return which paths meet no target on several ways, of which the ends may be on one.

        `whole`: displacement along a straight way [m]. `ways`: start [m], straight share, and end [m].
        """
        passes = mi.Bool(active)
        for start, straight, end in ways:
            turn = start + whole * straight
            for one, other in ((start, turn), (turn, end)):
                length = dr.norm(other - one)
                ray = mi.Ray3f(one, (other - one) / dr.maximum(length, _BEYOND))
                ray.maxt = length - _BEFORE
                passes &= ~self.are_at(solids.ray_intersect(ray, passes & (length > _BEFORE)))
        return passes
