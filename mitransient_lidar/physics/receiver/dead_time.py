"""Counting with dead time in time bins: probabilities of counts, their covariances, and random realisations.

A cell that fires in a bin is dead for the rest of that bin and for the dead time tau after it. In bins of width dt this
makes tau/dt + 1/2 bins, the firing bin included: on average the event is in the middle of its bin. The fractional part
of this number is the probability of one more dead bin. This is the model of Coates (1968) with a dead time shorter than
the record; the count rate of steady light is correct to second order in the events per bin.

Arrays `events` hold the mean number of events per bin that a live cell would detect, shape (..., time), and
probabilities have the same shape. All cells are live at the first bin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray, positive


class DeadBins(NamedTuple):
    """Bins for which a cell is dead, the firing bin included: `bins`, and one more with probability `fraction`."""

    bins: int
    fraction: float


def dead_bins(dead_time_ns: float, bin_width_ns: float) -> DeadBins:
    """Return the number of bins for which a cell is dead, dead_time_ns / bin_width_ns + 1/2 on average.

    Parameters
    ----------
    dead_time_ns : float
        Dead time [ns], at least the width of a bin. One that is longer than the record leaves only the first count.
    bin_width_ns : float
        Width of the bins [ns], positive.
    """
    tau, width = positive("dead_time_ns", dead_time_ns), positive("bin_width_ns", bin_width_ns)
    if tau < width:
        raise UserError(f"dead_time_ns = {tau:g} must be at least the bin width, {width:g} ns: use narrower bins")
    mean = tau / width + 0.5
    return DeadBins(int(mean), mean - int(mean))


def firing_probability(events: FloatArray, dead: DeadBins) -> tuple[FloatArray, FloatArray]:
    """Probabilities that a cell fires and that it is live in each bin, with a non-paralyzable dead time.

    fired = live (1 - exp(-events)), and live is 1 minus the probability of firing in the dead bins before.

    Notes
    -----
    P. B. Coates, J. Phys. E 1, 878 (1968), doi:10.1088/0022-3735/1/8/437, for a dead time up to the end of the record.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    fired, live = np.empty_like(hit), np.empty_like(hit)
    sums = np.zeros((len(hit) + 1, *hit.shape[1:]))
    for k in range(len(hit)):
        live[k] = 1 - (sums[k] - sums[max(0, k - dead.bins + 1)])
        if k >= dead.bins:
            live[k] -= dead.fraction * fired[k - dead.bins]
        fired[k] = live[k] * hit[k]
        sums[k + 1] = sums[k] + fired[k]
    return np.moveaxis(fired, 0, -1), np.moveaxis(live, 0, -1)


def firing_probability_paralyzable(events: FloatArray, dead: DeadBins) -> FloatArray:
    """Probability of a count in each bin when every event restarts the dead time.

    (1 - exp(-events)) times the probability of no event in the dead bins before.
    """
    mean = np.moveaxis(events, -1, 0)
    total = np.concatenate((np.zeros((1, *mean.shape[1:])), np.cumsum(mean, axis=0)))
    k = np.arange(len(mean))
    quiet = np.exp(total[np.maximum(k - dead.bins + 1, 0)] - total[k])
    quiet[dead.bins :] *= 1 + dead.fraction * np.expm1(-mean[: max(len(mean) - dead.bins, 0)])
    return np.asarray(np.moveaxis(-np.expm1(-mean) * quiet, 0, -1))


def pair_covariances(
    events: FloatArray, fired: FloatArray, dead: DeadBins, lags: int, paralyzable: bool = False
) -> list[FloatArray]:
    """Covariances of one cell's counts in pairs of bins.

    Parameters
    ----------
    events, dead, fired
        Arguments and result of `firing_probability`, or of `firing_probability_paralyzable`.
    lags : int
        Number of lags, at least 1.
    paralyzable : bool
        Whether every event restarts the dead time.

    Returns
    -------
    list of ndarray
        Item l has the covariance of the counts in the bins k and k + l, shape (..., time - l).

    Notes
    -----
    A count is a renewal of the process (Feller 1948, "On probability problems in the theory of counters"): the
    probability of another count at lag l follows from the recursion of `firing_probability` started with a count.
    """
    hit, q = -np.expm1(-np.moveaxis(events, -1, 0)), np.moveaxis(fired, -1, 0)
    length = len(q)
    result = [q * (1 - q)]
    again = [np.ones_like(q)]  # probability of a count at the lag, given one at lag 0
    sums = [np.zeros_like(q), np.ones_like(q)]  # sums[l]: over the lags below l
    for lag in range(1, min(lags, length)):
        kept = length - lag
        if paralyzable:
            # No second count within the dead bins; beyond them the counts are independent.
            free = q[lag:] * (lag > dead.bins)
            if lag == dead.bins:
                free = q[lag:] * (1 - dead.fraction) / (1 - dead.fraction * hit[:kept])
            result.append(q[:kept] * (free - q[lag:]))
            continue
        live = 1 - (sums[lag][:kept] - sums[max(0, lag - dead.bins + 1)][:kept])
        if lag >= dead.bins:
            live = live - dead.fraction * again[lag - dead.bins][:kept]
        again.append(live * hit[lag:])
        sums.append(sums[lag][:kept] + again[lag])
        result.append(q[:kept] * (again[lag] - q[lag:]))
    return [np.moveaxis(covariance, 0, -1) for covariance in result]


def sample_cells(events: FloatArray, cells: int, dead: DeadBins, shots: int, random: np.random.Generator) -> IntArray:
    """Draw the number of firing `cells`, each with the mean `events`, in `shots` records, shape (shots, ..., time)."""
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    fired = np.zeros((len(hit), shots, *hit.shape[1:]), dtype=np.int64)
    live = np.full(fired.shape[1:], cells, dtype=np.int64)
    late = np.zeros_like(live)
    for k in range(len(hit)):
        if k >= dead.bins:
            recovered = fired[k - dead.bins]
            stays = random.binomial(recovered, dead.fraction) if dead.fraction > 0 else np.zeros_like(late)
            live += recovered - stays + late
            late = stays
        fired[k] = random.binomial(live, hit[k])
        live -= fired[k]
    return np.ascontiguousarray(np.moveaxis(fired, 0, -1))


def sample_counter(
    events: FloatArray,
    dead: DeadBins,
    paralyzable: bool,
    shots: int,
    random: np.random.Generator,
    hazard: FloatArray | None = None,
) -> IntArray:
    """Draw the counts of a single cell, 0 or 1 in each bin, in `shots` records, shape (shots, ..., time).

    `hazard` is the probability of an afterpulse by the number of bins since the cell is live again, see
    `afterpulses.hazard`; None for no afterpulses.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    fired = np.zeros((len(hit), shots, *hit.shape[1:]), dtype=np.int64)
    free_from = np.zeros(fired.shape[1:], dtype=np.int64)
    if hazard is not None:
        # Before its first count, a cell has been live for longer than afterpulses last.
        free_from -= hazard.size
    for k in range(len(hit)):
        probability = hit[k]
        if hazard is not None:
            age = np.clip(k - free_from, 0, hazard.size - 1)
            probability = 1 - (1 - probability) * (1 - hazard[age])
        detected = random.random(free_from.shape) < probability
        counted = detected & (free_from <= k)
        fired[k] = counted
        restarts = np.flatnonzero(detected if paralyzable else counted)
        until = k + dead.bins + (random.random(restarts.size) < dead.fraction)
        flat = free_from.reshape(-1)
        flat[restarts] = np.maximum(flat[restarts], until)
    return np.ascontiguousarray(np.moveaxis(fired, 0, -1))
