"""The publication's figures: waveforms over depth with error bands (1, 2, 4, 9 to 16), and geometry (5, 6, 8)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from mitransient_lidar.physics.lidar.level_sea import LevelSea, refract
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.layout import draw_sea_level
from mitransient_lidar.plots.studies.shots import draw_sea
from mitransient_lidar.studies.publication import scenes
from mitransient_lidar.studies.publication.scenes import Renders
from mitransient_lidar.studies.publication.statements import change
from mitransient_lidar.studies.shots import render_found_shots

DEPTH_LABEL = "depth on the axis (m)"

PIXELS = ("red (0)", "green (1)", "blue (2)", "black (3)")  #: Names of the pixel colours, for legends.


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
    """Draw the mean over a render series against depth [m], with bands of one standard error; return its unit in W.

    `origin` selects the light from one origin, and `pixels` some pixels.
    """
    series = scenes.as_series(result)
    power = series.parts[origin] if origin else series.power
    mean, error = power.mean(axis=0), power.std(axis=0, ddof=1) / np.sqrt(len(power))
    depth = scenes.geometry_of(result).depth_of_time(series.time)
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
    """Draw a target's echo below a mast (figure 4)."""
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
        mean, geometry = scenes.as_series(result).mean(), scenes.geometry_of(result)
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
    """Draw pixels and target on the sea, and the waveforms, for 2x2 pixels (figure 13)."""
    return _target(renders, scenes.SQUARE, "13")


def strip_target(renders: Renders) -> Figure:
    """Draw pixels and target on the sea, and the waveforms, for 1x4 pixels (figure 14)."""
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


_STYLES = ("-", "--", ":")
_SECTION: dict[str, Any] = {"hide": ("top", "right"), "xlabel": "x (m)", "ylabel": "z (m)", "aspect": "equal"}


def surface_echoes(renders: Renders) -> Figure:
    """Draw the shots' places on the sea, and the surface echoes (figure 10)."""
    figure = drawing.new_figure(None, 10.4, 6.2)
    axes = figure.subplots(2, 3)
    _draw_places(renders, axes[0], "10")
    for ax, result, panel in zip(axes[1], scenes.three_shots(renders), "bcd", strict=True):
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
    results = scenes.three_shots(renders)
    for number, (result, style) in enumerate(zip(results, _STYLES, strict=True), start=1):
        draw_waveforms(ax, result, (4.0, 6.5), pixels=[0], label=f"shot {number}", linestyle=style)
    ax.legend(frameon=False)
    ax.set_title("11 (b)  bottom echo, red pixel", fontsize="medium")
    return figure


def paths(renders: Renders) -> Figure:
    """Draw the paths below the slopes of shots 1 and 3, refracted by Snell's law (figure 12)."""
    system, places = scenes.System.of(scenes.SHOTS[0]), scenes.shot_places(renders)
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
        title = f"12  shot {name}: slope {slope_deg:+.1f}°, in water {angle:.2f}°,\npath {path:.3f} m"
        drawing.finish(ax, title, **_SECTION, xlim=(-2, 3))
    return figure


def _draw_places(renders: Renders, axes: Sequence[Axes], number: str) -> None:
    """Draw the sea about each shot, with the footprints of beam and pixels."""
    places = scenes.shot_places(renders)
    drawn = render_found_shots(renders.session(scenes.SHOTS[0]), places, waveforms=False)
    for index, (ax, shot) in enumerate(zip(axes, places, strict=True)):
        draw_sea(ax, dataclasses.replace(drawn, shots=(shot,)), first=index + 1)
        # Adding 0 turns -0 into 0.
        along, across = (round(math.degrees(math.atan(slope)), 1) + 0.0 for slope in (shot.along, shot.across))
        if index:
            ax.set_ylabel("")
        ax.set_title(f"{number} (a)  {shot.kind}:\n{along:+.1f}° to the lidar, {across:+.1f}° left", fontsize="medium")


#: Half side of the drawn part of the sea, and distance between the refracted axes [m].
_HALF_SIDE, _AXES_APART = 1.3, 0.25


def system(_renders: Renders) -> Figure:
    """Draw the lidar, beam and field of view in air and in water, in the incidence plane (figure 5)."""
    numbers = scenes.System.of(scenes.FOUR)
    figure = drawing.new_figure(None, 8.0, 4.2)
    left, right = figure.subplots(1, 2)
    origin = np.array([-numbers.height * math.tan(numbers.off_nadir), 0.0, numbers.height])
    sea = LevelSea((numbers.refractive_index,))
    edges = {palette.VIEW: 0.5 * numbers.field_of_view, palette.BEAM: 0.5 * numbers.divergence}
    depths = np.linspace(0, numbers.bottom_depth, 2)
    for colour, half in edges.items():
        for angle in (numbers.off_nadir - half, numbers.off_nadir + half):
            down = np.array([math.sin(angle), 0.0, -math.cos(angle)])
            x = sea.at_height(origin, np.broadcast_to(down, (2, 3)), -depths)[:, 0]
            style = "-" if colour == palette.BEAM else "--"
            left.plot([origin[0], x[0]], [origin[2], 0], color=colour, linestyle=style, linewidth=1)
            above = x[0] - 3 * math.tan(angle)
            right.plot([above, *x], [3, *-depths], color=colour, linestyle=style, linewidth=1.2)
    axis = np.array([math.sin(numbers.off_nadir), 0.0, -math.cos(numbers.off_nadir)])
    x = sea.at_height(origin, np.broadcast_to(axis, (2, 3)), -depths)[:, 0]
    left.plot([origin[0], 0], [origin[2], 0], color="black", linewidth=0.8, linestyle="-.")
    right.plot([-3 * math.tan(numbers.off_nadir), *x], [3, *-depths], color="black", linewidth=0.8, linestyle="-.")
    left.plot([origin[0]] * 2, [origin[2], 0], color="0.6", linestyle=":")
    left.plot(origin[0], origin[2], "s", color="black")
    left.annotate(f"θ$_0$ = {math.degrees(numbers.off_nadir):.0f}°", (origin[0] + 4, 0.25 * numbers.height))
    left.annotate(f"H = {numbers.height:g} m", (origin[0] - 3, 0.4 * numbers.height), rotation=90, ha="right")
    left.set_xlim(1.4 * origin[0], 25)
    in_water = math.degrees(math.atan2(x[1], numbers.bottom_depth))
    right.annotate(
        f"θ$_w$ = {in_water:.2f}°", (0.5 * x[1], -0.5 * numbers.bottom_depth), backgroundcolor="white", ha="center"
    )
    for ax, title in ((left, "5  system in air"), (right, "5  sea, level, and bottom")):
        ax.axhline(0, color=palette.SEA, linewidth=2)
        drawing.finish(ax, title, **_SECTION)
    right.axhline(-numbers.bottom_depth, color=palette.BOTTOM, linewidth=2)
    right.plot([], [], color=palette.BEAM, label="beam, e$^{-1/2}$")
    right.plot([], [], color=palette.VIEW, linestyle="--", label="field of view")
    right.legend(frameon=False, fontsize="small", loc="upper right")
    return figure


def mesh(renders: Renders) -> Figure:
    """Draw axes refracted at sea facets, and the sea's triangles with the footprints (figure 6)."""
    from mitransient_lidar.transport.scene_parts import seas_of

    numbers, session = scenes.System.of(scenes.FOUR), renders.session(scenes.FOUR)
    sea = seas_of(session.scene)[0].sea
    figure = drawing.new_figure(None, 9.6, 4.6)
    left, right = figure.subplots(1, 2)
    count = round(_HALF_SIDE / sea.cell_size)
    lines = np.asarray(np.arange(-count, count + 1) * sea.cell_size, dtype=np.float64)
    heights = sea.heights(lines, lines)
    _draw_section(left, numbers, lines, heights[count])
    reach = 0.55 * numbers.field_of_view * numbers.slant_range / math.cos(numbers.off_nadir)
    wide = np.arange(-reach, reach, 2 * sea.cell_size)
    image = right.imshow(
        sea.heights(wide, wide), origin="lower", extent=(-reach, reach, -reach, reach), cmap=palette.ELEVATION
    )
    x, y = np.meshgrid(lines, lines)
    right.triplot(x.ravel(), y.ravel(), color="white", linewidth=0.3, alpha=0.8)
    figure.colorbar(image, ax=right, label="elevation (m)", shrink=0.7)
    for colour, angle, style in ((palette.BEAM, numbers.divergence, "-"), ("black", numbers.field_of_view, "--")):
        across = angle * numbers.slant_range
        along = across / math.cos(numbers.off_nadir)
        right.add_patch(Ellipse((0, 0), along, across, fill=False, color=colour, linestyle=style, linewidth=1.6))
    right.set(xlabel="x (m)", ylabel="y (m)", xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    right.set_title("6 (b)  triangles of the sea, beam (solid) and view (dashed)", fontsize="medium")
    return figure


def _draw_section(ax: Axes, numbers: scenes.System, lines: np.ndarray, heights: np.ndarray) -> None:
    """Draw a section of the sea along x, and parallel axes that its facets refract."""
    ax.plot(lines, heights, color=palette.SEA, linewidth=1.6)
    down = np.array([math.sin(numbers.off_nadir), -math.cos(numbers.off_nadir)])
    step = max(1, round(_AXES_APART / (lines[1] - lines[0])))
    for first in range(0, len(lines) - 1, step):
        slope = (heights[first + 1] - heights[first]) / (lines[1] - lines[0])
        point = 0.5 * np.array([lines[first] + lines[first + 1], heights[first] + heights[first + 1]])
        start = point - 0.8 * down
        end = point + 2.0 * refract(down, np.array([-slope, 1.0]), numbers.refractive_index)
        ax.plot([start[0], point[0]], [start[1], point[1]], color=palette.BEAM, linewidth=1)
        ax.plot([point[0], end[0]], [point[1], end[1]], color=palette.BEAM, linestyle="--", linewidth=1)
    drawing.finish(ax, "6 (a)  axes refracted by facets, section at y = 0", **_SECTION)


def pixels(renders: Renders) -> Figure:
    """Draw the pixels of the three layouts as seen from the lidar (figure 8)."""
    figure = drawing.new_figure(None, 8.4, 3.0)
    for ax, scene, panel in zip(figure.subplots(1, 3), scenes.LAYOUTS, "abc", strict=True):
        shapes = scenes.outlines(renders, scene)
        for number, (shape, colour) in enumerate(zip(shapes, palette.pixel_colours(len(shapes)), strict=True)):
            for line in shape:
                # angle_y to the left, angle_x, away from nadir, up.
                ax.fill(1e3 * line[:, 1], 1e3 * line[:, 0], facecolor=colour, edgecolor="white", alpha=0.85)
            points = 1e3 * np.concatenate(shape)
            centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
            ax.annotate(f"{number}", (centre[1], centre[0]), color="white", ha="center", va="center")
        layout = renders.session(scene).parameters["layout"]
        ax.set_title(f"8 ({panel})  {layout}", fontsize="medium")
        ax.set(aspect="equal", xlabel="to the left (mrad)", ylabel="away from nadir (mrad)" if panel == "a" else "")
        ax.invert_xaxis()
    return figure
