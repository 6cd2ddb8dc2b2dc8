"""Arrays of pixels: which pixel sees a tangent-plane point, and where to sample."""

from __future__ import annotations

import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.transport.fields import Field, Rectangle, Sector

logger = logging.getLogger(__name__)

#: Names of the four pixels of the published receivers, in pixel order.
PUBLISHED_NAMES = ("red", "green", "blue", "black")

#: Layouts of more pixels than this are imagers unless the scene says otherwise.
_LARGEST_LAYOUT = 16

FIELD_SHAPES = ("circle", "square")


class PixelArray(ABC):
    """The pixels of a receiver in tangent-plane angles [rad].

    Attributes
    ----------
    names
        One name a pixel.
    layout
        ``RxC``, or ``nested``.
    grid
        (rows, columns) of an imager, else None.
    area
        Area in which `sample` is uniform, counted once a pixel where pixels overlap [rad^2].
    field_of_view
        Full angle that holds all pixels [rad].
    field_of_view_shape
        ``circle``, ``square`` or ``nested``.
    """

    names: list[str]
    layout: str
    grid: tuple[int, int] | None
    area: float
    field_of_view: float
    field_of_view_shape: str

    @property
    def count(self) -> int:
        """Number of pixels."""
        return len(self.names)

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points (gx, gy) of density `count_at` / `area`."""

    @abstractmethod
    def pixel_at(self, gx: mi.Float, gy: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the pixel at a point and how many pixels hold it (0 outside all).

        Where pixels overlap, the uniform number `u` picks one of them.
        """

    @abstractmethod
    def centres(self) -> NDArray[np.float64]:
        """Return the pixels' centres (gx, gy) [rad], shape (pixels, 2)."""


class LayoutPixels(PixelArray):
    """A circular or square field of view cut into rows and columns.

    Points are drawn over the whole field of view and then given to the pixel that they fall into, so the number of
    pixels costs nothing and the pixels sum to the single pixel of the same field of view, path by path.

    Parameters
    ----------
    layout
        ``RxC``: R rows along range, row 0 the far edge (+gx); C columns, column 0 the -gy edge. ``1x4`` is the
        published receiver of four strips across range, the same as ``4x1``.
    field_of_view
        Diameter or side [rad], positive.
    shape
        ``circle`` or ``square``.
    imager
        Whether rows and columns stay apart in the result; None decides by the number of pixels.
    """

    def __init__(self, layout: str, field_of_view: float, shape: str, imager: bool | None = None) -> None:
        rows, columns = parse_layout(layout)
        half = 0.5 * field_of_view
        if shape not in FIELD_SHAPES:
            raise ValueError(f"field_of_view_shape = {shape!r} must be one of {', '.join(FIELD_SHAPES)}")
        self.field: Field = Sector(half) if shape == "circle" else Rectangle(-half, half, -half, half)
        self.layout = layout
        self.field_of_view = field_of_view
        self.field_of_view_shape = shape
        self.area = self.field.area
        self._rows, self._columns = rows, columns
        self.grid = (rows, columns) if (rows * columns > _LARGEST_LAYOUT if imager is None else imager) else None
        if (rows, columns) in ((2, 2), (4, 1)):
            self.names = list(PUBLISHED_NAMES)
        elif rows * columns == 1:
            self.names = ["single"]
        else:
            self.names = [f"r{row}c{column}" for row in range(rows) for column in range(columns)]

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points of the field of view."""
        return self.field.sample(u)

    def pixel_at(self, gx: mi.Float, gy: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the pixel at a point and whether the field of view holds it (1 or 0)."""
        half, full = 0.5 * self.field_of_view, self.field_of_view
        row = dr.clip(mi.Int32(dr.floor((half - gx) * (self._rows / full))), 0, self._rows - 1)
        column = dr.clip(mi.Int32(dr.floor((gy + half) * (self._columns / full))), 0, self._columns - 1)
        return mi.UInt32(row * self._columns + column), dr.select(self.field.contains(gx, gy), mi.Float(1), 0)

    def centres(self) -> NDArray[np.float64]:
        """Return centres of gravity (gx, gy) [rad], shape (pixels, 2); of the uncut cells in imagers."""
        half = 0.5 * self.field_of_view
        far = half - (np.arange(self._rows) + 0.5) * self.field_of_view / self._rows
        left = (np.arange(self._columns) + 0.5) * self.field_of_view / self._columns - half
        centres = np.stack(np.meshgrid(far, left, indexing="ij"), axis=-1).reshape(-1, 2)
        if self.count > _LARGEST_LAYOUT or self.field_of_view_shape == "square":
            return centres
        ticks = half * (2 * (np.arange(400) + 0.5) / 400 - 1)
        gx, gy = (g.ravel() for g in np.meshgrid(ticks, ticks))
        pixel, count = (np.array(a) for a in self.pixel_at(mi.Float(gx), mi.Float(gy), mi.Float(0)))
        for index in range(self.count):
            inside = (pixel == index) & (count > 0)
            if inside.any():
                centres[index] = gx[inside].mean(), gy[inside].mean()
        return centres


class ShapedPixels(PixelArray):
    """Pixels of any shape each, which may leave gaps and may overlap.

    Parameters
    ----------
    fields
        Shape of each pixel, at least one.
    names
        Name of each pixel, all different.
    """

    def __init__(self, fields: Sequence[Field], names: Sequence[str]) -> None:
        if len(set(names)) < len(fields):
            raise ValueError(f"pixel_name: names must differ, got {', '.join(names)}")
        self.fields = list(fields)
        self.names = list(names)
        self.layout = "nested" if len(fields) > 1 else "1x1"
        self.grid = None
        areas = np.array([field.area for field in fields])
        self.area = float(areas.sum())
        self._cdf = np.cumsum(areas) / self.area
        self.field_of_view = 2 * float(np.abs([field.bounds() for field in fields]).max())
        self.field_of_view_shape = "nested"
        for first, second in self._overlaps():
            logger.warning("pixels %r and %r overlap: light in both is counted in each", first, second)

    def _overlaps(self) -> list[tuple[str, str]]:
        """Return the names of pixels that overlap, found with 4096 points in each."""
        index = dr.arange(mi.Float, 4096)
        golden = index * 0.6180339887
        points = mi.Point2f((index + 0.5) / 4096, golden - dr.floor(golden))
        found = []
        for i, field in enumerate(self.fields[:-1]):
            gx, gy = field.sample(points)
            for j in range(i + 1, len(self.fields)):
                # Neighbours may share an edge to rounding: one point in 4096 is not an overlap.
                if dr.count(self.fields[j].contains(gx, gy))[0] > 1:
                    found.append((self.names[i], self.names[j]))
        return found

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points: a pixel by its area, then uniform in it."""
        gx, gy = mi.Float(0), mi.Float(0)
        low = 0.0
        for field, high in zip(self.fields, self._cdf, strict=True):
            chosen = u.x >= low
            x, y = field.sample(mi.Point2f(dr.clip((u.x - low) / (float(high) - low), 0, 1), u.y))
            gx, gy = dr.select(chosen, x, gx), dr.select(chosen, y, gy)
            low = float(high)
        return gx, gy

    def pixel_at(self, gx: mi.Float, gy: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return one pixel at a point and how many pixels hold it."""
        held = [field.contains(gx, gy) for field in self.fields]
        count = sum((dr.select(inside, mi.UInt32(1), 0) for inside in held), mi.UInt32(0))
        rank = dr.minimum(mi.UInt32(u * mi.Float(count)), dr.maximum(count, 1) - 1)
        chosen, seen = mi.UInt32(0), mi.UInt32(0)
        for index, inside in enumerate(held):
            chosen = dr.select(inside & (seen == rank), mi.UInt32(index), chosen)
            seen += dr.select(inside, mi.UInt32(1), 0)
        return chosen, mi.Float(count)

    def centres(self) -> NDArray[np.float64]:
        """Return centres of gravity (gx, gy) [rad], shape (pixels, 2)."""
        return np.array([field.centroid() for field in self.fields])


def parse_layout(layout: str) -> tuple[int, int]:
    """Return (rows, columns) of a layout such as ``2x2``; ``1x4`` is the published receiver of four strips.

    Raises
    ------
    ValueError
        When the text is not two positive whole numbers with an x between them, or has more than 2^20 pixels.
    """
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", layout)
    if not match:
        raise ValueError(f"layout = {layout!r} must be rows x columns, such as 1x1, 2x2, 1x4 or 128x128")
    rows, columns = int(match.group(1)), int(match.group(2))
    if rows * columns > 2**20:
        raise ValueError(f"layout = {layout!r} has {rows * columns} pixels; allowed are at most {2**20}")
    return (4, 1) if (rows, columns) == (1, 4) else (rows, columns)
