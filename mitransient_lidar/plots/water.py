"""Water figures: phase functions, and profiles with the layers that approximate them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import petzold_average_particle
from mitransient_lidar.physics.water.profiles import Profile
from mitransient_lidar.physics.water.seawater import water_phase_function
from mitransient_lidar.physics.water.water_types import water_of
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.studies import water_report
from mitransient_lidar.studies.water_report import PhaseFunction, fournier_forand_of

_SMALLEST_DEG = 0.01

#: Most phase functions drawn for a profile, and the smallest visible step of ln(bb/b) between them.
_MOST_FUNCTIONS, _RATIO_STEP = 8, 0.02

_DECADES = 5  #: Most decades on the axis of the coefficients, which may fall to 0.


def plot_water(
    kind: str,
    value: str | None,
    wavelength_nm: float,
    temperature: float,
    salinity: float,
    tolerance: float,
    path: drawing.FilePath | None = None,
) -> Figure:
    """Draw a water's phase function, or a profile with its layers.

    Arguments and errors as for `studies.water_report.describe_water`.
    """
    if kind == "profile":
        profile = water_report.profile_of(value)
        return plot_profile(profile, profile.layers(tolerance), Path(str(value)).name, path)
    found = water_of(kind, value, wavelength_nm, temperature, salinity)
    return plot_phase_function(*water_report.phase_function_of(kind, value, found), path)


def plot_phase_function(
    phase_function: PhaseFunction, label: str, title: str, path: drawing.FilePath | None = None
) -> Figure:
    """Draw a phase function beside pure sea water's and Petzold's average particle's.

    The left panel extends from 0.01 to 180 degrees, the right one over the backward hemisphere. The function maps
    angles [rad] to p [1/sr]; if it is `water_phase_function` itself, pure sea water is drawn once. `label` is its name
    in the legend.
    """
    figure = drawing.new_figure(path, 9.6, 4.6)
    full, backward = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    curves: list[tuple[PhaseFunction, str, dict[str, Any]]] = [
        (water_phase_function, "pure sea water", {"color": "0.5", "linestyle": (0, (1, 1.2)), "linewidth": 1.6}),
        (
            petzold_average_particle(),
            "Petzold's average particle",
            {"color": "0.2", "dashes": (5, 2), "linewidth": 1.2},
        ),
        (phase_function, label, {"color": palette.BLUE, "linewidth": 2.0}),
    ]
    if phase_function is water_phase_function:
        del curves[0]
    for ax, degrees in ((full, _angles()), (backward, np.linspace(90, 180, 361))):
        for curve, name, style in curves:
            ax.plot(degrees, curve(np.radians(degrees)), label=name, **style)
    _style_phase_axes(full)
    handles, labels = full.get_legend_handles_labels()
    full.legend(handles[::-1], labels[::-1], frameon=False, loc="upper right")
    backward.set(xlim=(90, 180), yscale="log", xticks=range(90, 181, 30), xlabel="scattering angle")
    backward.xaxis.set_major_formatter("{x:g}°")
    backward.set_title("backward hemisphere", fontsize="medium", color="0.3")
    drawing.add_grid(backward, hide=("top", "right"))
    figure.suptitle(title, fontsize="large", parse_math=False)
    return drawing.save(figure, path)


def plot_profile(profile: Profile, layers: WaterColumn, title: str, path: drawing.FilePath | None = None) -> Figure:
    """Draw a profile with its layers, from `Profile.layers`, and the phase functions of these layers.

    The left panel has the coefficients against depth, lines for the profile and steps for the layers. The right panel
    has the Fournier-Forand functions for at most 8 layers that differ in bb/b.

    Raises UserError if no Fournier-Forand function has the bb/b of a layer.
    """
    figure = drawing.new_figure(path, 10.4, 5.4)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    _draw_coefficients(left, profile, layers)
    shown = _distinct_layers(layers)
    degrees = _angles()
    for layer, style in zip(shown, palette.curves(len(shown), palette.ordered(len(shown))), strict=True):
        depth, ratio = float(layers.layer_tops[layer]), float(layers.backscatter_ratio[layer])
        label = f"{ratio:#.3g}"
        if len(shown) > 1:
            label += f" from {depth:.3g} m"
            mark = {"color": style["color"], "clip_on": False, "markersize": 7}
            left.plot(1.0, depth, "<", transform=left.get_yaxis_transform(), **mark)
        right.plot(degrees, fournier_forand_of(ratio)(np.radians(degrees)), linewidth=1.6, label=label, **style)
    _style_phase_axes(right)
    if shown:
        right.legend(title="Fournier-Forand, by bb/b", frameon=False, loc="upper right", alignment="left")
    else:
        right.text(0.5, 0.5, "no backscattering", transform=right.transAxes, ha="center", color="0.3")
    figure.suptitle(title, fontsize="large", parse_math=False)
    return drawing.save(figure, path)


def _draw_coefficients(ax: Axes, profile: Profile, column: WaterColumn) -> None:
    """Draw a profile's coefficients as lines and its layers' as steps, against depth."""
    bottom = float(profile.depth[-1])
    # Straight lines between the nodes are curves on a logarithmic axis.
    depth = np.union1d(profile.depth, np.linspace(0, bottom, 800))
    edges = np.append(column.layer_tops, bottom)
    coefficients = {
        "c": (profile.attenuation, column.attenuation),
        "b": (profile.scattering, column.scattering),
        "a": (profile.absorption, column.absorption),
        "bb": (profile.backscattering, column.backscattering),
    }
    for (name, (nodes, means)), style in zip(coefficients.items(), palette.curves(4), strict=True):
        stairs: dict[str, Any] = {"orientation": "horizontal", "baseline": None, "alpha": 0.35, "linewidth": 3.0}
        ax.stairs(means, edges, color=style["color"], **stairs)
        ax.plot(np.interp(depth, profile.depth, nodes), depth, linewidth=1.1, label=name, **style)
    values = np.concatenate([nodes for nodes, _ in coefficients.values()])
    top = float(values.max()) or 1.0
    low = max(float(values[values > 0].min(initial=top)), top * 10.0**-_DECADES)
    # Limits first: a logarithmic axis without a positive value finds none.
    ax.set(xlim=(low / 1.6, top * 1.6), ylim=(bottom, 0.0), xlabel="coefficient (1/m)", ylabel="depth (m)")
    ax.set_xscale("log")
    count = f"{column.count} layers" if column.count > 1 else "1 layer"
    place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    ax.legend(title=f"lines: profile, bands: {count}", ncols=4, frameon=False, handlelength=1.4, **place)
    drawing.add_grid(ax, hide=("top", "right"))


def _distinct_layers(column: WaterColumn) -> list[int]:
    """Return the layers, from the top, whose phase functions are drawn: spread evenly over the values of bb/b."""
    ratios = column.backscatter_ratio
    candidates = np.flatnonzero(ratios > 0)
    steps = np.round(np.log(ratios[candidates]) / _RATIO_STEP)
    # The first layer of each step is the uppermost; the steps come in increasing order.
    _, first = np.unique(steps, return_index=True)
    count = min(first.size, _MOST_FUNCTIONS)
    chosen = first[np.linspace(0, first.size - 1, count).round().astype(int)] if count else first
    return sorted(int(layer) for layer in candidates[chosen])


def _angles() -> FloatArray:
    """Return the angles [deg] of a curve on a logarithmic axis, denser towards 180."""
    return np.union1d(np.geomspace(_SMALLEST_DEG, 180, 600), np.linspace(1, 180, 359))


def _style_phase_axes(ax: Axes) -> None:
    ax.set(xscale="log", yscale="log", xlim=(_SMALLEST_DEG, 180), xticks=[0.01, 0.1, 1, 10, 90, 180])
    ax.xaxis.set_major_formatter("{x:g}°")
    drawing.finish(ax, hide=("top", "right"), xlabel="scattering angle", ylabel="phase function (1/sr)")
