"""Figures of the signal of a target, and of its change with the position of the target."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing

_DASHES = (0, (4, 2))


def plot_target_signal(result: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the power in every pixel with and without the target, and the signal of the target alone; or a map.

    `result` is that of `studies.target_signal.target_signal`.
    """
    if "target_x" in result.dims:
        return plot_target_map(result, path)
    figure = drawing.new_figure(path, 9.6, 7.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = result["time"].values
    draw_against_background(upper, result, "waveform")
    for i, colour in enumerate(drawing.pixel_colours(result.sizes["pixel"])):
        signal, error = (1e6 * result[name].values[i] for name in ("difference", "difference_stderr"))
        drawing.draw_band(lower, time, signal, error, color=colour, linewidth=1.4)
    top = float(1e6 * result["waveform"].max())
    upper.set_yscale("log")
    upper.set_ylim(1e-4 * top, 2 * top)
    upper.legend(frameon=False, fontsize="small", ncols=2)
    upper.set_ylabel("received power (µW)")
    lower.axhline(0, color="0.6", linewidth=0.8)
    lower.set(xlim=(time[0], time[-1]), xlabel=drawing.TIME_LABEL, ylabel="signal of the target (µW)")
    for ax in (upper, lower):
        ax.axvspan(result.attrs["gate_start_ns"], result.attrs["gate_end_ns"], color="0.93", zorder=0)
        drawing.add_grid(ax)
    snr = result["combined_detectability"].values
    upper.set_title(drawing.titled(result.attrs, f"best weighting: {snr[1] / snr[0]:.2f} times the SNR of the sum"))
    return drawing.save(figure, path)


def draw_against_background(ax: Axes, result: xr.Dataset, name: str) -> None:
    """Draw a variable [W] of every pixel as a line, and its background, the power without the target, dashed."""
    time, names = result["time"].values, [str(name) for name in result["pixel"].values]
    for i, (pixel, colour) in enumerate(zip(names, drawing.pixel_colours(len(names)), strict=True)):
        ax.plot(time, 1e6 * result[name].values[i], color=colour, linewidth=1.4, label=pixel)
        ax.plot(time, 1e6 * result["background"].values[i], color=colour, linewidth=0.9, linestyle=_DASHES)
    ax.plot([], [], color="0.4", linewidth=0.9, linestyle=_DASHES, label="without the target")


def plot_target_map(maps: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the share of the echo in each pixel, and the gain in SNR, against the target's position, seen from above.

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
        image = ax.imshow(values, origin="lower", extent=extent, vmin=low, vmax=high, cmap="viridis")
        for (i, j), value in np.ndenumerate(values):
            colour = "black" if value > low + 0.6 * (high - low) else "white"
            ax.text(y[j], x[i], f"{value:{digits}}", ha="center", va="center", size=7, color=colour)
        ax.set_title(title, fontsize="small")
        # Seen from above with +x up, +y is on the left, as in a picture taken from the lidar.
        ax.set(xlabel="target_y (m)", ylabel="target_x (m), +x up", xlim=(max(extent[:2]), min(extent[:2])))
        figure.colorbar(image, ax=ax, shrink=0.7)
    figure.suptitle(drawing.titled(maps.attrs, "share of the echo in each pixel against the place of the target"))
    return drawing.save(figure, path)
