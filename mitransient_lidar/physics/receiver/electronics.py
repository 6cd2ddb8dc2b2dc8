"""Receiver electronics: amplifier with noise and bandwidth, logarithmic compression, and digitiser."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import BOLTZMANN
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Plan, positive_option
from mitransient_lidar.core.validation import FloatArray, finite_array
from mitransient_lidar.physics.piecewise_linear import integral

_TAIL = 1e-10  # fraction of a filter's response left out at its ends
#: Longest part of a bin, in time constants of the responses, for which steady light has its shot noise to 0.5 %.
_PART = {"single_pole": 0.25, "gaussian": 1 / 3}
_ENDS = 0.02  # largest value at the ends of a measured impulse response, relative to its peak
_MOST_SAMPLES = 2**16  # in a measured impulse response
_NODES = 48  # of the quadrature over a normal distribution within 8 standard deviations


class Expected(NamedTuple):
    """Sample mean, variance and saturation probability, each with the shape (..., sample)."""

    mean: FloatArray
    variance: FloatArray
    saturation: FloatArray


@dataclass(frozen=True)
class LowPass:
    """Amplifier response to charges in equal parts of the bins, sampled in the middle of each bin."""

    parts: int  #: Parts per bin, an even number, or 1 where a sample is its bin's mean.
    first: int  #: Parts from the end of the first weight's part to the middle of the bin; negative after it.
    weights: FloatArray  #: Weights of parts, from late to early parts, with unit sum.

    @property
    def before(self) -> int:
        """Number of bins before a sample's own on which it depends."""
        return max(math.ceil((self.weights.size + self.first - self.parts // 2) / self.parts), 0)

    @property
    def after(self) -> int:
        """Number of bins after a sample's own on which it depends."""
        return math.ceil((self.parts // 2 - self.first) / self.parts) - 1

    @property
    def start(self) -> int:
        """Part of a record, with `before` bins before it, that is the first on which sample 0 depends."""
        return self.before * self.parts + self.parts // 2 - self.first - self.weights.size

    def by_bin(self) -> tuple[int, FloatArray]:
        """Return the response to light in whole bins: bins before the first weight's sample, and weights."""
        part = self.parts // 2 - 1 - self.first - np.arange(self.weights.size) if self.parts > 1 else np.zeros(1, int)
        lag = -(part // self.parts)
        return int(lag[0]), np.asarray(np.bincount(lag - lag[0], self.weights), dtype=np.float64)

    def divided(self, record: FloatArray) -> FloatArray:
        """Return a record, shape (..., time), that contains in each part of a bin an equal part of its value."""
        return record if self.parts == 1 else np.repeat(record / self.parts, self.parts, axis=-1)

    def sampled(self, record: FloatArray, stride: int, weights: FloatArray | None = None) -> FloatArray:
        """Filter a record of parts, with `before` and `after`; return every `stride`-th sample.

        `weights` replace the response's own; N weights less need a record that is N parts shorter.
        """
        weights = self.weights if weights is None else weights
        # Bin by bin: the samples between bins are not computed.
        first, part = divmod(self.start, self.parts)
        bins = -(-(part + weights.size) // self.parts)
        of_parts = np.zeros(bins * self.parts)
        of_parts[part : part + weights.size] = weights[::-1]
        count = (record.shape[-1] - self.start - weights.size) // self.parts + 1
        used = record[..., first * self.parts : (first + count + bins - 1) * self.parts]
        lacking = (count + bins - 1) * self.parts - used.shape[-1]
        used = np.pad(used, [(0, 0)] * (record.ndim - 1) + [(0, lacking)]) if lacking else used
        by_lag = used.reshape(*used.shape[:-1], -1, self.parts) @ of_parts.reshape(bins, self.parts).T
        return np.asarray(sum(by_lag[..., lag : lag + count : stride, lag] for lag in range(bins)))


MEAN_OF_BINS = LowPass(1, -1, np.ones(1))  #: Without a low-pass a sample is the mean of its bin.


@dataclass(frozen=True)
class Amplifier(Plan):
    """Transimpedance amplifier or load resistor.

    A coupling capacitor removes steady light from the signal. An echo with charge Q leaves a baseline that is lower by
    R Q/coupling_ns and recovers as exp(-t/coupling_ns), in full where the echo itself is clipped. The capacitor changes
    neither the amplifier's noise nor the signal variance here; really the latter is less by about the low-pass response
    time over coupling_ns.

    Thermal noise: J. B. Johnson and H. Nyquist, Phys. Rev. 32, 97 and 110 (1928), doi:10.1103/PhysRev.32.110.
    """

    transimpedance_ohm: Annotated[
        float,
        positive_option("Output voltage over input current; load resistance times gain of a voltage amplifier", "V/A"),
    ]
    noise_pa_per_rthz: Annotated[
        float, Option("White noise current density at the input, one-sided", 0, unit="pA/sqrt(Hz)")
    ] = 0.0
    load_ohm: Annotated[
        float | None, positive_option("Resistance with the thermal noise 4 k T/R, None for none", "ohm")
    ] = None
    temperature_k: Annotated[float, Option("Temperature of the resistance", 0, unit="K")] = 293.15
    bandwidth_mhz: Annotated[
        float | None, positive_option("Half-power frequency, None for a bandwidth limited by the bins alone", "MHz")
    ] = None
    response: Annotated[
        Literal["single_pole", "gaussian"],
        Option("Shape of the low-pass: exp(-t/tau)/tau with tau = 1/(2 pi f), or a Gaussian without delay"),
    ] = "single_pole"
    limit_v: Annotated[float | None, positive_option("Largest output of either sign, None for no limit", "V")] = None
    impulse_response: Annotated[
        tuple[tuple[float, ...], tuple[float, ...]] | None,
        Option(
            "Measured response instead of a bandwidth: times after the light [ns], ascending, including 0, and "
            "values in any unit, linear between them, with positive area, and at either end within 2 % of their peak"
        ),
    ] = None
    coupling_ns: Annotated[
        float | None,
        positive_option("Time constant of the capacitor between detector and amplifier, None for DC coupling", "ns"),
    ] = None
    recovery_ns: Annotated[
        float | None,
        positive_option("Time for which the output stays at its limit after an overload, None for none", "ns"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.impulse_response is not None:
            if self.bandwidth_mhz is not None:
                raise UserError(f"bandwidth_mhz = {self.bandwidth_mhz:g} and an impulse_response are alternatives")
            _check_response(*self.impulse_response)

    def low_pass(self, bin_width_ns: float) -> LowPass:
        """Return the response to charges in parts of bins, short enough for the noise in steady light to 0.5 %."""
        if self.impulse_response is not None:
            return _measured(*self.impulse_response, bin_width_ns)
        if self.bandwidth_mhz is None:
            return MEAN_OF_BINS
        from scipy.special import ndtr

        scale = self._time_constant_ns()
        longest = _PART[self.response] * scale
        parts = 2 * math.ceil(bin_width_ns / (2 * longest))
        decay = bin_width_ns / parts / scale
        if self.response == "single_pole":
            edges = np.arange(int(np.ceil(-np.log(_TAIL) / decay)) + 1)
            return LowPass(parts, 0, _unit(-np.diff(np.exp(-edges * decay))))
        reach = int(np.ceil(6.5 / decay))
        return LowPass(parts, -reach, _unit(np.diff(ndtr(np.arange(-reach, reach + 1) * decay))))

    def coupled(self, volts: FloatArray, sample_ns: float) -> FloatArray:
        """Return voltages behind the coupling capacitor, if any.

        `volts`: voltages minus the steady-light voltage [V], 0 before the first sample, shape (..., sample).
        `sample_ns`: time between samples [ns].
        """
        from scipy.signal import lfilter

        if self.coupling_ns is None:
            return volts
        kept = math.exp(-sample_ns / self.coupling_ns)
        return np.asarray(volts - lfilter([(1 - kept) / 2, (1 - kept) / 2], [1, -kept], volts, axis=-1))

    def noise(self, bin_width_ns: float, stride: int = 1) -> tuple[float, FloatArray]:
        """Return the amplifier's own noise in samples that are `stride` bins apart.

        Returns `deviation`: standard deviation [V]: the density's, over the noise bandwidth of the low-pass. This is
        pi/2 times the half-power frequency for a single pole and sqrt(pi/ln 16) times it for a Gaussian, or without a
        low-pass half the inverse bin width. `weights`: weights, with unit sum of squares, that give independent normal
        numbers the samples' correlation.
        """
        density = (1e-12 * self.noise_pa_per_rthz) ** 2
        if self.load_ohm is not None:
            density += 4 * BOLTZMANN * self.temperature_k / self.load_ohm
        volts = self.transimpedance_ohm * math.sqrt(density)
        if self.impulse_response is not None:
            return _noise_of_measured(*self.impulse_response, volts, stride * bin_width_ns)
        if self.bandwidth_mhz is None:
            return volts * math.sqrt(0.5e9 / bin_width_ns), np.ones(1)
        step = stride * bin_width_ns / self._time_constant_ns()
        if self.response == "single_pole":
            powers = np.exp(-step * np.arange(math.ceil(-math.log(_TAIL) / step) + 1))
            return volts * math.sqrt(0.5e6 * math.pi * self.bandwidth_mhz), _normal(powers)
        lags = np.arange(math.ceil(12 / step) + 1)
        weights = _weights_of_correlation(np.exp(-0.25 * (lags * step) ** 2))
        return volts * math.sqrt(1e6 * math.sqrt(math.pi / math.log(16)) * self.bandwidth_mhz), weights

    def _time_constant_ns(self) -> float:
        """Time constant of the single pole, or standard deviation of the Gaussian response."""
        assert self.bandwidth_mhz is not None
        factor = 1.0 if self.response == "single_pole" else math.sqrt(math.log(2))
        return factor / (2e-3 * math.pi * self.bandwidth_mhz)


@dataclass(frozen=True)
class LogAmplifier(Plan):
    """Logarithmic compression for voltages of either sign.

    The output is volts_per_decade asinh(v/(2 knee_v))/ln 10: volts_per_decade log10(v/knee_v) for v well above the
    knee. It is smooth at 0, where noise makes the input negative.
    """

    volts_per_decade: Annotated[float, positive_option("Output increase per input decade", "V")]
    knee_v: Annotated[float, positive_option("Input below which the output is linear", "V")]

    def compress(self, volts: FloatArray) -> FloatArray:
        """Return the output [V] for an input [V]."""
        return np.asarray(self.volts_per_decade / np.log(10) * np.arcsinh(volts / (2 * self.knee_v)))

    def expand(self, volts: npt.ArrayLike) -> FloatArray:
        """Return the input [V] for an output [V]."""
        output = np.asarray(volts, dtype=np.float64)
        with np.errstate(over="ignore"):
            return np.asarray(2 * self.knee_v * np.sinh(output * np.log(10) / self.volts_per_decade))

    def expansion(self, volts: npt.ArrayLike) -> FloatArray:
        """Return the derivative of the input with respect to the output, at an output [V]."""
        rate = np.log(10) / self.volts_per_decade
        return np.asarray(2 * self.knee_v * rate * np.cosh(np.asarray(volts, dtype=np.float64) * rate))


@dataclass(frozen=True)
class Digitiser(Plan):
    """Analogue-to-digital converter.

    Rounding adds a variance of step^2/12 (W. R. Bennett, Bell Syst. Tech. J. 27, 446 (1948)) if the preceding noise is
    at least about half a step. A steady signal with less noise has an error of up to half a step instead.
    """

    bits: Annotated[int, Option("Resolution", 1, 24)]
    full_scale_v: Annotated[float, positive_option("Range width: 2^bits steps", "V")]
    low_v: Annotated[float, Option("Voltage of code 0", unit="V")] = 0.0
    sampling_ghz: Annotated[
        float | None,
        positive_option(
            "Samples per ns, the time between which must be an integer number of the record's bins; None for one a bin",
            "GHz",
        ),
    ] = None
    block_threshold_v: Annotated[
        float | None,
        positive_option(
            "Height above the level without light from which samples start a block that is stored, None to store all",
            "V",
        ),
    ] = None
    block_before: Annotated[int, Option("Samples stored before those above the threshold", 0, 100_000)] = 0
    block_after: Annotated[int, Option("Samples stored after those above the threshold", 0, 100_000)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("block_before", "block_after"):
            if (number := getattr(self, name)) and self.block_threshold_v is None:
                raise UserError(f"{name} = {number} needs block_threshold_v, above which blocks are stored")

    @property
    def step_v(self) -> float:
        """Voltage per code [V]."""
        return self.full_scale_v / (1 << self.bits)

    @property
    def top_v(self) -> float:
        """Highest code's voltage [V]."""
        return self.low_v + self.full_scale_v - self.step_v

    def stride(self, bin_width_ns: float) -> int:
        """Return the number of bins between samples, for a bin width in ns."""
        if self.sampling_ghz is None:
            return 1
        bins = 1 / (self.sampling_ghz * bin_width_ns)
        if round(bins) < 1 or abs(bins - round(bins)) > 1e-6 * bins:
            raise UserError(
                f"sampling_ghz = {self.sampling_ghz:g} must give an integer number of bins of {bin_width_ns:g} ns "
                f"between samples, not {bins:.6g}"
            )
        return round(bins)

    def stored(self, samples: npt.NDArray[np.floating], dark: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which samples [V], shape (..., sample), are stored, for levels without light [V] that broadcast."""
        if self.block_threshold_v is None:
            return np.ones(np.shape(samples), np.bool_)
        above = samples > dark + self.block_threshold_v
        count = above.shape[-1]
        passed = np.zeros((*above.shape[:-1], count + 1), np.int32)
        np.cumsum(above, axis=-1, out=passed[..., 1:])
        place = np.arange(count)
        first, last = np.maximum(place - self.block_after, 0), np.minimum(place + self.block_before, count - 1)
        return np.asarray(passed[..., last + 1] > passed[..., first])


@dataclass(frozen=True)
class Readout:
    """Stages behind the low-pass of an amplifier, which clip, compress and round voltages; None leaves one out."""

    limit_v: float | None = None  #: Largest voltage of either sign [V].
    logarithm: LogAmplifier | None = None
    digitiser: Digitiser | None = None
    hold: int = 0  #: Samples for which the output stays at `limit_v` after an overload.

    @property
    def top_v(self) -> float:
        """Highest voltage before the logarithm that is not clipped [V]."""
        return self._limits()[0][1]

    def read(self, volts: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return the samples [V] for voltages [V], and where they are saturated."""
        clip, over = self._limits()
        if self.hold and self.limit_v is not None:
            held = _before(volts > self.limit_v, self.hold)
            # Beyond every limit, so that held samples are saturated.
            volts = np.where(held, np.inf, volts)
        saturated = (volts < over[0]) | (volts > over[1])
        samples = self._compressed(np.clip(volts, *clip))
        if self.digitiser is not None:
            low, step = self.digitiser.low_v, self.digitiser.step_v
            samples = low + step * np.rint((samples - low) / step)
        return samples, saturated

    def expected(self, mean: FloatArray, variance: FloatArray) -> Expected:
        """Return the sample moments for normally distributed voltages with a mean [V] and variance [V^2].

        Closed forms without a logarithm, Gauss-Legendre quadrature with one; clipped values are included. Samples that
        an overload may hold at the limit are taken as held with the largest probability of an overload in the time
        before.
        """
        from scipy.special import ndtr

        if self.limit_v is None and self.logarithm is None and self.digitiser is None:
            return Expected(mean, variance, np.zeros_like(mean))
        sigma = np.sqrt(variance)
        clip, over = self._limits()

        def below(edge: float) -> FloatArray:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.where(sigma > 0, ndtr((edge - mean) / sigma), mean < edge)

        # Moments about the mean's sample, against cancellation.
        centre = self._compressed(np.clip(mean, *clip))
        first, second = np.zeros_like(mean), np.zeros_like(mean)
        ends = below(clip[0]), 1 - below(clip[1])
        for edge, fraction in zip(clip, ends, strict=True):
            distance = np.where(fraction > 0, self._compressed(np.asarray(edge)) - centre, 0)
            first, second = first + fraction * distance, second + fraction * distance**2
        start, end = (np.clip(edge, mean - 8 * sigma, mean + 8 * sigma) for edge in clip)
        width = np.where(sigma > 0, sigma, 1)

        def density(volts: FloatArray) -> FloatArray:
            return np.asarray(np.exp(-0.5 * ((volts - mean) / width) ** 2) / (width * np.sqrt(2 * np.pi)))

        if self.logarithm is None:
            # Moments of a truncated normal distribution.
            within, offset = 1 - ends[0] - ends[1], mean - centre
            low, high = (variance * density(edge) for edge in (start, end))
            first = first + within * offset + low - high
            second = second + within * (offset**2 + variance) + 2 * offset * (low - high)
            second = second + (start - mean) * low - (end - mean) * high
        else:
            for node, weight in zip(*np.polynomial.legendre.leggauss(_NODES), strict=True):
                volts = (start + end) / 2 + node * (end - start) / 2
                fraction = weight * (end - start) / 2 * density(volts)
                distance = self._compressed(volts) - centre
                first, second = first + fraction * distance, second + fraction * distance**2
        saturation = np.clip(below(over[0]) + 1 - below(over[1]), 0, 1)
        rounding = 0.0 if self.digitiser is None else self.digitiser.step_v**2 / 12
        plain = Expected(centre + first, np.maximum(second - first**2, 0) + rounding * (1 - saturation), saturation)
        if self.hold == 0 or self.limit_v is None:
            return plain
        held = _before(1 - below(self.limit_v), self.hold)
        height = self._compressed(np.asarray(clip[1])) - plain.mean
        return Expected(
            plain.mean + held * height,
            (1 - held) * plain.variance + held * (1 - held) * height**2,
            held + (1 - held) * saturation,
        )

    def _compressed(self, volts: FloatArray) -> FloatArray:
        """Apply the logarithm, if any."""
        return volts if self.logarithm is None else self.logarithm.compress(volts)

    def _limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of clipping, and limits beyond which samples count as saturated [V]."""
        rail = np.inf if self.limit_v is None else self.limit_v
        clip, over = np.array([-rail, rail]), np.array([-rail, rail])
        if self.digitiser is not None:
            codes = np.array([self.digitiser.low_v, self.digitiser.top_v])
            beyond = codes + np.array([-0.5, 0.5]) * self.digitiser.step_v
            if self.logarithm is not None:
                codes, beyond = self.logarithm.expand(codes), self.logarithm.expand(beyond)
            clip, over = np.clip(codes, -rail, rail), np.clip(beyond, -rail, rail)
        return (float(clip[0]), float(clip[1])), (float(over[0]), float(over[1]))


def _before(values: npt.NDArray[Any], samples: int) -> npt.NDArray[Any]:
    """Return the largest of some values before each one, 0 where there are none; shape (..., sample)."""
    ends = [(0, 0)] * (values.ndim - 1) + [(samples, 0)]
    earlier = np.pad(values, ends)[..., :-1]
    return np.asarray(np.lib.stride_tricks.sliding_window_view(earlier, samples, axis=-1).max(axis=-1))


def _check_response(times: tuple[float, ...], values: tuple[float, ...]) -> None:
    """Refuse an impulse response that is not one."""
    t, h = finite_array("impulse_response", times), finite_array("impulse_response", values)
    if t.shape != h.shape or t.ndim != 1 or t.size < 3 or np.any(np.diff(t) <= 0):
        raise UserError("impulse_response must have at least 3 samples at ascending times")
    if t[0] > 0 or t[-1] <= 0:
        raise UserError(
            f"impulse_response is from {t[0]:g} to {t[-1]:g} ns: its times must hold 0, the arrival of the light"
        )
    ends = max(abs(h[0]), abs(h[-1])) / max(float(np.abs(h).max()), 1e-300)
    if ends > _ENDS:
        raise UserError(f"impulse_response is {100 * ends:.2g} % of its peak at an end, where it must be 0 within 2 %")
    if _area(t, h) <= 0:
        raise UserError("impulse_response must have a positive area")


def _area(t: FloatArray, h: FloatArray) -> float:
    """Return the area below samples."""
    return float(np.sum(0.5 * (h[1:] + h[:-1]) * np.diff(t)))


def _measured(times: tuple[float, ...], values: tuple[float, ...], bin_width_ns: float) -> LowPass:
    """Return the low-pass of a measured response: its integrals over parts of bins."""
    t, h = np.asarray(times), np.asarray(values)
    width = _area(t, h) / float(np.abs(h).max())
    parts = 2 * math.ceil(bin_width_ns / (2 * _PART["gaussian"] * width))
    part = bin_width_ns / parts
    first, last = math.floor(t[0] / part), math.ceil(t[-1] / part)
    edges = np.arange(first, last + 1) * part
    return LowPass(parts, first, _unit(np.diff(integral(t, h, edges))))


def _noise_of_measured(
    times: tuple[float, ...], values: tuple[float, ...], volts: float, step_ns: float
) -> tuple[float, FloatArray]:
    """Return the deviation [V], for a density [V/sqrt(Hz)], and the weights of noise behind a measured response."""
    t, h = np.asarray(times), np.asarray(values)
    h = h / _area(t, h)
    fine = min(float(np.diff(t).min()), step_ns) / 4
    fine = max(fine, (t[-1] - t[0]) / _MOST_SAMPLES)
    even = np.interp(np.arange(t[0], t[-1] + fine, fine), t, h)
    shifts = np.arange(math.ceil((t[-1] - t[0]) / step_ns) + 1) * step_ns / fine
    size = even.size
    powers = np.abs(np.fft.rfft(even, 2 * size)) ** 2
    correlation = np.interp(shifts, np.arange(size), np.fft.irfft(powers)[:size], right=0.0)
    # Half the one-sided density over both signs of the frequency, and 1e9 ns in a second.
    return volts * math.sqrt(0.5e9 * correlation[0] * fine), _weights_of_correlation(correlation)


def _weights_of_correlation(correlation: FloatArray) -> FloatArray:
    """Return weights whose correlation is given at lags from 0: their spectrum is the root of its spectrum."""
    spectrum = np.fft.rfft(np.concatenate([correlation, correlation[:0:-1]]))
    return _normal(np.fft.fftshift(np.fft.irfft(np.sqrt(np.maximum(spectrum.real, 0)), 2 * correlation.size - 1)))


def filtered(record: FloatArray, weights: FloatArray) -> FloatArray:
    """Convolve records, shape (..., time), with N weights; the result has N - 1 bins less."""
    from scipy.signal import oaconvolve

    if weights.size == 1:
        return np.asarray(record * weights[0])
    return np.asarray(oaconvolve(record, weights.reshape((1,) * (record.ndim - 1) + (-1,)), mode="valid", axes=-1))


def _unit(weights: FloatArray) -> FloatArray:
    """Return weights with unit sum."""
    return np.asarray(weights / weights.sum())


def _normal(weights: FloatArray) -> FloatArray:
    """Return weights with unit sum of squares."""
    return np.asarray(weights / np.sqrt(np.sum(weights**2)))
