"""Recorded shots from a result: its waveforms after a receiver chain, or its gates as camera frames."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, NamedTuple, TypeVar, Union

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.analysis.gates.recording import parameters_of, powers_of, record_gates
from mitransient_lidar.analysis.recorded import is_automatic, saturation_advice
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import RECEIVERS_OR_CAMERAS, Option, Seed, checked
from mitransient_lidar.core.validation import FloatArray, finite, in_range, integer, require_memory
from mitransient_lidar.physics.receiver.camera import Camera
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.receiver_files import (
    CAMERAS,
    Channel,
    ReceiverChannels,
    Setting,
    instrument_receiver,
    waveform_receiver,
)
from mitransient_lidar.physics.receiver.receiver_files import camera as camera_of
from mitransient_lidar.physics.receiver.receiver_files import receiver as receiver_named
from mitransient_lidar.results.attributes import join, label, made_from, split
from mitransient_lidar.results.geometry import optional_number
from mitransient_lidar.results.sum_errors import pooled_errors

#: A power, or pixel powers.
Powers = Union[npt.ArrayLike, "xr.DataArray"]

#: Forms in which a receiver is given.
Receiver = Camera | ReceiverChannels | ReceiverChain | str | os.PathLike[str]

_R = TypeVar("_R")

_LOG = logging.getLogger(__name__)

DENSEST = 12.0  # largest optical density
SATURATING = 0.05  #: Largest share of a series' shots that may saturate with an automatic gain or filter.

_GAIN = (
    "Factor of the amplifier's gain, or auto for the largest up to 1 without saturation, but of 5 % of a series' "
    "shots; by default the receiver's, or 1"
)
Gain = Annotated[Setting | None, Option(_GAIN, 0, above=True, form="NUMBER|auto")]
_DENSITY = (
    "Optical density of a filter before the detector, also for daylight, or auto for the least multiple of 0.1 without "
    "saturation, as for gain; by default the receiver's, or 0"
)
OpticalDensity = Annotated[Setting | None, Option(_DENSITY, 0, DENSEST, form="NUMBER|auto")]

_FAINT_W, _STEADY_BINS = 1e-9, 256  # light of which the sensitivity is measured [W], and its bins
_BYTES_PER_SAMPLE = 16  # memory of a sample: 8 while it is drawn, and 21 when its record is written


@checked
def detect_waveforms(
    dataset: results.Given,
    chain: Annotated[
        Receiver | None,
        Option(f"{RECEIVERS_OR_CAMERAS}. By default the result's instrument, or apd", flag="--receiver"),
    ] = None,
    shots: Annotated[int, Option("Records per waveform, or frames per gate, with independent noise", 1, 10**9)] = 1,
    seed: Seed = 0,
    background_power: Annotated[
        Powers, Option("Daylight power on each pixel [W] (at least 0)", flag="--background-power-w")
    ] = 0.0,
    *,
    gain: Gain = None,
    optical_density: OpticalDensity = None,
    advice: bool = True,
) -> xr.Dataset:
    """Record shots of a result, or of each shot in a series, with a receiver chain, or gates with a camera.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result with ``waveform`` [W] over (pixel, time) or (row, column, time), optionally after ``shot``; for a
        camera a gate stack, optionally over ``frame``.
    chain : Camera, ReceiverChannels, ReceiverChain, str or path-like, optional
        The receiver for every channel, or one chain for all; a name in `receiver_files.RECEIVERS` or of an instrument,
        a camera or its name in `receiver_files.CAMERAS`, or a TOML file
        (`physics.receiver.receiver_files.parse_receiver`). By default the receiver of the result's instrument, and the
        preset ``apd`` without one.
    background_power : array-like or xarray.DataArray
        Steady power in addition to the waveform [W], not negative: a number, or one per pixel; see
        `physics.lidar.clear_sky.background_power`.
    advice : bool
        Whether to find the gain and the optical density that fit, where they are not 'auto', and to log saturation.

    Returns
    -------
    xarray.Dataset
        ``signal`` and ``saturated`` over (shot, pixel, time) or (shot, row, column, time), for a series all records of
        its first shot first. The closed forms are over the same dimensions, without shot unless it is a series:
        ``signal_mean``, ``signal_deviation`` (standard deviation in a shot), ``snr`` and ``saturation`` (probability),
        and ``signal_mean_stderr``, the change in the mean by a render's ``waveform_stderr``. The signal is in V, after
        a counter in counts per bin, without an amplifier in electrons per bin. Per pixel, ``saturated_shots`` is the
        share of shots with saturated samples, ``saturated_samples`` the share of saturated samples [1]. ``time`` [ns],
        ``time_start_ns`` and ``bin_width_ns`` describe the samples; other coordinates and attributes come from the
        result. The chain's parameters are added as ``receiver.*``, with ``gain`` and ``optical_density`` as used;
        ``chosen`` names the one that was 'auto'. ``fitting_gain`` and ``fitting_optical_density`` each avoid saturation
        while the other one is kept (`ReceiverChain.fitting_gain`), but in ``saturating_share`` of a series' shots, at
        most `SATURATING`. Where channels differ, chain attributes are
        ``receiver.channels.NAME.*``, and the others lists over the pixels. ``event_height`` over the pixels comes from
        `ReceiverChain.event_height`. ``receiver_response`` over ``lag`` [ns] is the weight of a bin's light in later
        samples. If a converter stores blocks, samples outside them are NaN, and ``dark_level`` and ``block_level`` over
        the pixels are the level without light and the threshold level.

        A camera gives ``signal`` and ``saturated`` over (frame, row, column, gate) or (frame, pixel, gate), as integers
        [DN] with the fixed pattern of `Camera.pattern`. A stack over ``frame`` gives all of its first frame first. The
        closed forms are over the same dimensions, without frame unless the stack has it, and for each pixel with its
        pattern; ``snr`` is NaN where most frames saturate, ``signal_mean_stderr`` is by ``gate_energy_stderr``, and
        ``dark_level`` [DN] is the mean without light. A mean over ``frame`` averages. The coordinates come from the
        gate stack. See `analysis.gates.recording.record_gates` for gate jitter.

    Raises
    ------
    UserError
        If the dataset has other dimensions, gates without a camera or a camera without gates; its waveform is not
        finite or negative; the receiver is unknown or has no amplifier for a gain; both are 'auto'; noise alone exceeds
        the range; or another argument is out of range.

    Notes
    -----
    If the result includes a response (``response_time_ns``), an amplifier's bandwidth smooths it again, and the shot
    noise lacks that response's correlation. Render with a response time of 0 for a chain with a bandwidth. Dead times
    of counters and cells lose light without being marked as saturated. A result's infrared channel has its
    instrument's receiver, without daylight.
    """
    dataset, infrared = split(results.dataset_of("dataset", dataset, "waveforms", "gates"))
    if infrared is not None:
        given: dict[str, Any] = {"gain": gain, "optical_density": optical_density, "advice": advice}
        own = detect_waveforms(dataset, chain, shots, seed, background_power, **given)
        return join(own, detect_waveforms(infrared, None, shots, seed + 1, advice=advice))
    if (camera := _camera_of(dataset, chain)) is not None:
        return record_gates(dataset, camera, shots, seed, background_power, (gain, optical_density))
    receiver, groups, sky = _channels(dataset, chain, gain, optical_density, background_power)
    if len(groups) == 1:
        recorded = _record_channel(dataset, groups[0][0], shots, (seed, seed), sky, advice)
    else:
        parts = []
        for number, (channel, pixels) in enumerate(groups):
            part, light = dataset.isel(pixel=pixels), sky if np.ndim(sky) == 0 else sky[pixels]
            parts.append(_record_channel(part, channel, shots, (seed, seed + number), light, advice))
        recorded = _joined(parts, [pixels for _, pixels in groups])
    recorded.attrs |= {"noise_seed": int(seed)} | ({} if receiver.name == "custom" else {"receiver": receiver.name})
    if receiver.pulse_repetition_khz is not None:
        recorded.attrs["pulse_repetition_khz"] = receiver.pulse_repetition_khz
    if advice and recorded["saturated"].any():
        _LOG.log(logging.INFO if is_automatic(recorded) else logging.WARNING, "%s", saturation_advice(recorded))
    return recorded


record = detect_waveforms  #: Name at the top of the package.


def _camera_of(dataset: xr.Dataset, given: Any) -> Camera | None:
    """Return the camera that records the gates of a dataset, or None for a receiver that records its waveforms."""
    found = None if given is None else receiver_of("chain", given)
    if isinstance(found, Camera):
        if "gate_energy" not in dataset:
            raise UserError(
                f"chain = {found.name!r} is a camera, but the dataset has no gates: cut them with gates first"
            )
        return found
    if "waveform" in dataset:
        return None
    if found is None:
        raise UserError(f"the dataset has gates alone, which need a camera: {', '.join(CAMERAS)}, or a .toml file")
    return _named("chain", lambda: camera_of(found))


class PixelChain(NamedTuple):
    """Receiver of one pixel as used in a record, with its gain."""

    chain: ReceiverChain
    transmittance: float  #: Transmittance of the filter before the detector [1], for signal and background.
    background: float  #: Background power before the filter [W].


def pixel_chains(
    dataset: xr.Dataset,
    chain: Receiver | None = None,
    background_power: npt.ArrayLike | xr.DataArray = 0.0,
    *,
    gain: Setting | None = None,
    optical_density: Setting | None = None,
) -> list[PixelChain]:
    """Return each pixel's receiver with the gain and filter that `detect_waveforms` would use.

    Arguments and errors as for `detect_waveforms`, for a result without ``shot``; pixels of an imager are in row-major
    order.
    """
    _, groups, sky = _channels(dataset, chain, gain, optical_density, background_power)
    width, (_, light) = results.time_axis(dataset).bin_width_ns, _waveform(dataset)
    light = light.reshape(-1, light.shape[-1])
    backgrounds = np.broadcast_to(sky.ravel(), len(light))
    found: dict[int, PixelChain] = {}
    for channel, pixels in groups:
        own = backgrounds[pixels]
        used, density, _ = _in_range(channel, light[pixels], width, own, advice=False, series=False)
        found |= {pixel: PixelChain(used, 10**-density, float(backgrounds[pixel])) for pixel in pixels}
    return [found[pixel] for pixel in range(len(light))]


def shared_settings(
    dataset: xr.Dataset, receiver: ReceiverChannels, background_power: npt.ArrayLike = 0.0
) -> dict[int, tuple[float, float]]:
    """Return gain and optical density of a receiver's automatic channels, by their number, for all shots of a series.

    They are those with which `detect_waveforms` would record the series.
    """
    _, groups, sky = _channels(dataset, receiver, None, None, background_power)
    width, (_, light) = results.time_axis(dataset).bin_width_ns, _waveform(dataset)
    found: dict[int, tuple[float, float]] = {}
    for channel, pixels in groups:
        if "auto" in (channel.gain, channel.optical_density):
            own = np.broadcast_to(sky, light.shape[1:-1])[pixels]
            _, density, used = _in_range(channel, light[:, pixels], width, own, advice=False, series=True)
            found[receiver.number_of(str(dataset["pixel"].values[pixels[0]]))] = float(used["gain"]), density
    return found


def _channels(
    dataset: xr.Dataset,
    chain: Receiver | None,
    gain: Setting | None,
    optical_density: Setting | None,
    background_power: npt.ArrayLike | xr.DataArray,
) -> tuple[ReceiverChannels, list[tuple[Channel, list[int]]], FloatArray]:
    """Return the receiver, its channels with the numbers of their pixels, and the background."""
    receiver = receiver_of_result(dataset, chain, gain, optical_density)
    dims = tuple(dim for dim in _waveform(dataset)[0][:-1] if dim != "shot")
    sky = powers_of(dataset["waveform"].isel(time=0).isel(shot=0, missing_dims="ignore"), background_power, dims)
    pixels = [str(name) for name in dataset["pixel"].values] if dims == ("pixel",) else []
    # Shipped receivers go with other layouts and with some pixels alone; a file is of the lidar that it is given for.
    if receiver.name.endswith(".toml") and (absent := [name for name in receiver.channels if name not in pixels]):
        known = f"has the pixels {', '.join(pixels)}" if pixels else "is an image without named pixels"
        raise UserError(f"{receiver.name}: channels.{absent[0]} is for no pixel: the result {known}")
    if dims != ("pixel",):
        return receiver, [(receiver.default, list(range(math.prod(dataset.sizes[dim] for dim in dims))))], sky
    groups: dict[int, tuple[Channel, list[int]]] = {}
    for number, name in enumerate(pixels):
        channel = receiver.of(name)
        groups.setdefault(id(channel), (channel, []))[1].append(number)
    return receiver, list(groups.values()), sky


def receiver_of_result(
    dataset: xr.Dataset,
    chain: Receiver | None = None,
    gain: Setting | None = None,
    optical_density: Setting | None = None,
) -> ReceiverChannels:
    """Return the receiver that `detect_waveforms` would use, with its settings, of which some may be 'auto'."""
    if chain is not None:
        receiver = chain_of("chain", chain)
    else:
        receiver = instrument_receiver(str(dataset.attrs.get("instrument", ""))) or waveform_receiver("apd")
    receiver = receiver.for_light(optional_number(dataset.attrs, "wavelength_nm") or 532.0)
    if gain is None and optical_density is None:
        return receiver
    return receiver.with_settings(gain, optical_density)


def _joined(parts: list[xr.Dataset], places: list[list[int]]) -> xr.Dataset:
    """Return the records of pixel groups as one, with their differing attributes by pixel."""
    order = np.argsort(np.concatenate(places))
    joined = xr.concat(parts, "pixel", data_vars="minimal", coords="minimal", compat="override", join="override")
    joined = joined.isel(pixel=order)
    attributes: dict[str, Any] = {}
    for name in dict.fromkeys(name for part in parts for name in part.attrs):
        values: list[Any] = [part.attrs.get(name) for part in parts]
        if all(type(value) is type(values[0]) and np.array_equal(value, values[0]) for value in values):
            attributes[name] = values[0]
        elif name.startswith("receiver.") or None in values:
            for part in parts:
                for pixel in part["pixel"].values:
                    if name in part.attrs:
                        attributes[name.replace("receiver.", f"receiver.channels.{pixel}.", 1)] = part.attrs[name]
        else:
            each = [value for value, pixels in zip(values, places, strict=True) for _ in pixels]
            attributes[name] = [each[place] for place in order]
    joined.attrs = attributes
    return joined


def _record_channel(
    dataset: xr.Dataset, channel: Channel, shots: int, seeds: tuple[int, int], sky: FloatArray, advice: bool
) -> xr.Dataset:
    """Return the record for pixels that share a channel.

    Arguments as for `detect_waveforms`; seeds are for energy and trigger, and for everything else.
    """
    given = channel.chain
    dims, light = _waveform(dataset)
    pixels, series = tuple(dim for dim in dims[:-1] if dim != "shot"), dims[0] == "shot"
    width = results.time_axis(dataset).bin_width_ns
    smoothed = given.low_pass(width).weights.size > 1
    if smoothed and float(dataset.attrs.get("response_time_ns", 0)) > 0:
        _LOG.warning("the waveform includes a response time already, and the amplifier's bandwidth smooths it again")
    receiver, density, fitting = _in_range(channel, light, width, sky, advice, series)
    number = integer("shots", shots, 1, 10**9)
    require_memory(f"{number} records of {light.size} samples", _BYTES_PER_SAMPLE * number * light.size, "take fewer")
    power, background = 10**-density * light, np.broadcast_to(10**-density * sky, light.shape[:-1])
    signal, saturated = receiver.apply(power, width, shots, seeds[1], background, series=series, common_seed=seeds[0])
    number = len(signal)
    dark = None
    if receiver.digitiser is not None and receiver.digitiser.block_threshold_v is not None:
        dark = receiver.expected(np.zeros((*background.shape, 1)), width, background).mean
        stored = receiver.digitiser.stored(signal, dark)
        signal, saturated = np.where(stored, signal, np.float32(np.nan)), saturated & stored
    expected = receiver.expected(power, width, background)
    snr = receiver.snr(power, width, background, expected)
    stride = receiver.stride(width)
    time = dataset["time"][::stride]
    forms = [expected.mean, np.sqrt(expected.variance), snr, expected.saturation]
    # Without gates and errors, which a record does not have.
    kept = {*dims[:-1]}
    coords = {name: coordinate for name, coordinate in dataset.coords.items() if kept.issuperset(coordinate.dims)}
    if series:
        # The records of a shot follow each other, and its closed forms and coordinates are repeated.
        merged = (number * len(light), *signal.shape[2:])
        signal, saturated = np.moveaxis(signal, 0, 1).reshape(merged), np.moveaxis(saturated, 0, 1).reshape(merged)
        forms = [np.repeat(one, number, axis=0) for one in forms]
        numbers = np.repeat(np.arange(len(light)), number)
        coords = {name: one.isel(shot=numbers, missing_dims="ignore") for name, one in coords.items() if name != "shot"}
    over = ("shot", *pixels, "time")
    values: dict[str, Any] = {
        "signal": (over, signal),
        "saturated": (over, saturated),
        "signal_mean": (dims, forms[0]),
        "signal_deviation": (dims, forms[1]),
        "snr": (dims, forms[2]),
        "saturation": (dims, forms[3]),
        "saturated_shots": (pixels, saturated.any(axis=-1).mean(axis=0)),
        "saturated_samples": (pixels, saturated.mean(axis=(0, -1))),
    }
    if dark is not None and receiver.digitiser is not None:
        level = (dark[0] if series else dark)[..., 0]
        values["dark_level"] = (pixels, level)
        least = level + float(receiver.digitiser.block_threshold_v or 0)
        values["block_level"] = (pixels, least)
    first, weights = receiver.low_pass(width).by_bin()
    values["receiver_response"] = (("lag",), weights)
    if "waveform_stderr" in dataset:
        # The errors of a render's neighbouring bins agree in sign, as its pulse smooths them.
        error = np.nan_to_num(pooled_errors(dataset, few=True).transpose(*dims).values)
        shifted = receiver.expected(power + 10**-density * error, width, background).mean - expected.mean
        shifted = np.repeat(np.abs(shifted), number, axis=0) if series else np.abs(shifted)
        values["signal_mean_stderr"] = (dims, shifted)
    # Before the logarithm and the digitiser, as of light that is too weak for limits.
    linear = replace(receiver, logarithm=None, digitiser=None)
    steady = np.array([0.0, *[_FAINT_W] * _STEADY_BINS])
    answer = linear.expected(steady, width).mean - linear.expected(0 * steady, width).mean
    sensitivity = float(10**-density * answer.max() / _FAINT_W)
    values["receiver_sensitivity"] = (pixels, np.full([dataset.sizes[dim] for dim in pixels], sensitivity))
    heights = receiver.event_height(power, width, background)
    values["event_height"] = (pixels, heights.max(axis=0) if series else heights)
    labels = dataset["shot"].values if series and number == 1 else np.arange(len(signal))
    attributes = {
        **dataset.attrs,
        **made_from(dataset.attrs, "Signals of a receiver", "recorded"),
        "time_start_ns": float(time[0]) - 0.5 * width * stride,
        "bin_width_ns": width * stride,
        "rendered_bin_width_ns": width,
        "shots": len(signal),
        "background_power_w": np.ravel(sky).tolist() if np.ndim(sky) else float(sky),
        **dict(parameters_of("receiver", receiver)),
        **fitting,
    }
    axes = {"time": time, "shot": labels, "lag": (first + np.arange(weights.size)) * width}
    sampled = ("signal", "signal_mean", "signal_deviation", "dark_level", "block_level", "event_height")
    return label(xr.Dataset(values, {**coords, **axes}, attributes), **dict.fromkeys(sampled, receiver.units))


def _in_range(
    channel: Channel, light: FloatArray, width: float, sky: FloatArray, advice: bool, series: bool
) -> tuple[ReceiverChain, float, dict[str, float | str]]:
    """Return the chain with its gain, the optical density of the filter, and attributes with those that fit.

    Without `advice` only those that are automatic are sought. They suit all shots of a series but a share of
    `SATURATING`.
    """
    chain, gain, density = channel.chain, channel.gain, channel.optical_density
    if gain == density == "auto":
        raise UserError("gain = 'auto' and optical_density = 'auto' are alternatives: give one of them")
    if chain.amplifier is None and "auto" in (gain, density):
        name = "gain" if gain == "auto" else "optical_density"
        raise UserError(f"{name} = 'auto' needs a receiver with an amplifier: without one, nothing saturates")
    background, fitting = np.broadcast_to(sky, light.shape[:-1]), dict[str, float | str]()
    spared = int(SATURATING * len(light)) if series else 0
    if advice or "auto" in (gain, density):
        fitting["saturating_share"] = spared / len(light)
        light, background = chain.without_brightest(light, width, background, spared)
    chosen = 0.0 if density == "auto" else in_range("optical_density", density, 0, DENSEST)
    used = chain if gain in ("auto", 1) else chain.with_gain(finite("gain", gain))
    if advice or density == "auto":
        attenuation = used.fitting_attenuation(light, width, background)
        if math.isfinite(attenuation):
            # The margin keeps a density of 0.3 that rounding has raised.
            fitting["fitting_optical_density"] = math.ceil(10 * math.log10(attenuation) - 1e-6) / 10
        elif density == "auto":
            raise UserError("optical_density = 'auto' finds no filter: the noise alone exceeds the receiver's range")
        chosen = float(fitting["fitting_optical_density"]) if density == "auto" else chosen
    factor = 0.0 if gain == "auto" else float(gain)
    if advice or gain == "auto":
        largest = chain.fitting_gain(10**-chosen * light, width, 10**-chosen * background)
        if gain == "auto" and largest == 0:
            raise UserError("gain = 'auto' finds no gain of the photomultiplier: use optical_density = 'auto'")
        fitting["fitting_gain"] = largest
        factor = largest if gain == "auto" else factor
    automatic = "gain" if gain == "auto" else "optical_density" if density == "auto" else ""
    attributes = {"gain": factor, "optical_density": chosen, "chosen": automatic, **fitting}
    return (chain.with_gain(factor) if gain == "auto" and factor < 1 else used), chosen, attributes


def receiver_of(parameter: str, given: Receiver) -> ReceiverChannels | Camera:
    """Return a receiver from itself, its chain, a name, or a TOML file, as the named parameter."""
    return _named(parameter, lambda: receiver_named(given))


def chain_of(parameter: str, given: Receiver) -> ReceiverChannels:
    """Return a receiver of waveforms as `receiver_of`, which refuses a camera."""
    return _named(parameter, lambda: waveform_receiver(given))


def _named(parameter: str, found: Callable[[], _R]) -> _R:
    """Return a function's result, with the parameter's name in an error message."""
    try:
        return found()
    except UserError as error:
        text = str(error)
        raise UserError(
            f"{parameter}{text.removeprefix('receiver')}" if text.startswith("receiver =") else text
        ) from None


def _waveform(dataset: xr.Dataset) -> tuple[tuple[str, ...], FloatArray]:
    """Return the waveform's dimensions and values."""
    dims = results.record_dims(dataset, "waveform", shots=True)
    values = np.asarray(dataset["waveform"].values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise UserError(
            f"waveform has {np.count_nonzero(~np.isfinite(values))} values that are not finite; render again"
        )
    if np.any(values < 0):
        raise UserError(f"waveform holds {values.min():g} W; received power must not be negative")
    return dims, values
