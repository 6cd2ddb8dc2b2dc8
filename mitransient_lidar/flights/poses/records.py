"""Trajectory records: attitudes, times (flight, GPS week or GPS time), and checks of both."""

from __future__ import annotations

import datetime
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray

#: Orders and signs of the three rotations, as factors from the left, of which the last acts first on a vector: name,
#: axis, and sign of the angle (+1: counterclockwise seen against the axis).
_FACTORS = {
    "aerospace": (("yaw", "z", -1), ("pitch", "x", 1), ("roll", "y", 1)),
    "ARINC 705": (("yaw", "z", -1), ("roll", "y", 1), ("pitch", "x", 1)),
    "CANONICAL": (("roll", "x", 1), ("pitch", "y", 1), ("yaw", "z", 1)),
}

#: Their names: the order of inertial navigation, and the two that HELIOS++ calls ``rotationSpec``.
RotationSpec = Literal["aerospace", "ARINC 705", "CANONICAL"]


def rotation_matrices(
    roll_deg: npt.ArrayLike, pitch_deg: npt.ArrayLike, yaw_deg: npt.ArrayLike, rotation_spec: RotationSpec = "aerospace"
) -> FloatArray:
    """Return the matrices that turn body vectors into scene vectors.

    ``aerospace`` is yaw . pitch . roll: roll first turns the vector about the forward axis (positive: right side down).
    Pitch then turns it about the axis to the right (positive: nose up). Yaw turns it about the downward vertical
    (positive: clockwise from above, so that yaw is the heading from north). ``ARINC 705``, the default of HELIOS++, has
    the same signs but yaw . roll . pitch: pitch acts first. ``CANONICAL`` of HELIOS++ is roll about x, pitch about y
    and yaw about z, all counterclockwise seen against the axis, with yaw acting first.

    `roll_deg`, `pitch_deg`, `yaw_deg`: angles [deg], shape (n,). `rotation_spec`: order of the rotations.

    Result: shape (n, 3, 3).
    """
    angles = {"roll": roll_deg, "pitch": pitch_deg, "yaw": yaw_deg}
    first, second, third = (
        _about(axis, sign * np.radians(np.asarray(angles[name], dtype=np.float64)))
        for name, axis, sign in _FACTORS[rotation_spec]
    )
    return np.asarray(first @ second @ third)


def _about(axis: str, angle: FloatArray) -> FloatArray:
    """Return the rotations by angles [rad], shape (n,), counterclockwise seen against an axis, shape (n, 3, 3)."""
    fixed = "xyz".index(axis)
    one, two = (fixed + 1) % 3, (fixed + 2) % 3
    matrices = np.zeros((*angle.shape, 3, 3))
    matrices[..., fixed, fixed] = 1.0
    matrices[..., one, one] = matrices[..., two, two] = np.cos(angle)
    matrices[..., two, one] = np.sin(angle)
    matrices[..., one, two] = -np.sin(angle)
    return matrices


_LOG = logging.getLogger(__name__)

#: Systems of times: from any beginning, that of a GPS week, 6 January 1980, and 10^9 s later, in 2011.
TimeSystem = Literal["flight", "gps_week", "gps", "adjusted_gps"]

ADJUSTMENT_S = 1e9  #: What adjusted GPS times are less than those since 1980 [s].

#: Latest time of a week whose flight ends on the next day, and earliest adjusted time [s], of January 2012.
_LATEST_OF_WEEK, _EARLIEST_ADJUSTED = 8 * 86_400, 1e7

_MAY_BE_UNIX = 1.6e9  #: Earliest time that may be Unix time [s], of September 2020, and GPS time of 2030.
_UNIX_LESS_GPS = 315_964_782  #: Unix time less GPS time [s], with the 18 leap seconds since 2017.

_EPOCH = datetime.datetime(1980, 1, 6)


def time_system(time_s: FloatArray, file: str | None = None, *, is_sbet: bool = False) -> TimeSystem:
    """Return a platform's time system, where its table does not state it.

    Times of a file from 10^7 s on are adjusted GPS times, and from 10^9 s on GPS times. In an SBET file, smaller ones
    count from a week's start, up to a day after its end. In a text file, they count from the flight's start. Other
    platforms begin with their flight.

    Raises UserError if the times may be Unix times.

    `time_s`: times [s], not empty. `file`: file of the trajectory, None for other platforms. `is_sbet`: whether that is
    an SBET file.
    """
    latest = float(np.max(time_s))
    if file is None:
        return "flight"
    if latest >= _MAY_BE_UNIX:
        raise UserError(
            f"the times of {file}, up to {latest:.10g} s, may be Unix times, which are {_UNIX_LESS_GPS} s more than "
            "GPS times: convert them, or give time = 'gps' in [platform]"
        )
    if latest >= _EARLIEST_ADJUSTED:
        return "gps" if latest >= ADJUSTMENT_S else "adjusted_gps"
    return "gps_week" if is_sbet and latest <= _LATEST_OF_WEEK else "flight"


def tell_time_system(system: str, time_s: FloatArray) -> None:
    """Log what GPS times are taken for, with their day."""
    if system in ("gps", "adjusted_gps"):
        since = float(np.min(time_s)) + ADJUSTMENT_S * (system == "adjusted_gps")
        day = (_EPOCH + datetime.timedelta(seconds=since)).date()
        _LOG.info(
            "times of the flight are %s times, from %s on", system.replace("_gps", " GPS").replace("gps", "GPS"), day
        )


_LARGEST = 1e12  #: Largest number of a record: angles in double precision keep 0.1 millidegrees.


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Positions and attitudes of a platform, one for each time."""

    time_s: FloatArray  #: Times [s], shape (n,).
    position: FloatArray  #: Positions x (east), y (north), z (up) [m], shape (n, 3).
    #: Attitudes [deg], shape (n,): right side down, nose up, and clockwise from north.
    roll_deg: FloatArray
    pitch_deg: FloatArray
    yaw_deg: FloatArray


def check_records(records: PlatformPoses, source: str, place: Callable[[int], str]) -> None:
    """Check that there are 2 records or more, of numbers from -1e12 to 1e12, at times that increase.

    `records`: records whose arrays have matching lengths. `source`: name of all of them, for messages. `place`: name of
    a record, by its index from 0, for messages.

    Raises `UserError` for the first record with a fault.
    """
    count = len(records.time_s)
    if count < 2:
        raise UserError(f"{source} has a number of records of {count}: it must be at least 2")
    columns = {
        "time": records.time_s,
        "roll": records.roll_deg,
        "pitch": records.pitch_deg,
        "yaw": records.yaw_deg,
        **dict(zip("xyz", records.position.T, strict=True)),
    }
    for name, values in columns.items():
        if not (allowed := np.abs(values) <= _LARGEST).all():
            row = int(np.argmin(allowed))
            raise UserError(f"{place(row)}: {name} = {values[row]} must be a number from {-_LARGEST:g} to {_LARGEST:g}")
    if (backward := np.flatnonzero(np.diff(records.time_s) <= 0)).size:
        row = int(backward[0]) + 1
        before, after = records.time_s[row - 1 : row + 1].tolist()
        raise UserError(f"{place(row)}: time = {after!r} s must be later than that of the record before, {before!r} s")
