"""Lanes of shots: what each picks of objects that hold arrays with one entry a shot."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.transport.rng import Lanes, starts, tiled


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
