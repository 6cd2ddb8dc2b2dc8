"""How well two outcomes are told apart: rates of alarms and the area under their curve, with confidence intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array


class Rates(NamedTuple):
    """Shares of trials, and the limits of their confidence intervals; arrays of one shape."""

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
    """Rates with the intervals of Clopper and Pearson.

    Parameters
    ----------
    successes : array_like
        Numbers of successes, whole, 0 to `trials`.
    trials : int
        Number of trials, at least 1.
    confidence : float
        Probability with which an interval covers the truth, at least; above 0 and below 1.

    Returns
    -------
    Rates
        Of the shape of `successes`.

    Raises
    ------
    ValueError
        If an argument lies outside its range.

    Notes
    -----
    C. J. Clopper and E. S. Pearson, Biometrika 26, 404 (1934), doi:10.1093/biomet/26.4.404: exact, thus never too
    narrow. The limits are quantiles of beta distributions.
    """
    from scipy.special import betaincinv

    count, tail = finite_array("successes", successes), _tail(confidence)
    if trials < 1:
        raise ValueError(f"trials = {trials} must be at least 1")
    if np.any(count < 0) or np.any(count > trials) or np.any(count != np.rint(count)):
        raise ValueError(f"successes must be whole numbers between 0 and {trials}")
    low = np.where(count > 0, betaincinv(np.maximum(count, 1), trials - count + 1, tail), 0.0)
    high = np.where(count < trials, betaincinv(count + 1, np.maximum(trials - count, 1), 1 - tail), 1.0)
    return Rates(count / trials, low, high)


def exceedance(values: npt.ArrayLike, thresholds: npt.ArrayLike, confidence: float = 0.95) -> Rates:
    """Rates at which values lie above thresholds.

    Of the statistic of shots without a target they are probabilities of false alarm, with one those of detection; the
    two of each threshold are a point of the receiver operating characteristic.

    Parameters
    ----------
    values : array_like, shape (trials,)
        Independent outcomes, at least one.
    thresholds : array_like
        Thresholds, chosen without these values: for others the intervals are too narrow.
    confidence : float
        As for `binomial_rates`.

    Returns
    -------
    Rates
        Of the shape of `thresholds`.

    Raises
    ------
    ValueError
        If there are no values, some are not finite, or `confidence` is out of range.
    """
    ordered, limits = np.sort(_trials("values", values)), finite_array("thresholds", thresholds)
    above = ordered.size - np.searchsorted(ordered, limits, side="right")
    return binomial_rates(above, ordered.size, confidence)


def area_under_curve(null: npt.ArrayLike, target: npt.ArrayLike, confidence: float = 0.95) -> Area:
    """Area under the receiver operating characteristic: the chance that a target's value is the larger of a pair.

    Parameters
    ----------
    null, target : array_like, shape (trials,)
        Independent outcomes without and with the target, at least two of each.
    confidence : float
        As for `binomial_rates`.

    Returns
    -------
    Area
        Equal values count one half.

    Raises
    ------
    ValueError
        If there are too few values, some are not finite, or `confidence` is out of range.

    Notes
    -----
    The standard error is that of E. R. DeLong, D. M. DeLong and D. L. Clarke-Pearson, Biometrics 44, 837 (1988),
    doi:10.2307/2531595, equation 5 for one curve. The interval is normal in the logit of the area, so that it stays
    below 1; where all pairs are told apart the standard error is 0, and the area's lower limit is that at which so many
    pairs of independent shots would all be told apart with a probability of 1 - confidence.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    without, lit, tail = _trials("null", null, 2), _trials("target", target, 2), _tail(confidence)
    n, m = without.size, lit.size
    ranks = rankdata(np.concatenate([without, lit]))
    # For each shot, the share of the other kind's shots that it is told apart from.
    beaten = (ranks[n:] - rankdata(lit)) / n
    missed = 1 - (ranks[:n] - rankdata(without)) / m
    value = float(np.mean(beaten))
    error = float(np.sqrt(np.var(beaten, ddof=1) / m + np.var(missed, ddof=1) / n))
    if value in (0.0, 1.0):
        unseen = (2 * tail) ** (1 / min(n, m))
        return Area(value, error, unseen if value else 0.0, 1.0 if value else 1 - unseen)
    centre, reach = np.log(value / (1 - value)), -ndtri(tail) * error / (value * (1 - value))
    low, high = (1 / (1 + np.exp(-limit)) for limit in (centre - reach, centre + reach))
    return Area(value, error, float(low), float(high))


def _trials(name: str, values: npt.ArrayLike, fewest: int = 1) -> FloatArray:
    trials = finite_array(name, values)
    if trials.ndim != 1 or trials.size < fewest:
        raise ValueError(f"{name} of shape {trials.shape} must be a list of {fewest} or more numbers")
    return trials


def _tail(confidence: float) -> float:
    """Probability left out at each end of an interval."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence = {confidence:g} must be above 0 and below 1")
    return (1 - confidence) / 2
