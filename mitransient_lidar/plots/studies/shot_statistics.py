"""Figure of echoes against the slopes of the sea."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mitransient_lidar.plots import drawing
from mitransient_lidar.studies.shot_statistics import depth_bias, slope_correlations, slope_effects

_LABELS = {
    "strength": "surface echo (log10 W)",
    "separation": "far pair after near pair (ns)",
    "sideways": "green after red (ns)",
    "depth": "bottom too deep (m)",
}


def plot_shot_statistics(shots: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the strength, the times and the depths of echoes against the slopes that the beam meets.

    `shots` is a result of `studies.shot_statistics.shot_statistics`; a receiver without 2x2 pixels raises `UserError`.
    """
    figure = drawing.new_figure(path, 9.6, 7.0)
    effects, correlations = slope_effects(shots), slope_correlations(shots)
    for ax, (name, (slope, value)) in zip(figure.subplots(2, 2).flat, effects.items(), strict=True):
        ax.plot(np.degrees(np.arctan(slope)), value, ".", color="#1f5fd6", markersize=4)
        ax.set_xlabel("mean rise to the left (deg)" if name == "sideways" else "mean slope towards the lidar (deg)")
        ax.set_ylabel(_LABELS[name])
        ax.set_title(f"correlation {correlations[name]:+.2f}, {np.isfinite(value).sum()} shots", fontsize="small")
        drawing.add_grid(ax)
        if name == "depth":
            slopes = np.linspace(slope.min(), slope.max(), 100)
            names = ("scene.bottom_depth", "off_nadir_deg", "refractive_index")
            depth, off_nadir_deg, index = (float(shots.attrs[attribute]) for attribute in names)
            bias = depth_bias(slopes, depth, math.radians(off_nadir_deg), index)
            ax.plot(np.degrees(np.arctan(slopes)), bias, color="#d81e1e", label="refraction alone")
            ax.legend(frameon=False)
    figure.suptitle(drawing.titled(shots.attrs, f"{shots.sizes['shot']} shots"))
    return drawing.save(figure, path)
