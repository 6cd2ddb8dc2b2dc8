"""Corrections of a bottom echo's depth and strength for the sea surface slope.

Slopes are rises over runs, positive `along` the lidar's azimuth for a face towards the lidar; angles in rad.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import cos_in_water, fresnel


@dataclass(frozen=True)
class SlopeRefraction:
    """Ray refracted into the water by a sloping surface; arrays of one shape."""

    #: Cosines of the ray's angles from the facet's normal in air and water.
    cos_air: FloatArray
    cos_water: FloatArray
    cos_vertical: FloatArray  #: Cosine of the ray's angle from the vertical in the water.

    @classmethod
    def of(cls, along: npt.ArrayLike, across: npt.ArrayLike, off_nadir: float, n: float) -> SlopeRefraction:
        """Refract a ray at a facet, by Snell's law w = d/n + (cos_air/n - cos_water) m with the normal m.

        The facet's slopes [1] broadcast; NaN, and a ray that meets the facet from below, give NaN. The ray's angle in
        air from the vertical [rad] is 0 to below pi/2, and the water's refractive index at least 1.
        """
        a, b = np.broadcast_arrays(np.asarray(along, dtype=np.float64), np.asarray(across, dtype=np.float64))
        length = np.sqrt(1 + a**2 + b**2)
        cos_air = (a * np.sin(off_nadir) + np.cos(off_nadir)) / length
        cos_air = np.where(cos_air > 0, cos_air, np.nan)
        cos_water = cos_in_water(cos_air, n)
        return cls(cos_air, cos_water, np.cos(off_nadir) / n + (cos_water - cos_air / n) / length)


def bottom_depth(
    surface_range: npt.ArrayLike, path: npt.ArrayLike, height: float, off_nadir: float, ray: SlopeRefraction
) -> FloatArray:
    """Return a bottom point's depth below the mean sea level [m], corrected for the surface's height and slope.

    It is D = R cos(theta) - H + s cos(alpha), with the paths along the ray in air, R, and in the water, s [m]. H is the
    lidar's height above the mean sea level [m], and theta the ray's angle from the vertical in air [rad].

    Notes
    -----
    A face away from the lidar refracts the ray towards the vertical. The path to the bottom is shorter (Tulldahl 2006,
    FOI-R-2074-SE, figure 12), and a depth with a level sea's angle is too small. Assumptions: the beam follows the axis
    through a plane, and scattering does not change the echo time.
    """
    distance, length = np.asarray(surface_range, dtype=np.float64), np.asarray(path, dtype=np.float64)
    return np.asarray(distance * np.cos(off_nadir) - height + length * ray.cos_vertical)


def bottom_gain(surface_range: npt.ArrayLike, path: npt.ArrayLike, n: float, ray: SlopeRefraction) -> FloatArray:
    """Return a Lambertian bottom's gain under a sloping surface [1/m^2], without attenuation in the water.

    It is T^2 cos(alpha)/(S_s S_t), for an echo with the energy E A (rho/pi) gain exp(-2 K s); for a level sea it equals
    `lidar_geometry`'s. Paths are as for `bottom_depth`, n is the water's refractive index.

    Notes
    -----
    T is the facet's Fresnel transmittance. By Snell's law, a narrow pencil from the bottom point spreads through a
    plane with S_s = n R + s across the plane of incidence, and S_t = n R cos_water/cos_air + s cos_air/cos_water in it.
    """
    distance, length = np.asarray(surface_range, dtype=np.float64), np.asarray(path, dtype=np.float64)
    known = np.isfinite(ray.cos_air)
    _, transmittance = fresnel(np.arccos(np.clip(np.where(known, ray.cos_air, 1.0), 0, 1)), n)
    sagittal = n * distance + length
    tangential = n * distance * ray.cos_water / ray.cos_air + length * ray.cos_air / ray.cos_water
    return np.asarray(transmittance**2 * ray.cos_vertical / (sagittal * tangential))


#: Steps of the slopes along and across [1] and of the range [m] in which errors are propagated.
_STEPS = (0.01, 0.01, 0.01)


def variances(
    quantity: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    surface_range: float,
    before: Sequence[npt.ArrayLike],
    after: Sequence[npt.ArrayLike],
) -> tuple[FloatArray, FloatArray]:
    """Return a quantity's variances without and with the correction for slope and range.

    Without the correction the variance is the true correction's variance over the sea, with it the variance of its
    error. Both are to first order about the level sea, for independent slopes and range. NaN quantities are not
    corrected.

    Parameters
    ----------
    quantity : callable
        Corrected quantity as a function of the slopes along and across [1] and the surface range [m].
    surface_range : float
        Range of a level sea at its mean height [m].
    before, after : sequence of 3 array_like
        Standard deviations of slopes and range on the sea, infinite where unknown; standard errors of their estimates.
        They broadcast. A NaN error, for a slope that is not estimated, counts in neither.
    """
    level = np.array([0.0, 0.0, surface_range])
    without, corrected = np.zeros(1), np.zeros(1)
    for axis, step in enumerate(_STEPS):
        upper, lower = (quantity(*(level + sign * step * np.eye(3)[axis])) for sign in (1, -1))
        gradient = (upper - lower) / (2 * step)
        deviation, error = np.broadcast_arrays(*(np.asarray(one[axis], dtype=np.float64) for one in (before, after)))
        counts = ~np.isnan(error) & (gradient != 0)
        without, corrected = (
            variance + np.where(counts, gradient * np.where(counts, one, 0.0), 0.0) ** 2
            for variance, one in ((without, deviation), (corrected, error))
        )
    return without, corrected
