"""Height maps: the elevation of a surface on a rectangular grid, read from a file."""

from __future__ import annotations

import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.checks import FloatArray, positive

#: Positions may deviate from even spacing by this part of it, as 32-bit numbers and decimals of text do.
_UNEVENNESS = 1e-3

_NETCDF_NAMES = ("height", "elevation")
_EXR_CHANNELS = ("Y", "R", "Z")

Positions = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Elevation of a surface on a rectangular grid.

    Attributes
    ----------
    heights : ndarray, shape (rows, columns)
        Elevation [m]; row 0 has the smallest y, column 0 the smallest x.
    x, y : ndarray, shapes (columns,) and (rows,)
        Positions of columns and rows [m], evenly spaced, increasing, at least 2 each.
    """

    heights: FloatArray
    x: FloatArray
    y: FloatArray

    def sample(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return the elevation on grid lines, bilinear between the points of the map.

        Parameters
        ----------
        x, y : array_like, shapes (N,) and (M,)
            Positions of the grid lines [m]. A point outside the map has the height of the nearest point of its edge.

        Returns
        -------
        ndarray, shape (M, N)
            Elevation [m] at (x[i], y[j]) for element [j, i].
        """
        i, right = _cells(self.x, x)
        j, up = _cells(self.y, y)
        columns = self.heights[:, i] * (1 - right) + self.heights[:, i + 1] * right
        return np.asarray(columns[j] * (1 - up[:, None]) + columns[j + 1] * up[:, None])


def read_height_map(path: str | os.PathLike[str], size: float | None = None) -> HeightMap:
    """Read a height map from a file.

    Parameters
    ----------
    path : path
        File whose suffix tells its kind, heights in metres:

        ``.npy``
            a two-dimensional array, ``heights[j, i]`` at the j-th y and the i-th x;
        ``.npz``
            such an array ``heights`` and, if known, positions ``x`` and ``y`` [m];
        ``.exr``
            an image of one channel, or its channel Y, else R, else Z; its top row has the largest y;
        ``.nc``
            a variable ``height`` or ``elevation``, or the only one with two dimensions, of the dimensions (y, x) or
            (x, y) with, if known, the coordinates ``x`` and ``y`` [m]. Dimensions of other names count as (y, x).
    size : float, optional
        Distance from the first to the last column [m], positive. The map is centred on the origin and its cells are
        squares. Needed if the file has no positions, not allowed if it has.

    Returns
    -------
    HeightMap

    Raises
    ------
    ValueError
        If the file is missing, damaged or of another kind; the map not two-dimensional, of fewer than 2 rows or
        columns, or with holes; positions not increasing or not evenly spaced; or `size` not positive, missing or
        superfluous.
    """
    path = Path(path)
    readers = {".npy": _read_npy, ".npz": _read_npz, ".exr": _read_exr, ".nc": _read_netcdf}
    if path.suffix.lower() not in readers:
        raise UserError(f"cannot read {path}: the name of a height map must end in {', '.join(readers)}.")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}.") from error
    values, positions = readers[path.suffix.lower()](path)
    heights = _numbers(path, "heights", values)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise UserError(f"{path} has heights of shape {heights.shape}, but must have at least 2 rows and 2 columns.")
    holes = np.argwhere(~np.isfinite(heights))
    if len(holes) > 0:
        row, column = holes[0]
        raise UserError(
            f"{path} has holes, {len(holes)} of {heights.size} heights, the first in row {row} and column {column}"
            " counted from 0 at the smallest y and x: every height must be finite."
        )
    return HeightMap(heights, *_positions(path, heights.shape, positions, size))


def _positions(path: Path, shape: tuple[int, ...], given: tuple[Any, Any] | None, size: float | None) -> Positions:
    rows, columns = shape
    if given is None:
        if size is None:
            raise UserError(f"{path} does not tell where its heights are: give the size of the map along x, in metres.")
        cell = positive("size", size) / (columns - 1)
        x, y = (np.asarray((np.arange(n) - (n - 1) / 2) * cell, dtype=np.float64) for n in (columns, rows))
        return x, y
    if size is not None:
        raise UserError(f"size = {size} must not be given: {path} has positions of its own.")
    x, y = (
        _even_positions(path, name, values, n) for name, values, n in zip("xy", given, (columns, rows), strict=True)
    )
    return x, y


def _even_positions(path: Path, name: str, values: Any, count: int) -> FloatArray:
    positions = _numbers(path, name, values)
    if positions.shape != (count,):
        raise UserError(f"{path} has {name} of shape {positions.shape}, but its heights need ({count},).")
    if not np.all(np.isfinite(positions)):
        where = int(np.flatnonzero(~np.isfinite(positions))[0])
        raise UserError(f"{path} has {name}[{where}] = {positions[where]:g}: positions must be finite.")
    gaps = np.diff(positions)
    if not np.all(gaps > 0):
        where = int(np.flatnonzero(gaps <= 0)[0])
        raise UserError(
            f"{path} has {name}[{where}] = {positions[where]:g} and {name}[{where + 1}] = {positions[where + 1]:g}:"
            " positions must increase."
        )
    spacing = (positions[-1] - positions[0]) / (count - 1)
    worst = int(np.argmax(np.abs(gaps - spacing)))
    if abs(gaps[worst] - spacing) > _UNEVENNESS * spacing:
        raise UserError(
            f"{path} has {name}[{worst}] and {name}[{worst + 1}] {gaps[worst]:g} apart, but {spacing:g} on average:"
            " positions must be evenly spaced."
        )
    return positions


def _cells(positions: FloatArray, wanted: npt.ArrayLike) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Return the cells that hold the wanted positions, and how far in each they lie, 0 to 1."""
    inside = np.clip(np.asarray(wanted, dtype=np.float64), positions[0], positions[-1])
    index = np.clip(np.searchsorted(positions, inside, side="right") - 1, 0, len(positions) - 2)
    return index, (inside - positions[index]) / (positions[index + 1] - positions[index])


def _numbers(path: Path, name: str, values: Any) -> FloatArray:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise UserError(f"{path} has {name} of type {array.dtype}, but they must be real numbers.")
    return array.astype(np.float64)


def _read_npy(path: Path) -> tuple[Any, None]:
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False), None
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path} is damaged, or is not one array of numbers in NumPy's format.") from error


def _read_npz(path: Path) -> tuple[Any, tuple[Any, Any] | None]:
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in ("heights", "x", "y") if name in archive}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged, or is not an archive of arrays in NumPy's format.") from error
    if "heights" not in arrays:
        raise UserError(f"{path} must have an array heights, and may have x and y.")
    return arrays["heights"], _both(path, arrays)


def _read_exr(path: Path) -> tuple[Any, None]:
    import OpenEXR

    from mitransient_lidar import exr

    damaged = f"{path} is damaged, or is not an OpenEXR file: its image cannot be read."
    with path.open("rb") as file:
        # Without this look OpenEXR's message for a foreign file would reach the terminal.
        if file.read(len(exr.SIGNATURE)) != exr.SIGNATURE:
            raise UserError(damaged)
    with exr.silent_library():
        try:
            with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
                images = {name: channel.pixels.copy() for name, channel in file.channels().items()}
        except (RuntimeError, ValueError) as error:
            raise UserError(damaged) from error
    names = list(images) if len(images) == 1 else [name for name in _EXR_CHANNELS if name in images]
    if not names:
        channels = ", ".join(sorted(images))
        raise UserError(f"{path} has the channels {channels}: it must have only one, or one called Y, R or Z.")
    return images[names[0]][::-1], None


def _read_netcdf(path: Path) -> tuple[Any, tuple[Any, Any] | None]:
    import xarray as xr

    try:
        dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} is damaged, or is not a NetCDF-4 file.") from error
    flat = [name for name, variable in dataset.data_vars.items() if variable.ndim == 2]
    names = [name for name in _NETCDF_NAMES if name in dataset.data_vars] or flat
    if len(names) != 1:
        raise UserError(
            f"{path} has {len(names)} variables that may be the heights: it must have one called height or elevation,"
            " or only one with two dimensions."
        )
    variable = dataset[names[0]]
    if variable.dims == ("x", "y"):
        variable = variable.transpose("y", "x")
    return variable.values, _both(path, {name: dataset[name].values for name in ("x", "y") if name in dataset})


def _both(path: Path, arrays: dict[str, Any]) -> tuple[Any, Any] | None:
    """Return the positions x and y, None if there are none."""
    found = [name for name in ("x", "y") if name in arrays]
    if len(found) == 1:
        raise UserError(f"{path} has positions {found[0]} only: it must have both x and y, or none.")
    return (arrays["x"], arrays["y"]) if found else None
