"""Geometry drawings from the numbers in the scenes: figures 5, 6 and 8."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from mitransient_lidar.physics.lidar.level_sea import LevelSea, refract
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.studies.publication.scenes import FOUR, LAYOUTS, Renders, System, outlines

#: Half side of the drawn part of the sea, and distance between the refracted axes [m].
_HALF_SIDE, _AXES_APART = 1.3, 0.25


def system(_renders: Renders) -> Figure:
    """Draw the lidar, and beam and field of view in air and in water, in the plane of incidence (figure 5)."""
    numbers = System.of(FOUR)
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
        ax.set_title(title, fontsize="medium")
        ax.set(xlabel="x (m)", ylabel="z (m)", aspect="equal")
        drawing.add_grid(ax, hide=("top", "right"))
    right.axhline(-numbers.bottom_depth, color=palette.BOTTOM, linewidth=2)
    right.plot([], [], color=palette.BEAM, label="beam, e$^{-1/2}$")
    right.plot([], [], color=palette.VIEW, linestyle="--", label="field of view")
    right.legend(frameon=False, fontsize="small", loc="upper right")
    return figure


def mesh(renders: Renders) -> Figure:
    """Draw axes refracted at facets of the sea, and its triangles with the footprints (figure 6)."""
    from mitransient_lidar.transport.scene_parts import seas_of

    numbers, session = System.of(FOUR), renders.session(FOUR)
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


def _draw_section(ax: Axes, numbers: System, lines: np.ndarray, heights: np.ndarray) -> None:
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
    ax.set(xlabel="x (m)", ylabel="z (m)", aspect="equal")
    ax.set_title("6 (a)  axes refracted by facets, section at y = 0", fontsize="medium")
    drawing.add_grid(ax, hide=("top", "right"))


def pixels(renders: Renders) -> Figure:
    """Draw the pixels of the three layouts as seen from the lidar (figure 8)."""
    figure = drawing.new_figure(None, 8.4, 3.0)
    for ax, scene, panel in zip(figure.subplots(1, 3), LAYOUTS, "abc", strict=True):
        shapes = outlines(renders, scene)
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
