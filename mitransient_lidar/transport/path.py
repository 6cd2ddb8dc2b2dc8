"""State of a path and the one function that advances it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.system import LidarScene


@dataclass
class Path:
    """Where a path has got to.

    Attributes
    ----------
    point, direction
        Last vertex [m] (offset from surfaces against self-intersection) and unit direction of the next leg.
    in_water
        Whether the next leg runs in water.
    length
        Optical length so far [m]: distance times group index, summed over the legs.
    throughput
        Product of the path's factors since the receiver.
    scatterings
        Number of scattering events in the water so far.
    turns
        How often the path has changed between going down and going up.
    stratum
        Stratum of the water in which the next leg runs, if it runs in water.
    rays
        Number of rays traced so far, for the bench.
    active
        Whether the path goes on.
    """

    point: mi.Point3f
    direction: mi.Vector3f
    in_water: mi.Bool
    length: mi.Float
    throughput: mi.Float
    scatterings: mi.UInt32
    turns: mi.UInt32
    stratum: mi.UInt32
    rays: mi.UInt32
    active: mi.Bool

    @property
    def depth(self) -> mi.Float:
        """Depth below the mean sea level [m]."""
        return -self.point.z

    @property
    def downward(self) -> mi.Float:
        """Vertical component of the direction, positive downwards."""
        return -self.direction.z

    def ray(self) -> mi.Ray3f:
        """Return the next leg as a ray."""
        return mi.Ray3f(self.point, self.direction)


def optical_length(
    system: LidarScene, distance: mi.Float, in_water: mi.Bool | bool, stratum: mi.UInt32 | None = None
) -> mi.Float:
    """Return the optical length [m] of a leg: its distance times the group index of the medium that it crosses.

    In water that is the index of a stratum, by default of the first.
    """
    group = system.group_index if stratum is None or system.strata is None else system.strata.group(stratum)
    return distance * dr.select(mi.Bool(in_water), mi.Float(group), 1)


def count_turns(path: Path, before: mi.Float) -> None:
    """Count a turn where the vertical component of the direction, `before` the last vertex, has changed its sign."""
    path.turns += dr.select(path.active & (before * path.direction.z < 0), mi.UInt32(1), 0)


def advance(path: Path, system: LidarScene, distance: mi.Float, point: mi.Point3f) -> None:
    """Move a path along its direction to its next vertex.

    Parameters
    ----------
    path
        The path; its vertex and its optical length change.
    system
        The lidar scene, whose water times the leg.
    distance
        Length of the leg [m].
    point
        The vertex at its end [m]. On surfaces the intersection is more accurate than distance times direction.
    """
    leg = optical_length(system, distance, path.in_water, path.stratum)
    path.length = dr.select(path.active, path.length + leg, path.length)
    path.point = dr.select(path.active, point, path.point)
