"""What gate stacks tell of targets, drawn: the depth of the echo in every pixel, the contrast to the background."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import gate_drawing
from mitransient_lidar.errors import UserError
from mitransient_lidar.gate_files import check_stack
from mitransient_lidar.optics.gate_images import RangeImage, contrast, range_from_gates

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NAMED_PIXELS = 16  # on an axis


def depth_map(dataset: xr.Dataset, path: str | os.PathLike[str], from_depth: float | None = None) -> None:
    """Draw the depth that `optics.gate_images.range_from_gates` finds in every pixel, and how sure it is.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack with the coordinate ``gate_depth``.
    path : path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.
    from_depth : float, optional
        Leave out gates whose middle is less deep [m]. By default those that the surface echo reaches.

    Raises
    ------
    UserError
        If the dataset is no gate stack, has no depths, fewer than three gates are left, the suffix is another one, or
        the file cannot be written.
    """
    from mitransient_lidar.plotting import check_format

    check_format(Path(path))
    stack = check_stack(dataset)
    depths = gate_drawing.known_depths(stack)
    if depths is None:
        raise UserError(f"cannot write {path}: the stack has no gate_depth, as the time of its surface is not known.")
    used = ~gate_drawing.reached_by_surface(stack) if from_depth is None else depths >= from_depth
    if np.count_nonzero(used) < 3:
        reason = "below the surface echo" if from_depth is None else f"from from_depth = {from_depth:g} m on"
        raise UserError(
            f"cannot write {path}: {np.count_nonzero(used)} of {depths.size} gates lie {reason}, but 3 are needed."
        )
    stack, depths = stack.isel(gate=used), depths[used]
    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    found = range_from_gates(energy, stderr, depths, reach=_reach(stack))
    figure = (_draw_pixel_depths if "pixel" in stack.dims else _draw_depth_image)(stack, found)
    name = gate_drawing.scene_name(stack)
    figure.suptitle(f"{name}depth of the strongest echo, gates at {depths.min():.2f} to {depths.max():.2f} m")
    gate_drawing.save(figure, path)


def contrast_curve(
    dataset: xr.Dataset, path: str | os.PathLike[str], target: npt.ArrayLike, background: npt.ArrayLike
) -> None:
    """Draw how a target's contrast against its background goes with the delay of the gate.

    The contrast is Weber's (t - b) / b of the mean energies t and b of the two groups of pixels. Bars are one standard
    error if the errors of the pixels are independent; the band is its bound, reached if those within a group are
    fully correlated, as they partly are where pixels share photons. Gates whose background is below three standard
    errors are left out.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack.
    path : path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.
    target, background : array_like of bool, shape (row, column) or (pixel,)
        The pixels of either.

    Raises
    ------
    UserError
        If the dataset is no gate stack, a mask has another shape, is empty or shares pixels with the other one, no
        gate has a background, the suffix is another one, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format

    check_format(Path(path))
    stack = check_stack(dataset)
    shape = stack["gate_energy"].shape[:-1]
    masks = {"target": np.asarray(target, dtype=bool), "background": np.asarray(background, dtype=bool)}
    for name, mask in masks.items():
        if mask.shape != shape or not mask.any():
            raise UserError(
                f"{name} selects {np.count_nonzero(mask)} pixels of an array of shape {mask.shape}, but must select at "
                f"least one of {shape}."
            )
    if shared := np.count_nonzero(masks["target"] & masks["background"]):
        raise UserError(f"target and background must have no pixels in common, but share {shared}.")
    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    means = {name: energy[mask].mean(axis=0) for name, mask in masks.items()}
    independent = {name: np.sqrt((stderr[mask] ** 2).sum(axis=0)) / mask.sum() for name, mask in masks.items()}
    correlated = {name: stderr[mask].mean(axis=0) for name, mask in masks.items()}
    known = means["background"] > gate_drawing.SIGNIFICANT * independent["background"]
    if not known.any():
        raise UserError("the background is below three standard errors in every gate, so there is no contrast to draw.")
    t, b = (means[name][known] for name in masks)
    bars, bound = (
        contrast(t, b, errors["target"][known], errors["background"][known]) for errors in (independent, correlated)
    )
    start = stack["gate_start"].values[known]
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    ax = figure.subplots()
    ax.axhline(0, color="0.55", linewidth=0.9)
    low, high = (bound.weber + sign * bound.weber_stderr for sign in (-1, 1))
    ax.fill_between(
        start, low, high, color="#1f5fd6", alpha=0.16, linewidth=0, label="if pixels share their errors (bound)"
    )
    ax.errorbar(
        start,
        bars.weber,
        yerr=bars.weber_stderr,
        fmt="o-",
        color="#1f5fd6",
        linewidth=1.3,
        markersize=4,
        capsize=3,
        label="if their errors are independent",
    )
    ax.set_xlabel("delay of the gate: its opening since the pulse left the transmitter (ns)")
    ax.set_ylabel("contrast (target - background) / background")
    ax.grid(True, color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.legend(frameon=False, title="one standard error")
    depths = gate_drawing.known_depths(stack)
    if depths is not None and depths.size > 1:
        first, last = stack["gate_start"].values[[0, -1]]
        slope = (depths[-1] - depths[0]) / (last - first)
        over = ax.secondary_xaxis(
            "top", functions=(lambda ns: depths[0] + (ns - first) * slope, lambda m: first + (m - depths[0]) / slope)
        )
        over.set_xlabel("depth of the gate's middle (m)")
    pixels = f"{masks['target'].sum()} pixels against {masks['background'].sum()}"
    figure.suptitle(f"{gate_drawing.scene_name(stack)}contrast of the target, {pixels}")
    gate_drawing.save(figure, path)


def _reach(stack: xr.Dataset) -> int | None:
    """Return how many gates on each side of its strongest one an echo fills; None where the pulse is not known."""
    from mitransient_lidar.plotting import number

    pulse = number(stack.attrs, "pulse_fwhm_ns")
    if pulse is None:
        return None
    step = float(np.median(np.diff(stack["gate_start"].values)))
    half = 0.5 * float(stack["gate_width"].values.max()) + pulse
    return min(max(1, math.ceil(half / step - 0.5)), (stack.sizes["gate"] - 3) // 2)


def _draw_depth_image(stack: xr.Dataset, found: RangeImage) -> Figure:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    depth, confidence = found.depth, np.clip(np.nan_to_num(found.confidence), 0.0, 1.0)
    extent = gate_drawing.extent_mrad(stack)
    figure = Figure(figsize=(9.6, 4.3), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    sure = np.isfinite(depth) & (confidence >= 0.5)
    low, high = np.percentile(depth[sure], (0.5, 99.5)) if sure.any() else (0.0, 1.0)
    if high - low < 0.01:
        low, high = low - 0.005, high + 0.005
    # Reversed: the deeper, the darker.
    colours = ScalarMappable(Normalize(low, high), "viridis_r")
    left.imshow(depth, extent=extent, norm=colours.norm, cmap=colours.cmap, alpha=confidence)
    bar = figure.colorbar(colours, ax=left, extend="both", aspect=25, shrink=0.9)
    bar.ax.invert_yaxis()
    bar.set_label("depth (m)")
    image = right.imshow(confidence, extent=extent, cmap="gray", vmin=0, vmax=1)
    figure.colorbar(image, ax=right, aspect=25, shrink=0.9).set_label("confidence")
    middle = f"; standard error {100 * np.median(found.sigma[sure]):.2g} cm" if sure.any() else ""
    left.set_title(f"depth, paler where unsure{middle}", fontsize=10)
    right.set_title("confidence that there is an echo", fontsize=10)
    left.set_ylabel("away from nadir, gx (mrad)")
    for ax in (left, right):
        ax.set_xlabel("across, gy (mrad)")
    return figure


def _draw_pixel_depths(stack: xr.Dataset, found: RangeImage) -> Figure:
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import colours

    names = [str(name) for name in stack["pixel"].values]
    confidence = np.clip(np.nan_to_num(found.confidence), 0.0, 1.0)
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    places = np.arange(len(names))
    for place, colour in zip(places, colours(len(names)), strict=True):
        opacity = max(float(confidence[place]), 0.15)
        error = found.sigma[place]
        upper.errorbar(place, found.depth[place], error, fmt="o", capsize=4, color=colour, alpha=opacity)
        lower.bar(place, confidence[place], width=0.3, color=colour)
    upper.invert_yaxis()
    upper.set_ylabel("depth (m), paler where unsure")
    lower.set(ylabel="confidence", ylim=(0, 1), xlabel="pixel", xlim=(-0.6, len(names) - 0.4))
    step = math.ceil(len(names) / _NAMED_PIXELS)
    lower.set_xticks(places[::step], names[::step])
    for ax in (upper, lower):
        ax.grid(True, axis="y", color="0.9", linewidth=0.7)
        ax.set_axisbelow(True)
    return figure
