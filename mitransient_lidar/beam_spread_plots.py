"""Figures of how far light has spread at depth."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.special import gammainc

from mitransient_lidar.optics.beam_spread import BeamSpread
from mitransient_lidar.optics.checks import FloatArray
from mitransient_lidar.plotting import check_format
from mitransient_lidar.results import replacing

_DEPTHS: Any = matplotlib.colormaps["viridis_r"]

#: Share of the light at which a panel begins.
_SMALLEST_SHARE = 3e-3

#: Axes of the panels: the variable, its axis, the axis's label, and the title.
_PANELS = (
    ("within_radius", "radius", "distance from the centroid (m)", "all spread: beam, waves and scattering"),
    ("within_shift", "radius", "horizontal shift (m)", "spread by scattering alone"),
    ("within_delay", "delay", "delay (ns)", "delay by scattering"),
)


def plot_beam_spread(spread: xr.Dataset, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw how much of the light at each depth lies within a radius, and within a delay.

    Where the water above is uniform and scatters forwards, the closed form of McLean, Freeman and Walker (1998) is
    drawn dashed, for the slant way to the depth. Dots are the radii that hold 50 and 90 % of the light.

    Parameters
    ----------
    spread : xarray.Dataset
        A result of `mitransient_lidar.beam_spread.beam_spread`.
    path : path, optional
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Returns
    -------
    matplotlib.figure.Figure
        Independent of pyplot; needs no closing.

    Raises
    ------
    UserError
        If the suffix of `path` is another one, or the file cannot be written.
    """
    if path is not None:
        check_format(Path(path))
    figure = Figure(figsize=(12.4, 4.4), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    depths = spread["depth"].values
    colours = [_DEPTHS(0.18 + 0.82 * (rank + 1) / len(depths)) for rank in range(len(depths))]
    closed = [_closed_form(spread.attrs, float(depth)) for depth in depths]
    for ax, (name, axis, label, title) in zip(axes, _PANELS, strict=True):
        values = spread[axis].values
        for rank, colour in enumerate(colours):
            row = spread.isel(depth=rank)
            share, error = row[name].values, row[f"{name}_stderr"].values
            ax.plot(values, share, color=colour, linewidth=1.5)
            ax.fill_between(values, share - error, share + error, color=colour, alpha=0.25, linewidth=0)
            theory = closed[rank]
            if theory is not None and name != "within_radius":
                within = _within_shift(theory, values) if name == "within_shift" else _within_delay(theory, values)
                ax.plot(values, within, color=colour, linewidth=1.1, dashes=(4, 2.5))
            if name == "within_radius":
                ax.plot([row["radius_50"], row["radius_90"]], [0.5, 0.9], "o", color=colour, markersize=4)
        first = np.argmax(spread[name].values.max(axis=0, initial=0) > _SMALLEST_SHARE)
        _finish(ax, values[max(first - 1, 0) :], label, title)
    axes[0].set_ylabel("share of the light at the depth")
    _legend(axes[0], spread, colours)
    if any(theory is not None for theory in closed):
        dashed = Line2D([], [], color="0.35", linewidth=1.1, dashes=(4, 2.5), label="McLean et al. (1998)")
        axes[1].legend(handles=[dashed], loc="lower right", frameon=False, fontsize="small")
    figure.suptitle(f"{spread.attrs.get('scene', '')}  ·  spread of the light at depth", fontsize="large")
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=160)
    return figure


def _finish(ax: Axes, values: FloatArray, label: str, title: str) -> None:
    ax.set_xscale("log")
    ax.set(xlim=(values[0], values[-1]), ylim=(0, 1.02), xlabel=label)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_title(title, fontsize="medium", color="0.25")
    ax.grid(True, which="major", color="0.88", linewidth=0.7)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _legend(ax: Axes, spread: xr.Dataset, colours: list[Any]) -> None:
    """Tell the depths, with the share of their light that the receiver sees."""
    handles = []
    for depth, seen, colour in zip(spread["depth"].values, spread["in_view"].values, colours, strict=True):
        told = f": {100 * seen:.3g} % in view" if np.isfinite(seen) else ": no light"
        handles.append(Line2D([], [], color=colour, linewidth=2, label=f"{depth:.4g} m{told}"))
    ax.legend(handles=handles, loc="upper left", frameon=False, fontsize="small", handlelength=1.2)


def _closed_form(attributes: dict[str, Any], depth: float) -> BeamSpread | None:
    """Return the closed form along the slant way to a depth, None where the water above is not what it is for."""
    needed = ("uniform_down_to", "scattering", "absorption", "mean_cosine", "off_nadir_deg", "refractive_index")
    uniform, scattering, absorption, mean_cosine, off_nadir, index = (float(attributes[name]) for name in needed)
    if depth > uniform or scattering == 0 or not 0 <= mean_cosine < 1:
        return None
    slant = depth / np.sqrt(1 - (np.sin(np.radians(off_nadir)) / index) ** 2)
    return BeamSpread(slant, absorption, scattering, mean_cosine, float(attributes["group_index"]))


def _within_shift(theory: BeamSpread, radius: FloatArray) -> FloatArray:
    """Return the share of all light that comes within a radius of its unscattered ray."""
    return (theory.unscattered + theory.encircled(radius)) / (theory.unscattered + theory.transmittance)


def _within_delay(theory: BeamSpread, delay_ns: FloatArray) -> FloatArray:
    """Return the share of all light that comes within a delay: absorption on the detours thins a gamma density."""
    shape = theory.mean_delay**2 / theory.delay_variance
    rate = theory.mean_delay / theory.delay_variance + theory.absorption * theory.speed
    scattered = theory.transmittance * gammainc(shape, 1e-9 * rate * delay_ns)
    return np.asarray((theory.unscattered + scattered) / (theory.unscattered + theory.transmittance))
