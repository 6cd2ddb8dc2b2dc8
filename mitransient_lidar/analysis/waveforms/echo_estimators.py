"""Time, amplitude, energy and width of echoes from the samples around their peaks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.waveforms.echo_detection import (
    GAUSSIAN_AREA,
    BoolArray,
    Echoes,
    EchoFlag,
    IntArray,
    Records,
    error_of_sums,
    has_echo,
)
from mitransient_lidar.analysis.waveforms.echo_shape import Template
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.results.sum_errors import BlockCorrelation

_SUMMIT = 0.5  # lower limit of the summit of an echo, relative to its peak
_EDGE = 0.15  # half the samples that a crossing is read from, in pulse widths
_ENERGY_REACH = 1.5  # half the window of an energy, in echo widths


@dataclass(frozen=True)
class Window:
    """Samples around one echo of each record, less the surrounding signal."""

    #: Times from the middle bin of the echo [ns], shape (bins,), and times of the middle bins [ns], shape (n,).
    u: FloatArray
    middle: FloatArray
    #: Samples, their standard deviations, and whether they are inside the record; shape (n, bins).
    power: FloatArray
    noise: FloatArray
    inside: BoolArray
    bin_ns: float
    #: Weights of the levels before and after the echo in each sample, shape (2, bins), and their errors, shape (n, 2).
    ramps: FloatArray
    level_noise: FloatArray
    #: Bins of the samples, shape (n, bins), and the correlation of their noise as of `Records`.
    places: IntArray
    shared: BlockCorrelation | None

    @classmethod
    def around(
        cls,
        records: Records,
        bins: IntArray,
        width: float,
        *,
        after: IntArray | None = None,
        decay: npt.ArrayLike = 0.0,
    ) -> Window:
        """Return the samples within 1.75 expected echo widths of the peaks in `bins`, shape (n,).

        With the bins of the preceding surface echoes `after`, shape (n,), a ramp as long as the echo is subtracted. It
        connects the mean levels 1.5 to 2.5 echo widths before and after the echo. The level before it decays towards
        the echo as exp(-decay t) [1/ns], shape () or (n,).
        """
        half = max(int(np.ceil(1.75 * width / records.bin_ns)), 3)
        lags = np.arange(-half, half + 1)
        u = np.asarray(lags * records.bin_ns, dtype=np.float64)
        power, noise, inside = records.around(bins, lags)
        level_noise = np.zeros((len(power), 2))
        ramp = np.clip(0.5 + u / width, 0, 1)
        ramps = np.stack([1 - ramp, ramp])
        if after is not None:
            levels, level_noise = _levels(records, bins, after, width, np.asarray(decay))
            power = power - levels @ ramps
        places, middle = records.places(bins, lags), records.time_of(bins)
        return cls(u, middle, power, noise, inside, records.bin_ns, ramps, level_noise, places, records.shared)

    def error_of_sum(self, weights: FloatArray) -> FloatArray:
        """Return the standard error, shape (n,), for the samples' sum with `weights`, shape (n, bins)."""
        levels = np.sum((weights @ self.ramps.T * self.level_noise) ** 2, axis=1)
        scaled = np.where(self.inside, weights * self.noise, 0.0)
        return np.asarray(np.sqrt(error_of_sums(scaled, self.places, self.shared) ** 2 + levels))


def _levels(
    records: Records, bins: IntArray, after: IntArray, width: float, decay: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the levels before and after each echo, and their standard errors; shape (n, 2)."""
    half = max(int(np.ceil(2.5 * width / records.bin_ns)), 4)
    lags = np.arange(-half, half + 1)
    power, noise, inside = records.around(bins, lags)
    u = lags * records.bin_ns
    behind_surface = lags + (bins - after)[:, np.newaxis]
    usable = inside & (behind_surface > width / records.bin_ns)
    levels, errors = [], []
    for side in (-1, 1):
        counted = usable & (side * u >= 1.5 * width)
        count = counted.sum(axis=1)
        level = np.sum(np.where(counted, power, 0), axis=1) / np.maximum(count, 1)
        scaled = np.where(counted, noise, 0.0)
        error = error_of_sums(scaled, records.places(bins, lags), records.shared) / np.maximum(count, 1)
        if side < 0:
            fall = np.exp(-decay * np.sum(np.where(counted, -u, 0), axis=1) / np.maximum(count, 1))
            # Without samples between the echoes: the dip between them.
            dip = np.min(np.where(inside & (u <= 0) & (behind_surface >= 0), power, np.inf), axis=1)
            alone = count == 0
            level = np.where(alone, np.where(np.isfinite(dip), dip, 0), level * fall)
            error = np.where(alone, noise[:, half], error * fall)
        levels.append(level)
        errors.append(error)
    return np.stack(levels, axis=1), np.stack(errors, axis=1)


def summit(window: Window, flags: IntArray) -> Echoes:
    """Return time, height, width and energy of a Gaussian through each echo's summit.

    The logarithm of the samples above half the peak is fitted by a parabola with weights (model/noise)^2, iterated from
    (sample/noise)^2 (Guo 2011, IEEE Signal Process. Mag. 28(5), 134-137), which is exact for a Gaussian.
    """
    exists = has_echo(flags)
    scale = max(float(window.u[-1]), 1e-9)
    x = window.u / scale
    columns = np.stack([np.ones_like(x), x, x**2])
    usable = _top(window)
    log = np.log(np.where(usable, window.power, 1.0))
    weights = np.where(usable, (window.power / window.noise) ** 2, 0.0)
    few = np.count_nonzero(usable, axis=1) < 3
    weights[few] = 1.0  # regular, but not used
    for _ in range(3):
        normal = _regular(np.einsum("ib,nb,jb->nij", columns, weights, columns, optimize=True))
        right = np.einsum("ib,nb->ni", columns, weights * log, optimize=True)
        c = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
        model = np.exp(np.clip(c @ columns, -300, 300))
        weights = np.where(usable, (model / window.noise) ** 2, 0.0)
        weights[few] = 1.0
    covariance = np.linalg.inv(_regular(np.einsum("ib,nb,jb->nij", columns, weights, columns, optimize=True)))

    bad = few | (c[:, 2] >= 0)
    curvature = np.where(bad, -1.0, c[:, 2])
    peak = -0.5 * c[:, 1] / curvature
    bad |= np.abs(peak) > 1
    peak = np.where(bad, 0.0, peak)
    height = np.exp(np.where(bad, 0.0, np.clip(c[:, 0] - 0.25 * c[:, 1] ** 2 / curvature, -700, 700)))
    width = scale * np.sqrt(-4 * np.log(2) / curvature)
    zero = np.zeros_like(peak)
    to_time = scale * np.stack([zero, -0.5 / curvature, 0.5 * c[:, 1] / curvature**2], axis=1)
    to_log_height = np.stack([zero + 1, peak, peak**2], axis=1)
    to_log_width = np.stack([zero, zero, -0.5 / curvature], axis=1)

    def error(gradient: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", gradient, covariance, gradient)))

    cut = ~np.take_along_axis(window.inside, _nearest(window, scale * peak, width), axis=1).all(axis=1)
    flags = flags | np.where(exists & bad, int(EchoFlag.POOR_FIT), 0) | np.where(exists & cut, int(EchoFlag.CUT), 0)
    found = Echoes(
        window.middle + scale * peak,
        height,
        GAUSSIAN_AREA * height * width * 1e-9,
        width,
        error(to_time),
        np.hypot(height * error(to_log_height), 0.5 * np.linalg.norm(window.level_noise, axis=1)),
        GAUSSIAN_AREA * height * width * 1e-9 * error(to_log_height + to_log_width),
        width * error(to_log_width),
        flags,
    )
    return found.known_only(exists & ~bad)


def _regular(normal: FloatArray) -> FloatArray:
    """Return normal equations, shape (n, 3, 3), that can be solved, even where a fit has lost its samples."""
    trace = np.einsum("nii->n", normal)[:, np.newaxis, np.newaxis]
    return np.asarray(normal + np.where(trace > 0, 1e-13 * trace, 1.0) * np.eye(3))


def _top(window: Window) -> BoolArray:
    """Return the contiguous samples above half the largest near the middle, shape (n, bins)."""
    middle = window.u.size // 2
    near = slice(max(middle - 1, 0), middle + 2)
    high = window.inside & (window.power > _SUMMIT * window.power[:, near].max(axis=1, keepdims=True))
    high &= window.power > 0
    high[:, middle] |= window.power[:, middle] > 0
    right = np.logical_and.accumulate(high[:, middle:], axis=1)
    left = np.logical_and.accumulate(high[:, middle::-1], axis=1)[:, ::-1]
    return np.concatenate([left[:, :-1], right], axis=1)


def _nearest(window: Window, centre: FloatArray, width: FloatArray) -> IntArray:
    """Return the bins of the window half a width before and after a centre, shape (n, 2)."""
    ends = np.stack([centre - 0.5 * width, centre + 0.5 * width], axis=1)
    half = window.u.size // 2
    return np.clip(np.rint(ends / window.bin_ns).astype(np.intp) + half, 0, window.u.size - 1)


def gate_energy(window: Window, centre_ns: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Return each echo's energy within 1.5 widths [ns], and its error [unit times s], shape (n,)."""
    share = _share(window, centre_ns, _ENERGY_REACH * width)
    seconds = window.bin_ns * 1e-9
    return np.sum(share * window.power, axis=1) * seconds, window.error_of_sum(share) * seconds


def _share(window: Window, centre_ns: FloatArray, half: float) -> FloatArray:
    """Return each bin's fraction within half a width of a centre, shape (n, bins)."""
    distance = np.abs(window.middle[:, np.newaxis] + window.u - centre_ns[:, np.newaxis])
    return np.where(window.inside, np.clip(0.5 + (half - distance) / window.bin_ns, 0, 1), 0)


def centroid(window: Window, centre: FloatArray, half: float) -> tuple[FloatArray, FloatArray]:
    """Return each echo's centroid [ns] within half a width [ns] of itself, and its standard error, shape (n,).

    It is NaN for a first guess `centre` of NaN, and where the samples' sum is not positive.
    """
    time = window.middle[:, np.newaxis] + window.u
    for _ in range(8):
        weights = _share(window, centre, half)
        total = np.sum(weights * window.power, axis=1)
        usable = total > 0
        total = np.where(usable, total, 1.0)
        moment = np.sum(weights * window.power * (time - centre[:, np.newaxis]), axis=1) / total
        centre = np.where(usable, centre + np.clip(moment, -half, half), np.nan)
    # A window that moves with the centroid amplifies its errors by the power at its ends.
    ends = _nearest(window, np.nan_to_num(centre - window.middle), np.full(centre.shape, 2 * half))
    edges = np.take_along_axis(window.power, ends, axis=1).sum(axis=1)
    gain = np.clip(half * edges / (total * window.bin_ns), 0, 0.8)
    offset = weights * (time - centre[:, np.newaxis])
    return centre, np.asarray(window.error_of_sum(offset) / total / (1 - gain))


def crossing(
    window: Window, top: Echoes, level: FloatArray, level_stderr: FloatArray, template: Template
) -> tuple[FloatArray, FloatArray]:
    """Return the arrival of each echo from the time at which its leading edge crosses a level.

    A line through the logarithms, curved like the summit's Gaussian, crosses the level. The pulse's time from that
    level to its arrival is added: echoes longer than the pulse are too early.

    `window`, `top`: samples around the peaks, and their `summit`. `level`, `level_stderr`, shape (n,): power, between 0
    and the amplitude, and its standard error if it is a fraction of the amplitude, else 0. `template`: shape of an
    ideal echo.

    Returns `time_ns`, `stderr`, shape (n,): NaN where the edge does not cross the level.
    """
    high = window.power > level[:, np.newaxis]
    peak = np.nan_to_num(top.time_ns - window.middle)
    start = np.floor(peak / window.bin_ns).astype(np.intp) + window.u.size // 2
    bins = np.arange(window.u.size)
    low = ~high & window.inside & (bins <= start[:, np.newaxis])
    last = np.max(np.where(low, bins, -1), axis=1)
    known = (last >= 0) & (level > 0) & (level < top.amplitude)
    # A line through the samples within a third of the pulse averages the noise.
    half = max(round(_EDGE * template.fwhm_ns / window.bin_ns), 1)
    lags = np.arange(1 - half, half + 1)
    places = last[:, np.newaxis] + lags
    held = (places >= 0) & (places < window.u.size)
    places = np.clip(places, 0, window.u.size - 1)
    value = np.take_along_axis(window.power, places, axis=1)
    noise = np.take_along_axis(window.noise, places, axis=1)
    held &= np.take_along_axis(window.inside, places, axis=1) & (value > 0)
    # Less the curvature of a Gaussian edge, the logarithm is a line.
    width = np.nan_to_num(top.width_ns, nan=template.fwhm_ns)
    curvature = 8 * np.log(2) * (window.bin_ns / width) ** 2
    log = np.log(np.where(held, value, 1.0)) + 0.5 * curvature[:, np.newaxis] * lags**2
    weights = np.where(held, (value / noise) ** 2, 0.0)
    total = np.where(held.sum(axis=1) > 1, weights.sum(axis=1), 1.0)
    mean_lag, mean_log = np.sum(weights * lags, axis=1) / total, np.sum(weights * log, axis=1) / total
    offset = lags - mean_lag[:, np.newaxis]
    spread = np.sum(weights * offset**2, axis=1)
    known &= spread > 0
    spread = np.where(known, spread, 1.0)
    rate = np.sum(weights * offset * log, axis=1) / spread
    known &= rate > 0
    rate = np.where(known, rate, 1.0)
    wanted = np.log(np.where(known, level, 1.0))
    x = np.zeros(len(last))
    for _ in range(4):
        x = np.where(known, np.clip(mean_lag + (wanted - mean_log + 0.5 * curvature * x**2) / rate, -half, half + 1), 0)
    local = np.maximum(rate - curvature * x, 0.1 * rate)
    sampling = np.sqrt(1 / total + (x - mean_lag) ** 2 / spread) / local * window.bin_ns
    slope = np.where(known, level, 1.0) * local / window.bin_ns

    ratio = np.where(known, level / top.amplitude, 0.5)
    lead, per_ratio = template.rise(ratio)
    # An error of the height moves the crossing of a relative level, but only the correction of a fixed one.
    fixed = level_stderr == 0
    by_level = np.where(fixed, per_ratio * ratio * top.amplitude_stderr / top.amplitude, level_stderr / slope)
    time = window.middle + window.u[np.clip(last, 0, None)] + x * window.bin_ns - lead
    error = np.hypot(sampling, by_level)
    return np.where(known, time, np.nan), np.where(known, error, np.nan)


def leading_edge(
    window: Window, top: Echoes, template: Template, fraction: float = 0.5
) -> tuple[FloatArray, FloatArray]:
    """Return each echo's arrival from its edge at a fraction of its height; see `crossing`."""
    level = np.where(np.isfinite(top.amplitude), fraction * top.amplitude, -1.0)
    return crossing(window, top, level, fraction * top.amplitude_stderr, template)


def ideal_echo(template: Template, bin_ns: float, echo_fwhm_ns: float) -> tuple[Records, IntArray]:
    """Return an ideal echo's noise-free record with arrival at 0, and its peak bin."""
    half = int(np.ceil(max(-template.time_ns[0], template.time_ns[-1], 2 * echo_fwhm_ns) / bin_ns)) + 8
    time = np.arange(-half, half + 1) * bin_ns
    shape = np.interp(time, template.time_ns, template.power, left=0, right=0)[np.newaxis]
    return Records.of(shape, time), np.array([int(np.argmax(shape))])


def calibrate(
    time_of: Callable[[Window, Echoes], tuple[FloatArray, FloatArray]], template: Template, bin_ns: float, width: float
) -> float:
    """Return an estimator's bias [ns]: its time for an ideal echo that arrives at 0."""
    records, place = ideal_echo(template, bin_ns, width)
    window = Window.around(records, place, width)
    return float(time_of(window, summit(window, np.zeros(1, dtype=np.intp)))[0][0])
