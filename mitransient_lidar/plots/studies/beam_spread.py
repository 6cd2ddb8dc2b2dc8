"""Figure of the spread of the laser's light at depth."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mitransient_lidar.plots import drawing

_DEPTHS = matplotlib.colormaps["viridis_r"]

#: Share of the light at which the horizontal axis of a panel begins.
_SMALLEST_SHARE = 3e-3

#: Panels: variable, its coordinate, label of that axis, and title.
_PANELS = (
    ("within_radius", "radius", "distance from the centroid (m)", "total spread: beam, waves and scattering"),
    ("within_shift", "radius", "horizontal shift (m)", "spread by scattering alone"),
    ("within_delay", "delay", "delay (ns)", "delay by scattering"),
)


def plot_beam_spread(spread: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the share of the light at each depth within a radius, a horizontal shift and a delay.

    Dots are the radii that hold 50 and 90 % of the light. `spread` is a result of `studies.beam_spread.beam_spread`.
    """
    figure = drawing.new_figure(path, 12.4, 4.4)
    axes = figure.subplots(1, 3, sharey=True)
    depths = spread["depth"].values
    colours = [_DEPTHS(0.18 + 0.82 * (rank + 1) / len(depths)) for rank in range(len(depths))]
    for ax, (name, coordinate, label, title) in zip(axes, _PANELS, strict=True):
        values = spread[coordinate].values
        for rank, colour in enumerate(colours):
            row = spread.isel(depth=rank)
            drawing.draw_band(ax, values, row[name].values, row[f"{name}_stderr"].values, color=colour, linewidth=1.5)
            if name == "within_radius":
                ax.plot([row["radius_50"], row["radius_90"]], [0.5, 0.9], "o", color=colour, markersize=4)
        first = int(np.argmax(spread[name].values.max(axis=0, initial=0) > _SMALLEST_SHARE))
        ax.set_xscale("log")
        ax.set(xlim=(values[max(first - 1, 0)], values[-1]), ylim=(0, 1.02), xlabel=label)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_title(title, fontsize="medium", color="0.25")
        drawing.add_grid(ax, hide=("top", "right"))
    axes[0].set_ylabel("share of the light at the depth")
    _add_legend(axes[0], spread, colours)
    figure.suptitle(f"{spread.attrs.get('scene', '')}  ·  spread of the light at depth", fontsize="large")
    return drawing.save(figure, path)


def _add_legend(ax: Axes, spread: xr.Dataset, colours: list[Any]) -> None:
    """List the depths with the share of their light that is in the field of view."""
    handles = []
    for depth, in_view, colour in zip(spread["depth"].values, spread["in_view"].values, colours, strict=True):
        text = f"{100 * in_view:.3g} % in view" if np.isfinite(in_view) else "no light"
        handles.append(Line2D([], [], color=colour, linewidth=2, label=f"{depth:.4g} m: {text}"))
    ax.legend(handles=handles, loc="upper left", frameon=False, fontsize="small", handlelength=1.2)
