"""Positions and axes of the transmitter or the receiver, and tangent-plane coordinates about the axis."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.ranges import RANGES, ranged
from mitransient_lidar.core.validation import in_range
from mitransient_lidar.transport.opaque import aligned, opaque, opaque_vector
from mitransient_lidar.transport.rng import Lanes

#: Smallest distance of a pose from the mean sea level [m].
_NEAREST = 0.1

#: Distance from a pose under water at which its axis stands for its beam or view [m].
_UNDER_WATER_RANGE = 10.0

#: Vertical component of an axis below which it is taken as level.
_SMALLEST_DESCENT = 1e-3

#: Smallest sum of two distances [m], against division by zero.
_SMALLEST_DISTANCE = 1e-12


@dataclass(frozen=True)
class Pose:
    """Position and axis of a transmitter or receiver, or those of each of several shots.

    A point of the tangent plane about the axis is (angle_x, angle_y), in radians: its direction is the unit vector
    along ``axis + angle_x * far + angle_y * left``. +angle_x points away from nadir, and +angle_y along +y for the
    default pose. Poses of several shots serve paths alone: `direction`, `tangent`, `point` and `RelativePose`.

    Parameters
    ----------
    origin
        Position [m], shape (3,) or (shots, 3).
    axis, far, left
        Orthonormal directions: the optical axis, the direction of +angle_x and the direction of +angle_y.
    delay
        Length that is added to relative lengths [m], of each shot.
    lanes
        Lanes of the paths that have the pose of their shot; none for one pose of all paths.
    """

    origin: NDArray[np.float64]
    axis: NDArray[np.float64]
    far: NDArray[np.float64]
    left: NDArray[np.float64]
    delay: float | NDArray[np.float64] = 0.0
    lanes: Lanes | None = None

    @classmethod
    def from_angles(cls, altitude: float, off_nadir_deg: float, aim_x: float = 0.0, aim_y: float = 0.0) -> Pose:
        """Return the pose whose axis lies in the x-z plane and points to +x, and down or, under water, up.

        Parameters
        ----------
        altitude
            Height above the mean sea level [m], 0.1 to 1e6, or -1000 to -0.1 under water.
        off_nadir_deg
            Angle of the axis from the downward vertical [deg], 0 to 89.9, or 0 to 180 under water.
        aim_x, aim_y
            Point where the axis meets the mean sea level [m], -1e6 to 1e6; under water the point above the pose.

        Values out of range raise UserError.
        """
        altitude = ranged("altitude", altitude)
        if abs(altitude) < _NEAREST:
            raise UserError(
                f"altitude = {altitude:g} must lie between {_NEAREST:g} and {RANGES['altitude'][1]:g}, or "
                f"{RANGES['altitude'][0]:g} and {-_NEAREST:g} under water"
            )
        angle = np.deg2rad(in_range("off_nadir_deg", off_nadir_deg, 0.0, 89.9 if altitude > 0 else 180.0))
        sin, cos = np.sin(angle), np.cos(angle)
        back = altitude * sin / cos if altitude > 0 else 0.0
        origin = np.array([ranged("aim_x", aim_x) - back, ranged("aim_y", aim_y), altitude])
        return cls(origin, np.array([sin, 0.0, -cos]), np.array([cos, 0.0, sin]), np.array([0.0, 1.0, 0.0]))

    @classmethod
    def from_properties(cls, props: mi.Properties) -> Pose:
        """Read ``to_world``, or ``altitude``, ``off_nadir_deg``, ``aim_x`` and ``aim_y``, from plugin parameters.

        ``to_world`` maps the local axes as Mitsuba's ``look_at`` with ``up = (0, 0, 1)`` does: z is the optical
        axis, y is +angle_x (away from nadir) and x is +angle_y.
        """
        if "to_world" in props:
            if "altitude" in props or "off_nadir_deg" in props:
                raise UserError(f"{props.plugin_name()}: give either to_world or altitude and off_nadir_deg, not both")
            matrix = np.array(props["to_world"].matrix, dtype=np.float64)
            lengths = np.linalg.norm(matrix[:3, :3], axis=0)
            if not (np.isfinite(matrix).all() and np.all(lengths > 0)):
                raise UserError(f"{props.plugin_name()}: to_world must be finite, and no axis have a scale of 0")
            frame = matrix[:3, :3] / lengths
            if not np.allclose(frame.T @ frame, np.eye(3), atol=1e-4) or np.linalg.det(frame) < 0:
                raise UserError(
                    f"{props.plugin_name()}: to_world must be a rotation and a translation, without shear or reflection"
                )
            return cls(matrix[:3, 3], frame[:, 2], frame[:, 1], frame[:, 0])
        return cls.from_angles(
            props.get("altitude", 200.0),
            props.get("off_nadir_deg", 20.0),
            props.get("aim_x", 0.0),
            props.get("aim_y", 0.0),
        )

    def of(self, lanes: Lanes) -> Pose:
        """Return the poses with the lanes of paths."""
        return replace(self, lanes=lanes)

    def moved(self, rotation: NDArray[np.float64], shift: NDArray[np.float64]) -> Pose:
        """Return the poses after rotations, shape (shots, 3, 3), and displacements [m], shape (shots, 3)."""
        origin, axis, far, left = (rotation @ each for each in (self.origin, self.axis, self.far, self.left))
        return Pose(origin + shift, axis, far, left)

    def number(self, values: float | NDArray[np.float64]) -> mi.Float:
        """Return a number of all paths, or that of the shot of each path of shape (shots,), as kernels read it."""
        if np.ndim(values) == 0:
            return opaque(float(values))
        assert self.lanes is not None
        return self.lanes.pick(aligned(mi.Float, np.asarray(values, np.float32)))

    def vector(self, values: NDArray[np.float64]) -> mi.Vector3f:
        """Return a vector of all paths, shape (3,), or of the shot of each path, shape (shots, 3)."""
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

    @property
    def off_nadir_deg(self) -> float:
        """Angle of the axis from the vertical [deg]."""
        return float(np.degrees(np.arccos(np.clip(-self.axis[2], -1, 1))))

    @property
    def submerged(self) -> bool:
        """Whether the pose is under water."""
        return bool(np.max(self.origin[..., 2]) < 0)

    def require_above_sea(self) -> None:
        """Raise UserError for a pose under water."""
        if self.submerged:
            raise UserError(f"altitude = {self.origin[2]:g} is under water: this needs a lidar above the sea")

    def ground_point(self) -> NDArray[np.float64]:
        """Return where the axis meets the mean sea level z = 0 [m]; a distant point if it does not point down.

        For a pose under water it is the point 10 m ahead.
        """
        if self.submerged:
            return self.origin + _UNDER_WATER_RANGE * self.axis
        slope = min(float(self.axis[2]), -1e-6)
        return self.origin + self.axis * (-float(self.origin[2]) / slope)

    def nearby_point(self) -> NDArray[np.float64]:
        """Return the point in view to which lengths of paths are relative [m]: on the mean sea level, or the origin."""
        down = self.origin[2] > 0 and self.axis[2] < -_SMALLEST_DESCENT
        return self.ground_point() if down else self.origin

    def tangent_of_point(self, point: NDArray[np.float64]) -> tuple[float, float]:
        """Return (angle_x, angle_y) in radians of a point [m], shape (3,)."""
        offset = point - self.origin
        along = float(offset @ self.axis)
        return float(offset @ self.far) / along, float(offset @ self.left) / along


class RelativePose:
    """A pose relative to a reference point in the scene: accurate from orbit in single precision.

    Distances are relative to that of the reference point r. With the pose's origin o and a point p,
    |p - o| - |r - o| = (p - r) . (p - r + 2 (r - o)) / (|p - o| + |r - o|). Single precision has rounding errors of
    3 cm in coordinates and distances of 500 km, but of less than 0.1 mm in such differences to points within 100 m.

    Parameters
    ----------
    pose
        Transmitter or receiver.
    reference
        Reference point [m], shape (3,).
    """

    def __init__(self, pose: Pose, reference: NDArray[np.float64]) -> None:
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
        """Return (angle_x, angle_y) of points and the cosine of their directions with the axis; see `Pose.tangent`."""
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
