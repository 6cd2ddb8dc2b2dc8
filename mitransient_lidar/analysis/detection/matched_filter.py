"""Time of a known echo with unknown height in noisy samples: the matched filter and its lower error bound.

The arguments ``samples`` are records minus the background, shape (shots, samples), and ``templates`` the echo at
delays, shape (delays, samples). ``delays_ns`` are at least three equal steps [ns]. The noise ``covariance``, shape
(samples, samples), is positive definite.
"""

from __future__ import annotations

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray


def delays(samples: FloatArray, templates: FloatArray, delays_ns: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the most likely delays [ns] of echoes with unknown height, shape (shots,).

    The maximum of (x C^-1 s)/sqrt(s C^-1 s) over delays equals the likelihood's maximum with the height fitted, for
    normal noise (S. M. Kay, Fundamentals of Statistical Signal Processing, volume 2, 1998, section 7.4.2). It is
    interpolated by a parabola through the best delay and its neighbours, within `delays_ns`.
    """
    step = float(delays_ns[1] - delays_ns[0])
    filters = _solved(covariance, templates.T)
    score = samples @ (filters / np.sqrt(np.sum(templates.T * filters, axis=0)))
    best = np.clip(np.argmax(score, axis=1), 1, delays_ns.size - 2)
    left, middle, right = (score[np.arange(len(samples)), best + shift] for shift in (-1, 0, 1))
    curvature = left - 2 * middle + right
    top = np.divide(0.5 * (left - right), curvature, out=np.zeros_like(curvature), where=curvature < 0)
    return np.asarray(delays_ns[best] + np.clip(top, -1, 1) * step)


def delay_bound(templates: FloatArray, delays_ns: FloatArray, covariance: FloatArray) -> float:
    """Return the smallest standard deviation [ns] of an unbiased time for the middle template with unknown height.

    Cramer-Rao bound for a delay and a height: 1/sqrt(d C^-1 d - (d C^-1 s)^2/(s C^-1 s)) with the derivative
    d = ds/dt.
    """
    i = delays_ns.size // 2
    echo, slope = templates[i], (templates[i + 1] - templates[i - 1]) / (delays_ns[i + 1] - delays_ns[i - 1])
    filters = _solved(covariance, np.array([echo, slope]).T)
    information = float(slope @ filters[:, 1] - (slope @ filters[:, 0]) ** 2 / (echo @ filters[:, 0]))
    return float(1 / np.sqrt(information))


def _solved(covariance: FloatArray, right: FloatArray) -> FloatArray:
    """Return the covariance's inverse times `right`."""
    try:
        return np.asarray(np.linalg.solve(covariance, right))
    except np.linalg.LinAlgError:
        raise UserError("covariance must be positive definite: every sample must have noise") from None
