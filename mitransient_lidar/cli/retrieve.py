"""The command that retrieves slopes, bottom and water from a result."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, write_netcdf
from mitransient_lidar.cli.messages import name_subject
from mitransient_lidar.cli.options import pair
from mitransient_lidar.core.errors import UserError

_MOST_SHOTS = 200  # of a printed table
_WATER = {"a": "absorption", "bb": "backscattering", "Kd": "kd"}


def retrieve(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result: one shot or a series of shots.")
    ],
    slope_deviation: Annotated[
        str | None,
        typer.Option(
            metavar="ALONG,ACROSS",
            help="Standard deviations of the slopes of an unknown sea, greater than 0; by default those of a series.",
        ),
    ] = None,
    wind_speed: Annotated[
        float | None,
        typer.Option(metavar="M/S", help="Wind speed over the sea, 1 to 30; by default that of the scene."),
    ] = None,
    wind_direction_deg: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Direction that the wind blows towards, from +x, any angle."),
    ] = None,
    efficiency: Annotated[
        float | None, typer.Option(help="Two-way efficiency of optics and air, 0 to 1; by default that of the scene.")
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="NetCDF file for all estimates.")] = None,
    figure: Annotated[
        Path | None, typer.Option(help="PNG, PDF or SVG file of a series: estimates against the truth.")
    ] = None,
) -> None:
    """Retrieve slopes, bottom and water from a result.

    Estimates the sea's slope, the bottom's depth and reflectance, and the water's attenuation from the echoes of FILE;
    of a series, those of each shot beside the truth.
    """
    deviations = None if slope_deviation is None else pair("--slope-deviation", slope_deviation)
    if output is not None:
        check_suffix("--output", output, ".nc")
    check_figure(figure, option="--figure")
    from mitransient_lidar import results
    from mitransient_lidar.analysis.retrieval.retrieve import retrieve as retrieve_from

    dataset = results.dataset_of("FILE", file, "result")
    if figure is not None and "true_slope_along" not in dataset.coords:
        raise UserError(f"--figure {figure} needs a series of shots with true slopes, but {file} is none.")
    found = retrieve_from(
        dataset,
        wind_speed=wind_speed,
        wind_direction_deg=wind_direction_deg,
        slope_deviation=deviations,
        efficiency=efficiency,
    )
    name_subject(file, dataset.attrs)
    for line in _table(found) if "shot" in found.dims else _lines(found):
        typer.echo(line)
    if output is not None:
        write_netcdf(found, output)
    if figure is not None:
        from mitransient_lidar.plots.retrieval import plot_retrieval

        figure.parent.mkdir(parents=True, exist_ok=True)
        with announced():
            plot_retrieval(found, figure)


def _table(found: Any) -> list[str]:
    """Return a line for each shot of a series, with the truth if known, and lines that compare both."""
    from mitransient_lidar.plots.retrieval import estimates, truth_statistics

    columns = estimates(found)
    numbers = found["shot"].values if "shot" in found.coords else range(found.sizes["shot"])
    line = f"{'shot':>5}"
    for one in columns:
        line += f"{one.head:>18}" + (f"{'true':>9}" if one.truth is not None else "")
    lines = [line]
    for place, number in list(enumerate(numbers))[:_MOST_SHOTS]:
        line = f"{number:>5}"
        for one in columns:
            line += f"{_with_error(one.values[place], one.errors[place]):>18}"
            line += f"{one.truth[place]:>9.3f}" if one.truth is not None else ""
        lines.append(line)
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
    from mitransient_lidar.analysis.retrieval.column_retrieval import BACKSCATTER_RATIOS

    least, most = BACKSCATTER_RATIOS
    c = f"c {value['attenuation']:.3g}, {low:.2g} to {high:.2g} for particles of bb/b from {most:g} to {least:g}"
    return [*lines, f"water (1/m): {water}", f"attenuation (1/m): {c}"]


def _bottom_lines(found: Any) -> list[str]:
    from mitransient_lidar.analysis.retrieval.bottom_errors import REASONS, ReflectanceFlag

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
