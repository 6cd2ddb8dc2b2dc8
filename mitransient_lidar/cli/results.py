"""Commands that draw and compare results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.options import DrawingOnly
from mitransient_lidar.core.errors import UserError

_DIFFERENT = 1


def plot(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    output: DrawingOnly = None,
    log: Annotated[bool, typer.Option("--log", help="Logarithmic power axis only.")] = False,
    linear: Annotated[bool, typer.Option("--linear", help="Linear power axis only.")] = False,
    layout: Annotated[
        bool, typer.Option("--layout", help="Draw pixels, beam and targets on the sea instead, to FILE_layout.png.")
    ] = False,
) -> None:
    """Draw the waveforms or the layout of a result.

    Writes a PNG file, by default in the folder of FILE, and prints its path. With --layout it also prints where the
    axes of receiver and laser, refracted by a level sea, meet the sea level, targets' depths and the bottom: x, y, z.
    """
    if layout and (log or linear):
        raise UserError("--layout does not go with --log or --linear: a layout has no power axis.")
    from mitransient_lidar import results
    from mitransient_lidar.plots.layout import axis_points, plot_layout
    from mitransient_lidar.plots.waveforms import plot_waveforms

    if layout:
        target = output or file.with_name(f"{file.stem}_layout.png")
        dataset = results.open(file)
        plot_layout(dataset, target)
        typer.echo("\n".join([str(target), *axis_points(dataset)]))
        return
    target = output or file.with_suffix(".png")
    plot_waveforms(results.open(file), target, "both" if log == linear else "log" if log else "linear")
    typer.echo(target)


def compare(
    first: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    second: Annotated[Path, typer.Argument(metavar="OTHER", help="A result with the same pixels and time bins.")],
    output: DrawingOnly = None,
) -> None:
    """Test whether two results agree within their errors.

    Draws both and prints the path; exit code 1 if they differ.
    """
    from mitransient_lidar import results
    from mitransient_lidar.analysis import comparison
    from mitransient_lidar.plots.comparison import plot_comparison

    target = output or second.with_name(f"{first.stem}_{second.stem}.png")
    datasets = results.open(first), results.open(second)
    outcome = comparison.compare(*datasets)
    plot_comparison(*datasets, outcome, target)
    typer.echo(target)
    typer.echo(
        f"{'agree' if outcome.agrees else 'differ'}: {outcome.bin_count} bins, rms {outcome.rms:.2f} and largest "
        f"{outcome.largest:.1f} standard errors (chance explains {outcome.limit:.1f}); energy x "
        f"{outcome.energy_ratio:.4f} +- {outcome.energy_ratio_stderr:.4f}"
    )
    if not outcome.agrees:
        raise typer.Exit(_DIFFERENT)
