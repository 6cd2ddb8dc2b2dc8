"""Figures of waters: phase functions, and profiles with the layers that stand for them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.checks import FloatArray
from mitransient_lidar.optics.phase import fournier_forand, fournier_forand_parameters, petzold_average_particle
from mitransient_lidar.optics.seawater import water_phase_function
from mitransient_lidar.optics.water import WaterColumn
from mitransient_lidar.plotting import check_format
from mitransient_lidar.profiles import Profile
from mitransient_lidar.results import replacing

PhaseFunction = Callable[[npt.ArrayLike], FloatArray]

_SMALLEST_DEG = 0.01
_WATER = "#1f5fd6"
_DEPTHS: Any = matplotlib.colormaps["viridis_r"]
_COLOURS = {"c": "#111111", "b": "#1f5fd6", "a": "#d81e1e", "bb": "#17963f"}

#: Phase functions drawn of a profile, and the step of ln(bb/b) from which they differ visibly.
_MOST_FUNCTIONS, _RATIO_STEP = 8, 0.02

#: Most decades on the axis of the coefficients, which may fall to 0.
_DECADES = 5


def fournier_forand_of(backscatter_ratio: float) -> PhaseFunction:
    """Return the Fournier-Forand function of a bb/b, which maps angles [rad] to p [1/sr].

    Raises
    ------
    UserError
        If no such function has this bb/b.
    """
    try:
        n, mu = fournier_forand_parameters(backscatter_ratio)
    except ValueError as error:
        raise UserError(str(error)) from error
    return lambda theta: fournier_forand(theta, n, mu)


def plot_phase_function(
    phase_function: PhaseFunction, label: str, title: str, path: str | os.PathLike[str] | None = None
) -> Figure:
    """Draw a phase function beside those of pure sea water and of Petzold's average particle.

    Parameters
    ----------
    phase_function : callable
        Maps angles [rad] to p [1/sr]. If it is `water_phase_function` itself, that is drawn once.
    label, title : str
        What the legend calls it, and the title of the figure.
    path : path, optional
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Returns
    -------
    matplotlib.figure.Figure
        On the left from 0.01 to 180 degrees, on the right the backward hemisphere. Independent of pyplot.

    Raises
    ------
    UserError
        If the suffix of `path` is another one, or the file cannot be written.
    """
    if path is not None:
        check_format(Path(path))
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    whole, backward = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    average = petzold_average_particle()
    curves: list[tuple[PhaseFunction, str, dict[str, Any]]] = [
        (water_phase_function, "pure sea water", {"color": "0.5", "linestyle": (0, (1, 1.2)), "linewidth": 1.6}),
        (average, "Petzold's average particle", {"color": "0.2", "linestyle": (0, (5, 2)), "linewidth": 1.2}),
        (phase_function, label, {"color": _WATER, "linewidth": 2.0}),
    ]
    if phase_function is water_phase_function:
        del curves[0]
    for ax, degrees in ((whole, _angles()), (backward, np.linspace(90, 180, 361))):
        for curve, name, style in curves:
            ax.plot(degrees, curve(np.radians(degrees)), label=name, **style)
    _dress_phase_axes(whole)
    handles, labels = whole.get_legend_handles_labels()
    whole.legend(handles[::-1], labels[::-1], frameon=False, loc="upper right")
    backward.set(xlim=(90, 180), yscale="log", xticks=range(90, 181, 30))
    backward.xaxis.set_major_formatter("{x:g}°")
    backward.set_xlabel("scattering angle")
    backward.set_title("backwards", fontsize="medium", color="0.3")
    _tidy(backward)
    figure.suptitle(title, fontsize="large", parse_math=False)
    _save(figure, path)
    return figure


def plot_profile(
    profile: Profile, layers: WaterColumn, title: str, path: str | os.PathLike[str] | None = None
) -> Figure:
    """Draw a profile with the layers that stand for it, and phase functions of these layers.

    Parameters
    ----------
    profile : Profile
        What to draw.
    layers : WaterColumn
        What `Profile.layers` made of it.
    title : str
        Title of the figure.
    path : path, optional
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Returns
    -------
    matplotlib.figure.Figure
        On the left coefficients against depth, lines for the profile and steps for the layers; on the right the
        Fournier-Forand functions of at most 8 layers whose bb/b differ. Independent of pyplot.

    Raises
    ------
    UserError
        If the suffix of `path` is another one, the file cannot be written, or no Fournier-Forand function has the bb/b
        of a layer.
    """
    if path is not None:
        check_format(Path(path))
    figure = Figure(figsize=(10.4, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    _draw_coefficients(left, profile, layers)
    bottom = float(profile.depth[-1])
    shown = _distinct_layers(layers)
    degrees = _angles()
    for layer in shown:
        depth, ratio = float(layers.tops[layer]), float(layers.backscatter_ratio[layer])
        several = len(shown) > 1
        colour = _DEPTHS(0.1 + 0.9 * depth / bottom) if several else _WATER
        label = f"{ratio:#.3g} from {depth:.3g} m" if several else f"{ratio:#.3g}"
        values = fournier_forand_of(ratio)(np.radians(degrees))
        right.plot(degrees, values, color=colour, linewidth=1.6, label=label)
        if several:
            left.plot(1.0, depth, "<", color=colour, transform=left.get_yaxis_transform(), clip_on=False, markersize=7)
    _dress_phase_axes(right)
    if shown:
        right.legend(title="Fournier-Forand of bb/b", frameon=False, loc="upper right", alignment="left")
    else:
        right.text(0.5, 0.5, "nothing is scattered backwards", transform=right.transAxes, ha="center", color="0.3")
    figure.suptitle(title, fontsize="large", parse_math=False)
    _save(figure, path)
    return figure


def _draw_coefficients(ax: Axes, profile: Profile, column: WaterColumn) -> None:
    """Draw the coefficients of a profile as lines and those of its layers as steps, against depth."""
    bottom = float(profile.depth[-1])
    # Straight lines between the nodes are curves on a logarithmic axis.
    depth = np.union1d(profile.depth, np.linspace(0, bottom, 800))
    edges = np.append(column.tops, bottom)
    coefficients = {
        "c": (profile.attenuation, column.attenuation),
        "b": (profile.scattering, column.scattering),
        "a": (profile.absorption, column.absorption),
        "bb": (profile.backscattering, column.backscattering),
    }
    for name, (nodes, means) in coefficients.items():
        colour = _COLOURS[name]
        ax.stairs(means, edges, orientation="horizontal", baseline=None, color=colour, alpha=0.35, linewidth=3.0)
        ax.plot(np.interp(depth, profile.depth, nodes), depth, color=colour, linewidth=1.1, label=name)
    values = np.concatenate([nodes for nodes, _ in coefficients.values()])
    top = float(values.max()) or 1.0
    low = max(float(values[values > 0].min(initial=top)), top * 10.0**-_DECADES)
    # Limits first: without a positive value a logarithmic axis finds none of its own.
    ax.set(xlim=(low / 1.6, top * 1.6), ylim=(bottom, 0.0))
    ax.set_xscale("log")
    ax.set_xlabel("coefficient (1/m)")
    ax.set_ylabel("depth (m)")
    count = f"{column.count} layers" if column.count > 1 else "1 layer"
    ax.legend(
        title=f"lines: the profile, bands: {count}",
        ncols=4,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        handlelength=1.4,
        frameon=False,
    )
    _tidy(ax)


def _distinct_layers(column: WaterColumn) -> list[int]:
    """Return the layers, from the top, whose phase functions are drawn: spread evenly over the values of bb/b."""
    ratios = column.backscatter_ratio
    candidates = np.flatnonzero(ratios > 0)
    steps = np.round(np.log(ratios[candidates]) / _RATIO_STEP)
    # The first of each step is the uppermost; the steps come in increasing order.
    _, first = np.unique(steps, return_index=True)
    count = min(first.size, _MOST_FUNCTIONS)
    chosen = first[np.linspace(0, first.size - 1, count).round().astype(int)] if count else first
    return sorted(int(layer) for layer in candidates[chosen])


def _angles() -> FloatArray:
    """Return the angles [deg] of a curve on a logarithmic axis, denser towards 180."""
    return np.union1d(np.geomspace(_SMALLEST_DEG, 180, 600), np.linspace(1, 180, 359))


def _dress_phase_axes(ax: Axes) -> None:
    ax.set(xscale="log", yscale="log", xlim=(_SMALLEST_DEG, 180))
    ax.set_xticks([0.01, 0.1, 1, 10, 90, 180])
    ax.xaxis.set_major_formatter("{x:g}°")
    ax.set_xlabel("scattering angle")
    ax.set_ylabel("phase function (1/sr)")
    _tidy(ax)


def _tidy(ax: Axes) -> None:
    ax.grid(True, which="major", color="0.88", linewidth=0.7)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _save(figure: Figure, path: str | os.PathLike[str] | None) -> None:
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=160)
