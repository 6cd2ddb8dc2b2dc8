"""Times of trajectories: seconds of a flight, of a GPS week, or since the beginning of GPS time."""

from __future__ import annotations

import datetime
import logging
from typing import Literal

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray

_LOG = logging.getLogger(__name__)

#: Systems of times: from any beginning, that of a GPS week, 6 January 1980, and 10^9 s later, in 2011.
TimeSystem = Literal["flight", "gps_week", "gps", "adjusted_gps"]

#: What adjusted GPS times are less than those since 1980 [s].
ADJUSTMENT_S = 1e9

#: Latest time of a week whose flight ends on the next day, and earliest adjusted time [s], of January 2012.
_LATEST_OF_WEEK, _EARLIEST_ADJUSTED = 8 * 86_400, 1e7

#: Earliest time that may be Unix time [s], of September 2020, and GPS time of 2030.
_MAY_BE_UNIX = 1.6e9

#: Unix time less GPS time [s], with the 18 leap seconds since 2017.
_UNIX_LESS_GPS = 315_964_782

_EPOCH = datetime.datetime(1980, 1, 6)


def time_system(time_s: FloatArray, file: str | None = None, *, is_sbet: bool = False) -> TimeSystem:
    """Return the system of the times of a platform, where its table does not state it.

    Times of a file from 10^7 s on are adjusted GPS times, and from 10^9 s on GPS times. Smaller ones are of a week in
    an SBET file, up to a day after its end, and of the flight in a text file. Other platforms begin with their flight.

    Raises UserError if the times may be Unix times.

    Parameters
    ----------
    time_s
        Times [s], not empty.
    file
        File of the trajectory, None for other platforms.
    is_sbet
        Whether that is an SBET file.
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
