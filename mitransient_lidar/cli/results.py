"""Commands that show, draw, record and compare results."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitransient_lidar.cli import generator
from mitransient_lidar.cli.files import PAGE_MB, announced, check_figure, check_suffix, write_page
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.cli.overwriting import draws_again, parameters
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option

if TYPE_CHECKING:
    import xarray as xr

COMMANDS = generator.Commands()

_DIFFERENT = 1


@COMMANDS.add("Analyse results", "", "output/table1.nc -o waveforms.png")
def _view(
    file: Annotated[
        Path,
        Option(
            "EXR or NetCDF file of a result, a gate stack or recorded signals; XML file or name of a scene; LAS "
            "file, folder or store of a flight; waveforms in PulseWaves (.pls) or, with --waveforms, LAS or LAZ",
            form="FILE",
            is_argument=True,
        ),
    ],
    output: Annotated[
        Path | None, Option("HTML file for the page, by default a temporary one; PNG, PDF or SVG file for a drawing")
    ] = None,
    browser: Annotated[bool, Option("Open the page in the browser")] = True,
    shot: Annotated[int | None, Option("Number of a shot in a series, from 0; by default their mean")] = None,
    plot: Annotated[bool, Option("Draw the waveforms instead, to FILE.png")] = False,
    log: Annotated[bool, Option("Draw them with a logarithmic power axis only")] = False,
    linear: Annotated[bool, Option("Draw them with a linear power axis only")] = False,
    components: Annotated[bool, Option("Draw the light by origin instead, to FILE_components.png")] = False,
    layout: Annotated[bool, Option("Draw pixels, beam and targets on the sea instead, to FILE_layout.png")] = False,
    waveforms: generator.Waveforms = None,
    channel: generator.Channel = None,
    lidar: generator.Lidar = None,
    define: generator.Define = None,
    quiet: generator.Quiet = False,
) -> None:
    """Show a result, a scene or the points of a flight in the browser, or draw a result's waveforms or layout.

    The page of a scene has sea, bottom, targets, layers, beam and pixels in three dimensions, to scale; that of a
    flight or LAS file its points by class, with errors of their heights. The page of a result is a map of the
    pixels at each time, and the waveforms of those that are clicked. Pages need no network. Gates are shown where
    FILE has them, of frames of a camera their mean. With --plot, --components, --layout or a drawing as --output, a
    PNG, PDF or SVG file is written instead, by default in FILE's folder. Both print the path. With --layout, the
    command also prints where the axes of receiver and laser, refracted by a level sea, meet the sea level, targets'
    depths and the bottom: x, y, z.
    """
    is_page = output is None or output.suffix.lower() == ".html"
    selection = generator.waveform_selection(file, waveforms, channel, lidar)
    others = {"--plot": plot, "--log": log, "--linear": linear, "--components": components, "--layout": layout}
    # A LAS file is one of points unless its waveforms are asked for.
    if is_points := _is_points(file) and not (waveforms or channel or lidar):
        selection = {}
    if is_scene := names_scene(file) or is_points:
        for option in [name for name, given in {**others, "--shot": shot is not None}.items() if given]:
            raise UserError(f"{option} needs a result: {file} is a scene or points")
    if define and not names_scene(file):
        raise UserError(f"-D needs a scene: {file} is none")
    if is_scene or (not any(others.values()) and is_page):
        _show(file, output, shot, browser, define, quiet, selection)
        return
    if layout and (log or linear):
        raise UserError("--layout does not go with --log or --linear: a layout has no power axis")
    if components and (log or linear or layout):
        raise UserError("--components does not go with --log, --linear or --layout: its drawing has both scales")
    if output is not None and output.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise UserError(f"--output {output} must end in .png, .pdf or .svg, or .html for a page")
    target = output or file.with_name(f"{file.stem}{'_layout' if layout else '_components' if components else ''}.png")
    draws_again(file)
    check_figure(target)
    from mitransient_lidar import results
    from mitransient_lidar.plots.layout import axis_points, plot_layout
    from mitransient_lidar.plots.waveforms import plot_components, plot_waveforms
    from mitransient_lidar.results.files import kinds_of

    of_gates = () if layout or components else ("gates", "frames")
    dataset = results.dataset_of("FILE", file, "waveforms", "signals", *of_gates, **selection)
    if shot is not None:
        dataset = _shot(dataset, shot, file)
    with announced():
        if not {"waveforms", "signals"} & kinds_of(dataset):
            from mitransient_lidar.plots.gates.images import plot_gates

            plot_gates(dataset, target, log=log and not linear)
        elif layout:
            plot_layout(dataset, target)
        elif components:
            plot_components(dataset, target)
        else:
            plot_waveforms(dataset, target, "both" if log == linear else "log" if log else "linear")
    if layout:
        typer.echo("\n".join(axis_points(dataset)))


def names_scene(file: Path) -> bool:
    """Return whether an argument is the name of a shipped scene, or the path of an XML file."""
    from mitransient_lidar.loading.catalogue import scene_names

    return file.suffix.lower() == ".xml" or str(file) in scene_names()


def _is_points(file: Path) -> bool:
    """Return whether a path is that of a flight, or of points."""
    return file.is_dir() or file.suffix.lower() in (".las", ".laz")


def _show(
    file: Path,
    output: Path | None,
    shot: int | None,
    browser: bool,
    define: list[str] | None,
    quiet: bool,
    selection: dict[str, Any],
) -> None:
    """Write the page of a result, a scene or points, and open it in the browser."""
    if output is not None:
        check_suffix("--output", output, ".html")
    from mitransient_lidar import results
    from mitransient_lidar.plots import viewer

    with reporting(quiet):
        if names_scene(file):
            page = viewer.view_scene(str(file), parameters(define))
        elif _is_points(file) and not selection:
            page = viewer.view_points(file)
        else:
            dataset = results.dataset_of("FILE", file, "waveforms", "signals", "gates", "frames", **selection)
            page = viewer.view(dataset if shot is None else _shot(dataset, shot, file), limit_mb=PAGE_MB)
    path = write_page(page, output)
    if browser and not webbrowser.open(path.resolve().as_uri()):
        typer.echo("no browser was found: open the page in one.", err=True)


def _shot(dataset: xr.Dataset, number: int, file: Path) -> xr.Dataset:
    """Return one shot from a series."""
    if "shot" not in dataset.dims:
        raise UserError(f"--shot {number} needs a series of shots, but {file} holds a single shot")
    if number not in dataset["shot"].values:
        first, last = (int(end) for end in dataset["shot"].values[[0, -1]])
        raise UserError(f"--shot {number} must be one of the shots in {file}, {first} to {last}")
    return dataset.sel(shot=number)


@COMMANDS.add("Analyse results", "", "one/table1.nc other/table1.nc")
def _compare(
    first: Annotated[
        Path, Option("An EXR or NetCDF result, or the record of shots, also LAS or .pls", form="FILE", is_argument=True)
    ],
    second: Annotated[Path, Option("A result with the same pixels and bins or gates", form="OTHER", is_argument=True)],
    output: generator.DrawingOnly = None,
    as_json: generator.Json = False,
    waveforms: generator.Waveforms = None,
    channel: generator.Channel = None,
    lidar: generator.Lidar = None,
) -> None:
    """Test whether two results agree within their errors.

    Draws both and prints the path, without --json; exit code 1 if they differ.
    """
    from mitransient_lidar import results
    from mitransient_lidar.analysis import comparison
    from mitransient_lidar.plots.waveforms import plot_comparison
    from mitransient_lidar.results.waveform_files import is_waveform_file

    if as_json and output is not None:
        raise UserError("--json draws nothing: leave out --output")
    target = output or second.with_name(f"{first.stem}_{second.stem}.png")
    if not as_json:
        check_figure(target)
    recorded = [one for one in (first, second) if is_waveform_file(one)]
    selection = generator.waveform_selection(recorded[0] if recorded else first, waveforms, channel, lidar)
    given = (
        results.dataset_of(name, one, "result", "gates", "signals", **(selection if one in recorded else {}))
        for name, one in (("FILE", first), ("OTHER", second))
    )
    datasets = comparison.as_bins(*given)
    outcome = comparison.compare(*datasets)
    if as_json:
        names = ("agrees", "bin_count", "rms", "largest", "limit", "energy_ratio", "energy_ratio_stderr")
        generator.print_json({name: getattr(outcome, name) for name in names})
    else:
        with announced():
            plot_comparison(*datasets, outcome, target)
        typer.echo(
            f"{'agree' if outcome.agrees else 'differ'}: {outcome.bin_count} bins, rms {outcome.rms:.2f} and largest "
            f"{outcome.largest:.1f} standard errors (chance explains {outcome.limit:.1f}); energy x "
            f"{outcome.energy_ratio:.4f} +- {outcome.energy_ratio_stderr:.4f}"
        )
    if not outcome.agrees:
        raise typer.Exit(_DIFFERENT)
