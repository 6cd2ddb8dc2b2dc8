"""Waveform records, and detection of the echoes in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from itertools import combinations

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, finite_array, positive
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.results.sum_errors import BlockCorrelation

IntArray = npt.NDArray[np.intp]
BoolArray = npt.NDArray[np.bool_]

_NOISE_FLOOR = 1e-6  # smallest noise, relative to the largest sample of a record
_SMOOTHING = 0.5  # width of the detection filter in echo widths
_SURFACE_LEVEL = 1e-3  # smallest surface echo, relative to the largest value of a record
_FAINT = 0.02  # smallest echo behind the surface, relative to the strongest one there
_FOCUSED = 0.5  # smallest target below waves above the column, relative to it
_EVENT = 0.8  # height of a single event after the detection filter
_BEFORE = 0.6  # weight of the signal one reach before an echo beside the mean from one to two reaches behind it
_EARLY = 3.0  # thresholds, or heights of single events, above which an echo counts before the sea's
_GONE = 0.8  # signal two reaches behind the last echo, relative to the column before it
_BRIGHTER = 1.5  # largest signal behind a bottom, relative to it: light of wider paths may have a peak of its own
_REACH = 1.5  # distance from an echo to the signal around it, in echo widths
_BEHIND_EDGE, _STAYS = (0.8, 1.2), 0.15  # reaches behind an edge, and the share of its rise that is left there
_LEAST_COLUMN = 0.1  # column before an edge, relative to the peak
# Least excess at half the reach over that at the reach, as of an echo four times as wide as expected (0.25 for wide
# humps), and standard deviations of the noise by which it must be larger.
_NARROW, _SURE = 0.28, 1.0
BEHIND_EDGE = _BEHIND_EDGE[0] * _REACH  #: Echo widths behind a peak from which on an edge is told by the signal.
GAUSSIAN_AREA = float(np.sqrt(np.pi / np.log(16)))  # area of a Gaussian of unit height and unit width at half maximum


class EchoFlag(IntFlag):
    """Problems of an echo; 0 if there are none."""

    NO_ECHO = 1  # no signal above the noise; the values are NaN
    SATURATED = 2  # the detector or the digitiser was at its limit
    MERGED = 4  # less than an echo width from another echo
    CUT = 8  # extends beyond an end of the record
    POOR_FIT = 16  # too few usable samples, a fit that has not converged, or one with a doubtful amplitude
    SCATTERED_LIGHT = 64  # the beam does not light the pixel: the light has been scattered, and the depth is too large
    FEW_EVENTS = 128  # no higher than single events of the detector, such as dark counts: may be noise
    COLUMN_ONSET = 256  # a surface without an echo of its own, whose time is that of the column's onset
    NO_SURFACE_LIGHT = 32  # the beam does not light the surface in the pixel, or the first echo is not the surface's


class EchoClass(IntEnum):
    """What an echo is. Land and objects above the water are timed in air, bottoms and objects in it in the water."""

    NONE = 0
    SURFACE = 1  # of the sea
    COLUMN = 2
    BOTTOM = 3
    MERGED = 4  # a bottom less than 1.8 echo widths behind its surface
    OBJECT = 5  # in the water, before the bottom
    LAND = 6
    ABOVE = 7  # an object above the water, before other echoes


def has_echo(flags: IntArray) -> BoolArray:
    """Return where there is an echo of its own: where flags include neither `NO_ECHO` nor `COLUMN_ONSET`."""
    return np.asarray((flags & int(EchoFlag.NO_ECHO | EchoFlag.COLUMN_ONSET)) == 0)


@dataclass(frozen=True)
class Records:
    """Waveforms with their noise."""

    power: FloatArray  #: Samples less the baseline, shape (n, time); any unit, W for energies in J.
    time_ns: FloatArray  #: Centres of the bins [ns], evenly spaced, shape (time,).
    noise: FloatArray  #: Standard deviation of each sample, independent between bins, shape (n, time) or (n, 1).
    #: Correlation of the samples, and the inflation of their noise to that of means over neighbours, where sums of
    #: samples are not those of independent bins. None otherwise.
    shared: BlockCorrelation | None = None

    @classmethod
    def of(cls, waveforms: npt.ArrayLike, time_ns: npt.ArrayLike, noise: npt.ArrayLike = 0.0) -> Records:
        """Check waveforms, shape (n, time), at bin centres [ns], at least 8, evenly spaced and increasing.

        The samples' standard deviation has the shape (), (n,) or (n, time) and is not negative. At least a millionth of
        the record's largest sample keeps weights finite. Invalid arrays raise `UserError`.
        """
        power, time, sigma = (
            finite_array(name, values)
            for name, values in (("waveforms", waveforms), ("time_ns", time_ns), ("noise", noise))
        )
        if time.ndim != 1 or time.size < 8:
            raise UserError(f"time_ns of shape {time.shape} must be a list of at least 8 times")
        steps = np.diff(time)
        if steps[0] <= 0 or np.any(np.abs(steps - steps[0]) > 1e-4 * steps[0] + 1e-9 * np.abs(time).max()):
            raise UserError("time_ns must increase in equal steps")
        if power.ndim != 2 or power.shape[1] != time.size:
            raise UserError(f"waveforms of shape {power.shape} must have the shape (n, {time.size})")
        if sigma.ndim == 1:
            sigma = sigma[:, np.newaxis]
        if sigma.ndim > 2 or (sigma.ndim == 2 and sigma.shape not in (power.shape, (len(power), 1))):
            raise UserError(f"noise of shape {np.shape(noise)} must be a number, one per waveform, or one per sample")
        if np.any(sigma < 0):
            raise UserError(f"noise = {sigma.min():g} must not be negative")
        least = _NOISE_FLOOR * np.max(np.abs(power), axis=1, initial=0.0)[:, np.newaxis]
        floored = np.maximum(sigma, np.where(least > 0, least, 1.0))
        return cls(power, time, np.asarray(np.broadcast_to(floored, (len(power), floored.shape[-1]))))

    @property
    def bin_ns(self) -> float:
        """Width of the bins [ns]."""
        return float(self.time_ns[-1] - self.time_ns[0]) / (self.time_ns.size - 1)

    def without(self, unusable: BoolArray) -> Records:
        """Return the waveforms with samples that do not count, shape (n, time)."""
        if not unusable.any():
            return self
        # Far above what a clipped echo may have been.
        noise = 1e3 * np.max(np.abs(self.power), axis=1, keepdims=True)
        return replace(self, noise=np.where(unusable, noise, self.noise))

    def part(self, rows: IntArray) -> Records:
        """Return some of the waveforms."""
        return replace(self, power=self.power[rows], noise=self.noise[rows])

    def time_of(self, bins: IntArray) -> FloatArray:
        """Return bin centres [ns]; for bins outside the record, the nearest centre inside."""
        return np.asarray(self.time_ns[np.clip(bins, 0, self.time_ns.size - 1)])

    def places(self, bins: IntArray, lags: IntArray) -> IntArray:
        """Return the bins at lags from a bin of each record, those outside the record moved to its ends."""
        return np.asarray(np.clip(bins[:, np.newaxis] + lags, 0, self.time_ns.size - 1))

    def around(self, bins: IntArray, lags: IntArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the samples at lags from a bin of each record, their noise, and whether they are in the record."""
        places = bins[:, np.newaxis] + lags
        inside = (places >= 0) & (places < self.time_ns.size)
        clipped = self.places(bins, lags)
        power = np.take_along_axis(self.power, clipped, axis=1)
        noise = np.take_along_axis(np.broadcast_to(self.noise, self.power.shape), clipped, axis=1)
        return power, noise, inside


def error_of_sums(scaled: FloatArray, places: IntArray | None, shared: BlockCorrelation | None) -> FloatArray:
    """Return the standard errors of sample sums, shape (n,).

    Parameters
    ----------
    scaled
        Noise of the samples times their weights, shape (n, bins); 0 outside the record.
    places
        Bins of the samples, in the record, shape (n, bins); None for all bins.
    shared
        As of `Records`.
    """
    if shared is None:
        return np.asarray(np.linalg.norm(scaled, axis=1))
    if places is None:
        return np.sqrt(np.maximum(shared.covariance(scaled[:, np.newaxis])[:, 0, 0], 0))
    return np.sqrt(np.maximum(shared.variances(scaled, places), 0))


@dataclass(frozen=True)
class DetectedEchoes:
    """Surface, targets and bottom of each record: peak bins, -1 without an echo, and `EchoFlag` sums.

    The first target is the strongest one, and others follow by strength.
    """

    bins: IntArray  #: Shape (2 + targets, n), with a target at least.
    flags: IntArray  #: Of the same shape.

    @property
    def surface(self) -> IntArray:
        """Bins of the surface peaks, shape (n,)."""
        return np.asarray(self.bins[0])

    def neighbours(self, echo: int) -> tuple[IntArray, IntArray]:
        """Return the bins of the last echo before an echo and the first one after it, -1 without one, shape (n,)."""
        others = np.delete(self.bins, echo, axis=0)
        own, known = self.bins[echo], others >= 0
        before = np.max(np.where(known & (others < own), others, -1), axis=0)
        behind = np.min(np.where(known & (others > own), others, np.iinfo(np.intp).max), axis=0)
        return before, np.where(behind < np.iinfo(np.intp).max, behind, -1)


@dataclass(frozen=True)
class Echoes:
    """Measured quantities of one echo per record, NaN without an echo; shape (n,) each.

    Arrival [ns], height above the surrounding signal [record's unit], integral over time [unit times s], and full width
    at half maximum [ns]. Further their standard errors by record noise, and `EchoFlag` sums.
    """

    time_ns: FloatArray
    amplitude: FloatArray
    energy: FloatArray
    width_ns: FloatArray
    time_stderr: FloatArray
    amplitude_stderr: FloatArray
    energy_stderr: FloatArray
    width_stderr: FloatArray
    flags: IntArray

    def known_only(self, known: BoolArray) -> Echoes:
        """Return the echoes with NaN where they are not known."""
        numbers = {name: np.where(known, value, np.nan) for name, value in vars(self).items() if name != "flags"}
        return replace(self, **numbers)

    def or_at(self, time_ns: FloatArray, error_ns: float) -> Echoes:
        """Return the echoes with other times and an error of these [ns] where they have none."""
        lacking = np.isnan(self.time_ns) & np.isfinite(time_ns)
        error = np.where(lacking, error_ns, self.time_stderr)
        return replace(self, time_ns=np.where(lacking, time_ns, self.time_ns), time_stderr=error)

    def delayed(self, delay_ns: float | FloatArray, error_ns: float | FloatArray = 0.0) -> Echoes:
        """Return the echoes with a delay added to their times, and its standard error [ns]."""
        return replace(self, time_ns=self.time_ns + delay_ns, time_stderr=np.hypot(self.time_stderr, error_ns))


def smooth(records: Records, width_ns: float) -> tuple[FloatArray, FloatArray]:
    """Return records after a Gaussian filter of a full width at half maximum [ns], and their noise."""
    from scipy.ndimage import correlate1d

    sigma = max(width_ns / FWHM_PER_SIGMA / records.bin_ns, 0.3)
    lags = np.arange(-int(4 * sigma + 1), int(4 * sigma + 1) + 1)
    weights = np.exp(-0.5 * (lags / sigma) ** 2)
    weights /= weights.sum()
    # Zero beyond the ends: the noise of a repeated sample would not be averaged.
    if records.noise.shape[1] == 1:
        noise = records.noise * np.linalg.norm(weights)
    else:
        noise = np.sqrt(correlate1d(records.noise**2, weights**2, axis=1, mode="nearest"))
    return np.asarray(correlate1d(records.power, weights, axis=1, mode="constant")), noise


def find_echoes(
    records: Records,
    echo_fwhm_ns: float,
    *,
    threshold: float = 5.0,
    contrast: float = 0.05,
    earliest_ns: float = -np.inf,
    latest_ns: npt.ArrayLike = np.inf,
    after_ns: npt.ArrayLike = -np.inf,
    event_height: npt.ArrayLike = 0.0,
    waves: bool = False,
    targets: int | None = None,
    tail: float = 0.0,
) -> DetectedEchoes:
    """Find surface, target and bottom.

    The surface echo is the first peak above the noise. After it, a peak exceeds the water column if the smoothed signal
    w exceeds two levels. The first, w(t-d)^2/w(t-2d), is extrapolated from the column before it; the second,
    sqrt(w(t-d) w(t+d)), is interpolated. Where w(t+2d) is below 0.8 w(t-d), as after a bottom, the second is w(t-d)^0.6
    v^0.4, with the mean v of w from t+d to t+2d. An exponential exceeds none: neither the column nor a step down in it
    is a peak. Where t-2d is in the surface echo, the signal must rise again after a dip. The last peak is the bottom,
    earlier ones are targets. Peaks below two thirds of what follows the last one are none. Peaks below a fiftieth of
    the strongest are ignored; among peaks less than an echo width apart the strongest counts. After the upper edge of a
    turbid layer the signal does not fall back to the column above it. Such a rise is no echo. Nor is a first summit
    four times as wide as an echo in a record without a surface echo: light that was scattered to a pixel beside the
    beam rises and falls slowly. Waves focus a shot's light, so that its column has peaks. Under waves, targets rise
    above the column by at least half of it, and near the surface also above half the column after them.

    Parameters
    ----------
    records : Records
        The waveforms.
    echo_fwhm_ns : float
        Expected full width of an echo at half maximum after pulse, response and footprint [ns], above 0.
    threshold : float
        Detection threshold of the smoothed signal [standard deviations of the noise], above 0.
    contrast : float
        Least excess over the column for peaks after the surface, relative to the signal, 0 to 1.
    earliest_ns : float
        Earliest time of the surface echo [ns]; before it only echoes above three thresholds count, which are land.
    latest_ns : array_like, shape () or (n,)
        Latest time of the surface echo [ns]. Where the first peak is later, there is none, and the peak is a target or
        the bottom.
    after_ns : array_like, shape () or (n,)
        Time from which on echoes count [ns].
    event_height : array_like, shape () or (n,)
        Height that single events of the detector reach. Lower peaks count only where there is no higher one.
    waves : bool
        Whether the light has passed waves.
    targets : int, optional
        Largest number of targets of a record, at least 1; all by default.
    tail : float
        Signal of an ideal echo `BEHIND_EDGE` echo widths behind its peak, relative to the peak.

    Raises
    ------
    UserError
        If a number is out of range.
    """
    width = positive("echo_fwhm_ns", echo_fwhm_ns)
    threshold, contrast = positive("threshold", threshold), finite("contrast", contrast)
    if not 0 <= contrast < 1:
        raise UserError(f"contrast = {contrast:g} must be at least 0 and below 1")
    power, noise = smooth(records, _SMOOTHING * width)
    count = power.shape[1]
    bins = np.arange(count)
    early = records.time_ns < earliest_ns
    events = np.broadcast_to(np.asarray(event_height, dtype=np.float64), len(power))[:, np.newaxis]
    surface = _first_peak(
        power,
        np.where(early, _EARLY * np.maximum(noise, events / threshold), noise),
        threshold,
        records.time_ns >= np.asarray(after_ns)[..., np.newaxis],
    )
    # Without a surface echo, the others are behind its latest time.
    latest = np.searchsorted(records.time_ns, np.broadcast_to(np.asarray(latest_ns), surface.shape), side="right") - 1
    late, reach = surface > latest, max(round(_REACH * width / records.bin_ns), 1)
    # The rise of a late first peak is no column before it.
    origin = np.where(late, np.minimum(latest, surface - reach), surface)
    surface = np.where(late, -1, surface)
    behind = bins > origin[:, np.newaxis]
    rises, by_column, column = _above_column(np.maximum(power, 0), reach)
    # Near the surface there is no column to extrapolate from: the excess is the rise after a dip.
    rise = power - np.minimum.accumulate(np.where(behind, power, np.inf), axis=1)
    apart = width / records.bin_ns
    near_until = np.where(surface >= 0, surface + 2 * reach + apart, -np.inf)[:, np.newaxis]
    stands_out = np.where(behind & (bins <= near_until), rise, by_column)
    dip = np.minimum.accumulate(np.where(behind, np.maximum(stands_out, 0), np.inf), axis=1)
    dip = np.where(np.isfinite(dip), dip, 0)
    found = behind & ((surface >= 0) | late)[:, np.newaxis]
    # An echo on the border has its peak in one of both: the rise has its own a little farther.
    beyond, within = bins > near_until, bins <= near_until + 0.5 * apart
    peaks, excess = np.zeros(power.shape, dtype=bool), np.full(power.shape, -np.inf)
    for shape, above, where in ((rises, by_column, beyond), (rise, rise, within)):
        own = np.where(found & where & _is_peak(shape), above - dip, -np.inf)
        # The factor accounts for the noise of the samples of the column.
        own[(own <= 1.5 * threshold * noise) | (own <= contrast * power)] = -np.inf
        peaks, excess = peaks | np.isfinite(own), np.maximum(excess, own)
    peaks &= ~_is_edge(power, noise, peaks & beyond, reach, threshold, tail)
    alone = np.flatnonzero(late)
    error = np.broadcast_to(noise, power.shape)[alone]
    summit = power[alone] >= np.maximum.accumulate(power[alone], axis=1) - threshold * error
    peaks[alone] &= ~(summit & _is_hump(np.maximum(power[alone], 0), error, reach))
    # Much weaker peaks are in the tail of a strong echo.
    peaks &= excess > _FAINT * np.max(np.where(peaks, excess, 0), axis=1, keepdims=True)

    # A single event is as narrow as the response, which smoothing lowers.
    few = np.broadcast_to(np.asarray(event_height, dtype=np.float64), surface.shape)[:, np.newaxis] * _EVENT
    strong = peaks & (excess >= few)
    peaks = np.where(strong.any(axis=1, keepdims=True), strong, peaks)
    # Light behind a bottom is not much brighter: such a peak is on the rise of light that the water has scattered.
    last = count - 1 - np.argmax(peaks[:, ::-1], axis=1)[:, np.newaxis]
    later = np.max(np.where(bins > last + apart, power, -np.inf), axis=1, keepdims=True)
    peaks &= _BRIGHTER * power > later - threshold * noise
    bottom = np.where(peaks.any(axis=1), count - 1 - np.argmax(peaks[:, ::-1], axis=1), -1)
    before = peaks & (bins < (bottom - apart)[:, np.newaxis])
    if waves:
        around = np.maximum(power - rise, _column_behind(power, noise, reach))
        level = np.where(bins <= near_until, around, column)
        before &= power - level > _FOCUSED * level
    chosen = _strongest(before, excess, apart, targets)
    places = np.stack([surface, *chosen, bottom])
    flags = np.where(places < 0, int(EchoFlag.NO_ECHO), 0)
    flags[1:] |= np.where((places[1:] >= 0) & ~strong.any(axis=1), int(EchoFlag.FEW_EVENTS), 0)
    for first, second in combinations(range(len(places)), 2):
        near = (places[first] >= 0) & (places[second] >= 0) & (np.abs(places[second] - places[first]) < apart)
        flags[[first, second]] |= np.where(near, int(EchoFlag.MERGED), 0)
    flags[[0, -1]] |= np.where(_hides_bottom(records, power, width, surface) & (bottom < 0), int(EchoFlag.MERGED), 0)
    return DetectedEchoes(places, flags)


def _strongest(peaks: BoolArray, excess: FloatArray, apart: float, most: int | None) -> list[IntArray]:
    """Return the bins of peaks, the strongest first, without those less than `apart` from a stronger one.

    Each of shape (n,), -1 where there are no more; one at least, and `most` at most.
    """
    left, bins = peaks.copy(), np.arange(peaks.shape[1])
    found: list[IntArray] = []
    while not found or (left.any() and (most is None or len(found) < most)):
        place = np.where(left.any(axis=1), np.argmax(np.where(left, excess, -np.inf), axis=1), -1)
        found.append(place)
        left &= np.abs(bins - place[:, np.newaxis]) >= apart
        left &= (place >= 0)[:, np.newaxis]
    return found


def _is_edge(
    power: FloatArray, noise: FloatArray, peaks: BoolArray, reach: int, threshold: float, tail: float
) -> BoolArray:
    """Return which peaks are rises of the column: behind them the signal stays above the column before, and only falls.

    An echo of a Gaussian pulse has fallen to a twentieth within 0.8 reaches, others to their `tail`. Between two echoes
    the signal rises again.
    """
    edges = np.zeros_like(peaks)
    start, end = (max(round(share * reach), 1) for share in _BEHIND_EDGE)
    rows, places = np.nonzero(peaks)
    inside = (places >= 2 * reach) & (places + end < power.shape[1])
    rows, places = rows[inside], places[inside]
    before, earlier = (np.maximum(power[rows, places - lag], 0) for lag in (reach, 2 * reach))
    falls_by = np.divide(before, earlier, out=np.ones_like(before), where=earlier > before)
    lags = np.arange(end + 1)
    column = before[:, np.newaxis] * falls_by[:, np.newaxis] ** (1 + lags / reach)
    behind = power[rows[:, np.newaxis], places[:, np.newaxis] + lags]
    error = np.broadcast_to(noise, power.shape)[rows, places]
    above = behind - column
    stays = above[:, start:].min(axis=1) > np.maximum(max(_STAYS, 2 * tail) * above[:, 0], 1.5 * threshold * error)
    falls = np.diff(behind, axis=1).max(axis=1) <= threshold * error
    dark = before < np.maximum(_LEAST_COLUMN * behind[:, 0], threshold * error)
    edges[rows, places] = stays & falls & ~dark
    return edges


def _is_hump(power: FloatArray, noise: FloatArray, reach: int) -> BoolArray:
    """Return where the excess of a signal, shape (n, time), over neighbours grows with the square of their distance."""

    def excess(lag: int) -> FloatArray:
        padded = np.pad(power, ((0, 0), (lag, lag)), mode="edge")
        return np.asarray(power - np.sqrt(padded[:, : -2 * lag] * padded[:, 2 * lag :]))

    return excess(max(round(0.5 * reach), 1)) < _NARROW * excess(reach) + _SURE * noise


def _first_peak(power: FloatArray, noise: FloatArray, threshold: float, allowed: BoolArray) -> IntArray:
    """Return the bin of the first peak after the signal exceeds the noise, -1 if it never does; shape (n,)."""
    level = np.maximum(threshold * noise, _SURFACE_LEVEL * power.max(axis=1, keepdims=True, initial=0.0))
    above = (power > level) & allowed
    start = np.argmax(above, axis=1)
    falls = np.zeros(power.shape, dtype=bool)
    falls[:, :-1] = power[:, 1:] < power[:, :-1]
    falls[:, -1] = True
    falls &= np.arange(power.shape[1]) >= start[:, np.newaxis]
    return np.where(above.any(axis=1), np.argmax(falls, axis=1), -1)


def _is_peak(values: FloatArray) -> BoolArray:
    """Return where values, shape (n, time), are larger than those before and not smaller than those after them."""
    peaks = np.zeros(values.shape, dtype=bool)
    peaks[:, 1:-1] = (values[:, 1:-1] > values[:, :-2]) & (values[:, 1:-1] >= values[:, 2:])
    return peaks


def _above_column(power: FloatArray, reach: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the excess of a signal, shape (n, time), over the column around it, and the column before it.

    The first excess is that whose peaks count, the second one their heights: both are the same but for the last echo,
    whose scattered light lowers the first.
    """
    padded = np.pad(power, ((0, 0), (2 * reach, 2 * reach)), mode="edge")
    size = power.shape[1]
    earlier, before = padded[:, :size], padded[:, reach : reach + size]
    after, far = padded[:, 3 * reach : 3 * reach + size], padded[:, 4 * reach :]
    falls_by = np.divide(before, earlier, out=np.ones_like(before), where=earlier > before)
    # Light of a bottom that was scattered in the water follows its echo, and is gone further behind, as is the column.
    mean = np.lib.stride_tricks.sliding_window_view(padded[:, 3 * reach :], reach + 1, axis=1).mean(axis=-1)
    behind = before**_BEFORE * mean ** (1 - _BEFORE)
    beside, column = np.sqrt(before * after), before * falls_by
    between = np.where(far < _GONE * before, behind, beside)
    return power - np.maximum(column, beside), power - np.maximum(column, between), column


def _column_behind(power: FloatArray, noise: FloatArray, reach: int) -> FloatArray:
    """Return the column behind each sample, extrapolated to it from the lowest signals within one and two reaches.

    It is at most the mean of two logarithms, the sample's and the lowest signal's. So the end of column or record is no
    steep decay.
    """
    from scipy.ndimage import minimum_filter1d

    size = reach + 1
    ahead = minimum_filter1d(power, size, axis=1, origin=-(size // 2), mode="nearest")
    first = np.maximum(ahead, noise)
    later = np.maximum(np.pad(ahead, ((0, 0), (0, reach)), mode="edge")[:, reach:], noise)
    return np.asarray(np.minimum(first * np.maximum(first / later, 1), np.sqrt(first * np.maximum(power, first))))


def _hides_bottom(records: Records, power: FloatArray, width: float, surface: IntArray) -> BoolArray:
    """Return where a surface echo without a column is too wide for one echo, and thus includes the bottom."""
    rows = np.arange(len(power))
    place = np.maximum(surface, 0)
    half = power >= 0.5 * power[rows, place][:, np.newaxis]
    bins = np.arange(power.shape[1])
    start = np.max(np.where(~half & (bins < place[:, np.newaxis]), bins, -1), axis=1)
    end = np.min(np.where(~half & (bins > place[:, np.newaxis]), bins, power.shape[1]), axis=1)
    single = width * np.sqrt(1 + _SMOOTHING**2)
    wide = (end - start - 1) * records.bin_ns > 1.1 * single
    tail = power[rows, np.minimum(end + int(_REACH * width / records.bin_ns), power.shape[1] - 1)]
    return np.asarray((surface >= 0) & wide & (tail < 0.05 * power[rows, place]))
