"""Sample limits: how long echoes are clipped, which meet a bottom twice, digitiser steps, and noise of means."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray, IntArray
from mitransient_lidar.core.validation import FloatArray

_OF_UNIFORM = 12**-0.5  # standard deviation of a uniform distribution over its width


def saturated_spans(saturated: BoolArray, bins: IntArray, width: float) -> FloatArray:
    """Return how many bins are clipped about echoes, 0 of those without a saturated sample within an echo width.

    `saturated`: whether samples are saturated, shape (n, time). `bins`: peak bins, -1 without an echo, shape (echo, n).
    `width`: echo width in bins, by which runs of saturated samples may be apart to count as one.
    """
    count, index = saturated.shape[1], np.arange(saturated.shape[1])
    if not saturated.any():
        return np.zeros(bins.shape)
    before = np.maximum.accumulate(np.where(saturated, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(saturated, index, count)[:, ::-1], axis=1)[:, ::-1]
    # Samples between two saturated ones that are near each other are in one run.
    inside = saturated | ((before >= 0) & (after < count) & (after - before <= width))
    first = np.maximum.accumulate(np.where(inside, -1, index), axis=1) + 1
    last = np.minimum.accumulate(np.where(inside, count, index)[:, ::-1], axis=1)[:, ::-1] - 1
    half, lines = int(np.ceil(width)), np.arange(len(saturated))
    low, top = np.clip(bins - half, 0, count - 1), np.clip(bins + half, 0, count - 1)
    left, right = after[lines, low], before[lines, top]
    found = (bins >= 0) & (left <= right)
    ends = last[lines, np.maximum(right, 0)] - first[lines, np.minimum(left, count - 1)] + 1
    return np.where(found, ends, 0).astype(np.float64)


def widen(errors: FloatArray, spans: FloatArray) -> None:
    """Add to the errors of times [ns], shape (n, ..., echo), that a peak may be anywhere in the time that is clipped.

    `spans` are these times about surface, targets and bottom [ns], shape (echo, n); the second echo is the column.
    """
    for echo, clipped in zip((0, *range(2, len(spans) + 1)), spans, strict=True):
        error, span = errors[..., echo], clipped.reshape(-1, *[1] * (errors.ndim - 2))
        error[:] = np.where(span > 0, np.hypot(np.minimum(error, span), _OF_UNIFORM * span), error)


def longest_run(saturated: BoolArray) -> tuple[IntArray, IntArray]:
    """Return first and last bin of the longest saturated run, samples of shape (n, time); 1 and 0 without any."""
    index = np.arange(saturated.shape[1])
    run = index - np.maximum.accumulate(np.where(saturated, -1, index), axis=1)
    last = run.argmax(axis=1)
    return last - run.max(axis=1) + 1, last


def may_be_second_return(
    time_ns: FloatArray, half_ns: FloatArray, clipped_ns: FloatArray, width_ns: float
) -> BoolArray:
    """Return which echoes may be light that a bottom within a clipped time has returned twice.

    Echo times, and half their delays after the mean surface, have the shape (n, estimator, echo), first and last
    clipped times (n, 2). Half delays below two echo widths are within the surface's own echo.
    """
    start, end = clipped_ns.T[..., np.newaxis, np.newaxis]
    clipped = (start <= time_ns - half_ns) & (time_ns - half_ns <= end) & (half_ns > 2 * width_ns)
    return np.asarray(clipped & (np.arange(time_ns.shape[-1]) > 1))


def level_error(rest: FloatArray, inflated: float, samples: npt.NDArray[np.floating]) -> FloatArray:
    """Return the standard error of weak steady signals above the level without light, shape (pixels,).

    `rest`: samples without light less this level, shape (shots, pixels, bins). `inflated`: standard deviation ratio for
    means of samples, neighbouring to independent. `samples`: samples with light, whose least difference is the step of
    the digitiser.

    Noise with standard deviation s spreads a level over digitiser steps h: rounding shifts the mean by h/pi exp(-2 pi^2
    s^2/h^2) at most (B. Widrow, I. Kollar, M.-C. Liu, IEEE Trans. Instrum. Meas. 45, 353 (1996)). Without noise, each
    of signal and level is uniformly distributed over a step.
    """
    steps = np.diff(np.unique(samples))
    step = float(steps.min()) if steps.size else 0.0
    scatter = np.asarray(rest.std(axis=(0, 2)), dtype=np.float64)
    noise = np.maximum(scatter**2 - (step * _OF_UNIFORM) ** 2, 0)
    rounding = math.sqrt(2) * _OF_UNIFORM * step * np.exp(-2 * (math.pi / step) ** 2 * noise) if step > 0 else 0.0
    return np.hypot(inflated * scatter / math.sqrt(rest[:, 0].size), rounding)


def inflation(rest: FloatArray, run: int) -> float:
    """Return the standard deviation of means of `run` neighbouring samples over that of independent samples.

    NaN are missing samples.
    """
    run = min(run, rest.shape[-1])
    blocks = rest.shape[-1] // run
    means = rest[..., : blocks * run].reshape(*rest.shape[:-1], blocks, run).mean(axis=-1)
    known = means[np.isfinite(means)]
    variance = float(np.mean(rest[np.isfinite(rest)] ** 2)) if known.size else 0.0
    return math.sqrt(max(run * float(np.mean(known**2)) / variance, 1.0)) if variance > 0 else 1.0
