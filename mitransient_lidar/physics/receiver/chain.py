"""Receiver chains, from the optical power on a detector to recorded samples with noise.

Powers are means over time bins; before and after a record there is only the background, such as
`clear_sky.background_power`.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import ELEMENTARY_CHARGE
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.processors import usable_processors
from mitransient_lidar.core.validation import FloatArray, integer, non_negative_array, positive
from mitransient_lidar.physics.receiver import detectors, electronics
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter, delayed

_BLOCK = 2**20  # samples drawn at a time, which limits the memory of a thread
_RARE = 1e-3  # share of records in which a single event is higher than stated
_OVERLAPPING = 3.0  # events in a bin above which they overlap
_HEADROOM = 6.0  # standard deviations of noise below the upper limit of samples in range
_STRONGEST = 16  # records that a gain or an attenuation is fitted to
_DARKEST = math.log(1e12)  # largest attenuation that is tried
_MOST_STEPS, _IN_RANGE = 20, 1e-9  # steps of fitting a gain, and the relative excess at which they end


class Record(NamedTuple):
    """Samples of shots, shape (shots, ..., sample): `signal` in 32 bits, and whether it is `saturated`."""

    signal: npt.NDArray[np.float32]
    saturated: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ReceiverChain:
    """Receiver stages, in signal order.

    Raises UserError if the stages do not fit together.

    Mean and variance are exact up to the amplifier. For logarithm, saturation and rounding a sample is assumed to be
    normally distributed. This holds where the amplifier's noise or tens of photoelectrons within its response dominate.
    With a logarithm and less than one photoelectron, errors of 0.05 standard deviations in the mean and of a third in
    the variance were found. The shots themselves (`apply`) make no such assumption.

    Only drawn shots have jitter. Closed forms describe a shot with mean energy at its nominal time.
    """

    detector: detectors.Detector  #: A `SinglePhotonDetector` outputs counts and takes no further stages.
    amplifier: electronics.Amplifier | None = None  #: None for an output of charge in electrons per bin.
    logarithm: electronics.LogAmplifier | None = None  #: It requires an amplifier.
    digitiser: electronics.Digitiser | None = None  #: It requires an amplifier.
    wavelength_nm: float = 532.0  #: Vacuum wavelength [nm], positive.
    source: str = ""  #: Source of the numbers.
    jitter: ShotJitter | None = None  #: Energy and time jitter of the shots; None for none.

    def __post_init__(self) -> None:
        positive("wavelength_nm", self.wavelength_nm)
        for name in ("logarithm", "digitiser"):
            if self.amplifier is None and getattr(self, name) is not None:
                raise UserError(f"{name} needs an amplifier, which converts the charge to a voltage")
        if self.amplifier is not None and isinstance(self.detector, detectors.SinglePhotonDetector):
            raise UserError("amplifier must be None behind a SinglePhotonDetector, which outputs counts")
        if self.amplifier is not None and self.amplifier.recovery_ns is not None and self._limit_v() is None:
            raise UserError(
                f"recovery_ns = {self.amplifier.recovery_ns:g} needs a limit_v of the amplifier, or a "
                "largest_current_ma of the detector, from which it recovers"
            )

    @property
    def units(self) -> str:
        """Unit of the samples: 'V', or '1' for electrons and counts per bin."""
        return "1" if self.amplifier is None else "V"

    def stride(self, bin_width_ns: float) -> int:
        """Return the number of bins between samples, for a bin width in ns; sample i is taken in bin i stride."""
        return 1 if self.digitiser is None else self.digitiser.stride(positive("bin_width_ns", bin_width_ns))

    @property
    def forgets_light(self) -> bool:
        """Whether samples depend only on light within the low-pass and the time of the shot is certain."""
        recovers = self.amplifier is not None and not (
            self.amplifier.coupling_ns is None and self.amplifier.recovery_ns is None
        )
        linear = isinstance(self.detector, detectors.LinearDetector) and not self.detector.tail_fractions
        return linear and not recovers and self.jitter is None

    def apply(
        self,
        power: npt.ArrayLike,
        bin_width_ns: float,
        shots: int,
        seed: int,
        background: npt.ArrayLike = 0.0,
        *,
        series: bool = False,
        common_seed: int | None = None,
    ) -> Record:
        """Draw independent shots.

        Returns the signal in `units`, and whether amplifier or digitiser are saturated.

        `power`, shape (..., time): mean optical power of the signal on the detector in each bin [W], not negative.
        `bin_width_ns`: bin width [ns], positive. `shots`: number of shots, 1 to 10^9. `seed`: seed of the random
        numbers, 0 to 2^63 - 1. The same arguments give the same samples on any number of cores. `background`: constant
        power added to the signal [W], not negative: a number, or one for each record. `series`: whether the first power
        axis counts different pulses, each with its own energy and trigger. All other records are channels that share a
        shot's energy and trigger. `common_seed`: seed of energy and trigger, by default `seed`: the same one for
        channels that are drawn one by one.
        """
        light, sky = self._light(power, bin_width_ns, background)
        number, start = integer("shots", shots, 1, 10**9), integer("seed", seed, 0, 2**63 - 1)
        stride = self.stride(bin_width_ns)
        shape = number, len(light), -(-light.shape[-1] // stride)
        record = Record(np.empty(shape, np.float32), np.empty(shape, np.bool_))
        low_pass = self.low_pass(bin_width_ns)
        length = low_pass.parts * (light.shape[-1] + low_pass.before + low_pass.after)
        some = max(1, min(_BLOCK // length, len(light)))
        size = max(1, _BLOCK // (some * length))
        blocks = [(i, j) for i in range(0, number, size) for j in range(0, len(light), some)]
        seeds = np.random.SeedSequence(start).spawn(len(blocks))
        jitter = None
        if self.jitter is not None:
            records = np.shape(power)[:-1]
            drawn = self.jitter.draw(number, records, series, start, start if common_seed is None else common_seed)
            jitter = tuple(one.reshape(number, -1) for one in drawn)

        def draw(block: int) -> None:
            i, j = blocks[block]
            own = slice(i, min(i + size, number)), slice(j, j + some)
            random = np.random.default_rng(seeds[block])
            part = bin_width_ns / low_pass.parts
            if jitter is None:
                events = self.events(light[own[1]], bin_width_ns, sky[own[1]])
                charge = self.detector.sample(events, part, own[0].stop - i, random)
            else:
                energy, delay = (one[own] for one in jitter)
                shifted = energy[..., np.newaxis] * delayed(light[own[1]], delay / bin_width_ns)
                charge = self.detector.sample(self.events(shifted, bin_width_ns, sky[own[1]]), part, 1, random)[0]
            record.signal[own], record.saturated[own] = self._process(charge, bin_width_ns, sky[own[1]], random)

        with ThreadPoolExecutor(min(len(blocks), usable_processors(), 8)) as pool:
            for _ in pool.map(draw, range(len(blocks))):
                pass
        whole = number, *np.shape(power)[:-1], shape[-1]
        return Record(record.signal.reshape(whole), record.saturated.reshape(whole))

    def expected(
        self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike = 0.0
    ) -> electronics.Expected:
        """Return mean, variance and saturation probability of the samples in closed form, in `units`.

        Arguments as for `apply`.
        """
        mean, variance = self._unlimited(power, bin_width_ns, background)
        if self.amplifier is None:
            return electronics.Expected(mean, variance, np.zeros_like(mean))
        return self.readout(bin_width_ns).expected(mean, variance)

    def with_gain(self, factor: float) -> ReceiverChain:
        """Return the chain with another gain, by a photomultiplier's dynodes or the amplifier of other detectors.

        Raises UserError if the factor is not positive, there is no amplifier, or dynodes would cease to amplify.
        """
        if self.amplifier is None:
            raise UserError(f"gain = {factor:g} needs an amplifier, which this receiver lacks")
        if isinstance(self.detector, detectors.LinearDetector) and self.detector.dynode_gains:
            return replace(self, detector=self.detector.with_gain(factor))
        ohm = self.amplifier.transimpedance_ohm * positive("gain", factor)
        return replace(self, amplifier=replace(self.amplifier, transimpedance_ohm=ohm))

    def fitting_gain(
        self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike = 0.0, samples: slice = slice(None)
    ) -> float:
        """Return the largest factor of the gain, at most 1, that keeps samples in range; see `with_gain`.

        Samples are in range with 6 standard deviations of noise below the upper limit of tube, amplifier and digitiser.
        Only `samples` count. Other arguments as for `apply`. The factor is 1 without an amplifier or a limit, and 0
        where a photomultiplier's dynodes would have to attenuate.
        """
        factor, chain = 1.0, self
        light, sky = self._light(power, bin_width_ns, background)
        # Behind a photomultiplier, the noise of the amplifier stays and the excess noise grows.
        for step in range(_MOST_STEPS):
            if chain.amplifier is None or not math.isfinite(top := chain.readout(bin_width_ns).top_v):
                break
            highest = chain._highest(light, bin_width_ns, sky, samples)
            if highest.max() <= top * (1 + _IN_RANGE):
                break
            factor *= top / float(highest.max())
            try:
                chain = self.with_gain(factor)
            except UserError:
                return 0.0
            if step == 0:
                strongest = np.argsort(highest)[-_STRONGEST:]
                light, sky = light[strongest], sky[strongest]
        return factor

    def without_brightest(
        self, power: FloatArray, bin_width_ns: float, background: FloatArray, count: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return powers, shape (shots, ..., time), and backgrounds, shape (shots, ...), without the brightest shots.

        These are the `count` shots whose records have the highest voltages.
        """
        if count == 0 or self.amplifier is None:
            return power, background
        highest = self._highest(power, bin_width_ns, background).reshape(len(power), -1).max(axis=1)
        kept = np.sort(np.argsort(highest, kind="stable")[: len(power) - count])
        return power[kept], background[kept]

    def fitting_attenuation(self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike = 0.0) -> float:
        """Return the least factor, at least 1, by which light must be attenuated for samples in range.

        Signal and background are attenuated alike. In range is as for `fitting_gain`; infinite if the noise alone
        exceeds the range. Arguments as for `apply`.
        """
        from scipy.optimize import brentq

        if self.amplifier is None or not math.isfinite(top := self.readout(bin_width_ns).top_v):
            return 1.0
        light = np.asarray(power, dtype=np.float64)
        sky = np.broadcast_to(np.asarray(background, dtype=np.float64), light.shape[:-1]).ravel()
        light = light.reshape(-1, light.shape[-1])
        highest = self._highest(light, bin_width_ns, sky)
        strongest = np.argsort(highest)[-_STRONGEST:]
        light, sky = light[strongest], sky[strongest]

        def excess(log: float) -> float:
            least = math.exp(-log)
            return float(self._highest(least * light, bin_width_ns, least * sky).max()) / top - 1

        if excess(0.0) <= 0:
            return 1.0
        return math.inf if excess(_DARKEST) > 0 else math.exp(brentq(excess, 0.0, _DARKEST, xtol=1e-6))

    def _highest(
        self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike, samples: slice = slice(None)
    ) -> FloatArray:
        """Return the highest voltage of each record without limits, with headroom for noise [V], shape (...)."""
        mean, variance = self._unlimited(power, bin_width_ns, background)
        return np.asarray((mean + _HEADROOM * np.sqrt(variance))[..., samples].max(axis=-1))

    def _unlimited(
        self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance of the samples before clipping, logarithm and rounding."""
        light, sky = self._light(power, bin_width_ns, background)
        low_pass, stride = self.low_pass(bin_width_ns), self.stride(bin_width_ns)
        some = max(1, _BLOCK * 8 // (low_pass.parts * light.shape[-1] * low_pass.weights.size))
        parts = [
            self._filtered_moments(light[i : i + some], bin_width_ns, sky[i : i + some], stride)
            for i in range(0, len(light), some)
        ]
        shape = *np.shape(power)[:-1], -1
        mean, variance = (np.concatenate(part).reshape(shape) for part in zip(*parts, strict=True))
        return mean, variance if self.amplifier is None else variance + self.amplifier.noise(bin_width_ns)[0] ** 2

    def event_height(self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike = 0.0) -> FloatArray:
        """Return the height in the samples that a single event exceeds in one of a thousand records, shape (...).

        Events come from light and dark counts; where many overlap, only a few in each bin count. Their charges are
        gamma-distributed, as in `LinearDetector`. 1 for photon counters; 0 for other detectors without an amplifier, or
        where events are rarer.
        """
        from scipy.stats import gamma

        light, sky = self._light(power, bin_width_ns, background)
        if isinstance(self.detector, detectors.SinglePhotonDetector):
            return np.ones(np.shape(power)[:-1])
        if self.amplifier is None:
            return np.zeros(np.shape(power)[:-1])
        low_pass = self.low_pass(bin_width_ns)
        events = self.events(light, bin_width_ns, sky)
        number = np.minimum(events, _OVERLAPPING / low_pass.parts).sum(axis=-1)
        spread = max(self.detector.charge_spread, 1e-6)
        rare = np.clip(_RARE / np.maximum(number, 1e-12), 0, 1)
        charge = np.where(rare < 1, gamma.isf(rare, 1 / spread, scale=spread), 0.0) * self.detector.gain
        peak = float(low_pass.weights.max()) * self.volts_per_electron(bin_width_ns)
        return (charge * peak).reshape(np.shape(power)[:-1])

    def snr(
        self,
        power: npt.ArrayLike,
        bin_width_ns: float,
        background: npt.ArrayLike = 0.0,
        lit: electronics.Expected | None = None,
    ) -> FloatArray:
        """Return the samples' signal-to-noise ratio in one shot, shape (..., sample).

        The mean excess over the mean without signal is divided by the standard deviation with signal. The result is 0
        without signal, infinite without noise, and NaN where most samples are saturated. For the mean of n shots the
        ratio is sqrt(n) times larger. `lit` is the result of `expected` for the other arguments, if known; arguments as
        for `apply`.
        """
        if lit is None:
            lit = self.expected(power, bin_width_ns, background)
        # Records with one background share the result without signal.
        sky = np.broadcast_to(non_negative_array("background", background), np.shape(power)[:-1])
        levels, level = np.unique(sky, return_inverse=True)
        dark = self.expected(np.zeros((levels.size, np.shape(power)[-1])), bin_width_ns, levels)
        rise = lit.mean - dark.mean[level.reshape(sky.shape)]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(rise == 0, 0, rise / np.sqrt(lit.variance))
        return np.where(lit.saturation > 0.5, np.nan, ratio)

    def low_pass(self, bin_width_ns: float) -> electronics.LowPass:
        """Return the response of the amplifier, if any, for a bin width [ns]."""
        return electronics.MEAN_OF_BINS if self.amplifier is None else self.amplifier.low_pass(bin_width_ns)

    def events(self, power: FloatArray, bin_width_ns: float, background: FloatArray) -> FloatArray:
        """Return mean primary events in parts of bins, plus the parts before and after that the low-pass needs.

        Events in the detector's tail are included. Powers [W] have the shape (..., time), backgrounds [W] the shape
        (...).
        """
        low_pass = self.low_pass(bin_width_ns)
        ends = [(0, 0)] * (power.ndim - 1) + [(low_pass.before, low_pass.after)]
        photons = (
            (np.pad(power, ends) + background[..., None])
            * 1e-9
            * bin_width_ns
            * detectors.photons_per_joule(self.wavelength_nm)
        )
        part = bin_width_ns / low_pass.parts
        events = self.detector.event_means(low_pass.divided(photons), part)
        if not self.detector.tail_fractions:
            return events
        return self.detector.with_tail(events, self._steady_events(bin_width_ns, background), part)

    def _steady_events(self, bin_width_ns: float, background: FloatArray) -> FloatArray:
        """Return mean primary events by background [W] and dark current in a part of a bin, shape (..., 1)."""
        parts = self.low_pass(bin_width_ns).parts
        photons = background[..., None] * 1e-9 * bin_width_ns * detectors.photons_per_joule(self.wavelength_nm) / parts
        return self.detector.event_means(photons, bin_width_ns / parts)

    def _light(
        self, power: npt.ArrayLike, bin_width_ns: float, background: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Return checked powers, shape (record, time), and backgrounds, shape (record,)."""
        signal, sky = non_negative_array("power", power), non_negative_array("background", background)
        positive("bin_width_ns", bin_width_ns)
        if signal.ndim == 0 or signal.size == 0:
            raise UserError(f"power of shape {signal.shape} must have a time axis and values")
        if sky.shape not in ((), signal.shape[:-1]):
            raise UserError(f"background of shape {sky.shape} must be a number or of shape {signal.shape[:-1]}")
        return signal.reshape(-1, signal.shape[-1]), np.broadcast_to(sky, signal.shape[:-1]).ravel()

    def _filtered_moments(
        self, power: FloatArray, bin_width_ns: float, background: FloatArray, stride: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of the detector's signal in the samples: charges, or volts after an amplifier."""
        low_pass = self.low_pass(bin_width_ns)
        weights = low_pass.weights
        events = self.events(power, bin_width_ns, background)
        charge, covariances = self.detector.moments(events, bin_width_ns / low_pass.parts, weights.size)
        variance = low_pass.sampled(covariances[0], stride, weights**2)
        for lag, covariance in enumerate(covariances[1:], 1):
            variance += 2 * low_pass.sampled(covariance, stride, weights[:-lag] * weights[lag:])
        volts = 1.0 if self.amplifier is None else self.volts_per_electron(bin_width_ns)
        mean = self.coupled(low_pass.sampled(charge, stride) * volts, bin_width_ns, background)
        return mean, np.maximum(variance, 0) * volts**2

    def coupled(self, volts: FloatArray, bin_width_ns: float, background: FloatArray) -> FloatArray:
        """Return samples of the detector's signal [V], shape (..., sample), after the coupling capacitor, if any.

        Backgrounds [W] have the shape (...), or the shape of its last axes.
        """
        if self.amplifier is None or self.amplifier.coupling_ns is None:
            return volts
        low_pass = self.low_pass(bin_width_ns)
        events = self.events(np.zeros((*background.shape, 1)), bin_width_ns, background)
        charge, _ = self.detector.moments(events, bin_width_ns / low_pass.parts, 1)
        steady = low_pass.sampled(charge, 1) * self.volts_per_electron(bin_width_ns)
        return self.amplifier.coupled(volts - steady, bin_width_ns * self.stride(bin_width_ns))

    def volts_per_electron(self, bin_width_ns: float) -> float:
        """Mean voltage over a part of a bin per electron in it."""
        assert self.amplifier is not None
        width = bin_width_ns / self.low_pass(bin_width_ns).parts
        return self.amplifier.transimpedance_ohm * ELEMENTARY_CHARGE / (1e-9 * width)

    def readout(self, bin_width_ns: float) -> electronics.Readout:
        """Return the stages behind the low-pass and the coupling."""
        assert self.amplifier is not None
        recovery = self.amplifier.recovery_ns or 0.0
        hold = math.ceil(recovery / (bin_width_ns * self.stride(bin_width_ns)) - 1e-9)
        return electronics.Readout(self._limit_v(), self.logarithm, self.digitiser, hold)

    def _limit_v(self) -> float | None:
        """Return the largest voltage of amplifier and detector, or None."""
        assert self.amplifier is not None
        limits = [] if self.amplifier.limit_v is None else [self.amplifier.limit_v]
        if isinstance(self.detector, detectors.LinearDetector) and math.isfinite(self.detector.largest_current_ma):
            limits.append(1e-3 * self.detector.largest_current_ma * self.amplifier.transimpedance_ohm)
        return min(limits, default=None)

    def _process(
        self, charge: FloatArray, bin_width_ns: float, background: FloatArray, random: np.random.Generator
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Convert charges in electrons in each part of a bin to samples."""
        low_pass, stride = self.low_pass(bin_width_ns), self.stride(bin_width_ns)
        if self.amplifier is None:
            signal = low_pass.sampled(charge, stride)
            return signal, np.zeros(signal.shape, np.bool_)
        volts = low_pass.sampled(charge, stride) * self.volts_per_electron(bin_width_ns)
        volts = self.coupled(volts, bin_width_ns, background)
        deviation, weights = self.amplifier.noise(bin_width_ns, stride)
        if deviation > 0:
            normal = random.standard_normal((*volts.shape[:-1], volts.shape[-1] + weights.size - 1))
            volts += deviation * electronics.filtered(normal, weights)
        return self.readout(bin_width_ns).read(volts)
