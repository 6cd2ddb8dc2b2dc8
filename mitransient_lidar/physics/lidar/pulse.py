"""Transmitted pulse shape, and its convolution with the receiver's response over time bins."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from os import PathLike
from typing import Literal

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.headings import Column
from mitransient_lidar.core.tables.text_tables import read_time_samples
from mitransient_lidar.core.validation import ArrayLike, BoolArray, FloatArray, non_negative, positive, time_samples
from mitransient_lidar.physics.piecewise_linear import first_crossing, integral, locate, node_integrals

logger = logging.getLogger(__name__)

FWHM_PER_SIGMA = float(np.sqrt(8 * np.log(2)))
_TAIL = 1e-10  # energy left out at each kernel end
_MOST_BINS = 10**7  # in a kernel
_LONGEST_DIRECT = 2000  # bins of a kernel from which Fourier transforms are faster

#: Lowest sample in a file relative to the largest one; negative samples are noise.
_LOWEST_SAMPLE = -0.1

_POWER = Column(
    "power",
    (
        *("p", "w", "mw", "signal", "amplitude", "ampl", "intensity", "irradiance", "energy", "counts", "current"),
        *("v", "mv", "volt", "volts", "voltage", "ch1", "ch2", "ch3", "ch4"),
    ),
)


@dataclass(frozen=True, eq=False)
class Pulse:
    """Pulse with unit energy whose peak leaves the transmitter at t = 0.

    Build one with `gaussian`, `sampled` or `from_file`.
    """

    shape: Literal["gaussian", "sampled"]  #: Selects which of the fields below apply.
    #: Full width at half maximum [ns]; for a sampled pulse, the time from first to last crossing of half the largest
    #: sample.
    fwhm_ns: float
    times_ns: FloatArray  #: Times of the samples [ns] with the largest sample at 0, shape (S,).
    power: FloatArray  #: Power at the samples [1/ns]: linear between them, 0 outside, unit area, shape (S,).

    @classmethod
    def gaussian(cls, fwhm_ns: float) -> Pulse:
        """Gaussian pulse of full width at half maximum `fwhm_ns` [ns], positive."""
        return cls("gaussian", positive("fwhm_ns", fwhm_ns), np.zeros(0), np.zeros(0))

    @classmethod
    def sampled(cls, times_ns: ArrayLike, power: ArrayLike) -> Pulse:
        """Pulse given by samples.

        `times_ns`: strictly increasing times [ns], at least 2, shape (S,). They are shifted so that the (first) largest
        sample is at 0. `power`: power in any unit, not negative, not all 0, shape (S,). It is scaled to unit area.
        """
        t, p = time_samples(times_ns, "power", power)
        non_negative("power", p.min())
        area = np.sum(np.diff(t) * (p[1:] + p[:-1]) / 2)
        if area <= 0:
            raise UserError("power must be greater than 0 somewhere")
        half = 0.5 * p.max()
        fwhm_ns = -first_crossing(-t[::-1], p[::-1], half) - first_crossing(t, p, half)
        return cls("sampled", fwhm_ns, t - t[np.argmax(p)], p / area)

    @classmethod
    def from_file(cls, path: str | PathLike[str]) -> Pulse:
        """Read a sampled pulse from a text file.

        Raises UserError if the file cannot be read, a sample is lower than that, or `sampled` refuses the samples.

        `path`: file for `text_tables.read_time_samples`: times as for `sampled`, and the power in any unit. Its name
        may be power, signal, amplitude, intensity, voltage, counts, W, V or mV, among others. Samples below 0, down to
        -0.1 times the largest one, are noise and set to 0 with a warning in the log.
        """
        times, power = read_time_samples(path, _POWER)
        lowest = power.min(initial=0.0)
        if lowest < 0 and np.all(np.isfinite(power)):
            if lowest < _LOWEST_SAMPLE * power.max():
                raise UserError(
                    f"{path} has power = {lowest:g} with a largest one of {power.max():g}: samples must not be "
                    "negative beyond noise, a tenth of the largest one"
                )
            logger.warning(
                "%s: %d of %d samples are below 0, down to %.2g of the largest one, and set to 0",
                path,
                np.sum(power < 0),
                power.size,
                lowest / power.max(),
            )
            power = np.maximum(power, 0.0)
        return cls.sampled(times, power)

    @property
    def span_ns(self) -> tuple[float, float]:
        """Time before and after the peak within which all of the energy but 1e-11 leaves the transmitter [ns]."""
        if self.shape == "gaussian":
            return 3 * self.fwhm_ns, 3 * self.fwhm_ns
        return -float(self.times_ns[0]), float(self.times_ns[-1])

    def cumulative(self, t_ns: ArrayLike) -> FloatArray:
        """Fraction of the energy that has left the transmitter by the times `t_ns` [ns]."""
        t = np.asarray(t_ns, dtype=np.float64)
        if self.shape == "gaussian":
            # The normal distribution function; scipy.special would take longer to import than a pass.
            erfc = np.vectorize(math.erfc, otypes=[np.float64])
            return np.asarray(0.5 * erfc(-t * FWHM_PER_SIGMA / self.fwhm_ns / np.sqrt(2)))
        return integral(self.times_ns, self.power, t)

    def kernel(self, bin_width_ns: float, response_time_ns: float = 0.0) -> tuple[int, FloatArray]:
        """Discrete impulse response of pulse and receiver for ideal echo histograms.

        Raises UserError if a number is out of range, or pulse and response have more than 10 million bins.

        `bin_width_ns`: bin width [ns], positive. `response_time_ns`: time constant tau of a causal single-pole response
        exp(-t/tau)/tau [ns]; 0 for none.

        Returns
        -------
        first_lag : int
            First weight's lag in bins, usually negative.
        weights : ndarray, shape (M,)
            weights[m] is the fraction of an echo in the centre of bin 0 that arrives in bin first_lag + m. They are
            exact integrals over the bins with the sum 1, truncated where less than 1e-10 lies outside.
        """
        dt = positive("bin_width_ns", bin_width_ns)
        tau = non_negative("response_time_ns", response_time_ns)
        if self.shape == "gaussian":
            start, end = -7 * self.fwhm_ns / FWHM_PER_SIGMA, 7 * self.fwhm_ns / FWHM_PER_SIGMA
        else:
            start, end = self.times_ns[0], self.times_ns[-1]
        first, last = int(np.floor(start / dt - 0.5)), int(np.ceil((end + 30 * tau) / dt + 0.5))
        if last - first > _MOST_BINS:
            raise UserError(f"bin_width_ns = {dt:g} is too short for the pulse: it would have {last - first:.3g} bins")
        edges = (np.arange(first, last + 2, dtype=np.float64) - 0.5) * dt
        arrived = self.cumulative(edges) if tau == 0 else self._response(edges, tau)
        kept = np.flatnonzero((arrived[1:] > _TAIL) & (arrived[:-1] < 1 - _TAIL))
        weights = np.maximum(np.diff(arrived)[kept[0] : kept[-1] + 1], 0)
        return first + int(kept[0]), weights / weights.sum()

    def _response(self, t: FloatArray, tau: float) -> FloatArray:
        """Cumulative energy after a single-pole response: F with tau F' = cumulative - F."""
        if self.shape == "gaussian":
            return _gaussian_response(t, self.fwhm_ns / FWHM_PER_SIGMA, tau)
        # On a segment C is quadratic and F = q + (F_0 - q_0) exp(-x/tau), q = C - tau C' + tau^2 C''.
        width = np.diff(self.times_ns)
        slope = np.diff(self.power) / width
        nodes = node_integrals(self.times_ns, self.power)
        q_start = nodes[:-1] - tau * self.power[:-1] + tau**2 * slope
        q_end = nodes[1:] - tau * self.power[1:] + tau**2 * slope
        decay = np.exp(-width / tau)
        at_node = np.zeros(nodes.size)
        for j in range(width.size):
            at_node[j + 1] = q_end[j] + (at_node[j] - q_start[j]) * decay[j]
        i, x = locate(self.times_ns, t)
        q = self.cumulative(t) - tau * (self.power[i] + slope[i] * x) + tau**2 * slope[i]
        inside = q + (at_node[i] - q_start[i]) * np.exp(-x / tau)
        late = np.maximum(t - self.times_ns[-1], 0)
        after = 1 + (at_node[-1] - 1) * np.exp(-late / tau)
        return np.where(t < self.times_ns[0], 0, np.where(late > 0, after, inside))


def waveform(energy: ArrayLike, bin_width_ns: float, kernel: tuple[int, FloatArray]) -> FloatArray:
    """Received power from ideal echo energies.

    Parameters
    ----------
    energy : array_like, shape (..., time)
        Energy per bin [J]; at least one bin.
    bin_width_ns : float
        Bin width [ns], positive, the kernel's.
    kernel : (int, ndarray)
        First lag and weights, from `Pulse.kernel`.

    Returns
    -------
    ndarray, shape (..., time)
        Mean power in each bin [W]. Energy that the kernel moves past either end of the time axis is lost.
    """
    seconds = positive("bin_width_ns", bin_width_ns) * 1e-9
    histogram = np.asarray(energy, dtype=np.float64)
    if histogram.ndim == 0 or histogram.shape[-1] == 0:
        raise UserError(f"energy of shape {histogram.shape} must have a time axis")
    first, weights = kernel
    count = histogram.shape[-1]
    lags = first + np.arange(weights.size)
    reached = np.abs(lags) < count
    lags, weights = lags[reached], weights[reached]
    # One convolution for all histograms, with zeros between them.
    padded = np.zeros((histogram.size // count, count + max(lags.size - 1, 0)))
    padded[:, :count] = histogram.reshape(-1, count)
    power = np.zeros((len(padded), count))
    if lags.size and len(padded):
        found = _convolved(padded, weights / seconds)
        start, end = max(lags[0], 0), min(count + lags[-1], count)
        power[:, start:end] = found[:, start - lags[0] : end - lags[0]]
    return power.reshape(histogram.shape)


def _convolved(padded: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the convolution of histograms that end in as many zeros as there are weights, but one."""
    if weights.size <= _LONGEST_DIRECT:
        return np.convolve(padded.ravel(), weights)[: padded.size].reshape(padded.shape)
    length = 1 << (padded.shape[1] - 1).bit_length()
    spectrum, found = np.fft.rfft(weights, length), np.empty_like(padded)
    for row, histogram in zip(found, padded, strict=True):
        unknown = np.isnan(histogram)
        row[:] = np.fft.irfft(np.fft.rfft(np.where(unknown, 0, histogram), length) * spectrum, length)[: histogram.size]
        # Rounding, of the largest power, must neither make power negative nor light bins that no energy reaches.
        if not np.any(histogram < 0):
            np.maximum(row, 0, out=row)
        row[~_reached(histogram != 0, weights.size)] = 0
        row[_reached(unknown, weights.size)] = np.nan
    return found


def _reached(sources: BoolArray, size: int) -> BoolArray:
    """Return the bins in which a kernel with some bins contains a share of any source."""
    known = np.concatenate([np.zeros(size, dtype=np.int64), np.cumsum(sources)])
    return np.asarray(known[size:] > known[: sources.size])


def _gaussian_response(t: FloatArray, sigma: float, tau: float) -> FloatArray:
    """Cumulative distribution of an exponentially modified Gaussian."""
    from scipy.special import erfcx, ndtr

    z = t / sigma - sigma / tau
    # exp(sigma^2/(2 tau^2) - t/tau) ndtr(z): its exponent overflows before the centre, erfcx after it.
    before = 0.5 * erfcx(np.maximum(-z, 0) / np.sqrt(2)) * np.exp(-0.5 * (t / sigma) ** 2)
    after = np.exp(-np.maximum(z, 0) * sigma / tau - 0.5 * (sigma / tau) ** 2) * ndtr(z)
    return np.asarray(ndtr(t / sigma) - np.where(z < 0, before, after))
