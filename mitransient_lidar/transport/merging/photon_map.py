"""Light from the laser, stored by cell or patch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.contribution import Contribution, split_flag, with_flag
from mitransient_lidar.transport.merging.patches import SolidPatch
from mitransient_lidar.transport.opaque import opaque_index
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.perturbations import Perturbations, SumStore
from mitransient_lidar.transport.random_walk import RandomWalkPath
from mitransient_lidar.transport.rng import Lanes, Shots

#: Number of photons that are kept of full buckets, of cells and of patches: more take time and reduce the variance
#: little.
PHOTONS_OF_CELL, PHOTONS_OF_PATCH = 8, 32

#: Numbers that tell the hits of a path apart; those of paths with more rays may be those of other paths.
_RAYS_PER_PATH = 509


@dataclass(frozen=True)
class Photon:
    """Stored light.

    Attributes
    ----------
    direction
        Unit direction of propagation.
    length
        Optical length of its path from the laser [m].
    contribution
        What its path carries: energy [J], in the water times track length [J m].
    mis_partial_sum
        As in `RandomWalkPath`.
    position
        Scalar product of position and direction [m].
    inverse_density
        As in `SegmentPoints`; 0 on solids.
    connectable
        Whether it can be connected from elsewhere, on solids.
    label
        Scattering events and reversals of its path (`PathClasses.pack`).
    """

    direction: mi.Vector3f
    length: mi.Float
    contribution: Contribution
    mis_partial_sum: mi.Float
    position: mi.Float
    inverse_density: mi.Float
    connectable: mi.Bool
    label: mi.UInt32

    @property
    def unscattered(self) -> mi.Bool:
        """Whether no event in the water has scattered the path: its sum has no terms."""
        return self.mis_partial_sum == 0


class _PhotonStore:
    """Stored photons.

    Each is two packets of four numbers that are read together, with flags in signs (`with_flag`), sums of
    perturbations, and a label if these are kept:

    ==============  ==============================================================================================
    ``_direction``  x and y of the direction, ``inverse_density`` with the flag ``connectable``, length
    ``_factors``    `Contribution.packed`, ``mis_partial_sum`` with the flag of a direction upwards, tag, position
    ==============  ==============================================================================================
    """

    def __init__(self, size: int, labelled: bool, perturbations: int) -> None:
        # Two arrays: a second write to the same one would compute all photons again.
        self._direction, self._factors = (dr.empty(mi.Float, 4 * size) for _ in range(2))
        self._label = dr.zeros(mi.UInt32, size) if labelled else None
        self._sums = SumStore(size, perturbations)

    def write(self, photon: Photon, tag: mi.UInt32, place: mi.UInt32, active: mi.Bool) -> None:
        """Store photons and their tags, and compute what is stored."""
        direction, carried = photon.direction, photon.contribution
        inverse_density = with_flag(photon.inverse_density, photon.connectable)
        summed = with_flag(photon.mis_partial_sum, direction.z > 0)
        where = mi.Vector4f(direction.x, direction.y, inverse_density, photon.length)
        factors = mi.Vector4f(carried.packed(), summed, dr.reinterpret_array(mi.Float, tag), photon.position)
        dr.scatter(self._direction, where, place, active)
        dr.scatter(self._factors, factors, place, active)
        if self._label is not None:
            dr.scatter(self._label, photon.label, place, active)
        self._sums.write(carried.sums, place, active)
        dr.eval(self._direction, self._factors, self._label, self._sums.packets)

    def read(self, place: mi.UInt32, active: mi.Bool) -> tuple[Photon, mi.UInt32]:
        """Return photons and their tags."""
        x, y, inverse_density, length = dr.gather(mi.Vector4f, self._direction, place, active)
        packed, summed, tag, position = dr.gather(mi.Vector4f, self._factors, place, active)
        inverse_density, connectable = split_flag(inverse_density)
        mis_partial_sum, up = split_flag(summed)
        z = dr.sqrt(dr.maximum(1 - x * x - y * y, 0))
        direction = mi.Vector3f(x, y, dr.select(up, z, -z))
        label = mi.UInt32(0) if self._label is None else dr.gather(mi.UInt32, self._label, place, active)
        carried = Contribution.unpacked(packed, self._sums.read(place, active))
        photon = Photon(direction, length, carried, mis_partial_sum, position, inverse_density, connectable, label)
        return photon, dr.reinterpret_array(mi.UInt32, tag)


class PhotonMap:
    """Photons sorted by bucket, by counting.

    Of full buckets only some photons are kept, at random, with larger weights of the same sum if all are equal.

    Parameters
    ----------
    buckets
        Number of buckets.
    bucket
        Bucket of each photon.
    u
        Uniform random numbers that select photons.
    most
        Expected number of photons that are kept of a bucket with more.
    labelled
        Whether labels are kept.
    perturbations
        Number of sums that are kept.
    """

    def __init__(
        self, buckets: int, bucket: mi.UInt32, u: mi.Float, most: int, labelled: bool, perturbations: int
    ) -> None:
        counts = dr.zeros(mi.UInt32, buckets)
        dr.scatter_add(counts, mi.UInt32(1), bucket)
        self._bucket, self._most = bucket, most
        dr.eval(self._bucket, counts, u)
        self._found = dr.gather(mi.UInt32, counts, bucket)
        self._kept = u * mi.Float(self._found) < most
        self._counts = dr.zeros(mi.UInt32, buckets)
        self._rank = dr.scatter_inc(self._counts, bucket, self._kept)
        dr.eval(self._found, self._rank, self._kept, self._counts)
        self._end = dr.cumsum(self._counts)
        self.count = int(self._end[buckets - 1])
        self._photons = _PhotonStore(self.count, labelled, perturbations)

    def fill(self, photon: Photon, tag: mi.UInt32) -> None:
        """Store the photons in the order of their buckets, with their cells' tags."""
        place = dr.gather(mi.UInt32, self._end, self._bucket) - 1 - self._rank
        scaled = replace(photon, contribution=photon.contribution.scaled(self._scale()))
        self._photons.write(scaled, tag, place, self._kept)
        self._bucket = self._found = self._rank = self._counts = mi.UInt32()
        self._kept = mi.Bool()

    def _scale(self) -> mi.Float:
        """Return the factors of the weights of the photons that are kept.

        How many are kept of a full bucket is random: their weights add up to all of its light, and on average to that
        of the buckets of which nothing is kept, too.
        """
        found, kept = mi.Float(self._found), dr.gather(mi.UInt32, self._counts, self._bucket, self._kept)
        some = 1 - dr.exp(found * dr.log(1 - self._most / found))
        return dr.select(found > self._most, found / (some * mi.Float(kept)), 1)

    def find(self, bucket: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """Return the first photon of a bucket and the end of its photons; nothing where inactive."""
        end = dr.gather(mi.UInt32, self._end, bucket, active)
        return dr.gather(mi.UInt32, self._end, bucket - 1, active & (bucket > 0)), end

    def photon(self, index: mi.UInt32, active: mi.Bool) -> tuple[Photon, mi.UInt32]:
        """Return photons and their tags."""
        return self._photons.read(index, active)


class PhotonBuffer:
    """Light of `photons` paths of each shot on solids; at most `capacity` hits are stored, but all are counted.

    One hit of each path is stored by the number of the path, too, to be connected.
    """

    def __init__(
        self, capacity: int, photons: int, classes: PathClasses, shots: int, perturbations: Perturbations
    ) -> None:
        self.capacity, self.photons, self._shots = capacity, photons, shots
        self._capacity = opaque_index(capacity)
        photons *= shots
        self._classes = classes
        self._stored = dr.zeros(mi.UInt32, 1)
        self._patch = dr.empty(mi.UInt32, 2 * capacity)
        # Lane, and number of the ray that ends there.
        self._ray = dr.empty(mi.UInt32, 2 * capacity)
        self._label = dr.empty(mi.UInt32, capacity if classes.labels_orders else 1)
        # Of each hit: direction and length; `Contribution.packed` and whether it is connectable.
        self._record = dr.empty(mi.Float, 4 * capacity)
        self._carried = dr.empty(mi.Float, 2 * capacity)
        # Of the connectable hit of each path: direction and length; `Contribution.packed` and place.
        self._connectable = dr.zeros(mi.Float, 4 * photons)
        self._place = dr.zeros(mi.Float, 4 * photons)
        self._connectable_label = dr.zeros(mi.UInt32, photons if classes.labels_orders else 1)
        self._sums = SumStore(capacity, perturbations.count)
        self._connectable_sums = SumStore(photons, perturbations.count)

    def add(
        self, path: RandomWalkPath, place: mi.Point3f, patch: SolidPatch, active: mi.Bool, connectable: mi.Bool
    ) -> None:
        """Store light that has met patches of solids at places [m]; at most one hit of a path is `connectable`."""
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), active)
        keep = active & (slot < self._capacity)
        where = mi.Vector4f(path.direction.x, path.direction.y, path.direction.z, path.length)
        dr.scatter(self._patch, mi.Point2u(patch.bucket, patch.tag), slot, keep)
        dr.scatter(self._ray, mi.Point2u(path.lane, path.rays), slot, keep)
        dr.scatter(self._record, where, slot, keep)
        carried = path.packed()
        dr.scatter(self._carried, mi.Vector2f(carried, dr.select(connectable, mi.Float(1), 0)), slot, keep)
        dr.scatter(self._connectable, where, path.lane, connectable)
        dr.scatter(self._place, mi.Vector4f(carried, place.x, place.y, place.z), path.lane, connectable)
        if self._classes.labels_orders:
            label = self._classes.pack(mi.UInt32(0), path.scatterings, path.reversals)
            dr.scatter(self._label, label, slot, keep)
            dr.scatter(self._connectable_label, label, path.lane, connectable)
        self._sums.write(path.sums, slot, keep)
        self._connectable_sums.write(path.sums, path.lane, connectable)

    def sort(self, buckets: int, shots: Shots) -> tuple[PhotonMap | None, int]:
        """Return the photons in a map, or None, and their number, stored or not."""
        dr.eval(self._stored, self._patch, self._ray, self._record, self._carried, self._label)
        dr.eval(self._connectable, self._place, self._connectable_label)
        dr.eval(self._sums.packets, self._connectable_sums.packets)
        wanted = int(self._stored[0])
        if wanted == 0:
            return None, 0
        index = dr.arange(mi.UInt32, min(wanted, self.capacity))
        bucket, tag = dr.gather(mi.Point2u, self._patch, index)
        x, y, z, length = dr.gather(mi.Vector4f, self._record, index)
        # Neither other paths nor a scene that differs a little change the random number of a hit.
        lane, ray = dr.gather(mi.Point2u, self._ray, index)
        lanes = Lanes.of_paths(lane, self._shots, self.photons)
        u = mi.sample_tea_float32(shots.keys(lanes), lanes.number * _RAYS_PER_PATH + ray)
        carried, connectable = dr.gather(mi.Vector2f, self._carried, index)
        contribution, zero = Contribution.unpacked(carried, self._sums.read(index)), mi.Float(0)
        kept = self._classes.labels_orders, len(contribution.sums)
        photons = PhotonMap(buckets, bucket, u, PHOTONS_OF_PATCH, *kept)
        label = dr.gather(mi.UInt32, self._label, index) if self._classes.labels_orders else mi.UInt32(0)
        hit = Photon(mi.Vector3f(x, y, z), length, contribution, zero, zero, zero, connectable > 0, label)
        photons.fill(hit, tag)
        return photons, wanted

    def connectable(self, index: mi.UInt32) -> tuple[mi.Point3f, Photon]:
        """Return the hits of paths by number that can be connected [m], and their photons, of throughput 0 for none."""
        x, y, z, length = dr.gather(mi.Vector4f, self._connectable, index)
        carried, px, py, pz = dr.gather(mi.Vector4f, self._place, index)
        label = dr.gather(mi.UInt32, self._connectable_label, index) if self._classes.labels_orders else mi.UInt32(0)
        contribution, zero = Contribution.unpacked(carried, self._connectable_sums.read(index)), mi.Float(0)
        photon = Photon(mi.Vector3f(x, y, z), length, contribution, zero, zero, zero, mi.Bool(True), label)
        return mi.Point3f(px, py, pz), photon
