"""Sectors of rings about the beam: cells that are small where the light is narrow and large where it is spread."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.transport.opaque import aligned, opaque
from mitransient_lidar.transport.rng import Lanes
from mitransient_lidar.transport.snell import refract

#: Growth of the core radius with depth [m/m], as light spreads by ripples and scattering.
_CORE_PER_METRE = 0.05

#: Least cosine of the axis with the vertical, for axes close to the horizon and above it.
_SMALLEST_COSINE = 0.01

#: Largest slope of the axis against the vertical along which patches are projected.
_LARGEST_SLANT = 2.0

#: Core radius at the surface over the beam's standard deviation there.
CORE_PER_SPREAD = 2.0


@dataclass(frozen=True)
class RingSector:
    """Sector of a ring.

    Attributes
    ----------
    ring, number
        Number of the ring, counted outwards, and of the sector in it.
    inner, outer
        Radii of the ring [m].
    share
        Inverse of the number of sectors of the ring.
    """

    ring: mi.UInt32
    number: mi.UInt32
    inner: mi.Float
    outer: mi.Float
    share: mi.Float


class BeamRings:
    """Rings about the refracted axis of the beam, cut into sectors that are about as long as wide.

    With the core radius q, rings have equal widths in arsinh(r / q): nearly equal ones in the core, and widths
    proportional to the radius r far from it. On a sea that is lit obliquely rings are ellipses, as footprints are.

    Parameters
    ----------
    pose
        Pose of the laser.
    spread
        Standard deviation of the beam where its axis meets the sea, across the axis [m].
    index
        Refractive index of the water over that at the laser.
    growth
        Growth of the core radius with depth [m/m].

    The axis begins where it meets the mean sea level, or where each shot's beam meets the sea (`of_entries`).
    """

    def __init__(self, pose: Pose, spread: float, index: float, growth: float = _CORE_PER_METRE) -> None:
        self.spread, self._growth, self._index = opaque(spread), opaque(growth), index
        self._entry = mi.Vector3f(opaque(0.0))
        horizontal, down = pose.axis[:2], max(-float(pose.axis[2]), _SMALLEST_COSINE)
        spot = pose.origin[:2] + horizontal * (float(pose.origin[2]) / down)
        sine = float(np.hypot(*horizontal))
        azimuth = horizontal / sine if sine > 0 else pose.far[:2]
        self._spot = [opaque(x) for x in spot]
        self._azimuth = [opaque(x) for x in azimuth]
        cosine = max(math.sqrt(max(1 - (sine / index) ** 2, 0.0)), _SMALLEST_COSINE)
        #: Horizontal displacement of the axis for each metre of depth.
        self.shear = [opaque(x / (index * cosine)) for x in horizontal]
        #: The same where patches are projected along the axis, else 0: axes close to the horizon, or above it.
        self.slant = self.shear if np.hypot(*horizontal) < _LARGEST_SLANT * index * cosine else [opaque(0.0)] * 2
        #: Ratio of the axes of the ellipses.
        self.cosine = opaque(down)

    def of_entries(self, entries: FloatArray, axes: FloatArray | None = None) -> BeamRings:
        """Return rings about axes that begin elsewhere: displacements of each shot [m], shape (shots, 3).

        Shots whose beams have directions of their own in air, `axes` of the same shape, have axes of their own.
        """
        rings = copy.copy(self)
        rings._entry = mi.Vector3f(*_columns(entries))
        if axes is not None:
            sine = np.hypot(axes[:, 0], axes[:, 1])
            cosine = np.maximum(np.sqrt(np.maximum(1 - (sine / self._index) ** 2, 0)), _SMALLEST_COSINE)
            shear = axes[:, :2] / (self._index * cosine)[:, None]
            is_steep = sine < _LARGEST_SLANT * self._index * cosine
            rings.shear, rings.slant = _columns(shear), _columns(np.where(is_steep[:, None], shear, 0.0))
        return rings

    def repeated(self, copies: int) -> BeamRings:
        """Return the rings of each shot several times in turn."""
        rings = copy.copy(self)
        rings._entry = dr.repeat(self._entry, copies)
        if any(dr.width(each) > 1 for each in self.shear):
            sides = self.shear, self.slant
            rings.shear, rings.slant = ([dr.repeat(each, copies) for each in pair] for pair in sides)
        dr.eval(rings._entry, rings.shear, rings.slant)
        return rings

    def of(self, lanes: Lanes) -> BeamRings:
        """Return the rings of each lane's shot."""
        if lanes.shots == 1:
            return self
        rings = copy.copy(self)
        rings._entry = lanes.pick(self._entry)
        if any(dr.width(each) > 1 for each in self.shear):
            rings.shear, rings.slant = ([lanes.pick(each) for each in sides] for sides in (self.shear, self.slant))
        return rings

    def depth_at(self, z: mi.Float) -> mi.Float:
        """Return the depth of a height [m] below the beginning of the axis [m]."""
        return self._entry.z - z

    def core(self, depth: mi.Float) -> mi.Float:
        """Return the core radius at a depth [m]."""
        return CORE_PER_SPREAD * self.spread + self._growth * depth

    def offset(self, x: mi.Float, y: mi.Float, depth: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return offsets from the axis, scaled along it so that the ellipses are circles [m]."""
        dx = x - self._spot[0] - self._entry.x - self.shear[0] * depth
        dy = y - self._spot[1] - self._entry.y - self.shear[1] * depth
        along, across = self.along_and_across(mi.Vector2f(dx, dy))
        return along * self.cosine, across

    def refracted(self, slope: mi.Vector2f) -> mi.Vector3f:
        """Return the unit direction of the axis below facets of a slope."""
        level = dr.normalize(mi.Vector3f(self.shear[0], self.shear[1], -1))
        index = opaque(self._index)
        x, y = index * level.x, index * level.y
        to_laser = mi.Vector3f(-x, -y, dr.safe_sqrt(1 - x * x - y * y))
        normal = mi.Normal3f(dr.normalize(mi.Vector3f(-slope.x, -slope.y, 1)))
        return -refract(to_laser, normal, dr.rcp(index))

    def along_and_across(self, horizontal: mi.Vector2f) -> tuple[mi.Float, mi.Float]:
        """Return the components of horizontal vectors along and across the azimuth of the axis."""
        (x, y), (ax, ay) = horizontal, self._azimuth
        return ax * x + ay * y, ax * y - ay * x

    def point(self, along: mi.Float, across: mi.Float, depth: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Invert `offset`."""
        ax, ay = self._azimuth
        along = along / self.cosine
        x = self._spot[0] + self._entry.x + self.shear[0] * depth + ax * along - ay * across
        return x, self._spot[1] + self._entry.y + self.shear[1] * depth + ay * along + ax * across

    def sector(
        self, along: mi.Float, across: mi.Float, core: mi.Float, width: mi.Float, shift: mi.Point2f
    ) -> RingSector:
        """Return the sectors at offsets, of rings of a `width` over the core radius, shifted by random numbers."""
        radius = dr.sqrt(along * along + across * across)
        ring = dr.floor(dr.asinh(radius / core) / width + shift.x)
        inner = core * dr.sinh(width * dr.maximum(ring - shift.x, 0))
        outer = core * dr.sinh(width * (ring + 1 - shift.x))
        count = dr.maximum(dr.round(dr.pi * (outer + inner) / (outer - inner)), 1)
        turn = dr.atan2(across, along) * dr.inv_two_pi + shift.y
        number = dr.minimum(dr.floor((turn - dr.floor(turn)) * count), count - 1)
        return RingSector(mi.UInt32(ring), mi.UInt32(number), inner, outer, dr.rcp(count))

    def area(self, sector: RingSector) -> mi.Float:
        """Return the areas of sectors on the level sea [m^2]."""
        return dr.pi * (sector.outer - sector.inner) * (sector.outer + sector.inner) * sector.share / self.cosine

    def draw(self, sector: RingSector, shift: mi.Point2f, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Map uniform numbers to offsets, uniform in sectors."""
        radius = dr.sqrt(dr.lerp(dr.square(sector.inner), dr.square(sector.outer), u))
        sin, cos = dr.sincos(dr.two_pi * ((mi.Float(sector.number) + v) * sector.share - shift.y))
        return radius * cos, radius * sin


def _columns(values: FloatArray) -> list[mi.Float]:
    """Return the columns of values of shots, shape (shots, n)."""
    return [aligned(mi.Float, column.astype(np.float32)) for column in values.T]
