"""State of a path, and the only function that advances it in distance and time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.contribution import Contribution
from mitransient_lidar.transport.medium.index_layers import IndexLayers
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene import WaterScene

#: Surface length of paths that have not met the sea first [m].
NO_SURFACE = 1e9


@dataclass
class Path(Contribution):
    """A path from the receiver or from the laser, up to its last vertex, with what it carries.

    Attributes
    ----------
    point, direction
        Last vertex [m] (offset from surfaces against self-intersection) and unit direction of the next segment.
    in_water
        Whether the next segment lies in water.
    at_start
        Whether the next segment is the first one.
    length
        Optical length so far [m]: distance times group index, summed over the segments, less the distance from the
        start to the scene's reference point (`RelativePose`).
    scatterings
        Number of scattering events in the water so far.
    reversals
        Number of changes between going down and going up so far.
    index_layer
        Index layer of the next segment, if it lies in water.
    surface_length
        Optical length from the start by the point where the path first met the sea to the other end [m], as `length`;
        far beyond any record if its first segment has ended elsewhere.
    before_first_solid
        Whether the path has met no solid (bottom or target) yet.
    rays
        Number of rays traced so far, for the benchmark.
    active
        Whether the path continues.
    """

    point: mi.Point3f
    direction: mi.Vector3f
    in_water: mi.Bool
    at_start: mi.Bool
    length: mi.Float
    scatterings: mi.UInt32
    reversals: mi.UInt32
    index_layer: mi.UInt32
    surface_length: mi.Float
    before_first_solid: mi.Bool
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
        """Return the next segment as a ray."""
        return mi.Ray3f(self.point, self.direction)

    def optical_length(self, distance: mi.Float, index_layers: IndexLayers | None) -> mi.Float:
        """Return the optical length of a distance along the next segment [m]."""
        group = mi.Float(1) if index_layers is None else index_layers.group(self.index_layer)
        return distance * dr.select(self.in_water, group, 1)

    @staticmethod
    def initial(
        scene: WaterScene, pose: KernelPose, angles: mi.Point2f, throughput: mi.Float, active: mi.Bool
    ) -> dict[str, Any]:
        """Return the fields of paths that start from a pose at tangent-plane angles."""
        direction = pose.direction(angles.x, angles.y)
        point, length = scene.first_points(pose, angles, direction)
        return {
            "point": point,
            "direction": direction,
            "in_water": mi.Bool(pose.submerged),
            "at_start": mi.Bool(True),
            "length": length,
            "throughput": throughput,
            "lost": mi.Bool(False),
            "scatterings": mi.UInt32(0),
            "reversals": mi.UInt32(0),
            "index_layer": mi.UInt32(0),
            "surface_length": mi.Float(NO_SURFACE),
            "before_first_solid": mi.Bool(True),
            "rays": mi.UInt32(0),
            "active": active,
            "sums": scene.perturbations.start(),
        }


def advance(path: Path, index_layers: IndexLayers | None, distance: mi.Float, point: mi.Point3f) -> None:
    """Move paths over a distance [m] to their next vertices `point` [m]; their optical lengths grow.

    On surfaces `point`, the intersection, is more accurate than distance times direction. Without water there are no
    index layers.
    """
    path.length += dr.select(path.active, path.optical_length(distance, index_layers), 0)
    path.point = dr.select(path.active, point, path.point)
    path.at_start &= ~path.active
