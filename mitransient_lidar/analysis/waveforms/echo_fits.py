"""Gaussian decomposition: joint fits of echoes and the water column around them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.waveforms.column_onset import ColumnOnset
from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray, Echoes, EchoFlag, IntArray, Records, has_echo
from mitransient_lidar.analysis.waveforms.echo_shape import EchoShape
from mitransient_lidar.core.validation import FloatArray

Model = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_ITERATIONS = 60
_FEWEST_BINS = 4  # on either side of a peak
_SIGNIFICANT = 9.0  # decrease of the squared residuals by which a surface height is distinct from the column's onset
_CLEAR = 10.0  # standard errors of a height above which it is not tested
# Relative deviation of a column from the mean over waves, at its onset and behind it.
_OF_WAVES, _OF_FOCUSING = 0.1, 0.8
_FAINT = 0.1  # first guess of the height of a surface whose column is brighter, over the peak
_RISE = 0.5  # level of the column that its rise crosses
_BRIGHT = 10.0  # levels of the column beyond which a peak is that of the surface
_WEAK = 0.3  # first guess of the height of a surface without such a peak, in levels of the column
_FAR = (-np.inf, np.inf)
_BEFORE_NEXT, _LEAST_BEHIND = 1.5, 0.5  # end of a surface's samples before the next echo, and behind its peak [widths]
# Place of a surface's decay among its parameters, largest logarithm of its ratio to the given one, and its least error.
_OF_RATE, _MOST_DECAYS, _LEAST_DECAY_ERROR = 4, 2.0, 0.01
_BROAD = 2.0  # width over waves from which an echo is the column's, in echo widths
_CLOSE = 0.5  # least distance from the earliest time of a surface that a fit may find, in echo widths
_HEIGHTS = np.array([0.0, 0.05, 0.12, 0.25, 0.45])  # tested heights of a surface that is not distinct, over the peak


def gaussian_surface(
    records: Records,
    bins: IntArray,
    width: float,
    decay: npt.ArrayLike,
    flags: IntArray,
    shape: EchoShape,
    column: ColumnOnset | None = None,
    level: tuple[FloatArray, FloatArray] | None = None,
    *,
    reflects: bool = True,
    decay_error: npt.ArrayLike = 0.0,
    following: IntArray | None = None,
) -> Echoes:
    """Fit a surface echo together with the water column that begins at it.

    The model is A E(u) plus a column C F(u) exp(-k (u - p)) from u = 0 on, blurred by E. Here u is the time since the
    surface, and p the time for an echo with the found peak. E is the ideal echo shape, blurred by a Gaussian with free
    width, and F the focusing by waves. It is fitted from two echo widths before the peak to two after it, and
    determines the surface even where the peak is that of the column. Amplitude, energy and width are those of A E. A
    single shot's focusing differs from its mean. Over waves, samples more than an echo width after the rise to C / 2
    therefore have a relative error of 0.8. Peaks above 10 C are excepted.

    A surface echo that is weak relative to the column is fitted nearly as well without A, one or two nanoseconds
    earlier. Where A lowers the squared residuals by less than 9, the result is the mean over fits with fixed A, 0 to
    0.45 times the peak. Weights are their likelihood and a prior probability of one half for A = 0; errors include the
    spread. Over waves, it may lie within half an echo width of the earliest time that samples about the peak allow.
    Then the peak is too deep in the column, and no surface is found. Over waves, an A E wider than two echo widths is
    light of the column, and does not count.

    `records`, `bins`, `flags`, shape (n,): the waveforms, the surface peak bins, and the echoes' `EchoFlag`. `width`:
    expected full echo width at half maximum [ns]. `decay`, shape () or (n,): column decay rate k [1/ns], above 0, as
    fitted after the echo or typical. `shape`: shape of an ideal echo. `column`: blurred form of F; by default for F =
    1. `level`, shape (n,): c from the column behind the echo, extrapolated to the peak, and its standard error; NaN
    where it is not known. `reflects`: whether the surface may send light back; otherwise A is 0, and the column's onset
    is the time. `decay_error`, shape () or (n,): standard error of the logarithm of k. `following`, shape (n,): bins of
    the next echoes, -1 without one. Samples less than 1.5 echo widths before them do not count, except until half a
    width behind the peak.
    """
    begin = column or ColumnOnset()
    # The brightest depth may be the peak, later than the surface; that of a single shot may be twice as deep.
    early = begin.brightest_ns
    data = Windows.of(records, bins, width, decay, (-2 - 2 * early / width, 2), shape)
    data = replace(data, earliest=-1.2 * width - 2 * early)
    if following is not None:
        apart = np.where(following >= 0, (following - bins) * records.bin_ns, np.inf)
        until = np.maximum(apart - _BEFORE_NEXT * width, _LEAST_BEHIND * width)
        data = replace(data, usable=data.usable & (data.u - shape.peak_ns <= until[:, np.newaxis]))
    # A column over waves that begins at the earliest time that a fit may find began before it.
    limit = data.earliest + _CLOSE * width if early > 0 else -np.inf
    deviation = np.maximum(np.broadcast_to(np.asarray(decay_error, np.float64), bins.shape), _LEAST_DECAY_ERROR)
    data = replace(data, known=((4, np.zeros(bins.shape), deviation), *([(3, *level)] if level is not None else [])))
    peak = data.peak()
    rise = np.full(peak.shape, np.nan)
    if early > 0:
        data, rise = data.about_rise(rise if level is None else level[0])
    sigma = np.full(peak.shape, shape.sigma_of(width))
    start = np.stack([np.full(peak.shape, -0.3 * width), sigma, 0.5 * peak, 0.7 * peak, 0 * peak], axis=1)
    faint = start if early == 0 else np.stack([start[:, 0] - early, sigma, 0 * peak, 0.7 * peak, 0 * peak], axis=1)

    if level is not None:
        rises = np.isfinite(rise)
        for first in (start, faint):
            first[rises, 0], first[rises, 3] = rise[rises], level[0][rises]
        start[rises, 2] = _WEAK * level[0][rises]

    def model(p: FloatArray, u: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
        time, s, height, level, q = (p[:, i : i + 1] for i in range(5))
        k = k * np.exp(q)
        jacobian = np.zeros((5, len(p), u.size))
        for delay, share, weight in shape.terms:
            v = u - time - delay
            z = v / s
            gauss = share * np.exp(-0.5 * z**2)
            # A Gaussian times an exponential is a later Gaussian.
            value, first, second = begin.at(v - k * s**2, s)
            fall = weight * np.exp(np.clip(0.5 * (k * s) ** 2 - k * (u - delay), -700, 700))
            jacobian[0] += height * gauss * z / s - level * fall * first
            jacobian[1] += height * gauss * z**2 / s + level * fall * s * (k**2 * value - 2 * k * first + second)
            jacobian[2] += gauss
            jacobian[3] += fall * value
            jacobian[4] += level * fall * k * ((k * s**2 - u + delay) * value - s**2 * first)
        return height * jacobian[2] + level * jacobian[3], jacobian.transpose(1, 0, 2)

    def fitted(start: FloatArray, rows: BoolArray, height: FloatArray | None = None) -> WindowFits:
        found = fit_windows(model, start, data, peak, rows, height)
        # Light that waves focus in the middle of a column resembles a surface that is much too wide.
        broad = (found.values[:, 1] > shape.sigma_of(_BROAD * width)) & (early > 0)
        return replace(found, good=found.good & ~broad, cost=np.where(broad, np.inf, found.cost))

    exists = has_echo(flags)
    if not reflects:
        only = fit_windows(model, faint, data, peak, exists, np.where(exists, 0.0, np.nan))
        return _echoes(records, bins, only.later(limit), flags, shape)
    fit = fitted(start, exists)
    tried: list[WindowFits] = []
    if early > 0:
        # A column that is brightest below the surface has the shape of a late echo.
        tried.append(fit_windows(model, faint, data, peak, exists, np.where(exists, 0.0, np.nan)))
        faint = np.where(tried[0].good[:, np.newaxis], tried[0].values, faint)
        second = faint.copy()
        second[:, 2] = _FAINT * peak
        other = fitted(second, exists)
        fit = fit.replaced(other.good & ~(fit.good & (fit.cost <= other.cost)), other)
    error = np.sqrt(fit.covariance[:, 2, 2])
    weak = exists & ~(fit.good & (fit.values[:, 2] > _CLEAR * error))
    some = fit.good & (fit.values[:, 2] > error)
    for share in _HEIGHTS:
        if tried and share == 0:
            weak = exists & tried[0].good & (tried[0].cost <= fit.cost + _SIGNIFICANT)
            continue
        if not weak.any():
            return _echoes(records, bins, fit.later(limit), flags, shape)
        tried.append(fitted(faint, weak, np.where(weak, share * peak, np.nan)))
        faint = np.where(tried[-1].good[:, np.newaxis], tried[-1].values, faint)
        weak &= ~some | (tried[0].cost <= fit.cost + _SIGNIFICANT)
    return _echoes(records, bins, fit.replaced(weak, _mean(tried)).later(limit), flags, shape)


def gaussian_echo(
    records: Records,
    bins: IntArray,
    width: float,
    decay: npt.ArrayLike,
    flags: IntArray,
    shape: EchoShape,
    *,
    after: IntArray | None = None,
    around: tuple[IntArray, IntArray] | None = None,
) -> Echoes:
    """Fit an echo at which the column ends.

    The model is A E(u) plus a column exp(-k u). The column has one level before and one after the echo; the step
    between them is blurred like the echo. It is fitted from two echo widths before the peak to one and a half after it.
    Samples less than an echo width after the surface peaks in bins `after`, shape (n,), are left out. So are samples
    nearer to the echoes before and after it, in bins `around`, each of shape (n,) and -1 without one. The other
    arguments are those of `gaussian_surface`.
    """
    data = Windows.of(records, bins, width, decay, (-2, 1.5), shape)
    if after is not None:
        first = (np.minimum(after + width / records.bin_ns, 0.5 * (after + bins)) - bins) * records.bin_ns
        data = replace(data, usable=data.usable & (data.u - shape.peak_ns >= first[:, np.newaxis]))
    if around is not None:
        ends = [
            np.where(one >= 0, 0.5 * (one - bins) * records.bin_ns, end) for one, end in zip(around, _FAR, strict=True)
        ]
        low, high = (end[:, np.newaxis] for end in ends)
        from_peak = data.u - shape.peak_ns
        data = replace(data, usable=data.usable & (from_peak >= low) & (from_peak <= high))
    peak = data.peak()
    early = np.argmax(data.usable, axis=1)
    before = np.maximum(np.take_along_axis(data.power, early[:, np.newaxis], axis=1)[:, 0], 0)
    before = np.minimum(before, 0.5 * peak)
    start = np.stack([0 * peak, np.full(peak.shape, shape.sigma_of(width)), peak, before, 0 * peak], axis=1)

    def model(p: FloatArray, u: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import ndtr

        time, s, height, level, behind = (p[:, i : i + 1] for i in range(5))
        fall = np.exp(-k * (u - time))
        step = fall * (behind - level)
        by_time, by_s, echo, passed = (np.zeros((len(p), u.size)) for _ in range(4))
        for delay, share, weight in shape.terms:
            z = (u - time - delay) / s
            gauss = np.exp(-0.5 * z**2)
            edge = weight * step * gauss / (np.sqrt(2 * np.pi) * s)
            by_time += height * share * gauss * z / s - edge
            by_s += height * share * gauss * z**2 / s - edge * z
            echo += share * gauss
            passed += weight * ndtr(z)
        column = fall * level + step * passed
        jacobian = np.stack([by_time + k * column, by_s, echo, fall * (1 - passed), fall * passed], axis=1)
        return height * echo + column, jacobian

    return _echoes(records, bins, fit_windows(model, start, data, peak, has_echo(flags)), flags, shape)


@dataclass(frozen=True)
class Windows:
    """Samples about the peaks: times from them (bins,), samples and noise (n, bins), and decay rates (n, 1).

    Times count from an ideal echo's arrival with its peak in the peak bin; `earliest` is the first one that a fit may
    find. Parameters may be `known`, with their standard errors, shape (n,); NaN where they are not.
    """

    u: FloatArray
    power: FloatArray
    noise: FloatArray
    usable: BoolArray
    rate: FloatArray
    width: float
    shape: EchoShape
    earliest: float
    known: tuple[tuple[int, FloatArray, FloatArray], ...] = ()

    @classmethod
    def of(
        cls,
        records: Records,
        bins: IntArray,
        width: float,
        decay: npt.ArrayLike,
        span: tuple[float, float],
        shape: EchoShape,
    ) -> Windows:
        """Return the samples in a span of echo widths about the peaks, and at least four bins on both sides."""
        rate = np.broadcast_to(np.asarray(decay, dtype=np.float64), bins.shape)[:, np.newaxis]
        low, high = (end * width / records.bin_ns for end in span)
        # Coarse samples of short pulses determine all parameters only together with their surroundings.
        lags = np.arange(min(int(np.floor(low)), -_FEWEST_BINS), max(int(np.ceil(high)), _FEWEST_BINS) + 1)
        power, noise, inside = records.around(bins, lags)
        u = np.asarray(lags * records.bin_ns + shape.peak_ns, dtype=np.float64)
        return cls(u, power, noise, inside, rate, width, shape, -1.2 * width)

    def about_rise(self, level: FloatArray) -> tuple[Windows, FloatArray]:
        """Return the samples with focusing uncertainty, and the rise times of columns with a level.

        Samples later than a width behind the rise are uncertain, unless their peak is far above the column. The time is
        NaN for such a peak, and for a column without a level.
        """
        known = np.isfinite(level) & (level > 0)
        height = np.where(known, level, np.inf)[:, np.newaxis]
        above = self.usable & (self.power > _RISE * height)
        first = self.u[np.argmax(above, axis=1)]
        rises = above.any(axis=1) & (self.peak() < _BRIGHT * height[:, 0])
        late = rises[:, np.newaxis] & (self.u > first[:, np.newaxis] + self.width)
        share = np.where(late, _OF_FOCUSING, _OF_WAVES)
        noise = np.hypot(self.noise, share * np.maximum(self.power, 0))
        return replace(self, noise=noise), np.where(rises, first - self.shape.peak_ns, np.nan)

    def limits(self, scale: FloatArray, size: int) -> Limits:
        """Return the limits for echoes at a scale, shape (n,), with so many parameters."""
        lowest, highest = np.full(size, -np.inf), np.full(size, np.inf)
        lowest[:3] = self.earliest, self.shape.least_sigma, 0
        highest[:2] = 1.2 * self.width, self.shape.sigma_of(3 * self.width)
        unit = np.full((len(scale), size), self.width)
        unit[:, 2:] = scale[:, np.newaxis]
        if any(index == _OF_RATE for index, _, _ in self.known):
            unit[:, _OF_RATE], lowest[_OF_RATE], highest[_OF_RATE] = 1.0, -_MOST_DECAYS, _MOST_DECAYS
        return Limits(lowest, highest, unit)

    def peak(self) -> FloatArray:
        """Return the largest sample within half an echo width, shape (n,)."""
        near = np.abs(self.u - self.shape.peak_ns) < 0.5 * self.width
        return np.asarray(np.max(np.where(self.usable & near, self.power, 0), axis=1))


@dataclass(frozen=True)
class WindowFits:
    """Parameters (n, p), their covariance (n, p, p), squared residuals and convergence of the fits (n,)."""

    values: FloatArray
    covariance: FloatArray
    cost: FloatArray
    good: BoolArray

    def later(self, limit: float) -> WindowFits:
        """Return the fits, of which only those count that are later than a time from the peak."""
        return replace(self, good=self.good & (self.values[:, 0] > limit))

    def replaced(self, where: BoolArray, fit: WindowFits) -> WindowFits:
        """Return this fit with another one in some rows."""
        return WindowFits(
            np.where(where[:, np.newaxis], fit.values, self.values),
            np.where(where[:, np.newaxis, np.newaxis], fit.covariance, self.covariance),
            np.where(where, fit.cost, self.cost),
            np.where(where, fit.good, self.good),
        )


def _mean(tried: list[WindowFits]) -> WindowFits:
    """Return the mean of fits at the heights `_HEIGHTS`, each weighted with its likelihood."""
    cost = np.stack([np.where(fit.good, fit.cost, np.inf) for fit in tried])
    good = np.isfinite(cost).any(axis=0)
    likelihood = np.exp(-0.5 * (cost - np.where(good, cost.min(axis=0), 0)))
    # Prior: one half for A = 0, one half uniform over the heights.
    prior = np.gradient(_HEIGHTS)
    prior[[0, -1]] *= 0.5
    prior /= prior.sum()
    prior[0] += 1
    weight = prior[:, np.newaxis] * likelihood
    weight /= np.where(good, weight.sum(axis=0), 1.0)
    values = np.stack([fit.values for fit in tried])
    mean = np.einsum("jn,jnp->np", weight, values)
    apart = values - mean
    within = np.stack([np.where(fit.good[:, np.newaxis, np.newaxis], fit.covariance, 0) for fit in tried])
    covariance = np.einsum("jn,jnpq->npq", weight, within + apart[..., :, np.newaxis] * apart[..., np.newaxis, :])
    return WindowFits(mean, covariance, cost.min(axis=0), good)


class Limits(NamedTuple):
    """Least and largest values of fit parameters, and their units; shape (p,) or (n, p) each."""

    lowest: FloatArray
    highest: FloatArray
    unit: FloatArray


def fit_windows(
    model: Model,
    start: FloatArray,
    data: Windows,
    scale: FloatArray,
    wanted: BoolArray,
    held: FloatArray | None = None,
    limits: Limits | None = None,
) -> WindowFits:
    """Fit a model to many windows at once by damped least squares (Levenberg and Marquardt).

    Heights, the third parameters, that are not NaN in `held`, shape (n,), are fixed. Without limits, echo parameters
    are meant: time, standard deviation, and heights in units of `scale`.
    """
    u, power, usable, rate = data.u, data.power, data.usable, data.rate
    count, size = start.shape
    held = np.full(count, np.nan) if held is None else held
    fixed = np.isfinite(held)
    wanted = wanted & (np.count_nonzero(usable, axis=1) > size + 1) & (scale > 0)
    scale = np.where(scale > 0, scale, 1.0)
    values = start.copy()
    values[fixed, 2] = held[fixed]
    covariance = np.full((count, size, size), np.nan)
    good = np.zeros(count, dtype=bool)
    damping = np.full(count, 1e-3)
    # Fits with fixed heights, which are only compared, need less accuracy.
    enough = np.where(fixed, 1e-3, 1e-4)
    weights = np.where(usable, 1 / data.noise, 0.0)
    lowest, highest, unit = (np.broadcast_to(one, start.shape) for one in limits or data.limits(scale, size))
    values[:, :2] = np.clip(values[:, :2], lowest[:, :2], highest[:, :2])
    active = np.flatnonzero(wanted)
    cost = np.full(count, np.inf)
    found, jacobian = model(values[active], u, rate[active])
    prior = _Prior.of(data.known, count)
    cost[active] = np.sum((weights[active] * (power[active] - found)) ** 2, axis=1) + prior.cost(values, active)
    for _ in range(_ITERATIONS):
        if not active.size:
            break
        w, x, y, k = weights[active], values[active], power[active], rate[active]
        weighted = jacobian * (w[:, np.newaxis, :] * unit[active][..., np.newaxis])
        weighted[fixed[active], 2] = 0
        normal = weighted @ weighted.transpose(0, 2, 1)
        right = (weighted @ (w * (y - found))[..., np.newaxis])[..., 0]
        normal[:, prior.index, prior.index] += (prior.weight * unit[:, prior.index])[active] ** 2
        right[:, prior.index] += (prior.weight**2 * unit[:, prior.index] * (prior.mean - values[:, prior.index]))[
            active
        ]
        # A parameter at a limit stays there while the residuals push it outwards.
        low, high = lowest[active], highest[active]
        stuck = ((x <= low) & (right < 0)) | ((x >= high) & (right > 0))
        right[stuck] = 0
        normal = np.where(stuck[:, :, np.newaxis] | stuck[:, np.newaxis, :], 0, normal)
        diagonal = np.einsum("nii->ni", normal)
        # The ridge keeps a parameter that the samples do not constrain.
        ridge = damping[active][:, np.newaxis] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        damped = normal + ridge[:, :, np.newaxis] * np.eye(size)
        step = np.linalg.solve(damped, right[..., np.newaxis])[..., 0]
        trial = x + np.clip(step, -1, 1) * unit[active]
        trial = np.clip(trial, low, high)
        trial[:, 2] = np.where(fixed[active], held[active], trial[:, 2])
        tried, changed = model(trial, u, k)
        after = values.copy()
        after[active] = trial
        new = np.sum((w * (y - tried)) ** 2, axis=1) + prior.cost(after, active)
        better = new <= cost[active]
        settled = better & (cost[active] - new <= 1e-7 * new + enough[active])
        small = np.max(np.abs(trial - x) / unit[active], axis=1) < 1e-7
        values[active] = np.where(better[:, np.newaxis], trial, x)
        cost[active] = np.where(better, new, cost[active])
        damping[active] = np.clip(np.where(better, 0.1, 8.0) * damping[active], 1e-12, 1e6)
        good[active] = settled | small
        found[better], jacobian[better] = tried[better], changed[better]
        if (done := settled | small).any():
            active, found, jacobian = active[~done], found[~done], jacobian[~done]
    if good.any():
        _, jacobian = model(values[good], u, rate[good])
        weighted = jacobian * (weights[good][:, np.newaxis, :] * unit[good][..., np.newaxis])
        normal = weighted @ weighted.transpose(0, 2, 1)
        normal[:, prior.index, prior.index] += (prior.weight * unit[:, prior.index])[good] ** 2
        # A fixed height has no correlation; its error is that of a fit of the height alone.
        still = fixed[good]
        normal[still, 2, :2] = normal[still, :2, 2] = 0
        normal[still, 2, 3:] = normal[still, 3:, 2] = 0
        trace = np.einsum("nii->n", normal)[:, np.newaxis, np.newaxis]
        inverse = np.linalg.inv(normal + 1e-13 * trace * np.eye(size))
        covariance[good] = inverse * unit[good][:, :, np.newaxis] * unit[good][:, np.newaxis, :]
    good &= fixed | (values[:, 2] > 0)
    return WindowFits(values, covariance, cost, good)


@dataclass(frozen=True)
class _Prior:
    """Known values (n, k) for k fit parameters, and their inverse standard errors, 0 where not known."""

    index: list[int]
    mean: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, known: tuple[tuple[int, FloatArray, FloatArray], ...], count: int) -> _Prior:
        """Return the priors of some parameters."""
        index = [one[0] for one in known]
        mean, error = (np.array([one[part] for one in known]).reshape(len(known), count).T for part in (1, 2))
        usable = np.isfinite(mean) & (error > 0)
        return cls(index, np.where(usable, mean, 0), np.where(usable, 1 / np.where(usable, error, 1), 0))

    def cost(self, values: FloatArray, rows: IntArray) -> FloatArray:
        """Return the squared residuals of some fits."""
        return np.asarray(np.sum((self.weight[rows] * (values[rows][:, self.index] - self.mean[rows])) ** 2, axis=1))


def _echoes(records: Records, bins: IntArray, fit: WindowFits, flags: IntArray, shape: EchoShape) -> Echoes:
    """Return the echoes of fits whose first parameters are time, sigma and height."""
    time, s, height = fit.values[:, 0], fit.values[:, 1], fit.values[:, 2]
    variance = np.einsum("nii->ni", fit.covariance)
    area = np.sqrt(2 * np.pi) * 1e-9 * shape.heights.sum()
    mixed = s**2 * variance[:, 2] + height**2 * variance[:, 1] + 2 * s * height * fit.covariance[:, 1, 2]
    middle, top = records.time_of(bins) - shape.peak_ns, shape.top_of(s)
    width, by_sigma = shape.width_of(s)
    peak = middle + time + shape.peak_ns
    cut = (peak - 0.5 * width < records.time_ns[0]) | (peak + 0.5 * width > records.time_ns[-1])
    exists = has_echo(flags)
    flags = flags | np.where(exists & ~fit.good, int(EchoFlag.POOR_FIT), 0)
    flags = flags | np.where(exists & cut, int(EchoFlag.CUT), 0)
    found = Echoes(
        middle + time,
        height * top,
        area * height * s,
        width,
        np.sqrt(variance[:, 0]),
        np.sqrt(variance[:, 2]) * top,
        area * np.sqrt(np.maximum(mixed, 0)),
        by_sigma * np.sqrt(variance[:, 1]),
        flags,
    )
    return found.known_only(exists & fit.good)
