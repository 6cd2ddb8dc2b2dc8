"""Directions about a centre that are equally many in each octave of distance from it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import opaque


class Octaves:
    """Sampling of the tangent plane about a centre: even in a core, beyond it as much in each octave of distance.

    The density is 1 / (pi ln(1 + R^2 / q^2) (r^2 + q^2)) at the distance r, with the core q, up to the edge R.

    Parameters
    ----------
    centre
        (angle_x, angle_y) of the centre [rad], shape (2,).
    core, edge
        Radii of the core and of all samples [rad], positive.
    """

    def __init__(self, centre: FloatArray, core: float, edge: float) -> None:
        self._centre = [opaque(angle) for angle in centre]
        self._core, self._edge, self._log_range = opaque(core), opaque(edge), opaque(np.log1p((edge / core) ** 2))

    def around(self, radius: mi.Float, turn: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return points at distances from the centre [rad] and azimuths [turns]."""
        sin, cos = dr.sincos(dr.two_pi * turn)
        return dr.fma(radius, cos, self._centre[0]), dr.fma(radius, sin, self._centre[1])

    def sample(self, u: mi.Point2f) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to points."""
        return self.around(self._core * dr.sqrt(dr.maximum(dr.exp(u.x * self._log_range) - 1, 0)), u.y)

    def density(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Float:
        """Return the density in `sample` [1/rad^2]."""
        radius2 = dr.square(angle_x - self._centre[0]) + dr.square(angle_y - self._centre[1])
        density = dr.inv_pi / (self._log_range * (radius2 + self._core * self._core))
        return dr.select(radius2 <= self._edge * self._edge, density, 0)

    def in_core(self, angle_x: mi.Float, angle_y: mi.Float) -> mi.Bool:
        """Return whether points lie in the core."""
        radius2 = dr.square(angle_x - self._centre[0]) + dr.square(angle_y - self._centre[1])
        return radius2 <= self._core * self._core
