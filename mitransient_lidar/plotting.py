"""Figures of results: waveforms of few pixels, images of many."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import matplotlib
import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle
from scipy.constants import speed_of_light

from mitransient_lidar.errors import UserError
from mitransient_lidar.results import replacing

Scale = Literal["both", "linear", "log"]

_FOUR = ("#d81e1e", "#17963f", "#1f5fd6", "#111111")  # red, green, blue, black: the published pixels
_PREFIXES = {9: "G", 6: "M", 3: "k", 0: "", -3: "m", -6: "µ", -9: "n", -12: "p", -15: "f", -18: "a"}
_FORMATS = (".png", ".pdf", ".svg")
_LISTED_PIXELS = 12  # more have no legend and no error bands
_DECADES = 7  # at most, on a logarithmic axis


def plot_waveforms(dataset: xr.Dataset, path: str | os.PathLike[str] | None = None, scale: Scale = "both") -> Figure:
    """Draw a result: its waveforms, or for an imager the total energy and the summed waveform.

    Bands are +-1 standard error. The depth axis holds along the axis of the receiver,
    depth = (t - t_surface) c0 / (2 n_g) cos(theta_water); without the attributes that it needs it is left out, and
    likewise the drawing of the pixels.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of `mitransient_lidar.results`.
    path : path, optional
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.
    scale : {'both', 'linear', 'log'}
        Scale of the power axis; 'both' draws two panels.

    Returns
    -------
    matplotlib.figure.Figure
        Independent of pyplot; needs no closing.

    Raises
    ------
    ValueError
        If `scale` is another one.
    UserError
        If the suffix of `path` is another one, or the file cannot be written.
    """
    if scale not in get_args(Scale):
        raise ValueError(f"scale = {scale!r} must be one of {', '.join(get_args(Scale))}.")
    if path is not None:
        check_format(Path(path))

    panels = ["linear", "log"] if scale == "both" else [scale]
    figure = Figure(figsize=(9.6, 4.3 if len(panels) == 1 else 6.0), layout="constrained")
    is_image = "pixel" not in dataset.dims
    grid = figure.add_gridspec(len(panels), 2, width_ratios=(1.6, 1.0) if is_image else (4.2, 1.3))
    axes: list[Axes] = []
    for row in range(len(panels)):
        axes.append(figure.add_subplot(grid[row, 0], sharex=axes[0] if axes else None))
    side = figure.add_subplot(grid[:, 1])

    if is_image:
        palette = colours(1)
        power = dataset["waveform"].sum(("row", "column")).values[np.newaxis]
        # Pixels share photons: their errors do not add up in quadrature, and the error of the sum is not known.
        error = np.zeros_like(power)
        _draw_image(figure, side, dataset)
    else:
        names = [str(name) for name in dataset["pixel"].values]
        palette = colours(len(names))
        power, error = dataset["waveform"].values, dataset["waveform_stderr"].values
        _draw_pixels(side, dataset, names, palette)

    limits = time_limits(dataset)
    for ax, panel in zip(axes, panels, strict=True):
        _draw_waveforms(ax, dataset["time"].values, power, error, palette, limits, log=panel == "log")
    for ax in axes[:-1]:
        ax.tick_params(labelbottom=False)
    axes[-1].set_xlabel("time since the pulse left the transmitter (ns)")
    _add_depth_axis(axes[0], dataset.attrs)
    figure.suptitle(_title(dataset.attrs), fontsize="large")

    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=160)
    return figure


def check_format(path: Path) -> None:
    """Raise a UserError unless a file's suffix is that of a figure."""
    if path.suffix.lower() not in _FORMATS:
        raise UserError(f"cannot write {path}: the file name must end in {', '.join(_FORMATS[:-1])} or {_FORMATS[-1]}.")


def _draw_waveforms(
    ax: Axes,
    time: npt.NDArray[np.float64],
    power: npt.NDArray[np.float64],
    error: npt.NDArray[np.float64],
    colours: Sequence[Any],
    limits: tuple[float, float],
    *,
    log: bool,
) -> None:
    inside = (time >= limits[0]) & (time <= limits[1])
    shown = power[:, inside]
    # A logarithmic axis ends where the signal sinks into its own error.
    significant = shown[np.isfinite(shown) & (shown > 0) & ~(shown < 3.0 * error[:, inside])]
    top = float(significant.max()) if significant.size else 1.0
    factor, prefix = si_prefix(top)
    floor = top * 1e-3
    if significant.size:
        floor = max(0.5 * float(np.quantile(significant, 0.01)), top * 10.0**-_DECADES)
    few = len(power) <= _LISTED_PIXELS
    for values, spread, colour in zip(power, error, colours, strict=True):
        ax.plot(time, values / factor, color=colour, linewidth=1.3 if few else 0.6)
        if few:
            # A logarithmic axis has no place for the part of a band below zero.
            low = np.maximum(values - spread, floor * 1e-3) if log else values - spread
            ax.fill_between(time, low / factor, (values + spread) / factor, color=colour, alpha=0.22, linewidth=0)
    ax.set_xlim(limits)
    if log:
        ax.set_yscale("log")
        ax.set_ylim(floor / factor, top / factor * 2.0)
    else:
        ax.set_ylim(min(0.0, float(np.nanmin(shown, initial=0.0))) / factor, top / factor * 1.08)
    ax.set_ylabel(f"received power ({prefix}W)")
    ax.grid(True, which="major", color="0.88", linewidth=0.7)
    ax.set_axisbelow(True)
    ax.spines["right"].set_visible(False)


def time_limits(dataset: xr.Dataset) -> tuple[float, float]:
    """Return the window of the echoes with a margin, or all of the time axis where it is not known."""
    time, attributes = dataset["time"].values, dataset.attrs
    half = 0.5 * (number(attributes, "bin_width_ns") or 1.0)
    first, last = float(time[0]) - half, float(time[-1]) + half
    start = number(attributes, "window_start_ns")
    end = number(attributes, "window_end_ns")
    if start is None or end is None or not first < end or not start < last or not start < end:
        return first, last
    margin = 0.06 * (end - start)
    return max(first, start - margin), min(last, end + margin)


def _add_depth_axis(ax: Axes, attributes: dict[str, Any]) -> None:
    needed = ("surface_time_ns", "refractive_index", "group_index", "off_nadir_deg")
    surface_ns, refractive_index, group_index, off_nadir_deg = (number(attributes, name) for name in needed)
    if surface_ns is None or refractive_index is None or group_index is None or off_nadir_deg is None:
        return
    # Snell's law for the axis of the receiver, from air into water.
    cos_water = math.sqrt(1.0 - (math.sin(math.radians(off_nadir_deg)) / refractive_index) ** 2)
    metres_per_ns = 1e-9 * speed_of_light / (2.0 * group_index) * cos_water

    def to_depth(time_ns: Any) -> Any:
        return (time_ns - surface_ns) * metres_per_ns

    def to_time(depth: Any) -> Any:
        return depth / metres_per_ns + surface_ns

    depth = ax.secondary_xaxis("top", functions=(to_depth, to_time))
    depth.set_xlabel("depth (m)")


def _draw_pixels(ax: Axes, dataset: xr.Dataset, names: Sequence[str], colours: Sequence[Any]) -> None:
    """Draw the pixels as the receiver sees them: far from nadir on top, +gy to the right."""
    attributes = dataset.attrs
    ax.set_axis_off()
    if len(names) <= _LISTED_PIXELS:
        handles = [Patch(color=colour, label=name) for name, colour in zip(names, colours, strict=True)]
        legend = ax.legend(
            handles=handles,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.08),
            ncols=1 if len(names) <= 4 else 2,
            frameon=False,
            handlelength=1.0,
        )
        legend.set_in_layout(False)  # it stands in the room that the square axes leave free
    ax.set_anchor("N")
    gx, gy = dataset["gx"].values, dataset["gy"].values
    width = number(attributes, "field_of_view_mrad")
    if width is None or width <= 0:
        if len(names) > 1:
            ax.scatter(gy, gx, c=list(colours), s=24)
            ax.set_aspect("equal", "datalim")
        return
    sides = tuple(attributes.get("field_of_view_sides_mrad") or (width, width))
    outline: Patch
    if attributes.get("field_of_view_shape", "circle") == "circle":
        outline = Circle((0, 0), width / 2)
    else:
        outline = Rectangle((-sides[1] / 2, -sides[0] / 2), sides[1], sides[0])
    outline.set(facecolor="none", edgecolor="0.25", linewidth=1.2)
    ax.add_patch(outline)
    cells = _cells(str(attributes.get("layout", "")), gx, gy, sides)
    if cells is None:
        ax.scatter(gy, gx, c=list(colours), s=12)
    else:
        for (left, bottom, cell_width, cell_height), colour in zip(cells, colours, strict=True):
            cell = Rectangle((left, bottom), cell_width, cell_height, facecolor=colour, edgecolor="white", alpha=0.9)
            ax.add_patch(cell)
            cell.set_clip_path(outline)
    ax.set(xlim=(-0.56 * width, 0.56 * width), ylim=(-0.56 * width, 0.56 * width), aspect="equal")
    ax.text(0, 0.56 * width, "far", ha="center", va="bottom", fontsize="small", color="0.3")
    ax.text(0, -0.56 * width, f"near · {width:g} mrad", ha="center", va="top", fontsize="small", color="0.3")


def _cells(
    layout: str, gx: npt.NDArray[np.float64], gy: npt.NDArray[np.float64], sides: tuple[float, float]
) -> list[tuple[float, float, float, float]] | None:
    """Return each pixel's rectangle (left, bottom, width, height) in a layout of equal cells, None for other layouts.

    The layout counts cells in both directions; which number is along range shows from the pixels' centres.
    """
    first, separator, second = layout.lower().partition("x")
    if not (separator and first.isdecimal() and second.isdecimal() and int(first) * int(second) == len(gx) > 0):
        return None
    for along, across in {(int(first), int(second)), (int(second), int(first))}:
        height, breadth = sides[0] / along, sides[1] / across
        rows = np.floor((sides[0] / 2 - gx) / height).astype(int)
        columns = np.floor((gy + sides[1] / 2) / breadth).astype(int)
        inside = ((rows >= 0) & (rows < along) & (columns >= 0) & (columns < across)).all()
        if inside and len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(gx):
            return [
                (column * breadth - sides[1] / 2, sides[0] / 2 - (row + 1) * height, breadth, height)
                for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
            ]
    return None


def _draw_image(figure: Figure, ax: Axes, dataset: xr.Dataset) -> None:
    energy = dataset["impulse_response"].sum("time").values
    gx, gy = dataset["gx"].values, dataset["gy"].values
    finite = energy[np.isfinite(energy)]
    factor, prefix = si_prefix(float(finite.max()) if finite.size else 0.0)
    half_row = 0.5 * (abs(gx[0, 0] - gx[-1, 0]) / (gx.shape[0] - 1) if gx.shape[0] > 1 else 1.0)
    half_column = 0.5 * (abs(gy[0, -1] - gy[0, 0]) / (gy.shape[1] - 1) if gy.shape[1] > 1 else 1.0)
    extent = (gy.min() - half_column, gy.max() + half_column, gx.min() - half_row, gx.max() + half_row)
    image = ax.imshow(energy / factor, extent=extent, origin="upper", cmap="viridis", interpolation="nearest")
    ax.set_xlabel("across, gy (mrad)")
    ax.set_ylabel("away from nadir, gx (mrad)")
    ax.set_anchor("N")
    scale = ax.inset_axes((0.0, -0.24, 1.0, 0.05))
    scale.set_in_layout(False)  # it stands in the room that the square pixels leave free
    figure.colorbar(image, cax=scale, orientation="horizontal", label=f"total energy ({prefix}J)")


def colours(count: int) -> list[Any]:
    """Return a colour for each pixel; of four pixels those of the published figures."""
    if count == 1:
        return ["#111111"]
    if count == 4:
        return list(_FOUR)
    if count <= 10:
        return list(matplotlib.colormaps["tab10"].colors[:count])  # type: ignore[attr-defined]
    return list(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.92, count)))


def si_prefix(largest: float) -> tuple[float, str]:
    """Return the power of a thousand, and its prefix, that brings a number between 1 and 1000."""
    exponent = 3 * math.floor(math.log10(largest) / 3) if largest > 0 else 0
    exponent = min(max(exponent, min(_PREFIXES)), max(_PREFIXES))
    return 10.0**exponent, _PREFIXES[exponent]


def number(attributes: dict[str, Any], name: str) -> float | None:
    """Return an attribute that is a finite number, else None."""
    value = attributes.get(name)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def _title(attributes: dict[str, Any]) -> str:
    scene = Path(str(attributes.get("scene", ""))).stem
    error = number(attributes, "error_median")
    accuracy = f"median standard error {100 * error:.2g} %" if error is not None else ""
    return "  ·  ".join(part for part in (scene or "received power", accuracy) if part)
