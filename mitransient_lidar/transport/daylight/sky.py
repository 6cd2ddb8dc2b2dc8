"""Sky radiance distributions, and sun directions."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

#: Points along each axis of the quadrature that normalises a sky.
_QUADRATURE_POINTS = 1024


def direction_of(zenith_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    """Return the unit direction of a zenith angle and an azimuth from +x towards +y [deg]."""
    zenith, azimuth = np.radians((zenith_deg, azimuth_deg))
    return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


def uniform_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return a uniform sky's relative radiance."""
    return mi.Float(1)


def overcast_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the relative radiance of an overcast sky: three times as bright at the zenith as at the horizon.

    Cardioidal sky of Moon and Spencer 1942, Illuminating Engineering 37, 707.
    """
    return 1 + 2 * direction.z


def clear_distribution(direction: mi.Vector3f, sun: mi.Vector3f) -> mi.Float:
    """Return the relative radiance of a clear sky, bright around the sun and at the horizon.

    Harrison and Coombes 1988, equations 3 to 5 (doi:10.1016/0038-092X(88)90072-2), without the factor that depends on
    the sun's zenith angle alone.
    """
    cosine = dr.dot(direction, sun)
    # The arc cosine is inaccurate next to the sun.
    angle = 2 * dr.safe_asin(0.5 * dr.norm(direction - sun))
    around = 1.63 + 53.7 * dr.exp(-5.49 * angle) + 2.04 * dr.square(cosine) * sun.z
    return around * (1 - dr.exp(-0.19 / dr.maximum(direction.z, 1e-6)))


#: Relative radiance by distribution name.
SKIES: dict[str, Callable[[mi.Vector3f, mi.Vector3f], mi.Float]] = {
    "clear": clear_distribution,
    "overcast": overcast_distribution,
    "uniform": uniform_distribution,
}


def relative_irradiance(name: str, sun: NDArray[np.float64]) -> float:
    """Return the irradiance on a level plane by a relative radiance distribution, with the midpoint rule."""
    n = _QUADRATURE_POINTS
    index = dr.arange(mi.UInt32, n**2)
    cosine2 = (mi.Float(index % n) + 0.5) / n
    sin, cos = dr.sincos(dr.two_pi * (mi.Float(index // n) + 0.5) / n)
    level = dr.sqrt(1 - cosine2)
    direction = mi.Vector3f(level * cos, level * sin, dr.sqrt(cosine2))
    radiance = SKIES[name](direction, mi.Vector3f(sun.tolist()))
    return float(np.pi * np.mean(np.array(radiance, dtype=np.float64)))
