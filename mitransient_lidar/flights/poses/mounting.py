"""Mounting a scanner on a platform, and the lines of sight of all pulses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.options import Option, Plan
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.flights.poses.records import rotation_matrices
from mitransient_lidar.flights.poses.scanner import Scanner
from mitransient_lidar.flights.poses.trajectory import Trajectory
from mitransient_lidar.physics.lidar.pose import Pose

#: Step of the angles of pixels about their axis [deg], and sine of the angle from nadir below which they have none.
_TURN_DEG, _LEVEL = 10.0, 1e-6


@dataclass(frozen=True)
class Mounting(Plan):
    """Position and attitude of a scanner on its platform.

    Angles are from the platform axes, with signs and order ``aerospace`` of `records.rotation_matrices`.
    """

    roll_deg: Annotated[float, Option("Roll, which turns the nadir of the scanner to the left", unit="deg")] = 0.0
    pitch_deg: Annotated[float, Option("Pitch, which turns it forward", unit="deg")] = 0.0
    yaw_deg: Annotated[float, Option("Yaw, which turns its forward axis to the right", unit="deg")] = 0.0
    lever_arm: Annotated[
        tuple[float, float, float],
        Option(
            "Position of the scanner from the point whose positions the trajectory has, x to the right, y forward and "
            "z up in the axes of the platform",
            unit="m",
            form="x, y and z in metres",
        ),
    ] = (0.0, 0.0, 0.0)

    @property
    def rotation(self) -> FloatArray:
        """Matrix from scanner to platform axes, shape (3, 3)."""
        return rotation_matrices(self.roll_deg, self.pitch_deg, self.yaw_deg)


@dataclass(frozen=True)
class PulsePoses(Pose):
    """Scanner poses at pulses in the scene frame, x east, y north and z up."""

    time_s: FloatArray  #: Times [s], shape (shots,).
    #: Angles of the pulses across the flight from the vertical [deg], positive to the right of the platform's forward
    #: axis, so that a roll counts as in LAS files, shape (shots,).
    scan_angle_deg: FloatArray
    line: IntArray  #: Numbers of the flight lines, from 0, shape (shots,).


def pulse_poses(trajectory: Trajectory, mounting: Mounting, scanner: Scanner, times: npt.ArrayLike) -> PulsePoses:
    """Return lines of sight of pulses.

    With platform rotation R and mounting rotation M, a scanner direction d is R M d in the scene. The scanner is at the
    trajectory's position plus R times the lever arm.

    `trajectory`, `mounting`, `scanner`: platform motion, scanner place on it, and scan. `times`: times of the pulses
    [s], on the flight lines, shape (shots,).

    Raises `UserError` for a time that is not finite or on no flight line.
    """
    platform = trajectory.at(times)
    parts = np.split(platform.time_s, np.flatnonzero(np.diff(platform.line)) + 1)
    scan = (np.concatenate(one) for one in zip(*map(scanner.directions, parts), strict=True))
    turned = platform.rotation @ mounting.rotation
    axis, far, left = (np.einsum("nij,nj->ni", turned, one) for one in scan)
    # Horizontal part of the forward axis; a platform that points up or down has none, and its scan angle is 0.
    ahead_x, ahead_y = platform.rotation[:, 0, 1], platform.rotation[:, 1, 1]
    level = np.hypot(ahead_x, ahead_y)
    right = (axis[:, 0] * ahead_y - axis[:, 1] * ahead_x) / np.where(level > 0, level, 1.0)
    return PulsePoses(
        time_s=platform.time_s,
        origin=platform.position + platform.rotation @ np.array(mounting.lever_arm),
        axis=axis,
        far=far,
        left=left,
        scan_angle_deg=np.degrees(np.arctan2(right, -axis[:, 2])),
        line=platform.line,
    )


def poses_of(column: Callable[[str], FloatArray]) -> Pose:
    """Return the poses of pulses from columns such as ``origin_x``, by their names."""
    names = ("origin", "axis", "far", "left")
    return Pose(*(np.column_stack([column(f"{name}_{axis}") for axis in "xyz"]) for name in names))


def pixel_turns(poses: Pose) -> FloatArray:
    """Return the angles [deg] by which pixels are turned about their axis, from far to left, shape (shots,).

    They point to the plane of incidence, rounded to multiples of 10 degrees, -170 to 180; 0 for vertical axes.
    """
    axis, far = poses.axis, poses.far
    # Left of the plane of incidence is level.
    left = np.stack([-axis[:, 1], axis[:, 0], np.zeros(len(axis))], axis=1)
    outwards = np.cross(axis, left)
    turn = np.degrees(np.arctan2(np.sum(far * left, axis=1), np.sum(far * outwards, axis=1)))
    steps = np.round(turn / _TURN_DEG) * _TURN_DEG
    return np.where(np.hypot(axis[:, 0], axis[:, 1]) > _LEVEL, np.where(steps == -180, 180.0, steps + 0.0), 0.0)
