"""Commands that show, draw, record and compare results."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, write_netcdf
from mitransient_lidar.cli.messages import name_subject, reporting
from mitransient_lidar.cli.options import RECEIVERS, DrawingOnly, Quiet, Seed, number_or_auto
from mitransient_lidar.cli.overwriting import draws_again
from mitransient_lidar.core.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

_DIFFERENT = 1
_PAGE_MB = 200.0


def plot(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    output: DrawingOnly = None,
    log: Annotated[bool, typer.Option("--log", help="Logarithmic power axis only.")] = False,
    linear: Annotated[bool, typer.Option("--linear", help="Linear power axis only.")] = False,
    shot: Annotated[
        int | None, typer.Option(help="Number of a shot of a series, from 0; by default the mean of all.")
    ] = None,
    components: Annotated[
        bool, typer.Option("--components", help="Draw the light by origin instead, to FILE_components.png.")
    ] = False,
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
    if components and (log or linear or layout):
        raise UserError("--components does not go with --log, --linear or --layout: its drawing has both scales.")
    target = output or file.with_name(f"{file.stem}{'_layout' if layout else '_components' if components else ''}.png")
    draws_again(file)
    check_figure(target)
    from mitransient_lidar import results
    from mitransient_lidar.plots.layout import axis_points, plot_layout
    from mitransient_lidar.plots.waveforms import plot_components, plot_waveforms

    dataset = results.dataset_of("FILE", file, "waveforms", "signals")
    if shot is not None:
        dataset = _shot(dataset, shot, file)
    if layout:
        with announced():
            plot_layout(dataset, target)
        typer.echo("\n".join(axis_points(dataset)))
    elif components:
        with announced():
            plot_components(dataset, target)
    else:
        with announced():
            plot_waveforms(dataset, target, "both" if log == linear else "log" if log else "linear")


def view(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="EXR or NetCDF file of a result, a gate stack or recorded signals.")
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="HTML file to write; by default a temporary one.")
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    shot: Annotated[
        int | None, typer.Option(help="Number of a shot of a series, from 0; by default the mean of all.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Show a result in the browser: a map of the pixels at each time, and the waveforms of those that are clicked.

    Writes a page that needs no network, prints its path, and opens it. Gates are shown where FILE has them.
    """
    if output is not None:
        check_suffix("--output", output, ".html")
    from mitransient_lidar import results
    from mitransient_lidar.plots.viewer import view as page_of

    with reporting(quiet):
        dataset = results.dataset_of("FILE", file, "waveforms", "signals", "gates")
        page = page_of(dataset if shot is None else _shot(dataset, shot, file), limit_mb=_PAGE_MB)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
    with announced():
        path = page.save(output)
    if browser and not webbrowser.open(path.resolve().as_uri()):
        typer.echo("no browser was found: open the page in one.", err=True)


def _shot(dataset: xr.Dataset, number: int, file: Path) -> xr.Dataset:
    """Return one shot of a series."""
    if "shot" not in dataset.dims:
        raise UserError(f"--shot {number} needs a series of shots, but {file} holds a single shot.")
    if number not in dataset["shot"].values:
        first, last = (int(end) for end in dataset["shot"].values[[0, -1]])
        raise UserError(f"--shot {number} must be one of the shots of {file}, {first} to {last}.")
    return dataset.sel(shot=number)


def record(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result: one shot or a series.")],
    receiver: Annotated[
        str | None, typer.Option(help=f"{RECEIVERS} By default that of the result's instrument, or apd.")
    ] = None,
    gain: Annotated[
        str | None,
        typer.Option(
            metavar="FACTOR",
            help="Factor of the amplifier's gain, greater than 0, or auto; by default the receiver's, or 1.",
        ),
    ] = None,
    optical_density: Annotated[
        str | None,
        typer.Option(
            metavar="DENSITY",
            help="Optical density of a filter before the detector, 0 to 12, or auto; by default the receiver's, or 0.",
        ),
    ] = None,
    shots: Annotated[
        int, typer.Option(help="Number of records of each waveform with independent noise, 1 to 10^9.")
    ] = 1,
    background_power_w: Annotated[
        float, typer.Option(help="Power of the daylight on each pixel [W], at least 0.")
    ] = 0.0,
    seed: Seed = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="NetCDF file to write; FILE_recorded.nc by default.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Record the waveforms of a result with a receiver.

    Writes the signals with the noise of detector and electronics, which waveforms and plot read, and prints how much is
    saturated. Behind a converter they are its codes, with scale_factor and add_offset for volts. With auto, the gain or
    the filter is chosen so that nothing is saturated.
    """
    target = output or file.with_name(f"{file.stem}_recorded.nc")
    check_suffix("--output", target, ".nc")
    chosen: dict[str, Any] = {}
    for option, text in (("gain", gain), ("optical_density", optical_density)):
        chosen[option] = None if text is None else number_or_auto(f"--{option.replace('_', '-')}", text)
    from mitransient_lidar import results
    from mitransient_lidar.analysis import receiver as analysis

    with reporting(quiet):
        result = results.dataset_of("FILE", file, "result")
        recorded = analysis.detect_waveforms(result, receiver, shots, seed, background_power_w, **chosen)
    name_subject(file, result.attrs, quiet)
    write_netcdf(recorded, target)
    for line in analysis.describe_recording(recorded):
        typer.echo(line)


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
    check_figure(target)
    datasets = results.dataset_of("FILE", first, "result"), results.dataset_of("OTHER", second, "result")
    outcome = comparison.compare(*datasets)
    with announced():
        plot_comparison(*datasets, outcome, target)
    typer.echo(
        f"{'agree' if outcome.agrees else 'differ'}: {outcome.bin_count} bins, rms {outcome.rms:.2f} and largest "
        f"{outcome.largest:.1f} standard errors (chance explains {outcome.limit:.1f}); energy x "
        f"{outcome.energy_ratio:.4f} +- {outcome.energy_ratio_stderr:.4f}"
    )
    if not outcome.agrees:
        raise typer.Exit(_DIFFERENT)
