"""Cells of water about a laser under water: shells cut into rings and sectors about its axis."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.merging.cells import Cell
from mitransient_lidar.transport.opaque import changed, opaque, opaque_point
from mitransient_lidar.transport.rng import starts
from mitransient_lidar.transport.scene import LidarScene

#: Angular ring width, over the beam's standard deviation within two of them, and over the angle farther outside.
_RING_PER_SPREAD, _CORE_SPREADS = 0.1, 2.0

#: Largest thickness of a shell over its radius: the light decreases by its square.
_THICKNESS_PER_RADIUS = 0.04

#: Smallest shell radius [m].
_SMALLEST_RADIUS = 1e-3

#: Base-2 logarithm of the number of buckets, and bits for the numbers of ring and sector.
_BUCKET_BITS, _RING_BITS, _SECTOR_BITS = 20, 11, 9


class SphericalCells:
    """Cells about the laser, small where its light is concentrated, for a scene or for one pass.

    Angles from the axis are measured by the tangent of their half, up to the opposite direction. Rings are of equal
    width in asinh(tan(theta / 2) / core), and shells in log(r) up to the radius where they have their final thickness.

    `scene`: scene with laser and receiver under water. `thickness`: largest shell thickness [m].
    """

    OF_SHOTS = ("_shift", "_start")

    #: Base-2 logarithm of the number of buckets per shot.
    bits = _BUCKET_BITS

    def __init__(self, scene: LidarScene, thickness: float) -> None:
        self._shift, self._start = mi.Point4f(0), mi.UInt32(0)
        pose, spread = scene.transmitter.pose, float(scene.transmitter.angular_spread)
        self.origin = opaque_point(pose.origin)
        self.sides = [mi.Vector3f(opaque_point(side)) for side in (pose.far, pose.left, pose.axis)]
        core = min(np.tan(0.5 * _CORE_SPREADS * spread), 1.0)
        self.core, self.ring = opaque(core), opaque(min(0.5 * _RING_PER_SPREAD * spread / core, 0.1))
        self.thickness = opaque(thickness)
        self.even = opaque(thickness / _THICKNESS_PER_RADIUS)

    def of_pass(self, shift: mi.Point4f) -> SphericalCells:
        """Return the cells in a pass, shifted by the first three of four uniform random numbers per shot."""
        return changed(self, _shift=shift, _start=starts(dr.width(shift), 1 << _BUCKET_BITS))

    def typical_volume(self, point: mi.Point3f) -> mi.Float:
        """Return the cell volume [m^3] for the weights of merges, which are rare in small cells."""
        return self.locate(point).volume

    def locate(
        self, point: mi.Point3f, direction: mi.Vector3f | None = None, unscattered: mi.Bool | None = None
    ) -> Cell:
        """Return the cells that contain points; they do not depend on the directions of their lines."""
        offset = point - self.origin
        radius = dr.maximum(dr.norm(offset), _SMALLEST_RADIUS)
        x, y, along = (dr.dot(offset, side) for side in self.sides)
        across = dr.sqrt(x * x + y * y)
        tangent = across / dr.maximum(radius + along, 1e-6 * radius)
        # Rings: the innermost one is a disc.
        ring = dr.floor(dr.asinh(tangent / self.core) / self.ring + self._shift.x)
        inner, outer = (self.core * dr.sinh(dr.maximum(ring + k - self._shift.x, 0) * self.ring) for k in (0, 1))
        sectors = dr.round(np.pi * (outer + inner) / (outer - inner))
        turn = dr.atan2(y, x) * dr.inv_two_pi + 1 + self._shift.y
        sector = dr.minimum(dr.floor((turn - dr.floor(turn)) * sectors), sectors - 1)
        solid_angle = 4 * np.pi * (outer * outer - inner * inner)
        solid_angle /= (1 + inner * inner) * (1 + outer * outer) * sectors
        # Shells.
        shell = dr.floor(self._shell_at(radius) + self._shift.z)
        low, high = (self._radius_of(shell + k - self._shift.z) for k in (0, 1))
        volume = solid_angle * (high - low) * (high * high + high * low + low * low) / 3
        tag = mi.UInt32(mi.Int32(shell) + (1 << 10)) << (_RING_BITS + _SECTOR_BITS)
        tag |= (mi.UInt32(ring) << _SECTOR_BITS) | mi.UInt32(sector)
        # Fibonacci hashing (Knuth 1998, The Art of Computer Programming 3, section 6.4).
        return Cell(self._start + ((tag * 2654435769) >> (32 - _BUCKET_BITS)), tag, volume, volume)

    def _shell_at(self, radius: mi.Float) -> mi.Float:
        """Return the shell coordinate at a radius [m]."""
        ratio = radius / self.even
        return dr.select(ratio < 1, dr.log(ratio), ratio - 1) / _THICKNESS_PER_RADIUS

    def _radius_of(self, shell: mi.Float) -> mi.Float:
        """Return the radius [m] at a shell coordinate."""
        along = shell * _THICKNESS_PER_RADIUS
        return self.even * dr.select(along < 0, dr.exp(along), 1 + along)
