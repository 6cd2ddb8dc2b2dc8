"""Labelled results, and their files.

A result is an `xarray.Dataset` with the variables ``impulse_response`` [J per bin] and ``waveform`` [W] and their
standard errors ``impulse_response_stderr`` and ``waveform_stderr``. Dimensions are (pixel, time), or (row, column,
time) for an imager. The coordinates are ``time`` [ns] at the bin centres, ``pixel`` (names), and the pixel centres in
tangent-plane angles, ``angle_x`` and ``angle_y`` [mrad]. The render parameters are attributes, among them the scene and
all its plugin parameters (`loading.scene_source`), from which it can be rendered again. A shot series has the dimension
``shot`` first, and each shot's truth as coordinates. Light separated by its origin is in variables whose names end in
``_by_origin``, over ``origin`` and the other dimensions. Derivatives by scene parameters are in ``waveform_derivative``
and ``impulse_response_derivative``, over ``parameter`` and these. The power in pass batches is in ``waveform_batch``,
over ``batch`` and the same dimensions.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import finite, positive
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results.attributes import check_attributes, check_coordinates, described, label, provenance, text
from mitransient_lidar.results.geometry import optional_number

_LOG = logging.getLogger(__name__)

LIGHT = ("impulse_response", "impulse_response_stderr", "waveform", "waveform_stderr")  #: Variables in a result.
_TIME_TOLERANCE = 1e-3  # of a bin, between the time coordinate and the attributes
_NAMED_PIXELS = 5  # largest number of pixels listed in a warning


def build(
    *arrays: npt.ArrayLike,
    time: TimeAxis,
    pixel_names: Sequence[str],
    pixel_centres_mrad: npt.ArrayLike,
    grid: tuple[int, int] | None = None,
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Label a render's arrays as a result.

    Non-finite values are kept; a warning lists their pixels. Raises `ValueError` if names repeat, a number is out of
    range or an attribute has an unsupported type.

    `arrays`, shape (pixel, time): received energy and its standard error [J per bin], and received power after the
    pulse and the receiver's response and its standard error [W]. `time`: the time bins. `pixel_names`: unique pixel
    names; unused with `grid`. `pixel_centres_mrad`, shape (pixel, 2): pixel centres' tangent-plane angles (angle_x,
    angle_y) [mrad]. `grid`: an imager's rows and columns, with pixels in row-major order. `attributes`: the render's
    parameters and outcome; they override the attributes set here (``title``, ``history``, ...).
    """
    bins = {"time_start_ns": finite("time_start_ns", time.start_ns)}
    bins["bin_width_ns"] = positive("bin_width_ns", time.bin_width_ns)
    coords = pixel_coordinates(pixel_names, pixel_centres_mrad, grid)
    dims, layout = coords["angle_x"][0], coords["angle_x"][1].shape
    coords["time"] = ("time", time.centres_ns)
    data = {}
    for name, array in zip(LIGHT, arrays, strict=True):
        values = np.array(array, dtype=np.float64)
        counts = np.count_nonzero(~np.isfinite(values), axis=1)
        if affected := np.flatnonzero(counts).tolist():
            names = coords["pixel"][1] if grid is None else list(np.ndindex(grid))
            pixels = ", ".join(f"{names[index]}: {counts[index]}" for index in affected[:_NAMED_PIXELS])
            more = f" and {len(affected) - _NAMED_PIXELS} more pixels" if len(affected) > _NAMED_PIXELS else ""
            _LOG.warning("%s has non-finite values in pixel %s%s", name, pixels, more)
        data[name] = ((*dims, "time"), values.reshape(*layout, -1))
    return label(xr.Dataset(data, coords, provenance({**bins, **attributes})))


def build_series(*arrays: npt.ArrayLike, **described: Any) -> xr.Dataset:
    """Label a shot series' arrays, shape (shot, pixel, time), as a result; see `build`."""
    values = [np.asarray(array, dtype=np.float64) for array in arrays]
    # The mean includes values that are not finite in any shot.
    labelled = build(*(array.mean(axis=0) for array in values), **described)
    data = {
        name: (("shot", *labelled[name].dims), array.reshape(-1, *labelled[name].shape), labelled[name].attrs)
        for name, array in zip(LIGHT, values, strict=True)
    }
    return label(labelled.assign(data).assign_coords(shot=np.arange(len(values[0]))))


def add_components(dataset: xr.Dataset, origins: Sequence[str], *arrays: npt.ArrayLike) -> xr.Dataset:
    """Return a result from `build` or `build_series` with its light by origin.

    Arrays are the four in `build`, shape (pixel, origin, time), in a series with the shots first; origins' names are
    unique.
    """
    values = [np.moveaxis(np.asarray(array, dtype=np.float64), -2, 0) for array in arrays]
    added = _add(dataset, "by_origin", "{}, by origin", {"origin": np.array(origins, dtype=str)}, values)
    return label(added)


def add_derivatives(
    dataset: xr.Dataset,
    names: Sequence[str],
    values: Sequence[float],
    units: Sequence[str],
    methods: Sequence[str],
    *arrays: npt.ArrayLike,
) -> xr.Dataset:
    """Return a result from `build` or `build_series` with its derivatives by parameters.

    `dataset`: the result. `names`, `values`, `units`, `methods`: for each parameter: unique name, value at which the
    light was rendered, unit, and ``score`` or ``central differences``. `arrays`: the four arrays in `build`,
    differentiated by the parameter in its unit, shape (parameter, pixel, time). In a series, the shots follow the
    parameters.
    """
    coords = {
        "parameter": np.array(names, dtype=str),
        "parameter_value": np.array(values, dtype=np.float64),
        "parameter_units": np.array(units, dtype=str),
        "parameter_method": np.array(methods, dtype=str),
    }
    return label(_add(dataset, "derivative", "derivative of the {}", coords, arrays, " per unit of the parameter"))


def add_batches(dataset: xr.Dataset, passes: Sequence[int], waveforms: npt.ArrayLike) -> xr.Dataset:
    """Return a result from `build` with each pass batch's mean power, ``waveform_batch`` [W].

    `waveforms` have the shape (batch, pixel, time), and `passes` are the numbers of passes per batch.
    """
    waveform = dataset["waveform"]
    values = np.asarray(waveforms, dtype=np.float64).reshape(len(passes), *waveform.shape)
    with_batches = dataset.assign(waveform_batch=(("batch", *waveform.dims), values))
    return label(with_batches.assign_coords(batch_passes=("batch", np.array(passes))))


def _add(
    dataset: xr.Dataset,
    ending: str,
    meaning: str,
    coords: Mapping[str, npt.NDArray[Any]],
    arrays: Sequence[npt.ArrayLike],
    per_unit: str = "",
) -> xr.Dataset:
    """Return a result with other values for its four variables, under names with an ending before ``_stderr``.

    The first coordinate's dimension is added before the variables' own; `meaning` has their long names.
    """
    dim, (dims, shape) = next(iter(coords)), (dataset["waveform"].dims, dataset["waveform"].shape)
    data = {}
    for name, array in zip(LIGHT, arrays, strict=True):
        stem = name.removesuffix("_stderr")
        about = described(stem)
        own = {"units": about["units"] + per_unit, "long_name": meaning.format(about["long_name"])}
        if stem == name:
            own["ancillary_variables"] = f"{stem}_{ending}_stderr"
        else:
            own["long_name"] = f"standard error of the {own['long_name']}"
        values = np.asarray(array, dtype=np.float64).reshape(len(coords[dim]), *shape)
        data[f"{stem}_{ending}{name[len(stem) :]}"] = ((dim, *dims), values, own)
    return dataset.assign(data).assign_coords({name: (dim, values) for name, values in coords.items()})


def record_dims(dataset: xr.Dataset, name: str, *, shots: bool = False) -> tuple[str, ...]:
    """Return a variable's dimensions, (pixel, time) or (row, column, time), with `shots` also after ``shot``.

    Raises `UserError` if the variable or a coordinate is missing, the dimensions are others or empty, or the times are
    invalid.
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
    """Return a dataset's time bins.

    They come from the attributes ``time_start_ns`` and ``bin_width_ns`` where the coordinate ``time`` agrees with them,
    else from the coordinate, as after a selection of bins. Raises `UserError` if the dataset has no coordinate
    ``time``, or a single bin with unknown width.
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
    """Return pixel coordinates: their names, or rows and columns, and their centres angle_x and angle_y.

    Arguments as for `build`. Raises `ValueError` if names repeat, or their number differs from the centres' number.
    """
    centres = np.asarray(pixel_centres_mrad, dtype=np.float64)
    count = len(centres)
    coords: dict[str, Any]
    if grid is None:
        names = [text(name) for name in pixel_names]
        if len(names) != count or len(set(names)) != len(names):
            raise ValueError(f"pixel_names = {names} must be {count} different names, one a pixel.")
        coords = {"pixel": ("pixel", np.array(names, dtype=str), described("pixel"))}
    else:
        coords = {
            dim: (dim, np.arange(size), described(dim)) for dim, size in zip(("row", "column"), grid, strict=True)
        }
    dims, layout = tuple(coords), grid or (count,)
    for axis, name in enumerate(("angle_x", "angle_y")):
        coords[name] = (dims, centres[:, axis].reshape(layout), described(name))
    return coords


def check_axes(place: object, dataset: xr.Dataset, name: str) -> None:
    """Raise `UserError` if a variable has no times, pixels or bins, or times that are not finite or not increasing.

    The dataset's known attributes and coordinates are checked, too.
    """
    check_attributes(place, dataset.attrs)
    dims = tuple(str(dim) for dim in dataset[name].dims)
    if "time" not in dims or "time" not in dataset.coords:
        raise UserError(f"{place} has no coordinate time: its {name} has the dimensions {', '.join(dims)}")
    if empty := [dim for dim in dims if dataset.sizes[dim] == 0]:
        raise UserError(f"{place} is empty: its dimension {empty[0]} has the length 0, but must have at least 1")
    times = dataset["time"].values
    if times.dtype.kind not in "fiu":
        raise UserError(f"{place} has the coordinate time of type {times.dtype}: it must hold numbers, in ns")
    if not np.isfinite(times).all():
        raise UserError(f"{place} has the coordinate time = {times[~np.isfinite(times)][0]}: it must be finite")
    for index in np.flatnonzero(np.diff(times) <= 0)[:1]:
        raise UserError(
            f"{place} has the coordinate time = {times[index]:g}, {times[index + 1]:g} ns: it must increase strictly"
        )
    check_coordinates(place, dataset, name)
