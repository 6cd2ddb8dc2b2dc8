"""Total vertical and horizontal uncertainty of an instrument's soundings, from renders over known bottoms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS, TrajectoryErrors, sounding_uncertainty
from mitransient_lidar.analysis.waveforms.depth_correction import AXES, corrections_for
from mitransient_lidar.analysis.waveforms.echo_table import ESTIMATORS
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Infrared, Numbers, Option, checked
from mitransient_lidar.core.validation import finite
from mitransient_lidar.loading.instruments import read_instrument
from mitransient_lidar.rendering.passes import ProgressCallback
from mitransient_lidar.results.files import Given
from mitransient_lidar.results.variables import described
from mitransient_lidar.studies.cases import Cases
from mitransient_lidar.studies.depth_bias import (
    Depths,
    InstrumentName,
    OwnReceiver,
    Places,
    Records,
    SeaScene,
    SeaSeed,
    SeaTime,
    Waters,
    Winds,
    depth_bias,
    rising,
)

#: Parameters of uncertainties.
Pointing = Annotated[float, Option("Standard deviation of the beam direction, each axis", 0)]
PositionError = Annotated[float, Option("Standard deviation of the horizontal position, each axis", 0)]
HeightError = Annotated[float, Option("Standard deviation of the sea surface height", 0)]

#: Wind whose ripples a level sea has [m/s].
RIPPLES = 5.0

#: Winds [m/s] and waters in the tables for uncertainty tools, and depths at which airborne lidars find the bottom.
WINDS, WATERS, DEPTHS = (1.0, 3.0, 5.0, 7.0, 9.0), ("III", "1C", "3C", "5C", "7C", "9C"), (1.0, 1.5, 3.0, 6.0, 10.0)


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
    winds: Winds = WINDS,
    waters: Waters = WATERS,
    depths: Depths = DEPTHS,
    scene: SeaScene = "table1",
    receiver: OwnReceiver = None,
    infrared: Infrared = False,
    estimator: Annotated[str, Option("Depth estimator, as for echoes")] = "gaussian",
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
    if estimator not in ESTIMATORS:
        raise UserError(f"estimator = {estimator!r} must be one of {', '.join(ESTIMATORS)}")
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
