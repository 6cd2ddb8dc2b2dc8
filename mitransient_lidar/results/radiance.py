"""Images by daylight as labelled arrays, and their files.

An image is an `xarray.Dataset` with ``radiance`` and ``radiance_stderr`` [W m^-2 sr^-1 nm^-1] over (row, column) or
(pixel,), with a leading dimension ``frame`` and its coordinate ``time_s`` [s] for animations. With the width of a
filter it holds ``background_power`` [W], which the receiver detects in each pixel without its laser.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.clear_sky import background_power
from mitransient_lidar.results import exr, netcdf
from mitransient_lidar.results.dataset import provenance
from mitransient_lidar.results.formats import output_format

_UNIT = "W m-2 sr-1 nm-1"


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
            "frame": ("frame", np.arange(len(times)), {"units": "1", "long_name": "frame number"}),
            "time_s": ("frame", times, {"units": "s", "long_name": "time since the first frame"}),
        }
    area = {"units": "m2 sr", "long_name": "open area times solid angle times transmittance"}
    variables: dict[str, Any] = {
        "radiance": (dims, radiance, {"units": _UNIT, "long_name": "spectral radiance, mean over the pixel"}),
        "radiance_stderr": (dims, stderr, {"units": _UNIT, "long_name": "standard error of the radiance"}),
        "etendue": (inner, etendue.reshape(shape), area),
    }
    weight = np.where(np.isfinite(radiance), etendue.reshape(shape), 0)
    mean = float(np.sum(np.nan_to_num(radiance) * weight) / np.sum(weight))
    attributes = {**attributes, "background_radiance": mean}
    if filter_width_nm is not None:
        power = background_power(np.nan_to_num(radiance), etendue.reshape(shape), filter_width_nm)
        variables["background_power"] = (dims, power, {"units": "W", "long_name": "detected power of the daylight"})
        attributes["filter_width_nm"] = filter_width_nm
    title = f"Radiance by daylight, scene {attributes['scene']}"
    return xr.Dataset(variables, coords, {**provenance(attributes), "title": title})


def save_radiance(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write images to a NetCDF file (``.nc``), or to an EXR file (``.exr``); an existing file is replaced.

    An EXR file has the channels Y and Y.stderr and a part for each frame. Pixels without a grid are an image one row
    high.

    Raises
    ------
    UserError
        If the suffix is another one, or the file cannot be written.
    """
    file_format = output_format(Path(path))
    with replacing(path) as temporary:
        if file_format == "netcdf":
            netcdf.write_netcdf(dataset, temporary, ("radiance", "radiance_stderr"))
        else:
            exr.write_parts(temporary, _parts(dataset))


def _parts(dataset: xr.Dataset) -> list[exr.Part]:
    """Return the frames as images; the attributes are in the first one."""
    readable = {f"lidar.{name}": value for name, value in dataset.attrs.items()}
    columns = dataset.sizes.get("column", dataset.sizes.get("pixel", 1))
    animated = "frame" in dataset.dims
    parts = []
    for index in range(dataset.sizes.get("frame", 1)):
        frame = dataset.isel(frame=index) if animated else dataset
        channels = {
            channel: np.ascontiguousarray(frame[name].values.reshape(-1, columns), dtype=np.float32)
            for channel, name in (("Y", "radiance"), ("Y.stderr", "radiance_stderr"))
        }
        own = {"timeS": float(frame["time_s"])} if animated else {}
        exact = {"content": "radiance", "attributes": dataset.attrs} if index == 0 else None
        header = exr.header({**(readable if index == 0 else {}), **own}, exact)
        parts.append(exr.Part(f"frame{index:04d}" if animated else "", header, channels))
    return parts
