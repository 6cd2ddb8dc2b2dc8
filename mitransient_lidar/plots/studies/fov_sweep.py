"""Figure of the effective attenuation against the field of view."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from mitransient_lidar.physics.lidar.system_attenuation import system_attenuation
from mitransient_lidar.plots import drawing


def plot_fov_sweep(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the attenuations of `studies.fov_sweep.fov_sweep` against the radius of the spot in the field of view."""
    figure = drawing.new_figure(path, 7.2, 4.8)
    attributes = found.attrs
    names = ("attenuation", "kd", "a_plus_bb", "absorption", "beam_radius")
    c, kd, a_plus_bb, a, beam = (float(attributes[name]) for name in names)
    scaled = found["scaled_radius"].values
    low, high = 0.6 * scaled.min(), 1.7 * scaled.max()
    ax = figure.subplots()
    limits = {
        "c": (c, "#111111", "-"),
        "Kd": (kd, "#d81e1e", "-"),
        "a + bb": (a_plus_bb, "#17963f", "-"),
        "a": (a, "#17963f", ":"),
    }
    for label, (value, colour, style) in limits.items():
        ax.axhline(value, color=colour, linestyle=style, linewidth=1.2, label=f"{label} = {value:.3f} /m")
    line = np.geomspace(low, high, 200)
    fit = system_attenuation(c, min(kd, c), 2 * np.hypot(line / c, beam))
    ax.plot(line, fit, "--", color="0.45", linewidth=1.3, label="Kd + (c - Kd) exp(-0.85 c D)")
    ax.errorbar(
        scaled,
        found["effective_attenuation"].values,
        found["effective_attenuation_stderr"].values,
        fmt="o-",
        color="#1f5fd6",
        markersize=5,
        linewidth=1.3,
        capsize=3,
        label="K of the column, ±1 standard error",
    )
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    if low < c * beam < high:
        ax.axvline(c * beam, color="0.7", linestyle=":", linewidth=1.2)
        ax.text(c * beam, 0.02 * c, "  c R$_b$ of the beam", color="0.4", fontsize="small")
    ax.set_ylim(0, None)
    ax.set_xlabel("c R$_s$: beam attenuation times radius of the spot in the field of view")
    ax.set_ylabel("attenuation coefficient (1/m)")
    top = drawing.add_top_axis(ax, 0.0, found["field_of_view"].values[0] / scaled[0], "field of view (mrad)")
    for axis in (ax.xaxis, top):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    drawing.add_grid(ax)
    ax.legend(frameon=False, fontsize="small")
    depths = f"{attributes['min_depth']:g} to {attributes['max_depth']:g} m"
    text = f"slope of the column signal from {depths}, b/c = {(c - a) / c:.2g}"
    figure.suptitle(drawing.titled(attributes, text))
    return drawing.save(figure, path)
