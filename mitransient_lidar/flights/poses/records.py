"""Records of a trajectory, and their checks."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray

#: Largest number of a record: angles in double precision keep 0.1 millidegrees.
_LARGEST = 1e12


class TrajectoryRecords(NamedTuple):
    """Positions and attitudes of a platform, one for each time."""

    time_s: FloatArray  #: Times [s], shape (n,).
    position: FloatArray  #: Positions x, y, z [m], shape (n, 3).
    roll_deg: FloatArray  #: Roll [deg], shape (n,).
    pitch_deg: FloatArray  #: Pitch [deg], shape (n,).
    yaw_deg: FloatArray  #: Yaw [deg], shape (n,).


def check_records(records: TrajectoryRecords, source: str, place: Callable[[int], str]) -> None:
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
