"""Random numbers of a pass: independent streams for each path, and random shifts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def pass_streams(seed: int, purpose: int, count: int) -> mi.PCG32:
    """Return independent random number generators for `count` paths, of stage number `purpose` of a pass."""
    words = np.random.SeedSequence([seed, purpose]).generate_state(2, np.uint64)
    # Opaque, so that all seeds share a kernel.
    state, stream = (dr.opaque(mi.UInt64, int(word)) for word in words)
    index = dr.arange(mi.UInt32, count)
    # Neighbouring streams of PCG32 are correlated unless their states are scrambled (TEA, Zafar et al. 2010).
    high, low = mi.sample_tea_32(index, mi.UInt32(stream))
    return mi.PCG32(initstate=state ^ ((mi.UInt64(high) << 32) | mi.UInt64(low)), initseq=stream + mi.UInt64(index))


def stratified_point(index: mi.UInt32, count: int, rng: mi.PCG32) -> mi.Point2f:
    """Return a random point of the unit square in stratum number `index` of `count`.

    The strata are equal pieces of a Z-order curve (Morton 1966): neighbours in number are neighbours in the square, so
    that rays of a packet and their memory accesses stay together.
    """
    along = mi.UInt32(((mi.UInt64(index) << 32) | mi.UInt64(rng.next_uint32())) // count)
    rest = rng.next_uint32()
    # 16 bits of each coordinate from the curve and 8 random ones fill a float32 below 1 exactly.
    x = (_even_bits(along) << 8) | (rest & 0xFF)
    y = (_even_bits(along >> 1) << 8) | ((rest >> 8) & 0xFF)
    return mi.Point2f(mi.Float(x), mi.Float(y)) * 2**-24


def unit_points(count: int) -> mi.Point2f:
    """Return the points of a rank-1 lattice in the unit square."""
    index = dr.arange(mi.Float, count)
    y = index * 0.6180339887
    return mi.Point2f((index + 0.5) / count, y - dr.floor(y))


def _even_bits(number: mi.UInt32) -> mi.UInt32:
    """Return the 16 bits at even places, next to each other."""
    number = number & 0x55555555
    number = (number | (number >> 1)) & 0x33333333
    number = (number | (number >> 2)) & 0x0F0F0F0F
    number = (number | (number >> 4)) & 0x00FF00FF
    return (number | (number >> 8)) & 0x0000FFFF
