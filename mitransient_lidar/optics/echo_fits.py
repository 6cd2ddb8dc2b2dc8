"""Gaussian decomposition: echoes and the water column around them fitted together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, positive
from .echo_readings import known_only
from .echoes import Echoes, EchoFlag, IntArray, Records

BoolArray = npt.NDArray[np.bool_]
Model = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_FWHM = float(np.sqrt(8 * np.log(2)))
_ITERATIONS = 30
_TOLD = 9.0  # fall of the squared residuals by which a height of the surface's own is told from the column's onset
_PLAIN = 10.0  # standard errors of a height above which that is not asked
_HEIGHTS = np.array([0.0, 0.05, 0.12, 0.25, 0.45])  # of the peak, tried where the height is not told


def gaussian_surface(
    records: Records, bins: IntArray, echo_fwhm_ns: float, decay: npt.ArrayLike, flags: IntArray
) -> Echoes:
    """Fit a surface echo together with the water column that begins at it.

    The model is A exp(-u^2/(2 s^2)) plus a column C exp(-k u) from u = 0 on that has been blurred by the same Gaussian,
    where u is the time since the surface's: the two share their time and their width s. It is fitted from two echo
    widths before the peak to two after it, and finds the surface where the peak itself is that of the column.

    A surface that is low beside its column is nearly as well fitted without A and one or two nanoseconds earlier. Where
    A lowers the squared residuals by less than 9, the result is therefore the mean over fits with given A, 0 to 0.45 of
    the peak, weighted with their likelihood and with even odds that A = 0; the errors hold how far these fits differ.

    Parameters
    ----------
    records : Records
        The waveforms.
    bins : ndarray of int, shape (n,)
        Bins of the surface peaks.
    echo_fwhm_ns : float
        Expected width of the echo [ns], above 0.
    decay : array_like, shape () or (n,)
        Rate k at which the column falls [1/ns], at least 0.
    flags : ndarray of int, shape (n,)
        `EchoFlag` of the echoes; those without an echo are left out.

    Returns
    -------
    Echoes
        Amplitude, energy and width are those of the Gaussian A: what the surface itself returns.
    """
    width = positive("echo_fwhm_ns", echo_fwhm_ns)
    rate = np.broadcast_to(finite_array("decay", decay), bins.shape)
    u, power, noise, usable = _samples(records, bins, -2 * width, 2 * width)
    peak = np.max(np.where(usable & (np.abs(u) < 0.5 * width), power, 0), axis=1)
    start = np.stack([np.full(peak.shape, -0.3 * width), np.full(peak.shape, width / _FWHM), 0.5 * peak, 0.7 * peak], 1)

    def model(p: FloatArray, u: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import ndtr

        time, s, height, level = (p[:, i : i + 1] for i in range(4))
        v = u - time
        z = v / s
        gauss = np.exp(-0.5 * z**2)
        onset = np.exp(0.5 * (k * s) ** 2 - k * v) * ndtr(z - k * s)
        # d/dv of the blurred column is its Gaussian edge less k of itself.
        edge = gauss / (np.sqrt(2 * np.pi) * s)
        by_time = height * gauss * z / s + level * (k * onset - edge)
        by_s = height * gauss * z**2 / s + level * (k**2 * s * onset - edge * (z + k * s))
        return height * gauss + level * onset, np.stack([by_time, by_s, gauss, onset], axis=1)

    exists = (flags & int(EchoFlag.NO_ECHO)) == 0
    fit = _fit(model, start, u, power, noise, usable, rate[:, np.newaxis], width, peak, exists)
    error = np.sqrt(fit.covariance[:, 2, 2])
    weak = exists & ~(fit.good & (fit.values[:, 2] > _PLAIN * error))
    some = fit.good & (fit.values[:, 2] > error)
    tried: list[_Fit] = []
    for share in _HEIGHTS:
        if not weak.any():
            return _echoes(records, bins, fit, flags)
        held = np.where(weak, share * peak, np.nan)
        tried.append(_fit(model, start, u, power, noise, usable, rate[:, np.newaxis], width, peak, weak, held))
        start = np.where(tried[-1].good[:, np.newaxis], tried[-1].values, start)
        weak &= ~some | (tried[0].cost <= fit.cost + _TOLD)
    fit = fit.or_where(weak, _mean(tried))
    return _echoes(records, bins, fit, flags)


def gaussian_echo(
    records: Records,
    bins: IntArray,
    echo_fwhm_ns: float,
    decay: npt.ArrayLike,
    flags: IntArray,
    *,
    after: IntArray | None = None,
) -> Echoes:
    """Fit an echo on a column that it cuts off.

    The model is A exp(-u^2/(2 s^2)) plus a column of one level before and another one behind the echo, both falling as
    exp(-k u), with a step between them that has the blur of the echo. It is fitted from two echo widths before the peak
    to one and a half after it, behind the surface echo.

    Parameters
    ----------
    records, bins, echo_fwhm_ns, decay, flags
        As for `gaussian_surface`.
    after : ndarray of int, shape (n,), optional
        Bins of the surface peaks: samples less than an echo width behind them are left out.

    Returns
    -------
    Echoes
    """
    width = positive("echo_fwhm_ns", echo_fwhm_ns)
    rate = np.broadcast_to(finite_array("decay", decay), bins.shape)
    u, power, noise, usable = _samples(records, bins, -2 * width, 1.5 * width)
    if after is not None:
        first = (np.minimum(after + width / records.bin_ns, 0.5 * (after + bins)) - bins) * records.bin_ns
        usable &= u >= first[:, np.newaxis]
    peak = np.max(np.where(usable & (np.abs(u) < 0.5 * width), power, 0), axis=1)
    early = np.argmax(usable, axis=1)
    before = np.maximum(np.take_along_axis(power, early[:, np.newaxis], axis=1)[:, 0], 0)
    before = np.minimum(before, 0.5 * peak)
    start = np.stack([0 * peak, np.full(peak.shape, width / _FWHM), peak, before, 0 * peak], axis=1)

    def model(p: FloatArray, u: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray]:
        from scipy.special import ndtr

        time, s, height, level, behind = (p[:, i : i + 1] for i in range(5))
        v = u - time
        z = v / s
        gauss, passed, fall = np.exp(-0.5 * z**2), ndtr(z), np.exp(-k * v)
        column = fall * (level + (behind - level) * passed)
        edge = fall * (behind - level) * gauss / (np.sqrt(2 * np.pi) * s)
        by_time = height * gauss * z / s + k * column - edge
        by_s = height * gauss * z**2 / s - edge * z
        jacobian = np.stack([by_time, by_s, gauss, fall * (1 - passed), fall * passed], axis=1)
        return height * gauss + column, jacobian

    exists = (flags & int(EchoFlag.NO_ECHO)) == 0
    fit = _fit(model, start, u, power, noise, usable, rate[:, np.newaxis], width, peak, exists)
    return _echoes(records, bins, fit, flags)


@dataclass(frozen=True)
class _Fit:
    """Parameters (n, p), their covariance (n, p, p), squared residuals and whether the fit has converged (n,)."""

    values: FloatArray
    covariance: FloatArray
    cost: FloatArray
    good: BoolArray

    def or_where(self, other: BoolArray, fit: _Fit) -> _Fit:
        """Return this fit with another one in some rows."""
        return _Fit(
            np.where(other[:, np.newaxis], fit.values, self.values),
            np.where(other[:, np.newaxis, np.newaxis], fit.covariance, self.covariance),
            np.where(other, fit.cost, self.cost),
            np.where(other, fit.good, self.good),
        )


def _mean(tried: list[_Fit]) -> _Fit:
    """Return the mean of fits at the heights `_HEIGHTS`, each weighted with its likelihood."""
    cost = np.stack([np.where(fit.good, fit.cost, np.inf) for fit in tried])
    good = np.isfinite(cost).any(axis=0)
    likelihood = np.exp(-0.5 * (cost - np.where(good, cost.min(axis=0), 0)))
    # Even odds for no height at all, and as much shared by all heights alike.
    share = np.gradient(_HEIGHTS)
    share[[0, -1]] *= 0.5
    share /= share.sum()
    share[0] += 1
    weight = share[:, np.newaxis] * likelihood
    weight /= np.where(good, weight.sum(axis=0), 1.0)
    values = np.stack([fit.values for fit in tried])
    mean = np.einsum("jn,jnp->np", weight, values)
    apart = values - mean
    within = np.stack([np.where(fit.good[:, np.newaxis, np.newaxis], fit.covariance, 0) for fit in tried])
    covariance = np.einsum("jn,jnpq->npq", weight, within + apart[..., :, np.newaxis] * apart[..., np.newaxis, :])
    return _Fit(mean, covariance, cost.min(axis=0), good)


def _samples(
    records: Records, bins: IntArray, low: float, high: float
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return times from the peaks (bins,), and power, noise and whether the record holds them, (n, bins)."""
    lags = np.arange(int(np.floor(low / records.bin_ns)), int(np.ceil(high / records.bin_ns)) + 1)
    places = bins[:, np.newaxis] + lags
    clipped = np.clip(places, 0, records.time_ns.size - 1)
    power = np.take_along_axis(records.power, clipped, axis=1)
    noise = np.take_along_axis(np.broadcast_to(records.noise, records.power.shape), clipped, axis=1)
    return np.asarray(lags * records.bin_ns, dtype=np.float64), power, noise, places == clipped


def _fit(
    model: Model,
    start: FloatArray,
    u: FloatArray,
    power: FloatArray,
    noise: FloatArray,
    usable: BoolArray,
    rate: FloatArray,
    width: float,
    scale: FloatArray,
    wanted: BoolArray,
    held: FloatArray | None = None,
) -> _Fit:
    """Fit a model to many windows at once by Levenberg and Marquardt's damped least squares.

    Heights that are not NaN in `held`, shape (n,), stay as they are there.
    """
    count, size = start.shape
    held = np.full(count, np.nan) if held is None else held
    fixed = np.isfinite(held)
    wanted = wanted & (np.count_nonzero(usable, axis=1) > size + 1) & (scale > 0)
    scale = np.where(scale > 0, scale, 1.0)
    values = start.copy()
    values[fixed, 2] = held[fixed]
    covariance = np.full((count, size, size), np.nan)
    good = np.zeros(count, dtype=bool)
    damping = np.full(count, 1e-3)
    # Fits with given heights are only compared: nothing in them is as flat as time against height.
    enough = np.where(fixed, 1e-3, 1e-9)
    weights = np.where(usable, 1 / noise, 0.0)
    unit = np.ones((count, size))
    unit[:, :2] = width
    unit[:, 2:] = scale[:, np.newaxis]
    active = np.flatnonzero(wanted)
    cost = np.full(count, np.inf)
    found, jacobian = model(values[active], u, rate[active])
    cost[active] = np.sum((weights[active] * (power[active] - found)) ** 2, axis=1)
    for _ in range(_ITERATIONS):
        if not active.size:
            break
        w, x, y, k = weights[active], values[active], power[active], rate[active]
        weighted = jacobian * (w[:, np.newaxis, :] * unit[active][..., np.newaxis])
        weighted[fixed[active], 2] = 0
        normal = weighted @ weighted.transpose(0, 2, 1)
        right = (weighted @ (w * (y - found))[..., np.newaxis])[..., 0]
        diagonal = np.einsum("nii->ni", normal)
        # A parameter that the samples do not see stays where it is.
        ridge = damping[active][:, np.newaxis] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        damped = normal + ridge[:, :, np.newaxis] * np.eye(size)
        step = np.linalg.solve(damped, right[..., np.newaxis])[..., 0]
        trial = x + np.clip(step, -1, 1) * unit[active]
        trial[:, 0] = np.clip(trial[:, 0], -1.2 * width, 1.2 * width)
        trial[:, 1] = np.clip(trial[:, 1], 0.1 * width / _FWHM, 3 * width / _FWHM)
        trial[:, 2] = np.where(fixed[active], held[active], np.maximum(trial[:, 2], 0))
        tried, changed = model(trial, u, k)
        new = np.sum((w * (y - tried)) ** 2, axis=1)
        better = new <= cost[active]
        settled = better & (cost[active] - new <= 1e-7 * new + enough[active])
        small = np.max(np.abs(trial - x) / unit[active], axis=1) < 1e-7
        values[active] = np.where(better[:, np.newaxis], trial, x)
        cost[active] = np.where(better, new, cost[active])
        damping[active] = np.clip(np.where(better, 0.1, 8.0) * damping[active], 1e-12, 1e6)
        good[active] = settled | small
        found[better], jacobian[better] = tried[better], changed[better]
        if (done := settled | small).any():
            active, found, jacobian = (of_each[~done] for of_each in (active, found, jacobian))
    if good.any():
        _, jacobian = model(values[good], u, rate[good])
        weighted = jacobian * (weights[good][:, np.newaxis, :] * unit[good][..., np.newaxis])
        normal = weighted @ weighted.transpose(0, 2, 1)
        # A height that is held is not correlated with anything; its error is that of a fit of the height alone.
        still = fixed[good]
        normal[still, 2, :2] = normal[still, :2, 2] = 0
        normal[still, 2, 3:] = normal[still, 3:, 2] = 0
        trace = np.einsum("nii->n", normal)[:, np.newaxis, np.newaxis]
        inverse = np.linalg.inv(normal + 1e-13 * trace * np.eye(size))
        covariance[good] = inverse * unit[good][:, :, np.newaxis] * unit[good][:, np.newaxis, :]
    good &= fixed | (values[:, 2] > 0)
    return _Fit(values, covariance, cost, good)


def _echoes(records: Records, bins: IntArray, fit: _Fit, flags: IntArray) -> Echoes:
    """Return the numbers of a fit whose first parameters are time, sigma and height."""
    time, s, height = fit.values[:, 0], fit.values[:, 1], fit.values[:, 2]
    variance = np.einsum("nii->ni", fit.covariance)
    area = np.sqrt(2 * np.pi) * 1e-9
    mixed = s**2 * variance[:, 2] + height**2 * variance[:, 1] + 2 * s * height * fit.covariance[:, 1, 2]
    middle = records.time_ns[np.clip(bins, 0, records.time_ns.size - 1)]
    half = 0.5 * _FWHM * s
    cut = (middle + time - half < records.time_ns[0]) | (middle + time + half > records.time_ns[-1])
    exists = (flags & int(EchoFlag.NO_ECHO)) == 0
    flags = flags | np.where(exists & ~fit.good, int(EchoFlag.POOR_FIT), 0)
    flags = flags | np.where(exists & cut, int(EchoFlag.CUT), 0)
    found = Echoes(
        middle + time,
        height,
        area * height * s,
        _FWHM * s,
        np.sqrt(variance[:, 0]),
        np.sqrt(variance[:, 2]),
        area * np.sqrt(np.maximum(mixed, 0)),
        _FWHM * np.sqrt(variance[:, 1]),
        flags,
    )
    return known_only(found, exists & fit.good)
