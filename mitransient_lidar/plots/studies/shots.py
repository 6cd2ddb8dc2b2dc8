"""Figures for shots on a sea: footprints and waveforms, echoes against slopes, and estimates against the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from mitransient_lidar.analysis.retrieval.retrieval_table import estimates, truth_statistics
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.drawing import finish
from mitransient_lidar.rendering.shots.truth import Shot
from mitransient_lidar.studies.shots import RenderedShots, depth_bias, slope_correlations, slope_effects

_FAINT = 5e-3  #: Share of a pixel's peak that counts as an echo.


def plot_found_shots(rendered: RenderedShots, path: drawing.FilePath | None = None) -> Figure:
    """Draw the sea with beam and pixel footprints at each shot, and the shots' waveforms.

    `rendered` is a result of `studies.shots.render_found_shots`.
    """
    columns = min(2, len(rendered.results))
    rows = -(-len(rendered.results) // columns) if columns else 1
    figure = drawing.new_figure(path, 6.0 + 3.6 * columns, max(5.4, 2.7 * rows))
    grid = figure.add_gridspec(rows, 1 + columns, width_ratios=[1.5, *[1.0] * columns])
    draw_sea(figure.add_subplot(grid[:, 0]), rendered)
    limits = _time_limits(rendered.results)
    for index, (shot, result) in enumerate(zip(rendered.shots, rendered.results, strict=False)):
        ax = figure.add_subplot(grid[index // columns, 1 + index % columns])
        _draw_waveforms(ax, f"{index + 1} {shot.kind}", shot, result)
        ax.set_xlim(limits)
    figure.suptitle(rendered.scene)
    return drawing.save(figure, path)


def draw_sea(ax: Axes, rendered: RenderedShots, first: int = 1) -> None:
    """Draw elevations about the shots, and pixel and beam outlines at each shot on the mean sea level.

    Shots are numbered from `first` on.
    """
    sea, shots = rendered.sea, rendered.shots
    along, across = rendered.beam_spread
    x, y = np.array([shot.x for shot in shots]), np.array([shot.y for shot in shots])
    margin = max(6 * along, 0.1 * max(np.ptp(x), np.ptp(y)))
    spacing = sea.x[1] - sea.x[0]
    windows = []
    for places, lines in ((x, sea.x), (y, sea.y)):
        start = math.floor((places.min() - margin - lines[0]) / spacing)
        end = math.ceil((places.max() + margin - lines[0]) / spacing)
        windows.append(np.arange(start, end + 1))
    # The sea repeats itself.
    heights = sea.heights[np.ix_(windows[1] % len(sea.y), windows[0] % len(sea.x))]
    left, right = sea.x[0] + windows[0][[0, -1]] * spacing
    near, far = sea.y[0] + windows[1][[0, -1]] * spacing
    image = ax.imshow(
        heights, origin="lower", extent=(left, right, near, far), cmap=palette.ELEVATION, interpolation="bilinear"
    )
    ax.figure.colorbar(image, ax=ax, label="elevation (m)", shrink=0.6)
    styles = palette.curves(rendered.pixel_count)
    for number, shot in enumerate(shots, start=first):
        for pixel in np.unique(rendered.pixel_map[rendered.pixel_map >= 0]):
            lines, mask = rendered.pixel_lines, (rendered.pixel_map == pixel).astype(np.float64)
            line: dict[str, Any] = {
                "colors": [styles[pixel]["color"]],
                "linestyles": [styles[pixel]["linestyle"]],
                "linewidths": 1.2,
            }
            ax.contour(lines + shot.x, lines + shot.y, mask, [0.5], **line)
        angle = math.degrees(rendered.azimuth)
        ax.add_patch(Ellipse((shot.x, shot.y), 2 * along, 2 * across, angle=angle, fill=False, color=palette.BEAM))
        # Beside the footprint, whose lines would cross the number.
        edge = shot.y + rendered.pixel_lines.max()
        style: dict[str, Any] = {"ha": "center", "va": "bottom", "fontweight": "bold", "fontsize": "large"}
        style |= {"path_effects": [withStroke(linewidth=3, foreground="white")], "textcoords": "offset points"}
        ax.annotate(f"{number}", (shot.x, edge), (0, 2), **style)
    ax.set_aspect("equal")
    turn = math.degrees(rendered.azimuth)
    beam = "+x" if abs(turn) < 1e-4 else f"{abs(turn):.3g}° from +x towards {'+' if turn > 0 else '-'}y"
    ax.set_title(f"from above, beam along {beam}", fontsize="small")
    ax.set(xlabel="x (m)", ylabel="y (m)")


def _time_limits(results: Sequence[xr.Dataset]) -> tuple[float, float]:
    """Return all shots' echo windows, extended to where a pixel's power exceeds 0.5 % of its peak [ns].

    A crest's echoes are earlier than the window, which fits the mean sea level.
    """
    ends = []
    for result in results:
        power = np.nan_to_num(result["waveform"].values.reshape(-1, result.sizes["time"]))
        lit = result["time"].values[(power > _FAINT * power.max(axis=-1, keepdims=True)).any(axis=0)]
        ends.append((*drawing.time_limits(result), *lit[[0, -1]]) if lit.size else drawing.time_limits(result))
    return min(map(min, ends), default=0.0), max(map(max, ends), default=1.0)


def _draw_waveforms(ax: Axes, name: str, shot: Shot, result: xr.Dataset) -> None:
    """Draw a shot's waveforms, with the slopes that the beam meets."""
    power = result["waveform"].values.reshape(-1, result.sizes["time"])
    for values, style in zip(power, palette.curves(len(power)), strict=True):
        ax.plot(result["time"].values, 1e3 * values, linewidth=1.1, **style)
    ax.set_ylim(0, None)
    slopes = f"{math.degrees(math.atan(shot.along)):+.1f}°, {math.degrees(math.atan(shot.across)):+.1f}°"
    ax.set_title(f"{name} ({slopes})", fontsize="medium")
    ax.set(xlabel="time (ns)", ylabel="power (mW)")


_LABELS = {
    "strength": "power of the surface echo (log10 W)",
    "separation": "delay, far after near pair (ns)",
    "sideways": "delay, green after red (ns)",
    "depth": "depth minus true depth (m)",
}


def plot_shot_statistics(shots: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw echo strength, times and depths against the slopes that the beam meets.

    `shots` is a result of `studies.shots.shot_statistics`; a receiver without 2x2 pixels raises `UserError`.
    """
    figure = drawing.new_figure(path, 9.6, 7.0)
    effects, correlations = slope_effects(shots), slope_correlations(shots)
    for ax, (name, (slope, value)) in zip(figure.subplots(2, 2).flat, effects.items(), strict=True):
        ax.plot(np.degrees(np.arctan(slope)), value, ".", color=palette.BLUE, markersize=4)
        along = "mean rise to the left (deg)" if name == "sideways" else "mean slope towards the lidar (deg)"
        finish(ax, xlabel=along, ylabel=_LABELS[name])
        ax.set_title(
            f"correlation {correlations[name]:+.2f}, {np.isfinite(value).sum()} of {value.size} shots", fontsize="small"
        )
        if name == "depth":
            slopes = np.linspace(slope.min(), slope.max(), 100)
            names = ("scene.bottom_depth", "off_nadir_deg", "refractive_index")
            depth, off_nadir_deg, index = (float(shots.attrs[attribute]) for attribute in names)
            bias = depth_bias(slopes, depth, math.radians(off_nadir_deg), index)
            ax.plot(np.degrees(np.arctan(slopes)), bias, color=palette.RED, label="refraction alone")
            ax.legend(frameon=False)
    figure.suptitle(drawing.titled(shots.attrs, f"{shots.sizes['shot']} shots"))
    return drawing.save(figure, path)


def plot_retrieval(found: xr.Dataset, path: drawing.FilePath | None = None) -> Figure:
    """Draw the estimates for a shot series against the truth, with their standard errors if known.

    `found` is a result of `analysis.retrieval.retrieve.retrieve` for a series from
    `rendering.shots.series.render_shots`.

    Raises UserError if the shots have no truth.
    """
    figure = drawing.new_figure(path, 9.6, 9.0)
    shown = [(one, one.truth) for one in estimates(found) if one.truth is not None]
    if not shown:
        raise UserError("found has no truth: it must come from a series of shots with true slopes and depths")
    for ax, (one, truth) in zip(figure.subplots(2, 2).flat, shown, strict=False):
        varied = bool(np.any(truth != truth[0]))
        x, label = (truth, f"true {one.head}") if varied else (np.arange(len(truth)), "shot")
        ax.errorbar(x, one.values, one.errors, fmt=".", color=palette.BLUE, markersize=5, linewidth=0.7)
        middle = float(np.mean(truth[np.isfinite(truth)])) if np.isfinite(truth).any() else 0.0
        ax.axline((middle if varied else 0.0, middle), slope=float(varied), color="0.5", linewidth=0.9)
        ax.set_title(truth_statistics(one).partition(": ")[2].replace(", rms of", ",\nrms of"), fontsize="small")
        ax.locator_params(nbins=6)
        drawing.finish(ax, xlabel=label, ylabel=f"estimated {one.head}")
    bars = Line2D([], [], color=palette.BLUE, marker=".", label="estimates, ±1 standard error")
    line = Line2D([], [], color="0.5", linewidth=0.9, label="truth")
    figure.legend(handles=[bars, line], loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(drawing.titled(found.attrs, f"{found.sizes['shot']} shots"))
    return drawing.save(figure, path)
