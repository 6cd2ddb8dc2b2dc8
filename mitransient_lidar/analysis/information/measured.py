"""Measured or simulated waveforms to which a model is fitted, and a render's prediction for them."""

from __future__ import annotations

import csv
import math
import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.analysis.information.errors import noise_of_mean, smoothed_variance
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import read_text
from mitransient_lidar.core.validation import FloatArray, positive, shown
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector
from mitransient_lidar.physics.receiver.receiver_files import ReceiverChannels, waveform_receiver
from mitransient_lidar.results import waveform_files
from mitransient_lidar.results.attributes import described
from mitransient_lidar.results.files import Given

_TIME, _STDERR = "time_ns", "_stderr"  # time column, and end of the error columns' names
_STEP = 1e-4  # of the differences that give derivatives after a receiver, relative to the largest power
_SATURATED = 1e-3  # probability of saturation above which a sample is left out


@dataclass(frozen=True)
class ReceiverSettings:
    """Receiver that recorded a signal: chain, filter optical density and background [W] on each pixel."""

    chains: tuple[ReceiverChain, ...]
    optical_densities: FloatArray
    backgrounds: FloatArray
    above_dark: bool = False  #: Whether the level without light has been subtracted.


@dataclass(frozen=True)
class Measured:
    """Waveforms to fit."""

    #: Samples, shape (pixel, time), with the pixels of an imager in row-major order; NaN where there is none.
    values: FloatArray
    #: Their standard errors in the same unit and shape; None where they are unknown or the model's.
    stderr: FloatArray | None
    time_ns: FloatArray  #: Sample times [ns], shape (time,), increasing strictly.
    #: Correlation between errors of samples that are 0, 1, ... apart, shape (lags,); 1 for lag 0.
    correlation: FloatArray
    template: xr.DataArray  #: Array with dimensions, coordinates and attributes of the waveforms.
    calibrated: bool = True  #: Whether values and times are a model's, so that neither scale nor offset are unknown.
    #: Receiver of a signal, None for waveforms, and number of averaged records.
    receiver: ReceiverSettings | None = None
    shots: int = 1
    estimated: bool = False  #: Whether `stderr` is from the spread of a few passes.
    #: Deviations of the waveforms in pass batches, shape (batch, pixel, time); see `batch_deviations`.
    batches: FloatArray | None = None
    #: Variance of the render whose record a signal is, which `stderr` and the receiver's noise leave out, shape (pixel,
    #: time); None without one.
    render_variance: FloatArray | None = None
    #: Sample variance by the converter in a table with a receiver, shape (pixel, time); None without one.
    rounding: FloatArray | None = None

    @property
    def pixel_dims(self) -> tuple[str, ...]:
        """Dimensions before ``time``."""
        return tuple(str(dim) for dim in self.template.dims[:-1])

    def labelled(self, values: npt.ArrayLike, name: str) -> xr.DataArray:
        """Return values with the shape (pixel, time) under the dimensions and coordinates of the waveforms."""
        about = {"units": self.template.attrs.get("units", ""), "long_name": name, **described(name)}
        return self.template.copy(data=np.reshape(values, self.template.shape)).assign_attrs(about)

    def best_scale(self, mean: FloatArray, noise: FloatArray | None) -> float:
        """Return the scale of a model's samples, in the same shape, by least squares with variances `noise`.

        Raises `UserError` if the waveforms have no light where the model has.
        """
        weight = np.where(np.isfinite(self.values), 1.0, 0.0)
        if noise is not None:
            weight = np.divide(weight, noise, out=np.zeros_like(mean), where=noise > 0)
        scale = float(np.sum(weight * mean * np.nan_to_num(self.values))) / max(float(np.sum(weight * mean**2)), 1e-300)
        if not scale > 0:
            raise UserError("the waveforms have no light where the scene has: they must rise with the light")
        return scale


class Prediction(NamedTuple):
    """Model samples, at their own times."""

    time_ns: FloatArray  #: Shape (time,).
    mean: FloatArray  #: In the unit of the waveforms before any scale, shape (pixel, time).
    derivative: FloatArray  #: Per unit of each parameter, shape (parameter, pixel, time).
    model_variance: FloatArray  #: Variance by the model's Monte Carlo, shape (pixel, time).
    noise_variance: FloatArray | None  #: Variance of the mean record, shape (pixel, time); None without a receiver.
    valid: npt.NDArray[np.bool_]  #: Samples that are not saturated, shape (pixel, time).
    correlation: FloatArray  #: Correlation of Monte Carlo errors by the distance in samples, shape (lags,).
    batches: FloatArray | None  #: Deviations by batches of passes, shape (batch, pixel, time); see `batch_deviations`.

    def interpolated(self, times: FloatArray, values: FloatArray, outside: float | None = None) -> FloatArray:
        """Return rows of values, shape (pixel, time), at other times, linear between its own ones.

        Outside they have the end values, or another value.
        """
        return np.array([np.interp(times, self.time_ns, row, left=outside, right=outside) for row in values])


def with_waveforms(source: Given) -> Given:
    """Return the dataset of a result or signals, given itself or by its file; a table's path unchanged.

    Raises `UserError` if it is another dataset, or its file cannot be read.
    """
    is_path = isinstance(source, (str, os.PathLike)) and not waveform_files.is_waveform_file(source)
    if is_path and Path(source).suffix.lower() not in (".nc", ".exr", ""):
        return source
    return results.dataset_of("source", source, "waveforms", "signals")


def measured(
    source: xr.Dataset | str | os.PathLike[str],
    *,
    noise: float | None = None,
    receiver: str | os.PathLike[str] | ReceiverChain | None = None,
) -> Measured:
    """Return the waveforms in a result, a recorded signal, or a table.

    Raises `UserError` if the file cannot be read, a series has more than one shot, the receiver is unknown, or a value
    is out of range.

    `source`: a result with ``waveform``, or with the ``signal`` of `analysis.receiver.detect_waveforms`, whose records
    are averaged; or its EXR or NetCDF file. A CSV file has the column ``time_ns``, one column for each pixel in any
    unit, and optionally ``NAME_stderr`` with their standard errors. LAS, LAZ and PulseWaves files
    (`results.waveform_files`) give such a table: their mean waveform, minus the level before the surface. `noise`:
    standard deviation of every waveform sample, above 0 and in the waveforms' unit, in place of their own. `receiver`:
    receiver of a signal, as for `detect_waveforms`; by default the one that its attributes name. For a table, the
    receiver whose response and noise the model gets: a preset, an instrument, or a TOML file. After a logarithm,
    samples are volts, which are expanded; limits and rounding are found from the samples.
    """
    given = None if noise is None else positive("noise", noise)
    source = with_waveforms(source)
    recorded = isinstance(source, xr.Dataset) and waveform_files.FILE in source.attrs
    if isinstance(source, xr.Dataset) and "signal" in source and not recorded:
        if given is not None:
            raise UserError(f"noise = {given:g} is that of the receiver of a signal: leave it out")
        return _of_signal(source, receiver)
    if recorded or not isinstance(source, xr.Dataset):
        table = _with_noise(_of_file(source) if isinstance(source, xr.Dataset) else _read_csv(Path(source)), given)
        return table if receiver is None else _behind(table, waveform_receiver(receiver))
    if receiver is not None:
        raise UserError("receiver is that of a signal or a table, and these waveforms are light [W]: leave it out")
    dims = results.record_dims(source, "waveform")
    values = _by_pixel(source["waveform"], dims)
    stderr = _by_pixel(source["waveform_stderr"], dims) if "waveform_stderr" in source else None
    found = Measured(
        values,
        stderr,
        _times(source),
        correlation(source.attrs),
        source["waveform"],
        estimated=stderr is not None,
        batches=None if stderr is None else batch_deviations(source, dims),
    )
    return _with_noise(found, given)


def predict(found: Measured, dataset: xr.Dataset, parameters: list[str]) -> Prediction:
    """Return a render's prediction, with derivatives, for the pixels of waveforms, after their receiver if any.

    Derivatives after a receiver are central differences: of its closed form, in the derivative's direction. Raises
    `UserError` if the render has other pixels, lacks a derivative, or holds values that are not finite.
    """
    dataset = _same_pixels(found, dataset)
    dims = (*found.pixel_dims, "time")
    light = _by_pixel(dataset["waveform"], dims)
    if "waveform_derivative" not in dataset:
        raise UserError("the model has no variable waveform_derivative: it must give the derivatives by its parameters")
    known = [str(name) for name in dataset["parameter"].values]
    if missing := [name for name in parameters if name not in known]:
        raise UserError(f"the model has no derivative by {missing[0]}, only by {', '.join(known)}")
    wanted = dataset["waveform_derivative"].sel(parameter=parameters).transpose("parameter", *dims)
    slopes = np.asarray(wanted.values, dtype=np.float64).reshape(len(parameters), *light.shape)
    error = _by_pixel(dataset["waveform_stderr"], dims) if "waveform_stderr" in dataset else np.zeros_like(light)
    for name, array in (("waveform", light), ("waveform_derivative", slopes)):
        if not np.isfinite(array).all():
            raise UserError(
                f"{name} of the model has {np.count_nonzero(~np.isfinite(array))} values that are not finite"
            )
    error = np.nan_to_num(error)
    times, lags, batches = _times(dataset), correlation(dataset.attrs), batch_deviations(dataset, dims)
    if found.receiver is None:
        return Prediction(times, light, slopes, error**2, None, np.ones(light.shape, dtype=bool), lags, batches)
    width = results.time_axis(dataset).bin_width_ns
    return _recorded(found.receiver, found.shots, light, slopes, error, times, width, lags, batches)


def _recorded(
    receiver: ReceiverSettings,
    shots: int,
    light: FloatArray,
    slopes: FloatArray,
    error: FloatArray,
    times: FloatArray,
    width: float,
    lags: FloatArray,
    batches: FloatArray | None,
) -> Prediction:
    """Return the mean record of light, shape (pixel, time), with derivatives and errors, by the receiver's closed form.

    Errors in a render's neighbouring bins agree in sign. They are propagated as one change in the light, like each pass
    batch's deviation.
    """
    largest = np.abs(slopes).max(axis=-1, keepdims=True, initial=0)
    reach = np.divide(_STEP * light.max(), largest, out=np.zeros_like(largest), where=largest > 0)
    parts = []
    for pixel, (chain, density, sky) in enumerate(
        zip(receiver.chains, receiver.optical_densities, receiver.backgrounds, strict=True)
    ):
        filtered, background = 10.0**-density, 10.0**-density * sky
        steps = reach[:, pixel] * slopes[:, pixel]
        own = light[pixel : pixel + 1]
        deviations = np.zeros((0, own.size)) if batches is None else batches[:, pixel]
        dark = np.zeros_like(own)
        lit = np.concatenate([own, own + error[pixel], own + steps, own - steps, own + deviations, dark])
        expected = chain.expected(filtered * np.maximum(lit, 0), width, np.full(len(lit), background))
        count = len(steps)
        rise = expected.mean[2 : 2 + count] - expected.mean[2 + count : 2 + 2 * count]
        slope = np.divide(rise, 2 * reach[:, pixel], out=np.zeros_like(rise), where=reach[:, pixel] > 0)
        noise = noise_of_mean(expected.variance[0], chain.digitiser, shots)
        level = expected.mean[-1] if receiver.above_dark else 0.0
        one = expected.mean[0] - level, slope, (expected.mean[1] - expected.mean[0]) ** 2, noise
        moved = expected.mean[2 + 2 * count : -1] - expected.mean[0]
        parts.append((*one, expected.saturation[0] < _SATURATED, moved))
    mean, slope, by_model, variance, valid, moved = zip(*parts, strict=True)
    stride = receiver.chains[0].stride(width)
    return Prediction(
        times[::stride],
        np.array(mean),
        np.stack(slope, axis=1),
        np.array(by_model),
        np.array(variance),
        np.array(valid),
        lags[::stride],
        None if batches is None else np.stack(moved, axis=1),
    )


def batch_deviations(dataset: xr.Dataset, dims: tuple[str, ...]) -> FloatArray | None:
    """Return the deviations of a render's pass batches from its mean, shape (batch, pixel, time), or None.

    Their outer products add up to an unbiased estimate of the error covariance over all bins. For N passes in B
    batches, deviations of means over n passes are multiplied by sqrt(n/N/(B - 1)).
    """
    if "waveform_batch" not in dataset or dataset.sizes["batch"] < 2:
        return None
    passes, mean = dataset["batch_passes"].values, _by_pixel(dataset["waveform"], dims)
    means = np.asarray(dataset["waveform_batch"].transpose("batch", *dims).values, dtype=np.float64)
    factor = np.sqrt(passes / passes.sum() / (passes.size - 1))
    return np.asarray((means.reshape(-1, *mean.shape) - mean) * factor[:, None, None])


def correlation(attributes: Any) -> FloatArray:
    """Return the correlation between a render's bin errors by their distance in bins, shape (lags,).

    The pulse smooths bin errors, so that neighbours agree. The attribute ``error_inflation`` compares means over n = 1,
    2, 4, ... bins: it divides their standard deviation by the one for independent bins. Its square is f(n)^2 = 1 + 2
    sum (1 - k/n) r(k) over the lags 0 < k < n. It is solved for r constant between these numbers of bins. Without it,
    bins are independent.
    """
    bins, inflation = (np.atleast_1d(attributes.get(name, ())) for name in ("error_inflation_bins", "error_inflation"))
    found = [1.0]
    for count, factor in zip(bins[1:].astype(int), inflation[1:], strict=True):
        known, new = np.arange(1, len(found)), np.arange(len(found), count)
        rest = float(factor) ** 2 - 1 - 2 * float(np.sum((1 - known / count) * found[1:]))
        found += [float(np.clip(rest / (2 * np.sum(1 - new / count)), -1, 1))] * new.size
    return np.array(found)


def _of_signal(dataset: xr.Dataset, given: Any) -> Measured:
    """Return the mean over a signal's records, whose errors come from its receiver."""
    results.record_dims(dataset, "signal", shots=True)
    if "signal_mean" in dataset and "shot" in dataset["signal_mean"].dims:
        raise UserError("the signals are those of a series of shots: select one shot with isel(shot=...)")
    values = dataset["signal"]
    if "shot" in values.dims:  # samples that some shots have not stored are missing: the others are the high ones
        values = values.mean("shot", keep_attrs=True, skipna=False)
    dims = tuple(str(dim) for dim in values.dims)
    pixels = [str(name) for name in dataset["pixel"].values] if "pixel" in dims else []
    count = math.prod(dataset.sizes[dim] for dim in dims[:-1])
    name = given if given is not None else dataset.attrs.get("receiver")
    if name is None:
        raise UserError("the signal does not name its receiver, which is a chain of its own: give it with receiver")
    known = waveform_receiver(name)
    lists = {
        key: np.broadcast_to(np.asarray(dataset.attrs.get(key, usual), dtype=np.float64), (count,))
        for key, usual in (("gain", 1.0), ("optical_density", 0.0), ("background_power_w", 0.0))
    }
    plain = [known.of(pixel).chain for pixel in pixels] or [known.default.chain] * count
    chains = tuple(
        chain if gain == 1 else chain.with_gain(float(gain)) for chain, gain in zip(plain, lists["gain"], strict=True)
    )
    settings = ReceiverSettings(chains, lists["optical_density"], lists["background_power_w"])
    step = results.time_axis(dataset).bin_width_ns
    shots = int(dataset.sizes.get("shot", 1)) if "shot" in dataset["signal"].dims else 1
    of_render = None
    if "signal_mean_stderr" in dataset:
        error = dataset["signal_mean_stderr"].transpose(*dims)
        # Few passes determine their errors badly, and bins whose variance is low by chance would count too much.
        of_render = smoothed_variance(_by_pixel(error, dims) ** 2)
    return Measured(
        _by_pixel(values, dims),
        None,
        _times(dataset),
        _response_correlation(chains[0], step, int(dataset.sizes["time"])),
        values,
        receiver=settings,
        shots=shots,
        render_variance=of_render,
    )


def _of_file(dataset: xr.Dataset) -> Measured:
    """Return the mean of waveforms that a lidar has recorded."""
    mean, shots = waveform_files.mean_above_dark(dataset), int(dataset.sizes["shot"])
    return Measured(mean.values, None, mean["time"].values, np.ones(1), mean, calibrated=False, shots=shots)


def _behind(table: Measured, receiver: ReceiverChannels) -> Measured:
    """Return a table's waveforms with their receiver, as samples that are linear in the light, above the dark level.

    The rounding step is the smallest difference between two samples.
    """
    pixels = [str(name) for name in table.template["pixel"].values]
    given = [receiver.of(pixel).chain for pixel in pixels]
    values, stderr = table.values, table.stderr
    if (logarithm := given[0].logarithm) is not None:
        stderr = None if stderr is None else stderr * logarithm.expansion(values)
        values = logarithm.expand(values)
    chains = tuple(_linear(chain) for chain in given)
    step = float(np.median(np.diff(table.time_ns)))
    rounding = np.zeros_like(values)
    if given[0].digitiser is not None and logarithm is None:
        for row, samples in zip(rounding, values, strict=True):
            codes = np.unique(samples[np.isfinite(samples)])
            row += float(np.min(np.diff(codes), initial=np.inf)) ** 2 / 12 if codes.size > 1 else 0.0
    return replace(
        table,
        values=values,
        stderr=stderr,
        correlation=_response_correlation(chains[0], step, table.time_ns.size),
        template=table.template.copy(data=values),
        receiver=ReceiverSettings(chains, np.zeros(len(chains)), np.zeros(len(chains)), above_dark=True),
        render_variance=None,
        rounding=rounding,
    )


def _linear(chain: ReceiverChain) -> ReceiverChain:
    """Return a chain without limits, logarithm and converter."""
    amplifier = chain.amplifier and replace(chain.amplifier, limit_v=None, recovery_ns=None)
    detector = chain.detector
    if isinstance(detector, LinearDetector):
        detector = replace(detector, largest_current_ma=math.inf)
    return replace(chain, detector=detector, amplifier=amplifier, logarithm=None, digitiser=None, jitter=None)


def _response_correlation(chain: ReceiverChain, step_ns: float, count: int) -> FloatArray:
    """Return the noise correlation between samples that are `step_ns` apart, after the amplifier's low-pass."""
    low_pass = chain.low_pass(step_ns)
    weights = low_pass.weights
    whole = np.correlate(weights, weights, "full")[weights.size - 1 :: low_pass.parts][:count]
    return np.asarray(whole / whole[0])


def _same_pixels(found: Measured, dataset: xr.Dataset) -> xr.Dataset:
    """Return the model pixels that match the waveforms', by their names; a single pixel may have any name."""
    if "waveform" not in dataset:
        raise UserError("the model has no variable waveform")
    own = tuple(str(dim) for dim in dataset["waveform"].dims if dim != "time")
    if own != found.pixel_dims:
        raise UserError(f"the scene has pixels over ({', '.join(own)}), the waveforms over {found.pixel_dims}")
    if own == ("pixel",):
        wanted = [str(name) for name in found.template["pixel"].values]
        names = [str(name) for name in dataset["pixel"].values]
        if len(wanted) == len(names) == 1:
            return dataset
        if missing := [name for name in wanted if name not in names]:
            raise UserError(f"the scene has no pixel {missing[0]}: its pixels are {', '.join(names)}")
        return dataset.isel(pixel=[names.index(name) for name in wanted])
    sizes = tuple(dataset.sizes[dim] for dim in own)
    if sizes != found.template.shape[:-1]:
        raise UserError(f"the scene has {sizes} rows and columns, the waveforms {found.template.shape[:-1]}")
    return dataset


def _with_noise(found: Measured, noise: float | None) -> Measured:
    """Return waveforms with a constant error instead of their own."""
    if noise is None:
        return found
    stderr = np.full(found.values.shape, noise)
    return replace(found, stderr=stderr, correlation=np.ones(1), estimated=False, batches=None)


def _by_pixel(array: xr.DataArray, dims: tuple[str, ...]) -> FloatArray:
    """Return an array of the given dimensions in the shape (pixel, time)."""
    values = np.asarray(array.transpose(*dims).values, dtype=np.float64)
    return values.reshape(-1, values.shape[-1])


def _times(dataset: xr.Dataset) -> FloatArray:
    return np.asarray(dataset["time"].values, dtype=np.float64)


def _read_csv(path: Path) -> Measured:
    """Read a waveform table; see `measured`."""
    try:
        lines = [line for line in csv.reader(read_text(path).splitlines()) if any(cell.strip() for cell in line)]
    except csv.Error as problem:
        raise UserError(f"{path} is not a CSV file") from problem
    heading = [name.strip() for name in lines[0]] if lines else []
    if _TIME not in heading or len(heading) < 2:
        raise UserError(f"{path} must begin with a heading of {_TIME} and names of pixels, separated by commas")
    if twice := [name for name, count in Counter(heading).items() if count > 1]:
        raise UserError(f"{path} has two columns {twice[0]!r}: every column must have a name of its own")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(heading):
            raise UserError(f"{path}, row {number} has {len(line)} values but must have {len(heading)}")
        rows.append([_number(path, number, name, cell) for name, cell in zip(heading, line, strict=True)])
    if len(rows) < 2:
        raise UserError(f"{path} has {len(rows)} rows of numbers: it must have 2 or more")
    columns = dict(zip(heading, np.array(rows).T, strict=True))
    times = columns.pop(_TIME)
    for index in np.flatnonzero(~(np.diff(times) > 0))[:1]:
        raise UserError(f"{path} has {_TIME} = {times[index]:g}, {times[index + 1]:g}: it must increase strictly")
    pixels = [name for name in columns if not (name.endswith(_STDERR) and name.removesuffix(_STDERR) in columns)]
    errors = [columns.get(f"{name}{_STDERR}") for name in pixels]
    known = [error for error in errors if error is not None]
    if known and len(known) < len(pixels):
        lacking = next(name for name, error in zip(pixels, errors, strict=True) if error is None)
        raise UserError(f"{path} has errors of some pixels alone: the column {lacking}{_STDERR} is missing")
    for name, error in zip(pixels, known, strict=False):
        if np.any(error <= 0):
            raise UserError(f"{path} has {name}{_STDERR} = {np.nanmin(error):g}: it must be greater than 0")
    values = np.array([columns[name] for name in pixels])
    coords = {"pixel": ("pixel", np.array(pixels, dtype=str)), "time": ("time", times, {"units": "ns"})}
    template = xr.DataArray(values, coords, ("pixel", "time"))
    return Measured(values, np.array(known) if known else None, times, np.ones(1), template, calibrated=False)


def _number(path: Path, row: int, name: str, cell: str) -> float:
    """Return a cell of a table as a number, NaN where it is empty."""
    text = cell.strip() or ("" if name == _TIME else "nan")
    try:
        number = float(text)
    except ValueError:
        raise UserError(f"{path}, row {row}: {name} = {shown(cell)} must be a number") from None
    if math.isinf(number):
        raise UserError(f"{path}, row {row}: {name} = {number} must be finite")
    return number
