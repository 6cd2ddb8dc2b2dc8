"""Fits of the water column's signal: its attenuation, and changes between layers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.waveforms.echo_detection import (
    BoolArray,
    Echoes,
    EchoFlag,
    IntArray,
    Records,
    error_of_sums,
)
from mitransient_lidar.core.validation import FloatArray, integer, non_negative

_FEWEST = 8  # bins of a column's fit
_SEGMENT = 4  # fewest bins on either side of a change
_CLEAR = 6.0  # smallest signal-to-noise ratio of a bin whose logarithm is used
_OF_TAILS = 0.3  # error of the tails of echoes between which a column is short
_STEEPEST = 5.0  # decay of a short column over the typical one
_RUN = 7  # bins of the running mean from which a logarithm is weighted


@dataclass(frozen=True)
class ColumnFit:
    """Exponential signals of water columns; shape (n,) each, NaN without a column.

    Signal extrapolated to the surface [record's unit], decay rate [1/ns], error correlation, squared residuals in noise
    units per degree of freedom, and number of bins.
    """

    level: FloatArray
    level_stderr: FloatArray
    decay: FloatArray
    decay_stderr: FloatArray
    correlation: FloatArray
    chi2: FloatArray
    bins: IntArray


def column_fit(
    records: Records,
    start_ns: npt.ArrayLike,
    end_ns: npt.ArrayLike,
    surface_ns: npt.ArrayLike,
    gain: npt.ArrayLike = 1.0,
) -> ColumnFit:
    """Fit P(t) = gain(t) level exp(-decay (t - t_surface)) to the bins of a column.

    Weighted least squares in the power, unbiased, started from a fit of logarithms.

    Parameters
    ----------
    records : Records
        The waveforms.
    start_ns, end_ns, surface_ns : array_like, shape (n,)
        First and last bin centres to use, NaN without a column, and arrival of the surface echo [ns].
    gain : array_like, shape () or (n, time)
        Relative signal by distance and refraction, in any unit.

    Returns
    -------
    ColumnFit
        NaN for columns below 8 bins, and without a positive level whose error is below 100 %.
    """
    start, end, surface = (np.asarray(v, dtype=np.float64)[:, np.newaxis] for v in (start_ns, end_ns, surface_ns))
    delay = records.time_ns - np.nan_to_num(surface)
    inside = (records.time_ns >= start) & (records.time_ns <= end)
    shape = np.broadcast_to(np.asarray(gain), records.power.shape)
    count = inside.sum(axis=1)
    enough = count >= _FEWEST
    scaled = np.where(inside, records.power / shape, 0)
    noise = np.broadcast_to(records.noise, records.power.shape) / shape
    level, rate = _log_line(delay, scaled, noise, inside)
    weights = np.where(inside, 1 / noise**2, 0)
    for _ in range(4):
        model = level[:, np.newaxis] * np.exp(np.clip(-rate[:, np.newaxis] * delay, -60, 60))
        parts = (np.where(inside, model, 0), np.where(inside, -delay * model, 0))
        normal, right = _normal(weights, parts, scaled - parts[0])
        step = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
        level = level * (1 + np.clip(step[:, 0], -0.9, 2))
        rate = rate + np.clip(step[:, 1], -0.5, 0.5)
    covariance = np.linalg.inv(normal)
    residual = np.sum(weights * (scaled - parts[0]) ** 2, axis=1) / np.maximum(count - 2, 1)
    if records.shared is not None:
        # The fit weights samples as independent ones; the errors that it states have their correlation.
        weighted = np.stack(parts, axis=1) * np.where(inside, 1 / noise, 0.0)[:, np.newaxis]
        covariance = records.shared.covariance(covariance @ weighted)
    errors = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0))
    known = enough & np.isfinite(errors).all(axis=1) & (errors[:, 0] < 1) & (level > 0)
    product = errors.prod(axis=1)
    correlation = covariance[:, 0, 1] / np.where(known & (product > 0), product, 1.0)
    numbers = [level, level * errors[:, 0], rate, errors[:, 1], correlation, residual]
    level, level_error, rate, rate_error, correlation, residual = (np.where(known, one, np.nan) for one in numbers)
    return ColumnFit(level, level_error, rate, rate_error, correlation, residual, np.where(known, count, 0))


def column_echoes(records: Records, column: ColumnFit, start: FloatArray, end: FloatArray, delay: FloatArray) -> Echoes:
    """Return the columns between two times as echoes, with their level at a delay [ns] from the fits' reference."""
    inside = (records.time_ns >= start[:, np.newaxis]) & (records.time_ns <= end[:, np.newaxis])
    power, noise = np.where(inside, records.power, 0), np.where(inside, records.noise, 0)
    total = np.sum(power, axis=1)
    safe = np.where(total > 0, total, 1.0)
    seconds = records.bin_ns * 1e-9
    time = np.sum(power * records.time_ns, axis=1) / safe
    # Noise alone may have a level, but its centroid is anywhere.
    known = np.isfinite(column.level) & (total > 0) & (time >= start) & (time <= end)
    time_error = error_of_sums(noise * (records.time_ns - time[:, np.newaxis]), None, records.shared) / safe
    level = column.level * np.exp(-column.decay * delay)
    relative = column.level_stderr / column.level
    mixed = 2 * column.correlation * relative * delay * column.decay_stderr
    level_error = level * np.sqrt(np.maximum(relative**2 + (delay * column.decay_stderr) ** 2 - mixed, 0))
    # A column that does not decay has no width.
    decay = np.where(column.decay > 0, column.decay, np.nan)
    half = np.log(2) / decay
    return Echoes(
        time,
        level,
        total * seconds,
        half,
        time_error,
        level_error,
        error_of_sums(noise, None, records.shared) * seconds,
        half * column.decay_stderr / decay,
        np.where(known, 0, int(EchoFlag.NO_ECHO)),
    ).known_only(known)


def column_between(
    records: Records, echoes: list[Echoes], width_ns: float, surface_ns: FloatArray, decay: float
) -> FloatArray:
    """Return the signals of columns too short for a fit at the surface, shape (n,); NaN without samples.

    They are means over the samples between the surface and the last echo, less the tails of all echoes, which are not
    wider than expected. A sample counts by its noise and 0.3 of the tails. The decay is that of the samples, one to
    five times a typical one [1/ns].
    """
    time = records.time_ns[np.newaxis]
    inside = (time > surface_ns[:, np.newaxis]) & (time < echoes[-1].time_ns[:, np.newaxis])
    tails = np.zeros(records.power.shape)
    for one in echoes:
        apart = (time - one.time_ns[:, np.newaxis]) / np.minimum(one.width_ns, width_ns)[:, np.newaxis]
        tails += np.nan_to_num(one.amplitude[:, np.newaxis] * np.exp(-4 * np.log(2) * apart**2))
    weight = np.where(inside, 1 / (records.noise**2 + (_OF_TAILS * tails) ** 2), 0)
    total = np.maximum(weight.sum(axis=1), 1e-300)
    weight /= total[:, np.newaxis]
    rest, delay = records.power - tails, np.where(inside, time - surface_ns[:, np.newaxis], 0)
    mean, centre = np.sum(weight * rest, axis=1), np.sum(weight * delay, axis=1)
    apart = delay - centre[:, np.newaxis]
    falls = -np.sum(weight * rest * apart, axis=1) / np.maximum(mean * np.sum(weight * apart**2, axis=1), 1e-300)
    return np.where(inside.any(axis=1), mean * np.exp(np.clip(falls, decay, _STEEPEST * decay) * centre), np.nan)


def _normal(
    weights: FloatArray, parts: tuple[FloatArray, FloatArray], residual: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations of two parameters, regular even without samples."""
    one, two = parts
    terms = [np.sum(weights * a * b, axis=1) for a, b in ((one, one), (one, two), (two, two))]
    empty = terms[0] * terms[2] - terms[1] ** 2 <= 1e-12 * terms[0] * terms[2]
    diagonal = [np.where(empty, 1.0, term) for term in (terms[0], terms[2])]
    mixed = np.where(empty, 0.0, terms[1])
    normal = np.stack([np.stack([diagonal[0], mixed], 1), np.stack([mixed, diagonal[1]], 1)], axis=1)
    right = np.stack([np.sum(weights * part * residual, axis=1) for part in parts], axis=1)
    return normal, np.where(empty[:, np.newaxis], 0.0, right)


def _log_line(
    delay: FloatArray, power: FloatArray, noise: FloatArray, inside: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return level and decay rate from a line through the logarithms, shape (n,)."""
    usable = inside & (power > 0)
    weights = np.where(usable, (power / noise) ** 2, 0)
    log = np.log(np.where(usable, power, 1.0))
    normal, right = _normal(weights, (usable.astype(np.float64), np.where(usable, -delay, 0)), log)
    c = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
    return np.exp(np.clip(c[:, 0], -700, 700)), np.clip(c[:, 1], -2, 2)


@dataclass(frozen=True)
class ChangePoints:
    """Changes in the columns' exponentials, the strongest first; shape (n, layers).

    Times of the changes [ns], NaN without further bins, and upper probability bounds that noise alone causes as strong
    a change in any bin. Further the log ratio between the signals after and before the change, and decay rates [1/ns].
    """

    time_ns: FloatArray
    p_value: FloatArray
    step: FloatArray
    decay_before: FloatArray
    decay_after: FloatArray


def change_points(
    records: Records,
    start_ns: npt.ArrayLike,
    end_ns: npt.ArrayLike,
    gain: npt.ArrayLike = 1.0,
    *,
    layers: int = 1,
    model_error: float = 0.02,
    blur_ns: float = 0.0,
) -> ChangePoints:
    """Test columns for changes in level or rate of their exponential.

    At every bin, two lines through the logarithms before and behind it are compared with one line through both. With
    noise alone, the two additional parameters lower the weighted squares by more than x with the probability exp(-x/2)
    at one bin. At any of N bins the probability is at most N exp(-x/2) (Bonferroni). Further changes are searched for
    between those already found (binary segmentation; Scott and Knott 1974, Biometrics 30, 507-512).

    Parameters
    ----------
    records : Records
        The waveforms, up to the first bin whose signal is below six times the noise.
    start_ns, end_ns : array_like, shape (n,)
        First and last bin centres of the column [ns]; NaN without a column.
    gain : array_like, shape () or (n, time)
        Relative signal by distance and refraction.
    layers : int
        Number of changes to search for, 1 to 8.
    model_error : float
        Relative deviation of a homogeneous column from an exponential, at least 0; it is added to the noise.
    blur_ns : float
        Duration of a sudden change after pulse and beam [ns], at least 0: the bins within it are excluded.

    Raises
    ------
    UserError
        If a number is out of range.
    """
    layers, model_error = integer("layers", layers, 1, 8), non_negative("model_error", model_error)
    start, end = (np.asarray(v, dtype=np.float64)[:, np.newaxis] for v in (start_ns, end_ns))
    inside = (records.time_ns >= start) & (records.time_ns <= end)
    held = np.flatnonzero(inside.any(axis=0))
    count = len(records.power)
    if not held.size:
        unknown = np.full((count, layers), np.nan)
        return ChangePoints(unknown, np.ones((count, layers)), unknown, unknown, unknown)
    part = slice(held[0], held[-1] + 1)
    gap = int(0.5 * non_negative("blur_ns", blur_ns) / records.bin_ns)
    sums = _Sums.of(records, part, inside, gain, model_error, gap)
    first = np.argmax(sums.usable, axis=1)
    last = np.where(sums.usable.any(axis=1), sums.usable.shape[1] - np.argmax(sums.usable[:, ::-1], axis=1), first)
    segments = [(first, last)]
    splits = [sums.best_split(first, last)]
    found = []
    for _ in range(layers):
        gains = np.stack([fall for fall, _ in splits])
        which = np.argmax(gains, axis=0)
        rows = np.arange(count)
        place = np.stack([at for _, at in splits])[which, rows]
        low = np.stack([a for a, _ in segments])[which, rows]
        high = np.stack([b for _, b in segments])[which, rows]
        found.append(sums.describe(records.time_ns[part], gains.max(axis=0), low, place, high))
        for index in range(len(segments)):
            # The part before the change replaces the segment; the other one is appended.
            hit = which == index
            old_low, old_high = segments[index]
            segments[index] = (old_low, np.where(hit, np.maximum(place - gap, old_low), old_high))
            segments.append((np.where(hit, np.minimum(place + gap, old_high), old_high), old_high))
        if len(found) < layers:
            splits = [sums.best_split(a, b) for a, b in segments]
    return ChangePoints(*(np.stack(values, axis=1) for values in zip(*found, strict=True)))


@dataclass(frozen=True)
class _Sums:
    """Cumulative sums for lines through runs of bins; shape (6, n, bins + 1)."""

    sums: FloatArray
    usable: BoolArray
    step_ns: float
    gap: int

    @classmethod
    def of(
        cls, records: Records, part: slice, inside: BoolArray, gain: npt.ArrayLike, model_error: float, gap: int
    ) -> _Sums:
        from scipy.ndimage import uniform_filter1d

        power = records.power[:, part]
        noise = np.broadcast_to(records.noise, records.power.shape)[:, part]
        shape = np.broadcast_to(np.asarray(gain), records.power.shape)[:, part]
        mean = uniform_filter1d(power, _RUN, axis=1, mode="nearest")
        clear = (mean > _CLEAR * noise) & (power > 0)
        member = inside[:, part]
        # A column ends where it is below the noise, even before an echo.
        usable = member & np.logical_and.accumulate(clear | ~member, axis=1)
        relative = np.where(usable, noise / np.where(usable, mean, 1.0), 1.0)
        # The mean logarithm of a noisy value is less than the logarithm of its mean.
        y = np.where(usable, np.log(np.where(usable, power / shape, 1.0)) + 0.5 * relative**2, 0)
        # Centred values keep the sums exact.
        y = np.where(usable, y - (y.sum(axis=1) / np.maximum(usable.sum(axis=1), 1))[:, np.newaxis], 0)
        w = np.where(usable, 1 / (relative**2 + model_error**2), 0)
        x = np.arange(power.shape[1]) - 0.5 * power.shape[1]
        terms = np.stack([w, w * x, w * x * x, w * y, w * x * y, w * y * y])
        return cls(np.cumsum(np.pad(terms, ((0, 0), (0, 0), (1, 0))), axis=2), usable, records.bin_ns, gap)

    def squares(self, part: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the weighted squares about the line through runs with these sums (6, ...), its slope and centre."""
        w, wx, wxx, wy, wxy, wyy = part
        total = np.where(w > 0, w, 1.0)
        spread = wxx - wx**2 / total
        mixed = wxy - wx * wy / total
        slope = np.where(spread > 0, mixed / np.where(spread > 0, spread, 1.0), 0.0)
        return wyy - wy**2 / total - slope * mixed, slope, wx / total, wy / total

    def best_split(self, low: IntArray, high: IntArray) -> tuple[FloatArray, IntArray]:
        """Return how much the best split of bins [low, high) lowers the squares, and its bin; shape (n,)."""
        places = np.arange(self.sums.shape[2])
        at_low, at_high = (
            np.take_along_axis(self.sums, edge[np.newaxis, :, np.newaxis], axis=2) for edge in (low, high)
        )
        gap = self.gap
        left = self.sums[..., np.maximum(places - gap, 0)] - at_low
        right = at_high - self.sums[..., np.minimum(places + gap, places[-1])]
        split = self.squares(left)[0] + self.squares(right)[0]
        joint = self.squares(left + right)[0]
        room = _SEGMENT + gap
        allowed = (places >= low[:, np.newaxis] + room) & (places <= high[:, np.newaxis] - room)
        fall = np.where(allowed, joint - split, -np.inf)
        return fall.max(axis=1), np.argmax(fall, axis=1)

    def describe(
        self, time_ns: FloatArray, fall: FloatArray, low: IntArray, place: IntArray, high: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return time, p-value, step and the two rates of a change before the bin `place`."""
        rows = np.arange(len(place))
        ends = (low, np.maximum(place - self.gap, 0), np.minimum(place + self.gap, self.sums.shape[2] - 1), high)
        at = [self.sums[:, rows, edge] for edge in ends]
        _, slope, x, y = self.squares(at[1] - at[0])
        _, slope_after, x_after, y_after = self.squares(at[3] - at[2])
        known = np.isfinite(fall)
        edge = place - 0.5 - 0.5 * (self.sums.shape[2] - 1)
        step = (y_after + slope_after * (edge - x_after)) - (y + slope * (edge - x))
        tested = np.maximum(high - low - 2 * (_SEGMENT + self.gap) + 1, 1)
        p_value = np.where(known, np.minimum(tested * np.exp(-0.5 * np.maximum(np.where(known, fall, 0), 0)), 1), 1)
        time = time_ns[np.clip(place, 1, time_ns.size) - 1] + 0.5 * self.step_ns
        numbers = (step, -slope / self.step_ns, -slope_after / self.step_ns)
        step, before, after = (np.where(known, value, np.nan) for value in numbers)
        return np.where(known, time, np.nan), p_value, step, before, after
