"""Command for the figures of the publication."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import check_writable
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.cli.options import OUTPUT, Quiet


def figures(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Figures, as fig09; all by default.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for figures and table.")] = OUTPUT / "figures",
    target_error: Annotated[
        float, typer.Option(help="Relative standard error of the median bin, greater than 0.")
    ] = 0.01,
    max_time: Annotated[
        float | None, typer.Option(help="Begin no further figure after this many seconds (greater than 0).")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers, 0 to 10^6.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Make the figures of the published model again.

    Writes a PNG file for each figure, and a table of the publication's statements with our numbers, their errors, and
    whether they hold.
    """
    from mitransient_lidar.plots.publication import figures as publication
    from mitransient_lidar.studies.publication.statements import describe_statements

    chosen = publication.check_names(names)
    check_writable(output, [output / f"{name}.png" for name in chosen] + [output / publication.TABLE])
    options: dict[str, Any] = {"target_error": target_error, "max_time": max_time, "seed": seed}
    with reporting(quiet) as progress:
        made = publication.figures(chosen, output, progress=progress, **options)
    for path in made.files:
        typer.echo(path)
    for line in describe_statements(made.statements):
        typer.echo(line)
    if made.interrupted:
        done = max(len(made.files) - 1, 0)
        raise KeyboardInterrupt(f"interrupted after {done} of {len(chosen)} figures, which are kept.")
