"""Differences between a model and fitted waveforms, which may lie behind an amplifier of unknown bandwidth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.electronics import Amplifier

_COMPRESSED = 0.02  # of the largest sample, above which a logarithm is compared
_LEAST_OVERLAP = 0.5  # share of a model's energy that lies within the record
_BRIGHT = 1e-3  # of a pixel's largest sample, above which it has light: the bottom's is far below the surface's
_MOST_LAGS = 64  # in an estimated correlation, in samples


class Misfit(NamedTuple):
    """Differences between model and waveforms, whose squares are added up: 0 for samples with weight 0.

    Differences between values, or with `softening` between logarithms of samples above it: asinh(value/softening). With
    `blur` both are filtered by a Gaussian, so that echoes agree partly before they coincide.
    """

    weights: FloatArray  #: 1 over the standard deviation, shape (pixel, time).
    softening: FloatArray | None = None  #: In the unit of the waveforms, above 0, shape (pixel, time).
    blur: float = 0.0  #: Standard deviation of the filter [samples].

    def of(self, mean: FloatArray, values: FloatArray) -> FloatArray:
        """Return the differences, shape (pixel, time)."""
        mean, values = self.blurred(mean), self.blurred(values)
        if self.softening is None:
            return np.asarray(self.weights * (mean - values))
        return np.asarray(self.weights * (np.arcsinh(mean / self.softening) - np.arcsinh(values / self.softening)))

    def slopes(self, mean: FloatArray, derivative: FloatArray) -> FloatArray:
        """Return the differences' derivatives from the mean's derivatives, shape (parameter, pixel, time)."""
        if self.softening is None:
            return np.asarray(self.weights * self.blurred(derivative))
        return np.asarray(self.weights / np.hypot(self.blurred(mean), self.softening) * self.blurred(derivative))

    def blurred(self, array: FloatArray) -> FloatArray:
        """Return an array, shape (..., pixel, time), after the filter; samples of weight 0 count as dark."""
        if not self.blur:
            return array
        from scipy.ndimage import gaussian_filter1d

        lit = np.where(self.weights > 0, array, 0.0)
        return np.asarray(gaussian_filter1d(lit, self.blur, axis=-1, mode="constant"))


def best_offset(times: FloatArray, values: FloatArray, model_times: FloatArray, mean: FloatArray) -> float:
    """Return the time [ns] by which waveforms are later than a model, whose light is searched for in the whole record.

    At this time the squared difference between compressed samples, asinh(value / 2 % of the largest), is least over the
    record. The samples have a scale of their own, and the model is dark outside its own record. The column and faint
    echoes count beside the surface echo. Waveforms and model have times [ns], shape (time,), those of the model evenly
    spaced, and samples, shape (pixel, time).
    """
    step = float(np.median(np.diff(model_times)))
    grid = np.arange(times[0], times[-1] + 0.5 * step, step)
    across, energy = np.zeros(grid.size + model_times.size - 1), np.zeros(grid.size + model_times.size - 1)
    for row, own in zip(values, mean, strict=True):
        sampled, shape = _compressed(np.interp(grid, times, row)), _compressed(own)
        across += np.correlate(sampled, shape, "full")
        energy += np.correlate(np.ones(grid.size), shape**2, "full")
    inside = energy >= _LEAST_OVERLAP * energy.max()
    explained = np.where(inside, np.maximum(across, 0) ** 2 / np.where(inside, energy, 1.0), 0.0)
    lag = int(np.argmax(explained)) - (model_times.size - 1)
    return float(grid[0] + lag * step - model_times[0])


def light_duration(times: FloatArray, mean: FloatArray) -> float:
    """Return the time from the first to the last sample of a model with light in any pixel [ns]."""
    bright = times[(mean > _BRIGHT * mean.max(axis=-1, keepdims=True)).any(axis=0)]
    return float(bright[-1] - bright[0]) if bright.size else 0.0


def residual_correlation(residuals: FloatArray) -> FloatArray:
    """Return the correlation of residuals, shape (pixel, time), by their distance, up to the first insignificant one.

    It contains the correlation of unknown noise and the misfit that neighbours share.
    """
    total, count = float(np.sum(residuals**2)), max(int(np.count_nonzero(residuals)), 1)
    found = [1.0]
    for lag in range(1, min(_MOST_LAGS, residuals.shape[-1] // 4)):
        value = float(np.sum(residuals[:, lag:] * residuals[:, :-lag])) / max(total, 1e-300)
        if value < 2 / math.sqrt(count):
            break
        found.append(value)
    return np.array(found)


def _compressed(values: FloatArray) -> FloatArray:
    """Return a row's compressed samples."""
    level = max(_COMPRESSED * float(np.max(values, initial=0.0)), 1e-300)
    return np.asarray(np.arcsinh(values / level))


BANDWIDTH = "bandwidth_mhz"
BANDWIDTH_START, BANDWIDTH_BOUNDS = 100.0, (1.0, 1e4)  # [MHz]
_STEP = 0.01  # relative one of the differences that give the derivative by the bandwidth


def behind_bandwidth(model: Callable[[Mapping[str, float]], xr.Dataset]) -> Callable[[Mapping[str, float]], xr.Dataset]:
    """Return a model of `fits.WaveformFit` whose light passes a single pole with the frequency ``bandwidth_mhz``.

    The half-power frequency is in MHz. The model has the derivative by it, and another one does not call `model` again.
    """
    last: list[tuple[dict[str, float], xr.Dataset]] = []

    def behind(values: Mapping[str, float]) -> xr.Dataset:
        others = {name: value for name, value in values.items() if name != BANDWIDTH}
        if not last or last[0][0] != others:
            last[:] = [(others, model(others))]
        light, bandwidth = last[0][1], values[BANDWIDTH]
        width = results.time_axis(light).bin_width_ns
        names = [name for name in light.data_vars if str(name).startswith("waveform") and "time" in light[name].dims]
        smoothed = light.assign({name: _behind(light[name], bandwidth, width) for name in names})
        ends = [_behind(light["waveform"], factor * bandwidth, width) for factor in (1 + _STEP, 1 - _STEP)]
        slope = ((ends[0] - ends[1]) / (2 * _STEP * bandwidth)).expand_dims(parameter=[BANDWIDTH])
        # A model without other free parameters has no derivatives.
        slopes = smoothed.get("waveform_derivative")
        if slopes is not None and "parameter_units" in slopes.coords:
            slope = slope.assign_coords(parameter_units=("parameter", ["MHz"]))
        both = [slope] if slopes is None else [slopes, slope]
        joined = xr.concat(both, "parameter", coords="minimal", compat="override", join="override")
        return smoothed.drop_dims("parameter", errors="ignore").assign(waveform_derivative=joined)

    return behind


def _behind(array: xr.DataArray, bandwidth_mhz: float, width_ns: float) -> xr.DataArray:
    """Return light in bins of a width [ns], dark before the first one, as samples behind a single pole."""
    first, weights = Amplifier(1.0, bandwidth_mhz=bandwidth_mhz).low_pass(width_ns).by_bin()
    values: FloatArray = array.transpose(..., "time").values
    from scipy.signal import oaconvolve

    shape = (1,) * (values.ndim - 1) + (-1,)
    smoothed = oaconvolve(values, weights.reshape(shape), axes=-1)[..., -first:][..., : values.shape[-1]]
    return array.transpose(..., "time").copy(data=np.asarray(smoothed))
