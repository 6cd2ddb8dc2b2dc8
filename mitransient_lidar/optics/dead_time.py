"""Counting with dead time in time bins: what a blind detector still sees, its statistics, and their correction.

A cell that fires in a bin is blind for the rest of that bin and for the dead time tau after it. In bins of width dt the
blind time is tau/dt + 1/2 bins, the firing bin included: the event lies anywhere in its bin, in the middle on average.
What is left over of a whole number of bins is a probability: so many cells wait one bin more. This is the model of
Coates (1968) with a dead time shorter than the record, and the rate of a steady light is right to second order in the
events per bin.

Arrays hold the mean number of events that a live cell would see in a bin, over (..., time). All cells are live at the
first bin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, non_negative, positive, whole

IntArray = npt.NDArray[np.int64]


class BlindBins(NamedTuple):
    """Bins for which a cell is blind, its own included: `bins`, and one more with probability `share`."""

    bins: int
    share: float


class CountStatistics(NamedTuple):
    """Mean and variance of a number of counts."""

    mean: float
    variance: float


def blind_bins(dead_time_ns: float, bin_width_ns: float) -> BlindBins:
    """Bins for which a dead time blinds a cell.

    Parameters
    ----------
    dead_time_ns : float
        Dead time [ns], at least the width of a bin. One that is longer than the record leaves the first count only.
    bin_width_ns : float
        Width of the bins [ns], positive.

    Returns
    -------
    BlindBins
        Their mean number is dead_time_ns / bin_width_ns + 1/2.

    Raises
    ------
    ValueError
        If a time is not positive or the dead time is shorter than a bin.
    """
    tau, width = positive("dead_time_ns", dead_time_ns), positive("bin_width_ns", bin_width_ns)
    if tau < width:
        raise ValueError(f"dead_time_ns = {tau:g} must be at least the bin width, {width:g} ns: use narrower bins")
    blind = tau / width + 0.5
    return BlindBins(int(blind), blind - int(blind))


def fired_share(events: FloatArray, blind: BlindBins) -> tuple[FloatArray, FloatArray]:
    """Probabilities that a cell fires, and that it is live, in each bin, when light cannot prolong the dead time.

    Parameters
    ----------
    events : ndarray, shape (..., time)
        Mean number of events in a live cell.
    blind : BlindBins
        From `blind_bins`.

    Returns
    -------
    fired, live : ndarray, shape (..., time)
        fired = live (1 - exp(-events)), and live is 1 less what has fired within the blind bins before.

    Notes
    -----
    P. B. Coates, J. Phys. E 1, 878 (1968), doi:10.1088/0022-3735/1/8/437, for a dead time up to the end of the record.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    fired, live = np.empty_like(hit), np.empty_like(hit)
    sums = np.zeros((len(hit) + 1, *hit.shape[1:]))
    for k in range(len(hit)):
        live[k] = 1 - (sums[k] - sums[max(0, k - blind.bins + 1)])
        if k >= blind.bins:
            live[k] -= blind.share * fired[k - blind.bins]
        fired[k] = live[k] * hit[k]
        sums[k + 1] = sums[k] + fired[k]
    return np.moveaxis(fired, 0, -1), np.moveaxis(live, 0, -1)


def fired_share_paralyzable(events: FloatArray, blind: BlindBins) -> FloatArray:
    """Probability that a cell counts in each bin, when every event begins the dead time anew.

    Parameters
    ----------
    events, blind
        As for `fired_share`.

    Returns
    -------
    ndarray, shape (..., time)
        (1 - exp(-events)) times the probability that nothing came within the blind bins before.
    """
    mean = np.moveaxis(events, -1, 0)
    total = np.concatenate((np.zeros((1, *mean.shape[1:])), np.cumsum(mean, axis=0)))
    k = np.arange(len(mean))
    quiet = np.exp(total[np.maximum(k - blind.bins + 1, 0)] - total[k])
    quiet[blind.bins :] *= 1 + blind.share * np.expm1(-mean[: max(len(mean) - blind.bins, 0)])
    return np.asarray(np.moveaxis(-np.expm1(-mean) * quiet, 0, -1))


def pair_covariances(
    events: FloatArray, fired: FloatArray, blind: BlindBins, lags: int, paralyzable: bool = False
) -> list[FloatArray]:
    """Covariances of one cell's counts in pairs of bins.

    Parameters
    ----------
    events, blind
        As for `fired_share`.
    fired : ndarray, shape (..., time)
        What `fired_share` or `fired_share_paralyzable` returned.
    lags : int
        Number of lags, at least 1.
    paralyzable : bool
        Whether every event begins the dead time anew.

    Returns
    -------
    list of ndarray
        The lag l has the covariance of the counts in the bins k and k + l, shape (..., time - l).

    Notes
    -----
    After a count the process begins anew (Feller 1948, "On probability problems in the theory of counters"): the
    probability of a further count at lag l follows from the recursion of `fired_share` that begins with a count.
    """
    hit, q = -np.expm1(-np.moveaxis(events, -1, 0)), np.moveaxis(fired, -1, 0)
    length = len(q)
    result = [q * (1 - q)]
    again = [np.ones_like(q)]  # probability of a count at the lag, given one at lag 0
    sums = [np.zeros_like(q), np.ones_like(q)]  # sums[l]: over the lags below l
    for lag in range(1, min(lags, length)):
        kept = length - lag
        if paralyzable:
            # Beyond the blind bins nothing is left of the count; within them there is no second one.
            free = q[lag:] * (lag > blind.bins)
            if lag == blind.bins:
                free = q[lag:] * (1 - blind.share) / (1 - blind.share * hit[:kept])
            result.append(q[:kept] * (free - q[lag:]))
            continue
        live = 1 - (sums[lag][:kept] - sums[max(0, lag - blind.bins + 1)][:kept])
        if lag >= blind.bins:
            live = live - blind.share * again[lag - blind.bins][:kept]
        again.append(live * hit[lag:])
        sums.append(sums[lag][:kept] + again[lag])
        result.append(q[:kept] * (again[lag] - q[lag:]))
    return [np.moveaxis(covariance, 0, -1) for covariance in result]


def sample_cells(events: FloatArray, cells: int, blind: BlindBins, shots: int, random: np.random.Generator) -> IntArray:
    """Draw how many of many like cells fire.

    Parameters
    ----------
    events, blind
        As for `fired_share`.
    cells : int
        Number of cells, each of which sees `events`.
    shots : int
        Number of realisations.
    random : numpy.random.Generator
        Source of random numbers.

    Returns
    -------
    ndarray of int, shape (shots, ..., time)
        Cells that fire in each bin.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    fired = np.zeros((len(hit), shots, *hit.shape[1:]), dtype=np.int64)
    live = np.full(fired.shape[1:], cells, dtype=np.int64)
    late = np.zeros_like(live)
    for k in range(len(hit)):
        if k >= blind.bins:
            recovered = fired[k - blind.bins]
            stays = random.binomial(recovered, blind.share) if blind.share > 0 else np.zeros_like(late)
            live += recovered - stays + late
            late = stays
        fired[k] = random.binomial(live, hit[k])
        live -= fired[k]
    return np.ascontiguousarray(np.moveaxis(fired, 0, -1))


def sample_counter(
    events: FloatArray, blind: BlindBins, paralyzable: bool, shots: int, random: np.random.Generator
) -> IntArray:
    """Draw the counts of a single cell.

    Parameters
    ----------
    events, blind, shots, random
        As for `sample_cells`.
    paralyzable : bool
        Whether every event begins the dead time anew.

    Returns
    -------
    ndarray of int, shape (shots, ..., time)
        0 or 1 in each bin.
    """
    hit = -np.expm1(-np.moveaxis(events, -1, 0))
    fired = np.zeros((len(hit), shots, *hit.shape[1:]), dtype=np.int64)
    free_from = np.zeros(fired.shape[1:], dtype=np.int64)
    for k in range(len(hit)):
        came = random.random(free_from.shape) < hit[k]
        counted = came & (free_from <= k)
        fired[k] = counted
        blinds = np.flatnonzero(came if paralyzable else counted)
        until = k + blind.bins + (random.random(blinds.size) < blind.share)
        flat = free_from.reshape(-1)
        flat[blinds] = np.maximum(flat[blinds], until)
    return np.ascontiguousarray(np.moveaxis(fired, 0, -1))


def correct_pile_up(counts: npt.ArrayLike, shots: int, dead_time_ns: float, bin_width_ns: float) -> FloatArray:
    """Mean events per bin from a histogram of counts that dead time distorts.

    Parameters
    ----------
    counts : array_like, shape (..., time)
        Counts in each bin, summed over `shots`.
    shots : int
        Number of shots, at least 1.
    dead_time_ns : float
        Dead time that light does not prolong [ns], at least a bin. For first photons only, one beyond the record.
    bin_width_ns : float
        Width of the bins [ns], positive.

    Returns
    -------
    ndarray, shape (..., time)
        Mean number of events per shot and bin, efficiency and dark counts included; infinite where every live
        shot counted, NaN where no shot was live.

    Raises
    ------
    ValueError
        If there are more counts than live shots or a parameter lies outside its range.

    Notes
    -----
    -ln(1 - counts/live), where live is the number of shots less those blinded by counts before: P. B. Coates,
    J. Phys. E 1, 878 (1968), doi:10.1088/0022-3735/1/8/437.
    """
    seen = np.moveaxis(np.atleast_1d(finite_array("counts", counts)), -1, 0)
    number = whole("shots", shots, 1, 2**53)
    blind = blind_bins(dead_time_ns, bin_width_ns)
    if np.any(seen < 0):
        raise ValueError(f"counts = {seen.min():g} must not be negative")
    total = np.concatenate((np.zeros((1, *seen.shape[1:])), np.cumsum(seen, axis=0)))
    k = np.arange(len(seen))
    live = number - (total[k] - total[np.maximum(k - blind.bins + 1, 0)])
    if np.any(seen > live):
        raise ValueError(f"counts = {seen.max():g} must not exceed the shots that are live, of {number}")
    live[blind.bins :] -= blind.share * seen[: max(len(seen) - blind.bins, 0)]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.moveaxis(-np.log1p(-np.minimum(seen / live, 1)), 0, -1))


def steady_counts(
    rate_hz: float, dead_time_ns: float, duration_ns: float, paralyzable: bool = False
) -> CountStatistics:
    """Count a steady light for a long time with a detector that has been open long.

    Parameters
    ----------
    rate_hz : float
        Events per second without dead time, at least 0.
    dead_time_ns : float
        Dead time tau [ns], at least 0.
    duration_ns : float
        Time T of counting [ns], longer than the dead time.
    paralyzable : bool
        Whether every event prolongs the dead time.

    Returns
    -------
    CountStatistics
        Not paralyzable: r T/(1 + r tau), and the variance r T/(1 + r tau)^3, to which a constant below 1/6 is added
        at finite T. Paralyzable: m = r T exp(-r tau) and the variance m - m^2 (tau/T) (2 - tau/T).

    Raises
    ------
    ValueError
        If a parameter lies outside its range.

    Notes
    -----
    W. Feller (1948), "On probability problems in the theory of counters"; J. W. Mueller, Nucl. Instrum. Methods 112,
    47 (1973), doi:10.1016/0029-554X(73)90773-8.
    """
    rate = non_negative("rate_hz", rate_hz)
    tau, duration = 1e-9 * non_negative("dead_time_ns", dead_time_ns), 1e-9 * positive("duration_ns", duration_ns)
    if duration <= tau:
        raise ValueError(f"duration_ns = {duration_ns:g} must be longer than the dead time, {dead_time_ns:g} ns")
    if not paralyzable:
        slowed = 1 + rate * tau
        return CountStatistics(rate * duration / slowed, rate * duration / slowed**3)
    mean = rate * duration * float(np.exp(-rate * tau))
    return CountStatistics(mean, mean - mean**2 * (tau / duration) * (2 - tau / duration))
