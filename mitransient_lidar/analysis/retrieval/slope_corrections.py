"""Corrections of depth and strength of a bottom echo for the slope of the sea surface.

Slopes are rises over runs, positive `along` the lidar's azimuth for a face towards the lidar; angles in rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, finite_array, in_range, positive
from mitransient_lidar.physics.lidar.refraction import fresnel


@dataclass(frozen=True)
class SlopeRefraction:
    """Ray refracted into the water by a sloping surface; arrays of one shape.

    Attributes
    ----------
    cos_air, cos_water
        Cosines of the ray's angles from the facet's normal in air and water.
    cos_vertical
        Cosine of the ray's angle from the vertical in the water.
    """

    cos_air: FloatArray
    cos_water: FloatArray
    cos_vertical: FloatArray

    @classmethod
    def of(cls, along: npt.ArrayLike, across: npt.ArrayLike, off_nadir: float, n: float) -> SlopeRefraction:
        """Refract the axis of a lidar at a facet, by Snell's law w = d/n + (cos_air/n - cos_water) m with the normal m.

        Parameters
        ----------
        along, across : array_like
            Slopes of the facet [1]; they broadcast. NaN, as a ray that hits the facet from below, gives NaN.
        off_nadir : float
            Angle of the ray in air from the vertical [rad], 0 to below pi/2.
        n : float
            Refractive index of the water, at least 1.

        Raises
        ------
        UserError
            If an angle or the index is out of range.
        """
        angle = in_range("off_nadir", off_nadir, 0, np.pi / 2)
        index = in_range("n", n, 1, np.inf)
        a, b = np.broadcast_arrays(np.asarray(along, dtype=np.float64), np.asarray(across, dtype=np.float64))
        length = np.sqrt(1 + a**2 + b**2)
        cos_air = (a * np.sin(angle) + np.cos(angle)) / length
        cos_air = np.where(cos_air > 0, cos_air, np.nan)
        cos_water = np.sqrt(1 - (1 - cos_air**2) / index**2)
        return cls(cos_air, cos_water, np.cos(angle) / index + (cos_water - cos_air / index) / length)


def bottom_depth(
    surface_range: npt.ArrayLike, path: npt.ArrayLike, height: float, off_nadir: float, ray: SlopeRefraction
) -> FloatArray:
    """Return the depth of a bottom point below the mean sea level [m], corrected for height and slope of the surface.

    It is D = R cos(theta) - H + s cos(alpha), with the height of the surface H - R cos(theta).

    Parameters
    ----------
    surface_range, path : array_like
        Paths along the ray in air, R, and in the water, s [m].
    height : float
        Height of the lidar above the mean sea level [m], above 0.
    off_nadir : float
        Angle of the ray in air from the vertical [rad].
    ray : SlopeRefraction
        The ray in the water.

    Raises
    ------
    UserError
        If `height` is not positive.

    Notes
    -----
    A face away from the lidar refracts the ray towards the vertical: the path to the bottom is shorter (Tulldahl 2006,
    FOI-R-2074-SE, figure 12), and a depth for the angle of a level sea too small. Assumed: the whole beam follows the
    axis through a plane, and scattering does not delay or advance the echo (no undercutting).
    """
    distance, length = np.asarray(surface_range, dtype=np.float64), np.asarray(path, dtype=np.float64)
    return np.asarray(distance * np.cos(off_nadir) - positive("height", height) + length * ray.cos_vertical)


def bottom_gain(surface_range: npt.ArrayLike, path: npt.ArrayLike, n: float, ray: SlopeRefraction) -> FloatArray:
    """Return the gain of a Lambertian bottom under a sloping surface [1/m^2], without attenuation in the water.

    It is T^2 cos(alpha)/(S_s S_t), for an echo of the energy E A (rho/pi) gain exp(-2 K s); for a level sea it equals
    that of `lidar_equation`.

    Parameters
    ----------
    surface_range, path : array_like
        Paths in air, R, and in the water, s [m].
    n : float
        Refractive index of the water, at least 1.
    ray : SlopeRefraction
        The ray in the water.

    Raises
    ------
    UserError
        If a path is not finite or `n` is out of range.

    Notes
    -----
    T is the Fresnel transmittance of the facet. A narrow pencil from the bottom point spreads through a plane with
    S_s = n R + s and S_t = n R cos_water/cos_air + s cos_air/cos_water, by Snell's law across and in the plane of
    incidence.
    """
    distance, length = finite_array("surface_range", surface_range), finite_array("path", path)
    index = in_range("n", n, 1, np.inf)
    known = np.isfinite(ray.cos_air)
    _, transmittance = fresnel(np.arccos(np.clip(np.where(known, ray.cos_air, 1.0), 0, 1)), index)
    sagittal = index * distance + length
    tangential = index * distance * ray.cos_water / ray.cos_air + length * ray.cos_air / ray.cos_water
    return np.asarray(transmittance**2 * ray.cos_vertical / (sagittal * tangential))
