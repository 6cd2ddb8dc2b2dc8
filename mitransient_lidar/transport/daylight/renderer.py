"""Daylight passes, for each pixel's radiance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi

from mitransient_lidar.core.validation import require_memory
from mitransient_lidar.transport.daylight.sampling import FovSampler
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
from mitransient_lidar.transport.rng import pass_streams

#: Number of the random streams within a pass.
_STREAM = 4

#: Number of scattering events beyond which paths survive each with this probability: without absorption they would not
#: end.
_LONG, _LONG_SURVIVAL = 100, 0.9


@dataclass
class ReceivedDaylight:
    """Daylight in one pass.

    Attributes
    ----------
    found
        Each pixel's radiance times solid angle [W m^-2 nm^-1], shape (pixels,); NaN where a value was not finite.
    sampled
        Solid angle that each pixel's samples represent [sr], shape (pixels,).
    edge_loss
        Radiance times solid angle that would have been found if the surface mesh did not end, shape (1,).
    rays
        Number of traced rays.
    """

    found: mi.Float64
    sampled: mi.Float64
    edge_loss: mi.Float64
    rays: mi.Float64


class DaylightLight(PathLight):
    """Sun and sky, and the light of a pass; uniform random numbers `u` choose a point on the sun's disc per path."""

    def __init__(self, scene: DaylightScene, received: ReceivedDaylight, u: mi.Point2f, weight: mi.Float) -> None:
        self.scene, self.received, self.weight = scene, received, weight
        self.sampler = RefractedSunSampler(scene, scene.sun_directions(u))
        self.invalid = dr.zeros(mi.Bool, dr.width(received.found))

    def add(self, pixel: mi.UInt32, found: mi.Float, active: mi.Bool) -> None:
        """Add radiance to pixels, and mark those that it makes invalid."""
        # Sums leave out values that are not finite; the pixel is marked instead.
        dr.scatter(self.invalid, mi.Bool(True), pixel, active & ~dr.isfinite(found))
        dr.scatter_add(self.received.found, mi.Float64(found), pixel, active & (found > 0))

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
        self.add(path.pixel, energy, active)

    def escape(self, path: ConnectedPath, active: mi.Bool) -> None:
        """Add the sky where paths leave the scene, and the sun where they could not be connected to it."""
        scene = self.scene
        radiance = dr.select(path.reflected_by_sea, 0, scene.sky_radiance(path.direction))
        if scene.sun is not None:
            radiance += dr.select(path.specular, scene.sun.radiance(path.direction), 0)
        self.add(path.pixel, self.weight * path.throughput * radiance, active & ~path.in_water)

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
        self.add(path.pixel, self.weight * path.throughput * radiance, bright)

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
        found, sampled, lost = (dr.zeros(mi.Float64, count) for count in (pixels, pixels, 1))
        received = ReceivedDaylight(found, sampled, lost, mi.Float64(0))
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
        dr.eval(received.found, received.sampled, received.edge_loss, received.rays)
        return received


@runtime_checkable
class DaylightIntegrator(Protocol):
    """The integrator ``passive_volpath``."""

    plugin: str
    passive: bool

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> DaylightRenderer:
        """Return the pass renderer for a scene."""
