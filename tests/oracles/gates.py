"""Transmission of gates, whose integral the package has in closed form."""

import numpy as np

#: Full length of a raised-cosine edge over its 10-90 % time: sin^2 passes 0.1 and 0.9 at 0.2048 and 0.7952 of it.
EDGE_PER_RISE = np.pi / (np.pi - 2 * np.arccos(0.8))


def transmission(shape, t_ns):
    """Return the transmission of a `GateShape`, 0 to 1, at times [ns] after the half height of the rising edge."""
    t = np.asarray(t_ns, dtype=np.float64)
    if shape.times_ns.size:
        return np.interp(t, shape.times_ns, shape.values, left=0.0, right=0.0)
    return _edge(t, shape.rise_ns) - _edge(t - shape.width_ns, shape.fall_ns)


def _edge(t, rise):
    if rise == 0:
        return np.where(t >= 0, 1.0, 0.0)
    return np.sin(0.5 * np.pi * np.clip(t / (EDGE_PER_RISE * rise) + 0.5, 0, 1)) ** 2
