"""Sea slope, bottom and water, estimated from result echoes.

The functions take a dataset with ``waveform`` [W] over (pixel, time) or (shot, pixel, time), and keep the dimension
``shot``. Receiver and transmitter must be coaxial.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.retrieval import (
    bottom_errors,
    column_retrieval,
    scattered_light,
    surface_inputs,
    surface_slope,
)
from mitransient_lidar.analysis.retrieval.bottom_errors import ReflectanceFlag, scatter, steadier
from mitransient_lidar.analysis.retrieval.surface_echoes import PixelMap, SeaLidar, sea_shots
from mitransient_lidar.analysis.retrieval.surface_slope import SlopeRefraction, bottom_depth, bottom_gain
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, checked
from mitransient_lidar.core.validation import FloatArray, in_range, positive
from mitransient_lidar.results import geometry
from mitransient_lidar.results.attributes import flagged, label, made_from
from mitransient_lidar.results.files import Given, dataset_of

_LOG = logging.getLogger(__name__)

_DEEPEST_PATH = 8.0  # in the water, at which a column shows the water's properties [m]


def surface_slopes(
    dataset: xr.Dataset,
    *,
    wind_speed: float | None = None,
    wind_direction_deg: float | None = None,
    slope_deviation: tuple[float, float] | None = None,
    efficiency: float | None = None,
) -> xr.Dataset:
    """Estimate slope, direction and height of the surface from the pixels' surface echoes: times and strengths.

    Raises `UserError` if the dataset lacks pixels, a coordinate or an attribute, or a number is out of range.

    `dataset`: waveforms of at least two pixels. `wind_speed`: wind speed [m/s], 1 to 30, whose sea gives the prior. By
    default, the scene's if its sea has the Elfouhaily spectrum and the Cox and Munk slopes. `wind_direction_deg`:
    direction that the wind blows towards, counter-clockwise from +x [degree]. By default, the scene's, or +x.
    `slope_deviation`: prior for an unknown sea instead: standard deviations of the slopes along the lidar's azimuth and
    across, averaged over a footprint [1], above 0. `efficiency`: as for `bottom`.

    Result: over ``shot`` if present: ``slope_along``, positive for a face towards the lidar, ``slope_across``, positive
    for a rise to the left [1], with ``_stderr``; ``slope_deg`` and ``slope_direction_deg`` of the steepest rise from
    the lidar's azimuth to the left [degree]; ``surface_range`` along the axis, with ``_stderr``, and ``surface_height``
    above the mean level [m], with ``_stderr``; ``plane_misfit`` [ns]. NaN where the pixels do not determine it.
    Attributes: ``slope_method``: ``times and strengths``, ``times on a sea`` or ``times``; and
    ``slope_prior_deviation``: prior standard deviations along and across [1] and of the range [m]. Without a sea model,
    a slope beyond 5 standard deviations of the sea's slopes (attribute ``surface_slope_variance``) is NaN as well, and
    ``slope_refused`` is 1.

    With a known wind, the estimate is `surface_slope.slopes_on_sea`: slopes averaged over the beam's footprint, with
    errors that hold on this sea. It needs a Gaussian beam and 2 to 64 pixels with outlines. Strengths count if the
    waveform is in W and the efficiency known. Otherwise a plane is fitted to the times; without a prior, its slopes are
    much steeper than a sea's.

    Times come from the ``gaussian`` estimator. A pixel's light is a Gaussian beam inside its outline, or without
    outlines a point at its centre.
    """
    lidar = geometry.lidar_geometry(dataset.attrs)
    if "pixel" not in dataset.dims or dataset.sizes["pixel"] < 2:
        raise UserError("surface slopes need waveforms of at least 2 pixels over the dimension pixel")
    for name, value in {"wind_speed": wind_speed, "wind_direction_deg": wind_direction_deg}.items():
        if slope_deviation is not None and value is not None:
            raise UserError(f"slope_deviation = {slope_deviation} and {name} = {value:g} are alternatives")
    echoes = echo_table.extract(dataset).transpose(..., "pixel")
    surface = echoes.sel(echo="surface")
    shape = surface["time_ns"].shape[:-1]
    time, error = (surface[name].values.reshape(-1, dataset.sizes["pixel"]) for name in ("time_ns", "time_ns_stderr"))
    light = surface_inputs.pixel_light(dataset)
    plane = surface_slope.fit_plane(time, light, lidar.off_nadir, stderr_ns=error)
    refused, limit = np.zeros(len(time), dtype=bool), surface_inputs.steepest_sea(dataset)
    wind = None if slope_deviation is not None else surface_inputs.wind(dataset, wind_speed, wind_direction_deg)
    if wind is not None:
        scale = surface_inputs.energy_scale(dataset, efficiency)
        measured = surface_inputs.pixel_echoes(echoes, lidar, light)
        lines = surface_inputs.outlines(dataset)
        beam = 0.5e-3 * geometry.required_number(dataset.attrs, "divergence_mrad")
        sender = SeaLidar(**vars(lidar), beam=beam, pixels=PixelMap.of_outlines(lines))
        sea = surface_slope.slopes_on_sea(measured, sea_shots(sender, *wind), scale)
        per_height = np.array([1, 1, 1 / math.cos(lidar.off_nadir)])
        seen = np.isfinite(time).any(axis=1)
        along, across, height = np.where(seen, sea.mean.T, np.nan)
        variance = np.where(seen, np.diagonal(sea.covariance, axis1=1, axis2=2).T, np.nan)
        along_error, across_error, distance_error = np.sqrt(variance) * per_height[:, np.newaxis]
        method = "times on a sea" if scale is None else "times and strengths"
        distance = (lidar.height - height) / math.cos(lidar.off_nadir)
        prior = np.sqrt(np.diag(sea.prior)) * per_height
    else:
        slopes = [(plane.along, plane.along_stderr), (plane.across, plane.across_stderr)]
        steep = [np.abs(slope) > limit for slope, _ in slopes]
        refused = np.any(steep, axis=0)
        slopes = [
            (np.where(one, np.nan, slope), np.where(one, np.nan, error))
            for one, (slope, error) in zip(steep, slopes, strict=True)
        ]
        if slope_deviation is None:
            slope_deviation = dataset.attrs.get("slope_deviation")
        if slope_deviation is not None:
            slopes = [
                surface_slope.with_prior(*pair, positive("slope_deviation", one))
                for pair, one in zip(slopes, slope_deviation, strict=True)
            ]
        (along, along_error), (across, across_error) = slopes
        height = lidar.height - plane.range_m * math.cos(lidar.off_nadir)
        method, distance, distance_error = "times", plane.range_m, plane.range_stderr
        prior = np.array(surface_inputs.largest_deviations(dataset))
        if slope_deviation is not None:
            prior[:2] = slope_deviation
    height_error = distance_error * math.cos(lidar.off_nadir)
    steepness, direction = surface_slope.steepest(along, across)
    table = {
        "slope_along": along,
        "slope_along_stderr": along_error,
        "slope_across": across,
        "slope_across_stderr": across_error,
        "slope_deg": np.degrees(steepness),
        "slope_direction_deg": np.degrees(direction),
        "surface_range": distance,
        "surface_range_stderr": distance_error,
        "surface_height": height,
        "surface_height_stderr": height_error,
        "plane_misfit": plane.misfit_ns,
        "slope_refused": refused.astype(np.float64),
    }
    found = _labelled(dataset, table, shape)
    found = found.assign_attrs(slope_method=method, slope_prior_deviation=[float(one) for one in prior])
    return found.assign_attrs({"steepest_slope": limit}) if math.isfinite(limit) else found


def bottom(dataset: xr.Dataset, slopes: xr.Dataset, *, efficiency: float | None = None) -> xr.Dataset:
    """Estimate depth and reflectance of the bottom, without and with the surface's slope and height.

    Raises `UserError` if the dataset lacks an attribute or a number is out of range.

    `dataset`: waveforms; their pixels are summed. All shots must be in the same water. `slopes`: output of
    `surface_slopes`. An unknown slope is replaced by 0, an unknown range by the mean sea's. `efficiency`: transmitter
    and receiver efficiency times the atmosphere's two-way transmittance, 0 to 1. By default, from the attribute
    ``two_way_efficiency``.

    Result: over ``shot`` if present and ``correction``: ``reflectance`` [1] through a level sea at its mean height
    (``level``), through the shot's plane (``slope``), and from the ratio of the echo to the column (``column``), with
    ``reflectance_stderr``; ``depth_m`` below the mean sea level [m], NaN for the last, with ``depth_m_stderr`` by
    noise, method, slope and height of the sea; ``reflectance_corrected`` and ``depth_corrected``, whether the
    correction was applied: otherwise the value is the one before it. Also ``bottom_energy`` [J], ``reflectance_flags``,
    sums of `bottom_errors.ReflectanceFlag`, and from the last reflectance ``class_probability`` over ``bottom_class``.
    NaN without a bottom echo; reflectances are NaN where a flag is set, without a column with a warning. Depth and
    energy are NaN if the echo comes from a target.

    Reflectances ``level`` and ``slope`` use the mean attenuation over all shots. The ratio needs a column with at least
    8 bins in each shot, but hardly depends on the slope, and corrects for focusing by waves.

    Column and bottom decay as `scattered_light` finds for homogeneous water with typical particles. The light is the
    beam's light in the pixels (coordinate ``beam_share``) through the open part of the aperture. Reflectance errors
    include noise, 1 % of the echo energy, and the unknown particle bb/b. Focusing waves, sea slope and height, and the
    beam share that targets hide add to them. So do layers: differences from homogeneous water, or 3 % of the two-way
    optical depth where columns are too short for a test. A relative error above 0.5 leaves no value. Errors of
    efficiencies and pulse energy are not included.

    A correction that is not expected to lower the variance is not applied. The slope correction is left out where
    `surface_slope.variances` gives no lower variance with it, and the column correction where its noise exceeds the
    reflectance scatter over the shots. With at least 8 shots, a correction that increases the reflectance scatter is
    not applied to any, as focusing by waves may have the opposite effect. With fewer shots their scatter is not known.
    """
    lidar = geometry.lidar_geometry(dataset.attrs)
    summed = surface_inputs.summed_pixels(dataset)
    echoes = echo_table.extract(summed, depth_from="mean", layers=2).isel(pixel=0)
    margin = 0.5 * float(echoes.attrs["echo_fwhm_ns"]) * lidar.depth_per_ns
    flags, hidden = bottom_errors.target_flags(echoes, dataset.attrs, margin, one_place="shot" not in echoes.dims)
    seabed, column = (echoes.sel(echo=name) for name in ("bottom", "column"))
    seabed = seabed.where(xr.DataArray(flags & ReflectanceFlag.TARGET == 0, dims=seabed["time_ns"].dims))
    time = seabed["time_ns"].values
    system, share = geometry.lidar_system(dataset.attrs, efficiency), geometry.share_in_view(dataset)
    flags |= np.where(share < bottom_errors.LEAST_SHARE, int(ReflectanceFlag.NO_DIRECT_LIGHT), 0)
    share = np.where(share < bottom_errors.LEAST_SHARE, np.nan, share)
    waveforms = Waveforms.from_dataset(summed, None, None, None, None)
    scattered = scattered_light.of_columns(waveforms, echoes, system, share, dataset)
    whole, by_noise = bottom_errors.whole_energy(waveforms, echoes, scattered)
    missing = np.isnan(time)
    energy, energy_error = np.where(missing, np.nan, whole), np.where(missing, np.nan, by_noise)
    along, across = (np.nan_to_num(slopes[f"slope_{name}"].values) for name in ("along", "across"))
    known_range = slopes["surface_range"].values
    ranges = np.where(np.isfinite(known_range), known_range, lidar.slant_range)
    level = SlopeRefraction.of(0.0, 0.0, lidar.off_nadir, lidar.refractive_index)
    ray = SlopeRefraction.of(along, across, lidar.off_nadir, lidar.refractive_index)
    surfaces: list[tuple[npt.ArrayLike, FloatArray, SlopeRefraction]] = [
        (lidar.slant_range, (time - lidar.surface_time_ns) * lidar.metres_per_ns, level),
        (ranges, (time - 2e9 * ranges / C0) * lidar.metres_per_ns, ray),
    ]
    depth = [bottom_depth(distance, path, lidar.height, lidar.off_nadir, one) for distance, path, one in surfaces]

    power, attenuation = column["amplitude"].values, echoes["attenuation"].values
    mean_attenuation = scattered_light.mean_of_known(attenuation)
    if math.isnan(mean_attenuation):
        _LOG.warning("no waveform has a column long enough for a fit: the reflectance of the bottom is unknown")
    helpful, by_sea = bottom_errors.sea_variances(lidar, time, mean_attenuation, slopes)
    by_waves, by_estimate = by_sea["depth"]
    depth_corrected = helpful["depth"] & np.isfinite(depth[1])
    depth[1] = np.where(depth_corrected, depth[1], depth[0])
    # The error through a level sea includes that by typical waves, which estimated slope and height replace.
    level_error = np.hypot(seabed["depth_m_stderr"].values, seabed["depth_m_method_error"].values)
    others = np.maximum(level_error**2 - np.where(np.isfinite(by_waves), by_waves, 0), 0)
    depth_error = [level_error, np.where(depth_corrected, np.sqrt(others + by_estimate), level_error)]
    received = system.energy * system.aperture_area * share
    reflectance = []
    more = 0.0 if scattered is None else scattered.bottom_loss(np.asarray(surfaces[0][1]))
    # Waves focus the bottom's light as they do the column's.
    light = energy * np.exp(more) / bottom_errors.focusing_at(dataset, depth[0])
    for distance, path, one in surfaces:
        gain = bottom_gain(distance, np.nan_to_num(path), lidar.refractive_index, one)
        reflectance.append(np.pi * light * np.exp(2 * mean_attenuation * path) / (received * gain))
    slope_corrected = helpful["reflectance"] & np.isfinite(reflectance[1]) & steadier(reflectance[1], reflectance[0])
    reflectance[1] = np.where(slope_corrected, reflectance[1], reflectance[0])
    backscatter = scattered_light.mean_of_known(scattered_light.backscatter_of(echoes, system, share))
    delay = time - echoes["time_ns"].sel(echo="surface").values
    spreading = lidar.spreading(np.nan_to_num(delay) * lidar.metres_per_ns)
    at_bottom = power * spreading * np.exp(-2 * attenuation * delay * lidar.metres_per_ns)
    vertical = np.where(slope_corrected, ray.cos_vertical, level.cos_vertical)
    ratio = column_retrieval.bottom_reflectance(light, at_bottom, backscatter, vertical, lidar.group_index)
    of_echo = bottom_errors.echo_error(energy, energy_error)
    of_decay = 2 * delay * lidar.metres_per_ns * echoes["attenuation_stderr"].values
    parts = (energy_error / energy, column["amplitude_stderr"].values / power, of_decay)
    relative = np.sqrt(sum(np.nan_to_num(part) ** 2 for part in parts))
    column_corrected = np.isfinite(ratio) & (relative < scatter(reflectance[1])) & steadier(ratio, reflectance[1])
    reflectance.append(np.where(column_corrected, ratio, np.where(np.isfinite(ratio), reflectance[1], np.nan)))

    loss = bottom_errors.loss_error(waveforms, echoes, depth[0], surfaces[0][1], mean_attenuation, scattered)
    common = of_echo**2 + loss**2 + hidden**2 + scattered_light.mean_of_known(of_decay**2) / _count(of_decay)
    wavy = bottom_errors.focusing(dataset.attrs, lidar.slant_range) ** 2
    without, corrected = by_sea["reflectance"]
    of_sea = [wavy + without, wavy + np.where(slope_corrected, corrected, without)]
    # The ratio to the column removes the sea's effect on a shot, but not on the mean over all.
    of_ratio = relative**2 + of_sea[1] / _count(ratio)
    of_sea.append(np.where(column_corrected, of_ratio, of_sea[1]))
    deviation = np.sqrt(common[..., np.newaxis] + np.stack(np.broadcast_arrays(*of_sea), axis=-1))
    flags |= np.where(np.isfinite(time) & np.isnan(attenuation), int(ReflectanceFlag.NO_COLUMN), 0)
    unsure = (deviation[..., 2] > bottom_errors.LARGEST_ERROR) & np.isfinite(share)
    flags |= np.where(unsure, int(ReflectanceFlag.UNCERTAIN), 0)
    unsure = (deviation > bottom_errors.LARGEST_ERROR) | (flags != 0)[..., np.newaxis]
    known = np.where(unsure, np.nan, np.stack(reflectance, axis=-1))
    errors = np.abs(known) * deviation
    probability = column_retrieval.bottom_class(known[..., 2], errors[..., 2])
    found = _labelled(dataset, {"bottom_energy": energy}, echoes["attenuation"].shape)
    dims = tuple(found["bottom_energy"].dims)
    unknown = np.full(np.shape(time), np.nan)
    depths = np.stack(np.broadcast_arrays(*depth, unknown), axis=-1)
    depth_errors = np.where(np.isfinite(depths), np.stack(np.broadcast_arrays(*depth_error, unknown), axis=-1), np.nan)
    applied: dict[str, tuple[Any, Any]] = {
        "reflectance": (slope_corrected, column_corrected),
        "depth": (depth_corrected, False),
    }
    for name, (by_slope, by_column) in applied.items():
        steps = np.stack(np.broadcast_arrays(np.zeros(np.shape(time), dtype=bool), by_slope, by_column), axis=-1)
        found[f"{name}_corrected"] = ((*dims, "correction"), steps)
    numbers = {"reflectance": known, "reflectance_stderr": errors, "depth_m": depths, "depth_m_stderr": depth_errors}
    for name, values in numbers.items():
        found[name] = ((*dims, "correction"), values)
    found["class_probability"] = ((*dims, "bottom_class"), probability)
    found["reflectance_flags"] = (dims, np.broadcast_to(flags, np.shape(time)), flagged(ReflectanceFlag))
    names = {"correction": ["level", "slope", "column"], "bottom_class": list(column_retrieval.BOTTOM_CLASSES)}
    return label(found.assign_coords(names), "bottom")


def water(dataset: xr.Dataset, *, efficiency: float | None = None) -> xr.Dataset:
    """Estimate absorption, backscattering, Kd and bounds of c from the column.

    Raises `UserError` if the view is too narrow, the dataset lacks an attribute or a number is out of range.

    `dataset`: waveforms; their pixels are summed. The field of view on the sea must be at least 6 m, far wider than the
    beam. `efficiency`: as for `bottom`.

    Result: over ``shot`` if present: ``column_attenuation``, ``absorption``, ``backscattering`` and ``kd`` with
    ``_stderr``, and ``attenuation`` with its bounds ``attenuation_low`` and ``attenuation_high`` [1/m]; see
    `column_retrieval.WaterEstimate`. NaN without a column or where the pixels see less than a twentieth of the beam.
    """
    lidar = geometry.lidar_geometry(dataset.attrs)
    summed = surface_inputs.summed_pixels(dataset)
    end = lidar.surface_time_ns + _DEEPEST_PATH / lidar.metres_per_ns
    in_range("spot_diameter", geometry.spot_diameter(dataset.attrs), column_retrieval.SMALLEST_SPOT, math.inf)
    shallow = summed.isel(time=summed["time"].values < end)
    echoes = echo_table.extract(shallow).isel(pixel=0)
    column, system = echoes.sel(echo="column"), geometry.lidar_system(dataset.attrs, efficiency)
    share = np.where((seen := geometry.share_in_view(dataset)) < bottom_errors.LEAST_SHARE, np.nan, seen)
    waveforms = Waveforms.from_dataset(shallow, None, None, None, None)
    light = scattered_light.of_columns(waveforms, echoes, system, share, dataset)
    decay, decay_error = echoes["attenuation"].values, echoes["attenuation_stderr"].values
    backscatter = scattered_light.backscatter_of(echoes, system, share)
    excess, gain = (np.nan, np.nan) if light is None else (light.excess, light.level)
    found = column_retrieval.water_of_column(decay, backscatter, excess, gain)
    table = {"column_attenuation": decay, "column_attenuation_stderr": decay_error, **vars(found)}
    level_error = (column["amplitude_stderr"] / column["amplitude"]).values
    table |= {f"{name}_stderr": error for name, error in found.errors(decay_error, level_error).items()}
    return _labelled(dataset, table, np.shape(decay), "water")


@checked
def retrieve(
    dataset: Given,
    *,
    slope_deviation: Annotated[
        tuple[float, float] | None,
        Option(
            "Standard deviations of an unknown sea's slopes, by default from a series",
            0,
            above=True,
            form="ALONG,ACROSS",
        ),
    ] = None,
    wind_speed: Annotated[float | None, Option("Wind speed over the sea, by default the scene's", 1, 30, "m/s")] = None,
    wind_direction_deg: Annotated[
        float | None, Option("Direction that the wind blows towards, from +x [degrees], any angle")
    ] = None,
    efficiency: Annotated[
        float | None, Option("Two-way efficiency of optics and air, by default the scene's", 0, 1)
    ] = None,
) -> xr.Dataset:
    """Estimate surface, bottom and, if the view is wide enough, water from the pixels' waveforms.

    Parameters
    ----------
    dataset : xarray.Dataset or path
        Waveforms of one shot or of a series.
    wind_speed, wind_direction_deg, slope_deviation
        Wind [m/s], its direction [degree], or standard deviations of the sea slopes [1], as for `surface_slopes`.
    efficiency : float, optional
        Efficiency of optics and atmosphere, 0 to 1, as for `bottom`.

    Returns
    -------
    xarray.Dataset
        The variables from `surface_slopes`, `bottom` and `water`; NaN where unknown.

    Raises
    ------
    UserError
        If a number is out of range, the dataset lacks what these functions need, or no quantity can be estimated.
    """
    dataset = dataset_of("dataset", dataset, "waveforms")
    if "pixel" in dataset.dims and dataset.sizes["pixel"] == 1:
        slopes = _unknown_slopes(dataset)
    else:
        slopes = surface_slopes(
            dataset,
            wind_speed=wind_speed,
            wind_direction_deg=wind_direction_deg,
            slope_deviation=slope_deviation,
            efficiency=efficiency,
        )
    parts = [slopes, bottom(dataset, slopes, efficiency=efficiency)]
    spot = geometry.spot_diameter(dataset.attrs)
    if spot >= column_retrieval.SMALLEST_SPOT:
        parts.append(water(dataset, efficiency=efficiency))
    found = xr.merge(parts, combine_attrs="override", join="exact", compat="override")
    measured = ("surface_range", "depth_m", "column_attenuation")
    if not any(np.isfinite(found[name]).any() for name in measured if name in found):
        raise UserError("nothing can be estimated: no waveform has a surface echo, a column or a bottom echo")
    return found.assign_attrs(made_from(dataset.attrs, "Surface, bottom and water", "estimated"))


def _unknown_slopes(dataset: xr.Dataset) -> xr.Dataset:
    """Return the table of `surface_slopes` for a single pixel, which shows the surface height alone."""
    lidar = geometry.lidar_geometry(dataset.attrs)
    echoes = echo_table.extract(dataset, targets=1).isel(pixel=0)
    time, by_noise, by_method = (echoes[f"surface_time_ns{end}"].values for end in ("", "_stderr", "_method_error"))
    distance, error = (0.5e-9 * C0 * one for one in (time, np.hypot(by_noise, by_method)))
    unknown, cosine = np.full(np.shape(time), np.nan), math.cos(lidar.off_nadir)
    names = ("slope_along", "slope_across", "slope_deg", "slope_direction_deg", "plane_misfit")
    table = dict.fromkeys((*names, *(f"{name}_stderr" for name in names[:2])), unknown)
    table |= {
        "surface_range": distance,
        "surface_range_stderr": error,
        "surface_height": lidar.height - distance * cosine,
        "surface_height_stderr": error * cosine,
        "slope_refused": np.zeros(np.shape(time)),
    }
    prior = [float(one) for one in surface_inputs.largest_deviations(dataset)]
    found = _labelled(dataset, table, np.shape(time))
    return found.assign_attrs(slope_method="no times of other pixels", slope_prior_deviation=prior)


def _labelled(
    dataset: xr.Dataset, table: Mapping[str, FloatArray], shape: tuple[int, ...], kind: str = ""
) -> xr.Dataset:
    """Return arrays with one value per waveform over the dataset's shots."""
    dims = ("shot",) if shape else ()
    data = {name: (dims, np.reshape(values, shape)) for name, values in table.items()}
    coords: dict[Any, Any] = {name: one for name, one in dataset.coords.items() if shape and one.dims == ("shot",)}
    return label(xr.Dataset(data, coords, dataset.attrs), kind)


def _count(values: FloatArray) -> int:
    """Return the number of known values, at least 1."""
    return max(int(np.isfinite(values).sum()), 1)
