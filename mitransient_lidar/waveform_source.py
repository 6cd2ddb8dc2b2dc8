"""Waveforms of a dataset made ready to be measured: baseline, noise, and the lidar's geometry."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import dataset_files, results
from mitransient_lidar.errors import UserError
from mitransient_lidar.optics.checks import FloatArray, positive
from mitransient_lidar.optics.echoes import Records, Template
from mitransient_lidar.optics.electronics import LogAmplifier
from mitransient_lidar.optics.pulse import Pulse
from mitransient_lidar.optics.refraction import snell, solid_angle_per_area, surface_time_ns
from mitransient_lidar.optics.water import C0

_DIMENSIONS = (("pixel", "time"), ("row", "column", "time"))
_SHOTS, _FEWEST_SHOTS = 200, 20  # shots that tell how alike neighbouring samples are
_LONGEST_ECHO = 4.0  # pulse widths: beyond, the footprint's spread is not used


def open_waveforms(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read waveforms: a result, or a NetCDF file of shots or of what a receiver recorded.

    Parameters
    ----------
    path : path
        What `results.save` wrote, or `xarray.Dataset.to_netcdf` in the format NetCDF-4.

    Returns
    -------
    xarray.Dataset
        With ``waveform`` or ``signal``, in memory.

    Raises
    ------
    UserError
        If the file is missing or damaged, or holds neither.
    """
    if dataset_files.read_signature(path) != dataset_files.HDF5_SIGNATURE:
        return results.open(path)
    try:
        dataset = dataset_files.read_netcdf(path)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path} is not of mitransient-lidar: {error}") from error
    if not {"signal", "waveform"} & set(dataset):
        raise UserError(f"{path} holds neither a signal nor a waveform over time.")
    return dataset


@dataclass(frozen=True)
class Source:
    """Waveforms and what is needed to measure them.

    Attributes
    ----------
    dims, shape, unit
        Dimensions, their sizes and the unit of the variable.
    samples
        Its values, shape (count, time); the pixels repeat from shot to shot. Of a signal behind a logarithm, the
        voltages before it.
    time_ns
        Centres of the bins [ns], shape (time,).
    baseline
        What each pixel records without light, shape (pixels,).
    noise
        Standard deviation of each pixel's samples, shape (pixels, time) or (pixels, 1).
    saturated, saturation_level
        Samples at a limit, of the shape of `samples`, and the least such sample.
    kernel, template
        Pulse and response in bins, and the shape of an ideal echo.
    echo_fwhm_ns
        Expected width of an echo [ns].
    quiet_until_ns
        No echo comes before [ns].
    surface_ns
        Arrival of the mean surface echo [ns].
    metres_per_ns, attenuation_per_decay
        Depth per delay [m/ns], and attenuation along the path per rate of decay [ns/m].
    gain
        What distance and refraction leave of a signal over that at the surface, shape (1, time).
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    unit: str
    samples: npt.NDArray[Any]
    time_ns: FloatArray
    baseline: FloatArray
    noise: FloatArray
    saturated: npt.NDArray[np.bool_] | None
    saturation_level: float
    kernel: tuple[int, FloatArray]
    template: Template
    echo_fwhm_ns: float
    quiet_until_ns: float
    surface_ns: float
    metres_per_ns: float
    attenuation_per_decay: float
    gain: FloatArray

    @property
    def count(self) -> int:
        """Number of waveforms."""
        return len(self.samples)

    @classmethod
    def of(
        cls,
        dataset: xr.Dataset,
        pulse: Pulse | None,
        noise: float | npt.ArrayLike | None,
        echo_fwhm_ns: float | None,
        saturation_level: float | None,
    ) -> Source:
        """Read a dataset; the arguments are those of `waveforms.extract`.

        Raises
        ------
        UserError
            If the dataset does not hold what is needed.
        ValueError
            If another argument is out of range.
        """
        name, dims = _variable(dataset)
        logarithm = _logarithm(dataset) if name == "signal" else None
        if logarithm is not None:
            dataset = _expanded(dataset, logarithm)
            saturation_level = None if saturation_level is None else float(logarithm.expand(saturation_level))
        time = np.asarray(dataset["time"].values, dtype=np.float64)
        values = dataset[name].values
        samples = values.reshape(-1, time.size)
        if not np.isfinite(samples).all():
            raise UserError(f"{name} holds values that are not finite: render or record it again")
        height, off_nadir = _attribute(dataset, "altitude"), math.radians(_attribute(dataset, "off_nadir_deg"))
        index, group = _attribute(dataset, "refractive_index"), _attribute(dataset, "group_index")
        surface = dataset.attrs.get("surface_time_ns", float(surface_time_ns(height, off_nadir)))
        shape = pulse or Pulse.gaussian(_attribute(dataset, "pulse_fwhm_ns"))
        step = float(time[1] - time[0]) if time.size > 1 else 1.0
        response = float(dataset.attrs.get("response_time_ns", 0.0))
        template = Template.of(shape, step, response)
        # Two-way time over the angle from the axis, in the plane of incidence.
        slope = 2e6 * height * math.sin(off_nadir) / (C0 * math.cos(off_nadir) ** 2)
        width = _width(dataset, template, slope) if echo_fwhm_ns is None else positive("echo_fwhm_ns", echo_fwhm_ns)
        view = 0.5 * float(dataset.attrs.get("field_of_view_mrad", 0.0))
        quiet_until = surface - 2 * width - slope * view
        pixels = int(np.prod([dataset.sizes[dim] for dim in dims if dim not in ("shot", "time")]))
        quiet = time < quiet_until
        baseline = np.zeros(pixels)
        if name == "signal":
            if np.count_nonzero(quiet) < 4:
                raise UserError(f"the record must hold at least 4 bins before {quiet_until:.1f} ns for its baseline")
            baseline = samples[:, quiet].reshape(-1, pixels, np.count_nonzero(quiet)).mean(axis=(0, 2))
        found = _noise(dataset, name, samples, baseline, quiet, noise, max(int(template.fwhm_ns / step), 1))
        cos_water = float(np.cos(snell(off_nadir, index)))
        per_ns = 1e-9 * C0 / (2 * group)
        depth = np.maximum(time - surface, 0) * per_ns * cos_water
        loss = solid_angle_per_area(height, depth, off_nadir, index)
        return cls(
            dims,
            values.shape,
            str(dataset[name].attrs.get("units", "")),
            samples,
            time,
            baseline,
            found,
            dataset["saturated"].values.reshape(-1, time.size).astype(bool) if "saturated" in dataset else None,
            math.inf if saturation_level is None else float(saturation_level),
            shape.kernel(step, response),
            template,
            width,
            quiet_until,
            surface,
            per_ns * cos_water,
            0.5 / per_ns,
            (loss / solid_angle_per_area(height, 0.0, off_nadir, index))[np.newaxis],
        )

    def records(self, rows: slice) -> Records:
        """Return some of the waveforms less their baseline."""
        pixel = np.arange(rows.start, rows.stop) % self.baseline.size
        return Records.of(self.samples[rows] - self.baseline[pixel, np.newaxis], self.time_ns, self.noise[pixel])


def _variable(dataset: xr.Dataset) -> tuple[str, tuple[str, ...]]:
    """Return which variable to measure and its dimensions."""
    names = [name for name in ("signal", "waveform") if name in dataset]
    if not names:
        raise UserError("the dataset has neither signal nor waveform: it must be a result that kept its record in time")
    dims = tuple(str(dim) for dim in dataset[names[0]].dims)
    if tuple(dim for dim in dims[:1] if dim != "shot") + dims[1:] not in _DIMENSIONS:
        raise UserError(
            f"{names[0]} has the dimensions {dims}; they must be (pixel, time) or (row, column, time), or these after "
            "shot"
        )
    if missing := [dim for dim in dims if dim not in dataset.coords]:
        raise UserError(f"the dataset has no coordinate {missing[0]}; {names[0]} over {dims} needs it")
    return names[0], dims


def _attribute(dataset: xr.Dataset, name: str) -> float:
    value = dataset.attrs.get(name)
    if not isinstance(value, (int, float)) or not math.isfinite(value) or value < 0:
        raise UserError(f"the attribute {name} = {value!r} of the dataset must be a number of at least 0")
    return float(value)


def _logarithm(dataset: xr.Dataset) -> LogAmplifier | None:
    """Return the logarithm behind which a signal was recorded."""
    names = [f"receiver.logarithm.{field.name}" for field in fields(LogAmplifier)]
    if not set(names) & set(dataset.attrs):
        return None
    return LogAmplifier(*(_attribute(dataset, name) for name in names))


def _expanded(dataset: xr.Dataset, logarithm: LogAmplifier) -> xr.Dataset:
    """Return a dataset with the signal before the logarithm, and its standard deviation to first order."""
    signal = dataset["signal"]
    replaced = {"signal": signal.copy(data=logarithm.expand(signal.values))}
    if "signal_deviation" in dataset:
        deviation = dataset["signal_deviation"]
        mean = dataset["signal_mean"] if "signal_mean" in dataset else signal.mean({"shot"} & set(signal.dims))
        replaced["signal_deviation"] = deviation * logarithm.expansion(mean.transpose(*deviation.dims).values)
    return dataset.assign(replaced)


def _width(dataset: xr.Dataset, template: Template, ns_per_mrad: float) -> float:
    """Return the width [ns] of an echo of the whole beam's footprint on the level sea, or of what a view holds."""
    sigma = 0.5 * float(dataset.attrs.get("divergence_mrad", 0.0))
    if field := float(dataset.attrs.get("field_of_view_mrad", 0.0)):
        sigma = min(sigma, 0.25 * field)
    spread = math.sqrt(8 * math.log(2)) * sigma * ns_per_mrad
    return min(math.hypot(template.fwhm_ns, spread), _LONGEST_ECHO * template.fwhm_ns)


def _noise(
    dataset: xr.Dataset,
    name: str,
    samples: npt.NDArray[Any],
    baseline: FloatArray,
    quiet: npt.NDArray[np.bool_],
    noise: float | npt.ArrayLike | None,
    run: int,
) -> FloatArray:
    """Return the noise of each pixel, shape (pixels, time) or (pixels, 1)."""
    pixels, count = baseline.size, samples.shape[1]
    if noise is not None:
        given = np.asarray(noise, dtype=np.float64)
        if given.size not in (1, pixels, pixels * count):
            raise UserError(f"noise of shape {given.shape} must be a number, or one for each pixel, or pixel and bin")
        return given.reshape(-1, 1) + np.zeros((pixels, 1)) if given.size <= pixels else given.reshape(pixels, count)
    if name == "waveform" and "waveform_stderr" in dataset:
        bins, growth = (dataset.attrs.get(key, 1.0) for key in ("error_growth_bins", "error_growth"))
        factor = np.interp(math.log(run), np.log(np.atleast_1d(bins)), np.atleast_1d(growth))
        return float(factor) * dataset["waveform_stderr"].values.reshape(-1, count)[-pixels:]
    if np.count_nonzero(quiet) < 4:
        raise UserError("noise must be given: the record does not hold 4 bins before the surface echo")
    rest = samples[:, quiet].reshape(-1, pixels, np.count_nonzero(quiet)) - baseline[:, np.newaxis]
    spread = np.sqrt(np.mean(rest**2, axis=(0, 2)))[:, np.newaxis]
    if "signal_deviation" not in dataset:
        return np.asarray(spread * _growth(rest, run))
    # A sample at a limit does not scatter, and is not the better known for that.
    deviation = np.maximum(dataset["signal_deviation"].values.reshape(-1, count), spread)
    shots = samples[: _SHOTS * pixels].reshape(-1, pixels, count)
    if len(shots) < _FEWEST_SHOTS:
        return np.asarray(deviation * _growth(rest, run))
    # The shots differ by their noise only, which a filter makes more alike under an echo than in the dark.
    floored = np.where(deviation > 0, deviation, 1.0)
    return np.asarray(deviation * _growth((shots - shots.mean(axis=0)) / floored, run))


def _growth(rest: FloatArray, run: int) -> float:
    """Return by how much means of neighbouring samples (..., time) spread more than those of independent ones."""
    run = min(run, rest.shape[-1])
    blocks = rest.shape[-1] // run
    means = rest[..., : blocks * run].reshape(*rest.shape[:-1], blocks, run).mean(axis=-1)
    variance = float(np.mean(rest**2))
    return math.sqrt(max(run * float(np.mean(means**2)) / variance, 1.0)) if variance > 0 else 1.0
