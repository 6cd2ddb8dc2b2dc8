"""Pixels in the shape of hexagons, in rings about a central one."""

from __future__ import annotations

import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.sensor.pixels import MOST_PIXELS, PixelArray

_ROOT3 = math.sqrt(3.0)


class HexPixels(PixelArray):
    """A hexagon and rings of hexagons around it, in rows along angle_y.

    The field of view is the circumscribed circle about the axis. For N hexagons with side s its radius is sqrt(N) s,
    and they fill 3 sqrt(3) / (2 pi) = 82.7 % of it for any N.

    The array without its central hexagon is three parallelograms of n x (n + 1) hexagons for n rings. Points are drawn
    in these and assigned to hexagons afterwards, at a cost that does not depend on N.

    Parameters
    ----------
    layout
        ``hexN`` with N = 1, 7, 19, 37, ... hexagons.
    field_of_view
        Circle diameter [rad], positive.
    fill_factor
        Share of each hexagon that receives light, 0.01 to 1: a smaller hexagon about the same centre.

    Notes
    -----
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
