"""Spread of light by scattering on its way down to a depth and back up, drawn from the phase functions.

Light goes down from the surface, turns once, by the bottom or by one scattering event, and returns. On each way it
scatters any number of times and goes down (or up) all the time. By reciprocity both ways have the same distribution;
pairs of independent ways give that of the whole path. Light that changes more often between down and up is left out:
its share is about the square of backscattering times depth.
Two-way use of a beam spread function follows Katsev et al. (1997), J. Opt. Soc. Am. A 14, 1338,
doi:10.1364/JOSAA.14.001338; here ways are followed without a small-angle approximation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable

_LEVEL = 0.01  #: Least downward component of a direction: light that is more nearly level leaves beam and view.

_MOST_EVENTS = 200  #: Largest number of events of a way.

#: Ways, and pairs of them, for each path: paths are sorted by displacement, and one stands for its neighbours.
_WAYS, _PAIRS = 16, 8

_LEAST_SCATTERING = 1e-12  #: Least scattering coefficient, so that optical depths increase strictly [1/m].


@dataclass(frozen=True, eq=False)
class TwoWaySpread:
    """Paths that scatter forwards on at least one of their ways, by depth; arrays of shape (depths, paths).

    All are relative to the straight path along the axis, which is tilted towards +x, and sorted by displacement. The
    mean of a weight is the energy of scattered light over (1 - q^2) times the energy of light that meets absorption
    alone. Here q is the share of light that no event has turned on one way.
    """

    depths: FloatArray  #: Depths [m], increasing, shape (depths,).
    #: Displacement of the straight way that the light came down beside, from that in which it is seen [m].
    shift_x: FloatArray
    shift_y: FloatArray
    excess: FloatArray  #: Length of the path beyond the straight one [m].
    #: Weights of light that a horizontal Lambertian plane has turned, and that one scattering event has turned [1].
    of_bottom: FloatArray
    of_water: FloatArray
    events: IntArray  #: Number of scattering events without that one.
    #: Displacement of the way up from the straight one [m], and depths of the first events on the ways down and up over
    #: the depth, 1 without any.
    up_x: FloatArray
    up_y: FloatArray
    straight_down: FloatArray
    straight_up: FloatArray

    @classmethod
    def of_column(
        cls,
        column: WaterColumn,
        phases: Sequence[PowerLawTable],
        depths: FloatArray,
        cos_water: float,
        paths: int,
        seed: int = 0,
    ) -> TwoWaySpread:
        """Draw paths, the same ones for the same arguments.

        `column`, `phases`: layers of water, and the phase function of each. `depths`: depths [m], increasing, positive,
        shape (depths,). `cos_water`: cosine of the axis in the water from the vertical, above 0 to 1. `paths`: number
        of paths for each depth. `seed`: seed of the random numbers.
        """
        rng = np.random.default_rng(seed)
        ways = _Ways(column, phases, depths, cos_water, _WAYS * paths, rng)
        count = _PAIRS * paths
        found: list[list[FloatArray]] = []
        layers = column.layer_at(depths)
        for number, (layer, q) in enumerate(zip(layers, ways.unscattered, strict=True)):
            scattered = np.flatnonzero(ways.values[number, 7] > 0)
            mass = ways.share * scattered.size / (_WAYS * paths)
            shares = np.array([q * mass, q * mass, mass**2])
            if shares.sum() <= 0:
                found.append([np.zeros(paths)] * 8 + [np.ones(paths)] * 2)
                continue
            # The first part has scattered on the way down alone, the second on the way up, the third on both.
            ends = np.round(np.cumsum(shares) / shares.sum() * count).astype(int)
            place = np.arange(count)
            slant = 1 / ways.values[number, 6, scattered]
            down, up = (scattered[_drawn(slant, count, rng)] for _ in range(2))
            down[(place >= ends[0]) & (place < ends[1])] = up[place < ends[0]] = -1
            (x1, y1, e1, a1, *u1, n1, s1), (x2, y2, e2, a2, *u2, n2, s2) = (
                ways.values[number][:, one] for one in (down, up)
            )
            absorbed = np.exp(-(a1 + a2)) * shares.sum() / (1 - q**2)
            # More of the ways that end nearly level, of which few have most of the water's light.
            for one, ends in ((down, u1[2]), (up, u2[2])):
                absorbed *= np.where(one < 0, 1.0, ends * slant.mean())
            s = np.clip(0.5 + 0.5 * sum(first * second for first, second in zip(u1, u2, strict=True)), 1e-6, 1)
            phase = phases[layer].eval_s(s) / phases[layer].eval_s(1.0)
            of_water = absorbed * phase * cos_water**2 / (u1[2] * u2[2])
            # Seen at x, light has turned at x + (x2, y2), which that of the way down reaches from x + (x2 - x1, ...).
            groups = np.argsort(np.hypot(x2 - x1, y2 - y1)).reshape(paths, _PAIRS)
            # Long paths absorb more: each stands for its neighbours in proportion to what is left of it.
            kept = np.cumsum(absorbed[groups], axis=1)
            chosen = np.sum(kept < rng.random((paths, 1)) * kept[:, -1:], axis=1)
            one = np.take_along_axis(groups, chosen[:, None], axis=1)[:, 0]
            moved = [each[one] for each in (x2 - x1, y2 - y1, e1 + e2)]
            weights = (each[groups].mean(axis=1) for each in (absorbed, of_water))
            found.append([*moved, *weights, *(each[one] for each in (n1 + n2, x2, y2, s1, s2))])
        arrays = [np.array(each) for each in zip(*found, strict=True)]
        x, y, excess, of_bottom, of_water, events, *of_ways = arrays
        return cls(depths, x, y, excess, of_bottom, of_water, events.astype(np.int64), *of_ways)


class _Ways:
    """Ways down from the surface along a tilted axis, all with an event above the last depth.

    `share`: share of the light that meets an event above the last depth. `unscattered`: share of the light that has met
    none at each depth, shape (depths,). `values`: displacement x, y [m], excess length [m], excess absorption,
    direction x, y, z, number of events of ways at each depth, and depth of the first over it, shape
    (depths, 9, ways + 1). The number is 0 for ways that go up before it, and the last way is straight.
    """

    def __init__(
        self,
        column: WaterColumn,
        phases: Sequence[PowerLawTable],
        depths: FloatArray,
        cos_water: float,
        count: int,
        rng: np.random.Generator,
    ) -> None:
        deepest = float(depths[-1])
        tops = column.layer_tops[column.layer_tops < deepest]
        edges = np.append(tops, deepest)
        used = slice(0, tops.size)
        optical = np.append(0, np.cumsum(np.diff(edges) * np.maximum(column.scattering[used], _LEAST_SCATTERING)))
        absorbed = np.append(0, np.cumsum(np.diff(edges) * column.absorption[used]))
        whole = optical[-1] / cos_water
        self.share = -np.expm1(-whole)
        self.unscattered = np.exp(-np.interp(depths, edges, optical) / cos_water)
        axis = np.array([np.sqrt(1 - cos_water**2), 0.0, cos_water])
        self.values = np.zeros((depths.size, 9, count + 1))
        self.values[:, 4:7], self.values[:, 8] = axis[:, None], 1.0
        position, direction = np.zeros((3, count)), np.tile(axis[:, None], (1, count))
        length, depth_a, first = (np.zeros(count) for _ in range(3))
        alive = np.arange(count)
        # Stratified, so that the share of ways that have scattered above each depth has little noise.
        flight = -np.log1p(-self.share * (rng.permutation(count) + rng.random(count)) / count)
        for event in range(_MOST_EVENTS):
            below = np.interp(position[2], edges, optical) + flight * direction[2]
            z = np.where(below < optical[-1], np.interp(below, optical, edges), np.inf)
            first = first if event else z
            for number in np.flatnonzero(depths >= position[2].min(initial=np.inf)) if event else ():
                crosses = np.flatnonzero((position[2] < depths[number]) & (z >= depths[number]))
                step = (depths[number] - position[2][crosses]) / direction[2][crosses]
                ways = alive[crosses]
                run = length[crosses] + step
                tilt = depths[number] / cos_water
                x = position[0][crosses] + step * direction[0][crosses] - tilt * axis[0]
                y = position[1][crosses] + step * direction[1][crosses]
                above = np.interp([depths[number]], edges, absorbed) - np.interp(position[2][crosses], edges, absorbed)
                total = depth_a[crosses] + above / direction[2][crosses]
                more = total - np.interp(depths[number], edges, absorbed) / cos_water
                events = np.full(ways.shape, event)
                straight = first[ways] / depths[number]
                self.values[number][:, ways] = x, y, run - tilt, more, *direction[:, crosses], events, straight
            goes_on = np.isfinite(z)
            step = (z[goes_on] - position[2][goes_on]) / direction[2][goes_on]
            alive, position, direction = alive[goes_on], position[:, goes_on], direction[:, goes_on]
            depth_a = (
                depth_a[goes_on]
                + (np.interp(z[goes_on], edges, absorbed) - np.interp(position[2], edges, absorbed)) / direction[2]
            )
            length = length[goes_on] + step
            position = position + step * direction
            position[2] = z[goes_on]
            direction = _turned(direction, self._angles(column, phases, position[2], rng), rng)
            down = direction[2] > _LEVEL
            alive, position, direction = alive[down], position[:, down], direction[:, down]
            length, depth_a = length[down], depth_a[down]
            if not alive.size:
                break
            flight = rng.exponential(size=alive.size)

    @staticmethod
    def _angles(
        column: WaterColumn, phases: Sequence[PowerLawTable], depths: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """Return scattering angles at depths [rad]."""
        u, layers, theta = rng.random(depths.size), column.layer_at(depths), np.empty(depths.size)
        for layer in np.unique(layers):
            here = layers == layer
            theta[here] = scattering_angles(phases[layer], u[here])
        return theta


def _drawn(weights: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """Return numbers in random order, each about as often as its weight says."""
    sums = np.cumsum(weights)
    places = (np.arange(count) + rng.random(count)) * (sums[-1] / count)
    return rng.permutation(np.minimum(np.searchsorted(sums, places, side="right"), sums.size - 1))


def _turned(direction: FloatArray, theta: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return unit directions, shape (3, n), turned by angles [rad] to a random side."""
    azimuth = 2 * np.pi * rng.random(theta.size)
    # Frame of Duff et al. (2017), J. Comput. Graph. Tech. 6 (1); z is positive here.
    x, y, z = direction
    a = -1 / (1 + z)
    side = np.array([1 + x * x * a, x * y * a, -x])
    other = np.array([x * y * a, 1 + y * y * a, -y])
    sin = np.sin(theta)
    turned = sin * np.cos(azimuth) * side + sin * np.sin(azimuth) * other + np.cos(theta) * direction
    return np.asarray(turned / np.linalg.norm(turned, axis=0))


_NODES = 8192  #: Nodes in the inverse of a phase function's distribution.
LARGEST_ANGLE = np.radians(80.0)  #: Scattering by more is loss: the light has left the beam [rad].
_FAR = 1e6  #: Displacement in place of displacements by larger angles [m].


def scattering_angles(phase: PowerLawTable, u: FloatArray) -> FloatArray:
    """Return scattering angles [rad] of a phase function for uniform numbers."""
    theta = np.concatenate([[0.0], np.geomspace(1e-6, np.pi, _NODES)])
    return np.asarray(np.interp(u, phase.cdf_s(np.sin(theta / 2) ** 2), theta))


def displacements(
    column: WaterColumn,
    phases: Sequence[PowerLawTable],
    depths: FloatArray,
    most: int,
    count: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return displacements at depths by 0, 1, ... forward scattering events on a vertical way, as complex numbers [m].

    `column`, `phases`: water layers, and the phase function of each. `depths`: depths [m], shape (depths,), positive.
    `most`: largest number of events. `count`: number of samples. `rng`: random numbers.

    Result: shape (depths, most + 1, count). Events are at random optical depths of scattering. Angles above 80 degrees
    move light out of any beam.
    """
    found = np.zeros((depths.size, most + 1, count), np.complex128)
    tops = np.append(column.layer_tops, np.inf)
    # The same random numbers at all depths.
    u, along, turn = rng.random((3, most, count))
    angles = {id(phase): scattering_angles(phase, u) for phase in phases}
    for number, depth in enumerate(depths):
        edges = np.append(tops[tops < depth], depth)
        b = column.scattering[: edges.size - 1]
        optical = np.append(0.0, np.cumsum(b * np.diff(edges)))
        place = optical[-1] * along
        layer = np.clip(np.searchsorted(optical, place, side="right") - 1, 0, b.size - 1)
        where = edges[layer] + (place - optical[layer]) / np.where(b > 0, b, 1.0)[layer]
        theta = np.empty(place.shape)
        for one in np.unique(layer):
            theta[layer == one] = angles[id(phases[one])][layer == one]
        moved = np.where(theta < LARGEST_ANGLE, np.tan(np.minimum(theta, LARGEST_ANGLE)) * (depth - where), _FAR)
        found[number, 1:] = np.cumsum(moved * np.exp(2j * np.pi * turn), axis=0)
    return found
