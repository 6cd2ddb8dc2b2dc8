"""Merging of laser light with receiver paths, in cells in the water and on patches of solids."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.cells import WaterCells
from mitransient_lidar.transport.merging.patches import SolidPatches, foreshortening
from mitransient_lidar.transport.merging.photon_map import PhotonMap
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells
from mitransient_lidar.transport.paths.passes import ReceivedLight
from mitransient_lidar.transport.paths.path import PathPoint, interaction_at
from mitransient_lidar.transport.paths.random_walk import Action, RandomWalkPath
from mitransient_lidar.transport.paths.ripple_focusing import Echo
from mitransient_lidar.transport.perturbations import Sums, joined
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import met_shape


def merge_in_water(
    scene: LidarScene,
    received: ReceivedLight,
    points: PathPoint,
    cells: WaterCells | SphericalCells,
    photons: PhotonMap,
    connections: mi.Float,
) -> None:
    """Merge points on the receiver's paths with the light in their cells.

    A point represents a track with length s and throughput beta, a photon one with length s' and energy w. With the
    cell's volume V each pair adds beta s w s' / V times scattering coefficient and phase function. The weight is among
    all merges and `connections`, a share of all pairs, that make the same path; water and bubbles make different paths.
    """
    water, perturbations = scene.required_water, scene.perturbations
    cell = cells.locate(points.point)
    mei = interaction_at(points.point, points.direction)
    layer = water.flight.layer_at(-points.point.z)
    scatterers = [(water.phases.at(layer), water.scattering_flight.coefficient(layer))]
    if water.plume is not None:
        scatterers.append((water.plume_phase, water.plume.scattering_at(points.point)))
    absorption = water.absorption_flight.coefficient(layer)
    group = water.index_layers.group(water.index_layers.at(-points.point.z))
    first, end = photons.find(cell.bucket, mi.Bool(True))
    typical = cells.typical_volume(points.point)
    weight = points.throughput * typical / cell.volume
    weight_of_unscattered = points.throughput * typical / cell.volume_of_unscattered

    def merge(index: mi.UInt32) -> tuple[mi.UInt32]:
        active = index < end
        photon, tag, position = photons.photon(index, active)
        active &= tag == cell.tag
        shared, shares = mi.Float(0), []
        for phase, scattering in scatterers:
            value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, -photon.direction, active)
            own = (typical + connections * (points.inverse_density + photon.inverse_density)) / (scattering * value[0])
            shares.append(dr.rcp(own + points.mis_partial_sum + photon.mis_partial_sum))
            shared += shares[-1]
        # The photon continues to the plane through the point normal to its direction, so that times do not blur.
        beyond = dr.dot(points.point, photon.direction) - position
        factor = dr.select(photon.unscattered, weight_of_unscattered, weight)
        energy = factor * photon.throughput * shared * dr.exp(-absorption * beyond)
        length = points.length + photon.length + beyond * group
        by_water = None if len(scatterers) == 1 else shares[0] / shared
        depth, light = -points.point.z, -photon.direction
        sums = perturbations.about(joined(points.sums, photon.sums), depth, beyond)
        sums = perturbations.at_event(sums, depth, points.direction, light, by_water)
        receive(received, points, photon, 1, length, energy, active, sums)
        return (index + 1,)

    dr.while_loop((first,), lambda index: index < end, merge, label="merge in the water")


def merge_on_solids(
    patches: SolidPatches,
    received: ReceivedLight,
    photons: PhotonMap | None,
    connections: mi.Float,
    rng: mi.PCG32,
) -> Action:
    """Return the action that merges the receiver's paths with the light on the solids that they meet.

    A path with throughput beta and a photon with energy w on a patch with area A add beta w / A times the BSDF, and
    times the ratio of the foreshortening at both points. They are weighted against `connections`, a share of all pairs,
    that make the same path.
    """

    def merge(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        if photons is None:
            return
        patch, random = patches.locate(si), mi.PCG32(rng)
        first, end = photons.find(patch.bucket, active)
        shape = met_shape(si)
        solid, sums = received.classes.solid(shape), received.histogram.perturbations.at_solid(path.sums, shape)
        covered = patches.inverse_share(patch, shape, random, active & (first < end))
        weight = path.throughput * covered / patch.area
        typical, at_place = patches.typical_area(si), patches.scene.on_shapes(si)
        connection = connections * path.inverse_density / dr.abs(dr.dot(si.n, path.direction))

        def add(index: mi.UInt32) -> tuple[mi.UInt32]:
            within = index < end
            photon, tag, connectable = photons.photon(index, within)
            within &= tag == patch.tag
            outgoing = si.to_local(-photon.direction)
            # Mitsuba's BSDFs include the cosine to the shading normal. The photon's energy per area includes the true
            # surface's cosine, which is divided out.
            cosine = dr.abs(dr.dot(si.n, photon.direction))
            bsdf = si.bsdf().eval(mi.BSDFContext(), at_place, outgoing, within)[0] / cosine
            connected = dr.select(connectable > 0, connection, 0)
            share = typical / (connected + typical)
            energy = weight * photon.throughput * foreshortening(cosine, patch.cosine) * bsdf * share
            lit, length = within & (bsdf > 0), path.length + photon.length
            receive(received, path, photon, 0, length, energy, lit, joined(sums, photon.sums), solid)
            return (index + 1,)

        dr.while_loop((first,), lambda index: index < end, add, label="merge on solids")

    return merge


def receive(
    received: ReceivedLight,
    point: PathPoint,
    light: PathPoint,
    events: int,
    length: mi.Float,
    energy: mi.Float,
    active: mi.Bool,
    sums: Sums,
    solid: mi.UInt32 | None = None,
    between: Sequence[mi.Vector3f] = (),
) -> None:
    """Add the light on complete paths, each from a receiver part up to a point and a laser part.

    The parts meet with a number of scattering `events`, or on the `solid` with a number; `between` are the directions
    of segments between them. `sums` are the perturbation sums of the complete paths. Paths with a lost part are lost.
    """
    lost = point.lost | light.lost
    order, reversals = point.scatterings + events + light.scatterings, point.reversals
    if received.classes.by_order:
        # Light continues against the directions of the receiver's part.
        course = [point.direction.z, *(direction.z for direction in between), -light.direction.z]
        for here, following in pairwise(course):
            reversals = reversals + dr.select(here * following < 0, mi.UInt32(1), 0)
        reversals = reversals + light.reversals
    echo, number = Echo(point.surface_length, solid is not None), mi.UInt32(0) if solid is None else solid
    received.receive(point.pixel, order, reversals, number, length, energy, active & ~lost, echo, sums)
    received.histogram.lose(energy, active & lost)
