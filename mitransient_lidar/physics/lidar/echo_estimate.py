"""Fast estimate of the light of homogeneous water and of level bottoms in it, without tracing rays.

Light is the lidar equation's, on the axis of a level sea. Scattering moves and delays it: paths scatter forwards a
random number of times at random depths. Each event shifts all that follows by the tangent of its angle times the
remaining distance. One scattering by a large angle, or the bottom, turns the path. Shifts on the way down move the
point that is lit, and with it the time. Shifts on the way up move only the direction from which its light is seen.

Directions that forward scattering has spread matter to the water and not to the bottom. Per depth, light along a slant
meets more water, by 1/cos, and it returns by other angles than 180 degrees. The energy that a level Lambertian bottom
receives and returns through a horizontal plane is the same for all directions. The signal of a column thus decays more
slowly than the echoes of bottoms. Two-way use of the beam spread function in this way follows Katsev et al. (1997), J.
Opt. Soc. Am. A 14, 1338, doi:10.1364/JOSAA.14.001338, and Walker and McLean (1999), Appl. Opt. 38, 2384,
doi:10.1364/AO.38.002384; angles are drawn from the phase function here, since its moments describe sea water badly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, snell, turn_by_slope
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import LARGEST_ANGLE, scattering_angles

#: Nodes of phase functions at the angles by which paths turn, in sin^2(theta/2).
_BACKWARD = np.linspace(0.05, 1, 192)


class Arrivals(NamedTuple):
    """Light that comes back; arrays of one shape."""

    shift: (
        FloatArray  #: Direction in the tangent plane of the receiver [rad], as complex numbers: from nadir, and left.
    )
    time_ns: FloatArray  #: Time since the light left the transmitter [ns].
    energy: FloatArray  #: Energy received [J].


def water_and_bottoms(
    system: LidarSystem,
    coefficients: tuple[float, float],
    phase: PowerLawTable,
    slope_variance: float,
    depth: float,
    shape: tuple[int, int],
    rng: np.random.Generator,
) -> tuple[Arrivals, Arrivals]:
    """Return the light of water, and of bottoms of reflectance pi in the middle of each of its steps of equal depth.

    `system`: transmitter and receiver, at one place with one axis. `coefficients`: absorption and scattering of the
    water [1/m], the latter above 0. `phase`: its phase function. `slope_variance`: total variance of the Gaussian
    slopes of waves and ripples [1]. `depth`: depth of the last light [m]. `shape`: number of paths, and of steps: the
    shape of the results. `rng`: source of random numbers.
    """
    (a, b), (paths, steps) = coefficients, shape
    spread = _scattered(system, coefficients, phase, depth, shape, rng)
    thickness = depth / steps
    # One offset for all paths: the sum over the steps is a rectangle rule with a random start.
    depths = np.asarray(thickness * (np.arange(steps) + rng.random()), dtype=np.float64)
    theta = _off_nadir(system, np.zeros(1, dtype=np.complex128))
    cosine = np.cos(snell(theta, system.refractive_index))
    # Deflections by slopes where light enters and leaves the water.
    turn = turn_by_slope(system.off_nadir, system.refractive_index)
    slopes = [np.sqrt(0.5 * slope_variance) * rng.standard_normal((paths, 2)) for _ in range(2)]
    ripples = [turn * (one[:, :1] + 1j * one[:, 1:]) for one in slopes]

    def arrivals(depth: FloatArray, returned: FloatArray) -> Arrivals:
        in_water = depth / system.cos_water
        *shifts, delay, kept = spread.at(in_water)
        distance = system.slant_range + in_water / system.refractive_index
        down, up = ((shift + tilt * in_water) / distance for shift, tilt in zip(shifts, ripples, strict=True))
        to_lit = _off_nadir(system, down)
        slant = depth / np.cos(snell(to_lit, system.refractive_index))
        time = 2e9 / C0 * (system.height / np.cos(to_lit) + system.group_index * slant) + delay
        lost = np.exp(-2 * a * depth / cosine)
        return Arrivals(down + up, time, system.water_gain(depth, theta) * returned * lost * kept / paths)

    backscatter = _backscatter(b, phase, *spread.tilts(depths / system.cos_water))
    water = arrivals(depths, np.asarray(backscatter * thickness / cosine))
    return water, arrivals(np.asarray(thickness * (np.arange(steps) + 0.5)), cosine)


def _off_nadir(system: LidarSystem, angle: FloatArray) -> FloatArray:
    """Return the angle from the vertical of directions in the tangent plane [rad]."""
    sin, cos = np.sin(system.off_nadir), np.cos(system.off_nadir)
    return np.asarray(np.arctan2(np.hypot(sin + angle.real * cos, angle.imag), cos - angle.real * sin))


def _backscatter(b: float, phase: PowerLawTable, down: FloatArray, up: FloatArray) -> FloatArray:
    """Return the backscatter per depth of light that arrives and returns in directions [1/(m sr)].

    Directions are tangents of their angles from the ray that is not scattered, as complex numbers.
    """
    lengths = [np.minimum(np.sqrt(1 + np.abs(one) ** 2), 1 / np.cos(LARGEST_ANGLE)) for one in (down, up)]
    both = lengths[0] * lengths[1]
    s = np.clip(0.5 + 0.5 * (1 - (down * up.conj()).real) / both, _BACKWARD[0], 1)
    return np.asarray(np.interp(s, _BACKWARD, b * phase.eval_s(_BACKWARD)) * both)


def _scattered(
    system: LidarSystem,
    coefficients: tuple[float, float],
    phase: PowerLawTable,
    depth: float,
    shape: tuple[int, int],
    rng: np.random.Generator,
) -> _Spread:
    """Draw the forward scattering of paths, at slant distances to the last light, on the way down and up."""
    (a, b), (count, steps) = coefficients, shape
    longest = depth / system.cos_water
    number = rng.poisson(2 * b * longest, count)
    path = np.repeat(np.arange(count), number)
    distance = b * longest * rng.random(path.size) / b
    theta = scattering_angles(phase, rng.random(path.size))
    is_lost = theta > LARGEST_ANGLE
    end = np.full(count, np.inf)
    np.minimum.at(end, path[is_lost], distance[is_lost])
    path, distance, theta = (each[~is_lost] for each in (path, distance, theta))
    turn = np.tan(theta) * np.exp(2j * np.pi * rng.random(path.size))
    grid = np.linspace(0, longest, steps + 1)
    cell = path * steps + np.minimum(np.searchsorted(grid, distance, side="right") - 1, steps - 1)
    detour = 1 / np.cos(theta) - 1
    is_down = rng.random(path.size) < 0.5
    turns = [part * leg for leg in (is_down, ~is_down) for part in (turn.real, turn.imag)]
    weights = (*turns, detour / (2 * system.metres_per_ns), detour * a)

    def summed(values: FloatArray) -> FloatArray:
        """Return sums over the events of each path before each node of the grid."""
        found = np.bincount(cell, values, count * steps).reshape(shape)
        return np.pad(np.cumsum(found, axis=1), ((0, 0), (1, 0)))

    return _Spread(grid, end, [(summed(weight), summed(weight * distance)) for weight in weights])


class _Spread(NamedTuple):
    """Sums over scattering events, which are linear in the distance beyond each event."""

    grid: FloatArray  #: Nodes of the distance [m].
    end: FloatArray  #: Distance at which each path is lost [m].
    sums: list[tuple[FloatArray, FloatArray]]  #: Of weights, and of these times distances, before each node.

    def at(self, distance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return shifts on the way down and up [m], delay [ns] and share of the energy that is kept at distances [m].

        Shifts are complex numbers, away from nadir and to the left. Sums are linear between the nodes of the grid, as
        if events within a cell were spread along it.
        """
        low, part = self._place(distance)

        def beyond(sums: tuple[FloatArray, FloatArray]) -> FloatArray:
            nodes = [self.grid[node] * sums[0][:, node] - sums[1][:, node] for node in (low, low + 1)]
            return np.asarray((1 - part) * nodes[0] + part * nodes[1])

        down_x, down_y, up_x, up_y, delay, absorbed = map(beyond, self.sums)
        kept = np.where(self.end[:, None] > distance, np.exp(-absorbed), 0.0)
        return down_x + 1j * down_y, up_x + 1j * up_y, delay, kept

    def tilts(self, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sums of the tangents of the angles on the way down and up at distances [m], as complex numbers."""
        low, part = self._place(distance)
        x, y, up_x, up_y = ((1 - part) * sums[:, low] + part * sums[:, low + 1] for sums, _ in self.sums[:4])
        return x + 1j * y, up_x + 1j * up_y

    def _place(self, distance: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the node before distances and the part of the cell behind it."""
        last = self.grid.size - 1
        place = np.clip(distance / self.grid[-1] * last, 0, last)
        low = np.minimum(place.astype(np.intp), last - 1)
        return low, place - low
