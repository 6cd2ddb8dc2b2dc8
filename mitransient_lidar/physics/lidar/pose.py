"""Position and axis of a transmitter or receiver, and tangent-plane angles about the axis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.lidar import LIDAR_TRANSMITTER
from mitransient_lidar.core.validation import FloatArray, IntArray, in_range

_NEAREST = 0.1  #: Smallest distance of a pose from the mean sea level [m].
_UNDER_WATER_RANGE = 10.0  #: Distance from a pose under water at which its axis stands for its beam or view [m].

_SMALLEST_DESCENT = 1e-3  #: Vertical component of an axis below which it is taken as level.
_SMALLEST_AZIMUTH = 1e-9  #: Horizontal component of an axis below which it has no azimuth.


@dataclass(frozen=True)
class Pose:
    """Position and axis of a transmitter or receiver, for one shot or several.

    A tangent-plane point about the axis is (angle_x, angle_y), in radians. Its direction is the unit vector along
    ``axis + angle_x * far + angle_y * left``. The angle_x axis points away from nadir, and angle_y along +y for the
    default pose.
    """

    origin: FloatArray  #: Position [m], shape (3,) or (shots, 3).
    #: Orthonormal directions: the optical axis, the +angle_x direction and the +angle_y direction.
    axis: FloatArray
    far: FloatArray
    left: FloatArray

    @classmethod
    def from_angles(cls, altitude: float, off_nadir_deg: float, aim_x: float = 0.0, aim_y: float = 0.0) -> Self:
        """Return the pose whose axis lies in the x-z plane and points to +x, and down or, under water, up.

        `altitude`: height above the mean sea level [m], 0.1 to 1e6, or -1000 to -0.1 under water. `off_nadir_deg`: axis
        angle from the downward vertical [deg], 0 to 89.9, or 0 to 180 under water. `aim_x`, `aim_y`: point where the
        axis meets the mean sea level [m], -1e7 to 1e7. Under water it is the point above the pose.

        Values out of range raise UserError.
        """
        allowed = LIDAR_TRANSMITTER["altitude"]
        altitude = allowed.number(altitude)
        if abs(altitude) < _NEAREST:
            raise UserError(
                f"altitude = {altitude:g} must lie between {_NEAREST:g} and {allowed.high:g}, or "
                f"{allowed.low:g} and {-_NEAREST:g} under water"
            )
        angle = np.deg2rad(in_range("off_nadir_deg", off_nadir_deg, 0.0, 89.9 if altitude > 0 else 180.0))
        sin, cos = np.sin(angle), np.cos(angle)
        back = altitude * sin / cos if altitude > 0 else 0.0
        x, y = (LIDAR_TRANSMITTER[name].number(value) for name, value in (("aim_x", aim_x), ("aim_y", aim_y)))
        origin = np.array([x - back, y, altitude])
        return cls(origin, np.array([sin, 0.0, -cos]), np.array([cos, 0.0, sin]), np.array([0.0, 1.0, 0.0]))

    @classmethod
    def from_matrix(cls, name: str, matrix: FloatArray) -> Self:
        """Return the pose by a transformation, shape (4, 4), a parameter with this name.

        It maps the local axes as Mitsuba's ``look_at`` with ``up = (0, 0, 1)`` does. The optical axis is z, +angle_x
        (away from nadir) is y, and +angle_y is x. A matrix that is not a rotation, a scale and a translation raises
        UserError.
        """
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        if not (np.isfinite(matrix).all() and np.all(lengths > 0)):
            raise UserError(f"{name} must be finite, and no axis have a scale of 0")
        frame = matrix[:3, :3] / lengths
        if not np.allclose(frame.T @ frame, np.eye(3), atol=1e-4) or np.linalg.det(frame) < 0:
            raise UserError(f"{name} must be a rotation and a translation, without shear or reflection")
        return cls(matrix[:3, 3], frame[:, 2], frame[:, 1], frame[:, 0])

    @property
    def frame(self) -> FloatArray:
        """The directions axis, far and left as rows, shape (..., 3, 3)."""
        return np.stack([self.axis, self.far, self.left], axis=-2)

    def moved(self, rotation: FloatArray, shift: FloatArray) -> Self:
        """Return the poses after rotations, shape (..., 3, 3), and displacements [m], shape (..., 3)."""
        origin, axis, far, left = (rotation @ each for each in (self.origin, self.axis, self.far, self.left))
        return replace(self, origin=origin + shift, axis=axis, far=far, left=left)

    def part(self, rows: slice | IntArray) -> Self:
        """Return the poses for some shots."""
        return replace(self, **{name: getattr(self, name)[rows] for name in ("origin", "axis", "far", "left")})

    def rays(self, angles: FloatArray) -> FloatArray:
        """Return directions for tangent-plane angles [rad], shape (..., 2), with the length 1/cos to the axis."""
        return np.asarray(self.axis + angles[..., :1] * self.far + angles[..., 1:] * self.left)

    def directions(self, angles: FloatArray) -> FloatArray:
        """Return unit directions of tangent-plane angles [rad], shape (..., 2)."""
        rays = self.rays(angles)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def angles_of(self, directions: FloatArray) -> FloatArray:
        """Return the tangent-plane angles [rad], shape (..., 2), for directions of any length, shape (..., 3).

        Directions behind the pose give the angles of the opposite directions.
        """
        along = directions @ self.axis
        return np.stack([directions @ self.far / along, directions @ self.left / along], axis=-1)

    @property
    def off_nadir_deg(self) -> float:
        """Axis angle from the vertical [deg]."""
        return float(np.degrees(np.arccos(np.clip(-self.axis[2], -1, 1))))

    @property
    def azimuth(self) -> FloatArray:
        """Axis direction from +x to +y [rad], 0 for a vertical axis, shape (...,)."""
        x, y = self.axis[..., 0], self.axis[..., 1]
        return np.where(np.hypot(x, y) > _SMALLEST_AZIMUTH, np.arctan2(y, x), 0.0)

    @property
    def submerged(self) -> bool:
        """Whether the pose is under water."""
        return bool(np.max(self.origin[..., 2]) < 0)

    def require_above_sea(self) -> None:
        """Raise UserError for a pose under water."""
        if self.submerged:
            raise UserError(f"altitude = {self.origin[2]:g} is under water: this needs a lidar above the sea")

    def ground_point(self) -> FloatArray:
        """Return where the axis meets the mean sea level z = 0 [m]; a distant point if it does not point down.

        For a pose under water it is the point 10 m ahead.
        """
        if self.submerged:
            return self.origin + _UNDER_WATER_RANGE * self.axis
        slope = np.minimum(self.axis[..., 2:], -1e-6)
        return np.asarray(self.origin + self.axis * (-self.origin[..., 2:] / slope))

    @property
    def ground_range(self) -> float:
        """Distance to the ground point [m]."""
        return float(np.linalg.norm(self.ground_point() - self.origin))

    @property
    def looks_down(self) -> bool:
        """Whether the axis meets the mean sea level from above."""
        return bool(self.origin[2] > 0 and self.axis[2] < -_SMALLEST_DESCENT)

    def nearby_point(self) -> FloatArray:
        """Return the point in view to which lengths of paths are relative [m]: on the mean sea level, or the origin."""
        return self.ground_point() if self.looks_down else self.origin
