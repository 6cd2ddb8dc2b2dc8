"""Light from the laser, stored by cell or patch."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mitransient_lidar.transport.merging.patches import SolidPatch
from mitransient_lidar.transport.merging.segments import PackedStore
from mitransient_lidar.transport.opaque import opaque_index
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.paths.path import PathPoint
from mitransient_lidar.transport.paths.random_walk import RandomWalkPath
from mitransient_lidar.transport.perturbations import Perturbations
from mitransient_lidar.transport.rng import Lanes, Shots

#: Number of photons kept in full buckets, of cells and of patches: more take time and reduce the variance little.
PHOTONS_OF_CELL, PHOTONS_OF_PATCH = 8, 32

#: Numbers that tell a path's hits apart; paths with more rays may share numbers with other paths.
_RAYS_PER_PATH = 509


#: Stored light in a bucket: the z component of its direction follows from the others and the flag `up`. `further` is
#: the position of light in the water along its direction [m]; on solids, whether it can be connected (1).
_PHOTON = {
    **{"x": "Float", "y": "Float", "inverse_density": "Float", "length": "Float"},
    **{"throughput|lost": "Float", "mis_partial_sum|up": "Float", "tag": "UInt32", "further": "Float"},
}

#: Stored solid hit.
_HIT = {
    **{"bucket": "UInt32", "tag": "UInt32", "lane": "UInt32", "rays|connectable": "UInt32"},
    **{"direction": "Vector3f", "length": "Float"},
    **{"throughput|lost": "Float", "point": "Point3f"},
}


def _labelled(fields: dict[str, str], classes: PathClasses, perturbations: int) -> dict[str, str | int]:
    """Return the fields of light with those that only some passes need."""
    return {**fields, **({"label": "UInt32"} if classes.labels_orders else {}), "sums": perturbations}


class PhotonMap:
    """Light sorted by bucket, by counting.

    Full buckets keep only some photons, at random, with larger weights that have the same sum if all are equal.

    `light`: the light. `buckets`, `bucket`, `tag`: number of buckets; each photon's bucket, and its cell's or patch's
    tag there. `further`: a further number for each. `u`: uniform random numbers that select photons. `most`: expected
    number of photons kept in a bucket with more. `classes`: path classes, which need the numbers of scattering events
    or not.
    """

    def __init__(
        self,
        light: PathPoint,
        buckets: int,
        bucket: mi.UInt32,
        tag: mi.UInt32,
        further: mi.Float,
        u: mi.Float,
        most: int,
        classes: PathClasses,
    ) -> None:
        self._classes = classes
        counts = dr.zeros(mi.UInt32, buckets)
        dr.scatter_add(counts, mi.UInt32(1), bucket)
        # The light itself is computed again below: to keep it takes 3 % less time, and 60 % more memory.
        dr.eval(bucket, counts, u)
        found = dr.gather(mi.UInt32, counts, bucket)
        kept = u * mi.Float(found) < most
        counts = dr.zeros(mi.UInt32, buckets)
        rank = dr.scatter_inc(counts, bucket, kept)
        dr.eval(found, rank, kept, counts)
        self._end = dr.cumsum(counts)
        self.count = int(self._end[buckets - 1])
        self._photons = PackedStore(self.count, _labelled(_PHOTON, classes, len(light.sums)))
        # The number kept in a full bucket is random: their weights add up to all its light, and on average to the light
        # of buckets that keep nothing, too.
        number, number_kept = mi.Float(found), mi.Float(dr.gather(mi.UInt32, counts, bucket, kept))
        some = 1 - dr.exp(number * dr.log(1 - most / number))
        scale = dr.select(number > most, number / (some * number_kept), 1)
        x, y, z = light.direction
        values = {**vars(light), "x": x, "y": y, "up": z > 0, "tag": tag, "further": further}
        values |= {"throughput": light.throughput * scale, "label": classes.pack(light)}
        self._photons.write(values, dr.gather(mi.UInt32, self._end, bucket) - 1 - rank, kept)
        self._photons.evaluate()

    def find(self, bucket: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        """Return a bucket's first photon and the end of its photons; nothing where inactive."""
        end = dr.gather(mi.UInt32, self._end, bucket, active)
        return dr.gather(mi.UInt32, self._end, bucket - 1, active & (bucket > 0)), end

    def photon(self, index: mi.UInt32, active: mi.Bool) -> tuple[PathPoint, mi.UInt32, mi.Float]:
        """Return photons, as far as they are stored, with their tags and further numbers."""
        found = self._photons.read(index, active)
        x, y = found["x"], found["y"]
        z = dr.sqrt(dr.maximum(1 - x * x - y * y, 0))
        direction = mi.Vector3f(x, y, dr.select(found["up"], z, -z))
        return _light(found, self._classes, direction=direction), found["tag"], found["further"]


class PhotonBuffer:
    """Light on solids from `photons` paths per shot; at most `capacity` hits are stored, but all are counted.

    One hit per path is also found by the path's number, to be connected.
    """

    def __init__(
        self, capacity: int, photons: int, classes: PathClasses, shots: int, perturbations: Perturbations
    ) -> None:
        self.capacity, self.photons, self._shots = capacity, photons, shots
        self._capacity = opaque_index(capacity)
        self._classes = classes
        self._stored = dr.zeros(mi.UInt32, 1)
        self._hits = PackedStore(capacity, _labelled(_HIT, classes, perturbations.count))
        #: Number of each path's connectable hit, counted from 1.
        self._of_path = dr.zeros(mi.UInt32, photons * shots)

    def add(
        self,
        path: RandomWalkPath,
        throughput: mi.Float,
        place: mi.Point3f,
        patch: SolidPatch,
        active: mi.Bool,
        connectable: mi.Bool,
    ) -> None:
        """Store light that has met patches on solids at points [m]; at most one hit per path is `connectable`.

        Its `throughput` is the path's throughput over the foreshortening at its point.
        """
        slot = dr.scatter_inc(self._stored, mi.UInt32(0), active)
        values = {**vars(path), "throughput": throughput, "point": place, "bucket": patch.bucket, "tag": patch.tag}
        values |= {"connectable": connectable, "label": self._classes.pack(path)}
        self._hits.write(values, slot, active & (slot < self._capacity))
        dr.scatter(self._of_path, slot + 1, path.lane, connectable)

    def sort(self, buckets: int, shots: Shots) -> tuple[PhotonMap | None, int]:
        """Return the photons in a map, or None, and their number, stored or not."""
        dr.eval(self._stored, self._of_path)
        self._hits.evaluate()
        wanted = int(self._stored[0])
        if wanted == 0:
            return None, 0
        found = self._hits.read(dr.arange(mi.UInt32, min(wanted, self.capacity)))
        # Neither other paths nor a scene that differs a little change the random number of a hit.
        lanes = Lanes.of_paths(found["lane"], self._shots, self.photons)
        u = mi.sample_tea_float32(shots.keys(lanes), lanes.number * _RAYS_PER_PATH + found["rays"])
        connectable = dr.select(found["connectable"], mi.Float(1), 0)
        place = buckets, found["bucket"], found["tag"]
        light = _light(found, self._classes)
        return PhotonMap(light, *place, connectable, u, PHOTONS_OF_PATCH, self._classes), wanted

    def connectable(self, index: mi.UInt32) -> PathPoint:
        """Return the hits by path number that can be connected, with throughput 0 for none."""
        number = dr.gather(mi.UInt32, self._of_path, index)
        return _light(self._hits.read(number - 1, number > 0), self._classes)


def _light(stored: dict[str, Any], classes: PathClasses, **fields: Any) -> PathPoint:
    """Return light from its stored values, and from further fields."""
    label = stored.get("label", mi.UInt32(0))
    known = {name: value for name, value in stored.items() if name in PathPoint.__dataclass_fields__}
    return PathPoint(**known, **classes.unpack(label), **fields)
