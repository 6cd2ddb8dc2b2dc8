"""Enhancement of echoes from the water by waves that light crosses twice.

Waves focus light under water, and light returns best to its origin: through the same slopes. Among all pairs of ways
down and up between lidar and a point, those through nearby sea points have alike slopes. The mean over seas of the
irradiance times the visibility of the point, divided by the product of their means, is

    g = integral of N(d - o; (a z)^2 D(d)) over the distance d of the two points on the sea,

with the normal density N, the 2x2 structure function of slopes D(d), and a ray's displacement a z by a slope at the
depth z. The offset o is the displacement of one way against the other, by scattering or between laser and receiver. It
is exact for small Gaussian slopes. Slopes that are drawn anew on each way, such as ripples, have the constant D = 2 v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.validation import ArrayLike, FloatArray
from mitransient_lidar.physics.lidar.level_sea import turn_by_slope
from mitransient_lidar.physics.sea.wave_spectrum import SeaState, WaveSpectrum

#: Shortest wave, a capillary one [m], and longest distances over which slopes differ [m].
_SHORTEST_WAVE, _FARTHEST = 8.5e-4, 300.0

#: Least table depth [m]: above it few data exist on the waves that count, and depths are within them.
LEAST_DEPTH = 0.5

#: Nodes in wavenumber, in distance, and in the angle between distance and displacement.
_WAVENUMBERS, _DISTANCES, _ANGLES = 400, 120, 16

#: Displacements of a table [m]: the enhancement falls with their logarithm, below the first one by 0.2 % at most.
_DISPLACEMENTS = np.geomspace(1e-6, 3.0, 40)

_FAR_APART = 8.0  #: Ways whose displacement exceeds the displacement by slopes this many times are independent.


@dataclass(frozen=True, eq=False)
class SlopeStructure:
    """Slope structure functions of an isotropic sea against distance."""

    distance: FloatArray  #: Point distances [m], equally spaced in their logarithm.
    #: Mean square difference of the slopes along the distance and across it [1].
    along: FloatArray
    across: FloatArray

    def enhancement(self, spread: ArrayLike, displacement: ArrayLike) -> FloatArray:
        """Return the enhancement g [1].

        `spread`: displacement of a ray over the slope that causes it [m], a depth times a factor below 1; any shape.
        `displacement`: displacement of the two ways against each other [m]; broadcast with `spread`.
        """
        spreads, apart = np.broadcast_arrays(np.asarray(spread, np.float64), np.asarray(displacement, np.float64))
        found = np.ones(spreads.shape)
        near = apart**2 <= _FAR_APART**2 * spreads**2 * np.interp(apart, self.distance, self.across)
        spreads, apart = (one[near][:, None, None] for one in (spreads, apart))
        nodes, weights = np.polynomial.legendre.leggauss(_ANGLES)
        # Denser about the displacement's direction.
        angle = np.pi * (0.5 * (nodes + 1)) ** 2
        weight = weights * 0.5 * (nodes + 1) * np.pi
        d = self.distance[:, None]
        along, across = (spreads**2 * one[:, None] for one in (self.along, self.across))
        exponent = -0.5 * ((d - apart * np.cos(angle)) ** 2 / along + (apart * np.sin(angle)) ** 2 / across)
        density = np.exp(exponent) / (np.pi * np.sqrt(along * across))
        # At both ends of the distances nothing is left.
        step = np.log(self.distance[1] / self.distance[0])
        found[near] = step * (density @ weight @ self.distance**2)
        return found


@dataclass(frozen=True, eq=False)
class EnhancementTable:
    """Enhancement by depth and displacement."""

    depths: FloatArray  #: Depths [m], ascending, shape (depths,).
    values: FloatArray  #: Enhancements [1], shape (depths, displacements).

    @classmethod
    def of(cls, structure: SlopeStructure, depths: FloatArray, spread_per_depth: float) -> EnhancementTable:
        """Return a sea's table; `spread_per_depth` is a ray's displacement over depth and slope [1]."""
        spreads = spread_per_depth * depths[:, None]
        return cls(depths, structure.enhancement(spreads, _DISPLACEMENTS))

    def at(self, depth: ArrayLike, displacement: ArrayLike) -> FloatArray:
        """Return enhancements at depths and displacements [m], arrays that broadcast.

        They are linear in the logarithms of depth and displacement, and constant beyond the table. Above its first
        depth they fall to 1 at the surface.
        """
        z, apart = np.broadcast_arrays(np.asarray(depth, np.float64), np.asarray(displacement, np.float64))
        place, other = (
            np.interp(np.log(np.maximum(one, nodes[0])), np.log(nodes), np.arange(nodes.size))
            for one, nodes in ((z, self.depths), (apart, _DISPLACEMENTS))
        )
        low, left = (
            np.minimum(one.astype(np.intp), size - 2)
            for one, size in zip((place, other), self.values.shape, strict=True)
        )
        down, right = place - low, other - left
        first, second = (
            (1 - right) * self.values[row, left] + right * self.values[row, left + 1] for row in (low, low + 1)
        )
        found = (1 - down) * first + down * second
        return np.asarray(1 + (found - 1) * np.clip(z / self.depths[0], 0, 1))


def slope_spread(off_nadir: float, refractive_index: float) -> float:
    """Return the displacement of a ray over depth and slope [1], at an angle from the vertical in air [rad].

    The point at a depth moves by `turn_by_slope` across the plane of incidence, and by 1/cos^2(phi) times it in the
    plane, with the refracted angle phi. The result is the geometric mean.
    """
    cos_water = np.sqrt(1 - (np.sin(off_nadir) / refractive_index) ** 2)
    return float(turn_by_slope(off_nadir, refractive_index) / cos_water)


def slope_structures(
    spectrum: WaveSpectrum | SeaState, resolved_variance: float, ripple_variance: float
) -> tuple[SlopeStructure, SlopeStructure]:
    """Return the structure functions of a sea, and of the same sea with ripples drawn anew for each way.

    `spectrum`: spectrum of all waves. `resolved_variance`, `ripple_variance`: slope variances of longer waves and of
    ripples, both axes [1]. Ripples are the waves above the wavenumber at which the spectrum reaches the first variance,
    scaled to the second.
    """
    from scipy.special import j0, j1

    k = np.geomspace(0.1 * spectrum.peak_wavenumber, 2 * np.pi / _SHORTEST_WAVE, _WAVENUMBERS)
    slopes = np.asarray(spectrum.omnidirectional(k) * k**3)
    steps = np.gradient(np.log(k))
    variance = slopes * steps
    is_ripple = np.cumsum(variance) > resolved_variance
    ripples = np.where(is_ripple, variance, 0.0)
    ripples *= ripple_variance / max(float(ripples.sum()), 1e-30)
    distance = np.geomspace(1e-5, _FARTHEST, _DISTANCES)
    x = np.outer(distance, k)
    across = j1(x) / x
    along = j0(x) - across

    def structure(waves: FloatArray, independent: float) -> SlopeStructure:
        total = 0.5 * waves.sum() + independent
        return SlopeStructure(distance, *(2 * (total - kernel @ waves) for kernel in (along, across)))

    waves = np.where(is_ripple, 0.0, variance)
    return structure(waves + ripples, 0.0), structure(waves, 0.5 * ripple_variance)
