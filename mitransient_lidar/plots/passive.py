"""Figures and animations for daylight images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.validation import FloatArray, integer
from mitransient_lidar.plots import drawing, palette

#: Share of the pixels that may be brighter than white, or darker than black: glints would leave the rest black.
_CLIPPED = 0.01

#: Smallest animation width [pixels].
_ANIMATION_WIDTH = 384


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
    ax.set_title(_title(picture))
    return drawing.save(figure, path)


def animate_passive(dataset: xr.Dataset, path: drawing.FilePath) -> None:
    """Write the frames of an imager, from `rendering.passive.render_passive`, as an endless GIF animation in real time.

    Raises
    ------
    UserError
        If the dataset has no frames or no image, or the name of the file does not end in ``.gif``.
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


def _title(picture: xr.Dataset) -> str:
    attributes = picture.attrs
    parts = [str(attributes.get("scene", ""))]
    if "sun_zenith_deg" in attributes:
        parts.append(f"sun at {attributes['sun_zenith_deg']:g}° from the zenith")
    if "sky_distribution" in attributes:
        parts.append(f"{attributes['sky_distribution']} sky")
    if "time_s" in picture:
        parts.append(f"{float(picture['time_s']):.2f} s")
    return ", ".join(parts)
