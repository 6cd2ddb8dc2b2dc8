"""Height grids in map coordinates (ESRI ASCII, GeoTIFF, BAG), and coordinate systems through pyproj."""

from __future__ import annotations

import functools
import os
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_regular, is_there, read_text, replacing
from mitransient_lidar.core.formats.array_files import LARGEST_ARRAY, Array, check_hdf5, check_size, damaged_file
from mitransient_lidar.core.validation import FloatArray, integer, positive, shown

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

_P = ParamSpec("_P")
_T = TypeVar("_T")

#: Largest difference between a projection's scale and 1. UTM zones and national grids have up to 0.003, Mercator's
#: projection beyond 8 degrees latitude has more.
LARGEST_DISTORTION = 0.01

_METRES_PER_FOOT = 0.3048


@functools.cache
def _thread() -> ThreadPoolExecutor:
    """Return the thread in which pyproj reads the systems of maps."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(1, "pyproj")


# A forked process has no thread but its own.
os.register_at_fork(after_in_child=_thread.cache_clear)


def _in_one_thread(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Run a function in a lasting thread, and return its result, which must contain no pyproj object.

    Mitsuba reads scenes in threads that end for Python after each plugin. pyproj then destroys its data for the thread,
    and takes them again for the next plugin: the process ended in a segmentation fault.
    """

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        return _thread().submit(function, *args, **kwargs).result()

    return run


class MapSystem(NamedTuple):
    """Projected coordinate system of a map."""

    wkt: str | None  #: WKT of the horizontal part; None for an old .prj file, which names units only.
    name: str
    unit: str  #: Position unit.
    metres: float  #: Its length [m].
    vertical_unit: str = ""  #: Height unit, "" if it is not stated.
    vertical_metres: float = 1.0  #: Its length [m].
    is_down: bool | None = None  #: Whether the vertical axis points down; None without one.
    datum: str = ""  #: Name of the vertical part.

    @_in_one_thread
    def check_scale(self, path: object, x: float, y: float) -> None:
        """Refuse a system whose metres at a place (x, y), in its own unit, are not metres on the ground."""
        if self.wkt is None:
            return
        import pyproj

        crs = pyproj.CRS.from_wkt(self.wkt)
        to_degrees = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
        places = [np.atleast_1d(one) for one in to_degrees.transform(x, y)]
        scale = distortions(crs, *places)[1][0]
        if not abs(scale - 1) < LARGEST_DISTORTION:
            raise UserError(
                f"{path} has coordinates in {self.name}, whose lengths at ({x:.10g}, {y:.10g}) are {scale:.4g} times"
                f" those on the ground: they must be within {LARGEST_DISTORTION:.0%}, as in UTM"
            )

    @_in_one_thread
    def distance_from(self, other: MapSystem, x: float, y: float) -> float:
        """Return the distance between the point x, y [m] in this system and the same numbers in another one [m].

        It is the distance at the farthest corner of a 1 km square at the point.
        """
        if self.wkt is None or other.wkt is None:
            return 0.0
        import pyproj

        x_m, y_m = np.array([x, x + 1e3, x, x + 1e3]), np.array([y, y, y + 1e3, y + 1e3])
        to_other = pyproj.Transformer.from_crs(self.wkt, other.wkt, always_xy=True)
        east, north = to_other.transform(x_m / self.metres, y_m / self.metres)
        return float(np.hypot(other.metres * east - x_m, other.metres * north - y_m).max())


def parsed_system(name: object, text: Any) -> Any:
    """Return the `pyproj.CRS` of a code, a WKT or attributes; `name` is the parameter or the file, for the message."""
    import pyproj

    try:
        return pyproj.CRS.from_cf(text) if isinstance(text, dict) else pyproj.CRS.from_user_input(text)
    except (pyproj.exceptions.CRSError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{name} = {shown(text)} is no coordinate system that pyproj knows, such as EPSG:32633"
        ) from error


def is_east_north(system: Any) -> bool:
    """Return whether x is east and y north, or both follow meridians near a pole, so that maps are not mirrored."""
    directions = sorted(str(axis.direction) for axis in system.axis_info[:2])
    return directions in (["east", "north"], ["north", "north"], ["south", "south"])


@_in_one_thread
def map_system(path: object, text: Any, name: object = None) -> MapSystem:
    """Return a map's system from a code, a WKT or attributes, which belong to `name` or to the map's own file.

    Raises `UserError` if pyproj does not know it, its coordinates are degrees or geocentric, or its axes do not point
    to east and north.
    """
    system = parsed_system(path if name is None else name, text)
    horizontal, vertical = system, None
    if system.is_compound:
        horizontal, vertical = system.sub_crs_list[0], system.sub_crs_list[1].axis_info[0]
    elif len(system.axis_info) == 3:
        vertical = system.axis_info[2]
    if horizontal.is_bound:
        horizontal = horizontal.source_crs
    called = system.name
    if horizontal.is_geographic:
        raise UserError(f"{path} has coordinates in degrees ({called}): they must be projected, in metres or feet")
    if not horizontal.is_projected and not horizontal.is_engineering:
        raise UserError(f"{path} has coordinates in {called}: they must be projected, in metres or feet")
    axes = horizontal.axis_info[:2]
    if horizontal.is_projected and not is_east_north(horizontal):
        directions = " and ".join(str(axis.direction) for axis in axes)
        raise UserError(f"{path} has coordinates in {called}, to {directions}: they must be to east and north")
    unit, metres = (str(axes[0].unit_name), float(axes[0].unit_conversion_factor)) if axes else ("metre", 1.0)
    found = MapSystem(horizontal.to_wkt() if horizontal.is_projected else None, called, unit, metres)
    if vertical is None:
        return found
    return found._replace(
        vertical_unit=str(vertical.unit_name),
        vertical_metres=float(vertical.unit_conversion_factor),
        is_down=str(vertical.direction) == "down",
        datum=system.sub_crs_list[1].name if system.is_compound else f"the ellipsoid of {called}",
    )


def read_prj(path: Path) -> MapSystem | None:
    """Return the system in the .prj file that shares a grid's name, None if there is none.

    Such files are WKT, or lines such as ``Projection UTM`` and ``Units METERS`` in an old format of ESRI.
    """
    prj = next((one for one in (path.with_suffix(".prj"), path.with_suffix(".PRJ")) if is_there(one)), None)
    if prj is None:
        return None
    text = read_text(prj).strip()
    if not text.lower().startswith("projection"):
        return map_system(path, text, prj)
    words = [line.split() for line in text.upper().splitlines()]
    old = {line[0]: " ".join(line[1:]) for line in words if len(line) > 1}
    if old["PROJECTION"].startswith("GEO") or old.get("UNITS") in ("DD", "DS", "DMS"):
        raise UserError(f"{path} has coordinates in degrees ({prj}): they must be projected, in metres or feet")
    lengths = {"METERS": 1.0, "FEET": _METRES_PER_FOOT}
    unit, heights = old.get("UNITS", "METERS"), old.get("ZUNITS", "NO")
    for name, value, allowed in (("Units", unit, lengths), ("Zunits", heights, (*lengths, "NO"))):
        if value not in allowed:
            raise UserError(f"{path} has {name} {value} in {prj}: allowed are {', '.join(allowed)}")
    stated = {} if heights == "NO" else {"vertical_unit": heights.lower(), "vertical_metres": lengths[heights]}
    return MapSystem(None, old["PROJECTION"], unit.lower(), lengths[unit], **stated)  # type: ignore[arg-type]


def distortions(system: Any, longitude: FloatArray, latitude: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the azimuth of true north from grid north [deg], and the scale of a projection, at positions [deg].

    The scale is of lengths in the projection to lengths on the ground, along the meridian or the parallel, whichever
    differs more from 1; NaN outside the projection.
    """
    import pyproj

    factors = pyproj.Proj(system).get_factors(longitude, latitude)
    scales = np.stack([factors.meridional_scale, factors.parallel_scale])
    scales[~np.isfinite(scales)] = np.nan
    return -np.asarray(factors.meridian_convergence), np.where(
        abs(scales[0] - 1) > abs(scales[1] - 1), scales[0], scales[1]
    )


#: Value of ASCII grid cells without a height, if the header does not name another, and of empty BAG cells.
_ASCII_EMPTY, _BAG_EMPTY = -9999.0, 1e6

_ROUNDED = 1e-5  #: Relative difference between a cell and the no-height value: it may be written with six digits.

_HIGHEST = 12_000.0  #: Largest distance of heights from the mean sea level [m]: deeper than any sea.

#: Numbers that programs write for no data, of either sign, where no other height is nearer than a tenth of them.
NO_DATA = (99.0, 999.0, 9999.0)
_NEAR = 0.1

_CORNER_TOLERANCE = 0.1  #: Largest deviation between a BAG file's corners and its cells, in cells.


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
