"""Time of a known echo of unknown height in noisy samples: the matched filter, and the bound of its error."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, positive


def delays(
    samples: npt.ArrayLike,
    templates: npt.ArrayLike,
    delays_ns: npt.ArrayLike,
    covariance: npt.ArrayLike,
) -> FloatArray:
    """Find the times of echoes of unknown height, by the matched filter that fits best.

    Parameters
    ----------
    samples : array_like, shape (shots, samples)
        Records less the background.
    templates : array_like, shape (times, samples)
        The echo at different delays.
    delays_ns : array_like, shape (times,)
        These delays [ns], at least three in equal steps.
    covariance : array_like, shape (samples, samples)
        Of the noise, positive definite.

    Returns
    -------
    ndarray, shape (shots,)
        Delay of each shot [ns]: the top of a parabola through the best delay and its neighbours, which stays within
        `delays_ns`.

    Raises
    ------
    ValueError
        If the shapes do not fit, a value is not finite, the delays are not in equal steps, or the covariance is
        singular.

    Notes
    -----
    The maximum of (x C^-1 s)/sqrt(s C^-1 s) over delays is that of the likelihood with the height fitted, for normal
    noise (S. M. Kay, Fundamentals of Statistical Signal Processing, volume 2, 1998, section 7.4.2).
    """
    x, s, t = (
        finite_array(name, value)
        for name, value in (("samples", samples), ("templates", templates), ("delays_ns", delays_ns))
    )
    if x.ndim != 2 or s.shape != (t.size, x.shape[1]) or t.size < 3:
        raise ValueError(f"templates of shape {s.shape} must be (delays, samples) for samples of shape {x.shape}")
    step = positive("delays_ns step", t[1] - t[0])
    if not np.allclose(np.diff(t), step):
        raise ValueError("delays_ns must increase in equal steps")
    filters = _solved(covariance, s.T)
    score = x @ (filters / np.sqrt(np.sum(s.T * filters, axis=0)))
    best = np.clip(np.argmax(score, axis=1), 1, t.size - 2)
    left, middle, right = (score[np.arange(len(x)), best + shift] for shift in (-1, 0, 1))
    bend = left - 2 * middle + right
    top = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.asarray(t[best] + np.clip(top, -1, 1) * step)


def delay_bound(templates: npt.ArrayLike, delays_ns: npt.ArrayLike, covariance: npt.ArrayLike) -> float:
    """Smallest standard deviation of an unbiased time of an echo of unknown height [ns].

    Parameters
    ----------
    templates, delays_ns, covariance
        As for `delays`; the echo is the template in the middle.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        As `delays`.

    Notes
    -----
    The bound of Cramer and Rao for a delay and a height: 1/sqrt(d C^-1 d - (d C^-1 s)^2/(s C^-1 s)) with the
    derivative d = ds/dt.
    """
    s, t = finite_array("templates", templates), finite_array("delays_ns", delays_ns)
    if s.ndim != 2 or len(s) != t.size or t.size < 3:
        raise ValueError(f"templates of shape {s.shape} must be (delays, samples) for delays of shape {t.shape}")
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
        raise ValueError("covariance must be positive definite: every sample needs some noise") from None
