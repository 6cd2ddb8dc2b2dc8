"""Scenes lit by sun and sky, and daylight passes for each pixel's radiance over a uniformly sampled field of view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import require_memory
from mitransient_lidar.transport.paths import refracted_connection
from mitransient_lidar.transport.paths.path import ConnectedPath
from mitransient_lidar.transport.paths.volpath import BYTES_PER_PATH, PathLight, PathTracer, VolpathOptions
from mitransient_lidar.transport.perturbations import Sums
from mitransient_lidar.transport.plugin_types import Daylight, SkyEmitter, SunEmitter, Transmitter
from mitransient_lidar.transport.rng import pass_streams, stratified_point
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.scene_parts import find_receiver, find_solids, fit_seas
from mitransient_lidar.transport.sensor.pixels import PixelArray, parse_layout
from mitransient_lidar.transport.sensor.receiver import Receiver, SensorSample, solid_angle_factor

_SAME_DIRECTION_DEG = 0.05  #: Largest angle between the sun and the sun of a clear sky [deg].


@dataclass(frozen=True)
class DaylightScene(WaterScene):
    """A scene lit by sun and sky."""

    #: The ``sun`` and the ``sky`` plugins, None where there is none; at least one is present.
    sun: SunEmitter | None
    sky: SkyEmitter | None

    @classmethod
    def from_scene(cls, scene: mi.Scene, sensor: mi.Sensor) -> DaylightScene:
        """Find the parts in a loaded scene. A ``lidar_transmitter`` may be present and is ignored.

        Raises UserError when a part is missing, not supported, or there are several where one is allowed.
        """
        fit_seas(scene)
        receiver = find_receiver(sensor)
        found: dict[str, mi.Emitter] = {}
        for emitter in scene.emitters():
            if isinstance(emitter, Daylight):
                if emitter.daylight in found:
                    raise UserError(f"emitters: the scene has more than one {emitter.daylight}; allowed is one")
                found[emitter.daylight] = emitter
            elif not isinstance(emitter, Transmitter):
                raise UserError("emitters: passive imaging allows sun, sky and lidar_transmitter; there is another one")
        if not found:
            raise UserError("emitters: passive imaging needs a sun or a sky, and the scene has neither")
        sun, sky = found.get("sun"), found.get("sky")
        if sun is not None and sky is not None and sky.distribution == "clear":
            _check_sun(sun, sky)
        if receiver.pose.origin[2] <= 0:
            raise UserError("altitude: the receiver must be above the mean sea level z = 0")
        return cls(**vars(find_solids(scene, receiver)), sun=sun, sky=sky)

    def sky_radiance(self, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance of the sky in a direction [W m^-2 sr^-1 nm^-1]; 0 below the horizon."""
        return mi.Float(0) if self.sky is None else self.sky.radiance(direction)

    def sun_directions(self, u: mi.Point2f) -> mi.Vector3f:
        """Map uniform numbers to directions of the sun's disc, or to the zenith without a sun."""
        return mi.Vector3f(0, 0, 1) if self.sun is None else self.sun.sample(u)


def _check_sun(sun: SunEmitter, sky: SkyEmitter) -> None:
    """Refuse a clear sky with another direction of the sun."""
    apart = float(np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(sun.direction - sky.sun))))
    if apart > _SAME_DIRECTION_DEG:
        raise UserError(
            f"sun_zenith_deg and sun_azimuth_deg of the clear sky put the sun {apart:.3g} degrees from where it is: "
            "they must be the sun's own zenith_deg and azimuth_deg"
        )


_QUADRATURE_POINTS = 1024  #: Points along each axis of the quadrature that normalises a sky.


def direction_of(zenith_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    """Return the unit direction of a zenith angle and an azimuth from +x towards +y [deg]."""
    zenith, azimuth = np.radians((zenith_deg, azimuth_deg))
    return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


def uniform_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return a uniform sky's relative radiance."""
    return mi.Float(1)


def overcast_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the relative radiance of an overcast sky: three times as bright at the zenith as at the horizon.

    Cardioidal sky of Moon and Spencer 1942, Illuminating Engineering 37, 707.
    """
    return 1 + 2 * direction.z


def clear_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the relative radiance of a clear sky, bright around the sun and at the horizon.

    Harrison and Coombes 1988, equations 3 to 5 (doi:10.1016/0038-092X(88)90072-2), without the factor that depends on
    the sun's zenith angle alone.
    """
    cosine = dr.dot(direction, sun)
    # The arc cosine is inaccurate next to the sun.
    angle = 2 * dr.safe_asin(0.5 * dr.norm(direction - sun))
    around = 1.63 + 53.7 * dr.exp(-5.49 * angle) + 2.04 * dr.square(cosine) * sun.z
    return around * (1 - dr.exp(-0.19 / dr.maximum(direction.z, 1e-6)))


#: Relative radiance by distribution name.
SKIES: dict[str, Callable[[mi.Vector3f, mi.Vector3f], mi.Float]] = {
    "clear": clear_distribution,
    "overcast": overcast_distribution,
    "uniform": uniform_distribution,
}


def relative_irradiance(name: str, sun: NDArray[np.float64]) -> float:
    """Return the irradiance on a level plane by a relative radiance distribution, with the midpoint rule."""
    n = _QUADRATURE_POINTS
    index = dr.arange(mi.UInt32, n**2)
    cosine2 = (mi.Float(index % n) + 0.5) / n
    sin, cos = dr.sincos(dr.two_pi * (mi.Float(index // n) + 0.5) / n)
    level = dr.sqrt(1 - cosine2)
    direction = mi.Vector3f(level * cos, level * sin, dr.sqrt(cosine2))
    radiance = SKIES[name](direction, mi.Vector3f(sun.tolist()))
    return float(np.pi * np.mean(np.array(radiance, dtype=np.float64)))


_STREAM = 4  #: Number of the random streams within a pass.

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
        self.sampler = refracted_connection.RefractedSunSampler(scene, scene.sun_directions(u))
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
        self, si: mi.SurfaceInteraction3f, emitter: refracted_connection.EmitterDirection, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Connect surface points to the sun."""
        sun = self.scene.sun
        if sun is None:
            return mi.Float(0), mi.Float(0)
        return refracted_connection.connect_sun(
            self.scene, si, emitter.in_air, sun.sampled_irradiance, active
        ), mi.Float(0)

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

    def lose(self, emitter: refracted_connection.EmitterDirection, share: mi.Float, crossing: mi.Point3f) -> None:
        """Add sunlight to the losses."""
        sun = self.scene.sun
        if sun is not None:
            missing = share * refracted_connection.level_transmittance(self.scene, emitter) * sun.sampled_irradiance
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
    prepare: Callable[[mi.Scene, mi.Sensor], DaylightRenderer]  #: Returns the pass renderer for a scene.


_LATTICE = 4096  #: Least number of points along each field-of-view axis for the pixels' solid angles.
_RAYS = 2**14  #: Number of rays for the share of the field of view outside the surface mesh.


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
