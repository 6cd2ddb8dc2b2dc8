"""Drawings of pictures by daylight: stills, and animations of moving ones."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.plotting import check_format, colours
from mitransient_lidar.results import replacing

#: Share of the pixels that are brighter than white: glints would leave the rest black.
_CLIPPED = 0.01

#: Smallest width of an animation [pixels].
_ANIMATION_WIDTH = 384


def plot_passive(dataset: xr.Dataset, path: str | os.PathLike[str], frame: int = 0) -> None:
    """Draw a picture: in grey, the far edge on top, or the radiance of each pixel where they form no grid.

    Parameters
    ----------
    dataset
        What `passive.render_passive` returned.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.
    frame
        Which frame of moving pictures.

    Raises
    ------
    UserError
        When the suffix is another one, there is no such frame, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    check_format(Path(path))
    picture = _frame(dataset, frame)
    radiance = 1e3 * picture["radiance"].values
    figure = Figure(figsize=(6.4, 5.6), layout="constrained")
    ax = figure.subplots()
    unit = "radiance (mW m$^{-2}$ sr$^{-1}$ nm$^{-1}$)"
    if "pixel" in dataset.dims:
        names = [str(name) for name in dataset["pixel"].values]
        ax.bar(names, radiance, yerr=1e3 * picture["radiance_stderr"].values, color=colours(len(names)), width=0.6)
        ax.set_ylabel(unit)
        ax.grid(True, axis="y", color="0.9", linewidth=0.7)
        ax.set_axisbelow(True)
    else:
        low, high = _levels(1e3 * dataset["radiance"].values)
        image = ax.imshow(radiance, cmap="gray", vmin=low, vmax=high, extent=_extent(dataset), interpolation="nearest")
        figure.colorbar(image, ax=ax, label=unit, extend="max", shrink=0.85)
        ax.set_xlabel("gy (mrad)")
        ax.set_ylabel("gx (mrad), away from nadir upwards")
    ax.set_title(_title(dataset, picture))
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)


def animate_passive(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write moving pictures of an imager as a GIF animation in their own time, repeated for ever.

    Parameters
    ----------
    dataset
        What `passive.render_passive` returned, with frames.
    path
        File to write, ending in ``.gif``.

    Raises
    ------
    UserError
        When the suffix is another one, the dataset has no frames or is not of an imager, or the file cannot be written.
    """
    from PIL import Image

    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise UserError(f"cannot write {path}: the file name must end in .gif.")
    if dataset["radiance"].dims != ("frame", "row", "column"):
        raise UserError("an animation needs frames of an imager: render more than one, of a layout of many pixels")
    radiance = dataset["radiance"].values
    low, high = _levels(radiance)
    grey = np.nan_to_num(255 * np.clip((radiance - low) / max(high - low, 1e-300), 0, 1)).astype(np.uint8)
    scale = max(1, -(-_ANIMATION_WIDTH // radiance.shape[2]))
    pictures = [Image.fromarray(np.repeat(np.repeat(image, scale, 0), scale, 1)) for image in grey]
    seconds = np.diff(dataset["time_s"].values)
    # GIF counts in hundredths of a second; browsers slow down below two.
    duration = max(20, round(100 * float(seconds.mean())) * 10) if seconds.size else 100
    with replacing(path) as temporary:
        pictures[0].save(temporary, save_all=True, append_images=pictures[1:], duration=duration, loop=0)


def _frame(dataset: xr.Dataset, frame: int) -> xr.Dataset:
    if "frame" not in dataset.dims:
        return dataset
    if not 0 <= frame < dataset.sizes["frame"]:
        raise UserError(f"frame = {frame} must lie between 0 and {dataset.sizes['frame'] - 1}")
    return dataset.isel(frame=frame)


def _levels(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return the radiances that are black and white: the same in all frames."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = np.quantile(known, [_CLIPPED, 1 - _CLIPPED])
    # A little darker than the darkest, so that the dark keeps its shades.
    return float(max(0.0, low - 0.15 * (high - low))), float(high)


def _extent(dataset: xr.Dataset) -> tuple[float, float, float, float]:
    """Return the edges of the image in mrad: left, right, bottom, top."""
    gx, gy = dataset["gx"].values, dataset["gy"].values
    half = [0.5 * np.ptp(g) / max(n - 1, 1) for g, n in zip((gy, gx), (gy.shape[1], gy.shape[0]), strict=True)]
    return gy.min() - half[0], gy.max() + half[0], gx.min() - half[1], gx.max() + half[1]


def _title(dataset: xr.Dataset, picture: xr.Dataset) -> str:
    told: list[Any] = [str(dataset.attrs.get("scene", ""))]
    if "sun_zenith_deg" in dataset.attrs:
        told.append(f"sun at {dataset.attrs['sun_zenith_deg']:g}°")
    if "sky_distribution" in dataset.attrs:
        told.append(f"{dataset.attrs['sky_distribution']} sky")
    if "frame" in dataset.dims:
        told.append(f"{float(picture['time_s']):.2f} s")
    return ", ".join(told)
