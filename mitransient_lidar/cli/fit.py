"""The command that fits parameters of a scene to waveforms."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import announced, check_targets, write_netcdf
from mitransient_lidar.cli.generator import Call, Command
from mitransient_lidar.cli.messages import exit_if_interrupted
from mitransient_lidar.cli.options import OUTPUT, Quiet
from mitransient_lidar.core.files import replacing
from mitransient_lidar.core.interruption import DeferredInterrupt

_REFUSED = 1  # exit code of a fit that is refused


def _fit(
    call: Call,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Result or recorded signal (.nc, .exr), or a CSV file with the column time_ns and one for each pixel.",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the files.")] = OUTPUT,
    quiet: Quiet = False,
) -> None:
    """Fit, print and write."""
    targets = [output / f"fit.{kind}" for kind in ("nc", "csv", "png")]
    check_targets(output, targets, str(file))
    from mitransient_lidar.plots.studies.fit import plot_fit
    from mitransient_lidar.studies import fit as study

    with DeferredInterrupt(at_once=False):
        fitted = call(file)
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


COMMANDS = {
    "fit": Command(
        "Analyse results",
        "studies.fit:fit",
        _fit,
        """Fit parameters of a scene to waveforms.

        Weighted least squares with the derivatives of renders. Prints values with standard errors, and writes fit.nc
        (with covariance, fitted waveform and residuals), fit.csv and fit.png. A fit whose chi-squared exceeds 5 times
        the expected one is refused, or, where the noise is unknown, one that leaves 10 % of the squares of the samples:
        it is printed and written with exit code 1. Ctrl-C ends the fit at its last step, which it prints and writes
        (exit code 130).
        """,
    ),
}
