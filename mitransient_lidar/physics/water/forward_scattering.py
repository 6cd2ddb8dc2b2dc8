"""Sideways displacement of light by given numbers of forward scattering events."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable

#: Nodes in the inverse of a phase function's distribution.
_NODES = 8192

#: Scattering by more is loss: the light has left the beam [rad].
LARGEST_ANGLE = np.radians(80.0)

#: Displacement in place of displacements by larger angles [m].
_FAR = 1e6


def scattering_angles(phase: PowerLawTable, u: FloatArray) -> FloatArray:
    """Return scattering angles [rad] of a phase function for uniform numbers."""
    theta = np.concatenate([[0.0], np.geomspace(1e-6, np.pi, _NODES)])
    return np.asarray(np.interp(u, phase.cdf_s(np.sin(theta / 2) ** 2), theta))


def displacements(
    column: WaterColumn,
    phases: Sequence[PowerLawTable],
    depths: FloatArray,
    most: int,
    count: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return displacements at depths by 0, 1, ... forward scattering events on a vertical way, as complex numbers [m].

    Parameters
    ----------
    column, phases
        Water layers, and the phase function of each.
    depths
        Depths [m], shape (depths,), positive.
    most
        Largest number of events.
    count
        Number of samples.
    rng
        Random numbers.

    Returns
    -------
    ndarray
        Shape (depths, most + 1, count). Events are at random optical depths of scattering. Angles above 80 degrees move
        light out of any beam.
    """
    found = np.zeros((depths.size, most + 1, count), np.complex128)
    tops = np.append(column.layer_tops, np.inf)
    # The same random numbers at all depths.
    u, along, turn = rng.random((3, most, count))
    angles = {id(phase): scattering_angles(phase, u) for phase in phases}
    for number, depth in enumerate(depths):
        edges = np.append(tops[tops < depth], depth)
        b = column.scattering[: edges.size - 1]
        optical = np.append(0.0, np.cumsum(b * np.diff(edges)))
        place = optical[-1] * along
        layer = np.clip(np.searchsorted(optical, place, side="right") - 1, 0, b.size - 1)
        where = edges[layer] + (place - optical[layer]) / np.where(b > 0, b, 1.0)[layer]
        theta = np.empty(place.shape)
        for one in np.unique(layer):
            theta[layer == one] = angles[id(phases[one])][layer == one]
        moved = np.where(theta < LARGEST_ANGLE, np.tan(np.minimum(theta, LARGEST_ANGLE)) * (depth - where), _FAR)
        found[number, 1:] = np.cumsum(moved * np.exp(2j * np.pi * turn), axis=0)
    return found
