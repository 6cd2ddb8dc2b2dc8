"""Counting with dead time in time bins: probabilities of counts, their covariances, and random realisations.

A cell that fires in a bin is dead for the rest of that bin and for the dead time tau after it. Counted from the firing
bin, this makes tau/dt + u bins, with the bin width dt and the event's mean position u in its bin. It is 1/2 in weak
light, and less in strong light, whose first event is early. The excess over the whole part of tau/dt is the probability
of further dead bins. This is the model of Coates (1968) with a dead time shorter than the record. With this u the count
rate in steady light is exact (W. Feller 1948, "On probability problems in the theory of counters").

Arrays `events` contain the mean number of events per bin that a live cell would detect, shape (..., time).
Probabilities have the same shape. All cells are live at the first bin.

After a count a channel with afterpulses is dead as without them. Once it is live again, the time to an afterpulse is
exponentially distributed, with a probability that an afterpulse occurs at all. The next count, of either kind, begins
this anew. Counts are a renewal process, whose state is the channel's live time: recursions over it are exact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray, positive

_LAST_AFTERPULSES = 1e-9  # neglected share of the afterpulses


class DeadBins(NamedTuple):
    """Dead time in bins: its whole part, for which a cell is dead in any case, and the rest, below 1."""

    bins: int
    rest: float


def dead_bins(dead_time_ns: float, bin_width_ns: float) -> DeadBins:
    """Return a dead time in bins.

    `dead_time_ns`: dead time [ns], at least the bin width. One that is longer than the record leaves only the first
    count. `bin_width_ns`: bin width [ns], positive.
    """
    tau, width = positive("dead_time_ns", dead_time_ns), positive("bin_width_ns", bin_width_ns)
    if tau < width:
        raise UserError(f"dead_time_ns = {tau:g} must be at least the bin width, {width:g} ns: use narrower bins")
    bins = int(tau / width)
    return DeadBins(bins, tau / width - bins)


def further_bins(events: FloatArray, dead: DeadBins, paralyzable: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return the probabilities that a cell that fires is dead in the first bin beyond `dead.bins`, and in the second.

    For a non-paralyzable dead time their sum is the rest plus the first event's mean position in its bin, 1/x -
    1/(exp(x) - 1) for x events. For a paralyzable one they make the probability of a count x exp(-x tau/dt).
    """
    x = np.maximum(events, 1e-6)
    hit = -np.expm1(-x)
    if not paralyzable:
        place = np.where(x < 1e-3, 0.5 - x / 12, 1 + 1 / x - 1 / hit)
        return np.minimum(dead.rest + place, 1.0), np.maximum(dead.rest + place - 1, 0.0)
    # The exact probability of a count over that without further bins.
    quiet = x * np.exp(-(1 + dead.rest) * x) / hit
    return np.minimum((1 - quiet) / hit, 1.0), np.maximum((1 - quiet * np.exp(x)) / hit, 0.0)


def firing_probability(events: FloatArray, dead: DeadBins) -> tuple[FloatArray, FloatArray]:
    """Probabilities that a cell fires and that it is live in each bin, with a non-paralyzable dead time.

    fired = live (1 - exp(-events)), and live is 1 minus the probability of firing in the dead bins before.

    P. B. Coates, J. Phys. E 1, 878 (1968), doi:10.1088/0022-3735/1/8/437, for a dead time up to the end of the record.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    further = further_bins(np.moveaxis(events, -1, 0), dead)
    fired, live = np.empty_like(hit), np.empty_like(hit)
    sums = np.zeros((len(hit) + 1, *hit.shape[1:]))
    for k in range(len(hit)):
        live[k] = 1 - (sums[k] - sums[max(0, k - dead.bins + 1)])
        for ago, share in enumerate(further, dead.bins):
            if k >= ago:
                live[k] -= share[k - ago] * fired[k - ago]
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
    for ago, share in enumerate(further_bins(mean, dead, paralyzable=True), dead.bins):
        quiet[ago:] *= 1 + (share * np.expm1(-mean))[: max(len(mean) - ago, 0)]
    return np.asarray(np.moveaxis(-np.expm1(-mean) * quiet, 0, -1))


def pair_covariances(
    events: FloatArray, fired: FloatArray, dead: DeadBins, lags: int, paralyzable: bool = False
) -> list[FloatArray]:
    """Covariances between one cell's counts in pairs of bins.

    `events`, `dead`, `fired`: arguments and result of `firing_probability`, or of `firing_probability_paralyzable`.
    `lags`: number of lags, at least 1. `paralyzable`: whether every event restarts the dead time.

    Result: item l contains the covariance between the counts in bins k and k + l, shape (..., time - l).

    A count renews the process (Feller 1948, "On probability problems in the theory of counters"): the probability of
    another count at lag l follows from the recursion of `firing_probability` started with a count.
    """
    hit, q = -np.expm1(-np.moveaxis(events, -1, 0)), np.moveaxis(fired, -1, 0)
    length = len(q)
    first, second = further = further_bins(np.moveaxis(events, -1, 0), dead, paralyzable)
    result = [q * (1 - q)]
    again = [np.ones_like(q)]  # probability of a count at the lag, given one at lag 0
    sums = [np.zeros_like(q), np.ones_like(q)]  # sums[l]: over the lags below l
    for lag in range(1, min(lags, length)):
        kept = length - lag
        if paralyzable:
            # No second count within the dead bins; beyond them the counts are independent.
            free = q[lag:] * (lag >= dead.bins)
            if lag == dead.bins:
                free *= (1 - first[:kept]) / (1 - first[:kept] * hit[:kept])
                # A count leaves no event in the bin before it.
                free[1:] /= 1 - second[: kept - 1] * hit[: kept - 1]
            elif lag == dead.bins + 1:
                free *= (1 - second[:kept]) / (1 - second[:kept] * hit[:kept])
            result.append(q[:kept] * (free - q[lag:]))
            continue
        live = 1 - (sums[lag][:kept] - sums[max(0, lag - dead.bins + 1)][:kept])
        for ago, share in enumerate(further, dead.bins):
            if lag >= ago:
                live = live - share[lag - ago : length - ago] * again[lag - ago][:kept]
        again.append(live * hit[lag:])
        sums.append(sums[lag][:kept] + again[lag])
        result.append(q[:kept] * (again[lag] - q[lag:]))
    return [np.moveaxis(covariance, 0, -1) for covariance in result]


def sample_cells(events: FloatArray, cells: int, dead: DeadBins, shots: int, random: np.random.Generator) -> IntArray:
    """Draw the number of firing `cells`, each with the mean `events`, in `shots` records, shape (shots, ..., time)."""
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    first, second = further_bins(np.moveaxis(events, -1, 0), dead)
    fired = np.zeros((len(hit), shots, *hit.shape[1:]), dtype=np.int64)
    live = np.full(fired.shape[1:], cells, dtype=np.int64)
    late = later = np.zeros_like(live)
    for k in range(len(hit)):
        live += later
        if k > dead.bins:
            again = second[k - dead.bins - 1] / first[k - dead.bins - 1]
            later = random.binomial(late, again) if np.any(again) else np.zeros_like(late)
            live += late - later
        if k >= dead.bins:
            recovered = fired[k - dead.bins]
            late = random.binomial(recovered, first[k - dead.bins])
            live += recovered - late
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

    `hazard` is the afterpulse probability by the number of bins since the cell is live again, see `afterpulse_hazard`;
    None for no afterpulses.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    first, second = further_bins(np.moveaxis(events, -1, 0), dead, paralyzable)
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
        chance = random.random(restarts.size)
        further = (np.broadcast_to(share[k], free_from.shape).reshape(-1)[restarts] for share in (first, second))
        until = k + dead.bins + sum((chance < share).astype(np.int64) for share in further)
        flat = free_from.reshape(-1)
        flat[restarts] = np.maximum(flat[restarts], until)
    return np.ascontiguousarray(np.moveaxis(fired, 0, -1))


def afterpulse_hazard(probability: float, decay_bins: float, bins: int) -> FloatArray:
    """Return the probability of an afterpulse in a bin if there was none before.

    `probability`: probability of an afterpulse at any time, above 0 and below 1. `decay_bins`: mean time to an
    afterpulse in bins, positive. `bins`: record length in bins; none lasts longer.

    Result, shape (age,): by bins since the channel is live; the last one is 0 and stands for all later bins.
    """
    size = min(math.ceil(-math.log(_LAST_AFTERPULSES) * decay_bins), bins) + 1
    none_until = 1 - probability + probability * np.exp(-np.arange(size + 1) / decay_bins)
    found = 1 - none_until[1:] / none_until[:-1]
    found[-1] = 0.0
    return np.asarray(found)


def afterpulse_moments(
    events: FloatArray, dead: DeadBins, chances: FloatArray, lags: int
) -> tuple[FloatArray, list[FloatArray]]:
    """Return one channel's count probability in each bin, and covariances between pairs of bins.

    `events`, shape (..., time): mean events per bin of a live channel, without afterpulses. `dead`: bins for which a
    channel is dead after a count. `chances`, shape (age,): result of `afterpulse_hazard`. `lags`: number of lags, at
    least 1.

    Returns `fired`, shape (..., time). `covariances`: item l contains the covariance between the counts in bins k and k
    + l, shape (..., time - l).
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    length = len(hit)
    first, second = further_bins(np.moveaxis(events, -1, 0), dead)
    # Shares of channels that are live again some bins after a count.
    ends = list(enumerate((1 - first, first - second, second), dead.bins))
    state = np.zeros((chances.size, *hit.shape[1:]))
    state[-1] = 1.0  # as if live for long
    fired = np.zeros_like(hit)
    for k in range(length):
        state[0] += sum(share[k - ago] * fired[k - ago] for ago, share in ends if k >= ago)
        fired[k], state = _next_bin(state, hit[k], chances)
    covariances = [fired * (1 - fired)]
    # Probabilities of another count after one in each bin, by the lag.
    again = np.zeros((min(lags, length), *hit.shape))
    again[0] = 1.0
    state = np.zeros((chances.size, *hit.shape))
    for lag in range(1, min(lags, length)):
        kept = length - lag
        state = state[:, :kept]
        state[0] += sum(share[lag - ago : length - ago] * again[lag - ago, :kept] for ago, share in ends if lag >= ago)
        again[lag, :kept], state = _next_bin(state, hit[lag:], chances)
        covariances.append(fired[:kept] * (again[lag, :kept] - fired[lag:]))
    return np.moveaxis(fired, 0, -1), [np.moveaxis(one, 0, -1) for one in covariances]


def _next_bin(state: FloatArray, hit: FloatArray, chances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the probability of a count in a bin, and the probability of each live-channel age in the next bin."""
    quiet = (1 - hit) * (1 - chances.reshape(-1, *(1,) * hit.ndim))
    survived = state * quiet
    after = np.zeros_like(state)
    after[1:] = survived[:-1]
    after[-1] += survived[-1]
    fired: FloatArray = np.sum(state, axis=0) - np.sum(survived, axis=0)
    return fired, after
