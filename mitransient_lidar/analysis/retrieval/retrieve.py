"""Slope of the sea, bottom and water, estimated from the echoes of results.

The functions take a dataset with ``waveform`` [W] over (pixel, time) or (shot, pixel, time), and keep the dimension
``shot``. Receiver and transmitter must be coaxial.
"""

from __future__ import annotations

import json
import logging
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.retrieval import column_retrieval, surface_slope
from mitransient_lidar.analysis.retrieval.slope_corrections import SlopeRefraction, bottom_depth, bottom_gain
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range, positive
from mitransient_lidar.results.geometry import LidarGeometry, required_number

_LOG = logging.getLogger(__name__)
_COLUMN_START = 1.75  # echo widths after the surface at which `echo_table` begins to fit the column


def surface_slopes(
    dataset: xr.Dataset, *, slope_deviation: tuple[float, float] | None = None, facets: float = 1.0
) -> xr.Dataset:
    """Estimate the slope of the surface, and its direction, from the times of the pixels' surface echoes.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms of at least two pixels.
    slope_deviation : (float, float), optional
        Prior: standard deviations of the slopes along the lidar's azimuth and across, averaged over a footprint [1],
        above 0. Without it, the estimates are much steeper than the sea.
    facets : float
        As for `surface_slope.fit_plane`.

    Returns
    -------
    xarray.Dataset
        Over ``shot`` if present: ``slope_along``, positive for a face towards the lidar, ``slope_across``, positive for
        a rise to the left [1], with ``_stderr``; ``slope_deg`` and ``slope_direction_deg`` of the steepest rise from
        the lidar's azimuth to the left [degree]; ``surface_range`` along the axis and ``surface_height`` above the mean
        level [m]; ``plane_misfit`` [ns]. NaN where the pixels do not determine it.

    Raises
    ------
    UserError
        If the dataset lacks pixels, a coordinate or an attribute, or a number is out of range.

    Notes
    -----
    Times are those of the ``gaussian`` estimator. The light of a pixel is that of a Gaussian beam inside its outline,
    or without outlines a point at its centre.
    """
    lidar = LidarGeometry.from_attributes(dataset.attrs)
    if "pixel" not in dataset.dims or dataset.sizes["pixel"] < 2:
        raise UserError("surface slopes need waveforms of at least 2 pixels over the dimension pixel")
    echoes = echo_table.extract(dataset).sel(echo="surface").transpose(..., "pixel")
    shape = echoes["time_ns"].shape[:-1]
    time, error = (echoes[name].values.reshape(-1, dataset.sizes["pixel"]) for name in ("time_ns", "time_ns_stderr"))
    plane = surface_slope.fit_plane(time, pixel_light(dataset), lidar.off_nadir, stderr_ns=error, facets=facets)
    slopes = [(plane.along, plane.along_stderr), (plane.across, plane.across_stderr)]
    if slope_deviation is not None:
        slopes = [
            surface_slope.with_prior(*pair, positive("slope_deviation", one))
            for pair, one in zip(slopes, slope_deviation, strict=True)
        ]
    (along, along_error), (across, across_error) = slopes
    steepness, direction = surface_slope.steepest(along, across)
    height = lidar.height - plane.range_m * math.cos(lidar.off_nadir)
    table = {
        "slope_along": (along, "1", "slope of the surface along the lidar's azimuth"),
        "slope_along_stderr": (along_error, "1", "standard error of the slope along"),
        "slope_across": (across, "1", "slope of the surface across the lidar's azimuth"),
        "slope_across_stderr": (across_error, "1", "standard error of the slope across"),
        "slope_deg": (np.degrees(steepness), "degree", "angle of the surface from the horizontal"),
        "slope_direction_deg": (np.degrees(direction), "degree", "direction of the rise from the lidar's azimuth"),
        "surface_range": (plane.range_m, "m", "distance to the surface along the axis"),
        "surface_height": (height, "m", "height of the surface above the mean sea level"),
        "plane_misfit": (plane.misfit_ns, "ns", "deviation of the echoes from a plane"),
    }
    return _labelled(dataset, table, shape)


def pixel_light(dataset: xr.Dataset) -> surface_slope.PixelLight:
    """Return the distribution of the light in the pixels of a result."""
    outlines = json.loads(dataset.attrs.get("pixel_outlines", "[]"))
    angle_x, angle_y = (1e-3 * dataset[name].values.astype(np.float64) for name in ("angle_x", "angle_y"))
    if len(outlines) != angle_x.size or "divergence_mrad" not in dataset.attrs:
        return surface_slope.PixelLight(angle_x, angle_y, np.zeros_like(angle_x))
    lines: list[list[npt.ArrayLike]] = [[1e-3 * np.reshape(line, (-1, 2)) for line in one] for one in outlines]
    return surface_slope.PixelLight.of_outlines(lines, 0.5e-3 * required_number(dataset.attrs, "divergence_mrad"))


def bottom(
    dataset: xr.Dataset,
    slopes: xr.Dataset,
    *,
    efficiency: float | None = None,
    relative_error: float = 0.15,
    classes: dict[str, float] | None = None,
) -> xr.Dataset:
    """Estimate depth and reflectance of the bottom, without and with the surface's slope and height.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms; their pixels are summed. All shots must be of the same water.
    slopes : xarray.Dataset
        Output of `surface_slopes`. An unknown slope is replaced by 0, an unknown range by that of the mean sea.
    efficiency : float, optional
        Efficiencies of transmitter and receiver times the two-way transmittance of the atmosphere, 0 to 1. By default,
        from the scene's parameters ``optical_efficiency`` and ``two_way_atmospheric_transmittance``.
    relative_error : float
        Relative error of the scale of the reflectance, for the classes [1], 0 to 1.
    classes : dict of str to float, optional
        As for `column_retrieval.bottom_class`.

    Returns
    -------
    xarray.Dataset
        Over ``shot`` if present and ``correction``: ``reflectance`` [1] through a level sea at its mean height
        (``level``), through the plane of the shot (``slope``), and from the ratio of the echo to the column
        (``column``), and ``depth_m`` below the mean sea level [m], NaN for the last. Also ``bottom_energy`` [J], and
        for the last reflectance ``reflectance_stderr`` from noise, an upper bound, and ``class_probability`` over
        ``bottom_class``. NaN without a bottom echo; reflectances are NaN without a column, with a warning.

    Raises
    ------
    UserError
        If the dataset lacks an attribute or a number is out of range.

    Notes
    -----
    Reflectances ``level`` and ``slope`` use the mean attenuation of all shots. The ratio needs a column of at least 8
    bins in each shot, but hardly depends on the slope, and corrects for focusing by waves.
    """
    lidar = LidarGeometry.from_attributes(dataset.attrs)
    share = in_range("relative_error", relative_error, 0, 1)
    echoes = echo_table.extract(_summed(dataset), depth_from="mean").isel(pixel=0)
    seabed, column = (echoes.sel(echo=name) for name in ("bottom", "column"))
    time, energy = seabed["time_ns"].values, seabed["energy"].values
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

    system = lidar.lidar_system(dataset.attrs, efficiency)
    power, attenuation = column["amplitude"].values, echoes["attenuation"].values
    mean_level, mean_attenuation = (_mean(values) for values in (power, attenuation))
    if math.isnan(mean_attenuation):
        _LOG.warning("no waveform has a column long enough for a fit: the reflectance of the bottom is unknown")
    received = system.energy * system.aperture_area
    reflectance = []
    for distance, path, one in surfaces:
        gain = bottom_gain(distance, np.nan_to_num(path), lidar.refractive_index, one)
        reflectance.append(np.pi * energy * np.exp(2 * mean_attenuation * path) / (received * gain))
    water_gain = system.water_gain(0.0, lidar.off_nadir)
    backscatter = column_retrieval.backscatter_of_level(mean_level, water_gain, lidar.group_index)
    delay = time - echoes["time_ns"].sel(echo="surface").values
    spreading = lidar.spreading(np.nan_to_num(delay) * lidar.metres_per_ns)
    at_bottom = power * spreading * np.exp(-2 * attenuation * delay * lidar.metres_per_ns)
    reflectance.append(
        column_retrieval.bottom_reflectance(energy, at_bottom, backscatter, ray.cos_vertical, lidar.group_index)
    )
    parts = (
        seabed["energy_stderr"].values / energy,
        column["amplitude_stderr"].values / power,
        2 * delay * lidar.metres_per_ns * echoes["attenuation_stderr"].values,
    )
    relative = np.sqrt(sum(np.nan_to_num(part) ** 2 for part in parts))
    names, probability = column_retrieval.bottom_class(
        reflectance[2], np.abs(np.nan_to_num(reflectance[2])) * np.hypot(relative, share), classes
    )
    found = _labelled(
        dataset,
        {
            "bottom_energy": (energy, "J", "energy of the bottom echo"),
            "reflectance_stderr": (reflectance[2] * relative, "1", "standard error of the reflectance from noise"),
        },
        echoes["attenuation"].shape,
    )
    dims = tuple(found["bottom_energy"].dims)
    depths = np.stack([*np.broadcast_arrays(*depth), np.full(np.shape(depth[1]), np.nan)], axis=-1)
    for name, values, dim, unit, text in (
        ("reflectance", np.stack(reflectance, axis=-1), "correction", "1", "reflectance of the bottom"),
        ("depth_m", depths, "correction", "m", "depth of the bottom below the mean sea level"),
        ("class_probability", probability, "bottom_class", "1", "probability of the bottom's class"),
    ):
        found[name] = ((*dims, dim), values, {"units": unit, "long_name": text})
    return found.assign_coords(correction=["level", "slope", "column"], bottom_class=names)


def water(
    dataset: xr.Dataset, *, efficiency: float | None = None, phase_factor: float = 1.0, deepest_path: float = 8.0
) -> xr.Dataset:
    """Estimate absorption, backscattering, Kd and bounds of c from the column.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms; their pixels are summed. The field of view on the sea must be at least 6 m, far wider than the beam.
    efficiency : float, optional
        As for `bottom`.
    phase_factor : float
        As for `column_retrieval.water_of_column`.
    deepest_path : float
        Largest path in the water at which the column is used [m], above 0. The attenuation of a column depends on the
        path; the constants of the retrieval are for 8 m.

    Returns
    -------
    xarray.Dataset
        Over ``shot`` if present: ``column_attenuation``, ``absorption``, ``backscattering``, ``kd``, ``attenuation``,
        ``attenuation_low`` and ``attenuation_high`` [1/m]; see `column_retrieval.WaterEstimate`.

    Raises
    ------
    UserError
        If the view is too narrow, the dataset lacks an attribute or a number is out of range.
    """
    lidar = LidarGeometry.from_attributes(dataset.attrs)
    summed = _summed(dataset)
    end = lidar.surface_time_ns + positive("deepest_path", deepest_path) / lidar.metres_per_ns
    echoes = echo_table.extract(summed.isel(time=summed["time"].values < end)).isel(pixel=0)
    level = echoes["amplitude"].sel(echo="column").values
    start = _COLUMN_START * float(echoes.attrs["echo_fwhm_ns"]) * lidar.metres_per_ns
    gain = lidar.lidar_system(dataset.attrs, efficiency).water_gain(0.0, lidar.off_nadir)
    backscatter = column_retrieval.backscatter_of_level(level, gain, lidar.group_index)
    decay = echoes["attenuation"].values
    found = column_retrieval.water_of_column(
        decay, backscatter, lidar.spot_diameter(dataset.attrs), first_path=start, phase_factor=phase_factor
    )
    table = {
        "column_attenuation": (decay, "1/m", "attenuation of the column's signal along the path"),
        "absorption": (found.absorption, "1/m", "absorption coefficient"),
        "backscattering": (found.backscattering, "1/m", "backscattering coefficient"),
        "kd": (found.kd, "1/m", "diffuse attenuation coefficient"),
        "attenuation": (found.attenuation, "1/m", "beam attenuation coefficient for the typical bb/b"),
        "attenuation_low": (found.attenuation_low, "1/m", "smallest beam attenuation coefficient"),
        "attenuation_high": (found.attenuation_high, "1/m", "largest beam attenuation coefficient"),
    }
    return _labelled(dataset, table, np.shape(decay))


def retrieve(
    dataset: xr.Dataset, *, slope_deviation: tuple[float, float] | None = None, efficiency: float | None = None
) -> xr.Dataset:
    """Return the estimates of `surface_slopes`, `bottom` and, if the view is wide enough, `water`; NaN where unknown.

    The arguments and errors are those of these functions. If no quantity can be estimated, `UserError` is raised.
    """
    slopes = surface_slopes(dataset, slope_deviation=slope_deviation)
    parts = [slopes, bottom(dataset, slopes, efficiency=efficiency)]
    spot = LidarGeometry.from_attributes(dataset.attrs).spot_diameter(dataset.attrs)
    if spot >= column_retrieval.SMALLEST_SPOT:
        parts.append(water(dataset, efficiency=efficiency))
    found = xr.merge(parts, combine_attrs="override", join="exact", compat="override")
    measured = ("surface_range", "depth_m", "column_attenuation")
    if not any(np.isfinite(found[name]).any() for name in measured if name in found):
        raise UserError("nothing can be estimated: no waveform has a surface echo, a column or a bottom echo")
    return found


def _summed(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the sum of its pixels as the only pixel."""
    if "waveform" not in dataset:
        raise UserError("the dataset has no waveform: the energy of echoes needs a result in W")
    if "pixel" not in dataset["waveform"].dims:
        raise UserError(f"waveform has the dimensions {dataset['waveform'].dims}; they must be pixel and time, or shot")
    summed = dataset[["waveform"]].sum("pixel")
    if "waveform_stderr" in dataset:
        summed["waveform_stderr"] = (dataset["waveform_stderr"] ** 2).sum("pixel") ** 0.5
    summed = summed.expand_dims(pixel=["all"]).transpose(..., "pixel", "time")
    summed["waveform"].attrs.update(dataset["waveform"].attrs)
    if "shot" in summed.dims and "shot" not in summed.coords:
        summed = summed.assign_coords(shot=np.arange(summed.sizes["shot"]))
    return summed.assign_attrs(dataset.attrs)


def _labelled(dataset: xr.Dataset, table: dict[str, tuple[FloatArray, str, str]], shape: tuple[int, ...]) -> xr.Dataset:
    """Return arrays with one value per waveform over the dataset's shots."""
    dims = ("shot",) if shape else ()
    data = {
        name: (dims, np.reshape(values, shape), {"units": unit, "long_name": text})
        for name, (values, unit, text) in table.items()
    }
    coords: dict[Any, Any] = {name: one for name, one in dataset.coords.items() if shape and one.dims == ("shot",)}
    return xr.Dataset(data, coords, dataset.attrs)


def _mean(values: FloatArray) -> float:
    return float(values[known].mean()) if (known := np.isfinite(values)).any() else math.nan
