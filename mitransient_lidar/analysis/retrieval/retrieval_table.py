"""Lines that show the results of `retrieve`: for a single shot, and for a series beside the truth."""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.retrieval.bottom_errors import REASONS, ReflectanceFlag
from mitransient_lidar.analysis.retrieval.column_retrieval import BACKSCATTER_RATIOS
from mitransient_lidar.core.tables.written import table_lines
from mitransient_lidar.core.validation import FloatArray

_MOST_SHOTS = 200  # in a table
_WATER = {"a": "absorption", "bb": "backscattering", "Kd": "kd"}


def describe_retrieval(found: xr.Dataset) -> list[str]:
    """Return lines for a result of `analysis.retrieval.retrieve.retrieve`."""
    return _table(found) if "shot" in found.dims else _lines(found)


class Estimate(NamedTuple):
    """An estimate over the shots of a series: heading with unit, values, standard errors and truth, if known."""

    head: str
    values: FloatArray
    errors: FloatArray
    truth: FloatArray | None


def estimates(found: xr.Dataset) -> list[Estimate]:
    """Return slopes, heights, depths and reflectances from a result of `analysis.retrieval.retrieve.retrieve`.

    The result is over ``shot``. Depths are below the mean sea level through the shot's slope, reflectances by the ratio
    to the column.
    """
    through_slope = found.sel(correction="slope")
    columns = {
        "slope along": ("slope_along", "true_slope_along"),
        "slope across": ("slope_across", "true_slope_across"),
        "height (m)": ("surface_height", "true_surface_height"),
        "depth (m)": ("depth_m", "true_bottom_depth"),
    }

    listed = [
        Estimate(
            head,
            through_slope[name].values,
            through_slope[f"{name}_stderr"].values,
            through_slope[truth].values if truth in through_slope else None,
        )
        for head, (name, truth) in columns.items()
    ]
    by_column = found.sel(correction="column")
    values, errors = (by_column[name].values for name in ("reflectance", "reflectance_stderr"))
    return [*listed, Estimate("reflectance", values, errors, None)]


def truth_statistics(one: Estimate) -> str:
    """Return a line with bias and scatter of an estimate about the truth; empty for fewer than 2 known shots."""
    if one.truth is None:
        return ""
    known = np.isfinite(one.values) & np.isfinite(one.truth)
    if np.count_nonzero(known) < 2:
        return ""
    error = one.values[known] - one.truth[known]
    text = f"{one.head}: bias {error.mean():+.3f}, rms error {np.sqrt(np.mean(error**2)):.3f}"
    if np.ptp(one.truth[known]) > 0 and np.ptp(one.values[known]) > 0:
        text += f", correlation {np.corrcoef(one.values[known], one.truth[known])[0, 1]:+.2f}"
    text += f", rms of error / standard error {np.sqrt(np.mean((error / one.errors[known]) ** 2)):.2f}"
    return f"{text}, {np.count_nonzero(known)} shots"


def _table(found: Any) -> list[str]:
    """Return a line for each shot of a series, with the truth if known, and lines that compare both."""
    columns = estimates(found)
    numbers = found["shot"].values if "shot" in found.coords else range(found.sizes["shot"])
    heads, cells = [("shot", ">5")], [numbers]
    for one in columns:
        heads.append((one.head, ">18"))
        cells.append(list(map(_with_error, one.values, one.errors)))
        if one.truth is not None:
            heads.append(("true", ">9.3f"))
            cells.append(one.truth)
    lines = table_lines(heads, itertools.islice(zip(*cells, strict=True), _MOST_SHOTS))
    if len(numbers) > _MOST_SHOTS:
        lines.append(f"{len(numbers) - _MOST_SHOTS} more shots: write them all with -o OUT.nc")
    return lines + [text for one in columns if (text := truth_statistics(one))]


def _with_error(value: float, error: float, form: str = ".3f") -> str:
    """Return a value with its error, or that it is not observable."""
    return (
        "not observable" if math.isnan(value) or math.isnan(error) else f"{value:{form}} +- {error:{form.lstrip('+')}}"
    )


def _lines(found: Any) -> list[str]:
    """Return lines that describe the estimates."""
    value = {str(name): float(one) for name, one in found.data_vars.items() if one.ndim == 0}
    lines = [f"slope from {found.attrs['slope_method']}"]
    for name, positive in (("along", "a face towards the lidar"), ("across", "a rise to the left")):
        known = f"{_with_error(value[f'slope_{name}'], value[f'slope_{name}_stderr'], '+.4f')} (+ is {positive})"
        unknown = "not observable with these pixels"
        if value["slope_refused"]:
            unknown = (
                f"refused, an estimate is steeper than {found.attrs['steepest_slope']:.2f}, beyond what the sea has"
            )
        lines.append(f"slope {name}: {unknown if math.isnan(value[f'slope_{name}']) else known}")
    height = value["surface_height"]
    known = f"surface: {_with_error(height, value['surface_height_stderr'], '+.3f')} m from the mean level"
    lines.append("surface: not observable, no echo" if math.isnan(height) else known)
    lines += _bottom_lines(found)
    if "kd" not in value:
        return [*lines, "water: not observable, the field of view is too narrow"]
    if math.isnan(value["kd"]):
        return [*lines, "water: not observable, no column that can be fitted"]
    water = ", ".join(
        f"{name} {_with_error(value[key], value[f'{key}_stderr'], '.3g')}" for name, key in _WATER.items()
    )
    low, high = value["attenuation_low"], value["attenuation_high"]
    least, most = BACKSCATTER_RATIOS
    c = f"c {value['attenuation']:.3g}, {low:.2g} to {high:.2g} for particles of bb/b from {most:g} to {least:g}"
    return [*lines, f"water (1/m): {water}", f"attenuation (1/m): {c}"]


def _bottom_lines(found: Any) -> list[str]:
    depth, error = found["depth_m"].values, found["depth_m_stderr"].values
    flags = int(found["reflectance_flags"])
    reasons = ", ".join(text for flag, text in REASONS.items() if flags & flag)
    if math.isnan(depth[0]):
        return [f"bottom: not observable, {reasons if flags & ReflectanceFlag.TARGET else 'no echo'}"]
    level, corrected = (f"{_with_error(*each)} m" for each in zip(depth[:2], error[:2], strict=True))
    lines = [f"bottom depth: {corrected}, {level} through a level sea"]
    if not found["depth_corrected"].values[1]:
        lines[0] += " (not corrected for the slope: it is known no better than the sea's slopes are)"
    if flags:
        return [*lines, f"bottom reflectance: not observable, {reasons}"]
    applied = [True, *found["reflectance_corrected"].values[1:]]
    estimates = (found[name].values for name in ("correction", "reflectance", "reflectance_stderr"))
    text = ", ".join(
        f"{by} {_with_error(rho, error)}" + ("" if known else " (not corrected)")
        for by, rho, error, known in zip(*estimates, applied, strict=True)
    )
    shares = zip(found["bottom_class"].values, found["class_probability"].values, strict=True)
    classes = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares)
    return [*lines, f"bottom reflectance: {text}", f"probability of the bottom's class: {classes}"]
