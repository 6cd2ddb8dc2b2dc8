"""Depth errors and total propagated uncertainty of an instrument, from renders over known bottoms."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar._version import release
from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS, TrajectoryErrors, sounding_uncertainty
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms.depth_correction import (
    AXES,
    correct_depths,
    corrections_for,
    summarize_depths,
    usual_attenuation,
)
from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray, has_echo
from mitransient_lidar.analysis.waveforms.echo_table import ESTIMATORS, extract
from mitransient_lidar.analysis.waveforms.surface_times import check_surface
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import RECEIVERS, Infrared, Numbers, Option, checked, positive_option
from mitransient_lidar.core.parameters.fields import is_green
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray, finite
from mitransient_lidar.loading.catalogue import read_instrument
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.results.attributes import described, label
from mitransient_lidar.results.files import Given
from mitransient_lidar.studies.cases import Cases

_LOG = logging.getLogger(__name__)

#: Waters by their Jerlov types: clear ocean, coast, and turbid coast.
WATERS = ("IB", "1C", "5C")


def rising(meaning: str, unit: str, **more: Any) -> Option:
    """Return the declaration of a list of increasing numbers from 0 on."""
    return Option(meaning, 0, None, unit, ascending=True, form="N,N,...", **more)


#: Parameters for an instrument's tables.
InstrumentName = Annotated[str, Option("Name of the instrument", form="INSTRUMENT", is_argument=True)]
Winds = Annotated[Numbers, rising("Wind speeds; 0 for a level sea with ripples", "m/s")]
Waters = Annotated[Sequence[str], Option("Jerlov types from clear to turbid", form="NAME,NAME,...")]
Depths = Annotated[Numbers, rising("Bottom depths", "m", above=True)]
SeaScene = Annotated[str, Option("Scene that supplies sea, water and bottom")]
OwnReceiver = Annotated[str | None, Option(f"{RECEIVERS}. By default the instrument's")]
Places = Annotated[int, Option("Random locations per wavy sea, or renders of a level sea", 2, 10_000)]
Records = Annotated[int, Option("Records with noise at each location", 1, 10_000)]
SeaTime = Annotated[
    float | None, positive_option("Render no sea after this many seconds; omitted seas are NaN in the table")
]
SeaSeed = Annotated[int, Option("Random seed", 0, 2**31)]

#: Wavelength in their tables [nm].
_WAVELENGTH = 532.0

#: Relative standard error of renders over a level sea, relative to waves, which differ more between locations.
_LEVEL = 0.6

#: Difference of the second angle [degree], and angle from which it is less.
_FURTHER, _GRAZING = 5.0, 60.0

#: Distance from the bottom within which its signal is the largest [m].
_NEAR = 0.5

#: Signal-to-noise ratio of bright bottoms, and largest error of their depths [m].
_BRIGHT, _RIGHT = 10.0, 2.0

#: Attributes of renders that do not depend on angle, wind, water and depth.
_GEOMETRY = ("altitude", "divergence_mrad", "refractive_index")

#: Numbers for each bottom, estimator and pixel.
_NUMBERS = (
    *("bias", "spread", "found", "noise_error", "error", "z", "wrong", "flagged", "bright", "bright_found", "hidden"),
    *("corrected_bias", "corrected_spread", "corrected_z", "snr"),
)

#: Numbers for bottoms that are not found.
_ZERO = ("found", "flagged", "wrong")


@checked
def depth_bias(
    instrument: InstrumentName,
    params: Mapping[str, Any] | None = None,
    *,
    angles_deg: Annotated[
        Numbers | None, rising("Angles from nadir; by default the instrument's and 5 more", "degrees", flag="--angles")
    ] = None,
    winds: Winds = (0.0, 3.0, 6.0),
    ripples: Annotated[Numbers, rising("Winds whose ripples level seas have", "m/s", above=True)] = (3.0, 6.0),
    waters: Waters = WATERS,
    depths: Depths = (3.0, 6.0, 10.0),
    scene: SeaScene = "table1",
    estimators: Sequence[str] = ESTIMATORS,
    receiver: OwnReceiver = None,
    infrared: Infrared = False,
    shots: Places = 12,
    records: Records = 5,
    target_error: Annotated[
        float,
        Option("Relative standard error of a render over waves; 0.6 of it over a level sea", 0, 1, above=True),
    ] = 0.05,
    corrections: Annotated[
        Given | None,
        Option("Correction table made with another seed, to test it; auto for the shipped one", form="FILE"),
    ] = None,
    max_time: SeaTime = None,
    seed: SeaSeed = 1,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Measure the depth errors in an instrument's records, at each angle, wind, water and depth.

    Parameters
    ----------
    params, scene
        A scene with the parameters ``aim_x``, ``aim_y``, ``off_nadir_deg``, ``wind_speed``, ``spectrum``, ``jerlov``
        and ``bottom_depth``, and further parameters.
    waters
        Jerlov types, from clear to turbid, at 532 nm, whatever the instrument has.
    depths
        Bottom depths [m], above 0, ascending. Bottoms that waves uncover are not rendered. Nor are bottoms below one
        that no channel finds though it found a shallower one: ``found``, ``flagged`` and ``wrong`` are 0, other numbers
        NaN.
    estimators
        Estimators in `echo_table.extract`.
    infrared
        Whether the surface is that of the instrument's infrared channel, as far as it is known better.
    target_error
        Relative standard error of each location's render, above 0; 0.6 times this over a level sea. Bottoms in faint
        pixels have larger errors than the median, and are not found where these could be mistaken for echoes: see
        ``hidden``.
    max_time
        Time after which no sea is rendered [s], above 0; the first one always is. All numbers for omitted seas are NaN,
        and the attribute ``seas_left_out`` has their number.

    Returns
    -------
    xarray.Dataset
        Over ``off_nadir_deg``, ``wind_speed``, ``water``, ``depth``, ``estimator`` and ``pixel``, where ``wind_speed``
        is 0 for each entry of the coordinate ``ripples`` [m/s], and equals it in seas with waves: ``bias``, ``spread``,
        ``found``, ``noise_error``, ``error``, ``z`` and ``wrong`` from `summarize_depths`; with `corrections` also
        ``corrected_bias``, ``corrected_spread`` and ``corrected_z``; and the shares of shots ``flagged`` with a depth,
        ``bright`` with a signal-to-noise ratio above 10 at the bottom, ``bright_found`` with a depth among these, and
        ``hidden``, bright ones without a depth that have one where render errors do not count as noise. Without
        estimator: ``snr``; without estimator and pixel: ``slope_along`` and ``slope_across``, root mean squares of the
        mean slopes in the beam, and the measured ``attenuation`` [1/m], NaN in columns that are too short. The truth is
        the bottom depth below the mean surface in the beam.

    Raises
    ------
    UserError
        If the instrument is unknown or not green, a number or parameter is out of range, or the receiver counts photons
        and has less than one count in the brightest sample of a record.
    KeyboardInterrupt
        If a render was interrupted.
    """
    own = read_instrument(instrument)
    former = None if corrections is None else corrections_for(instrument, corrections)
    if former is not None:
        check_surface(former, infrared)
    values = {one.name: one.value for one in own.parameters}
    if not is_green(laser := float(values["wavelength_nm"])):
        raise UserError(f"instrument = {instrument!r} has wavelength_nm = {laser:g}: depth errors are of green light")
    usual = float(values["off_nadir_deg"])
    other = usual + (_FURTHER if usual < _GRAZING else -_FURTHER)
    axes = {
        "off_nadir_deg": np.asarray(sorted((usual, other)) if angles_deg is None else angles_deg, float),
        "wind_speed": np.asarray(winds, float),
        "water": np.asarray(waters, dtype=str),
        "depth": np.asarray(depths, float),
    }
    of_level = np.asarray(ripples, float)
    waves = axes["wind_speed"][axes["wind_speed"] > 0]
    if waves.size < axes["wind_speed"].size:
        axes["wind_speed"] = np.concatenate([np.zeros_like(of_level), waves])
        waves = np.concatenate([of_level, waves])
    cells: dict[tuple[int, ...], dict[str, Any]] = {}
    pixels: list[str] = []
    geometry: dict[str, float] = {}
    places = list(np.ndindex(*(values.size for values in axes.values())))
    seas = Cases(places, "seas", max_time=max_time, progress=progress)
    for place in seas:
        angle, wind, water, depth = (values[index] for values, index in zip(axes.values(), place, strict=True))
        shallower = [cells[(*place[:3], index)] for index in range(place[3]) if (*place[:3], index) in cells]
        seen = [bool(np.any(cell["found"] > 0)) for cell in shallower]
        if not any(seen) or seen[-1]:
            given = {
                "wavelength_nm": _WAVELENGTH,
                **(params or {}),
                "off_nadir_deg": float(angle),
                "wind_speed": float(waves[place[1]]),
                "jerlov": str(water),
                "bottom_depth": float(depth),
                "surface_seed": seed + seas.begun - 1,
                **({} if wind else {"spectrum": "flat"}),
            }
            options: dict[str, Any] = {"count": shots} if wind else {"positions": [(0.0, 0.0)] * shots}
            options |= {"instrument": instrument, "infrared": infrared, "seed": seed, "first_seed": seed}
            error = target_error * (1 if wind else _LEVEL)
            rendered = seas.keep(render_shots(scene, given, target_error=error, **options))
            # Troughs may leave a shallow bottom dry.
            wet = np.isfinite(rendered["true_bottom_depth_below_surface"].values)
            if not wet.all():
                _LOG.warning("%d of %d shots find the bottom at %g m dry", np.count_nonzero(~wet), wet.size, depth)
            if wet.any():
                recorded = detect_waveforms(rendered.isel(shot=wet), receiver or instrument, records, seed)
                _check_counts(recorded)
                cells[place] = _cell(recorded, estimators, former)
                pixels = [str(name) for name in recorded["pixel"].values]
                geometry = {name: float(recorded.attrs[name]) for name in _GEOMETRY if name in recorded.attrs}
        seas.step()
    if not cells:
        raise UserError(f"depth = {axes['depth'].tolist()} must hold one below the waves of {winds} m/s")
    attributes = {
        "title": f"Errors of the depths of {instrument}",
        "source": release(),
        "instrument": instrument,
        "receiver": receiver or instrument,
        "infrared_surface": int(infrared),
        "scene": scene,
        "parameters": json.dumps({name: str(value) for name, value in (params or {}).items()}),
        "shots": shots,
        "records": records,
        "target_error": target_error,
        "level_renders": shots,
        "seed": seed,
        "seas_left_out": seas.left_out,
        **geometry,
    }
    found = _labelled(axes, cells, pixels, list(estimators), attributes, seas.begun)
    return label(found.assign_coords(ripples=("wind_speed", waves)))


def describe_depth_bias(found: xr.Dataset) -> list[str]:
    """Return table lines for the estimator ``gaussian`` in a result of `depth_bias`, in centimetres."""
    columns = [("angle", ">6.1f"), ("wind", ">6g"), ("ripples", ">9g"), (" water", "<7"), ("depth", ">6g")]
    columns += [(" channel", "<11"), ("SNR", ">7.1f"), ("found", ">7"), (">10", ">7"), ("hidden", ">8")]
    columns += [("flagged", ">9"), ("bias", ">8.1f"), ("spread", ">8.1f"), ("error", ">8.1f"), ("z", ">6.2f")]
    columns += [("wrong", ">7"), ("bias", ">10.1f"), ("spread", ">8.1f"), ("z", ">6.2f")]
    rows = []
    for place in np.ndindex(*(found.sizes[axis] for axis in AXES)):
        at = found.sel(estimator="gaussian").isel(dict(zip(AXES, place, strict=True)))
        if np.isnan(at["found"].values).all():  # left out
            continue
        for pixel in found["pixel"].values:
            cell = at.sel(pixel=pixel)
            own = {name: float(cell[name]) for name in cell.data_vars if cell[name].ndim == 0}
            share = {name: f"{100 * value:.0f} %" if math.isfinite(value) else "-" for name, value in own.items()}
            row = [*(float(at[name]) for name in ("off_nadir_deg", "wind_speed", "ripples")), f" {at['water'].item()}"]
            row += [float(at["depth"]), f" {pixel}", own["snr"], f"{100 * own['found']:.0f} %", share["bright_found"]]
            row += [share["hidden"], share["flagged"], *(100 * own[name] for name in ("bias", "spread", "error"))]
            row += [own["z"], f"{100 * own['wrong']:.1f} %"]
            if "corrected_bias" in own:
                row += [100 * own["corrected_bias"], 100 * own["corrected_spread"], own["corrected_z"]]
            rows.append(row)
    return table_lines(columns if "corrected_bias" in found else columns[:-3], rows)


def _check_counts(recorded: xr.Dataset) -> None:
    """Refuse records of photon counters in which the brightest sample has less than one count on average."""
    brightest = float(recorded["signal_mean"].max())
    counts = recorded["signal"].attrs["units"] == "1" and float(recorded["event_height"].max()) > 0
    if counts and brightest < 1:
        raise UserError(
            f"receiver = {recorded.attrs['receiver']!r} must give at least 1 count in the brightest sample of a "
            f"record, but gives {brightest:.2g}: single photons are no waveform to measure a depth in"
        )


def _cell(recorded: xr.Dataset, estimators: Sequence[str], corrections: xr.Dataset | None) -> dict[str, Any]:
    """Return the numbers of one sea, over estimator and pixel, or pixel, or without dimensions."""
    truth = recorded["true_bottom_depth_below_surface"].values
    found = extract(recorded, list(estimators), targets=1)
    numbers: dict[str, Any] = dict(summarize_depths(found, truth))
    if corrections is not None:
        after = summarize_depths(correct_depths(found, corrections), truth)
        numbers |= {f"corrected_{name}": after[name] for name in ("bias", "spread", "z")}
    numbers["attenuation"] = usual_attenuation(found["attenuation"].values, found["attenuation_stderr"].values)
    depth = (recorded["time"] - recorded["surface_time"]) * recorded["depth_per_ns"]
    near = np.abs(depth - float(np.mean(truth))) < _NEAR
    largest = recorded["snr"].where(near).max("time").transpose("shot", "pixel")
    numbers["snr"] = largest.median("shot").values
    return numbers | rms_slopes(recorded) | _shares(recorded, found, truth, largest.values > _BRIGHT)


def rms_slopes(recorded: xr.Dataset) -> dict[str, float]:
    """Return root mean squares of the mean slopes in the beam [1], along and across, by their names."""
    names = ("slope_along", "slope_across")
    return {name: float(np.sqrt(np.mean(recorded[f"true_{name}"].values ** 2))) for name in names}


def _shares(recorded: xr.Dataset, found: xr.Dataset, truth: FloatArray, bright: BoolArray) -> dict[str, FloatArray]:
    """Return the shares of shots whose bottom is flagged, bright, bright and found, and hidden by errors of the render.

    Bright shots and pixels are of the shape (shots, pixels); shares are over estimator and pixel.
    """

    def with_depth(echoes: xr.Dataset) -> tuple[FloatArray, npt.NDArray[np.intp]]:
        bottom = echoes.sel(echo="bottom").transpose("shot", "pixel", "estimator")
        flags = bottom["flags"].values
        return np.where(has_echo(flags), bottom["depth_m"].values, np.nan), flags

    wanted = bright[..., np.newaxis]
    depth, flags = with_depth(found)
    known = np.isfinite(depth)
    hidden = np.zeros(known.shape, dtype=bool)
    if "signal_mean_stderr" in recorded and (wanted & ~known).any():
        exact, _ = with_depth(extract(recorded.drop_vars("signal_mean_stderr"), found["estimator"].values.tolist()))
        hidden = wanted & ~known & (np.abs(exact - truth[:, np.newaxis, np.newaxis]) < _RIGHT)
    share = np.broadcast_to(wanted, known.shape).mean(axis=0)
    of_bright = np.divide((wanted & known).mean(axis=0), share, out=np.full(share.shape, np.nan), where=share > 0)
    flagged = known & (flags != 0)
    means = {"flagged": flagged.mean(axis=0), "bright": share, "bright_found": of_bright, "hidden": hidden.mean(axis=0)}
    return {name: values.T for name, values in means.items()}


def _labelled(
    axes: Mapping[str, Any],
    cells: Mapping[tuple[int, ...], Mapping[str, Any]],
    pixels: Sequence[str],
    estimators: Sequence[str],
    attributes: Mapping[str, Any],
    begun: int,
) -> xr.Dataset:
    """Return the table for all seas, of which the first `begun` were rendered or need not be."""
    shape = tuple(values.size for values in axes.values())

    def table(name: str) -> Any:
        first = np.asarray(next(iter(cells.values()))[name])
        values = np.full((*shape, *first.shape), 0.0 if name in _ZERO else np.nan)
        for place, cell in cells.items():
            values[place] = cell[name]
        values.reshape(-1, *first.shape)[begun:] = np.nan
        return values

    data: dict[str, Any] = {}
    for name in _NUMBERS:
        if name in next(iter(cells.values())):
            dims = (*AXES, "pixel") if name == "snr" else (*AXES, "estimator", "pixel")
            data[name] = (dims, table(name))
    # Root mean squares of slopes, under the names of the shots' truth.
    for name in ("slope_along", "slope_across", "attenuation"):
        data[name] = (AXES, table(name))
    coords: dict[str, Any] = dict(axes)
    coords |= {"estimator": list(estimators), "pixel": list(pixels)}
    return label(xr.Dataset(data, coords, dict(attributes)), "bias")


#: Parameters of uncertainties.
Pointing = Annotated[float, Option("Standard deviation of the beam direction, each axis", 0)]
PositionError = Annotated[float, Option("Standard deviation of the horizontal position, each axis", 0)]
HeightError = Annotated[float, Option("Standard deviation of the sea surface height", 0)]

#: Wind whose ripples a level sea has [m/s].
RIPPLES = 5.0

#: Winds [m/s] and waters in the tables for uncertainty tools, and depths at which airborne lidars find the bottom.
_SURVEY_WINDS, _SURVEY_DEPTHS = (1.0, 3.0, 5.0, 7.0, 9.0), (1.0, 1.5, 3.0, 6.0, 10.0)
_SURVEY_WATERS = ("III", "1C", "3C", "5C", "7C", "9C")


@checked
def tpu(
    instrument: InstrumentName,
    params: Mapping[str, Any] | None = None,
    *,
    altitudes: Annotated[
        Numbers | None, rising("Lidar heights above the sea; by default the instrument's", "m", above=True)
    ] = None,
    angles_deg: Annotated[
        Numbers | None, rising("Angles from nadir; by default the instrument's", "degrees", flag="--angles")
    ] = None,
    winds: Winds = _SURVEY_WINDS,
    waters: Waters = _SURVEY_WATERS,
    depths: Depths = _SURVEY_DEPTHS,
    scene: SeaScene = "table1",
    receiver: OwnReceiver = None,
    infrared: Infrared = False,
    estimator: Annotated[str, Option("Depth estimator, as for echoes", form="|".join(ESTIMATORS))] = "gaussian",
    shots: Places = 12,
    records: Records = 4,
    corrections: Annotated[
        Given | None,
        Option("Table from depth-bias that also corrects the depths, auto for the shipped one, or none", form="FILE"),
    ] = "auto",
    pointing_mrad: Pointing = 0.1,
    position_m: PositionError = 0.05,
    height_m: HeightError = 0.05,
    max_time: SeaTime = None,
    seed: SeaSeed = 1,
    progress: ProgressCallback | None = None,
) -> xr.Dataset:
    """Determine an instrument's sounding uncertainties at each altitude, angle, wind, water and depth.

    Parameters
    ----------
    params, scene
        As for `depth_bias.depth_bias`.
    infrared
        As of `depth_bias.depth_bias`; ``auto`` corrections then are none.
    max_time
        Time after which no sea is rendered [s], above 0. Uncertainties for omitted seas are NaN; altitudes without any
        rendered sea are left out. The attribute ``seas_left_out`` has the number of both.

    Returns
    -------
    xarray.Dataset
        As from `sounding_uncertainty`, with the dimension ``altitude`` in front.

    Raises
    ------
    UserError
        If the instrument or estimator is unknown, or a number or parameter is out of range.
    """
    usual = {one.name: one.value for one in read_instrument(instrument).parameters}
    given = dict(params or {})
    own = [finite("altitude", given.get("altitude", usual["altitude"]))]
    heights = np.asarray(own if altitudes is None else altitudes, float)
    if corrections is not None:
        # Shipped tables are of surfaces from green light.
        unwanted = isinstance(corrections, str) and corrections in ("none", "auto" if infrared else "none")
        corrections = None if unwanted else corrections_for(instrument, corrections)
    trajectory = TrajectoryErrors(pointing_mrad, position_m, height_m)
    angles = [float(usual["off_nadir_deg"])] if angles_deg is None else angles_deg
    found: list[xr.Dataset] = []
    cases = Cases(heights.tolist(), "altitudes", unit="cell", max_time=max_time, progress=progress)
    for height in cases:
        options: dict[str, Any] = {"scene": scene, "receiver": receiver, "infrared": infrared, "seed": seed}
        options |= {"angles_deg": angles, "winds": winds, "ripples": [RIPPLES], "waters": waters, "depths": depths}
        options |= {"estimators": [estimator], "shots": shots, "records": records, "corrections": corrections}
        at_height = {**given, "altitude": height}
        table = depth_bias(instrument, at_height, max_time=cases.left, progress=cases.step, **options)
        found.append(sounding_uncertainty(cases.keep(table), trajectory))
    joined = xr.concat(found, "altitude", combine_attrs="drop_conflicts")
    seas = math.prod(found[0].sizes[axis] for axis in AXES)
    left_out = sum(one.attrs["seas_left_out"] for one in found) + cases.left_out * seas
    rendered = ("altitude", heights[: len(found)], described("altitude"))
    return joined.assign_coords(altitude=rendered).assign_attrs(estimator=estimator, seas_left_out=left_out)


def describe_tpu(found: xr.Dataset) -> list[str]:
    """Return table lines for a result of `tpu`, one for each water and wind.

    TVU at 95 % at each depth [cm], corrected if there are corrections, with the order met, and a [cm] and b [%] of the
    fit at one standard deviation, with its root mean square residual [cm].
    """
    one = found.isel(correction=-1)
    names = [*(order.name for order in SURVEY_ORDERS), "none"]
    heads = "".join(f"{f'{depth:g} m':>7}{'':10}" for depth in one["depth"].values)
    lines = [f"{'altitude':>8}{'angle':>7}{'wind':>6} {'water':<6}{heads}{'a':>8}{'b':>7}{'residual':>10}"]
    for place in np.ndindex(*(one.sizes[axis] for axis in ("altitude", "off_nadir_deg", "wind_speed", "water"))):
        cell = one.isel(dict(zip(("altitude", "off_nadir_deg", "wind_speed", "water"), place, strict=True)))
        text = f"{float(cell['altitude']):>8g}{float(cell['off_nadir_deg']):>7g}{float(cell['wind_speed']):>6g} "
        text += f"{cell['water'].item():<6}"
        for tvu, order in zip(cell["tvu"].values, cell["order"].values, strict=True):
            text += f"{100 * tvu:>7.1f} {names[order]:<9}" if order >= 0 else f"{'-':>7}{'':10}"
        residual = np.sqrt((cell["vertical_residual"] ** 2).mean())
        text += "".join(f"{100 * float(cell[f'vertical_{name}']):>{8 - number}.2f}" for number, name in enumerate("ab"))
        lines.append(f"{text}{100 * float(residual):>10.2f}")
    if left_out := found.attrs.get("seas_left_out"):
        lines.append(f"- also stands for {left_out} seas that were left out by max_time")
    return lines
