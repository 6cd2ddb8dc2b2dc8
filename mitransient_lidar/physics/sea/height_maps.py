"""Height maps: elevations of a surface, read from a file."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.array_files import Array, read_exr, read_npy, read_npz, readable_suffix
from mitransient_lidar.core.maps import Grid, MapSystem, read_ascii_grid, read_bag, read_geotiff
from mitransient_lidar.core.validation import ArrayLike, BoolArray, FloatArray, IntArray, finite, positive
from mitransient_lidar.physics.piecewise_linear import locate
from mitransient_lidar.physics.sea import height_files

logger = logging.getLogger(__name__)

_FARTHEST = 1e4  #: Farthest distance of x = y = 0 from a map [m]: single precision resolves a millimetre there.

_Given = tuple[str | None, str | None, float | None]
"""Sign, unit and no-data value for `heights_in_metres`."""


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Elevation of a surface on a rectangular grid, evenly spaced along each axis."""

    heights: FloatArray  #: Elevation [m], shape (rows, columns); row 0 has the smallest y, column 0 the smallest x.
    x: FloatArray  #: Column positions [m], increasing, at least 2.
    y: FloatArray  #: Row positions [m], increasing, at least 2.
    origin: tuple[float, float] | None = None  #: Point of the map at x = y = 0 [m], if it is in map coordinates.
    filled: BoolArray | None = None  #: Cells without a value of their own, in the shape of the heights.
    system: MapSystem | None = None  #: Coordinate system of the file, if it states one.

    def covers(self, x: ArrayLike, y: ArrayLike) -> BoolArray:
        """Return whether locations x, y [m], in one shape, are in map cells with a value of their own."""
        inside, nearest = [], []
        for wanted, positions in ((x, self.x), (y, self.y)):
            cell = (positions[-1] - positions[0]) / (positions.size - 1)
            index = (np.asarray(wanted, dtype=np.float64) - positions[0]) / cell
            inside.append((index >= -0.5) & (index <= positions.size - 0.5))
            nearest.append(np.clip(np.nan_to_num(np.rint(index)), 0, positions.size - 1).astype(np.intp))
        known = True if self.filled is None else ~self.filled[nearest[1], nearest[0]]
        return np.asarray(inside[0] & inside[1] & known)

    def sample(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the elevation on grid lines by bilinear interpolation.

        `x`, `y`, shapes (N,) and (M,): grid line positions [m]. A point outside the map has the height of the nearest
        edge point.

        Result, shape (M, N): elevation [m] at (x[i], y[j]) for element [j, i].
        """
        (i, right), (j, up) = _cells(self.x, x), _cells(self.y, y)
        columns = self.heights[:, i] * (1 - right) + self.heights[:, i + 1] * right
        return np.asarray(columns[j] * (1 - up[:, None]) + columns[j + 1] * up[:, None])

    def facet_variance(self, wind_direction: float) -> tuple[float, float]:
        """Return the mean-square slopes of facets along and across the wind, whose direction is in radians."""
        right = np.diff(self.heights, axis=1) / (self.x[1] - self.x[0])
        up = np.diff(self.heights, axis=0) / (self.y[1] - self.y[0])
        cos, sin = math.cos(wind_direction), math.sin(wind_direction)
        # The two triangles of a cell, split from its lower right to its upper left corner.
        pairs = ((right[:-1], up[:, :-1]), (right[1:], up[:, 1:]))
        along = float(np.mean([np.mean((cos * x + sin * y) ** 2) for x, y in pairs]))
        across = float(np.mean([np.mean((cos * y - sin * x) ** 2) for x, y in pairs]))
        return along, across


def read_height_map(
    path: str | os.PathLike[str],
    size: float | None = None,
    origin: tuple[float, float] | None = None,
    values: str | None = None,
    holes: str = "refuse",
    cell: float | None = None,
    unit: str | None = None,
    no_data: float | None = None,
) -> HeightMap:
    """Read a height map from a file.

    Raises UserError if the file is missing, damaged or in another format; the map not two-dimensional, with fewer than
    2 rows or columns, or with holes; heights beyond 12 000 m, or equal to an undeclared value for no data; units
    unknown or not stated beside feet; positions not increasing or not evenly spaced, in degrees, rotated, or with
    another scale than the ground; `size` not positive, missing or superfluous; `origin` far outside the map, or given
    for a file without positions; `cell` for another file than points, or more than half of their extent; or points on a
    line, or too many.

    Parameters
    ----------
    path : path
        File with heights or depths; its suffix selects the format:

        ``.npy``
            a two-dimensional array, ``heights[j, i]`` at the j-th y and the i-th x;
        ``.npz``
            such an array ``heights`` and, optionally, positions ``x`` and ``y`` [m];
        ``.exr``
            an image of one channel, or its channel Y, else R, else Z; its top row has the largest y;
        ``.nc``
            a variable with two dimensions; see `height_files.read_netcdf_heights`;
        ``.asc``
            an ESRI ASCII grid, with a .prj file beside it or without;
        ``.tif``, ``.tiff``
            a GeoTIFF with one band;
        ``.bag``
            a Bathymetric Attributed Grid with one resolution;
        ``.xyz``, ``.csv``, ``.txt``
            a table of points x, y, z, with or without a heading; see `height_files.read_points`.
    size : float, optional
        Distance from the first to the last column [m], positive. The map is centred on the origin and its cells are
        squares. Required if the file has no positions, not allowed if it has.
    origin : (float, float), optional
        Map point (x, y) [m], within 10 km of the map, that lies at x = y = 0 in the result. Default: the centre for an
        .asc, .tif or .bag file and for points; other positions are kept.
    values : {'heights', 'depths'}, optional
        Whether the values are positive up or down. Default: as the file states, or heights.
    holes : {'refuse', 'fill', 'keep'}
        Whether cells without a finite value are refused, filled with the value of the nearest cell that has one, with a
        warning in the log, or kept as NaN.
    cell : float, optional
        Cell of the grid on which scattered points are interpolated [m], positive. Default: the square root of the area
        of their convex hull divided by their number. Only for points; points on an even grid keep its cell by default.
    unit : str, optional
        Unit of the values, such as 'ft', if the file does not state it. Default: metres.
    no_data : float, optional
        Value of cells without a height, if the file does not declare it.

    Notes
    -----
    Scattered points are triangulated (Delaunay), and heights are linear in each triangle; cells outside the convex hull
    are holes. Points on an even grid, at a quarter of its places or more, are its cells, and other cells are holes.
    """
    path = Path(path)
    if holes not in ("refuse", "fill", "keep"):
        raise UserError(f"map_holes = {holes!r} must be refuse or fill")
    kind = readable_suffix(path, (*_READERS, *_POINTS), "height map")
    if cell is not None and kind not in _POINTS:
        raise UserError(f"map_cell = {cell} must not be given: {path} is not a table of points")
    given = values, unit, no_data
    if kind in _POINTS:
        if size is not None:
            raise _superfluous_size(path, size)
        grid = _points(path, cell, given)
    else:
        grid = _in_metres(path, _READERS[kind](path), size, given)
        if origin is not None and size is not None:
            raise UserError(f"origin_x and origin_y must not be given: {path} has no positions")
    x, y = grid.positions["x"], grid.positions["y"]
    heights, filled = _without_holes(path, grid.values, (float(y[1] - y[0]), float(x[1] - x[0])), holes)
    terrain = _moved(path, HeightMap(heights, x, y, None, filled, grid.stated.system), grid.centre, origin)
    place = "" if terrain.origin is None else "; x = y = 0 is its point ({:.10g}, {:.10g})".format(*terrain.origin)
    logger.info(
        "%s: map of %d x %d cells, %g x %g m, heights from %g to %g m%s%s; %s",
        *(path, x.size, y.size, x[-1] - x[0], y[-1] - y[0], np.nanmin(heights), np.nanmax(heights), place),
        ", the centre" if place and origin is None else "",
        height_files.described(grid.stated, values, unit, 0 if filled is None else int(filled.sum())),
    )
    return terrain


def map_origin(read: Callable[..., Any]) -> tuple[float, float] | None:
    """Return the map point at x = y = 0 [m] of a plugin's parameters; raise UserError if it has one of two alone."""
    x, y = read("origin_x"), read("origin_y")
    if (x is None) != (y is None):
        raise UserError(f"origin_x = {x} and origin_y = {y} must be given together")
    return None if x is None else (x, y)


def _points(path: Path, cell: float | None, given: _Given) -> Grid:
    """Return the grid from a point table [m]."""
    points, stated = height_files.read_points(path)
    if len(points):
        spacing = float(np.sqrt(np.ptp(points[:, 0]) * np.ptp(points[:, 1]) / len(points)))
        height_files.check_positions(path, stated, points[:, 0], points[:, 1], spacing)
    points[:, 2] = height_files.heights_in_metres(path, points[:, 2], stated, *given)
    points[:, :2] *= height_files.position_unit(path, stated)
    return height_files.grid_of_points(path, points, stated, cell)


def _in_metres(path: Path, grid: Grid, size: float | None, given: _Given) -> Grid:
    """Return a grid in metres; without its own positions, about the origin with the given size."""
    heights, stated = _numbers(path, "heights", grid.values), grid.stated
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise UserError(f"{path} has heights of shape {heights.shape}, but must have at least 2 rows and 2 columns")
    heights = height_files.heights_in_metres(path, heights, stated, *given)
    counts = {"x": heights.shape[1], "y": heights.shape[0]}
    if len(grid.positions) == 1:
        raise UserError(f"{path} has positions {next(iter(grid.positions))} only: it must have both x and y, or none")
    if not grid.positions:
        if size is None:
            raise UserError(f"{path} has no positions of its heights: give the size of the map along x, in metres")
        cell = positive("size", size) / (counts["x"] - 1)
        return Grid(heights, {name: (np.arange(n) - (n - 1) / 2) * cell for name, n in counts.items()}, stated)
    if size is not None:
        raise _superfluous_size(path, size)
    x, y = (_even_positions(path, name, grid.positions[name], count) for name, count in counts.items())
    at_x, at_y = grid.centre or (0.0, 0.0)
    height_files.check_positions(path, stated, at_x + x, at_y + y, min(float(x[1] - x[0]), float(y[1] - y[0])))
    unit = height_files.position_unit(path, stated)
    return Grid(heights, {"x": unit * x, "y": unit * y}, stated, grid.centre and (unit * at_x, unit * at_y))


def _superfluous_size(path: Path, size: float) -> UserError:
    return UserError(f"size = {size} must not be given: {path} has positions of its own")


def _without_holes(
    path: Path, heights: FloatArray, spacing: tuple[float, float], treatment: str
) -> tuple[FloatArray, BoolArray | None]:
    """Return the heights with holes filled from the nearest cell, and where; refuse holes that are not to be filled."""
    empty = ~np.isfinite(heights)
    count = int(empty.sum())
    if count == 0:
        return heights, None
    row, column = np.argwhere(empty)[0]
    if treatment == "refuse" or count == heights.size:
        raise UserError(
            f"{path} has holes, {count} of {heights.size} heights, the first in row {row} and column {column} counted "
            "from 0 at the smallest y and x: every height must be finite, unless map_holes of a seabed is fill"
        )
    if treatment == "keep":
        return heights, empty
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(empty, sampling=spacing, return_distances=False, return_indices=True)
    logger.warning("%s: %d of %d heights are missing, filled from the nearest cells", path, count, heights.size)
    return np.asarray(heights[tuple(nearest)]), empty


def _moved(
    path: Path, terrain: HeightMap, centre: tuple[float, float] | None, origin: tuple[float, float] | None
) -> HeightMap:
    """Return the map with a point of it at x = y = 0.

    The positions of `terrain` are relative to `centre`, or as they are in the file if it is None.
    """
    axes = terrain.x, terrain.y
    if centre is None and origin is None:
        _warn_beside(path, axes)
        return terrain
    middle = centre or (0.0, 0.0)
    point = middle if origin is None else origin
    for name, axis, zero, value in zip("xy", axes, middle, point, strict=True):
        low, high = zero + float(axis[0]), zero + float(axis[-1])
        if not low - _FARTHEST <= finite(f"origin_{name}", value) <= high + _FARTHEST:
            raise UserError(
                f"origin_{name} = {value:.10g} must lie within {_FARTHEST / 1000:g} km of {path}, whose {name} is "
                f"{low:.10g} to {high:.10g}"
            )
    x, y = (axis + (zero - value) for axis, zero, value in zip(axes, middle, point, strict=True))
    _warn_beside(path, (x, y))
    return replace(terrain, x=x, y=y, origin=point)


def _warn_beside(path: Path, axes: tuple[FloatArray, FloatArray]) -> None:
    """Warn of a map that does not contain x = y = 0."""
    if not all(axis[0] <= 0 <= axis[-1] for axis in axes):
        logger.warning(
            "%s: x from %.10g to %.10g and y from %.10g to %.10g m do not contain x = y = 0, where the lidar aims by "
            "default; origin_x and origin_y of a seabed move the map",
            *(path, axes[0][0], axes[0][-1], axes[1][0], axes[1][-1]),
        )


def _even_positions(path: Path, name: str, values: Array, count: int) -> FloatArray:
    """Return `count` finite, increasing, evenly spaced positions."""
    positions = _numbers(path, name, values)
    if positions.shape != (count,):
        raise UserError(f"{path} has {name} of shape {positions.shape}, but its heights need ({count},)")
    for i in np.flatnonzero(~np.isfinite(positions))[:1]:
        raise UserError(f"{path} has {name}[{i}] = {positions[i]:g}: positions must be finite")
    gaps = np.diff(positions)
    for i in np.flatnonzero(gaps <= 0)[:1]:
        raise UserError(
            f"{path} has {name}[{i}] = {positions[i]:g} and {name}[{i + 1}] = {positions[i + 1]:g}:"
            " positions must increase"
        )
    spacing = (positions[-1] - positions[0]) / (count - 1)
    worst = int(np.argmax(np.abs(gaps - spacing)))
    if abs(gaps[worst] - spacing) > height_files.UNEVENNESS * spacing:
        raise UserError(
            f"{path} has {name}[{worst}] and {name}[{worst + 1}] {gaps[worst]:g} apart, but {spacing:g} on average:"
            " positions must be evenly spaced"
        )
    return positions


def _cells(positions: FloatArray, wanted: ArrayLike) -> tuple[IntArray, FloatArray]:
    """Return the cells of the wanted positions, and the relative position in each, 0 to 1."""
    index, distance = locate(positions, np.asarray(wanted, dtype=np.float64))
    return index, distance / (positions[index + 1] - positions[index])


def _numbers(path: Path, name: str, values: Array) -> FloatArray:
    """Return real numbers in 64 bits."""
    if values.dtype.kind not in "iuf":
        raise UserError(f"{path} has {name} of type {values.dtype}, but they must be real numbers")
    return values.astype(np.float64)


def _read_npz(path: Path) -> Grid:
    arrays = read_npz(path, ("heights", "x", "y"))
    if "heights" not in arrays:
        raise UserError(f"{path} must have an array heights, and may have x and y")
    return Grid(arrays.pop("heights"), arrays)


def _read_exr(path: Path) -> Grid:
    images = read_exr(path)
    names = list(images) if len(images) == 1 else [name for name in "YRZ" if name in images]
    if not names:
        channels = ", ".join(sorted(images))
        raise UserError(f"{path} has the channels {channels}: it must have only one, or one called Y, R or Z")
    return Grid(images[names[0]][::-1], {})


_READERS: dict[str, Callable[[Path], Grid]] = {
    ".npy": lambda path: Grid(read_npy(path), {}),
    ".npz": _read_npz,
    ".exr": _read_exr,
    ".nc": height_files.read_netcdf_heights,
    ".asc": read_ascii_grid,
    ".tif": read_geotiff,
    ".tiff": read_geotiff,
    ".bag": read_bag,
}
_POINTS = (".xyz", ".csv", ".txt")

#: Suffixes of maps that lie about their centre, in their own coordinates, where no origin is given.
IN_MAP_COORDINATES = (".asc", ".tif", ".tiff", ".bag", *_POINTS)
