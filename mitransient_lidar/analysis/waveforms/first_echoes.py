"""What the first echo of a record is: land, the sea's surface, or a bottom with or without its surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, logsumexp

from mitransient_lidar.analysis.waveforms.column_onset import ColumnOnset
from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray, Echoes, IntArray, Records, error_of_sums
from mitransient_lidar.analysis.waveforms.echo_fits import Limits, Model, WindowFits, Windows, fit_windows
from mitransient_lidar.analysis.waveforms.echo_shape import BlurredPulse, EchoShape
from mitransient_lidar.analysis.waveforms.surface_times import SurfaceLevel
from mitransient_lidar.core.validation import FloatArray

#: Separation from which surface and bottom are two echoes, in echo widths.
SEPARATE = 1.8
#: Standard deviation of the logarithm of a column's decay, as of Jerlov's waters.
OF_DECAY = 1.0

_DELAYS = 32  # delays of a bottom that are tried
_SHORTEST_NS = 0.05  # delay of a bottom that is fitted [ns]
_FARTHEST = 4.0  # standard deviations of the surface from its level to the longest delay
_BEFORE, _BEHIND = 2.0, 3.0  # samples before the earliest surface and behind the peak, in echo widths
_COLUMN_NS = 10.0  # of the column behind a surface that count [ns]
_OF_SAMPLE, _OF_PEAK = 0.01, 1e-3  # errors of the pulse's shape, relative to the sample and to the peak
_AT_ONCE = 2**17  # samples that are fitted at once, for speed
_BOTH = 0.3  # delay from which the peak may be that of the surface or of the bottom, in echo widths
# Prior distributions: heights of land and depths of bottoms that are as likely as each other [m], and shares.
_HIGHEST, _DEEPEST, _OF_LAND, _WITHOUT_BOTTOM = 20.0, 10.0, 0.5, 0.3
# Of a column of unknown water, relative to the peak, and the highest level of a column over that of the clearest water.
_LEAST_COLUMN, _MOST_COLUMN = 1e-5, 150.0
_FARTHEST_DECAY = 2.3  # largest logarithm of a column's decay over the typical one
_LEVELS, _CLEAR = 64, 3.0  # tried levels of a column, and standard errors from which on its fit alone counts
# Runs of samples behind those of the fits: their number and length [ns], decays that are tried, and the error of the
# pulse's tail there over the peak, where the sensitivity of the receiver is known and where it is not.
_RUNS, _RUN_NS, _DECAYS, _OF_TAIL = 8, 20.0, 9, (2e-5, 1e-3)
_SIGNIFICANT = 5.0  # standard errors of the height of a surface that is told apart
_LEAST_SPREAD = 0.02  # standard deviation of a surface's time [ns]
# Light that a bottom sends back to itself by total reflection at the surface: times over those of the depth between
# which it counts, from 1/sqrt(1 - 1/n^2) on, their steps, and the prior of the reflectance: mean, error, largest.
_AGAIN, _STEPS, _REFLECTANCE = (1.5, 12.0), 12, (0.2, 0.15, 0.6)
# Errors of samples over waves, and of those of a column, which are below a share of the peak.
_OF_WAVES, _OF_FOCUSING, _FAINT = 0.1, 0.3, 0.05
_FIRST_BLUR = 0.01  # first guess of the variance of a blur, relative to the largest


@dataclass(frozen=True)
class FirstEchoes:
    """What the first echoes of n records are."""

    chance: FloatArray  #: Probabilities of land, of a surface whose bottom is not seen, and of a bottom, shape (3, n).
    #: Land or bottom, and the surface before a bottom where it has an echo of its own that is told apart.
    bottom: Echoes
    surface: Echoes
    #: Arrival of the surface of a bottom and its standard deviation [ns], shape (n,); NaN for land.
    surface_ns: FloatArray
    surface_stderr: FloatArray
    film_ns: FloatArray  #: Delay by water on land, root mean square over land and bottom [ns], shape (n,).

    def part(self, rows: BoolArray) -> FirstEchoes:
        """Return the first echoes of some records."""
        bottom, surface = (
            Echoes(**{name: value[rows] for name, value in vars(one).items()}) for one in (self.bottom, self.surface)
        )
        times = (one[rows] for one in (self.surface_ns, self.surface_stderr, self.film_ns))
        return FirstEchoes(self.chance[:, rows], bottom, surface, *times)


@dataclass(frozen=True)
class Priors:
    """What is known of n records before they are fitted."""

    level: SurfaceLevel  #: Time of the surface.
    #: Height in air and depth in the water per time [m/ns], shape (n,).
    metres_per_ns: FloatArray
    depth_per_ns: FloatArray
    #: Signal of the column of the clearest water at the surface [unit of the record], shape (n,); 0 where unknown.
    least_column: FloatArray
    decay: float  #: Typical rate of decay of a column [1/ns].
    onset: ColumnOnset  #: Mean focusing of the column's light by waves.
    opaque: bool  #: Whether light of column and bottom is part of the surface's echo.
    #: Standard error of weak steady signals above the level without light [unit of the record], shape (n,).
    baseline_stderr: FloatArray

    def column(self, delay_ns: FloatArray, decay: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        """Return the signal of a column at delays from the surface, over that at the surface, and its derivative."""
        times, factors = self.onset.times, self.onset.factors
        slopes = np.append(np.diff(factors) / np.diff(times), 0.0)
        behind = np.maximum(delay_ns, 0)
        fall = np.exp(-decay * behind)
        factor = np.interp(behind, times, factors)
        slope = slopes[np.clip(np.searchsorted(times, behind, side="right") - 1, 0, len(slopes) - 1)]
        return fall * factor, np.where(delay_ns > 0, fall * (slope - decay * factor), 0.0)


def first_echoes(
    records: Records,
    bins: IntArray,
    pulse: BlurredPulse,
    shape: EchoShape,
    width: float,
    priors: Priors,
    extent: FloatArray,
) -> FirstEchoes:
    """Decide what records' first peaks are, with a fit for each possibility.

    Parameters
    ----------
    records, bins : Records and ndarray of int, shape (n,)
        The waveforms and their first peak bins.
    pulse, shape, width
        The ideal echo, and the expected full echo width [ns].
    priors
        What is known before.
    extent
        Delays behind these peaks up to which there may be a bottom [ns], shape (n,).

    Notes
    -----
    All possibilities consist of the known pulse P, blurred by a Gaussian with free width for slopes. Its integral
    stands for a column with constant backscattering. Land is A P(t - t1). A surface is A P(t - t1) and a column from t1
    on, which decays. A bottom at t1 + d is A P(t - t1 - d), a column from t1 to t1 + d, and its surface echo A' P(t -
    t1). Heights are not negative. Fits keep a column's log decay within about 1 of the typical one. Light that the
    surface totally reflects meets the bottom again. For a Lambertian bottom with reflectance rho it is 2 rho d^2/u^3
    per time at u > 1.5 d after the bottom. This leaves out later passages, and holds below a level surface. Samples
    have their noise and the pulse shape's error, 10 % over waves.

    Probabilities follow from Bayes' theorem with these priors. Land and water are as likely. Land heights are uniform
    up to 20 m above the surface, bottom depths up to 10 m. The surface has its level's normal distribution. Three
    waters in ten show no bottom. Column decays are uniform up to ten times the typical one. Their log levels are
    uniform from the clearest water to 150 times as much, or to the peak. Land is thus what stands above the surface, or
    what has no column where even the clearest water would show one. The next 160 ns behind the samples of the fits
    count, too: they tell a surface from land, but not from a bottom. A column that a digitiser rounds to nothing does
    not tell them. Surface and column echoes beside a bottom cost their parameter volume (Laplace's approximation).
    Depths are means over 32 delays d, up to the surface at 4 standard deviations above its level. Where the surface has
    its own echo, they follow from the fit of all parameters. Errors include the delays' spread and spacing.
    """
    level, count = priors.level, len(bins)
    spread = np.maximum(level.stderr_ns, _LEAST_SPREAD)
    arrival = records.time_of(bins) - shape.peak_ns
    longest = np.maximum(arrival - level.time_ns + _FARTHEST * spread, np.maximum(SEPARATE * width, extent))
    delays = np.linspace(0, 1, _DELAYS + 1)[1:, np.newaxis] ** 1.5 * longest
    fits = _Fits.of(records, bins, pulse, shape, width, longest, priors)
    zero = np.zeros(count)

    land = fits.bottom(zero, zero, surface=False)
    land_ns = arrival + land.values[:, 0]
    log_land = np.log(_OF_LAND * priors.metres_per_ns / _HIGHEST) - 0.5 * land.cost
    log_land += log_ndtr((level.time_ns - land_ns) / spread)
    own = _echo(land, pulse.area_ns, shape, 0, land_ns, _error(land, 0))
    if priors.opaque:
        log_sea = np.log(1 - _OF_LAND) - 0.5 * land.cost + _log_normal(land_ns, level.time_ns, spread)
        chance = np.exp([log_land, log_sea] - np.logaddexp(log_land, log_sea))
        none = np.full(count, np.nan)
        return FirstEchoes(np.stack([*chance, zero]), own, own.known_only(zero > 0), none, none, zero)

    sea = fits.surface()
    log_sea = np.log((1 - _OF_LAND) * _WITHOUT_BOTTOM) - 0.5 * sea.cost
    log_sea += _log_normal(arrival + sea.values[:, 0], level.time_ns, spread)
    column, with_late = _log_column(sea, records, land_ns, fits)
    log_sea += with_late + _log_decay(sea, 4)

    tried = fits.bottoms(delays)
    bottom_ns = arrival + np.stack([one.values[:, 0] for one in tried])
    surface_ns = bottom_ns - delays
    prior = np.log((1 - _OF_LAND) * (1 - _WITHOUT_BOTTOM) * priors.depth_per_ns / _DEEPEST)
    # Light that follows long behind a bottom is scattered, too.
    prior += np.maximum(with_late - column, 0)
    posterior = prior + _log_normal(surface_ns, level.time_ns, spread)
    posterior += np.stack([-0.5 * one.cost - _occam(one) for one in tried])
    steps = np.gradient(np.concatenate([zero[np.newaxis], delays]), axis=0)[1:]
    posterior += np.log(steps)
    best = np.argmax(posterior, axis=0)
    # Where the surface has an echo of its own, the delay is much better known than those that are tried.
    fit = _chosen(tried, best)
    free = fits.bottom(fit.values[:, 0], np.take_along_axis(delays, best[np.newaxis], axis=0)[0], start=fit.values)
    delay, error = free.values[:, 7], _error(free, 7)
    distinct = free.good & (free.values[:, 3] > _SIGNIFICANT * _error(free, 3)) & (delay > _SHORTEST_NS) & (error > 0)
    own_ns = arrival + free.values[:, 0]
    of_free = prior + _log_normal(own_ns - delay, level.time_ns, spread) - 0.5 * free.cost - _occam(free)
    of_free += np.log(np.sqrt(2 * np.pi) * np.where(distinct, error, 1.0))
    log_bottom = np.maximum(logsumexp(posterior, axis=0), np.where(distinct, of_free, -np.inf))

    logs = np.stack([log_land, log_sea, log_bottom])
    chance = np.exp(logs - logsumexp(logs, axis=0))
    dry = chance[0] >= chance[2]
    distinct &= ~dry
    weight = np.exp(posterior - logsumexp(posterior, axis=0))
    noise = np.stack([_error(one, 0) for one in tried])
    time, time_error = _mean(weight, bottom_ns, noise)
    # Delays between those that are tried are as likely as these.
    top, top_error = _mean(weight, surface_ns, np.hypot(noise, steps / np.sqrt(12)))
    area = pulse.area_ns
    bottom = _echo(_chosen([land, fit], np.where(dry, 0, 1)), area, shape, 0, time, time_error)
    # The height of an echo that may include a surface is that of both, whose error is that of one.
    bottom = replace(bottom, amplitude_stderr=_error(land, 2))
    distinct_bottom = _echo(free, area, shape, 0, own_ns, _error(free, 0))
    bottom = _where(distinct, distinct_bottom, _where(dry, own, bottom))
    own_error = np.sqrt(np.maximum(_error(free, 0) ** 2 + error**2 - 2 * free.covariance[:, 0, 7], 0))
    surface = _echo(free, area, shape, 1, own_ns - delay, own_error).known_only(distinct)
    surface_ns, surface_stderr = np.where(distinct, (own_ns - delay, own_error), (top, top_error))
    film = np.sqrt(chance[2] / (chance[0] + chance[2]) * np.sum(weight * delays**2, axis=0))
    surface_ns, surface_stderr = np.where(dry, np.nan, (surface_ns, surface_stderr))
    return FirstEchoes(chance, bottom, surface, surface_ns, surface_stderr, film)


@dataclass(frozen=True)
class _Fits:
    """Fits of the possibilities to samples; times count from an ideal echo's arrival with its peak at the bin.

    Parameters of bottom or land: time [ns], blur variance [ns^2] and height; heights of surface echo and column;
    relative height of light that meets the bottom again; log ratio of the column's decay to the typical one; perhaps
    the delay [ns]. A surface has its height, the column height and this logarithm.
    """

    data: Windows
    peak: FloatArray
    pulse: BlurredPulse
    longest: FloatArray
    priors: Priors

    @classmethod
    def of(
        cls,
        records: Records,
        bins: IntArray,
        pulse: BlurredPulse,
        shape: EchoShape,
        width: float,
        longest: FloatArray,
        priors: Priors,
    ) -> _Fits:
        """Return fits of samples about the peaks, with the pulse shape's error in their noise."""
        span = -(float(longest.max()) / width + _BEFORE), _BEHIND + _COLUMN_NS / width
        data = Windows.of(records, bins, width, 0.0, span, shape)
        peak = data.peak()
        # Focusing of a single shot differs from the mean.
        faint, waves = data.power < _FAINT * peak[:, np.newaxis], priors.onset.times.size > 1
        share = np.where(faint, _OF_FOCUSING, _OF_WAVES) if waves else _OF_SAMPLE
        error = np.hypot(share * np.maximum(data.power, 0), _OF_PEAK * peak[:, np.newaxis])
        return cls(replace(data, noise=np.hypot(data.noise, error)), peak, pulse, longest, priors)

    def _part(self, rows: IntArray) -> _Fits:
        """Return some records' fits, with repetitions."""
        data = self.data
        of_rows = {name: getattr(data, name)[rows] for name in ("power", "noise", "usable", "rate")}
        return replace(self, data=replace(data, **of_rows), peak=self.peak[rows], longest=self.longest[rows])

    def bottoms(self, delays: FloatArray) -> list[WindowFits]:
        """Fit bottoms that follow a surface by delays, shape (m, n); the peak belongs to either."""
        found: list[WindowFits] = []
        for some in np.array_split(delays, min(math.ceil(delays.size * self.data.u.size / _AT_ONCE), len(delays))):
            delay = some.ravel()
            rows = np.tile(np.arange(len(self.peak)), len(some))
            fits = self._part(rows).bottom(0 * delay, delay)
            both = np.flatnonzero(delay > _BOTH * self.data.width)
            other = self._part(rows[both]).bottom(delay[both], delay[both])
            better = other.cost < fits.cost[both]
            for name, values in vars(fits).items():
                values[both[better]] = getattr(other, name)[better]
            found += map(WindowFits, *(np.split(values, len(some)) for values in vars(fits).values()))
        return found

    def bottom(
        self, time: FloatArray, delay: FloatArray, *, surface: bool = True, start: FloatArray | None = None
    ) -> WindowFits:
        """Fit bottoms that follow a surface by a delay, shape (n,), free with a start; or land without a surface."""
        pulse, area, free = self.pulse, self.pulse.area_ns, start is not None
        half, blur = 0.5 * self.peak, np.full(time.shape, _FIRST_BLUR * self.pulse.variances[-1])
        mean, deviation, largest = _REFLECTANCE
        none = 0 * half
        first = np.stack([time, blur, half, half * surface, 0.01 * half * surface, none + mean * surface, none], axis=1)
        if start is not None:
            first = np.column_stack([start, delay])
        edges = np.geomspace(*_AGAIN, _STEPS + 1)
        density = -np.diff(edges**-2.0) / np.diff(edges)
        rises = np.diff(density, prepend=0.0, append=0.0)

        def model(p: FloatArray, u: FloatArray, apart: FloatArray) -> tuple[FloatArray, FloatArray]:
            time, blur, height, top, column, again, q = (p[:, i : i + 1] for i in range(7))
            apart = p[:, 7:] if free else apart
            echo, slope, by_blur = pulse.blurred(u - time, blur)
            if not surface:
                none = np.zeros_like(echo)
                return height * echo, np.stack([-height * slope, height * by_blur, echo, *[none] * 4], axis=1)
            begins, ends = pulse.plain(u - time + apart), pulse.plain(u - time)
            decay = self.priors.decay * np.exp(q)
            fall, falls = self.priors.column(u - time + apart, decay)
            inside = (begins[1] - ends[1]) / area
            lit = fall * inside
            by_delay = top * pulse.plain_slope(u - time + apart) + column * (fall * begins[0] / area + falls * inside)
            by_time = -height * slope - by_delay + column * fall * ends[0] / area
            second, falling, stretched = (np.zeros_like(echo) for _ in range(3))
            per_delay = 1 / np.maximum(apart, _SHORTEST_NS)
            for edge, rise in zip(edges, rises, strict=True):
                power, passed = pulse.plain(u - time - edge * apart)
                second += rise * per_delay * passed
                falling += rise * per_delay * power
                stretched += rise * per_delay * (edge * power + passed * per_delay)
            by_time -= height * again * falling
            by_delay -= height * again * stretched
            by_decay = -column * decay * np.maximum(u - time + apart, 0) * lit
            parts = [by_time, height * by_blur, echo + again * second, begins[0], lit, height * second, by_decay]
            parts += [by_delay] if free else []
            return height * (echo + again * second) + top * begins[0] + column * lit, np.stack(parts, axis=1)

        known = ((5, np.full(time.shape, mean), np.full(time.shape, deviation)),) if surface else ()
        limit = [np.inf] * 3 + [np.inf if surface else 0.0] * 2 + [largest * surface]
        return self._fit(model, first, delay, limit, 6, known)

    def surface(self) -> WindowFits:
        """Fit a surface and the column behind it."""
        pulse, area, none = self.pulse, self.pulse.area_ns, np.zeros(self.peak.shape)
        blur = np.full(self.peak.shape, _FIRST_BLUR * self.pulse.variances[-1])

        def model(p: FloatArray, u: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
            time, blur, height, column, q = (p[:, i : i + 1] for i in range(5))
            decay = self.priors.decay * np.exp(q)
            echo, slope, by_blur = pulse.blurred(u - time, blur)
            power, inside = pulse.plain(u - time)
            fall, falls = self.priors.column(u - time, decay)
            lit = fall * inside / area
            by_time = -height * slope - column * (fall * power + falls * inside) / area
            by_decay = -column * decay * np.maximum(u - time, 0) * lit
            return height * echo + column * lit, np.stack([by_time, height * by_blur, echo, lit, by_decay], axis=1)

        first = np.stack([none, blur, self.peak, 0.01 * self.peak, none], axis=1)
        return self._fit(model, first, none, [np.inf] * 4, 4)

    def _fit(
        self,
        model: Model,
        start: FloatArray,
        rate: FloatArray,
        most: list[float],
        decay: int,
        known: tuple[tuple[int, FloatArray, FloatArray], ...] = (),
    ) -> WindowFits:
        """Fit a model with upper parameter limits before the decay, and what is known about some of them."""
        width, none = self.data.width, np.zeros(len(start))
        lowest, highest = np.zeros(start.shape), np.full(start.shape, np.inf)
        highest[:, :decay] = most
        lowest[:, 0], highest[:, 0] = -self.longest - width, self.longest + width
        highest[:, 1] = self.pulse.variances[-1]
        lowest[:, decay], highest[:, decay] = -_FARTHEST_DECAY, _FARTHEST_DECAY
        unit = np.full(start.shape, width)
        unit[:, 1] = highest[:, 1]
        unit[:, 2:decay] = np.where(self.peak > 0, self.peak, 1.0)[:, np.newaxis]
        unit[:, 5:7] = unit[:, decay] = 1.0
        if start.shape[1] > decay + 1:
            lowest[:, -1], highest[:, -1] = _SHORTEST_NS, self.longest
        every = np.ones(len(start), dtype=bool)
        data = replace(self.data, rate=rate[:, np.newaxis], known=(*known, (decay, none, none + OF_DECAY)))
        return fit_windows(model, start, data, self.peak, every, limits=Limits(lowest, highest, unit))


def _chosen(tried: list[WindowFits], best: IntArray) -> WindowFits:
    """Return the fit of each record that is best."""
    found = tried[0]
    for number, one in enumerate(tried[1:], 1):
        found = found.replaced(best == number, one)
    return found


def _error(fit: WindowFits, index: int) -> FloatArray:
    """Return the standard error of a parameter, 0 where it is not known."""
    return np.sqrt(np.maximum(np.nan_to_num(fit.covariance[:, index, index]), 0))


def _occam(fit: WindowFits) -> FloatArray:
    """Return log ratios of prior volumes to errors, for surface and column heights and the decay."""
    covariance, total = fit.covariance, -_log_decay(fit, 6)
    known = np.maximum(covariance[:, 6, 6], 1e-300)
    for index in (3, 4):
        # That of a height with the decay as fitted.
        variance = np.nan_to_num(covariance[:, index, index] - covariance[:, index, 6] ** 2 / known)
        ratio = fit.values[:, index] / np.sqrt(np.maximum(variance, 1e-300))
        total += np.log1p(np.minimum(ratio, 1e12))
    return total


def _log_decay(fit: WindowFits, index: int) -> FloatArray:
    """Return the logarithm of a column's prior over all decays, relative to its density at the fitted one.

    Decays are as likely as each other up to ten times the typical one; the fit's own prior does not count.
    """
    error, q = _error(fit, index), fit.values[:, index]
    # Precision of the samples alone.
    precision = 1 / np.where(error > 0, error, OF_DECAY) ** 2 - 1 / OF_DECAY**2
    density = q - _FARTHEST_DECAY + 0.5 * np.log(2 * np.pi / np.maximum(precision, 1e-12))
    return np.asarray(np.minimum(density + 0.5 * (q / OF_DECAY) ** 2, 0.0))


def _log_normal(time: FloatArray, middle: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the times' log density [1/ns]."""
    return np.asarray(-0.5 * ((time - middle) / spread) ** 2 - np.log(spread * np.sqrt(2 * np.pi)))


def _late_light(records: Records, first_ns: FloatArray, fits: _Fits) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return decay probabilities, and what samples after the fitted ones state about column levels.

    The log likelihood ratio of a level L to no light is L a - L^2 b/2.

    Parameters
    ----------
    records, first_ns, fits
        Waveforms, arrivals of their first echoes [ns], shape (n,), and their fits.

    Returns
    -------
    ndarray
        Probabilities of decays, shape (decays, 1), and a and b, shape (decays, n).
    """
    priors = fits.priors
    noise = np.broadcast_to(records.noise, records.power.shape)
    delay = records.time_ns - first_ns[:, np.newaxis]
    # Rounding hides the same part of all runs, which together count as one.
    floor = np.where(priors.least_column > 0, *_OF_TAIL) * fits.peak
    floor = np.hypot(floor, math.sqrt(_RUNS) * priors.baseline_stderr)
    q = np.linspace(-_FARTHEST_DECAY, _FARTHEST_DECAY, _DECAYS)[:, np.newaxis]
    chance = np.exp(-0.5 * (q / OF_DECAY) ** 2)
    linear, square = (np.zeros((_DECAYS, len(first_ns))) for _ in range(2))
    for start in float(fits.data.u[-1]) + records.bin_ns + _RUN_NS * np.arange(_RUNS):
        inside = (delay >= start) & (delay < start + _RUN_NS)
        number = np.maximum(inside.sum(axis=1), 1)
        mean = np.sum(np.where(inside, records.power, 0.0), axis=1) / number
        error = np.hypot(error_of_sums(np.where(inside, noise, 0.0), None, records.shared) / number, floor)
        weight = np.where(inside.any(axis=1), 1 / np.maximum(error, 1e-300) ** 2, 0.0)
        column, _ = priors.column(np.full(len(mean), start + 0.5 * _RUN_NS), priors.decay * np.exp(q))
        linear, square = linear + weight * column * mean, square + weight * column**2
    return chance / chance.sum(), linear, square


def _log_column(fit: WindowFits, records: Records, first_ns: FloatArray, fits: _Fits) -> tuple[FloatArray, FloatArray]:
    """Return a column's log mean likelihood over its prior levels, relative to the fitted one.

    First without light after the fitted samples, then with it, relative to no such light.
    """
    priors, peak = fits.priors, fits.peak
    error, found = np.where(_error(fit, 3) > 0, _error(fit, 3), peak), fit.values[:, 3]
    chance, linear, square = _late_light(records, first_ns, fits)
    error = np.hypot(error, priors.baseline_stderr)
    low = np.maximum(np.maximum(priors.least_column, _LEAST_COLUMN * peak), 1e-300)
    high = np.where(priors.least_column > 0, np.minimum(_MOST_COLUMN * low, peak), peak)
    decades = np.log(np.maximum(high / low, 10.0))
    levels = low * np.exp(decades * np.linspace(0, 1, _LEVELS)[:, np.newaxis])
    # Where no level is within the error of a distinct one, the integral of its normal distribution.
    clear = (found > _CLEAR * error) & (found > low)
    sharp = np.log(np.sqrt(2 * np.pi) * error / np.where(clear, found, 1.0) / decades)
    logs = -0.5 * np.minimum(np.abs(levels - found) / error, 1e6) ** 2
    level = levels[:, np.newaxis]
    late = logsumexp(level * linear - 0.5 * level**2 * square, axis=1, b=chance)
    near, both = (np.where(clear, sharp, logsumexp(one, axis=0) - np.log(_LEVELS)) for one in (logs, logs + late))
    return np.asarray(near), np.asarray(both)


def _mean(weight: FloatArray, times: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return means of times over possibilities, and their standard deviations."""
    middle = np.sum(weight * times, axis=0)
    return middle, np.sqrt(np.sum(weight * ((times - middle) ** 2 + errors**2), axis=0))


def _echo(fit: WindowFits, area_ns: float, shape: EchoShape, echo: int, time: FloatArray, error: FloatArray) -> Echoes:
    """Return the bottom (0) or the surface (1) of fits, with a time and its standard error [ns]."""
    area, height, height_error = 1e-9 * area_ns, fit.values[:, 2 + echo], _error(fit, 2 + echo)
    blur = 0.0 if echo else fit.values[:, 1]
    width = np.sqrt(shape.fwhm_ns**2 + 8 * np.log(2) * blur + 0 * height)
    width_error = 0 * height if echo else 4 * np.log(2) * _error(fit, 1) / width
    flags = np.zeros(len(time), dtype=np.intp)
    return Echoes(time, height, area * height, width, error, height_error, area * height_error, width_error, flags)


def _where(first: BoolArray, one: Echoes, other: Echoes) -> Echoes:
    """Return one echo or another one."""
    return Echoes(**{name: np.where(first, value, getattr(other, name)) for name, value in vars(one).items()})
