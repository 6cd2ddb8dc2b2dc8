"""16-bit images for other programs: the gates in a stack, and camera frames, as TIFF and PNG.

A frame keeps its digital numbers. Energies are numbers from 0 to 65535, the largest finite one in the stack. The
description states the energy per number [J]. Pixels without a grid form an image one row high. A TIFF file has one page
for each frame and gate, all gates in the first frame first; PNG files are numbered, ``<name>_gate000.png``, for several
frames ``<name>_frame0000_gate000.png``. Each has a description in JSON: ``frame`` and ``gate``, its ``gate_start_ns``
and ``gate_width_ns``, ``gate_depth_m`` if it is known, and a number's ``unit`` with its ``scale``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing, together
from mitransient_lidar.results.gate_stack import check_stack, has_frames

SUFFIXES = (".tif", ".tiff", ".png")
_MOST = 65535
_DESCRIPTION = 270  # TIFF tag
_LARGEST_TIFF = 4e9  # bytes, with 32-bit offsets


def write(dataset: xr.Dataset, path: Path) -> list[Path]:
    """Write gates or frames as one TIFF file or as numbered PNG files, and return their paths.

    Raises `UserError` if the dataset has neither, a number of a frame exceeds 16 bits, or a TIFF file would exceed 4
    GB.
    """
    from PIL import Image, PngImagePlugin

    images, scale = _numbers(dataset, path)
    if path.suffix.lower() != ".png":
        if images.nbytes > _LARGEST_TIFF:
            raise UserError(f"cannot write {path}: {images.nbytes:.3g} bytes exceed the 4 GB of a TIFF file")
        pages = []
        for about, image in _described(dataset, images, scale):
            page = Image.fromarray(image)
            page.encoderinfo = {"tiffinfo": {_DESCRIPTION: json.dumps(about)}}
            pages.append(page)
        with replacing(path) as temporary:
            first = pages[0].encoderinfo["tiffinfo"]
            pages[0].save(temporary, format="TIFF", save_all=True, append_images=pages[1:], tiffinfo=first)
        return [path]
    paths = []
    with together():
        for about, image in _described(dataset, images, scale):
            frame = f"_frame{about['frame']:04d}" if len(images) > 1 else ""
            paths.append(path.with_name(f"{path.stem}{frame}_gate{about['gate']:03d}.png"))
            text = PngImagePlugin.PngInfo()
            text.add_text("Description", json.dumps(about))
            with replacing(paths[-1]) as temporary:
                Image.fromarray(image).save(temporary, format="PNG", pnginfo=text)
    return paths


def _numbers(dataset: xr.Dataset, path: Path) -> tuple[npt.NDArray[np.uint16], float]:
    """Return 16-bit numbers over (frame, gate, row, column), and the value for one [J or digital number]."""
    is_frames = has_frames(dataset)
    if not is_frames and "gate_energy" not in dataset:
        raise UserError(f"cannot write {path}: a {path.suffix} file holds gates or frames of a camera")
    found = dataset["signal"] if is_frames else check_stack(dataset)["gate_energy"]
    found = found if "frame" in found.dims else found.expand_dims("frame")
    pixels = [dim for dim in ("row", "column", "pixel") if dim in found.dims]
    values = found.transpose("frame", "gate", *pixels).values
    values = values if len(pixels) == 2 else values[:, :, np.newaxis]
    if is_frames:
        if (largest := int(values.max())) > _MOST:
            raise UserError(f"cannot write {path}: the digital number {largest} exceeds 16 bits; use a .nc file")
        return np.ascontiguousarray(values, np.uint16), 1.0
    finite = np.where(np.isfinite(values), np.maximum(values, 0), 0)
    scale = float(finite.max()) / _MOST or 1.0
    return np.round(finite / scale).astype(np.uint16), scale


def _described(
    dataset: xr.Dataset, images: npt.NDArray[np.uint16], scale: float
) -> Iterator[tuple[dict[str, Any], npt.NDArray[np.uint16]]]:
    """Yield each image with its description."""
    known = {"gate_start_ns": "gate_start", "gate_width_ns": "gate_width", "gate_depth_m": "gate_depth"}
    unit = "DN" if has_frames(dataset) else "J"
    for frame, gate in np.ndindex(images.shape[:2]):
        places = {
            key: float(dataset[name].isel(frame=frame, missing_dims="ignore").values[gate])
            for key, name in known.items()
            if name in dataset.coords
        }
        places = {key: value for key, value in places.items() if np.isfinite(value)}
        yield {"frame": frame, "gate": gate, **places, "unit": unit, "scale": scale}, images[frame, gate]
