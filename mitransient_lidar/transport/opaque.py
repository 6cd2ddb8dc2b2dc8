"""Scene constants kept opaque, so that kernels need not be recompiled for another shot or sea."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def opaque(value: float) -> mi.Float:
    """Return a number that kernels read from memory."""
    return dr.opaque(mi.Float, float(value))


def opaque_point(values: Sequence[float] | NDArray[np.float64]) -> mi.Point3f:
    """Return a point, of values of shape (3,), that kernels read from memory."""
    return mi.Point3f(*(opaque(value) for value in values))


def is_one_of(pointer: mi.ShapePtr, shapes: Sequence[mi.Shape]) -> mi.Bool:
    """Return whether a pointer refers to one of the shapes."""
    number = dr.reinterpret_array(mi.UInt32, pointer)
    found = mi.Bool(False)
    for shape in shapes:
        wanted = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
        found |= number == dr.opaque(mi.UInt32, int(wanted[0]))
    return found
