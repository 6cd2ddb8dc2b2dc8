"""What echoes tell of the sea's slope, the bottom and the water: the estimators of `optics` applied to results.

Every function takes a result, or recorded shots, with ``waveform`` [W] over (pixel, time) or (shot, pixel, time); what
it returns keeps the dimension ``shot``. Receiver and transmitter must share their place and axis.
"""

from __future__ import annotations

import json
import logging
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar import waveforms
from mitransient_lidar.errors import UserError
from mitransient_lidar.estimates_lidar import Lidar, number
from mitransient_lidar.loading import readable_errors
from mitransient_lidar.optics import slope_corrections, surface_slope, turbidity
from mitransient_lidar.optics.checks import FloatArray, in_range, positive
from mitransient_lidar.optics.refraction import snell, solid_angle_per_area
from mitransient_lidar.optics.water import C0

_LOG = logging.getLogger(__name__)
_SPOT_MARGIN = 1.75  # echo widths after the surface at which `waveforms` begins to fit the column


def surface_slopes(
    dataset: xr.Dataset, *, slope_deviation: tuple[float, float] | None = None, facets: float = 1.0
) -> xr.Dataset:
    """Estimate the slope of the surface, and its direction, from the times of the pixels' surface echoes.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms of at least two pixels.
    slope_deviation : (float, float), optional
        Standard deviations of the sea's slopes along the lidar's azimuth and across, averaged over a footprint [1],
        above 0: estimates are then the most likely slopes, those of times alone being far steeper than the sea.
    facets : float
        As for `optics.surface_slope.fit_plane`.

    Returns
    -------
    xarray.Dataset
        Over ``shot`` where there is one: ``slope_along``, positive for a face towards the lidar, ``slope_across``,
        positive for a rise to the left [1], with ``_stderr``; ``slope_deg`` and ``slope_direction_deg`` of the steepest
        rise from the lidar's azimuth to the left [degree]; ``surface_range`` along the axis and ``surface_height``
        above the mean level [m]; ``plane_misfit`` [ns]. NaN where pixels do not tell: strips across the azimuth tell
        nothing of the slope across.

    Raises
    ------
    UserError
        If the dataset lacks pixels, a coordinate or an attribute, or a number is out of range.

    Notes
    -----
    Times are those of `waveforms.extract` with its Gaussians. Positions of the light in pixels are those of a Gaussian
    beam inside the outlines that a result keeps; without outlines, the pixels' centres, as if each were a point.
    """
    lidar = Lidar.of(dataset)
    if "pixel" not in dataset.dims or dataset.sizes["pixel"] < 2:
        raise UserError("surface slopes need waveforms of at least 2 pixels over the dimension pixel")
    echoes = waveforms.extract(dataset).sel(echo="surface").transpose(..., "pixel")
    shape = echoes["time_ns"].shape[:-1]
    time, error = (echoes[name].values.reshape(-1, dataset.sizes["pixel"]) for name in ("time_ns", "time_ns_stderr"))
    with readable_errors():
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
    """Return where the light of a result's pixels comes from: see `optics.surface_slope.PixelLight`."""
    attributes = dataset.attrs
    outlines = json.loads(attributes.get("pixel_outlines", "[]"))
    gx, gy = (1e-3 * dataset[name].values.astype(np.float64) for name in ("gx", "gy"))
    if len(outlines) != gx.size or "divergence_mrad" not in attributes:
        return surface_slope.PixelLight(gx, gy, np.zeros_like(gx))
    lines: list[list[npt.ArrayLike]] = [[1e-3 * np.reshape(line, (-1, 2)) for line in one] for one in outlines]
    with readable_errors():
        return surface_slope.PixelLight.of_outlines(lines, 0.5e-3 * number(dataset, "divergence_mrad"))


def bottom(
    dataset: xr.Dataset,
    slopes: xr.Dataset,
    *,
    efficiency: float | None = None,
    relative_error: float = 0.15,
    classes: dict[str, float] | None = None,
) -> xr.Dataset:
    """Estimate depth and reflectivity of the bottom, without and with the surface's slope and height.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms; their pixels are added up. All shots must be of the same water.
    slopes : xarray.Dataset
        What `surface_slopes` returned. An unknown slope counts as 0, an unknown range as that of the mean sea.
    efficiency : float, optional
        Efficiencies of transmitter and receiver times the two-way transmittance of the atmosphere, 0 to 1. Without it,
        from the scene's parameters ``optical_efficiency`` and ``two_way_atmospheric_transmittance``.
    relative_error : float
        How well the reflectivity's scale is known, for the classes [1], 0 to 1.
    classes : dict of str to float, optional
        As for `optics.turbidity.bottom_class`.

    Returns
    -------
    xarray.Dataset
        Over ``shot`` where there is one, over ``correction`` (level, slope, column): ``reflectivity`` [1], as through a
        level sea at its mean height, through the shot's own plane, and by the ratio of the echo to the column. Over
        ``correction`` (level, slope) alone, under ``depth_m``: depth below the mean sea level [m]. Also
        ``bottom_energy`` [J], ``reflectivity_stderr`` from noise, an upper bound, and over ``bottom_class``:
        ``class_probability`` of the last reflectivity. NaN without a bottom echo; without any
        column that can be fitted, reflectivities are NaN, too, and a sentence says so in the log.

    Raises
    ------
    UserError
        If the dataset lacks an attribute or a number is out of range.

    Notes
    -----
    Reflectivities ``level`` and ``slope`` take one attenuation for all shots, the mean column's. The ratio needs the
    column of each shot, at least 8 bins long, but no slope to speak of, and takes the waves' focusing out as well.
    """
    lidar = Lidar.of(dataset)
    with readable_errors():
        share = in_range("relative_error", relative_error, 0, 1)
    echoes = waveforms.extract(_summed(dataset), depth_from="mean").isel(pixel=0)
    shape = echoes["attenuation"].shape
    seabed, column = (echoes.sel(echo=name) for name in ("bottom", "column"))
    time, energy = seabed["time_ns"].values, seabed["energy"].values
    known = {name: slopes[name].values for name in ("slope_along", "slope_across", "surface_range")}
    level_range = lidar.height / math.cos(lidar.off_nadir)
    ranges = np.where(np.isfinite(known["surface_range"]), known["surface_range"], level_range)
    along, across = (np.nan_to_num(known[f"slope_{name}"]) for name in ("along", "across"))
    level_path = (time - lidar.surface_ns) * lidar.metres_per_ns
    path = (time - 2e9 * ranges / C0) * lidar.metres_per_ns
    ray = slope_corrections.SlopeRefraction.of(along, across, lidar.off_nadir, lidar.index)
    level = slope_corrections.SlopeRefraction.of(0.0, 0.0, lidar.off_nadir, lidar.index)

    depth = [
        slope_corrections.bottom_depth(distance, way, lidar.height, lidar.off_nadir, one)
        for distance, way, one in ((level_range, level_path, level), (ranges, path, ray))
    ]
    with readable_errors():
        system = lidar.system(dataset, efficiency)
        power, attenuation = column["amplitude"].values, echoes["attenuation"].values
        mean_level, mean_attenuation = (_mean(values) for values in (power, attenuation))
        if math.isnan(mean_attenuation):
            _LOG.warning("no waveform has a column long enough to be fitted: the bottom's reflectivity is unknown")
        received = system.energy * system.aperture_area
        reflectivity = [
            np.pi
            * energy
            * np.exp(2 * mean_attenuation * way)
            / (received * slope_corrections.bottom_gain(distance, np.nan_to_num(way), lidar.index, one))
            for distance, way, one in ((level_range, level_path, level), (ranges, path, ray))
        ]
        backscatter = turbidity.backscatter_of_level(mean_level, system.water_gain(0.0, lidar.off_nadir), lidar.group)
        delay = time - echoes["time_ns"].sel(echo="surface").values
        spreading = _spreading(lidar, np.nan_to_num(delay) * lidar.metres_per_ns)
        fallen = power * spreading * np.exp(-2 * attenuation * delay * lidar.metres_per_ns)
        reflectivity.append(turbidity.bottom_reflectivity(energy, fallen, backscatter, ray.cos_vertical, lidar.group))
        parts = (
            seabed["energy_stderr"].values / energy,
            column["amplitude_stderr"].values / power,
            2 * delay * lidar.metres_per_ns * echoes["attenuation_stderr"].values,
        )
        relative = np.sqrt(sum(np.nan_to_num(part) ** 2 for part in parts))
        names, probability = turbidity.bottom_class(
            reflectivity[2], np.abs(np.nan_to_num(reflectivity[2])) * np.hypot(relative, share), classes
        )
    found = _labelled(
        dataset,
        {
            "bottom_energy": (energy, "J", "energy of the bottom echo"),
            "reflectivity_stderr": (reflectivity[2] * relative, "1", "standard error of the reflectivity from noise"),
        },
        shape,
    )
    dims = tuple(found["bottom_energy"].dims)
    corrections = ["level", "slope", "column"]
    described = {"units": "1", "long_name": "reflectivity of the bottom"}
    found["reflectivity"] = ((*dims, "correction"), np.stack(reflectivity, axis=-1), described)
    unknown = np.full(np.shape(depth[1]), np.nan)
    described = {"units": "m", "long_name": "depth of the bottom below the mean sea level"}
    found["depth_m"] = ((*dims, "correction"), np.stack([*np.broadcast_arrays(*depth), unknown], axis=-1), described)
    described = {"units": "1", "long_name": "probability of the bottom's class"}
    found["class_probability"] = ((*dims, "bottom_class"), probability, described)
    return found.assign_coords(correction=corrections, bottom_class=names)


def water(
    dataset: xr.Dataset, *, efficiency: float | None = None, phase_factor: float = 1.0, deepest_path: float = 8.0
) -> xr.Dataset:
    """Estimate absorption, backscattering, Kd and bounds of c from the column.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms; their pixels are added up. The receiver must see a spot of at least 6 m, far wider than the beam.
    efficiency : float, optional
        As for `bottom`.
    phase_factor : float
        As for `optics.turbidity.water_of_column`.
    deepest_path : float
        Path in the water down to which the column is used [m], above 0. In a view of 30 mrad a column falls the faster
        the deeper it is; the retrieval's constants belong to 8 m.

    Returns
    -------
    xarray.Dataset
        Over ``shot`` where there is one: ``column_attenuation``, ``absorption``, ``backscattering``, ``kd``,
        ``attenuation``, ``attenuation_low`` and ``attenuation_high`` [1/m]; see `optics.turbidity.WaterEstimate`.

    Raises
    ------
    UserError
        If the view is too narrow, the dataset lacks an attribute or a number is out of range.
    """
    lidar = Lidar.of(dataset)
    whole = _summed(dataset)
    with readable_errors():
        end = lidar.surface_ns + positive("deepest_path", deepest_path) / lidar.metres_per_ns
    echoes = waveforms.extract(whole.isel(time=whole["time"].values < end)).isel(pixel=0)
    level = echoes["amplitude"].sel(echo="column").values
    start = _SPOT_MARGIN * float(echoes.attrs["echo_fwhm_ns"]) * lidar.metres_per_ns
    with readable_errors():
        gain = lidar.system(dataset, efficiency).water_gain(0.0, lidar.off_nadir)
        backscatter = turbidity.backscatter_of_level(level, gain, lidar.group)
        decay = echoes["attenuation"].values
        found = turbidity.water_of_column(
            decay, backscatter, lidar.spot(dataset), first_path=start, phase_factor=phase_factor
        )
    table = {
        "column_attenuation": (decay, "1/m", "attenuation of the column's signal along the path"),
        "absorption": (found.absorption, "1/m", "absorption coefficient"),
        "backscattering": (found.backscattering, "1/m", "backscattering coefficient"),
        "kd": (found.kd, "1/m", "diffuse attenuation coefficient"),
        "attenuation": (found.attenuation, "1/m", "beam attenuation coefficient for the usual bb/b"),
        "attenuation_low": (found.attenuation_low, "1/m", "least beam attenuation coefficient"),
        "attenuation_high": (found.attenuation_high, "1/m", "largest beam attenuation coefficient"),
    }
    return _labelled(dataset, table, np.shape(decay))


def estimate(
    dataset: xr.Dataset, *, slope_deviation: tuple[float, float] | None = None, efficiency: float | None = None
) -> xr.Dataset:
    """Return what `surface_slopes`, `bottom` and, where the view is wide enough, `water` tell; NaN for the rest.

    Parameters
    ----------
    dataset : xarray.Dataset
        Waveforms of at least two pixels.
    slope_deviation, efficiency
        As for those functions.

    Raises
    ------
    UserError
        As they do, or when nothing can be told.
    """
    slopes = surface_slopes(dataset, slope_deviation=slope_deviation)
    parts = [slopes, bottom(dataset, slopes, efficiency=efficiency)]
    if Lidar.of(dataset).spot(dataset) >= turbidity.SMALLEST_SPOT:
        parts.append(water(dataset, efficiency=efficiency))
    found = xr.merge(parts, combine_attrs="override", join="exact", compat="override")
    measured = ("surface_range", "depth_m", "column_attenuation")
    if not any(np.isfinite(found[name]).any() for name in measured if name in found):
        raise UserError("nothing can be told: no waveform has a surface echo, a column or a bottom echo")
    return found


def _summed(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose pixels are one."""
    if "waveform" not in dataset:
        raise UserError("the dataset has no waveform: the energy of echoes needs a result in W")
    if "pixel" not in dataset["waveform"].dims:
        raise UserError(f"waveform has the dimensions {dataset['waveform'].dims}; they must be pixel and time, or shot")
    summed = dataset[["waveform"]].sum("pixel")
    if "waveform_stderr" in dataset:
        summed["waveform_stderr"] = (dataset["waveform_stderr"] ** 2).sum("pixel") ** 0.5
    whole = summed.expand_dims(pixel=["all"]).transpose(..., "pixel", "time")
    whole["waveform"].attrs.update(dataset["waveform"].attrs)
    if "shot" in whole.dims and "shot" not in whole.coords:
        whole = whole.assign_coords(shot=np.arange(whole.sizes["shot"]))
    return whole.assign_attrs(dataset.attrs)


def _labelled(dataset: xr.Dataset, table: dict[str, tuple[FloatArray, str, str]], shape: tuple[int, ...]) -> xr.Dataset:
    """Return arrays, one value a waveform, over the dataset's shots."""
    dims = ("shot",) if shape else ()
    data = {
        name: (dims, np.reshape(values, shape), {"units": unit, "long_name": text})
        for name, (values, unit, text) in table.items()
    }
    coords: dict[Any, Any] = {"shot": dataset["shot"].values} if shape and "shot" in dataset.coords else {}
    return xr.Dataset(data, coords, dataset.attrs)


def _mean(values: FloatArray) -> float:
    return float(values[known].mean()) if (known := np.isfinite(values)).any() else math.nan


def _spreading(lidar: Lidar, path: FloatArray) -> FloatArray:
    """Return what distance and refraction leave of a signal from a path in the water over that at the surface."""
    depth = np.maximum(path, 0) * math.cos(float(snell(lidar.off_nadir, lidar.index)))
    below, surface = (solid_angle_per_area(lidar.height, d, lidar.off_nadir, lidar.index) for d in (depth, 0.0))
    return np.asarray(below / surface)
