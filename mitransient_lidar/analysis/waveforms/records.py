"""Waveforms of a dataset, prepared for measurement: baseline, noise and lidar geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.analysis.waveforms.column_onset import ColumnOnset, Fading, Focusing
from mitransient_lidar.analysis.waveforms.depth_errors import HEIGHTS, column_gain
from mitransient_lidar.analysis.waveforms.echo_detection import Records
from mitransient_lidar.analysis.waveforms.echo_shape import BlurredPulse, EchoShape, Response, Template
from mitransient_lidar.analysis.waveforms.saturation import inflation, level_error
from mitransient_lidar.analysis.waveforms.surface_times import GRAZING, LEAST_SHARE, LEVEL, SurfaceLevel
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray, positive
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry, surface_time_ns
from mitransient_lidar.physics.lidar.pulse import Pulse
from mitransient_lidar.physics.receiver.electronics import LogAmplifier
from mitransient_lidar.results.geometry import LinesOfSight, lidar_geometry, pulse_of, required_number
from mitransient_lidar.results.sum_errors import BlockCorrelation, SumErrors, pooled_errors

#: Some of the waveforms.
Rows = IntArray | slice

_MOST_SHOTS, _FEWEST_SHOTS = 200, 20  # shots that the correlation of neighbouring samples is estimated from
_FEWEST_QUIET = 4  # bins before the surface echo that baseline and noise need
_LATEST = 3.0  # widths of an echo by which the surface may be late
_UNKNOWN_SEA = -3.0, 3.0  # lowest and highest point of a sea without the attribute surface_heights_m [m]
_UNKNOWN = 10.0  # noise of samples that are not stored, over the threshold of blocks
_LAND = 30.0  # height of an echo before the sea's, in typical deviations of samples or heights of single events
_TAIL = 2e-4  # of an echo, relative to its peak, that does not disturb the column
_BLUR = 1.0  # largest standard deviation of an echo's blur, in echo widths
_LONGEST_ECHO = 4.0  # largest expected width of an echo, in pulse widths


@dataclass(frozen=True)
class Waveforms:
    """Waveforms of a dataset with the quantities that their measurement needs."""

    #: Dimensions, their sizes and the unit of the variable.
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    unit: str
    #: Its values, shape (count, time), with all pixels of a shot before the next shot; of a signal after a logarithm,
    #: the voltages before it.
    samples: npt.NDArray[Any]
    time_ns: FloatArray  #: Centres of the bins [ns], shape (time,).
    #: Level of each pixel without light, shape (pixels,), and standard deviation of its samples, shape (pixels, time)
    #: or (pixels, 1), or of each waveform where it differs between shots, shape (count, time).
    baseline: FloatArray
    noise: FloatArray
    #: Standard error of weak steady signals above this level, by the level and by rounding, shape (pixels,).
    baseline_stderr: FloatArray
    #: Samples at a limit, of the shape of `samples`, and the least such sample.
    saturated: npt.NDArray[np.bool_] | None
    saturation_level: float
    #: Pulse and response in bins, and the shape of an ideal echo, also as a sum of Gaussians.
    kernel: tuple[int, FloatArray]
    template: Template
    echo_shape: EchoShape
    #: Mean focusing of the column's light by waves, None where it is not known, and the onset of the column.
    focusing: Focusing | None
    onset: ColumnOnset
    fading: Fading  #: How the column fades by absorption.
    #: Expected width of an echo, and end of the part of the record without echoes [ns].
    echo_fwhm_ns: float
    quiet_until_ns: float
    geometry: LidarGeometry  #: Lidar geometry on the axis.
    lines: LinesOfSight  #: Lines of sight, of the pixels of every shot or of one for all shots, shape (pixels,).
    event_height: FloatArray  #: Height that single events of the detector reach, shape (pixels,).
    #: Lowest point of the sea [m], negative, and its highest one; those of a rough sea where they are not known.
    lowest_m: float
    highest_m: float
    #: Signal per power of steady light [unit/W], shape (pixels,), and power of a column at the surface per
    #: backscattering coefficient [W m], 0 and NaN where they are not known.
    sensitivity: FloatArray
    column_gain: float
    #: Correlation of the noise of samples as of `echo_detection.Records`, None where samples are independent.
    shared: BlockCorrelation | None = None

    @property
    def count(self) -> int:
        """Number of waveforms."""
        return len(self.samples)

    @classmethod
    def from_dataset(
        cls,
        dataset: xr.Dataset,
        pulse: Pulse | None,
        noise: float | npt.ArrayLike | None,
        echo_fwhm_ns: float | None,
        saturation_level: float | None,
    ) -> Waveforms:
        """Read a dataset; the arguments and errors are those of `echo_table.extract`."""
        name = next((name for name in ("signal", "waveform") if name in dataset), None)
        if name is None:
            raise UserError("the dataset has neither signal nor waveform: it must be a result with a record in time")
        dims = results.record_dims(dataset, name, shots=True)
        logarithm = _logarithm(dataset) if name == "signal" else None
        if logarithm is not None:
            dataset = _expanded(dataset, logarithm)
            saturation_level = None if saturation_level is None else float(logarithm.expand(saturation_level))
        time = np.asarray(dataset["time"].values, dtype=np.float64)
        samples = dataset[name].values.reshape(-1, time.size)
        in_blocks = name == "signal" and {"dark_level", "block_level"} <= set(dataset)
        if not np.isfinite(samples).all() and (not in_blocks or np.isinf(samples).any()):
            raise UserError(f"{name} holds values that are not finite: render or record it again")
        geometry = lidar_geometry(dataset.attrs)
        shape = pulse or pulse_of(dataset.attrs)
        step = results.time_axis(dataset).bin_width_ns
        response = required_number(dataset.attrs, "response_time_ns", 0.0)
        receiver = _receiver_response(dataset, step) if name == "signal" else None
        template = Template.of(shape, step if receiver is None else receiver.bin_ns, response, receiver)
        kernel = shape.kernel(step, response) if receiver is None else template.kernel(step)
        # Two-way time per angle from the axis, in the plane of incidence.
        ns_per_mrad = 1e-3 * geometry.surface_ns_per_rad
        given = None if echo_fwhm_ns is None else positive("echo_fwhm_ns", echo_fwhm_ns)
        width = given or _echo_width(dataset, template, ns_per_mrad)
        echo_shape = EchoShape.of(template)
        wavelength = required_number(dataset.attrs, "wavelength_nm", 532.0)
        fading = Fading.of(wavelength, geometry.metres_per_ns, template.fwhm_ns)
        focusing = None if fading.opaque else Focusing.from_attributes(dataset.attrs)
        half_view = 0.5 * required_number(dataset.attrs, "field_of_view_mrad", 0.0)
        quiet_until = geometry.surface_time_ns - 2 * width - ns_per_mrad * half_view
        # Crests are earlier than the mean sea level.
        heights = np.atleast_1d(dataset.attrs.get("surface_heights_m", 0.0))
        of_crest = quiet_until - float(surface_time_ns(heights[-1], geometry.off_nadir))
        if np.count_nonzero(time < of_crest) >= _FEWEST_QUIET:
            quiet_until = of_crest
        pixels = int(np.prod([dataset.sizes[dim] for dim in dims if dim not in ("shot", "time")]))
        sea = np.atleast_1d(dataset.attrs.get("surface_heights_m", _UNKNOWN_SEA))
        events = _event_height(dataset, pixels) if name == "signal" else np.zeros(pixels)
        quiet, calm = time < quiet_until, samples
        if name == "signal" and not in_blocks:
            quiet, calm = _without_land(samples, time, quiet_until, events, width)
        run = max(int(template.fwhm_ns / step), 1)
        baseline = baseline_error = np.zeros(pixels)
        if in_blocks:
            baseline, _ = _block_levels(dataset, pixels)
        elif name == "signal":
            if np.count_nonzero(quiet) < _FEWEST_QUIET:
                raise UserError(
                    f"the record must hold at least {_FEWEST_QUIET} bins before {quiet_until:.1f} ns for its baseline"
                )
            dark = calm[:, quiet].reshape(-1, pixels, np.count_nonzero(quiet))
            baseline = dark.mean(axis=(0, 2))
            rest = dark - baseline[:, np.newaxis]
            baseline_error = level_error(rest, inflation(rest, run), samples[: _MOST_SHOTS * pixels])
        deviation, shared = _noise(dataset, name, samples, calm, baseline, quiet, noise, run), None
        if name == "waveform" and noise is None and "waveform_stderr" in dataset:
            deviation, shared = _noise_of_render(dataset, deviation, run)
        if in_blocks:
            samples, deviation = _without_gaps(dataset, samples, deviation)
        return cls(
            dims,
            dataset[name].shape,
            str(dataset[name].attrs.get("units", "")),
            samples,
            time,
            baseline,
            deviation,
            baseline_error,
            dataset["saturated"].values.reshape(-1, time.size).astype(bool) if "saturated" in dataset else None,
            math.inf if saturation_level is None else float(saturation_level),
            kernel,
            template,
            echo_shape,
            focusing,
            ColumnOnset.of(focusing, geometry.depth_per_ns, echo_shape.sigma_of(3 * width)),
            fading,
            width,
            quiet_until,
            geometry,
            _lines_of_sight(dataset, dims[:-1]),
            events,
            float(sea[0]),
            float(sea[-1]),
            _sensitivity(dataset, name, pixels),
            column_gain(dataset.attrs),
            shared,
        )

    @property
    def tail_ns(self) -> float:
        """Time from the peak of a surface echo to where its tail has ended and the column begins [ns]."""
        width, template = self.echo_fwhm_ns, self.template
        return max(1.75 * width, template.tail_ns(_TAIL) + width - template.fwhm_ns)

    @property
    def reflects(self) -> bool:
        """Whether facets of the sea may send light back."""
        return bool(self.geometry.off_nadir < GRAZING)

    @property
    def column_from_ns(self) -> float:
        """Time from the peak of a surface echo from which on the column is fitted [ns], NaN where it has faded."""
        return math.nan if self.fading.opaque else self.tail_ns

    @cached_property
    def blurred_pulse(self) -> BlurredPulse:
        """The ideal echo, blurred as by slopes."""
        return BlurredPulse.of(self.template, _BLUR * self.echo_fwhm_ns)

    @property
    def brightest(self) -> float:
        """Largest share of the beam in a pixel, 0 where it is not known."""
        return float(np.nan_to_num(self.lines.beam_share).max(initial=0.0))

    def _numbers(self, rows: Rows) -> IntArray:
        """Return the numbers of some waveforms."""
        return np.arange(self.count)[rows]

    def lines_of(self, rows: Rows) -> LinesOfSight:
        """Return some waveforms' lines of sight."""
        return self.lines.at(self._numbers(rows) % self.lines.off_nadir.size)

    def latest_surface(self, rows: Rows) -> FloatArray:
        """Return the latest surface echo times [ns], for the sea's lowest point, shape (waveforms,).

        Pixels without direct light have none.
        """
        lines = self.lines_of(rows)
        trough = -self.lowest_m / (0.5e-9 * C0 * np.cos(lines.off_nadir))
        margin = _LATEST * (self.echo_fwhm_ns + lines.surface_spread) + self.template.peak_ns + self.onset.brightest_ns
        dark = lines.beam_share < LEAST_SHARE * self.brightest
        return np.asarray(lines.surface_time + np.where(dark, 0, trough + margin))

    def surface_level(self, rows: Rows) -> SurfaceLevel:
        """Return the mean sea level's arrival in some waveforms, with the waves about it."""
        lines = self.lines_of(rows)
        per_metre = 1 / (0.5e-9 * C0 * np.cos(lines.off_nadir))
        waves = (self.highest_m - self.lowest_m) / HEIGHTS
        return SurfaceLevel(lines.surface_time, np.hypot(math.hypot(waves, LEVEL) * per_metre, lines.surface_spread))

    def column_signal(self, rows: Rows) -> FloatArray:
        """Return the signal of a column at the surface per backscattering coefficient, 0 where it is not known."""
        share = np.nan_to_num(self.lines_of(rows).beam_share)
        pixel = self._numbers(rows) % self.sensitivity.size
        return np.asarray(share * self.sensitivity[pixel] * np.nan_to_num(self.column_gain))

    def events(self, rows: Rows) -> FloatArray:
        """Return the heights that single events of the detector reach, shape (waveforms,)."""
        return np.asarray(self.event_height[self._numbers(rows) % self.event_height.size])

    def level_stderr(self, rows: Rows) -> FloatArray:
        """Return the standard errors of weak steady signals, shape (waveforms,)."""
        return np.asarray(self.baseline_stderr[self._numbers(rows) % self.baseline_stderr.size])

    def gain(self, rows: Rows) -> FloatArray:
        """Return the signal over that at the surface by distance, refraction and waves, shape (waveforms, time)."""
        lines = self.lines_of(rows)
        spreading = lines.spreading(self.geometry, self.time_ns)
        if self.focusing is None:
            return spreading
        return spreading * self.focusing.at(lines.depth_of_time(np.broadcast_to(self.time_ns, spreading.shape)))

    def saturated_samples(self, rows: Rows, records: Records) -> npt.NDArray[np.bool_]:
        """Return which samples are saturated in some waveforms, shape (waveforms, time)."""
        baseline = self.baseline[self._numbers(rows) % self.baseline.size, np.newaxis]
        high: npt.NDArray[np.bool_] = records.power + baseline >= self.saturation_level
        return high if self.saturated is None else high | self.saturated[rows]

    def records(self, rows: Rows) -> Records:
        """Return some of the waveforms less their baseline."""
        pixel = self._numbers(rows) % self.baseline.size
        noise = self.noise[rows] if len(self.noise) == self.count else self.noise[pixel]
        found = Records.of(self.samples[rows] - self.baseline[pixel, np.newaxis], self.time_ns, noise)
        return replace(found, shared=self.shared)


def _event_height(dataset: xr.Dataset, pixels: int) -> FloatArray:
    """Return the height that single events of the detector reach, shape (pixels,); 0 where it is not known."""
    if "event_height" not in dataset or dataset["event_height"].size != pixels:
        return np.zeros(pixels)
    return np.nan_to_num(dataset["event_height"].values.reshape(-1).astype(np.float64))


def _sensitivity(dataset: xr.Dataset, name: str, pixels: int) -> FloatArray:
    """Return the signal per power of steady light, shape (pixels,); 0 where it is not known."""
    if name == "waveform":
        return np.ones(pixels)
    if "receiver_sensitivity" not in dataset or dataset["receiver_sensitivity"].size != pixels:
        return np.zeros(pixels)
    return np.asarray(dataset["receiver_sensitivity"].values.reshape(-1), dtype=np.float64)


def _without_land(
    samples: npt.NDArray[Any], time: FloatArray, quiet_until: float, events: FloatArray, width: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[Any]]:
    """Return the bins before the sea and the samples of shots that are quiet there; else the bins before any land."""
    quiet = time < quiet_until
    if np.count_nonzero(quiet) < _FEWEST_QUIET:
        return quiet, samples
    rest = np.abs(samples[:, quiet] - np.nanmedian(samples[:, quiet]))
    least = max(float(np.nanmedian(rest)), float(np.nanmean(rest)) / _LAND, float(events.max(initial=0.0)))
    above = rest > _LAND * least
    if not above.any() or least <= 0:
        return quiet, samples
    of_shot = samples.reshape(-1, events.size, samples.shape[1])
    calm = ~above.any(axis=1).reshape(-1, events.size).any(axis=1)
    if calm.any():
        return quiet, of_shot[calm].reshape(-1, samples.shape[1])
    before = time < time[np.flatnonzero(above.any(axis=0))[0]] - 2 * width
    return (before if np.count_nonzero(before) >= _FEWEST_QUIET else quiet), samples


def _receiver_response(dataset: xr.Dataset, step: float) -> Response | None:
    """Return the response of the receiver that recorded a signal; None where it is not known."""
    if "receiver_response" not in dataset:
        return None
    response = dataset["receiver_response"]
    if response.dims != ("lag",) or response.size == 0 or "lag" not in response.coords:
        raise UserError(f"receiver_response of the dimensions {response.dims} must have the dimension lag")
    weights, lag = (np.asarray(one.values, dtype=np.float64) for one in (response, response["lag"]))
    if not (np.isfinite(weights).all() and np.isfinite(lag).all() and weights.sum() > 0):
        raise UserError("receiver_response must be finite, of a positive sum")
    width = step if lag.size == 1 else float(lag[-1] - lag[0]) / (lag.size - 1)
    if width <= 0 or np.any(np.abs(lag - lag[0] - width * np.arange(lag.size)) > 1e-3 * width):
        raise UserError("lag of receiver_response must increase in equal steps")
    return Response(round(lag[0] / width), weights / weights.sum(), width)


def _lines_of_sight(dataset: xr.Dataset, dims: tuple[str, ...]) -> LinesOfSight:
    """Return the waveforms' lines of sight, once for all shots if they share them."""
    moves = any("shot" in dataset[name].dims for name in ("surface_time", "angle_x") if name in dataset.coords)
    return LinesOfSight.from_dataset(dataset, dims if moves else tuple(dim for dim in dims if dim != "shot"))


def _logarithm(dataset: xr.Dataset) -> LogAmplifier | None:
    """Return the logarithmic amplifier of a recorded signal."""
    names = [f"receiver.logarithm.{field.name}" for field in fields(LogAmplifier)]
    if not set(names) & set(dataset.attrs):
        return None
    return LogAmplifier(*(required_number(dataset.attrs, name) for name in names))


def _expanded(dataset: xr.Dataset, logarithm: LogAmplifier) -> xr.Dataset:
    """Return a dataset with the signal before the logarithm, and its standard deviations to first order."""
    signal = dataset["signal"]
    replaced = {"signal": signal.copy(data=logarithm.expand(signal.values))}
    if "event_height" in dataset:
        replaced["event_height"] = dataset["event_height"].copy(data=logarithm.expand(dataset["event_height"].values))
    for name in {"signal_mean", "dark_level", "block_level"} & set(dataset):
        replaced[name] = dataset[name].copy(data=logarithm.expand(dataset[name].values))
    for name in ("signal_deviation", "signal_mean_stderr"):
        if name in dataset:
            error = dataset[name]
            mean = dataset["signal_mean"] if "signal_mean" in dataset else signal.mean({"shot"} & set(signal.dims))
            replaced[name] = error * logarithm.expansion(mean.transpose(*error.dims).values)
    return dataset.assign(replaced)


def _echo_width(dataset: xr.Dataset, template: Template, ns_per_mrad: float) -> float:
    """Return a level sea's echo width [ns] over the footprint of beam or field of view."""
    sigma = 0.5 * required_number(dataset.attrs, "divergence_mrad", 0.0)
    if field := required_number(dataset.attrs, "field_of_view_mrad", 0.0):
        sigma = min(sigma, 0.25 * field)
    spread = math.sqrt(8 * math.log(2)) * sigma * ns_per_mrad
    return min(math.hypot(template.fwhm_ns, spread), _LONGEST_ECHO * template.fwhm_ns)


def _noise(
    dataset: xr.Dataset,
    name: str,
    samples: npt.NDArray[Any],
    calm: npt.NDArray[Any],
    baseline: FloatArray,
    quiet: npt.NDArray[np.bool_],
    noise: float | npt.ArrayLike | None,
    run: int,
) -> FloatArray:
    """Return the noise for means of `run` samples, shaped as `Waveforms.noise`."""
    pixels, count = baseline.size, samples.shape[1]
    if noise is not None:
        given = np.asarray(noise, dtype=np.float64)
        if given.size not in (1, pixels, pixels * count):
            raise UserError(f"noise of shape {given.shape} must be a number, or one per pixel, or per pixel and bin")
        return given.reshape(-1, 1) + np.zeros((pixels, 1)) if given.size <= pixels else given.reshape(pixels, count)
    if name == "waveform" and "waveform_stderr" in dataset:
        return np.asarray(pooled_errors(dataset, few=True).values.reshape(-1, count), dtype=np.float64)
    by_receiver = _receiver_noise(dataset, samples, calm, baseline, quiet, run)
    if "signal_mean_stderr" not in dataset:
        return by_receiver
    # Structures within the error of a render are no echoes, though they are in all records of a shot. That of a peak is
    # its own, without the factor of means, with which most bottoms of renders to 10 % would be lost.
    by_render = dataset["signal_mean_stderr"].values.reshape(-1, count)
    if len(by_receiver) not in (1, len(by_render)):
        by_receiver = np.tile(by_receiver, (len(by_render) // pixels, 1))
    return np.asarray(np.hypot(by_receiver, by_render))


def _noise_of_render(
    dataset: xr.Dataset, deviation: FloatArray, run: int
) -> tuple[FloatArray, BlockCorrelation | None]:
    """Return the noise for means of `run` render samples with the errors `deviation`, and its correlation."""
    errors = SumErrors.of(dataset)
    if errors is None:
        return deviation, None
    factor = errors.of_means(deviation, run, int(dataset.attrs.get("passes", 0)))
    return factor * deviation, None if errors.shared is None else replace(errors.shared, inflation=factor)


def _receiver_noise(
    dataset: xr.Dataset,
    samples: npt.NDArray[Any],
    calm: npt.NDArray[Any],
    baseline: FloatArray,
    quiet: npt.NDArray[np.bool_],
    run: int,
) -> FloatArray:
    """Return the receiver signal's noise for means of `run` samples."""
    pixels, count = baseline.size, samples.shape[1]
    if "block_level" in dataset:  # noise alone is hardly stored
        stated, mean = (dataset[key].values.reshape(-1, count) for key in ("signal_deviation", "signal_mean"))
        shots = samples[: _MOST_SHOTS * pixels].reshape(-1, pixels, count)
        own = slice(0, len(shots) * pixels)
        floored = np.where(stated > 0, stated, 1.0)
        known = (shots - mean[own].reshape(-1, pixels, count)) / floored[own].reshape(-1, pixels, count)
        return np.asarray(stated * inflation(known, run))
    if np.count_nonzero(quiet) < _FEWEST_QUIET:
        raise UserError(f"noise must be given: the record has less than {_FEWEST_QUIET} bins before the surface echo")
    rest = calm[:, quiet].reshape(-1, pixels, np.count_nonzero(quiet)) - baseline[:, np.newaxis]
    spread = np.sqrt(np.mean(rest**2, axis=(0, 2)))[:, np.newaxis]
    if "signal_deviation" not in dataset:
        return np.asarray(spread * inflation(rest, run))
    # The scatter of a sample at a limit is smaller than its error.
    deviation = dataset["signal_deviation"].values.reshape(-1, pixels, count)
    deviation = np.maximum(deviation, spread)
    shots = samples[: _MOST_SHOTS * pixels].reshape(-1, pixels, count)
    # Jitter moves and scales whole echoes from shot to shot, which is no noise of their samples.
    if len(shots) < _FEWEST_SHOTS or "receiver.jitter" in dataset.attrs:
        return np.asarray(deviation.reshape(-1, count) * inflation(rest, run))
    # The noise has a larger correlation in an echo than in the dark. Shots of one place differ by noise alone.
    of_each = "shot" in dataset["signal_deviation"].dims and "signal_mean" in dataset
    mean = dataset["signal_mean"].values.reshape(-1, pixels, count)[: len(shots)] if of_each else shots.mean(axis=0)
    floored = np.where(deviation > 0, deviation, 1.0)[: len(shots)]
    return np.asarray(deviation.reshape(-1, count) * inflation((shots - mean) / floored, run))


def _without_gaps(
    dataset: xr.Dataset, samples: npt.NDArray[Any], noise: FloatArray
) -> tuple[npt.NDArray[Any], FloatArray]:
    """Return samples and noise, shape (count, time), with the dark level where no sample is stored.

    Signals there may lie anywhere up to the threshold of blocks: they hardly count.
    """
    dark, level = _block_levels(dataset, dataset["dark_level"].size)
    missing, pixel = np.isnan(samples), np.arange(len(samples)) % dark.size
    own = np.broadcast_to(noise if len(noise) == len(samples) else noise[pixel], samples.shape)
    unknown = np.maximum(own, _UNKNOWN * (level - dark)[pixel, np.newaxis])
    return np.where(missing, dark[pixel, np.newaxis], samples), np.where(missing, unknown, own)


def _block_levels(dataset: xr.Dataset, pixels: int) -> tuple[FloatArray, FloatArray]:
    """Return the level without light, and that above which samples are stored, shape (pixels,)."""
    dark, level = (dataset[name].values.ravel().astype(np.float64) for name in ("dark_level", "block_level"))
    if dark.size != pixels or level.size != pixels or not np.all(level > dark) or not np.isfinite(level - dark).all():
        raise UserError("dark_level and block_level must have a finite number for each pixel, and the second be larger")
    return dark, level
