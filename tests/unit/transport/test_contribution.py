"""Storage of what parts of paths carry."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.contribution import Contribution, split_flag, with_flag
from mitransient_lidar.transport.merging.photon_map import Photon, PhotonMap

#: Zero, numbers from the smallest to the largest of single precision, and those that are not finite.
NUMBERS = np.float32([0, 1e-45, 1.2e-38, 0.1, 3.4e38, np.inf, np.nan, -np.nan])


def test_numbers_and_flags_are_stored_without_loss():
    # A sign that a comparison finds would lose the flags of 0 and of NaN, which must stay NaN to be reported.
    for flag in (False, True):
        number, found = split_flag(with_flag(mi.Float(NUMBERS), mi.Bool(flag)))
        np.testing.assert_array_equal(np.array(number), np.abs(NUMBERS))
        assert (np.array(found) == flag).all()


def test_photons_are_stored_without_loss():
    """Each in a bucket of its own, so that all are kept; the z component is accurate to the rounding of the others."""
    random, count = np.random.default_rng(5), 256
    direction = random.normal(size=(3, count))
    direction /= np.linalg.norm(direction, axis=0)
    numbers = random.exponential(size=(6, count)) * (random.random((6, count)) < 0.7)
    throughput, summed, inverse_density, length, position, change = map(mi.Float, np.float32(numbers))
    lost, connectable = (mi.Bool(random.random(count) < 0.5) for _ in range(2))
    label, tag = (mi.UInt32(random.integers(2**32, size=count)) for _ in range(2))
    carried = Contribution(throughput, lost, [change])
    photon = Photon(
        mi.Vector3f(np.float32(direction)), length, carried, summed, -position, inverse_density, connectable, label
    )
    bucket = random.permutation(count)
    photons = PhotonMap(count, mi.UInt32(bucket), dr.zeros(mi.Float, count), 8, True, 1)
    photons.fill(photon, tag)
    first, end = photons.find(mi.UInt32(bucket), mi.Bool(True))
    assert (np.array(end - first) == 1).all()
    found, found_tag = photons.photon(first, mi.Bool(True))
    np.testing.assert_allclose(np.array(found.direction), direction, atol=2e-3)
    np.testing.assert_array_equal(np.sign(np.array(found.direction.z)), np.sign(np.float32(direction[2])))
    pairs = [(found_tag, tag), (found.direction.x, photon.direction.x), (found.direction.y, photon.direction.y)]
    pairs += zip((*found.contribution.sums, found.contribution.throughput), (change, throughput), strict=True)
    pairs += [(found.contribution.lost, lost)]
    names = ("length", "mis_partial_sum", "position", "inverse_density", "connectable", "label")
    pairs += [(vars(found)[name], vars(photon)[name]) for name in names]
    for stored, given in pairs:
        np.testing.assert_array_equal(np.array(stored), np.array(given))
