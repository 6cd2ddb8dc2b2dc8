"""The natural random walk of light through sea surface and water, from the laser or from the receiver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.flight import LayeredFlight
from mitransient_lidar.transport.opaque import opaque_point
from mitransient_lidar.transport.path import Path, advance, count_turns
from mitransient_lidar.transport.pose import Pose
from mitransient_lidar.transport.strata import Strata
from mitransient_lidar.transport.system import LidarScene, WaterScene
from mitransient_lidar.transport.tracks import Tracks


@dataclass
class WalkPath(Path):
    """A path that remembers where else it could have been merged.

    Attributes
    ----------
    competition
        Sum over the path's scattering events of 1 / (b p): the inverse of the scattering coefficient [1/m] times the
        phase function [1/sr]. It is the density, up to a common factor, with which the same path would have arisen
        from a merge at that event.
    pristine
        Whether the path has met no solid yet.
    virtual
        Whether it has passed beside the surface patch, and goes on as if the sea did not end there: such paths tell
        what is lost.
    offset
        Distance from the last vertex to the next point of the path's track [m].
    """

    competition: mi.Float
    pristine: mi.Bool
    virtual: mi.Bool
    offset: mi.Float

    @property
    def weight(self) -> mi.Float:
        """Throughput, negative for virtual paths."""
        return dr.select(self.virtual, -self.throughput, self.throughput)


def start_walk(pose: Pose, direction: mi.Vector3f, throughput: mi.Float, offset: mi.Float) -> WalkPath:
    """Return paths at their start in the air: directions, throughputs (0: none) and offsets of their first points."""
    return WalkPath(
        point=opaque_point(pose.origin),
        direction=direction,
        in_water=mi.Bool(False),
        length=mi.Float(0),
        throughput=throughput,
        scatterings=mi.UInt32(0),
        turns=mi.UInt32(0),
        stratum=mi.UInt32(0),
        rays=mi.UInt32(0),
        active=(throughput > 0) & dr.full(mi.Bool, True, dr.width(direction)),
        competition=mi.Float(0),
        pristine=mi.Bool(True),
        virtual=mi.Bool(False),
        offset=offset,
    )


#: Called where paths have met something: paths, interaction, which lanes.
Action = Callable[[WalkPath, mi.SurfaceInteraction3f, mi.Bool], None]


def scattering_event(
    system: WaterScene, path: Path, flight: LayeredFlight | None, scattered: mi.Bool, rng: mi.PCG32
) -> tuple[mi.MediumInteraction3f, Any, mi.UInt32]:
    """Return the interaction, the phase function (None without water) and the scatterer that paths have met.

    `flight` is what their flights were drawn from.
    """
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p = path.point
    mei.wi = -path.direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.t = dr.select(scattered, mi.Float(1), dr.inf)
    if system.water is None:
        return mei, None, mi.UInt32(0)
    scatterer = system.water.scatterer_at(flight, path.point, rng)
    return mei, system.water.phases.at(scatterer), scatterer


class Walk:
    """Walks by the phase function and the BSDFs alone, and records legs in the water.

    Flights are drawn from the scattering coefficient; absorption is a weight. So as many walks reach the bottom of
    absorbing water as its top, with weights that fall smoothly.

    Parameters
    ----------
    system
        The lidar scene; it has water.
    mode
        ``Importance`` for light from the laser, ``Radiance`` for paths from the receiver.
    destination
        Where the light has to go at last: paths that cannot get there before the record ends are given up.
    """

    def __init__(self, system: LidarScene, mode: mi.TransportMode, destination: Pose) -> None:
        self.system = system
        water: Any = system.water
        self._water = water
        self._strata: Strata = water.strata
        self.context = mi.BSDFContext(mode)
        self.adjoint = mode == mi.TransportMode.Importance
        self.destination = opaque_point(destination.origin)

    def run(
        self,
        path: WalkPath,
        rng: mi.PCG32,
        label: mi.UInt32,
        tracks: Tracks,
        *,
        at_solid: Action,
        at_first: Action | None = None,
        past_solids: bool,
    ) -> WalkPath:
        """Walk until all paths have ended.

        Parameters
        ----------
        path, rng
            Paths at their start, and their random numbers.
        label
            What to remember with each path's legs.
        tracks
            Takes the legs in the water, up to the first solid.
        at_solid
            What to do where a path meets a solid under water.
        at_first
            What to do where a path ends its first leg.
        past_solids
            Whether paths go on beyond the first solid.
        """

        def body(path: WalkPath, rng: mi.PCG32) -> tuple[WalkPath, mi.PCG32]:
            first, wet = path.length == 0, path.active & path.in_water
            si, scattered, beside, at_edge, length = self._fly(path, rng, first, wet)
            useful = dr.minimum(length, self._longest(path))
            path.offset = tracks.add(path, useful, label, wet & path.active & path.pristine)
            self._arrive(path, si, scattered | beside | at_edge, length, wet)
            if at_first is not None:
                at_first(path, si, first & path.active & ~beside)
            met = path.active & ~(scattered | beside | at_edge)
            at_sea = met & self.system.is_surface(si.shape)
            solid = met & ~at_sea
            at_solid(path, si, solid & wet)
            self._turn(path, rng, si, scattered & path.active, at_sea, solid)
            self._enter_beside(path, beside)
            if self._strata.count > 1:
                self._strata.bend(path, at_edge & path.active, radiance=not self.adjoint)
            if not past_solids:
                path.active &= path.pristine
            away = dr.norm(self.destination - path.point)
            path.active &= path.length + away < self.system.film.path_end
            return path, rng

        path, _ = dr.while_loop((path, rng), lambda path, rng: path.active, body, label="walk")
        return path

    def _fly(
        self, path: WalkPath, rng: mi.PCG32, first: mi.Bool, wet: mi.Bool
    ) -> tuple[mi.SurfaceInteraction3f, mi.Bool, mi.Bool, mi.Bool, mi.Float]:
        """Return what the path would meet, and how far it goes.

        Between these: whether it scatters before, passes beside the sea, or comes to the edge of its stratum.
        """
        si = self.system.scene.ray_intersect(path.ray(), path.active)
        path.rays += dr.select(path.active, mi.UInt32(1), 0)
        distance = self._water.free_flight(self._water.scattering_flight, path, rng)
        scattered = wet & (distance < si.t)
        at_edge = mi.Bool(False)
        if self._strata.count > 1:
            to_edge = self._strata.to_edge(path, wet)
            at_edge = to_edge < dr.minimum(distance, si.t)
            scattered &= ~at_edge
        beside = path.active & first & (path.downward > 0)
        beside &= ~si.is_valid() | self.system.beside_surface(si.p.z, mi.Bool(False))
        path.active &= scattered | beside | at_edge | si.is_valid()
        length = dr.select(beside, -path.depth / path.downward, dr.select(scattered, distance, si.t))
        if self._strata.count > 1:
            length = dr.select(at_edge, to_edge, length)
        return si, scattered & path.active, beside, at_edge, length

    def _longest(self, path: WalkPath) -> mi.Float:
        """Return how far the next leg in water can go before its light comes too late for the record [m].

        What is left to the destination falls at most by the leg's component towards it.
        """
        away = self.destination - path.point
        distance = dr.norm(away)
        spare = self.system.film.path_end - path.length - distance
        return spare / (self._strata.group(path.stratum) - dr.dot(away, path.direction) / distance)

    def _arrive(
        self, path: WalkPath, si: mi.SurfaceInteraction3f, free: mi.Bool, length: mi.Float, wet: mi.Bool
    ) -> None:
        """Move the path to the end of its leg, which is `free` or on a surface, and absorb on the way."""
        absorbed = self._water.absorption_flight.optical_depth(path.depth, path.downward, length)
        path.throughput *= dr.select(wet, dr.exp(-absorbed), 1)
        advance(path, self.system, length, dr.select(free, path.point + path.direction * length, si.p))
        # Light that has passed beside the surface patch is lost.
        path.active &= ~self.system.beside_surface(path.point.z, wet)

    def _turn(
        self,
        path: WalkPath,
        rng: mi.PCG32,
        si: mi.SurfaceInteraction3f,
        scattered: mi.Bool,
        at_sea: mi.Bool,
        solid: mi.Bool,
    ) -> None:
        """Draw the direction in which the path goes on."""
        pick, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        at_surface = at_sea | solid
        bs, bsdf_weight = si.bsdf().sample(self.context, si, pick, u, at_surface)
        flight = self._water.scattering_flight
        mei, phase, scatterer = scattering_event(self.system, path, flight, scattered, rng)
        natural, weight, pdf = phase.sample(mi.PhaseFunctionContext(), mei, pick, u, scattered)
        # The sum runs over what the film would see: scattering coefficient times value of the phase function.
        likely = self._water.coefficient(flight, scatterer) * weight[0] * pdf
        path.competition += dr.select(scattered, dr.rcp(likely), 0)
        path.scatterings += dr.select(scattered, mi.UInt32(1), 0)
        direction = dr.select(scattered, dr.normalize(natural), si.to_world(bs.wo))
        factor = dr.select(scattered, weight[0], dr.select(at_surface, bsdf_weight[0], 1))
        if self.adjoint:
            factor *= dr.select(at_surface, _shading_correction(si, path.direction, direction), 1)
        # At solids little light goes on: give its weight to a few.
        survival = dr.select(solid, dr.minimum(factor, 1), 1)
        path.active &= (factor > 0) & (rng.next_float32() < survival)
        path.throughput *= dr.select(path.active, factor / survival, 1)
        # Light that a solid lets pass unchanged has not met it.
        path.pristine &= ~(solid & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null))
        path.in_water = dr.select(at_sea, bs.wo.z < 0, path.in_water)
        path.point = dr.select(at_surface, si.spawn_ray(direction).o, path.point)
        before = mi.Float(path.direction.z)
        path.direction = dr.select(path.active & (at_surface | scattered), direction, path.direction)
        count_turns(path, before)

    def _enter_beside(self, path: WalkPath, beside: mi.Bool) -> None:
        """Let paths that pass beside the surface patch enter still water, to learn what is lost there."""
        index = float(self.system.refractive_index)
        across = mi.Vector2f(path.direction.x, path.direction.y) / index
        entered = mi.Vector3f(across.x, across.y, -dr.safe_sqrt(1 - dr.squared_norm(across)))
        path.direction = dr.select(beside, entered, path.direction)
        path.throughput *= dr.select(beside, 4 * index / (1 + index) ** 2, 1)
        path.in_water |= beside
        path.virtual |= beside


def _shading_correction(si: mi.SurfaceInteraction3f, incoming: mi.Vector3f, outgoing: mi.Vector3f) -> mi.Float:
    """Return the factor by which light differs from importance at interpolated normals.

    Veach 1997, section 5.3 (thesis, Stanford University): the cosines of light are those of the true surface.
    """
    shading = dr.abs(dr.dot(incoming, si.sh_frame.n) * dr.dot(outgoing, si.n))
    true = dr.abs(dr.dot(incoming, si.n) * dr.dot(outgoing, si.sh_frame.n))
    return dr.select(true > 0, shading / true, 0)
