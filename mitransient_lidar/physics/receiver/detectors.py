"""Photodetectors: charge or counts in each time bin for a mean number of photons, as moments and realisations.

`LinearDetector` represents photodiodes, avalanche photodiodes and photomultipliers, `SiliconPhotomultiplier` arrays of
Geiger-mode cells, `SinglePhotonDetector` one such cell with a counter. Each has

- `event_means`: mean primary events (photoelectrons, avalanches) per bin, dark events included;
- `moments`: mean and covariances of the output in closed form;
- `sample`: output realisations.

The output is a charge in electrons per bin; for the single-photon detector it is a count per bin. Photons arrive as a
Poisson process: laser speckle averages out over the many coherence cells of an airborne receiver (Goodman 1965).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from mitransient_lidar.core.constants import C0, ELEMENTARY_CHARGE, PLANCK
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Plan, positive_option
from mitransient_lidar.core.validation import FloatArray, IntArray, finite_array, in_range, positive
from mitransient_lidar.physics.receiver import dead_time


@dataclass(frozen=True, kw_only=True)
class SignalTail(Plan):
    """Events that follow light events, as a sum of decaying exponentials; the default has none.

    Delayed events are a Poisson process with the gain, excess noise and shot noise of other events. Their rate is the
    light's rate convolved with sum_i f_i exp(-(t - d_i)/tau_i)/tau_i. After an echo with peak P and a duration w (its
    energy over its peak) much shorter than tau, the tail begins at P f w/tau: 1e-3 times the peak for f = 1e-3 tau/w.

    Photomultipliers have such tails by fluorescence of their window and by ions: W. H. Hunt and S. K. Poultney, IEEE
    Trans. Nucl. Sci. 22, 116 (1975), doi:10.1109/TNS.1975.4327627; Y. Zhao, Appl. Opt. 38, 4639 (1999),
    doi:10.1364/AO.38.004639.
    """

    tail_fractions: Annotated[
        tuple[float, ...],
        Option("Events in each exponential per light event, or charge per charge; their sum is at most 1", 0),
    ] = ()
    tail_decays_ns: Annotated[tuple[float, ...], positive_option("Decay time of each exponential", "ns")] = ()
    tail_delays_ns: Annotated[
        tuple[float, ...], Option("Delay of each exponential's start after the light; empty for no delay", 0, unit="ns")
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(self.tail_fractions)
        if sum(self.tail_fractions) > 1:
            raise UserError(f"tail_fractions = {list(self.tail_fractions)} must have a sum of at most 1")
        for name, sizes in (("tail_decays_ns", (count,)), ("tail_delays_ns", (0, count))):
            if len(values := getattr(self, name)) not in sizes:
                raise UserError(f"{name} = {list(values)} must have as many numbers as tail_fractions, {count}")

    def with_tail(self, events: FloatArray, steady: FloatArray, part_ns: float) -> FloatArray:
        """Return mean events, including delayed ones.

        `events`, shape (..., time): mean events in parts of bins. `steady`, shape (..., 1): mean events by background
        and dark current alone, which were there long before the record. `part_ns`: part width [ns].
        """
        from scipy.signal import lfilter

        signal = self._tail_sources(events, part_ns) - steady
        total = events + sum(self.tail_fractions) * steady
        delays = self.tail_delays_ns or (0.0,) * len(self.tail_fractions)
        for fraction, decay, delay in zip(self.tail_fractions, self.tail_decays_ns, delays, strict=True):
            # Light within a part is taken at its middle; the exponential is integrated over each later part.
            root = np.exp(-0.5 * part_ns / decay)
            tail = fraction * lfilter([1 - root, root - root**2], [1, -(root**2)], signal, axis=-1)
            parts = int(delay / part_ns)
            later = delay / part_ns - parts
            for shift, share in ((parts, 1 - later), (parts + 1, later)):
                if shift < tail.shape[-1]:
                    total[..., shift:] += share * tail[..., : tail.shape[-1] - shift]
        return np.asarray(total)

    def _tail_sources(self, events: FloatArray, part_ns: float) -> FloatArray:
        """Return the mean events that are followed by delayed ones."""
        return events


Moments = tuple[FloatArray, list[FloatArray]]
"""Mean, shape (..., time), and covariances of the bins k and k + l at index l, shape (..., time - l)."""


def photons_per_joule(wavelength_nm: float) -> float:
    """Return the number of photons per joule of light at a vacuum wavelength [nm], positive."""
    return positive("wavelength_nm", wavelength_nm) * 1e-9 / (PLANCK * C0)


def avalanche_excess_noise(gain: float, ionisation_ratio: float) -> float:
    """Excess noise factor of an avalanche photodiode, F = k M + (1 - k) (2 - 1/M).

    `gain`: mean multiplication M, at least 1. `ionisation_ratio`: effective ratio k of the ionisation coefficients,
    holes over electrons where electrons begin the avalanche, 0 to 1.

    R. J. McIntyre, IEEE Trans. Electron Devices 13, 164 (1966), doi:10.1109/T-ED.1966.15651.
    """
    multiplication, k = in_range("gain", gain, 1, np.inf), in_range("ionisation_ratio", ionisation_ratio, 0, 1)
    return float(k * multiplication + (1 - k) * (2 - 1 / multiplication))


def dynode_excess_noise(dynode_gains: Sequence[float]) -> float:
    """Excess noise factor for a chain of dynodes with Poisson-distributed secondary electrons.

    `dynode_gains`: mean secondary electrons d per electron of each dynode, above 1; at least one dynode.

    F = 1 + 1/d_1 + 1/(d_1 d_2) + ...; d/(d - 1) for many equal dynodes. Cascade variances: W. Shockley and J. R.
    Pierce, Proc. IRE 26, 321 (1938).
    """
    gains = finite_array("dynode_gains", dynode_gains)
    if gains.ndim != 1 or gains.size == 0 or np.any(gains <= 1):
        raise UserError(f"dynode_gains = {list(dynode_gains)} must be a list of numbers above 1")
    return float(1 + np.sum(1 / np.cumprod(gains)))


@dataclass(frozen=True)
class LinearDetector(SignalTail):
    """Detector whose charge is proportional to the light: photodiode, avalanche photodiode or photomultiplier.

    A photomultiplier's afterpulses are a tail of its signal.

    The charge of n events is drawn from a gamma distribution with mean n gain and variance n gain^2 (excess_noise - 1).
    The leakage's shot noise is drawn from a normal distribution. Mean and variance are exact, the tail shapes are not.
    """

    quantum_efficiency: Annotated[
        float,
        Option("Primary events per photon, of a photomultiplier times the collection efficiency", 0, 1, above=True),
    ]
    gain: Annotated[float, Option("Mean charge per event in electrons", 1)] = 1.0
    excess_noise: Annotated[float, Option("Mean square of the charge over its squared mean", 1)] = 1.0
    dark_current_na: Annotated[
        float, Option("Dark current before the multiplication: the anode's over the gain", 0, unit="nA")
    ] = 0.0
    leakage_current_na: Annotated[
        float, Option("Unmultiplied dark current, such as the surface current of an avalanche photodiode", 0, unit="nA")
    ] = 0.0
    dynode_gains: Annotated[
        tuple[float, ...],
        Option("Dynode gains of a photomultiplier, whose voltage can be lowered; empty for other detectors"),
    ] = ()
    largest_current_ma: Annotated[
        float, positive_option("Largest output current in pulses: behind an amplifier, more saturates", "mA")
    ] = np.inf

    @classmethod
    def avalanche(
        cls,
        quantum_efficiency: float,
        gain: float,
        ionisation_ratio: float,
        dark_current_na: float = 0.0,
        leakage_current_na: float = 0.0,
        tail_fractions: tuple[float, ...] = (),
        tail_decays_ns: tuple[float, ...] = (),
        tail_delays_ns: tuple[float, ...] = (),
    ) -> LinearDetector:
        """Avalanche photodiode below breakdown, its excess noise from `avalanche_excess_noise`."""
        return cls(
            quantum_efficiency,
            gain,
            avalanche_excess_noise(gain, ionisation_ratio),
            dark_current_na,
            leakage_current_na,
            tail_fractions=tail_fractions,
            tail_decays_ns=tail_decays_ns,
            tail_delays_ns=tail_delays_ns,
        )

    @classmethod
    def photomultiplier(
        cls,
        quantum_efficiency: float,
        dynode_gains: Sequence[float],
        dark_current_na: float = 0.0,
        largest_current_ma: float = np.inf,
        tail_fractions: tuple[float, ...] = (),
        tail_decays_ns: tuple[float, ...] = (),
        tail_delays_ns: tuple[float, ...] = (),
    ) -> LinearDetector:
        """Photomultiplier tube, its gain and excess noise from the gains of its dynodes (`dynode_excess_noise`)."""
        tube = cls(
            quantum_efficiency,
            dark_current_na=dark_current_na,
            largest_current_ma=largest_current_ma,
            tail_fractions=tail_fractions,
            tail_decays_ns=tail_decays_ns,
            tail_delays_ns=tail_delays_ns,
        )
        return tube.with_dynodes(dynode_gains)

    @property
    def charge_spread(self) -> float:
        """Variance of an event's charge over its squared mean [1]."""
        return self.excess_noise - 1

    def with_gain(self, factor: float) -> LinearDetector:
        """Return a photomultiplier at another voltage: its gain times a factor, the same for each dynode.

        Raises UserError if a dynode's gain would not be above 1.
        """
        each = positive("gain", factor) ** (1 / len(self.dynode_gains))
        gains = [each * gain for gain in self.dynode_gains]
        if min(gains) <= 1:
            least = min(self.dynode_gains) ** -len(self.dynode_gains)
            raise UserError(f"gain = {factor:g} must be above {least:.3g}, for gains of all dynodes above 1")
        return self.with_dynodes(gains)

    def with_dynodes(self, dynode_gains: Sequence[float]) -> LinearDetector:
        """Return the detector with other gains of its dynodes; gain and excess noise follow from them."""
        gains, noise = tuple(float(gain) for gain in dynode_gains), dynode_excess_noise(dynode_gains)
        return replace(self, gain=float(np.prod(gains)), excess_noise=noise, dynode_gains=gains)

    def event_means(self, photons: FloatArray, bin_width_ns: float) -> FloatArray:
        """Mean events per bin for a mean number of photons per bin, in the same shape."""
        return self.quantum_efficiency * photons + _electrons(self.dark_current_na, bin_width_ns)

    def moments(self, events: FloatArray, bin_width_ns: float, lags: int) -> Moments:
        """Mean and covariances of the charge per bin; the bins are independent, so that only lag 0 is returned."""
        leakage = _electrons(self.leakage_current_na, bin_width_ns)
        return self.gain * events + leakage, [self.gain**2 * self.excess_noise * events + leakage]

    def sample(self, events: FloatArray, bin_width_ns: float, shots: int, random: np.random.Generator) -> FloatArray:
        """Draw charges in electrons per bin, shape ``(shots, *events.shape)``."""
        count = random.poisson(events, (shots, *events.shape))
        charge = multiplied(count, self.gain, self.excess_noise - 1, random)
        if leakage := _electrons(self.leakage_current_na, bin_width_ns):
            charge += random.normal(leakage, np.sqrt(leakage), charge.shape)
        return charge


@dataclass(frozen=True)
class SiliconPhotomultiplier(SignalTail):
    """Geiger-mode cells in parallel (SiPM, MPPC).

    Cells without crosstalk are independent: the number of primary avalanches in a bin is binomial. Each makes a
    Borel-distributed total number of avalanches, with mean 1/(1 - L) and variance L/(1 - L)^3, L = -ln(1 - crosstalk)
    (S. Vinogradov, Nucl. Instrum. Methods A 695, 247 (2012), arXiv:1109.2014). Here L is multiplied by the mean
    fraction of live cells. The dead time of cells fired by crosstalk is neglected, which matters where many cells fire.
    A cell recovers instantaneously. Afterpulses occur in any cell, with equal probability.
    """

    quantum_efficiency: Annotated[
        float, Option("Photon detection efficiency, with fill factor and avalanche probability", 0, 1, above=True)
    ]
    cells: Annotated[int, Option("Number of cells, evenly illuminated", 1, 10**9)]
    recovery_time_ns: Annotated[float, positive_option("Dead time after a cell fires, at least the bin width", "ns")]
    crosstalk: Annotated[float, Option("Probability that an avalanche immediately triggers further ones", 0, 0.5)] = 0.0
    dark_count_rate_hz: Annotated[float, Option("Dark counts in all cells, without crosstalk", 0, unit="1/s")] = 0.0
    gain: Annotated[float, Option("Mean avalanche charge in electrons", 1)] = 1.0
    gain_spread: Annotated[float, Option("Standard deviation of the charge over its mean", 0)] = 0.0

    @property
    def charge_spread(self) -> float:
        """Variance of an event's charge, including the events that it triggers, over its squared mean [1]."""
        offspring = -np.log1p(-self.crosstalk)
        return float(offspring / (1 - offspring) + self.gain_spread**2 * (1 - offspring))

    def event_means(self, photons: FloatArray, bin_width_ns: float) -> FloatArray:
        """Mean events per bin, with all cells live, for a mean number of photons per bin, in the same shape."""
        return self.quantum_efficiency * photons + 1e-9 * self.dark_count_rate_hz * bin_width_ns

    def moments(self, events: FloatArray, bin_width_ns: float, lags: int) -> Moments:
        """Mean and covariances of the charge per bin for mean events per bin, shape (..., time)."""
        dead = dead_time.dead_bins(self.recovery_time_ns, bin_width_ns)
        per_cell = events / self.cells
        fired, live = dead_time.firing_probability(per_cell, dead)
        offspring = self._offspring(fired, live)
        family, spread = 1 / (1 - offspring), offspring / (1 - offspring) ** 3
        primaries = self.cells * fired
        covariances = [
            self.cells * self.gain**2 * one * family[..., : one.shape[-1]] * family[..., lag:]
            for lag, one in enumerate(dead_time.pair_covariances(per_cell, fired, dead, lags))
        ]
        covariances[0] += self.gain**2 * primaries * (spread + self.gain_spread**2 * family)
        return self.gain * primaries * family, covariances

    def sample(self, events: FloatArray, bin_width_ns: float, shots: int, random: np.random.Generator) -> FloatArray:
        """Draw charges in electrons per bin, shape ``(shots, *events.shape)``."""
        dead = dead_time.dead_bins(self.recovery_time_ns, bin_width_ns)
        per_cell = events / self.cells
        count = dead_time.sample_cells(per_cell, self.cells, dead, shots, random)
        if self.crosstalk > 0:
            offspring = self._offspring(*dead_time.firing_probability(per_cell, dead)).ravel()
            flat = count.reshape(-1)
            parents = np.flatnonzero(flat)
            born = flat[parents]
            while born.size:
                born = random.poisson(offspring[parents % offspring.size] * born)
                parents, born = parents[born > 0], born[born > 0]
                flat[parents] += born
        return multiplied(count, self.gain, self.gain_spread**2, random)

    def _tail_sources(self, events: FloatArray, part_ns: float) -> FloatArray:
        """Return the mean primary avalanches, fewer than the events where cells are dead."""
        dead = dead_time.dead_bins(self.recovery_time_ns, part_ns)
        return self.cells * dead_time.firing_probability(events / self.cells, dead)[0]

    def _offspring(self, fired: FloatArray, live: FloatArray) -> FloatArray:
        """Mean avalanches that one triggers directly."""
        return np.asarray(-np.log1p(-self.crosstalk) * np.maximum(live - fired, 0))


@dataclass(frozen=True)
class SinglePhotonDetector(SignalTail):
    """Single-photon avalanche diode, or several channels that share the light evenly, with a counter in time bins.

    The detector is live at the first bin of the record, as if gated on there. The time to an afterpulse is
    exponentially distributed, and an afterpulse may cause another one. Each count begins anew: carriers that earlier
    counts have trapped cease to count, so that the counts are a renewal process with exact moments.
    """

    quantum_efficiency: Annotated[float, Option("Photon detection efficiency", 0, 1, above=True)]
    dead_time_ns: Annotated[
        float,
        positive_option(
            "Dead time after a count, at least the width of a bin; one longer than the record leaves only the first "
            "photon",
            "ns",
        ),
    ]
    dark_count_rate_hz: Annotated[float, Option("Dark counts in all channels", 0, unit="1/s")] = 0.0
    paralyzable: Annotated[bool, Option("Whether an event in the dead time prolongs it")] = False
    channels: Annotated[
        int, Option("Number of channels, each with its own dead time, whose counts are summed", 1, 10_000)
    ] = 1
    afterpulse_probability: Annotated[
        float,
        Option(
            "Probability that a count causes another one in its channel after the dead time, where no other event is "
            "earlier; it needs a detector that is not paralyzable",
            *(0, 0.5),
        ),
    ] = 0.0
    afterpulse_decay_ns: Annotated[
        float | None,
        positive_option("Mean time from the end of the dead time to an afterpulse, for a probability above 0", "ns"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.afterpulse_probability > 0:
            if self.paralyzable:
                raise UserError(
                    f"afterpulse_probability = {self.afterpulse_probability:g} must be 0 for a paralyzable detector"
                )
            if self.afterpulse_decay_ns is None:
                raise UserError("afterpulse_decay_ns is required for an afterpulse_probability above 0")

    def event_means(self, photons: FloatArray, bin_width_ns: float) -> FloatArray:
        """Mean events per bin without dead time for a mean number of photons per bin, in the same shape."""
        return self.quantum_efficiency * photons + 1e-9 * self.dark_count_rate_hz * bin_width_ns

    def moments(self, events: FloatArray, bin_width_ns: float, lags: int) -> Moments:
        """Mean and covariances of the counts for mean events per bin, shape (..., time)."""
        dead, own = dead_time.dead_bins(self.dead_time_ns, bin_width_ns), events / self.channels
        hazard = self._hazard(bin_width_ns, events.shape[-1])
        if hazard is not None:
            fired, covariances = dead_time.afterpulse_moments(own, dead, hazard, lags)
        elif self.paralyzable:
            fired = dead_time.firing_probability_paralyzable(own, dead)
            covariances = dead_time.pair_covariances(own, fired, dead, lags, paralyzable=True)
        else:
            fired, _ = dead_time.firing_probability(own, dead)
            covariances = dead_time.pair_covariances(own, fired, dead, lags)
        return self.channels * fired, [self.channels * one for one in covariances]

    def sample(self, events: FloatArray, bin_width_ns: float, shots: int, random: np.random.Generator) -> FloatArray:
        """Draw counts per bin, 0 to the number of channels, shape ``(shots, *events.shape)``."""
        dead, own = dead_time.dead_bins(self.dead_time_ns, bin_width_ns), events / self.channels
        hazard = self._hazard(bin_width_ns, events.shape[-1])
        count = np.zeros((shots, *events.shape))
        for _ in range(self.channels):
            count += dead_time.sample_counter(own, dead, self.paralyzable, shots, random, hazard)
        return count

    def _hazard(self, bin_width_ns: float, bins: int) -> FloatArray | None:
        """Return the probability of an afterpulse in each bin since a channel is live, or None without afterpulses."""
        if self.afterpulse_probability == 0 or self.afterpulse_decay_ns is None:
            return None
        return dead_time.afterpulse_hazard(self.afterpulse_probability, self.afterpulse_decay_ns / bin_width_ns, bins)


Detector = LinearDetector | SiliconPhotomultiplier | SinglePhotonDetector


def _electrons(current_na: float, bin_width_ns: float) -> float:
    """Electrons per bin for a current."""
    return current_na * 1e-9 * bin_width_ns * 1e-9 / ELEMENTARY_CHARGE


def multiplied(count: IntArray, gain: float, relative_variance: float, random: np.random.Generator) -> FloatArray:
    """Random charge of `count` events, each with a mean `gain` and a relative variance."""
    if relative_variance == 0:
        return gain * count.astype(np.float64)
    return gain * relative_variance * random.standard_gamma(count / relative_variance)
