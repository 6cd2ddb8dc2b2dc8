"""Figures with gate images, with animations, and with images by daylight."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.validation import BoolArray, FloatArray, integer
from mitransient_lidar.plots import drawing, palette
from mitransient_lidar.results.gate_stack import as_stack
from mitransient_lidar.results.geometry import optional_number

_LIT = 0.01  # share of the beam in a lit pixel, relative to the brightest
SIGNIFICANT = 3.0  #: Standard errors above which a value counts.

_BRIGHT = 99.0  # percentile of a gate's pixels within the colours: a small bright target may be clipped
_DECADES = 3.0  # on a logarithmic colour scale
_SHOWN_GATES = 36  # on a contact sheet
_FRAMES_PER_SECOND = 8
_FRAME_DPI = 100
_LABEL_ROOM = 0.2  # inches, below the images on a contact sheet
_PIXEL_DECADES = 5  # at most, on the logarithmic axis of a few pixels


class ColourScale(NamedTuple):
    """Common colours for all gates in a stack."""

    factor: float  #: Energy per unit [J].
    unit: str  #: Unit name, such as "aJ".
    norm: Normalize  #: From energies in that unit to colours.
    label: str  #: Colour bar label, with the share of values above the brightest colour.
    extend: Literal["neither", "min", "max", "both"]  #: Ends beyond which values lie.

    def draw(self, ax: Axes, energy: FloatArray, stack: xr.Dataset, *, label: bool = True) -> AxesImage:
        """Draw one gate's energies [J]; pixels with non-finite values are grey."""
        colours = matplotlib.colormaps[palette.LIGHT].with_extremes(bad="0.6")
        return drawing.draw_image(ax, energy / self.factor, stack, label=label, norm=self.norm, cmap=colours)

    def add_bar(self, figure: Figure, image: AxesImage, axes: Any, label: str, **options: Any) -> Colorbar:
        """Draw the colour bar of some axes, with plain numbers on a logarithmic scale too."""
        bar = figure.colorbar(image, ax=axes, extend=self.extend, label=label, **options)
        if isinstance(self.norm, LogNorm):
            drawing.plain_logarithms(bar.long_axis)
        return bar


def plot_gates(dataset: xr.Dataset, path: drawing.FilePath | None = None, log: bool = False) -> Figure:
    """Draw a contact sheet of gates on one common scale; for pixels without an image, their energy against depth.

    For camera frames, it draws their mean above the dark level (`results.gate_stack.as_stack`).

    From more than 36 gates every second, third, ... one is drawn. The colours end at the brightest gate below the
    surface (at its 99th percentile), so that the surface echo does not darken the rest. The colour bar label states the
    share of brighter values. With `log` the colour scale, or the energy axis, is logarithmic.

    Raises `UserError` if the dataset is no gate stack.
    """
    figure = drawing.new_figure(path, 9.6, 4.6)
    stack = as_stack(dataset)
    (_draw_pixel_gates if "pixel" in stack.dims else _draw_sheet)(figure, stack, log=log)
    return drawing.save(figure, path)


def check_animation(stack: xr.Dataset, path: Path) -> None:
    """Raise a `UserError` if the stack has no images."""
    if "pixel" in stack.dims:
        raise UserError(
            f"cannot write {path}: an animation needs images, but this stack has {stack.sizes['pixel']} single pixels; "
            "draw its contact sheet"
        )


def find_ffmpeg(path: Path) -> str:
    """Return the ffmpeg that Matplotlib finds, or the one from the extra ``movie``; raise `UserError` without both."""
    if FFMpegWriter.isAvailable():
        return str(matplotlib.rcParams["animation.ffmpeg_path"])
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise UserError(
            f"cannot write {path}: .mp4 needs the program ffmpeg, which pip install 'mitransient-lidar[movie]' brings; "
            "choose .gif without it"
        ) from None


def animate_gates(dataset: xr.Dataset, path: drawing.FilePath, log: bool = False) -> None:
    """Write a gate stack animation, one frame per gate, with the mean energy against depth.

    The colours are as in `plot_gates`. The file name ends in ``.gif`` or ``.mp4``.

    Raises `UserError` if the dataset is no gate stack of an imager, the file has another suffix, ffmpeg is missing or
    fails, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise UserError(f"cannot write {path}: the file name of an animation must end in .gif or .mp4")
    stack = as_stack(dataset)
    check_animation(stack, path)
    figure, show = _animated_figure(stack, log=log)
    # The layout is computed once, so that frames do not shift against each other.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    kind: type[AbstractMovieWriter] = PillowWriter if suffix == ".gif" else FFMpegWriter
    writer = kind(fps=_FRAMES_PER_SECOND)
    program: dict[Any, Any] = {} if suffix == ".gif" else {"animation.ffmpeg_path": find_ffmpeg(path)}
    with replacing(path) as temporary:
        try:
            with matplotlib.rc_context(program), writer.saving(figure, os.fspath(temporary), _FRAME_DPI):
                for index in range(stack.sizes["gate"]):
                    show(index)
                    writer.grab_frame()
        except CalledProcessError as error:
            raise UserError(f"cannot write {path}: ffmpeg ended with the error {error.returncode}") from error


def colour_scale(stack: xr.Dataset, *, log: bool) -> ColourScale:
    """Return the common colours for an imager's gates.

    They end at the largest 99th percentile over the gates below the surface echo. If this echo's time is unknown, they
    end at the value that the 99th percentile exceeds in one gate of ten.
    """
    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    # One gate after the other, since copies of large stacks take as much memory as they do.
    gates = [energy[..., gate] for gate in range(energy.shape[-1])]
    bright = np.array([np.percentile(np.where(np.isfinite(image), image, 0.0), _BRIGHT) for image in gates])
    below = ~reached_by_surface(stack)
    if "surface_time_ns" not in stack.attrs:
        top = float(np.percentile(bright, 90))
    else:
        top = float(bright[below].max() if below.any() else bright.max())
    if top <= 0:
        highest = max(float(image[np.isfinite(image)].max(initial=0.0)) for image in gates)
        top = highest if highest > 0 else 1.0
    brighter = sum(np.count_nonzero(np.isfinite(image) & (image > top)) for image in gates) / energy.size
    factor, unit = unit_of(stack, top)
    label = (
        f"{stack['gate_energy'].attrs.get('long_name', 'energy in the gate')} ({unit}{', logarithmic' if log else ''})"
    )
    if brighter:
        surface = "" if below.all() else ", including the surface echo,"
        label += f"; {100 * brighter:.2g} % of the values{surface} are brighter"
    if not log:
        return ColourScale(factor, unit, Normalize(0.0, top / factor), label, "max" if brighter else "neither")
    significant = energy[np.isfinite(energy) & (energy > SIGNIFICANT * stderr) & (energy > 0)]
    bottom = max(top * 10.0**-_DECADES, float(np.percentile(significant, 1)) if significant.size else 0.0)
    # Clipped, so that values of 0 and below are dark and not missing.
    norm = LogNorm(min(bottom, 0.5 * top) / factor, top / factor, clip=True)
    return ColourScale(factor, unit, norm, label, "both" if brighter else "min")


def unit_of(stack: xr.Dataset, largest: float) -> tuple[float, str]:
    """Return the unit's factor and name for drawing values from `as_stack` up to the largest one."""
    if (unit := stack["gate_energy"].attrs.get("units", "J")) != "J":
        return 1.0, str(unit)
    factor, prefix = drawing.si_prefix(largest)
    return factor, f"{prefix}J"


def reached_by_surface(stack: xr.Dataset) -> BoolArray:
    """Return which gates open before the surface echo's end in a lit pixel; none if its time is unknown."""
    surface = optional_number(stack.attrs, "surface_time_ns")
    if surface is None:
        return np.zeros(stack.sizes["gate"], dtype=bool)
    if "surface_time" in stack.coords and "beam_share" in stack.coords:
        lit = stack["beam_share"].values >= _LIT * stack["beam_share"].values.max()
        surface = max(surface, float(stack["surface_time"].values[lit].max(initial=surface)))
    # Waves and the width of the image lengthen the echo beyond the pulse.
    names = ("pulse_fwhm_ns", "response_time_ns", "gate_rise_ns")
    length = 1.5 * sum(optional_number(stack.attrs, name) or 0.0 for name in names)
    return np.asarray(stack["gate_start"].values < surface + length)


def known_depths(stack: xr.Dataset) -> FloatArray | None:
    """Return the gates' middle depths [m], None if they are unknown."""
    if "gate_depth" not in stack.coords or not np.isfinite(stack["gate_depth"].values).all():
        return None
    return np.asarray(stack["gate_depth"].values, dtype=np.float64)


def _caption(stack: xr.Dataset, index: int) -> tuple[str, str]:
    """Return a gate's number and depth, and the time during which it is open."""
    start, width = (float(stack[name].values[index]) for name in ("gate_start", "gate_width"))
    depths = known_depths(stack)
    depth = "" if depths is None else f"  {depths[index]:.2f} m"
    return f"#{index}{depth}", f"{start:.1f} to {start + width:.1f} ns"


def _title(stack: xr.Dataset, shown: int) -> str:
    count, width = stack.sizes["gate"], float(stack["gate_width"].values[0])
    gates = f"{count} gates" if shown == count else f"{shown} of {count} gates"
    pulses = int(stack.attrs.get("pulses", 1))
    return drawing.titled(stack.attrs, f"{gates} of {width:g} ns" + (f", {pulses} pulses" if pulses > 1 else ""))


def _draw_sheet(figure: Figure, stack: xr.Dataset, *, log: bool) -> None:
    energy = stack["gate_energy"].values
    shown = range(0, stack.sizes["gate"], math.ceil(stack.sizes["gate"] / _SHOWN_GATES))
    columns = _columns(len(shown))
    rows = math.ceil(len(shown) / columns)
    left, right, near, far = drawing.image_extent(stack)
    panel = 8.7 / columns * min(max((far - near) / (left - right), 0.3), 2.0)  # height in inches
    figure.set_figheight(rows * (panel + 0.34) + 1.5)
    axes = figure.subplots(rows, columns, squeeze=False)
    scale = colour_scale(stack, log=log)
    for ax in axes.flat[len(shown) :]:
        ax.set_axis_off()
    for place, (index, ax) in enumerate(zip(shown, axes.flat, strict=False)):
        image = scale.draw(ax, energy[..., index], stack, label=False)
        ax.set_title("\n".join(_caption(stack, index)), fontsize=8.5, linespacing=1.15, pad=3)
        ax.tick_params(labelsize=8, labelleft=place % columns == 0, labelbottom=place + columns >= len(shown))
        ax.locator_params(nbins=4)
    # Below a colour bar of all images, the layout leaves too little room for the label.
    room = _LABEL_ROOM / figure.get_figheight()
    figure.set_layout_engine("constrained", rect=(0, room, 1, 1 - room))
    figure.supxlabel(drawing.ANGLE_Y_LABEL, fontsize=10)
    figure.supylabel(drawing.ANGLE_X_LABEL, fontsize=10)
    figure.suptitle(_title(stack, len(shown)), fontsize=12)
    scale.add_bar(figure, image, axes, scale.label, location="top", fraction=0.05, aspect=60, shrink=0.8)


def _columns(count: int) -> int:
    """Return the number of images in a row: at most 6, fewer if the last row then has fewer gaps."""
    if count <= 3:
        return count
    return min(range(3, 7), key=lambda columns: -count % columns + 1.2 * abs(columns - min(6.0, 1.3 * count**0.5)))


def _animated_figure(stack: xr.Dataset, *, log: bool) -> tuple[Figure, Callable[[int], None]]:
    """Return an animation's figure, and the function that shows a gate in it."""
    energy = stack["gate_energy"].values
    scale = colour_scale(stack, log=log)
    figure = drawing.new_figure(None, 8.4, 5.4)
    left, right = figure.subplots(1, 2, width_ratios=(2.3, 1))
    image = scale.draw(left, energy[..., 0], stack)
    scale.add_bar(figure, image, left, scale.label.replace("; ", "\n"), location="bottom", aspect=40, shrink=0.9)
    depths = known_depths(stack)
    axis = stack["gate_start"].values if depths is None else depths
    mean = energy.mean(axis=(0, 1)) / scale.factor
    right.plot(mean, axis, color="0.25", linewidth=1.2)
    (marker,) = right.plot([], [], "o", color=palette.RED, markersize=8, clip_on=False)
    top = float(np.nanmax(mean, initial=0.0))
    if top > 0:
        right.set_xscale("log")
        right.set_xlim(max(1e-4 * top, 0.5 * float(np.nanmin(mean[mean > 0]))), 2 * top)
    right.invert_yaxis()
    right.yaxis.set(ticks_position="right", label_position="right")
    right.set_ylabel("start of the gate (ns)" if depths is None else "depth (m)")
    right.set_xlabel(f"mean over the image ({scale.unit})")
    drawing.add_grid(right)
    title = figure.suptitle("gate", fontsize=12)

    def show(index: int) -> None:
        image.set_data(energy[..., index] / scale.factor)
        # The marker of a mean below the logarithmic axis is at its edge.
        marker.set_data([max(mean[index], right.get_xlim()[0])], [axis[index]])
        gate, time = _caption(stack, index)
        text = f"gate {gate.removeprefix('#').replace('  ', '  ·  ')}  ·  {time}"
        title.set_text(drawing.titled(stack.attrs, text))

    show(0)
    return figure, show


def _draw_pixel_gates(figure: Figure, stack: xr.Dataset, *, log: bool) -> None:
    names = [str(name) for name in stack["pixel"].values]
    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    top = float(np.nanmax(energy, initial=0.0))
    factor, unit = unit_of(stack, top)
    significant = energy[energy > SIGNIFICANT * stderr]
    floor = max(0.5 * float(significant.min(initial=top)), top * 10.0**-_PIXEL_DECADES) / factor
    depths = known_depths(stack)
    axis = stack["gate_start"].values if depths is None else depths
    ax = figure.subplots()
    for i, (name, mark) in enumerate(zip(names, palette.marked(len(names)), strict=True)):
        style = {"linewidth": 1.3, "markersize": 4, "label": name, **mark}
        lowest = 1e-3 * floor if log else -np.inf
        drawing.draw_band(ax, axis, energy[i] / factor, stderr[i] / factor, lowest=lowest, **style)
    if log and top > 0:
        ax.set_yscale("log")
        ax.set_ylim(floor, 2 * top / factor)
    if len(names) <= drawing.LISTED_PIXELS:
        ax.legend(title="pixel", frameon=False)
    ax.set_xlabel("start of the gate (ns)" if depths is None else "depth of the gate's middle (m)")
    ax.set_ylabel(f"{stack['gate_energy'].attrs['long_name']} ({unit})")
    drawing.add_grid(ax)
    ax.set_title(_title(stack, stack.sizes["gate"]))


#: Share of the pixels that may be brighter than white, or darker than black: glints would leave the rest black.
_CLIPPED = 0.01

_ANIMATION_WIDTH = 384  #: Smallest animation width [pixels].


def plot_passive(dataset: xr.Dataset, path: drawing.FilePath | None = None, frame: int = 0) -> Figure:
    """Draw an image in grey, with the far edge on top; pixels without a grid as bars of their radiance.

    `dataset`: a result of `mitransient_lidar.rendering.passive.render_passive`. `path`: file to write. `frame`: frame
    index, if there are several.
    """
    figure = drawing.new_figure(path, 6.4, 5.6)
    picture = dataset
    if "frame" in dataset.dims:
        picture = dataset.isel(frame=integer("frame", frame, 0, dataset.sizes["frame"] - 1))
    radiance = 1e3 * picture["radiance"].values
    ax = figure.subplots()
    unit = "radiance (mW m$^{-2}$ sr$^{-1}$ nm$^{-1}$)"
    if "pixel" in dataset.dims:
        names = [str(name) for name in dataset["pixel"].values]
        error = 1e3 * picture["radiance_stderr"].values
        ax.bar(names, radiance, yerr=error, color=palette.pixel_colours(len(names)), width=0.6)
        ax.set_ylabel(unit)
        drawing.add_grid(ax, "y")
    else:
        low, high = _levels(1e3 * dataset["radiance"].values)
        image = drawing.draw_image(ax, radiance, dataset, cmap="gray", vmin=low, vmax=high)
        figure.colorbar(image, ax=ax, label=unit, extend="max", shrink=0.85)
    ax.set_title(_picture_title(picture))
    return drawing.save(figure, path)


def animate_passive(dataset: xr.Dataset, path: drawing.FilePath) -> None:
    """Write an imager's frames, from `rendering.passive.render_passive`, as an endless GIF animation in real time.

    Raises `UserError` if the dataset has no frames or no image, or the file's name does not end in ``.gif``.
    """
    from PIL import Image

    if Path(path).suffix.lower() != ".gif":
        raise UserError(f"cannot write {path}: the file name must end in .gif")
    if dataset["radiance"].dims != ("frame", "row", "column"):
        raise UserError("an animation needs frames of an imager: render several frames of a layout with many pixels")
    radiance = drawing.as_seen(dataset)["radiance"].values
    low, high = _levels(radiance)
    grey = np.nan_to_num(255 * np.clip((radiance - low) / max(high - low, 1e-300), 0, 1)).astype(np.uint8)
    scale = max(1, -(-_ANIMATION_WIDTH // radiance.shape[2]))
    pictures = [Image.fromarray(np.repeat(np.repeat(image, scale, 0), scale, 1)) for image in grey]
    seconds = np.diff(dataset["time_s"].values)
    # GIF counts in hundredths of a second, and browsers slow down frames shorter than two of them.
    duration = max(20, round(100 * float(seconds.mean())) * 10) if seconds.size else 100
    with replacing(path) as temporary:
        pictures[0].save(temporary, save_all=True, append_images=pictures[1:], duration=duration, loop=0)


def _levels(values: FloatArray) -> tuple[float, float]:
    """Return the radiances that are drawn black and white, common to all frames."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return 0.0, 1.0
    low, high = np.quantile(finite, [_CLIPPED, 1 - _CLIPPED])
    # Black is below the radiance of the darkest pixels, which thus keep their contrast.
    return float(max(0.0, low - 0.15 * (high - low))), float(high)


def _picture_title(picture: xr.Dataset) -> str:
    attributes = picture.attrs
    parts = [str(attributes.get("scene", ""))]
    if "sun_zenith_deg" in attributes:
        parts.append(f"sun at {attributes['sun_zenith_deg']:g}° from the zenith")
    if "sky_distribution" in attributes:
        parts.append(f"{attributes['sky_distribution']} sky")
    if "time_s" in picture:
        parts.append(f"{float(picture['time_s']):.2f} s")
    return ", ".join(parts)
