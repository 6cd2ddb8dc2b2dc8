"""Figure of the detection of a target with one pixel and with several."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing
from mitransient_lidar.plots.studies.target_signal import draw_against_background

_COLOURS = {"single": "0.25", "sum": "#e69f00", "brightest": "#56b4e9", "best": "#d55e00"}
_LABELS = {
    "single": "one pixel for all light",
    "sum": "sum of the pixels",
    "brightest": "brightest pixel alone",
    "best": "best weighting",
}


def plot_detection(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the signals, the operating characteristics, the signal required for detection, and the depth error.

    `found` is a result of `studies.detection.detect`.
    """
    figure = drawing.new_figure(path, 12.5, 7.6)
    light, characteristic, required, gains, errors, depths = figure.subplots(2, 3).flat
    _draw_light(light, found)
    _draw_characteristic(characteristic, found)
    _draw_required(required, found)
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
        f"{attributes['scene']}, receiver {attributes['receiver']}: detection in {noise}, "
        f"{100 * attributes['confidence']:g} % confidence intervals"
    )
    return drawing.save(figure, path)


def _draw_light(ax: Axes, found: xr.Dataset) -> None:
    time = found["time"].values
    middle = float(time[np.argmax(found["difference"].values.sum(axis=0))])
    shown = found.isel(time=np.abs(time - middle) <= 4 * found.attrs["pulse_fwhm_ns"])
    draw_against_background(ax, shown, "difference")
    ax.axhline(0, color="0.6", linewidth=0.8)
    ax.legend(frameon=False, fontsize="small")
    ax.set_xlim(shown["time"].values[0], shown["time"].values[-1])
    _label(ax, "signal of the target, and background", "time (ns)", "power (µW)")


def _draw_characteristic(ax: Axes, found: xr.Dataset) -> None:
    """Draw closed forms as lines, and simulated shots at a few thresholds with the intervals of both rates."""
    for name, one in _combinations(found):
        ax.plot(one["false_alarm"], one["expected_detection"], color=_COLOURS[name], linewidth=1.3, label=_LABELS[name])
        few = one.sel(false_alarm=[found.attrs["pfa"], *np.logspace(-3, -1, 5)], method="nearest")
        x, y = few["drawn_false_alarm"], few["drawn_detection"]
        bars = [[rate - few[f"{rate.name}_low"], few[f"{rate.name}_high"] - rate] for rate in (x, y)]
        ax.errorbar(x, y, bars[1], bars[0], fmt="o", color=_COLOURS[name], markersize=2.5, linewidth=0.9)
    ax.axvline(found.attrs["pfa"], color="0.6", linewidth=0.8)
    ax.set_xscale("log")
    ax.set(xlim=(float(found["false_alarm"][0]), 0.9), ylim=(0, 1.02))
    ax.errorbar([], [], 1, 1, fmt="o", color="0.5", markersize=2.5, label=f"{found.attrs['shots']} simulated shots")
    share = 100 * found.attrs["drawn_share"]
    _label(ax, f"at {share:.2g} % of the target's signal", "probability of false alarm", "probability of detection")


def _draw_required(ax: Axes, found: xr.Dataset) -> None:
    kinds = {"needed_target": "of the\ntarget's signal", "needed_energy": "of the\npulse energy"}
    _draw_groups(ax, found, kinds, 100, bars=False)
    ax.set_yscale("log")
    title = f"required for $P_d$ = {found.attrs['pd']:g} at $P_{{fa}}$ = {found.attrs['pfa']:g}"
    _label(ax, title, "", "share (%)")


def _draw_errors(ax: Axes, found: xr.Dataset) -> None:
    _draw_groups(ax, found, {"depth_spread": "standard\ndeviation", "depth_bias": "bias"}, 1e3)
    ax.axhline(0, color="0.6", linewidth=0.8)
    _label(ax, "depth from the echo at the full signal", "", "error (mm)")


def _draw_gains(ax: Axes, found: xr.Dataset) -> None:
    kinds = {
        "gain_target": "target's\nsignal",
        "gain_energy": "pulse\nenergy",
        "depth_gain": "standard dev.\nof the depth",
    }
    _draw_groups(ax, found, kinds)
    ax.axhline(1, color="0.6", linewidth=0.8)
    # A very wide interval must not hide the others.
    largest = max(float(found[kind].where(np.isfinite(found[kind])).max()) for kind in kinds)
    ax.set_ylim(0, min(ax.get_ylim()[1], 2 * max(largest, 1)))
    _label(ax, "gain over one pixel for all light", "", "factor")


def _draw_depths(ax: Axes, found: xr.Dataset) -> None:
    for name, one in _combinations(found):
        share, low, high = (100 * one[f"needed_at_depth{end}"].values for end in ("", "_low", "_high"))
        bars = np.maximum([share - low, high - share], 0)
        ax.errorbar(one["depth"], share, yerr=bars, color=_COLOURS[name], marker="o", markersize=3, linewidth=1.3)
        reached = float(one["detectable_depth"])
        if np.isfinite(reached):
            ax.plot([reached], [100], color=_COLOURS[name], marker="v", markersize=8, zorder=3)
    ax.axhline(100, color="0.6", linewidth=0.8)
    ax.set_yscale("log")
    _label(ax, "detectable below 100 %", "depth of the target (m)", "required share of its signal (%)")


def _draw_groups(ax: Axes, found: xr.Dataset, kinds: dict[str, str], scale: float = 1.0, bars: bool = True) -> None:
    """Draw a group of bars or points with confidence intervals for each kind, one for each combination; skip inf."""
    largest = max(float(np.nanmax(np.where(np.isfinite(found[kind]), np.abs(found[kind]), 0))) for kind in kinds)
    for place, (name, one) in enumerate(_combinations(found)):
        for group, kind in enumerate(kinds):
            value, low, high = (scale * float(one[kind + end]) for end in ("", "_low", "_high"))
            if not np.isfinite([value, low, high]).all():
                continue
            x = group + 0.2 * (place - 1.5)
            interval = [[max(value - low, 0)], [max(high - value, 0)]]
            style: dict[str, Any] = {"color": _COLOURS[name], "ecolor": "black", "capsize": 2, "linewidth": 0.9}
            if bars:
                ax.bar(x, value, 0.18, color=_COLOURS[name])
            ax.errorbar(x, value, interval, fmt="none" if bars else "o", **style)
            if not bars or abs(value) > 0.05 * scale * largest:
                text = f"{value:.2g}" if value < 1 else f"{value:.3g}"
                ax.annotate(text, (x, high), (0, 3), textcoords="offset points", ha="center", fontsize=7)
    ax.set_xticks(range(len(kinds)), list(kinds.values()))
    ax.margins(x=0.08, y=0.12)


def _combinations(found: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    return [(str(name), found.sel(combination=name)) for name in found["combination"].values]


def _label(ax: Axes, title: str, x: str, y: str) -> None:
    ax.set_title(title, fontsize="medium")
    ax.set(xlabel=x, ylabel=y)
    drawing.add_grid(ax)
