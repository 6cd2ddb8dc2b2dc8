"""Integrals and crossings of functions that are linear between nodes."""

from __future__ import annotations

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
