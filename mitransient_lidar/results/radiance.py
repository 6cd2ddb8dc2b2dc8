"""Images by daylight as labelled arrays.

An image is an `xarray.Dataset` with ``radiance`` and ``radiance_stderr`` [W m^-2 sr^-1 nm^-1] over (row, column) or
(pixel,), with a leading dimension ``frame`` and its coordinate ``time_s`` [s] for animations. With the width of a
filter it holds ``background_power`` [W], which the receiver detects in each pixel without its laser.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.clear_sky import background_power
from mitransient_lidar.results.attributes import provenance, titled
from mitransient_lidar.results.variables import label


def build_radiance(
    frames: Sequence[tuple[FloatArray, FloatArray]],
    times: FloatArray | None,
    etendue: FloatArray,
    *,
    coords: Mapping[str, Any],
    grid: tuple[int, int] | None,
    filter_width_nm: float | None,
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Label images by daylight.

    Parameters
    ----------
    frames
        Radiance and its standard error [W m^-2 sr^-1 nm^-1] of each frame, shape (pixels,) each.
    times
        Times of the frames [s], shape (frames,); None for a single image.
    etendue
        Open area times solid angle times transmittance of optics and air of each pixel [m^2 sr], shape (pixels,).
    coords, grid
        Coordinates of the pixels, from `dataset.pixel_coordinates`, and (rows, columns) of an imager, or None.
    filter_width_nm
        Width of the receiver's filter [nm], or None.
    attributes
        Attributes of the result.
    """
    inner: tuple[str, ...] = ("pixel",) if grid is None else ("row", "column")
    shape = (len(etendue),) if grid is None else grid
    dims, counts = (inner, shape) if times is None else (("frame", *inner), (len(frames), *shape))
    radiance, stderr = (np.reshape([frame[i] for frame in frames], counts) for i in (0, 1))
    coords = dict(coords)
    if times is not None:
        coords |= {
            "frame": ("frame", np.arange(len(times))),
            "time_s": ("frame", times),
        }
    variables: dict[str, Any] = {
        "radiance": (dims, radiance),
        "radiance_stderr": (dims, stderr),
        "etendue": (inner, etendue.reshape(shape)),
    }
    weight = np.where(np.isfinite(radiance), etendue.reshape(shape), 0)
    mean = float(np.sum(np.nan_to_num(radiance) * weight) / np.sum(weight))
    attributes = {**attributes, "background_radiance": mean}
    if filter_width_nm is not None:
        power = background_power(np.nan_to_num(radiance), etendue.reshape(shape), filter_width_nm)
        variables["background_power"] = (dims, power)
        attributes["filter_width_nm"] = filter_width_nm
    title = titled("Radiance by daylight", attributes)
    return label(xr.Dataset(variables, coords, {**provenance(attributes), "title": title}))
