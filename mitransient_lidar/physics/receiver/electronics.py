"""Receiver electronics: amplifier with noise and bandwidth, logarithmic compression, and digitiser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import BOLTZMANN
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, integer, non_negative, positive

_TAIL = 1e-10  # fraction of a filter's response left out at its ends
_NODES = 48  # of the quadrature over a normal distribution within 8 standard deviations


class Expected(NamedTuple):
    """Mean and variance of samples and their probability of saturation, each of shape (..., sample)."""

    mean: FloatArray
    variance: FloatArray
    saturation: FloatArray


@dataclass(frozen=True)
class Amplifier:
    """Transimpedance amplifier or load resistor.

    Parameters
    ----------
    transimpedance_ohm : float
        Output voltage over input current [V/A], positive; load resistance times gain of a voltage amplifier.
    noise_pa_per_rthz : float
        White noise current density at the input, one-sided [pA/sqrt(Hz)], at least 0.
    load_ohm : float or None
        Resistance with the thermal noise 4 k T/R [ohm], positive; None for none.
    temperature_k : float
        Temperature of the resistance [K], at least 0.
    bandwidth_mhz : float or None
        Half-power frequency [MHz], positive; None for a bandwidth limited by the bins alone.
    response : {'single_pole', 'gaussian'}
        Shape of the low-pass: exp(-t/tau)/tau with tau = 1/(2 pi f), or a Gaussian without delay.
    limit_v : float or None
        Largest output of either sign [V], positive; None for no limit.

    Notes
    -----
    Thermal noise: J. B. Johnson and H. Nyquist, Phys. Rev. 32, 97 and 110 (1928), doi:10.1103/PhysRev.32.110.
    """

    transimpedance_ohm: float
    noise_pa_per_rthz: float = 0.0
    load_ohm: float | None = None
    temperature_k: float = 293.15
    bandwidth_mhz: float | None = None
    response: Literal["single_pole", "gaussian"] = "single_pole"
    limit_v: float | None = None

    def __post_init__(self) -> None:
        positive("transimpedance_ohm", self.transimpedance_ohm)
        for name in ("noise_pa_per_rthz", "temperature_k"):
            non_negative(name, getattr(self, name))
        for name in ("load_ohm", "bandwidth_mhz", "limit_v"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        if self.response not in ("single_pole", "gaussian"):
            raise UserError(f"response = {self.response!r} must be 'single_pole' or 'gaussian'")

    def white_noise(self, bin_width_ns: float) -> float:
        """Return the standard deviation [V] of the input noise, averaged over a bin, before the low-pass."""
        density = (1e-12 * self.noise_pa_per_rthz) ** 2
        if self.load_ohm is not None:
            density += 4 * BOLTZMANN * self.temperature_k / self.load_ohm
        return float(self.transimpedance_ohm * np.sqrt(density / (2e-9 * bin_width_ns)))

    def kernel(self, bin_width_ns: float) -> tuple[int, FloatArray]:
        """Return first lag and weights of the low-pass: the fraction of a charge in the middle of bin 0 in each bin."""
        if self.bandwidth_mhz is None:
            return 0, np.ones(1)
        if self.response == "single_pole":
            decay = bin_width_ns * 2e-3 * np.pi * self.bandwidth_mhz
            last = int(np.ceil(-np.log(_TAIL) / decay))
            edges = np.maximum(np.arange(last + 2) - 0.5, 0)
            return 0, _unit(-np.diff(np.exp(-edges * decay)))
        from scipy.special import ndtr

        sigma = np.sqrt(np.log(2)) / (2e-3 * np.pi * self.bandwidth_mhz) / bin_width_ns
        reach = int(np.ceil(6.5 * sigma))
        return -reach, _unit(np.diff(ndtr((np.arange(-reach, reach + 2) - 0.5) / sigma)))


@dataclass(frozen=True)
class LogAmplifier:
    """Logarithmic compression of voltages of either sign.

    The output is volts_per_decade asinh(v/(2 knee_v))/ln 10: volts_per_decade log10(v/knee_v) for v well above the
    knee, and smooth at 0, where noise makes the input negative.
    """

    volts_per_decade: float  #: Increase of the output per decade of the input [V], positive.
    knee_v: float  #: Input below which the output is linear [V], positive.

    def __post_init__(self) -> None:
        positive("volts_per_decade", self.volts_per_decade)
        positive("knee_v", self.knee_v)

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
class Digitiser:
    """Analogue-to-digital converter.

    Parameters
    ----------
    bits : int
        Resolution, 1 to 24.
    full_scale_v : float
        Width of the range [V], positive: 2^bits steps.
    low_v : float
        Voltage of code 0 [V].
    sampling_ghz : float or None
        Samples per ns, positive. The time between them must be an integer number of the record's bins; None for one
        sample per bin.

    Notes
    -----
    Rounding adds a variance of step^2/12 (W. R. Bennett, Bell Syst. Tech. J. 27, 446 (1948)) if the noise before it is
    at least about half a step; a steady signal with less noise has an error of up to half a step instead.
    """

    bits: int
    full_scale_v: float
    low_v: float = 0.0
    sampling_ghz: float | None = None

    def __post_init__(self) -> None:
        integer("bits", self.bits, 1, 24)
        positive("full_scale_v", self.full_scale_v)
        finite("low_v", self.low_v)
        if self.sampling_ghz is not None:
            positive("sampling_ghz", self.sampling_ghz)

    @property
    def step_v(self) -> float:
        """Voltage per code [V]."""
        return self.full_scale_v / (1 << self.bits)

    @property
    def top_v(self) -> float:
        """Voltage of the highest code [V]."""
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


@dataclass(frozen=True)
class Readout:
    """Stages behind the low-pass of an amplifier, which clip, compress and round voltages; None leaves one out."""

    limit_v: float | None = None  #: Largest voltage of either sign [V].
    logarithm: LogAmplifier | None = None
    digitiser: Digitiser | None = None

    @property
    def top_v(self) -> float:
        """Highest voltage before the logarithm that is not clipped [V]."""
        return self._limits()[0][1]

    def read(self, volts: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return the samples [V] for voltages [V], and where they are saturated."""
        clip, over = self._limits()
        saturated = (volts < over[0]) | (volts > over[1])
        samples = self._compressed(np.clip(volts, *clip))
        if self.digitiser is not None:
            low, step = self.digitiser.low_v, self.digitiser.step_v
            samples = low + step * np.rint((samples - low) / step)
        return samples, saturated

    def expected(self, mean: FloatArray, variance: FloatArray) -> Expected:
        """Return the moments of the samples for normally distributed voltages of a mean [V] and variance [V^2].

        Gauss-Legendre quadrature within the limits; clipped values are included.
        """
        from scipy.special import ndtr

        if self.limit_v is None and self.logarithm is None and self.digitiser is None:
            return Expected(mean, variance, np.zeros_like(mean))
        sigma = np.sqrt(variance)
        clip, over = self._limits()

        def below(edge: float) -> FloatArray:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.where(sigma > 0, ndtr((edge - mean) / sigma), mean < edge)

        # Moments about the sample of the mean, against cancellation.
        centre = self._compressed(np.clip(mean, *clip))
        first, second = np.zeros_like(mean), np.zeros_like(mean)
        for edge, fraction in ((clip[0], below(clip[0])), (clip[1], 1 - below(clip[1]))):
            distance = np.where(fraction > 0, self._compressed(np.asarray(edge)) - centre, 0)
            first, second = first + fraction * distance, second + fraction * distance**2
        start, end = (np.clip(edge, mean - 8 * sigma, mean + 8 * sigma) for edge in clip)
        width = np.where(sigma > 0, sigma, 1)
        for node, weight in zip(*np.polynomial.legendre.leggauss(_NODES), strict=True):
            volts = (start + end) / 2 + node * (end - start) / 2
            density = np.exp(-0.5 * ((volts - mean) / width) ** 2) / (width * np.sqrt(2 * np.pi))
            fraction = weight * (end - start) / 2 * density
            distance = self._compressed(volts) - centre
            first, second = first + fraction * distance, second + fraction * distance**2
        saturation = np.clip(below(over[0]) + 1 - below(over[1]), 0, 1)
        rounding = 0.0 if self.digitiser is None else self.digitiser.step_v**2 / 12
        return Expected(centre + first, np.maximum(second - first**2, 0) + rounding * (1 - saturation), saturation)

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


def filtered(record: FloatArray, weights: FloatArray) -> FloatArray:
    """Convolve records, shape (..., time), with N weights; the result has N - 1 bins less."""
    from scipy.signal import oaconvolve

    if weights.size == 1:
        return np.asarray(record * weights[0])
    return np.asarray(oaconvolve(record, weights.reshape((1,) * (record.ndim - 1) + (-1,)), mode="valid", axes=-1))


def _unit(weights: FloatArray) -> FloatArray:
    """Return weights of unit sum."""
    return np.asarray(weights / weights.sum())
