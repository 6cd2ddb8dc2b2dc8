"""Three shots on waves: figures 10, 11 and 12."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitransient_lidar.physics.lidar.level_sea import refract
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.publication.waveforms import add_pixel_legend, draw_waveforms
from mitransient_lidar.plots.studies.shots import draw_sea
from mitransient_lidar.studies.publication.renders import Renders
from mitransient_lidar.studies.publication.scenes import SHOTS, System, shot_places, three_shots
from mitransient_lidar.studies.shots import render_found_shots

_STYLES = ("-", "--", ":")


def surface_echoes(renders: Renders) -> Figure:
    """Draw the places of the shots on the sea, and the surface echoes (figure 10)."""
    figure = drawing.new_figure(None, 10.4, 6.2)
    axes = figure.subplots(2, 3)
    _draw_places(renders, axes[0], "10")
    for ax, result, panel in zip(axes[1], three_shots(renders), "bcd", strict=True):
        draw_waveforms(ax, result, (-1.2, 1.2))
        ax.set_title(f"10 ({panel})  surface echo, shot {'bcd'.index(panel) + 1}", fontsize="medium")
    add_pixel_legend(axes[1, 0], "upper left")
    return figure


def bottom_echoes(renders: Renders) -> Figure:
    """Draw the shot locations on the sea, and the bottom echoes in the red pixel (figure 11)."""
    figure = drawing.new_figure(None, 10.4, 6.2)
    grid = figure.add_gridspec(2, 3)
    _draw_places(renders, [figure.add_subplot(grid[0, number]) for number in range(3)], "11")
    ax = figure.add_subplot(grid[1, :])
    results = three_shots(renders)
    for number, (result, style) in enumerate(zip(results, _STYLES, strict=True), start=1):
        draw_waveforms(ax, result, (4.0, 6.5), pixels=[0], label=f"shot {number}", linestyle=style)
    ax.legend(frameon=False)
    ax.set_title("11 (b)  bottom echo, red pixel", fontsize="medium")
    return figure


def paths(renders: Renders) -> Figure:
    """Draw the paths below the slopes of shots 1 and 3, refracted by Snell's law (figure 12)."""
    system, places = System.of(SHOTS[0]), shot_places(renders)
    figure = drawing.new_figure(None, 7.0, 3.6)
    for ax, slope, name in zip(figure.subplots(1, 2), (places[0].along, places[2].along), "AB", strict=True):
        down = np.array([math.sin(system.off_nadir), -math.cos(system.off_nadir)])
        # A face towards the lidar rises away from it.
        ray = refract(down, np.array([-slope, 1.0]), system.refractive_index)
        path = system.bottom_depth / -ray[1]
        end = path * ray
        ax.plot([-1.5, 1.5], [-1.5 * slope, 1.5 * slope], color=palette.SEA, linewidth=2)
        ax.plot([-2, 3], [-system.bottom_depth] * 2, color=palette.BOTTOM, linewidth=2)
        ax.plot([-2 * down[0], 0, end[0]], [-2 * down[1], 0, end[1]], color=palette.BEAM)
        ax.plot([0, 0], [0, -system.bottom_depth], color="0.6", linestyle=":")
        slope_deg, angle = math.degrees(math.atan(slope)), math.degrees(math.atan2(ray[0], -ray[1]))
        ax.set_title(
            f"12  shot {name}: slope {slope_deg:+.1f}°, in water {angle:.2f}°,\npath {path:.3f} m", fontsize="medium"
        )
        ax.set(xlabel="x (m)", ylabel="z (m)", xlim=(-2, 3), aspect="equal")
        drawing.add_grid(ax, hide=("top", "right"))
    return figure


def _draw_places(renders: Renders, axes: Sequence[Axes], number: str) -> None:
    """Draw the sea about each shot, with the footprints of beam and pixels."""
    places = shot_places(renders)
    drawn = render_found_shots(renders.session(SHOTS[0]), places, waveforms=False)
    for index, (ax, shot) in enumerate(zip(axes, places, strict=True)):
        draw_sea(ax, dataclasses.replace(drawn, shots=(shot,)), first=index + 1)
        # Adding 0 turns -0 into 0.
        along, across = (round(math.degrees(math.atan(slope)), 1) + 0.0 for slope in (shot.along, shot.across))
        if index:
            ax.set_ylabel("")
        ax.set_title(f"{number} (a)  {shot.kind}:\n{along:+.1f}° to the lidar, {across:+.1f}° left", fontsize="medium")
