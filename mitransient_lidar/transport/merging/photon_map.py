"""Light from the laser, stored by cell or patch."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.patches import Patch
from mitransient_lidar.transport.path_classes import PathClasses
from mitransient_lidar.transport.random_walk import RandomWalkPath

#: Largest number of photons of a bucket that are used for one point. Where a beam or field of view is no wider than a
#: cell, thousands would take minutes and reduce the variance little; usually the fullest buckets hold fifteen.
_MOST_PHOTONS = 32


@dataclass(frozen=True)
class Photon:
    """Stored light.

    Attributes
    ----------
    direction
        Unit direction of propagation.
    length
        Optical length of its path from the laser [m].
    weight
        Energy [J], in the water times track length [J m]; negative for paths outside the surface mesh.
    mis_partial_sum
        As in `RandomWalkPath`.
    position
        Scalar product of position and direction [m].
    label
        Scattering events and reversals of its path (`PathClasses.pack`).
    """

    direction: mi.Vector3f
    length: mi.Float
    weight: mi.Float
    mis_partial_sum: mi.Float
    position: mi.Float
    label: mi.UInt32


class PhotonMap:
    """Photons sorted by bucket, by counting: `bucket` is that of each photon, `labelled` whether labels are kept."""

    def __init__(self, buckets: int, bucket: mi.UInt32, labelled: bool) -> None:
        self.count = dr.width(bucket)
        counts = dr.zeros(mi.UInt32, buckets)
        self._bucket = bucket
        self._rank = dr.scatter_inc(counts, bucket, dr.full(mi.Bool, True, self.count))
        dr.eval(self._rank, self._bucket, counts)
        self._end = dr.cumsum(counts)
        self._record = mi.Float()
        self._label = dr.zeros(mi.UInt32, self.count) if labelled else None

    def fill(self, photon: Photon, tag: mi.UInt32) -> None:
        """Store the photons in the order of their buckets, with their cells' tags."""
        place = dr.gather(mi.UInt32, self._end, self._bucket) - 1 - self._rank
        self._record = dr.empty(mi.Float, 8 * self.count)
        where = mi.Vector4f(photon.direction.x, photon.direction.y, photon.direction.z, photon.length)
        rest = mi.Vector4f(photon.weight, photon.mis_partial_sum, dr.reinterpret_array(mi.Float, tag), photon.position)
        dr.scatter(self._record, where, 2 * place)
        dr.scatter(self._record, rest, 2 * place + 1)
        if self._label is not None:
            dr.scatter(self._label, photon.label, place)
        dr.eval(self._record, self._end, self._label)
        self._bucket, self._rank = mi.UInt32(), mi.UInt32()

    def sample(self, bucket: mi.UInt32, u: mi.Float, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Return first photon, end and step of the photons of a bucket that are used; nothing where inactive.

        The uniform number `u` selects each photon with a probability of one over the step.
        """
        end = dr.gather(mi.UInt32, self._end, bucket, active)
        first = dr.gather(mi.UInt32, self._end, bucket - 1, active & (bucket > 0))
        step = (end - first) // (_MOST_PHOTONS + 1) + 1
        return first + dr.minimum(mi.UInt32(u * mi.Float(step)), step - 1), end, step

    def photon(self, index: mi.UInt32, active: mi.Bool) -> tuple[Photon, mi.UInt32]:
        """Return photons and their tags."""
        x, y, z, length = dr.gather(mi.Vector4f, self._record, 2 * index, active)
        weight, mis_partial_sum, tag, position = dr.gather(mi.Vector4f, self._record, 2 * index + 1, active)
        label = mi.UInt32(0) if self._label is None else dr.gather(mi.UInt32, self._label, index, active)
        photon = Photon(mi.Vector3f(x, y, z), length, weight, mis_partial_sum, position, label)
        return photon, dr.reinterpret_array(mi.UInt32, tag)


class PhotonBuffer:
    """Light on patches of solids, in any order; at most `capacity` photons are stored, but all are counted."""

    def __init__(self, capacity: int, classes: PathClasses) -> None:
        self.capacity = capacity
        self._classes = classes
        self._stored = dr.zeros(mi.UInt32, 1)
        self._patch = dr.empty(mi.UInt32, 2 * capacity)
        self._label = dr.empty(mi.UInt32, capacity if classes.separate else 1)
        self._record = dr.empty(mi.Float, 4 * capacity)
        self._weight = dr.empty(mi.Float, capacity)

    def add(self, path: RandomWalkPath, patch: Patch, active: mi.Bool) -> None:
        """Store light that has met patches of solids."""
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), active)
        keep = active & (slot < self.capacity)
        where = mi.Vector4f(path.direction.x, path.direction.y, path.direction.z, path.length)
        dr.scatter(self._patch, mi.Point2u(patch.bucket, patch.tag), slot, keep)
        dr.scatter(self._record, where, slot, keep)
        dr.scatter(self._weight, path.weight, slot, keep)
        if self._classes.separate:
            dr.scatter(self._label, self._classes.pack(mi.UInt32(0), path.scatterings, path.reversals), slot, keep)

    def sort(self, buckets: int) -> tuple[PhotonMap | None, int]:
        """Return the photons in a map, or None, and their number, stored or not."""
        dr.eval(self._stored, self._patch, self._record, self._weight, self._label)
        wanted = int(self._stored[0])
        if wanted == 0:
            return None, 0
        index = dr.arange(mi.UInt32, min(wanted, self.capacity))
        bucket, tag = dr.gather(mi.Point2u, self._patch, index)
        x, y, z, length = dr.gather(mi.Vector4f, self._record, index)
        photons = PhotonMap(buckets, bucket, self._classes.separate)
        label = dr.gather(mi.UInt32, self._label, index) if self._classes.separate else mi.UInt32(0)
        weight = dr.gather(mi.Float, self._weight, index)
        photons.fill(Photon(mi.Vector3f(x, y, z), length, weight, mi.Float(0), mi.Float(0), label), tag)
        return photons, wanted
