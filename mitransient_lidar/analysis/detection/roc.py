"""Receiver operating characteristic: alarm rates and the area under the curve, with confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray


class Rates(NamedTuple):
    """Fractions of trials, and the limits of their confidence intervals; arrays with one shape."""

    rate: FloatArray
    low: FloatArray
    high: FloatArray


class Area(NamedTuple):
    """Area under a receiver operating characteristic: its value, standard error and confidence interval."""

    value: float
    stderr: float
    low: float
    high: float


def binomial_rates(successes: npt.ArrayLike, trials: int, confidence: float = 0.95) -> Rates:
    """Return rates with Clopper-Pearson intervals for numbers of successes, 0 to `trials`, in their shape.

    Notes
    -----
    C. J. Clopper and E. S. Pearson, Biometrika 26, 404 (1934), doi:10.1093/biomet/26.4.404: exact and conservative, so
    that `confidence` is the smallest coverage probability. The limits are beta distribution quantiles.
    """
    from scipy.special import betaincinv

    count, tail = np.asarray(successes, dtype=np.float64), (1 - confidence) / 2
    low = np.where(count > 0, betaincinv(np.maximum(count, 1), trials - count + 1, tail), 0.0)
    high = np.where(count < trials, betaincinv(count + 1, np.maximum(trials - count, 1), 1 - tail), 1.0)
    return Rates(count / trials, low, high)


def exceedance(values: npt.ArrayLike, thresholds: npt.ArrayLike, confidence: float = 0.95) -> Rates:
    """Return the rates of values, shape (trials,), above thresholds, in the shape of `thresholds`.

    For shots without a target these are false alarm probabilities, with a target detection probabilities; both at one
    threshold are a point on the receiver operating characteristic. The thresholds must not depend on the values;
    otherwise the intervals of `binomial_rates` are too narrow.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    return binomial_rates(ordered.size - np.searchsorted(ordered, thresholds, side="right"), ordered.size, confidence)


def area_under_curve(null: npt.ArrayLike, target: npt.ArrayLike, confidence: float = 0.95) -> Area:
    """Return the area under the receiver operating characteristic of outcomes without and with the target.

    It is the probability that the value with a target is the larger of a pair; equal values count one half. The
    outcomes, shape (trials,), are independent, at least two of each.

    Notes
    -----
    The standard error follows E. R. DeLong, D. M. DeLong and D. L. Clarke-Pearson, Biometrics 44, 837 (1988),
    doi:10.2307/2531595, equation 5 for one curve. The interval is normal in the area's logit and thus below 1. If all
    pairs are separated, the standard error is 0. The lower limit is then the area at which as many pairs of independent
    shots would all be separated with a probability of 1 - confidence.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    without, with_target = np.asarray(null, dtype=np.float64), np.asarray(target, dtype=np.float64)
    n, m, tail = without.size, with_target.size, (1 - confidence) / 2
    ranks = rankdata(np.concatenate([without, with_target]))
    # For each shot, the fraction of the other kind's shots on the correct side of it.
    above = (ranks[n:] - rankdata(with_target)) / n
    below = 1 - (ranks[:n] - rankdata(without)) / m
    value = float(np.mean(above))
    error = float(np.sqrt(np.var(above, ddof=1) / m + np.var(below, ddof=1) / n))
    if value in (0.0, 1.0):
        limit = (2 * tail) ** (1 / min(n, m))
        return Area(value, error, limit if value else 0.0, 1.0 if value else 1 - limit)
    centre, reach = np.log(value / (1 - value)), -ndtri(tail) * error / (value * (1 - value))
    low, high = (1 / (1 + np.exp(-limit)) for limit in (centre - reach, centre + reach))
    return Area(value, error, float(low), float(high))
