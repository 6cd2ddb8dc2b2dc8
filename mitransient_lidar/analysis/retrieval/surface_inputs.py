"""Result quantities that give the sea surface slope: wind, energies, pixels and echoes."""

from __future__ import annotations

import json
import math

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.retrieval.surface_echoes import LEAST_WIND_SPEED
from mitransient_lidar.analysis.retrieval.surface_slope import PixelEchoes, PixelLight
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.physics.sea.cox_munk import MAX_WIND_SPEED
from mitransient_lidar.physics.sea.wave_spectrum import GRAVITY
from mitransient_lidar.results import sum_errors
from mitransient_lidar.results.geometry import LinesOfSight, lidar_system, optional_number, pose_of, required_number

_MOST_PIXELS = 64  # whose echoes are modelled on a sea
_STEEPEST = 5.0  # standard deviations of the sea's slopes beyond which an estimate is refused


def pixel_light(dataset: xr.Dataset) -> PixelLight:
    """Return the light distribution in a result's pixels."""
    lines = outlines(dataset)
    angle_x, angle_y = (1e-3 * dataset[name].values.astype(np.float64) for name in ("angle_x", "angle_y"))
    if len(lines) != angle_x.size or "divergence_mrad" not in dataset.attrs:
        return PixelLight(angle_x, angle_y, np.zeros_like(angle_x))
    return PixelLight.of_outlines(lines, 0.5e-3 * required_number(dataset.attrs, "divergence_mrad"))


def largest_deviations(dataset: xr.Dataset) -> tuple[float, float, float]:
    """Return upper limits of the standard deviations of slopes along and across [1] and range [m].

    With no knowledge of the sea but its total slope variance, the slopes over a footprint vary at most as all its
    slopes do. Its height varies at most like the fully developed sea with this slope variance. Its deviation is sigma =
    0.21 U^2/(4 g) (Pierson and Moskowitz 1964, doi:10.1029/JZ069i024p05181), with the total 0.003 + 5.08e-3 U (Cox and
    Munk 1954, doi:10.1364/JOSA.44.000838). They are infinite where it is unknown.
    """
    return deviations_of_sea(float(dataset.attrs.get("surface_slope_variance", math.inf)))


def deviations_of_sea(total: float) -> tuple[float, float, float]:
    """Return the deviations of `largest_deviations` for a total slope variance [1], at least 0."""
    wind = max(total - 0.003, 0.0) / 5.08e-3
    return math.sqrt(0.5 * total), math.sqrt(0.5 * total), 0.21 * wind**2 / (4 * GRAVITY)


def wind(dataset: xr.Dataset, speed: float | None, direction_deg: float | None) -> tuple[float, float] | None:
    """Return wind speed [m/s] and direction from the lidar's azimuth [rad], None if a sea cannot be modelled."""
    attributes = dataset.attrs
    sea = attributes.get("scene.spectrum"), attributes.get("scene.slope_variance")
    is_gaussian = attributes.get("scene.slope_distribution", "gaussian") == "gaussian"
    pixels = len(outlines(dataset))
    beam = attributes.get("beam_profile", "gaussian"), attributes.get("divergence_across_mrad")
    usable = (
        "divergence_mrad" in attributes
        and beam[0] == "gaussian"
        and beam[1] in (None, attributes["divergence_mrad"])
        and 2 <= pixels <= _MOST_PIXELS
        and pixels == dataset.sizes["pixel"]
    )
    if speed is not None and not usable:
        raise UserError(
            f"wind_speed = {speed:g} needs a result of a round Gaussian beam and 2 to {_MOST_PIXELS} pixels with "
            "outlines; slope_deviation does not"
        )
    if speed is None:
        is_modelled = is_gaussian and sea == ("elfouhaily", "cox_munk")
        known = finite("scene.wind_speed", attributes.get("scene.wind_speed", 0)) if is_modelled else 0.0
        if not usable or not LEAST_WIND_SPEED <= known <= MAX_WIND_SPEED:
            return None
        speed = known
    direction = attributes.get("scene.wind_direction_deg", 0) if direction_deg is None else direction_deg
    pose = pose_of(attributes)
    azimuth = 0.0 if pose is None else float(pose.azimuth)
    return speed, math.radians(finite("wind_direction_deg", direction)) - azimuth


def energy_scale(dataset: xr.Dataset, efficiency: float | None) -> float | None:
    """Return energy times efficiencies and open aperture [J m^2], None if echoes are not in J or it is unknown."""
    names = ("scene.optical_efficiency", "scene.two_way_atmospheric_transmittance")
    of_scene = all(name in dataset.attrs for name in names)
    known = efficiency is not None or "two_way_efficiency" in dataset.attrs or of_scene
    if "signal" in dataset or not known:
        return None
    system = lidar_system(dataset.attrs, efficiency)
    return system.energy * system.aperture_area


def pixel_echoes(echoes: xr.Dataset, lidar: LidarGeometry, light: PixelLight) -> PixelEchoes:
    """Return the surface echoes in a table from `echo_table.extract` whose last dimension is pixel."""
    pixels, width = echoes.sizes["pixel"], float(echoes.attrs["echo_fwhm_ns"])
    surface = echoes.sel(echo="surface")
    time, error, energy, energy_error = (
        surface[name].values.reshape(-1, pixels) for name in ("time_ns", "time_ns_stderr", "energy", "energy_stderr")
    )
    level = echoes["amplitude"].sel(echo="column").values.reshape(-1, pixels)
    known = np.isfinite(level)
    # Pixels without a column hide as little as possible.
    column = np.array([np.median(one[some]) if some.any() else 0.0 for one, some in zip(level.T, known.T, strict=True)])
    column = np.maximum(1e-9 * width * column, 1e-6 * np.nanmax(energy, initial=1e-30))
    return PixelEchoes(time, error, energy, energy_error, column, lidar.surface_ns_per_rad * light.spread, width)


def outlines(dataset: xr.Dataset) -> list[list[FloatArray]]:
    """Return a result's pixel outlines [rad]; an empty list without them."""
    lines = json.loads(dataset.attrs.get("pixel_outlines", "[]"))
    return [[1e-3 * np.reshape(line, (-1, 2)) for line in one] for one in lines]


def steepest_sea(dataset: xr.Dataset) -> float:
    """Return the largest slope [1] that the sea can have in one direction, infinite if its slopes are unknown."""
    variance = optional_number(dataset.attrs, "surface_slope_variance")
    return math.inf if variance is None else _STEEPEST * math.sqrt(0.5 * variance)


def summed_pixels(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the sum of its pixels as the only pixel."""
    if "waveform" not in dataset:
        raise UserError("the dataset has no waveform: the energy of echoes needs a result in W")
    if "pixel" not in dataset["waveform"].dims:
        raise UserError(f"waveform has the dimensions {dataset['waveform'].dims}; they must be pixel and time, or shot")
    summed = dataset[["waveform"]].sum("pixel")
    if sum_errors.VARIABLE in dataset:
        summed[sum_errors.VARIABLE] = dataset[sum_errors.VARIABLE]
    if "waveform_stderr" in dataset:
        summed["waveform_stderr"] = (dataset["waveform_stderr"] ** 2).sum("pixel") ** 0.5
    summed = summed.expand_dims(pixel=["all"]).transpose(..., "pixel", "time")
    summed["waveform"].attrs.update(dataset["waveform"].attrs)
    if "surface_time" in dataset.coords and "shot" not in dataset["surface_time"].dims:
        summed = summed.assign_coords(LinesOfSight.from_dataset(dataset).combined().coordinates(("pixel",), (1,)))
    if "shot" in summed.dims and "shot" not in summed.coords:
        summed = summed.assign_coords(shot=np.arange(summed.sizes["shot"]))
    return summed.assign_attrs(dataset.attrs)
