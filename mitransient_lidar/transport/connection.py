"""The surface connection: how a vertex under water reaches the laser or the sun through a rough, wavy surface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.path import Path, optical_length
from mitransient_lidar.transport.pose import Pose
from mitransient_lidar.transport.system import LidarScene, WaterScene

#: Newton steps towards Snell's law: four leave less than 1e-4 rad even 5 m above and 40 m below the sea at 80 degrees.
_NEWTON_STEPS = 4

#: Depth below which a point counts as this deep [m], which keeps the equations regular at the surface.
_SMALLEST_DEPTH = 1e-4


@dataclass
class SourceDirection:
    """How a source of light in the air appears from a point under water, through a flat mean surface.

    Attributes
    ----------
    in_air
        Unit direction from the surface to the source.
    in_water
        Unit direction from the point up to the surface, refracted by Snell's law.
    """

    in_air: mi.Vector3f
    in_water: mi.Vector3f


@dataclass
class ConnectedPath(Path):
    """A path whose vertices are connected to the source of light.

    Attributes
    ----------
    lobe_ratio
        Density of the surface connection's proposal over that of the walk, for the direction of the next leg; 0 where
        no connection was tried.
    pristine
        Whether the path has met no solid yet.
    """

    lobe_ratio: mi.Float
    pristine: mi.Bool


@dataclass
class Turn:
    """Directions that leave a vertex, as density and as value of phase function or BSDF.

    Attributes
    ----------
    value
        Phase function [1/sr], or BSDF times cosine.
    pdf
        Density with which the walk draws the direction [1/sr].
    """

    value: mi.Float
    pdf: mi.Float


def start_path(pose: Pose, direction: mi.Vector3f, active: mi.Bool) -> ConnectedPath:
    """Return paths at their start in the air, where they look along directions."""
    return ConnectedPath(
        point=opaque_point(pose.origin),
        direction=direction,
        in_water=mi.Bool(False),
        length=mi.Float(0),
        throughput=mi.Float(1),
        scatterings=mi.UInt32(0),
        turns=mi.UInt32(0),
        stratum=mi.UInt32(0),
        rays=mi.UInt32(0),
        active=active,
        lobe_ratio=mi.Float(0),
        pristine=mi.Bool(True),
    )


class SourceLobe(ABC):
    """Directions in the water, from a point up to the surface, along which light from a source may arrive.

    The lobe is that of a flat virtual interface with Gaussian slopes, lit along the direction in which the source is
    seen; its slope variance is that of ripples and waves together, so that it covers every facet of the real surface.

    Parameters
    ----------
    system
        The scene.
    """

    def __init__(self, system: WaterScene) -> None:
        self.index = float(system.refractive_index)
        self.slope_variance = float(system.slope_variance)
        self._strata = system.strata

    @abstractmethod
    def towards_source(self, point: mi.Point3f) -> SourceDirection:
        """Return the source's direction in the air and, refracted, in the water."""

    def _refract(self, in_air: mi.Vector3f, normal: mi.Normal3f) -> mi.Vector3f:
        """Return the direction in the water, up to the facet, of light that comes from `in_air` through a facet."""
        cosine = dr.dot(in_air, normal)
        eta = 1 / self.index
        # The light goes on along -in_water; what is returned points back up.
        root = dr.safe_sqrt(1 - eta * eta * (1 - cosine * cosine))
        return eta * in_air + (root - eta * cosine) * mi.Vector3f(normal)

    def sample(self, source: SourceDirection, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """Sample a direction of the lobe; return it and its density [1/sr] (0 when the facet is not lit)."""
        slope = dr.sqrt(-self.slope_variance * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        normal = mi.Normal3f(dr.normalize(mi.Vector3f(-slope * cos, -slope * sin, 1)))
        direction = self._refract(source.in_air, normal)
        return direction, self.pdf(source, direction)

    def pdf(self, source: SourceDirection, direction: mi.Vector3f) -> mi.Float:
        """Return the density [1/sr] of a direction in the water.

        The facet that refracts the source's light into it has its normal along n w - i (generalised half vector; Walter
        et al. 2007, equations 16 and 17, doi:10.2312/EGWR/EGSR07/195-206).
        """
        half = self.index * direction - source.in_air
        length = dr.norm(half)
        normal = half / length
        slope2 = (dr.square(normal.x) + dr.square(normal.y)) / dr.square(normal.z)
        slopes = dr.exp(-slope2 / self.slope_variance) / (np.pi * self.slope_variance)
        cos_water = dr.dot(direction, normal)
        # d(slopes) = d(normal) / cos^3, d(normal) = n^2 |w.m| / |n w - i|^2 d(w).
        jacobian = dr.square(self.index) * cos_water / dr.square(length)
        valid = (normal.z > 0) & (cos_water > 0) & (dr.dot(source.in_air, normal) > 0)
        cos3 = normal.z * normal.z * normal.z
        return dr.select(valid, slopes / cos3 * jacobian, 0)

    def below(self, direction: mi.Vector3f, density: mi.Float, stratum: mi.UInt32) -> tuple[mi.Vector3f, mi.Float]:
        """Return a sampled direction and its density [1/sr] as they are in the stratum of the point."""
        return (direction, density) if self._strata is None else self._strata.from_first(direction, density, stratum)

    def pdf_below(self, source: SourceDirection, direction: mi.Vector3f, stratum: mi.UInt32) -> mi.Float:
        """Return the density [1/sr] of a direction in the stratum of the point."""
        if self._strata is None:
            return self.pdf(source, direction)
        first, factor = self._strata.to_first(direction, stratum)
        return self.pdf(source, first) * factor


class SurfaceLobe(SourceLobe):
    """Lobe of the laser.

    Parameters
    ----------
    system
        The lidar scene.
    """

    def __init__(self, system: LidarScene) -> None:
        super().__init__(system)
        self.laser = opaque_point(system.transmitter.pose.origin)

    def towards_source(self, point: mi.Point3f) -> SourceDirection:
        """Return the laser's direction in the air and, refracted, in the water."""
        return self.towards_laser(point)

    def towards_laser(self, point: mi.Point3f) -> SourceDirection:
        """Return the laser's direction in the air and, refracted, in the water.

        Newton's method on Snell's law for the horizontal distance between the point and where the ray crosses z = 0. It
        starts below the root, at the refracted straight line; there the sine of the angle in water is concave in the
        distance, so that the steps approach the root from one side at any altitude and angle.
        """
        depth = dr.maximum(-point.z, _SMALLEST_DEPTH)
        height = self.laser.z
        offset = mi.Vector2f(self.laser.x - point.x, self.laser.y - point.y)
        total = dr.norm(offset)
        sine = total * dr.rsqrt(dr.square(total) + dr.square(height + depth)) / self.index
        wet = depth * sine * dr.rsqrt(1 - sine * sine)
        for _ in range(_NEWTON_STEPS):
            dry = total - wet
            r_air = dr.rsqrt(dry * dry + height * height)
            r_water = dr.rsqrt(wet * wet + depth * depth)
            slope_air = dr.square(height * r_air) * r_air
            slope_water = self.index * dr.square(depth * r_water) * r_water
            wet += (dry * r_air - self.index * wet * r_water) / (slope_air + slope_water)
        horizontal = offset * dr.select(total > 0, wet / total, 0)
        crossing = mi.Point3f(point.x + horizontal.x, point.y + horizontal.y, 0)
        in_air = dr.normalize(self.laser - crossing)
        return SourceDirection(in_air, self._refract(in_air, mi.Normal3f(0, 0, 1)))


class SunLobe(SourceLobe):
    """Lobe of a source so far away that every point sees it in one direction.

    Parameters
    ----------
    system
        The scene.
    in_air
        Unit direction from the surface to the source, one for each path or one for all; it points up.
    """

    def __init__(self, system: WaterScene, in_air: mi.Vector3f) -> None:
        super().__init__(system)
        self._direction = SourceDirection(in_air, self._refract(in_air, mi.Normal3f(0, 0, 1)))

    def towards_source(self, point: mi.Point3f) -> SourceDirection:
        """Return the source's direction in the air and, refracted, in the water."""
        return self._direction


def laser_through(system: LidarScene, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Connect a surface point to the laser by a straight line in the air.

    Parameters
    ----------
    system
        The lidar scene.
    si
        Where the light meets the surface; ``si.wi`` is the direction it goes on to.
    active
        Which lanes ask.

    Returns
    -------
    radiance
        Energy per area and solid angle [J/(m^2 sr)] that leaves along ``si.wi``: intensity, BSDF with its cosine, and
        inverse square of the distance; 0 where something is in the way or the surface turns its wet side to the laser.
    length
        Optical length of the line [m].
    """
    laser = opaque_point(system.transmitter.pose.origin)
    offset = laser - si.p
    distance = dr.norm(offset)
    direction = offset / distance
    bsdf = _towards_air(system, si, direction, active)
    radiance = bsdf * system.transmitter.intensity(-direction) / dr.square(distance)
    active &= radiance > 0
    active &= ~system.scene.ray_test(si.spawn_ray_to(laser), active)
    return dr.select(active, radiance, 0), optical_length(system, distance, False)


def sun_through(
    system: WaterScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, irradiance: float, active: mi.Bool
) -> mi.Float:
    """Connect a surface point to a source at infinity, as `laser_through` does to the laser.

    Parameters
    ----------
    system
        The scene.
    si
        Where the light meets the surface; ``si.wi`` is the direction it goes on to.
    direction
        Unit direction to the source.
    irradiance
        What it gives on a plane normal to its rays, in any unit.
    active
        Which lanes ask.

    Returns
    -------
    Radiance that leaves along ``si.wi`` [irradiance / sr]; 0 where something is in the way or the surface turns its wet
    side to the source.
    """
    radiance = irradiance * _towards_air(system, si, direction, active)
    lit = active & (radiance > 0)
    lit &= ~system.scene.ray_test(si.spawn_ray(direction), lit)
    return dr.select(lit, radiance, 0)


def _towards_air(system: WaterScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """Return BSDF times cosine [1/sr] of light from a direction in the air; 0 on the surface's wet side."""
    active = active & ~(system.is_surface(si.shape) & (dr.dot(direction, si.n) <= 0))
    return dr.select(active, si.bsdf().eval(mi.BSDFContext(), si, si.to_local(direction), active)[0], 0)
