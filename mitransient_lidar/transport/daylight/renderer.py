"""Daylight passes, for each pixel's radiance, over a uniformly sampled field of view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.validation import require_memory
from mitransient_lidar.transport.daylight.scene import DaylightScene
from mitransient_lidar.transport.paths.path import ConnectedPath
from mitransient_lidar.transport.paths.refracted_connection import (
    EmitterDirection,
    RefractedSunSampler,
    connect_sun,
    level_transmittance,
)
from mitransient_lidar.transport.paths.volpath import BYTES_PER_PATH, PathLight, PathTracer, VolpathOptions
from mitransient_lidar.transport.perturbations import Sums
from mitransient_lidar.transport.rng import pass_streams, stratified_point
from mitransient_lidar.transport.sensor.pixels import PixelArray, parse_layout
from mitransient_lidar.transport.sensor.receiver import Receiver, SensorSample, solid_angle_factor

#: Number of the random streams within a pass.
_STREAM = 4

#: Number of scattering events beyond which paths survive each with this probability: without absorption they would not
#: end.
_LONG, _LONG_SURVIVAL = 100, 0.9


@dataclass
class ReceivedDaylight:
    """Daylight in one pass."""

    #: Each pixel's radiance times solid angle [W m^-2 nm^-1], shape (pixels,); NaN where a value was not finite.
    found: mi.Float64
    scattered: mi.Float64  #: Part of `found` by paths that the water has scattered, without values that are not finite.
    sampled: mi.Float64  #: Solid angle that each pixel's samples represent [sr], shape (pixels,).
    #: Radiance times solid angle that would have been found if the surface mesh did not end, shape (1,).
    edge_loss: mi.Float64
    rays: mi.Float64  #: Number of traced rays.


class DaylightLight(PathLight):
    """Sun and sky, and the light of a pass. Uniform random numbers `u` choose a point on the sun's disc per path."""

    def __init__(self, scene: DaylightScene, received: ReceivedDaylight, u: mi.Point2f, weight: mi.Float) -> None:
        self.scene, self.received, self.weight = scene, received, weight
        self.sampler = RefractedSunSampler(scene, scene.sun_directions(u))
        self.invalid = dr.zeros(mi.Bool, dr.width(received.found))

    def add(self, path: ConnectedPath, found: mi.Float, active: mi.Bool) -> None:
        """Add radiance to the paths' pixels, and mark those that it makes invalid."""
        pixel = path.pixel
        # Sums leave out values that are not finite; the pixel is marked instead.
        dr.scatter(self.invalid, mi.Bool(True), pixel, active & ~dr.isfinite(found))
        bright = active & (found > 0)
        dr.scatter_add(self.received.found, mi.Float64(found), pixel, bright)
        diffuse = bright & (path.scatterings > 0) & dr.isfinite(found)
        dr.scatter_add(self.received.scattered, mi.Float64(found), pixel, diffuse)

    def connect(
        self, si: mi.SurfaceInteraction3f, emitter: EmitterDirection, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Connect surface points to the sun."""
        sun = self.scene.sun
        if sun is None:
            return mi.Float(0), mi.Float(0)
        return connect_sun(self.scene, si, emitter.in_air, sun.sampled_irradiance, active), mi.Float(0)

    def receive(
        self, path: ConnectedPath, length: mi.Float, energy: mi.Float, active: mi.Bool, on_solid: mi.Bool, sums: Sums
    ) -> None:
        """Add sunlight."""
        self.add(path, energy, active)

    def escape(self, path: ConnectedPath, active: mi.Bool) -> None:
        """Add the sky where paths leave the scene, and the sun where they could not be connected to it."""
        scene = self.scene
        radiance = dr.select(path.reflected_by_sea, 0, scene.sky_radiance(path.direction))
        if scene.sun is not None:
            radiance += dr.select(path.specular, scene.sun.radiance(path.direction), 0)
        self.add(path, self.weight * path.throughput * radiance, active & ~path.in_water)

    def reflect(self, path: ConnectedPath, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Bool) -> None:
        """Add the sky that the dry side of the sea surface reflects, where the ray is not blocked."""
        if self.scene.sky is None:
            return
        context = mi.BSDFContext()
        context.type_mask = mi.BSDFFlags.Reflection.value
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        sample, value = si.bsdf().sample(context, si, mi.Float(0), u, active)
        ray = si.spawn_ray(si.to_world(sample.wo))
        radiance = value[0] * self.scene.sky_radiance(ray.d)
        bright = active & (radiance > 0)
        bright &= ~self.scene.ray_test(ray, bright)
        path.rays += dr.select(active, mi.UInt32(1), 0)
        self.add(path, self.weight * path.throughput * radiance, bright)

    def lose(self, emitter: EmitterDirection, share: mi.Float, crossing: mi.Point3f) -> None:
        """Add sunlight to the losses."""
        sun = self.scene.sun
        if sun is not None:
            missing = share * level_transmittance(self.scene, emitter) * sun.sampled_irradiance
            dr.scatter_add(self.received.edge_loss, mi.Float64(missing), mi.UInt32(0), missing > 0)

    def end_paths(self, path: ConnectedPath, rng: mi.PCG32) -> None:
        """End very long paths at random."""
        path.active &= (path.scatterings <= _LONG) | (rng.next_float32() < _LONG_SURVIVAL)
        path.throughput = dr.select(path.scatterings > _LONG, path.throughput / _LONG_SURVIVAL, path.throughput)


class DaylightRenderer:
    """Renders independent passes of daylight over one prepared scene, by default with `paths` paths each."""

    def __init__(self, scene: DaylightScene, options: VolpathOptions, paths: int) -> None:
        self.scene, self.options, self.paths = scene, options, paths
        self.sampler = FovSampler(scene.receiver)

    def render_pass(self, seed: int, *, paths: int | None = None) -> ReceivedDaylight:
        """Render one pass; passes with different seeds are independent."""
        count = self.paths if paths is None else paths
        require_memory(f"{count} paths", BYTES_PER_PATH * count, "take fewer paths_per_pass")
        with dr.suspend_grad():
            rng = pass_streams(seed, _STREAM, count)
            start = self.sampler.sample(dr.arange(mi.UInt32, count), count, rng)
            pose, found = self.scene.receiver_pose, start.weight > 0
            path = ConnectedPath.start(self.scene, pose, start.angles, mi.Float(1), found, pixel=start.pixel)
            return self.follow(path, rng, start.weight)

    def follow(self, path: ConnectedPath, rng: mi.PCG32, weight: mi.Float) -> ReceivedDaylight:
        """Trace paths from their last vertices to their ends, with the weight [sr] of each."""
        pixels = self.scene.receiver.pixels.count
        found, scattered, sampled, lost = (dr.zeros(mi.Float64, count) for count in (pixels, pixels, pixels, 1))
        received = ReceivedDaylight(found, scattered, sampled, lost, mi.Float64(0))
        dr.scatter_add(received.sampled, mi.Float64(weight), path.pixel, weight > 0)
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        light = DaylightLight(self.scene, received, u, weight)
        options = self.options
        if self.scene.sun is None:
            # Nothing to be guided to.
            options = replace(options, samples_emitter=False, expects_emitter=False, solid_guiding_probability=None)
            options = replace(options, guiding_probability=0.0)
        received.rays = PathTracer(self.scene, options, light).trace(path, rng)
        received.found = dr.select(light.invalid, dr.nan, received.found)
        dr.eval(received)
        return received


@runtime_checkable
class DaylightIntegrator(Protocol):
    """The integrator ``passive_volpath``."""

    plugin: str
    passive: bool
    #: Returns the pass renderer for a scene.
    prepare: Callable[[mi.Scene, mi.Sensor], DaylightRenderer]


#: Least number of points along each field-of-view axis for the pixels' solid angles.
_LATTICE = 4096

#: Number of rays for the share of the field of view outside the surface mesh.
_RAYS = 2**14


class FovSampler:
    """Samples the receiver's field of view uniformly.

    Samples are stratified. Where the optics blur, the place on the detector is drawn first, then the direction from
    which it receives light.
    """

    def __init__(self, receiver: Receiver) -> None:
        self.receiver = receiver

    def sample(self, index: mi.UInt32, count: int, rng: mi.PCG32) -> SensorSample:
        """Sample directions for paths number `index` of `count`; weights are the solid angles they represent [sr]."""
        pixels = self.receiver.pixels
        px, py = pixels.sample(stratified_point(index, count, rng))
        dx, dy = self.receiver.displacement(rng)
        angle_x, angle_y = px - dx, py - dy
        pixel, here = pixels.pixel_at(px, py, rng.next_float32())
        weight = pixels.area / count * solid_angle_factor(px, py)
        return SensorSample.at(self.receiver.pose, angle_x, angle_y, pixel, dr.select(here > 0, weight, 0))


def pixel_solid_angles(pixels: PixelArray) -> NDArray[np.float64]:
    """Return each pixel's solid angle [sr], shape (pixels,), counted on a fine lattice over the field of view.

    Layout cells that the field of view does not cut are exact.
    """
    # An integer number of points in every layout cell.
    cells = parse_layout(pixels.layout) if pixels.layout[0].isdigit() else (1, 1)
    rows, columns = (cell * -(-_LATTICE // cell) for cell in cells)
    index = dr.arange(mi.UInt32, rows * columns)
    full = pixels.field_of_view
    angle_x = full * (0.5 - (mi.Float(index // columns) + 0.5) / rows)
    angle_y = full * ((mi.Float(index % columns) + 0.5) / columns - 0.5)
    u = mi.Float(index * mi.UInt32(2654435769) >> 8) * 2**-24
    pixel, here = pixels.pixel_at(angle_x, angle_y, u)
    found = dr.zeros(mi.Float64, pixels.count)
    # Where pixels overlap, a random one counts.
    dr.scatter_add(found, mi.Float64(here * solid_angle_factor(angle_x, angle_y)), pixel, here > 0)
    return np.array(found) * full**2 / (rows * columns)


def share_outside_surface(scene: DaylightScene, sampler: FovSampler) -> float:
    """Return the field-of-view share that points down outside the surface mesh."""
    if not scene.surfaces:
        return 0.0
    seen = sampler.sample(dr.arange(mi.UInt32, _RAYS), _RAYS, pass_streams(0, 0, _RAYS))
    points, _ = scene.first_points(scene.receiver.pose, seen.angles, seen.direction)
    ray = mi.Ray3f(points, seen.direction)
    si = scene.ray_intersect(ray, seen.weight > 0)
    outside = ~si.is_valid() & (seen.direction.z < 0)
    outside |= si.is_valid() & scene.outside_surface(si.p.z, mi.Bool(False))
    weight = np.array(seen.weight, dtype=np.float64)
    return float(weight[np.array(outside)].sum() / max(weight.sum(), 1e-300))
