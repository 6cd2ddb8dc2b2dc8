"""Bubbles in the water, crossed in closed form: a box behind a ship, or a layer below a windy sea."""

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
    """

    scattering: float  #: Scattering coefficient of the bubbles [1/m], 0 to 1000, added to the water's.
    #: Start of the plume, at the stern [m], -1e7 to 1e7.
    x: float
    y: float
    bearing: float  #: Heading of the ship [rad], counter-clockwise from +x; the plume lies behind.
    #: Plume extent [m].
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


_SMALL = 1e-2  #: Relative change of the density along a segment below which series replace quotients that cancel.

_LEVEL = 1e-9  #: Least vertical component of a direction, which stands for level ones.


@dataclass(frozen=True)
class BubbleLayer:
    """Bubbles everywhere, whose scattering falls with depth as exp(-z / depth); even above the mean sea level.

    They scatter and do not absorb, and have the interface of `BubblePlume`.
    """

    #: Scattering coefficient of the bubbles at the mean sea level [1/m], at most 1000, added to the water's.
    scattering: float
    depth: float  #: Depth at which it has fallen to 1/e [m], 0.05 to 20.

    def scattering_at(self, point: mi.Point3f) -> mi.Float:
        """Return the scattering coefficient of the bubbles at a point [1/m]."""
        return opaque(self.scattering) * dr.exp(dr.minimum(point.z, 0) / opaque(self.depth))

    #: Scattering coefficient at a bubble event [1/m].
    scattering_of_event = scattering_at

    def optical_depth(self, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float) -> mi.Float:
        """Return the optical depth that the bubbles add to a segment."""
        depth, downward = -point.z, self._inclined(-direction.z)
        rises = downward < 0
        # Downwards the crest comes first, upwards last.
        below = dr.clip(dr.select(rises, -depth / downward, length + depth / downward), 0, length)
        below = dr.select((depth >= 0) & ~rises, length, below)
        return opaque(self.scattering) * (length - below) + self._below(dr.maximum(depth, 0), downward, below)

    def distance(self, point: mi.Point3f, direction: mi.Vector3f, optical_depth: mi.Float) -> mi.Float:
        """Return the distance at which a ray has crossed an optical depth of bubbles [m], infinite if it never does."""
        density, depth, downward = opaque(self.scattering), -point.z, self._inclined(-direction.z)
        rises, start = downward < 0, dr.maximum(depth, 0)
        to_level = dr.maximum(-depth / downward, 0)
        in_crest = density * to_level
        level = dr.select(rises, self._below(start, downward, to_level), in_crest)
        through = self._below_distance(start, downward, dr.select(rises, optical_depth, optical_depth - in_crest))
        sinking = dr.select(optical_depth <= in_crest, optical_depth / density, to_level + through)
        rising = dr.select(optical_depth <= level, through, to_level + (optical_depth - level) / density)
        return dr.select(rises, rising, sinking)

    def _inclined(self, downward: mi.Float) -> mi.Float:
        """Return a direction's downward component, not 0."""
        return dr.select(dr.abs(downward) > _LEVEL, downward, _LEVEL)

    def _below(self, depth: mi.Float, downward: mi.Float, length: mi.Float) -> mi.Float:
        """Return the optical depth of a segment below the mean sea level."""
        density, scale = opaque(self.scattering), opaque(self.depth)
        start, change = dr.exp(-depth / scale), downward * length / scale
        series = start * length * (1 + change * (change / 6 - 0.5))
        quotient = scale / downward * (start - dr.exp(-(depth + downward * length) / scale))
        return density * dr.select(dr.abs(change) < _SMALL, series, quotient)

    def _below_distance(self, depth: mi.Float, downward: mi.Float, optical_depth: mi.Float) -> mi.Float:
        """Return the distance of an optical depth below the mean sea level [m], infinite if it is not reached."""
        density, scale = opaque(self.scattering), opaque(self.depth)
        start = dr.exp(-depth / scale)
        # Density left at the end, relative to the density at the mean sea level.
        end = start - optical_depth * downward / (density * scale)
        change = optical_depth * downward / (density * scale * start)
        series = optical_depth / (density * start) * (1 + change * (0.5 + change / 3))
        quotient = (-scale * dr.log(end) - depth) / downward
        return dr.select(end > 0, dr.select(dr.abs(change) < _SMALL, series, quotient), dr.inf)
