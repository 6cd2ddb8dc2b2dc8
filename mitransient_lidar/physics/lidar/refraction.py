"""Refraction at a level sea surface: directions, Fresnel transmission, focusing, and the time of the surface echo.

Angles are from the vertical, `theta` in air and `phi` in water; n is the index of water relative to air.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray, finite_array, in_range, positive


def snell(theta: npt.ArrayLike, n: float) -> FloatArray:
    """Refraction angle [rad] in water with relative index `n` >= 1 for angles `theta` [rad] in air."""
    return np.asarray(np.arcsin(np.sin(finite_array("theta", theta)) / in_range("n", n, 1, np.inf)))


def cos_in_water(cosine: npt.ArrayLike, n: float) -> FloatArray:
    """Return the cosines of refraction angles in water from the cosines in air, by Snell's law."""
    return np.asarray(np.sqrt(1 - (1 - np.asarray(cosine, dtype=np.float64) ** 2) / n**2))


def turn_by_slope(theta: npt.ArrayLike, n: float) -> FloatArray:
    """Return the angle by which a slope turns the refracted ray over the slope, 1 - cos(theta)/(n cos(phi))."""
    angle = np.asarray(theta, dtype=np.float64)
    return np.asarray(1 - np.cos(angle) / (n * np.sqrt(1 - (np.sin(angle) / n) ** 2)))


def refract(direction: FloatArray, normal: FloatArray, n: float) -> FloatArray:
    """Return unit directions refracted from air into water by a facet, shape (..., 2 or 3).

    Parameters
    ----------
    direction
        Unit directions of propagation in the air, shape (..., 2 or 3).
    normal
        Facet normals into the air, of any length, with the same shape.
    n
        Refractive index of the water relative to air, at least 1.
    """
    unit = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    cosine = -np.sum(direction * unit, axis=-1, keepdims=True)
    return np.asarray(direction / n + (cosine / n - cos_in_water(cosine, n)) * unit)


def refract_level(direction: FloatArray, n: float) -> FloatArray:
    """Return unit directions refracted downwards by the level surface, as `refract` does by a facet, shape (..., 3)."""
    horizontal = direction[..., :2] / n
    down = -np.sqrt(1 - np.sum(horizontal**2, axis=-1, keepdims=True))
    return np.concatenate([horizontal, down], axis=-1)


def fresnel(theta: npt.ArrayLike, n: float) -> tuple[FloatArray, FloatArray]:
    """Power reflectance and transmittance of a smooth interface for unpolarised light.

    Parameters
    ----------
    theta : array_like
        Incidence angle [rad], 0 to pi/2.
    n : float
        Index behind the interface relative to that before it; below 1 from water to air.

    Returns
    -------
    reflectance, transmittance : ndarray
        They add up to 1; the reflectance is 1 beyond the critical angle.
    """
    angle = finite_array("theta", theta)
    cos_i = np.cos(angle)
    sin_t = np.sin(angle) / positive("n", n)
    cos_t = np.sqrt(np.maximum(1 - sin_t**2, 0))
    with np.errstate(invalid="ignore"):
        s = (cos_i - n * cos_t) / (cos_i + n * cos_t)
        p = (n * cos_i - cos_t) / (n * cos_i + cos_t)
    reflectance = np.where(sin_t < 1, 0.5 * (s**2 + p**2), 1.0)
    return reflectance, 1 - reflectance


def solid_angle_per_area(height: npt.ArrayLike, depth: npt.ArrayLike, theta: npt.ArrayLike, n: float) -> FloatArray:
    """Solid angle in water per receiver area, at a point on the refracted ray.

    Parameters
    ----------
    height, depth : array_like
        Receiver height and point depth [m].
    theta, n
        Ray angle in air [rad], and water refractive index.

    Returns
    -------
    ndarray
        d(omega)/dA [sr/m^2] for an aperture normal to the ray: 1/(S_s S_t) with the sagittal and tangential distances
        S_s = n H/cos(theta) + D/cos(phi) and S_t = n H cos(phi)/cos^2(theta) + D cos(theta)/cos^2(phi).
    """
    h, d = np.asarray(height, dtype=np.float64), np.asarray(depth, dtype=np.float64)
    air, water = np.cos(finite_array("theta", theta)), np.cos(snell(theta, n))
    sagittal = n * h / air + d / water
    tangential = n * h * water / air**2 + d * air / water**2
    return np.asarray(1 / (sagittal * tangential))


def surface_time_ns(height: npt.ArrayLike, theta: npt.ArrayLike) -> FloatArray:
    """Two-way time [ns] to the level surface from `height` [m] at the angle `theta` [rad]."""
    return np.asarray(2e9 * np.asarray(height, dtype=np.float64) / (C0 * np.cos(finite_array("theta", theta))))
