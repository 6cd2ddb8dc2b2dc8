"""Refraction at a level sea by bisection, from Snell's law alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray

#: Halvings of the interval of tangents.
_STEPS = 200


def refracted_path(
    horizontal: npt.ArrayLike, height: npt.ArrayLike, depth: npt.ArrayLike, n: float
) -> tuple[FloatArray, FloatArray]:
    """Angles from the vertical [rad] in air and water of the ray between a point in air and one in the water.

    They solve height tan(theta) + depth tan(phi) = horizontal with sin(theta) = n sin(phi).

    Parameters
    ----------
    horizontal : array_like
        Horizontal distance [m]; the angles have its sign.
    height, depth : array_like
        Height above the surface, above 0, and depth below it [m].
    n : float
        Refractive index of the water.
    """
    rho, h, d = np.broadcast_arrays(*(np.asarray(one, dtype=np.float64) for one in (horizontal, height, depth)))
    low, high = np.zeros(rho.shape), np.abs(rho) / h
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        beyond = h * middle + d * np.tan(np.arcsin(np.sin(np.arctan(middle)) / n)) > np.abs(rho)
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    theta = np.copysign(np.arctan(0.5 * (low + high)), rho)
    return theta, np.arcsin(np.sin(theta) / n)
