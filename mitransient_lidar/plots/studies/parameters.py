"""Figures for scene parameters: their Cramer-Rao bounds, and a fit to waveforms."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.drawing import finish, new_panels

_SHOWN = 20  # designs in a panel, the best ones
_WIDE = 20.0  # largest over smallest ratio from which on the axis is logarithmic


def plot_bounds(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw a result of `studies.bounds.bounds`.

    For several designs, a panel per parameter ranks them by their bound's ratio to the first, best on top, at most 20.
    For a single design, the bounds stand beside the bounds with the other parameters known, and the correlations.
    """
    if found.sizes["design"] == 1:
        return _plot_one(found.isel(design=0), path)
    names, shown = found["parameter"].values, min(found.sizes["design"], _SHOWN)
    labels = 0.075 * max(len(str(label)) for label in found["design"].values)
    figure, axes, *_ = new_panels(path, names.size, (2.9 + labels, 0.27 * shown + 1.1), (0.0, 0.4))
    for ax, name in zip(axes, names, strict=True):
        _rank(ax, found.sel(parameter=name))
    text = f"bounds of single shots relative to {found['design'].values[0]}, receiver {found.attrs['receiver']}"
    figure.suptitle(drawing.titled(found.attrs, text))
    return drawing.save(figure, path)


def _rank(ax: Axes, one: xr.Dataset) -> None:
    """Draw the ratios of one parameter, with the bounds as numbers."""
    order = np.argsort(one["bound"].values, kind="stable")[:_SHOWN]
    ranked = one.isel(design=order)
    places = np.arange(order.size)
    ratio, error = ranked["ratio"].values, np.nan_to_num(ranked["ratio_stderr"].values)
    styles = [palette.marked(3)[2 * bool(number)] for number in order]
    drawn = np.isfinite(ratio)
    for place in places[drawn]:
        style = {"linestyle": "none", "markersize": 5, "capsize": 3, **styles[place]}
        ax.errorbar(ratio[place], place, xerr=error[place], **style)
    for place in places:
        value = float(ranked["bound"][place])
        text = f"{value:.3g}" if math.isfinite(value) else "no bound"
        style = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "va": "center", "size": 7}
        ax.annotate(text, (1, place), (4, 0), **style)
    ax.axvline(1, color="0.6", linewidth=0.9)
    ax.set_yticks(places, ranked["design"].values.tolist(), fontsize="small")
    if drawn.any() and ratio[drawn].max() > _WIDE * ratio[drawn].min():
        ax.set_xscale("log")
    unit = one["parameter_units"].item()
    title = f"{one['parameter'].item()}, bounds in {'units of 1' if unit == '1' else unit}"
    finish(ax, title, grid="x", ylim=(order.size - 0.5, -0.5), xlabel="bound over that of the first design")


def _plot_one(one: xr.Dataset, path: drawing.FilePath | None) -> Figure:
    """Draw one design's bounds and correlations."""
    names = [str(name) for name in one["parameter"].values]
    figure = drawing.new_figure(path, 9.2, 0.42 * len(names) + 2.2)
    left, right = figure.subplots(1, 2)
    places = np.arange(len(names))
    # Offsets and angles may be 0, where a relative bound does not exist.
    value = np.abs(one["parameter_value"].values)
    scale = np.where(value > 0, value, 1.0)
    labels = [
        name if size > 0 else f"{name} ({unit})"
        for name, size, unit in zip(names, value, one["parameter_units"].values, strict=True)
    ]
    for key, colour, fill, text in (
        ("bound", palette.BLUE, palette.BLUE, "all unknown"),
        ("bound_known", palette.BLUE, "none", "others known"),
    ):
        relative = one[key].values / scale
        drawn = np.isfinite(relative)
        left.plot(relative[drawn], places[drawn], "o", color=colour, markerfacecolor=fill, label=text)
    for place in places[~np.isfinite(one["bound"].values)]:
        left.text(0.02, place, "no bound", transform=left.get_yaxis_transform(), va="center", size=8, color="0.4")
    left.set_yticks(places, labels)
    text = "bound over the value, absolute where a unit is given"
    finish(left, grid="x", xscale="log", ylim=(len(names) - 0.5, -0.5), xlabel=text)
    left.legend(frameon=False, fontsize="small")
    image = right.imshow(one["correlation"].values, vmin=-1, vmax=1, cmap=palette.SIGNED)
    for (row, column), number in np.ndenumerate(one["correlation"].values):
        if math.isfinite(number):
            colour = "white" if abs(number) > 0.6 else "black"
            right.text(column, row, f"{number:.2f}", ha="center", va="center", size=7, color=colour)
    right.set_xticks(places, names, rotation=40, ha="right", fontsize="small")
    right.set_yticks(places, names, fontsize="small")
    figure.colorbar(image, ax=right, label="correlation of the estimates", shrink=0.8)
    figure.suptitle(drawing.titled(one.attrs, f"bounds of a single shot, receiver {one.attrs['receiver']}"))
    return drawing.save(figure, path)


_SHOWN_PIXELS = 12  # more would hide each other


def plot_fit(fitted: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw measured and fitted waveforms above their differences in standard deviations, one colour per pixel.

    `fitted` is a result of `studies.fit.fit`. From more than 12 pixels, those with the largest peaks are drawn. The
    title gives the values with their standard errors.
    """
    time = fitted["time"].values
    rows = {name: fitted[name].values.reshape(-1, time.size) for name in ("measured", "measured_stderr", "fitted")}
    residual, used = (fitted[name].values.reshape(-1, time.size) for name in ("residual", "used"))
    strongest = np.sort(np.argsort(-rows["fitted"].max(axis=-1), kind="stable")[:_SHOWN_PIXELS])
    names = fitted["pixel"].values if "pixel" in fitted.coords else np.arange(len(residual)).astype(str)
    figure = drawing.new_figure(path, 9.6, 6.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    shown = used[strongest].any(axis=0)
    for pixel, mark in zip(strongest, palette.marked(strongest.size), strict=True):
        values = np.where(used[pixel] > 0, rows["measured"][pixel], np.nan)
        error = np.nan_to_num(rows["measured_stderr"][pixel])
        style = {"linestyle": "none", "markersize": 3, "elinewidth": 0.7, "alpha": 0.75, **mark}
        upper.errorbar(time, values, error, label=str(names[pixel]), **style)
        upper.plot(time, np.where(used[pixel] > 0, rows["fitted"][pixel], np.nan), color=mark["color"], linewidth=1.1)
        lower.plot(time, residual[pixel], linestyle="none", markersize=3, **mark)
    peak = float(np.nanmax(rows["fitted"][strongest]))
    # Noise would fill the lower decades of a logarithmic axis.
    noise = float(np.median(np.nan_to_num(rows["measured_stderr"][strongest])))
    linear = min(max(1e-3 * peak, 3 * noise), 0.3 * peak)
    upper.set_yscale("symlog", linthresh=linear, linscale=0.5)
    upper.legend(frameon=False, ncols=2 if strongest.size > 4 else 1)
    unit = fitted["measured"].attrs.get("units") or "any unit"
    finish(upper, ylim=(-linear, 2 * peak), ylabel=f"waveform ({unit})")
    limits, label = (time[shown][0], time[shown][-1]), "difference\n(standard deviations)"
    finish(lower, zero=0, xlim=limits, xlabel=drawing.TIME_LABEL, ylabel=label)
    columns = (fitted[name].values for name in ("parameter", "value", "stderr"))
    text = ", ".join(f"{name} {value:.4g} ± {error:.2g}" for name, value, error in zip(*columns, strict=True))
    figure.suptitle(drawing.titled(fitted.attrs, text), fontsize="medium")
    return drawing.save(figure, path)
