"""Unidirectional volumetric path tracing with the surface connection: the reference, and pictures by daylight."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.validation import require_memory
from mitransient_lidar.transport.medium.free_flight import LayeredFlight
from mitransient_lidar.transport.medium.tabulated_phase import deflect, henyey_greenstein, sample_henyey_greenstein
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.paths.passes import PassRenderer, PathClasses, ReceivedLight
from mitransient_lidar.transport.paths.path import ConnectedPath, PathStep, ScatteringEvent, Vertex
from mitransient_lidar.transport.paths.refracted_connection import (
    EmitterDirection,
    RefractedEmitterSampler,
    RefractedLaserSampler,
    SubmergedLaserSampler,
    connect_event_to_laser,
    connect_laser,
    level_transmittance,
    perturbed_to_laser,
    trace_to_top_layer,
)
from mitransient_lidar.transport.paths.ripple_focusing import Echo
from mitransient_lidar.transport.perturbations import Sums, joined
from mitransient_lidar.transport.rng import Shots
from mitransient_lidar.transport.scene import LidarScene, WaterScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler
from mitransient_lidar.transport.solids import met_shape

#: Asymmetry of the Henyey-Greenstein lobe towards the emitter from which guided directions are drawn: the best from 0.7
#: to 0.95 in clear and turbid water, with the default probability.
_GUIDING_ASYMMETRY = 0.87

#: Lobe asymmetry on solids with their own lobe probability: closer to sunlight under water.
_SOLID_GUIDING_ASYMMETRY = 0.95

#: Radiance under water far from the emitter's direction, over the mean of all directions, that the roulette assumes.
_DIFFUSE_RADIANCE = 0.5

_STREAM = 3  #: Number of the random streams within a pass.

BYTES_PER_PATH = 18  #: Memory per path: the state of its random numbers [bytes].


@dataclass(frozen=True)
class VolpathOptions:
    """Path tracer options; the plugins ``lidar_volpath`` and ``passive_volpath`` document most of them."""

    max_scatterings: int = -1
    roulette_threshold: float = 0.001
    guiding_probability: float = 0.4
    #: Whether directions towards the emitter are sampled, besides the path's own: the balance heuristic combines both.
    samples_emitter: bool = True
    complement_only: bool = False
    #: Guiding probability on solids below water that scatters all light; None is the probability at scattering events,
    #: with the same lobe.
    solid_guiding_probability: float | None = None
    #: Whether the roulette counts throughput times the radiance expected under water, which is largest about the
    #: emitter's direction, instead of throughput alone.
    expects_emitter: bool = False
    #: Whether absorption reduces path weights, instead of the number of paths that scatter or arrive.
    weights_absorption: bool = False
    connects_solids: bool = False  #: Whether `complement_only` has the paths whose first solid is under water, too.


class PathLight:
    """Emitters to which the vertices of paths are connected, and the light received from them."""

    sampler: RefractedEmitterSampler  #: Samples directions under water towards the emitter.
    weight: mi.Float  #: Light weight of each path.

    #: Whether the emitter is under water, where straight lines reach it.
    submerged = False

    @abstractmethod
    def connect(
        self, si: mi.SurfaceInteraction3f, emitter: EmitterDirection, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Connect surface points to the emitter; return radiance along ``si.wi`` and relative length [m]."""

    def connect_event(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Connect scattering events to an emitter under water: see `connect_event_to_laser`."""
        raise NotImplementedError

    @abstractmethod
    def receive(
        self, path: ConnectedPath, length: mi.Float, energy: mi.Float, active: mi.Bool, on_solid: mi.Bool, sums: Sums
    ) -> None:
        """Record light that arrives along paths of an optical length [m], connected from solids or elsewhere.

        `sums` are the perturbation sums of the complete paths.
        """

    def perturbed(self, sums: Sums, point: mi.Point3f, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Sums:
        """Return the sums of paths with the lines from points to the emitter, which begin at surfaces where active."""
        return sums

    @abstractmethod
    def lose(self, emitter: EmitterDirection, share: mi.Float, crossing: mi.Point3f) -> None:
        """Add connections beyond the end of the surface mesh to the losses, as through a flat sea at normal incidence.

        `share` is the received energy per radiance above the surface at `crossing`.
        """

    def length_by(self, path: ConnectedPath) -> mi.Float:
        """Return the optical length from the receiver by the last vertex straight to the emitter [m]; 0 if far away."""
        return mi.Float(0)

    def solid(self, shape: mi.ShapePtr) -> mi.UInt32:
        """Return the numbers of solids as `PathClasses.solid`; 0 where light has no such classes."""
        return mi.UInt32(0)

    def escape(self, path: ConnectedPath, active: mi.Bool) -> None:
        """Record light of emitters that paths meet when they leave the scene; there is none by default."""

    def reflect(self, path: ConnectedPath, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Bool) -> None:
        """Record other emitters' light that the dry side of the sea surface reflects; there is none by default."""

    @abstractmethod
    def end_paths(self, path: ConnectedPath, rng: mi.PCG32) -> None:
        """End paths that no more light can reach in time, or at random after very many scattering events."""


class LaserLight(PathLight):
    """The laser, and the light of a pass."""

    def __init__(self, scene: LidarScene, received: ReceivedLight, weight: mi.Float) -> None:
        self.scene, self.received, self.weight = scene, received, weight
        self.submerged = scene.submerged
        self.sampler = SubmergedLaserSampler(scene) if scene.submerged else RefractedLaserSampler(scene)
        self._to_laser = scene.relative(scene.transmitter_pose)
        self._path_end = opaque(scene.axis.path_end - scene.reference_length)

    def connect(
        self, si: mi.SurfaceInteraction3f, emitter: EmitterDirection, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Connect surface points to the laser."""
        return connect_laser(self.scene, si, active)

    def connect_event(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Connect scattering events to a laser under water."""
        return connect_event_to_laser(self.scene, point, active)

    def perturbed(self, sums: Sums, point: mi.Point3f, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Sums:
        """Return the sums of paths with the lines from points to the laser."""
        return perturbed_to_laser(self.scene, sums, point, si, active)

    def length_by(self, path: ConnectedPath) -> mi.Float:
        """Return the optical length from the receiver by the last vertex straight to the laser [m]."""
        return path.length + self._to_laser.distance(path.point)

    def solid(self, shape: mi.ShapePtr) -> mi.UInt32:
        """Return the solids' numbers among the light classes."""
        return self.received.classes.solid(shape)

    def receive(
        self, path: ConnectedPath, length: mi.Float, energy: mi.Float, active: mi.Bool, on_solid: mi.Bool, sums: Sums
    ) -> None:
        """Add energy to the histogram."""
        # The connection to a laser above goes up: from a vertex that was reached downwards it is one more reversal.
        upward = self.scene.transmitter_pose.point.z - path.point.z
        reversals = path.reversals + dr.select(path.downward * upward > 0, mi.UInt32(1), 0)
        echo = Echo(path.surface_length, on_solid | ~path.before_first_solid)
        self.received.receive(path.pixel, path.scatterings, reversals, path.solid, length, energy, active, echo, sums)

    def lose(self, emitter: EmitterDirection, share: mi.Float, crossing: mi.Point3f) -> None:
        """Add energy to the losses."""
        pose = self.scene.transmitter_pose
        offset = pose.point - crossing
        intensity = self.scene.transmitter.intensity_at(*pose.tangent(-dr.normalize(offset)))
        missing = share * level_transmittance(self.scene, emitter) * intensity / dr.squared_norm(offset)
        self.received.histogram.lose(missing, missing > 0)

    def end_paths(self, path: ConnectedPath, rng: mi.PCG32) -> None:
        """End paths whose light would arrive after the record."""
        path.active &= path.length + self._to_laser.distance(path.point) < self._path_end


class PathTracer:
    """Traces paths from the receiver and connects their vertices to a light.

    Each vertex under water samples a direction in which the emitter may appear through the surface. The direction is
    traced to the real surface, where it is connected. A path that reaches the surface unscattered is connected there,
    too. Both estimate the same paths; the balance heuristic combines them (Veach and Guibas 1995,
    doi:10.1145/218380.218498).
    """

    def __init__(self, scene: WaterScene, options: VolpathOptions, light: PathLight) -> None:
        self.scene, self.options, self.light = scene, options, light
        flight = scene.water.flight if scene.water is not None else None
        self._absorption: LayeredFlight | None = None
        if options.weights_absorption and scene.water is not None:
            flight, self._absorption = scene.water.scattering_flight, scene.water.absorption_flight
        self._step = PathStep(scene, flight, mi.TransportMode.Radiance)

    def trace(self, path: ConnectedPath, rng: mi.PCG32) -> mi.Float64:
        """Follow paths to their ends; return the number of rays."""

        def body(path: ConnectedPath, rng: mi.PCG32) -> tuple[ConnectedPath, mi.PCG32]:
            self._extend(path, rng)
            return path, rng

        path, _ = dr.while_loop((path, rng), lambda path, rng: path.active, body, label="lidar_volpath")
        return dr.sum(mi.Float64(path.rays))

    def _extend(self, path: ConnectedPath, rng: mi.PCG32) -> None:
        """Go to the next vertex, connect it to the emitter, and choose the next direction."""
        first = mi.Bool(path.at_start)
        vertex = self._step.next_vertex(path, rng)
        wet = path.active & path.in_water & dr.isfinite(vertex.reach)
        # Probability that the path's own sampling crosses the segment.
        transmittance = dr.exp(-self._sampled_depth(path.point, path.direction, vertex.reach, wet))
        self.light.escape(path, path.active & ~vertex.exists)
        path.active &= vertex.exists
        path.scatterings += dr.select(vertex.scattered, mi.UInt32(1), 0)
        if self.options.max_scatterings >= 0:
            path.active &= path.scatterings <= self.options.max_scatterings
        if self._absorption is not None:
            absorbed = self._absorption.optical_depth(path.depth, path.downward, vertex.length)
            path.throughput *= dr.select(path.active & path.in_water, dr.exp(-absorbed), 1)
        path.sums = self.scene.perturbations.along(
            path.sums, path.depth, path.downward, vertex.length, path.active & path.in_water
        )
        self._step.arrive(path, vertex)
        by_surface = self.light.length_by(path)
        path.surface_length = dr.select(first & vertex.at_sea, by_surface, path.surface_length)
        event = self._step.scattering_event(path, vertex.scattered, rng)
        if self.scene.water is not None and self._absorption is None:
            path.throughput *= dr.select(vertex.scattered, self.scene.water.albedo(event.scatterer), 1)
        emitter = self.light.sampler.direction_from(path.point)
        met_first = vertex.on_solid & path.before_first_solid
        path.solid = dr.select(met_first, self.light.solid(met_shape(vertex.si)), path.solid)
        if self.light.submerged:
            self._connect_straight(path, vertex, event, emitter, first)
        else:
            self._connect(path, rng, vertex, event, emitter, transmittance, first)
        passes = self._redirect(path, rng, vertex, event, emitter)
        crosses = vertex.at_boundary | passes
        path.emitter_ratio = dr.select(crosses, path.emitter_ratio / transmittance, path.emitter_ratio)
        self._step.cross_boundary(path, vertex.at_boundary & path.active)
        self._roulette(path, rng, emitter)
        self.light.end_paths(path, rng)

    def _connect(
        self,
        path: ConnectedPath,
        rng: mi.PCG32,
        vertex: Vertex,
        event: ScatteringEvent,
        emitter: EmitterDirection,
        transmittance: mi.Float,
        first: mi.Bool,
    ) -> None:
        """Connect from under water through the surface, and from the surface and from solids in the air directly."""
        scene, si, light = self.scene, vertex.si, self.light
        submerged = vertex.submerged
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        up, density = light.sampler.sample_in_layer(emitter, u, path.index_layer)
        sampled = submerged & (density > 0) if self.options.samples_emitter else mi.Bool(False)
        value, pdf = self._evaluate(emitter, vertex, event, sampled, up)
        ray = dr.select(vertex.scattered, mi.Ray3f(path.point, up), scene.spawn_ray(si, up))
        top = trace_to_top_layer(scene, ray, path.index_layer, sampled)
        above, to_surface, share = scene.look_through(top.ray, sampled)
        arrives = sampled & (top.factor > 0)
        met = arrives & above.is_valid() & scene.is_surface(above.shape)
        # Beyond the end of the surface mesh a flat sea replaces it, to estimate the loss.
        lost = arrives & ~above.is_valid() & (top.ray.d.z > 0)
        distance = dr.select(lost, dr.maximum(-top.ray.o.z, 0) / top.ray.d.z, to_surface)
        crossed = top.optical_depth + self._optical_depth(top.ray.o, top.ray.d, distance, met | lost)
        clear = share * dr.exp(-crossed)
        if self._absorption is None:
            own = pdf * clear
        else:
            sampled_depth = self._sampled_depth(top.ray.o, top.ray.d, distance, met | lost)
            own = pdf * share * dr.exp(top.absorption_depth - top.optical_depth - sampled_depth)
        combined = density + own
        connected = value * clear / combined * top.factor
        factor = dr.select(met, connected, self._own_weight(path, transmittance))
        crossing = dr.select(met, above, si)
        direct = vertex.at_sea | (vertex.on_solid & ~vertex.in_water)
        radiance, air_length = light.connect(crossing, emitter, met | direct)
        skipped = path.optical_length(dr.dot(ray.o - path.point, up), scene.index_layers)
        in_water = skipped + top.optical_length + to_surface * opaque(scene.group_index)
        water_length = dr.select(met, in_water, 0)
        energy = light.weight * path.throughput * factor * radiance
        if self.options.complement_only:
            energy = dr.select(self._merged(path, vertex, first), 0, energy)
        # One ray along the path, one up to the surface, one to the emitter.
        path.rays += dr.select(path.active, mi.UInt32(1), 0) + dr.select(sampled, mi.UInt32(1), 0)
        path.rays += dr.select(met | direct, mi.UInt32(1), 0)
        sums = joined(self._step.perturbed_connection(path, vertex, event, up, met), top.sums)
        sums = scene.perturbations.along(sums, -top.ray.o.z, -top.ray.d.z, to_surface, met)
        sums = light.perturbed(sums, crossing.p, crossing, met | direct)
        light.receive(path, path.length + water_length + air_length, energy, radiance > 0, vertex.on_solid, sums)
        light.reflect(path, si, rng, vertex.at_sea & ~vertex.in_water)
        # For the loss, the sampled direction's density replaces the density of the surface's BSDF.
        share = light.weight * path.throughput * connected * density
        light.lose(emitter, dr.select(lost, share, 0), top.ray(distance))

    def _connect_straight(
        self, path: ConnectedPath, vertex: Vertex, event: ScatteringEvent, emitter: EmitterDirection, first: mi.Bool
    ) -> None:
        """Connect scattering events and surfaces to an emitter under water by straight lines."""
        light = self.light
        direction, irradiance, event_length = light.connect_event(path.point, vertex.scattered)
        value, _ = self._evaluate(emitter, vertex, event, vertex.scattered, direction)
        radiance, length = light.connect(vertex.si, emitter, vertex.on_surface)
        radiance = dr.select(vertex.scattered, value * irradiance, radiance)
        length = dr.select(vertex.scattered, event_length, length)
        energy = light.weight * path.throughput * radiance
        if self.options.complement_only:
            energy = dr.select(self._merged(path, vertex, first), 0, energy)
        path.rays += dr.select(path.active, mi.UInt32(2), 0)
        sums = self._step.perturbed_connection(path, vertex, event, direction, vertex.scattered)
        sums = light.perturbed(sums, path.point, vertex.si, vertex.on_surface)
        light.receive(path, path.length + length, energy, radiance > 0, vertex.on_solid, sums)

    def _merged(self, path: ConnectedPath, vertex: Vertex, first: mi.Bool) -> mi.Bool:
        """Return whether ``lidar_merging`` finds the connections of a vertex by merging."""
        submerged = vertex.scattered if self.options.connects_solids else vertex.submerged
        seen_through = submerged | (vertex.at_sea & (path.scatterings > 0))
        return (first & vertex.on_surface) | (path.before_first_solid & seen_through)

    def _optical_depth(self, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float, active: mi.Bool) -> mi.Float:
        """Return the optical depth of segments in water, 0 for inactive lanes."""
        if self.scene.water is None:
            return mi.Float(0)
        return dr.select(active, self.scene.water.optical_depth(point, direction, length), 0)

    def _sampled_depth(self, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float, active: mi.Bool) -> mi.Float:
        """Return the optical depth from which paths draw the events on segments in water, 0 for inactive lanes."""
        depth = self._optical_depth(point, direction, length, active)
        if self._absorption is None:
            return depth
        return depth - dr.select(active, self._absorption.optical_depth(-point.z, -direction.z, length), 0)

    def _guiding_probability(self, vertex: Vertex, emitter: EmitterDirection) -> mi.Float | float:
        """Return the probability of the lobe towards the emitter.

        Solids with their own probability multiply it by the light share from the emitter that is scattered above them:
        connections find the unscattered light.
        """
        on_solids, water = self.options.solid_guiding_probability, self.scene.water
        if on_solids is None or water is None:
            return self.options.guiding_probability
        depth, up = dr.maximum(-vertex.si.p.z, 0), emitter.in_water.z
        scattered = 1 - dr.exp(-water.scattering_flight.optical_depth(depth, -up, depth / up))
        return dr.select(vertex.scattered, mi.Float(self.options.guiding_probability), on_solids * scattered)

    def _by_lobe(self, vertex: Vertex, formula: Callable[[mi.Float, float], mi.Float], value: mi.Float) -> mi.Float:
        """Return a formula's result for a value and the asymmetry of the lobe towards the emitter."""
        broad = formula(value, _GUIDING_ASYMMETRY)
        if self.options.solid_guiding_probability is None:
            return broad
        return dr.select(vertex.scattered, broad, formula(value, _SOLID_GUIDING_ASYMMETRY))

    def _evaluate(
        self, emitter: EmitterDirection, vertex: Vertex, event: ScatteringEvent, active: mi.Bool, direction: mi.Vector3f
    ) -> tuple[mi.Float, mi.Float]:
        """Return phase function, or BSDF times cosine, of a direction and the density with which paths draw it."""
        value, pdf = mi.Float(0), mi.Float(0)
        probability, si = self._guiding_probability(vertex, emitter), vertex.si
        guided = self._by_lobe(vertex, henyey_greenstein, dr.dot(direction, emitter.in_water))
        if event.phase is not None:
            at_event = vertex.scattered & active
            context = mi.PhaseFunctionContext()
            phase_value, phase_pdf = event.phase.eval_pdf(context, event.interaction, direction, at_event)
            value = dr.select(at_event, phase_value[0], 0)
            pdf = dr.select(at_event, dr.lerp(phase_pdf, guided, probability), 0)
        on_solid = active & ~vertex.scattered
        at_place, local = self.scene.on_shapes(si), si.to_local(direction)
        solid_value, solid_pdf = si.bsdf().eval_pdf(mi.BSDFContext(), at_place, local, on_solid)
        solid_pdf = dr.select(vertex.is_rough, dr.lerp(solid_pdf, guided, probability), solid_pdf)
        return dr.select(on_solid, solid_value[0], value), dr.select(on_solid, solid_pdf, pdf)

    def _own_weight(self, path: ConnectedPath, transmittance: mi.Float) -> mi.Float:
        """Return the weight of a connection made by the path's own sampling, against the sampled connection."""
        if not self.options.samples_emitter:
            return mi.Float(1)
        return dr.select(path.emitter_ratio > 0, transmittance / (transmittance + path.emitter_ratio), 1)

    def _redirect(
        self, path: ConnectedPath, rng: mi.PCG32, vertex: Vertex, event: ScatteringEvent, emitter: EmitterDirection
    ) -> mi.Bool:
        """Draw the next direction; at scattering events and rough solids under water, some of them near the emitter.

        Return whether paths pass a solid unchanged.
        """
        probability, si = self._guiding_probability(vertex, emitter), vertex.si
        pick, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        submerged = vertex.submerged
        mixed = vertex.scattered | (submerged & vertex.on_surface & vertex.is_rough)
        guided = pick < probability
        # The random number is rescaled and reused by the phase function and the BSDF.
        rest = dr.clip((pick - probability) / (1 - probability), 0, 1)
        u_bsdf = dr.select(mixed, rest, pick)
        at_place = self.scene.on_shapes(si)
        bs, bsdf_weight = si.bsdf().sample(self._step.context, at_place, u_bsdf, u, vertex.on_surface)
        direction, pdf = si.to_world(bs.wo), bs.pdf
        factor = dr.select(vertex.on_surface, bsdf_weight[0], 1)
        if event.phase is not None:
            context = mi.PhaseFunctionContext()
            natural, _, _ = event.phase.sample(context, event.interaction, rest, u, vertex.scattered)
            natural = dr.select(vertex.scattered, natural, direction)
            cosine = self._by_lobe(vertex, sample_henyey_greenstein, u.x)
            towards = deflect(mi.Frame3f(emitter.in_water), 0.5 * (1 - cosine), dr.two_pi * u.y)
            drawn = dr.select(guided, towards, natural)
            value, mixed_pdf = self._evaluate(emitter, vertex, event, mixed, drawn)
            direction = dr.select(mixed, dr.normalize(drawn), direction)
            pdf = dr.select(mixed, mixed_pdf, pdf)
            factor = dr.select(mixed, value / mixed_pdf, factor)
        specular = vertex.on_surface & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        passes = ~mixed & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        if self.options.complement_only and not self.options.connects_solids:
            # Merging also finds the rest of the path, unless it can meet a mirror or a solid in the air first.
            path.active &= ~(path.before_first_solid & vertex.on_solid & ~passes & submerged & ~specular)
            if not self.scene.has_specular_or_dry_solids:
                path.active &= ~(path.before_first_solid & vertex.scattered)
        turned = (vertex.on_surface | vertex.scattered) & ~passes
        sampler_pdf = self.light.sampler.pdf_in_layer(emitter, direction, path.index_layer)
        ratio = dr.select(submerged & ~specular & (pdf > 0), sampler_pdf / pdf, 0)
        passed = path.emitter_ratio / dr.select(passes, bs.pdf, 1)
        path.emitter_ratio = dr.select(turned, ratio, passed)
        self._step.perturb(path, vertex, event, direction, passes)
        self._step.redirect(path, vertex, direction, factor, bs, passes)
        path.solid = dr.select(path.before_first_solid, mi.UInt32(0), path.solid)
        path.specular = dr.select(turned, specular, path.specular)
        reflected = vertex.at_sea & ~vertex.in_water & ~path.in_water
        path.reflected_by_sea = dr.select(turned, reflected, path.reflected_by_sea)
        return passes

    def _roulette(self, path: ConnectedPath, rng: mi.PCG32, emitter: EmitterDirection) -> None:
        """End paths that are expected to find little light at random, and compensate in the others."""
        expected = path.throughput
        if self.options.expects_emitter:
            # The lobe over its mean: paths guided to the emitter have little throughput and find much light.
            lobe = 4 * np.pi * henyey_greenstein(dr.dot(path.direction, emitter.in_water), _GUIDING_ASYMMETRY)
            expected = dr.select(path.in_water, expected * (_DIFFUSE_RADIANCE + lobe), expected)
        survival = dr.minimum(expected / max(self.options.roulette_threshold, 1e-30), 1)
        path.active &= rng.next_float32() < survival
        path.throughput = dr.select(path.active, path.throughput / survival, path.throughput)


def trace_connected(
    scene: LidarScene,
    sampler: SensorSampler,
    options: VolpathOptions,
    received: ReceivedLight,
    shots: Shots,
    paths: int,
) -> None:
    """Trace a number of paths from the receiver for each shot, connect them to the laser, and add their light."""
    require_memory(f"{shots.count * paths} paths", BYTES_PER_PATH * shots.count * paths, "take fewer paths_per_pass")
    lanes = shots.paths(paths)
    scene, rng = lanes.pick(scene), shots.streams(_STREAM, lanes)
    start = sampler.sample_shots(lanes, paths, rng)
    found = start.weight > 0
    path = ConnectedPath.start(scene, scene.receiver_pose, start.angles, mi.Float(1), found, pixel=start.pixel)
    light = LaserLight(scene, received, start.weight)
    received.rays += PathTracer(scene, options, light).trace(path, rng)


class VolpathRenderer(PassRenderer):
    """Renders passes with the path tracer."""

    def __init__(self, scene: LidarScene, classes: PathClasses, paths: int, options: VolpathOptions) -> None:
        super().__init__(scene, classes, paths)
        self.options = options

    def trace(self, received: ReceivedLight, shots: Shots, paths: int) -> None:
        """Trace paths and connect them to the laser."""
        trace_connected(self.scene, self.sampler, self.options, received, shots, paths)
