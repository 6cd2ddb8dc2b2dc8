"""Surface echo of ripples on tilted facets, relative to that of Gaussian slopes."""

from __future__ import annotations

import numpy as np

from mitransient_lidar.core.validation import FloatArray, in_range, positive

#: Facet slopes of the quadrature along one axis, and their range in standard deviations.
_NODES, _REACH = 161, 6.0


def two_scale_ratio(
    facet_variance: tuple[float, float], ripple_variance: tuple[float, float], theta: float, azimuth: float = 0.0
) -> float:
    """Mean monostatic surface echo over that of Gaussian slopes of the same total variance.

    Parameters
    ----------
    facet_variance, ripple_variance : tuple of float
        Slope variances along and across the wind [1]: of the facets, and of the ripples about each facet. Positive.
    theta : float
        Angle of the ray from the vertical [rad], 0 to 1.2.
    azimuth : float
        Angle of the ray's horizontal direction from the wind [rad].

    Returns
    -------
    float
        Ratio [1]; 1 in the limit of small slopes, where those of facets and ripples add.

    Raises
    ------
    ValueError
        If a parameter lies outside its range.

    Notes
    -----
    On a facet of slope a the ripples that reflect towards the lidar have the slope (b - a)/(1 + a b), not b - a, with
    b the tangent of the ray's angle. Far in the tail of the slopes, at light wind and large angles, the two-scale model
    of a rough sea is much brighter than the Gaussian law. Per horizontal area, a facet of normal n sends back
    D(w) / (4 n_z) with the ripples' normal distribution D about it (Walter, Marschner, Li and Torrance 2007,
    doi:10.2312/EGWR/EGSR07/195-206, eq. 20 and 25); masking is left out.
    """
    theta = in_range("theta", theta, 0.0, 1.2)
    facets = [positive("facet_variance", variance) for variance in facet_variance]
    ripples = [positive("ripple_variance", variance) for variance in ripple_variance]
    t = np.linspace(-_REACH, _REACH, _NODES)
    along, across = np.meshgrid(t * np.sqrt(facets[0]), t * np.sqrt(facets[1]), indexing="ij")
    weight = np.exp(-0.5 * (t[:, None] ** 2 + t**2))
    up = 1 / np.sqrt(1 + along**2 + across**2)
    normal = np.stack([-along * up, -across * up, up], axis=-1)
    horizontal = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.sin(theta)
    ray = np.array([-horizontal[0], -horizontal[1], np.cos(theta)])

    # The ripples' axes lie in the facet, the first above the wind's direction.
    first = np.stack([np.ones_like(along), np.zeros_like(along), along], axis=-1)
    first -= np.sum(first * normal, axis=-1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    cosine = np.maximum(normal @ ray, 1e-6)
    slopes = (first @ ray) / cosine, (np.cross(normal, first) @ ray) / cosine
    echo = _density(slopes, ripples) / cosine**4 / up
    mean = float(np.sum(weight * echo) / np.sum(weight))
    total = [facet + ripple for facet, ripple in zip(facets, ripples, strict=True)]
    tilt = horizontal / np.cos(theta)
    return mean / float(_density((tilt[0], tilt[1]), total) / np.cos(theta) ** 4)


def _density(slopes: tuple[FloatArray, FloatArray], variance: list[float]) -> FloatArray:
    """Return the Gaussian density of slopes [1]."""
    exponent = -0.5 * (slopes[0] ** 2 / variance[0] + slopes[1] ** 2 / variance[1])
    return np.asarray(np.exp(exponent) / (2 * np.pi * np.sqrt(variance[0] * variance[1])))
