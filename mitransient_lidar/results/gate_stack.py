"""Gate stacks: each pixel's energy in each gate, as a labelled dataset.

A gate stack is an `xarray.Dataset` with ``gate_energy`` and ``gate_energy_stderr`` [J]. This is the energy that a pixel
collects while a gate is open, summed over the gate's pulses. Dimensions are (row, column, gate) for imagers and (pixel,
gate) otherwise. Coordinates are the pixels' own, ``gate`` (0, 1, ...), and ``gate_start`` and ``gate_width`` [ns]
between half heights. ``gate_depth`` is the depth [m] of the gate's middle on the receiver's axis, NaN where the surface
echo time is unknown. In the other pixels the middle has other depths; see `LinesOfSight`. The attributes come from the
result and the gate train.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from os import PathLike
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, checked, positive_option
from mitransient_lidar.core.validation import ArrayLike, FloatArray
from mitransient_lidar.physics.lidar.gate_train import GateShape, GateTrain, range_time_ns
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results import sum_errors
from mitransient_lidar.results.attributes import check_attributes, check_coordinates, label, made_from
from mitransient_lidar.results.geometry import lidar_geometry, optional_number, required_number

_OF_BINS = ("time", "origin", "batch", *sum_errors.DIMS)  #: Dimensions that only results with time bins have.

_ROUNDING = 1e-6  # fraction of a bin by which rounded times may exceed the record


@checked
def train_from_options(
    attributes: Mapping[str, Any],
    *,
    start_ns: Annotated[float | None, Option("Start time of the first gate at half height [ns]")] = None,
    start_depth_m: Annotated[
        float | None,
        Option("Depth below the mean sea level at which the first gate opens on the axis [m]", flag="--start-depth"),
    ] = None,
    start_range_m: Annotated[
        float | None, Option("Distance from the lidar along the axis [m], instead of a time", 0, flag="--start-range")
    ] = None,
    width_ns: Annotated[float | None, positive_option("Gate width between half heights", "ns")] = None,
    step_ns: Annotated[float | None, positive_option("Time from gate to gate, by default the width", "ns")] = None,
    count: Annotated[int, Option("Number of gates", 1, 100_000)] = 1,
    rise_ns: Annotated[
        float, Option("10-90 % time of the rising edge; both edges take at most 1.18 widths", 0, unit="ns")
    ] = 0.0,
    fall_ns: Annotated[float, Option("90-10 % time of the falling edge", 0, unit="ns")] = 0.0,
    profile_file: Annotated[
        str | PathLike[str] | None,
        Option("Measured gate instead of width and edges: columns time [ns], transmission", flag="--profile"),
    ] = None,
    jitter_ns: Annotated[float, Option("Standard deviation of the gates' opening", 0, unit="ns")] = 0.0,
    pulses: Annotated[int, Option("Pulses accumulated in a gate", 1, 10**9)] = 1,
) -> GateTrain:
    """Build a gate train from the command ``gates``'s options.

    Parameters
    ----------
    attributes : mapping
        A result's attributes, with the lidar geometry if the start is a depth.
    start_ns, start_depth_m, start_range_m : float, optional
        Half height of the first gate's rising edge: its time [ns], or the depth below the mean sea level or range from
        the lidar on the receiver's axis whose echo arrives then [m]; exactly one.

    Raises
    ------
    UserError
        If an option is missing, out of range, or incompatible with another.
    """
    if profile_file is not None and (rise_ns or fall_ns):
        raise UserError(
            f"rise_ns = {rise_ns:g} and fall_ns = {fall_ns:g} must be 0 with a profile, which includes its edges"
        )
    if sum(one is not None for one in (start_ns, start_depth_m, start_range_m)) != 1:
        raise UserError("a gate train needs one start: start_ns, start_depth_m or start_range_m")
    if (profile_file is None) == (width_ns is None):
        raise UserError("a gate train needs one shape: either width_ns or a profile file")
    start = start_ns
    if start_depth_m is not None:
        start = float(lidar_geometry(attributes, surface="level").time_of_depth(start_depth_m))
    elif start_range_m is not None and (optional_number(attributes, "altitude") or 0.0) < 0:  # under water
        start = range_time_ns(start_range_m, 0.0, required_number(attributes, "group_index"))
    elif start_range_m is not None:
        geometry = lidar_geometry(attributes, surface="level")
        start = range_time_ns(start_range_m, geometry.slant_range, geometry.group_index)
    assert start is not None
    shape = GateShape.edges(width_ns, rise_ns, fall_ns) if width_ns else GateShape.from_file(str(profile_file))
    return GateTrain.measured(
        shape.jittered(jitter_ns), start, shape.width_ns if step_ns is None else step_ns, count, pulses
    )


def gate_depths(train: GateTrain, attributes: Mapping[str, Any]) -> FloatArray:
    """Return the depths [m] of the gates' middles below the mean sea level on the axis, NaN if one is unknown."""
    try:
        return lidar_geometry(attributes, surface="level").depth_of_time(train.middles_ns)
    except UserError:
        return np.full(train.count, np.nan)


def build_gates(
    energy: ArrayLike, stderr: ArrayLike, train: GateTrain, *, coords: Mapping[Any, Any], attributes: Mapping[str, Any]
) -> xr.Dataset:
    """Label the energies in gates, summed over their pulses, and their standard errors [J] as a gate stack.

    They have the shape (row, column, gate) or (pixel, gate). An imager's pixels may be in one axis, in row-major order.
    With the coordinate ``frame`` that dimension is first. Coordinates and attributes are a result's; the coordinate
    ``time`` is ignored. Raises `UserError` if the energies have another shape.
    """
    pixels = xr.Dataset(coords={name: value for name, value in coords.items() if name != "time"})
    dims = ("row", "column") if "row" in pixels.sizes else ("pixel",)
    frames = ("frame",) if "frame" in pixels.sizes else ()
    first, shape = (tuple(pixels.sizes[dim] for dim in each) for each in (frames, dims))
    variables = {}
    for name, values in (("gate_energy", energy), ("gate_energy_stderr", stderr)):
        array = np.asarray(values, np.float64)
        whole = (*first, *shape, train.count)
        if array.shape not in (whole, (*first, math.prod(shape), train.count)):
            raise UserError(f"{name} has shape {array.shape}; it must be {whole}")
        variables[name] = ((*frames, *dims, "gate"), array.reshape(whole))
    axis = {
        "gate": np.arange(train.count),
        "gate_start": train.starts_ns,
        "gate_width": np.full(train.count, train.width_ns),
        "gate_depth": gate_depths(train, attributes),
    }
    stack = label(pixels.assign(variables).assign_coords({name: ("gate", values) for name, values in axis.items()}))
    stack.attrs = {
        **attributes,
        **made_from(attributes, "Energy in gates", "cut into gates"),
        "gate_step_ns": train.step_ns,
        "gate_rise_ns": train.rise_ns,
        "gate_fall_ns": train.fall_ns,
        "pulses": train.pulses,
        **({"gate_jitter_ns": train.shape.jitter_ns} if train.shape.jitter_ns else {}),
    }
    if train.profile is not None:
        stack.attrs["gate_profile_ns"] = train.profile.times_ns.tolist()
        stack.attrs["gate_profile"] = train.profile.values.tolist()
    return stack


def add_gate_derivatives(stack: xr.Dataset, slopes: ArrayLike, stderr: ArrayLike) -> xr.Dataset:
    """Return a gate stack from `build_gates` with its energies' derivatives by parameters.

    The derivatives and their standard errors are in J per parameter unit, shape (parameter, pixel, gate).
    """
    energy = stack["gate_energy"]
    arrays = {
        f"gate_energy_derivative{end}": (("parameter", *energy.dims), np.reshape(values, (-1, *energy.shape)))
        for end, values in (("", slopes), ("_stderr", stderr))
    }
    return label(stack.assign(arrays))


def average_frames(stack: xr.Dataset) -> xr.Dataset:
    """Return the mean over a gate stack's frames, whose standard errors are independent; one without frames stays.

    The frames' coordinates, such as their times, are left out.
    """
    if "frame" not in stack.dims:
        return stack
    errors = [name for name in stack.data_vars if str(name).endswith("_stderr")]
    square = (stack[errors] ** 2).mean("frame", skipna=False, keep_attrs=True) / stack.sizes["frame"]
    mean = stack.drop_vars(errors).mean("frame", skipna=False, keep_attrs=True)
    root = square**0.5
    for name in errors:
        root[name].attrs = stack[name].attrs
    return mean.merge(root, combine_attrs="override").assign_attrs(stack.attrs)


def check_train(train: GateTrain, attributes: Mapping[str, Any], time: TimeAxis) -> None:
    """Raise `UserError` if a gate train ends before the surface echo or is not within the record."""
    spans = train.spans_ns
    closes = spans[-1, 1]
    surface, first_surface = (optional_number(attributes, name) for name in ("surface_time_ns", "window_start_ns"))
    if (optional_number(attributes, "altitude") or 0.0) < 0:
        surface = None  # the water comes first
    # Pixels near nadir receive the surface echo before the mean.
    if surface is not None and first_surface is not None:
        surface = min(surface, first_surface)
    if closes <= time.start_ns or (surface is not None and closes <= surface):
        what = "the record starts" if surface is None or surface < time.start_ns else "the surface echo arrives"
        earliest = time.start_ns if surface is None else max(time.start_ns, surface)
        raise UserError(
            f"gate train before the surface: its last gate closes at {closes:.1f} ns, but {what} at {earliest:.1f} ns; "
            "choose a later start or more gates"
        )
    slack = _ROUNDING * time.bin_width_ns
    outside = np.flatnonzero((spans[:, 0] < time.start_ns - slack) | (spans[:, 1] > time.end_ns + slack))
    if outside.size:
        gate = int(outside[0])
        raise UserError(
            f"gate {gate} is open from {spans[gate, 0]:.1f} to {spans[gate, 1]:.1f} ns, but every gate must lie within "
            f"the record, {time.start_ns:.1f} to {time.end_ns:.1f} ns"
        )


def check_stack(dataset: xr.Dataset, place: object = "the gate stack") -> xr.Dataset:
    """Return a dataset's gates, with their derivatives if it has any, without its time bins; ``gate`` is last.

    Several frames give their mean, `average_frames`. Raises `UserError` if it has no gates, or dimensions other than
    (row, column, gate) or (pixel, gate); `place` names it.
    """
    if missing := [name for name in ("gate_energy", "gate_energy_stderr") if name not in dataset]:
        raise UserError(f"the dataset is no gate stack: it has no variable {missing[0]}")
    dataset = average_frames(dataset)
    energy = dataset["gate_energy"]
    pixels = next((names for names in (("row", "column"), ("pixel",)) if {*names, "gate"} == set(energy.dims)), None)
    if pixels is None or energy.size == 0 or set(dataset["gate_energy_stderr"].dims) != set(energy.dims):
        raise UserError(
            f"the dataset is no gate stack: gate_energy has the shape {dict(energy.sizes)}, but must have the "
            "dimensions (row, column, gate) or (pixel, gate), like gate_energy_stderr, and must not be empty"
        )
    needed = {"gate_start": {"gate"}, "gate_width": {"gate"}, "angle_x": {*pixels}, "angle_y": {*pixels}}
    for name, dims in needed.items():
        if name not in dataset.coords or set(dataset[name].dims) != dims:
            raise UserError(f"the dataset is no gate stack: it has no coordinate {name} over ({', '.join(dims)})")
    check_attributes(place, dataset.attrs)
    check_coordinates(place, dataset, "gate_energy")
    stack = dataset.drop_dims(_OF_BINS, errors="ignore")
    if "gate_energy_derivative" not in stack:
        stack = stack.drop_dims("parameter", errors="ignore")
    return stack.transpose(..., *pixels, "gate")


def as_stack(dataset: xr.Dataset) -> xr.Dataset:
    """Return gates to draw and to analyse as a gate stack, with a name and unit for ``gate_energy`` in its attributes.

    Camera frames become their mean above the dark level [DN], with this mean's standard error. A stack with a sea for
    each frame becomes the mean over the frames. Raises `UserError` as for `check_stack`.
    """
    if not has_frames(dataset):
        stack = check_stack(dataset)
        stack["gate_energy"].attrs |= {"long_name": "energy in the gate", "units": "J"}
        return stack
    mean = dataset["signal"].mean("frame")
    deviation = np.sqrt((dataset["signal_deviation"] ** 2).mean("frame" if "frame" in dataset["snr"].dims else ()))
    coords = {name: one for name, one in dataset.coords.items() if name != "frame"}
    coords = {name: one.mean("frame") if "frame" in one.dims else one for name, one in coords.items()}
    energy: dict[str, Any] = {"gate_energy": mean - dataset["dark_level"]}
    energy["gate_energy_stderr"] = deviation / math.sqrt(dataset.sizes["frame"])
    stack = check_stack(xr.Dataset(coords=coords).assign(energy).assign_attrs(dataset.attrs))
    stack["gate_energy"].attrs |= {"long_name": "signal above the dark level", "units": "DN"}
    return stack


def has_frames(dataset: xr.Dataset) -> bool:
    """Return whether a dataset has camera frames: a signal over gates. A record in time may have gates beside."""
    return "signal" in dataset and "gate" in dataset["signal"].dims
