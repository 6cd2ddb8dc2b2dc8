"""Readers of trajectories: text files as HELIOS++ reads them, and SBET files of inertial navigation."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import check_size
from mitransient_lidar.core.maps.coordinate_systems import (
    LARGEST_DISTORTION,
    distortions,
    is_east_north,
    parsed_system,
)
from mitransient_lidar.core.tables.headings import METRES, Column, Heading, read_headings
from mitransient_lidar.core.tables.long_tables import read_head, read_long_table
from mitransient_lidar.core.validation import integer
from mitransient_lidar.flights.poses.records import PlatformPoses, check_records

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

    Each line is a record: time [s], roll, pitch, yaw [deg], x, y, z [m], as `long_tables.read_long_table` reads
    it. Another order is given by the names of the columns, with units or without, in a line
    ``#HEADER: "t", "x", ...`` or in a first line without numbers; ``#TIME_COLUMN: 0`` names the column of the time by
    its index from 0. Unlike HELIOS++, which sorts records, this function refuses times that go back.

    Raises UserError if the file cannot be read, a column or its unit is unknown, a column is missing, or a line does
    not hold one finite number for each column at a time later than the time of the line before.
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

    A record is 17 little-endian 64-bit numbers: time [s]; latitude and longitude [rad] and ellipsoidal height [m] of
    WGS 84; three velocities; roll, pitch and platform heading [rad]; wander angle [rad]; three accelerations; three
    angular rates. The true heading is the platform heading less the wander angle; yaw is counted from grid north, from
    which true north differs by the meridian convergence.

    Raises UserError if the file cannot be read or has more than 1 GiB; its size is no multiple of 136 bytes; a record
    is not finite, not on the Earth, or not later than the one before; or the coordinate system is unknown, has no
    metres, or has another scale there.

    `path`: SBET file. `epsg`: EPSG code of projected coordinates in metres, such as 32633 for UTM zone 33 N. x is east
    and y north on the grid; z is the ellipsoidal height [m]. Positions have the scale of the grid, within a zone of UTM
    0.9996 to 1.001, which may differ from 1 by 1 %.
    """
    import pyproj

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
