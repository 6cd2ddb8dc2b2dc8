"""Bottom depths in a scene at locations on its sea, which waves follow."""

from __future__ import annotations

from functools import cached_property

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.sea.sea_surface import DEEP
from mitransient_lidar.physics.sea.shoaling import BottomDepths
from mitransient_lidar.transport.opaque import aligned_ray
from mitransient_lidar.transport.solids import box_of, scene_of_shapes

#: Smallest bottom side over the largest solid's side: waves do not follow targets and piers.
_BOTTOM_PER_LARGEST = 0.25

#: Distance of locations from the bottoms' edges, and of ray starts above them [m].
_MARGIN = 1e-3


class _Bottoms:
    """Bottoms of a scene in a box from `low` to `high` [m]."""

    def __init__(self, shapes: list[mi.Shape]) -> None:
        boxes = [box_of(shape) for shape in shapes]
        self._shapes = shapes
        self.low, self.high = np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)

    @cached_property
    def _scene(self) -> mi.Scene:
        return scene_of_shapes(self._shapes, ())

    def depths(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return depths [m] on grid lines [m], shape (len(y), len(x)): of the nearest place in the box, or `DEEP`."""
        if self.low[2] == self.high[2]:
            return np.full((len(y), len(x)), -self.low[2])
        lines = (
            np.clip(values, low + _MARGIN, high - _MARGIN)
            for values, low, high in zip((x, y), self.low, self.high, strict=False)
        )
        east, north = (values.ravel() for values in np.meshgrid(*lines))
        top = float(self.high[2]) + _MARGIN
        origins = np.stack([east, north, np.full(east.size, top)], axis=1)
        down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
        found = self._scene.ray_intersect_preliminary(aligned_ray(origins, down, np.full(east.size, np.inf)))
        distance = np.array(found.t, dtype=np.float64)
        depth = np.where(np.isfinite(distance), distance - top, DEEP)
        return np.asarray(depth.reshape(len(y), len(x)))


def bottom_depths(scene: mi.Scene) -> BottomDepths | None:
    """Return a scene's bottom depths in its frame, None without a bottom.

    Bottoms are the solids whose shorter horizontal side is at least a quarter of the largest solid's. Beyond them the
    depth is the depth of their nearest edge.
    """
    shapes = [
        shape
        for shape in scene.shapes()
        if not shape.is_medium_transition() and shape.bbox().valid() and shape.class_name() != "Instance"
    ]
    sides = [float((high - low)[:2].min()) for low, high in map(box_of, shapes)]
    largest = max(sides, default=0.0)
    found = [shape for shape, side in zip(shapes, sides, strict=True) if side >= _BOTTOM_PER_LARGEST * largest]
    if not largest > 0:
        return None
    bottoms = _Bottoms(found)
    return BottomDepths(-float(bottoms.high[2]), bottoms.depths)
