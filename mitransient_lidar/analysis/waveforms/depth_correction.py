"""Depth corrections by the mean error in renders of the same instrument."""

from __future__ import annotations

import importlib.resources
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms.depth_errors import rendered_bin_ns, rounding_ns
from mitransient_lidar.analysis.waveforms.echo_detection import EchoClass, EchoFlag, has_echo
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, non_negative
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.results.attributes import described, step_of_history
from mitransient_lidar.results.files import Given, dataset_of
from mitransient_lidar.results.geometry import required_number

#: Dimensions of a table that depths are interpolated in, in this order, before estimator and pixel.
AXES = ("off_nadir_deg", "wind_speed", "water", "depth")

#: Share of shots with a depth from which a bias counts for the changes between nodes; fewest places of a spread.
_USUAL, _FEWEST = 0.5, 4.0
#: Rate of a random walk from left-out nodes over that from differences, which a trend raises: the mean of the depths
#: and waters, over a level sea, of eight tables.
_OF_TWO = 0.47
#: Rate of level seas between ripples where a table has those of one wind [m^2 per inverse slope variance], by tables.
_OF_RIPPLES = 4.4e-5
_SAME_RING = 0.05  # largest difference of the radii of pixels on a ring, over the largest radius
_ANGLE_DIGITS = 6  # of angles between pixels [deg]
_NEAR = 2.0  # largest error of a depth that counts [m]
_LEVEL = 1e-6  # largest difference of the heights of a level sea [m]


def corrections_for(instrument: str, given: Given, name: str = "corrections") -> xr.Dataset:
    """Return a correction table, as from `studies.depth_bias`: itself, from a file, or with ``auto`` the shipped one.

    Raises `UserError` if it cannot be read, there is none of the instrument, or it is no such table; `name` is that of
    the parameter.
    """
    source = given
    if isinstance(given, str) and given == "auto":
        if not instrument:
            raise UserError(
                "corrections = 'auto' needs a result of an instrument: give the file of a table of depth-bias"
            )
        folder = Path(str(importlib.resources.files("mitransient_lidar.scenes"))) / "instruments"
        source = folder / f"{instrument}_depths.nc"
        if Path(instrument).name != instrument or not source.is_file():
            raise UserError(
                f"there are no shipped corrections of the instrument {instrument}: make them with depth-bias"
            )
    table = dataset_of(name, source, "corrections")
    place = "the table of corrections" if isinstance(source, xr.Dataset) else source
    wanted = {*AXES, "estimator", "pixel"}
    known = "ripples" in table.coords and "instrument" in table.attrs
    if not known or set(table["bias"].dims) != wanted or set(table["attenuation"].dims) != set(AXES):
        raise UserError(f"{place} holds no corrections of depths: it must be a table of depth-bias")
    level = table["wind_speed"].values == 0
    axes = {axis: table[axis].values for axis in ("off_nadir_deg", "depth", "wind_speed")}
    axes |= {"wind_speed": axes["wind_speed"][~level], "ripples": table["ripples"].values[level]}
    for axis, values in axes.items():
        if np.any(np.diff(values) <= 0):
            raise UserError(f"{place} has {axis} that does not ascend")
    return table.transpose(*AXES, "estimator", "pixel")


def correct_depths(found: Given, table: Given, wind_speed: float | None = None, turn_deg: float = 0.0) -> xr.Dataset:
    """Subtract a table's mean errors from bottom and target depths.

    Parameters
    ----------
    found : xarray.Dataset
        Echoes, from `echo_table.extract` with ``depth_from`` echo.
    table : xarray.Dataset
        From `studies.depth_bias.depth_bias`, its file, or ``auto`` for the shipped one of the instrument.
    wind_speed : float, optional
        Wind speed [m/s], at least 0; for a level sea the wind of its ripples. Defaults to the result's scene. With 0,
        the sea is level.
    turn_deg : float
        Angle by which the pixels are turned about the receiver's axis, from far to left [deg]; see `turned_pixels`.

    Returns
    -------
    xarray.Dataset
        The echoes with ``depth_m`` less the bias and ``depth_correction_m``, what was subtracted. Biases and spreads
        are interpolated linearly in angle from nadir, wind, attenuation and depth. For level seas the inverse slope
        variance of ripples replaces the wind. The attenuation (`usual_attenuation`) is compared among columns as long.
        Outside the table they are those of its ends, but spreads that grow with the angle or the wind go on growing.
        Where the column has no attenuation, the mean over waters counts, each with its share of bottoms found at this
        depth. Only table depths without attenuation are used. Where it has one, only depths with it are used. A bias
        counts with the share bias^2/(bias^2 + spread^2/n), for n places of a sea.

        ``depth_m_method_error`` is the root sum square of

        - the table's spread beyond its noise error, over waves with the mean over waters; where the noise error exceeds
          the spread, ``depth_m_stderr`` is reduced to the spread;
        - the error spread/sqrt(n) of the mean bias over n locations with waves, or n renders of a level sea;
        - the bias error between nodes and beyond the table's ends, as for random walks: see Notes;
        - the spread of biases over waters, where the column has no attenuation;
        - the rounding of the surface time to a render bin, largest over the pixels; see `depth_errors.rounding_ns`.

    Raises
    ------
    UserError
        If the table is of another instrument, lacks an estimator or a pixel, or the wind is not known.

    Notes
    -----
    The linear interpolation of a random walk between nodes at the distances g and h has the variance rate times g h/(g
    + h), and beyond an end rate times g (kriging, linear variogram; G. Matheron, Principles of geostatistics, Economic
    Geology 58 (1963), 1246, doi:10.2113/gsecongeo.58.8.1246). The rate along an axis is a mean over the lowest-wind
    cells in which half of the shots have a depth. Each node is left out in turn; its squared difference from the
    interpolated neighbours is divided by g h/(g + h). Two nodes give 0.47 of their squared difference over the
    distance. This is the mean ratio of both rates in eight tables (0.57 +- 0.12 in the shipped ones). One node gives 0.
    One wind of ripples gives 0.44 cm^2 for each unit of the inverse slope variance, the mean of the tables. Rates along
    wind and ripples exclude the variance of location means. Cells in which fewer of the shots have a depth count only
    where no other ones do. Without any bias of an estimator in a pixel, depths and errors stay as they are.
    """
    found = dataset_of("found", found, "echoes")
    instrument = str(found.attrs.get("instrument", ""))
    table = corrections_for(instrument, table, "table")
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
    depth = found["depth_m"] if several else found["depth_m"].expand_dims(estimator=list(names))
    arranged = depth.transpose("estimator", "pixel", ..., "echo")
    opacity, at_depth = _opacity(found, arranged)
    learnt = _learnt(table.sel(pixel=found["pixel"].values, estimator=list(names)))
    if turn_deg != 0:
        learnt = turned_pixels(learnt, found["angle_x"].values, found["angle_y"].values, turn_deg)
    others = _of_columns(learnt, bool(np.isnan(opacity)))
    learnt = _of_columns(learnt, bool(np.isfinite(opacity)))
    # Linear are spreads, not their squares: where surface echoes fade with the angle, errors of 22 degrees would be
    # mostly those of 25.
    learnt["deviation"] = learnt["variance"] ** 0.5
    wind, level = _sea(found, wind_speed)
    angle = required_number(found.attrs, "off_nadir_deg")
    cell, rates = _of_sea(learnt, wind, level), _walks(learnt, others, angle)
    nodes = table["off_nadir_deg"].values
    cell = _between(cell, "off_nadir_deg", nodes, angle)
    depths = table["depth"].values
    attenuation = _along_depth(cell["attenuation"].transpose("water", "depth").values, depths, np.array(at_depth))
    of_waters = _shares(attenuation, opacity)
    by_angle, by_wind = _walked(nodes, angle), _walked_of_sea(table, wind, level)
    by_water = _walked(attenuation, opacity)
    amount, deviation, variance, share = (np.zeros(arranged.shape) for _ in range(4))
    for e, p in np.ndindex(arranged.shape[:2]):
        at = arranged.values[e, p]
        one = cell.isel(estimator=e, pixel=p)
        rate = {axis: of.isel(estimator=e, pixel=p).values for axis, of in rates.items()}
        rows = {
            name: _along_depth(one[name].transpose("water", "depth").values, depths, at)
            for name in ("bias", "deviation", "noise_share", "found")
        }
        shares = np.broadcast_to(of_waters.reshape(-1, *[1] * at.ndim), rows["bias"].shape)
        if np.isnan(opacity):  # waters in which a bottom at this depth is seen
            shares = rows["found"] / np.maximum(rows["found"].sum(axis=0), 1e-9)
        for name, target in (("bias", amount), ("deviation", deviation), ("noise_share", share)):
            target[e, p] = np.sum(shares * rows[name], axis=0)
        variance[e, p] = deviation[e, p] ** 2
        if np.isnan(opacity):
            variance[e, p] += np.sum(shares * (rows["bias"] - amount[e, p]) ** 2, axis=0)
        known = [np.where(row, depths, np.nan) for row in one["bias"].transpose("water", "depth").notnull().values]
        walked = np.stack([_walked(depths if np.isnan(nodes).all() else nodes, at) for nodes in known])
        by_depth = np.tensordot(rate["depth"], shares * walked, 1)
        between = np.tensordot(rate["off_nadir_deg"], shares, 1) * by_angle + float(rate["water"]) * by_water
        between = between + np.tensordot(rate["ripples" if level else "wind_speed"], shares, 1) * by_wind
        variance[e, p] += by_depth + between if one["bias"].notnull().any() else np.nan
    amount[..., :2] = 0.0

    def of_echoes(values: FloatArray) -> xr.DataArray:
        whole = arranged.copy(data=np.where(np.isfinite(arranged.values), values, np.nan)).transpose(*depth.dims)
        return (whole if several else whole.isel(estimator=0, drop=True)).transpose(*found["depth_m"].dims)

    correction, error = of_echoes(amount), of_echoes(np.sqrt(variance))
    if "surface_spread" in found.coords and "depth_per_ns" in found.coords:
        rounding = found["depth_per_ns"] * rounding_ns(found["surface_spread"], rendered_bin_ns(found.attrs))
        # A pixel without light of the surface has the time of another one.
        error = (error**2 + rounding.max("pixel") ** 2).transpose(*correction.dims) ** 0.5
    if "class" in found:
        # In air there is nothing to correct, and joint fits of surface and bottom have no such bias.
        correction = correction.where(~found["class"].isin([EchoClass.LAND, EchoClass.ABOVE, EchoClass.MERGED]))
    behind = xr.DataArray([False, False, True, True], dims="echo") & correction.notnull()
    stated = {
        "depth_m": found["depth_m"] - correction.fillna(0),
        "depth_m_stderr": found["depth_m_stderr"] * of_echoes(share).where(behind, 1.0),
        "depth_m_method_error": found["depth_m_method_error"].where(~behind | error.isnull(), error),
    }
    added = {name: values.assign_attrs(found[name].attrs) for name, values in stated.items()}
    corrected = found.assign(added | {"depth_correction_m": correction.assign_attrs(described("depth_correction_m"))})
    history = step_of_history("corrected", found.attrs)
    return corrected.assign_attrs(depth_corrections=table.attrs["instrument"], history=history)


def _learnt(table: xr.Dataset) -> xr.Dataset:
    """Return a table with the biases that count, the depth variance without noise, and the noise share.

    The variables added are ``variance`` [m^2], that of the mean bias included, and ``noise_share``.
    """
    waves = table["wind_speed"] > 0
    usual = table["found"] >= _USUAL
    counts = usual | ~usual.any(("water", "depth"))
    table = table.assign({name: table[name].where(counts) for name in ("bias", "spread", "noise_error")})
    records = float(table.attrs.get("records", 1))
    shots = table["found"] * float(table.attrs.get("shots", np.inf))
    # Records of a single render of a level sea differ by noise alone.
    independent = waves | (table.attrs.get("level_renders", 1) > 1)
    number = shots.where(independent, records * shots).clip(min=_FEWEST)
    uncertain = (table["spread"] ** 2 / number).where(independent, 0.0).fillna(0)
    certain = table["bias"] ** 2 / (table["bias"] ** 2 + uncertain).where(lambda total: total > 0, 1.0)
    left = table["spread"] ** 2 / (1 - 1 / number)
    noise = table["noise_error"] ** 2
    beyond = left - noise
    beyond = beyond.mean("water").where(waves, beyond).clip(min=0).where(left.notnull())
    return table[["bias", "spread", "found", "noise_error", "attenuation"]].assign(
        bias=table["bias"] * certain,
        variance=beyond + uncertain,
        uncertain=uncertain,
        noise_share=np.sqrt((left / noise).where(noise > 0, 1.0).clip(max=1)),
    )


def _of_columns(learnt: xr.Dataset, known: bool) -> xr.Dataset:
    """Return a table without the biases of columns whose attenuation is not `known`, or is where it is not.

    Without it the echo of a bottom is not separated from its column, and has another bias, no neighbour in depth.
    A water without any left stays as it is.
    """
    alike = learnt["attenuation"].notnull() == known
    alike = alike | ~(alike & learnt["bias"].notnull()).any("depth")
    return learnt.assign({name: learnt[name].where(alike) for name in ("bias", "variance", "noise_share", "uncertain")})


def turned_pixels(learnt: xr.Dataset, angle_x: FloatArray, angle_y: FloatArray, turn_deg: float) -> xr.Dataset:
    """Return a table for pixels that are turned about the receiver's axis.

    A bias depends on the angle between a pixel's place and the plane of incidence. A turned pixel lies between two
    table pixels on its ring. Its bias is linear in this angle between their biases b_1 and b_2, with weights 1 - w and
    w. Besides their variances it has the variance w (1 - w) (b_2 - b_1)^2.

    `learnt`: table over ``pixel``, with the variables ``bias`` and ``variance`` [m^2]. `angle_x`, `angle_y`: pixel
    centres, away from nadir and to the left, in any unit, shape (pixels,). `turn_deg`: angle from far to left [deg].
    """
    place = np.asarray(angle_x) + 1j * np.asarray(angle_y)
    radius = np.abs(place)
    same = np.abs(radius[:, np.newaxis] - radius) <= _SAME_RING * radius.max()
    azimuth = np.degrees(np.angle(place))
    ahead = np.round(azimuth - azimuth[:, np.newaxis] - turn_deg, _ANGLE_DIGITS) % 360
    ahead, behind = (np.where(same, angle, np.inf) for angle in (ahead, -ahead % 360))
    ways = np.stack([behind.min(axis=1), ahead.min(axis=1)])
    in_middle = radius <= _SAME_RING * radius.max()
    before, after = (np.where(in_middle, np.arange(radius.size), angle.argmin(axis=1)) for angle in (behind, ahead))
    share = np.where(in_middle, 0.0, ways[0] / np.maximum(ways.sum(axis=0), 10.0**-_ANGLE_DIGITS))
    first, second = (learnt.isel(pixel=one).assign_coords(pixel=learnt["pixel"]) for one in (before, after))
    w = xr.DataArray(share, dims="pixel", coords={"pixel": learnt["pixel"]})
    mixed = first.where(w < 1, 0) * (1 - w) + second.where(w > 0, 0) * w
    apart = (second["bias"] - first["bias"]).where((w > 0) & (w < 1), 0)
    mixed["variance"] = mixed["variance"] + apart**2 * w * (1 - w)
    whole = [name for name in learnt.data_vars if "pixel" not in learnt[name].dims]
    return mixed.assign({name: learnt[name] for name in whole})


def _of_sea(learnt: xr.Dataset, wind: float, level: bool) -> xr.Dataset:
    """Return a table at a wind or, for a level sea, at its ripples' wind; a level sea is the one without wind."""
    rows = learnt["wind_speed"].values == 0
    waves, ripples = learnt.isel(wind_speed=~rows), learnt["ripples"].values[rows]
    calm = learnt.isel(wind_speed=rows)
    if rows.any():
        calm = _between(calm, "wind_speed", _calmness(ripples), float(_calmness(wind)[0]))
        if level or rows.all():
            return calm
        waves = xr.concat([calm.expand_dims(wind_speed=[0.0]), waves.drop_vars("ripples")], "wind_speed")
    return _between(waves, "wind_speed", waves["wind_speed"].values, wind)


def _calmness(winds: npt.ArrayLike) -> FloatArray:
    """Return minus the inverse ripple slope variances at winds [m/s]; they ascend with the winds.

    A level surface's log echo is linear in it, and depth errors follow this echo.
    """
    return np.array([-1 / sum(cox_munk(float(wind))) for wind in np.atleast_1d(winds)])


def _between(table: xr.Dataset, axis: str, nodes: FloatArray, value: float) -> xr.Dataset:
    """Interpolate a table linearly between an axis's nodes; where one node lacks a cell, the other's counts.

    Beyond its ends values are those of the ends, but ``deviation`` goes on linearly where it ascends outwards.
    """
    place = float(np.interp(value, nodes, np.arange(nodes.size)))
    low = int(place)
    first, second = (table.isel({axis: min(one, nodes.size - 1)}, drop=True) for one in (low, low + 1))
    cell = first.fillna(second) * (1 - (place - low)) + second.fillna(first) * (place - low)
    if "deviation" in table and nodes.size > 1 and not nodes[0] <= value <= nodes[-1]:
        end, inner = (0, 1) if value < nodes[0] else (-1, -2)
        last, former = (table["deviation"].isel({axis: one}, drop=True) for one in (end, inner))
        beyond = (value - nodes[end]) / (nodes[end] - nodes[inner])
        cell["deviation"] = cell["deviation"] + beyond * (last - former).clip(min=0).fillna(0)
    return cell


def _walked_of_sea(table: xr.Dataset, wind: float, level: bool) -> float:
    """Return g h/(g + h), as `_walked`, for a wind between the table's waves, or ripples for level seas."""
    rows = table["wind_speed"].values == 0
    nodes = table["ripples"].values[rows == level] if np.any(rows == level) else table["wind_speed"].values
    nodes = np.append(nodes, 0.0) if rows.any() and not level else nodes
    return float(_walked(_calmness(nodes), _calmness(wind))[0] if level else _walked(nodes, wind))


def _walks(learnt: xr.Dataset, others: xr.Dataset, angle: float) -> dict[str, xr.DataArray]:
    """Return random-walk rates of biases along a table's axes [m^2 per unit], as `correct_depths`.

    All but ``water`` are over water. A water without them has the others' mean, or the mean of `others`, columns of the
    other kind, or 0. For ``wind_speed`` and ``ripples`` they are between the table's angles, minus the variance of
    location means.
    """

    def of_lowest(table: xr.Dataset, axis: str) -> xr.DataArray:
        calm = table.isel(wind_speed=0)
        bias = calm["bias"].where(calm["found"] >= _USUAL)
        rate = _rate(bias, calm["attenuation"] if axis == "water" else calm[axis], axis)
        rate = rate.mean([dim for dim in rate.dims if dim == axis or dim not in ("water", "estimator", "pixel")])
        return rate if axis == "water" else rate.fillna(rate.mean("water")).transpose("water", ...)

    axes = ("off_nadir_deg", "depth", "water")
    rates = {axis: of_lowest(learnt, axis).fillna(of_lowest(others, axis)).fillna(0) for axis in axes}
    rows = learnt["wind_speed"] == 0
    for name, own in (("ripples", learnt.isel(wind_speed=rows)), ("wind_speed", learnt.isel(wind_speed=~rows))):
        if own.sizes["wind_speed"] < 2:
            rates[name] = xr.full_like(rates["depth"], _OF_RIPPLES if name == "ripples" else 0.0)
            continue
        usual, places = own.where(own["found"] >= _USUAL), own["ripples"].values
        steps = np.diff(_calmness(places) if name == "ripples" else places)
        first, second = (usual.isel(wind_speed=part).drop_vars("wind_speed") for part in (slice(-1), slice(1, None)))
        change = (second["bias"] - first["bias"]) ** 2 - first["uncertain"] - second["uncertain"]
        change = _OF_TWO * change / xr.DataArray(steps, dims="wind_speed")
        rate = change.mean([dim for dim in change.dims if dim in ("wind_speed", "depth")]).clip(min=0)
        rate = _between(rate.to_dataset(name="rate"), "off_nadir_deg", learnt["off_nadir_deg"].values, angle)["rate"]
        rates[name] = rate.fillna(rate.mean("water")).fillna(0).transpose("water", ...)
    return rates


def _rate(bias: xr.DataArray, nodes: xr.DataArray, axis: str) -> xr.DataArray:
    """Return the squared changes of biases along an axis over its unit; see `correct_depths`."""
    count = bias.sizes[axis]
    if count > 2:
        parts = [slice(i, count - 2 + i) for i in range(3)]
        before, here, after = (bias.isel({axis: part}).drop_vars(axis) for part in parts)
        places = [nodes.isel({axis: part}).drop_vars(axis) for part in parts]
        g, h = np.abs(places[1] - places[0]), np.abs(places[2] - places[1])
        rate: xr.DataArray = (here - (h * before + g * after) / (g + h)) ** 2 * (g + h) / (g * h)
        if rate.notnull().any():
            return rate
    differences: xr.DataArray = _OF_TWO * bias.diff(axis) ** 2 / np.abs(nodes.diff(axis))
    return differences


def summarize_depths(found: xr.Dataset, truth: npt.ArrayLike) -> dict[str, FloatArray]:
    """Return what the depths of bottoms are worth, over estimator and pixel.

    `found`: echoes over shot, pixel, estimator and echo. `truth`, shape (shots,): depth of the bottom below the local
    surface [m].

    Returns `dict`: ``found``, the share of shots with a depth; ``bias`` and ``spread``, mean error and its standard
    deviation, of depths within 2 m; ``noise_error`` and ``error``, the median stated errors by noise and in all; ``z``,
    the root mean square of error over stated error; ``wrong``, the share of shots that err by more than 0.5 m without a
    flag.
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


def usual_attenuation(attenuation: FloatArray, stderr: FloatArray) -> float:
    """Return the waveforms' mean attenuation, shaped as its errors, weighted with their inverse squares.

    It is NaN where fewer than half of the waveforms have a column to measure it in. The weights leave out pixels that
    see too little of a short column.
    """
    known = np.isfinite(attenuation) & (stderr > 0)
    if not known.size or known.mean() < _USUAL:
        return math.nan
    return float(np.average(attenuation[known], weights=stderr[known] ** -2.0))


def _opacity(found: xr.Dataset, depth: xr.DataArray) -> tuple[float, float]:
    """Return the column attenuation, NaN where unknown, and the median depth of the bottoms [m]."""
    values, stderr = (found[name].transpose("pixel", ...).values for name in ("attenuation", "attenuation_stderr"))
    bottom = depth.isel(estimator=0, echo=-1).values
    known = np.isfinite(bottom) & np.isfinite(values)
    return usual_attenuation(values, stderr), float(np.median(bottom[known])) if known.any() else 0.0


def _sea(found: xr.Dataset, given: float | None) -> tuple[float, bool]:
    """Return the wind speed of a result's scene or ripples [m/s], and whether the sea is level."""
    lowest, highest = found.attrs.get("surface_heights_m", (math.nan, math.nan))
    level = bool(highest - lowest < _LEVEL) or given == 0
    if given is not None:
        return non_negative("wind_speed", given), level
    wind: Any = found.attrs.get("scene.wind_speed")
    try:
        return float(wind), level
    except (TypeError, ValueError):
        raise UserError("the wind speed of the result is not known: give it") from None


def _shares(nodes: FloatArray, value: float) -> FloatArray:
    """Return node weights for linear interpolation, constant beyond the ends; NaN is unknown."""
    order = np.flatnonzero(np.isfinite(nodes))
    order = order[np.argsort(nodes[order])]
    if not order.size or np.isnan(value):
        return np.full(nodes.size, 1 / nodes.size)
    weights = np.zeros(nodes.size)
    weights[order] = [np.interp(value, nodes[order], one) for one in np.eye(order.size)]
    return weights


def _walked(nodes: FloatArray, values: npt.ArrayLike) -> FloatArray:
    """Return g h/(g + h) for values at the distances g and h from nodes, g beyond an end, and 0 for NaN."""
    known = np.sort(nodes[np.isfinite(nodes)])
    if not known.size:
        return np.zeros(np.shape(values))
    at = np.nan_to_num(values, nan=float(known[0]))
    after = np.searchsorted(known, at)
    before, after = np.maximum(after - 1, 0), np.minimum(after, known.size - 1)
    low, high = np.abs(at - known[before]), np.abs(known[after] - at)
    inside = before != after
    return np.asarray(np.where(inside, low * high / np.where(inside, low + high, 1.0), low))


def _along_depth(values: FloatArray, depths: FloatArray, at: FloatArray) -> FloatArray:
    """Return values, shape (water, depth), at depths of any shape, which stands after the waters.

    They are linear between known depths, constant beyond; a water without any has the nearest water's.
    """
    known = np.isfinite(values)
    if not known.any():
        return np.full((len(values), *at.shape), np.nan)
    waters = np.flatnonzero(known.any(axis=1))
    nearest = [waters[np.argmin(np.abs(waters - water))] for water in range(len(values))]
    places = np.nan_to_num(at, nan=float(depths[0]))
    return np.stack([np.interp(places, depths[known[water]], values[water][known[water]]) for water in nearest])
