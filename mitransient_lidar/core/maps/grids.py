"""Height grids in map coordinates: ESRI ASCII grids, GeoTIFF and Bathymetric Attributed Grids (BAG)."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_regular, read_text, replacing
from mitransient_lidar.core.formats.array_files import LARGEST_ARRAY, Array, check_hdf5, check_size, damaged_file
from mitransient_lidar.core.maps.coordinate_systems import MapSystem, map_system, read_prj
from mitransient_lidar.core.validation import FloatArray, integer, positive

#: Value of ASCII grid cells without a height, if the header does not name another, and of empty BAG cells.
_ASCII_EMPTY, _BAG_EMPTY = -9999.0, 1e6

#: Relative difference between a cell and the no-height value: it may be written with six digits.
_ROUNDED = 1e-5

#: Largest distance of heights from the mean sea level [m]: deeper than any sea.
_HIGHEST = 12_000.0

#: Numbers that programs write for no data, of either sign, where no other height is nearer than a tenth of them.
NO_DATA = (99.0, 999.0, 9999.0)
_NEAR = 0.1

#: Largest deviation between a BAG file's corners and its cells, in cells.
_CORNER_TOLERANCE = 0.1


class Stated(NamedTuple):
    """Statements of a file about its heights and positions."""

    unit: str = ""  #: Height unit, "" if it is not stated.
    is_down: bool | None = None  #: Whether the values are depths; None if it is not stated.
    position_unit: str = ""  #: Position unit, "" if it is not stated.
    system: MapSystem | None = None


class Grid(NamedTuple):
    """Heights on a grid, in the units of their file."""

    values: Array  #: Shape (rows, columns) with increasing y and x; NaN where there is no value.
    positions: dict[str, Array]  #: Column positions ``x``, and row positions ``y``, as far as the file has them.
    stated: Stated = Stated()
    centre: tuple[float, float] | None = None  #: Point x, y from which the positions count; None for the origin.

    @classmethod
    def of_cells(
        cls, values: FloatArray, first: tuple[float, float], cell: tuple[float, float], stated: Stated
    ) -> Grid:
        """Return a grid from the centre (x, y) of the cell in row 0 and column 0, and the cell sizes along x and y.

        Map coordinates have up to eight digits: positions are exact about the centre.
        """
        x, y = ((np.arange(n) - (n - 1) / 2) * size for n, size in zip(values.shape[::-1], cell, strict=True))
        return cls(values, {"x": x, "y": y}, stated, (first[0] - float(x[0]), first[1] - float(y[0])))


def without_no_data(values: npt.NDArray[Any], no_data: float | None) -> FloatArray:
    """Return values as float64, NaN where they are the value for no data, which may be rounded to six digits."""
    values = np.array(values, dtype=np.float64)
    if no_data is not None:
        with np.errstate(invalid="ignore", over="ignore"):
            values[np.abs(values - no_data) <= _ROUNDED * abs(no_data)] = np.nan
    return values


def undeclared_no_data(
    values: FloatArray, metres: float = 1.0, numbers: tuple[float, ...] = NO_DATA
) -> tuple[float, int, str] | None:
    """Return the most frequent height, in a unit in metres, that is none but is not declared to be no data.

    Such heights are beyond 12 000 m, or one of `numbers` of either sign that is far from all others. Returned are the
    height, how often it occurs, and the reason; None if there is no such height.
    """
    known = values[np.isfinite(values)]
    suspects, reason = known[np.abs(metres * known) > _HIGHEST], f"beyond {_HIGHEST:g} m"
    for value in (sign * one for one in numbers for sign in (-1, 1)):
        near = known[np.abs(known - value) < _NEAR * abs(value)]
        if not suspects.size and near.size and np.all(near == value):
            suspects, reason = near, "far from all others"
    if not suspects.size:
        return None
    kinds, counts = np.unique(suspects, return_counts=True)
    return float(kinds[np.argmax(counts)]), int(counts.max()), reason


def read_ascii_grid(path: Path) -> Grid:
    """Read an ESRI ASCII grid: a header with names and numbers, and cell rows from the largest y down.

    Header (ESRI, "ASCII raster format"): ncols, nrows, xllcorner or xllcenter, yllcorner or yllcenter, cellsize or dx
    and dy, and nodata_value, by default -9999. A file of the same name that ends in .prj may describe the coordinates.
    GDAL reads such grids as well, but takes words and missing cells as zeros.
    """
    words = read_text(path, LARGEST_ARRAY).replace(",", ".").split()
    length = next((i for i in range(0, len(words), 2) if not words[i][0].isalpha() or words[i].lower() == "nan"), 0)
    try:
        header = {words[i].lower(): float(words[i + 1]) for i in range(0, length, 2)}
        values = np.array(words[length:], dtype=np.float64)
    except ValueError as error:
        raise UserError(f"{path} is damaged, or is not an ESRI ASCII grid: {error}") from error
    columns, rows = (integer(f"{path}: {name}", _entry(path, header, name), 1, 10**6) for name in ("ncols", "nrows"))
    if values.size != columns * rows:
        raise UserError(f"{path} has {values.size} values but must have ncols = {columns} times nrows = {rows}")
    cell = _entry(path, header, "dx", "cellsize"), _entry(path, header, "dy", "cellsize")
    positive(f"{path}: cellsize", min(cell))
    first = [
        header[f"{axis}llcorner"] + size / 2
        if f"{axis}llcorner" in header
        else _entry(path, header, f"{axis}llcenter", f"{axis}llcorner")
        for axis, size in zip("xy", cell, strict=True)
    ]
    values = without_no_data(values, header.get("nodata_value", _ASCII_EMPTY)).reshape(rows, columns)[::-1]
    return Grid.of_cells(values, (first[0], first[1]), cell, stated_by(read_prj(path)))


def _entry(path: Path, header: dict[str, float], *names: str) -> float:
    """Return the first of these header entries."""
    for name in names:
        if np.isfinite(header.get(name, np.nan)):
            return header[name]
    raise UserError(f"{path} must have {' or '.join(names)} in its header, which has {', '.join(header) or 'nothing'}")


def stated_by(system: MapSystem | None, unit: str = "") -> Stated:
    """Return a coordinate system's statements; `unit` is the height unit, if the file has it elsewhere."""
    if system is None:
        return Stated(unit)
    return Stated(unit or system.vertical_unit, system.is_down, system.unit, system)


def read_geotiff(path: Path) -> Grid:
    """Read a GeoTIFF with one band."""
    return _read_raster(path, "GTiff", "GeoTIFF")


def read_bag(path: Path) -> Grid:
    """Read the elevations in a Bathymetric Attributed Grid with one resolution, positive up [m].

    The format (Open Navigation Surface, "Format Specification Document: Description of Bathymetric Attributed Grid
    Object") is HDF5. Its corners are cell centres, but some programs write their edges.
    """
    return _read_raster(path, "BAG", "Bathymetric Attributed Grid of one resolution")


def _read_raster(path: Path, driver: str, kind: str) -> Grid:
    """Read a raster's first band by a GDAL driver."""
    import rasterio

    if driver == "BAG":
        with damaged_file(f"{path} is damaged, or is not a {kind}."):
            check_hdf5(path)
    # GDAL reads files beside it of the same name, such as .tfw and .tif.aux.xml.
    for beside in path.parent.iterdir():
        if beside.name.startswith(f"{path.stem}."):
            check_regular(beside)
    with (
        warnings.catch_warnings(action="ignore", category=rasterio.errors.NotGeoreferencedWarning),
        damaged_file(f"{path} is damaged, or is not a {kind}."),
        rasterio.open(path, driver=driver) as file,
    ):
        return _raster(path, file, driver == "BAG")


def _raster(path: Path, file: Any, is_bag: bool) -> Grid:
    """Return the first band of an open raster; refuse several bands, and rotated or missing map coordinates."""
    place = file.transform
    if file.count != 1 and not is_bag:
        raise UserError(f"{path} has {file.count} bands: a height map must have one")
    if place.is_identity:
        raise UserError(f"{path} has no map coordinates: it must have them")
    if place.b != 0 or place.d != 0:
        raise UserError(f"{path} is rotated against its map coordinates: rows must run along x")
    system = map_system(path, file.crs.to_wkt()) if file.crs else None
    check_size(path, 8.0 * file.width * file.height)
    values = without_no_data(file.read(1), _BAG_EMPTY if is_bag else file.nodata)
    values[file.read_masks(1) == 0] = np.nan
    values = file.scales[0] * values + file.offsets[0]
    rows, columns = values.shape
    x, y = place.c + place.a / 2, place.f + place.e / 2
    if place.e < 0:
        values, y = values[::-1], y + (rows - 1) * place.e
    if place.a < 0:
        values, x = values[:, ::-1], x + (columns - 1) * place.a
    cell = (abs(place.a), abs(place.e))
    stated = stated_by(system, file.units[0] or "")
    if is_bag:
        # Elevations are in metres and positive up, whatever their datum is called.
        stated = stated._replace(unit="m", is_down=False)
        shift = _corner_shift(path, file.tags(ns="xml:BAG"), (columns, rows), cell)
        x, y = x + shift[0] * cell[0], y + shift[1] * cell[1]
    return Grid.of_cells(values, (x, y), cell, stated)


def write_geotiff(
    path: str | os.PathLike[str], bands: Mapping[str, FloatArray], x: FloatArray, y: FloatArray, wkt: str = ""
) -> None:
    """Write maps as the named bands of a GeoTIFF, in single precision with NaN for no data.

    `path`: the file. `bands`: values by name, shape (rows, columns) with increasing y and x. `x`, `y`: evenly spaced
    column and row positions in map coordinates, at least 2 each. `wkt`: coordinate system, empty if it is unknown.
    """
    import rasterio

    cell = [(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (x, y)]
    place = rasterio.Affine(cell[0], 0, x[0] - cell[0] / 2, 0, -cell[1], y[-1] + cell[1] / 2)
    shape = {"width": len(x), "height": len(y), "count": len(bands)}
    about = {"dtype": "float32", "nodata": np.nan, "transform": place, "crs": wkt or None, "compress": "deflate"}
    with (
        warnings.catch_warnings(action="ignore", category=rasterio.errors.NotGeoreferencedWarning),
        replacing(path) as temporary,
        rasterio.open(temporary, "w", driver="GTiff", **shape, **about) as file,
    ):
        for number, (name, values) in enumerate(bands.items(), 1):
            file.write(np.asarray(values[::-1], np.float32), number)
            file.set_band_description(number, name)


def _corner_shift(
    path: Path, metadata: dict[str, str], count: tuple[int, int], cell: tuple[float, float]
) -> tuple[float, float]:
    """Return the distances from a BAG's corner to its first cell along x and y, in cells: 0, or 0.5 for edges."""
    found = re.search(r"coordinates[^>]*>([^<]*)<", " ".join(metadata.values()))
    corners = [[float(one) for one in word.split(",")[:2]] for word in found[1].split()[:2]] if found else []
    shifts = []
    for axis, number in enumerate(count):
        steps = (corners[1][axis] - corners[0][axis]) / cell[axis]
        inset = next((shift for shift in (0, 1) if abs(steps - number + 1 - shift) < _CORNER_TOLERANCE), None)
        if inset is None:
            raise UserError(
                f"{path} has {number} cells along {'xy'[axis]}, but corners that are {steps:.6g} cells apart"
            )
        shifts.append(0.5 * inset)
    return shifts[0], shifts[1]
