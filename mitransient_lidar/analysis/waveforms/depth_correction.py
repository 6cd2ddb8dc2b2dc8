"""Corrections of depths by the mean error that renders of the same instrument have."""

from __future__ import annotations

import importlib.resources
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag, has_echo
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, non_negative
from mitransient_lidar.results import netcdf
from mitransient_lidar.results.formats import input_format
from mitransient_lidar.results.geometry import required_number

#: Dimensions of a table that depths are interpolated in, in this order, before estimator and pixel.
AXES = ("off_nadir_deg", "wind_speed", "water", "depth")

_TABLE = ("bias", "spread", "found", "attenuation")
_LEAST_ERROR = 0.01  # of a corrected depth [m]
#: Error of biases between the nodes of a table, relative: that of 32 cells of level seas at other angles and depths.
_OF_BIAS = 0.25
_NEAR = 2.0  # largest error of a depth that counts [m]


def read_corrections(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a table of corrections, as of `depth_bias`, from a NetCDF file.

    Raises
    ------
    UserError
        If the file cannot be read, or holds no such table.
    """
    if input_format(path) != "netcdf":
        raise UserError(f"{path} must be a NetCDF file (.nc) of depth-bias")
    table = netcdf.read_netcdf(path)
    wanted = {*AXES, "estimator", "pixel"}
    if not set(_TABLE) <= set(table.data_vars) or set(table["bias"].dims) != wanted or "instrument" not in table.attrs:
        raise UserError(f"{path} holds no corrections of depths: it must be a table of depth-bias")
    for axis in ("off_nadir_deg", "wind_speed", "depth"):
        if np.any(np.diff(table[axis].values) <= 0):
            raise UserError(f"{path} has {axis} that does not ascend")
    return table.transpose(*AXES, "estimator", "pixel")


def corrections_for(instrument: str, given: str | os.PathLike[str]) -> xr.Dataset:
    """Return the table of a file, or with ``auto`` the shipped one of an instrument.

    Raises
    ------
    UserError
        If it cannot be read, or there is none.
    """
    if given != "auto":
        return read_corrections(given)
    if not instrument:
        raise UserError("corrections = 'auto' needs a result of an instrument: give the file of a table of depth-bias")
    path = Path(str(importlib.resources.files("mitransient_lidar.scenes"))) / "instruments" / f"{instrument}_depths.nc"
    if Path(instrument).name != instrument or not path.is_file():
        raise UserError(f"there are no shipped corrections of the instrument {instrument}: make them with depth-bias")
    return read_corrections(path)


def correct_depths(found: xr.Dataset, table: xr.Dataset, wind_speed: float | None = None) -> xr.Dataset:
    """Subtract the mean errors of a table from the depths of bottoms and targets.

    Parameters
    ----------
    found : xarray.Dataset
        Echoes, from `echo_table.extract` with ``depth_from`` echo.
    table : xarray.Dataset
        From `read_corrections` or `studies.depth_bias.depth_bias`.
    wind_speed : float, optional
        Wind speed [m/s], at least 0; by default that of the result's scene, 0 over a level sea.

    Returns
    -------
    xarray.Dataset
        The echoes with ``depth_m`` less the bias, ``depth_correction_m`` (what was subtracted), and as
        ``depth_m_method_error`` the spread that is left in renders with a quarter of the bias, the error of biases
        between nodes. Errors are interpolated linearly in the angle from nadir, the wind, the attenuation of the column
        (the median over the waveforms), and the depth; outside the table they are those of its ends. A bias counts with
        the share bias^2/(bias^2 + spread^2/n), for n places of a sea.

    Raises
    ------
    UserError
        If the table is of another instrument, lacks an estimator or a pixel, or the wind is not known.
    """
    instrument = found.attrs.get("instrument", "")
    if instrument != table.attrs["instrument"]:
        own = f"instrument {instrument}" if instrument else "no instrument"
        raise UserError(f"the corrections are of the instrument {table.attrs['instrument']}, but the result has {own}")
    if "pixel" not in found.dims:
        raise UserError("corrections need the dimension pixel")
    for name in ("pixel", "estimator"):
        wanted = np.atleast_1d(found[name].values if name in found.coords else found.attrs["estimators"]).tolist()
        if missing := [one for one in wanted if one not in table[name].values]:
            raise UserError(f"the corrections lack the {name} {missing[0]!r}")
    several = "estimator" in found.dims
    names = found["estimator"].values if several else found.attrs["estimators"]
    # Biases that are small beside their own error, over the places of a sea, count little.
    noise = (table["spread"] ** 2 / float(table.attrs.get("shots", np.inf))).fillna(0)
    certain = table["bias"] ** 2 / (table["bias"] ** 2 + noise).where(lambda square: square > 0, 1.0)
    table = table.assign(bias=table["bias"] * certain)
    own_table = table.sel(pixel=found["pixel"].values, estimator=list(names))
    wind = _wind(found) if wind_speed is None else non_negative("wind_speed", wind_speed)
    place = {"off_nadir_deg": required_number(found.attrs, "off_nadir_deg"), "wind_speed": wind}
    cell = own_table[list(_TABLE)]
    for axis, value in place.items():
        nodes = table[axis].values
        cell = (
            cell.interp({axis: float(np.clip(value, nodes[0], nodes[-1]))}) if nodes.size > 1 else cell.isel({axis: 0})
        )
    # Shape (water, depth, estimator, pixel).
    bias, spread = (cell[name].transpose("water", "depth", "estimator", "pixel").values for name in ("bias", "spread"))
    attenuation = cell["attenuation"].transpose("water", ...).values
    depth = found["depth_m"] if several else found["depth_m"].expand_dims(estimator=list(names))
    arranged = depth.transpose("estimator", "pixel", ..., "echo")
    amount, left = (np.zeros(arranged.shape) for _ in range(2))
    water = _place_of(attenuation, _median(found["attenuation"].values))
    nodes = table["depth"].values
    for e in range(arranged.shape[0]):
        for p in range(arranged.shape[1]):
            for values, target in ((bias, amount), (spread, left)):
                target[e, p] = _interpolated(values[:, :, e, p], water, _place_of(nodes, arranged.values[e, p]))
    amount[..., :2] = 0.0
    correction = arranged.copy(data=np.where(np.isfinite(arranged.values), amount, np.nan)).transpose(*depth.dims)
    error = arranged.copy(data=np.maximum(np.hypot(left, _OF_BIAS * amount), _LEAST_ERROR)).transpose(*depth.dims)
    if not several:
        correction, error = correction.isel(estimator=0, drop=True), error.isel(estimator=0, drop=True)
    correction = correction.transpose(*found["depth_m"].dims)
    behind = xr.DataArray([False, False, True, True], dims="echo")
    method = found["depth_m_method_error"].where(~behind | correction.isnull(), error.transpose(*correction.dims))
    described = {"units": "m", "long_name": "mean error that was subtracted from the depth"}
    corrected = found.assign(
        depth_m=(found["depth_m"] - correction.fillna(0)).assign_attrs(found["depth_m"].attrs),
        depth_m_method_error=method.assign_attrs(found["depth_m_method_error"].attrs),
        depth_correction_m=correction.assign_attrs(described),
    )
    return corrected.assign_attrs(depth_corrections=table.attrs["instrument"])


def summarize_depths(found: xr.Dataset, truth: npt.ArrayLike) -> dict[str, FloatArray]:
    """Return what the depths of bottoms are worth, over estimator and pixel.

    Parameters
    ----------
    found : xarray.Dataset
        Echoes over shot, pixel, estimator and echo.
    truth : array_like, shape (shots,)
        Depth of the bottom below the local surface [m].

    Returns
    -------
    dict
        ``found``, the share of shots with a depth; ``bias`` and ``spread``, mean error and its standard deviation,
        of depths within 2 m; ``noise_error`` and ``error``, the medians of the stated error by noise, and of all;
        ``z``, the root mean square of error over stated error; ``wrong``, the share of shots that err by more than
        0.5 m without a flag.
    """
    bottom = found.sel(echo="bottom").transpose("shot", "pixel", "estimator")
    depth, noise, method = (bottom[name].values for name in ("depth_m", "depth_m_stderr", "depth_m_method_error"))
    flags = bottom["flags"].values
    usual = np.isfinite(depth) & has_echo(flags)
    error = depth - np.asarray(truth, dtype=np.float64)[:, np.newaxis, np.newaxis]
    stated = np.hypot(noise, method)
    near = usual & (np.abs(error) < _NEAR)
    masked, known = np.where(near, error, np.nan), np.where(near, stated, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        empty = ~near.any(axis=0)
        filled, stated_filled = np.where(empty, 0.0, masked), np.where(empty, 1.0, known)
        numbers = {
            "bias": np.nanmean(filled, axis=0),
            "spread": np.nanstd(filled, axis=0),
            "noise_error": np.nanmedian(np.where(empty, 0.0, np.where(near, noise, np.nan)), axis=0),
            "error": np.nanmedian(stated_filled, axis=0),
            "z": np.sqrt(np.nanmean((filled / stated_filled) ** 2, axis=0)),
        }
    values = {name: np.where(empty, np.nan, value).T for name, value in numbers.items()}
    problems = flags & ~int(EchoFlag.NO_ECHO)
    values["found"] = usual.mean(axis=0).T
    values["wrong"] = np.mean(usual & (np.abs(error) > 0.5) & (problems == 0), axis=0).T
    return values


def _median(values: FloatArray) -> float:
    """Return the median of the numbers among values, NaN without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan


def _wind(found: xr.Dataset) -> float:
    """Return the wind speed of a result's scene [m/s], 0 for a level sea."""
    lowest, highest = found.attrs.get("surface_heights_m", (math.nan, math.nan))
    if highest - lowest < 1e-6:
        return 0.0
    wind: Any = found.attrs.get("scene.wind_speed")
    try:
        return float(wind)
    except (TypeError, ValueError):
        raise UserError("the wind speed of the result is not known: give it") from None


def _place_of(nodes: FloatArray, values: npt.ArrayLike) -> FloatArray:
    """Return places of values between nodes, 0 for the first one; of NaN, that of the lowest node."""
    order = np.flatnonzero(np.isfinite(nodes))
    if not order.size:
        return np.zeros(np.shape(values))
    order = order[np.argsort(nodes[order])]
    return np.asarray(np.interp(np.nan_to_num(values, nan=float(nodes[order[0]])), nodes[order], order.astype(float)))


def _interpolated(values: FloatArray, row: FloatArray, column: FloatArray) -> FloatArray:
    """Return values, shape (rows, columns), between their nodes; missing ones are those of the nearest node."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros(np.shape(column))
    rows, columns = np.nonzero(known)
    filled = values.copy()
    for i, j in np.argwhere(~known):
        nearest = np.argmin(10 * np.abs(rows - i) + np.abs(columns - j))
        filled[i, j] = values[rows[nearest], columns[nearest]]
    low = np.minimum(row.astype(int), values.shape[0] - 1)
    left = np.minimum(column.astype(int), values.shape[1] - 1)
    down, right = row - low, column - left
    below, beyond = np.minimum(low + 1, values.shape[0] - 1), np.minimum(left + 1, values.shape[1] - 1)
    first = (1 - right) * filled[low, left] + right * filled[low, beyond]
    second = (1 - right) * filled[below, left] + right * filled[below, beyond]
    return np.asarray((1 - down) * first + down * second)
