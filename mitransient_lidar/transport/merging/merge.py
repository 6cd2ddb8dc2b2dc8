"""Merging of light from the laser with paths from the receiver, in cells of water and on patches of solids."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.cells import WaterCells
from mitransient_lidar.transport.merging.patches import SolidPatches
from mitransient_lidar.transport.merging.photon_map import Photon, PhotonMap
from mitransient_lidar.transport.merging.segments import SegmentBuffer, SegmentPoints
from mitransient_lidar.transport.merging.spherical_cells import SphericalCells
from mitransient_lidar.transport.passes import PassRecord
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.random_walk import Action, RandomWalkPath
from mitransient_lidar.transport.scene import LidarScene


def store_points(
    segments: SegmentBuffer, count: int, cells: WaterCells | SphericalCells, classes: PathClasses
) -> PhotonMap | None:
    """Store the `count` points of light paths by their cells; return None if there are none."""
    if count == 0:
        return None
    index = dr.arange(mi.UInt32, count)
    bucket, _, _ = cells.locate(segments.points(index).point)
    photons = PhotonMap(cells.grid.buckets, bucket, classes.separate)
    # Computed again, which costs less than keeping the points.
    points = segments.points(index)
    _, tag, _ = cells.locate(points.point)
    position = dr.dot(points.point, points.direction)
    photon = Photon(points.direction, points.length, points.weight, points.mis_partial_sum, position, points.label)
    photons.fill(photon, tag)
    return photons


def merge_in_water(
    scene: LidarScene,
    record: PassRecord,
    points: SegmentPoints,
    cells: WaterCells | SphericalCells,
    photons: PhotonMap,
    u: mi.Float,
) -> None:
    """Merge points of the receiver's paths with the light in their cells.

    A point represents a track of length s and throughput beta, a photon one of length s' and energy w. With the cell's
    volume V each pair adds beta s w s' / V times scattering coefficient and phase function, weighted among all merges
    that make the same path; water and bubbles make different paths. The uniform random numbers `u` select photons in
    cells with too many.
    """
    water = scene.water
    bucket, cell, volume = cells.locate(points.point)
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi = points.point, -points.direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    layer = water.flight.layer_at(-points.point.z)
    scatterers = [(water.phases.at(layer), water.scattering_flight.attenuation(layer))]
    if water.plume is not None:
        scatterers.append((water.plume_phase, water.plume.scattering_at(points.point)))
    absorption = water.absorption_flight.attenuation(layer)
    group = water.index_layers.group(water.index_layers.at(-points.point.z))
    subpath = SensorSubpath(*record.classes.unpack(points.label), points.direction, points.weight)
    first, end, step = photons.sample(bucket, u, mi.Bool(True))
    weight = points.weight / volume * mi.Float(step)
    relative_volume = cells.relative_volume(points.point)

    def merge(index: mi.UInt32) -> tuple[mi.UInt32]:
        active = index < end
        photon, tag = photons.photon(index, active)
        active &= tag == cell
        shared = mi.Float(0)
        for phase, scattering in scatterers:
            value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, -photon.direction, active)
            density = relative_volume / (scattering * value[0])
            shared += relative_volume / (density + points.mis_partial_sum + photon.mis_partial_sum)
        # The photon continues to the plane through the point normal to its direction, so that times do not blur.
        beyond = dr.dot(points.point, photon.direction) - photon.position
        energy = weight * photon.weight * shared * dr.exp(-absorption * beyond)
        length = points.length + photon.length + beyond * group
        subpath.add(record, photon, 1, length, energy, active)
        return (index + step,)

    dr.while_loop((first,), lambda index: index < end, merge, label="merge in the water")


def merge_on_solids(
    patches: SolidPatches, record: PassRecord, photons: PhotonMap | None, pixel: mi.UInt32, rng: mi.PCG32
) -> Action:
    """Return the action that merges the receiver's paths with the light on the solids that they meet.

    A path of throughput beta and a photon of energy w on a patch of area A add beta w / A times the BSDF.
    """

    def merge(path: RandomWalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        if photons is None:
            return
        patch = patches.locate(si)
        first, end, step = photons.sample(patch.bucket, rng.next_float32(), active)
        subpath = SensorSubpath(pixel, path.scatterings, path.reversals, path.direction, path.weight)
        weight = path.weight * patches.inverse_share(patch, si.shape, rng, active & (first < end)) / patch.area
        weight *= mi.Float(step)

        def add(index: mi.UInt32) -> tuple[mi.UInt32]:
            within = index < end
            photon, tag = photons.photon(index, within)
            within &= tag == patch.tag
            outgoing = si.to_local(-photon.direction)
            # Mitsuba's BSDFs include the cosine of the shading normal. The photon's energy per area includes that of
            # the true surface, which is divided out.
            cosine = dr.abs(dr.dot(si.n, photon.direction))
            bsdf = si.bsdf().eval(mi.BSDFContext(), si, outgoing, within)[0] / cosine
            energy = weight * photon.weight * bsdf
            subpath.add(record, photon, 0, path.length + photon.length, energy, within & (bsdf > 0))
            return (index + step,)

        dr.while_loop((first,), lambda index: index < end, add, label="merge on solids")

    return merge


@dataclass(frozen=True)
class SensorSubpath:
    """The receiver's part of merged paths."""

    pixel: mi.UInt32
    scatterings: mi.UInt32
    reversals: mi.UInt32
    direction: mi.Vector3f
    weight: mi.Float

    def add(
        self, record: PassRecord, photon: Photon, events: int, length: mi.Float, energy: mi.Float, active: mi.Bool
    ) -> None:
        """Add merged paths, with 0 or 1 scattering `events` at the merge, to a record.

        Paths of which one part lies outside the surface mesh count as lost.
        """
        outside = (self.weight < 0) | (photon.weight < 0)
        order, reversals = self.scatterings, self.reversals
        if record.classes.separate:
            _, before, reversed_before = record.classes.unpack(photon.label)
            # Light continues against the direction of the receiver's part: a reversal if both point down, or both up.
            here = dr.select(photon.direction.z * self.direction.z > 0, mi.UInt32(1), 0)
            reversals = reversals + reversed_before + here
            order = order + before + events
        record.receive(self.pixel, order, reversals, length, energy, active & ~outside)
        record.lose(dr.abs(energy), active & outside)
