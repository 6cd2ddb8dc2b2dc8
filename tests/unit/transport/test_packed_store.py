"""Photons in packed arrays, and lanes of paths that share a kernel."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from kernel_arrays import array, vector

from mitransient_lidar.transport.merging.photon_map import PhotonMap
from mitransient_lidar.transport.merging.segments import PackedStore
from mitransient_lidar.transport.opaque import aligned
from mitransient_lidar.transport.paths.passes import PathClasses
from mitransient_lidar.transport.paths.path import PathPoint
from mitransient_lidar.transport.rng import Lanes, starts, tiled

#: Zero, numbers from the smallest to the largest of single precision, and those that are not finite.
NUMBERS = np.float32([0, 1e-45, 1.2e-38, 0.1, 3.4e38, np.inf, np.nan, -np.nan])


def test_numbers_and_flags_are_stored_without_loss():
    # A sign that a comparison finds would lose the flags of 0 and of NaN, which must stay NaN to be reported.
    place, index = dr.arange(mi.UInt32, len(NUMBERS)), np.arange(len(NUMBERS), dtype=np.uint32) << 28
    for flag in (False, True):
        opaque_flag = dr.opaque(mi.Bool, flag)
        for sums in range(4):  # Packets of one, two and four numbers.
            store = PackedStore(len(NUMBERS), {"number|flag": "Float", "index": "UInt32", "sums": sums})
            given = [array(np.roll(NUMBERS, k)) for k in range(sums)]
            values = {"number": array(NUMBERS), "flag": opaque_flag, "index": aligned(mi.UInt32, index), "sums": given}
            store.write(values, place, mi.Bool(True))
            found = store.read(place)
            np.testing.assert_array_equal(np.array(found["number"]), np.abs(NUMBERS))
            np.testing.assert_array_equal(np.array(found["index"]), index)
            np.testing.assert_array_equal(np.array(found["sums"]), np.array(given))
            assert (np.array(found["flag"]) == flag).all()


def test_photons_are_stored_without_loss():
    """Each in a bucket of its own, so that all are kept; the z component is accurate to the rounding of the others."""
    random, count = np.random.default_rng(5), 256
    direction = random.normal(size=(3, count))
    direction /= np.linalg.norm(direction, axis=0)
    numbers = random.exponential(size=(6, count)) * (random.random((6, count)) < 0.7)
    throughput, summed, inverse_density, length, position, change = map(array, numbers)
    point = PathPoint(
        direction=vector(direction),
        length=length,
        throughput=throughput,
        lost=mi.Bool(random.random(count) < 0.5),
        sums=[change],
        scatterings=mi.UInt32(random.integers(64, size=count)),
        reversals=mi.UInt32(random.integers(64, size=count)),
        mis_partial_sum=summed,
        inverse_density=inverse_density,
    )
    tag, bucket = mi.UInt32(random.integers(2**32, size=count)), random.permutation(count)
    place, none = (count, mi.UInt32(bucket), tag), dr.zeros(mi.Float, count)
    photons = PhotonMap(point, *place, -position, none, 8, PathClasses(orders=2))
    first, end = photons.find(mi.UInt32(bucket), mi.Bool(True))
    assert (np.array(end - first) == 1).all()
    found, found_tag, further = photons.photon(first, mi.Bool(True))
    np.testing.assert_allclose(np.array(found.direction), direction, atol=2e-3)
    np.testing.assert_array_equal(np.sign(np.array(found.direction.z)), np.sign(np.float32(direction[2])))
    pairs = [(found_tag, tag), (further, -position), (found.sums[0], change)]
    pairs += [(found.direction.x, point.direction.x), (found.direction.y, point.direction.y)]
    names = ("length", "throughput", "lost", "scatterings", "reversals", "mis_partial_sum", "inverse_density")
    pairs += [(getattr(found, name), getattr(point, name)) for name in names]
    for stored, given in pairs:
        np.testing.assert_array_equal(np.array(stored), np.array(given))


@dataclass(frozen=True)
class Part:
    """One array of the shots, one of all shots, and a table that is no array of shots."""

    OF_SHOTS = ("place", "width", "start")

    place: mi.Point2f
    width: mi.Float
    start: mi.UInt32
    table: mi.Float


class Whole:
    OF_SHOTS = ("parts",)

    def __init__(self, part):
        self.parts = [part, None]


def test_lanes_pick_what_their_shots_have():
    """Of each shot three times in turn, in lanes of two paths each; without a change of the objects themselves."""
    part = Part(mi.Point2f([1, 2], [3, 4]), mi.Float(7), starts(2, 10), mi.Float([5, 6]))
    whole = Whole(part)
    several = tiled(whole, 3)
    lanes = Lanes.of_paths(dr.arange(mi.UInt32, 12), 6, 2)
    found, none = lanes.pick(several).parts
    shot = np.repeat([0, 1], 6)
    np.testing.assert_array_equal(np.array(found.place), [1 + shot, 3 + shot])
    np.testing.assert_array_equal(np.array(found.start), 10 * shot)
    assert (dr.width(found.width), found.width[0], none) == (1, 7, None)
    np.testing.assert_array_equal(np.array(found.table), [5, 6])
    assert whole.parts[0] is part
    assert dr.width(part.place) == 2
    alone = Lanes.of_paths(dr.arange(mi.UInt32, 4), 1, 4).pick(Part(mi.Point2f(1, 3), mi.Float(7), starts(1, 10), None))
    assert dr.width(alone.place) == 1
