"""What a sloping sea surface does to the depth and to the strength of a bottom echo, and how to take it out.

Slopes are rises over runs, positive `along` the lidar's azimuth for a face turned towards the lidar; angles in rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, in_range, positive
from .refraction import fresnel


@dataclass(frozen=True)
class SlopeRefraction:
    """A ray that a sloping surface lets into the water; arrays of one shape.

    Attributes
    ----------
    cos_air, cos_water
        Cosines of the ray's angles from the facet's normal, above and below it.
    cos_vertical
        Cosine of the angle of the ray in the water from the vertical.
    """

    cos_air: FloatArray
    cos_water: FloatArray
    cos_vertical: FloatArray

    @classmethod
    def of(cls, along: npt.ArrayLike, across: npt.ArrayLike, off_nadir: float, n: float) -> SlopeRefraction:
        """Refract the axis of a lidar at a facet.

        Parameters
        ----------
        along, across : array_like
            Slopes of the facet [1]; they broadcast. NaN stays NaN.
        off_nadir : float
            Angle of the ray in air from the vertical [rad], 0 to below pi/2.
        n : float
            Refractive index of the water, at least 1.

        Returns
        -------
        SlopeRefraction
            NaN where the ray would meet the facet's underside.

        Raises
        ------
        ValueError
            If an angle or the index is out of range.

        Notes
        -----
        Snell's law for vectors: w = d/n + (cos_air/n - cos_water) m with the normal m.
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
    """Depth of a bottom point below the mean sea level, with the surface's own height and slope.

    Parameters
    ----------
    surface_range : array_like
        Distance from the lidar to the surface along the ray [m].
    path : array_like
        Way from there to the bottom in the water [m].
    height : float
        Height of the lidar above the mean sea level [m], above 0.
    off_nadir : float
        Angle of the ray in air from the vertical [rad].
    ray : SlopeRefraction
        The ray in the water.

    Returns
    -------
    ndarray
        D = R cos(theta) - H + s cos(alpha) [m], the height of the surface being H - R cos(theta).

    Raises
    ------
    ValueError
        If `height` is not positive.

    Notes
    -----
    A face turned away from the lidar bends the ray towards the vertical: the way to the bottom is shorter (Tulldahl
    2006, FOI-R-2074-SE, figure 12), and a depth read with the angle of a level sea too small. Assumed: the whole beam
    follows the axis through a plane, and light scattered on the way is not late (no undercutting).
    """
    distance, way = np.asarray(surface_range, dtype=np.float64), np.asarray(path, dtype=np.float64)
    return np.asarray(distance * np.cos(off_nadir) - positive("height", height) + way * ray.cos_vertical)


def bottom_gain(surface_range: npt.ArrayLike, path: npt.ArrayLike, n: float, ray: SlopeRefraction) -> FloatArray:
    """Strength of a Lambertian bottom seen through a sloping surface, without attenuation in the water.

    Parameters
    ----------
    surface_range, path : array_like
        Ways in air and water [m].
    n : float
        Refractive index of the water, at least 1.
    ray : SlopeRefraction
        The ray in the water.

    Returns
    -------
    ndarray
        T^2 cos(alpha)/(S_s S_t) [1/m^2], so that the echo's energy is E A (rho/pi) gain exp(-2 K s); `lidar_equation`
        has the same for a level sea.

    Raises
    ------
    ValueError
        If a way is not finite or `n` is out of range.

    Notes
    -----
    T is Fresnel's transmittance at the facet. A narrow pencil from the bottom point spreads with S_s = n R + s and
    S_t = n R cos_water/cos_air + s cos_air/cos_water through a plane: Snell's law across and in the plane
    of incidence.
    """
    distance, way = finite_array("surface_range", surface_range), finite_array("path", path)
    index = in_range("n", n, 1, np.inf)
    known = np.isfinite(ray.cos_air)
    _, transmittance = fresnel(np.arccos(np.clip(np.where(known, ray.cos_air, 1.0), 0, 1)), index)
    sagittal = index * distance + way
    tangential = index * distance * ray.cos_water / ray.cos_air + way * ray.cos_air / ray.cos_water
    return np.asarray(transmittance**2 * ray.cos_vertical / (sagittal * tangential))


def bottom_factor(
    path: npt.ArrayLike,
    surface_range: npt.ArrayLike,
    attenuation: npt.ArrayLike,
    n: float,
    ray: SlopeRefraction,
    level: SlopeRefraction,
) -> FloatArray:
    """Energy of a bottom echo through a slope over that of the same bottom under a level surface.

    Parameters
    ----------
    path, surface_range : array_like
        Way in the water through the slope, and distance to the surface [m].
    attenuation : array_like
        Attenuation K of the signal along the way, exp(-2 K s) [1/m], at least 0.
    n : float
        Refractive index of the water, at least 1.
    ray, level : SlopeRefraction
        The ray through the slope and through a level surface.

    Returns
    -------
    ndarray
        Factor to divide an energy by [1].

    Raises
    ------
    ValueError
        If a number is not finite, or `attenuation` negative.

    Notes
    -----
    The level way to the same depth is s cos(alpha)/cos(alpha_0). The gain of a face towards the lidar is higher, since
    it is met more steeply, and the way longer: in clear or shallow water the two nearly cancel, and what waves do to a
    bottom echo is to focus it. `turbidity.bottom_reflectivity` takes that out as well.
    """
    way, decay = finite_array("path", path), finite_array("attenuation", attenuation)
    if np.any(decay < 0):
        raise ValueError(f"attenuation = {decay.min():g} must not be negative")
    direct = way * ray.cos_vertical / level.cos_vertical
    gains = bottom_gain(surface_range, way, n, ray) / bottom_gain(surface_range, np.nan_to_num(direct), n, level)
    return np.asarray(gains * np.exp(-2 * decay * (way - direct)))
