"""Integrals and crossings for functions that are linear between nodes, and the inside of polygons."""

from __future__ import annotations

from typing import Any

import numpy as np

from mitransient_lidar.core.validation import FloatArray, IntArray


def locate(nodes: FloatArray, t: FloatArray) -> tuple[IntArray, FloatArray]:
    """Segment of each t and distance from its start; values outside the nodes are clamped to the nearest end."""
    inside = np.clip(t, nodes[0], nodes[-1])
    i = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, nodes.size - 2)
    return i, inside - nodes[i]


def node_integrals(nodes: FloatArray, values: FloatArray) -> FloatArray:
    """Integral from the first node to every node."""
    pieces = np.diff(nodes) * (values[1:] + values[:-1]) / 2
    return np.concatenate(([0.0], np.cumsum(pieces)))


def integral(nodes: FloatArray, values: FloatArray, t: FloatArray) -> FloatArray:
    """Integral from the first node to each t; the function is 0 outside the nodes."""
    i, x = locate(nodes, t)
    slope = np.diff(values) / np.diff(nodes)
    return np.asarray(node_integrals(nodes, values)[i] + x * (values[i] + 0.5 * slope[i] * x))


def first_crossing(t: FloatArray, values: FloatArray, level: float) -> float:
    """First time at which linear interpolation of the samples reaches a level; `t[0]` if they start above it."""
    i = int(np.argmax(values >= level))
    if i == 0:
        return float(t[0])
    return float(t[i - 1] + (level - values[i - 1]) / (values[i] - values[i - 1]) * (t[i] - t[i - 1]))


def inside_polygon(corners: FloatArray, x: Any, y: Any) -> Any:
    """Return whether points, in arrays of any library, have an odd number of edges between them and x = infinity.

    Corners (x, y) have the shape (n, 2), at least three that are not on one line.
    """
    inside: Any = None
    # Python numbers: NumPy scalars would turn Dr.Jit arrays into NumPy ones.
    for (x0, y0), (x1, y1) in zip(corners.tolist(), np.roll(corners, -1, axis=0).tolist(), strict=True):
        if y0 != y1:
            beyond = ((y < y0) != (y < y1)) & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
            inside = beyond if inside is None else inside ^ beyond
    return inside
