"""Trials of a target's detection: what a receiver makes of rendered light, in closed form and by drawn shots.

The functions return what `detection.detect` returns, as variables of an `xarray.Dataset`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mitransient_lidar.optics import roc
from mitransient_lidar.optics.checks import FloatArray
from mitransient_lidar.optics.detection import Cases, sample_moments, within_range
from mitransient_lidar.optics.echo_delays import delay_bound, delays
from mitransient_lidar.optics.receivers import ReceiverChain

Variables = dict[str, Any]

#: What is compared: one detector for the light of all pixels, and three ways to use the signals of a detector each.
COMBINATIONS = ("single", "sum", "brightest", "best")

#: Half width of the gate about the target's echo, and of the search for its time, in the pulse's full widths.
HALF_GATE, HALF_SEARCH = 1.5, 0.8

#: Smallest and largest share of the target's signal, or of the pulse's energy, that is looked at.
_LEVELS = (1e-8, 1e4)

#: Of all intervals.
CONFIDENCE = 0.95

_DELAYS = 41

#: Groups of shots of one scene, and most groups of renders, that a jackknife leaves out one by one.
_GROUPS, _MOST_GROUPS = 20, 10


@dataclass(frozen=True)
class Level:
    """Logarithm of the level at which the detection is as wanted, and what leaving out groups of renders adds to it."""

    log: float
    changes: FloatArray

    def limits(self, other: Level | None = None) -> tuple[float, float, float]:
        """Return the level, or that of another over it, and the limits of its confidence interval."""
        log, changes = (
            (self.log, self.changes) if other is None else (other.log - self.log, other.changes - self.changes)
        )
        reach = _reach(changes)
        return math.exp(log), math.exp(log - reach), math.exp(log + reach)


@dataclass(frozen=True)
class Experiment:
    """Mean light of a scene on its pixels, and the receiver that records it.

    Attributes
    ----------
    bare, own
        Power without the target, and what the target adds [W], shape (renders, pixels, time).
    seas
        Whether each render is of another sea; otherwise all are of the same.
    chain, bin_width_ns, sky
        The receiver, the width of the bins [ns] and the steady power on each pixel [W].
    samples
        Samples about the target's echo.
    brightest
        Number of the pixel with the strongest echo.
    """

    bare: FloatArray
    own: FloatArray
    seas: bool
    chain: ReceiverChain
    bin_width_ns: float
    sky: float
    samples: slice
    brightest: int

    @property
    def groups(self) -> int:
        """Number of groups of renders for the jackknife."""
        return min(len(self.bare), _MOST_GROUPS)

    def light(self, share: float, energy: float, left_out: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return powers [W] without and with a share of the target's signal, shape (cases, pixels, time).

        Without a group of renders when `left_out` is its number.
        """
        numbers = np.arange(len(self.bare))
        kept = numbers if left_out is None else np.setdiff1d(numbers, np.array_split(numbers, self.groups)[left_out])
        bare, own = self.bare[kept], self.own[kept]
        if not self.seas:
            bare, own = bare.mean(axis=0, keepdims=True), own.mean(axis=0, keepdims=True)
        return energy * bare, energy * np.maximum(bare + share * own, 0)

    def on_detectors(self, single: bool, light: FloatArray) -> tuple[FloatArray, float]:
        """Return signal and sky [W] on one detector for all pixels, or on one for each."""
        return (light.sum(axis=-2, keepdims=True), self.sky * light.shape[-2]) if single else (light, self.sky)

    def ranged(self, single: bool, light: FloatArray) -> ReceiverChain:
        """Return the chain with the gain that records this light."""
        power, sky = self.on_detectors(single, light)
        return within_range(self.chain, power, self.bin_width_ns, self.samples, np.full(power.shape[:-1], sky))

    def cases(self, name: str, share: float, energy: float, left_out: int | None = None) -> Cases:
        """Return the samples of a combination."""
        single = name == "single"
        pair = self.light(share, energy, left_out)
        chain = self.ranged(single, np.maximum(*pair))
        found = []
        for light in pair:
            power, sky = self.on_detectors(single, light)
            mean, covariance = sample_moments(
                chain, power, self.bin_width_ns, self.samples, np.full(power.shape[:-1], sky)
            )
            count, detectors, samples = mean.shape
            joint = np.zeros((count, detectors, samples, detectors, samples))
            for i in range(detectors):
                joint[:, i, :, i, :] = covariance[:, i]
            width = detectors * samples
            found += [mean.reshape(count, width), joint.reshape(count, width, width)]
        matrix = self.matrix(name, samples)
        return Cases(found[0], found[1], found[2], found[3], detectors).combined(matrix, len(matrix) // samples)

    def matrix(self, name: str, samples: int) -> FloatArray:
        """Return what a combination takes of the samples of all detectors."""
        pixels = self.bare.shape[1]
        taken = {
            "single": np.ones((1, 1)),
            "sum": np.ones((1, pixels)),
            "brightest": np.eye(pixels)[[self.brightest]],
            "best": np.eye(pixels),
        }
        return np.kron(taken[name], np.eye(samples))

    def draw(self, single: bool, light: FloatArray, chain: ReceiverChain, shots: int, seed: int) -> FloatArray:
        """Draw the samples of shots, shape (shots, cases, detectors * samples)."""
        power, sky = self.on_detectors(single, light)
        record = chain.apply(power, self.bin_width_ns, shots, seed, np.full(power.shape[:-1], sky))
        signal = record.signal[..., self.samples]
        return signal.reshape(*signal.shape[:2], -1).astype(np.float64)

    def needed(self, name: str, kind: str, pfa: float, pd: float) -> Level:
        """Return the share of the target's signal, or of the pulse's energy, that is detected as wanted."""
        from scipy.optimize import brentq
        from scipy.special import ndtri

        def margin(log: float, left_out: int | None = None) -> float:
            share, energy = (math.exp(log), 1.0) if kind == "target" else (1.0, math.exp(log))
            try:
                statistic = self.cases(name, share, energy, left_out).statistic()
            except ValueError:
                return -math.inf  # a detector that is blind at this level, as by dead time after the surface echo
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
    """Return the levels that are detected as wanted, and their gains over one detector for all."""
    data: Variables = {
        "deflection": ("combination", [trial.cases(name, 1, 1).statistic().deflection for name in COMBINATIONS])
    }
    for kind in ("target", "energy"):
        levels = [trial.needed(name, kind, pfa, pd) for name in COMBINATIONS]
        data |= _with_limits(f"needed_{kind}", [level.limits() for level in levels], "1")
        data |= _with_limits(f"gain_{kind}", [level.limits(levels[0]) for level in levels], "1")
    return data


def drawn(trial: Experiment, share: float, pfa: float, shots: int, seed: int) -> Variables:
    """Return rates of drawn shots with a share of the target's signal, and what the closed form expects."""
    count = len(trial.bare) if trial.seas else 1
    nominal = np.union1d(np.logspace(math.log10(min(1e-4, pfa / 3)), -0.05, 80), pfa)
    pair = trial.light(share, 1)
    records = {}
    for single in (True, False):
        chain = trial.ranged(single, np.maximum(*pair))
        records[single] = [
            trial.draw(single, light, chain, -(-shots // count), _seed(seed, single, which))
            for which, light in enumerate(pair)
        ]
    rates: dict[str, list[Any]] = {}
    for name in COMBINATIONS:
        statistic = trial.cases(name, share, 1).statistic()
        matrix = trial.matrix(name, trial.samples.stop - trial.samples.start)
        null, lit = (
            (np.einsum("nci,ci->nc", record @ matrix.T, statistic.weights) - statistic.offsets).ravel()
            for record in records[name == "single"]
        )
        thresholds = statistic.threshold(nominal)
        for key, found in (
            ("drawn_false_alarm", roc.exceedance(null, thresholds, CONFIDENCE)),
            ("drawn_detection", roc.exceedance(lit, thresholds, CONFIDENCE)),
        ):
            rates.setdefault(key, []).append(found)
        area = roc.area_under_curve(null, lit, CONFIDENCE)
        rates.setdefault("area", []).append((area.value, area.low, area.high))
        rates.setdefault("expected_area", []).append(statistic.area())
        rates.setdefault("expected_detection", []).append(statistic.detection(nominal))
    along = ("combination", "false_alarm")
    data: Variables = {
        "false_alarm": ("false_alarm", nominal),
        "expected_detection": (along, rates["expected_detection"]),
        "expected_area": ("combination", rates["expected_area"]),
        **_with_limits("area", rates["area"], "1"),
    }
    for key in ("drawn_false_alarm", "drawn_detection"):
        for i, end in enumerate(("", "_low", "_high")):
            data[key + end] = (along, np.array([found[i] for found in rates[key]]), {"units": "1"})
    return data


def depth_errors(trial: Experiment, shots: int, seed: int, pulse_fwhm_ns: float, metres_per_ns: float) -> Variables:
    """Return bias and spread of the depth of the echo of the scene as it is, by the matched filter's time."""
    steps = HALF_SEARCH * pulse_fwhm_ns * np.linspace(-1, 1, _DELAYS)
    bare, lit = trial.light(1, 1)
    count = len(bare)
    drawn_times: dict[str, FloatArray] = {}
    bounds = {}
    for single in (True, False):
        chain = trial.ranged(single, lit)
        record = trial.draw(single, lit, chain, -(-shots // count), _seed(seed, single, 2))
        for name in COMBINATIONS if not single else ("single",):
            if (name == "single") != single:
                continue
            cases = trial.cases(name, 1, 1)
            matrix = trial.matrix(name, trial.samples.stop - trial.samples.start)
            times = []
            for i in range(count):
                learnt = [i] if count == 1 else [k for k in range(count) if k != i]
                echo = _delayed(trial, single, chain, bare[learnt].mean(0), lit[learnt].mean(0), steps) @ matrix.T
                known = cases if count == 1 else cases.others(i)
                noise = known.covariance(with_target=True)
                times.append(delays(record[:, i] @ matrix.T - known.null_mean.mean(axis=0), echo, steps, noise))
            drawn_times[name] = metres_per_ns * np.array(times)
            bounds[name] = metres_per_ns * delay_bound(echo, steps, noise) if count == 1 else math.nan
    groups = {
        name: list(times) if count > 1 else np.array_split(times[0], _GROUPS) for name, times in drawn_times.items()
    }
    spreads = {name: _jackknife(groups[name], lambda all_: math.log(np.std(all_, ddof=1))) for name in COMBINATIONS}
    biases = {name: _jackknife(groups[name], lambda all_: float(np.mean(all_))) for name in COMBINATIONS}
    bias = []
    for name in COMBINATIONS:
        value, changes = biases[name]
        bias.append((value, value - _reach(changes), value + _reach(changes)))
    levels = {name: Level(*spreads[name]) for name in COMBINATIONS}
    gains = [levels[name].limits(levels["single"]) for name in COMBINATIONS]
    return {
        **_with_limits("depth_bias", bias, "m"),
        **_with_limits("depth_spread", [levels[name].limits() for name in COMBINATIONS], "m"),
        **_with_limits("depth_gain", gains, "1"),
        "depth_bound": ("combination", [bounds[name] for name in COMBINATIONS], {"units": "m"}),
    }


def by_depth(trials: Sequence[Experiment], places: Sequence[float], pfa: float, pd: float) -> Variables:
    """Return the share of the target's signal that is needed at each depth, and the depth at which it is 1."""
    table = [[trial.needed(name, "target", pfa, pd) for trial in trials] for name in COMBINATIONS]
    needed = np.array([[level.limits() for level in row] for row in table])
    reached = []
    for row in table:
        value = _crossing(places, [level.log for level in row])
        left_out = range(len(row[0].changes))
        changes = np.array([_crossing(places, [level.log + level.changes[i] for level in row]) for i in left_out])
        reach = _reach(changes)
        reached.append((value, value - reach, value + reach))
    data: Variables = {"depth": ("depth", list(places), {"units": "m"})}
    for i, end in enumerate(("", "_low", "_high")):
        data[f"needed_at_depth{end}"] = (("combination", "depth"), needed[..., i], {"units": "1"})
    return data | _with_limits("detectable_depth", reached, "m")


def _crossing(places: Sequence[float], logs: Sequence[float]) -> float:
    """Return where logarithms first rise through 0, NaN where they do not."""
    for i in range(len(places) - 1):
        if logs[i] <= 0 < logs[i + 1]:
            share = 1.0 if math.isinf(logs[i + 1]) else -logs[i] / (logs[i + 1] - logs[i])
            return places[i] + share * (places[i + 1] - places[i])
    return math.nan


def _delayed(
    trial: Experiment, single: bool, chain: ReceiverChain, bare: FloatArray, lit: FloatArray, steps: FloatArray
) -> FloatArray:
    """Return what an echo adds to the samples at delays, shape (delays, detectors * samples)."""
    from scipy.interpolate import CubicSpline

    bins = np.arange(bare.shape[-1])
    moved = CubicSpline(bins, lit - bare, axis=-1)(np.clip(bins - steps[:, None] / trial.bin_width_ns, 0, bins[-1]))
    powers = np.concatenate([bare[None], np.maximum(bare + np.moveaxis(moved, 1, 0), 0)])
    power, sky = trial.on_detectors(single, powers)
    mean = chain.expected(power, trial.bin_width_ns, np.full(power.shape[:-1], sky)).mean[..., trial.samples]
    samples = mean.reshape(len(mean), -1)
    return np.asarray(samples[1:] - samples[0])


def _jackknife(groups: Sequence[FloatArray], measure: Callable[[FloatArray], float]) -> tuple[float, FloatArray]:
    """Return a measure of all groups, and what leaving out each adds to it."""
    value = measure(np.concatenate(groups))
    rest = [measure(np.concatenate([*groups[:i], *groups[i + 1 :]])) for i in range(len(groups))]
    return value, np.array(rest) - value


def _reach(changes: FloatArray) -> float:
    """Return half the width of a confidence interval from a jackknife's changes, by Student's t."""
    from scipy.stats import t

    count = len(changes)
    error = math.sqrt((count - 1) / count * float(np.sum((changes - changes.mean()) ** 2)))
    return float(t.ppf((1 + CONFIDENCE) / 2, count - 1)) * error


def _with_limits(name: str, values: Sequence[tuple[float, float, float]], unit: str) -> Variables:
    """Return a variable over combinations, and the limits of its interval."""
    table = np.array(values, dtype=np.float64)
    return {
        f"{name}{end}": ("combination", table[:, i], {"units": unit}) for i, end in enumerate(("", "_low", "_high"))
    }


def _seed(seed: int, single: bool, which: int) -> int:
    """Return the seed of a record's noise, another one for each."""
    return int(np.random.SeedSequence([seed, int(single), which]).generate_state(1, np.uint32)[0])
