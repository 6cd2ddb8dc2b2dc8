"""Afterpulses of photon counters: probabilities of counts in time bins and their covariances.

After a count a channel is dead as in `dead_time`. Once it is live again, the time to an afterpulse is exponentially
distributed, with a probability that there is one at all; the next count, of either kind, begins this anew. Counts are
a renewal process, whose state is the time since the channel is live: recursions over it are exact.
"""

from __future__ import annotations

import math

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.dead_time import DeadBins, further_bins

_LAST = 1e-9  # share of the afterpulses that is left out


def hazard(probability: float, decay_bins: float, bins: int) -> FloatArray:
    """Return the probability of an afterpulse in a bin if there was none before.

    Parameters
    ----------
    probability : float
        Probability of an afterpulse at any time, above 0 and below 1.
    decay_bins : float
        Mean time to an afterpulse in bins, positive.
    bins : int
        Length of the record in bins; none lasts longer.

    Returns
    -------
    ndarray, shape (age,)
        By bins since the channel is live; the last one is 0 and stands for all later bins.
    """
    size = min(math.ceil(-math.log(_LAST) * decay_bins), bins) + 1
    none_until = 1 - probability + probability * np.exp(-np.arange(size + 1) / decay_bins)
    found = 1 - none_until[1:] / none_until[:-1]
    found[-1] = 0.0
    return np.asarray(found)


def moments(events: FloatArray, dead: DeadBins, chances: FloatArray, lags: int) -> tuple[FloatArray, list[FloatArray]]:
    """Return the probability of a count of one channel in each bin, and covariances of pairs of bins.

    Parameters
    ----------
    events : ndarray, shape (..., time)
        Mean events per bin of a live channel, without afterpulses.
    dead : DeadBins
        Bins for which a channel is dead after a count.
    chances : ndarray, shape (age,)
        Result of `hazard`.
    lags : int
        Number of lags, at least 1.

    Returns
    -------
    fired : ndarray, shape (..., time)
    covariances : list of ndarray
        Item l has the covariance of the counts in the bins k and k + l, shape (..., time - l).
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    length = len(hit)
    first, second = further_bins(np.moveaxis(events, -1, 0), dead)
    # Shares of the channels that are live again a number of bins after a count.
    ends = list(enumerate((1 - first, first - second, second), dead.bins))
    state = np.zeros((chances.size, *hit.shape[1:]))
    state[-1] = 1.0  # as if live for long
    fired = np.zeros_like(hit)
    for k in range(length):
        state[0] += sum(share[k - ago] * fired[k - ago] for ago, share in ends if k >= ago)
        fired[k], state = _step(state, hit[k], chances)
    covariances = [fired * (1 - fired)]
    # Probabilities of another count after one in each bin, by the lag.
    again = np.zeros((min(lags, length), *hit.shape))
    again[0] = 1.0
    state = np.zeros((chances.size, *hit.shape))
    for lag in range(1, min(lags, length)):
        kept = length - lag
        state = state[:, :kept]
        state[0] += sum(share[lag - ago : length - ago] * again[lag - ago, :kept] for ago, share in ends if lag >= ago)
        again[lag, :kept], state = _step(state, hit[lag:], chances)
        covariances.append(fired[:kept] * (again[lag, :kept] - fired[lag:]))
    return np.moveaxis(fired, 0, -1), [np.moveaxis(one, 0, -1) for one in covariances]


def _step(state: FloatArray, hit: FloatArray, chances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the probability of a count in a bin, and that of each age of a live channel in the next one."""
    quiet = (1 - hit) * (1 - chances.reshape(-1, *(1,) * hit.ndim))
    survived = state * quiet
    after = np.zeros_like(state)
    after[1:] = survived[:-1]
    after[-1] += survived[-1]
    fired: FloatArray = np.sum(state, axis=0) - np.sum(survived, axis=0)
    return fired, after
