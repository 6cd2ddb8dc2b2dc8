"""Height files: survey points, NetCDF by the CF conventions, and the meaning of values and positions in any file."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.array_files import check_size, read_netcdf
from mitransient_lidar.core.maps import Grid, Stated, map_system, stated_by, undeclared_no_data, without_no_data
from mitransient_lidar.core.tables.headings import METRES, Column, Heading, parse_heading, pick_columns
from mitransient_lidar.core.tables.text_tables import read_long_table
from mitransient_lidar.core.validation import FloatArray, finite, positive

logger = logging.getLogger(__name__)

UNEVENNESS = 1e-3  #: Relative tolerance of even spacing, for 32-bit numbers and rounded decimals.
_MOST_SCATTERED = 2 * 10**6  #: Most scattered points, whose triangulation takes a kilobyte and 10 microseconds each.

_LEAST_SHARE = 0.25  #: Least share of grid cells with a point for points to count as a grid.

_X = Column("x", ("easting", "east", "e", "x coordinate", "point x"), METRES)
_Y = Column("y", ("northing", "north", "n", "y coordinate", "point y"), METRES)
_Z = Column("z", ("height", "elevation", "elev", "altitude", "h", "point z"), METRES)
_DEPTH = Column("depth", (), METRES)
_ANGLES = Column("latitude or longitude", ("lat", "latitude", "lon", "long", "longitude"))

#: Largest angles [deg], and the cell below which positions among them are taken for degrees.
_LARGEST_ANGLES, _SMALLEST_CELL = (360.0, 90.0), 0.02

_ALLOWED = "m, cm, km, ft, ftUS, fathom"

#: Names of heights in NetCDF files, and units that are none.
_NETCDF_NAMES = ("height", "elevation", "depth")
_NO_UNIT = ("", "1")

_GRID_MAPPING = {"crs_wkt", "spatial_ref", "grid_mapping_name"}  #: Grid mapping attributes.


def length_unit(name: str, unit: str) -> float:
    """Return a unit in metres; `name` is the quantity, for the message.

    Raises UserError if it is no unit of length.
    """
    key = re.sub(r"[\s_.]+", "", unit.lower())
    if key not in METRES:
        raise UserError(f"{name} in {unit!r}: allowed are {_ALLOWED}")
    return METRES[key]


def heights_in_metres(
    path: Path,
    values: FloatArray,
    stated: Stated,
    sign: str | None = None,
    unit: str | None = None,
    no_data: float | None = None,
) -> FloatArray:
    """Return heights above the mean sea level [m], positive up, NaN where there is none.

    Raises UserError if the unit is unknown, contradicts the file's, or is not stated beside positions that are not in
    metres; or heights are beyond 12 000 m, or look like a value for no data.

    `path`: their file, for messages. `values`: values as in the file, NaN where they are declared to be missing.
    `stated`: statements of the file about them. `sign`, 'heights' or 'depths': whether they are positive up or down.
    Default: as the file states, or up. `unit`: their unit, where the file does not state it. Default: metres.
    `no_data`: value without a height, which the file does not declare.
    """
    if sign not in (None, "heights", "depths"):
        raise UserError(f"map_values = {sign!r} must be heights or depths")
    metres = _height_unit(path, stated, unit)
    values = without_no_data(values, None if no_data is None else finite("map_no_data", no_data))
    if suspect := undeclared_no_data(values, metres):
        value, times, reason = suspect
        raise UserError(
            f"{path} has {times} of {values.size} heights of {value:.9g}, {reason}, which it does not declare to be "
            f"no data: map_no_data = {value:.9g} of a seabed must say so if they are"
        )
    is_down = bool(stated.is_down) if sign is None else sign == "depths"
    return -metres * values if is_down else metres * values


def _height_unit(path: Path, stated: Stated, unit: str | None) -> float:
    """Return the height unit in metres."""
    given = None if unit is None else length_unit("map_unit is", unit)
    system = stated.system
    if stated.unit:
        from_system = system is not None and stated.unit == system.vertical_unit
        metres = system.vertical_metres if from_system and system else length_unit(f"{path} has heights", stated.unit)
        if given is not None and not math.isclose(given, metres, rel_tol=1e-9):
            raise UserError(f"map_unit = {unit!r} must not differ from that of {path}, {stated.unit}")
        return metres
    if given is None and position_unit(path, stated) != 1:
        raise UserError(
            f"{path} has positions in {stated.position_unit} but does not state the unit of its heights: map_unit "
            f"must, one of {_ALLOWED}"
        )
    return 1.0 if given is None else given


def position_unit(path: Path, stated: Stated) -> float:
    """Return the unit of positions in metres, 1 where it is not stated."""
    if stated.system is not None and stated.position_unit == stated.system.unit:
        return stated.system.metres
    return length_unit(f"{path} has positions", stated.position_unit) if stated.position_unit else 1.0


def check_positions(path: Path, stated: Stated, x: FloatArray, y: FloatArray, cell: float) -> None:
    """Refuse positions in degrees, or whose metres differ from metres on the ground.

    `path`: their file, for messages. `stated`: statements of the file about them. `x`, `y`: positions as in the file,
    at least the least and the largest of them. `cell`: typical distance between neighbours.
    """
    middle = [0.5 * float(one.min() + one.max()) for one in (x, y)]
    if stated.system is not None:
        # CF requires units of the coordinates themselves, which may be kilometres.
        unit = position_unit(path, stated) / stated.system.metres
        stated.system.check_scale(path, unit * middle[0], unit * middle[1])
        return
    is_within = all(np.abs(one).max() <= most for one, most in zip((x, y), _LARGEST_ANGLES, strict=True))
    is_away = any(abs(place) > 2 * float(np.ptp(one)) for place, one in zip(middle, (x, y), strict=True))
    if not stated.position_unit and is_within and is_away and cell < _SMALLEST_CELL:
        raise UserError(
            f"{path} has positions about ({middle[0]:.6g}, {middle[1]:.6g}) in cells of {cell:.2g}, which look like"
            " degrees: they must be projected, in metres, or their unit be stated"
        )


def described(stated: Stated, values: str | None, unit: str | None, holes: int) -> str:
    """Return a file's statements as text for the log."""
    system = stated.system
    sign = {True: "down", False: "up", None: "up (not stated)"}[stated.is_down]
    sign = {"depths": "down", "heights": "up", None: sign}[values]
    datum = system.datum if system and system.datum else "mean sea level (not stated)"
    return (
        f"values in {stated.unit or unit or 'm (not stated)'}, positive {sign}, zero at {datum}, {holes} holes; "
        f"positions in {stated.position_unit or 'm (not stated)'}, coordinate system "
        f"{system.name if system else 'not stated'}"
    )


def read_netcdf_heights(path: Path) -> Grid:
    """Read heights or depths from a NetCDF-4 file.

    The variable is called ``height``, ``elevation`` or ``depth``, or is the only one with two dimensions. These are (y,
    x) or (x, y), with or without the coordinates ``x`` and ``y``. The coordinates may have other names if their
    ``standard_name`` is ``projection_x_coordinate`` and ``projection_y_coordinate``. Dimensions with other names count
    as (y, x). The reader uses ``units`` of all three, ``positive`` or ``standard_name`` of the heights, and a grid
    mapping.

    Raises UserError if it has no such variable or several, or positions in degrees.
    """
    dataset = read_netcdf(path)
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    flat = [str(name) for name, variable in dataset.data_vars.items() if variable.ndim == 2]
    names = [name for name in _NETCDF_NAMES if name in flat] or flat
    if len(names) != 1:
        found = f" ({', '.join(names)})" if names else ""
        raise UserError(
            f"{path} has {len(names)} variables that may be the heights{found}: it must have one called"
            f" {', '.join(_NETCDF_NAMES)}, or only one with two dimensions"
        )
    heights = variables[names[0]]
    x, y = _axis(variables, "x"), _axis(variables, "y")
    positions = {axis: variables[name] for axis, name in (("x", x), ("y", y)) if name in variables}
    for name in (*map(str, heights.dims), x, y):
        units = str(variables[name].attrs["units"]) if name in variables else ""
        if units.lower().startswith("deg") or name.lower() in ("lat", "lon", "latitude", "longitude"):
            raise UserError(f"{path} has positions {name} in degrees: they must be projected, in metres or feet")
    mapping = next((one.attrs for one in variables.values() if not _GRID_MAPPING.isdisjoint(one.attrs)), None)
    stated = stated_by(None if mapping is None else map_system(path, mapping))
    of_axes = {str(variable.attrs["units"]) for variable in positions.values()}
    if len(of_axes) > 1:
        raise UserError(f"{path} has x and y in {' and '.join(sorted(of_axes))}: they must have the same units")
    unit = "".join(of_axes - set(_NO_UNIT))
    stated = stated._replace(
        unit=stated.unit if heights.attrs["units"] in _NO_UNIT else str(heights.attrs["units"]),
        is_down=_is_down(names[0], heights.attrs, stated.is_down),
        position_unit=unit or stated.position_unit,
    )
    values = heights.values.T if heights.dims == (x, y) else heights.values
    if values.dtype.kind == "f":
        for attribute in ("_FillValue", "missing_value"):
            number = heights.attrs.get(attribute)
            values = without_no_data(values, None if number is None else float(number))
    return Grid(values, {name: variable.values for name, variable in positions.items()}, stated)


def _axis(variables: Mapping[str, Any], axis: str) -> str:
    """Return the name of the positions along x or y."""
    standard = f"projection_{axis}_coordinate"
    found = [name for name, one in variables.items() if one.attrs.get("standard_name") == standard]
    return found[0] if axis not in variables and len(found) == 1 else axis


def _is_down(name: str, attributes: Mapping[str, object], default: bool | None) -> bool | None:
    """Return whether heights are positive down, by their attributes, their name, or a vertical axis."""
    direction = str(attributes.get("positive", "")).lower()
    if direction in ("up", "down"):
        return direction == "down"
    standard = str(attributes.get("standard_name", ""))
    if "depth" in standard or (not standard and name == "depth"):
        return True
    return False if "height" in standard or "altitude" in standard else default


def read_points(path: Path) -> tuple[FloatArray, Stated]:
    """Read a point table.

    `core.tables.text_tables.read_long_table` describes the format. A heading names the columns x, y and z, or easting,
    northing, and height, elevation or depth, with or without a unit of length. Without one they are the first three.

    Raises UserError as `read_long_table`; or if columns are missing, ambiguous, in an unknown unit, or angles; x and y
    have different units; or a position is not finite.

    Returns `points`, shape (points, 3): x, y and z as in the file; z is NaN where it is missing. `stated`: units that
    the heading states, and whether z is called depth.
    """

    def choose(names: list[str]) -> list[tuple[int, Heading]]:
        if not names:
            return [(i, Heading(column, "", 0.0)) for i, column in enumerate((_X, _Y, _Z))]
        is_placed = any(heading and heading.known_unit for heading in (parse_heading(name, (_X, _Y)) for name in names))
        if not is_placed and any(parse_heading(name, (_ANGLES,)) for name in names):
            raise UserError(f"{path} has columns of degrees ({', '.join(names)}): positions must be projected")
        return pick_columns(path, names, ((_X,), (_Y,), (_Z, _DEPTH)))

    table = read_long_table(path, (_X, _Y, _Z), (_DEPTH, _ANGLES), choose, [])
    points, (x, y, z) = table.values, table.headings
    if x.unit != y.unit:
        raise UserError(f"{path} has x in {x.unit or 'no unit'} and y in {y.unit or 'no unit'}: they must be the same")
    for row in np.flatnonzero(~np.isfinite(points[:, :2]).all(axis=1) | np.isinf(points[:, 2]))[:1]:
        shown = ", ".join(f"{one:g}" for one in points[row])
        raise UserError(f"{path}, line {table.line(row)}: the point {shown} must be finite")
    return points, Stated(z.unit, True if z.column is _DEPTH else None, x.unit)


def grid_of_points(path: Path, points: FloatArray, stated: Stated, cell: float | None) -> Grid:
    """Return points on a grid: their own, if they have one, or else interpolated.

    Raises UserError if there are fewer than 3 points, they are on a line, or too many; or the cell is more than half of
    their extent.

    `path`: their file, for messages. `points`: positions and heights [m]; points with a height of NaN are left out,
    shape (points, 3). `stated`: statements of the file about them. `cell`: cell of the grid on which scattered points
    are interpolated [m].
    """
    if missing := int(np.isnan(points[:, 2]).sum()):
        logger.warning("%s: %d of %d points have no height and are left out", path, missing, len(points))
        points = points[~np.isnan(points[:, 2])]
    if len(points) < 3:
        raise UserError(f"{path} has {len(points)} points: a height map needs at least 3")
    corner = points[:, :2].min(axis=0)
    places, extent = points[:, :2] - corner, np.ptp(points[:, :2], axis=0)
    if cell is None and (own := _own_grid(places, points[:, 2])) is not None:
        return Grid.of_cells(own[0], (float(corner[0]), float(corner[1])), own[1], stated)
    if len(points) > _MOST_SCATTERED:
        raise UserError(
            f"{path} has {len(points)} scattered points: {_MOST_SCATTERED} are the most, thin them or grid them"
        )
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import ConvexHull, Delaunay, QhullError

    try:
        area, triangles = ConvexHull(places).volume, Delaunay(places)
    except (QhullError, ValueError) as error:
        raise UserError(f"{path} has points on a line: a height map needs an area") from error
    size = float(np.sqrt(area / len(points))) if cell is None else positive("map_cell", cell)
    if size > 0.5 * extent.min():
        raise UserError(f"map_cell = {size:g} must be at most half of {extent.min():g} m, the extent of {path}")
    columns, rows = np.floor(extent / size * (1 + 1e-9)) + 1
    check_size(path, 8 * columns * rows)
    x, y = (
        0.5 * (one - (count - 1) * size) + size * np.arange(count)
        for one, count in zip(extent, (columns, rows), strict=True)
    )
    values = LinearNDInterpolator(triangles, points[:, 2])(*np.meshgrid(x, y))
    first = float(corner[0] + x[0]), float(corner[1] + y[0])
    return Grid.of_cells(np.asarray(values), first, (size, size), stated)


def _own_grid(places: FloatArray, heights: FloatArray) -> tuple[FloatArray, tuple[float, float]] | None:
    """Return values and cells of the even grid that places from its corner are on, shape (n, 2); None without one."""
    index, cells = [], []
    for axis in range(2):
        gaps = np.diff(np.unique(places[:, axis]))
        # Positions are rounded: equal ones may differ by a thousandth of a cell.
        gaps = gaps[gaps > 2 * UNEVENNESS * gaps.max(initial=0.0)]
        if not gaps.size:
            return None
        cell = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
        steps = np.rint(places[:, axis] / cell)
        # The last place gives the cell precisely.
        cell = float(places[:, axis].max() / max(steps.max(), 1))
        if np.abs(places[:, axis] / cell - steps).max() > 0.05:
            return None
        index.append(steps.astype(np.int64))
        cells.append(cell)
    columns, rows = (int(one.max()) + 1 for one in index)
    if len(heights) < _LEAST_SHARE * columns * rows:
        return None
    values = np.full((rows, columns), np.nan)
    values[index[1], index[0]] = heights
    return values, (cells[0], cells[1])
