"""Numbers for kernels of tests: neither their values nor their place in memory make Dr.Jit compile another kernel."""

import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import aligned


def array(values):
    """Return numbers, one or an array, as a flat array that kernels read from memory."""
    return aligned(mi.Float, np.atleast_1d(values).astype(np.float32))


def vector(components):
    """Return a vector of three components, each a number or an array."""
    return mi.Vector3f(*(array(one) for one in components))
