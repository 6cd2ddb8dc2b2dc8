"""The water column's signal: its attenuation, and layers where that changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, non_negative, whole
from .echoes import IntArray, Records

BoolArray = npt.NDArray[np.bool_]

_FEWEST = 8  # bins that a column's fit needs
_SEGMENT = 4  # fewest bins on either side of a change
_CLEAR = 6.0  # least ratio of signal to noise of a bin whose logarithm is used
_RUN = 7  # bins of the running mean that weighs a logarithm


@dataclass(frozen=True)
class ColumnFit:
    """Exponential signals of water columns; shape (n,) each, NaN where there is no column.

    Attributes
    ----------
    level, level_stderr
        Signal at the surface, extrapolated [unit of the record].
    decay, decay_stderr
        Rate at which it falls with the delay [1/ns].
    correlation
        Correlation of the errors of the two.
    chi2
        Squared residuals in units of the noise, a degree of freedom.
    bins
        Number of bins used.
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

    Weighted least squares in the power itself, from a start in its logarithm: noise does not bend it.

    Parameters
    ----------
    records : Records
        The waveforms.
    start_ns, end_ns : array_like, shape (n,)
        First and last bin centres to use [ns]; NaN for no column.
    surface_ns : array_like, shape (n,)
        Arrival of the surface echo [ns].
    gain : array_like, shape () or (n, time)
        What distance and refraction leave of the signal, in any unit.

    Returns
    -------
    ColumnFit
        Known where at least 8 bins are in the column and the signal falls or rises within reason.
    """
    start, end, surface = (np.asarray(v, dtype=np.float64)[:, np.newaxis] for v in (start_ns, end_ns, surface_ns))
    delay = records.time_ns - np.nan_to_num(surface)
    inside = (records.time_ns >= start) & (records.time_ns <= end)
    shape = np.broadcast_to(finite_array("gain", gain), records.power.shape)
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
    errors = np.sqrt(np.einsum("nii->ni", covariance))
    known = enough & np.isfinite(errors).all(axis=1) & (errors[:, 0] < 1) & (level > 0)
    correlation = covariance[:, 0, 1] / errors.prod(axis=1)
    numbers = [level, level * errors[:, 0], rate, errors[:, 1], correlation, residual]
    level, level_error, rate, rate_error, correlation, residual = (np.where(known, one, np.nan) for one in numbers)
    return ColumnFit(level, level_error, rate, rate_error, correlation, residual, np.where(known, count, 0))


def _normal(
    weights: FloatArray, parts: tuple[FloatArray, FloatArray], residual: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations of two parameters, regular even where there are no samples."""
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
    positive_ = inside & (power > 0)
    weights = np.where(positive_, (power / noise) ** 2, 0)
    log = np.log(np.where(positive_, power, 1.0))
    normal, right = _normal(weights, (positive_.astype(np.float64), np.where(positive_, -delay, 0)), log)
    c = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
    return np.exp(np.clip(c[:, 0], -700, 700)), np.clip(c[:, 1], -2, 2)


@dataclass(frozen=True)
class ChangePoints:
    """Where the exponentials of the columns change, the strongest change first; shape (n, layers).

    Attributes
    ----------
    time_ns
        Times of the changes [ns], NaN where nothing is left to search.
    p_value
        Upper bound of the chance that noise alone makes as strong a change anywhere in the bins searched.
    step
        Logarithm of the signal behind the change over that before it.
    decay_before, decay_after
        Rates of the exponentials on both sides [1/ns].
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
    """Test columns for places where their exponential changes in level or rate.

    Two lines through the logarithms, before and behind every bin in turn, are compared with one through both. Where
    noise alone is at work, the weighted squares fall by more than x for the two more parameters with the chance
    exp(-x/2) at one place, and with N exp(-x/2) at most at any of N (Bonferroni). Further changes are sought between
    those already found
    (binary segmentation; Scott and Knott 1974, Biometrics 30, 507-512).

    Parameters
    ----------
    records : Records
        The waveforms. Bins from the first on in which the signal is less than six times the noise are left out.
    start_ns, end_ns : array_like, shape (n,)
        First and last bin centres of the column [ns]; NaN for no column.
    gain : array_like, shape () or (n, time)
        What distance and refraction leave of the signal.
    layers : int
        How many changes to seek, 1 to 8.
    model_error : float
        How far a homogeneous column is from an exponential, relative, at least 0: it counts as noise.
    blur_ns : float
        How long pulse and beam make a sudden change [ns], at least 0: as many bins about it are left out.

    Returns
    -------
    ChangePoints

    Raises
    ------
    ValueError
        If a number is out of range.
    """
    layers, model_error = whole("layers", layers, 1, 8), non_negative("model_error", model_error)
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
            # The half before the change takes the segment's place; the other one is new.
            hit = which == index
            old_low, old_high = segments[index]
            segments[index] = (old_low, np.where(hit, np.maximum(place - gap, old_low), old_high))
            segments.append((np.where(hit, np.minimum(place + gap, old_high), old_high), old_high))
        if len(found) < layers:
            splits = [sums.best_split(a, b) for a, b in segments]
    return ChangePoints(*(np.stack(values, axis=1) for values in zip(*found, strict=True)))


@dataclass(frozen=True)
class _Sums:
    """Running sums from which lines through runs of bins follow; shape (6, n, bins + 1)."""

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
        shape = np.broadcast_to(finite_array("gain", gain), records.power.shape)[:, part]
        mean = uniform_filter1d(power, _RUN, axis=1, mode="nearest")
        clear = (mean > _CLEAR * noise) & (power > 0)
        member = inside[:, part]
        # A column ends where it meets the noise, even if an echo rises behind that.
        usable = member & np.logical_and.accumulate(clear | ~member, axis=1)
        relative = np.where(usable, noise / np.where(usable, mean, 1.0), 1.0)
        # The mean of a noisy value's logarithm is less than the logarithm of its mean.
        y = np.where(usable, np.log(np.where(usable, power / shape, 1.0)) + 0.5 * relative**2, 0)
        # Numbers near zero keep the sums exact.
        y = np.where(usable, y - (y.sum(axis=1) / np.maximum(usable.sum(axis=1), 1))[:, np.newaxis], 0)
        w = np.where(usable, 1 / (relative**2 + model_error**2), 0)
        x = np.arange(power.shape[1]) - 0.5 * power.shape[1]
        terms = np.stack([w, w * x, w * x * x, w * y, w * x * y, w * y * y])
        return cls(np.cumsum(np.pad(terms, ((0, 0), (0, 0), (1, 0))), axis=2), usable, records.bin_ns, gap)

    def squares(self, part: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return weighted squares about the line of runs with these sums (6, ...), its slope, and centre (x, y)."""
        w, wx, wxx, wy, wxy, wyy = part
        total = np.where(w > 0, w, 1.0)
        spread = wxx - wx**2 / total
        mixed = wxy - wx * wy / total
        slope = np.where(spread > 0, mixed / np.where(spread > 0, spread, 1.0), 0.0)
        return wyy - wy**2 / total - slope * mixed, slope, wx / total, wy / total

    def best_split(self, low: IntArray, high: IntArray) -> tuple[FloatArray, IntArray]:
        """Return by how much the best split of the bins [low, high) lowers the squares, and its place; shape (n,)."""
        places = np.arange(self.sums.shape[2])
        at_low, at_high = (
            np.take_along_axis(self.sums, edge[np.newaxis, :, np.newaxis], axis=2) for edge in (low, high)
        )
        gap = self.gap
        left = self.sums[..., np.maximum(places - gap, 0)] - at_low
        right = at_high - self.sums[..., np.minimum(places + gap, places[-1])]
        split = self.squares(left)[0] + self.squares(right)[0]
        whole_ = self.squares(left + right)[0]
        room = _SEGMENT + gap
        allowed = (places >= low[:, np.newaxis] + room) & (places <= high[:, np.newaxis] - room)
        fall = np.where(allowed, whole_ - split, -np.inf)
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
