"""Pixels drawn as a label image."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.opaque import aligned, opaque
from mitransient_lidar.transport.sensor.image_sampling import ImageSampler, read_image
from mitransient_lidar.transport.sensor.pixels import MOST_PIXELS, PixelArray

#: Integers up to this are exact in 32-bit images.
_LARGEST_LABEL = 2**24


class MappedPixels(PixelArray):
    """A square field of view divided into pixels by a label image.

    All cells with one label are one pixel, named ``label`` and the number; those with the label 0 receive nothing.
    Points are drawn over all labelled cells, so that the pixels sum to the single pixel of the same cells path by path.

    Parameters
    ----------
    labels
        Integers from 0, not all 0, shape (rows, columns); row 0 is the far edge (+angle_x), column 0 the left one
        (+angle_y).
    field_of_view
        Side of the square [rad], positive.
    """

    def __init__(self, labels: NDArray[np.integer], field_of_view: float) -> None:
        numbers, pixel = np.unique(labels, return_inverse=True)
        pixel = pixel.reshape(labels.shape)
        if numbers[0] == 0:
            numbers, pixel = numbers[1:], pixel - 1
        self._pixel = pixel
        self._table = aligned(mi.Int32, pixel)
        self._sampler = ImageSampler(np.asarray(pixel >= 0, dtype=np.float64))
        self.names = [f"label{number}" for number in numbers]
        self.layout = "map"
        self.grid = None
        self.field_of_view = field_of_view
        self.field_of_view_shape = "square"
        self.area = field_of_view**2 * float(np.mean(pixel >= 0))

    @classmethod
    def from_file(cls, path: str, field_of_view: float) -> MappedPixels:
        """Read the labels from a .png, .npy or .exr file; raise UserError when it holds no valid labels."""
        values = read_image("pixel_map", path)
        where = f"pixel_map = {path!r}"
        if (values != np.round(values)).any() or values.min() < 0 or values.max() > _LARGEST_LABEL:
            raise UserError(f"{where} must hold labels that are integers from 0 to {_LARGEST_LABEL}")
        if not values.any():
            raise UserError(f"{where} must have a label other than 0, which is no pixel")
        labels = values.astype(np.int64)
        count = len(np.unique(labels[labels > 0]))
        if count > MOST_PIXELS:
            raise UserError(f"{where} has {count} labels; allowed are at most {MOST_PIXELS}")
        return cls(labels, field_of_view)

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points of the labelled cells."""
        row, column = self._sampler.sample(u)
        rows, columns = self._pixel.shape
        half, full = opaque(0.5 * self.field_of_view), opaque(self.field_of_view)
        return half - row * (full / rows), half - column * (full / columns)

    def pixel_at(self, angle_x: mi.Float, angle_y: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the pixel at a point and whether its cell has a label (1 or 0)."""
        rows, columns = self._pixel.shape
        half, full = opaque(0.5 * self.field_of_view), opaque(self.field_of_view)
        row = mi.Int32(dr.floor((half - angle_x) * (rows / full)))
        column = mi.Int32(dr.floor((half - angle_y) * (columns / full)))
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        pixel = dr.gather(mi.Int32, self._table, mi.UInt32(row * columns + column), inside)
        inside &= pixel >= 0
        return mi.UInt32(dr.select(inside, pixel, 0)), dr.select(inside, mi.Float(1), 0)

    def centres(self) -> NDArray[np.float64]:
        """Return the pixels' centres of gravity (angle_x, angle_y) [rad], shape (pixels, 2)."""
        rows, columns = self._pixel.shape
        row, column = np.nonzero(self._pixel >= 0)
        pixel = self._pixel[row, column]
        cells = np.bincount(pixel)
        angle_x = 0.5 - (np.bincount(pixel, row + 0.5) / cells) / rows
        angle_y = 0.5 - (np.bincount(pixel, column + 0.5) / cells) / columns
        return self.field_of_view * np.stack([angle_x, angle_y], axis=1)
