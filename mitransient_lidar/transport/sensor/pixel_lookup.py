"""Lookup of the pixels that contain a point."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.transport.sensor.fov_shapes import FovShape

#: Cells of the table along a side for each pixel along a side, and at most.
_CELLS_PER_PIXEL, _MOST_CELLS = 8, 256


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
        """Return field number `wanted` of those in a part of the list that contain a point, and how many do."""

        def step(index: mi.UInt32, chosen: mi.UInt32, count: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
            field = dr.gather(mi.UInt32, self._fields, index)
            inside = dr.switch(field, self._contains, angle_x, angle_y)
            chosen = dr.select(inside & (count == wanted), field, chosen)
            return index + 1, chosen, count + dr.select(inside, mi.UInt32(1), 0)

        state = first, mi.UInt32(0), mi.UInt32(0)
        _, chosen, count = dr.while_loop(state, lambda index, chosen, count: index < end, step, label="pixel lookup")
        return chosen, count
