"""Recorded shots of a result: its waveforms after a receiver chain."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, in_range
from mitransient_lidar.physics.receiver.presets import RECEIVERS, ReceiverChain

_LOG = logging.getLogger(__name__)

_DENSEST = 12.0  # largest optical density
_LISTED_PIXELS = 12  # most pixels whose saturation is listed


def detect_waveforms(
    dataset: xr.Dataset,
    chain: ReceiverChain | str,
    shots: int = 1,
    seed: int = 0,
    background_power: npt.ArrayLike | xr.DataArray = 0.0,
    *,
    gain: float | Literal["auto"] = 1.0,
    optical_density: float | Literal["auto"] = 0.0,
) -> xr.Dataset:
    """Record shots of a result, or of each shot of a series, with a receiver chain.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result with ``waveform`` [W] over (pixel, time) or (row, column, time), optionally after ``shot``.
    chain : ReceiverChain or str
        The receiver chain, or its name in `physics.receiver.presets.RECEIVERS`.
    shots, seed : int
        Number of records of each waveform with independent noise, at least 1, and seed of the noise, at least 0.
    background_power : array-like or xarray.DataArray
        Steady power in addition to the waveform [W], not negative: a number, or one per pixel; see
        `physics.lidar.clear_sky.background_power`.
    gain : float or 'auto'
        Factor of the amplifier's transimpedance, above 0; 'auto' for the largest up to 1 without saturation.
    optical_density : float or 'auto'
        Optical density of a filter before the detector, 0 to 12, which also attenuates the background; 'auto' for the
        least multiple of 0.1 without saturation.

    Returns
    -------
    xarray.Dataset
        ``signal`` and ``saturated`` over (shot, pixel, time) or (shot, row, column, time), for a series all records of
        its first shot first; over the same dimensions, without shot unless it is a series, the closed forms
        ``signal_mean``, ``signal_deviation`` (standard deviation of a shot), ``snr`` and ``saturation`` (probability).
        The signal is in V, after a counter in counts per bin, without an amplifier in electrons per bin. Per pixel,
        ``saturated_shots`` is the share of shots with saturated samples, ``saturated_samples`` that of the samples
        [1]. ``time`` [ns], ``time_start_ns`` and ``bin_width_ns`` are those of the samples; other coordinates and
        attributes are those of the result, with the parameters of the chain as ``receiver.*``, ``gain`` and
        ``optical_density`` as used (``chosen`` names the one that was 'auto'), and ``fitting_gain`` and
        ``fitting_optical_density``, each of which avoids saturation while the other one is kept
        (`ReceiverChain.fitting_gain`).

    Raises
    ------
    UserError
        If the dataset has other dimensions, its waveform is not finite or negative, the receiver is unknown or has no
        amplifier for a gain, both are 'auto', noise alone exceeds the range, or another argument is out of range.

    Notes
    -----
    If the result includes a response (``response_time_ns``), the bandwidth of an amplifier smooths it again, and the
    shot noise lacks the correlation of that response: render with a response time of 0 for a chain with a bandwidth.
    Dead times of counters and cells lose light without being marked as saturated.
    """
    given = receiver_chain("chain", chain)
    dims, light = _waveform(dataset)
    pixels, series = tuple(dim for dim in dims[:-1] if dim != "shot"), dims[0] == "shot"
    width = results.time_axis(dataset).bin_width_ns
    sky = _background(dataset, background_power, pixels)
    smoothed = given.amplifier is not None and given.amplifier.bandwidth_mhz is not None
    if smoothed and float(dataset.attrs.get("response_time_ns", 0)) > 0:
        _LOG.warning("the waveform includes a response time already, and the amplifier's bandwidth smooths it again")
    receiver, density, fitting = _in_range(given, gain, optical_density, light, width, sky)
    power, background = 10**-density * light, np.broadcast_to(10**-density * sky, light.shape[:-1])
    signal, saturated = receiver.apply(power, width, shots, seed, background)
    number = len(signal)
    expected = receiver.expected(power, width, background)
    snr = receiver.snr(power, width, background)
    stride = receiver.stride(width)
    time = dataset["time"][::stride]
    forms = [expected.mean, np.sqrt(expected.variance), snr, expected.saturation]
    coords = {name: coordinate for name, coordinate in dataset.coords.items() if "time" not in coordinate.dims}
    if series:
        # The records of a shot follow each other, and its closed forms and coordinates are repeated.
        merged = (number * len(light), *signal.shape[2:])
        signal, saturated = np.moveaxis(signal, 0, 1).reshape(merged), np.moveaxis(saturated, 0, 1).reshape(merged)
        forms = [np.repeat(one, number, axis=0) for one in forms]
        numbers = np.repeat(np.arange(len(light)), number)
        coords = {name: one.isel(shot=numbers, missing_dims="ignore") for name, one in coords.items() if name != "shot"}
    over, sampled, share = ("shot", *pixels, "time"), {"units": receiver.units}, {"units": "1"}
    values: dict[str, Any] = {
        "signal": (over, signal, {**sampled, "long_name": "recorded signal"}),
        "saturated": (over, saturated, {"long_name": "sample at a limit of amplifier or digitiser"}),
        "signal_mean": (dims, forms[0], {**sampled, "long_name": "mean of the recorded signal"}),
        "signal_deviation": (
            dims,
            forms[1],
            {**sampled, "long_name": "standard deviation of the recorded signal of a shot"},
        ),
        "snr": (dims, forms[2], {**share, "long_name": "signal-to-noise ratio of a shot"}),
        "saturation": (dims, forms[3], {**share, "long_name": "probability that a sample is saturated"}),
        "saturated_shots": (
            pixels,
            saturated.any(axis=-1).mean(axis=0),
            {**share, "long_name": "share of shots with saturated samples"},
        ),
        "saturated_samples": (
            pixels,
            saturated.mean(axis=(0, -1)),
            {**share, "long_name": "share of saturated samples"},
        ),
    }
    labels = dataset["shot"].values if series and number == 1 else np.arange(len(signal))
    attributes = {
        **dataset.attrs,
        "time_start_ns": float(time[0]) - 0.5 * width * stride,
        "bin_width_ns": width * stride,
        "shots": len(signal),
        "noise_seed": int(seed),
        "background_power_w": np.ravel(sky).tolist() if np.ndim(sky) else float(sky),
        **({"receiver": chain} if isinstance(chain, str) else {}),
        **dict(_described("receiver", receiver)),
        **fitting,
    }
    shot = ("shot", labels, {"long_name": "number of the shot"})
    recorded = xr.Dataset(values, {**coords, "time": time, "shot": shot}, attributes)
    if saturated.any():
        _LOG.warning("%s", saturation_advice(recorded))
    return recorded


def saturation_advice(recorded: xr.Dataset) -> str:
    """Return a sentence on the saturation in a record of `detect_waveforms`, and on what would avoid it."""
    saturated = recorded["saturated"]
    share = float(saturated.any([dim for dim in saturated.dims if dim != "shot"]).mean())
    if share == 0:
        return "no sample is saturated"
    text = f"{_percent(share)} of the shots have saturated samples"
    if "fitting_optical_density" in recorded.attrs:
        density = recorded.attrs["fitting_optical_density"]
        text += f": a filter of optical density {density:.1f} (factor {10**density:.3g})"
        gain = recorded.attrs["fitting_gain"]
        text += f" or a gain of {gain:.3g} would fit" if gain > 0 else " would fit"
    return text


def describe_recording(recorded: xr.Dataset) -> list[str]:
    """Return lines on a record of `detect_waveforms`: gain and filter as used, and saturation in total and by pixel."""
    attributes = recorded.attrs
    used = ", ".join(
        f"{name.replace('_', ' ')} {attributes[name]:.4g}{' (auto)' if attributes['chosen'] == name else ''}"
        for name in ("gain", "optical_density")
    )
    lines = [
        f"{recorded.sizes['shot']} shots, receiver {attributes.get('receiver', 'custom')}, {used}",
        saturation_advice(recorded),
    ]
    shots, samples = recorded["saturated_shots"], recorded["saturated_samples"]
    if not shots.any():
        return lines
    if shots.dims != ("pixel",) or shots.size > _LISTED_PIXELS:
        most = f"{_percent(float(shots.max()))} of its shots, {_percent(float(samples.max()))} of its samples"
        return [*lines, f"most saturated pixel: {most}"]
    for name, of_shots, of_samples in zip(recorded["pixel"].values, shots.values, samples.values, strict=True):
        lines.append(f"saturated in {name}: {_percent(of_shots)} of the shots, {_percent(of_samples)} of the samples")
    return lines


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _in_range(
    chain: ReceiverChain, gain: float | str, density: float | str, light: FloatArray, width: float, sky: FloatArray
) -> tuple[ReceiverChain, float, dict[str, float | str]]:
    """Return the chain with its gain, the optical density of the filter, and attributes with those that fit."""
    if gain == density == "auto":
        raise UserError("gain = 'auto' and optical_density = 'auto' are alternatives: give one of them")
    if chain.amplifier is None and "auto" in (gain, density):
        name = "gain" if gain == "auto" else "optical_density"
        raise UserError(f"{name} = 'auto' needs a receiver with an amplifier: without one, nothing saturates")
    background = np.broadcast_to(sky, light.shape[:-1])
    wanted = 0.0 if density == "auto" else in_range("optical_density", density, 0, _DENSEST)
    used = chain if gain in ("auto", 1) else chain.with_gain(finite("gain", gain))
    attenuation = used.fitting_attenuation(light, width, background)
    if math.isinf(attenuation) and density == "auto":
        raise UserError("optical_density = 'auto' finds no filter: the noise alone exceeds the receiver's range")
    # The margin keeps a density of 0.3 that rounding has raised.
    fitting = math.ceil(10 * math.log10(attenuation) - 1e-6) / 10 if math.isfinite(attenuation) else math.inf
    chosen = fitting if density == "auto" else wanted
    largest = chain.fitting_gain(10**-chosen * light, width, 10**-chosen * background)
    if gain == "auto" and largest == 0:
        raise UserError("gain = 'auto' finds no gain of the photomultiplier: use optical_density = 'auto'")
    factor = largest if gain == "auto" else float(gain)
    automatic = "gain" if gain == "auto" else "optical_density" if density == "auto" else ""
    attributes: dict[str, float | str] = {
        "gain": factor,
        "optical_density": chosen,
        "chosen": automatic,
        "fitting_gain": largest,
    }
    if math.isfinite(fitting):
        attributes["fitting_optical_density"] = fitting
    return (chain.with_gain(factor) if gain == "auto" and factor < 1 else used), chosen, attributes


def receiver_chain(name: str, chain: ReceiverChain | str) -> ReceiverChain:
    """Return a receiver chain, which may be given by its name in `RECEIVERS`, as the parameter `name`."""
    if isinstance(chain, ReceiverChain):
        return chain
    if chain not in RECEIVERS:
        raise UserError(f"{name} = {chain!r} must be a ReceiverChain or one of {', '.join(RECEIVERS)}")
    return RECEIVERS[chain]


def _waveform(dataset: xr.Dataset) -> tuple[tuple[str, ...], FloatArray]:
    """Return dimensions and values of the waveform."""
    dims = results.record_dims(dataset, "waveform", shots=True)
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
        of_pixels = dataset["waveform"].isel(time=0).isel(shot=0, missing_dims="ignore")
        power = power.broadcast_like(of_pixels).transpose(*dims) if power.ndim else power
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


def _described(name: str, part: Any) -> Mapping[str, int | float | str | list[float]]:
    """Return the parameters of a stage and of its nested stages as attributes; None and () are left out."""
    found: dict[str, int | float | str | list[float]] = {}
    if is_dataclass(part):
        if name != "receiver":
            found[name] = type(part).__name__
        for field in fields(part):
            found |= _described(f"{name}.{field.name}", getattr(part, field.name))
    elif isinstance(part, bool):
        found[name] = int(part)
    elif isinstance(part, tuple):
        found |= {name: list(part)} if part else {}
    elif part is not None:
        found[name] = part
    return found
