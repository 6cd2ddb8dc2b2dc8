"""Weighted nonlinear least squares for waveforms, with the model's exact derivatives.

Scale and time offset of uncalibrated waveforms are parameters like the others and not projected out. Bounds, weights
and the covariance treat all parameters alike. They start at the time with the largest model correlation and at the
linear least-squares scale. Positive parameters are fitted as logarithms.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.information.alignment import Misfit, best_offset, light_duration, residual_correlation
from mitransient_lidar.analysis.information.cramer_rao import SCALE, TIME_OFFSET, free_parameters
from mitransient_lidar.analysis.information.errors import NO_BATCHES, Errors, estimate_errors, smoothed_variance
from mitransient_lidar.analysis.information.fit_table import FittedSamples, fit_table
from mitransient_lidar.analysis.information.measured import Measured, Prediction, predict
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray, integer

#: A function that returns a render, with derivatives, for values of the free parameters.
Model = Callable[[Mapping[str, float]], "xr.Dataset"]

_WINDOW = 10.0  # model bins by which the time offset may change before samples in use are chosen anew
_MOST_ROUNDS = 8  # of weights that follow the model
_SETTLED = 0.05  # standard errors by which parameters may still change in the last round
_LINEAR = 0.2  # standard errors from a render within which the model is taken as linear, and not rendered again
_TOLERANCE, _COARSE_TOLERANCE = 1e-3, 0.03  # relative change in the sum of squares that ends a round, and an approach
_CONDITION = 1e6  # of parameter correlations, above which their inverse is not used
_RELATIVE_ERROR = 0.1  # for every sample while a fit approaches the solution
_UNKNOWN_ERROR = 0.01  # standard deviation in place of unknown ones then, over the largest sample
#: Standard deviations of the filters under which waveforms with unknown time approach a model, over its light's
#: duration.
_BLURS = (0.15, 0.04, 0.0)
_DARK = 0.01  # of a model's largest sample, below which it is dark beyond an end of its record
_DIGITS = 12  # of rendered values: logarithms and back change the last ones


class _Rendered(NamedTuple):
    """Values of all free parameters whose model was rendered."""

    values: dict[str, float]
    prediction: Prediction
    information: FloatArray  #: Inverse of the parameter covariance, shape (parameter, parameter).
    influence: FloatArray  #: Change in the differences per unit of each parameter, shape (parameter,).


class WaveformFit:
    """Fit of a model's parameters to waveforms.

    Raises `UserError` if a start or bounds are invalid, there is nothing to fit, no sample lies within the model's
    time, or the waveforms have no light where the model has.

    `found`: the waveforms. `model`: returns ``waveform``, optionally ``waveform_stderr``, and ``waveform_derivative``
    over (parameter, pixel, time) or (parameter, row, column, time) for values of the parameters. The same values give
    the same waveform. `starts`: starts of the model parameters, and optionally of ``scale`` and ``time_offset_ns``.
    `bounds`: lowest and highest values by name; see `free_parameters`. `free_scale`, `free_time`: whether scale and
    time offset of the waveforms are unknown, by default only for uncalibrated waveforms.
    """

    def __init__(
        self,
        found: Measured,
        model: Model,
        starts: Mapping[str, float],
        bounds: Mapping[str, tuple[float, float]] | None = None,
        *,
        free_scale: bool | None = None,
        free_time: bool | None = None,
    ) -> None:
        self.found, self.model = found, model
        nuisances = {SCALE: free_scale, TIME_OFFSET: free_time}
        self.nuisances = [name for name, free in nuisances.items() if (not found.calibrated if free is None else free)]
        self.names = [name for name in starts if name not in nuisances]
        if fixed := [name for name in starts if name in nuisances and name not in self.nuisances]:
            raise UserError(f"start of {fixed[0]}: it is fixed")
        if not self.names:
            raise UserError("free = '' must name at least one parameter of the scene")
        if found.receiver is not None and found.calibrated and self.nuisances:
            raise UserError(f"{self.nuisances[0]} of a recorded signal is that of its receiver: it cannot be free")
        # Invalid starts and bounds are refused before the first render.
        later = {name: 1.0 for name in self.nuisances if name not in starts}
        early = {name: ends for name, ends in (bounds or {}).items() if name not in later}
        free_parameters({**starts, **later}, early)
        self.renders = 0
        self._kept: dict[tuple[float, ...], Prediction] = {}
        self._former: tuple[dict[tuple[float, ...], Prediction], _Rendered | None] = {}, None
        self.units: dict[str, str] = {}
        # The last accepted step that was rendered, and why others were not tried.
        self._rendered: _Rendered | None = None
        self._refusal, self._exhausted, self.interrupted = "", False, False
        self._blur_ns = 0.0
        aligned = self._align({name: float(value) for name, value in starts.items()})
        self.free = free_parameters(aligned, bounds)
        self.values = aligned

    def forget(self, model: Model | None = None) -> None:
        """Forget the renders so far, for a changed or another model; an interruption of its first one restores them."""
        self.model = model or self.model
        self._former = self._kept, self._rendered
        self._kept, self._rendered = {}, None

    def approach(self, *, most_renders: int = 60, until: float = math.inf) -> None:
        """Move `values` from the starts towards the solution, where `run` begins, by a model that may be coarse.

        Light falls exponentially with water coefficients, so that logarithms of samples are nearly linear in them where
        values are not. Least squares of logarithms approach the solution; samples there have a relative error of a
        tenth besides their own. From some starts, least squares of values need many steps, or end elsewhere. Limits are
        as for `run`, which has one render left at least.
        """
        self._limit, self._until = integer("most_renders", most_renders, 2, 10_000) - 1, until
        blurs: tuple[float, ...] = (0.0,)
        if TIME_OFFSET in self.nuisances:
            model = self._prediction(self.values)
            blurs = tuple(share * light_duration(model.time_ns, model.mean) for share in _BLURS)
        for self._blur_ns in blurs:
            found = self._approached()
            # Without time for another render, the last one remains.
            self.values = self._rendered.values if self._is_over and self._rendered is not None else found
        self._blur_ns = 0.0

    def _approached(self) -> dict[str, float]:
        """Return the least-squares solution for logarithms from `values`, after a filter if waveforms are blurred."""
        used = self._used(self.values)
        mean, _, by_model, noise = self._at(self.values)
        largest = float(np.abs(self.found.values[used]).max())
        variance = np.full_like(mean, (_UNKNOWN_ERROR * largest) ** 2) if noise is None else noise
        known = used & (variance > 0)
        softening = np.sqrt(np.where(known, variance, 1.0))
        # Samples that are in the noise on one side alone contain little information: their logarithms are far from
        # linear.
        darker = np.minimum(np.abs(np.nan_to_num(self.found.values)), np.abs(mean))
        if self._blur_ns:
            darker = np.abs(mean)
        relative = (variance + smoothed_variance(by_model)) / (darker**2 + softening**2)
        weights = np.where(known, 1 / np.sqrt(relative + _RELATIVE_ERROR**2), 0.0)
        step = float(np.median(np.diff(self.found.time_ns)))
        misfit = Misfit(weights, softening, self._blur_ns / step)
        return self._solution(self.values, misfit, used, _COARSE_TOLERANCE)

    def noise_ratio(self) -> float:
        """Return the variance of the model's Monte Carlo over the waveform variance, at `values`.

        The median over the samples that carry information, 0 where the waveform errors are unknown.
        """
        values = self.values
        used = self._used(values)
        mean, slopes, by_model, noise = self._at(values)
        if noise is None:
            return 0.0
        carrying = used & (noise > 0) & (np.abs(slopes).max(axis=0) > 0) & (mean**2 > noise)
        return float(np.median(by_model[carrying] / noise[carrying])) if carrying.any() else 0.0

    def run(self, *, most_renders: int = 60, until: float = math.inf, scale_errors: bool = False) -> xr.Dataset:
        """Fit and return the table of parameters and the fitted waveforms.

        `most_renders`, `until`: renders, 2 to 10000, and time of `time.perf_counter` [s] that end the fit without
        convergence. `scale_errors`: whether to multiply covariances by the reduced chi-squared, as is done where errors
        are unknown.

        Result: over ``parameter``, each in the unit ``parameter_units``: ``value``, ``stderr``, ``stderr_by_model``
        (part by the model's Monte Carlo), ``start``, ``low`` and ``high`` (bounds) and ``at_bound``; ``covariance`` and
        ``correlation`` over (parameter, other_parameter). Over the waveform dimensions: ``measured``,
        ``measured_stderr``, ``fitted``, ``fitted_stderr`` (the model's Monte Carlo), ``residual`` in standard
        deviations of both, and ``used`` (1 for fitted samples). Attributes: ``chi_squared``, its mean ``expected`` and
        ``freedom`` (also for errors that neighbours share), ``probability`` of a larger one, ``renders``, ``rounds``,
        ``converged``, and ``refused`` (1 where the scene does not explain the waveforms). ``interrupted`` is 1 after
        Ctrl-C; ``messages`` are sentences on what the waveforms do not determine. The squared ``residual`` values add
        up to ``chi_squared``.
        """
        self._limit, self._until = integer("most_renders", most_renders, 2, 10_000), until
        self._rendered, self._exhausted = None, False
        values, rounds, settled = dict(self.values), 0, False
        while (
            not (settled or self._exhausted) and rounds < _MOST_ROUNDS and (rounds == 0 or self.renders < self._limit)
        ):
            rounds += 1
            used = self._used(values)
            former, values = values, self._solution(values, Misfit(self._weights(values, used)), used)
            errors = self._errors(values, used, scale_errors)
            change = np.array([values[name] - former[name] for name in values])
            settled = bool(np.all(np.abs(change) <= _SETTLED * np.nan_to_num(errors.stderr, nan=np.inf)))
        return self._dataset(values, used, errors, rounds, settled and not (self._exhausted or self.interrupted))

    def _solution(
        self, values: Mapping[str, float], misfit: Misfit, used: BoolArray, tolerance: float = _TOLERANCE
    ) -> dict[str, float]:
        """Return the values with the smallest sum of squared differences, starting from others."""
        from scipy.optimize import least_squares

        self._refusal = ""
        ends = (
            np.array([free.internal(free.low) for free in self.free]),
            np.array([free.internal(free.high) for free in self.free]),
        )
        self._narrow(ends, values)
        solution = least_squares(
            partial(self._residuals, misfit=misfit, used=used),
            np.clip([free.internal(values[free.name]) for free in self.free], *ends),
            jac=partial(self._jacobian, misfit=misfit, used=used),
            bounds=ends,
            method="dogbox",  # The other one takes small steps beside finite bounds, even if these are far.
            x_scale="jac",
            ftol=tolerance,
            xtol=1e-12,
            gtol=1e-12,
            max_nfev=self._limit,
        )
        return self._named(solution.x)

    def _prediction(self, values: Mapping[str, float]) -> Prediction:
        """Return the model samples, rendered unless one of the last renders has these values or near ones."""
        key = self._key(values)
        if key in self._kept:
            return self._kept[key]
        if self._is_near(values):
            assert self._rendered is not None
            near = self._rendered.prediction
            steps = [values[name] - self._rendered.values[name] for name in self.names]
            return near._replace(mean=near.mean + np.tensordot(steps, near.derivative, 1))
        try:
            if self.interrupted:
                raise KeyboardInterrupt
            dataset = self.model(dict(zip(self.names, key, strict=True)))
        except KeyboardInterrupt:
            self.interrupted = True
            if not self._kept and self._former[0]:
                (self._kept, self._rendered), self._former = self._former, ({}, None)
                return self._prediction(values)
            raise
        self.renders += 1
        # A step that is refused leads back to the values before it.
        self._kept = dict([*self._kept.items()][-1:]) | {key: predict(self.found, dataset, self.names)}
        if "parameter_units" in dataset.coords:
            units = dict(zip(dataset["parameter"].values.tolist(), dataset["parameter_units"].values, strict=True))
            self.units = {str(name): str(unit) for name, unit in units.items()}
        return self._kept[key]

    def _is_near(self, values: Mapping[str, float]) -> bool:
        """Return whether the model at some values follows from the last accepted render and its derivatives.

        They must be near in standard errors. A relative curvature of 1 by each positive parameter must also matter
        little, which may fail for hardly distinguishable parameters.
        """
        if (last := self._rendered) is None:
            return False
        change = np.array([values[name] - last.values[name] for name in values])
        bent = sum(
            influence * step**2 / max(values[free.name], 1e-300)
            for free, influence, step in zip(self.free, last.influence, change, strict=True)
            if free.is_logarithm
        )
        return bool(change @ last.information @ change < _LINEAR**2 and bent < _LINEAR)

    @property
    def _is_over(self) -> bool:
        """Whether there is neither time nor a number left for another render, or one was interrupted."""
        return self.interrupted or self.renders >= self._limit or time.perf_counter() >= self._until

    def _key(self, values: Mapping[str, float]) -> tuple[float, ...]:
        """Return the rendered values of the model parameters."""
        return tuple(float(f"{values[name]:.{_DIGITS}g}") for name in self.names)

    def _at(self, values: Mapping[str, float]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
        """Return the expectation at the times of the waveforms.

        Mean and variance by Monte Carlo, shape (pixel, time), derivatives by all free parameters, shape (parameter,
        pixel, time), and waveform variance, None if unknown.
        """
        model = self._prediction(values)
        scale, times = values.get(SCALE, 1.0), self._model_times(values)
        mean, slopes = (self._resampled(values, array) for array in (model.mean, model.derivative))
        by_model = model.interpolated(times, model.model_variance, outside=0.0)
        noise = None if model.noise_variance is None else model.interpolated(times, model.noise_variance)
        rows = dict(zip(self.names, scale * slopes, strict=True)) | {SCALE: mean}
        if TIME_OFFSET in values:
            rows[TIME_OFFSET] = -scale * self._resampled(values, model.mean, order=1)
        derivative = np.array([rows[name] for name in values])
        if self.found.stderr is not None:
            noise = np.nan_to_num(self.found.stderr) ** 2
        elif noise is not None:
            noise = scale**2 * noise
            for other in (self.found.render_variance, self.found.rounding):
                noise = noise if other is None else noise + other
        return scale * mean, derivative, scale**2 * by_model, noise

    def _model_times(self, values: Mapping[str, float]) -> FloatArray:
        """Return the times of the waveforms in the model [ns], shape (time,)."""
        return self.found.time_ns - values.get(TIME_OFFSET, 0.0)

    def _resampled(self, values: Mapping[str, float], array: FloatArray, order: int = 0) -> FloatArray:
        """Return a model array, shape (..., pixel, time), or its derivative, at the times of the waveforms.

        It is 0 outside the model's record.
        """
        known, times = self._prediction(values).time_ns, self._model_times(values)
        if order == 0 and np.array_equal(times, known):
            return array
        from scipy.interpolate import CubicSpline

        # A pulse of a few bins is smooth: an interpolation by lines would flatten its peaks.
        outside = (times < known[0]) | (times > known[-1])
        return np.where(outside, 0.0, CubicSpline(known, array, axis=-1)(times, order))

    def _used(self, values: Mapping[str, float]) -> BoolArray:
        """Return which samples are fitted: those within the model for any offset that the round may reach."""
        model = self._prediction(values)
        times = self._model_times(values)
        margin = self._window(model) if TIME_OFFSET in values else 0.0
        rounding = 1e-6 * float(model.time_ns[1] - model.time_ns[0]) if model.time_ns.size > 1 else 0.0
        # Where a record begins or ends in the dark, it is dark beyond, too.
        dark = [bool(np.all(model.mean[:, end] < _DARK * model.mean.max())) for end in (0, -1)]
        first = model.time_ns[0] + (-margin if dark[0] else margin)
        last = model.time_ns[-1] + (2 * margin if dark[1] and self._blur_ns else -margin)
        inside = (times >= first - rounding) & (times <= last + rounding)
        known = np.isfinite(self.found.values)
        if self.found.stderr is not None:
            known &= np.isfinite(self.found.stderr)
        used = known & inside
        if not model.valid.all():
            nearest = np.clip(np.searchsorted(model.time_ns, times - rounding), 0, model.time_ns.size - 1)
            used &= model.valid[:, nearest]
        if np.count_nonzero(used) <= len(values):
            raise UserError(
                f"the waveforms have {np.count_nonzero(used)} samples from {times[0]:g} to {times[-1]:g} ns within the "
                f"record of the scene, {model.time_ns[0]:g} to {model.time_ns[-1]:g} ns: there must be more than "
                f"{len(values)} with a known error"
            )
        return np.asarray(used)

    def _weights(self, values: Mapping[str, float], used: BoolArray) -> FloatArray:
        """Return 1 over the standard deviation of the difference between waveforms and model, 0 where it is not used.

        Variances from few passes are smoothed, since bins with a variance that is low by chance would count too much.
        """
        _, _, by_model, noise = self._at(values)
        if noise is not None and self.found.estimated:
            noise = smoothed_variance(noise)
        variance = np.ones_like(by_model) if noise is None else smoothed_variance(by_model) + noise
        weighted = used & (variance > 0)
        return np.where(weighted, 1 / np.sqrt(np.where(weighted, variance, 1.0)), 0.0)

    def _residuals(self, x: FloatArray, misfit: Misfit, used: BoolArray) -> FloatArray:
        """Return the differences, or NaN, after which the optimiser takes a smaller step.

        That is where the scene is impossible, or too many renders were made. Beside impossible scenes, near values
        are taken for impossible, too.
        """
        values = self._named(x)
        unknown = np.full(np.count_nonzero(used), np.nan)
        if self._key(values) not in self._kept:
            near = self._is_near(values)
            self._exhausted |= not near and self._is_over
            if self._exhausted or (near and self._refusal):
                return unknown
        try:
            mean = self._at(values)[0]
        except UserError as error:
            self._refusal = str(error)
            return unknown
        except KeyboardInterrupt:
            # The previous renders are all that is left.
            self._exhausted = True
            return unknown
        return np.asarray(misfit.of(mean, np.nan_to_num(self.found.values))[used])

    def _jacobian(self, x: FloatArray, misfit: Misfit, used: BoolArray) -> FloatArray:
        values = self._named(x)
        mean, derivative, _, noise = self._at(values)
        slopes = misfit.slopes(mean, derivative)[:, used].T
        if (rendered := self._kept.get(self._key(values))) is not None:
            scaled = slopes
            if misfit.softening is None and noise is None:
                # Unknown errors are the residuals' errors.
                scaled = slopes / (float(np.std((self.found.values - mean)[used])) or 1.0)
            information = scaled.T @ scaled
            if misfit.softening is None and noise is not None:
                errors = self._errors(values, used, False)
                # The inverse for hardly distinguishable parameters would come from rounding.
                if not np.isnan(errors.covariance).any() and np.linalg.cond(errors.correlation) < _CONDITION:
                    information = np.linalg.inv(errors.correlation) / np.outer(errors.stderr, errors.stderr)
            self._rendered = _Rendered(values, rendered, information, np.linalg.norm(scaled, axis=0))
        return slopes * [values[free.name] if free.is_logarithm else 1.0 for free in self.free]

    def _named(self, x: FloatArray) -> dict[str, float]:
        return {free.name: free.value(float(one)) for free, one in zip(self.free, x, strict=True)}

    def _narrow(self, ends: tuple[FloatArray, FloatArray], values: Mapping[str, float]) -> None:
        """Narrow the time offset bounds to the offsets that used samples allow, and the bounds for blurred echoes."""
        for index, free in enumerate(self.free):
            if self._blur_ns and free.is_logarithm and free.name != SCALE:
                # Blurred echoes hardly determine some parameters, which would run away.
                at = free.internal(values[free.name])
                ends[0][index] = max(ends[0][index], at - 1)
                ends[1][index] = min(ends[1][index], at + 1)
            if free.name == TIME_OFFSET:
                margin = self._window(self._prediction(values))
                ends[0][index] = max(ends[0][index], values[TIME_OFFSET] - margin)
                ends[1][index] = min(ends[1][index], values[TIME_OFFSET] + margin)

    def _window(self, model: Prediction) -> float:
        """Return the largest change of the time offset in a round [ns]."""
        bins = _WINDOW * float(model.time_ns[-1] - model.time_ns[0]) / max(model.time_ns.size - 1, 1)
        return max(bins, 2 * self._blur_ns)

    def _align(self, starts: dict[str, float]) -> dict[str, float]:
        """Return the starts, with time offset and scale from the first render."""
        values = np.nan_to_num(self.found.values)
        if TIME_OFFSET in self.nuisances and TIME_OFFSET not in starts:
            model = self._prediction(starts)
            starts[TIME_OFFSET] = best_offset(self.found.time_ns, values, model.time_ns, model.mean)
        if SCALE in self.nuisances and SCALE not in starts:
            mean, _, _, noise = self._at({**starts, SCALE: 1.0})
            starts[SCALE] = self.found.best_scale(mean, noise)
        return starts

    def _errors(self, values: Mapping[str, float], used: BoolArray, scale_errors: bool) -> Errors:
        """Return the errors at some values."""
        mean, derivative, by_model, noise = self._at(values)
        weights = self._weights(values, used)
        model = self._prediction(values)
        step, own_step = (float(np.median(np.diff(times))) for times in (self.found.time_ns, model.time_ns))
        distance = np.arange(0, model.correlation.size * own_step, step) / own_step
        lags = np.interp(distance, np.arange(model.correlation.size), model.correlation, right=0.0)
        by_render = model.batches
        if by_render is not None:
            by_render = values.get(SCALE, 1.0) * self._resampled(values, by_render)
        recorded = self.found.render_variance
        if noise is not None and recorded is not None:
            noise = noise - recorded
        residuals = weights * (np.nan_to_num(self.found.values) - mean)
        alike = self.found.correlation
        if noise is None and not self.found.calibrated and self.found.receiver is None:
            alike = residual_correlation(residuals)
        errors = estimate_errors(
            residuals,
            weights * derivative,
            (weights if noise is None else weights * np.sqrt(noise), alike),
            (weights * np.sqrt(by_model), lags),
            np.array([free.is_bound(values[free.name]) for free in self.free]),
            scale_errors,
            known_noise=noise is not None,
            batches=[None if one is None else weights * one for one in (self.found.batches, by_render)],
            borrows=self.found.estimated,
            recorded=None if recorded is None else weights * np.sqrt(recorded),
        )
        if noise is None or scale_errors or self.found.estimated:
            return errors
        return errors.grown_with_misfit()

    def _dataset(
        self, values: Mapping[str, float], used: BoolArray, errors: Errors, rounds: int, converged: bool
    ) -> xr.Dataset:
        """Return the result of `run`."""
        mean, _, by_model, noise = self._at(values)
        samples = FittedSamples(mean, by_model, noise, self._weights(values, used))
        messages = [] if converged else [f"the fit has not converged in {self.renders} renders"]
        if self._refusal:
            messages.append(f"steps were refused, at which the fit may have ended: {self._refusal}")
        if self.found.estimated and self.found.batches is None and self._prediction(values).batches is None:
            messages.append(NO_BATCHES)
        ending = {"renders": self.renders, "rounds": rounds, "interrupted": int(self.interrupted)}
        table = fit_table(self.found, self.free, values, samples, errors, self.units, messages)
        return table.assign_attrs(ending, converged=int(converged and not table.attrs["refused"]))
