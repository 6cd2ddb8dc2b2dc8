"""Pixel arrays, also from a label image: sampling, and lookup of the pixel that sees a tangent-plane point."""

from __future__ import annotations

import logging
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.opaque import aligned, opaque
from mitransient_lidar.transport.rng import unit_points
from mitransient_lidar.transport.sensor.fov_shapes import FovShape, Rectangle, Sector
from mitransient_lidar.transport.sensor.image_sampling import ImageSampler, read_image

logger = logging.getLogger(__name__)

#: Names of the four pixels in the published receivers, in pixel order.
PUBLISHED_NAMES = ("red", "green", "blue", "black")

_LARGEST_LAYOUT = 16  #: Layouts of more pixels than this are imagers by default.

#: Largest number of pixels in a receiver, and in one with rows and columns.
MOST_PIXELS, _MOST_OF_LAYOUT = 2**20, 2**22

_OVERLAP_POINTS = 4096  #: Points in each pixel that find overlaps.
_CELLS_PER_PIXEL, _MOST_CELLS = 8, 256  #: Cells of the table along a side for each pixel along a side, and at most.


class PixelArray(ABC):
    """A receiver's pixels in tangent-plane angles [rad]."""

    names: list[str]  #: One name a pixel.
    layout: str  #: ``RxC``, ``hexN``, ``map`` or ``nested``.
    grid: tuple[int, int] | None  #: (rows, columns) of an imager, else None.
    area: float  #: Area in which `sample` is uniform, counted once a pixel where pixels overlap [rad^2].
    field_of_view: float  #: Full angle that contains all pixels [rad]: diameter or side about the axis.
    field_of_view_shape: str  #: ``circle``, ``square``, ``rectangle`` or ``nested``.
    #: Full angles along angle_x and angle_y [rad] for rows and columns of pixels, else None.
    sides: tuple[float, float] | None = None

    @property
    def count(self) -> int:
        """Number of pixels."""
        return len(self.names)

    @abstractmethod
    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points (angle_x, angle_y) with the density: number of pixels there over `area`."""

    @abstractmethod
    def pixel_at(self, angle_x: mi.Float, angle_y: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return a pixel at a point, one of several by the uniform number `u`, and how many contain it (0 outside)."""

    @abstractmethod
    def centres(self) -> NDArray[np.float64]:
        """Return the pixels' centres (angle_x, angle_y) [rad], shape (pixels, 2)."""


class LayoutPixels(PixelArray):
    """A circular, square or rectangular field of view cut into rows and columns.

    Points are drawn over the field of view and then assigned to pixels. The pixels thus sum, path by path, to a single
    pixel with the same field of view.

    `layout`: ``RxC``: R rows along range, row 0 the far edge (+angle_x); C columns, column 0 the left edge (+angle_y).
    ``1x4`` is ``4x1``. `field_of_view`: diameter or side [rad], positive; of a rectangle (height along angle_x, width
    along angle_y). `shape`: ``circle`` or ``square``; different sides make a rectangle. `imager`: whether rows and
    columns are separate dimensions of the result; None decides by the number of pixels. `fill_factor`: share of each
    cell that receives light, 0.01 to 1: a smaller rectangle about the same centre, cut by the circle.
    """

    sides: tuple[float, float]

    def __init__(
        self,
        layout: str,
        field_of_view: float | tuple[float, float],
        shape: str,
        imager: bool | None = None,
        fill_factor: float = 1.0,
    ) -> None:
        rows, columns = parse_layout(layout)
        self.sides = field_of_view if isinstance(field_of_view, tuple) else (field_of_view, field_of_view)
        height, width = (0.5 * side for side in self.sides)
        if height != width:
            shape = "rectangle"
        self.field: FovShape = Sector(height) if shape == "circle" else Rectangle(-height, height, -width, width)
        self.layout = layout
        self.field_of_view = max(self.sides)
        self.field_of_view_shape = shape
        # With gaps, all of each cell is sampled, though the circle cuts some.
        self._shrink = math.sqrt(fill_factor)
        self.area = fill_factor * self.sides[0] * self.sides[1] if fill_factor < 1 else self.field.area
        self._rows, self._columns = rows, columns
        self.grid = (rows, columns) if (rows * columns > _LARGEST_LAYOUT if imager is None else imager) else None
        if (rows, columns) in ((2, 2), (4, 1)):
            self.names = list(PUBLISHED_NAMES)
        elif rows * columns == 1:
            self.names = ["single"]
        else:
            self.names = [f"r{row}c{column}" for row in range(rows) for column in range(columns)]

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points in the field of view, or in its cells when they leave gaps."""
        if self._shrink == 1:
            return self.field.sample(u)
        height, width = self.sides
        row, column = u.x * self._rows, u.y * self._columns
        row, column = (dr.lerp(dr.floor(g) + 0.5, g, opaque(self._shrink)) for g in (row, column))
        top, left, down, across = map(opaque, (0.5 * height, 0.5 * width, height / self._rows, width / self._columns))
        return top - row * down, left - column * across

    def pixel_at(self, angle_x: mi.Float, angle_y: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the pixel at a point and whether the field of view contains it (1 or 0)."""
        height, width = self.sides
        down = (opaque(0.5 * height) - angle_x) * opaque(self._rows / height)
        across = (opaque(0.5 * width) - angle_y) * opaque(self._columns / width)
        row = dr.clip(mi.Int32(dr.floor(down)), 0, self._rows - 1)
        column = dr.clip(mi.Int32(dr.floor(across)), 0, self._columns - 1)
        inside = self.field.contains(angle_x, angle_y)
        if self._shrink < 1:
            off_centre = dr.maximum(dr.abs(down - row - 0.5), dr.abs(across - column - 0.5))
            inside &= off_centre <= opaque(0.5 * self._shrink)
        return mi.UInt32(row * self._columns + column), dr.select(inside, mi.Float(1), 0)

    def centres(self) -> NDArray[np.float64]:
        """Return centres of gravity (angle_x, angle_y) [rad], shape (pixels, 2); in imagers the uncut cells'."""
        height, width = self.sides
        far = 0.5 * height - (np.arange(self._rows) + 0.5) * height / self._rows
        left = 0.5 * width - (np.arange(self._columns) + 0.5) * width / self._columns
        centres = np.stack(np.meshgrid(far, left, indexing="ij"), axis=-1).reshape(-1, 2)
        if self.count > _LARGEST_LAYOUT or self.field_of_view_shape != "circle":
            return centres
        ticks = 0.5 * height * (2 * (np.arange(400) + 0.5) / 400 - 1)
        angle_x, angle_y = (g.ravel() for g in np.meshgrid(ticks, ticks))
        pixel, count = (np.array(a) for a in self.pixel_at(mi.Float(angle_x), mi.Float(angle_y), mi.Float(0)))
        for index in range(self.count):
            inside = (pixel == index) & (count > 0)
            if inside.any():
                centres[index] = angle_x[inside].mean(), angle_y[inside].mean()
        return centres


class ShapedPixels(PixelArray):
    """Pixels of any shapes, at least one, with different names; they may leave gaps and overlap."""

    def __init__(self, fields: Sequence[FovShape], names: Sequence[str]) -> None:
        if len(set(names)) < len(fields):
            raise UserError(f"pixel_name: names must differ, got {', '.join(names)}")
        self.fields = list(fields)
        self.names = list(names)
        self.layout = "nested" if len(fields) > 1 else "1x1"
        self.grid = None
        areas = np.array([field.area for field in fields])
        self.area = float(areas.sum())
        ends = np.cumsum(areas) / self.area
        self._starts = aligned(mi.Float, np.append(0, ends[:-1]))
        self._per_share = aligned(mi.Float, 1 / np.diff(ends, prepend=0))
        self.field_of_view = 2 * float(np.abs([field.bounds() for field in fields]).max())
        self.field_of_view_shape = "nested"
        self._lookup = FovLookup(fields)
        for first, second in self._overlaps():
            logger.warning("pixels %r and %r overlap: light in both is counted in each", first, second)

    def _overlaps(self) -> list[tuple[str, str]]:
        """Return the names of pixels that overlap, found with 4096 points in each."""
        neighbours = self._lookup.neighbours.tolist()
        if not neighbours:
            return []
        points = unit_points(_OVERLAP_POINTS)
        lane = dr.arange(mi.UInt32, _OVERLAP_POINTS * self.count)
        pixel = lane // _OVERLAP_POINTS
        angle_x, angle_y = self._sample_in(pixel, dr.gather(mi.Point2f, points, lane % _OVERLAP_POINTS))
        _, held = self._lookup.find(angle_x, angle_y, mi.Float(0))
        # Neighbours may share an edge to rounding: one point in 4096 is not an overlap.
        shared = np.bincount(np.array(pixel)[np.array(held) > 1], minlength=self.count) > 1
        found = []
        for i, j in neighbours:
            if shared[i] and dr.count(self.fields[j].contains(*self.fields[i].sample(points)))[0] > 1:
                found.append((self.names[i], self.names[j]))
        return found

    def _sample_in(self, pixel: mi.UInt32, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points of the given pixels."""
        return tuple(dr.switch(pixel, [field.sample for field in self.fields], u))

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points: a pixel by its area, then uniform in it."""
        last = len(self.fields) - 1
        pixel = dr.binary_search(0, last, lambda i: dr.gather(mi.Float, self._starts, i + 1) <= u.x)
        start, per_share = (dr.gather(mi.Float, table, pixel) for table in (self._starts, self._per_share))
        point = mi.Point2f(dr.clip((u.x - start) * per_share, 0, 1), u.y)
        return self._sample_in(mi.UInt32(pixel), point)

    def pixel_at(self, angle_x: mi.Float, angle_y: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return one pixel at a point and how many pixels contain it."""
        pixel, count = self._lookup.find(angle_x, angle_y, u)
        return pixel, mi.Float(count)

    def centres(self) -> NDArray[np.float64]:
        """Return centres of gravity (angle_x, angle_y) [rad], shape (pixels, 2)."""
        return np.array([field.centroid() for field in self.fields])


class FovLookup:
    """Tests only the fields near a point, which a table of square cells lists, so that many cost no more than a few."""

    def __init__(self, fields: Sequence[FovShape]) -> None:
        self._contains = [field.contains for field in fields]
        bounds = np.array([field.bounds() for field in fields])
        low, high = bounds[:, [0, 2]].min(axis=0), bounds[:, [1, 3]].max(axis=0)
        self._side = min(_MOST_CELLS, _CELLS_PER_PIXEL * math.ceil(math.sqrt(len(fields))))
        self._low = low.tolist()
        size = (high - low) / self._side
        self._per_radian = (1 / size).tolist()
        ticks = (np.arange(self._side) + 0.5)[:, None] * size + low
        angle_x, angle_y = (g.ravel() for g in np.meshgrid(*ticks.T, indexing="ij"))
        # Half the diagonal of a cell, with a margin for points that rounding puts into the next one.
        reach = 0.501 * float(np.hypot(*size))
        near = np.stack([field.comes_near(angle_x, angle_y, reach) for field in fields], axis=1)
        self._first = mi.UInt32(np.concatenate([[0], np.cumsum(near.sum(axis=1))]))
        self._fields = mi.UInt32(np.nonzero(near)[1])
        shared = near.T.astype(np.float32) @ near.astype(np.float32)
        #: Pairs of fields that may overlap, shape (pairs, 2).
        self.neighbours: NDArray[np.int64] = np.argwhere(np.triu(shared, 1) > 0)

    def find(self, angle_x: mi.Float, angle_y: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.UInt32]:
        """Return one of the fields that contain a point, chosen by the uniform number `u`, and how many do."""
        i, j = (
            mi.UInt32(dr.clip((g - low) * scale, 0, self._side - 1))
            for g, low, scale in zip((angle_x, angle_y), self._low, self._per_radian, strict=True)
        )
        cell = i * self._side + j
        first, end = (dr.gather(mi.UInt32, self._first, cell + step) for step in (0, 1))
        chosen, count = self._holder(angle_x, angle_y, first, end, mi.UInt32(0))
        # A second search, only where another field than the first is chosen.
        wanted = dr.minimum(mi.UInt32(u * mi.Float(count)), dr.maximum(count, 1) - 1)
        other, _ = self._holder(angle_x, angle_y, dr.select(wanted > 0, first, end), end, wanted)
        return dr.select(wanted > 0, other, chosen), count

    def _holder(
        self, angle_x: mi.Float, angle_y: mi.Float, first: mi.UInt32, end: mi.UInt32, wanted: mi.UInt32
    ) -> tuple[mi.UInt32, mi.UInt32]:
        """Return field number `wanted` among those in a part of the list that contain a point, and their number."""

        def step(index: mi.UInt32, chosen: mi.UInt32, count: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
            field = dr.gather(mi.UInt32, self._fields, index)
            inside = dr.switch(field, self._contains, angle_x, angle_y)
            chosen = dr.select(inside & (count == wanted), field, chosen)
            return index + 1, chosen, count + dr.select(inside, mi.UInt32(1), 0)

        state = first, mi.UInt32(0), mi.UInt32(0)
        _, chosen, count = dr.while_loop(state, lambda index, chosen, count: index < end, step, label="pixel lookup")
        return chosen, count


def parse_layout(layout: str) -> tuple[int, int]:
    """Return (rows, columns) for a layout such as ``2x2``; ``1x4`` is the published receiver with four strips.

    Raises UserError when the text is not two positive integers with an x between them, or has more than 2^22 pixels.
    """
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", layout)
    if not match:
        raise UserError(f"layout = {layout!r} must be rows x columns, such as 1x1, 2x2, 1x4 or 128x128, or hex7")
    rows, columns = int(match.group(1)), int(match.group(2))
    if rows * columns > _MOST_OF_LAYOUT:
        raise UserError(f"layout = {layout!r} has {rows * columns} pixels; allowed are at most {_MOST_OF_LAYOUT}")
    return (4, 1) if (rows, columns) == (1, 4) else (rows, columns)


_LARGEST_LABEL = 2**24  #: Integers up to this are exact in 32-bit images.


class MappedPixels(PixelArray):
    """A square field of view divided into pixels by a label image.

    All cells with one label are one pixel, named ``label`` and the number; those with the label 0 receive nothing.
    Points are drawn over all labelled cells, so that the pixels sum to the single pixel of the same cells path by path.

    `labels`: integers from 0, not all 0, shape (rows, columns). Row 0 is the far edge (+angle_x), column 0 the left one
    (+angle_y). `field_of_view`: side of the square [rad], positive.
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


_ROOT3 = math.sqrt(3.0)


class HexPixels(PixelArray):
    """A hexagon and rings of hexagons around it, in rows along angle_y.

    The field of view is the circumscribed circle about the axis. For N hexagons with side s its radius is sqrt(N) s.
    They fill 3 sqrt(3) / (2 pi) = 82.7 % of it for any N.

    The array without its central hexagon is three parallelograms of n x (n + 1) hexagons for n rings. Points are drawn
    in these and assigned to hexagons afterwards, at a cost that does not depend on N.

    `layout`: ``hexN`` with N = 1, 7, 19, 37, ... hexagons. `field_of_view`: circle diameter [rad], positive.
    `fill_factor`: share of each hexagon that receives light, 0.01 to 1: a smaller hexagon about the same centre.

    A hexagon has the axial coordinates (column, row) with its centre at angle_x = 1.5 s row and angle_y = sqrt(3) s
    (column + row / 2).
    """

    def __init__(self, layout: str, field_of_view: float, fill_factor: float = 1.0) -> None:
        count = hexagon_count(layout)
        self._rings = rings = (math.isqrt(12 * count - 3) - 3) // 6
        self._side = 0.5 * field_of_view / math.sqrt(count)
        self._shrink = math.sqrt(fill_factor)
        self.layout = layout
        self.grid = None
        self.area = fill_factor * count * 1.5 * _ROOT3 * self._side**2
        self.field_of_view = field_of_view
        self.field_of_view_shape = "circle"
        # Axial coordinates of each pixel, from the far row to the near one, and from left (+angle_y) to right in a row.
        rows = [(rings - k, 2 * rings + 1 - abs(rings - k)) for k in range(2 * rings + 1)]
        self._axial = np.array([(rings - max(row, 0) - i, row) for row, length in rows for i in range(length)])
        names = [f"r{k}c{i}" for k, (_, length) in enumerate(rows) for i in range(length)]
        self.names = names if count > 1 else ["single"]

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to uniform points in the hexagons."""
        rings, count = self._rings, self.count
        of_centre = u.x * count < 1
        part = (u.x * count - 1) * (3 / max(count - 1, 1))
        third = dr.minimum(dr.floor(part), 2)
        across = dr.select(of_centre, u.x * count, (part - third) * rings)
        along = dr.select(of_centre, u.y, u.y * (rings + 1))
        a, b = dr.floor(across), dr.floor(along)
        # The rhombic cell of the lattice has the same points as the hexagon, moved by lattice vectors.
        column, row = across - a, along - b
        near_column, near_row = _round(column, row)
        side, shrink = opaque(self._side), opaque(self._shrink)
        angle_x, angle_y = _position(column - near_column, row - near_row, side)
        # In the first parallelogram, next to the centre; the others are rotated by 120 and 240 degrees.
        column, row = dr.select(of_centre, 0, a + 1 - b), dr.select(of_centre, 0, b)
        for rotation in (1, 2):
            rotated = ~of_centre & (third >= rotation)
            column, row = dr.select(rotated, -column - row, column), dr.select(rotated, column, row)
        x, y = _position(column, row, side)
        return dr.fma(angle_x, shrink, x), dr.fma(angle_y, shrink, y)

    def pixel_at(self, angle_x: mi.Float, angle_y: mi.Float, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """Return the pixel at a point and whether a hexagon contains it (1 or 0)."""
        rings, side = self._rings, opaque(self._side)
        row = angle_x / (1.5 * side)
        column, row = _round(angle_y / (_ROOT3 * side) - 0.5 * row, row)
        inside = dr.maximum(dr.maximum(dr.abs(column), dr.abs(row)), dr.abs(column + row)) <= rings
        if self._shrink < 1:
            x, y = _position(column, row, side)
            x, y = dr.abs(angle_x - x), dr.abs(angle_y - y)
            inside &= dr.maximum(y, 0.5 * (_ROOT3 * x + y)) <= opaque(0.5 * _ROOT3 * self._side * self._shrink)
        i, k = mi.Int32(dr.select(inside, column, 0)), rings - mi.Int32(dr.select(inside, row, 0))
        # Hexagons in the rows before this one: rows grow from rings + 1 hexagons to 2 rings + 1, and shrink again.
        past = dr.maximum(k - rings, 0)
        before = k * (rings + 1) + (k * (k - 1)) // 2 - past * past + past
        index = before + rings - dr.maximum(rings - k, 0) - i
        return mi.UInt32(dr.select(inside, index, 0)), dr.select(inside, mi.Float(1), 0)

    def centres(self) -> NDArray[np.float64]:
        """Return the centres of the hexagons (angle_x, angle_y) [rad], shape (pixels, 2)."""
        column, row = self._axial.T.astype(np.float64)
        return np.stack(_position(column, row, self._side), axis=1)


def hexagon_count(layout: str) -> int:
    """Return the number of hexagons in a layout such as ``hex7``.

    Raises UserError when the number is not one hexagon plus complete rings around it, or is above 2^20.
    """
    match = re.fullmatch(r"hex([1-9]\d*)", layout)
    count = int(match.group(1)) if match else 0
    root = math.isqrt(max(12 * count - 3, 0))
    if root * root != 12 * count - 3:
        raise UserError(f"layout = {layout!r} must have 1, 7, 19, 37, 61, ... hexagons, a centre and complete rings")
    if count > MOST_PIXELS:
        raise UserError(f"layout = {layout!r} has {count} pixels; allowed are at most {MOST_PIXELS}")
    return count


def _round(column: mi.Float, row: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return the axial coordinates of the hexagon around a point: round three cube coordinates, correct the worst."""
    third = -column - row
    c, r, t = dr.round(column), dr.round(row), dr.round(third)
    off_c, off_r, off_t = dr.abs(c - column), dr.abs(r - row), dr.abs(t - third)
    worst_c = (off_c > off_r) & (off_c > off_t)
    worst_r = ~worst_c & (off_r > off_t)
    return dr.select(worst_c, -r - t, c), dr.select(worst_r, -c - t, r)


def _position(column: mi.Float, row: mi.Float, side: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return (angle_x, angle_y) from axial coordinates, for a hexagon side."""
    return 1.5 * side * row, _ROOT3 * side * (column + 0.5 * row)
