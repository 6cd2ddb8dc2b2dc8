"""Random walk of light through sea surface and water, from the laser or from the receiver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.medium.water import refract_level
from mitransient_lidar.transport.opaque import opaque
from mitransient_lidar.transport.paths.path import Path, PathStep, Vertex
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene import LidarScene

#: Smallest distance to the destination [m], against division by zero where paths start there.
_SMALLEST_DISTANCE = 1e-9


@dataclass(kw_only=True)
class RandomWalkPath(Path):
    """A random-walk path; `inverse_density` belongs to the end of its last segment."""

    #: Number of the path, and of its points in the water so far.
    lane: mi.UInt32
    points: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    #: 1 / (b p) of the last vertex [m sr] if it is a scattering event in the water, else 0 (see `mis_partial_sum`).
    inverse_scattering_density: mi.Float = field(default_factory=lambda: mi.Float(0))
    offset: mi.Float  #: Distance from the last vertex to the next point along the path [m].

    @classmethod
    def walking(
        cls, scene: LidarScene, pose: KernelPose, angles: mi.Point2f, throughput: mi.Float, offset: mi.Float
    ) -> Self:
        """Return paths from laser or receiver at tangent-plane angles, without those whose throughput is 0."""
        count = dr.width(angles)
        active = (throughput > 0) & dr.full(mi.Bool, True, count)
        return cls.start(scene, pose, angles, throughput, active, lane=dr.arange(mi.UInt32, count), offset=offset)


class Segments(Protocol):
    """Store of the segments in the water, up to the first solid."""

    def add(self, path: Any, length: mi.Float, active: mi.Bool) -> mi.Float:
        """Store each path's next segment and return the offset of the first point beyond its end [m]."""


#: Callback at solids and at first hits: paths, interaction, active lanes.
Action = Callable[[RandomWalkPath, mi.SurfaceInteraction3f, mi.Bool], None]


class EstimateRates(Protocol):
    """Rates with which different estimates find the same path."""

    @property
    def in_water(self) -> mi.Float:
        """Rate of connections between two scattering events."""

    def volume(self, point: mi.Point3f) -> mi.Float:
        """Return the merge rate at scattering events [m^3]."""


class RandomWalk:
    """Random walk that draws directions from phase functions and BSDFs alone, and stores its segments in the water.

    Free flights are drawn from the scattering coefficient, and absorption is a weight, so that absorption does not end
    paths before the bottom.

    `scene`: scene with water. `mode`: ``Importance`` for light from the laser, ``Radiance`` for paths from the
    receiver. `destination`: receiver pose for light, laser pose for paths from the receiver. `path_end`: optical path
    length at which the record ends [m]: paths that cannot arrive before end. `rates`: rates of the estimates at
    scattering events; without them `mis_partial_sum` stays 0.
    """

    def __init__(
        self,
        scene: LidarScene,
        mode: mi.TransportMode,
        destination: KernelPose,
        path_end: float,
        rates: EstimateRates | None = None,
    ) -> None:
        self.scene, self._rates = scene, rates
        self._water, self._path_end = scene.required_water, opaque(path_end - scene.reference_length)
        self._step = PathStep(scene, self._water.scattering_flight, mode)
        self._destination, self._to_go = destination.point, scene.relative(destination)

    def run(
        self,
        path: RandomWalkPath,
        rng: mi.PCG32,
        segments: Segments,
        *,
        on_solid: Action,
        on_first_hit: Action | None = None,
        past_solids: bool,
    ) -> RandomWalkPath:
        """Walk until all paths have ended.

        `on_solid` is called where a path meets a solid under water. `on_first_hit` is called where its first segment
        ends on the sea or on a solid in the air. `past_solids` is whether paths continue beyond the first solid.
        """
        step, perturbations = self._step, self.scene.perturbations

        def body(path: RandomWalkPath, rng: mi.PCG32) -> tuple[RandomWalkPath, mi.PCG32]:
            first, wet = mi.Bool(path.at_start), path.active & path.in_water
            vertex = step.next_vertex(path, rng)
            path.rays += dr.select(path.active, mi.UInt32(1), 0)
            self._end_outside(path, vertex, first)
            path.active &= vertex.exists
            in_record = dr.minimum(vertex.length, self._longest(path))
            path.offset = segments.add(path, in_record, wet & path.active & path.before_first_solid)
            absorption = self._water.absorption_flight.optical_depth(path.depth, path.downward, vertex.length)
            path.throughput *= dr.select(wet, dr.exp(-absorption), 1)
            path.sums = perturbations.along(path.sums, path.depth, path.downward, vertex.length, wet & path.active)
            depth = self._water.scattering_flight.optical_depth(path.depth, path.downward, vertex.length)
            inverse = path.inverse_scattering_density
            path.inverse_density = dr.select(inverse > 0, inverse * dr.square(vertex.length) * dr.exp(depth), 0)
            step.arrive(path, vertex)
            by_surface = path.length + self._to_go.distance(path.point)
            path.surface_length = dr.select(first & vertex.at_sea, by_surface, path.surface_length)
            if on_first_hit is not None:
                on_first_hit(path, vertex.si, first & (vertex.at_sea | (vertex.on_solid & ~wet)))
            hit = vertex.on_solid & wet
            # Most segments end in the water: the action is skipped where no path of a packet meets a solid.
            dr.if_stmt((path, vertex.si, hit), hit, on_solid, lambda *_: None, label="solid")
            self._redirect(path, rng, vertex)
            self._enter_outside(path, vertex.outside)
            step.cross_boundary(path, vertex.at_boundary & path.active)
            if not past_solids:
                path.active &= path.before_first_solid
            path.active &= path.length + self._to_go.distance(path.point) < self._path_end
            return path, rng

        path, _ = dr.while_loop((path, rng), lambda path, rng: path.active, body, label="random walk")
        return path

    def _end_outside(self, path: RandomWalkPath, vertex: Vertex, first: mi.Bool) -> None:
        """End the first segment of paths that miss the surface mesh at the mean sea level."""
        outside = path.active & first & ~path.in_water & (path.downward > 0)
        outside &= ~vertex.si.is_valid() | self.scene.outside_surface(vertex.si.p.z, mi.Bool(False))
        vertex.outside = outside
        vertex.length = dr.select(outside, -path.depth / path.downward, vertex.length)

    def _longest(self, path: RandomWalkPath) -> mi.Float:
        """Return the length of the next segment in water beyond which its light arrives after the record [m]."""
        # The remaining distance to the destination decreases at most by the segment's component towards it.
        away = self._destination - path.point
        distance = dr.maximum(dr.norm(away), _SMALLEST_DISTANCE)
        spare = self._path_end - path.length - self._to_go.distance(path.point)
        return spare / (self._water.index_layers.group(path.index_layer) - dr.dot(away, path.direction) / distance)

    def _redirect(self, path: RandomWalkPath, rng: mi.PCG32, vertex: Vertex) -> None:
        """Draw the next direction."""
        step, si = self._step, vertex.si
        pick, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        bs, bsdf_weight = si.bsdf().sample(step.context, self.scene.on_shapes(si), pick, u, vertex.on_surface)
        event = step.scattering_event(path, vertex.scattered, rng)
        context = mi.PhaseFunctionContext()
        natural, weight, pdf = event.phase.sample(context, event.interaction, pick, u, vertex.scattered)
        b_p = self._water.coefficient(self._water.scattering_flight, event.scatterer, path.point) * weight[0] * pdf
        inverse = dr.select(vertex.scattered, dr.rcp(b_p), 0)
        if self._rates is not None:
            connections = self._rates.in_water * path.inverse_density
            path.mis_partial_sum += inverse * (self._rates.volume(path.point) + connections)
        path.inverse_scattering_density = inverse
        path.scatterings += dr.select(vertex.scattered, mi.UInt32(1), 0)
        direction = dr.select(vertex.scattered, dr.normalize(natural), si.to_world(bs.wo))
        factor = dr.select(vertex.scattered, weight[0], dr.select(vertex.on_surface, bsdf_weight[0], 1))
        if step.adjoint:
            factor *= dr.select(vertex.on_surface, _shading_correction(si, path.direction, direction), 1)
        # Russian roulette at solids, which reflect little light.
        survival = dr.select(vertex.on_solid, dr.minimum(factor, 1), 1)
        path.active &= (factor > 0) & (rng.next_float32() < survival)
        passes = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        step.perturb(path, vertex, event, direction, passes)
        step.redirect(path, vertex, direction, factor / survival, bs, passes)

    def _enter_outside(self, path: RandomWalkPath, outside: mi.Bool) -> None:
        """Refract paths outside the surface mesh into level water, to measure the loss."""
        index = opaque(self.scene.refractive_index)
        entered, _ = refract_level(path.direction, 1 / index)
        path.direction = dr.select(outside, entered, path.direction)
        path.throughput *= dr.select(outside, 4 * index / (1 + index) ** 2, 1)
        path.in_water |= outside
        path.lost |= outside


def _shading_correction(si: mi.SurfaceInteraction3f, incoming: mi.Vector3f, outgoing: mi.Vector3f) -> mi.Float:
    """Return the factor by which light differs from importance at interpolated normals.

    Veach 1997, section 5.3 (thesis, Stanford University): light has the cosines to the true surface.
    """
    shading = dr.abs(dr.dot(incoming, si.sh_frame.n) * dr.dot(outgoing, si.n))
    true = dr.abs(dr.dot(incoming, si.n) * dr.dot(outgoing, si.sh_frame.n))
    return dr.select(true > 0, shading / true, 0)
