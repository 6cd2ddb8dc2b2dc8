"""Random numbers of a pass: independent streams for each path, and random shifts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def pass_streams(seed: int, purpose: int, count: int) -> mi.PCG32:
    """Return independent random number generators for `count` paths.

    Parameters
    ----------
    seed
        Seed of the pass.
    purpose
        Number of the stage that asks; stages of one pass are independent.
    count
        Number of paths.
    """
    words = np.random.SeedSequence([seed, purpose]).generate_state(2, np.uint64)
    # Opaque, so that another seed is the same kernel.
    state, stream = (dr.opaque(mi.UInt64, int(word)) for word in words)
    index = dr.arange(mi.UInt32, count)
    # Neighbouring streams of PCG32 are correlated unless their states are scrambled (TEA, Zafar et al. 2010).
    high, low = mi.sample_tea_32(index, mi.UInt32(stream))
    return mi.PCG32(initstate=state ^ ((mi.UInt64(high) << 32) | mi.UInt64(low)), initseq=stream + mi.UInt64(index))


def stratified_point(index: mi.UInt32, count: int, rng: mi.PCG32) -> mi.Point2f:
    """Return one random point of the unit square for each stratum.

    The strata are equal pieces of a Z-order curve (Morton 1966), so that neighbours in number are neighbours in
    the square: rays of a packet stay together, and so do the memory accesses of what they find.

    Parameters
    ----------
    index
        Number of the stratum, 0 to count - 1.
    count
        Number of strata.
    rng
        Random numbers, one generator a lane.
    """
    along = mi.UInt32(((mi.UInt64(index) << 32) | mi.UInt64(rng.next_uint32())) // count)
    rest = rng.next_uint32()
    # 16 bits of each coordinate from the curve and 8 random ones fill a float32 below 1 exactly.
    x = (_even_bits(along) << 8) | (rest & 0xFF)
    y = (_even_bits(along >> 1) << 8) | ((rest >> 8) & 0xFF)
    return mi.Point2f(mi.Float(x), mi.Float(y)) * 2**-24


def unit_points(count: int) -> mi.Point2f:
    """Return points that fill the unit square evenly, always the same: a rank-1 lattice."""
    index = dr.arange(mi.Float, count)
    turns = index * 0.6180339887
    return mi.Point2f((index + 0.5) / count, turns - dr.floor(turns))


def _even_bits(number: mi.UInt32) -> mi.UInt32:
    """Return the 16 bits at even places, moved together."""
    number = number & 0x55555555
    number = (number | (number >> 1)) & 0x33333333
    number = (number | (number >> 2)) & 0x0F0F0F0F
    number = (number | (number >> 4)) & 0x00FF00FF
    return (number | (number >> 8)) & 0x0000FFFF
