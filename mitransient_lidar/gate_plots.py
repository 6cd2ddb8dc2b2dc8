"""Pictures of gate stacks: contact sheet and movie, and from `gate_echo_plots` depth map and contrast of a target."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from mitransient_lidar import gate_drawing
from mitransient_lidar.errors import UserError
from mitransient_lidar.gate_echo_plots import contrast_curve, depth_map
from mitransient_lidar.gate_files import check_stack
from mitransient_lidar.results import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["animation", "contact_sheet", "contrast_curve", "depth_map"]

_SHOWN_GATES = 36  # on a contact sheet
_FRAMES_PER_SECOND = 8
_FRAME_DPI = 100
_LISTED_PIXELS = 12  # more have no legend
_PIXEL_DECADES = 5  # at most, on the logarithmic axis of few pixels


def contact_sheet(dataset: xr.Dataset, path: str | os.PathLike[str], log: bool = False) -> None:
    """Draw the gates side by side on one common scale; of few pixels, their energy against depth.

    Of more than 36 gates every second, third, ... one is drawn. The colours end at the brightest gate below the surface
    (at its 99th percentile), so that the surface echo does not darken the rest; the colour bar says how many values are
    brighter.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack, see `mitransient_lidar.gate_files`.
    path : path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.
    log : bool
        Colours, or the axis of few pixels, over the logarithm of the energy.

    Raises
    ------
    UserError
        If the dataset is no gate stack, the suffix is another one, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format

    check_format(Path(path))
    stack = check_stack(dataset)
    if "pixel" in stack.dims:
        gate_drawing.save(_draw_pixel_gates(stack, log=log), path)
        return
    energy = stack["gate_energy"].values
    shown = range(0, stack.sizes["gate"], math.ceil(stack.sizes["gate"] / _SHOWN_GATES))
    columns = _columns(len(shown))
    rows = math.ceil(len(shown) / columns)
    left, right, near, far = extent = gate_drawing.extent_mrad(stack)
    panel = 8.7 / columns * min(max((far - near) / (right - left), 0.3), 2.0)  # height in inches
    figure = Figure(figsize=(9.6, rows * (panel + 0.34) + 1.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    scale = gate_drawing.colour_scale(stack, log=log)
    for ax in axes.flat[len(shown) :]:
        ax.set_axis_off()
    for place, (index, ax) in enumerate(zip(shown, axes.flat, strict=False)):
        image = gate_drawing.draw_image(ax, energy[..., index] / scale.factor, extent, scale.norm)
        ax.set_title("\n".join(gate_drawing.caption(stack, index)), fontsize=8.5, linespacing=1.15, pad=3)
        ax.tick_params(labelsize=8, labelleft=place % columns == 0, labelbottom=place + columns >= len(shown))
        ax.locator_params(nbins=4)
    figure.supxlabel("across, gy (mrad)", fontsize=10)
    figure.supylabel("away from nadir, gx (mrad)", fontsize=10)
    figure.suptitle(gate_drawing.sheet_title(stack, len(shown)), fontsize=12)
    scale.add_bar(figure, image, axes, location="top", fraction=0.05, aspect=60, shrink=0.8)
    gate_drawing.save(figure, path)


def check_movie(stack: xr.Dataset, path: Path) -> None:
    """Raise a UserError where a movie of a gate stack cannot be made: of single pixels, or .mp4 without ffmpeg."""
    from matplotlib.animation import FFMpegWriter

    if "pixel" in stack.dims:
        raise UserError(
            f"cannot write {path}: a movie needs images, but this stack has {stack.sizes['pixel']} single pixels; "
            "draw its contact sheet."
        )
    if path.suffix.lower() == ".mp4" and not FFMpegWriter.isAvailable():
        raise UserError(f"cannot write {path}: .mp4 needs the program ffmpeg, which is not installed; choose .gif.")


def animation(dataset: xr.Dataset, path: str | os.PathLike[str], log: bool = False) -> None:
    """Make a movie of the gates: one frame each, beside the mean energy against depth.

    The colours are those of `contact_sheet`.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack of an imager.
    path : path
        File to write, ending in ``.gif`` or, where the program ffmpeg is installed, ``.mp4``.
    log : bool
        Colours over the logarithm of the energy.

    Raises
    ------
    UserError
        If the dataset is no gate stack of an imager, the suffix is another one, ffmpeg is needed and missing or fails,
        or the file cannot be written.
    """
    from subprocess import CalledProcessError

    from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise UserError(f"cannot write {path}: the file name of a movie must end in .gif or .mp4.")
    stack = check_stack(dataset)
    check_movie(stack, path)
    figure, show = _movie_figure(stack, log=log)
    # The layout is settled once: frames must not shift against each other.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    kind: type[AbstractMovieWriter] = PillowWriter if suffix == ".gif" else FFMpegWriter
    writer = kind(fps=_FRAMES_PER_SECOND)
    with replacing(path) as temporary:
        try:
            with writer.saving(figure, os.fspath(temporary), _FRAME_DPI):
                for index in range(stack.sizes["gate"]):
                    show(index)
                    writer.grab_frame()
        except CalledProcessError as error:
            raise UserError(f"cannot write {path}: ffmpeg ended with the error {error.returncode}.") from error


def _columns(count: int) -> int:
    """Return how many of the images stand side by side: 6 of many, less where that leaves fewer gaps."""
    if count <= 3:
        return count
    return min(range(3, 7), key=lambda columns: -count % columns + 1.2 * abs(columns - min(6.0, 1.3 * count**0.5)))


def _movie_figure(stack: xr.Dataset, *, log: bool) -> tuple[Figure, Callable[[int], None]]:
    """Return the figure of a movie and what shows a gate in it."""
    from matplotlib.figure import Figure

    energy = stack["gate_energy"].values
    scale = gate_drawing.colour_scale(stack, log=log)
    figure = Figure(figsize=(8.4, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2.3, 1))
    image = gate_drawing.draw_image(left, energy[..., 0] / scale.factor, gate_drawing.extent_mrad(stack), scale.norm)
    left.set_xlabel("across, gy (mrad)")
    left.set_ylabel("away from nadir, gx (mrad)")
    label = scale.label.replace("; ", "\n")
    scale.add_bar(figure, image, left, label, location="bottom", aspect=40, shrink=0.9)
    depths = gate_drawing.known_depths(stack)
    axis = stack["gate_start"].values if depths is None else depths
    mean = energy.mean(axis=(0, 1)) / scale.factor
    right.plot(mean, axis, color="0.25", linewidth=1.2)
    (marker,) = right.plot([], [], "o", color="#d4472e", markersize=8, clip_on=False)
    top = float(np.nanmax(mean, initial=0.0))
    if top > 0:
        right.set_xscale("log")
        right.set_xlim(max(1e-4 * top, 0.5 * float(np.nanmin(mean[mean > 0]))), 2 * top)
    right.invert_yaxis()
    right.yaxis.set(ticks_position="right", label_position="right")
    right.set_ylabel("opening of the gate (ns)" if depths is None else "depth (m)")
    right.set_xlabel(f"mean over the image ({scale.unit})")
    right.grid(True, color="0.9", linewidth=0.7)
    title = figure.suptitle("gate", fontsize=12)

    def show(index: int) -> None:
        image.set_data(energy[..., index] / scale.factor)
        # A mean off the logarithmic axis has its marker at the edge.
        marker.set_data([max(mean[index], right.get_xlim()[0])], [axis[index]])
        which, when = gate_drawing.caption(stack, index)
        title.set_text(
            f"{gate_drawing.scene_name(stack)}gate {which.removeprefix('#').replace('  ', '  ·  ')}  ·  {when}"
        )

    show(0)
    return figure, show


def _draw_pixel_gates(stack: xr.Dataset, *, log: bool) -> Figure:
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import colours, si_prefix

    names = [str(name) for name in stack["pixel"].values]
    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    top = float(np.nanmax(energy, initial=0.0))
    factor, prefix = si_prefix(top)
    significant = energy[energy > gate_drawing.SIGNIFICANT * stderr]
    floor = max(0.5 * float(significant.min(initial=top)), top * 10.0**-_PIXEL_DECADES) / factor
    depths = gate_drawing.known_depths(stack)
    axis = stack["gate_start"].values if depths is None else depths
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    ax = figure.subplots()
    for values, spread, name, colour in zip(energy / factor, stderr / factor, names, colours(len(names)), strict=True):
        ax.plot(axis, values, "o-", color=colour, linewidth=1.3, markersize=3.5, label=name)
        # A logarithmic axis has no place for the part of a band below zero.
        low = np.maximum(values - spread, 1e-3 * floor) if log else values - spread
        ax.fill_between(axis, low, values + spread, color=colour, alpha=0.2, linewidth=0)
    if log and top > 0:
        ax.set_yscale("log")
        ax.set_ylim(floor, 2 * top / factor)
    if len(names) <= _LISTED_PIXELS:
        ax.legend(title="pixel", frameon=False)
    ax.set_xlabel("opening of the gate (ns)" if depths is None else "depth of the gate's middle (m)")
    ax.set_ylabel(f"energy in the gate ({prefix}J)")
    ax.grid(True, color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.set_title(gate_drawing.sheet_title(stack, stack.sizes["gate"]))
    return figure
