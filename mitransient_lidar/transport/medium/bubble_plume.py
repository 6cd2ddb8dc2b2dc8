"""A region of bubbles in the water: a box behind a ship, crossed in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.transport.opaque import opaque, opaque_point


@dataclass(frozen=True)
class BubblePlume:
    """Bubbles of even density behind a ship, from the surface down.

    They scatter and do not absorb. A flight ends at the first event by bubbles or water layers, which is exact for
    their sum.

    Parameters
    ----------
    scattering
        Scattering coefficient of the bubbles [1/m], 0 to 1000, added to the water's.
    x, y
        Start of the plume, at the stern [m], -1e7 to 1e7.
    bearing
        Heading of the ship [rad], counter-clockwise from +x; the plume lies behind.
    length, width, depth
        Plume extent [m].
    """

    scattering: float
    x: float
    y: float
    bearing: float
    length: float
    width: float
    depth: float

    def displaced(self, place: FloatArray, aim: FloatArray, turn: complex) -> BubblePlume:
        """Return the plume in a frame that is turned by `turn`, of modulus 1, and has a place (x, y) at `aim` [m]."""
        stern = (complex(self.x, self.y) - complex(*place)) / turn + complex(*aim)
        return replace(self, x=stern.real, y=stern.imag, bearing=float(self.bearing - np.angle(turn)))

    def _from_stern(self, point: mi.Point3f) -> tuple[mi.Float, mi.Float]:
        """Return the distances of a point from the stern, astern and across [m]."""
        return self._frame(point - opaque_point((self.x, self.y, 0.0)))

    def _frame(self, vector: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Return a vector's components astern and across."""
        cos, sin = opaque(np.cos(self.bearing)), opaque(np.sin(self.bearing))
        return -(cos * vector.x + sin * vector.y), cos * vector.y - sin * vector.x

    def holds(self, point: mi.Point3f) -> mi.Bool:
        """Return whether a point is in the plume."""
        astern, across = self._from_stern(point)
        length, half_width, bottom = map(opaque, (self.length, self.width / 2, -self.depth))
        return (astern >= 0) & (astern <= length) & (dr.abs(across) <= half_width) & (point.z >= bottom)

    def scattering_at(self, point: mi.Point3f) -> mi.Float:
        """Return the scattering coefficient of the bubbles at a point [1/m]."""
        return dr.select(self.holds(point), opaque(self.scattering), 0)

    def scattering_of_event(self, point: mi.Point3f) -> mi.Float:
        """Return the scattering coefficient at a bubble event [1/m], which may be on the edge."""
        return opaque(self.scattering)

    def crossing(self, point: mi.Point3f, direction: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
        """Return the distances at which a ray enters and leaves the plume [m], in reverse order where it misses."""
        near, far = mi.Float(0), mi.Float(dr.inf)
        astern, across = self._from_stern(point)
        along_astern, along_across = self._frame(direction)
        slabs = (
            (astern, along_astern, 0.0, opaque(self.length)),
            (across, along_across, opaque(-self.width / 2), opaque(self.width / 2)),
            # The plume reaches up into the wave crests.
            (point.z, direction.z, opaque(-self.depth), 1e4),
        )
        for place, speed, low, high in slabs:
            # A ray parallel to a slab's faces is inside everywhere or nowhere.
            safe = dr.select(dr.abs(speed) > 1e-9, speed, 1e-9)
            first, second = (low - place) / safe, (high - place) / safe
            near, far = dr.maximum(near, dr.minimum(first, second)), dr.minimum(far, dr.maximum(first, second))
        return near, far

    def optical_depth(self, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float) -> mi.Float:
        """Return the optical depth that the bubbles add to a segment."""
        near, far = self.crossing(point, direction)
        return opaque(self.scattering) * dr.maximum(dr.minimum(far, length) - near, 0)

    def distance(self, point: mi.Point3f, direction: mi.Vector3f, optical_depth: mi.Float) -> mi.Float:
        """Return the distance at which a ray has crossed an optical depth of bubbles [m], infinite if it never does."""
        near, far = self.crossing(point, direction)
        end = near + optical_depth / opaque(self.scattering)
        return dr.select(end < far, end, dr.inf)
