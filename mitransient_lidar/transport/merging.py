"""Merging of light from the laser with paths from the receiver, in cells of water and on patches of solids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.cells import SolidPatches, WaterCells
from mitransient_lidar.transport.path import optical_length
from mitransient_lidar.transport.photons import Photon, PhotonMap
from mitransient_lidar.transport.sorting import receive
from mitransient_lidar.transport.system import LidarScene
from mitransient_lidar.transport.tracks import TrackPoints, Tracks
from mitransient_lidar.transport.walk import Action, WalkPath


def store_points(tracks: Tracks, count: int, cells: WaterCells) -> PhotonMap | None:
    """Store the `count` points of light paths by their cells; return None without any."""
    if count == 0:
        return None
    index = dr.arange(mi.UInt32, count)
    bucket, _, _ = cells.locate(tracks.points(index).point)
    photons = PhotonMap(cells.grid.buckets, bucket, tracks.system.sorting is not None)
    # Worked out anew: reading the legs again costs less than keeping the points.
    points = tracks.points(index)
    _, tag, _ = cells.locate(points.point)
    place = dr.dot(points.point, points.direction)
    photons.fill(Photon(points.direction, points.length, points.weight, points.competition, place, points.label), tag)
    return photons


def merge_in_water(
    system: LidarScene,
    points: TrackPoints,
    cells: WaterCells,
    photons: PhotonMap,
    choice: mi.Float,
    lost: mi.Float64,
) -> None:
    """Merge points of the receiver's paths with the light in their cells, into the film.

    A point stands for a track of length s and throughput beta, a photon for one of length s' and energy w; with the
    cell's volume V each pair adds beta s w s' / V times the scattering coefficient and the phase function, shared among
    all merges that make the same path. Water and bubbles make different paths. `choice`, a uniform random number for
    each point, picks the photons of cells that hold too many.
    """
    water: Any = system.water
    bucket, cell, volume = cells.locate(points.point)
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi = points.point, -points.direction
    mei.sh_frame = mi.Frame3f(mei.wi)
    layer = water.flight.layer_at(-points.point.z)
    phase = water.phases.at(layer)
    scatterers = [(phase, water.scattering_flight.attenuation(layer))]
    if water.plume is not None:
        bubbles = dr.select(water.plume.holds(points.point), mi.Float(water.plume.scattering), 0)
        scatterers.append((water.plume_phase, bubbles))
    absorption = water.absorption_flight.attenuation(layer)
    stratum = water.strata.at(-points.point.z)
    half = _Half.of_points(system, points)
    first, end, step = photons.sample(bucket, choice, mi.Bool(True))
    weight = points.weight / volume * mi.Float(step)

    def merge(index: mi.UInt32) -> tuple[mi.UInt32]:
        active = index < end
        photon, tag = photons.photon(index, active)
        active &= tag == cell
        shared = mi.Float(0)
        for phase, scattering in scatterers:
            value, _ = phase.eval_pdf(mi.PhaseFunctionContext(), mei, -photon.direction, active)
            shared += dr.rcp(dr.rcp(scattering * value[0]) + points.competition + photon.competition)
        # The photon goes on to the plane across its direction through the point: times do not blur over the cell.
        beyond = dr.dot(points.point, photon.direction) - photon.place
        energy = weight * photon.weight * shared * dr.exp(-absorption * beyond)
        length = points.length + photon.length + optical_length(system, beyond, True, stratum)
        _add(system, lost, half, photon, 1, length, energy, active)
        return (index + step,)

    dr.while_loop((first,), lambda index: index < end, merge, label="merge in the water")


def merger_at_solids(
    system: LidarScene,
    patches: SolidPatches,
    photons: PhotonMap | None,
    pixel: mi.UInt32,
    rng: mi.PCG32,
    lost: mi.Float64,
) -> Action:
    """Return the action by which the receiver's paths, where they meet solids, are merged with the light there.

    A path of throughput beta and a photon of energy w on a patch of area A add beta w / A times the BSDF.
    """

    def merge(path: WalkPath, si: mi.SurfaceInteraction3f, active: mi.Bool) -> None:
        if photons is None:
            return
        patch = patches.locate(si)
        first, end, step = photons.sample(patch.bucket, rng.next_float32(), active)
        half = _Half(pixel, path.scatterings, path.turns, path.direction, path.weight)
        weight = path.weight * patches.inverse_share(patch, si.shape, rng, active & (first < end)) / patch.area
        weight *= mi.Float(step)

        def add(index: mi.UInt32) -> tuple[mi.UInt32]:
            within = index < end
            photon, tag = photons.photon(index, within)
            within &= tag == patch.tag
            outgoing = si.to_local(-photon.direction)
            # Mitsuba's BSDFs hold the cosine of the shading normal, which stays. A photon's energy on an area is that
            # of its radiance times the cosine of the true surface, which goes.
            cosine = dr.abs(dr.dot(si.n, photon.direction))
            bsdf = si.bsdf().eval(mi.BSDFContext(), si, outgoing, within)[0] / cosine
            energy = weight * photon.weight * bsdf
            _add(system, lost, half, photon, 0, path.length + photon.length, energy, within & (bsdf > 0))
            return (index + step,)

        dr.while_loop((first,), lambda index: index < end, add, label="merge at solids")

    return merge


@dataclass(frozen=True)
class _Half:
    """The receiver's half of paths that are merged: pixel, events and turns so far, direction and weight."""

    pixel: mi.UInt32
    scatterings: mi.UInt32
    turns: mi.UInt32
    direction: mi.Vector3f
    weight: mi.Float

    @classmethod
    def of_points(cls, system: LidarScene, points: TrackPoints) -> _Half:
        """Return the halves that end at points of tracks."""
        none = mi.UInt32(0)
        label = system.sorting.unpack(points.label) if system.sorting is not None else (points.label, none, none)
        return cls(*label, points.direction, points.weight)


def _add(
    system: LidarScene,
    lost: mi.Float64,
    half: _Half,
    photon: Photon,
    events: int,
    length: mi.Float,
    energy: mi.Float,
    active: mi.Bool,
) -> None:
    """Add a merged path, with 0 or 1 scattering `events` at the merge, to the film.

    Where one of its halves passed beside the surface it goes to what is lost instead.
    """
    virtual = (half.weight < 0) | (photon.weight < 0)
    order, turns = half.scatterings, half.turns
    if system.sorting is not None:
        _, before, turned = system.sorting.unpack(photon.label)
        # Light that comes down goes on against the half's direction: it turns where both point down, or both up.
        turns = turns + turned + dr.select(photon.direction.z * half.direction.z > 0, mi.UInt32(1), 0)
        order = order + before + events
    receive(system, half.pixel, order, turns, length, energy, active & ~virtual)
    dr.scatter_add(lost, mi.Float64(dr.abs(energy)), mi.UInt32(0), active & virtual)
