"""Sectors of rings about the beam: cells that are small where the light is narrow and large where it is spread."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import refract as refract_at_facet
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.transport.medium.water import refract
from mitransient_lidar.transport.opaque import aligned, changed, opaque

_CORE_PER_METRE = 0.05  #: Growth of the core radius with depth [m/m], as light spreads by ripples and scattering.
_SMALLEST_COSINE = 0.01  #: Least cosine of the axis with the vertical, for axes close to the horizon and above it.

_LARGEST_SLANT = 2.0  #: Largest slope of the axis against the vertical along which patches are projected.
CORE_PER_SPREAD = 2.0  #: Core radius at the surface over the beam's standard deviation there.

#: Least and largest width of cells on the axis, over the core radius: rings have different 32-bit numbers, and are not
#: wider than the beam.
_WIDTHS = 1e-6, 1.0

#: Largest width of automatic cells at the surface, in attenuation lengths, as level light in wider ones is wrong, and
#: largest core radius: cells that narrow find no light in wider beams.
_LONGEST, _WIDEST_BEAM = 0.3, 500.0


def cell_widths(given: float, spread: float, attenuation: float) -> tuple[float, float]:
    """Return the nearest possible cell width for rings about a beam, and the largest width in water.

    Raises UserError if the beam is too wide for automatic cells.

    `given`: width on the axis at the surface [m]; 0 for an automatic one, which then is 0. `spread`: beam standard
    deviation there [m]. `attenuation`: beam attenuation of the water [1/m].
    """
    core = CORE_PER_SPREAD * spread
    if given:
        width = min(max(given, _WIDTHS[0] * core), _WIDTHS[1] * core)
        return width, width
    if core * attenuation > _WIDEST_BEAM:
        raise UserError(
            f"lidar_merging: the beam is {2 * core:.3g} m wide on the sea, more than {2 * _WIDEST_BEAM:g} attenuation "
            "lengths of the water: use lidar_volpath"
        )
    return 0.0, _LONGEST / attenuation if attenuation > 0 else math.inf


@dataclass(frozen=True)
class RingSector:
    """Sector of a ring."""

    #: Ring number, counted outwards, and number of the sector in it.
    ring: mi.UInt32
    number: mi.UInt32
    #: Ring radii [m].
    inner: mi.Float
    outer: mi.Float
    share: mi.Float  #: Inverse of the number of sectors in the ring.


class BeamRings:
    """Rings about the refracted axis of the beam, cut into sectors that are about as long as wide.

    With the core radius q, rings have equal widths in arsinh(r / q). The widths are nearly equal in the core, and
    proportional to the radius r far from it. On an obliquely lit sea rings are ellipses, as footprints are.

    `pose`: laser pose. `spread`: beam standard deviation where its axis meets the sea, across the axis [m]. `index`:
    refractive index of the water over that at the laser. `growth`: growth of the core radius with depth [m/m]. `tilt`:
    mean slopes of the sea along x and y, which refracts the axis [1], shape (1, 2); by default it is level.

    The axis begins where it meets the mean sea level, or where each shot's beam meets the sea (`of_entries`).
    """

    OF_SHOTS = ("_entry", "shear", "slant", "_level", "tilt")

    def __init__(
        self, pose: Pose, spread: float, index: float, growth: float = _CORE_PER_METRE, tilt: FloatArray | None = None
    ) -> None:
        self.spread, self._growth, self._index = opaque(spread), opaque(growth), index
        self._entry = mi.Vector3f(opaque(0.0))
        #: -1 for an axis that rises in the water, else 1.
        self._sense = -1.0 if pose.submerged and pose.axis[2] > 0 else 1.0
        #: Ratio of the ellipses' axes.
        self.cosine = opaque(max(-self._sense * float(pose.axis[2]), _SMALLEST_COSINE))
        self._aim(pose, np.zeros((1, 2)) if tilt is None else tilt)

    def _aim(self, pose: Pose, tilt: FloatArray) -> None:
        """Lay the axis through a pose's axis."""
        horizontal, down = pose.axis[:2], max(-self._sense * float(pose.axis[2]), _SMALLEST_COSINE)
        spot = pose.origin[:2] + horizontal * (self._sense * float(pose.origin[2]) / down)
        sine = float(np.hypot(*horizontal))
        azimuth = horizontal / sine if sine > 0 else pose.far[:2]
        self._spot = [opaque(x) for x in spot]
        self._azimuth = [opaque(x) for x in azimuth]
        self._set_axes(pose.axis[np.newaxis], tilt)

    def alike(self, pose: Pose, entries: FloatArray, tilt: FloatArray) -> BeamRings:
        """Return the same rings about another pose's axis, below a sea with other mean slopes."""
        rings = changed(self)
        rings._aim(pose, tilt)
        return rings.of_entries(entries)

    def of_entries(
        self, entries: FloatArray, axes: FloatArray | None = None, tilts: FloatArray | None = None
    ) -> BeamRings:
        """Return rings about axes that begin elsewhere: displacements of each shot [m], shape (shots, 3).

        Shots whose beams have their own directions in air, `axes` in the same shape, have their own axes. Their seas
        have mean slopes `tilts`, shape (shots, 2).
        """
        rings = changed(self, _entry=mi.Vector3f(*_columns(entries)))
        if axes is not None and tilts is not None:
            rings._set_axes(axes, tilts)
        return rings

    def _set_axes(self, axes: FloatArray, tilts: FloatArray) -> None:
        """Refract axes, unit directions in air for one or more shots, shape (shots, 3), by seas with mean slopes."""
        index, horizontal = self._index, axes[:, :2]
        sine = np.hypot(*horizontal.T)
        cosine = np.maximum(np.sqrt(np.maximum(1 - (sine / index) ** 2, 0)), _SMALLEST_COSINE)
        level = shear = self._sense * horizontal / (index * cosine)[:, None]
        if tilts.any():
            refracted = refract_at_facet(axes, np.column_stack([-tilts, np.ones(len(tilts))]), index)
            shear = refracted[:, :2] / np.maximum(-refracted[:, 2:], _SMALLEST_COSINE)
        is_steep = sine < _LARGEST_SLANT * index * cosine
        #: Horizontal axis displacement per metre of depth.
        self.shear = _columns(shear)
        #: The same where patches are projected along the axis, else 0: axes close to the horizon, or above it.
        self.slant = _columns(np.where(is_steep[:, None], shear, 0.0))
        #: Horizontal axis displacement below level facets per metre of depth.
        self._level = _columns(level)
        #: Mean sea slopes along x and y.
        self.tilt = _columns(tilts)

    def depth_at(self, z: mi.Float) -> mi.Float:
        """Return a height's depth [m] below the axis's beginning [m]."""
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
        """Return the unit direction of the axis below facets with a slope."""
        level = dr.normalize(mi.Vector3f(self._level[0], self._level[1], -1))
        index = opaque(self._index)
        x, y = index * level.x, index * level.y
        to_laser = mi.Vector3f(-x, -y, dr.safe_sqrt(1 - x * x - y * y))
        normal = mi.Normal3f(dr.normalize(mi.Vector3f(-slope.x, -slope.y, 1)))
        return -refract(to_laser, normal, dr.rcp(index))

    def along_and_across(self, horizontal: mi.Vector2f) -> tuple[mi.Float, mi.Float]:
        """Return the components of horizontal vectors along and across the axis azimuth."""
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
        """Return the sectors at offsets, in rings with a `width` over the core radius, shifted by random numbers."""
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
    """Return the columns of shot values, shape (shots, n)."""
    if len(values) == 1:
        return [opaque(float(value)) for value in values[0]]
    return [aligned(mi.Float, column.astype(np.float32)) for column in values.T]
