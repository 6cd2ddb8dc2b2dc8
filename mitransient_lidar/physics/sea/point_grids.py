"""Points of a survey, and the grid of heights that they have or that is interpolated between them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from mitransient_lidar.core.array_files import check_size
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.grids import Grid, Stated
from mitransient_lidar.core.headings import METRES, Column, Heading, parse_heading, pick_columns
from mitransient_lidar.core.long_tables import read_long_table
from mitransient_lidar.core.validation import FloatArray, positive

logger = logging.getLogger(__name__)

#: Relative tolerance of even spacing, for 32-bit numbers and rounded decimals.
UNEVENNESS = 1e-3

#: Most scattered points, whose triangulation takes a kilobyte and 10 microseconds each.
_MOST_SCATTERED = 2 * 10**6

#: Least share of the cells of a grid that have a point, if points are taken as one.
_LEAST_SHARE = 0.25

_X = Column("x", ("easting", "east", "e", "x coordinate", "point x"), METRES)
_Y = Column("y", ("northing", "north", "n", "y coordinate", "point y"), METRES)
_Z = Column("z", ("height", "elevation", "elev", "altitude", "h", "point z"), METRES)
_DEPTH = Column("depth", (), METRES)
_ANGLES = Column("latitude or longitude", ("lat", "latitude", "lon", "long", "longitude"))


def read_points(path: Path) -> tuple[FloatArray, Stated]:
    """Read a table of points.

    `core.long_tables.read_long_table` describes the format. A heading names the columns x, y and z, or easting,
    northing, and height, elevation or depth, with or without a unit of length. Without one they are the first three.

    Returns
    -------
    points : ndarray, shape (points, 3)
        x, y and z as in the file; z is NaN where it is missing.
    stated : Stated
        Units that the heading states, and whether z is called depth.

    Raises
    ------
    UserError
        As `read_long_table`; or if columns are missing, ambiguous, in an unknown unit, or angles; x and y have
        different units; or a position is not finite.
    """

    def choose(names: list[str]) -> list[tuple[int, Heading]]:
        if not names:
            return [(i, Heading(column, "", 0.0)) for i, column in enumerate((_X, _Y, _Z))]
        is_placed = any(heading and heading.known_unit for heading in (parse_heading(name, (_X, _Y)) for name in names))
        if not is_placed and any(parse_heading(name, (_ANGLES,)) for name in names):
            raise UserError(f"{path} has columns of degrees ({', '.join(names)}): positions must be projected.")
        return pick_columns(path, names, ((_X,), (_Y,), (_Z, _DEPTH)))

    table = read_long_table(path, (_X, _Y, _Z), (_DEPTH, _ANGLES), choose, [])
    points, (x, y, z) = table.values, table.headings
    if x.unit != y.unit:
        raise UserError(f"{path} has x in {x.unit or 'no unit'} and y in {y.unit or 'no unit'}: they must be the same.")
    for row in np.flatnonzero(~np.isfinite(points[:, :2]).all(axis=1) | np.isinf(points[:, 2]))[:1]:
        shown = ", ".join(f"{one:g}" for one in points[row])
        raise UserError(f"{path}, line {table.line(row)}: the point {shown} must be finite.")
    return points, Stated(z.unit, True if z.column is _DEPTH else None, x.unit)


def grid_of_points(path: Path, points: FloatArray, cell: float | None) -> Grid:
    """Return points on a grid: their own, if they have one, or else interpolated.

    Parameters
    ----------
    path : Path
        Their file, for messages.
    points : ndarray, shape (points, 3)
        Positions and heights [m]; points with a height of NaN are left out.
    cell : float, optional
        Cell of the grid on which scattered points are interpolated [m].

    Raises
    ------
    UserError
        If there are fewer than 3 points, they are on a line, or too many; or the cell is more than half of their
        extent.
    """
    if missing := int(np.isnan(points[:, 2]).sum()):
        logger.warning("%s: %d of %d points have no height and are left out", path, missing, len(points))
        points = points[~np.isnan(points[:, 2])]
    if len(points) < 3:
        raise UserError(f"{path} has {len(points)} points: a height map needs at least 3.")
    # Map coordinates have up to eight digits: distances are exact about the lower corner.
    corner = points[:, :2].min(axis=0)
    places, extent = points[:, :2] - corner, np.ptp(points[:, :2], axis=0)
    if cell is None and (grid := _own_grid(places, points[:, 2])) is not None:
        return grid._replace(first=(float(corner[0]), float(corner[1])))
    if len(points) > _MOST_SCATTERED:
        raise UserError(
            f"{path} has {len(points)} scattered points: {_MOST_SCATTERED} are the most, thin them or grid them."
        )
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import ConvexHull, Delaunay, QhullError

    try:
        area, triangles = ConvexHull(places).volume, Delaunay(places)
    except (QhullError, ValueError) as error:
        raise UserError(f"{path} has points on a line: a height map needs an area.") from error
    size = float(np.sqrt(area / len(points))) if cell is None else positive("map_cell", cell)
    if size > 0.5 * extent.min():
        raise UserError(f"map_cell = {size:g} must be at most half of {extent.min():g} m, the extent of {path}.")
    columns, rows = np.floor(extent / size * (1 + 1e-9)) + 1
    check_size(path, 8 * columns * rows)
    x, y = (
        0.5 * (one - (count - 1) * size) + size * np.arange(count)
        for one, count in zip(extent, (columns, rows), strict=True)
    )
    values = LinearNDInterpolator(triangles, points[:, 2])(*np.meshgrid(x, y))
    return Grid(np.asarray(values), (float(corner[0] + x[0]), float(corner[1] + y[0])), (size, size))


def _own_grid(places: FloatArray, heights: FloatArray) -> Grid | None:
    """Return the even grid that places from its corner are on, shape (n, 2), and None if there is none."""
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
    return Grid(values, (0.0, 0.0), (cells[0], cells[1]))
