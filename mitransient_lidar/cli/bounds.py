"""Command that computes least errors of parameters, and compares designs by them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_figure, write_netcdf
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.cli.options import OUTPUT, RECEIVERS, Define, Quiet, Scene, Seed, number_or_auto, parameters
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import finite


def bounds(
    scene: Scene,
    free: Annotated[
        str, typer.Option(metavar="P1,P2,...", help="Unknown parameters, e.g. attenuation,bottom_reflectance.")
    ],
    define: Define = None,
    over: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=V1,V2,...",
            help="Values of a parameter of the scene to compare, separated by semicolons where they hold commas. "
            "Repeatable: all combinations count.",
        ),
    ] = None,
    receiver: Annotated[
        str | None,
        typer.Option(
            help=f"{RECEIVERS} Several, separated by commas, are compared. By default the instrument's, or apd."
        ),
    ] = None,
    gain: Annotated[
        str | None,
        typer.Option(
            metavar="FACTOR",
            help="Factor of the receiver's gain, greater than 0, or auto for the largest without saturation.",
        ),
    ] = None,
    optical_density: Annotated[
        str | None,
        typer.Option(
            metavar="DENSITY", help="Optical density of a filter, 0 to 12, or auto for the least without saturation."
        ),
    ] = None,
    background_power_w: Annotated[
        float, typer.Option(help="Power of the daylight on each pixel [W], at least 0.")
    ] = 0.0,
    nuisance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=STD]",
            help="Also unknown: time_offset [ns] or scale of the light [1], or known to a standard deviation. "
            "Repeatable.",
        ),
    ] = None,
    renders: Annotated[
        int, typer.Option(help="Independent renders of each design, 2 to 1000; 3 or more give errors.")
    ] = 4,
    passes: Annotated[int, typer.Option(help="Number of independent passes of each render, 2 to 100 000.")] = 16,
    max_time: Annotated[
        float | None,
        typer.Option(help="Begin no further design after this many seconds, and leave it out (greater than 0)."),
    ] = None,
    seed: Seed = 0,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; also writes the data as .nc and .csv.")
    ] = OUTPUT / "bounds.png",
    quiet: Quiet = False,
) -> None:
    """Compute the least errors of parameters from a shot, and rank designs.

    Cramer-Rao bounds: no unbiased estimate from the record of one shot, with the noise of a receiver, has a smaller
    standard deviation. Renders the scene with derivatives by the free parameters, for each combination of values.
    """
    unknown = [name.strip() for name in free.split(",")]
    if not all(unknown):
        raise UserError(f"--free = {free!r} has an empty entry: it must be names separated by commas")
    check_figure(output, ".nc", ".csv")
    designs = dict(_values(one) for one in over or [])
    if len(designs) < len(over or []):
        raise UserError("--over names a parameter twice: give all its values in one option")
    nuisances = dict(_nuisance(one) for one in nuisance or [])
    settings: dict[str, Any] = {
        name: None if text is None else number_or_auto(f"--{name.replace('_', '-')}", text)
        for name, text in (("gain", gain), ("optical_density", optical_density))
    }
    from mitransient_lidar.plots.studies.bounds import plot_bounds
    from mitransient_lidar.studies import bounds as study

    with reporting(quiet) as progress:
        found = study.bounds(
            scene,
            parameters(define),
            free=unknown,
            over=designs,
            receiver=None if receiver is None else [name.strip() for name in receiver.split(",")],
            background_power_w=background_power_w,
            nuisances=nuisances,
            renders=renders,
            passes=passes,
            max_time=max_time,
            seed=seed,
            progress=progress,
            **settings,
        )
    output.parent.mkdir(parents=True, exist_ok=True)
    with announced():
        plot_bounds(found, output)
        write_netcdf(found, output.with_suffix(".nc"))
        study.write_table(found, output.with_suffix(".csv"))
    typer.echo("\n".join(study.describe_bounds(found)))


def _values(text: str) -> tuple[str, list[str]]:
    """Return the name of a parameter and its values."""
    name, equals, given = text.partition("=")
    values = [value.strip() for value in given.split(";" if ";" in given else ",")]
    if not (name.strip() and equals and all(values)):
        raise UserError(f"--over {text} is not of the form name=value,value,...")
    return name.strip(), values


def _nuisance(text: str) -> tuple[str, float]:
    """Return the name of a nuisance, and the standard deviation to which it is known."""
    name, equals, known = text.partition("=")
    return name.strip(), finite(f"--nuisance {name.strip()}", known) if equals else math.inf
