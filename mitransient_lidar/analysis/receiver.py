"""Recorded shots of a result: its waveforms after a receiver chain."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.presets import RECEIVERS, ReceiverChain

_LOG = logging.getLogger(__name__)


def detect_waveforms(
    dataset: xr.Dataset,
    chain: ReceiverChain | str,
    shots: int = 1,
    seed: int = 0,
    background_power: npt.ArrayLike | xr.DataArray = 0.0,
) -> xr.Dataset:
    """Record shots of a result with a receiver chain.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result with ``waveform`` [W] over (pixel, time) or (row, column, time).
    chain : ReceiverChain or str
        The receiver chain, or its name in `physics.receiver.presets.RECEIVERS`.
    shots, seed : int
        Number of shots of the waveform with independent noise, at least 1, and seed of the noise, at least 0.
    background_power : array-like or xarray.DataArray
        Steady power in addition to the waveform [W], not negative: a number, or one per pixel; see
        `physics.lidar.clear_sky.background_power`.

    Returns
    -------
    xarray.Dataset
        ``signal`` and ``saturated`` over (shot, pixel, time) or (shot, row, column, time); over the same dimensions
        without shot the closed forms ``signal_mean``, ``signal_deviation`` (standard deviation of a shot), ``snr``
        and ``saturation`` (probability). The signal is in V, after a counter in counts per bin, without an amplifier
        in electrons per bin. ``time`` [ns], ``time_start_ns`` and ``bin_width_ns`` are those of the samples; other
        coordinates and attributes are those of the result, with the parameters of the chain as ``receiver.*``.

    Raises
    ------
    UserError
        If the dataset has other dimensions, its waveform is not finite or negative, the receiver is unknown, or another
        argument is out of range.

    Notes
    -----
    If the result includes a response (``response_time_ns``), the bandwidth of an amplifier smooths it again, and the
    shot noise lacks the correlation of that response: render with a response time of 0 for a chain with a bandwidth.
    """
    receiver = receiver_chain("chain", chain)
    dims, power = _waveform(dataset)
    axis = results.time_axis(dataset)
    width = axis.bin_width_ns
    background = _background(dataset, background_power, dims[:-1])
    smoothed = receiver.amplifier is not None and receiver.amplifier.bandwidth_mhz is not None
    if smoothed and float(dataset.attrs.get("response_time_ns", 0)) > 0:
        _LOG.warning("the waveform includes a response time already, and the amplifier's bandwidth smooths it again")
    record = receiver.apply(power, width, shots, seed, background)
    expected = receiver.expected(power, width, background)
    snr = receiver.snr(power, width, background)
    stride = receiver.stride(width)
    time = dataset["time"][::stride]
    sampled = {"units": receiver.units}
    deviation = {**sampled, "long_name": "standard deviation of the recorded signal of a shot"}
    probability = {"units": "1", "long_name": "probability that a sample is saturated"}
    values: dict[str, Any] = {
        "signal": (("shot", *dims), record.signal, {**sampled, "long_name": "recorded signal"}),
        "saturated": (("shot", *dims), record.saturated, {"long_name": "sample at a limit of amplifier or digitiser"}),
        "signal_mean": (dims, expected.mean, {**sampled, "long_name": "mean of the recorded signal"}),
        "signal_deviation": (dims, np.sqrt(expected.variance), deviation),
        "snr": (dims, snr, {"units": "1", "long_name": "signal-to-noise ratio of a shot"}),
        "saturation": (dims, expected.saturation, probability),
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


def receiver_chain(name: str, chain: ReceiverChain | str) -> ReceiverChain:
    """Return a receiver chain, which may be given by its name in `RECEIVERS`, as the parameter `name`."""
    if isinstance(chain, ReceiverChain):
        return chain
    if chain not in RECEIVERS:
        raise UserError(f"{name} = {chain!r} must be a ReceiverChain or one of {', '.join(RECEIVERS)}")
    return RECEIVERS[chain]


def _waveform(dataset: xr.Dataset) -> tuple[tuple[str, ...], FloatArray]:
    """Return dimensions and values of the waveform."""
    dims = results.record_dims(dataset, "waveform")
    values = np.asarray(dataset["waveform"].values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise UserError(
            f"waveform has {np.count_nonzero(~np.isfinite(values))} values that are not finite; render again"
        )
    if np.any(values < 0):
        raise UserError(f"waveform holds {values.min():g} W; received power must not be negative")
    return dims, values


def _background(dataset: xr.Dataset, power: npt.ArrayLike | xr.DataArray, dims: tuple[str, ...]) -> FloatArray:
    """Return a number or one number per pixel."""
    if isinstance(power, xr.DataArray):
        if set(power.dims) - set(dims):
            raise UserError(f"background_power has the dimensions {power.dims}; they must be among {dims}")
        power = power.broadcast_like(dataset["waveform"].isel(time=0)).transpose(*dims) if power.ndim else power
    try:
        values = np.asarray(power, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"background_power = {power!r} must be a number, or one per pixel") from None
    pixels = tuple(dataset.sizes[name] for name in dims)
    if values.shape not in ((), pixels):
        raise UserError(
            f"background_power has the shape {values.shape}; it must be a number or have the shape {pixels}"
        )
    return values


def _described(name: str, part: Any) -> Mapping[str, int | float | str]:
    """Return the parameters of a stage and of its nested stages as attributes."""
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
