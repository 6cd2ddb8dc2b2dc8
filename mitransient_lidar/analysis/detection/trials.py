"""Performance of target detection by a receiver, in closed form and from random shots.

The functions return variables for the dataset of `studies.detection.detect`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.detection import matched_filter, statistics
from mitransient_lidar.analysis.information.errors import jackknife_error
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.chain import ReceiverChain

Variables = dict[str, Any]

#: Pixel combinations: one detector for all pixels, and three combinations of the signals from one detector per pixel.
COMBINATIONS = ("single", "sum", "brightest", "best")

#: Half widths of the gate about the target's echo, and of the search for its time, in pulse widths.
HALF_GATE, HALF_SEARCH = 1.5, 0.8

CONFIDENCE = 0.95  #: Confidence of all intervals.

_LEVELS = (1e-8, 1e4)  # smallest and largest fraction of the target's signal, or of the pulse energy
_DELAYS = 41  # in the matched filter
_GROUPS, MOST_GROUPS = 20, 10  # jackknife groups of shots in one scene, and largest number of groups of renders


@dataclass(frozen=True)
class Level:
    """Logarithm of the level for the required detection, and its changes when groups of renders are left out."""

    log: float
    changes: FloatArray

    def limits(self, other: Level | None = None) -> tuple[float, float, float]:
        """Return the level, or another level's ratio to it, and the limits of its confidence interval."""
        log, changes = self.log, self.changes
        if other is not None:
            log, changes = other.log - log, other.changes - changes
        value, low, high = interval(log, changes)
        return math.exp(value), math.exp(low), math.exp(high)


@dataclass(frozen=True)
class Experiment:
    """A scene's mean light on its pixels, and the receiver that records it.

    `background` is the power without the target, and `difference` the power that the target adds [W], shape (renders,
    pixels, time). They come from different `seas` or one. `sky` is the steady power on each pixel [W], and `samples`
    are the samples about the target's echo. `brightest` is the index of the pixel with the strongest echo.
    """

    background: FloatArray
    difference: FloatArray
    seas: bool
    chain: ReceiverChain
    bin_width_ns: float
    sky: float
    samples: slice
    brightest: int

    @property
    def groups(self) -> int:
        """Number of render groups for the jackknife."""
        return min(len(self.background), MOST_GROUPS)

    def light(self, share: float, energy: float, left_out: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return powers [W] without and with a fraction of the target's signal, shape (cases, pixels, time).

        The render group `left_out` is excluded.
        """
        numbers = np.arange(len(self.background))
        kept = numbers if left_out is None else np.setdiff1d(numbers, np.array_split(numbers, self.groups)[left_out])
        background, difference = self.background[kept], self.difference[kept]
        if not self.seas:
            background, difference = (values.mean(axis=0, keepdims=True) for values in (background, difference))
        return energy * background, energy * np.maximum(background + share * difference, 0)

    def on_detectors(self, single: bool, light: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return signal and sky [W] on one detector for all pixels, or on one per pixel."""
        power, sky = (light.sum(axis=-2, keepdims=True), self.sky * light.shape[-2]) if single else (light, self.sky)
        return power, np.full(power.shape[:-1], sky)

    def ranged(self, single: bool, light: FloatArray) -> ReceiverChain:
        """Return the chain with a gain for this light."""
        power, sky = self.on_detectors(single, light)
        return statistics.within_range(self.chain, power, self.bin_width_ns, self.samples, sky)

    def gain(self, single: bool) -> float:
        """Return the factor of the transimpedance that keeps the echo in range, on one detector or one per pixel."""
        chain = self.ranged(single, np.maximum(*self.light(1, 1)))
        if chain.amplifier is None or self.chain.amplifier is None:
            return 1.0
        return chain.amplifier.transimpedance_ohm / self.chain.amplifier.transimpedance_ohm

    def cases(self, name: str | int, share: float, energy: float, left_out: int | None = None) -> statistics.Cases:
        """Return a combination's samples, or the samples of one pixel by index."""
        single = name == "single"
        pair = self.light(share, energy, left_out)
        chain = self.ranged(single, np.maximum(*pair))
        found = []
        for light in pair:
            power, sky = self.on_detectors(single, light)
            mean, covariance = statistics.sample_moments(chain, power, self.bin_width_ns, self.samples, sky)
            count, detectors, samples = mean.shape
            joint = np.zeros((count, detectors, samples, detectors, samples))
            for i in range(detectors):
                joint[:, i, :, i, :] = covariance[:, i]
            width = detectors * samples
            found += [mean.reshape(count, width), joint.reshape(count, width, width)]
        matrix = self.matrix(name)
        return statistics.Cases(found[0], found[1], found[2], found[3], detectors).combined(
            matrix, len(matrix) // samples
        )

    def matrix(self, name: str | int) -> FloatArray:
        """Return the matrix from all detectors' samples to a combination's or a pixel's."""
        pixels, samples = self.background.shape[1], self.samples.stop - self.samples.start
        weights: dict[str | int, FloatArray] = {
            "single": np.ones((1, 1)),
            "sum": np.ones((1, pixels)),
            "best": np.eye(pixels),
            **{index: np.eye(pixels)[[index]] for index in range(pixels)},
        }
        weights["brightest"] = weights[self.brightest]
        return np.asarray(np.kron(weights[name], np.eye(samples)), dtype=np.float64)

    def draw(self, single: bool, light: FloatArray, chain: ReceiverChain, shots: int, seed: int) -> FloatArray:
        """Return random samples of shots, shape (shots, cases, detectors * samples)."""
        power, sky = self.on_detectors(single, light)
        record = chain.apply(power, self.bin_width_ns, shots, seed, sky, series=True)
        signal = record.signal[..., self.samples]
        return signal.reshape(*signal.shape[:2], -1).astype(np.float64)

    def needed(self, name: str, kind: str, pfa: float, pd: float) -> Level:
        """Return the fraction of target signal or pulse energy for the required detection."""
        from scipy.optimize import brentq
        from scipy.special import ndtri

        def margin(log: float, left_out: int | None = None) -> float:
            share, energy = (math.exp(log), 1.0) if kind == "target" else (1.0, math.exp(log))
            try:
                statistic = self.cases(name, share, energy, left_out).statistic()
            except ValueError:
                return -math.inf  # no detection at this level, for example by dead time after the surface echo
            return float(statistic.quantile(pfa) - ndtri(pd))

        step = math.log(4.0) * (-1 if margin(0.0) > 0 else 1)
        log = 0.0
        while (margin(log + step) > 0) == (step < 0):
            log += step
            if not math.log(_LEVELS[0]) < log < math.log(_LEVELS[1]):
                return Level(math.inf * step, np.zeros(self.groups))
        root = float(brentq(margin, *sorted((log, log + step)), xtol=1e-4))
        slope = (margin(root + 0.02) - margin(root - 0.02)) / 0.04
        return Level(root, np.array([-margin(root, i) / slope for i in range(self.groups)]))


def needs(trial: Experiment, pfa: float, pd: float) -> Variables:
    """Return the levels of the required detection, and their gains over one detector for all pixels."""
    deflections = [trial.cases(name, 1, 1).statistic().deflection for name in COMBINATIONS]
    data: Variables = {"deflection": ("combination", deflections)}
    for kind in ("target", "energy"):
        levels = [trial.needed(name, kind, pfa, pd) for name in COMBINATIONS]
        data |= with_limits(f"needed_{kind}", [level.limits() for level in levels])
        data |= with_limits(f"gain_{kind}", [level.limits(levels[0]) for level in levels])
    return data


def detected(trial: Experiment, pfa: float) -> Variables:
    """Return the probability of detecting the full signal at a false alarm probability, combined and by pixel.

    A detector that does not see the target raises only false alarms.
    """
    from scipy.special import ndtr, ndtri

    def quantile(name: str | int, left_out: int | None = None) -> float:
        try:
            return float(trial.cases(name, 1, 1, left_out).statistic().quantile(pfa))
        except ValueError:
            return float(ndtri(pfa))

    def limits(name: str | int) -> FloatArray:
        value = quantile(name)
        changes = np.array([quantile(name, i) for i in range(trial.groups)]) - value
        return np.asarray(ndtr(interval(value, changes)))

    pixels = range(trial.background.shape[1])
    return {
        **with_limits("detection", [limits(name) for name in COMBINATIONS]),
        **with_limits("pixel_detection", [limits(pixel) for pixel in pixels], dims=("pixel",)),
    }


def drawn(trial: Experiment, share: float, pfa: float, shots: int, seed: int) -> Variables:
    """Return rates for random shots with a fraction of the target's signal, and the closed-form rates."""
    count = len(trial.background) if trial.seas else 1
    nominal = np.union1d(np.logspace(math.log10(min(1e-4, pfa / 3)), -0.05, 80), pfa)
    pair = trial.light(share, 1)
    records = {}
    for single in (True, False):
        chain = trial.ranged(single, np.maximum(*pair))
        records[single] = [
            trial.draw(single, light, chain, -(-shots // count), _seed(seed, single, which))
            for which, light in enumerate(pair)
        ]
    rates: dict[str, list[Any]] = defaultdict(list)
    for name in COMBINATIONS:
        statistic = trial.cases(name, share, 1).statistic()
        matrix = trial.matrix(name)
        null, target = (
            (np.einsum("nci,ci->nc", record @ matrix.T, statistic.weights) - statistic.offsets).ravel()
            for record in records[name == "single"]
        )
        thresholds = statistic.threshold(nominal)
        area = statistics.area_under_curve(null, target, CONFIDENCE)
        rates["drawn_false_alarm"].append(statistics.exceedance(null, thresholds, CONFIDENCE))
        rates["drawn_detection"].append(statistics.exceedance(target, thresholds, CONFIDENCE))
        rates["area"].append((area.value, area.low, area.high))
        rates["expected_area"].append(statistic.area())
        rates["expected_detection"].append(statistic.detection(nominal))
    along = ("combination", "false_alarm")
    data: Variables = {
        "false_alarm": ("false_alarm", nominal),
        "expected_detection": (along, rates["expected_detection"]),
        "expected_area": ("combination", rates["expected_area"]),
        **with_limits("area", rates["area"]),
    }
    for key in ("drawn_false_alarm", "drawn_detection"):
        data |= with_limits(key, np.moveaxis(np.array(rates[key]), 1, -1), dims=along)
    return data


def depth_errors(trial: Experiment, shots: int, seed: int, pulse_fwhm_ns: float, metres_per_ns: float) -> Variables:
    """Return bias and spread of the full echo's depth, from the time by the matched filter."""
    steps = HALF_SEARCH * pulse_fwhm_ns * np.linspace(-1, 1, _DELAYS)
    background, target = trial.light(1, 1)
    count = len(background)
    depths: dict[str, FloatArray] = {}
    bounds = {}
    for single in (True, False):
        chain = trial.ranged(single, target)
        record = trial.draw(single, target, chain, -(-shots // count), _seed(seed, single, 2))
        for name in COMBINATIONS[:1] if single else COMBINATIONS[1:]:
            cases = trial.cases(name, 1, 1)
            matrix = trial.matrix(name)
            times = []
            for i in range(count):
                kept = [i] if count == 1 else [k for k in range(count) if k != i]
                mean_pair = background[kept].mean(0), target[kept].mean(0)
                echo = _delayed(trial, single, chain, *mean_pair, steps) @ matrix.T
                known = cases if count == 1 else cases.others(i)
                noise = known.covariance(with_target=True)
                times.append(
                    matched_filter.delays(record[:, i] @ matrix.T - known.null_mean.mean(axis=0), echo, steps, noise)
                )
            depths[name] = metres_per_ns * np.array(times)
            bounds[name] = metres_per_ns * matched_filter.delay_bound(echo, steps, noise) if count == 1 else math.nan
    levels, bias = {}, []
    for name in COMBINATIONS:
        groups = list(depths[name]) if count > 1 else np.array_split(depths[name][0], _GROUPS)
        levels[name] = Level(*_jackknife(groups, lambda errors: math.log(np.std(errors, ddof=1))))
        bias.append(interval(*_jackknife(groups, lambda errors: float(np.mean(errors)))))
    return {
        **with_limits("depth_bias", bias),
        **with_limits("depth_spread", [levels[name].limits() for name in COMBINATIONS]),
        **with_limits("depth_gain", [levels[name].limits(levels["single"]) for name in COMBINATIONS]),
        "depth_bound": ("combination", [bounds[name] for name in COMBINATIONS]),
    }


def by_depth(trials: Sequence[Experiment], places: Sequence[float], pfa: float, pd: float) -> Variables:
    """Return the required fraction of the target's signal at each depth, and the depth at which it is 1."""
    table = [[trial.needed(name, "target", pfa, pd) for trial in trials] for name in COMBINATIONS]
    reached = []
    for row in table:
        left_out = range(len(row[0].changes))
        changes = [crossing(places, [level.log + level.changes[i] for level in row]) for i in left_out]
        reached.append(interval(crossing(places, [level.log for level in row]), np.array(changes)))
    needed = [[level.limits() for level in row] for row in table]
    return {
        "depth": ("depth", list(places)),
        **with_limits("needed_at_depth", needed, dims=("combination", "depth")),
        **with_limits("detectable_depth", reached),
    }


def crossing(places: Sequence[float], logs: Sequence[float]) -> float:
    """Return the first place where logarithms rise through 0, NaN if there is none."""
    for i in range(len(places) - 1):
        if logs[i] <= 0 < logs[i + 1]:
            share = 1.0 if math.isinf(logs[i + 1]) else -logs[i] / (logs[i + 1] - logs[i])
            return places[i] + share * (places[i + 1] - places[i])
    return math.nan


def _delayed(
    trial: Experiment, single: bool, chain: ReceiverChain, background: FloatArray, target: FloatArray, steps: FloatArray
) -> FloatArray:
    """Return the samples added by an echo at delays, shape (delays, detectors * samples)."""
    from scipy.interpolate import CubicSpline

    bins = np.arange(background.shape[-1])
    places = np.clip(bins - steps[:, None] / trial.bin_width_ns, 0, bins[-1])
    moved = CubicSpline(bins, target - background, axis=-1)(places)
    powers = np.concatenate([background[None], np.maximum(background + np.moveaxis(moved, 1, 0), 0)])
    power, sky = trial.on_detectors(single, powers)
    mean = chain.expected(power, trial.bin_width_ns, sky).mean[..., trial.samples]
    samples = mean.reshape(len(mean), -1)
    return np.asarray(samples[1:] - samples[0])


def _jackknife(groups: Sequence[FloatArray], measure: Callable[[FloatArray], float]) -> tuple[float, FloatArray]:
    """Return a measure of all groups, and its changes when each is left out."""
    value = measure(np.concatenate(groups))
    rest = [measure(np.concatenate([*groups[:i], *groups[i + 1 :]])) for i in range(len(groups))]
    return value, np.array(rest) - value


def interval(value: float, changes: FloatArray) -> tuple[float, float, float]:
    """Return a value and the limits of its confidence interval from a jackknife's changes, by Student's t."""
    from scipy.stats import t

    reach = float(t.ppf((1 + CONFIDENCE) / 2, len(changes) - 1)) * jackknife_error(changes)
    return value, value - reach, value + reach


def with_limits(name: str, values: npt.ArrayLike, dims: tuple[str, ...] = ("combination",)) -> Variables:
    """Return a variable and the limits of its interval, the last axis of the values."""
    table = np.array(values, dtype=np.float64)
    return {f"{name}{end}": (dims, table[..., i]) for i, end in enumerate(("", "_low", "_high"))}


def _seed(seed: int, single: bool, which: int) -> int:
    """Return a different seed for the noise of each record."""
    return int(np.random.SeedSequence([seed, int(single), which]).generate_state(1, np.uint32)[0])
