"""Labelled results, and their files.

A result is an `xarray.Dataset` with the variables ``impulse_response`` [J per bin] and ``waveform`` [W] and their
standard errors ``impulse_response_stderr`` and ``waveform_stderr``, over the dimensions (pixel, time), or (row, column,
time) for an imager. The coordinates are ``time`` [ns] at the centres of the bins, ``pixel`` (names), and the centres of
the pixels in tangent-plane angles, ``angle_x`` and ``angle_y`` [mrad]. The parameters of the render are attributes,
among them the scene and all parameters of its plugins (`loading.scene_record`), from which it can be rendered again. A
series of shots has the dimension ``shot`` first, and the truth of each shot as coordinates. Light that was separated
by its origin is in variables whose names end in ``_by_origin``, over ``origin`` and the other dimensions; derivatives
by parameters of the scene are in ``waveform_derivative`` and ``impulse_response_derivative``, over ``parameter`` and
these. The power of batches of passes is in ``waveform_batch``, over ``batch`` and the same dimensions.

EXR files round the values to 32 bits and store everything else exactly, without the light by origin; NetCDF files store
everything exactly.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar._version import __version__
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.validation import finite, positive
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results import exr, netcdf, sum_errors
from mitransient_lidar.results.formats import (
    IMAGE_AXES,
    attribute,
    describe,
    input_format,
    labelled,
    output_format,
    text,
)
from mitransient_lidar.results.geometry import optional_number
from mitransient_lidar.results.schema import check_attributes, check_coordinates

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
_TIME_TOLERANCE = 1e-3  # of a bin, between the time coordinate and the attributes
_NAMED_PIXELS = 5  # largest number of pixels listed in a warning


def build(
    impulse_response: npt.ArrayLike,
    impulse_response_stderr: npt.ArrayLike,
    waveform: npt.ArrayLike,
    waveform_stderr: npt.ArrayLike,
    *,
    time: TimeAxis,
    pixel_names: Sequence[str],
    pixel_centres_mrad: npt.ArrayLike,
    grid: tuple[int, int] | None = None,
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Label the arrays of a render as a result.

    Non-finite values are kept; a warning lists their pixels.

    Parameters
    ----------
    impulse_response, impulse_response_stderr : array-like of shape (pixel, time)
        Received energy and its standard error [J per bin].
    waveform, waveform_stderr : array-like of shape (pixel, time)
        Received power after the pulse and the receiver's response, and its standard error [W].
    time : TimeAxis
        The time bins.
    pixel_names : sequence of str
        Unique names of the pixels; unused with `grid`.
    pixel_centres_mrad : array-like of shape (pixel, 2)
        Tangent-plane angles (angle_x, angle_y) of the centres of the pixels [mrad].
    grid : tuple of int, optional
        Rows and columns of an imager, with pixels in row-major order.
    attributes : mapping of str to int, float, str or a list of those
        Parameters and outcome of the render; they override the attributes set here (``title``, ``history``, ...).

    Raises
    ------
    ValueError
        If shapes disagree, names repeat, a number is out of range or an attribute has an unsupported type.
    """
    arrays = (impulse_response, impulse_response_stderr, waveform, waveform_stderr)
    values = {name: np.array(array, dtype=np.float64) for name, array in zip(_VARIABLES, arrays, strict=True)}
    shape = values["impulse_response"].shape
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"impulse_response has shape {shape}; it must be (pixel, time) with at least one of each.")
    for name, array in values.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}; it must be that of impulse_response, {shape}.")
    if time.bin_count != shape[1]:
        raise ValueError(f"time has {time.bin_count} bins; it must have those of impulse_response, {shape[1]}.")
    centres = np.asarray(pixel_centres_mrad, dtype=np.float64)
    if centres.shape != (shape[0], 2) or not np.isfinite(centres).all():
        raise ValueError(
            f"pixel_centres_mrad must be {shape[0]} finite pairs (angle_x, angle_y), but has shape {centres.shape}."
        )
    bins = {"time_start_ns": finite("time_start_ns", time.start_ns)}
    bins["bin_width_ns"] = positive("bin_width_ns", time.bin_width_ns)

    coords = pixel_coordinates(pixel_names, centres, grid)
    dims, layout = coords["angle_x"][0], coords["angle_x"][1].shape
    time_name = "time at the centre of the bin since the pulse's peak left the transmitter"
    coords["time"] = ("time", time.centres_ns, {"units": "ns", "long_name": time_name})
    names = coords["pixel"][1].tolist() if grid is None else [str(divmod(i, grid[1])) for i in range(shape[0])]
    _warn_of_non_finite(values, names)
    return xr.Dataset(
        {name: ((*dims, "time"), values[name].reshape(*layout, -1), about) for name, about in _VARIABLES.items()},
        coords,
        provenance({**bins, **attributes}),
    )


def build_series(*arrays: npt.ArrayLike, **described: Any) -> xr.Dataset:
    """Label the arrays of a series of shots, of shape (shot, pixel, time), as a result; see `build`."""
    values = [np.asarray(array, dtype=np.float64) for array in arrays]
    # The mean holds what is not finite in any shot.
    labelled = build(*(array.mean(axis=0) for array in values), **described)
    data = {
        name: (("shot", *labelled[name].dims), array.reshape(-1, *labelled[name].shape), labelled[name].attrs)
        for name, array in zip(_VARIABLES, values, strict=True)
    }
    number = ("shot", np.arange(len(values[0])), {"units": "1", "long_name": "number of the shot"})
    return labelled.assign(data).assign_coords(shot=number)


def add_components(dataset: xr.Dataset, origins: Sequence[str], *arrays: npt.ArrayLike) -> xr.Dataset:
    """Return a result of `build` or `build_series` with its light by origin.

    Parameters
    ----------
    dataset : xarray.Dataset
        The result.
    origins : sequence of str
        Unique names of the origins.
    arrays : array-like of shape (pixel, origin, time)
        The four arrays of `build`, of each origin; of a series with the shots first.
    """
    values = [np.moveaxis(np.asarray(array, dtype=np.float64), -2, 0) for array in arrays]
    coords = {"origin": (np.array(origins, dtype=str), {"long_name": "where the light comes from"})}
    return _add(
        dataset, "by_origin", coords, values, lambda about: {**about, "long_name": f"{about['long_name']}, by origin"}
    )


def add_derivatives(
    dataset: xr.Dataset,
    names: Sequence[str],
    values: Sequence[float],
    units: Sequence[str],
    methods: Sequence[str],
    *arrays: npt.ArrayLike,
) -> xr.Dataset:
    """Return a result of `build` or `build_series` with its derivatives by parameters.

    Parameters
    ----------
    dataset : xarray.Dataset
        The result.
    names, values, units, methods : sequences
        Of each parameter: unique name, value at which the light was rendered, unit, and ``score`` or ``central
        differences``.
    arrays : array-like of shape (parameter, pixel, time)
        Derivatives of the four arrays of `build` by the parameter in its unit; of a series with the shots after the
        parameters.
    """
    coords = {
        "parameter": (np.array(names, dtype=str), {"long_name": "parameter of the scene"}),
        "parameter_value": (np.array(values, dtype=np.float64), {"long_name": "value of the parameter"}),
        "parameter_units": (np.array(units, dtype=str), {"long_name": "unit of the parameter"}),
        "parameter_method": (np.array(methods, dtype=str), {"long_name": "estimate of the derivative"}),
    }

    def described(about: Mapping[str, str]) -> dict[str, str]:
        name = about["long_name"].replace("received", "derivative of the received")
        return {"units": f"{about['units']} per unit of the parameter", "long_name": name}

    return _add(dataset, "derivative", coords, arrays, described)


def add_batches(dataset: xr.Dataset, passes: Sequence[int], waveforms: npt.ArrayLike) -> xr.Dataset:
    """Return a result of `build` with the mean power of each batch of passes, ``waveform_batch`` [W].

    Parameters
    ----------
    dataset : xarray.Dataset
        The result.
    passes : sequence of int
        Number of passes of each batch.
    waveforms : array-like of shape (batch, pixel, time)
        Mean power of these passes [W].
    """
    waveform = dataset["waveform"]
    values = np.asarray(waveforms, dtype=np.float64).reshape(len(passes), *waveform.shape)
    about = {"units": "W", "long_name": "received power by a batch of passes"}
    counted = ("batch", np.array(passes), {"units": "1", "long_name": "number of passes of the batch"})
    return dataset.assign(waveform_batch=(("batch", *waveform.dims), values, about)).assign_coords(batch_passes=counted)


def _add(
    dataset: xr.Dataset,
    ending: str,
    coords: Mapping[str, tuple[npt.NDArray[Any], dict[str, str]]],
    arrays: Sequence[npt.ArrayLike],
    described: Callable[[Mapping[str, str]], dict[str, str]],
) -> xr.Dataset:
    """Return a result with other values of its four variables, under names with an ending.

    The dimension of the first coordinate is added before those of the variables; `described` gives units and name.
    """
    dim, (dims, shape) = next(iter(coords)), (dataset["waveform"].dims, dataset["waveform"].shape)
    data = {}
    for (name, about), array in zip(_VARIABLES.items(), arrays, strict=True):
        attributes = described(about)
        if "ancillary_variables" in about:
            attributes["ancillary_variables"] = _with_ending(about["ancillary_variables"], ending)
        values = np.asarray(array, dtype=np.float64).reshape(len(coords[dim][0]), *shape)
        data[_with_ending(name, ending)] = ((dim, *dims), values, attributes)
    return dataset.assign(data).assign_coords({name: (dim, *about) for name, about in coords.items()})


def _with_ending(name: str, ending: str) -> str:
    """Return the name of a variable with an ending, which precedes that of standard errors."""
    stem = name.removesuffix("_stderr")
    return f"{stem}_{ending}{name[len(stem) :]}"


def record_dims(dataset: xr.Dataset, name: str, *, shots: bool = False) -> tuple[str, ...]:
    """Return the dimensions of a variable, (pixel, time) or (row, column, time), with `shots` also after ``shot``.

    Raises
    ------
    UserError
        If the variable or a coordinate is missing, the dimensions are others or empty, or the times are invalid.
    """
    if name not in dataset:
        raise UserError(f"the dataset has no variable {name}: it must be a result with a record in time")
    dims = tuple(str(dim) for dim in dataset[name].dims)
    own = dims[1:] if shots and dims[:1] == ("shot",) else dims
    if own not in (("pixel", "time"), ("row", "column", "time")):
        after = ", or these after shot" if shots else ""
        raise UserError(f"{name} has the dimensions {dims}; they must be (pixel, time) or (row, column, time){after}")
    if missing := [dim for dim in dims if dim not in dataset.coords]:
        raise UserError(f"the dataset has no coordinate {missing[0]}; {name} over {dims} needs it")
    check_axes("the dataset", dataset, name)
    return dims


def time_axis(dataset: xr.Dataset) -> TimeAxis:
    """Return the time bins of a dataset.

    They come from the attributes ``time_start_ns`` and ``bin_width_ns`` where the coordinate ``time`` agrees with
    them, else from the coordinate, as after a selection of bins.

    Raises
    ------
    UserError
        If the dataset has no coordinate ``time``, or a single bin of unknown width.
    """
    if "time" not in dataset.coords:
        raise UserError("the dataset has no coordinate time")
    centres = np.asarray(dataset["time"].values, dtype=np.float64)
    start, width = (optional_number(dataset.attrs, name) for name in ("time_start_ns", "bin_width_ns"))
    if start is not None and width is not None and width > 0:
        stored = TimeAxis(start, width, centres.size)
        if np.allclose(stored.centres_ns, centres, rtol=0, atol=_TIME_TOLERANCE * width):
            return stored
    if centres.size > 1:
        width = float(centres[-1] - centres[0]) / (centres.size - 1)
    if width is None or not width > 0:
        raise UserError("the dataset has no attribute bin_width_ns, and its coordinate time no two increasing times")
    return TimeAxis(float(centres[0]) - 0.5 * width, width, centres.size)


def pixel_coordinates(
    pixel_names: Sequence[str], pixel_centres_mrad: npt.ArrayLike, grid: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Return the coordinates of pixels: their names, or rows and columns, and their centres angle_x and angle_y.

    The arguments are those of `build`.

    Raises
    ------
    ValueError
        If names repeat, or the number of names or grid cells differs from that of the centres.
    """
    centres = np.asarray(pixel_centres_mrad, dtype=np.float64)
    count = len(centres)
    coords: dict[str, Any]
    if grid is None:
        names = [text(name) for name in pixel_names]
        if len(names) != count or len(set(names)) != len(names):
            raise ValueError(f"pixel_names = {names} must be {count} different names, one a pixel.")
        coords = {"pixel": ("pixel", np.array(names, dtype=str), {"long_name": "pixel name"})}
    else:
        rows, columns = grid
        if rows < 1 or columns < 1 or rows * columns != count:
            raise ValueError(f"grid = {grid} must have as many cells as there are pixels, {count}.")
        coords = {
            dim: (dim, np.arange(size), {"units": "1", "long_name": IMAGE_AXES[dim][0]})
            for dim, size in zip(("row", "column"), grid, strict=True)
        }
    dims, layout = tuple(coords), grid or (count,)
    where = {
        "angle_x": "in the plane of incidence, away from nadir",
        "angle_y": "across the plane of incidence, to the left",
    }
    for axis, (name, direction) in enumerate(where.items()):
        described = {"units": "mrad", "long_name": f"angle of the pixel's centre {direction}"}
        coords[name] = (dims, centres[:, axis].reshape(layout), described)
    return coords


def provenance(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a result, checked, with ``title``, ``source`` and ``history`` added.

    Raises
    ------
    ValueError
        If an attribute is no int, float, str or list of one of those.
    """
    return {
        "Conventions": "CF-1.11",
        "title": f"Received lidar power, scene {attributes['scene']}" if "scene" in attributes else "Lidar power",
        "source": f"mitransient-lidar {__version__}",
        "history": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} rendered by mitransient-lidar {__version__}",
        **{text(name): attribute(name, value) for name, value in attributes.items()},
    }


def save(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a result to an EXR (``.exr``) or NetCDF file (``.nc``) atomically; an existing file is replaced.

    Coordinates and, for NetCDF, variables may have been added to the result of `build` or `open`.

    Raises
    ------
    UserError
        If the file name ends otherwise, the dataset is no result, or the file cannot be written.
    """
    path = Path(path)
    file_format = output_format(path)
    if missing := [name for name in _VARIABLES if name not in dataset]:
        raise UserError(f"cannot write {path}: the dataset has no variable {missing[0]}.")
    with replacing(path) as temporary:
        if file_format == "exr":
            _write_exr(dataset, path, temporary)
        else:
            endings = "by_origin", "derivative"
            large = [*_VARIABLES, "waveform_batch", sum_errors.VARIABLE]
            large += [_with_ending(name, ending) for ending in endings for name in _VARIABLES]
            large = [name for name in large if name in dataset]
            netcdf.write_netcdf(dataset, temporary, large)


def open(path: str | os.PathLike[str], *, signals: bool = False) -> xr.Dataset:
    """Read a result from an EXR or NetCDF file of `save` into memory; values from an EXR file have 32 bits.

    With `signals`, the signals of a receiver (`analysis.receiver.detect_waveforms`) are read, too.

    Raises
    ------
    UserError
        If the file is missing, damaged, truncated, or not a result of this package, or its times are invalid.
    """
    path = Path(path)
    dataset = _read_exr(path) if input_format(path) == "exr" else netcdf.read_netcdf(path)
    if "signal" in dataset and "waveform" not in dataset:
        if signals:
            check_axes(path, dataset, "signal")
            return dataset
        raise UserError(f"{path} holds signals of a receiver; give the result that they were recorded from.")
    if any(name not in dataset for name in _VARIABLES):
        raise UserError(f"{path} is a NetCDF file, but not a result of mitransient-lidar.")
    check_axes(path, dataset, "waveform")
    return dataset


def check_axes(place: object, dataset: xr.Dataset, name: str) -> None:
    """Raise `UserError` if a variable has no times, pixels or bins, or times that are not finite or not increasing.

    The known attributes and coordinates of the dataset are checked, too.
    """
    check_attributes(place, dataset.attrs)
    dims = tuple(str(dim) for dim in dataset[name].dims)
    if "time" not in dims or "time" not in dataset.coords:
        raise UserError(f"{place} has no coordinate time: its {name} has the dimensions {', '.join(dims)}.")
    if empty := [dim for dim in dims if dataset.sizes[dim] == 0]:
        raise UserError(f"{place} is empty: its dimension {empty[0]} has the length 0, but must have at least 1.")
    times = dataset["time"].values
    if times.dtype.kind not in "fiu":
        raise UserError(f"{place} has the coordinate time of type {times.dtype}: it must hold numbers, in ns.")
    if not np.isfinite(times).all():
        raise UserError(f"{place} has the coordinate time = {times[~np.isfinite(times)][0]}: it must be finite.")
    for index in np.flatnonzero(np.diff(times) <= 0)[:1]:
        raise UserError(
            f"{place} has the coordinate time = {times[index]:g}, {times[index + 1]:g} ns: it must increase strictly."
        )
    check_coordinates(place, dataset, name)


def _write_exr(dataset: xr.Dataset, path: Path, temporary: Path) -> None:
    if "shot" in dataset.dims:
        raise UserError(f"cannot write {path}: an EXR file holds a single shot; use a .nc file.")
    # The attributes have the curve of the errors of sums in its place.
    dataset = dataset.drop_dims(sum_errors.DIMS, errors="ignore")
    if extra := [str(name) for name in dataset.data_vars if name not in _VARIABLES]:
        raise UserError(f"cannot write {path}: an EXR file cannot store the variable {extra[0]}; use a .nc file.")
    stacks: dict[str, dict[str, npt.NDArray[Any]]] = {}
    for name, (stack, component) in _CHANNELS.items():
        values = dataset[name].values
        # Pixels without a grid form an image one row high.
        image = values if values.ndim == 3 else values[np.newaxis]
        stacks.setdefault(stack, {})[component] = image
    exact, readable = describe(dataset, tuple(_VARIABLES))
    readable |= {"timeStartNs": dataset.attrs["time_start_ns"], "binWidthNs": dataset.attrs["bin_width_ns"]}
    exr.write(temporary, stacks, exact, readable)


def _read_exr(path: Path) -> xr.Dataset:
    stacks, exact = exr.read(path)
    try:
        return labelled({name: stacks[stack][part] for name, (stack, part) in _CHANNELS.items()}, exact)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: its metadata and its image disagree.") from error


def _warn_of_non_finite(values: Mapping[str, npt.NDArray[np.float64]], names: Sequence[str]) -> None:
    for variable, array in values.items():
        counts = np.count_nonzero(~np.isfinite(array), axis=1)
        if affected := np.flatnonzero(counts).tolist():
            pixels = ", ".join(f"{names[index]}: {counts[index]}" for index in affected[:_NAMED_PIXELS])
            more = f" and {len(affected) - _NAMED_PIXELS} more pixels" if len(affected) > _NAMED_PIXELS else ""
            _LOG.warning("%s has non-finite values in pixel %s%s", variable, pixels, more)
