"""Shapes that coincide in a face: rounding would decide which of them a ray meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.solids import box_rays, met_shape, scene_of_shapes

#: Distance within which faces coincide, and by which they are moved apart: absolute [m] and over coordinates.
_SAME, _APART, _ROUNDING = 2e-5, 1e-4, 2.0**-20

#: Least cosine between normals of faces that coincide, and least number of rays that find them.
_PARALLEL, _LEAST_RAYS = 0.9999, 3

#: Largest vertical component of a direction that counts as level.
_LEVEL = 1e-3

#: Rays along each side of a box.
_TICKS = 32

#: Largest size of a shape that lies on another one, over that of the other one.
_SMALLER = 0.99

#: Largest number of shapes that lie on each other.
_MOST_IN_A_STACK = 64


@dataclass(frozen=True)
class _Contact:
    """A shape and a larger one that coincide: a point of their faces [m], and the normals of both there, shape (3,)."""

    shape: mi.Shape
    larger: mi.Shape
    point: FloatArray
    normal: FloatArray
    normal_of_larger: FloatArray


def separate_contacts(scene: WaterScene) -> list[mi.Shape]:
    """Move solids 0.1 mm off others with which they coincide in a face; return those that have been moved.

    Off a bottom a solid is moved upwards. Of two others whose faces look at each other the upper one is moved, or the
    smaller one to the side; of two whose faces look the same way the smaller one, if it lies within the larger one.

    Raises
    ------
    UserError
        If a solid coincides with the surface of the water, or if it is not defined which one of two solids is seen.
    """
    # Waves coincide with nothing.
    waves = [sea for sea in scene.seas if np.isfinite(sea.sea.cell_size)]
    shapes = [shape for shape in scene.mitsuba_scene.shapes() if not any(shape is sea for sea in waves)]
    pending = _neighbours(shapes, scene.surfaces)
    moved: dict[int, mi.Shape] = {}
    for _ in range(_MOST_IN_A_STACK):
        found = [contact for larger, others in pending for contact in _contacts(larger, others, scene.groups)]
        separations = [_separation(contact, scene) for contact in found]
        if not any(separations):
            _refuse_visible(found, shapes, scene.groups)
            return list(moved.values())
        # Once in a round, so that others on both sides of a shape do not push it to and fro.
        for moving, direction in {id(one[0]): one for one in separations if one is not None}.values():
            _move(moving, direction)
            moved[id(moving)] = moving
        pending = [
            (larger, others)
            for larger, others in pending
            if any(one is contact.larger or one is contact.shape for contact in found for one in (larger, *others))
        ]
    raise _refusal(found[0], f"they are two of more than {_MOST_IN_A_STACK} that lie on each other")


def _neighbours(shapes: Sequence[mi.Shape], surfaces: Sequence[mi.Shape]) -> list[tuple[mi.Shape, list[mi.Shape]]]:
    """Return shapes with the smaller ones whose bounding boxes touch theirs, pairs of surfaces of the water aside."""
    if len(shapes) < 2:
        return []
    low, high = (np.array([getattr(shape.bbox(), end) for shape in shapes], np.float64) for end in ("min", "max"))
    margin = _tolerance(np.abs([low, high]).max(axis=(0, 2)))[:, None]
    is_surface = np.array([any(shape is surface for surface in surfaces) for shape in shapes])
    sizes = np.where(is_surface, np.inf, np.linalg.norm(high - low, axis=1))
    order, found = np.lexsort((np.arange(len(shapes)), -sizes)), []
    for rank, number in enumerate(order):
        others = order[rank + 1 :]
        touch = (low[others] <= high[number] + margin[others]) & (high[others] >= low[number] - margin[others])
        others = others[touch.all(axis=1) & ~(is_surface[number] & is_surface[others])]
        if len(others):
            found.append((shapes[number], [shapes[other] for other in others]))
    return found


def _contacts(larger: mi.Shape, others: list[mi.Shape], groups: Sequence[mi.Shape]) -> list[_Contact]:
    """Return where other shapes coincide with a larger one."""
    around, found = larger.bbox(), []
    boxes = []
    for other in others:
        box = mi.ScalarBoundingBox3f(other.bbox())
        box.clip(around)
        boxes.append(box)
    origins, directions = (
        np.concatenate(arrays)
        for arrays in zip(*(box_rays(np.array(box.min), np.array(box.max), _TICKS) for box in boxes), strict=True)
    )
    if len(origins) == 0:
        return []
    ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T))
    si = scene_of_shapes(others, groups).ray_intersect(ray)
    dr.eval(si)
    tolerance = _tolerance(dr.max(dr.abs(si.p)))
    back = mi.Ray3f(dr.fma(2 * tolerance, si.n, si.p), -si.n)
    back.maxt = 4 * tolerance
    on_larger = scene_of_shapes([larger], groups).ray_intersect(back, si.is_valid())
    same = si.is_valid() & on_larger.is_valid() & (dr.abs(on_larger.t - 2 * tolerance) < tolerance)
    same &= dr.abs(dr.dot(si.n, on_larger.n)) > _PARALLEL
    shape = dr.reinterpret_array(mi.UInt32, met_shape(si))
    # One by one, each would trace the rays again.
    dr.eval(same, shape, si.p, si.n, on_larger.n)
    met = np.array(same)
    rows = [np.array(values, np.float64).T[met] for values in (si.p, si.n, on_larger.n)]
    numbers = np.array(shape)[met]
    for other in others:
        own = numbers == int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(other))[0])
        if own.sum() >= _LEAST_RAYS:
            found.append(_Contact(other, larger, *(row[own][0] for row in rows)))
    return found


def _separation(contact: _Contact, scene: WaterScene) -> tuple[mi.Shape, FloatArray] | None:
    """Return the shape of a contact that is moved, and in which unit direction; None where it is not defined."""
    pair = contact.shape, contact.larger
    if any(one is surface for one in pair for surface in scene.surfaces):
        raise _refusal(contact, "one of them is the surface of the water")
    bottoms = [any(one is bottom for bottom in scene.bottoms) for one in pair]
    if bottoms[0] != bottoms[1]:
        moving, normal = pair if bottoms[1] else pair[::-1], contact.normal_of_larger if bottoms[1] else contact.normal
        return moving[0], np.copysign(1.0, normal[2]) * normal
    if contact.normal @ contact.normal_of_larger < 0:
        # Bodies leave each other, single faces pass each other; what goes up stays off all that lies below.
        direction = contact.normal_of_larger if _has_body(contact, scene.groups) else contact.normal
        return pair[int(direction[2] < -_LEVEL)], np.copysign(1.0, direction[2] + _LEVEL) * direction
    return (contact.shape, contact.normal_of_larger) if _lies_within(contact) else None


def _refuse_visible(contacts: Sequence[_Contact], shapes: Sequence[mi.Shape], groups: Sequence[mi.Shape]) -> None:
    """Refuse contacts that nothing covers."""
    for contact in contacts:
        start = contact.point + 2 * _tolerance(np.abs(contact.point).max()) * contact.normal
        ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(contact.normal))
        ray.maxt = 4 * _step(contact.point)
        if not scene_of_shapes(shapes, groups).ray_test(ray)[0]:
            raise _refusal(contact, "it is not defined which one is seen")


def _has_body(contact: _Contact, groups: Sequence[mi.Shape]) -> bool:
    """Return whether the shape of a contact has another face behind the one that coincides."""
    start = contact.point - 2 * _tolerance(np.abs(contact.point).max()) * contact.normal
    ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(-contact.normal))
    return bool(scene_of_shapes([contact.shape], groups).ray_test(ray)[0])


def _lies_within(contact: _Contact) -> bool:
    """Return whether the shape of a contact is smaller than the larger one and lies within its bounding box."""
    (low, high), (lowest, highest) = (
        (np.array(one.bbox().min, np.float64), np.array(one.bbox().max, np.float64))
        for one in (contact.shape, contact.larger)
    )
    margin = _tolerance(np.abs([lowest, highest]).max())
    smaller = np.linalg.norm(high - low) < _SMALLER * np.linalg.norm(highest - lowest)
    # Beside the face, a body reaches beyond it.
    across = np.abs(contact.normal) < 1 - _SMALLER
    return bool(smaller and (~across | ((low >= lowest - margin) & (high <= highest + margin))).all())


def _move(shape: mi.Shape, direction: FloatArray) -> None:
    """Move a shape off another one."""
    values = mi.traverse(shape)
    by = _step(np.array([shape.bbox().min, shape.bbox().max])) * direction
    if "to_world" in values:
        values["to_world"] = type(values["to_world"])().translate(by.tolist()) @ values["to_world"]
    elif "vertex_positions" in values:
        points = dr.unravel(mi.Point3f, values["vertex_positions"]) + mi.Vector3f(by.tolist())
        values["vertex_positions"] = dr.ravel(points)
    elif "control_points" in values:
        values["control_points"] += mi.Float(np.tile([*by, 0.0], dr.width(values["control_points"]) // 4))
    values.update()


def _step(coordinates: FloatArray) -> float:
    """Return the distance by which a shape of coordinates is moved [m]."""
    return float(_APART + 2 * _ROUNDING * np.abs(coordinates).max())


def _tolerance(coordinate: FloatArray | mi.Float) -> FloatArray | mi.Float:
    """Return the distance within which faces at a coordinate coincide [m]."""
    return _SAME + _ROUNDING * coordinate


def _refusal(contact: _Contact, reason: str) -> UserError:
    """Return the error of two shapes that coincide."""
    return UserError(
        f"shapes {contact.shape.id()!r} and {contact.larger.id()!r} coincide in a face at z = {contact.point[2]:.4g} m "
        f"and {reason}: move one of them by 1 mm or more"
    )
