"""Integrator plugin ``passive_volpath``: pictures by daylight."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitransient_lidar.plugins import lidar_volpath

from mitransient_lidar.transport.connection import (
    ConnectedPath,
    SourceDirection,
    SourceLobe,
    SunLobe,
    start_path,
    sun_through,
)
from mitransient_lidar.transport.daylight import DaylightScene, FieldSampler
from mitransient_lidar.transport.streams import pass_streams

#: Number of this integrator's random streams within a pass.
_STREAM = 4

#: Scattering events beyond which a tenth of the paths ends at each: without absorption light would wander on for ever.
_LONG = 100
_LONG_SURVIVAL = 0.9


@dataclass
class DaylightPath(ConnectedPath):
    """A path whose vertices are connected to the sun, and which may get to the sky.

    Attributes
    ----------
    mirrored
        Whether the path has come along the one direction that the last surface allows, or from the receiver: then it
        was not connected to the sun there, and may meet its disc.
    reflected
        Whether the sea's dry side has reflected it last: then the sky was asked for there.
    """

    mirrored: mi.Bool
    reflected: mi.Bool


class PassiveVolpath(lidar_volpath.LidarVolpath):
    r"""Volumetric path tracer for pictures by daylight (``passive_volpath``).

    =====================  =======  ====================================================================================
    Parameter              Type     Meaning
    =====================  =======  ====================================================================================
    paths_per_pass,                 As for ``lidar_volpath``
    max_scatterings,
    roulette_threshold,
    connection
    turn_share             float    Share of turns that are drawn from a lobe towards the sun, without one upwards, 0 to
                                    0.99. No echo ends the paths here: more would make some of them weigh too much.
                                    Default: 0.1
    =====================  =======  ====================================================================================

    Renders the radiance that each pixel sees, in the unit of ``sun`` and ``sky``: W m^-2 sr^-1 nm^-1. Paths start
    evenly over the field of view and walk as those of ``lidar_volpath``: through the sea's waves and ripples, to
    scattering events in the water, to targets and the bottom. Vertices are connected to the sun as to the laser there;
    each path sees one point of its disc. The sky is what paths meet that leave the scene; what the sea reflects of it
    is asked for by a ray of its own, as a path alone would be reflected once in fifty times.

    The sea must be rough, as every ``ocean_surface`` is: through a smooth ``dielectric`` the sun's disc is met by
    chance only, and the picture is noisy.

    Light from beside the surface patch is lost. The air is clear; the receiver's optics do not enter the radiance.

    .. code-block:: xml

        <integrator type="passive_volpath">
            <integer name="paths_per_pass" value="262144"/>
        </integrator>

    .. code-block:: python

        {'type': 'passive_volpath', 'paths_per_pass': 262144}
    """

    #: Name under which results record the integrator.
    plugin = "passive_volpath"

    #: Value of ``turn_share`` where none is given.
    default_turn_share = 0.1

    def __init__(self, props: mi.Properties) -> None:
        if "unmerged" in props:
            raise ValueError("unmerged is for lidar_volpath: leave it out")
        super().__init__(props)
        self._wanted_connection = self.connection
        #: Radiance times solid angle that the last pass has found for each pixel [W m^-2 nm^-1].
        self.found = mi.Float64(0)
        #: Solid angle of its samples for each pixel [sr].
        self.sampled = mi.Float64(0)
        self._invalid = mi.Bool(False)
        self._view: tuple[mi.Scene, mi.Sensor, DaylightScene, FieldSampler] | None = None
        self._system: DaylightScene | None = None

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> None:
        """Refuse to record a lidar's echoes.

        Raises
        ------
        ValueError
            Always.
        """
        raise ValueError("integrator: passive_volpath has no laser; use a lidar integrator, or render_passive")

    def prepare_view(self, scene: mi.Scene, sensor: mi.Sensor) -> tuple[DaylightScene, FieldSampler]:
        """Find and check the parts of a scene; done once for a scene and sensor."""
        if self._view is None or self._view[0] is not scene or self._view[1] is not sensor:
            system = DaylightScene.from_scene(scene, sensor)
            self._view = scene, sensor, system, FieldSampler(system.receiver)
        return self._view[2], self._view[3]

    def release(self) -> None:
        """Forget the scene, which holds this integrator and could otherwise never be freed."""
        self._view = self._system = None

    def render(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor | int = 0,
        seed: mi.UInt32 = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render one pass.

        Parameters
        ----------
        scene, sensor
            What to render; a sensor or its index.
        seed
            Seed of the pass; passes with different seeds are independent.
        spp
            Paths for each pixel; 0 takes ``paths_per_pass`` for all pixels together.
        develop
            Whether to return the radiance instead of leaving what it is made from in `found` and `sampled`.
        evaluate
            Whether to compute now.

        Returns
        -------
        TensorXf
            Radiance [W m^-2 sr^-1 nm^-1], shape (pixel,) or (row, column); 0 where no path has started.
        """
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        system, view = self.prepare_view(scene, sensor)
        pixels = system.receiver.pixels
        count = spp * pixels.count if spp > 0 else self.paths_per_pass
        with dr.suspend_grad():
            rng = pass_streams(int(np.array(seed).item()), _STREAM, count)
            start = view.sample(dr.arange(mi.UInt32, count), count, rng)
            path = start_path(system.receiver.pose, start.direction, start.weight > 0)
            self.follow(system, path, rng, start.pixel, start.weight)
        if evaluate:
            dr.eval(self.found, self.sampled, self.lost, self.rays)
        if not develop:
            return mi.TensorXf()
        radiance = dr.select(self.sampled > 0, self.found / self.sampled, 0)
        return mi.TensorXf(mi.Float(radiance), shape=pixels.grid or (pixels.count,))

    def follow(
        self,
        system: DaylightScene,
        path: ConnectedPath,
        rng: mi.PCG32,
        pixel: mi.UInt32,
        weight: mi.Float,
    ) -> None:
        """Trace paths from where they are to their ends; each counts for a pixel with a weight [sr]."""
        self._system = system
        self.connection = "walk" if system.sun is None else self._wanted_connection
        self.lost = dr.zeros(mi.Float64, 1)
        self.found = dr.zeros(mi.Float64, system.receiver.pixels.count)
        self._invalid = dr.zeros(mi.Bool, system.receiver.pixels.count)
        self.sampled = dr.zeros(mi.Float64, system.receiver.pixels.count)
        dr.scatter_add(self.sampled, mi.Float64(weight), pixel, weight > 0)
        lobe = SunLobe(system, system.sun_directions(mi.Point2f(rng.next_float32(), rng.next_float32())))
        seen = DaylightPath(**vars(path), mirrored=mi.Bool(True), reflected=mi.Bool(False))
        self._trace(system, lobe, seen, rng, pixel, weight)
        self.found = dr.select(self._invalid, dr.nan, self.found)

    def _add(self, pixel: mi.UInt32, found: mi.Float, active: mi.Bool) -> None:
        # Sums leave out what is not a number: it is marked apart, to be told of.
        dr.scatter(self._invalid, mi.Bool(True), pixel, active & ~dr.isfinite(found))
        dr.scatter_add(self.found, mi.Float64(found), pixel, active & (found > 0))

    def _escape(self, path: DaylightPath, active: mi.Bool, pixel: mi.UInt32, weight: mi.Float) -> None:
        """Let paths see the sky that meet nothing any more, and the sun where they could not be connected to it."""
        system = self._system
        radiance = dr.select(path.reflected, 0, system.sky_radiance(path.direction))
        if system.sun is not None:
            radiance += dr.select(path.mirrored, system.sun.radiance(path.direction), 0)
        self._add(pixel, weight * path.throughput * radiance, active & ~path.in_water)

    def _light(
        self, system: DaylightScene, source: SourceDirection, crossing: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Connect points in the air or on the surface to the sun."""
        if system.sun is None:
            return mi.Float(0), mi.Float(0)
        return sun_through(system, crossing, source.in_air, system.sun.sampled_irradiance, active), mi.Float(0)

    def _receive(
        self,
        system: DaylightScene,
        path: DaylightPath,
        pixel: mi.UInt32,
        length: mi.Float,
        energy: mi.Float,
        active: mi.Bool,
    ) -> None:
        """Add light of the sun."""
        self._add(pixel, energy, active)

    def _account(
        self, system: DaylightScene, source: SourceDirection, lobe_share: mi.Float, crossing: mi.Point3f
    ) -> None:
        """Estimate what would have come from the sun had the surface not ended, as `lidar_volpath` does."""
        if system.sun is None:
            return
        index = float(system.refractive_index)
        through = 4 * index / (1 + index) ** 2 * source.in_air.z / source.in_water.z
        missing = lobe_share * through * system.sun.sampled_irradiance
        dr.scatter_add(self.lost, mi.Float64(missing), mi.UInt32(0), missing > 0)

    def _is_useful(self, system: DaylightScene, lobe: SourceLobe, path: DaylightPath) -> mi.Bool:
        """Return which paths can still find light: all."""
        return mi.Bool(True)

    def _connect_more(
        self,
        system: DaylightScene,
        path: DaylightPath,
        si: mi.SurfaceInteraction3f,
        at_dry_sea: mi.Bool,
        pixel: mi.UInt32,
        weight: mi.Float,
        rng: mi.PCG32,
    ) -> None:
        """Add the sky that the dry side of the sea reflects, where nothing is in the way."""
        if system.sky is None:
            return
        context = mi.BSDFContext()
        context.type_mask = mi.BSDFFlags.Reflection.value
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        sample, value = si.bsdf().sample(context, si, mi.Float(0), u, at_dry_sea)
        ray = si.spawn_ray(si.to_world(sample.wo))
        radiance = value[0] * system.sky_radiance(ray.d)
        bright = at_dry_sea & (radiance > 0)
        bright &= ~system.scene.ray_test(ray, bright)
        path.rays += dr.select(at_dry_sea, mi.UInt32(1), 0)
        self._add(pixel, weight * path.throughput * radiance, bright)

    def _turn_path(
        self,
        system: DaylightScene,
        lobe: SourceLobe,
        source: SourceDirection,
        path: DaylightPath,
        si: mi.SurfaceInteraction3f,
        mei: mi.MediumInteraction3f,
        phase: object,
        scattered: mi.Bool,
        submerged: mi.Bool,
        at_sea: mi.Bool,
        solid: mi.Bool,
        rng: mi.PCG32,
    ) -> mi.Bool:
        """Draw the direction in which the path goes on, and remember how it was turned."""
        dry = ~path.in_water
        turned = scattered | at_sea | solid
        delta = super()._turn_path(system, lobe, source, path, si, mei, phase, scattered, submerged, at_sea, solid, rng)
        path.mirrored = dr.select(turned, delta, path.mirrored)
        path.reflected = dr.select(turned, at_sea & dry & ~path.in_water, path.reflected)
        return delta

    def _roulette(self, path: DaylightPath, rng: mi.PCG32) -> None:
        """End paths of little throughput at random, and very long ones."""
        super()._roulette(path, rng)
        survives = (path.scatterings <= _LONG) | (rng.next_float32() < _LONG_SURVIVAL)
        path.active &= survives
        path.throughput = dr.select(path.scatterings > _LONG, path.throughput / _LONG_SURVIVAL, path.throughput)

    def to_string(self) -> str:
        """Return a description."""
        return f"PassiveVolpath[paths_per_pass={self.paths_per_pass}, connection={self._wanted_connection}]"


mi.register_integrator("passive_volpath", lambda props: PassiveVolpath(props))
