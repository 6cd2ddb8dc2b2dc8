"""Figures for a target's signal, its change with target position, and its detection."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.drawing import finish

_DASHES = (0, (4, 2))
_EVERY: dict[str, Any] = {"markevery": 0.1, "markersize": 4}


def plot_target_signal(result: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the power in every pixel with and without the target, and the target's signal alone; or a map.

    `result` comes from `studies.target_signal.target_signal`.
    """
    if "target_x" in result.dims:
        return plot_target_map(result, path)
    figure = drawing.new_figure(path, 9.6, 7.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = result["time"].values
    draw_against_background(upper, result, "waveform")
    for i, mark in enumerate(palette.marked(result.sizes["pixel"])):
        signal, error = (1e6 * result[name].values[i] for name in ("difference", "difference_stderr"))
        drawing.draw_band(lower, time, signal, error, linewidth=1.4, **_EVERY, **mark)
    top = float(1e6 * result["waveform"].max())
    upper.legend(frameon=False, fontsize="small", ncols=2)
    finish(upper, yscale="log", ylim=(1e-4 * top, 2 * top), ylabel="received power (µW)")
    limits = time[0], time[-1]
    finish(lower, zero=0, xlim=limits, xlabel=drawing.TIME_LABEL, ylabel="signal of the target (µW)")
    for ax in (upper, lower):
        ax.axvspan(result.attrs["gate_start_ns"], result.attrs["gate_end_ns"], color="0.93", zorder=0)
    snr = result["combined_detectability"].values
    upper.set_title(drawing.titled(result.attrs, f"best weighting: {snr[1] / snr[0]:.2f} times the SNR of the sum"))
    return drawing.save(figure, path)


def draw_against_background(ax: Axes, result: xr.Dataset, name: str) -> None:
    """Draw every pixel's variable [W] as a line, and its background, the power without the target, dashed."""
    time, names = result["time"].values, [str(name) for name in result["pixel"].values]
    for i, (pixel, mark) in enumerate(zip(names, palette.marked(len(names)), strict=True)):
        ax.plot(time, 1e6 * result[name].values[i], linewidth=1.4, label=pixel, **_EVERY, **mark)
        background = 1e6 * result["background"].values[i]
        ax.plot(time, background, linewidth=0.9, linestyle=_DASHES, **_EVERY, **mark)
    ax.plot([], [], color="0.4", linewidth=0.9, linestyle=_DASHES, label="without the target")


def plot_target_map(maps: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw each pixel's echo share, and the gain in SNR, against the target's position, seen from above.

    `maps` is a result of `studies.target_signal.target_map`.
    """
    names = [str(name) for name in maps["pixel"].values]
    figure = drawing.new_figure(path, 2.7 * (len(names) + 1), 3.0)
    x, y = maps["target_x"].values, maps["target_y"].values
    snr = maps["combined_detectability"]
    share = 100 * maps["echo"] / maps["combined_echo"].sel(combination="sum")
    share = share.transpose("pixel", "target_x", "target_y")
    ratio = snr.sel(combination="best") / snr.sel(combination="sum")
    gain = ratio.transpose("target_x", "target_y").values
    panels = [(f"{name} (%)", share.values[i], 0.0, 100.0, ".0f") for i, name in enumerate(names)]
    panels.append(("SNR, best / sum", gain, 1.0, float(np.nanmax(gain)), ".2f"))
    steps = [np.diff(axis).mean() / 2 if len(axis) > 1 else 0.5 for axis in (y, x)]
    extent = (y[0] - steps[0], y[-1] + steps[0], x[0] - steps[1], x[-1] + steps[1])
    for ax, (title, values, low, high, digits) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        image = ax.imshow(values, origin="lower", extent=extent, vmin=low, vmax=high, cmap=palette.SEQUENCE)
        for (i, j), value in np.ndenumerate(values):
            colour = "black" if value > low + 0.6 * (high - low) else "white"
            ax.text(y[j], x[i], f"{value:{digits}}", ha="center", va="center", size=7, color=colour)
        ax.set_title(title, fontsize="small")
        # Seen from above with +x up, +y is on the left, as in a picture taken from the lidar.
        ax.set(xlabel="target_y (m)", ylabel="target_x (m), +x up", xlim=(max(extent[:2]), min(extent[:2])))
        figure.colorbar(image, ax=ax, shrink=0.7)
    figure.suptitle(drawing.titled(maps.attrs, "share of the echo in each pixel against the place of the target"))
    return drawing.save(figure, path)


_STYLES = dict(zip(("best", "brightest", "sum", "single"), palette.marked(4), strict=True))
_LABELS = {
    "single": "one pixel for all light",
    "sum": "sum of the pixels",
    "brightest": "brightest pixel alone",
    "best": "best weighting",
}

#: Bar groups, by their variables.
_REQUIRED = {"needed_target": "of the\ntarget's signal", "needed_energy": "of the\npulse energy"}
_ERRORS = {"depth_spread": "standard\ndeviation", "depth_bias": "bias"}
_GAINS = {
    "gain_target": "target's\nsignal",
    "gain_energy": "pulse\nenergy",
    "depth_gain": "standard dev.\nof the depth",
}


def plot_detection(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the signals, the operating characteristics, the signal required for detection, and the depth error.

    `found` is a result of `studies.detection.detect`. For gates: the gates in which the target is brightest and darkest
    against the noise, the weights in their sum, and the detection with frames and single gates. Without a receiver: the
    target's signal.
    """
    if "detection" not in found:
        return plot_target_signal(found, path)
    if "gate" in found.dims:
        return _plot_image_detection(found, path)
    figure = drawing.new_figure(path, 12.5, 7.6)
    light, characteristic, required, gains, errors, depths = figure.subplots(2, 3).flat
    _draw_light(light, found)
    _draw_characteristic(characteristic, found)
    _draw_groups(required, found, _REQUIRED, 100, bars=False)
    title = f"required for $P_d$ = {found.attrs['pd']:g} at $P_{{fa}}$ = {found.attrs['pfa']:g}"
    finish(required, title, yscale="log", ylabel="share (%)")
    _draw_groups(errors, found, _ERRORS, 1e3)
    finish(errors, "depth from the echo at the full signal", zero=0, ylabel="error (mm)")
    _draw_groups(gains, found, _GAINS)
    finish(gains, "gain over one pixel for all light", zero=1, ylabel="factor")
    # A very wide interval must not hide the others.
    largest = max(float(found[kind].where(np.isfinite(found[kind])).max()) for kind in _GAINS)
    gains.set_ylim(0, min(gains.get_ylim()[1], 2 * max(largest, 1)))
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


def _plot_image_detection(found: xr.Dataset, path: drawing.FilePath | None) -> Figure:
    """Draw the detection in gates."""
    figure = drawing.new_figure(path, 12.5, 7.6)
    axes, ratio = list(figure.subplots(2, 3).flat), found["contrast_to_noise"]
    best = [int(ratio[place]["gate"]) for place in (ratio.argmax(ratio.dims), ratio.argmin(ratio.dims))]
    shown = [(gate, "contrast_to_noise", "contrast-to-noise ratio of a frame") for gate in best]
    for ax, (gate, name, label) in zip(axes, [*shown, (best[0], "filter_weight", "weight (1/DN)")], strict=False):
        values, depth = found[name].sel(gate=gate), float(found["gate_depth"].sel(gate=gate))
        reach = float(np.abs(found[name]).max()) or 1.0
        style: dict[str, Any] = {"cmap": palette.SIGNED, "vmin": -reach, "vmax": reach}
        if "row" in found.dims:
            image = drawing.draw_image(ax, values.transpose("row", "column").values, found, **style)
            figure.colorbar(image, ax=ax, label=label, shrink=0.8)
        else:
            ax.bar([str(pixel) for pixel in found["pixel"].values], values)
            ax.set_ylabel(label)
        ax.set_title(f"gate {gate}, {depth:.2f} m", fontsize="medium")
    frames, single, depths, pd = *axes[3:], found.attrs["pd"]
    rates = {"": found} | {f" at {depth:g} m": found.sel(depth=depth) for depth in found.get("depth", xr.DataArray([]))}
    for name, one in rates.items():
        value, low, high = (one[f"detection{'_at_depth' if name else ''}{end}"].values for end in ("", "_low", "_high"))
        line: dict[str, Any] = {"label": f"target{name}", "marker": ".", "linewidth": 1.3}
        drawing.draw_band(frames, found["frames"].values, value, np.array([value - low, high - value]), **line)
    finish(frames, "all gates", zero=pd, xscale="log", ylim=(0, 1.02), xlabel="frames of each gate", ylabel="$P_d$")
    frames.legend(frameon=False, fontsize="small")
    width = float(found["gate_width"][0])
    for count in found["adjoining"].values:
        rate = found["gate_detection"].sel(adjoining=count).values
        single.plot(found["gate_start"], rate, marker=".", linewidth=1.3, label=f"{count * width:.3g} ns")
    of_frames = f"{found.attrs['frames']} frame{'s' * (found.attrs['frames'] > 1)}"
    finish(
        single, f"a single gate, {of_frames}", zero=pd, ylim=(0, 1.02), xlabel="start of the gate (ns)", ylabel="$P_d$"
    )
    single.legend(title="width", frameon=False, fontsize="small")
    if "depth" in found.dims:
        value, low, high = (found[f"frames_needed_at_depth{end}"].values for end in ("", "_low", "_high"))
        seen = np.isfinite(value)
        bars = [(value - low)[seen], np.where(np.isfinite(high), high - value, 0)[seen]]
        depths.errorbar(found["depth"].values[seen], value[seen], bars, marker="o", linewidth=1.3)
        finish(depths, f"for $P_d$ = {pd:g}", yscale="log", xlabel="depth of the target (m)", ylabel="frames needed")
    else:
        depths.axis("off")
    figure.suptitle(
        drawing.titled(found.attrs, f"receiver {found.attrs['receiver']}, $P_{{fa}}$ = {found.attrs['pfa']:g}")
    )
    return drawing.save(figure, path)


def _draw_light(ax: Axes, found: xr.Dataset) -> None:
    time = found["time"].values
    middle = float(time[np.argmax(found["difference"].values.sum(axis=0))])
    shown = found.isel(time=np.abs(time - middle) <= 4 * found.attrs["pulse_fwhm_ns"])
    draw_against_background(ax, shown, "difference")
    ax.legend(frameon=False, fontsize="small")
    labels: dict[str, Any] = {"xlabel": "time (ns)", "ylabel": "power (µW)"}
    finish(ax, "signal of the target, and background", zero=0, xlim=shown["time"].values[[0, -1]], **labels)


def _draw_characteristic(ax: Axes, found: xr.Dataset) -> None:
    """Draw closed forms as lines, and simulated shots at a few thresholds with both rates' intervals."""
    for name, one in _combinations(found):
        ax.plot(one["false_alarm"], one["expected_detection"], color=_STYLES[name]["color"], linewidth=1.3)
        few = one.sel(false_alarm=[found.attrs["pfa"], *np.logspace(-3, -1, 5)], method="nearest")
        x, y = few["drawn_false_alarm"], few["drawn_detection"]
        bars = [[rate - few[f"{rate.name}_low"], few[f"{rate.name}_high"] - rate] for rate in (x, y)]
        style: dict[str, Any] = {"linestyle": "none", "markersize": 4, "elinewidth": 0.9, "label": _LABELS[name]}
        ax.errorbar(x, y, bars[1], bars[0], **style, **_STYLES[name])
    ax.axvline(found.attrs["pfa"], color="0.6", linewidth=0.8)
    ax.set(xscale="log", xlim=(float(found["false_alarm"][0]), 0.9), ylim=(0, 1.02))
    ax.errorbar([], [], 1, 1, fmt="o", color="0.5", markersize=2.5, label=f"{found.attrs['shots']} simulated shots")
    labels: dict[str, Any] = {"xlabel": "probability of false alarm", "ylabel": "probability of detection"}
    finish(ax, f"at {100 * found.attrs['drawn_share']:.2g} % of the target's signal", **labels)


def _draw_depths(ax: Axes, found: xr.Dataset) -> None:
    for name, one in _combinations(found):
        share, low, high = (100 * one[f"needed_at_depth{end}"].values for end in ("", "_low", "_high"))
        bars = np.maximum([share - low, high - share], 0)
        ax.errorbar(one["depth"], share, yerr=bars, markersize=4, linewidth=1.3, **_STYLES[name])
        reached = float(one["detectable_depth"])
        if np.isfinite(reached):
            ax.plot([reached], [100], color=_STYLES[name]["color"], marker="|", markersize=14, zorder=3)
    labels: dict[str, Any] = {"xlabel": "depth of the target (m)", "ylabel": "required share of its signal (%)"}
    finish(ax, "detectable below 100 %", zero=100, yscale="log", **labels)


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
            style: dict[str, Any] = {"ecolor": "black", "capsize": 2, "linewidth": 0.9, **_STYLES[name]}
            if bars:
                ax.bar(x, value, 0.18, color=_STYLES[name]["color"])
            ax.errorbar(x, value, interval, linestyle="none", markersize=5, **style)
            if not bars or abs(value) > 0.05 * scale * largest:
                text = f"{value:.2g}" if value < 1 else f"{value:.3g}"
                ax.annotate(text, (x, high), (0, 3), textcoords="offset points", ha="center", fontsize=7)
    ax.set_xticks(range(len(kinds)), list(kinds.values()))
    ax.margins(x=0.08, y=0.12)


def _combinations(found: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    return [(str(name), found.sel(combination=name)) for name in found["combination"].values]
