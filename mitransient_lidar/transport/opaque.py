"""Scene constants kept opaque, so that kernels need not be recompiled for another shot, sea or water."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

#: Type of a Dr.Jit array, or of an object that kernels read.
ArrayT = TypeVar("ArrayT")


def opaque(value: float) -> mi.Float:
    """Return a number that kernels read from memory."""
    return dr.opaque(mi.Float, float(value))


def opaque_index(value: int) -> mi.UInt32:
    """Return a number at least 0 that kernels read from memory."""
    return dr.opaque(mi.UInt32, value)


def opaque_vector(values: Sequence[float] | NDArray[np.float64]) -> mi.Vector3f:
    """Return a vector, from values with shape (3,), that kernels read from memory."""
    return mi.Vector3f(*(opaque(value) for value in values))


def opaque_point(values: Sequence[float] | NDArray[np.float64]) -> mi.Point3f:
    """Return a point, from values with shape (3,), that kernels read from memory."""
    return mi.Point3f(*(opaque(value) for value in values))


def aligned_ray(origins: NDArray[np.float64], directions: NDArray[np.float64], ends: NDArray[np.float64]) -> mi.Ray3f:
    """Return rays from origins (n, 3) [m] in directions (n, 3) up to lengths (n,) [m].

    Their coordinates are separate arrays: parts of one array would make its size a part of kernels.
    """
    origin, direction = ([aligned(mi.Float, one) for one in values.T] for values in (origins, directions))
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
    ray.maxt = aligned(mi.Float, ends)
    return ray


def shape_number(shape: mi.Shape) -> int:
    """Return a shape's number, above 0, as kernels use it."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def is_one_of(pointer: mi.ShapePtr, shapes: Sequence[mi.Shape]) -> mi.Bool:
    """Return whether a pointer refers to one of the shapes."""
    number = dr.reinterpret_array(mi.UInt32, pointer)
    found = mi.Bool(False)
    for shape in shapes:
        found |= number == opaque_index(shape_number(shape))
    return found


def changed(given: ArrayT, **values: Any) -> ArrayT:
    """Return a copy of an object with other values for some attributes."""
    found = copy.copy(given)
    vars(found).update(values)
    return found


def aligned(array_type: Callable[[Any], ArrayT], values: NDArray[np.generic]) -> ArrayT:
    """Return values as a flat Dr.Jit array that starts at a multiple of 64 bytes.

    Dr.Jit leaves arrays of NumPy where they are, and compiles another kernel for an array that is not aligned.
    """
    dtype = np.array(array_type(0)).dtype
    buffer = np.empty(values.size * dtype.itemsize + 64, np.uint8)
    start = -buffer.ctypes.data % 64
    copy = buffer[start : start + values.size * dtype.itemsize].view(dtype)
    copy[:] = values.ravel()
    return array_type(copy)
