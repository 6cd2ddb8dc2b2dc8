"""Frames of a gated camera: noisy gate images, as digital numbers, with their moments in closed form."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.gates.cut import cut_gates
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, require_memory
from mitransient_lidar.physics.lidar.gate_train import GateShape, GateTrain
from mitransient_lidar.physics.receiver.camera import Camera
from mitransient_lidar.results.attributes import made_from
from mitransient_lidar.results.gate_stack import check_stack
from mitransient_lidar.results.variables import label

_LOG = logging.getLogger(__name__)

_BLOCK = 2**22  # values of a block of gates that is drawn at once
_DIMMED = ("gate_energy", "gate_energy_stderr", "waveform", "waveform_stderr")  # light behind a filter
_MOMENTS = ("signal_mean", "signal_deviation", "snr", "saturation", "signal_mean_stderr")


def record_gates(
    dataset: xr.Dataset, camera: Camera, frames: int, seed: int, background_power: Any, settings: tuple[Any, Any]
) -> xr.Dataset:
    """Return the frames of a camera for a gate stack.

    The arguments are those of `analysis.receiver.detect_waveforms`, with gain and optical density as settings.
    """
    names = ("gain", "optical_density")
    for name, value in zip(names, settings, strict=True):
        if value == "auto":
            raise UserError(f"{name} = 'auto' needs a receiver of waveforms: give a number for a camera")
    factor, density = (float(usual if one is None else one) for one, usual in zip(settings, (1, 0), strict=True))
    check_stack(dataset)
    first = dataset["gate_energy"].isel(gate=0).isel(frame=0, missing_dims="ignore")
    sky = powers_of(first, background_power, tuple(str(dim) for dim in first.dims))
    used = camera if factor == 1 else replace(camera, gain=camera.gain * factor)
    dimmed = dataset.assign({name: one * 10**-density for name, one in dataset.items() if name in _DIMMED})
    recorded = _recorded(dimmed, used, frames, seed, sky * 10**-density)
    own = {"noise_seed": int(seed), "receiver": camera.name, **dict(zip(names, (factor, density), strict=True))}
    recorded.attrs |= own | dict(parameters_of("receiver", used))
    return recorded


def _recorded(dataset: xr.Dataset, camera: Camera, frames: int, seed: int, sky: FloatArray) -> xr.Dataset:
    """Return frames of a gate stack; see `record_gates`.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack, of one sea or with one for each ``frame``, and waveforms if it has them.
    camera : Camera
        The camera.
    frames : int
        Frames of each gate and sea.
    seed : int
        Seed of the noise.
    sky : ndarray
        Power of the daylight on each pixel [W], a number or over the pixels.

    Notes
    -----
    The jitter of the gates needs the energy at shifted gates: that of the waveforms of the same dataset, or else of
    the gates before and after one if they follow within the longer of the pulse and the gate's edges. With neither, it
    is left out, and a warning says so. The standard errors of the mean are as if those of all pixels had one sign.
    """
    energy, error = (dataset[name].transpose(..., "gate") for name in ("gate_energy", "gate_energy_stderr"))
    lowest = float(energy.min())
    if not np.isfinite(lowest) or lowest < 0 or not np.isfinite(float(energy.max())):
        raise UserError(f"gate_energy holds {lowest:g} J; the energy of a gate must be finite and not negative")
    seas = dataset.sizes["frame"] if "frame" in energy.dims else 1
    energy, error = (one.transpose("frame", ..., missing_dims="ignore") for one in (energy, error))
    dims = tuple(str(dim) for dim in energy.dims if dim != "frame")
    shape = tuple(dataset.sizes[dim] for dim in dims)
    _warn(dataset, camera, dims)
    number, size = seas * frames, int(np.prod(shape))
    require_memory(f"{number} frames of {size} pixels and gates", size * (4 * number + 24 * seas + 32), "take fewer")
    opened, pulses = _open_ns(dataset), int(dataset.attrs.get("pulses", 1))
    signal = np.empty((number, *shape), np.uint16 if camera.bits <= 16 else np.uint32)
    saturated = np.empty(signal.shape, np.bool_)
    moments = {name: np.empty((seas, *shape), np.float32) for name in _MOMENTS}
    pattern = camera.pattern(shape[:-1])
    known: dict[str, Any] = {"background": sky, "pulses": pulses, "pattern": pattern}
    dark = camera.expected(np.zeros((*shape[:-1], 1)), opened, pulses=pulses, pattern=pattern).mean
    step = max(_BLOCK // (size // shape[-1]), 1)
    for sea in range(seas):
        light, stderr = (np.reshape(one.values, (seas, *shape))[sea] for one in (energy, error))
        light, slope = _jittered(dataset, camera, light)
        for block, start in enumerate(range(0, shape[-1], step)):
            part = (..., slice(start, start + step))
            known["slope"] = None if slope is None else slope[part]
            expected = camera.expected(light[part], opened, **known)
            shifted = camera.expected(light[part] + np.nan_to_num(stderr[part]), opened, **known).mean
            deviation = np.sqrt(expected.variance)
            snr = np.divide(expected.mean - dark, deviation, out=np.zeros_like(dark + deviation), where=deviation > 0)
            for name, one in zip(
                _MOMENTS, (expected.mean, deviation, snr, expected.saturation, shifted - expected.mean), strict=True
            ):
                moments[name][sea][part] = one
            drawn = camera.sample(light[part], opened, frames, (seed, sea, block), **known)
            own = (slice(sea * frames, (sea + 1) * frames), *part)
            signal[own], saturated[own] = drawn
    over = dims if "frame" not in energy.dims else ("frame", *dims)
    values: dict[str, Any] = {"signal": (("frame", *dims), signal), "saturated": (("frame", *dims), saturated)}
    for name, one in moments.items():
        values[name] = (over, np.repeat(one, frames, axis=0) if "frame" in over else one[0])
    values["dark_level"] = (dims[:-1], dark[..., 0].astype(np.float32))
    coords = {name: one for name, one in dataset.coords.items() if {"frame", *dims}.issuperset(one.dims)}
    if "frame" in over:
        places = np.repeat(np.arange(seas), frames)
        coords = {name: one.isel(frame=places, missing_dims="ignore") for name, one in coords.items()}
    attributes = {
        **dataset.attrs,
        **made_from(dataset.attrs, "Frames of a gated camera", "recorded"),
        "frames": number,
        "background_power_w": np.ravel(sky).tolist() if sky.ndim and sky.size <= 100 else float(sky.mean()),
    }
    counts = dict.fromkeys(("signal", "signal_mean", "signal_deviation", "dark_level"), "count")
    return label(xr.Dataset(values, {**coords, "frame": np.arange(number)}, attributes), "frames", **counts)


def describe_frames(recorded: xr.Dataset) -> list[str]:
    """Return lines on frames of `record_gates`: their number, signal-to-noise ratio, and saturation."""
    attributes, gates = recorded.attrs, recorded["snr"].dims[:-1]
    mean, share = recorded["snr"].mean(gates), recorded["saturated"].mean(("frame", *gates))
    best = int(np.argmax(mean.values))
    lines = [
        f"{recorded.sizes['frame']} frames of {recorded.sizes['gate']} gates, camera {attributes.get('receiver')}, "
        f"{attributes.get('pulses', 1)} pulses a frame",
        f"largest mean signal-to-noise ratio of a pixel and frame: {float(mean[best]):.3g} in gate {best}",
    ]
    if not share.any():
        return [*lines, "no pixel is saturated"]
    worst = int(np.argmax(share.values))
    return [
        *lines,
        f"saturated in gate {worst}: {100 * float(share[worst]):.3g} % of the pixels, the most of all gates",
    ]


def _open_ns(dataset: xr.Dataset) -> float:
    """Return the integral of the transmission of each gate [ns]."""
    shape = _shape(dataset.attrs)
    return float(dataset["gate_width"][0]) if shape is None else float(shape.open_time(np.inf))


def _shape(attributes: Mapping[Any, Any]) -> GateShape | None:
    """Return the measured shape of the gates, or None for edges, whose integral is the width."""
    if "gate_profile" not in attributes:
        return None
    return GateShape.sampled(attributes["gate_profile_ns"], attributes["gate_profile"])


def _jittered(dataset: xr.Dataset, camera: Camera, energy: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return the mean energy over the jitter of the gates [J], and its derivative with their time [J/ns] or None.

    The energy is of second order in the jitter.
    """
    jitter, attributes = camera.gate_jitter_ns, dataset.attrs
    if jitter == 0:
        return energy, None
    if "waveform" in dataset and "frame" not in dataset.dims:
        shape, width = _shape(attributes), float(dataset["gate_width"][0])
        edges = float(attributes.get("gate_rise_ns", 0)), float(attributes.get("gate_fall_ns", 0))
        rest = float(attributes.get("gate_step_ns", width)), dataset.sizes["gate"]
        early, late = (
            cut_gates(
                dataset.drop_dims("gate"),
                GateTrain(
                    float(dataset["gate_start"][0]) + shift, width, *rest, *edges, int(attributes["pulses"]), shape
                ),
            )["gate_energy"].values
            for shift in (-jitter, jitter)
        )
        return 0.5 * (early + late), (late - early) / (2 * jitter)
    step = float(attributes.get("gate_step_ns", np.inf))
    scale = max(float(attributes.get(name, 0)) for name in ("pulse_fwhm_ns", "gate_rise_ns", "gate_fall_ns"))
    if energy.shape[-1] < 2 or step > scale:
        _LOG.warning(
            "the gate jitter of %g ns is left out: it needs waveforms, or gates that follow within %g ns", jitter, scale
        )
        return energy, None
    # Beyond the ends the energy is taken as a straight line.
    ends = np.concatenate(
        [2 * energy[..., :1] - energy[..., 1:2], energy, 2 * energy[..., -1:] - energy[..., -2:-1]], axis=-1
    )
    before, after = ends[..., :-2], ends[..., 2:]
    mean = energy + 0.5 * (jitter / step) ** 2 * (before + after - 2 * energy)
    return np.maximum(mean, 0), (after - before) / (2 * step)


def _warn(dataset: xr.Dataset, camera: Camera, dims: tuple[str, ...]) -> None:
    """Warn of gates that the camera does not open, and of blur that is left out."""
    start, width = float(dataset["gate_start"].min()), float(dataset["gate_width"].min())
    if start < camera.insertion_delay_ns:
        _LOG.warning(
            "the first gate opens at %g ns, before the insertion delay of %g ns", start, camera.insertion_delay_ns
        )
    if width < camera.shortest_gate_ns:
        _LOG.warning(
            "the gates of %g ns are shorter than the camera's, of at least %g ns", width, camera.shortest_gate_ns
        )
    if "pixel" in dims and min(camera.optics_mtf, camera.intensifier_mtf) < 1:
        _LOG.warning("the blur of optics and intensifier is left out: the pixels are no image")


def powers_of(of_pixels: xr.DataArray, power: npt.ArrayLike | xr.DataArray, dims: tuple[str, ...]) -> FloatArray:
    """Return a number or one number per pixel, of an array over the pixels."""
    if isinstance(power, xr.DataArray):
        if set(power.dims) - set(dims):
            raise UserError(f"background_power has the dimensions {power.dims}; they must be among {dims}")
        power = power.broadcast_like(of_pixels).transpose(*dims) if power.ndim else power
    try:
        values = np.asarray(power, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"background_power = {power!r} must be a number, or one per pixel") from None
    pixels = tuple(of_pixels.sizes[name] for name in dims)
    if values.shape not in ((), pixels):
        raise UserError(
            f"background_power has the shape {values.shape}; it must be a number or have the shape {pixels}"
        )
    if np.any(values < 0):
        raise UserError(f"background_power = {values.min():g} must not be negative")
    return values


def parameters_of(name: str, part: Any) -> Mapping[str, int | float | str | list[float]]:
    """Return the parameters of a stage and of its nested stages as attributes; None and () are left out."""
    found: dict[str, int | float | str | list[float]] = {}
    if is_dataclass(part):
        if name != "receiver":
            found[name] = type(part).__name__
        for field in fields(part):
            found |= parameters_of(f"{name}.{field.name}", getattr(part, field.name))
    elif isinstance(part, bool):
        found[name] = int(part)
    elif isinstance(part, tuple) and part and isinstance(part[0], tuple):
        # A measured response; the record holds that of its bins.
        found[name] = f"{len(part[0])} samples, {part[0][0]:g} to {part[0][-1]:g} ns"
    elif isinstance(part, tuple):
        found |= {name: list(part)} if part else {}
    elif part is not None:
        found[name] = part
    return found
