"""Figures of estimates from a series of shots against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mitransient_lidar.analysis.retrieval.retrieval_table import estimates, truth_statistics
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.plots import drawing

_COLOURS = {"along": "#1f5fd6", "across": "#d8821e"}
_NAMES = {"along": "towards the lidar", "across": "to the left"}


def plot_slopes(receivers: Mapping[str, xr.Dataset], path: drawing.FilePath | None = None) -> Figure:
    """Draw retrieved slopes against true ones, one panel for each receiver; the legends give `slope_statistics`.

    `receivers` holds, by the name of at least one receiver, results of `analysis.retrieval.retrieve.surface_slopes`
    with ``true_slope_along`` and ``true_slope_across`` [1] over ``shot``.

    Examples
    --------
    ``docs/images/slope.png``, in about eight minutes on two cores::

        found = {}
        for layout in ("2x2", "1x4"):
            sea = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15, "layout": layout}
            shots = shot_series.render_shots("fig09_2x2", sea, count=200, passes=2)
            found[layout] = retrieve.surface_slopes(shots)
        plot_slopes(found, "slope.png")
    """
    figure = drawing.new_figure(path, 4.6 * max(len(receivers), 1), 4.8)
    if not receivers:
        raise UserError("receivers = {} must hold at least one")
    axes = figure.subplots(1, len(receivers), sharex=True, sharey=True, squeeze=False)[0]
    for ax, (name, found) in zip(axes, receivers.items(), strict=True):
        for direction, colour in _COLOURS.items():
            truth, retrieved = (found[f"{kind}slope_{direction}"].values for kind in ("true_", ""))
            finite = retrieved[np.isfinite(retrieved)]
            if finite.size < 4 or np.ptp(finite) == 0:
                continue
            one = slope_statistics(truth, retrieved)
            label = f"{_NAMES[direction]}: r = {one['correlation']:.2f}, bias {one['bias_deg']:+.1f}°, "
            label += f"RMS {one['rms_deg']:.1f}°"
            degrees = (np.degrees(np.arctan(values)) for values in (truth, retrieved))
            ax.plot(*degrees, ".", color=colour, markersize=4, label=label)
        ax.axline((0, 0), slope=1, color="0.5", linewidth=0.9)
        ax.set_title(f"{name}, {found.sizes['shot']} shots", fontsize="medium")
        ax.set_xlabel("true mean slope over the footprint (deg)")
        ax.set_aspect("equal")
        drawing.add_grid(ax)
        ax.legend(loc="upper left", framealpha=0.9, fontsize="small", handletextpad=0.2)
    axes[0].set_ylabel("slope retrieved from one shot (deg)")
    return drawing.save(figure, path)


def plot_retrieval(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the estimates of a series of shots against the truth, with their standard errors if known.

    `found` is a result of `analysis.retrieval.retrieve.retrieve` for a series of `rendering.shots.series.render_shots`.

    Raises
    ------
    UserError
        If the shots have no truth.
    """
    figure = drawing.new_figure(path, 9.6, 9.0)
    shown = [(one, one.truth) for one in estimates(found) if one.truth is not None]
    if not shown:
        raise UserError("found has no truth: it must come from a series of shots with true slopes and depths")
    for ax, (one, truth) in zip(figure.subplots(2, 2).flat, shown, strict=False):
        varied = bool(np.any(truth != truth[0]))
        x, label = (truth, f"true {one.head}") if varied else (np.arange(len(truth)), "shot")
        ax.errorbar(x, one.values, one.errors, fmt=".", color=_COLOURS["along"], markersize=5, linewidth=0.7)
        middle = float(np.mean(truth[np.isfinite(truth)])) if np.isfinite(truth).any() else 0.0
        ax.axline((middle if varied else 0.0, middle), slope=float(varied), color="0.5", linewidth=0.9)
        ax.set(xlabel=label, ylabel=f"estimated {one.head}")
        ax.set_title(truth_statistics(one).partition(": ")[2].replace(", rms of", ",\nrms of"), fontsize="small")
        ax.locator_params(nbins=6)
        drawing.add_grid(ax)
    bars = Line2D([], [], color=_COLOURS["along"], marker=".", label="estimates, ±1 standard error")
    line = Line2D([], [], color="0.5", linewidth=0.9, label="truth")
    figure.legend(handles=[bars, line], loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(drawing.titled(found.attrs, f"{found.sizes['shot']} shots"))
    return drawing.save(figure, path)


def slope_statistics(truth: FloatArray, retrieved: FloatArray) -> dict[str, float]:
    """Compare slopes [1] over shots, leaving out NaN.

    Returns
    -------
    dict
        ``correlation`` with the ends ``low`` and ``high`` of its 95 % interval (Fisher's z), NaN if all slopes of one
        kind are equal, ``bias_deg``, ``rms_deg`` and ``median_deg`` of the errors [degree], and ``shots``.

    Raises
    ------
    UserError
        If fewer than 4 shots have both slopes.
    """
    known = np.isfinite(truth) & np.isfinite(retrieved)
    count = int(np.count_nonzero(known))
    if count < 4:
        raise UserError(f"slopes of {count} shots are known and must be at least 4 to be compared")
    with np.errstate(divide="ignore", invalid="ignore"):
        # The interval of a correlation of 1 or -1 is this point; that of equal slopes is not known.
        correlation = float(np.corrcoef(truth[known], retrieved[known])[0, 1])
        z, width = float(np.arctanh(correlation)), 1.96 / math.sqrt(count - 3)
    error = np.degrees(np.arctan(retrieved[known]) - np.arctan(truth[known]))
    return {
        "correlation": correlation,
        "low": math.tanh(z - width),
        "high": math.tanh(z + width),
        "bias_deg": float(error.mean()),
        "rms_deg": float(np.sqrt(np.mean(error**2))),
        "median_deg": float(np.median(np.abs(error))),
        "shots": float(count),
    }
