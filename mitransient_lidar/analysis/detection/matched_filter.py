"""Time of a known echo of unknown height in noisy samples: the matched filter, and the lower bound of its error."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite_array, positive


def delays(
    samples: npt.ArrayLike, templates: npt.ArrayLike, delays_ns: npt.ArrayLike, covariance: npt.ArrayLike
) -> FloatArray:
    """Return the delays [ns] of echoes of unknown height, from the matched filter that fits best, shape (shots,).

    Parameters
    ----------
    samples : array_like, shape (shots, samples)
        Records less the background.
    templates, delays_ns : array_like, shape (times, samples) and (times,)
        The echo at different delays, and these delays [ns], at least three in equal steps.
    covariance : array_like, shape (samples, samples)
        Covariance of the noise, positive definite.

    Raises
    ------
    UserError
        If shapes disagree, a value is not finite, the delays are not in equal steps, or the covariance is singular.

    Notes
    -----
    The maximum of (x C^-1 s)/sqrt(s C^-1 s) over delays is that of the likelihood with the height fitted, for normal
    noise (S. M. Kay, Fundamentals of Statistical Signal Processing, volume 2, 1998, section 7.4.2). It is interpolated
    by a parabola through the best delay and its neighbours, within `delays_ns`.
    """
    x, s, t = (
        finite_array(name, value)
        for name, value in (("samples", samples), ("templates", templates), ("delays_ns", delays_ns))
    )
    if x.ndim != 2 or s.shape != (t.size, x.shape[1]) or t.size < 3:
        raise UserError(f"templates of shape {s.shape} must be (delays, samples) for samples of shape {x.shape}")
    step = positive("delays_ns step", t[1] - t[0])
    if not np.allclose(np.diff(t), step):
        raise UserError("delays_ns must increase in equal steps")
    filters = _solved(covariance, s.T)
    score = x @ (filters / np.sqrt(np.sum(s.T * filters, axis=0)))
    best = np.clip(np.argmax(score, axis=1), 1, t.size - 2)
    left, middle, right = (score[np.arange(len(x)), best + shift] for shift in (-1, 0, 1))
    bend = left - 2 * middle + right
    top = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.asarray(t[best] + np.clip(top, -1, 1) * step)


def delay_bound(templates: npt.ArrayLike, delays_ns: npt.ArrayLike, covariance: npt.ArrayLike) -> float:
    """Return the smallest standard deviation of an unbiased time of an echo of unknown height [ns].

    The arguments and errors are those of `delays`; the echo is the middle template.

    Notes
    -----
    Cramer-Rao bound for a delay and a height: 1/sqrt(d C^-1 d - (d C^-1 s)^2/(s C^-1 s)) with the derivative
    d = ds/dt.
    """
    s, t = finite_array("templates", templates), finite_array("delays_ns", delays_ns)
    if s.ndim != 2 or len(s) != t.size or t.size < 3:
        raise UserError(f"templates of shape {s.shape} must be (delays, samples) for delays of shape {t.shape}")
    i = t.size // 2
    echo, slope = s[i], (s[i + 1] - s[i - 1]) / (t[i + 1] - t[i - 1])
    filters = _solved(covariance, np.array([echo, slope]).T)
    information = float(slope @ filters[:, 1] - (slope @ filters[:, 0]) ** 2 / (echo @ filters[:, 0]))
    return float(1 / np.sqrt(information))


def _solved(covariance: npt.ArrayLike, right: FloatArray) -> FloatArray:
    """Return the inverse of the covariance times `right`."""
    try:
        return np.asarray(np.linalg.solve(finite_array("covariance", covariance), right))
    except np.linalg.LinAlgError:
        raise UserError("covariance must be positive definite: every sample must have noise") from None
