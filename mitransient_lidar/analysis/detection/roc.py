"""Receiver operating characteristic: alarm rates and the area under the curve, with confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite_array


class Rates(NamedTuple):
    """Fractions of trials, and the limits of their confidence intervals; arrays of one shape."""

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
    """Return rates with Clopper-Pearson intervals, in the shape of `successes`.

    Parameters
    ----------
    successes, trials : array_like, int
        Numbers of successes, integers from 0 to `trials`, and number of trials, at least 1.
    confidence : float
        Smallest coverage probability of an interval, above 0 and below 1.

    Raises
    ------
    UserError
        If an argument is out of range.

    Notes
    -----
    C. J. Clopper and E. S. Pearson, Biometrika 26, 404 (1934), doi:10.1093/biomet/26.4.404: exact and conservative. The
    limits are quantiles of beta distributions.
    """
    from scipy.special import betaincinv

    count, tail = finite_array("successes", successes), _tail(confidence)
    if trials < 1:
        raise UserError(f"trials = {trials} must be at least 1")
    if np.any(count < 0) or np.any(count > trials) or np.any(count != np.rint(count)):
        raise UserError(f"successes must be integers between 0 and {trials}")
    low = np.where(count > 0, betaincinv(np.maximum(count, 1), trials - count + 1, tail), 0.0)
    high = np.where(count < trials, betaincinv(count + 1, np.maximum(trials - count, 1), 1 - tail), 1.0)
    return Rates(count / trials, low, high)


def exceedance(values: npt.ArrayLike, thresholds: npt.ArrayLike, confidence: float = 0.95) -> Rates:
    """Return the rates of values, shape (trials,), above thresholds, in the shape of `thresholds`.

    For shots without a target these are probabilities of false alarm, with a target those of detection; both for one
    threshold are a point of the receiver operating characteristic. The thresholds must not depend on the values;
    otherwise the intervals of `binomial_rates` are too narrow.

    Raises
    ------
    UserError
        If there are no values, some are not finite, or `confidence` is out of range.
    """
    ordered, limits = np.sort(_trials("values", values)), finite_array("thresholds", thresholds)
    above = ordered.size - np.searchsorted(ordered, limits, side="right")
    return binomial_rates(above, ordered.size, confidence)


def area_under_curve(null: npt.ArrayLike, target: npt.ArrayLike, confidence: float = 0.95) -> Area:
    """Return the area under the receiver operating characteristic.

    It is the probability that the value with a target is the larger of a pair; equal values count one half.

    Parameters
    ----------
    null, target, confidence : array_like, shape (trials,), and float
        Independent outcomes without and with the target, at least two of each; the confidence of `binomial_rates`.

    Raises
    ------
    UserError
        If there are too few values, some are not finite, or `confidence` is out of range.

    Notes
    -----
    The standard error is that of E. R. DeLong, D. M. DeLong and D. L. Clarke-Pearson, Biometrics 44, 837 (1988),
    doi:10.2307/2531595, equation 5 for one curve. The interval is normal in the logit of the area and thus below 1. If
    all pairs are separated, the standard error is 0 and the lower limit is the area at which as many pairs of
    independent shots would all be separated with a probability of 1 - confidence.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    without, with_target, tail = _trials("null", null, 2), _trials("target", target, 2), _tail(confidence)
    n, m = without.size, with_target.size
    ranks = rankdata(np.concatenate([without, with_target]))
    # For each shot, the fraction of shots of the other kind that it is separated from.
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


def _trials(name: str, values: npt.ArrayLike, fewest: int = 1) -> FloatArray:
    trials = finite_array(name, values)
    if trials.ndim != 1 or trials.size < fewest:
        raise UserError(f"{name} of shape {trials.shape} must be a list of {fewest} or more numbers")
    return trials


def _tail(confidence: float) -> float:
    """Return the probability outside each end of an interval."""
    if not 0 < confidence < 1:
        raise UserError(f"confidence = {confidence:g} must be above 0 and below 1")
    return (1 - confidence) / 2
