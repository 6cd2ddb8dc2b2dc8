"""Echo depths in a gate stack."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from mitransient_lidar.analysis.gates.range_images import DepthImage, depth_image
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.plots.gates.images import known_depths, reached_by_surface
from mitransient_lidar.results.gate_stack import as_stack, has_frames
from mitransient_lidar.results.geometry import optional_number

_NAMED_PIXELS = 16  # on an axis


def plot_depths(dataset: xr.Dataset, path: drawing.FilePath | None = None, from_depth: float | None = None) -> Figure:
    """Draw the depth of the strongest echo in every pixel, and its confidence, from `range_images.depth_image`.

    `dataset`: a gate stack with the coordinate ``gate_depth``. `path`: file to write. `from_depth`: leave out gates
    whose middle is shallower on the axis [m]; by default gates that open before the surface echo's end. Raises
    `UserError` if the dataset is no gate stack, has no depths, or fewer than three gates are left.
    """
    figure = drawing.new_figure(path, 9.6, 4.3)
    stack = as_stack(dataset)
    depths = known_depths(stack)
    if depths is None:
        raise UserError("the stack has no gate_depth, since the time of its surface echo is unknown")
    used = ~reached_by_surface(stack) if from_depth is None else depths >= from_depth
    count = int(np.count_nonzero(used))
    if count < 3:
        place = "below the surface echo" if from_depth is None else f"below from_depth = {from_depth:g} m"
        raise UserError(f"{count} of {depths.size} gates lie {place}, but a drawing of depths needs at least 3")
    # The last gates, as a view.
    last = slice(depths.size - count, None)
    stack, depths = stack.isel(gate=last), depths[last]
    given = dataset.isel(gate=last) if has_frames(dataset) else stack
    found = depth_image(given, reach=_reach(stack))
    (_draw_pixel_depths if "pixel" in stack.dims else _draw_depth_image)(figure, stack, found)
    text = f"depth of the strongest echo, gates at {depths.min():.2f} to {depths.max():.2f} m on the axis"
    figure.suptitle(drawing.titled(stack.attrs, text))
    return drawing.save(figure, path)


def _reach(stack: xr.Dataset) -> int | None:
    """Return how many gates an echo fills on each side of its strongest one; None for an unknown pulse."""
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
    colours = ScalarMappable(Normalize(low, high), f"{palette.SEQUENCE}_r")
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
    for place, colour in enumerate(palette.pixel_colours(len(names))):
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
