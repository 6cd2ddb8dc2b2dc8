"""Merging of light from the laser with paths from the receiver, in cells of water and on patches of solids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.cells import WaterCells
from mitransient_lidar.transport.merging.patches import SolidPatches
from mitransient_lidar.transport.merging.photon_map import Photon, PhotonMap
from mitransient_lidar.transport.merging.segments import SegmentBuffer, SegmentPoints
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells
from mitransient_lidar.transport.passes import PassRecord
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.perturbations import Sums, joined
from mitransient_lidar.transport.random_walk import Action, RandomWalkPath
from mitransient_lidar.transport.ripple_focusing import Echo
from mitransient_lidar.transport.rng import Shots
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.solids import met_shape


def store_points(
    segments: SegmentBuffer,
    count: int,
    cells: WaterCells | SphericalCells,
    classes: PathClasses,
    shots: Shots,
    most: int,
) -> PhotonMap | None:
    """Store the `count` points of light paths by their cells, `most` of full ones; return None if there are none."""
    if count == 0:
        return None
    index = dr.arange(mi.UInt32, count)
    cells = cells.of(segments.lanes(index))
    points = segments.points(index)
    bucket = cells.locate(points.point, points.direction, points.unscattered).bucket
    u = segments.random(index, shots)
    kept = classes.labels_orders, len(points.contribution.sums)
    photons = PhotonMap(shots.count << cells.grid.bits, bucket, u, most, *kept)
    # Computed again, which costs less than keeping the points.
    points = segments.points(index)
    tag = cells.locate(points.point, points.direction, points.unscattered).tag
    position = dr.dot(points.point, points.direction)
    photon = Photon(
        points.direction,
        points.length,
        points.contribution,
        points.mis_partial_sum,
        position,
        points.inverse_density,
        mi.Bool(False),
        points.label,
    )
    photons.fill(photon, tag)
    return photons


def merge_in_water(
    scene: LidarScene,
    record: PassRecord,
    points: SegmentPoints,
    cells: WaterCells | SphericalCells,
    photons: PhotonMap,
    connections: mi.Float,
) -> None:
    """Merge points of the receiver's paths with the light in their cells.

    A point represents a track of length s and throughput beta, a photon one of length s' and energy w. With the cell's
    volume V each pair adds beta s w s' / V times scattering coefficient and phase function, weighted among all merges
    and `connections`, a share of all pairs, that make the same path; water and bubbles make different paths.
    """
    water, perturbations = scene.required_water, scene.perturbations
    cell = cells.locate(points.point)
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi = points.point, -points.direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    layer = water.flight.layer_at(-points.point.z)
    scatterers = [(water.phases.at(layer), water.scattering_flight.coefficient(layer))]
    if water.plume is not None:
        scatterers.append((water.plume_phase, water.plume.scattering_at(points.point)))
    absorption = water.absorption_flight.coefficient(layer)
    group = water.index_layers.group(water.index_layers.at(-points.point.z))
    subpath = SensorSubpath.at(record, points, mi.UInt32(0))
    first, end = photons.find(cell.bucket, mi.Bool(True))
    typical = cells.typical_volume(points.point)
    throughput, sums_before = points.contribution.throughput, points.contribution.sums
    weight = throughput * typical / cell.volume
    weight_of_unscattered = throughput * typical / cell.volume_of_unscattered

    def merge(index: mi.UInt32) -> tuple[mi.UInt32]:
        active = index < end
        photon, tag = photons.photon(index, active)
        active &= tag == cell.tag
        shared, shares = mi.Float(0), []
        for phase, scattering in scatterers:
            value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, -photon.direction, active)
            own = (typical + connections * (points.inverse_density + photon.inverse_density)) / (scattering * value[0])
            shares.append(dr.rcp(own + points.mis_partial_sum + photon.mis_partial_sum))
            shared += shares[-1]
        # The photon continues to the plane through the point normal to its direction, so that times do not blur.
        beyond = dr.dot(points.point, photon.direction) - photon.position
        factor = dr.select(photon.unscattered, weight_of_unscattered, weight)
        energy = factor * photon.contribution.throughput * shared * dr.exp(-absorption * beyond)
        length = points.length + photon.length + beyond * group
        by_water = None if len(scatterers) == 1 else shares[0] / shared
        depth, light = -points.point.z, -photon.direction
        sums = perturbations.about(joined(sums_before, photon.contribution.sums), depth, beyond)
        sums = perturbations.at_event(sums, depth, points.direction, light, by_water)
        subpath.add(record, photon, 1, length, energy, active, sums)
        return (index + 1,)

    dr.while_loop((first,), lambda index: index < end, merge, label="merge in the water")


def merge_on_solids(
    patches: SolidPatches,
    record: PassRecord,
    photons: PhotonMap | None,
    pixel: mi.UInt32,
    connections: mi.Float,
    rng: mi.PCG32,
) -> Action:
    """Return the action that merges the receiver's paths with the light on the solids that they meet.

    A path of throughput beta and a photon of energy w on a patch of area A add beta w / A times the BSDF, weighted
    against `connections`, a share of all pairs, that make the same path.
    """

    def merge(path: RandomWalkPath, si: mi.SurfaceInteraction3f, inverse_density: mi.Float, active: mi.Bool) -> None:
        if photons is None:
            return
        patch, random = patches.locate(si), mi.PCG32(rng)
        first, end = photons.find(patch.bucket, active)
        shape = met_shape(si)
        solid, sums = record.classes.solid(shape), record.histogram.perturbations.at_solid(path.sums, shape)
        events = path.scatterings, path.reversals
        subpath = SensorSubpath(pixel, *events, solid, path.direction, path.lost, path.surface_length)
        covered = patches.inverse_share(patch, shape, random, active & (first < end))
        weight = path.throughput * covered / patch.area
        typical = patches.typical_area(si)
        connection = connections * inverse_density / dr.abs(dr.dot(si.n, path.direction))

        def add(index: mi.UInt32) -> tuple[mi.UInt32]:
            within = index < end
            photon, tag = photons.photon(index, within)
            within &= tag == patch.tag
            outgoing = si.to_local(-photon.direction)
            # Mitsuba's BSDFs include the cosine of the shading normal. The photon's energy per area includes that of
            # the true surface, which is divided out.
            cosine = dr.abs(dr.dot(si.n, photon.direction))
            bsdf = si.bsdf().eval(mi.BSDFContext(), si, outgoing, within)[0] / cosine
            connected = dr.select(photon.connectable, connection, 0)
            share = typical / (connected + typical)
            energy = weight * photon.contribution.throughput * bsdf * share
            lit, length = within & (bsdf > 0), path.length + photon.length
            total = joined(sums, photon.contribution.sums)
            subpath.add(record, photon, 0, length, energy, lit, total, on_solid=True)
            return (index + 1,)

        dr.while_loop((first,), lambda index: index < end, add, label="merge on solids")

    return merge


@dataclass(frozen=True)
class SensorSubpath:
    """The receiver's part of merged paths, and the number of the solid on which it ends (0 for none)."""

    pixel: mi.UInt32
    scatterings: mi.UInt32
    reversals: mi.UInt32
    solid: mi.UInt32
    direction: mi.Vector3f
    lost: mi.Bool
    surface_length: mi.Float

    @classmethod
    def at(cls, record: PassRecord, point: SegmentPoints, solid: mi.UInt32) -> SensorSubpath:
        """Return the parts up to points of the receiver's paths."""
        events = record.classes.unpack(point.label)
        return cls(*events, solid, point.direction, point.contribution.lost, point.surface_length)

    def add(
        self,
        record: PassRecord,
        light: Photon | SegmentPoints,
        events: int,
        length: mi.Float,
        energy: mi.Float,
        active: mi.Bool,
        sums: Sums,
        between: Sequence[mi.Vector3f] = (),
        on_solid: bool = False,
    ) -> None:
        """Add complete paths to a record, with a number of scattering `events` where the parts meet.

        `sums` are those of the perturbations of the complete paths, `on_solid` is whether they have met a solid,
        `between` are the directions of segments between the receiver's part and the light's. Paths with a lost part are
        lost.
        """
        lost = self.lost | light.contribution.lost
        order, reversals = self.scatterings + events, self.reversals
        _, before, reversed_before = record.classes.unpack(light.label)
        order = order + before
        if record.classes.by_order:
            # Light continues against the directions of the receiver's part.
            course = [self.direction.z, *(direction.z for direction in between), -light.direction.z]
            for here, following in pairwise(course):
                reversals = reversals + dr.select(here * following < 0, mi.UInt32(1), 0)
            reversals = reversals + reversed_before
        echo = Echo(self.surface_length, on_solid)
        record.receive(self.pixel, order, reversals, self.solid, length, energy, active & ~lost, echo, sums)
        record.lose(energy, active & lost)
