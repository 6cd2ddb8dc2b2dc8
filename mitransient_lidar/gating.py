"""Gate stacks: what a gated receiver would have recorded, cut from a result that kept its histogram.

A gate stack is an `xarray.Dataset` with ``gate_energy`` and ``gate_energy_stderr`` [J], the energy that a pixel
collects while a gate is open, of all the pulses that the gate adds up. Dimensions are (row, column, gate) for imagers
and (pixel, gate) otherwise. Coordinates are those of the pixels, ``gate`` (0, 1, ...), ``gate_start`` and
``gate_width`` [ns] between half heights, and ``gate_depth`` [m], the depth of the gate's middle, NaN where the surface
echo's time is unknown. The attributes are those of the result and the gates' own.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar._version import __version__
from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.checks import FloatArray
from mitransient_lidar.optics.gates import GateShape, GateTrain, depth_of_time, time_of_depth
from mitransient_lidar.optics.refraction import snell

_LOG = logging.getLogger(__name__)

_DEPTH_ATTRIBUTES = ("surface_time_ns", "refractive_index", "group_index", "off_nadir_deg")

_GROWTH = ("error_growth_bins", "error_growth")

#: Part of a bin by which rounded times may exceed the record.
_ROUNDING = 1e-6


def train_from_options(
    attributes: Mapping[str, Any],
    *,
    start_ns: float | None = None,
    start_depth_m: float | None = None,
    width_ns: float | None = None,
    step_ns: float | None = None,
    count: int = 1,
    rise_ns: float = 0.0,
    fall_ns: float = 0.0,
    profile_file: str | PathLike[str] | None = None,
    pulses: int = 1,
) -> GateTrain:
    """Build a gate train from what a user gives.

    Parameters
    ----------
    attributes : mapping
        Attributes of a result; a start in depth needs their geometry.
    start_ns, start_depth_m : float, optional
        Half height of the first gate's rising edge, as a time [ns] or as a depth [m]; one of them.
    width_ns : float, optional
        Time between the half heights of a gate [ns], greater than 0; not with `profile_file`.
    step_ns : float, optional
        Time from gate to gate [ns], greater than 0; by default the width.
    count : int
        Number of gates, 1 to 100 000.
    rise_ns, fall_ns : float
        10-90 % times of the edges [ns], at least 0; not with `profile_file`.
    profile_file : path, optional
        Measured gate: two columns, time [ns] and transmission 0 to 1.
    pulses : int
        Pulses that a gate adds up, 1 to 10^9.

    Returns
    -------
    GateTrain

    Raises
    ------
    UserError
        If an option is missing, out of range, or does not go with another.
    """
    if profile_file is not None and (rise_ns or fall_ns):
        raise UserError(
            f"rise_ns = {rise_ns:g} and fall_ns = {fall_ns:g} must be 0 with a profile, which has its edges"
        )
    try:
        if start_ns is not None and start_depth_m is None:
            start = start_ns
        elif start_depth_m is not None and start_ns is None:
            start = float(time_of_depth(start_depth_m, *_axis(attributes)))
        else:
            raise UserError("a gate train needs one start: either start_ns or start_depth_m")
        if profile_file is not None and width_ns is None:
            profile = GateShape.from_file(profile_file)
            return GateTrain.measured(profile, start, profile.width_ns if step_ns is None else step_ns, count, pulses)
        if width_ns is not None and profile_file is None:
            return GateTrain(start, width_ns, width_ns if step_ns is None else step_ns, count, rise_ns, fall_ns, pulses)
        raise UserError("a gate train needs one shape: either width_ns or a profile file")
    except OSError as error:
        raise UserError(f"cannot read {profile_file}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(str(error)) from error


def gate_depths(train: GateTrain, attributes: Mapping[str, Any]) -> FloatArray:
    """Return the depths [m] of the gates' middles, NaN without the attributes that tell the depth axis."""
    try:
        return depth_of_time(train.middles_ns, *_axis(attributes))
    except UserError:
        return np.full(train.count, np.nan)


def build_gates(
    energy: npt.ArrayLike,
    stderr: npt.ArrayLike,
    train: GateTrain,
    *,
    coords: Mapping[Any, Any],
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Label the energies in gates.

    Parameters
    ----------
    energy, stderr : array-like of shape (row, column, gate) or (pixel, gate)
        Energy that each gate collects of all its pulses, and its standard error [J]. The pixels of an imager may come
        row by row in one axis.
    train : GateTrain
        The gates.
    coords : mapping
        Coordinates of the pixels as in a result: ``row``, ``column`` or ``pixel``, and ``gx``, ``gy``. A ``time`` is
        left out.
    attributes : mapping of str to int, float, str or a list of those
        Attributes of the result.

    Returns
    -------
    xarray.Dataset
        As described at the head of this module.

    Raises
    ------
    ValueError
        If the energies have another shape.
    """
    pixels = xr.Dataset(coords={name: value for name, value in coords.items() if name != "time"})
    dims = ("row", "column") if "row" in pixels.sizes else ("pixel",)
    shape = tuple(pixels.sizes[dim] for dim in dims)
    values = {"gate_energy": np.asarray(energy, np.float64), "gate_energy_stderr": np.asarray(stderr, np.float64)}
    for name, array in values.items():
        if array.shape not in ((*shape, train.count), (math.prod(shape), train.count)):
            raise ValueError(f"{name} has shape {array.shape}; it must be {(*shape, train.count)}.")
    described = {
        "gate_energy": {
            "units": "J",
            "long_name": "energy collected while the gate is open",
            "ancillary_variables": "gate_energy_stderr",
        },
        "gate_energy_stderr": {"units": "J", "long_name": "standard error of the energy collected in the gate"},
    }
    axis = {
        "gate": (np.arange(train.count), {"long_name": "number of the gate"}),
        "gate_start": (train.starts_ns, {"units": "ns", "long_name": "half height of the gate's rising edge"}),
        "gate_width": (
            np.full(train.count, train.width_ns),
            {"units": "ns", "long_name": "time between the half heights of the gate"},
        ),
        "gate_depth": (
            gate_depths(train, attributes),
            {"units": "m", "long_name": "depth of the middle of the gate", "positive": "down"},
        ),
    }
    stack = pixels.assign(
        {name: ((*dims, "gate"), array.reshape(*shape, train.count), described[name]) for name, array in values.items()}
    ).assign_coords({name: ("gate", array, about) for name, (array, about) in axis.items()})
    history = str(attributes.get("history", ""))
    stack.attrs = {
        **attributes,
        "title": f"Energy in gates, scene {attributes['scene']}" if "scene" in attributes else "Energy in gates",
        "history": "\n".join(part for part in (history, f"gates by mitransient-lidar {__version__}") if part),
        "gate_step_ns": train.step_ns,
        "gate_rise_ns": train.rise_ns,
        "gate_fall_ns": train.fall_ns,
        "pulses": train.pulses,
    }
    if train.profile is not None:
        stack.attrs["gate_profile_ns"] = train.profile.times_ns.tolist()
        stack.attrs["gate_profile"] = train.profile.values.tolist()
    return stack


def cut_gates(dataset: xr.Dataset, train: GateTrain) -> xr.Dataset:
    """Cut gates from the waveforms of a result.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result that kept its histogram: ``waveform`` and ``waveform_stderr`` [W] over (row, column, time) or (pixel,
        time).
    train : GateTrain
        The gates; all must lie within the record.

    Returns
    -------
    xarray.Dataset
        The gate stack.

    Raises
    ------
    UserError
        If the dataset has no waveforms, the train ends before the surface echo, or a gate is not within the record.

    Notes
    -----
    The waveform is the mean power in each bin, so a gate's energy is the sum of power times bin width times the gate's
    exact mean over the bin. Bins of a pass share light, which the pulse spreads over several; their errors are
    correlated. The standard error is the quadrature sum times the factor by which the error of a sum of so many bins
    was seen to exceed it in the passes of the render (attributes ``error_growth_bins`` and ``error_growth``, linear in
    the logarithm of the number of bins; beyond the last it grows as the square root). A gate with weights w counts as
    (sum w)^2 / sum w^2 bins. Never is it more than the plain sum of the errors, which stands where the factor is
    unknown.
    """
    if missing := [name for name in ("waveform", "waveform_stderr") if name not in dataset]:
        raise UserError(
            f"the stack has no {missing[0]}: gates can be cut only from a result that kept its histogram, so render "
            "the scene again with other gates"
        )
    waveform = dataset["waveform"]
    if waveform.dims not in (("row", "column", "time"), ("pixel", "time")):
        raise UserError(
            f"waveform has the dimensions {tuple(map(str, waveform.dims))}; they must be (row, column, time) or "
            "(pixel, time)"
        )
    start, width = (_required(dataset.attrs, name) for name in ("time_start_ns", "bin_width_ns"))
    bins = waveform.sizes["time"]
    check_train(train, dataset.attrs, start, width, bins)
    growth = _growth(dataset.attrs)
    if growth is None:
        _LOG.info("the result does not tell how errors of bins add up: the errors of the gates are upper bounds")
    power, error = waveform.values, dataset["waveform_stderr"].transpose(*waveform.dims).values
    energy = np.zeros((*power.shape[:-1], train.count))
    stderr = np.zeros_like(energy)
    for gate in range(train.count):
        first, weights = train.gate_bins(gate, start, width, bins)
        # Only the bins that the gate touches: a NaN elsewhere is none of its business.
        touched = slice(first, first + weights.size)
        energy[..., gate] = power[..., touched] @ weights
        bound = error[..., touched] @ weights
        if growth is None:
            stderr[..., gate] = bound
        else:
            equivalent = float(weights.sum() ** 2 / np.sum(weights**2))
            quadrature = np.sqrt(error[..., touched] ** 2 @ weights**2)
            stderr[..., gate] = np.minimum(quadrature * _growth_at(growth, equivalent), bound)
    joules = train.pulses * width * 1e-9
    return build_gates(joules * energy, joules * stderr, train, coords=dataset.coords, attributes=dataset.attrs)


def check_train(train: GateTrain, attributes: Mapping[str, Any], start: float, width: float, bins: int) -> None:
    """Refuse a train that ends before the surface echo or is not whole within the record [ns]."""
    end = start + width * bins
    spans = train.spans_ns
    closes = spans[-1, 1]
    surface = _surface_start(attributes)
    if closes <= start or (surface is not None and closes <= surface):
        what = "the record starts" if surface is None or surface < start else "the surface echo comes"
        earliest = start if surface is None else max(start, surface)
        raise UserError(
            f"gate train before the surface: its last gate closes at {closes:.1f} ns, but {what} at {earliest:.1f} ns; "
            "start it later or take more gates"
        )
    slack = _ROUNDING * width
    outside = np.flatnonzero((spans[:, 0] < start - slack) | (spans[:, 1] > end + slack))
    if outside.size:
        gate = int(outside[0])
        raise UserError(
            f"gate {gate} is open from {spans[gate, 0]:.1f} to {spans[gate, 1]:.1f} ns, but every gate must lie within "
            f"the record, {start:.1f} to {end:.1f} ns"
        )


def _surface_start(attributes: Mapping[str, Any]) -> float | None:
    """Return the earliest time of a surface echo [ns]: pixels near nadir see theirs before the mean."""
    mean, first = (_number(attributes, name) for name in ("surface_time_ns", "window_start_ns"))
    return mean if mean is None or first is None else min(mean, first)


def _growth(attributes: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
    """Return numbers of bins and the growth of their sum's error over the quadrature sum, if the result has them."""
    bins, growth = (np.atleast_1d(np.asarray(attributes.get(name, []), np.float64)) for name in _GROWTH)
    if bins.size == 0 or bins.shape != growth.shape:
        return None
    return bins, growth


def _growth_at(growth: tuple[FloatArray, FloatArray], bins: float) -> float:
    """Return the growth of the error for a number of bins, not always whole."""
    known, values = growth
    beyond = math.sqrt(max(bins / known[-1], 1))
    return float(np.interp(math.log(bins), np.log(known), values)) * beyond


def _axis(attributes: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return the depth axis: time of the surface echo [ns], group index, and cosine of the axis in the water."""
    surface, index, group, angle = (_required(attributes, name) for name in _DEPTH_ATTRIBUTES)
    return surface, group, float(np.cos(snell(math.radians(angle), index)))


def _required(attributes: Mapping[str, Any], name: str) -> float:
    number = _number(attributes, name)
    if number is None:
        raise UserError(f"the result has no attribute {name}, which its gates and depths need")
    return number


def _number(attributes: Mapping[str, Any], name: str) -> float | None:
    value = attributes.get(name)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
