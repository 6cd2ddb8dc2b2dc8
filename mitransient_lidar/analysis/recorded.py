"""What a record of `analysis.receiver.detect_waveforms` says of its settings and of saturation."""

from __future__ import annotations

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.gates.recording import describe_frames

_LISTED_PIXELS = 12  #: Most pixels whose saturation is listed.


def saturation_advice(recorded: xr.Dataset) -> str:
    """Return a sentence on the saturation in a record from `detect_waveforms`, and on how to avoid it."""
    saturated = recorded["saturated"]
    share = float(saturated.any([dim for dim in saturated.dims if dim != "shot"]).mean())
    if share == 0:
        return "no sample is saturated"
    text = f"{_percent(share)} of the shots have saturated samples"
    allowed = float(np.max(recorded.attrs.get("saturating_share", 0.0)))
    if is_automatic(recorded):
        return f"{text}, of {_percent(allowed)} that may have them with an automatic setting"
    if {"fitting_optical_density", "fitting_gain"} <= recorded.attrs.keys():
        density = float(np.max(recorded.attrs["fitting_optical_density"]))
        text += f": a filter of optical density {density:.1f} (factor {10**density:.3g})"
        gain = float(np.min(recorded.attrs["fitting_gain"]))
        text += f" or a gain of {gain:.3g} would fit" if gain > 0 else " would fit"
        text += f", with {_percent(allowed)} of saturated shots" if allowed else ""
    return text


def describe_recording(recorded: xr.Dataset) -> list[str]:
    """Return lines on a record of `detect_waveforms`: gain and filter as used, and saturation in total and by pixel."""
    if "gate" in recorded.dims:
        return describe_frames(recorded)
    attributes = recorded.attrs
    used = ", ".join(
        f"{name.replace('_', ' ')} {_span(attributes[name])}{' (auto)' if name in attributes['chosen'] else ''}"
        for name in ("gain", "optical_density")
    )
    count = recorded.sizes["shot"]
    lines = [
        f"{count} shot{'s' * (count != 1)}, receiver {attributes.get('receiver', 'custom')}, {used}",
        saturation_advice(recorded),
    ]
    if "block_level" in recorded:
        lines.append(f"{_percent(float(recorded['signal'].notnull().mean()))} of the samples are stored in blocks")
    shots, samples = recorded["saturated_shots"], recorded["saturated_samples"]
    if not shots.any():
        return lines
    if shots.dims != ("pixel",) or shots.size > _LISTED_PIXELS:
        most = f"{_percent(float(shots.max()))} of its shots, {_percent(float(samples.max()))} of its samples"
        return [*lines, f"most saturated pixel: {most}"]
    for name, of_shots, of_samples in zip(recorded["pixel"].values, shots.values, samples.values, strict=True):
        lines.append(f"saturated in {name}: {_percent(of_shots)} of the shots, {_percent(of_samples)} of the samples")
    return lines


def _span(values: float | list[float]) -> str:
    """Return a number, or the least and the largest one of a list."""
    low, high = np.min(values), np.max(values)
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def is_automatic(recorded: xr.Dataset) -> bool:
    """Return whether each channel of a record has a gain or a filter that was chosen for it."""
    return all(np.ravel(recorded.attrs["chosen"]))


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
