"""Shapes that coincide in a face: rounding would decide which of them a ray meets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import aligned_ray
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.solids import BEFORE, box_rays, scene_of_shapes

#: Distance within which faces coincide, and by which they are moved apart: absolute [m] and over coordinates.
_SAME, _APART, _ROUNDING = 2e-5, 1e-4, 2.0**-20

#: Least cosine between normals of faces that coincide, and least number of rays that find them.
_PARALLEL, _LEAST_RAYS = 0.9999, 3

_LEVEL = 1e-3  #: Largest vertical component of a direction that counts as level.
_TICKS, _PAIRS_AT_ONCE = 32, 256  #: Rays along each box side, and boxes whose rays are traced at once.
_SMALLER = 0.99  #: Largest size of a shape that lies on another one, relative to the other one.
_MOST_IN_A_STACK = 64  #: Largest number of shapes that lie on each other.


@dataclass(frozen=True)
class _Contact:
    """A shape and a larger one that coincide: a point on their faces [m], and both normals there, shape (3,).

    `has_body` states whether the shape has another face behind the one that coincides.
    """

    shape: mi.Shape
    larger: mi.Shape
    point: FloatArray
    normal: FloatArray
    normal_of_larger: FloatArray
    has_body: bool


class _Separation(NamedTuple):
    """A shape that is moved, in which unit direction, and whether off a face that looks the same way."""

    shape: mi.Shape
    direction: FloatArray
    flush: bool = False


#: A larger shape and one whose bounding box touches its own.
_Pair = tuple[mi.Shape, mi.Shape]


def separate_contacts(scene: WaterScene) -> list[mi.Shape]:
    """Move solids 0.1 mm off others with which they coincide in a face; return the moved ones.

    Off a bottom a solid is moved upwards. If the faces of two other solids look at each other, the upper solid is moved
    up, or the smaller one to the side. If they look the same way, the smaller solid is moved, if it lies within the
    larger one.

    Raises UserError if a solid coincides with the water surface, or if it is not defined which one of two solids is
    seen.
    """
    # Waves coincide with nothing.
    waves = [sea for sea in scene.seas if np.isfinite(sea.sea.cell_size)]
    shapes = [shape for shape in scene.mitsuba_scene.shapes() if not any(shape is sea for sea in waves)]
    pending, bottoms = _neighbours(shapes, scene.surfaces), scene.bottoms
    moved: dict[int, mi.Shape] = {}
    for _ in range(_MOST_IN_A_STACK):
        found = _contacts(pending, scene.groups)
        separations = [_separation(contact, scene.surfaces, bottoms) for contact in found]
        if not any(separations):
            _refuse_visible(found, shapes, scene.groups)
            return list(moved.values())
        # Once per round, so that shapes on both sides do not push a shape to and fro; off the shape that it faces
        # rather than off a shape that it is flush with.
        separations.sort(key=lambda one: one is not None and one.flush, reverse=True)
        for moving, direction, _ in {id(one.shape): one for one in separations if one is not None}.values():
            _move(moving, direction)
            moved[id(moving)] = moving
        touched = {id(one) for contact in found for one in (contact.shape, contact.larger)}
        pending = [pair for pair in pending if any(id(one) in touched for one in pair)]
    raise _refusal(found[0], f"they are two of more than {_MOST_IN_A_STACK} that lie on each other")


def _neighbours(shapes: Sequence[mi.Shape], surfaces: Sequence[mi.Shape]) -> list[_Pair]:
    """Return shape pairs whose bounding boxes touch, except pairs of water surfaces."""
    if len(shapes) < 2:
        return []
    low, high = _corners(shapes)
    margin = _tolerance(np.abs([low, high]).max(axis=(0, 2)))[:, None]
    is_surface = np.array([any(shape is surface for surface in surfaces) for shape in shapes])
    sizes = np.where(is_surface, np.inf, np.linalg.norm(high - low, axis=1))
    # By name where equal in size: Mitsuba returns shapes in any order.
    order, found = np.lexsort(([shape.id() for shape in shapes], -sizes)), []
    for rank, number in enumerate(order):
        others = order[rank + 1 :]
        touch = (low[others] <= high[number] + margin[others]) & (high[others] >= low[number] - margin[others])
        others = others[touch.all(axis=1) & ~(is_surface[number] & is_surface[others])]
        found += [(shapes[number], shapes[other]) for other in others]
    return found


def _contacts(pairs: Sequence[_Pair], groups: Sequence[mi.Shape]) -> list[_Contact]:
    """Return where paired shapes coincide, in pair order."""
    groups_of_pairs: dict[tuple[int, int], list[int]] = {}
    shapes = list({id(shape): shape for pair in pairs for shape in pair}.values())
    apart = _apart(shapes)
    group_of = {id(shape): number for number, group in enumerate(apart) for shape in group}
    for number, pair in enumerate(pairs):
        larger, other = (group_of[id(shape)] for shape in pair)
        groups_of_pairs.setdefault((larger, other), []).append(number)
    scenes = [scene_of_shapes(group, groups) for group in apart]
    found: dict[int, _Contact] = {}
    for (larger, other), numbers in groups_of_pairs.items():
        for start in range(0, len(numbers), _PAIRS_AT_ONCE):
            some = numbers[start : start + _PAIRS_AT_ONCE]
            contacts = _contacts_apart([pairs[number] for number in some], scenes[larger], scenes[other])
            found.update({some[number]: contact for number, contact in contacts.items()})
    return [found[number] for number in sorted(found)]


def _apart(shapes: Sequence[mi.Shape]) -> list[list[mi.Shape]]:
    """Return shapes in few groups: a ray through a shape's bounding box meets no other shape in its group there."""
    if not shapes:
        return []
    low, high = _corners(shapes)
    # Rays begin this far before a box.
    margin = (2 * BEFORE * (1 + np.abs([low, high]).max(axis=(0, 2))))[:, None]
    low, high, groups = low - margin, high + margin, np.zeros(len(shapes), np.int64)
    for number in range(1, len(shapes)):
        touch = ((low[:number] <= high[number]) & (high[:number] >= low[number])).all(axis=1)
        taken = np.zeros(number + 1, bool)
        taken[groups[:number][touch]] = True
        groups[number] = np.argmin(taken)
    found: list[list[mi.Shape]] = [[] for _ in range(groups.max() + 1)]
    for shape, group in zip(shapes, groups, strict=True):
        found[group].append(shape)
    return found


def _contacts_apart(pairs: Sequence[_Pair], largers: mi.Scene, others: mi.Scene) -> dict[int, _Contact]:
    """Return contacts by the numbers of their pairs, whose larger and whose other shapes are apart in scenes."""
    rays = [_rays(larger, other) for larger, other in pairs]
    owners = np.repeat(np.arange(len(pairs)), [len(origins) for origins, _, _ in rays])
    if len(owners) == 0:
        return {}
    origins, directions, ends = (np.concatenate(arrays) for arrays in zip(*rays, strict=True))
    si = others.ray_intersect(aligned_ray(origins, directions, ends))
    dr.eval(si)
    tolerance = _tolerance(dr.max(dr.abs(si.p)))
    back = mi.Ray3f(dr.fma(2 * tolerance, si.n, si.p), -si.n)
    back.maxt = 4 * tolerance
    on_larger = largers.ray_intersect(back, si.is_valid())
    same = si.is_valid() & on_larger.is_valid() & (dr.abs(on_larger.t - 2 * tolerance) < tolerance)
    same &= dr.abs(dr.dot(si.n, on_larger.n)) > _PARALLEL
    # One by one, each would trace the rays again.
    dr.eval(same, si.p, si.n, on_larger.n)
    met = np.flatnonzero(np.array(same))
    numbers, first, count = np.unique(owners[met], return_index=True, return_counts=True)
    numbers, first = numbers[count >= _LEAST_RAYS], met[first[count >= _LEAST_RAYS]]
    if len(numbers) == 0:
        return {}
    points, normals, of_larger = (np.array(values, np.float64).T[first] for values in (si.p, si.n, on_larger.n))
    bodies = _have_bodies([pairs[number][1] for number in numbers.tolist()], points, normals, others)
    rows = zip(numbers, points, normals, of_larger, bodies, strict=True)
    return {int(number): _Contact(*pairs[number][::-1], *row) for number, *row in rows}


def _rays(larger: mi.Shape, other: mi.Shape) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return origins, directions (n, 3) and lengths (n,) of rays through the box that two bounding boxes share."""
    box = mi.ScalarBoundingBox3f(other.bbox())
    box.clip(larger.bbox())
    low, high = np.array(box.min, np.float64), np.array(box.max, np.float64)
    origins, directions = box_rays(low, high, _TICKS)
    ends = np.where(directions > 0, high, low)
    lengths = np.abs((ends - origins) * directions).sum(axis=1)
    return origins, directions, lengths + BEFORE


def _have_bodies(
    shapes: Sequence[mi.Shape], points: FloatArray, normals: FloatArray, scene: mi.Scene
) -> NDArray[np.bool_]:
    """Return which shapes in a scene have another face behind their points (n, 3), within their boxes."""
    low, high = _corners(shapes)
    tolerance = _tolerance(np.abs(points).max(axis=1))
    starts = points - 2 * tolerance[:, None] * normals
    along = np.abs(normals) > _LEVEL
    ends = (np.where(normals < 0, high, low) - starts) / np.where(along, -normals, 1.0)
    # A flat shape ends before the ray begins.
    ends = np.maximum(np.where(along, ends, np.inf).min(axis=1) + tolerance, tolerance)
    return np.array(scene.ray_test(aligned_ray(starts, -normals, ends)))


def _separation(contact: _Contact, surfaces: Sequence[mi.Shape], bottoms: Sequence[mi.Shape]) -> _Separation | None:
    """Return how a contact is separated; None where it is not defined."""
    pair = contact.shape, contact.larger
    if any(one is surface for one in pair for surface in surfaces):
        raise _refusal(contact, "one of them is the surface of the water")
    is_bottom, on_bottom = (any(one is bottom for bottom in bottoms) for one in pair)
    if is_bottom != on_bottom:
        normal = contact.normal_of_larger if on_bottom else contact.normal
        return _Separation(pair[int(is_bottom)], np.copysign(1.0, normal[2]) * normal)
    if contact.normal @ contact.normal_of_larger < 0:
        # Bodies leave each other, single faces pass each other; a shape that goes up stays off everything below.
        direction = contact.normal_of_larger if contact.has_body else contact.normal
        return _Separation(pair[int(direction[2] < -_LEVEL)], np.copysign(1.0, direction[2] + _LEVEL) * direction)
    return _Separation(contact.shape, contact.normal_of_larger, flush=True) if _lies_within(contact) else None


def _refuse_visible(contacts: Sequence[_Contact], shapes: Sequence[mi.Shape], groups: Sequence[mi.Shape]) -> None:
    """Refuse contacts that nothing covers."""
    if not contacts:
        return
    points, normals = (np.array([getattr(one, name) for one in contacts]) for name in ("point", "normal"))
    starts = points + 2 * _tolerance(np.abs(points).max(axis=1))[:, None] * normals
    rays = aligned_ray(starts, normals, 4 * _step(points))
    covered = np.array(scene_of_shapes(shapes, groups).ray_test(rays))
    for number in np.flatnonzero(~covered):
        raise _refusal(contacts[int(number)], "it is not defined which one is seen")


def _lies_within(contact: _Contact) -> bool:
    """Return whether the shape of a contact is smaller than the larger one and lies within its bounding box."""
    (low, lowest), (high, highest) = _corners((contact.shape, contact.larger))
    margin = _tolerance(np.abs([lowest, highest]).max())
    smaller = np.linalg.norm(high - low) < _SMALLER * np.linalg.norm(highest - lowest)
    # Beside the face, a body reaches beyond it.
    across = np.abs(contact.normal) < 1 - _SMALLER
    return bool(smaller and (~across | ((low >= lowest - margin) & (high <= highest + margin))).all())


def _move(shape: mi.Shape, direction: FloatArray) -> None:
    """Move a shape off another one."""
    values = mi.traverse(shape)
    by = _step(np.ravel(_corners([shape]))) * direction
    if "to_world" in values:
        values["to_world"] = type(values["to_world"])().translate(by.tolist()) @ values["to_world"]
    elif "vertex_positions" in values:
        points = dr.unravel(mi.Point3f, values["vertex_positions"]) + mi.Vector3f(by.tolist())
        values["vertex_positions"] = dr.ravel(points)
    elif "control_points" in values:
        values["control_points"] += mi.Float(np.tile([*by, 0.0], dr.width(values["control_points"]) // 4))
    values.update()


def _corners(shapes: Sequence[mi.Shape]) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest corners of bounding boxes, shape (n, 3) [m]."""
    boxes = [shape.bbox() for shape in shapes]
    return np.array([box.min for box in boxes], np.float64), np.array([box.max for box in boxes], np.float64)


def _step(coordinates: FloatArray) -> FloatArray:
    """Return the distances by which shapes of coordinates (..., 3) are moved [m]."""
    return np.asarray(_APART + 2 * _ROUNDING * np.abs(coordinates).max(axis=-1))


def _tolerance(coordinate: FloatArray | mi.Float) -> FloatArray | mi.Float:
    """Return the distance within which faces at a coordinate coincide [m]."""
    return _SAME + _ROUNDING * coordinate


def _refusal(contact: _Contact, reason: str) -> UserError:
    """Return the error for two shapes that coincide."""
    return UserError(
        f"shapes {contact.shape.id()!r} and {contact.larger.id()!r} coincide in a face at z = {contact.point[2]:.4g} m "
        f"and {reason}: move one of them by 1 mm or more"
    )
