"""What values and positions of a height file mean: unit, sign, missing values and coordinate system."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.grids import Stated, undeclared_no_data, without_no_data
from mitransient_lidar.core.headings import METRES
from mitransient_lidar.core.validation import FloatArray, finite

#: Largest angles [deg], and the cell below which positions among them are taken for degrees.
_LARGEST_ANGLES, _SMALLEST_CELL = (360.0, 90.0), 0.02

_ALLOWED = "m, cm, km, ft, ftUS, fathom"


def length_unit(name: str, unit: str) -> float:
    """Return a unit in metres; `name` is what is in it, for the message.

    Raises
    ------
    UserError
        If it is no unit of length.
    """
    key = re.sub(r"[\s_.]+", "", unit.lower())
    if key not in METRES:
        raise UserError(f"{name} in {unit!r}: allowed are {_ALLOWED}.")
    return METRES[key]


def heights_in_metres(
    path: Path,
    values: npt.NDArray[np.float64],
    stated: Stated,
    sign: str | None = None,
    unit: str | None = None,
    no_data: float | None = None,
) -> FloatArray:
    """Return heights above the mean sea level [m], positive up, NaN where there is none.

    Parameters
    ----------
    path : Path
        Their file, for messages.
    values : ndarray
        Values as in the file, NaN where they are declared to be missing.
    stated : Stated
        What the file states of them.
    sign : {'heights', 'depths'}, optional
        Whether they are positive up or down. Default: what the file states, or up.
    unit : str, optional
        Their unit, where the file does not state it. Default: metres.
    no_data : float, optional
        Value without a height, which the file does not declare.

    Raises
    ------
    UserError
        If the unit is unknown, contradicts the file's, or is not stated beside positions that are not in metres; or
        heights are beyond 12 000 m, or look like a value for no data.
    """
    if sign not in (None, "heights", "depths"):
        raise UserError(f"map_values = {sign!r} must be heights or depths")
    metres = _height_unit(path, stated, unit)
    values = without_no_data(values, None if no_data is None else finite("map_no_data", no_data))
    if suspect := undeclared_no_data(values, metres):
        raise UserError(
            f"{path} has {suspect.times} of {values.size} heights of {suspect.value:.9g}, {suspect.reason}, which it"
            f" does not declare to be no data: map_no_data = {suspect.value:.9g} of a seabed must say so if they are."
        )
    is_down = bool(stated.is_down) if sign is None else sign == "depths"
    return -metres * values if is_down else metres * values


def _height_unit(path: Path, stated: Stated, unit: str | None) -> float:
    """Return the unit of heights in metres."""
    given = None if unit is None else length_unit("map_unit is", unit)
    system = stated.system
    if stated.unit:
        from_system = system is not None and stated.unit == system.vertical_unit
        metres = system.vertical_metres if from_system and system else length_unit(f"{path} has heights", stated.unit)
        if given is not None and not math.isclose(given, metres, rel_tol=1e-9):
            raise UserError(f"map_unit = {unit!r} must not differ from that of {path}, {stated.unit}.")
        return metres
    if given is None and position_unit(path, stated) != 1:
        raise UserError(
            f"{path} has positions in {stated.position_unit} but does not state the unit of its heights: map_unit must,"
            f" one of {_ALLOWED}."
        )
    return 1.0 if given is None else given


def position_unit(path: Path, stated: Stated) -> float:
    """Return the unit of positions in metres, 1 where it is not stated."""
    if stated.system is not None and stated.position_unit == stated.system.unit:
        return stated.system.metres
    return length_unit(f"{path} has positions", stated.position_unit) if stated.position_unit else 1.0


def check_positions(path: Path, stated: Stated, x: FloatArray, y: FloatArray, cell: float) -> None:
    """Refuse positions that are degrees, or whose metres are not those on the ground.

    Parameters
    ----------
    path : Path
        Their file, for messages.
    stated : Stated
        What the file states of them.
    x, y : ndarray
        Positions as in the file, at least the least and the largest of them.
    cell : float
        Typical distance of neighbours.
    """
    middle = [0.5 * float(one.min() + one.max()) for one in (x, y)]
    if stated.system is not None:
        # CF asks for units of the coordinates themselves, which may be kilometres.
        unit = position_unit(path, stated) / stated.system.metres
        stated.system.check_scale(path, unit * middle[0], unit * middle[1])
        return
    is_within = all(np.abs(one).max() <= most for one, most in zip((x, y), _LARGEST_ANGLES, strict=True))
    is_away = any(abs(place) > 2 * float(np.ptp(one)) for place, one in zip(middle, (x, y), strict=True))
    if not stated.position_unit and is_within and is_away and cell < _SMALLEST_CELL:
        raise UserError(
            f"{path} has positions about ({middle[0]:.6g}, {middle[1]:.6g}) in cells of {cell:.2g}, which look like"
            " degrees: they must be projected, in metres, or their unit be stated."
        )


def described(stated: Stated, values: str | None, unit: str | None, holes: int) -> str:
    """Return a description of what a file states, for the log."""
    system = stated.system
    sign = {True: "down", False: "up", None: "up (not stated)"}[stated.is_down]
    sign = {"depths": "down", "heights": "up", None: sign}[values]
    datum = system.datum if system and system.datum else "mean sea level (not stated)"
    return (
        f"values in {stated.unit or unit or 'm (not stated)'}, positive {sign}, zero at {datum}, {holes} holes; "
        f"positions in {stated.position_unit or 'm (not stated)'}, coordinate system "
        f"{system.name if system else 'not stated'}"
    )
