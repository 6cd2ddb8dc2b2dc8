"""Poses as kernels read them, and lengths relative to a reference point that are accurate in single precision."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.transport.opaque import aligned, opaque, opaque_vector
from mitransient_lidar.transport.rng import Lanes

_SMALLEST_DISTANCE = 1e-12  #: Smallest sum of two distances [m], against division by zero.


@dataclass(frozen=True)
class KernelPose(Pose):
    """One pose for all paths, or the poses of their shots, as kernels read them.

    Poses for several shots serve paths alone: `direction`, `tangent`, `point` and `RelativePose`.
    """

    OF_SHOTS = ("lanes",)

    delay: float | FloatArray = 0.0  #: Length that is added to relative lengths [m], per shot.
    lanes: Lanes | None = None  #: Lanes of the paths that have their shot's pose; none if all paths have one pose.
    #: Frame origin in the scene [m], shape (3,): not 0 in a scene far from its own origin.
    frame_origin: FloatArray = field(default_factory=lambda: np.zeros(3))

    def in_frame(self, frame_origin: FloatArray) -> Self:
        """Return a pose in the scene relative to a place there [m], shape (3,)."""
        return replace(self, origin=self.origin - frame_origin, frame_origin=frame_origin)

    def in_scene(self, points: FloatArray) -> FloatArray:
        """Return where points of the frame are in the scene [m], x, y or x, y, z along the last axis."""
        return np.asarray(points + self.frame_origin[: points.shape[-1]])

    def part(self, rows: slice | IntArray) -> KernelPose:
        """Return the poses for some shots."""
        return replace(super().part(rows), delay=np.broadcast_to(self.delay, len(self.origin))[rows])

    def number(self, values: float | FloatArray) -> mi.Float:
        """Return a number for all paths, or the number for each path's shot from shape (shots,), as kernels read it."""
        if np.ndim(values) == 0:
            return opaque(float(values))
        assert self.lanes is not None
        return self.lanes.pick(aligned(mi.Float, np.asarray(values, np.float32)))

    def vector(self, values: FloatArray) -> mi.Vector3f:
        """Return a vector for all paths, shape (3,), or for each path's shot, shape (shots, 3)."""
        return mi.Vector3f(*(self.number(values[..., axis]) for axis in range(3)))

    @property
    def point(self) -> mi.Point3f:
        """Position, as kernels read it [m]."""
        return mi.Point3f(self.vector(self.origin))

    def direction(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Vector3f:
        """Return the unit direction of the tangent-plane point (angle_x, angle_y)."""
        far, left, axis = (self.vector(v) for v in (self.far, self.left, self.axis))
        return dr.normalize(dr.fma(far, angle_x, dr.fma(left, angle_y, axis)))

    def tangent(self, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return (angle_x, angle_y) of a direction and its cosine with the axis, negative behind the tangent plane."""
        x, y, cos_axis = (dr.dot(direction, self.vector(v)) for v in (self.far, self.left, self.axis))
        scale = dr.rcp(cos_axis)
        return x * scale, y * scale, cos_axis


class RelativePose:
    """A pose relative to a reference point in the scene: accurate from orbit in single precision.

    Distances are relative to the reference point r. With the pose's origin o and a point p,
    |p - o| - |r - o| = (p - r) . (p - r + 2 (r - o)) / (|p - o| + |r - o|). Single precision rounds
    coordinates and distances of 500 km with 3 cm errors. Such differences to points within 100 m have errors below
    0.1 mm.

    `pose`: transmitter or receiver. `reference`: reference point [m], shape (3,).
    """

    def __init__(self, pose: KernelPose, reference: FloatArray) -> None:
        away = reference - pose.origin
        #: Distance to the reference point less the delay of the pose [m], in double precision.
        self.range = np.linalg.norm(away, axis=-1) - pose.delay
        self._reference, self._away = mi.Point3f(opaque_vector(reference)), pose.vector(away)
        self._range = pose.number(np.linalg.norm(away, axis=-1))
        self._delay = None if pose.lanes is None else pose.number(pose.delay)
        sides = (pose.far, pose.left, pose.axis)
        self._sides = [(pose.vector(side), pose.number(np.sum(side * away, axis=-1))) for side in sides]

    def distance(self, point: mi.Point3f) -> mi.Float:
        """Return the relative distances to points [m], negative for those nearer than the reference point."""
        offset = point - self._reference
        total = dr.norm(offset + self._away) + self._range
        distance = dr.dot(offset, offset + 2 * self._away) / dr.maximum(total, _SMALLEST_DISTANCE)
        return distance if self._delay is None else distance + self._delay

    def tangent(self, point: mi.Point3f) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return (angle_x, angle_y) of points, and the cosines between their directions and the axis."""
        offset = point - self._reference
        x, y, along = (dr.dot(offset, side) + constant for side, constant in self._sides)
        return x / along, y / along, along / dr.norm(offset + self._away)

    def at_height(self, angles: mi.Point2f, direction: mi.Vector3f, z: float) -> mi.Point3f:
        """Return where rays at tangent-plane angles, with a direction that goes down, meet a height [m].

        The reference point must be on the axis.
        """
        (far, _), (left, _), _ = self._sides
        # Through the plane normal to the axis, where coordinates are accurate.
        place = self._reference + self._range * (angles.x * far + angles.y * left)
        return place + direction * ((opaque(z) - place.z) / direction.z)
