"""Light paths, and one path step, shared by all integrators: flight, and change of medium and direction."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.medium.free_flight import LayeredFlight
from mitransient_lidar.transport.medium.tabulated_phase import NumberedPhase
from mitransient_lidar.transport.medium.water import IndexLayers, coinciding
from mitransient_lidar.transport.perturbations import Sums
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.scene import WaterScene
from mitransient_lidar.transport.solids import met_shape

NO_SURFACE = 1e9  #: Surface length of paths that have not met the sea first [m].


@dataclass(kw_only=True)
class PathPoint:
    """A point on a path from the receiver or from the laser, with the numbers of the path's part up to it."""

    #: Position [m], and unit direction in which the path passes it.
    point: mi.Point3f = field(default_factory=lambda: mi.Point3f(0))
    direction: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    #: Optical length up to it [m]: distance times group index, summed over the segments, minus the distance from the
    #: start to the scene's reference point (`RelativePose`).
    length: mi.Float = field(default_factory=lambda: mi.Float(0))
    #: Product of the part's factors, 0 or more: light energy from the laser [J]; for paths from the receiver, received
    #: energy per radiance at their end [m^2 sr]. At points along segments, times track length [m].
    throughput: mi.Float = field(default_factory=lambda: mi.Float(0))
    #: Whether the part has entered the water outside the surface mesh, as if the sea were level there: its complete
    #: paths measure the loss, and are not received.
    lost: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    sums: Sums = field(default_factory=list)  #: Sums of the `Perturbations` along the part.
    pixel: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))  #: Pixel of the path; 0 for light from the laser.
    #: Number of scattering events in the water, and of changes between going down and going up.
    scatterings: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    reversals: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    #: Optical length from the start, by the path's first point on the sea, to the other end [m], as `length`; far
    #: beyond any record if its first segment has ended elsewhere.
    surface_length: mi.Float = field(default_factory=lambda: mi.Float(NO_SURFACE))
    #: Sum of the densities, up to a common factor, with which the part's merges and connections make the same path.
    #: With the scattering coefficient b [1/m] and the phase function p [1/sr] at events, it is V / (b p) for a merge in
    #: cells with volume V. For a connection over the distance d with the scattering transmittance T, it is d^2 / (T b p
    #: b' p') times a rate.
    mis_partial_sum: mi.Float = field(default_factory=lambda: mi.Float(0))
    #: Reciprocal of the density, per volume, with which the last scattering event sends paths to the point [m^3]: 1 /
    #: (b p) times its squared distance, divided by the scattering transmittance on the way; 0 if the segment starts
    #: elsewhere.
    inverse_density: mi.Float = field(default_factory=lambda: mi.Float(0))

    @property
    def depth(self) -> mi.Float:
        """Depth below the mean sea level [m]."""
        return -self.point.z

    @property
    def downward(self) -> mi.Float:
        """Vertical component of the direction, positive downwards."""
        return -self.direction.z

    @property
    def unscattered(self) -> mi.Bool:
        """Whether no event in the water has scattered the path of a random walk: its sum has no terms."""
        return self.mis_partial_sum == 0


@dataclass(kw_only=True)
class Path(PathPoint):
    """A path up to its last vertex, which is offset from surfaces against self-intersection."""

    in_water: mi.Bool  #: Whether the next segment lies in water.
    at_start: mi.Bool = field(default_factory=lambda: mi.Bool(True))  #: Whether the next segment is the first one.
    #: Index layer of the next segment, if it lies in water.
    index_layer: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))
    #: Whether the path has met no solid (bottom or target) yet.
    before_first_solid: mi.Bool = field(default_factory=lambda: mi.Bool(True))
    rays: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))  #: Number of rays traced so far, for the benchmark.
    active: mi.Bool  #: Whether the path continues.

    @classmethod
    def start(
        cls,
        scene: WaterScene,
        pose: KernelPose,
        angles: mi.Point2f,
        throughput: mi.Float,
        active: mi.Bool,
        **fields: Any,
    ) -> Self:
        """Return paths that start from a pose at tangent-plane angles, with further fields."""
        direction = pose.direction(angles.x, angles.y)
        point, length = scene.first_points(pose, angles, direction)
        return cls(
            point=point,
            direction=direction,
            length=length,
            throughput=throughput,
            sums=scene.perturbations.start(),
            in_water=mi.Bool(pose.submerged),
            active=active,
            **fields,
        )

    def ray(self) -> mi.Ray3f:
        """Return the next segment as a ray."""
        return mi.Ray3f(self.point, self.direction)

    def optical_length(self, distance: mi.Float, index_layers: IndexLayers | None) -> mi.Float:
        """Return the optical length of a distance along the next segment [m]."""
        group = mi.Float(1) if index_layers is None else index_layers.group(self.index_layer)
        return distance * dr.select(self.in_water, group, 1)


@dataclass(kw_only=True)
class ConnectedPath(Path):
    """A path whose vertices are connected to an emitter."""

    #: Density of the sampled connection over the path's own sampling density, for the direction of the next segment; 0
    #: where no connection was sampled.
    emitter_ratio: mi.Float = field(default_factory=lambda: mi.Float(0))
    #: Whether the next segment has the one direction that a mirror or a smooth interface allows, or starts at the
    #: receiver: the last vertex could not be connected.
    specular: mi.Bool = field(default_factory=lambda: mi.Bool(True))
    #: Whether the next segment was reflected by the dry side of the sea surface.
    reflected_by_sea: mi.Bool = field(default_factory=lambda: mi.Bool(False))
    #: Number of the first solid met, as `PathClasses.solid`.
    solid: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))


@dataclass
class Vertex:
    """Segment end."""

    si: mi.SurfaceInteraction3f  #: Ray intersection, valid or not.
    reach: mi.Float  #: Distance to the surface or to the boundary of index layers, whichever is nearer [m].
    length: mi.Float  #: Segment length [m]: `reach`, or less up to a scattering event.
    scattered: mi.Bool  #: Whether the segment ends with a scattering event.
    at_boundary: mi.Bool  #: Whether it ends at an index layer boundary.
    outside: mi.Bool  #: Whether it ends where it enters the water outside the surface mesh.
    in_water: mi.Bool  #: Whether the segment lies in water.
    #: Whether it ends on the sea surface, or on a solid; set by `PathStep.arrive`.
    at_sea: mi.Bool
    on_solid: mi.Bool

    @property
    def exists(self) -> mi.Bool:
        """Whether the segment ends anywhere."""
        return self.scattered | self.at_boundary | self.outside | self.si.is_valid()

    @property
    def on_surface(self) -> mi.Bool:
        """Whether the segment ends on the sea surface or on a solid."""
        return self.at_sea | self.on_solid

    @property
    def submerged(self) -> mi.Bool:
        """Whether it lies under water: a scattering event, or a place on a solid."""
        return self.scattered | (self.on_solid & self.in_water)

    @property
    def is_rough(self) -> mi.Bool:
        """Whether its surface has no mirror-like part, so that any direction can be drawn and weighted."""
        return ~mi.has_flag(self.si.bsdf().flags(), mi.BSDFFlags.Delta)


@dataclass
class ScatteringEvent:
    """A scattering event: interaction, phase function (None without water), and number of the scatterer."""

    interaction: mi.MediumInteraction3f
    phase: mi.PhaseFunctionPtr | NumberedPhase
    scatterer: mi.UInt32


def interaction_at(point: mi.Point3f, direction: mi.Vector3f) -> mi.MediumInteraction3f:
    """Return interactions in the water at points that paths reach in a direction."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi = point, -direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    return mei


class PathStep:
    """Path steps through sea surface, water and solids.

    `flight`: free flight from which the distances to scattering events are drawn; None without water. `mode`:
    ``Radiance`` for paths from the receiver, ``Importance`` for light.
    """

    def __init__(self, scene: WaterScene, flight: LayeredFlight | None, mode: mi.TransportMode) -> None:
        self.scene, self.flight = scene, flight
        self.context = mi.BSDFContext(mode)
        self.adjoint = mode == mi.TransportMode.Importance

    def next_vertex(self, path: Path, rng: mi.PCG32) -> Vertex:
        """Return where the next segment ends: at a scattering event, a boundary of index layers, or a surface."""
        scene, no = self.scene, mi.Bool(False)
        in_water = mi.Bool(path.in_water)
        if scene.water is None or self.flight is None:
            si = scene.ray_intersect(path.ray(), path.active)
            return Vertex(si, si.t, si.t, no, no, no, in_water, no, no)
        wet = path.active & path.in_water
        distance = scene.water.free_flight(self.flight, path.point, path.direction, rng)
        end = dr.fma(path.direction.z, distance, path.point.z)
        empty = wet & scene.is_empty(path.point.z) & scene.is_empty(end)
        si = scene.ray_intersect(path.ray(), path.active & ~empty)
        reach, at_boundary = mi.Float(si.t), no
        layers = scene.water.index_layers
        if layers.count > 1:
            to_boundary = layers.to_boundary(path.depth, path.downward, path.index_layer, wet)
            # A solid in the boundary plane is met first from both sides: a path that begins there stays in its layer.
            same = (reach - to_boundary) * dr.abs(path.downward) < coinciding(reach)
            at_boundary = (to_boundary < reach) & ~same
            reach = dr.select(at_boundary, to_boundary, reach)
        scattered = wet & (distance < reach)
        length = dr.select(scattered, distance, reach)
        return Vertex(si, reach, length, scattered, at_boundary & ~scattered, no, in_water, no, no)

    def arrive(self, path: Path, vertex: Vertex) -> None:
        """Move paths to their next vertices and classify these; paths that pass outside the surface mesh end."""
        free = vertex.scattered | vertex.at_boundary | vertex.outside
        # On surfaces the intersection is more accurate than distance times direction.
        point = dr.select(free, path.point + path.direction * vertex.length, vertex.si.p)
        path.length += dr.select(path.active, path.optical_length(vertex.length, self.scene.index_layers), 0)
        path.point = dr.select(path.active, point, path.point)
        path.at_start &= ~path.active
        path.active &= ~self.scene.outside_surface(path.point.z, vertex.in_water)
        vertex.scattered &= path.active
        vertex.at_boundary &= path.active
        met = path.active & ~(vertex.scattered | vertex.at_boundary | vertex.outside)
        vertex.at_sea = met & self.scene.is_surface(vertex.si.shape)
        vertex.on_solid = met & ~vertex.at_sea

    def scattering_event(self, path: Path, scattered: mi.Bool, rng: mi.PCG32) -> ScatteringEvent:
        """Return the scattering event at the last vertex of paths."""
        mei = interaction_at(path.point, path.direction)
        mei.t = dr.select(scattered, mi.Float(1), dr.inf)
        water = self.scene.water
        if water is None or self.flight is None:
            return ScatteringEvent(mei, None, mi.UInt32(0))
        scatterer = water.scatterer_at(self.flight, path.point, rng)
        return ScatteringEvent(mei, water.phases.at(scatterer), scatterer)

    def redirect(
        self, path: Path, vertex: Vertex, direction: mi.Vector3f, factor: mi.Float, bs: mi.BSDFSample3f, passes: mi.Bool
    ) -> None:
        """Continue paths from a scattering event or a surface in a new direction.

        Paths end where `factor` of the throughput is 0. The sample `bs` from the surface's BSDF decides on which side
        of the sea surface a path continues; `passes` is whether a path crosses a solid unchanged (null interface).
        """
        path.throughput *= dr.select(path.active, factor, 1)
        path.active &= path.throughput > 0
        path.before_first_solid &= ~(vertex.on_solid & ~passes)
        path.in_water = dr.select(vertex.at_sea, bs.wo.z < 0, path.in_water)
        # The next segment begins beside the surface, 0.1 mm or more beyond the vertex.
        start = self.scene.spawn_ray(vertex.si, direction).o
        skipped = path.optical_length(dr.dot(start - vertex.si.p, direction), self.scene.index_layers)
        path.length += dr.select(vertex.on_surface & path.active, skipped, 0)
        path.point = dr.select(vertex.on_surface, start, path.point)
        before = mi.Float(path.direction.z)
        turned = path.active & (vertex.on_surface | vertex.scattered)
        path.direction = dr.select(turned, direction, path.direction)
        path.reversals += dr.select(path.active & (before * path.direction.z < 0), mi.UInt32(1), 0)

    def perturb(
        self, path: Path, vertex: Vertex, event: ScatteringEvent, direction: mi.Vector3f, passes: mi.Bool
    ) -> None:
        """Add the perturbations at the last vertices of paths that continue in a direction."""
        path.sums = self._sums_at_event(path, vertex.scattered, event, direction)
        path.sums = self.scene.perturbations.at_solid(path.sums, met_shape(vertex.si), vertex.on_solid & ~passes)
        path.sums = self.scene.perturbations.at_sea(path.sums, vertex.si, vertex.si.to_local(direction), vertex.at_sea)

    def perturbed_connection(
        self, path: Path, vertex: Vertex, event: ScatteringEvent, direction: mi.Vector3f, active: mi.Bool
    ) -> Sums:
        """Return the sums of paths with the last vertex connected in a direction where active."""
        sums = self._sums_at_event(path, vertex.scattered & active, event, direction)
        return self.scene.perturbations.at_solid(sums, met_shape(vertex.si), vertex.on_solid)

    def _sums_at_event(self, path: Path, active: mi.Bool, event: ScatteringEvent, direction: mi.Vector3f) -> Sums:
        if self.scene.water is not None and self.scene.perturbations.count:
            active = active & self.scene.water.is_water(event.scatterer)
        return self.scene.perturbations.at_event(path.sums, path.depth, path.direction, direction, active=active)

    def cross_boundary(self, path: Path, at_boundary: mi.Bool) -> None:
        """Refract paths at a boundary of index layers, or reflect them totally."""
        layers = self.scene.index_layers
        if layers is None or layers.count == 1:
            return
        beyond = dr.select(path.downward > 0, path.index_layer + 1, path.index_layer - 1)
        direction, ratio, passes = layers.refract(path.direction, path.index_layer, beyond, at_boundary)
        mirrored = mi.Vector3f(path.direction.x, path.direction.y, -path.direction.z)
        path.direction = dr.select(at_boundary, dr.select(passes, direction, mirrored), path.direction)
        path.reversals += dr.select(at_boundary & ~passes, mi.UInt32(1), 0)
        path.index_layer = dr.select(at_boundary & passes, beyond, path.index_layer)
        # Radiance scales with the square of the refractive index; energy does not.
        if not self.adjoint:
            path.throughput *= dr.select(at_boundary & passes, ratio * ratio, 1)
