"""Trajectories: position and attitude of a platform over time."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import one_of
from mitransient_lidar.core.validation import FloatArray, IntArray, finite_array, positive, shown
from mitransient_lidar.flights.poses.records import PlatformPoses, RotationSpec, check_records, rotation_matrices

#: Interpolation between records.
Interpolation = Literal["linear", "cubic"]

#: Longest time between records that splines go through, with its rounding, and fewest of such records [s].
_DENSE_S, _FEWEST_DENSE = 1.0 + 1e-6, 3

#: Most pulses of a flight.
_MOST_PULSES = 10**8

#: Pulses later than the end of a line by less than this part of their interval belong to it.
_LAST_PULSE = 1e-6


@dataclass(frozen=True, eq=False)
class InterpolatedPoses(PlatformPoses):
    """Poses of a platform at any times, roll and pitch -180 to 180 and yaw 0 to 360 degrees.

    `rotation`: matrices from the axes of the platform to those of the scene, shape (n, 3, 3). `line`: number of the
    flight line, from 0, shape (n,).
    """

    rotation: FloatArray
    line: IntArray


@dataclass(frozen=True, eq=False)
class Trajectory(PlatformPoses):
    """Position and attitude of a platform over time, and its flight lines.

    Axes of the platform are x to the right, y forward and z up. Between records, positions and angles are linear in
    time, or cubic splines (twice differentiable, not-a-knot ends) through records that follow each other within 1 s,
    and linear elsewhere. Angles take the shorter way round.

    Parameters
    ----------
    time_s, position, roll_deg, pitch_deg, yaw_deg
        The records, 2 or more at strictly increasing times.
    rotation_spec
        Order of the rotations, as in `records.rotation_matrices`.
    interpolation
        ``linear``, or ``cubic`` for records of a motion that is smooth.
    lines
        First and last time [s] of each flight line, within the records and in order, shape (lines, 2); by default one
        line from the first record to the last.

    Raises
    ------
    UserError
        For arrays of other shapes, another interpolation, and for the first record that is not finite or not later than
        the one before.
    """

    rotation_spec: RotationSpec = "aerospace"
    interpolation: Interpolation = "linear"
    lines: FloatArray = field(default_factory=lambda: np.empty((0, 2)))

    def __post_init__(self) -> None:
        for one in fields(self):
            if one.name not in ("rotation_spec", "interpolation"):
                object.__setattr__(self, one.name, _array(one.name, getattr(self, one.name)))
        one_of("rotation_spec", self.rotation_spec, get_args(RotationSpec))
        one_of("interpolation", self.interpolation, get_args(Interpolation))
        count = self.time_s.size
        for name in ("position", "roll_deg", "pitch_deg", "yaw_deg"):
            shape, wanted = getattr(self, name).shape, (count, 3) if name == "position" else (count,)
            if shape != wanted:
                raise UserError(f"{name} has the shape {shape}: it must be {wanted}")
        check_records(self, "a trajectory", lambda row: f"record {row + 1} of a trajectory")
        if self.lines.size == 0:
            object.__setattr__(self, "lines", self.time_s[[0, -1]][None])
        self._check_lines()

    def at(self, times: npt.ArrayLike) -> InterpolatedPoses:
        """Return the poses at times [s], shape (n,); raise `UserError` for a time that is on no flight line."""
        time = np.atleast_1d(finite_array("times", times))
        line = np.searchsorted(self.lines[:, 0], time, side="right") - 1
        outside = (line < 0) | (time > self.lines[line, 1])
        for row in np.flatnonzero(outside)[:1]:
            raise UserError(
                f"time = {time[row]:.10g} s (number {row + 1}) is on no flight line: the lines are {self._lines_text()}"
            )
        values = self._interpolated(time)
        position, (roll, pitch, yaw) = values[:, :3], values[:, 3:].T
        roll, pitch, yaw = 180 - (180 - roll) % 360, 180 - (180 - pitch) % 360, yaw % 360
        rotation = rotation_matrices(roll, pitch, yaw, self.rotation_spec)
        return InterpolatedPoses(time, position, roll, pitch, yaw, rotation, line)

    def _interpolated(self, time: FloatArray) -> FloatArray:
        """Return positions [m] and angles [deg], which may exceed a turn, at times on flight lines, shape (n, 6)."""
        records = self.time_s
        angles = (np.unwrap(angle, period=360.0) for angle in (self.roll_deg, self.pitch_deg, self.yaw_deg))
        values = np.column_stack([self.position, *angles])
        found = np.column_stack([np.interp(time, records, one) for one in values.T])
        if self.interpolation == "linear":
            return found
        ends = np.flatnonzero(np.diff(records) > _DENSE_S) + 1
        bounds = np.concatenate([[0], ends, [records.size]])
        for run in np.flatnonzero(np.diff(bounds) >= _FEWEST_DENSE):
            own = slice(bounds[run], bounds[run + 1])
            within = (time >= records[own][0]) & (time <= records[own][-1])
            if np.any(within):
                found[within] = CubicSpline(records[own], values[own])(time[within])
        return found

    def pulse_times(self, pulse_rate_hz: float) -> FloatArray:
        """Return the times [s] of pulses on all flight lines, shape (pulses,); each line begins with a pulse.

        Raises
        ------
        UserError
            For a rate [Hz] that is not positive or gives more than 10^8 pulses.
        """
        rate = positive("pulse_rate_hz", pulse_rate_hz)
        # Times since 1980 are rounded by a tenth of a microsecond.
        rounding = 2 * np.spacing(np.abs(self.lines).max()) * rate
        counts = np.floor((self.lines[:, 1] - self.lines[:, 0]) * rate + max(_LAST_PULSE, rounding)) + 1
        if counts.sum() > _MOST_PULSES:
            raise UserError(
                f"pulse_rate_hz = {rate:g} gives {counts.sum():.3g} pulses: at most {_MOST_PULSES:g} may be"
            )
        return np.concatenate(
            [
                np.minimum(first + np.arange(int(count)) / rate, last)
                for (first, last), count in zip(self.lines, counts, strict=True)
            ]
        )

    def _check_lines(self) -> None:
        """Raise `UserError` for flight lines that are no intervals within the records, one after the other."""
        lines, first, last = self.lines, self.time_s[0], self.time_s[-1]
        if lines.ndim != 2 or lines.shape[1] != 2 or not np.isfinite(lines).all():
            raise UserError(f"lines of shape {lines.shape} must be pairs of a first and a last time in seconds")
        if (np.diff(lines.ravel()) <= 0).any():
            raise UserError(f"the times of the flight lines, {self._lines_text()}, must increase")
        if lines[0, 0] < first or lines[-1, 1] > last:
            raise UserError(
                f"the flight lines, {self._lines_text()}, must lie in the trajectory, {first:.10g} to {last:.10g} s"
            )

    def _lines_text(self) -> str:
        """Return the times of the first flight lines, for messages."""
        texts = [f"{first:.10g} to {last:.10g} s" for first, last in self.lines[:4]]
        return ", ".join(texts) + (f" and {len(self.lines) - 4} more" if len(self.lines) > 4 else "")


def _array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Return a new array; raise `UserError` for values that are no numbers."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name} = {shown(values)} must hold numbers only") from None
