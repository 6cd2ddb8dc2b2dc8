"""Figure for estimates from a shot series against the truth."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mitransient_lidar.analysis.retrieval.retrieval_table import estimates, truth_statistics
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import drawing, palette


def plot_retrieval(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the estimates for a shot series against the truth, with their standard errors if known.

    `found` is a result of `analysis.retrieval.retrieve.retrieve` for a series from
    `rendering.shots.series.render_shots`.

    Raises UserError if the shots have no truth.
    """
    figure = drawing.new_figure(path, 9.6, 9.0)
    shown = [(one, one.truth) for one in estimates(found) if one.truth is not None]
    if not shown:
        raise UserError("found has no truth: it must come from a series of shots with true slopes and depths")
    for ax, (one, truth) in zip(figure.subplots(2, 2).flat, shown, strict=False):
        varied = bool(np.any(truth != truth[0]))
        x, label = (truth, f"true {one.head}") if varied else (np.arange(len(truth)), "shot")
        ax.errorbar(x, one.values, one.errors, fmt=".", color=palette.BLUE, markersize=5, linewidth=0.7)
        middle = float(np.mean(truth[np.isfinite(truth)])) if np.isfinite(truth).any() else 0.0
        ax.axline((middle if varied else 0.0, middle), slope=float(varied), color="0.5", linewidth=0.9)
        ax.set(xlabel=label, ylabel=f"estimated {one.head}")
        ax.set_title(truth_statistics(one).partition(": ")[2].replace(", rms of", ",\nrms of"), fontsize="small")
        ax.locator_params(nbins=6)
        drawing.add_grid(ax)
    bars = Line2D([], [], color=palette.BLUE, marker=".", label="estimates, ±1 standard error")
    line = Line2D([], [], color="0.5", linewidth=0.9, label="truth")
    figure.legend(handles=[bars, line], loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(drawing.titled(found.attrs, f"{found.sizes['shot']} shots"))
    return drawing.save(figure, path)
