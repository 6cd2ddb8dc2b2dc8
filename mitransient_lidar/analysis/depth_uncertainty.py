"""Sounding uncertainties from depth errors, waves, pointing and position, and the survey orders that they meet."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms.depth_correction import AXES
from mitransient_lidar.core.tables.written import write_csv
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.lidar.level_sea import snell, turn_by_slope
from mitransient_lidar.results.attributes import described
from mitransient_lidar.results.geometry import required_number

#: Smallest share of shots with a depth for which a cell has an uncertainty.
LEAST_FOUND = 0.5

#: Names in the dimension ``correction``: depths as measured, and corrected by a table of mean errors.
CORRECTIONS = ("none", "table")

#: Standard deviations to the 95 % limits of a normal error, in one dimension and for a circle in two.
VERTICAL_95, HORIZONTAL_95 = 1.96, 2.45


@dataclass(frozen=True)
class SurveyOrder:
    """Largest uncertainties in an order of hydrographic surveys, at the 95 % confidence level."""

    name: str
    vertical: tuple[float, float]  #: a [m] and b [1] of TVU = sqrt(a^2 + (b d)^2) at the depth d.
    horizontal: tuple[float, float]  #: Constant [m] and share of the depth [1] in THU, whose sum counts.

    def largest_tvu(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the largest total vertical uncertainty [m] at depths [m]."""
        return np.asarray(np.hypot(self.vertical[0], self.vertical[1] * np.asarray(depth, dtype=np.float64)))

    def largest_thu(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the largest total horizontal uncertainty [m] at depths [m]."""
        return np.asarray(self.horizontal[0] + self.horizontal[1] * np.asarray(depth, dtype=np.float64))


#: Orders from the strictest on: IHO Standards for Hydrographic Surveys, S-44, edition 6.1.0 (2022), table 1. Orders 1a
#: and 1b differ in coverage and in the features to be detected only.
SURVEY_ORDERS = (
    SurveyOrder("exclusive", (0.15, 0.0075), (1.0, 0.0)),
    SurveyOrder("special", (0.25, 0.0075), (2.0, 0.0)),
    SurveyOrder("1a/1b", (0.5, 0.013), (5.0, 0.05)),
    SurveyOrder("2", (1.0, 0.023), (20.0, 0.1)),
)


def order_met(depth: npt.ArrayLike, tvu: npt.ArrayLike, thu: npt.ArrayLike) -> IntArray:
    """Return the strictest order that total vertical and horizontal uncertainties at 95 % [m] meet at depths [m].

    It is the place in `SURVEY_ORDERS`, their number where no order is met, and -1 where an uncertainty is NaN. Shapes
    broadcast.
    """
    d, vertical, horizontal = np.broadcast_arrays(*(np.asarray(one, dtype=np.float64) for one in (depth, tvu, thu)))
    met = [(vertical <= one.largest_tvu(d)) & (horizontal <= one.largest_thu(d)) for one in SURVEY_ORDERS]
    place = np.argmax([*met, np.ones_like(met[0])], axis=0)
    return np.where(np.isfinite(vertical + horizontal), place, -1)


class TrajectoryErrors(NamedTuple):
    """Standard deviations of a survey trajectory's errors, by default a good inertial system's."""

    pointing_mrad: float = 0.1  #: Beam direction on either axis [mrad]: attitude, boresight and scanner.
    position_m: float = 0.05  #: Horizontal position on either axis [m].
    height_m: float = 0.05  #: Sea surface height [m]: position, range and datum.


def shift_by_slope(off_nadir: float, n: float) -> tuple[float, float]:
    """Return the horizontal shifts of a bottom point by a sea slope that is assumed to be level.

    They are per depth and slope [1], in the line of sight and across it, to first order. Arguments are the beam angle
    from the vertical [rad] and the water's refractive index.
    """
    turn, cos_water = float(turn_by_slope(off_nadir, n)), float(np.cos(snell(off_nadir, n)))
    return turn / cos_water**2, turn


def shift_by_pointing(off_nadir: float, height: float, depth: FloatArray, n: float) -> tuple[FloatArray, ...]:
    """Return the shifts of a bottom point at measured ranges by an error in the beam's direction.

    They are in the line of sight, across it and vertically [m/rad], in the shape of the bottom depths [m], to first
    order. An error in the angle from nadir causes the first and the last, an error across it the second. The beam angle
    is from the vertical [rad], and the lidar's height above the sea [m].
    """
    water = float(snell(off_nadir, n))
    cos_air, cos_water = float(np.cos(off_nadir)), float(np.cos(water))
    turned = cos_air / (n * cos_water)  # angle in the water per angle in air
    along = height / cos_air**2 + depth * turned / cos_water**2
    across = height / cos_air + depth / (n * cos_water)
    up = height * np.tan(off_nadir) + depth * turned * np.tan(water)
    return along, across, up


def sounding_uncertainty(table: xr.Dataset, trajectory: TrajectoryErrors | None = None) -> xr.Dataset:
    """Return the sounding uncertainties for one estimator at one altitude, and their fits.

    `table`: from `studies.depth_bias.depth_bias`, of one estimator; with the attributes ``altitude`` [m],
    ``refractive_index`` and ``divergence_mrad``. `trajectory`: trajectory errors of the survey.

    Returns
    -------
    xarray.Dataset
        Over ``off_nadir_deg``, ``wind_speed``, ``water`` and ``depth``, with ``correction`` in front for measured and,
        if the table has them, corrected depths: ``subaqueous_vertical``, ``tvu``, ``thu`` and ``order``; for both the
        same ``subaqueous_horizontal``, ``stated``, ``found`` and ``channel``; and without ``depth`` the fits
        ``vertical_a`` and ``vertical_b``, ``horizontal_a`` and ``horizontal_b``, with ``vertical_residual`` over all.
        All but ``found`` are NaN (-1 for ``order``, an empty ``channel``) where fewer than half the shots have a depth.
        Fits are NaN where no depth remains; a single depth gives a constant fit.

    Notes
    -----
    ``subaqueous_vertical`` is the root mean square error of depths below the sea in the beam, sqrt(bias^2 + spread^2).
    It is taken over shots on all waves at a wind, for the channel with the smallest. ``subaqueous_horizontal`` combines
    two parts. One is the refraction by the mean slopes in the beam, which a survey assumes to be level (pooled over
    waters and depths at a wind). The other is the beam's standard deviation on the sea. ``tvu`` is 1.96 times, ``thu``
    2.45 times the root of the summed squares of these and of the trajectory errors. Horizontal errors are means over
    both axes.
    """
    trajectory = trajectory or TrajectoryErrors()
    one = table.isel(estimator=0, drop=True).transpose(*AXES, "pixel", ...)
    measured = _root(one["bias"], one["spread"]).where(one["found"] >= LEAST_FOUND)
    best = measured.fillna(np.inf).argmin("pixel")
    known = measured.notnull().any("pixel")
    parts = [measured]
    if "corrected_bias" in one:
        parts.append(_root(one["corrected_bias"], one["corrected_spread"]))
    vertical = xr.concat([part.isel(pixel=best).where(known) for part in parts], "correction")
    vertical = vertical.assign_coords(correction=list(CORRECTIONS[: len(parts)])).drop_vars("pixel")
    horizontal = _subaqueous_horizontal(one, table.attrs).where(known)
    tvu, thu = _totals(vertical, horizontal, table.attrs, trajectory)
    depth = one["depth"].broadcast_like(tvu).transpose(*tvu.dims)
    data: dict[str, Any] = {
        "subaqueous_vertical": vertical,
        "subaqueous_horizontal": horizontal,
        "stated": one["error"].isel(pixel=best).where(known).drop_vars("pixel"),
        "tvu": tvu,
        "thu": thu,
        "order": (tvu.dims, order_met(depth.values, tvu.values, thu.broadcast_like(tvu).transpose(*tvu.dims).values)),
        "channel": one["pixel"].isel(pixel=best).where(known, "").drop_vars("pixel").astype(str),
        "found": one["found"].max("pixel"),
    }
    data |= _fits(vertical, horizontal)
    found = xr.Dataset(data).transpose("correction", *AXES)
    for name in found.data_vars:
        found[name].attrs = described(str(name))
    found["order"].attrs |= {
        "flag_values": np.arange(-1, len(SURVEY_ORDERS) + 1),
        "flag_meanings": " ".join(["unknown", *(one.name for one in SURVEY_ORDERS), "none"]),
    }
    title = f"Uncertainties of the soundings of {table.attrs['instrument']}"
    return found.assign_attrs({**table.attrs, **trajectory._asdict(), "title": title})


def non_negative_line(x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[float, float]:
    """Return the least-squares line's intercept and slope, both at least 0.

    NaN among `y` are left out. Without any other both are NaN, and for a single x the line is constant. With two
    unknowns the solution is the unconstrained one, the proportional one, or the constant one.
    """
    values: FloatArray = np.asarray(y, dtype=np.float64)
    known = np.isfinite(values)
    x, y = np.asarray(x, dtype=np.float64)[known], values[known]
    if not x.size:
        return math.nan, math.nan
    if np.ptp(x) == 0:
        return max(float(y.mean()), 0.0), 0.0
    slope = float(np.sum((x - x.mean()) * y) / np.sum((x - x.mean()) ** 2))
    intercept = float(y.mean() - slope * x.mean())
    if intercept < 0:
        intercept, slope = 0.0, float(np.sum(x * y) / np.sum(x**2))
    if slope < 0:
        intercept, slope = max(float(y.mean()), 0.0), 0.0
    return intercept, slope


def write_fits(found: xr.Dataset, part: str, path: str | os.PathLike[str]) -> None:
    """Write the fits, ``vertical`` or ``horizontal``, of one altitude, angle and correction for uncertainty tools.

    They are from `sounding_uncertainty`. The CSV file has the columns Wind, JerlovType, a and b, in m and per metre of
    depth, one standard deviation. Rows are by wind [m/s] and then by water, nan where there is no fit.
    """
    fits = {f"{part}_{name}": name for name in "ab"}
    frame = found[[*fits]].to_dataframe(["wind_speed", "water"]).reset_index()
    frame = frame.rename(columns={"wind_speed": "Wind", "water": "JerlovType", **fits})
    write_csv(frame[["Wind", "JerlovType", "a", "b"]], path, digits=6, unknown="nan")


def _subaqueous_horizontal(table: xr.Dataset, attributes: Any) -> xr.DataArray:
    """Return the standard deviation of the place on the bottom by waves and footprint [m], mean of both axes."""
    index = required_number(attributes, "refractive_index")
    beam = 0.5e-3 * required_number(attributes, "divergence_mrad") * required_number(attributes, "altitude")
    angles = np.radians(table["off_nadir_deg"].values)
    per_slope = np.array([shift_by_slope(float(angle), index) for angle in angles])
    square = xr.zeros_like(table["found"].isel(pixel=0, drop=True))
    for axis, name in enumerate(("slope_along", "slope_across")):
        shift = table["off_nadir_deg"].copy(data=per_slope[:, axis])
        on_sea = table["off_nadir_deg"].copy(data=beam / np.cos(angles) ** (2 - axis))
        slopes = (table[name] ** 2).mean(("water", "depth"))
        square = square + 0.5 * ((shift * table["depth"]) ** 2 * slopes + on_sea**2)
    return (square**0.5).transpose(*AXES)


def _root(*parts: xr.DataArray) -> xr.DataArray:
    """Return the root of the sum of squares."""
    square = parts[0] ** 2
    for part in parts[1:]:
        square = square + part**2
    return square**0.5


def _totals(
    vertical: xr.DataArray, horizontal: xr.DataArray, attributes: Any, trajectory: TrajectoryErrors
) -> tuple[xr.DataArray, xr.DataArray]:
    """Return total vertical and horizontal uncertainties at 95 % [m]."""
    height, index = (required_number(attributes, name) for name in ("altitude", "refractive_index"))
    depth: FloatArray = vertical["depth"].values
    angles = np.radians(vertical["off_nadir_deg"].values)
    # Shape (axis, angle, depth).
    shifts = np.array([shift_by_pointing(float(one), height, depth, index) for one in angles]).transpose(1, 0, 2)
    shifts *= 1e-3 * trajectory.pointing_mrad
    along, across, up = (xr.DataArray(one, dims=("off_nadir_deg", "depth")) for one in shifts)
    tvu = VERTICAL_95 * (vertical**2 + up**2 + trajectory.height_m**2) ** 0.5
    thu = HORIZONTAL_95 * (horizontal**2 + 0.5 * (along**2 + across**2) + trajectory.position_m**2) ** 0.5
    return tvu.transpose(*vertical.dims), thu.transpose(*horizontal.dims)


def _fits(vertical: xr.DataArray, horizontal: xr.DataArray) -> dict[str, xr.DataArray]:
    """Return the coefficients of the fits against depth, and the residuals of the vertical one."""
    depth = vertical["depth"]

    def lines(x: xr.DataArray, y: xr.DataArray) -> Any:
        return xr.apply_ufunc(
            non_negative_line, x, y, input_core_dims=[["depth"]] * 2, output_core_dims=[[], []], vectorize=True
        )

    constant, by_depth = (one**0.5 for one in lines(depth**2, vertical**2))
    first, second = lines(depth, horizontal)
    return {
        "vertical_a": constant,
        "vertical_b": by_depth,
        "vertical_residual": vertical - _root(constant, by_depth * depth),
        "horizontal_a": first,
        "horizontal_b": second,
    }
