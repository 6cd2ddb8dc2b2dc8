"""Drawings of how well a target is detected with one pixel and with several."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from mitransient_lidar.plotting import check_format, colours
from mitransient_lidar.results import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {"single": "0.25", "sum": "#e69f00", "brightest": "#56b4e9", "best": "#d55e00"}
_LABELS = {
    "single": "one pixel for all light",
    "sum": "sum of the pixels",
    "brightest": "brightest pixel alone",
    "best": "best weighting",
}


def plot_detection(found: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Draw the light, the operating characteristics, what is needed for detection, and the error of the depth.

    Parameters
    ----------
    found
        What `detection.detect` returned.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    UserError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure

    check_format(Path(path))
    figure = Figure(figsize=(12.5, 7.6), layout="constrained")
    light, characteristic, needed, gains, errors, depths = figure.subplots(2, 3).flat
    _draw_light(light, found)
    _draw_characteristic(characteristic, found)
    _draw_needed(needed, found)
    _draw_errors(errors, found)
    _draw_gains(gains, found)
    handles, labels = characteristic.get_legend_handles_labels()
    if "depth" in found.dims:
        _draw_depths(depths, found)
        figure.legend(handles, labels, loc="outside lower center", ncols=len(handles), frameon=False)
    else:
        depths.axis("off")
        depths.legend(handles, labels, loc="center", frameon=False, fontsize="large")
    attributes = found.attrs
    noise = f"noise and the clutter of {attributes['clutter']} seas" if attributes["clutter"] else "noise"
    figure.suptitle(
        f"{attributes['scene']}, receiver {attributes['receiver']}: detection in {noise}, bars of "
        f"{100 * attributes['confidence']:g} % confidence"
    )
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)


def _draw_light(ax: Axes, found: xr.Dataset) -> None:
    names = [str(name) for name in found["pixel"].values]
    own = found["difference"].values
    time = found["time"].values
    middle, reach = float(time[np.argmax(own.sum(axis=0))]), 4 * found.attrs["pulse_fwhm_ns"]
    shown = np.abs(time - middle) <= reach
    for i, (name, colour) in enumerate(zip(names, colours(len(names)), strict=True)):
        ax.plot(time[shown], 1e6 * own[i, shown], color=colour, linewidth=1.4, label=name)
        bare = 1e6 * found["background"].values[i, shown]
        ax.plot(time[shown], bare, color=colour, linewidth=0.9, linestyle=(0, (4, 2)))
    ax.plot([], [], color="0.4", linewidth=0.9, linestyle=(0, (4, 2)), label="without the target")
    ax.axhline(0, color="0.6", linewidth=0.8)
    ax.legend(frameon=False, fontsize="small")
    ax.set_xlim(time[shown][0], time[shown][-1])
    _label(ax, "the target's own light and the background", "time (ns)", "power (\u00b5W)")


def _draw_characteristic(ax: Axes, found: xr.Dataset) -> None:
    """Draw closed forms as lines, and drawn shots at a few thresholds with the intervals of both rates."""
    for name, one in _each(found):
        ax.plot(one["false_alarm"], one["expected_detection"], color=_COLOURS[name], linewidth=1.3, label=_LABELS[name])
        few = one.sel(false_alarm=[found.attrs["pfa"], *np.logspace(-3, -1, 5)], method="nearest")
        x, y = few["drawn_false_alarm"], few["drawn_detection"]
        bars = [
            [one_rate - few[f"{one_rate.name}_low"], few[f"{one_rate.name}_high"] - one_rate] for one_rate in (x, y)
        ]
        ax.errorbar(x, y, bars[1], bars[0], fmt="o", color=_COLOURS[name], markersize=2.5, linewidth=0.9)
    lowest = float(found["false_alarm"][0])
    ax.axvline(found.attrs["pfa"], color="0.6", linewidth=0.8)
    ax.set_xscale("log")
    ax.set_xlim(lowest, 0.9)
    ax.set_ylim(0, 1.02)
    ax.errorbar([], [], 1, 1, fmt="o", color="0.5", markersize=2.5, label=f"{found.attrs['shots']} shots drawn")
    share = 100 * found.attrs["drawn_share"]
    _label(ax, f"with {share:.2g} % of the target's signal", "probability of false alarm", "probability of detection")


def _draw_needed(ax: Axes, found: xr.Dataset) -> None:
    kinds = {"needed_target": "of the\ntarget's signal", "needed_energy": "of the\npulse's energy"}
    _draw_kinds(ax, found, kinds, 100, bars=False)
    ax.set_yscale("log")
    title = f"needed for $P_d$ = {found.attrs['pd']:g} at $P_{{fa}}$ = {found.attrs['pfa']:g}"
    _label(ax, title, "", "share (%)")


def _draw_errors(ax: Axes, found: xr.Dataset) -> None:
    _draw_kinds(ax, found, {"depth_spread": "spread", "depth_bias": "bias"}, 1e3)
    ax.axhline(0, color="0.6", linewidth=0.8)
    _label(ax, "depth from the echo of the whole target", "", "error (mm)")


def _draw_gains(ax: Axes, found: xr.Dataset) -> None:
    kinds = {"gain_target": "target's\nsignal", "gain_energy": "pulse\nenergy", "depth_gain": "spread\nof the depth"}
    _draw_kinds(ax, found, kinds)
    ax.axhline(1, color="0.6", linewidth=0.8)
    # An interval that tells nothing must not hide the others.
    largest = max(float(found[kind].where(np.isfinite(found[kind])).max()) for kind in kinds)
    ax.set_ylim(0, min(ax.get_ylim()[1], 2 * max(largest, 1)))
    _label(ax, "gain over one pixel: how much less is needed", "", "factor")


def _draw_depths(ax: Axes, found: xr.Dataset) -> None:
    for name, one in _each(found):
        share, low, high = (100 * one[f"needed_at_depth{end}"].values for end in ("", "_low", "_high"))
        bars = np.maximum([share - low, high - share], 0)
        ax.errorbar(one["depth"], share, yerr=bars, color=_COLOURS[name], marker="o", markersize=3, linewidth=1.3)
        reached = float(one["detectable_depth"])
        if np.isfinite(reached):
            ax.plot([reached], [100], color=_COLOURS[name], marker="v", markersize=8, zorder=3)
    ax.axhline(100, color="0.6", linewidth=0.8)
    ax.set_yscale("log")
    _label(ax, "detectable where the whole signal suffices", "depth of the target (m)", "needed of its signal (%)")


def _draw_kinds(ax: Axes, found: xr.Dataset, kinds: dict[str, str], scale: float = 1.0, bars: bool = True) -> None:
    """Draw groups of bars or points with confidence intervals, one for each combination, where they are finite."""
    largest = max(float(np.nanmax(np.where(np.isfinite(found[kind]), np.abs(found[kind]), 0))) for kind in kinds)
    for place, (name, one) in enumerate(_each(found)):
        for group, kind in enumerate(kinds):
            value, low, high = (scale * float(one[kind + end]) for end in ("", "_low", "_high"))
            if not np.isfinite([value, low, high]).all():
                continue
            x = group + 0.2 * (place - 1.5)
            if bars:
                ax.bar(x, value, 0.18, color=_COLOURS[name])
            ax.errorbar(
                x,
                value,
                [[max(value - low, 0)], [max(high - value, 0)]],
                fmt="none" if bars else "o",
                color=_COLOURS[name],
                ecolor="black",
                capsize=2,
                linewidth=0.9,
            )
            if not bars or abs(value) > 0.05 * scale * largest:
                text = f"{value:.2g}" if value < 1 else f"{value:.3g}"
                ax.annotate(text, (x, high), (0, 3), textcoords="offset points", ha="center", fontsize=7)
    ax.set_xticks(range(len(kinds)), list(kinds.values()))
    ax.margins(x=0.08, y=0.12)


def _each(found: xr.Dataset) -> list[tuple[str, Any]]:
    return [(str(name), found.sel(combination=name)) for name in found["combination"].values]


def _label(ax: Axes, title: str, x: str, y: str) -> None:
    ax.set_title(title, fontsize="medium")
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(True, color="0.92", linewidth=0.7)
    ax.set_axisbelow(True)
