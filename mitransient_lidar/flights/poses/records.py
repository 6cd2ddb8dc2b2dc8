"""Records of a trajectory, and their checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray

#: Largest number of a record: angles in double precision keep 0.1 millidegrees.
_LARGEST = 1e12


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Positions and attitudes of a platform, one for each time.

    Parameters
    ----------
    time_s
        Times [s], shape (n,).
    position
        Positions x (east), y (north), z (up) [m], shape (n, 3).
    roll_deg, pitch_deg, yaw_deg
        Attitudes [deg], shape (n,): right side down, nose up, and clockwise from north.
    """

    time_s: FloatArray
    position: FloatArray
    roll_deg: FloatArray
    pitch_deg: FloatArray
    yaw_deg: FloatArray


def check_records(records: PlatformPoses, source: str, place: Callable[[int], str]) -> None:
    """Check that there are 2 records or more, of numbers from -1e12 to 1e12, at times that increase.

    Parameters
    ----------
    records
        Records whose arrays have matching lengths.
    source
        Name of all of them, for messages.
    place
        Name of a record, by its index from 0, for messages.

    Raises
    ------
    UserError
        For the first record with a fault.
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
