"""Waveforms of the publication's figures over depth, with error bands: figures 1, 2, 4, 9, 13 to 16."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.layout import draw_sea_level
from mitransient_lidar.studies.publication import scenes
from mitransient_lidar.studies.publication.measures import change
from mitransient_lidar.studies.publication.renders import Renders, as_series, geometry_of

DEPTH_LABEL = "depth on the axis (m)"

#: Names of the pixel colours, for legends.
PIXELS = ("red (0)", "green (1)", "blue (2)", "black (3)")


def draw_waveforms(
    ax: Axes,
    result: xr.Dataset,
    limits: tuple[float, float],
    *,
    log: bool = False,
    origin: str = "",
    pixels: Sequence[int] | None = None,
    label: str = "",
    **style: object,
) -> float:
    """Draw the mean over a series of renders against depth [m], with bands of one standard error; return its unit in W.

    `origin` selects the light from one origin, and `pixels` some pixels.
    """
    series = as_series(result)
    power = series.parts[origin] if origin else series.power
    mean, error = power.mean(axis=0), power.std(axis=0, ddof=1) / np.sqrt(len(power))
    depth = geometry_of(result).depth_of_time(series.time)
    shown = (depth >= limits[0]) & (depth <= limits[1])
    factor, prefix = drawing.si_prefix(float(series.power.mean(axis=0)[:, shown].max()))
    styles = palette.curves(len(mean))
    for pixel in range(len(mean)) if pixels is None else pixels:
        curve = {"linewidth": 1.2, "label": label or None, **styles[pixel], **style}
        lowest = 1e-12 / factor if log else -np.inf
        drawing.draw_band(
            ax, depth[shown], mean[pixel, shown] / factor, error[pixel, shown] / factor, lowest=lowest, **curve
        )
    ax.set(xlim=limits, xlabel=DEPTH_LABEL, ylabel=f"received power ({prefix}W)")
    if log:
        ax.set_yscale("log")
    else:
        ax.set_ylim(0, None, auto=True)  # for the curves that follow
    drawing.add_grid(ax, hide=("top", "right"))
    return factor


def example(renders: Renders) -> Figure:
    """Draw a received waveform, on linear and logarithmic axes (figure 1b)."""
    result = renders.shot(scenes.SINGLE)
    figure = drawing.new_figure(None, 8.0, 3.2)
    for ax, log in zip(figure.subplots(1, 2), (False, True), strict=True):
        draw_waveforms(ax, result, (-1.5, 10.0), log=log)
    _show_decades(figure.axes[1:])
    figure.suptitle("1 (b)  surface echo, backscatter and bottom echo", fontsize="medium")
    return figure


def mine(renders: Renders) -> Figure:
    """Draw a sphere's echo (figure 2)."""
    figure = _with_part(renders.shot(scenes.MINE), (-1.5, 14.0), "2  sphere of 1 m at 9 m", "sphere alone", log=True)
    _show_decades(figure.axes)
    return figure


def mast(renders: Renders) -> Figure:
    """Draw the echo of a target below a mast (figure 4)."""
    summed = renders.shot(scenes.MAST).sum("pixel", keepdims=True, keep_attrs=True)
    return _with_part(summed, (-0.5, 2.5), "4  target of 1 m² at 1 m, grazing angle 5.4°", "target alone")


def _with_part(result: xr.Dataset, limits: tuple[float, float], title: str, label: str, *, log: bool = False) -> Figure:
    """Draw waveforms and the target's light alone."""
    figure = drawing.new_figure(None, 6.0, 3.4)
    ax = figure.subplots()
    draw_waveforms(ax, result, limits, log=log)
    draw_waveforms(ax, result, limits, log=log, origin="target", color=palette.TARGET, linestyle="--", label=label)
    ax.legend(frameon=False)
    ax.set_title(title, fontsize="medium")
    return figure


def pixels_over_bottom(renders: Renders) -> Figure:
    """Draw four pixels and one over a flat bottom (figure 9)."""
    return _four_and_one(renders, (scenes.FOUR, scenes.SINGLE), (-1.5, 10.0), "9")


def layered(renders: Renders) -> Figure:
    """Draw four pixels and one over water in two layers (figure 15)."""
    figure = _four_and_one(renders, (scenes.LAYERED_FOUR, scenes.LAYERED_SINGLE), (-1.5, 9.5), "15", log=True)
    _show_decades(figure.axes)
    return figure


def layer_zoom(renders: Renders) -> Figure:
    """Draw the change at 3 m, with arrows at its start and stop (figure 16)."""
    figure = _four_and_one(renders, (scenes.LAYERED_FOUR, scenes.LAYERED_SINGLE), (1.8, 5.0), "16", log=True)
    for ax, scene in zip(figure.axes, (scenes.LAYERED_FOUR, scenes.LAYERED_SINGLE), strict=True):
        result = renders.shot(scene)
        mean, geometry = as_series(result).mean(), geometry_of(result)
        factor, _ = drawing.si_prefix(float(mean.power[:, geometry.depth_of_time(mean.time) >= 1.8].max()))
        colours = palette.pixel_colours(len(mean.power))
        for pixel, middle in enumerate(scenes.layer_times(result)):
            for time in change(mean, pixel, float(middle)):
                point = float(geometry.depth_of_time(time)), float(np.interp(time, mean.time, mean.power[pixel]))
                arrow = {"arrowstyle": "-|>", "color": colours[pixel], "linewidth": 0.9}
                ax.annotate(
                    "", (point[0], point[1] / factor), xytext=(0, 18), textcoords="offset points", arrowprops=arrow
                )
    return figure


def square_target(renders: Renders) -> Figure:
    """Draw pixels and target on the sea, and the waveforms, of 2x2 pixels (figure 13)."""
    return _target(renders, scenes.SQUARE, "13")


def strip_target(renders: Renders) -> Figure:
    """Draw pixels and target on the sea, and the waveforms, of 1x4 pixels (figure 14)."""
    return _target(renders, scenes.STRIPS, "14")


def _four_and_one(
    renders: Renders, pair: tuple[str, str], limits: tuple[float, float], number: str, log: bool = False
) -> Figure:
    figure = drawing.new_figure(None, 9.0, 3.5)
    for ax, scene, panel in zip(figure.subplots(1, 2), pair, ("a", "b"), strict=True):
        result = renders.shot(scene)
        draw_waveforms(ax, result, limits, log=log)
        ax.set_title(f"{number} ({panel})  {'2x2 pixels' if panel == 'a' else 'single pixel'}", fontsize="medium")
    add_pixel_legend(figure.axes[0])
    return figure


def _target(renders: Renders, scene: str, number: str) -> Figure:
    result = renders.shot(scene)
    figure = drawing.new_figure(None, 9.0, 3.9)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
    draw_sea_level(left, result.isel(shot=0))
    left.set_title(f"{number} (a)  mean sea level, target as seen", fontsize="medium")
    draw_waveforms(right, result, (4.0, 11.0))
    right.set_title(f"{number} (b)  target of 1.5 m at 8 m", fontsize="medium")
    add_pixel_legend(right)
    return figure


def _show_decades(axes: Sequence[Axes]) -> None:
    """Limit logarithmic axes to the three and a half decades below their top."""
    for ax in axes:
        ax.set_ylim(3e-4 * ax.get_ylim()[1], None)


def add_pixel_legend(ax: Axes, loc: Literal["best", "upper left"] = "best") -> None:
    """Name the four pixels by their lines."""
    handles = [Line2D([], [], **style) for style in palette.curves(4)]
    ax.legend(handles, PIXELS, frameon=False, fontsize="small", loc=loc)
