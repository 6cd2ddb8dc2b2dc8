"""Depths of echoes, and contrast of a target, in a gate stack."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from mitransient_lidar.analysis.gates.range_images import DepthImage, contrast, depth_image
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import drawing
from mitransient_lidar.plots.gates.images import SIGNIFICANT, known_depths, reached_by_surface
from mitransient_lidar.results.gate_files import check_stack
from mitransient_lidar.results.geometry import optional_number

_NAMED_PIXELS = 16  # on an axis
_CONTRAST_COLOUR = "#1f5fd6"


def plot_depths(dataset: xr.Dataset, path: drawing.FilePath | None = None, from_depth: float | None = None) -> Figure:
    """Draw the depth of the strongest echo in every pixel, and its confidence, from `range_images.depth_image`.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack with the coordinate ``gate_depth``.
    path : path, optional
        File to write.
    from_depth : float, optional
        Leave out gates whose middle is shallower on the axis [m]; by default those that open before the end of the
        surface echo.

    Raises
    ------
    UserError
        If the dataset is no gate stack, has no depths, or fewer than three gates are left.
    """
    figure = drawing.new_figure(path, 9.6, 4.3)
    stack = check_stack(dataset)
    depths = known_depths(stack)
    if depths is None:
        raise UserError("the stack has no gate_depth, since the time of its surface echo is unknown.")
    used = ~reached_by_surface(stack) if from_depth is None else depths >= from_depth
    count = np.count_nonzero(used)
    if count < 3:
        place = "below the surface echo" if from_depth is None else f"below from_depth = {from_depth:g} m"
        raise UserError(f"{count} of {depths.size} gates lie {place}, but a drawing of depths needs at least 3.")
    stack, depths = stack.isel(gate=used), depths[used]
    found = depth_image(stack, reach=_reach(stack))
    (_draw_pixel_depths if "pixel" in stack.dims else _draw_depth_image)(figure, stack, found)
    text = f"depth of the strongest echo, gates at {depths.min():.2f} to {depths.max():.2f} m on the axis"
    figure.suptitle(drawing.titled(stack.attrs, text))
    return drawing.save(figure, path)


def plot_contrast(
    dataset: xr.Dataset, target: npt.ArrayLike, background: npt.ArrayLike, path: drawing.FilePath | None = None
) -> Figure:
    """Draw the contrast of a target against its background in a gate stack, against the start of the gate.

    The contrast is Weber's (t - b) / b of the mean energies t and b of two groups of pixels, selected by masks of shape
    (row, column) or (pixel,). Bars are one standard error if the errors of the pixels are independent; the band is its
    bound, reached if those within a group are fully correlated, as they partly are where pixels share photons. Gates
    whose background is below three standard errors are left out.

    Raises
    ------
    UserError
        If the dataset is no gate stack, a mask has another shape, is empty or shares pixels with the other one, or no
        gate has a background.
    """
    figure = drawing.new_figure(path, 9.6, 4.6)
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
    known = means["background"] > SIGNIFICANT * independent["background"]
    if not known.any():
        raise UserError("the background is below three standard errors in every gate: there is no contrast to draw.")
    t, b = (means[name][known] for name in masks)
    bars, bound = (contrast(t, b, *(errors[name][known] for name in masks)) for errors in (independent, correlated))
    starts = stack["gate_start"].values
    ax = figure.subplots()
    ax.axhline(0, color="0.55", linewidth=0.9)
    low, high = (bound.weber + sign * bound.weber_stderr for sign in (-1, 1))
    label = "fully correlated errors (bound)"
    ax.fill_between(starts[known], low, high, color=_CONTRAST_COLOUR, alpha=0.16, linewidth=0, label=label)
    style: dict[str, Any] = {"color": _CONTRAST_COLOUR, "linewidth": 1.3, "markersize": 4, "capsize": 3}
    ax.errorbar(starts[known], bars.weber, bars.weber_stderr, fmt="o-", label="independent errors", **style)
    ax.set_xlabel("start of the gate since the pulse left the transmitter (ns)")
    ax.set_ylabel("contrast (target - background) / background")
    drawing.add_grid(ax)
    ax.legend(frameon=False, title="one standard error")
    depths = known_depths(stack)
    if depths is not None and depths.size > 1:
        slope = (depths[-1] - depths[0]) / (starts[-1] - starts[0])
        drawing.add_top_axis(ax, depths[0] - slope * starts[0], slope, "depth of the gate's middle on the axis (m)")
    pixels = f"{masks['target'].sum()} pixels against {masks['background'].sum()}"
    figure.suptitle(drawing.titled(stack.attrs, f"contrast of the target, {pixels}"))
    return drawing.save(figure, path)


def _reach(stack: xr.Dataset) -> int | None:
    """Return the number of gates on each side of its strongest one that an echo fills; None for an unknown pulse."""
    pulse = optional_number(stack.attrs, "pulse_fwhm_ns")
    if pulse is None:
        return None
    step = float(np.median(np.diff(stack["gate_start"].values)))
    half = 0.5 * float(stack["gate_width"].values.max()) + pulse
    return min(max(1, math.ceil(half / step - 0.5)), (stack.sizes["gate"] - 3) // 2)


def _draw_depth_image(figure: Figure, stack: xr.Dataset, found: DepthImage) -> None:
    depth, confidence = found.depth, np.clip(np.nan_to_num(found.confidence), 0.0, 1.0)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    sure = np.isfinite(depth) & (confidence >= 0.5)
    low, high = np.percentile(depth[sure], (0.5, 99.5)) if sure.any() else (0.0, 1.0)
    if high - low < 0.01:
        low, high = low - 0.005, high + 0.005
    # Reversed: the deeper, the darker.
    colours = ScalarMappable(Normalize(low, high), "viridis_r")
    drawing.draw_image(left, depth, stack, norm=colours.norm, cmap=colours.cmap, alpha=confidence)
    bar = figure.colorbar(colours, ax=left, extend="both", aspect=25, shrink=0.9, label="depth (m)")
    bar.ax.invert_yaxis()
    image = drawing.draw_image(right, confidence, stack, cmap="gray", vmin=0, vmax=1)
    figure.colorbar(image, ax=right, aspect=25, shrink=0.9, label="confidence")
    error = ""
    if sure.any():
        parts = [(found.sigma, "noise"), (found.method_error, "method")]
        medians = [(float(np.median(one[sure])), by) for one, by in parts]
        known = [f"{100 * value:.2g} cm by {by}" for value, by in medians if math.isfinite(value)]
        error = f"\nstandard error (median) {', '.join(known)}"
    left.set_title(f"depth, pale where uncertain{error}", fontsize=10)
    right.set_title("confidence that there is an echo", fontsize=10)
    right.set_ylabel("")


def _draw_pixel_depths(figure: Figure, stack: xr.Dataset, found: DepthImage) -> None:
    names = [str(name) for name in stack["pixel"].values]
    confidence = np.clip(np.nan_to_num(found.confidence), 0.0, 1.0)
    figure.set_figheight(4.6)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for place, colour in enumerate(drawing.pixel_colours(len(names))):
        style = {"color": colour, "alpha": max(float(confidence[place]), 0.15)}
        stated = np.hypot(found.sigma[place], np.nan_to_num(found.method_error[place]))
        upper.errorbar(place, found.depth[place], stated, fmt="o", capsize=4, **style)
        lower.bar(place, confidence[place], width=0.3, color=colour)
    upper.invert_yaxis()
    upper.set_ylabel("depth (m), pale where uncertain")
    lower.set(ylabel="confidence", ylim=(0, 1), xlabel="pixel", xlim=(-0.6, len(names) - 0.4))
    step = math.ceil(len(names) / _NAMED_PIXELS)
    lower.set_xticks(range(0, len(names), step), names[::step])
    for ax in (upper, lower):
        drawing.add_grid(ax, "y")
