"""Readers of trajectories: text files as HELIOS++ reads them, and SBET files of inertial navigation."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.core.array_files import check_size
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file, read_text
from mitransient_lidar.core.validation import FloatArray, integer, is_number
from mitransient_lidar.flights.poses.records import TrajectoryRecords, check_records

#: Columns of a text file, in the order that holds without a heading, and what a heading may call them.
_COLUMNS = {
    "t": ("t", "time", "time_s", "gps_time"),
    "roll": ("roll", "roll_deg"),
    "pitch": ("pitch", "pitch_deg"),
    "yaw": ("yaw", "yaw_deg", "heading", "heading_deg"),
    "x": ("x", "x_m", "easting"),
    "y": ("y", "y_m", "northing"),
    "z": ("z", "z_m", "height"),
}

#: Largest text file [bytes]: four million records.
_LARGEST_TEXT = 2**28

#: Numbers of a record of an SBET file, and the largest file [bytes]: eleven hours of 200 records a second.
_SBET_NUMBERS, _LARGEST_SBET = 17, 2**30

#: Largest code of a coordinate system.
_LARGEST_EPSG = 10**6

#: Step that gives the direction of a meridian in a projection [deg], about a metre.
_STEP = 1e-5

#: Length of a degree of a meridian [m], within 0.6 %.
_METRES_PER_DEGREE = 111_130.0

#: Largest difference of the scale of a grid from 1: no UTM zone has it, but Mercator's projection beyond 18 degrees.
_LARGEST_DISTORTION = 0.05


def read_text_records(path: str | os.PathLike[str]) -> TrajectoryRecords:
    """Read a trajectory from a text file as HELIOS++ does.

    Each line is a record: time [s], roll, pitch, yaw [deg], x, y, z [m], separated by commas, semicolons, tabs or
    blanks. Another order is given by the names of the columns, in a line ``#HEADER: "t", "x", ...`` or in a first line
    without numbers; ``#TIME_COLUMN: 0`` names the column of the time by its index from 0. Other lines that begin with #
    are comments. Unlike HELIOS++, which sorts records, this function refuses times that go back.

    Raises
    ------
    UserError
        If the file cannot be read, a column is unknown or missing, or a line does not hold one finite number for each
        column at a time later than that of the line before.
    """
    names: list[str] = []
    time_column: int | None = None
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(path, _LARGEST_TEXT).splitlines(), start=1):
        text = line.strip()
        if text.startswith("#"):
            key, _, value = text[1:].partition(":")
            if key.strip() == "HEADER":
                names = _cells(value)
            elif key.strip() == "TIME_COLUMN":
                time_column = integer(f"{path}: TIME_COLUMN", int(value) if value.strip().isdecimal() else value, 0, 6)
        elif text:
            rows.append((number, _cells(text)))
    if not names and rows and not any(map(is_number, rows[0][1])):
        names = rows.pop(0)[1]
    order = _order(path, names, time_column)
    values = np.empty((len(rows), len(order)))
    for row, (number, cells) in enumerate(rows):
        if len(cells) != len(order) or not all(map(is_number, cells)):
            raise UserError(
                f"{path}, line {number}: {', '.join(cells)[:80]!r} must be {len(order)} numbers, {', '.join(order)}"
            )
        values[row] = [float(cell) for cell in cells]
    columns = {name: values[:, index] for index, name in enumerate(order)}
    records = TrajectoryRecords(
        columns["t"],
        np.column_stack([columns[name] for name in "xyz"]),
        columns["roll"],
        columns["pitch"],
        columns["yaw"],
    )
    check_records(records, str(path), lambda row: f"{path}, line {rows[row][0]}")
    return records


def read_sbet_records(path: str | os.PathLike[str], epsg: int) -> TrajectoryRecords:
    """Read a trajectory from an SBET file, and project it into a coordinate system.

    A record is 17 little-endian 64-bit numbers: time [s]; latitude and longitude [rad] and ellipsoidal height [m] of
    WGS 84; three velocities; roll, pitch and platform heading [rad]; wander angle [rad]; three accelerations; three
    angular rates. The true heading is the platform heading less the wander angle; yaw is counted from grid north, from
    which true north differs by the meridian convergence.

    Parameters
    ----------
    path
        SBET file.
    epsg
        EPSG code of projected coordinates in metres, such as 32633 for UTM zone 33 N. x is east and y north on the
        grid; z is the ellipsoidal height [m]. Positions have the scale of the grid, within a zone of UTM 0.9996 to
        1.001, which may differ from 1 by 5 %.

    Raises
    ------
    UserError
        If the file cannot be read or has more than 1 GiB; its size is no multiple of 136 bytes; a record is not finite,
        not on the Earth, or not later than the one before; the coordinate system is unknown, has no metres, or has
        another scale there; or pyproj is missing.
    """
    path = Path(path)
    width = 8 * _SBET_NUMBERS
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        check_size(path, size, _LARGEST_SBET)
        data = None if size % width else np.fromfile(file, dtype="<f8").reshape(-1, _SBET_NUMBERS)
    if data is None:
        raise UserError(f"{path} has {size} bytes, but an SBET file must have a multiple of {width}.")

    def place(row: int) -> str:
        return f"{path}, record {row + 1}"

    time, latitude, longitude, height = data[:, :4].T
    with np.errstate(over="ignore", invalid="ignore"):
        roll, pitch, heading = np.degrees([data[:, 7], data[:, 8], data[:, 9] - data[:, 10]])
    check_records(TrajectoryRecords(time, data[:, [2, 1, 3]], roll, pitch, heading), str(path), place)
    wrong = (np.abs(latitude) > np.pi / 2) | (np.abs(longitude) > 2 * np.pi)
    for row in np.flatnonzero(wrong)[:1]:
        raise UserError(
            f"{place(row)}: latitude = {latitude[row]:g} and longitude = {longitude[row]:g} must be radians, up to"
            " pi / 2 and 2 pi"
        )
    x, y, north, scale = _projected(np.degrees(longitude), np.degrees(latitude), epsg)
    for row in np.flatnonzero(~(np.abs(scale - 1) < _LARGEST_DISTORTION))[:1]:
        raise UserError(
            f"{place(row)}: latitude = {np.degrees(latitude[row]):g} and longitude = {np.degrees(longitude[row]):g} deg"
            f" must lie where a metre is a metre within 5 % in epsg = {epsg}; its scale there is {scale[row]:.3g}"
        )
    return TrajectoryRecords(time.copy(), np.column_stack([x, y, height]), roll, pitch, heading + north)


def _projected(
    longitude: FloatArray, latitude: FloatArray, epsg: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return x and y [m] of points [deg], the azimuth of true north from grid north [deg], and the scale."""
    project = _projection(epsg)
    x, y = project(longitude, latitude)
    north, south = np.minimum(latitude + _STEP, 90.0), np.maximum(latitude - _STEP, -90.0)
    (north_x, north_y), (south_x, south_y) = project(longitude, north), project(longitude, south)
    with np.errstate(invalid="ignore"):
        along_x, along_y = north_x - south_x, north_y - south_y
    scale = np.hypot(along_x, along_y) / (_METRES_PER_DEGREE * (north - south))
    return x, y, np.degrees(np.arctan2(along_x, along_y)), scale


def _projection(epsg: int) -> Any:
    """Return the function from longitude and latitude [deg] of WGS 84 to x and y [m]."""
    code = integer("epsg", epsg, 1, _LARGEST_EPSG)
    try:
        import pyproj
    except ImportError:
        raise UserError("SBET files need pyproj: install it by pip install 'mitransient-lidar[geo]'") from None
    try:
        system = pyproj.CRS.from_epsg(code)
    except pyproj.exceptions.CRSError:
        raise UserError(f"epsg = {code} is no coordinate system that pyproj knows") from None
    # x east and y north, or along two meridians near a pole, so that headings turn clockwise on the grid as well.
    directions = sorted(axis.direction for axis in system.axis_info[:2])
    if (
        not system.is_projected
        or directions not in (["east", "north"], ["north", "north"], ["south", "south"])
        or any(axis.unit_conversion_factor != 1 for axis in system.axis_info[:2])
    ):
        raise UserError(f"epsg = {code} ({system.name}) must be projected coordinates in metres, east and north")
    return pyproj.Transformer.from_crs(4326, system, always_xy=True).transform


def _cells(line: str) -> list[str]:
    """Split a line at commas, semicolons, tabs or blanks, and remove quotation marks."""
    separator = next((one for one in ",;\t" if one in line), None)
    return [cell.strip().strip("\"'") for cell in line.split(separator)]


def _order(path: str | os.PathLike[str], names: list[str], time_column: int | None) -> list[str]:
    """Return the names of the columns of a file, in its order."""
    given = names or [name for name in _COLUMNS if time_column is None or name != "t"]
    if time_column is not None:
        given = [*given[:time_column], "t", *given[time_column + bool(names) :]]
    order = []
    for name in given:
        word = re.sub(r"[\s(\[]+", "_", name.strip().lower()).rstrip(")]")
        known = next((key for key, aliases in _COLUMNS.items() if word in aliases), None)
        if known is None:
            raise UserError(f"{path} has an unknown column {name!r}: allowed are {', '.join(_COLUMNS)}")
        order.append(known)
    if sorted(order) != sorted(_COLUMNS):
        raise UserError(f"{path} has the columns {', '.join(order)}: it must have each of {', '.join(_COLUMNS)} once")
    return order
