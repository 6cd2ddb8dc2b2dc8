"""Drawings of a target's own signal, and of how it goes with the target's place."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.plotting import check_format, colours
from mitransient_lidar.results import replacing


def plot_target(result: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Draw every pixel's record with and without the target, and the target's own signal.

    Parameters
    ----------
    result
        What `target_signal.target_signal` returned.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    UserError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure

    check_format(Path(path))
    time = result["time"].values
    start, end = (float(result.attrs[f"gate_{name}_ns"]) for name in ("start", "end"))
    names = [str(name) for name in result["pixel"].values]
    figure = Figure(figsize=(9.6, 7.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for i, (name, colour) in enumerate(zip(names, colours(len(names)), strict=True)):
        one = result.isel(pixel=i)
        upper.plot(time, 1e6 * one["waveform"], color=colour, linewidth=1.4, label=name)
        upper.plot(time, 1e6 * one["background"], color=colour, linewidth=0.9, linestyle=(0, (4, 2)))
        own, error = 1e6 * one["difference"].values, 1e6 * one["difference_stderr"].values
        lower.plot(time, own, color=colour, linewidth=1.4)
        lower.fill_between(time, own - error, own + error, color=colour, alpha=0.2, linewidth=0)
    top = float(1e6 * result["waveform"].max())
    upper.set_yscale("log")
    upper.set_ylim(1e-4 * top, 2 * top)
    upper.plot([], [], color="0.4", linewidth=0.9, linestyle=(0, (4, 2)), label="without the target")
    upper.legend(frameon=False, fontsize="small", ncols=2)
    upper.set_ylabel("received power (\u00b5W)")
    lower.axhline(0, color="0.6", linewidth=0.8)
    lower.set_ylabel("the target's own (\u00b5W)")
    lower.set_xlabel("time since the pulse left the transmitter (ns)")
    lower.set_xlim(time[0], time[-1])
    for ax in (upper, lower):
        ax.axvspan(start, end, color="0.93", zorder=0)
        ax.grid(True, color="0.9", linewidth=0.7)
    snr = result["combined_detectability"].values
    gain = f"best weights give {snr[1] / snr[0]:.2f} times the SNR of the sum"
    upper.set_title(f"{result.attrs.get('scene', '')}: {gain}")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)


def plot_map(maps: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Draw how the pixels' shares of the echo, and their contrast, go with the target's place.

    Parameters
    ----------
    maps
        What `target_signal.target_map` returned.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    UserError
        When the file cannot be written.
    """
    from matplotlib.figure import Figure

    check_format(Path(path))
    names = [str(name) for name in maps["pixel"].values]
    x, y = maps["target_x"].values, maps["target_y"].values
    share = 100 * maps["echo"] / maps["combined_echo"].sel(combination="whole")
    share = share.transpose("pixel", "target_x", "target_y")
    gain = (
        maps["combined_detectability"].sel(combination="best") / maps["combined_detectability"].sel(combination="whole")
    ).transpose("target_x", "target_y")
    figure = Figure(figsize=(2.7 * (len(names) + 1), 3.0), layout="constrained")
    panels: list[tuple[str, Any, float, float]] = [
        (f"{name} (%)", share.values[i], 0, 100) for i, name in enumerate(names)
    ]
    panels.append(("SNR, best / sum", gain.values, 1.0, float(np.nanmax(gain))))
    steps = [np.diff(axis).mean() / 2 if len(axis) > 1 else 0.5 for axis in (y, x)]
    extent = (y[0] - steps[0], y[-1] + steps[0], x[0] - steps[1], x[-1] + steps[1])
    for ax, (title, values, low, high) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        image = ax.imshow(values, origin="lower", extent=extent, vmin=low, vmax=high, cmap="viridis")
        for i, place_x in enumerate(x):
            for j, place_y in enumerate(y):
                bright = values[i, j] > low + 0.6 * (high - low)
                text = f"{values[i, j]:.0f}" if high == 100 else f"{values[i, j]:.2f}"
                ax.text(place_y, place_x, text, ha="center", va="center", size=7, color="black" if bright else "white")
        ax.set_title(title, fontsize="small")
        ax.set_xlabel("target_y (m)")
        ax.set_ylabel("target_x (m)")
        figure.colorbar(image, ax=ax, shrink=0.7)
    figure.suptitle(f"{maps.attrs.get('scene', '')}: each pixel's share of the echo, by the target's place")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)
