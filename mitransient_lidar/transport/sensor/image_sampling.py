"""Images as parameters of a receiver: read from files, and sampled in proportion to their values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import check_size, damaged_file, read_exr, read_npy, readable_suffix
from mitransient_lidar.transport.opaque import aligned


def read_image(name: str, path: str) -> NDArray[np.float64]:
    """Read an image of one channel, shape (rows, columns), row 0 at the top, from a .png, .npy or .exr file.

    Values of PNG files are integers from 0 to 255 or 65535. Messages call the file the parameter `name`.

    Raises UserError when the file cannot be read, or does not hold finite real numbers in two dimensions.
    """
    where = f"{name} = {path!r}"
    try:
        values = _READERS[readable_suffix(Path(path), _READERS, "grey image")](Path(path))
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    if values.dtype.kind not in "biuf":
        raise UserError(f"{where} must hold real numbers")
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.size == 0:
        raise UserError(f"{where} has the shape {values.shape}: it must have rows and columns, and one (grey) channel")
    if not np.isfinite(values).all():
        raise UserError(f"{where} must hold finite numbers")
    return values.astype(np.float64)


def _read_png(path: Path) -> NDArray[Any]:
    """Read a PNG file, unless its header states too large a size."""
    with damaged_file(f"{path} is damaged, or is not a PNG file."), open_file(path) as file:
        width, height = np.frombuffer(file.read(24)[16:], dtype=">u4").tolist()
        check_size(path, 8.0 * width * height)
        return np.array(mi.Bitmap(str(path)))


def _read_channel(path: Path) -> NDArray[Any]:
    """Read the channels of an OpenEXR file, the last axis."""
    return np.stack(list(read_exr(path).values()), axis=-1)


_READERS = {".png": _read_png, ".npy": read_npy, ".exr": _read_channel}


class ImageSampler:
    """Draws points of an image with a density in proportion to its values, which are constant in each cell.

    `weights`: values, not negative and not all 0, shape (rows, columns).
    """

    def __init__(self, weights: NDArray[np.float64]) -> None:
        self.shape = weights.shape
        of_rows = weights.sum(axis=1)
        self._rows = aligned(mi.Float, np.cumsum(of_rows) / of_rows.sum())
        # Rows without weight are never drawn.
        columns = np.cumsum(weights, axis=1) / np.where(of_rows > 0, of_rows, 1)[:, None]
        self._columns = aligned(mi.Float, columns)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points (row, column), counted in cells from the top left corner."""
        rows, columns = self.shape
        row, down = _choose(self._rows, mi.UInt32(0), rows, u.x)
        column, across = _choose(self._columns, row * columns, columns, u.y)
        return mi.Float(row) + down, mi.Float(column) + across


def _choose(cdf: mi.Float, first: mi.UInt32, count: int, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Choose one of `count` cells whose cumulative shares begin at `first`, and reuse the number for a place in it."""
    cell = mi.UInt32(dr.binary_search(0, count - 1, lambda i: dr.gather(mi.Float, cdf, first + mi.UInt32(i)) <= u))
    low = dr.select(cell > 0, dr.gather(mi.Float, cdf, first + cell - 1, cell > 0), 0)
    return cell, dr.clip((u - low) / (dr.gather(mi.Float, cdf, first + cell) - low), 0, 1)
