"""Fast estimate of the echoes of sea surface, water and a level bottom, without tracing rays.

Light is the lidar equation's, on the lines of sight of a level sea. Scattering moves and delays it: paths scatter
forwards a random number of times at random depths, and each event shifts all that follows by the tangent of its angle
times the remaining distance. One scattering by a large angle, or the bottom, turns the path. Shifts on the way down
move the point that is lit, and with it the time; those on the way up move only the direction from which its light is
seen.

Directions that forward scattering has spread matter to the water and not to the bottom: per depth, light along a slant
meets more water, by 1/cos, and it returns by other angles than 180 degrees. The energy that a level Lambertian bottom
receives and returns through a horizontal plane is the same for all directions. The signal of a column thus decays more
slowly than the echoes of bottoms.
Two-way use of the beam spread function in this way follows Katsev et al. (1997), J. Opt. Soc. Am. A 14, 1338,
doi:10.1364/JOSAA.14.001338, and Walker and McLean (1999), Appl. Opt. 38, 2384, doi:10.1364/AO.38.002384; angles are
drawn from the phase function here, since its moments describe sea water badly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.lidar.level_sea import fresnel, snell, surface_time_ns, turn_by_slope
from mitransient_lidar.physics.lidar.lidar_geometry import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.two_way_spread import LARGEST_ANGLE, scattering_angles

#: Nodes of phase functions at the angles by which paths turn, in sin^2(theta/2).
_BACKWARD = np.linspace(0.05, 1, 192)


class Arrivals(NamedTuple):
    """Light that comes back; arrays of one shape."""

    angle_x: FloatArray  #: Direction in the tangent plane of the receiver, away from nadir [rad].
    angle_y: FloatArray  #: And to the left [rad].
    time_ns: FloatArray  #: Time since the light left the transmitter [ns].
    energy: FloatArray  #: Energy received [J].


@dataclass(frozen=True)
class EchoEstimate:
    """Lidar over a level sea and a level Lambertian bottom, transmitter and receiver at one place with one axis."""

    system: LidarSystem  #: The lidar; its energy and its indices.
    column: WaterColumn  #: Layers of the water.
    phases: Sequence[PowerLawTable]  #: Phase function of each layer.
    slope_covariance: FloatArray  #: Of waves and ripples together, away from nadir and to the left, shape (2, 2).
    bottom_depth: float  #: Depth of the bottom, or of the last light from the water without one [m].
    reflectance: float  #: Lambertian reflectance of the bottom, 0 to 1.
    #: Enhancement by waves that light crosses twice [1], of depths and displacements [m]; None for independent slopes.
    enhancement: Callable[[FloatArray, FloatArray], FloatArray] | None = None
    #: Density of the surface's slopes, shape (n, 2), over the Gaussian one [1]; None for Gaussian slopes.
    slope_ratio: Callable[[FloatArray], FloatArray] | None = None

    def surface(self, beam: FloatArray) -> Arrivals:
        """Return the glint of points of the beam in the tangent plane [rad], shape (n, 2), each of 1/n of the energy.

        Glint by Cox and Munk (1954), doi:10.1364/JOSA.44.000838, without shadows.
        """
        theta, azimuth = self._rays(*beam.T)
        slopes = np.tan(theta)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        exponent = np.einsum("ni,ij,nj->n", slopes, np.linalg.inv(self.slope_covariance), slopes)
        density = np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(np.linalg.det(self.slope_covariance)))
        if self.slope_ratio is not None:
            density = density * np.maximum(self.slope_ratio(slopes), 0.0)
        reflectance, _ = fresnel(0.0, self.system.refractive_index)
        geometry = self.system.aperture_area / (4 * np.cos(theta) ** 3 * self.system.height**2)
        energy = self.system.energy * reflectance * density * geometry / len(beam)
        return Arrivals(beam[:, 0], beam[:, 1], surface_time_ns(self.system.height, theta), energy)

    def water_and_bottom(
        self, beam: FloatArray, steps: int, rng: np.random.Generator, *, every_depth: bool = False
    ) -> tuple[Arrivals, Arrivals]:
        """Return the light of the water, in `steps` of equal depth, and of the bottom, of points of the beam.

        The points are those of `surface`. Arrays are of shape (n, steps) and (n, 1), or with `every_depth`, of bottoms
        in the middle of each step, (n, steps).
        """
        spread = self._scattered(len(beam), steps, rng)
        thickness = self.bottom_depth / steps
        # One offset for all paths: the sum over the steps is a rectangle rule with a random start.
        depths = np.asarray(thickness * (np.arange(steps) + rng.random()), dtype=np.float64)
        theta, _ = self._rays(*beam.T)
        cosine = np.cos(snell(theta, self.system.refractive_index))[:, None]
        none = np.zeros(self.column.count)
        absorbing = WaterColumn(self.column.layer_tops, self.column.absorption, none, none)
        ripples = [self._ripples(len(beam), rng)[:, None] for _ in range(2)]

        def arrivals(depth: FloatArray, returned: FloatArray) -> Arrivals:
            in_water = depth / self.system.cos_water
            *shifts, delay, kept = spread.at(in_water)
            distance = self.system.slant_range + in_water / self.system.refractive_index
            down, up = ((shift + tilt * in_water) / distance for shift, tilt in zip(shifts, ripples, strict=True))
            lit = beam[:, :1] + 1j * beam[:, 1:] + down
            to_lit, _ = self._rays(lit.real, lit.imag)
            slant = depth / np.cos(snell(to_lit, self.system.refractive_index))
            time = 2e9 / C0 * (self.system.height / np.cos(to_lit) + self.system.group_index * slant) + delay
            gain = self.system.water_gain(depth, theta[:, None])
            lost = np.exp(-2 * absorbing.cumulative(depth) / cosine)
            seen = lit + up
            if self.enhancement is not None:
                kept = kept * self.enhancement(depth, np.abs(shifts[0] + shifts[1]))
            return Arrivals(seen.real, seen.imag, time, gain * returned * lost * kept / len(beam))

        backscatter = self._backscatter(depths, *spread.tilts(depths / self.system.cos_water))
        water = arrivals(depths, np.asarray(backscatter * thickness / cosine))
        bottoms = np.asarray(thickness * (np.arange(steps) + 0.5) if every_depth else [self.bottom_depth])
        return water, arrivals(bottoms, self.reflectance / np.pi * cosine)

    def _backscatter(self, depths: FloatArray, down: FloatArray, up: FloatArray) -> FloatArray:
        """Return the backscatter per depth of light that arrives and returns in directions [1/(m sr)].

        Directions are tangents of their angles from the ray that is not scattered, as complex numbers.
        """
        lengths = [np.minimum(np.sqrt(1 + np.abs(one) ** 2), 1 / np.cos(LARGEST_ANGLE)) for one in (down, up)]
        both = lengths[0] * lengths[1]
        s = np.clip(0.5 + 0.5 * (1 - (down * up.conj()).real) / both, _BACKWARD[0], 1)
        found = np.empty(s.shape)
        layers = self.column.layer_at(depths)
        for one in np.unique(layers):
            values = self.column.scattering[one] * self.phases[one].eval_s(_BACKWARD)
            found[:, layers == one] = np.interp(s[:, layers == one], _BACKWARD, values)
        return np.asarray(found * both)

    def _rays(self, angle_x: FloatArray, angle_y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return angle from the vertical and azimuth [rad] of points in the tangent plane."""
        sin, cos = np.sin(self.system.off_nadir), np.cos(self.system.off_nadir)
        down, forward = cos - angle_x * sin, sin + angle_x * cos
        return np.arctan2(np.hypot(forward, angle_y), down), np.arctan2(angle_y, forward)

    def _ripples(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Return deflections by slopes where light enters or leaves the water [rad], as complex numbers.

        Slopes are Gaussian here.
        """
        root = np.linalg.cholesky(self.slope_covariance)
        slopes = rng.standard_normal((count, 2)) @ root.T
        turn = turn_by_slope(self.system.off_nadir, self.system.refractive_index)
        return np.asarray(turn * (slopes[:, 0] + 1j * slopes[:, 1]))

    def _scattered(self, count: int, steps: int, rng: np.random.Generator) -> _Spread:
        """Draw the forward scattering of paths, at slant distances to the bottom, on the way down and up."""
        tops = np.append(self.column.layer_tops, np.inf)
        edges = np.append(tops[tops < self.bottom_depth], self.bottom_depth) / self.system.cos_water
        b = self.column.scattering[: edges.size - 1]
        optical = np.append(0.0, np.cumsum(b * np.diff(edges)))
        number = rng.poisson(2 * optical[-1], count)
        path = np.repeat(np.arange(count), number)
        place = optical[-1] * rng.random(path.size)
        # Where nothing scatters, optical depths repeat: the last of equal ones is that of the layer below.
        layer = np.clip(np.searchsorted(optical, place, side="right") - 1, 0, b.size - 1)
        distance = edges[layer] + (place - optical[layer]) / np.where(b > 0, b, 1.0)[layer]
        u, theta = rng.random(path.size), np.zeros(path.size)
        for one in np.unique(layer):
            theta[layer == one] = scattering_angles(self.phases[one], u[layer == one])
        is_lost = theta > LARGEST_ANGLE
        end = np.full(count, np.inf)
        np.minimum.at(end, path[is_lost], distance[is_lost])
        path, distance, theta, layer = (each[~is_lost] for each in (path, distance, theta, layer))
        turn = np.tan(theta) * np.exp(2j * np.pi * rng.random(path.size))
        grid = np.linspace(0, edges[-1], steps + 1)
        cell = path * steps + np.minimum(np.searchsorted(grid, distance, side="right") - 1, steps - 1)
        detour = 1 / np.cos(theta) - 1
        is_down = rng.random(path.size) < 0.5
        turns = [part * leg for leg in (is_down, ~is_down) for part in (turn.real, turn.imag)]
        weights = *turns, detour / (2 * self.system.metres_per_ns), detour * self.column.absorption[layer]
        return _Spread(cell, distance, weights, end, grid, count)


class _Spread:
    """Sums over scattering events, which are linear in the distance beyond each event."""

    def __init__(
        self,
        cell: IntArray,
        distance: FloatArray,
        weights: Sequence[FloatArray],
        end: FloatArray,
        grid: FloatArray,
        count: int,
    ) -> None:
        self._end, self._grid = end, grid
        shape = count, grid.size - 1

        def summed(values: FloatArray) -> FloatArray:
            """Return sums over the events of each path before each node of the grid."""
            found = np.bincount(cell, values, shape[0] * shape[1]).reshape(shape)
            return np.pad(np.cumsum(found, axis=1), ((0, 0), (1, 0)))

        self._sums = [(summed(weight), summed(weight * distance)) for weight in weights]

    def at(self, distance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return shifts on the way down and up [m], delay [ns] and share of the energy that is kept at distances [m].

        Shifts are complex numbers, away from nadir and to the left. Sums are linear between the nodes of the grid, as
        if events within a cell were spread along it.
        """
        low, part = self._place(distance)

        def beyond(sums: tuple[FloatArray, FloatArray]) -> FloatArray:
            nodes = [self._grid[node] * sums[0][:, node] - sums[1][:, node] for node in (low, low + 1)]
            return np.asarray((1 - part) * nodes[0] + part * nodes[1])

        down_x, down_y, up_x, up_y, delay, absorbed = map(beyond, self._sums)
        kept = np.where(self._end[:, None] > distance, np.exp(-absorbed), 0.0)
        return down_x + 1j * down_y, up_x + 1j * up_y, delay, kept

    def tilts(self, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sums of the tangents of the angles on the way down and up at distances [m], as complex numbers."""
        low, part = self._place(distance)
        x, y, up_x, up_y = ((1 - part) * sums[:, low] + part * sums[:, low + 1] for sums, _ in self._sums[:4])
        return x + 1j * y, up_x + 1j * up_y

    def _place(self, distance: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the node before distances and the part of the cell behind it."""
        last = self._grid.size - 1
        place = np.clip(distance / self._grid[-1] * last, 0, last)
        low = np.minimum(place.astype(np.intp), last - 1)
        return low, place - low
