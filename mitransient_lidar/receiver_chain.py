"""Noisy, digitised shots of a rendered result: what a receiver chain makes of its waveforms."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.receivers import RECEIVERS, ReceiverChain

_LOG = logging.getLogger(__name__)
_DIMENSIONS = (("pixel", "time"), ("row", "column", "time"))


def detect_waveforms(
    dataset: xr.Dataset,
    chain: ReceiverChain | str,
    shots: int = 1,
    seed: int = 0,
    background_power: npt.ArrayLike | xr.DataArray = 0.0,
) -> xr.Dataset:
    """Record shots of a result with a receiver.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result with ``waveform`` [W] over (pixel, time) or (row, column, time).
    chain : ReceiverChain or str
        The receiver, or its name in `optics.receivers.RECEIVERS`.
    shots : int
        Number of independent shots, at least 1. All have the waveform of the result: the sea does not move.
    seed : int
        Seed of the noise, at least 0.
    background_power : array-like or xarray.DataArray
        Steady power on each pixel besides the waveform [W], not negative: a number, or one for each pixel, as
        `optics.daylight.background_power` has it of the sunlit sea.

    Returns
    -------
    xarray.Dataset
        ``signal`` and ``saturated`` over (shot, pixel, time) or (shot, row, column, time); over the same dimensions
        without shot the closed forms ``signal_mean``, ``signal_deviation`` (standard deviation of a shot), ``snr``
        and ``saturation`` (probability). The signal is in V, behind a counter in counts per bin, without an amplifier
        in electrons per bin. The coordinates are those of the result; ``time`` [ns] has the samples, and the
        attributes ``time_start_ns`` and ``bin_width_ns`` belong to them. The attributes of the result are kept, those
        that begin with ``receiver.`` tell of the chain.

    Raises
    ------
    UserError
        If the dataset is no such result, its waveform is not finite or negative, there is no such receiver, or another
        argument is out of range.

    Notes
    -----
    The noise of a shot is that of the waveform as it is: a result that holds the receiver's response
    (``response_time_ns``) already is smoothed once more by the bandwidth of an amplifier, and its shot noise lacks the
    correlation of that response. Render with a response time of 0 for a chain with a bandwidth.
    """
    receiver = _receiver(chain)
    dims, power = _waveform(dataset)
    width = _positive(dataset, "bin_width_ns")
    background = _background(dataset, background_power, dims[:-1])
    smoothed = receiver.amplifier is not None and receiver.amplifier.bandwidth_mhz is not None
    if smoothed and float(dataset.attrs.get("response_time_ns", 0)) > 0:
        _LOG.warning("the waveform holds a response time already, and the amplifier's bandwidth smooths it again")
    try:
        record = receiver.apply(power, width, shots, seed, background)
        lit = receiver.expected(power, width, background)
        snr = receiver.snr(power, width, background)
        stride = receiver.stride(width)
    except ValueError as error:
        raise UserError(str(error)) from error
    time = dataset["time"][::stride]
    sampled = {"units": receiver.units}
    values: dict[str, Any] = {
        "signal": (("shot", *dims), record.signal, {**sampled, "long_name": "recorded signal"}),
        "saturated": (("shot", *dims), record.saturated, {"long_name": "sample at a limit of amplifier or digitiser"}),
        "signal_mean": (dims, lit.mean, {**sampled, "long_name": "mean of the recorded signal"}),
        "signal_deviation": (
            dims,
            np.sqrt(lit.variance),
            {**sampled, "long_name": "standard deviation of the recorded signal of a shot"},
        ),
        "snr": (dims, snr, {"units": "1", "long_name": "signal-to-noise ratio of a shot"}),
        "saturation": (dims, lit.saturation, {"units": "1", "long_name": "probability that a sample is saturated"}),
    }
    coords = {name: coordinate for name, coordinate in dataset.coords.items() if "time" not in coordinate.dims}
    shot = ("shot", np.arange(len(record.signal)), {"long_name": "number of the shot"})
    attributes = {
        **dataset.attrs,
        "time_start_ns": float(time[0]) - 0.5 * width * stride,
        "bin_width_ns": width * stride,
        "shots": len(record.signal),
        "noise_seed": int(seed),
        "background_power_w": np.ravel(background).tolist() if np.ndim(background) else float(background),
        **({"receiver": chain} if isinstance(chain, str) else {}),
        **dict(_described("receiver", receiver)),
    }
    return xr.Dataset(values, {**coords, "time": time, "shot": shot}, attributes)


def _receiver(chain: ReceiverChain | str) -> ReceiverChain:
    if isinstance(chain, ReceiverChain):
        return chain
    if chain not in RECEIVERS:
        raise UserError(f"chain = {chain!r} must be a ReceiverChain or one of {', '.join(RECEIVERS)}")
    return RECEIVERS[chain]


def _waveform(dataset: xr.Dataset) -> tuple[tuple[str, ...], npt.NDArray[np.float64]]:
    """Return dimensions and values of the waveform."""
    if "waveform" not in dataset:
        raise UserError("the dataset has no variable waveform: it must be a result that kept its record in time")
    waveform = dataset["waveform"]
    dims = tuple(str(name) for name in waveform.dims)
    if dims not in _DIMENSIONS:
        raise UserError(f"waveform has the dimensions {dims}; they must be (pixel, time) or (row, column, time)")
    for name in dims:
        if name not in dataset.coords:
            raise UserError(f"the dataset has no coordinate {name}; a waveform over {dims} needs it")
    values = np.asarray(waveform.values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise UserError(
            f"waveform has {np.count_nonzero(~np.isfinite(values))} values that are not finite; render again"
        )
    if np.any(values < 0):
        raise UserError(f"waveform holds {values.min():g} W; received power must not be negative")
    return dims, values


def _positive(dataset: xr.Dataset, name: str) -> float:
    value = dataset.attrs.get(name)
    if not isinstance(value, (int, float)) or not 0 < value < np.inf:
        raise UserError(f"the attribute {name} = {value!r} of the dataset must be a number above 0")
    return float(value)


def _background(
    dataset: xr.Dataset, power: npt.ArrayLike | xr.DataArray, dims: tuple[str, ...]
) -> npt.NDArray[np.float64]:
    """Return a number or one number a pixel."""
    if isinstance(power, xr.DataArray):
        if set(power.dims) - set(dims):
            raise UserError(f"background_power has the dimensions {power.dims}; they must be among {dims}")
        if power.ndim:
            power = power.broadcast_like(dataset["waveform"].isel(time=0)).transpose(*dims).values
        else:
            power = power.values
    try:
        values = np.asarray(power, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"background_power = {power!r} must be a number, or one for each pixel") from None
    pixels = tuple(dataset.sizes[name] for name in dims)
    if values.shape not in ((), pixels):
        raise UserError(
            f"background_power has the shape {values.shape}; it must be a number or have the shape {pixels}"
        )
    return values


def _described(name: str, part: Any) -> Mapping[str, int | float | str]:
    """Return the parameters of a stage and of the stages within it as attributes."""
    found: dict[str, int | float | str] = {}
    if is_dataclass(part):
        if name != "receiver":
            found[name] = type(part).__name__
        for field in fields(part):
            found |= _described(f"{name}.{field.name}", getattr(part, field.name))
    elif isinstance(part, bool):
        found[name] = int(part)
    elif part is not None:
        found[name] = part
    return found
