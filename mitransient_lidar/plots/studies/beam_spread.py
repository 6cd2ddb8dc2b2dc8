"""Figure of the spread of the laser's light at depth."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.special import gammainc

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.small_angle import BeamSpread
from mitransient_lidar.plots import drawing

_DEPTHS = matplotlib.colormaps["viridis_r"]
_CLOSED_FORM: dict[str, Any] = {"linewidth": 1.1, "dashes": (4, 2.5)}

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

    Where the water above is uniform and scatters forwards, the closed form of McLean, Freeman and Walker (1998) is
    drawn dashed, for the slant path to the depth. It takes all scattering for that by one Gaussian lobe of the mean
    cosine. Functions of sea water have most of their light nearer to the forward direction and the rest farther from
    it: more light stays near the axis than in the closed form, and tails are longer. The legends give the largest
    difference; `physics.lidar.small_angle.BeamSpread` gives the errors of the closed form. Dots are the radii that hold
    50 and 90 % of the light. `spread` is a result of `studies.beam_spread.beam_spread`.
    """
    figure = drawing.new_figure(path, 12.4, 4.4)
    axes = figure.subplots(1, 3, sharey=True)
    depths = spread["depth"].values
    colours = [_DEPTHS(0.18 + 0.82 * (rank + 1) / len(depths)) for rank in range(len(depths))]
    closed_forms = [_closed_form(spread.attrs, float(depth)) for depth in depths]
    for ax, (name, coordinate, label, title) in zip(axes, _PANELS, strict=True):
        values = spread[coordinate].values
        differences = []
        for rank, (colour, closed) in enumerate(zip(colours, closed_forms, strict=True)):
            row = spread.isel(depth=rank)
            drawing.draw_band(ax, values, row[name].values, row[f"{name}_stderr"].values, color=colour, linewidth=1.5)
            if name == "within_radius":
                ax.plot([row["radius_50"], row["radius_90"]], [0.5, 0.9], "o", color=colour, markersize=4)
            elif closed is not None:
                share = _within_shift if name == "within_shift" else _within_delay
                ax.plot(values, share(closed, values), color=colour, **_CLOSED_FORM)
                apart = np.abs(share(closed, values) - row[name].values)
                differences.append(float(np.max(apart, initial=0.0, where=np.isfinite(apart))))
        first = int(np.argmax(spread[name].values.max(axis=0, initial=0) > _SMALLEST_SHARE))
        ax.set_xscale("log")
        ax.set(xlim=(values[max(first - 1, 0)], values[-1]), ylim=(0, 1.02), xlabel=label)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_title(title, fontsize="medium", color="0.25")
        drawing.add_grid(ax, hide=("top", "right"))
        if differences:
            text = "McLean et al. (1998), one Gaussian\nlobe for all scattering: differs by up\n"
            text += f"to {max(differences):.2f}, see the documentation"
            dashed = Line2D([], [], color="0.35", label=text, **_CLOSED_FORM)
            ax.legend(handles=[dashed], loc="lower right", frameon=False, fontsize="small")
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


def _closed_form(attributes: dict[str, Any], depth: float) -> BeamSpread | None:
    """Return the closed form along the slant path to a depth, None where it does not hold for the water above."""
    needed = ("uniform_down_to", "scattering", "absorption", "mean_cosine", "off_nadir_deg", "refractive_index")
    uniform, scattering, absorption, mean_cosine, off_nadir, index = (float(attributes[name]) for name in needed)
    if depth > uniform or scattering == 0 or not 0 <= mean_cosine < 1:
        return None
    slant = depth / np.sqrt(1 - (np.sin(np.radians(off_nadir)) / index) ** 2)
    return BeamSpread(slant, absorption, scattering, mean_cosine, float(attributes["group_index"]))


def _within_shift(closed: BeamSpread, radius: FloatArray) -> FloatArray:
    """Return the share of all light that arrives within a radius of its unscattered ray."""
    return (closed.unscattered + closed.encircled(radius)) / (closed.unscattered + closed.transmittance)


def _within_delay(closed: BeamSpread, delay_ns: FloatArray) -> FloatArray:
    """Return the share of all light that arrives within a delay: a gamma density, with absorption along the detours."""
    shape = closed.mean_delay**2 / closed.delay_variance
    rate = closed.mean_delay / closed.delay_variance + closed.absorption * closed.speed
    scattered = closed.transmittance * gammainc(shape, 1e-9 * rate * delay_ns)
    return np.asarray((closed.unscattered + scattered) / (closed.unscattered + closed.transmittance))
