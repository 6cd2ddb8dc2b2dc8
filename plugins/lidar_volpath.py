"""Integrator plugin ``lidar_volpath``: unidirectional, transient, unbiased."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.checks import in_range, whole
from mitransient_lidar.transport.connection import (
    ConnectedPath,
    SourceDirection,
    SourceLobe,
    SurfaceLobe,
    Turn,
    laser_through,
    start_path,
)
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.path import advance, count_turns, optical_length
from mitransient_lidar.transport.phase import deflect, henyey_greenstein, sample_henyey_greenstein
from mitransient_lidar.transport.receiving import ViewSampler
from mitransient_lidar.transport.sorting import MOST_ORDERS, receive
from mitransient_lidar.transport.strata import ascend
from mitransient_lidar.transport.streams import pass_streams
from mitransient_lidar.transport.system import LidarScene, WaterScene
from mitransient_lidar.transport.walk import scattering_event

#: Asymmetry of the broad lobe towards the laser from which a share of the turns is drawn. Of asymmetries 0.7 to 0.95
#: with shares 0.1 to 0.55 this one, with the default share, served clear and turbid water best.
TURN_ASYMMETRY = 0.87

#: Number of this integrator's random streams within a pass.
_STREAM = 3

_CONNECTIONS = ("combined", "lobe", "walk")


class LidarVolpath(mi.CppADIntegrator):
    r"""Transient volumetric path tracer with surface connection (``lidar_volpath``).

    =====================  =======  ====================================================================================
    Parameter              Type     Meaning
    =====================  =======  ====================================================================================
    paths_per_pass       integer  Paths of one pass, 1024 to 2^28, unless the sample count per pixel (``spp``) is given
                                    to ``mi.render``. Default: 262144
    max_scatterings        integer  Largest number of scattering events in the water, -1 for any. Default: -1
    roulette_threshold     float    Throughput below which Russian roulette begins, 0 to 1. A path that has
                                    turned carries little throughput and much signal, so this is low. Default: 0.001
    turn_share             float    Share of scattering events, and of hits of rough solids under water, whose direction
                                    is drawn from a broad lobe towards the laser instead of the phase function or
                                    BSDF, 0 to 0.99: every echo needs one large-angle turn, which is rare by nature.
                                    Default: 0.4
    connection             string   How vertices under water reach the laser: ``combined``, or for checks only
                                    ``lobe`` or ``walk``. Default: ``combined``
    unmerged               boolean  Whether to leave out what ``lidar_merging`` finds by merging: echoes of one vertex
                                    in the air, all paths that scatter in the water and meet no solid, and those whose
                                    first solid is under water and not a mirror. Default: false
    =====================  =======  ====================================================================================

    The unbiased reference. Paths start at the receiver, cross the surface (waves and ripples), scatter to any order,
    meet bottom and targets, and are reflected inside the surface. A point laser cannot be met by chance through a
    refracting surface, so each vertex under water proposes directions from the lobe in which the laser appears through
    a flat sea of the same total slope variance, traces one to the real surface, and connects there; where the walk
    itself reaches the surface unscattered it connects, too. Both estimate the same paths and are combined by the
    balance heuristic (Veach and Guibas 1995, doi:10.1145/218380.218498).

    Every leg is timed with the group index of the medium that it crosses.

    .. code-block:: xml

        <integrator type="lidar_volpath">
            <integer name="paths_per_pass" value="262144"/>
        </integrator>

    .. code-block:: python

        {'type': 'lidar_volpath', 'paths_per_pass': 262144}
    """

    #: Name under which results record the integrator.
    plugin = "lidar_volpath"

    #: Value of ``turn_share`` where none is given.
    default_turn_share = 0.4

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.paths_per_pass = whole("paths_per_pass", props.get("paths_per_pass", 2**18), 1024, 2**28)
        self.max_scatterings = whole("max_scatterings", props.get("max_scatterings", -1), -1, 2**30)
        self.roulette_threshold = in_range("roulette_threshold", props.get("roulette_threshold", 0.001), 0.0, 1.0)
        self.turn_share = in_range("turn_share", props.get("turn_share", self.default_turn_share), 0.0, 0.99)
        self.connection = props.get("connection", "combined")
        if self.connection not in _CONNECTIONS:
            raise ValueError(f"connection = {self.connection!r} must be one of {', '.join(_CONNECTIONS)}")
        #: Orders of scattering that are told apart, 0 for none.
        self.orders = 0
        self.unmerged = bool(props.get("unmerged", False))
        #: Energy [J] that the last pass would have received, had the surface patch not ended.
        self.lost = mi.Float64(0)
        #: Number of rays that the last pass traced.
        self.rays = mi.Float64(0)
        self._prepared: tuple[mi.Scene, mi.Sensor, LidarScene, ViewSampler] | None = None

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor) -> tuple[LidarScene, ViewSampler]:
        """Find and check the parts of a scene; done once for a scene and sensor."""
        if self._prepared is None or self._prepared[0] is not scene or self._prepared[1] is not sensor:
            system = LidarScene.from_scene(scene, sensor, self.orders)
            self._prepared = scene, sensor, system, ViewSampler(system.receiver, system.transmitter)
        return self._prepared[2], self._prepared[3]

    def sort_by_order(self, orders: int) -> None:
        """Tell this many orders of scattering apart, 0 to 62 (0: none): see `scattering_orders`."""
        self._prepared = None
        self.orders = whole("orders", orders, 0, MOST_ORDERS)

    def release(self) -> None:
        """Forget the scene, which holds this integrator and could otherwise never be freed."""
        self._prepared = None

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
            Whether to return the energies instead of leaving them in the film.
        evaluate
            Whether to compute now.

        Returns
        -------
        TensorXf
            Received energy [J], shape (pixel, time) or (row, column, time).
        """
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        system, view = self.prepare(scene, sensor)
        count = spp * system.receiver.pixels.count if spp > 0 else self.paths_per_pass
        system.prepare_film()
        self.lost = dr.zeros(mi.Float64, 1)
        with dr.suspend_grad():
            self.sample(system, view, count, int(np.array(seed).item()))
        if evaluate:
            system.film.schedule_storage()
            dr.eval(self.lost, self.rays)
        return system.film.develop() if develop else mi.TensorXf()

    def sample(self, system: LidarScene, view: ViewSampler, count: int, seed: int) -> None:
        """Trace `count` paths from the receiver and add what they find to the film."""
        rng = pass_streams(seed, _STREAM, count)
        start = view.sample(dr.arange(mi.UInt32, count), count, rng)
        path = start_path(system.receiver.pose, start.direction, start.weight > 0)
        self._trace(system, SurfaceLobe(system), path, rng, start.pixel, start.weight)

    def _trace(
        self,
        system: WaterScene,
        lobe: SourceLobe,
        path: ConnectedPath,
        rng: mi.PCG32,
        pixel: mi.UInt32,
        weight: mi.Float,
    ) -> None:
        """Follow paths to their ends; what they find counts for their pixels with their weights."""

        def body(path: ConnectedPath, rng: mi.PCG32) -> tuple[ConnectedPath, mi.PCG32]:
            self._step(system, lobe, path, rng, pixel, weight)
            return path, rng

        path, _ = dr.while_loop((path, rng), lambda path, rng: path.active, body, label="lidar_volpath")
        self.rays = dr.sum(mi.Float64(path.rays))

    def _step(
        self,
        system: WaterScene,
        lobe: SourceLobe,
        path: ConnectedPath,
        rng: mi.PCG32,
        pixel: mi.UInt32,
        weight: mi.Float,
    ) -> None:
        """Go to the next vertex, connect it to the source, and choose the direction in which the path goes on."""
        # Advance to whichever comes first, a scattering event or a surface.
        first = path.length == 0
        si = system.scene.ray_intersect(path.ray(), path.active)
        scattered, at_edge, distance, transmittance = self._fly(system, path, si, rng)
        met_nothing = path.active & ~(scattered | at_edge | si.is_valid())
        self._escape(path, met_nothing, pixel, weight)
        path.active &= ~met_nothing
        in_leg = mi.Bool(path.in_water)
        free = scattered | at_edge
        advance(path, system, distance, dr.select(free, path.point + path.direction * distance, si.p))
        # Light that has passed beside the surface patch is lost.
        path.active &= ~system.beside_surface(path.point.z, in_leg)
        path.scatterings += dr.select(scattered, mi.UInt32(1), 0)
        if self.max_scatterings >= 0:
            path.active &= path.scatterings <= self.max_scatterings

        # What happens here: scattering, a solid, or the sea surface.
        scattered &= path.active
        at_edge &= path.active
        hit = path.active & ~(scattered | at_edge)
        at_sea = hit & system.is_surface(si.shape)
        submerged = scattered | (hit & in_leg & ~at_sea)
        flight = system.water.flight if system.water is not None else None
        mei, phase, scatterer = scattering_event(system, path, flight, scattered, rng)
        if system.water is not None:
            path.throughput *= dr.select(scattered, system.water.albedo(scatterer), 1)
        merged = self._merged(path, first, scattered, hit, submerged, at_sea)

        # Connect: from under water through the surface, from the surface and from solids in the air directly.
        source = lobe.towards_source(path.point)
        up, lobe_pdf = lobe.sample(source, mi.Point2f(rng.next_float32(), rng.next_float32()))
        up, lobe_pdf = lobe.below(up, lobe_pdf, path.stratum)
        tried = submerged & (lobe_pdf > 0) if self.connection != "walk" else mi.Bool(False)
        turn = self._turn(source, si, mei, phase, scattered, tried, up)
        ascent = ascend(system, dr.select(scattered, mi.Ray3f(path.point, up), si.spawn_ray(up)), path.stratum, tried)
        above = system.scene.ray_intersect(ascent.ray, tried)
        risen = tried & (ascent.factor > 0)
        met = risen & above.is_valid() & system.is_surface(above.shape)
        # Where the surface patch has ended, a flat sea stands in for it in the account of what is lost.
        lost = risen & ~above.is_valid() & (ascent.ray.d.z > 0)
        leg = dr.select(lost, dr.maximum(-ascent.ray.o.z, 0) / ascent.ray.d.z, above.t)
        crossed = ascent.optical_depth + self._optical_depth(system, ascent.ray.o, ascent.ray.d, leg, met | lost)
        clear = dr.exp(-crossed)
        combined = lobe_pdf + (turn.pdf * clear if self.connection == "combined" else 0)
        connected = turn.value * clear / combined * ascent.factor
        factor = dr.select(met, connected, self._walk_weight(path, transmittance))
        crossing = dr.select(met, above, si)
        direct = hit & (at_sea | ~in_leg)
        radiance, air_length = self._light(system, source, crossing, met | direct)
        water_length = dr.select(met, ascent.optical_length + optical_length(system, above.t, True), 0)
        energy = dr.select(merged, 0, weight * path.throughput * factor * radiance)
        # One ray along the path, one up to the surface, one to the source.
        path.rays += dr.select(path.active, mi.UInt32(1), 0) + dr.select(tried, mi.UInt32(1), 0)
        path.rays += dr.select(met | direct, mi.UInt32(1), 0)
        self._receive(system, path, pixel, path.length + water_length + air_length, energy, radiance > 0)
        self._connect_more(system, path, si, at_sea & ~in_leg, pixel, weight, rng)
        # The lobe's own density stands for the surface's in what is lost.
        lobe_share = weight * path.throughput * connected * lobe_pdf
        self._account(system, source, dr.select(lost, lobe_share, 0), ascent.ray(leg))

        # Choose the next direction.
        self._turn_path(system, lobe, source, path, si, mei, phase, scattered, submerged, at_sea, hit & ~at_sea, rng)
        if system.strata is not None and system.strata.count > 1:
            path.lobe_ratio = dr.select(at_edge, path.lobe_ratio / transmittance, path.lobe_ratio)
            system.strata.bend(path, at_edge & path.active, radiance=True)
        path.active &= self._is_useful(system, lobe, path)
        self._roulette(path, rng)

    def _light(
        self, system: LidarScene, source: SourceDirection, crossing: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Connect points in the air or on the surface to the source: radiance, and optical length of the way [m]."""
        return laser_through(system, crossing, active)

    def _receive(
        self,
        system: LidarScene,
        path: ConnectedPath,
        pixel: mi.UInt32,
        length: mi.Float,
        energy: mi.Float,
        active: mi.Bool,
    ) -> None:
        """Record light that has come along a path of an optical length [m]."""
        # On to the laser the path goes up: from a vertex where it came down it turns.
        turns = path.turns + dr.select(path.downward > 0, mi.UInt32(1), 0)
        receive(system, pixel, path.scatterings, turns, length, energy, active)

    def _escape(self, path: ConnectedPath, active: mi.Bool, pixel: mi.UInt32, weight: mi.Float) -> None:
        """Serve paths that meet nothing any more: no laser is there."""

    def _connect_more(
        self,
        system: WaterScene,
        path: ConnectedPath,
        si: mi.SurfaceInteraction3f,
        at_dry_sea: mi.Bool,
        pixel: mi.UInt32,
        weight: mi.Float,
        rng: mi.PCG32,
    ) -> None:
        """Connect points on the sea's dry side to other sources: there are none."""

    def _is_useful(self, system: LidarScene, lobe: SurfaceLobe, path: ConnectedPath) -> mi.Bool:
        """Return which paths can still find light: beyond the film's end nothing can arrive any more."""
        return path.length + dr.norm(lobe.laser - path.point) < system.film.path_end

    def _merged(
        self,
        path: ConnectedPath,
        first: mi.Bool,
        scattered: mi.Bool,
        hit: mi.Bool,
        submerged: mi.Bool,
        at_sea: mi.Bool,
    ) -> mi.Bool:
        """Return whether the connections at this vertex are left to ``lidar_merging``."""
        if not self.unmerged:
            return mi.Bool(False)
        return (first & hit) | (path.pristine & (submerged | (at_sea & (path.scatterings > 0))))

    def _fly(
        self, system: WaterScene, path: ConnectedPath, si: mi.SurfaceInteraction3f, rng: mi.PCG32
    ) -> tuple[mi.Bool, mi.Bool, mi.Float, mi.Float]:
        """Return how far the path goes, and the transmittance of that leg to the next surface or edge.

        Before these: whether it scatters before, and whether it comes to the edge of its stratum.
        """
        if system.water is None:
            return mi.Bool(False), mi.Bool(False), si.t, mi.Float(1)
        wet = path.active & path.in_water
        distance = system.water.free_flight(system.water.flight, path, rng)
        longest = mi.Float(si.t)
        at_edge = mi.Bool(False)
        if system.strata.count > 1:
            to_edge = system.strata.to_edge(path, wet)
            at_edge = to_edge < longest
            longest = dr.minimum(longest, to_edge)
        scattered = wet & (distance < longest)
        to_end = self._optical_depth(system, path.point, path.direction, longest, wet & (si.is_valid() | at_edge))
        return scattered, at_edge & ~scattered, dr.select(scattered, distance, longest), dr.exp(-to_end)

    @staticmethod
    def _optical_depth(
        system: WaterScene, point: mi.Point3f, direction: mi.Vector3f, length: mi.Float, active: mi.Bool
    ) -> mi.Float:
        """Return the optical depth of a leg in water, 0 for inactive lanes."""
        if system.water is None:
            return mi.Float(0)
        return dr.select(active, system.water.optical_depth(point, direction, length), 0)

    def _turn(
        self,
        source: SourceDirection,
        si: mi.SurfaceInteraction3f,
        mei: mi.MediumInteraction3f,
        phase: object,
        scattered: mi.Bool,
        active: mi.Bool,
        direction: mi.Vector3f,
    ) -> Turn:
        """Return value and density of a direction at a scattering event or a solid."""
        value, pdf = mi.Float(0), mi.Float(0)
        if phase is not None:
            at_event = scattered & active
            phase_value, phase_pdf = phase.eval_pdf(mi.PhaseFunctionContext(), mei, direction, at_event)
            broad = henyey_greenstein(dr.dot(direction, source.in_water), TURN_ASYMMETRY)
            value = dr.select(at_event, phase_value[0], 0)
            pdf = dr.select(at_event, dr.lerp(phase_pdf, broad, self.turn_share), 0)
        at_solid = active & ~scattered
        solid_value, solid_pdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(direction), at_solid)
        broad = henyey_greenstein(dr.dot(direction, source.in_water), TURN_ASYMMETRY)
        solid_pdf = dr.select(self._is_rough(si), dr.lerp(solid_pdf, broad, self.turn_share), solid_pdf)
        return Turn(dr.select(at_solid, solid_value[0], value), dr.select(at_solid, solid_pdf, pdf))

    @staticmethod
    def _is_rough(si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Return whether a surface has no mirror-like part, so that any direction can be drawn and weighted."""
        return ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)

    def _walk_weight(self, path: ConnectedPath, transmittance: mi.Float) -> mi.Float:
        """Return the weight of a connection that the walk made: balance heuristic against the lobe."""
        if self.connection == "walk":
            return mi.Float(1)
        if self.connection == "lobe":
            return dr.select(path.lobe_ratio > 0, mi.Float(0), 1)
        return dr.select(path.lobe_ratio > 0, transmittance / (transmittance + path.lobe_ratio), 1)

    def _account(
        self,
        system: LidarScene,
        source: SourceDirection,
        lobe_share: mi.Float,
        crossing: mi.Point3f,
    ) -> None:
        """Estimate what would have arrived had the surface not ended.

        Where a connection misses the surface its light is taken as if it had crossed a flat one at normal incidence.
        """
        offset = opaque_point(system.transmitter.pose.origin) - crossing
        index = float(system.refractive_index)
        transmittance = 4 * index / (1 + index) ** 2
        through = transmittance * source.in_air.z / source.in_water.z
        missing = lobe_share * through * system.transmitter.intensity(-dr.normalize(offset)) / dr.squared_norm(offset)
        dr.scatter_add(self.lost, mi.Float64(missing), mi.UInt32(0), missing > 0)

    def _turn_path(
        self,
        system: WaterScene,
        lobe: SourceLobe,
        source: SourceDirection,
        path: ConnectedPath,
        si: mi.SurfaceInteraction3f,
        mei: mi.MediumInteraction3f,
        phase: object,
        scattered: mi.Bool,
        submerged: mi.Bool,
        at_sea: mi.Bool,
        solid: mi.Bool,
        rng: mi.PCG32,
    ) -> mi.Bool:
        """Draw the direction in which the path goes on, and update throughput, medium and lobe ratio.

        Return where a surface has given it the one direction that a mirror or a smooth interface allows.
        """
        pick, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        at_surface = at_sea | solid
        # Scattering events and rough solids under water: a share of the directions is drawn towards the laser.
        mixed = scattered | (submerged & at_surface & self._is_rough(si))
        broadly = pick < self.turn_share
        # Rescaled, the number that picks the lobe serves the phase function and the solid, too.
        rest = dr.clip((pick - self.turn_share) / (1 - self.turn_share), 0, 1)
        bs, bsdf_weight = si.bsdf().sample(mi.BSDFContext(), si, dr.select(mixed, rest, pick), u, at_surface)
        direction, pdf = si.to_world(bs.wo), bs.pdf
        factor = dr.select(at_surface, bsdf_weight[0], 1)
        if phase is not None:
            natural, _, _ = phase.sample(mi.PhaseFunctionContext(), mei, rest, u, scattered)
            natural = dr.select(scattered, natural, direction)
            cosine = sample_henyey_greenstein(u.x, TURN_ASYMMETRY)
            broad = deflect(mi.Frame3f(source.in_water), 0.5 * (1 - cosine), dr.two_pi * u.y)
            drawn = dr.select(broadly, broad, natural)
            turn = self._turn(source, si, mei, phase, scattered, mixed, drawn)
            direction = dr.select(mixed, dr.normalize(drawn), direction)
            pdf = dr.select(mixed, turn.pdf, pdf)
            factor = dr.select(mixed, turn.value / turn.pdf, factor)
        delta = at_surface & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        met = at_surface & ~at_sea & ~(~mixed & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null))
        if self.unmerged:
            # Whatever follows is merged, too, unless a mirror or a solid in the air can still come in between.
            path.active &= ~(path.pristine & met & submerged & ~delta)
            if not system.has_unmerged_solids:
                path.active &= ~(path.pristine & scattered)
        path.pristine &= ~met
        ratio = dr.select(submerged & ~delta & (pdf > 0), lobe.pdf_below(source, direction, path.stratum) / pdf, 0)
        path.lobe_ratio = dr.select(at_surface | scattered, ratio, path.lobe_ratio)
        path.in_water = dr.select(at_sea, bs.wo.z < 0, path.in_water)
        path.throughput *= dr.select(path.active, factor, 1)
        path.active &= path.throughput > 0
        path.point = dr.select(at_surface, si.spawn_ray(direction).o, path.point)
        before = mi.Float(path.direction.z)
        path.direction = dr.select(path.active & (at_surface | scattered), direction, path.direction)
        count_turns(path, before)
        return delta

    def _roulette(self, path: ConnectedPath, rng: mi.PCG32) -> None:
        """End paths of little throughput at random, and give their share to the ones that go on."""
        survival = dr.minimum(path.throughput / max(self.roulette_threshold, 1e-30), 1)
        path.active &= rng.next_float32() < survival
        path.throughput = dr.select(path.active, path.throughput / survival, path.throughput)

    def to_string(self) -> str:
        """Return a description."""
        return f"LidarVolpath[paths_per_pass={self.paths_per_pass}, connection={self.connection}]"


mi.register_integrator("lidar_volpath", lambda props: LidarVolpath(props))
