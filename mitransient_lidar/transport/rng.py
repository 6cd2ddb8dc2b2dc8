"""Random numbers in a pass: independent streams for each path in each shot, and random shifts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.opaque import aligned, changed, opaque_index

#: An array of Dr.Jit with one entry a shot, or an object that holds such arrays.
Tree = TypeVar("Tree")


@dataclass(frozen=True)
class Lanes:
    """Kernel lanes that belong to the shots in a pass."""

    shots: int  #: Number of shots.
    #: Each lane's shot number, and its path's number within the shot.
    shot: mi.UInt32
    number: mi.UInt32

    @classmethod
    def of_paths(cls, lane: mi.UInt32, shots: int, per_shot: int) -> Lanes:
        """Return lanes from path numbers, `per_shot` in each shot, one shot after the other."""
        if shots == 1:
            return cls(1, mi.UInt32(0), lane)
        paths = dr.opaque(mi.UInt32, per_shot)
        shot = lane // paths
        return cls(shots, shot, lane - shot * paths)

    def pick(self, tree: Tree) -> Tree:
        """Return the lanes' entries in an array with one entry per shot, or in an object that holds such arrays.

        An object names its arrays, and the objects that hold others, in ``OF_SHOTS``; one-entry arrays apply to all
        shots. A pose names its ``lanes``, and looks up its own numbers as kernels need them.
        """
        picked: Tree = _each_array(tree, lambda values: dr.gather(type(values), values, self.shot), self)
        return picked


def tiled(tree: Tree, copies: int) -> Tree:
    """Return an object that holds arrays with one entry a shot, for shots that are each repeated several times."""
    repeated: Tree = _each_array(tree, lambda values: dr.repeat(values, copies))
    return repeated


def starts(shots: int, size: int, copies: int = 1) -> mi.UInt32:
    """Return the number of the first of `size` entries in each shot; several copies in turn share it."""
    if shots * copies == 1:
        return mi.UInt32(0)
    return aligned(mi.UInt32, np.repeat(np.arange(shots) * size, copies))


def _each_array(tree: Any, change: Callable[[Any], Any], lanes: Lanes | None = None) -> Any:
    """Return a tree with its arrays of several shots changed."""
    if dr.is_array_v(tree):
        return change(tree) if dr.width(tree) > 1 else tree
    if isinstance(tree, list | tuple):
        return type(tree)(_each_array(part, change, lanes) for part in tree)
    names = getattr(tree, "OF_SHOTS", None)
    if names is None:
        return tree
    own = {name: _each_array(getattr(tree, name), change, lanes) for name in names}
    return changed(tree, **({"lanes": lanes} if names == ("lanes",) else own))


class Shots:
    """Shots in a pass, each with a seed: a shot's random numbers do not depend on the other shots."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self.count = len(seeds)
        self._seeds = [int(seed) for seed in seeds]

    def paths(self, per_shot: int) -> Lanes:
        """Return the lanes for `per_shot` paths in each shot."""
        return Lanes.of_paths(dr.arange(mi.UInt32, self.count * per_shot), self.count, per_shot)

    def streams(self, purpose: int, lanes: Lanes) -> mi.PCG32:
        """Return independent random number generators for stage number `purpose` in a pass."""
        words = [np.random.SeedSequence([seed, purpose]).generate_state(2, np.uint64) for seed in self._seeds]
        # Arrays, so that all seeds share a kernel.
        state, stream = (lanes.pick(aligned(mi.UInt64, word)) for word in np.array(words).T)
        # Neighbouring streams of PCG32 are correlated unless their states are scrambled (TEA, Zafar et al. 2010).
        high, low = mi.sample_tea_32(lanes.number, mi.UInt32(stream))
        scrambled = state ^ ((mi.UInt64(high) << 32) | mi.UInt64(low))
        return mi.PCG32(initstate=scrambled, initseq=stream + mi.UInt64(lanes.number))

    def uniform(self, purpose: int, count: int) -> list[mi.Float]:
        """Return `count` arrays of uniform random numbers, one number a shot."""
        drawn = [np.random.default_rng([seed, purpose]).random(count, np.float32) for seed in self._seeds]
        return [aligned(mi.Float, column) for column in np.array(drawn).T]

    def keys(self, lanes: Lanes) -> mi.UInt32:
        """Return 32 bits from the seeds."""
        bits = np.array([seed & 0xFFFFFFFF for seed in self._seeds], np.uint32)
        return lanes.pick(aligned(mi.UInt32, bits))


def pass_streams(seed: int, purpose: int, count: int) -> mi.PCG32:
    """Return independent random number generators for `count` paths, for stage number `purpose` in a pass."""
    shots = Shots([seed])
    return shots.streams(purpose, shots.paths(count))


def stratified_point(index: mi.UInt32, count: int | mi.UInt64, rng: mi.PCG32) -> mi.Point2f:
    """Return a random point in stratum number `index` of `count` in the unit square.

    The strata are equal pieces of a Z-order curve (Morton 1966). Neighbours in number are neighbours in the square: the
    rays in a packet and their memory accesses stay together.
    """
    # Dr.Jit compiles another kernel for every number by which it divides.
    strata = dr.opaque(mi.UInt64, count) if isinstance(count, int) else count
    along = mi.UInt32(((mi.UInt64(index) << 32) | mi.UInt64(rng.next_uint32())) // strata)
    rest = rng.next_uint32()
    # 16 bits of each coordinate from the curve and 8 random ones fill a float32 below 1 exactly.
    x = (_even_bits(along) << 8) | (rest & 0xFF)
    y = (_even_bits(along >> 1) << 8) | ((rest >> 8) & 0xFF)
    return mi.Point2f(mi.Float(x), mi.Float(y)) * 2**-24


def interleaved_point(index: mi.UInt32, count: int, sets: int, rng: mi.PCG32) -> mi.Point2f:
    """Return stratified points for `sets` sets, to which the lanes number `index` of `count` belong in turn."""
    if count % sets == 0:
        return stratified_point(index // sets, count // sets, rng)
    return stratified_point(index // sets, mi.UInt64((opaque_index(count + sets - 1) - index % sets) // sets), rng)


def unit_points(count: int, index: mi.UInt32 | None = None) -> mi.Point2f:
    """Return the points of a rank-1 lattice with `count` points in the unit square, by number or all."""
    number = dr.arange(mi.Float, count) if index is None else mi.Float(index)
    y = number * 0.6180339887
    return mi.Point2f((number + 0.5) / count, y - dr.floor(y))


def _even_bits(number: mi.UInt32) -> mi.UInt32:
    """Return the 16 bits at even places, next to each other."""
    number = number & 0x55555555
    number = (number | (number >> 1)) & 0x33333333
    number = (number | (number >> 2)) & 0x0F0F0F0F
    number = (number | (number >> 4)) & 0x00FF00FF
    return (number | (number >> 8)) & 0x0000FFFF
