"""Surface arrival in every pixel of a shot: its own echo, or pixels with direct light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.waveforms.depth_errors import mean_slope
from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray, EchoClass, IntArray
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.shot_jitter import timing_jitter
from mitransient_lidar.results.geometry import LinesOfSight, required_number

#: Least share of the beam in a pixel with direct light, relative to the brightest pixel.
LEAST_SHARE = 1e-3
#: Angle from nadir [rad] beyond which no facet sends light back: a slope of 7 deviations at 20 m/s (Cox and Munk).
GRAZING = np.radians(60.0)
_LIMIT = 4.0  # standard deviations by which an echo may deviate from the other pixels' surface
#: Error of the mean sea level [m].
LEVEL = 0.15
# Fewest surfaces that state the level of all, their standard deviation over the median of absolute deviations, and the
# error of columns' onsets [m].
_NEIGHBOURS, _PER_MAD, _ONSET = 8, 1.4826, 0.03
_SHAPE = 0.1  # error of an echo's time by its unknown shape, in echo widths
_LEAST_ERROR = 1e-3  # of a time [ns]


class SurfaceLevel(NamedTuple):
    """Arrival of the surface as known without a record: by the mean sea level, an infrared channel, or neighbours."""

    time_ns: FloatArray  #: Mean, shape (n,).
    stderr_ns: FloatArray  #: Standard deviation of the surface about it.

    def part(self, rows: IntArray | slice) -> SurfaceLevel:
        """Return those of some records."""
        return SurfaceLevel(self.time_ns[rows], self.stderr_ns[rows])

    def or_else(self, other: SurfaceLevel) -> SurfaceLevel:
        """Return these arrivals, and others where they are not known (NaN)."""
        known = np.isfinite(self.time_ns)
        return SurfaceLevel(*(np.where(known, own, one) for own, one in zip(self, other, strict=True)))

    def of_neighbours(
        self, time_ns: FloatArray, error_ns: FloatArray, known: BoolArray, per_metre: FloatArray
    ) -> SurfaceLevel:
        """Return arrivals by the mean level of the surfaces that are known, if they are several; else these.

        The arguments have the shape (n,): measured surface arrivals, their errors [ns], which ones count, and time per
        height [ns/m]. The level is the median height; its error contains the robust height spread, waves included, and
        the column onset error.
        """
        known = known & (2 * error_ns < self.stderr_ns)
        count = np.count_nonzero(known)
        height = (self.time_ns - time_ns)[known] / per_metre[known]
        level = float(np.median(height)) if count >= _NEIGHBOURS else np.inf
        if abs(level) > _LIMIT * LEVEL:
            return self
        spread = _PER_MAD * float(np.median(np.abs(height - level))) * np.sqrt(1 + 1 / count)
        error = per_metre * np.hypot(spread, _ONSET)
        return SurfaceLevel(self.time_ns - per_metre * level, np.minimum(error, self.stderr_ns))

    def combined(
        self, time_ns: FloatArray, noise_ns: FloatArray, method_ns: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return weighted means of measured arrivals and these, and their errors by noise and method [ns].

        Each of shape (n, ...), NaN where neither is known. Weights are the inverse squares of both errors together.
        """
        level, error = (one.reshape(-1, *[1] * (time_ns.ndim - 1)) for one in self)
        variance = noise_ns**2 + method_ns**2
        share = np.where(np.isfinite(time_ns), variance / np.maximum(variance + error**2, 1e-300), 1.0)
        share = np.where(np.isfinite(level), share, 0.0)
        known, noise, method, level, error = map(np.nan_to_num, (time_ns, noise_ns, method_ns, level, error))
        mean = np.where(np.isfinite(time_ns) | (share > 0), known + share * (level - known), np.nan)
        return mean, np.hypot((1 - share) * noise, share * error) + 0 * mean, (1 - share) * method


class SurfaceTimes(NamedTuple):
    """Arrival of the surface in every pixel, shape (shots, pixels)."""

    time_ns: FloatArray
    stderr_ns: FloatArray  #: Error by noise; of a time that is inferred from other pixels, the whole error.
    method_ns: FloatArray  #: Error by the few places that return light, 0 where it is inferred.
    own: BoolArray  #: Whether the pixel's own echo is a surface echo.


def infrared_level(
    table: xr.Dataset, infrared: xr.Dataset, green: xr.Dataset, lines: LinesOfSight, count: int
) -> SurfaceLevel:
    """Return the arrival of the surface in green waveforms as the infrared channel has measured it.

    Parameters
    ----------
    table
        Infrared channel echoes by one estimator.
    infrared, green
        Both results or records.
    lines
        Lines of sight for a shot's green pixels, shape (pixels,), or all waveforms.
    count
        Number of green waveforms.

    Notes
    -----
    Green pixels share the surface height over mean sea level in the infrared pixel that has most of the beam. Its error
    stems from the infrared time and both records' triggers and clocks. Waves add the standard deviation of slopes
    averaged over the green beam, times two lengths. These are the pixel's distance from the infrared beam, and a
    quarter of the green beam's diameter for its own mean height. Where it is not known, the level is NaN.
    """
    dims = tuple(str(dim) for dim in table["surface_time_ns"].dims)
    own = LinesOfSight.from_dataset(infrared, dims)
    shots = table.sizes.get("shot", 1)
    pixel = int(np.argmax(np.nan_to_num(own.beam_share).reshape(shots, -1).sum(axis=0)))

    def in_pixel(values: FloatArray) -> FloatArray:
        return np.asarray(values.reshape(shots, -1)[:, pixel])

    errors = (table[f"surface_time_ns_{name}"].values for name in ("stderr", "method_error"))
    half = 0.5e-9 * C0
    per_ns = half * np.cos(in_pixel(own.off_nadir))
    late = table["surface_time_ns"].values.ravel() - own.surface_time
    known = (table["class"].sel(echo="surface") == EchoClass.SURFACE).values
    height = np.where(in_pixel(known), -per_ns * in_pixel(late), np.nan)
    error = per_ns * in_pixel(np.hypot(*errors))
    pixels = count // shots
    lines = lines.at(np.arange(count) % lines.off_nadir.size)
    away = lines.surface_time * half
    x, y = away * lines.sight_x / np.cos(lines.off_nadir), away * lines.sight_y
    apart = _aim(green) - _aim(infrared)
    width = 2e-3 * required_number(green.attrs, "divergence_mrad", 0.0) * float(np.mean(away))
    slope = mean_slope(green.attrs, width)
    by_waves = slope * np.hypot(np.hypot(x + apart[0], y + apart[1]), 0.25 * width)
    timing = np.hypot(*(np.hypot(*timing_jitter(one.attrs)) for one in (green, infrared)))
    down = half * np.cos(lines.off_nadir)
    time = lines.surface_time - np.repeat(height, pixels) / down
    return SurfaceLevel(time, np.hypot(np.hypot(np.repeat(error, pixels), by_waves) / down, timing) + 0 * time)


def check_surface(corrections: xr.Dataset, infrared: bool) -> None:
    """Raise `UserError` for a depth error table whose surfaces are another channel's than depths count from."""
    if bool(corrections.attrs.get("infrared_surface", 0)) != infrared:
        kinds = ("green light, but depths", "infrared") if infrared else ("infrared light, but depths", "green")
        advice = ": take one of depth-bias --infrared" if infrared else ""
        raise UserError(f"corrections are of surfaces from {kinds[0]} count from {kinds[1]} light{advice}")


def _aim(dataset: xr.Dataset) -> FloatArray:
    """Return where the axis of the laser meets the mean sea level [m], shape (2,)."""
    pose = np.asarray(dataset.attrs.get("transmitter_pose", (0.0,) * 5 + (-1.0,)), dtype=np.float64)
    return np.asarray(pose[:2] - pose[3:5] * pose[2] / pose[5])


def surface_times(
    time_ns: FloatArray,
    stderr_ns: FloatArray,
    method_ns: FloatArray,
    lines: LinesOfSight,
    *,
    slope_variance: float,
    heights_m: tuple[float, float],
    echo_fwhm_ns: float,
    trigger_ns: float = 0.0,
    clock_ns: float = 0.0,
) -> SurfaceTimes:
    """Hold the surface echoes of shots against beam and geometry, and replace those without direct light.

    Parameters
    ----------
    time_ns, stderr_ns : ndarray, shape (shots, pixels)
        Arrival of the first echoes and its standard error by noise [ns]; NaN without one.
    method_ns : ndarray, shape (shots, pixels)
        Standard deviation of these times about the mean surface in the pixel [ns], as few places return the light.
    lines : LinesOfSight
        Lines of sight with arrays of shape (shots, pixels).
    slope_variance : float
        Variance of sea slopes, summed over two directions [1].
    heights_m : (float, float)
        Lowest and highest sea point [m], infinite if unknown.
    echo_fwhm_ns : float
        Expected full echo width at half maximum [ns].
    trigger_ns, clock_ns : float
        Standard deviations of a shot's time, which its pixels share, and a pixel's [ns]; see `ShotJitter`.

    Returns
    -------
    SurfaceTimes
        From pixels' own times where they have at least a thousandth of the brightest pixel's light. Their deviation
        from the level sea must agree, within 4 standard deviations, with the sea heights and with the light-weighted
        median over pixels. The times of other pixels follow these. Without any, the mean sea level counts with the
        heights' standard deviation as error, or NaN where heights are unknown. Where the shares of the beam are
        unknown, all times are own.

    Notes
    -----
    The deviation from the level sea has two parts. One is shared by all pixels of a shot, with the sea heights'
    variance. Each pixel's own has the sea slope times its distance from the light's middle as standard deviation. Its
    echo has the errors by noise and method. Times are mean deviations given all echoes of the shot. This draws
    uncertain times to the mean sea level and to the other pixels. An echo agrees with these within its error, its shape
    error, a tenth of its width, and the light spread.

    The error by noise includes what trigger and clock change between this time and later echoes of the same pixel. This
    is nothing for the pixel's own echo. Otherwise it is the clocks of all source pixels, and both as far as the time is
    drawn to the mean sea level.
    """
    known = np.isfinite(time_ns)
    share = lines.beam_share
    if np.isnan(share).any():
        return SurfaceTimes(time_ns, stderr_ns, np.where(known, method_ns, 0), known)
    light = share >= LEAST_SHARE * share.max(axis=1, keepdims=True)
    tilt = _tilt_ns(lines, np.sqrt(0.5 * slope_variance))
    noise = np.nan_to_num(stderr_ns)
    extent = np.hypot(np.hypot(noise, lines.surface_spread), _SHAPE * echo_fwhm_ns)
    deviation = np.where(known, time_ns, 0) - lines.surface_time
    # A crest is nearer than the mean sea level.
    per_metre = 1 / (0.5e-9 * C0 * np.cos(lines.off_nadir))
    latest, earliest = (-height * per_metre for height in heights_m)
    within = (deviation >= earliest - _LIMIT * extent) & (deviation <= latest + _LIMIT * extent)
    candidate = known & light & (share > 0) & within
    middle = _weighted_median(deviation, np.where(candidate, share, 0))
    lit = candidate & (np.abs(deviation - middle) <= _LIMIT * np.hypot(extent, tilt))
    # An eighth of the heights' range is their standard deviation.
    heights = 0.125 * (heights_m[1] - heights_m[0]) * per_metre
    level = np.hypot(heights, LEVEL * per_metre)
    variance = np.maximum(noise**2 + method_ns**2, _LEAST_ERROR**2)
    weight = np.where(lit, 1 / (variance + tilt**2), 0)
    precision = weight.sum(axis=1, keepdims=True) + 1 / level**2
    mean = np.sum(weight * deviation, axis=1, keepdims=True) / np.where(precision > 0, precision, 1.0)
    some = lit.any(axis=1, keepdims=True)
    mean_error = 1 / np.sqrt(np.where(precision > 0, precision, 1.0))
    inferred = lines.surface_time + np.where(some, mean, np.where(np.isfinite(heights), 0.0, np.nan))
    error = np.where(some, np.hypot(mean_error, tilt), np.where(np.isfinite(heights), heights, np.nan))
    share_of_own = tilt**2 / (variance + tilt**2)
    own = lines.surface_time + mean + share_of_own * (deviation - mean)
    own_variance = share_of_own * variance + (1 - share_of_own) ** 2 * mean_error**2
    # Noise of the mean comes from all pixels, noise of the pixel's part from one.
    gain = weight / np.where(precision > 0, precision, 1.0)
    shared = np.sum((gain * noise) ** 2, axis=1, keepdims=True) - (gain * noise) ** 2
    by_noise = (share_of_own + (1 - share_of_own) * gain) ** 2 * noise**2 + (1 - share_of_own) ** 2 * shared
    by_method = np.sqrt(np.maximum(own_variance - by_noise, 0))
    # Weights of the clocks in the time, less the pixel's own clock in its later echoes.
    others = np.sum(gain**2, axis=1, keepdims=True) - gain**2
    by_clocks = np.where(lit, (1 - share_of_own) ** 2 * ((1 - gain) ** 2 + others), 1 + gain**2 + others)
    # What the mean sea level has of the time does not move with the trigger.
    by_trigger = np.where(lit, 1 - share_of_own, 1.0) * (1 - gain.sum(axis=1, keepdims=True))
    by_timing = clock_ns**2 * by_clocks + (trigger_ns * by_trigger) ** 2
    return SurfaceTimes(
        np.where(lit, own, inferred),
        np.hypot(np.where(lit, np.sqrt(by_noise), error), np.sqrt(by_timing)),
        np.where(lit, by_method, 0),
        lit,
    )


def _tilt_ns(lines: LinesOfSight, slope: float) -> FloatArray:
    """Return arrival deviations [ns] by a sea slope about the middle of the beam's light."""
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
