"""Drawings of estimates against the truth."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.plotting import check_format
from mitransient_lidar.results import replacing

_COLOURS = {"along": "#1f5fd6", "across": "#d8821e"}
_NAMES = {"along": "towards the lidar", "across": "to the left"}


def plot_slopes(receivers: Mapping[str, xr.Dataset], path: str | os.PathLike[str]) -> dict[str, dict[str, float]]:
    """Draw estimated slopes against true ones, one panel a receiver.

    Parameters
    ----------
    receivers
        By the receiver's name, what `estimates.surface_slopes` returned, with ``true_slope_along`` and
        ``true_slope_across`` [1] over ``shot``.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Returns
    -------
    dict
        For each receiver and each slope that its pixels tell, as ``2x2 along``: `slope_statistics`.

    Raises
    ------
    UserError
        When there is no receiver, or the file cannot be written.

    Examples
    --------
    ``docs/slope.png``, in about five minutes on two cores::

        found = {}
        for layout in ("2x2", "1x4"):
            sea = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15, "layout": layout}
            shots = shot_series.render_shots("fig09_2x2", sea, count=200)
            slopes = estimates.surface_slopes(shots, slope_deviation=shots.attrs["slope_deviation"])
            found[layout] = slopes.merge(shots[["true_slope_along", "true_slope_across"]])
        plot_slopes(found, "slope.png")
    """
    from matplotlib.figure import Figure

    check_format(Path(path))
    if not receivers:
        raise UserError("receivers = {} must hold at least one")
    figure = Figure(figsize=(4.6 * len(receivers), 4.8), layout="constrained")
    axes = figure.subplots(1, len(receivers), sharex=True, sharey=True, squeeze=False)[0]
    told = {}
    for ax, (name, found) in zip(axes, receivers.items(), strict=True):
        for direction, colour in _COLOURS.items():
            truth, guess = (found[f"{kind}slope_{direction}"].values for kind in ("true_", ""))
            if np.count_nonzero(np.isfinite(guess)) < 4 or np.ptp(guess[np.isfinite(guess)]) == 0:
                continue
            one = slope_statistics(truth, guess)
            told[f"{name} {direction}"] = one
            label = f"{_NAMES[direction]}: r = {one['correlation']:.2f}, bias {one['bias_deg']:+.1f}°, "
            label += f"RMS {one['rms_deg']:.1f}°"
            degrees = (np.degrees(np.arctan(values)) for values in (truth, guess))
            ax.plot(*degrees, ".", color=colour, markersize=4, label=label)
        ax.axline((0, 0), slope=1, color="0.5", linewidth=0.9)
        ax.set_title(f"{name}, {found.sizes['shot']} shots", fontsize="medium")
        ax.set_xlabel("true mean slope over the footprint (deg)")
        ax.set_aspect("equal")
        ax.grid(True, color="0.9", linewidth=0.7)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False, fontsize="small", handletextpad=0.2)
    axes[0].set_ylabel("slope from one shot's surface echoes (deg)")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)
    return told


def slope_statistics(truth: np.ndarray, guess: np.ndarray) -> dict[str, float]:
    """Compare slopes [1] over shots, leaving out unknown ones.

    Returns
    -------
    dict
        ``correlation`` with the ends ``low`` and ``high`` of its 95 % interval (Fisher's z), ``bias_deg``, ``rms_deg``
        and ``median_deg`` of the errors [degree], and ``shots``.
    """
    known = np.isfinite(truth) & np.isfinite(guess)
    count = int(np.count_nonzero(known))
    if count < 4:
        raise UserError(f"slopes of {count} shots are known and must be at least 4 to be compared")
    correlation = float(np.corrcoef(truth[known], guess[known])[0, 1])
    z, width = math.atanh(correlation), 1.96 / math.sqrt(count - 3)
    error = np.degrees(np.arctan(guess[known]) - np.arctan(truth[known]))
    return {
        "correlation": correlation,
        "low": math.tanh(z - width),
        "high": math.tanh(z + width),
        "bias_deg": float(error.mean()),
        "rms_deg": float(np.sqrt(np.mean(error**2))),
        "median_deg": float(np.median(np.abs(error))),
        "shots": float(count),
    }
