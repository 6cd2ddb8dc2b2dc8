"""Figures for light in the water: spread at depth, attenuation against field of view, and scattering orders."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from mitransient_lidar.physics.lidar.axis_limits import system_attenuation
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.drawing import finish

_SMALLEST_SHARE = 3e-3  #: Light share at which a panel's horizontal axis begins.

#: Panels: variable, its coordinate, label of that axis, and title.
_PANELS = (
    ("within_radius", "radius", "distance from the centroid (m)", "total spread: beam, waves and scattering"),
    ("within_shift", "radius", "horizontal shift (m)", "spread by scattering alone"),
    ("within_delay", "delay", "delay (ns)", "delay by scattering"),
)


def plot_scattering(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw a result of `studies.light_classes.scattering`."""
    if "depth" in found.dims:
        return plot_beam_spread(found, path)
    return plot_fov_sweep(found, path) if "field_of_view" in found.dims else plot_scattering_orders(found, path)


def plot_beam_spread(spread: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the light share at each depth within a radius, a horizontal shift and a delay.

    Dots are the radii that contain 50 and 90 % of the light. `spread` is a result of `studies.beam_spread.beam_spread`.
    """
    figure = drawing.new_figure(path, 12.4, 4.4)
    axes = figure.subplots(1, 3, sharey=True)
    depths = spread["depth"].values
    styles = palette.curves(len(depths), palette.ordered(len(depths))[::-1])
    for ax, (name, coordinate, label, title) in zip(axes, _PANELS, strict=True):
        values = spread[coordinate].values
        for rank, style in enumerate(styles):
            row = spread.isel(depth=rank)
            drawing.draw_band(ax, values, row[name].values, row[f"{name}_stderr"].values, linewidth=1.5, **style)
            if name == "within_radius":
                ax.plot([row["radius_50"], row["radius_90"]], [0.5, 0.9], "o", color=style["color"], markersize=4)
        first = max(int(np.argmax(spread[name].values.max(axis=0, initial=0) > _SMALLEST_SHARE)) - 1, 0)
        ax.set(xscale="log", xlim=(values[first], values[-1]), ylim=(0, 1.02), xlabel=label)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_title(title, fontsize="medium", color="0.25")
        drawing.add_grid(ax, hide=("top", "right"))
    axes[0].set_ylabel("share of the light at the depth")
    _add_legend(axes[0], spread, styles)
    figure.suptitle(f"{spread.attrs.get('scene', '')}  ·  spread of the light at depth", fontsize="large")
    return drawing.save(figure, path)


def _add_legend(ax: Axes, spread: xr.Dataset, styles: list[dict[str, Any]]) -> None:
    """List the depths with their light share in the field of view."""
    handles = []
    for depth, in_view, style in zip(spread["depth"].values, spread["in_view"].values, styles, strict=True):
        text = f"{100 * in_view:.3g} % in view" if np.isfinite(in_view) else "no light"
        handles.append(Line2D([], [], linewidth=2, label=f"{depth:.4g} m: {text}", **style))
    ax.legend(handles=handles, loc="upper left", frameon=False, fontsize="small", handlelength=3)


def plot_fov_sweep(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the attenuations in `studies.light_classes.fov_sweep` against the spot radius in the field of view."""
    figure = drawing.new_figure(path, 7.2, 4.8)
    attributes = found.attrs
    names = ("attenuation", "kd", "a_plus_bb", "absorption", "beam_radius")
    c, kd, a_plus_bb, a, beam = (float(attributes[name]) for name in names)
    scaled = found["scaled_radius"].values
    low, high = 0.6 * scaled.min(), 1.7 * scaled.max()
    ax = figure.subplots()
    limits = {
        "c": (c, palette.BLACK, "-"),
        "Kd": (kd, palette.RED, "-."),
        "a + bb": (a_plus_bb, palette.GREEN, "--"),
        "a": (a, palette.GREEN, ":"),
    }
    for label, (value, colour, style) in limits.items():
        ax.axhline(value, color=colour, linestyle=style, linewidth=1.2, label=f"{label} = {value:.3f} /m")
    line = np.geomspace(low, high, 200)
    fit = system_attenuation(c, min(kd, c), 2 * np.hypot(line / c, beam))
    ax.plot(line, fit, "--", color="0.45", linewidth=1.3, label="Kd + (c - Kd) exp(-0.85 c D)")
    attenuation, error = (found[f"effective_attenuation{end}"].values for end in ("", "_stderr"))
    points: dict[str, Any] = {"fmt": "o-", "color": palette.BLUE, "markersize": 5, "linewidth": 1.3, "capsize": 3}
    ax.errorbar(scaled, attenuation, error, label="K of the column, ±1 standard error", **points)
    ax.set(xscale="log", xlim=(low, high))
    if low < c * beam < high:
        ax.axvline(c * beam, color="0.7", linestyle=":", linewidth=1.2)
        ax.text(c * beam, 0.02 * c, "  c R$_b$ of the beam", color="0.4", fontsize="small")
    text = "c R$_s$ (beam attenuation times radius of the spot in the field of view)"
    finish(ax, ylim=(0, None), xlabel=text, ylabel="attenuation coefficient (1/m)")
    top = drawing.add_top_axis(ax, 0.0, found["field_of_view"].values[0] / scaled[0], "field of view (mrad)")
    for axis in (ax.xaxis, top):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    ax.legend(frameon=False, fontsize="small")
    depths = f"{attributes['min_depth']:g} to {attributes['max_depth']:g} m"
    text = f"slope of the column signal from {depths}, b/c = {(c - a) / c:.2g}"
    figure.suptitle(drawing.titled(attributes, text))
    return drawing.save(figure, path)


def plot_scattering_orders(result: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw power by scattering order, and the share of light with several reversals, summed over the pixels.

    `result` comes from `studies.light_classes.scattering_orders`.
    """
    figure = drawing.new_figure(path, 9.0, 6.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    time = result["time"].values
    by_order = result["waveform"].sum(("pixel", "reversals")).values
    total = by_order.sum(axis=0)
    several = result["waveform"].sel(reversals="several").sum(("pixel", "order")).values
    styles = palette.curves(len(by_order), palette.ordered(len(by_order)))
    upper.plot(time, total, color="black", linewidth=1.6, label="all")
    for order, (power, style) in enumerate(zip(by_order, styles, strict=True)):
        label = f"≥ {order}" if order == len(by_order) - 1 else str(order)
        upper.plot(time, power, linewidth=1.1, label=label, **style)
    finish(upper, yscale="log", ylim=(1e-5 * total.max(), 2 * total.max()), ylabel="received power (W)")
    upper.legend(title="scattering events", frameon=False, ncols=2, fontsize="small")
    lit = total > 1e-5 * total.max()
    lower.plot(time[lit], 100 * several[lit] / total[lit], color=palette.RED, linewidth=1.2)
    finish(lower, xlabel=drawing.TIME_LABEL, ylabel="several\nreversals (%)", ylim=(0, None))
    upper.set_title(str(result.attrs.get("scene", "")))
    return drawing.save(figure, path)
