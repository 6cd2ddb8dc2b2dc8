"""The command that fits parameters of a scene to waveforms."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import announced, check_targets, write_netcdf
from mitransient_lidar.cli.messages import exit_if_interrupted, reporting
from mitransient_lidar.cli.options import OUTPUT, Define, Instrument, Quiet, parameters
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.validation import finite

_REFUSED = 1  # exit code of a fit that is refused


def fit(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Result or recorded signal (.nc, .exr), or a CSV file with the column time_ns and one for each pixel.",
        ),
    ],
    free: Annotated[
        str,
        typer.Option(metavar="NAME,NAME,...", help="Free parameters of the scene, and bandwidth_mhz of a receiver."),
    ],
    scene: Annotated[
        str | None, typer.Option(help="Name or XML file of the scene; by default that of the result.")
    ] = None,
    define: Define = None,
    instrument: Instrument = None,
    start: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Start of a free parameter. Repeatable.")
    ] = None,
    bounds: Annotated[
        list[str] | None, typer.Option(metavar="NAME=LOW:HIGH", help="Bounds of a free parameter. Repeatable.")
    ] = None,
    free_scale: Annotated[
        bool | None,
        typer.Option("--free-scale/--fixed-scale", help="Fit the scale of the waveforms, as by default of CSV files."),
    ] = None,
    free_time: Annotated[
        bool | None,
        typer.Option("--free-time/--fixed-time", help="Fit the time offset, as by default of CSV files."),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="Standard deviation of every sample, in the unit of the waveforms, greater than 0."),
    ] = None,
    receiver: Annotated[
        str | None,
        typer.Option(
            help="Receiver of a signal, by default the one that it names. Of a CSV file, the one whose response and "
            "noise the model gets: a preset, an instrument or a .toml file."
        ),
    ] = None,
    scale_errors: Annotated[
        bool, typer.Option("--scale-errors", help="Multiply the covariance by the reduced chi-squared.")
    ] = False,
    passes: Annotated[
        int | None, typer.Option(help="Passes of each render, 2 to 10^9; by default by the errors of the waveforms.")
    ] = None,
    max_time: Annotated[
        float | None,
        typer.Option(help="Try no step after this many seconds, so that the fit may not converge (greater than 0)."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of all renders, -2^63 to 2^63 - 1; by default not that of the result.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the files.")] = OUTPUT,
    quiet: Quiet = False,
) -> None:
    """Fit parameters of a scene to waveforms.

    Weighted least squares with the derivatives of renders. Prints values with standard errors, and writes fit.nc (with
    covariance, fitted waveform and residuals), fit.csv and fit.png. A fit whose chi-squared exceeds 5 times the
    expected one is refused, or, where the noise is unknown, one that leaves 10 % of the squares of the samples: it is
    printed and written with exit code 1. Ctrl-C ends the fit at its last step, which it prints and writes (exit code
    130).
    """
    targets = [output / f"fit.{kind}" for kind in ("nc", "csv", "png")]
    check_targets(output, targets, str(file))
    names = [name.strip() for name in free.split(",")]
    starts = {name: finite(f"--start {name}", value) for name, value in _pairs("--start", start).items()}
    limits = {name: _limits(name, text) for name, text in _pairs("--bounds", bounds).items()}
    from mitransient_lidar.plots.studies.fit import plot_fit
    from mitransient_lidar.studies import fit as study

    with DeferredInterrupt(at_once=False):
        with reporting(quiet) as progress:
            fitted = study.fit(
                file,
                scene,
                names,
                params=parameters(define),
                instrument=instrument,
                start=starts,
                bounds=limits,
                free_scale=free_scale,
                free_time=free_time,
                noise=noise,
                receiver=receiver,
                scale_errors=scale_errors,
                passes=passes,
                max_time=max_time,
                seed=seed,
                progress=progress,
            )
        output.mkdir(parents=True, exist_ok=True)
        heading, rows = study.table_rows(fitted)
        with announced():
            write_netcdf(fitted, targets[0])
            with replacing(targets[1]) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
                csv.writer(stream).writerows([heading, *rows])
            plot_fit(fitted, targets[2])
    typer.echo("\n".join(study.describe_fit(fitted)))
    exit_if_interrupted(fitted)
    if fitted.attrs["refused"]:
        raise typer.Exit(_REFUSED)


def _pairs(option: str, given: list[str] | None) -> dict[str, str]:
    """Return texts by name from arguments ``name=text``."""
    found = {}
    for one in given or []:
        name, equals, text = one.partition("=")
        if not (name.strip() and equals and text.strip()):
            raise UserError(f"{option} {one} is not of the form name=value.")
        found[name.strip()] = text.strip()
    return found


def _limits(name: str, text: str) -> tuple[float, float]:
    """Return two numbers separated by a colon."""
    ends = text.split(":")
    if len(ends) != 2:
        raise UserError(f"--bounds {name}={text} is not of the form name=low:high.")
    return finite(f"--bounds {name}", ends[0]), finite(f"--bounds {name}", ends[1])
