"""Arrival of the surface in every pixel of a shot: its own echo, or that of the pixels with direct light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.results.geometry import LinesOfSight

#: Least share of the beam in a pixel with direct light, relative to the brightest pixel.
LEAST_SHARE = 1e-3
_LIMIT = 4.0  # standard deviations by which an echo may deviate from the other pixels' surface
_LEVEL = 0.15  # error of the mean sea level [m]
_SHAPE = 0.1  # error of an echo's time by its unknown shape, in echo widths


class SurfaceTimes(NamedTuple):
    """Arrival of the surface [ns] and its standard error, and whether it is the pixel's own; shape (shots, pixels)."""

    time_ns: FloatArray
    stderr_ns: FloatArray
    own: BoolArray


def surface_times(
    time_ns: FloatArray,
    stderr_ns: FloatArray,
    lines: LinesOfSight,
    *,
    slope_variance: float,
    heights_m: tuple[float, float],
    echo_fwhm_ns: float,
) -> SurfaceTimes:
    """Hold the surface echoes of shots against beam and geometry, and replace those without direct light.

    Parameters
    ----------
    time_ns, stderr_ns : ndarray, shape (shots, pixels)
        Arrival of the first echoes and its standard error [ns]; NaN without one.
    lines : LinesOfSight
        Lines of sight with arrays of shape (shots, pixels).
    slope_variance : float
        Variance of the sea's slopes, the sum over two directions [1].
    heights_m : (float, float)
        Lowest and highest point of the sea [m], infinite if unknown.
    echo_fwhm_ns : float
        Expected full width of an echo at half maximum [ns].

    Returns
    -------
    SurfaceTimes
        A pixel's own time where it has at least a thousandth of the light of the brightest pixel, and where its
        deviation from the level sea agrees, within 4 standard deviations, with the heights of the sea and with the
        median of the pixels, weighted with their light; a noisy one is drawn towards the level sea. Otherwise, that of
        the level sea plus the mean deviation of the former pixels; without any of them, that of the mean sea level,
        with the standard deviation of the heights as error, or NaN where the heights are unknown. Where the shares of
        the beam are unknown, all times are own.

    Notes
    -----
    The variance of a pixel's deviation has four parts: the error of its time; the spread of the arrival over its light,
    since few facets return the light; the pixel's distance from the middle of the light times the deviation of the
    slopes along it; a tenth of the echo's width for its unknown shape. A replaced time has the error of the mean
    deviation, and the third part.
    """
    known = np.isfinite(time_ns)
    share = lines.beam_share
    if np.isnan(share).any():
        return SurfaceTimes(time_ns, stderr_ns, known)
    light = share >= LEAST_SHARE * share.max(axis=1, keepdims=True)
    tilt = _tilt_ns(lines, np.sqrt(0.5 * slope_variance))
    own_error = np.hypot(np.hypot(np.nan_to_num(stderr_ns), lines.surface_spread), _SHAPE * echo_fwhm_ns)
    deviation = np.where(known, time_ns, 0) - lines.surface_time
    # A crest is nearer than the mean sea level.
    latest, earliest = (-height / (0.5e-9 * C0 * np.cos(lines.off_nadir)) for height in heights_m)
    within = (deviation >= earliest - _LIMIT * own_error) & (deviation <= latest + _LIMIT * own_error)
    candidate = known & light & (share > 0) & within
    middle = _weighted_median(deviation, np.where(candidate, share, 0))
    lit = candidate & (np.abs(deviation - middle) <= _LIMIT * np.hypot(own_error, tilt))
    weight = np.where(lit, 1 / np.hypot(own_error, tilt) ** 2, 0)
    total = weight.sum(axis=1, keepdims=True)
    some = total > 0
    total = np.where(some, total, 1.0)
    mean = np.sum(weight * deviation, axis=1, keepdims=True) / total
    # An eighth of the heights' range is their standard deviation.
    spread = 0.125 * (heights_m[1] - heights_m[0]) / (0.5e-9 * C0 * np.cos(lines.off_nadir))
    level = np.where(np.isfinite(spread), 0.0, np.nan)
    inferred = lines.surface_time + np.where(some, mean, level)
    error = np.where(some, np.hypot(1 / np.sqrt(total), tilt), np.where(np.isfinite(spread), spread, np.nan))
    # A noisy time is drawn towards that of the mean sea level, by its own error and the heights of the sea.
    level_error = np.hypot(
        np.where(np.isfinite(spread), spread, np.inf), _LEVEL / (0.5e-9 * C0 * np.cos(lines.off_nadir))
    )
    noise = np.nan_to_num(stderr_ns)
    drawn = np.where(np.isfinite(level_error), noise**2 / (noise**2 + level_error**2), 0)
    own_time, own_noise = time_ns - drawn * deviation, noise * np.sqrt(1 - drawn)
    return SurfaceTimes(np.where(lit, own_time, inferred), np.where(lit, own_noise, error), lit)


def _tilt_ns(lines: LinesOfSight, slope: float) -> FloatArray:
    """Return the deviation [ns] of arrivals by a slope of the sea about the middle of the beam's light."""
    half = 0.5e-9 * C0  # metres of range per nanosecond
    away = lines.surface_time * half
    cosine = np.cos(lines.off_nadir)
    weight = lines.beam_share / np.maximum(lines.beam_share.sum(axis=1, keepdims=True), 1e-300)
    x, y = away * lines.sight_x / cosine, away * lines.sight_y
    x, y = (one - np.sum(weight * one, axis=1, keepdims=True) for one in (x, y))
    return np.asarray(slope * np.hypot(x, y) / (cosine * half))


def _weighted_median(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return weighted medians along the last axis, kept; any value without weight."""
    order = np.argsort(values, axis=1)
    cumulative = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    place = np.argmax(cumulative >= 0.5 * cumulative[:, -1:], axis=1)[:, np.newaxis]
    return np.asarray(np.take_along_axis(np.take_along_axis(values, order, axis=1), place, axis=1))
