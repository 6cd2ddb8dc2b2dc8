"""Echoes in waveforms: finding them, and their time, amplitude, energy and width read directly from the record.

All times are arrivals of light: a method that reports another point of the echo is calibrated with the transmitted
pulse, so that every method gives the same time for an echo of the pulse's own shape. Samples are means over their bins,
at the bins' centres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite, finite_array, positive
from .pulse import Pulse

IntArray = npt.NDArray[np.intp]

_FINE = 15  # points of a template in each bin; odd, so that one of them is the bin's centre
_NOISE_FLOOR = 1e-6  # of a record's largest sample: the least noise that weights are made of
_SMOOTHING = 0.5  # width of the search filter in echo widths
_SURFACE_LEVEL = 1e-3  # of a record's largest value: below it, nothing is a surface echo
_FAINT = 0.02  # of the strongest echo behind the surface: below it, nothing there is one
_REACH = 1.5  # from an echo to the signal around it, in echo widths
GAUSSIAN_AREA = float(np.sqrt(np.pi / np.log(16)))  # area of a Gaussian of unit height and unit width at half maximum


class EchoFlag(IntFlag):
    """What is wrong with an echo; 0 where nothing is."""

    NO_ECHO = 1  # nothing rises above the noise: its numbers are NaN
    SATURATED = 2  # the detector or the digitiser was at its limit
    MERGED = 4  # nearer to another echo than an echo is long
    CUT = 8  # reaches past an end of the record
    POOR_FIT = 16  # too few usable samples, or a fit that has not converged


@dataclass(frozen=True)
class Records:
    """Waveforms with their noise.

    Attributes
    ----------
    power
        Samples less the baseline, shape (n, time); any unit, W where energies are to be J.
    time_ns
        Centres of the bins [ns], evenly spaced, shape (time,).
    noise
        Standard deviation of each sample, that of noise independent from bin to bin, shape (n, time) or (n, 1).
    """

    power: FloatArray
    time_ns: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, waveforms: npt.ArrayLike, time_ns: npt.ArrayLike, noise: npt.ArrayLike = 0.0) -> Records:
        """Check and keep waveforms.

        Parameters
        ----------
        waveforms : array_like, shape (n, time)
            Samples less the baseline, finite.
        time_ns : array_like, shape (time,)
            Centres of the bins [ns], at least 8, evenly spaced and increasing.
        noise : array_like, shape (), (n,) or (n, time)
            Standard deviation of the samples, not negative. Less than a millionth of the record's largest sample counts
            as that, so that records without noise can be weighted, too.

        Returns
        -------
        Records

        Raises
        ------
        ValueError
            If an array is not of this form.
        """
        power, time, sigma = (
            finite_array(name, values)
            for name, values in (("waveforms", waveforms), ("time_ns", time_ns), ("noise", noise))
        )
        if time.ndim != 1 or time.size < 8:
            raise ValueError(f"time_ns of shape {time.shape} must be a list of at least 8 times")
        steps = np.diff(time)
        if steps[0] <= 0 or np.any(np.abs(steps - steps[0]) > 1e-4 * steps[0] + 1e-9 * np.abs(time).max()):
            raise ValueError("time_ns must increase in equal steps")
        if power.ndim != 2 or power.shape[1] != time.size:
            raise ValueError(f"waveforms of shape {power.shape} must have the shape (n, {time.size})")
        if sigma.ndim == 1:
            sigma = sigma[:, np.newaxis]
        if sigma.ndim > 2 or (sigma.ndim == 2 and sigma.shape not in (power.shape, (len(power), 1))):
            raise ValueError(f"noise of shape {np.shape(noise)} must be a number, one a waveform, or one a sample")
        if np.any(sigma < 0):
            raise ValueError(f"noise = {sigma.min():g} must not be negative")
        least = _NOISE_FLOOR * np.max(np.abs(power), axis=1, initial=0.0)[:, np.newaxis]
        floored = np.maximum(sigma, np.where(least > 0, least, 1.0))
        return cls(power, time, np.asarray(np.broadcast_to(floored, (len(power), floored.shape[-1]))))

    @property
    def bin_ns(self) -> float:
        """Width of the bins [ns]."""
        return float(self.time_ns[-1] - self.time_ns[0]) / (self.time_ns.size - 1)


@dataclass(frozen=True)
class Template:
    """Shape in the record of an ideal echo that arrives at time 0.

    Attributes
    ----------
    time_ns, power
        Points of the shape [ns], 15 in each bin, and its height there, 1 at the peak; shape (points,).
    peak_ns, fwhm_ns
        Time of the peak after the arrival, and full width at half maximum [ns].
    """

    time_ns: FloatArray
    power: FloatArray
    peak_ns: float
    fwhm_ns: float

    @classmethod
    def of(cls, pulse: Pulse, bin_width_ns: float, response_time_ns: float = 0.0) -> Template:
        """Shape of a pulse after the receiver's response, averaged over bins.

        Parameters
        ----------
        pulse : Pulse
            The transmitted pulse.
        bin_width_ns : float
            Width of the bins [ns], above 0.
        response_time_ns : float
            Time constant of the receiver's single-pole response [ns], at least 0.

        Returns
        -------
        Template

        Raises
        ------
        ValueError
            If a number is out of range.
        """
        step = positive("bin_width_ns", bin_width_ns) / _FINE
        first, weights = pulse.kernel(step, response_time_ns)
        shares = np.convolve(weights, np.full(_FINE, 1.0))
        time = np.asarray((first - (_FINE - 1) / 2 + np.arange(shares.size)) * step, dtype=np.float64)
        power = shares / shares.max()
        top = int(np.argmax(power))
        above = np.flatnonzero(power >= 0.5)
        left, right = above[0], above[-1]
        rise = np.interp(0.5, power[left - 1 : left + 1], time[left - 1 : left + 1]) if left > 0 else time[0]
        fall = np.interp(-0.5, -power[right : right + 2], time[right : right + 2])
        return cls(time, power, float(time[top] + step * _vertex(power[top - 1 : top + 2])), float(fall - rise))

    def rise(self, level: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Time after the arrival [ns] at which the edge passes a level (0 to 1, of the peak), and its derivative."""
        edge = slice(0, int(np.argmax(self.power)) + 1)
        heights, kept = np.unique(self.power[edge], return_index=True)
        wanted = np.clip(level, 1e-6, 0.999)
        time = np.interp(wanted, heights, self.time_ns[edge][kept])
        ahead = np.interp(np.minimum(wanted * 1.001, 1.0), heights, self.time_ns[edge][kept])
        return time, (ahead - time) / (0.001 * wanted)


@dataclass(frozen=True)
class Found:
    """Where the echoes of each record are: bins of their peaks, -1 where there is none, and flags; shape (n,) each.

    Attributes
    ----------
    surface, target, bottom
        Bins of the peaks.
    surface_flags, target_flags, bottom_flags
        Sums of `EchoFlag`.
    """

    surface: IntArray
    target: IntArray
    bottom: IntArray
    surface_flags: IntArray
    target_flags: IntArray
    bottom_flags: IntArray


@dataclass(frozen=True)
class Echoes:
    """Numbers of one echo of each record, NaN where there is none; shape (n,) each.

    Attributes
    ----------
    time_ns, amplitude, energy, width_ns
        Arrival [ns], height above what surrounds the echo [unit of the record], its integral over time [unit times s]
        and full width at half maximum [ns].
    time_stderr, amplitude_stderr, energy_stderr, width_stderr
        Their standard errors from the records' noise.
    flags
        Sums of `EchoFlag`.
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


def _vertex(three: FloatArray) -> float:
    """Return where the parabola through three equidistant samples has its extremum, from the middle one [steps]."""
    curvature = three[0] - 2 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / curvature) if curvature < 0 else 0.0


def smooth(records: Records, width_ns: float) -> tuple[FloatArray, FloatArray]:
    """Return records after a Gaussian filter of a full width at half maximum [ns], and their noise then."""
    from scipy.ndimage import correlate1d

    sigma = max(width_ns / np.sqrt(8 * np.log(2)) / records.bin_ns, 0.3)
    lags = np.arange(-int(4 * sigma + 1), int(4 * sigma + 1) + 1)
    weights = np.exp(-0.5 * (lags / sigma) ** 2)
    weights /= weights.sum()
    # Beyond the ends there is nothing: a repeated sample would be noise that no filter has lowered.
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
) -> Found:
    """Find surface, target and bottom.

    The surface echo is the first peak of what rises above the noise. Behind it, a peak stands out from the water column
    where the smoothed signal w exceeds both w(t-d)^2/w(t-2d), how the column before would go on, and
    sqrt(w(t-d) w(t+d)), the column that would join what is on both sides: both are exact for an exponential, so that
    neither the column nor a step down in it counts. Where that would reach the surface echo, the signal must rise again
    after a dip. The last peak is the bottom, the strongest before it a target; a fiftieth of the strongest is the least
    that counts.

    Parameters
    ----------
    records : Records
        The waveforms.
    echo_fwhm_ns : float
        Expected full width of an echo at half maximum [ns], above 0: pulse, response and the spread over the footprint.
    threshold : float
        Standard deviations of the noise above which a smoothed signal counts, above 0.
    contrast : float
        Share of the signal that must stand out in a peak behind the surface, 0 to 1.
    earliest_ns : float
        No surface echo is sought before [ns].

    Returns
    -------
    Found

    Raises
    ------
    ValueError
        If a number is out of range.
    """
    width = positive("echo_fwhm_ns", echo_fwhm_ns)
    threshold, contrast = positive("threshold", threshold), finite("contrast", contrast)
    if not 0 <= contrast < 1:
        raise ValueError(f"contrast = {contrast:g} must be at least 0 and below 1")
    power, noise = smooth(records, _SMOOTHING * width)
    count = power.shape[1]
    bins = np.arange(count)
    surface = _first_peak(power, noise, threshold, records.time_ns >= earliest_ns)

    reach = max(round(_REACH * width / records.bin_ns), 1)
    behind = bins > surface[:, np.newaxis]
    stands_out = _above_column(np.maximum(power, 0), reach)
    # Near the surface there is no column to compare with: there, what rises again after a dip stands out.
    lowest = np.minimum.accumulate(np.where(behind, power, np.inf), axis=1)
    apart = width / records.bin_ns
    near = behind & (bins <= surface[:, np.newaxis] + 2 * reach + apart)
    stands_out = np.where(near, power - lowest, stands_out)
    dip = np.minimum.accumulate(np.where(behind, np.maximum(stands_out, 0), np.inf), axis=1)
    excess = np.where(behind & (surface >= 0)[:, np.newaxis], stands_out, -np.inf)
    excess = np.minimum(excess, excess - np.where(np.isfinite(dip), dip, 0))
    peaks = np.zeros(power.shape, dtype=bool)
    peaks[:, 1:-1] = (stands_out[:, 1:-1] > stands_out[:, :-2]) & (stands_out[:, 1:-1] >= stands_out[:, 2:])
    # The signal and the two that it is compared with are all noisy.
    peaks &= (excess > 1.5 * threshold * noise) & (excess > contrast * power)

    # What follows a strong echo and is far weaker than it belongs to its tail.
    peaks &= excess > _FAINT * np.max(np.where(peaks, excess, 0), axis=1, keepdims=True)

    bottom = np.where(peaks.any(axis=1), count - 1 - np.argmax(peaks[:, ::-1], axis=1), -1)
    before = peaks & (bins < (bottom - apart)[:, np.newaxis])
    target = np.where(before.any(axis=1), np.argmax(np.where(before, excess, -np.inf), axis=1), -1)
    flags = [np.where(place < 0, int(EchoFlag.NO_ECHO), 0) for place in (surface, target, bottom)]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        places = (surface, target, bottom)
        near = (places[first] >= 0) & (places[second] >= 0) & (places[second] - places[first] < apart)
        for which in (first, second):
            flags[which] = flags[which] | np.where(near, int(EchoFlag.MERGED), 0)
    return _hidden_bottom(records, power, width, Found(surface, target, bottom, *flags))


def _first_peak(power: FloatArray, noise: FloatArray, threshold: float, allowed: npt.NDArray[np.bool_]) -> IntArray:
    """Bin of the first peak after the signal has left the noise, -1 where it never does; shape (n,)."""
    level = np.maximum(threshold * noise, _SURFACE_LEVEL * power.max(axis=1, keepdims=True, initial=0.0))
    above = (power > level) & allowed
    start = np.argmax(above, axis=1)
    falls = np.zeros(power.shape, dtype=bool)
    falls[:, :-1] = power[:, 1:] < power[:, :-1]
    falls[:, -1] = True
    falls &= np.arange(power.shape[1]) >= start[:, np.newaxis]
    return np.where(above.any(axis=1), np.argmax(falls, axis=1), -1)


def _above_column(power: FloatArray, reach: int) -> FloatArray:
    """Return what of a signal, shape (n, time), exceeds the column around it."""
    padded = np.pad(power, ((0, 0), (2 * reach, reach)), mode="edge")
    size = power.shape[1]
    earlier, before, after = padded[:, :size], padded[:, reach : reach + size], padded[:, 3 * reach : 3 * reach + size]
    falls_by = np.divide(before, earlier, out=np.ones_like(before), where=earlier > before)
    return np.asarray(power - np.maximum(before * falls_by, np.sqrt(before * after)))


def _hidden_bottom(records: Records, power: FloatArray, width: float, found: Found) -> Found:
    """Flag surface echoes that no water follows and that are too wide for one echo: they hold the bottom, too."""
    rows = np.arange(len(power))
    place = np.maximum(found.surface, 0)
    half = power >= 0.5 * power[rows, place][:, np.newaxis]
    bins = np.arange(power.shape[1])
    start = np.max(np.where(~half & (bins < place[:, np.newaxis]), bins, -1), axis=1)
    end = np.min(np.where(~half & (bins > place[:, np.newaxis]), bins, power.shape[1]), axis=1)
    single = width * np.sqrt(1 + _SMOOTHING**2)
    wide = (end - start - 1) * records.bin_ns > 1.1 * single
    tail = power[rows, np.minimum(end + int(_REACH * width / records.bin_ns), power.shape[1] - 1)]
    empty = tail < 0.05 * power[rows, place]
    hidden = np.where((found.surface >= 0) & (found.bottom < 0) & wide & empty, int(EchoFlag.MERGED), 0)
    return replace(found, surface_flags=found.surface_flags | hidden, bottom_flags=found.bottom_flags | hidden)
