"""Solids as light meets them, without ineffective ones, as instances; depths of the bottom, which waves follow."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.sea.sea_surface import DEEP
from mitransient_lidar.physics.sea.shoaling import BottomDepths
from mitransient_lidar.transport.opaque import aligned_ray

#: BSDFs that have no effect where the indices of refraction on both sides are equal.
_DIELECTRICS = ("SmoothDielectric", "ThinDielectric")

#: Ray positions within the cells along a side, as cell shares, and distance before a box at which rays begin [m].
_PLACES, BEFORE = (0.4142, 0.5858), 1e-3

_FLAT = 1e-4  #: Thickness of a flat box over its coordinates, or 1 m: rays along it would meet edges alone.


class _Children(mi.TraversalCallback):  # type: ignore[misc]
    """Collects the objects within an object."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[mi.Object] = []

    def put(self, name: str, value: object, *_: object) -> None:
        """Collect an object."""
        if isinstance(value, mi.Object):
            self.found.append(value)

    put_object = put


def children(parent: mi.Object) -> list[mi.Object]:
    """Return the objects within a Mitsuba object, in the order in which it shows them."""
    # A class made here would keep them alive until Python collects it, and with them their share of kernels.
    callback = _Children()
    parent.traverse(callback)
    return callback.found


def shape_groups(scene: mi.Scene) -> tuple[mi.Shape, ...]:
    """Return the shape groups that a scene's instances repeat.

    Raises UserError if one of them bounds a medium.
    """
    groups = tuple(child for child in children(scene) if child.class_name().startswith("ShapeGroup"))
    for group in groups:
        for shape in children(group):
            if shape.is_medium_transition():
                raise UserError(
                    f"shape {shape.id()!r} of the shapegroup {group.id()!r} has a medium: an instance has none"
                )
    return groups


def scene_of_shapes(shapes: Sequence[mi.Shape], groups: Sequence[mi.Shape]) -> mi.Scene:
    """Return a scene with shapes, and with the groups that instances among them repeat."""
    parts = *shapes, *groups
    ids = [shape.id() for shape in parts]
    named = {f"shape{number}": shape for number, shape in enumerate(parts)}
    scene = mi.load_dict({"type": "scene", **named}, parallel=False)
    # A scene renames its shapes.
    for shape, own in zip(parts, ids, strict=True):
        shape.set_id(own)
    return scene


def without_unseen(scene: mi.Scene, groups: Sequence[mi.Shape]) -> mi.Scene:
    """Return a scene of the shapes and groups that have an effect on light; the same one if all shapes have."""
    shapes = scene.shapes()
    seen = [shape for shape in shapes if shape.is_medium_transition() or not _is_unseen(shape)]
    return scene if len(seen) == len(shapes) else scene_of_shapes(seen, groups)


def _is_unseen(shape: mi.Shape) -> bool:
    """Return whether all light passes a shape unchanged."""
    bsdf = shape.bsdf()
    if bsdf is None or shape.class_name() == "Instance":
        return False
    if int(bsdf.flags()) & mi.BSDFFlags.All.value == mi.BSDFFlags.Null.value:
        return True
    values = {name: np.array(value) for name, value in mi.traverse(bsdf) if name.endswith(("eta", "value", "data"))}
    if bsdf.class_name() == "MaskBSDF":
        opacity = [value for name, value in values.items() if name.startswith("opacity")]
        return bool(opacity) and not any(value.any() for value in opacity)
    if bsdf.class_name() not in _DIELECTRICS:
        return False
    through = (value for name, value in values.items() if name == "eta" or name.startswith("specular_transmittance"))
    return all((value == 1).all() for value in through)


def box_of(shape: mi.Shape) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest coordinates of a shape's bounding box [m], shape (3,) each."""
    box = shape.bbox()
    return np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)


def box_rays(low: FloatArray, high: FloatArray, ticks: int) -> tuple[FloatArray, FloatArray]:
    """Return origins and directions, shape (n, 3), of rays from all sides through a box, `ticks` along each side.

    They begin 1 mm or more before the box, between its corners (x, y, z) [m], and pass beside edges of most meshes.
    """
    low, high = np.array(low, np.float64), np.array(high, np.float64)
    along, across = (grid.ravel() for grid in np.meshgrid(*((np.arange(ticks) + place) / ticks for place in _PLACES)))
    origins, directions = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        if min(high[u] - low[u], high[v] - low[v]) <= _FLAT * max(np.abs([low, high]).max(), 1.0):
            continue
        margin = BEFORE + BEFORE * np.abs([low[axis], high[axis]]).max()
        for start, sign in ((low[axis] - margin, 1.0), (high[axis] + margin, -1.0)):
            origin, direction = (np.zeros((ticks * ticks, 3)) for _ in range(2))
            origin[:, axis], direction[:, axis] = start, sign
            origin[:, u] = low[u] + along * (high[u] - low[u])
            origin[:, v] = low[v] + across * (high[v] - low[v])
            origins.append(origin)
            directions.append(direction)
    return np.reshape(origins, (-1, 3)), np.reshape(directions, (-1, 3))


def met_shape(si: mi.SurfaceInteraction3f) -> mi.ShapePtr:
    """Return the scene's shapes at intersections: an instance in place of the shape that it repeats."""
    return dr.select(si.instance != None, si.instance, si.shape)  # noqa: E711


def met_numbers(si: mi.SurfaceInteraction3f) -> NDArray[np.uint32]:
    """Return the numbers of the shapes that rays meet, as by `shape_number`; 0 where they meet none."""
    return np.array(dr.select(si.is_valid(), dr.reinterpret_array(mi.UInt32, met_shape(si)), 0))


#: Smallest bottom side over the largest solid's side: waves do not follow targets and piers.
_BOTTOM_PER_LARGEST = 0.25

#: Distance of locations from the bottoms' edges, and of ray starts above them [m]; places of second rays beside the
#: first one [m].
_MARGIN, _ASIDE = 1e-3, ((7e-4, 4e-4), (-5e-4, 8e-4))


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
    boxes = np.array([box_of(shape) for shape in found])
    lowest, highest = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    alone = cache(partial(scene_of_shapes, tuple(found), ()))

    def depths(x: FloatArray, y: FloatArray) -> FloatArray:
        """Return depths [m] on grid lines [m], shape (len(y), len(x)): of the nearest place in the box, or `DEEP`.

        Lines of several patches, shapes (n, len(x)) and (n, len(y)), give theirs, shape (n, len(y), len(x)).
        """
        shape = (*y.shape, x.shape[-1])
        if lowest[2] == highest[2]:
            return np.full(shape, -lowest[2])
        along_x, along_y = (
            np.clip(values, low + _MARGIN, high - _MARGIN)
            for values, low, high in zip((x, y), lowest, highest, strict=False)
        )
        east, north = (
            np.broadcast_to(values, shape).ravel() for values in (along_x[..., None, :], along_y[..., :, None])
        )
        top = float(highest[2]) + _MARGIN
        origins = np.stack([east, north, np.full(east.size, top)], axis=1)
        down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
        distance = np.full(east.size, np.inf)
        for aside in ((0.0, 0.0), *_ASIDE):
            # A few rays on edges of faces pass between them.
            if not (missed := np.flatnonzero(np.isinf(distance))).size:
                break
            rays = aligned_ray(origins[missed] + [*aside, 0.0], down[missed], np.full(missed.size, np.inf))
            distance[missed] = np.array(alone().ray_intersect_preliminary(rays, coherent=True).t)
        depth = np.where(np.isfinite(distance), distance - top, DEEP)
        return np.asarray(depth.reshape(shape))

    return BottomDepths(-float(highest[2]), depths)
