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
from mitransient_lidar.results.attributes import label, made_from
from mitransient_lidar.results.gate_stack import check_stack

_LOG = logging.getLogger(__name__)

_BLOCK = 2**22  # values in a block of gates that is drawn at once
_DIMMED = ("gate_energy", "gate_energy_stderr", "waveform", "waveform_stderr")  # light behind a filter
_MOMENTS = ("signal_mean", "signal_deviation", "snr", "saturation", "signal_mean_stderr")


def record_gates(
    dataset: xr.Dataset, camera: Camera, frames: int, seed: int, background_power: Any, settings: tuple[Any, Any]
) -> xr.Dataset:
    """Return a camera's frames for a gate stack, on one sea or with one for each ``frame``.

    Arguments as for `analysis.receiver.detect_waveforms`, with gain and optical density as settings.

    Notes
    -----
    Gate jitter needs the energy in shifted gates. It comes from waveforms in the same dataset, or else from the gates
    before and after one if they follow within the longer of the pulse and the gate's edges. With neither, it is left
    out, and a warning reports it. The mean of a stack that was rendered with jitter has it already. The standard errors
    of the mean assume one sign for all pixel errors.
    """
    if "auto" in settings:
        name = ("gain", "optical_density")[settings.index("auto")]
        raise UserError(f"{name} = 'auto' needs a receiver of waveforms: give a number for a camera")
    factor, density = (float(usual if one is None else one) for one, usual in zip(settings, (1, 0), strict=True))
    first = check_stack(dataset.isel(frame=0, missing_dims="ignore"))["gate_energy"].isel(gate=0)
    sky = powers_of(first, background_power, tuple(str(dim) for dim in first.dims))
    _warn(dataset, camera)
    jitter = float(np.hypot(camera.gate_jitter_ns, float(dataset.attrs.get("gate_jitter_ns", 0))))
    used = replace(camera, gate_jitter_ns=jitter)
    used = used if factor == 1 else replace(used, gain=camera.gain * factor)
    dimmed = dataset.assign({name: one * 10**-density for name, one in dataset.items() if name in _DIMMED})
    recorded = _recorded(dimmed, used, frames, seed, sky * 10**-density)
    recorded.attrs |= {
        **made_from(dataset.attrs, "Frames of a gated camera", "recorded"),
        **{"noise_seed": int(seed), "receiver": camera.name, "gain": factor, "optical_density": density},
        "background_power_w": float(sky) if sky.ndim == 0 else float(sky.mean()),
        **dict(parameters_of("receiver", used)),
    }
    return recorded


def _recorded(dataset: xr.Dataset, camera: Camera, frames: int, seed: int, sky: FloatArray) -> xr.Dataset:
    """Return frames for a gate stack with the daylight power on each pixel [W]."""
    energy = dataset["gate_energy"]
    if not (np.isfinite(energy) & (energy >= 0)).all():
        raise UserError(f"gate_energy holds {float(energy.min()):g} J; it must be finite and not negative")
    own = ("frame",) if "frame" in energy.dims else ()
    dims = ("row", "column", "gate") if "row" in energy.dims else ("pixel", "gate")
    seas, shape = dataset.sizes["frame"] if own else 1, tuple(dataset.sizes[dim] for dim in dims)
    number, size = seas * frames, int(np.prod(shape))
    require_memory(f"{number} frames of {size} pixels and gates", size * (4 * number + 24 * seas + 32), "take fewer")
    lights, errors = (
        dataset[name].transpose(*own, *dims).values.reshape(seas, *shape)
        for name in ("gate_energy", "gate_energy_stderr")
    )
    gate, pattern = _shape(dataset), camera.pattern(shape[:-1])
    opened = float(gate.open_time(gate.span_ns[1]))
    known: dict[str, Any] = {"background": sky, "pulses": int(dataset.attrs.get("pulses", 1)), "pattern": pattern}
    nothing = np.zeros((*shape[:-1], 1))
    unlit = camera.expected(nothing, opened, **known).mean
    dark = camera.expected(nothing, opened, **{**known, "background": 0.0}).mean
    signal = np.empty((number, *shape), np.uint16 if camera.bits <= 16 else np.uint32)
    saturated = np.empty(signal.shape, np.bool_)
    moments = np.empty((len(_MOMENTS), seas, *shape), np.float32)
    step = max(_BLOCK * shape[-1] // size, 1)
    for sea in range(seas):
        light, slope = _jittered(dataset, camera, lights[sea])
        for start in range(0, shape[-1], step):
            part = (..., slice(start, start + step))
            known["slope"] = None if slope is None else slope[part]
            expected = camera.expected(light[part], opened, **known)
            shifted = camera.expected(light[part] + np.nan_to_num(errors[sea][part]), opened, **known).mean
            deviation = np.sqrt(expected.variance)
            snr = np.divide(expected.mean - unlit, deviation, out=np.zeros_like(deviation), where=deviation > 0)
            snr[expected.saturation > 0.5] = np.nan
            moments[:, sea][part] = expected.mean, deviation, snr, expected.saturation, shifted - expected.mean
            mine = slice(sea * frames, (sea + 1) * frames), *part
            signal[mine], saturated[mine] = camera.sample(light[part], opened, frames, (seed, sea, start), **known)
    values: dict[str, Any] = {"signal": (("frame", *dims), signal), "saturated": (("frame", *dims), saturated)}
    for name, one in zip(_MOMENTS, moments, strict=True):
        values[name] = ((*own, *dims), np.repeat(one, frames, axis=0) if own else one[0])
    values["dark_level"] = (dims[:-1], dark[..., 0].astype(np.float32))
    coords = {name: one for name, one in dataset.coords.items() if {*own, *dims}.issuperset(one.dims)}
    if own:
        each = np.repeat(np.arange(seas), frames)
        coords = {name: one.isel(frame=each, missing_dims="ignore") for name, one in coords.items()}
    coords |= {"frame": np.arange(number)}
    counts = dict.fromkeys(("signal", "signal_mean", "signal_deviation", "dark_level"), "count")
    return label(xr.Dataset(values, coords, {**dataset.attrs, "frames": number}), "frames", **counts)


def describe_frames(recorded: xr.Dataset) -> list[str]:
    """Return lines on frames of `record_gates`: their number, signal-to-noise ratio, and saturation."""
    pulses, gates = recorded.attrs.get("pulses", 1), recorded["signal"].dims[1:-1]
    mean = recorded["snr"].mean([dim for dim in recorded["snr"].dims if dim != "gate"]).fillna(0).values
    share = recorded["saturated"].mean(("frame", *gates)).values
    best, worst = int(np.argmax(mean)), int(np.argmax(share))
    return [
        f"{recorded.sizes['frame']} frames of {recorded.sizes['gate']} gates, "
        f"camera {recorded.attrs.get('receiver')}, pulses a frame: {pulses}",
        f"largest mean signal-to-noise ratio of a pixel and frame: {mean[best]:.3g} in gate {best}",
        f"saturated in gate {worst}: {100 * share[worst]:.3g} % of the pixels, the most of all gates"
        if share.any()
        else "no pixel is saturated",
    ]


def _shape(dataset: xr.Dataset) -> GateShape:
    """Return the shape of a stack's gates."""
    attributes = dataset.attrs
    if "gate_profile" in attributes:
        return GateShape.sampled(attributes["gate_profile_ns"], attributes["gate_profile"])
    edges = (float(attributes.get(name, 0)) for name in ("gate_rise_ns", "gate_fall_ns"))
    return GateShape.edges(float(dataset["gate_width"][0]), *edges)


def _jittered(dataset: xr.Dataset, camera: Camera, energy: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return the mean energy over the jitter of the gates [J], and its derivative with their time [J/ns] or None."""
    jitter, attributes = camera.gate_jitter_ns, dataset.attrs
    if jitter == 0:
        return energy, None
    step = float(attributes.get("gate_step_ns", np.inf))
    shape = _shape(dataset)
    longest = max(float(attributes.get("pulse_fwhm_ns", 0)), shape.rise_ns, shape.fall_ns)
    if "waveform" in dataset and "frame" not in dataset.dims:
        apart, start, pulses = jitter, float(dataset["gate_start"][0]), int(attributes.get("pulses", 1))
        train = GateTrain.measured(shape, start, step, energy.shape[-1], pulses)
        before, after = (
            cut_gates(dataset.drop_dims("gate"), replace(train, start_ns=start + shift))["gate_energy"].values
            for shift in (-jitter, jitter)
        )
    else:
        return jittered_beside(energy, jitter, float(attributes.get("gate_jitter_ns", 0)), step, longest)
    return _moments(energy, before, after, apart, jitter, float(attributes.get("gate_jitter_ns", 0)))


def jittered_beside(
    energy: FloatArray, jitter: float, included: float, step: float, longest: float
) -> tuple[FloatArray, FloatArray | None]:
    """Return the mean gate energy over a jitter, and its derivative by gate time, from the neighbouring gates.

    Without gates that follow within the longer of pulse and edges, it is left out with a warning. The derivative is
    None without jitter, or where it is left out.

    Parameters
    ----------
    energy : ndarray
        Energy in the gates, shape (..., gate) [J], as of the mean; the derivative is in J/ns.
    jitter, included : float
        Standard deviation of the gate time, and its part that the energy already has [ns].
    step, longest : float
        Time from gate to gate, and the longest one that shows the energy between them [ns].
    """
    if jitter == 0:
        return energy, None
    if energy.shape[-1] == 1 or step > longest:
        text = "the gate jitter of %g ns is left out: it needs waveforms, or gates that follow within %g ns"
        _LOG.warning(text, jitter, longest)
        return energy, None
    # Beyond the ends the energy is taken as a straight line.
    first, last = (2 * energy[..., [end]] - energy[..., [beside]] for end, beside in ((0, 1), (-1, -2)))
    before, after = np.concatenate([first, energy[..., :-1]], -1), np.concatenate([energy[..., 1:], last], -1)
    return _moments(energy, before, after, step, jitter, included)


def _moments(
    energy: FloatArray, before: FloatArray, after: FloatArray, apart: float, jitter: float, included: float
) -> tuple[FloatArray, FloatArray]:
    """Return mean and derivative of the energy with respect to gate time, from gates `apart` before and after."""
    mean = energy + 0.5 * (jitter**2 - included**2) / apart**2 * (before + after - 2 * energy)
    return np.maximum(mean, 0), (after - before) / (2 * apart)


def _warn(dataset: xr.Dataset, camera: Camera) -> None:
    """Warn about gates that the camera does not open, and about blur that is left out."""
    start, width = float(dataset["gate_start"].min()), float(dataset["gate_width"].min())
    if start < camera.insertion_delay_ns:
        text = "the first gate opens at %g ns, before the insertion delay of %g ns"
        _LOG.warning(text, start, camera.insertion_delay_ns)
    if width < camera.shortest_gate_ns:
        _LOG.warning("the gates of %g ns are shorter than those of the camera, %g ns", width, camera.shortest_gate_ns)
    if "row" not in dataset.dims and min(camera.optics_mtf, camera.intensifier_mtf) < 1:
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
    """Return the parameters of a stage and its nested stages as attributes; None and () are left out."""
    found: dict[str, int | float | str | list[float]] = {}
    if is_dataclass(part):
        if name != "receiver":
            found[name] = type(part).__name__
        for field in fields(part):
            found |= parameters_of(f"{name}.{field.name}", getattr(part, field.name))
    elif isinstance(part, bool):
        found[name] = int(part)
    elif isinstance(part, tuple) and part and isinstance(part[0], tuple):
        # A measured response; the record contains its bin values.
        found[name] = f"{len(part[0])} samples, {part[0][0]:g} to {part[0][-1]:g} ns"
    elif isinstance(part, tuple):
        found |= {name: list(part)} if part else {}
    elif part is not None:
        found[name] = part
    return found
