"""Elements shared by all figures: file, text sizes, legends, units, titles, axes, panels and images."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import XAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Line
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.results.geometry import optional_number
from mitransient_lidar.results.waveform_files import FILE

FilePath = str | os.PathLike[str]

TIME_LABEL = "time since the pulse left the transmitter (ns)"
_RECORD_TIME = "time since the start of each waveform (ns)"
ANGLE_X_LABEL, ANGLE_Y_LABEL = "away from nadir, angle_x (mrad)", "to the left, angle_y (mrad)"

LISTED_PIXELS = 12  #: Most pixels that a legend lists by name.

_FORMATS = (".png", ".pdf", ".svg")
_DPI = 160
_PAGE_INCHES, _LEAST_POINTS = 7.0, 7.0  # width of a page, and size of the smallest text on it
_PREFIXES = {9: "G", 6: "M", 3: "k", 0: "", -3: "m", -6: "µ", -9: "n", -12: "p", -15: "f", -18: "a"}


class _PageFigure(Figure):
    """Figure whose texts are at least 7 pt high at the width of a page, and whose legends hide no data."""

    _is_legible = False

    def draw(self, renderer: Any) -> None:
        if not self._is_legible:
            self._is_legible = True
            make_legible(self, renderer)
        super().draw(renderer)


def make_legible(figure: Figure, renderer: Any) -> None:
    """Enlarge a figure's texts to 7 pt at a page's width, wrap its title, and move legends from data to the right."""
    least = _LEAST_POINTS * figure.get_figwidth() / _PAGE_INCHES
    for ax in [one for parent in figure.axes for one in (parent, *parent.child_axes)]:
        for axis in (ax.xaxis, ax.yaxis):
            if any(float(label.get_fontsize()) < least for label in axis.get_ticklabels(which="both")):
                axis.set_tick_params(which="both", labelsize=least)
    for text in figure.findobj(Text):
        text.set_fontsize(max(float(text.get_fontsize()), least))
    for text in figure.texts:
        text.set_wrap(not text.get_rotation())
    legends = [(ax, legend) for ax in figure.axes if (legend := ax.get_legend())]
    if legends and (layout := figure.get_layout_engine()):
        layout.execute(figure)
    for ax, legend in legends:
        if _hides_data(ax, legend.get_window_extent(renderer)):
            legend.set_loc("upper left")
            legend.set_bbox_to_anchor((1.0, 1.0))


def _hides_data(ax: Axes, box: Bbox) -> bool:
    """Return whether a canvas box covers parts of lines, points, bars or bands."""
    for line in ax.lines:
        path = line.get_transform().transform_path(line.get_path()).cleaned(remove_nans=True)
        if np.size(path.vertices) and path.intersects_bbox(box, filled=False):
            return True
    for one in ax.collections:
        places = one.get_offset_transform().transform(np.ma.filled(one.get_offsets(), np.nan))
        paths = [one.get_transform().transform_path(path) for path in one.get_paths()]
        if isinstance(one, PathCollection) and box.count_contains(places):
            return True
        if not isinstance(one, PathCollection) and any(path.intersects_bbox(box) for path in paths):
            return True
    return any(box.overlaps(patch.get_window_extent()) for patch in ax.patches if isinstance(patch, Rectangle))


def check_format(path: FilePath) -> None:
    """Raise a `UserError` unless the suffix of `path` is a figure's."""
    if Path(path).suffix.lower() not in _FORMATS:
        raise UserError(f"cannot write {path}: the file name must end in {', '.join(_FORMATS[:-1])} or {_FORMATS[-1]}")


def new_figure(path: FilePath | None, width: float, height: float) -> Figure:
    """Check the format of the file to write, and return an empty figure with a size in inches."""
    if path is not None:
        check_format(path)
    return _PageFigure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: FilePath | None) -> Figure:
    """Write a figure if there is a path, replacing an existing file only on success; return the figure."""
    if path is not None:
        with replacing(path) as temporary:
            if Path(path).suffix.lower() == ".png":
                _save_png(figure, temporary)
            else:
                figure.savefig(temporary, dpi=_DPI)
    return figure


def _save_png(figure: Figure, path: Path) -> None:
    """Write `figure.savefig`'s file in three quarters of its time: it draws a figure twice."""
    resolution = figure.dpi
    figure.dpi = _DPI
    try:
        canvas: Any = FigureCanvasAgg(figure)
        canvas.print_png(path)
    finally:
        figure.dpi = resolution


def si_prefix(largest: float) -> tuple[float, str]:
    """Return the power of 1000, and its SI prefix, that scales a number to between 1 and 1000."""
    exponent = 3 * math.floor(math.log10(largest) / 3) if largest > 0 else 0
    exponent = min(max(exponent, min(_PREFIXES)), max(_PREFIXES))
    return 10.0**exponent, _PREFIXES[exponent]


def scene_name(attributes: Mapping[str, Any]) -> str:
    """Return the scene's or recorded waveforms' name without suffix, and the instrument; empty if unknown."""
    names = Path(str(attributes.get("scene", attributes.get(FILE, "")))).stem, str(attributes.get("instrument", ""))
    return ", ".join(filter(None, names))


def time_label(dataset: xr.Dataset) -> str:
    """Return what a dataset's times count from."""
    return _RECORD_TIME if FILE in dataset.attrs and not dataset.attrs["time_start_ns"] else TIME_LABEL


def titled(attributes: Mapping[str, Any], text: str) -> str:
    """Return a title that begins with the scene's name, if known."""
    scene = scene_name(attributes)
    return f"{scene}: {text}" if scene else text


def time_limits(dataset: xr.Dataset) -> tuple[float, float]:
    """Return the echo window with a margin [ns], or the full time axis if the window is unknown."""
    time, attributes = dataset["time"].values, dataset.attrs
    half = 0.5 * (optional_number(attributes, "bin_width_ns") or 1.0)
    first, last = float(time[0]) - half, float(time[-1]) + half
    start, end = (optional_number(attributes, f"window_{name}_ns") for name in ("start", "end"))
    if start is None or end is None or not first < end or not start < last or not start < end:
        return first, last
    margin = 0.06 * (end - start)
    return max(first, start - margin), min(last, end + margin)


def add_grid(ax: Axes, axis: Literal["both", "x", "y"] = "both", hide: tuple[str, ...] = ()) -> None:
    """Draw light grid lines at the major ticks, below all curves, and hide frame sides."""
    ax.grid(True, which="major", axis=axis, color="0.9", linewidth=0.7)
    ax.set_axisbelow(True)
    for side in hide:
        ax.spines[side].set_visible(False)


def plain_logarithms(axis: Any) -> None:
    """Label a logarithmic axis, or a colour bar's, with the plain numbers 1, 2, 5, 10, ..."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def outline_patch(loops: Sequence[FloatArray], **style: Any) -> PathPatch:
    """Return a pixel's shape, given its closed lines (x, y): as one patch, they keep holes open."""
    return PathPatch(Line.make_compound_path(*(Line(loop, closed=True) for loop in loops)), **style)


def add_top_axis(ax: Axes, offset: float, slope: float, label: str) -> XAxis:
    """Add an axis on top with the values `offset` + `slope` x, and return it."""
    functions = (lambda x: offset + slope * x, lambda value: (value - offset) / slope)
    top = ax.secondary_xaxis("top", functions=functions)
    top.set_xlabel(label)
    return top.xaxis


def draw_band(
    ax: Axes, x: FloatArray, y: FloatArray, error: FloatArray, *, lowest: float = -np.inf, **style: Any
) -> None:
    """Draw a curve with a band of +-`error`, cut off at `lowest`, since a logarithmic axis has no values below 0.

    An error with the shape (2, len(x)) is for below and above the curve.
    """
    (line,) = ax.plot(x, y, **style)
    below, above = np.broadcast_to(error, (2, len(y)))
    ax.fill_between(x, np.maximum(y - below, lowest), y + above, color=line.get_color(), alpha=0.22, linewidth=0)


def draw_image(ax: Axes, values: FloatArray, dataset: xr.Dataset, *, label: bool = True, **style: Any) -> AxesImage:
    """Draw values with the shape (row, column) over the pixel angles, as seen from the lidar: far is up, +y left."""
    if label:
        ax.set(xlabel=ANGLE_Y_LABEL, ylabel=ANGLE_X_LABEL)
    left, right, near, far = image_extent(dataset)
    angle_x, angle_y = dataset["angle_x"].isel(column=0).values, dataset["angle_y"].isel(row=0).values
    across = (right, left) if angle_y[-1] > angle_y[0] else (left, right)
    along = (far, near) if angle_x[-1] > angle_x[0] else (near, far)
    image = ax.imshow(values, extent=(*across, *along), origin="upper", interpolation="nearest", **style)
    ax.set(xlim=(left, right), ylim=(near, far))
    return image


def as_seen(dataset: xr.Dataset) -> xr.Dataset:
    """Return an image as seen from the lidar, row 0 far and column 0 left, whichever way a user has turned it."""
    for dim, name in (("row", "angle_x"), ("column", "angle_y")):
        angle = dataset.get(name)
        if angle is not None and angle.sizes.get(dim, 1) > 1 and bool((angle.diff(dim) > 0).all()):
            dataset = dataset.isel({dim: slice(None, None, -1)})
    return dataset


def image_extent(dataset: xr.Dataset) -> tuple[float, float, float, float]:
    """Return an image's edges [mrad]: left, the largest angle_y, right, near and far."""
    angle_x, angle_y = dataset["angle_x"].values, dataset["angle_y"].values
    along, across = (0.5 * pitch for pitch in pixel_pitch(dataset))
    left, right = float(angle_y.max() + across), float(angle_y.min() - across)
    return left, right, float(angle_x.min() - along), float(angle_x.max() + along)


def pixel_pitch(dataset: xr.Dataset) -> tuple[float, float]:
    """Return row and column spacing [mrad]; the pixels in a single row or column count as square."""
    spans = (dataset["angle_x"].isel(column=0).values, dataset["angle_y"].isel(row=0).values)
    along, across = (float(np.ptp(values)) / max(values.size - 1, 1) for values in spans)
    return along or across or 1.0, across or along or 1.0


_COLUMNS = 3  # panels side by side


def new_panels(
    path: FilePath | None, count: int, size: tuple[float, float], margin: tuple[float, float], **shared: Any
) -> tuple[Figure, list[Axes], list[Axes], list[Axes]]:
    """Return a figure with panels, a size in inches each, at most three side by side; all, the lowest and first panels.

    `margin` is added to width and height, and `shared` states which axes are.
    """
    columns = min(_COLUMNS, count)
    rows = -(-count // columns)
    figure = new_figure(path, size[0] * columns + margin[0], size[1] * rows + margin[1])
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for ax in axes.flat[count:]:
        ax.axis("off")
    shown = list(axes.flat[:count])
    return figure, shown, shown[-columns:], shown[::columns]


def finish(
    ax: Axes,
    title: str = "",
    *,
    grid: Literal["both", "x"] = "both",
    hide: tuple[str, ...] = (),
    zero: float | None = None,
    **given: Any,
) -> None:
    """Add a title, a grid and a line at a value to a panel, hide frame sides, and set labels, limits and scales."""
    if title:
        ax.set_title(title, fontsize="medium")
    if zero is not None:
        ax.axhline(zero, color="0.6", linewidth=0.8)
    ax.set(**given)
    add_grid(ax, grid, hide)


def name_sides(
    figure: Figure, lowest: Sequence[Axes], x: str, first: Sequence[Axes], y: str, title: str | None = None
) -> None:
    """Label the axes below and to the left of panels, and list the first one's curves on the right."""
    for ax in lowest:
        ax.set_xlabel(x)
        ax.tick_params(labelbottom=True)
    for ax in first:
        ax.set_ylabel(y)
    handles, labels = first[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, title=title)
