"""Trajectories: platform position and attitude over time, from text files or SBET files (inertial navigation)."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import check_size
from mitransient_lidar.core.maps import (
    LARGEST_DISTORTION,
    distortions,
    is_east_north,
    parsed_system,
)
from mitransient_lidar.core.options import one_of
from mitransient_lidar.core.tables.headings import METRES, Column, Heading, read_headings
from mitransient_lidar.core.tables.text_tables import read_head, read_long_table
from mitransient_lidar.core.validation import FloatArray, IntArray, finite_array, integer, positive, shown
from mitransient_lidar.flights.poses.records import PlatformPoses, RotationSpec, check_records, rotation_matrices

_SECONDS = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6}
_DEGREES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0, "rad": math.degrees(1.0)}

#: Columns of a text file, in the order that holds without a heading.
_COLUMNS = (
    Column("t", ("time", "gps time"), _SECONDS),
    Column("roll", (), _DEGREES),
    Column("pitch", (), _DEGREES),
    Column("yaw", ("heading",), _DEGREES),
    Column("x", ("easting",), METRES),
    Column("y", ("northing",), METRES),
    Column("z", ("height",), METRES),
)

#: Numbers of a record of an SBET file, and the largest file [bytes]: eleven hours of 200 records a second.
_SBET_NUMBERS, _LARGEST_SBET = 17, 2**30


def read_text_records(path: str | os.PathLike[str]) -> PlatformPoses:
    """Read a trajectory from a text file as HELIOS++ does.

    Each line is a record: time [s], roll, pitch, yaw [deg], x, y, z [m], as `text_tables.read_long_table` reads
    it. Another order is given by the names of the columns, with units or without, in a line
    ``#HEADER: "t", "x", ...`` or in a first line without numbers; ``#TIME_COLUMN: 0`` names the column of the time by
    its index from 0. Unlike HELIOS++, which sorts records, this function refuses times that go back.

    Raises UserError if the file cannot be read, a column or its unit is unknown, or a column is missing. Each line
    needs one finite number for each column, and a later time than the line before.
    """
    path = Path(path)
    head = {}
    for line in read_head(path).splitlines():
        key, colon, value = line.strip().lstrip("#").partition(":")
        if colon and line.startswith("#"):
            head[key.strip()] = value.strip()
    time_column = None
    if (given := head.get("TIME_COLUMN")) is not None:
        time_column = integer(f"{path}: TIME_COLUMN", int(given) if given.isdecimal() else given, 0, len(_COLUMNS) - 1)

    def choose(names: list[str]) -> list[tuple[int, Heading]]:
        if not names:
            order = [*range(1, len(_COLUMNS))]
            order.insert(time_column or 0, 0)
            return [(order.index(i), Heading(column, "", 0.0)) for i, column in enumerate(_COLUMNS)]
        if time_column is not None and time_column < len(names):
            names[time_column] = "t"
        headings = {one.column.name: (i, one) for i, one in enumerate(read_headings(path, names, _COLUMNS)) if one}
        if missing := [column.name for column in _COLUMNS if column.name not in headings]:
            raise UserError(
                f"{path} has the columns {', '.join(names)}: it must have {', '.join(missing)}, and each of "
                f"{', '.join(column.name for column in _COLUMNS)} once"
            )
        return [headings[column.name] for column in _COLUMNS]

    names = [name.strip(" \"'") for name in head.get("HEADER", "").split(",")] if "HEADER" in head else []
    table = read_long_table(path, _COLUMNS, (), choose, names)
    time, roll, pitch, yaw, *position = (table.values * [heading.factor for heading in table.headings]).T
    records = PlatformPoses(time, np.column_stack(position), roll, pitch, yaw)
    check_records(records, str(path), lambda row: f"{path}, line {table.line(row)}")
    return records


def read_sbet_records(path: str | os.PathLike[str], epsg: int) -> PlatformPoses:
    """Read a trajectory from an SBET file, and project it into a coordinate system.

    A record is 17 little-endian 64-bit numbers: time [s]; WGS 84 latitude and longitude [rad] and ellipsoidal height
    [m]; three velocities; roll, pitch and platform heading [rad]. Then follow wander angle [rad], three accelerations
    and three angular rates. The true heading is the platform heading minus the wander angle. Yaw is counted from grid
    north, from which true north differs by the meridian convergence.

    Raises UserError if the file cannot be read, has more than 1 GiB, or its size is no multiple of 136 bytes. A record
    must be finite, on the Earth, and later than the one before. The coordinate system must be known, in metres, and
    have this scale there.

    `path`: SBET file. `epsg`: EPSG code of projected coordinates in metres, such as 32633 for UTM zone 33 N. x is east
    and y north on the grid; z is the ellipsoidal height [m]. Positions have the grid scale, within a UTM zone 0.9996 to
    1.001; it may differ from 1 by 1 %.
    """
    import pyproj

    path = Path(path)
    width = 8 * _SBET_NUMBERS
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        check_size(path, size, _LARGEST_SBET)
        data = None if size % width else np.fromfile(file, dtype="<f8").reshape(-1, _SBET_NUMBERS)
    if data is None:
        raise UserError(f"{path} has {size} bytes, but an SBET file must have a multiple of {width}")

    def place(row: int) -> str:
        return f"{path}, record {row + 1}"

    time, latitude, longitude, height = data[:, :4].T
    with np.errstate(over="ignore", invalid="ignore"):
        roll, pitch, heading = np.degrees([data[:, 7], data[:, 8], data[:, 9] - data[:, 10]])
    check_records(PlatformPoses(time, data[:, [2, 1, 3]], roll, pitch, heading), str(path), place)
    wrong = (np.abs(latitude) > np.pi / 2) | (np.abs(longitude) > 2 * np.pi)
    for row in np.flatnonzero(wrong)[:1]:
        raise UserError(
            f"{place(row)}: latitude = {latitude[row]:g} and longitude = {longitude[row]:g} must be radians, up to"
            " pi / 2 and 2 pi"
        )
    system = _system(epsg)
    places = np.degrees(longitude), np.degrees(latitude)
    x, y = pyproj.Transformer.from_crs(4326, system, always_xy=True).transform(*places)
    north, scale = distortions(system, *places)
    for row in np.flatnonzero(~(np.abs(scale - 1) < LARGEST_DISTORTION))[:1]:
        raise UserError(
            f"{place(row)}: latitude = {np.degrees(latitude[row]):g} and longitude = {np.degrees(longitude[row]):g} deg"
            f" must lie where a metre is a metre within {LARGEST_DISTORTION:.0%} in epsg = {epsg}; its scale there is "
            f"{scale[row]:.3g}"
        )
    return PlatformPoses(time.copy(), np.column_stack([x, y, height]), roll, pitch, heading + north)


def _system(epsg: int) -> Any:
    """Return projected coordinates in metres by their EPSG code."""
    system = parsed_system("epsg", epsg)
    metric = all(axis.unit_conversion_factor == 1 for axis in system.axis_info[:2])
    if not (system.is_projected and metric and is_east_north(system)):
        raise UserError(f"epsg = {epsg} ({system.name}) must be projected coordinates in metres, east and north")
    return system


#: Interpolation between records.
Interpolation = Literal["linear", "cubic"]

#: Longest time between records that splines go through, with its rounding, and fewest of such records [s].
_DENSE_S, _FEWEST_DENSE = 1.0 + 1e-6, 3

_MOST_PULSES = 10**8  #: Most pulses of a flight.
_LAST_PULSE = 1e-6  #: Pulses later than the end of a line by less than this part of their interval belong to it.


@dataclass(frozen=True, eq=False)
class InterpolatedPoses(PlatformPoses):
    """Poses of a platform at any times, roll and pitch -180 to 180 and yaw 0 to 360 degrees.

    `rotation`: matrices from platform to scene axes, shape (n, 3, 3). `line`: number of the flight line, from 0, shape
    (n,).
    """

    rotation: FloatArray
    line: IntArray


@dataclass(frozen=True, eq=False)
class Trajectory(PlatformPoses):
    """Position and attitude of a platform over time, and its flight lines.

    Axes of the platform are x to the right, y forward and z up. Between records, positions and angles are linear in
    time, or cubic splines (twice differentiable, not-a-knot ends). Splines pass through records that follow each other
    within 1 s, with lines elsewhere. Angles take the shorter way round.

    `time_s`, `position`, `roll_deg`, `pitch_deg`, `yaw_deg`: the records, 2 or more at strictly increasing times.
    `rotation_spec`: order of the rotations, as in `records.rotation_matrices`. `interpolation`: ``linear``, or
    ``cubic`` for records of a motion that is smooth. `lines`: first and last time [s] of each flight line, within the
    records and in order, shape (lines, 2); by default one line from the first record to the last.

    Raises `UserError` for arrays of other shapes, another interpolation, and for the first record that is not finite or
    not later than the one before.
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

        Raises `UserError` for a rate [Hz] that is not positive or gives more than 10^8 pulses.
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
