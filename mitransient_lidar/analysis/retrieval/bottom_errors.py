"""Depth and reflectance errors of a bottom, and reasons for which the reflectance is unknown."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import IntFlag
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.retrieval import surface_inputs
from mitransient_lidar.analysis.retrieval.scattered_light import ScatteredLight
from mitransient_lidar.analysis.retrieval.surface_echoes import inside_outline
from mitransient_lidar.analysis.retrieval.surface_slope import SlopeRefraction, bottom_depth, bottom_gain, variances
from mitransient_lidar.analysis.waveforms.column_onset import Focusing
from mitransient_lidar.analysis.waveforms.depth_errors import TYPICAL_SLOPE_VARIANCE
from mitransient_lidar.analysis.waveforms.echo_detection import error_of_sums
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.results.geometry import optional_number, pose_of

LARGEST_ERROR = 0.5  #: Largest relative standard error with which a reflectance is given.
#: Smallest share of the beam's energy in the pixels at which scattered light does not dominate their echoes.
LEAST_SHARE = 0.05

_FEWEST_SHOTS = 8  # whose reflectance scatter is known
_OF_ECHO = 0.01  # relative energy error of the bottom echo with its tail
_AROUND = (2.0, 4.0)  # echo widths before and behind a bottom echo whose light counts
_APART = 4.0  # echo widths between a bottom echo and others that leave this light its own
_OF_GAIN = 0.07  # error of the column's gain on the bottom by scattering, relative to it: bb/b is not known
_OF_SHAPE = 0.01  # error of the optical depth for a bottom as far below the surface as the column's fit is long
_UNTESTED = 0.03  # relative error of the optical depth where a column is too short to be tested for layers
_DEEPEST_CHANGE = 0.65  # in the column, over the bottom depth
_CERTAIN = 0.1  # relative error of a sum by noise above which a fit counts
_WINDOW = (2.7, 1.8)  # before the bottom echo where the column is compared with its fit, in echo widths
# Relative deviation of the light at a bottom by waves that focus it, over the deviation of the sea's slopes, times the
# beam width [m]; and width that is added to it. At 5 m/s and 8 m eight seas each had 21 % with a beam of 0.2 m and 5 %
# with one of 0.6 m; three had 2 % with one of 2.1 m.
_FOCUSING, _NARROWEST = 0.24, 0.1
_GRID, _REACH = 128, 4.0  # points along each side of a beam, and half its side in standard deviations


class ReflectanceFlag(IntFlag):
    """Reasons for which the reflectance of a bottom is not given; 0 if it is."""

    NO_COLUMN = 1  # no column that can be fitted: the attenuation is unknown
    NO_DIRECT_LIGHT = 2  # the pixels see less than a twentieth of the beam
    TARGET = 4  # the echo comes from the depth of a target
    EARLIER_ECHO = 8  # a target or a layer returns or absorbs an unknown share of the light before the bottom
    UNCERTAIN = 16  # its standard error would exceed half the reflectance


#: Explanations of the flags.
REASONS = {
    ReflectanceFlag.NO_COLUMN: "no column that can be fitted",
    ReflectanceFlag.NO_DIRECT_LIGHT: "the pixels see too little of the beam",
    ReflectanceFlag.TARGET: "the echo comes from the depth of a target",
    ReflectanceFlag.EARLIER_ECHO: "a target or a layer of the water returns an echo before the bottom's",
    ReflectanceFlag.UNCERTAIN: "its error would exceed half of it",
}


def loss_error(
    waveforms: Waveforms,
    echoes: xr.Dataset,
    depth: FloatArray,
    path: FloatArray,
    attenuation: float,
    light: ScatteredLight | None,
) -> float:
    """Return the method's error in the optical depth of both ways to the bottom [1], infinite if unknown.

    The loss assumes homogeneous water. Two signs that the water differs below count in full. One is the loss by two
    exponentials (`column_fits.change_points`), the other the logarithm of the signal before the bottom echo over the
    column's. From each its value for homogeneous water is subtracted. Both are means over the shots, in the same water.

    Waveforms are of one pixel, as is their table from `echo_table.extract` with `layers`. Bottom depths and one-way
    paths to them in the water [m] are per shot. The column attenuation along the path [1/m] is a mean; the scattered
    light is for homogeneous water.
    """
    depths = 2 * attenuation * path
    if light is None or not np.isfinite(depths).any():
        return np.inf
    split = _loss_of_layers(echoes, depth, path, depths, light)
    ahead = _excess_before_bottom(waveforms, echoes, light)
    far = float(np.nanmean(path)) / (light.fitted[-1] - light.fitted[0])
    parts = [_OF_GAIN * float(np.nanmean(light.gain_of_column(path))), _OF_SHAPE * far]
    parts += [] if np.isfinite(split).any() else [_UNTESTED * float(np.nanmean(depths))]
    parts += [float(np.mean(part[np.isfinite(part)])) for part in (split, ahead) if np.isfinite(part).any()]
    return float(np.linalg.norm(parts))


def _loss_of_layers(
    echoes: xr.Dataset, depth: FloatArray, path: FloatArray, loss: FloatArray, light: ScatteredLight
) -> FloatArray:
    """Return the optical depth of both ways by two exponentials less that by one, NaN for too short a column."""
    names = ("layer_depth_m", "layer_attenuation_above", "layer_attenuation_below")
    at, above, below = (np.moveaxis(echoes[name].transpose(..., "layer").values, -1, 0) for name in names)
    share = at / np.where(depth > 0, depth, np.nan)
    # The edge of the bottom echo looks like a change shortly before it.
    usable = (share > 0) & (share < _DEEPEST_CHANGE)
    first = np.argmax(usable, axis=0)[np.newaxis]
    part, upper, lower = (np.take_along_axis(one, first, axis=0)[0] for one in (share, above, below))
    difference: FloatArray = 2 * path * (upper * part + np.maximum(lower, 0) * (1 - part)) - loss
    if usable.any():
        # The column of homogeneous water is no exponential.
        more, less = light.slopes(float(np.nanmean(np.where(usable.any(axis=0), part * path, np.nan))))
        difference = difference - 2 * path * (more * part + less * (1 - part))
    return np.asarray(np.where(usable.any(axis=0), difference, np.where(np.isfinite(share[0]), 0.0, np.nan)))


def _excess_before_bottom(waveforms: Waveforms, echoes: xr.Dataset, light: ScatteredLight) -> FloatArray:
    """Return the logarithm of the signal before bottom echoes over the columns', per shot, NaN without both."""
    rows = slice(0, waveforms.count)
    time, width = waveforms.records(rows).time_ns, waveforms.echo_fwhm_ns
    start, middle = (echoes["time_ns"].sel(echo=name).values.reshape(-1, 1) for name in ("surface", "bottom"))
    inside = (time > np.maximum(middle - _WINDOW[0] * width, start + width)) & (time < middle - _WINDOW[1] * width)
    column = _column_of(waveforms, time, echoes, light)
    power = waveforms.records(rows).power
    measured, fitted = (np.sum(np.where(inside & np.isfinite(column), one, 0), axis=1) for one in (power, column))
    known = (measured > 0) & (fitted > 0)
    ratio = np.divide(measured, fitted, out=np.ones_like(measured), where=known)
    return np.where(known, np.log(ratio), np.nan).reshape(echoes["attenuation"].shape)


def whole_energy(
    waveforms: Waveforms, echoes: xr.Dataset, light: ScatteredLight | None
) -> tuple[FloatArray, FloatArray]:
    """Return the energies of bottom echoes with their tails, and their errors by noise [J].

    Light that the water scatters forwards arrives up to four echo widths later. The Gaussian fitted to the echo
    therefore lacks 1 to 7 % of the bottom's energy. The signal sum about the echo contains all of it. The column before
    the echo, and its late light after it, are subtracted. The Gaussian counts where noise makes the sum less certain
    than 10 %, or there is no column. It also counts where the sum would reach beyond the record, or another echo is
    less than four echo widths before the bottom's.

    Parameters as for `loss_error`.
    """
    rows = slice(0, waveforms.count)
    records, width = waveforms.records(rows), waveforms.echo_fwhm_ns
    middle, energy, error = (echoes[name].sel(echo="bottom").values for name in ("time_ns", "energy", "energy_stderr"))
    from_echo = records.time_ns - middle.reshape(-1, 1)
    inside = (from_echo > -_AROUND[0] * width) & (from_echo < _AROUND[1] * width)
    column = np.zeros(1) if light is None else _column_of(waveforms, records.time_ns, echoes, light)
    seconds = 1e-9 * records.bin_ns
    total = seconds * np.sum(np.where(inside, records.power - column, 0), axis=1).reshape(energy.shape)
    of_total = seconds * error_of_sums(np.where(inside, records.noise, 0), None, records.shared).reshape(energy.shape)
    start, end = records.time_ns[[0, -1]] + 0.5 * records.bin_ns * np.array([-1, 1])
    whole = (middle - _AROUND[0] * width >= start) & (middle + _AROUND[1] * width <= end)
    others = echoes["time_ns"].drop_sel(echo=["column", "bottom"]).transpose("echo", ...).values
    # Comparisons with the times of echoes that are not there are false.
    alone = ~(others > middle - _APART * width).any(axis=0)
    better = (light is not None) & np.isfinite(total) & (of_total < _CERTAIN * total) & whole & alone
    return np.where(better, total, energy), np.where(better, of_total, error)


def _column_of(waveforms: Waveforms, time: FloatArray, echoes: xr.Dataset, light: ScatteredLight) -> FloatArray:
    """Return the columns of fits to waveforms above a bottom, at all times, shape (waveforms, time)."""
    start, level = (
        echoes[name].sel(echo=echo).values.reshape(-1, 1)
        for name, echo in (("time_ns", "surface"), ("amplitude", "column"))
    )
    decay = echoes["attenuation"].values.reshape(-1, 1) * 2 * waveforms.geometry.metres_per_ns
    exponential = level * waveforms.gain(slice(0, waveforms.count)) * np.exp(-decay * (time - start))
    return np.asarray(exponential * light.column_ratio(waveforms.geometry.path_of_time(time)))


def focusing_at(dataset: xr.Dataset, depth: FloatArray) -> FloatArray:
    """Return the mean factor by which waves focus light at depths [m] as a result states it, 1 without them."""
    known = Focusing.from_attributes(dataset.attrs)
    return np.ones_like(depth) if known is None else np.where(np.isfinite(depth), known.at(np.nan_to_num(depth)), 1.0)


def slope_variance(attributes: Mapping[str, Any]) -> float:
    """Return the total variance of the sea's slopes [1], a typical one if it is unknown."""
    known = optional_number(attributes, "surface_slope_variance")
    return TYPICAL_SLOPE_VARIANCE if known is None else known


def focusing(attributes: Mapping[str, Any], slant_range: float) -> float:
    """Return the relative standard deviation of the light at a bottom by waves that focus it [1], 0 without waves.

    A beam's light is a mean over facets, whose number grows with the beam's area.
    """
    if not np.any(attributes.get("surface_heights_m", 1.0)):
        return 0.0
    known = (optional_number(attributes, name) for name in ("divergence_mrad", "field_of_view_mrad"))
    width = 1e-3 * slant_range * min((one for one in known if one is not None), default=0.0)
    return _FOCUSING * math.sqrt(slope_variance(attributes)) / math.hypot(width, _NARROWEST)


def sea_variances(
    lidar: LidarGeometry, time: FloatArray, attenuation: float, slopes: xr.Dataset
) -> tuple[dict[str, npt.NDArray[np.bool_]], dict[str, tuple[FloatArray, FloatArray]]]:
    """Return whether slopes and ranges from `surface_slopes` lower the variances of depth and log reflectance.

    Also return these variances without and with them, [m^2] and [1]. The former depth variance is infinite if the sea
    is unknown. The reflectance variance is then the value over a typical sea.
    """

    def through(along: FloatArray, across: FloatArray, distance: FloatArray) -> tuple[FloatArray, SlopeRefraction]:
        ray = SlopeRefraction.of(along, across, lidar.off_nadir, lidar.refractive_index)
        return np.nan_to_num((time - 2e9 * distance / C0) * lidar.metres_per_ns), ray

    def depth(along: FloatArray, across: FloatArray, distance: FloatArray) -> FloatArray:
        path, ray = through(along, across, distance)
        return bottom_depth(distance, path, lidar.height, lidar.off_nadir, ray)

    def log_reflectance(along: FloatArray, across: FloatArray, distance: FloatArray) -> FloatArray:
        path, ray = through(along, across, distance)
        gain = bottom_gain(distance, path, lidar.refractive_index, ray)
        return np.asarray(2 * np.nan_to_num(attenuation) * path - np.log(gain))

    names = ("slope_along_stderr", "slope_across_stderr", "surface_range_stderr")
    errors = [slopes[name].values if name in slopes else np.zeros(1) for name in names]
    before = slopes.attrs.get("slope_prior_deviation", [math.inf] * 3)
    # A slope that is not estimated is as uncertain as on the sea.
    typical = surface_inputs.deviations_of_sea(slope_variance(slopes.attrs))
    helpful: dict[str, npt.NDArray[np.bool_]] = {}
    by_sea: dict[str, tuple[FloatArray, FloatArray]] = {}
    for name, quantity in (("depth", depth), ("reflectance", log_reflectance)):
        without, corrected = variances(quantity, lidar.slant_range, before, errors)
        helpful[name] = np.reshape(corrected < without, time.shape)
        sea = list(before if name == "depth" else np.where(np.isfinite(before), before, typical))
        known = [np.where(np.isfinite(error), error, deviation) for error, deviation in zip(errors, sea, strict=True)]
        without, corrected = (
            np.broadcast_to(one, time.size).reshape(time.shape)
            for one in variances(quantity, lidar.slant_range, sea, known)
        )
        by_sea[name] = without, corrected
    return helpful, by_sea


def echo_error(energy: FloatArray, stderr: FloatArray) -> FloatArray:
    """Return the relative energy error of bottom echoes by noise and by the method."""
    return np.hypot(_OF_ECHO, np.nan_to_num(stderr / energy))


def scatter(reflectance: FloatArray) -> float:
    """Return the relative standard deviation of reflectances over shots, infinite for few shots."""
    known = reflectance[np.isfinite(reflectance) & (reflectance > 0)]
    return float(np.std(np.log(known))) if known.size >= _FEWEST_SHOTS else math.inf


def steadier(corrected: FloatArray, uncorrected: FloatArray) -> bool:
    """Return whether reflectances scatter less over shots, or have too few shots for that."""
    found = scatter(corrected)
    return math.isinf(found) or found < scatter(uncorrected)


def target_flags(
    echoes: xr.Dataset, attributes: Mapping[str, Any], margin: float, *, one_place: bool
) -> tuple[IntArray, float]:
    """Return flags for bottom echoes that targets disturb, and the share of the beam that targets hide from the bottom.

    The attribute ``target_outlines`` gives the targets, for shots at `one_place`. Otherwise the share is 0, and every
    echo before the bottom's has a flag. The echoes are from `echo_table.extract`, with depths below the mean sea level,
    at most `margin` [m] from the targets'.
    """
    bottom, before = (echoes["depth_m"].sel(echo=name).values for name in ("bottom", "target"))
    targets = json.loads(attributes.get("target_outlines", "[]"))
    floor = -float(attributes["bottom_point"][2]) if "bottom_point" in attributes else np.inf
    flags = np.zeros(np.shape(bottom), dtype=np.int64)
    for target in targets:
        deep, shallow = (-float(height) for height in target["z"])
        at_target = (bottom > shallow - margin) & (bottom < deep + margin) & (bottom < floor - margin)
        flags |= np.where(at_target, int(ReflectanceFlag.TARGET), 0)
    hidden = hidden_share(attributes, targets) if one_place and targets else 0.0
    if not hidden:
        flags |= np.where(np.isfinite(before), int(ReflectanceFlag.EARLIER_ECHO), 0)
    return flags, hidden


def hidden_share(attributes: Mapping[str, Any], targets: list[dict[str, Any]]) -> float:
    """Return the share of a Gaussian beam that meets targets in a result, 0 to 1; 0 if the beam is unknown."""
    divergence = optional_number(attributes, "divergence_mrad")
    pose = pose_of(attributes)
    if pose is None or divergence is None:
        return 0.0
    along = 0.5e-3 * divergence
    across = 0.5e-3 * (optional_number(attributes, "divergence_across_mrad") or divergence)
    turn = math.radians(optional_number(attributes, "ellipse_deg") or 0.0)
    ticks = _REACH * ((np.arange(_GRID) + 0.5) / _GRID * 2 - 1)
    u, v = np.meshgrid(ticks, ticks)
    weight = np.exp(-0.5 * (u**2 + v**2))
    angle_x = along * u * np.cos(turn) - across * v * np.sin(turn)
    angle_y = along * u * np.sin(turn) + across * v * np.cos(turn)
    hidden = np.zeros(u.shape, dtype=bool)
    for target in targets:
        line = np.reshape(target.get("seen", []), (-1, 2))
        if len(line) >= 3:
            corners = pose.angles_of(np.pad(line, ((0, 0), (0, 1))) - pose.origin)
            hidden |= inside_outline([corners], angle_x, angle_y)
    return float(np.sum(weight * hidden) / np.sum(weight))
