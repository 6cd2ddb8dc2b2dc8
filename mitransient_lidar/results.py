"""Results as labelled arrays, and the files that keep them.

A result is an `xarray.Dataset` with the variables ``impulse_response`` [J per bin] and ``waveform`` [W] and their
standard errors ``impulse_response_stderr`` and ``waveform_stderr``, over the dimensions (pixel, time), or (row, column,
time) for an imager. The coordinates are ``time`` [ns] at the centres of the bins, ``pixel`` (names), and the centres of
the pixels in tangent-plane angles, ``gx`` and ``gy`` [mrad]. The parameters of the render are attributes.

EXR files keep the values in 32 bits and everything else exactly; NetCDF files keep everything exactly.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import dataset_files, exr
from mitransient_lidar._version import __version__
from mitransient_lidar.dataset_files import attribute, text
from mitransient_lidar.errors import UserError

_LOG = logging.getLogger(__name__)

_VARIABLES: dict[str, dict[str, str]] = {
    "impulse_response": {
        "units": "J",
        "long_name": "received energy per time bin",
        "ancillary_variables": "impulse_response_stderr",
    },
    "impulse_response_stderr": {"units": "J", "long_name": "standard error of the received energy per time bin"},
    "waveform": {"units": "W", "long_name": "received power", "ancillary_variables": "waveform_stderr"},
    "waveform_stderr": {"units": "W", "long_name": "standard error of the received power"},
}
_CHANNELS = {
    "impulse_response": ("bin", "Y"),
    "impulse_response_stderr": ("bin", "stderr"),
    "waveform": ("wave", "Y"),
    "waveform_stderr": ("wave", "stderr"),
}
_NAMED_PIXELS = 5  # pixels named one by one in a warning


def build(
    impulse_response: npt.ArrayLike,
    impulse_response_stderr: npt.ArrayLike,
    waveform: npt.ArrayLike,
    waveform_stderr: npt.ArrayLike,
    *,
    time_start_ns: float,
    bin_width_ns: float,
    pixel_names: Sequence[str],
    pixel_centres_mrad: npt.ArrayLike,
    grid: tuple[int, int] | None = None,
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Label the arrays of a render.

    Non-finite values are kept, and logged as a warning that names their pixels.

    Parameters
    ----------
    impulse_response, impulse_response_stderr : array-like of shape (pixel, time)
        Received energy and its standard error. [J per bin]
    waveform, waveform_stderr : array-like of shape (pixel, time)
        Received power after the pulse and the receiver's response, and its standard error. [W]
    time_start_ns : float
        Left edge of the first bin; zero when the pulse's peak leaves the transmitter. [ns]
    bin_width_ns : float
        Width of the bins, above 0. [ns]
    pixel_names : sequence of str
        One name a pixel, all different. Not used with `grid`, where row and column name a pixel.
    pixel_centres_mrad : array-like of shape (pixel, 2)
        Tangent-plane angles (gx, gy) of the centres of the pixels. [mrad]
    grid : tuple of int, optional
        Rows and columns of an imager, whose pixels come row by row.
    attributes : mapping of str to int, float, str or a list of those
        Parameters and outcome of the render; they win over the attributes set here (``title``, ``history``, ...).

    Returns
    -------
    xarray.Dataset
        As described at the head of this module.

    Raises
    ------
    ValueError
        If shapes disagree, names repeat, numbers are out of range or an attribute is of another kind.
    """
    values = {
        name: np.array(array, dtype=np.float64)
        for name, array in zip(
            _VARIABLES, (impulse_response, impulse_response_stderr, waveform, waveform_stderr), strict=True
        )
    }
    shape = values["impulse_response"].shape
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"impulse_response has shape {shape}; it must be (pixel, time) with at least one of each.")
    for name, array in values.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}; it must be that of impulse_response, {shape}.")
    centres = np.asarray(pixel_centres_mrad, dtype=np.float64)
    if centres.shape != (shape[0], 2) or not np.isfinite(centres).all():
        raise ValueError(f"pixel_centres_mrad must be {shape[0]} finite pairs (gx, gy), but has shape {centres.shape}.")
    if not math.isfinite(time_start_ns):
        raise ValueError(f"time_start_ns = {time_start_ns} must be finite.")
    if not (math.isfinite(bin_width_ns) and bin_width_ns > 0):
        raise ValueError(f"bin_width_ns = {bin_width_ns} must be a finite number above 0.")

    coords = pixel_coordinates(pixel_names, centres, grid)
    dims = coords["gx"][0]
    layout = coords["gx"][1].shape
    time = time_start_ns + (np.arange(shape[1]) + 0.5) * bin_width_ns
    time_name = "time at the centre of the bin since the pulse's peak left the transmitter"
    coords["time"] = ("time", time, {"units": "ns", "long_name": time_name})

    _warn_of_non_finite(
        values,
        coords["pixel"][1].tolist() if grid is None else [f"({i // grid[1]}, {i % grid[1]})" for i in range(shape[0])],
    )
    return xr.Dataset(
        {name: ((*dims, "time"), values[name].reshape(*layout, -1), dict(_VARIABLES[name])) for name in _VARIABLES},
        coords,
        provenance({"time_start_ns": float(time_start_ns), "bin_width_ns": float(bin_width_ns), **attributes}),
    )


def pixel_coordinates(
    pixel_names: Sequence[str], pixel_centres_mrad: npt.ArrayLike, grid: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Return the coordinates of pixels: names, or row and column, and the centres gx and gy.

    Parameters
    ----------
    pixel_names, pixel_centres_mrad, grid
        As for `build`.

    Raises
    ------
    ValueError
        If names repeat, or their number or that of the grid's cells is not that of the centres.
    """
    centres = np.asarray(pixel_centres_mrad, dtype=np.float64)
    count = len(centres)
    dims: tuple[str, ...]
    layout: tuple[int, ...]
    coords: dict[str, Any]
    if grid is None:
        names = [text(name) for name in pixel_names]
        if len(names) != count or len(set(names)) != len(names):
            raise ValueError(f"pixel_names = {names} must be {count} different names, one a pixel.")
        dims, layout = ("pixel",), (count,)
        coords = {"pixel": ("pixel", np.array(names, dtype=str), {"long_name": "pixel name"})}
    else:
        rows, columns = grid
        if rows < 1 or columns < 1 or rows * columns != count:
            raise ValueError(f"grid = {grid} must have as many cells as there are pixels, {count}.")
        dims, layout = ("row", "column"), (rows, columns)
        coords = {
            "row": ("row", np.arange(rows), {"long_name": "row of the image, 0 farthest from nadir"}),
            "column": ("column", np.arange(columns), {"long_name": "column of the image, 0 at the -gy edge"}),
        }
    where = {"gx": "in the plane of incidence, away from nadir", "gy": "across the plane of incidence"}
    for axis, (name, direction) in enumerate(where.items()):
        described = {"units": "mrad", "long_name": f"angle of the pixel's centre {direction}"}
        coords[name] = (dims, centres[:, axis].reshape(layout), described)
    return coords


def provenance(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes of a result: those given, checked, and what made it (``title``, ``source``, ``history``).

    Raises
    ------
    ValueError
        If an attribute is no int, float, str or list of one of those.
    """
    return {
        "Conventions": "CF-1.11",
        "title": f"Received lidar power, scene {attributes['scene']}" if "scene" in attributes else "Lidar power",
        "source": f"mitransient-lidar {__version__}",
        "history": f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ} rendered by mitransient-lidar {__version__}",
        **{text(name): attribute(name, value) for name, value in attributes.items()},
    }


def save(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a result to an EXR or NetCDF file, whole or not at all.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of `build` or `open`; coordinates and, for NetCDF, variables may have been added.
    path : path
        File name that ends in ``.exr`` or ``.nc``. An existing file is replaced.

    Raises
    ------
    UserError
        If the suffix is another one, the dataset is no result, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".exr", ".nc"):
        raise UserError(f"cannot write {path}: the file name must end in .exr or .nc.")
    if missing := [name for name in _VARIABLES if name not in dataset]:
        raise UserError(f"cannot write {path}: the dataset has no variable {missing[0]}.")
    with replacing(path) as temporary:
        if suffix == ".exr":
            _write_exr(dataset, path, temporary)
        else:
            dataset_files.write_netcdf(dataset, temporary, _VARIABLES)


def open(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a result, whatever its file is called.

    Parameters
    ----------
    path : path
        An EXR or NetCDF file written by `save`.

    Returns
    -------
    xarray.Dataset
        The saved result, in memory; the values of an EXR file have been rounded to 32 bits.

    Raises
    ------
    UserError
        If the file is missing, damaged, truncated, or not a result of this package.
    """
    path = Path(path)
    signature = dataset_files.read_signature(path)
    if signature.startswith(exr.SIGNATURE):
        return _read_exr(path)
    if signature == dataset_files.HDF5_SIGNATURE:
        return _read_netcdf(path)
    raise UserError(f"{path} is neither an EXR nor a NetCDF-4 file.")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a new name in the folder of `path`; on success the file written there takes the place of `path`.

    On any failure, an interruption included, the new file is removed and `path` is as it was.

    Raises
    ------
    UserError
        If the operating system refuses.
    """
    path = Path(path)
    temporary = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}.") from error
    finally:
        # Below a regular file even the look for the temporary one fails.
        with contextlib.suppress(OSError):
            temporary.unlink()


def _write_exr(dataset: xr.Dataset, path: Path, temporary: Path) -> None:
    if extra := [str(name) for name in dataset.data_vars if name not in _VARIABLES]:
        raise UserError(f"cannot write {path}: an EXR file has no place for the variable {extra[0]}; use a .nc file.")
    stacks: dict[str, dict[str, npt.NDArray[Any]]] = {}
    for name, (stack, component) in _CHANNELS.items():
        values = dataset[name].values
        # Pixels that form no grid lie side by side in an image one row high.
        image = values if values.ndim == 3 else values[np.newaxis]
        stacks.setdefault(stack, {})[component] = image
    exact = {
        "dims": list(dataset["impulse_response"].dims),
        "attributes": dataset.attrs,
        "variables": {name: dataset[name].attrs for name in _VARIABLES},
        "coordinates": dataset_files.describe_coordinates(dataset),
    }
    readable = {f"lidar.{name}": value for name, value in dataset.attrs.items()}
    readable |= {"timeStartNs": dataset.attrs["time_start_ns"], "binWidthNs": dataset.attrs["bin_width_ns"]}
    if "pixel" in dataset.coords:
        readable["pixelNames"] = [str(name) for name in dataset["pixel"].values]
    exr.write(temporary, stacks, exact, readable)


def _read_exr(path: Path) -> xr.Dataset:
    stacks, exact = exr.read(path)
    try:
        images = {name: stacks[stack][component] for name, (stack, component) in _CHANNELS.items()}
        dims = tuple(exact["dims"])
        return xr.Dataset(
            {
                name: (dims, (image if len(dims) == 3 else image[0]).astype(np.float64), exact["variables"][name])
                for name, image in images.items()
            },
            dataset_files.coordinates(exact["coordinates"]),
            exact["attributes"],
        )
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: its metadata and its image do not belong together.") from error


def _read_netcdf(path: Path) -> xr.Dataset:
    dataset = dataset_files.read_netcdf(path)
    if any(name not in dataset for name in _VARIABLES):
        raise UserError(f"{path} is a NetCDF file, but not a result of mitransient-lidar.")
    return dataset


def _warn_of_non_finite(values: Mapping[str, npt.NDArray[np.float64]], names: Sequence[str]) -> None:
    for variable, array in values.items():
        counts = np.count_nonzero(~np.isfinite(array), axis=1)
        if affected := np.flatnonzero(counts).tolist():
            pixels = ", ".join(f"{names[index]}: {counts[index]}" for index in affected[:_NAMED_PIXELS])
            more = f" and {len(affected) - _NAMED_PIXELS} more pixels" if len(affected) > _NAMED_PIXELS else ""
            _LOG.warning("%s has non-finite values in pixel %s%s", variable, pixels, more)
