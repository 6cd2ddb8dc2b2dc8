"""The command that reads slopes, bottom and water from a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli_support import numbers, require, require_writable, sentences
from mitransient_lidar.errors import UserError

_WATER = {"a": "absorption", "bb": "backscattering", "Kd": "kd", "c": "attenuation"}


def estimate(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Result in an EXR or NetCDF file.")],
    deviation: Annotated[
        str | None,
        typer.Option(
            "--slope-deviation",
            metavar="ALONG,ACROSS",
            help="Standard deviations of the sea's slopes: weighs with them.",
        ),
    ] = None,
    efficiency: Annotated[
        float | None, typer.Option(help="Of optics and air, two-way. Without it, that of the scene's parameters.")
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="NetCDF file for all estimates.")] = None,
) -> None:
    """Estimate the sea's slope, the bottom's depth and reflectivity, and the water, from the echoes of a result."""
    with sentences():
        prior = None
        if deviation is not None:
            prior = numbers("--slope-deviation", deviation)
            require(len(prior) == 2 and min(prior) > 0, "--slope-deviation", deviation, "two numbers above 0")
        if efficiency is not None:
            require(0 < efficiency <= 1, "--efficiency", efficiency, "above 0 and at most 1")
        if output is not None:
            if output.suffix != ".nc":
                raise UserError(f"--output {output} must end in .nc.")
            require_writable(output.parent, [output])

        from mitransient_lidar import estimates, results

        pair = None if prior is None else (prior[0], prior[1])
        found = estimates.estimate(results.open(source), slope_deviation=pair, efficiency=efficiency)
        for line in _lines(found):
            typer.echo(line)
        if output is not None:
            output.parent.mkdir(parents=True, exist_ok=True)
            with results.replacing(output) as temporary:
                found.to_netcdf(temporary, engine="h5netcdf")
            typer.echo(output)


def _lines(found: Any) -> list[str]:
    """Say in words what has been found."""
    import numpy as np

    value = {str(name): float(one) for name, one in found.data_vars.items() if one.ndim == 0}
    lines = []
    for name, positive in (("along", "a face towards the lidar"), ("across", "a rise to the left")):
        slope, error = value[f"slope_{name}"], value[f"slope_{name}_stderr"]
        text = "not told by these pixels" if np.isnan(slope) else f"{slope:+.4f} +- {error:.4f} (+ is {positive})"
        lines.append(f"slope {name}: {text}")
    height = value["surface_height"]
    lines.append("surface: no echo" if np.isnan(height) else f"surface: {height:+.3f} m from the mean level")
    lines += _bottom_lines(found["depth_m"].values, found)
    if "kd" not in value:
        return [*lines, "water: the view is too narrow to tell"]
    if np.isnan(value["kd"]):
        return [*lines, "water: no column that can be fitted"]
    lines.append("water (1/m): " + ", ".join(f"{name} {value[key]:.4g}" for name, key in _WATER.items()))
    low, high = value["attenuation_low"], value["attenuation_high"]
    return [*lines, f"c is a guess: {low:.2g} to {high:.2g} 1/m, as bb/b goes from 0.044 to 0.01"]


def _bottom_lines(depth: Any, found: Any) -> list[str]:
    import numpy as np

    if np.isnan(depth[0]):
        return ["bottom: no echo"]
    lines = [f"bottom: {depth[1]:.3f} m deep, {depth[0]:.3f} m through a level sea"]
    reflectivity = found["reflectivity"].values
    if np.isnan(reflectivity).all():
        return [*lines, "bottom reflectivity: no column that can be fitted"]
    text = ", ".join(f"{by} {rho:.4f}" for by, rho in zip(found["correction"].values, reflectivity, strict=True))
    shares = zip(found["bottom_class"].values, found["class_probability"].values, strict=True)
    classes = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares)
    return [*lines, f"bottom reflectivity: {text}", f"bottom class: {classes}"]


#: In the order in which the help lists them.
COMMANDS = (estimate,)
