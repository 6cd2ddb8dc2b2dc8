"""Figure for two results and their differences."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mitransient_lidar.analysis.comparison import Comparison
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots import drawing, palette

#: Pixels above which their sum is drawn: a curve of each would take minutes, and hide the others.
_MOST_CURVES = 64

#: Bins from one marker on a curve to the next one.
_MARK_EVERY = 12


def plot_comparison(
    first: xr.Dataset, second: xr.Dataset, outcome: Comparison, path: drawing.FilePath | None = None
) -> Figure:
    """Draw two results with bands of two standard errors, and below them their difference in standard errors.

    For more than 64 pixels, it draws the summed waveforms, and the range of all differences in each bin. The results
    have the same pixels and time bins; `outcome` comes from `analysis.comparison.compare`.
    """
    figure = drawing.new_figure(path, 9.6, 6.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    time = first["time"].values
    are_few = len(outcome.z) <= _MOST_CURVES
    marks = palette.marked(len(outcome.z) if are_few else 1)
    powers, errors = ([_by_pixel(one, name) for one in (first, second)] for name in ("waveform", "waveform_stderr"))
    counted = np.isfinite(outcome.z)
    if not are_few:
        # Pixels share light: their sum's error differs from the error for independent pixels, and has no band.
        known = np.isfinite(powers[0]) & np.isfinite(powers[1])
        powers = [np.where(known, power, 0).sum(axis=0, keepdims=True) for power in powers]
        errors = [np.zeros_like(power) for power in powers]
    for power, error, style, label in zip(powers, errors, ("-", "--"), _labels(first, second), strict=True):
        for i, mark in enumerate(marks):
            curve = {
                **mark,
                "markevery": _MARK_EVERY,
                "markersize": 3.5,
                "linestyle": style,
                "linewidth": 0.9,
                "label": "_" if i else label,
            }
            drawing.draw_band(upper, time, power[i], 2 * error[i], lowest=1e-30, **curve)
    shown = powers[0][counted if are_few else counted.any(axis=0, keepdims=True)]
    upper.set_yscale("log")
    upper.set_ylim(0.5 * shown[shown > 0].min(), 2 * shown.max())
    upper.set_xlim(drawing.time_limits(first))
    quantity, unit = ("energy in the gate", "J") if "gate" in first.coords else ("received power", "W")
    upper.set_ylabel(f"{quantity}{'' if are_few else ', all pixels'} ({unit})")
    upper.legend(frameon=False)
    if are_few:
        for z, mark in zip(outcome.z, marks, strict=True):
            lower.plot(time, z, linestyle="none", markersize=3, **mark)
    else:
        lowest, highest = np.where(counted, outcome.z, np.inf).min(0), np.where(counted, outcome.z, -np.inf).max(0)
        lower.vlines(time[counted.any(0)], lowest[counted.any(0)], highest[counted.any(0)], color=marks[0]["color"])
    for level in (-outcome.limit, outcome.limit):
        lower.axhline(level, color="0.5", linewidth=0.8, linestyle=":")
    largest = 1.5 * max(outcome.limit, outcome.largest)
    lower.set(ylim=(-largest, largest), xlabel=drawing.time_label(first), ylabel="difference\n(standard errors)")
    for ax in (upper, lower):
        drawing.add_grid(ax)
    text = f"{outcome.bin_count} bins, rms {outcome.rms:.2f} and largest {outcome.largest:.1f} standard errors"
    text += f" (limit of chance {outcome.limit:.1f})"
    figure.suptitle(drawing.titled(first.attrs, text), fontsize="medium")
    return drawing.save(figure, path)


def _labels(first: xr.Dataset, second: xr.Dataset) -> list[str]:
    """Return labels for two results: the first of their attributes that differs."""
    for name in ("integrator", "scene", "instrument", "variant", "passes", "seed"):
        values = [str(result.attrs.get(name, "")) for result in (first, second)]
        if values[0] != values[1] and all(values):
            return [value if name in ("integrator", "scene", "instrument") else f"{name} {value}" for value in values]
    return ["first result", "second result"]


def _by_pixel(result: xr.Dataset, name: str) -> FloatArray:
    values = result[name].values
    return np.asarray(values.reshape(-1, values.shape[-1]))
