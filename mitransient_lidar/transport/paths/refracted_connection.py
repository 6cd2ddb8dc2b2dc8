"""Connection of vertices under water to the laser or the sun through a rough, wavy sea surface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.medium.water import coinciding, refract
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.perturbations import Sums
from mitransient_lidar.transport.scene import LidarScene, WaterScene

#: Newton steps towards Snell's law: four leave less than 1e-4 rad even 5 m above and 40 m below the sea at 80 degrees.
_NEWTON_STEPS = 4

_SMALLEST_DEPTH = 1e-4  #: Smallest depth of a point [m], which keeps the equations regular at the surface.


@dataclass
class EmitterDirection:
    """Direction of an emitter in the air, seen from a point under water through a flat mean surface."""

    in_air: mi.Vector3f  #: Unit direction from the surface to the emitter.
    in_water: mi.Vector3f  #: Unit direction from the point up to the surface, refracted by Snell's law.


class RefractedEmitterSampler(ABC):
    """Samples directions in the water, from a point up to the surface, along which an emitter's light may arrive.

    Their distribution belongs to a flat interface with Gaussian slopes that is lit from the emitter's direction. Its
    slope variance includes ripples and waves, so that it covers every facet on the real surface.
    """

    def __init__(self, scene: WaterScene) -> None:
        self.index = opaque(scene.refractive_index)
        self.slope_variance = opaque(scene.slope_variance)
        self._layers = scene.index_layers

    @abstractmethod
    def direction_from(self, point: mi.Point3f) -> EmitterDirection:
        """Return the emitter's direction from points under water."""

    def _level_direction(self, in_air: mi.Vector3f) -> EmitterDirection:
        return EmitterDirection(in_air, refract(in_air, mi.Normal3f(0, 0, 1), 1 / self.index))

    def sample(self, emitter: EmitterDirection, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """Sample a direction in the top index layer, with its density [1/sr]; 0 where the facet is not lit."""
        slope = dr.sqrt(-self.slope_variance * dr.log(1 - u.x))
        sin, cos = dr.sincos(dr.two_pi * u.y)
        normal = mi.Normal3f(dr.normalize(mi.Vector3f(-slope * cos, -slope * sin, 1)))
        direction = refract(emitter.in_air, normal, 1 / self.index)
        return direction, self.pdf(emitter, direction)

    def pdf(self, emitter: EmitterDirection, direction: mi.Vector3f) -> mi.Float:
        """Return the density [1/sr] of a direction in the top index layer.

        The facet that refracts the emitter's light into it has its normal along n w - i (generalised half vector;
        Walter et al. 2007, equations 16 and 17, doi:10.2312/EGWR/EGSR07/195-206).
        """
        half = self.index * direction - emitter.in_air
        length = dr.norm(half)
        normal = half / length
        slope2 = (dr.square(normal.x) + dr.square(normal.y)) / dr.square(normal.z)
        slopes = dr.exp(-slope2 / self.slope_variance) / (np.pi * self.slope_variance)
        cos_water = dr.dot(direction, normal)
        # d(slopes) = d(normal) / cos^3, d(normal) = n^2 |w.m| / |n w - i|^2 d(w).
        jacobian = dr.square(self.index) * cos_water / dr.square(length)
        valid = (normal.z > 0) & (cos_water > 0) & (dr.dot(emitter.in_air, normal) > 0)
        cos3 = normal.z * normal.z * normal.z
        return dr.select(valid, slopes / cos3 * jacobian, 0)

    def sample_in_layer(
        self, emitter: EmitterDirection, u: mi.Point2f, layer: mi.UInt32
    ) -> tuple[mi.Vector3f, mi.Float]:
        """Sample a direction in the index layer of the point, with its density [1/sr]."""
        direction, density = self.sample(emitter, u)
        return (direction, density) if self._layers is None else self._layers.from_top(direction, density, layer)

    def pdf_in_layer(self, emitter: EmitterDirection, direction: mi.Vector3f, layer: mi.UInt32) -> mi.Float:
        """Return a direction's density [1/sr] in the index layer of the point."""
        if self._layers is None:
            return self.pdf(emitter, direction)
        top, factor = self._layers.to_top(direction, layer)
        return self.pdf(emitter, top) * factor


class RefractedLaserSampler(RefractedEmitterSampler):
    """Directions towards the laser."""

    def __init__(self, scene: LidarScene) -> None:
        super().__init__(scene)
        self.laser = scene.transmitter_pose.point

    def direction_from(self, point: mi.Point3f) -> EmitterDirection:
        """Return the laser's direction from points under water.

        Newton's method on Snell's law for the horizontal distance between the point and the ray's crossing of z = 0. It
        starts below the root, at the refracted straight line. There the sine of the angle in water is concave in the
        distance. Steps approach the root from one side at any altitude and angle.
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
        return self._level_direction(dr.normalize(self.laser - crossing))


class SubmergedLaserSampler(RefractedEmitterSampler):
    """Directions towards a laser under water, which straight lines reach: none is sampled through the surface."""

    def __init__(self, scene: LidarScene) -> None:
        super().__init__(scene)
        self._laser = scene.transmitter_pose.point

    def direction_from(self, point: mi.Point3f) -> EmitterDirection:
        """Return the laser's direction from points under water."""
        direction = dr.normalize(self._laser - point)
        return EmitterDirection(direction, direction)

    def pdf_in_layer(self, emitter: EmitterDirection, direction: mi.Vector3f, layer: mi.UInt32) -> mi.Float:
        """Return the density 0."""
        return mi.Float(0)


class RefractedSunSampler(RefractedEmitterSampler):
    """Directions towards an emitter at infinity, in a unit direction from the surface, for all paths or one a path."""

    def __init__(self, scene: WaterScene, in_air: mi.Vector3f) -> None:
        super().__init__(scene)
        self._direction = self._level_direction(in_air)

    def direction_from(self, point: mi.Point3f) -> EmitterDirection:
        """Return the emitter's direction."""
        return self._direction


def level_transmittance(scene: WaterScene, emitter: EmitterDirection) -> mi.Float:
    """Return the transmittance of radiance through a level surface, with Fresnel's factor for normal incidence."""
    index = opaque(scene.refractive_index)
    return 4 * index / (1 + index) ** 2 * emitter.in_air.z / emitter.in_water.z


@dataclass
class TopLayerRay:
    """A ray from a vertex, refracted up to the top index layer."""

    ray: mi.Ray3f  #: The ray where it enters the top index layer, or starts in it.
    #: Optical length [m], optical depth, and absorption depth alone below the top index layer.
    optical_length: mi.Float
    optical_depth: mi.Float
    absorption_depth: mi.Float
    #: Radiance factor: squared ratio between the refractive indices, times the share that no shape blocks.
    factor: mi.Float
    sums: Sums  #: Perturbation sums below the top index layer.


def trace_to_top_layer(scene: WaterScene, ray: mi.Ray3f, layer: mi.UInt32, active: mi.Bool) -> TopLayerRay:
    """Trace rays from under water up to the top index layer."""
    traced = TopLayerRay(ray, mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(1), scene.perturbations.start())
    if scene.water is None:
        return traced
    water, layers = scene.water, scene.water.index_layers
    for number in range(layers.count - 1, 0, -1):
        here = active & (layer == number) & (traced.ray.d.z > 0)
        segment = mi.Ray3f(traced.ray.o, traced.ray.d)
        distance = dr.maximum((-segment.o.z - opaque(layers.boundaries[number - 1])) / segment.d.z, 0)
        # A solid in the boundary plane counts.
        segment.maxt = distance + coinciding(distance) / segment.d.z
        share = scene.share_along(segment, here)
        optical_depth = water.optical_depth(segment.o, segment.d, distance)
        absorption = water.absorption_flight.optical_depth(-segment.o.z, -segment.d.z, distance)
        above = mi.UInt32(number - 1)
        direction, ratio, passes = layers.refract(segment.d, mi.UInt32(number), above)
        traced.optical_length += dr.select(here, distance * layers.group(mi.UInt32(number)), 0)
        traced.optical_depth += dr.select(here, optical_depth, 0)
        traced.absorption_depth += dr.select(here, absorption, 0)
        traced.sums = scene.perturbations.along(traced.sums, -segment.o.z, -segment.d.z, distance, here)
        traced.factor *= dr.select(here, dr.select(passes, share * ratio * ratio, 0), 1)
        origin = dr.select(here, segment.o + segment.d * distance, segment.o)
        traced.ray = mi.Ray3f(origin, dr.select(here, direction, segment.d))
        layer = dr.select(here, above, layer)
    return traced


@dataclass
class StraightConnection:
    """Straight lines from points to the laser, in the medium of the laser; whether they are blocked is not known."""

    direction: mi.Vector3f  #: Unit direction to the laser.
    irradiance: mi.Float  #: Energy per area normal to the line [J/m^2].
    #: Distance [m], and relative optical length [m].
    distance: mi.Float
    length: mi.Float

    @classmethod
    def to_laser(cls, scene: LidarScene, point: mi.Point3f) -> StraightConnection:
        """Return the points' connections."""
        relative = scene.relative(scene.transmitter_pose)
        offset = scene.transmitter_pose.point - point
        distance = dr.norm(offset)
        direction = offset / distance
        irradiance = scene.transmitter.intensity_at(*relative.tangent(point)) / dr.square(distance)
        length = relative.distance(point)
        if scene.submerged:
            irradiance *= dr.exp(-scene.required_water.optical_depth(point, direction, distance))
            length += opaque(scene.group_index - 1) * distance
        return cls(direction, irradiance, distance, length)


def perturbed_to_laser(
    scene: LidarScene, sums: Sums, point: mi.Point3f, si: mi.SurfaceInteraction3f, active: mi.Bool
) -> Sums:
    """Return the sums of paths with straight lines from points to the laser, which begin at surfaces where active."""
    if not sums:
        return sums
    line = StraightConnection.to_laser(scene, point)
    at_sea = active & scene.is_surface(si.shape)
    sums = scene.perturbations.at_sea(sums, si, si.to_local(line.direction), at_sea)
    angle_x, angle_y, _ = scene.relative(scene.transmitter_pose).tangent(point)
    sums = scene.perturbations.at_laser(sums, scene.transmitter.profile, angle_x, angle_y)
    if not scene.submerged:
        return sums
    return scene.perturbations.along(sums, -point.z, -line.direction.z, line.distance)


def connect_event_to_laser(
    scene: LidarScene, point: mi.Point3f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
    """Connect scattering events to a laser under water.

    Return unit direction, energy per area normal to it [J/m^2] that no shape blocks, and relative length [m].
    """
    line = StraightConnection.to_laser(scene, point)
    ray = mi.Ray3f(point, line.direction)
    ray.maxt = line.distance
    lit = active & (line.irradiance > 0)
    return line.direction, dr.select(lit, scene.share_along(ray, lit) * line.irradiance, 0), line.length


def connect_laser(scene: LidarScene, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Connect surface points to the laser by straight lines in the air, or in the water of a laser under water.

    Returns `radiance`: energy per area and solid angle [J/(m^2 sr)] along ``si.wi`` by the light that no shape blocks.
    It is intensity times BSDF with its cosine times inverse square distance; 0 on the other side of the sea surface.
    `length`: length of the line [m], relative to the distance to the scene's reference point.
    """
    line = StraightConnection.to_laser(scene, si.p)
    radiance = _bsdf_towards(scene, si, line.direction, active, wet=scene.submerged) * line.irradiance
    active &= radiance > 0
    share = scene.share_along(si.spawn_ray_to(scene.transmitter_pose.point), active)
    return dr.select(active, share * radiance, 0), line.length


def connect_sun(
    scene: WaterScene,
    si: mi.SurfaceInteraction3f,
    direction: mi.Vector3f,
    irradiance: mi.Float | float,
    active: mi.Bool,
) -> mi.Float:
    """Connect surface points to an emitter at infinity in a unit direction, as `connect_laser` does to the laser.

    Return the radiance along ``si.wi`` [irradiance / sr], for the irradiance on a plane normal to the emitter's rays.
    """
    radiance = irradiance * _bsdf_towards(scene, si, direction, active)
    lit = active & (radiance > 0)
    return dr.select(lit, scene.share_along(si.spawn_ray(direction), lit) * radiance, 0)


def _bsdf_towards(
    scene: WaterScene, si: mi.SurfaceInteraction3f, direction: mi.Vector3f, active: mi.Bool, *, wet: bool = False
) -> mi.Float:
    """Return BSDF times cosine [1/sr] for a direction in the air, or in the water; 0 on the sea's other side."""
    cosine = dr.dot(direction, si.n)
    active = active & ~(scene.is_surface(si.shape) & ((cosine >= 0) if wet else (cosine <= 0)))
    value = si.bsdf().eval(mi.BSDFContext(), scene.on_shapes(si), si.to_local(direction), active)
    return dr.select(active, value[0], 0)
