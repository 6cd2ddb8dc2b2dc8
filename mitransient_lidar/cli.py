"""The command line ``mitransient-lidar``: render, plot, compare, shots, survey, spread, water, scenes, info, bench.

Mistakes of the user's end with one sentence on stderr and exit code 2, interruptions with exit code 130. Results go to
stdout, everything else to stderr. Modules that take long to import are imported by the commands that need them.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitransient_lidar._version import __version__
from mitransient_lidar.errors import UserError

if TYPE_CHECKING:
    import xarray as xr
    from rich.console import Console

_WRONG_USE = 2
_INTERRUPTED = 130  # what shells report after Ctrl-C
_DIFFERENT = 1
_LISTED_PIXELS = 12  # pixels with a line of their own in the summary

app = typer.Typer(
    help="Simulate multipixel depth-sounding lidar.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
scenes_app = typer.Typer(help="List, show or copy the scenes that come with the package.", rich_markup_mode=None)
app.add_typer(scenes_app, name="scenes")


def main() -> None:
    """Run the command line."""
    app(prog_name="mitransient-lidar")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@app.command()
def render(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Name of a shipped scene, or path of a Mitsuba XML file.")
    ],
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a parameter of the scene. Repeatable.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for the results; created if missing.")] = Path(
        "."
    ),
    integrator: Annotated[str | None, typer.Option(help="Integrator to use instead of the scene's.")] = None,
    target_error: Annotated[float | None, typer.Option(help="Stop at this relative standard error, e.g. 0.01.")] = None,
    max_time: Annotated[float | None, typer.Option(help="Stop after this many seconds.")] = None,
    passes: Annotated[int | None, typer.Option(help="Number of independent passes.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant, e.g. llvm_ad_mono.")] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw the waveforms.")] = True,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but the paths and errors.")] = False,
) -> None:
    """Render SCENE to DIR/<scene>.exr, .nc and .png and print their paths."""
    with _sentences():
        _require(target_error is None or _positive(target_error), "--target-error", target_error, "above 0")
        _require(max_time is None or _positive(max_time), "--max-time", max_time, "above 0")
        _require(passes is None or passes >= 2, "--passes", passes, "at least 2")
        _require(seed >= 0, "--seed", seed, "0 or above")
        params = _parameters(define or [])

        from mitransient_lidar.resources import scene_path

        name = scene_path(scene).stem
        targets = [output / f"{name}{suffix}" for suffix in (".exr", ".nc", *([".png"] if plot else []))]
        _require_writable(output, targets)

        from mitransient_lidar import rendering, results

        with _reporting(quiet) as progress:
            dataset = rendering.render(
                scene,
                params=params,
                integrator=integrator,
                target_error=target_error,
                max_time=max_time,
                passes=passes,
                seed=seed,
                variant=variant,
                progress=progress,
            )
        output.mkdir(parents=True, exist_ok=True)
        for target in targets:
            if target.suffix == ".png":
                from mitransient_lidar.plotting import plot_waveforms

                plot_waveforms(dataset, target)
            else:
                results.save(dataset, target)
        for target in targets:
            typer.echo(target)
        if not quiet:
            _summarise(dataset)
        if dataset.attrs.get("interrupted"):
            typer.echo(f"interrupted after {dataset.attrs.get('passes')} passes; what was rendered is kept.", err=True)
            raise typer.Exit(_INTERRUPTED)


@app.command()
def plot(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")] = None,
    log: Annotated[bool, typer.Option("--log", help="Logarithmic power axis only.")] = False,
    linear: Annotated[bool, typer.Option("--linear", help="Linear power axis only.")] = False,
) -> None:
    """Draw the waveforms of FILE, beside it unless -o says otherwise, and print the path."""
    with _sentences():
        from mitransient_lidar import results
        from mitransient_lidar.plotting import plot_waveforms

        target = output or file.with_suffix(".png")
        plot_waveforms(results.open(file), target, "both" if log == linear else "log" if log else "linear")
        typer.echo(target)


@app.command()
def shots(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene or path of an XML file.")],
    define: Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter.")] = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", metavar="X,Y", help="A place [m] instead of a search.")
    ] = None,
    steepness: Annotated[float, typer.Option(help="Slopes to find, in standard deviations.")] = 2.0,
    count: Annotated[int, typer.Option(help="Places of each kind.")] = 1,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to draw.")] = None,
    waveforms: Annotated[bool, typer.Option("--waveforms/--no-waveforms", help="Render the shots, too.")] = True,
) -> None:
    """List places on the sea by the slope the beam meets there (towards, level, away, sideways), and draw them."""
    with _sentences():
        _require(_positive(steepness), "--steepness", steepness, "above 0")
        _require(1 <= count <= 100, "--count", count, "1 to 100")
        params = _parameters(define or [])
        places = [_place(text) for text in at or []]

        from mitransient_lidar import shots as finder

        if places:
            found = finder.shots_at(scene, places, params)
        else:
            found = finder.find_shots(scene, params, steepness=steepness, count=count)
        typer.echo(f"{'kind':<10}{'shot_x':>10}{'shot_y':>10}{'along (deg)':>13}{'across (deg)':>14}")
        for shot in found:
            along, across = (math.degrees(math.atan(slope)) for slope in (shot.along, shot.across))
            typer.echo(f"{shot.kind:<10}{shot.x:>10.2f}{shot.y:>10.2f}{along:>13.2f}{across:>14.2f}")
        if output is not None:
            finder.plot_shots(scene, found, output, params, waveforms=waveforms)
            typer.echo(output)


@app.command()
def survey(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene or path of an XML file.")],
    define: Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter.")] = None,
    count: Annotated[int, typer.Option(help="Number of shots.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of their places.")] = 1,
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; a .nc lies beside it.")] = Path(
        "survey.png"
    ),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but the paths and errors.")] = False,
) -> None:
    """Render shots at random places of the sea and show how their echoes go with the slope they meet."""
    with _sentences():
        _require(2 <= count <= 100_000, "--count", count, "2 to 100000")
        _require(seed >= 0, "--seed", seed, "0 or above")
        params = _parameters(define or [])
        targets = [output, output.with_suffix(".nc")]
        _require_writable(output.parent, targets)

        from mitransient_lidar import results
        from mitransient_lidar import survey as surveying
        from mitransient_lidar.plotting import check_format

        check_format(output)
        with _counting(quiet, "shot") as progress:
            shots = surveying.survey(scene, params, count=count, seed=seed, progress=progress)
        output.parent.mkdir(parents=True, exist_ok=True)
        correlations = surveying.plot_survey(shots, output)
        with results.replacing(targets[1]) as temporary:
            shots.to_netcdf(temporary, engine="h5netcdf")
        for target in targets:
            typer.echo(target)
        for name, value in correlations.items():
            typer.echo(f"correlation of {name} with the slope: {value:+.3f}")


@app.command()
def spread(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene or path of an XML file.")],
    depths: Annotated[str, typer.Option(metavar="D1,D2,...", help="Depths below the mean sea level [m].")],
    define: Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter.")] = None,
    passes: Annotated[int, typer.Option(help="Number of independent passes.")] = 8,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; a .nc lies beside it.")] = Path(
        "spread.png"
    ),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but the paths and errors.")] = False,
) -> None:
    """Show how far the laser's light has spread at depths, sideways and in time, and what share the receiver sees."""
    with _sentences():
        _require(2 <= passes <= 10_000, "--passes", passes, "2 to 10000")
        _require(seed >= 0, "--seed", seed, "0 or above")
        params = _parameters(define or [])
        wanted = _numbers("--depths", depths)
        targets = [output, output.with_suffix(".nc")]
        _require_writable(output.parent, targets)

        from mitransient_lidar import beam_spread, results
        from mitransient_lidar.beam_spread_plots import plot_beam_spread
        from mitransient_lidar.plotting import check_format

        check_format(output)
        with _counting(quiet, "pass") as progress:
            found = beam_spread.beam_spread(scene, wanted, params, passes=passes, seed=seed, progress=progress)
        output.parent.mkdir(parents=True, exist_ok=True)
        plot_beam_spread(found, output)
        with results.replacing(targets[1]) as temporary:
            found.to_netcdf(temporary, engine="h5netcdf")
        for target in targets:
            typer.echo(target)
        if not quiet:
            for line in beam_spread.describe_spread(found):
                typer.echo(line)


@app.command()
def orders(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene or path of an XML file.")],
    define: Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter.")] = None,
    count: Annotated[int, typer.Option("--orders", help="Orders to tell apart.")] = 8,
    passes: Annotated[int, typer.Option(help="Number of passes.")] = 32,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file; a .nc beside it.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but results and errors.")] = False,
) -> None:
    """Tell how often the received light was scattered, and how much of it turned more than once."""
    with _sentences():
        _require(1 <= count <= 62, "--orders", count, "1 to 62")
        _require(2 <= passes <= 100_000, "--passes", passes, "2 to 100000")
        _require(seed >= 0, "--seed", seed, "0 or above")
        params = _parameters(define or [])
        targets = [output, output.with_suffix(".nc")] if output is not None else []
        if output is not None:
            from mitransient_lidar.plotting import check_format

            check_format(output)
            _require_writable(output.parent, targets)

        from mitransient_lidar import results, scattering_orders

        with _counting(quiet, "pass") as progress:
            found = scattering_orders.scattering_orders(
                scene, params, orders=count, passes=passes, seed=seed, progress=progress
            )
        if output is not None:
            output.parent.mkdir(parents=True, exist_ok=True)
            scattering_orders.plot_orders(found, output)
            with results.replacing(targets[1]) as temporary:
                found.to_netcdf(temporary, engine="h5netcdf")
            for target in targets:
                typer.echo(target)
        typer.echo(f"{'order':<8}{'energy (J)':>12}{'share (%)':>12}{'several turns (%)':>20}")
        for name, energy, share, several in scattering_orders.shares(found):
            typer.echo(f"{name:<8}{energy:>12.4g}{100 * share:>12.3f}{100 * several:>20.3f}")


@app.command()
def views(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene or path of an XML file.")],
    define: Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter.")] = None,
    fields: Annotated[
        str, typer.Option(metavar="F1,F2,...", help="Full angles of the fields of view in mrad.")
    ] = "2,5,10,20,50,100",
    from_depth: Annotated[float, typer.Option("--from", help="Depth in m from which the slope is measured.")] = 1.0,
    to_depth: Annotated[float, typer.Option("--to", help="Depth in m to which it is measured.")] = 5.0,
    passes: Annotated[int, typer.Option(help="Number of independent passes for each field.")] = 48,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; a .nc lies beside it.")] = Path(
        "views.png"
    ),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but results and errors.")] = False,
) -> None:
    """Show how the slope of the column signal goes with the field of view, between c and a."""
    with _sentences():
        _require(4 <= passes <= 10_000, "--passes", passes, "4 to 10000")
        _require(seed >= 0, "--seed", seed, "0 or above")
        params = _parameters(define or [])
        wanted = _numbers("--fields", fields)
        targets = [output, output.with_suffix(".nc")]
        _require_writable(output.parent, targets)

        from mitransient_lidar import column_views, results
        from mitransient_lidar.plotting import check_format

        check_format(output)
        depths = {"from_depth": from_depth, "to_depth": to_depth}
        with _counting(quiet, "pass") as progress:
            found = column_views.views(scene, wanted, params, **depths, passes=passes, seed=seed, progress=progress)
        output.parent.mkdir(parents=True, exist_ok=True)
        column_views.plot_views(found, output)
        with results.replacing(targets[1]) as temporary:
            found.to_netcdf(temporary, engine="h5netcdf")
        for target in targets:
            typer.echo(target)
        for line in column_views.describe_views(found):
            typer.echo(line)


@app.command()
def water(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="jerlov, chlorophyll, kd, secchi, petzold, profile or pure.")
    ],
    value: Annotated[
        str | None,
        typer.Argument(
            metavar="VALUE",
            help="Jerlov type, chlorophyll [mg/m^3], Kd [1/m], Secchi depth [m], Petzold's clear, coastal or turbid, "
            "or a profile's .csv or .nc file.",
        ),
    ] = None,
    wavelength: Annotated[float, typer.Option(help="Wavelength in nm.")] = 532.0,
    temperature: Annotated[float, typer.Option(help="Temperature in degrees Celsius, for the indices.")] = 20.0,
    salinity: Annotated[float, typer.Option(help="Salinity in per mille, for the indices.")] = 35.0,
    tolerance: Annotated[float, typer.Option(help="How far a profile's layers may be from it, relative.")] = 0.01,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to draw.")] = None,
) -> None:
    """Print the optical properties that a way of knowing a water stands for, and how to render with them."""
    with _sentences():
        from mitransient_lidar import water_kinds

        lines = water_kinds.describe_water(kind, value, wavelength, temperature, salinity, tolerance)
        if output is not None:
            water_kinds.plot_water(kind, value, wavelength, temperature, salinity, tolerance, output)
            lines.append(str(output))
        for line in lines:
            typer.echo(line)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    second: Annotated[Path, typer.Argument(metavar="OTHER", help="A result with the same pixels and time bins.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")] = None,
) -> None:
    """Say whether FILE and OTHER agree within their standard errors, and draw both; exit code 1 if they do not."""
    with _sentences():
        from mitransient_lidar import results
        from mitransient_lidar.comparison import plot_comparison

        target = output or second.with_name(f"{first.stem}_{second.stem}.png")
        outcome = plot_comparison(results.open(first), results.open(second), target)
        typer.echo(target)
        typer.echo(
            f"{'agree' if outcome.agrees else 'differ'}: {outcome.bin_count} bins, rms {outcome.rms:.2f} and largest "
            f"{outcome.largest:.1f} standard errors (chance explains {outcome.limit:.1f}); energy x "
            f"{outcome.energy_ratio:.4f} +- {outcome.energy_ratio_stderr:.4f}"
        )
    if not outcome.agrees:
        raise typer.Exit(_DIFFERENT)


@scenes_app.callback(invoke_without_command=True)
def _scenes(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        list_scenes()


@scenes_app.command("list")
def list_scenes() -> None:
    """List the shipped scenes."""
    with _sentences():
        from mitransient_lidar import resources

        names = resources.scene_names()
        width = max(map(len, names), default=0)
        for name in names:
            typer.echo(f"{name:{width}}  {resources.scene_summary(name)}".rstrip())


@scenes_app.command("show")
def show_scene(name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")]) -> None:
    """Print the XML of a scene."""
    with _sentences():
        from mitransient_lidar.resources import scene_text

        typer.echo(scene_text(name), nl=False)


@scenes_app.command("copy")
def copy_scene(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")],
    destination: Annotated[Path, typer.Argument(metavar="[DEST]", help="Folder, or path of the new file.")] = Path("."),
) -> None:
    """Copy a scene, in order to change it, and print the new path. Nothing is overwritten."""
    with _sentences():
        from mitransient_lidar import resources

        typer.echo(resources.copy_scene(name, destination))


@app.command()
def info() -> None:
    """Print versions, the Mitsuba variant, and where LLVM was found."""
    with _sentences():
        from mitransient_lidar import variants

        facts = variants.describe()
        width = max(map(len, facts))
        for name, value in facts.items():
            typer.echo(f"{name:{width}}  {value}")


@app.command()
def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer cases, in less than a minute.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    case: Annotated[str | None, typer.Option(help="Run this case only.")] = None,
    target_error: Annotated[float | None, typer.Option(help="Relative standard error to reach.")] = None,
) -> None:
    """Measure the time to a given accuracy."""
    with _sentences():
        _require(target_error is None or _positive(target_error), "--target-error", target_error, "above 0")

        from mitransient_lidar import bench as benchmark

        benchmark.run(quick=quick, json=json, case=case, target_error=target_error)


@contextlib.contextmanager
def _sentences() -> Iterator[None]:
    """Turn mistakes of the user's into one sentence and exit code 2, an interruption into exit code 130."""
    try:
        yield
    except UserError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(_WRONG_USE) from error
    except BrokenPipeError:
        raise  # the reader of stdout has left; Typer ends quietly
    except OSError as error:
        place = f" {error.filename}" if error.filename else ""
        typer.echo(f"cannot use{place}: {error.strerror or error}.", err=True)
        raise typer.Exit(_WRONG_USE) from error
    except KeyboardInterrupt as error:
        typer.echo("interrupted.", err=True)
        raise typer.Exit(_INTERRUPTED) from error


def _positive(value: float) -> bool:
    return math.isfinite(value) and value > 0


def _require(valid: bool, option: str, value: object, allowed: str) -> None:
    if not valid:
        raise UserError(f"{option} {value} is out of range: it must be {allowed}.")


def _parameters(definitions: list[str]) -> dict[str, str]:
    params = {}
    for definition in definitions:
        name, equals, value = definition.partition("=")
        if not (name.strip() and equals):
            raise UserError(f"-D {definition} is not of the form name=value.")
        params[name.strip()] = value.strip()
    return params


def _place(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--at {text} is not of the form x,y in metres.") from None
    return x, y


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise UserError(f"{option} {text} is not of the form 2,5,8.") from None


def _require_writable(folder: Path, targets: list[Path]) -> None:
    """Find out before a long render, and without a trace, whether the results can be written."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise UserError(f"cannot write to folder {folder}: {error.strerror}.") from error
    for target in targets:
        if target.is_dir():
            raise UserError(f"cannot write {target}: it is a folder.")


@contextlib.contextmanager
def _reporting(quiet: bool) -> Iterator[Callable[[Any], None] | None]:
    """Show log messages and a progress bar on stderr; yield the function that moves the bar."""
    import logging

    logger = logging.getLogger("mitransient_lidar")
    if quiet:
        logger.addHandler(logging.NullHandler())
        logger.propagate = False
        yield None
        return

    from rich.logging import RichHandler
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = _console()
    handler = RichHandler(console=console, show_path=False, show_time=False)
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("preparing", total=None)

            def show(state: Any) -> None:
                bar.update(task, description=_describe(state), completed=state.passes_done, total=state.passes_planned)

            yield show
    finally:
        logger.removeHandler(handler)


@contextlib.contextmanager
def _counting(quiet: bool, what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress bar on stderr; yield the function that takes what is done and planned."""
    if quiet:
        yield None
        return

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=_console(), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, planned: bar.update(task, completed=done, total=planned)


def _describe(state: Any) -> str:
    """Say in one line how far a render is (`rendering.Progress`)."""
    planned = f"/{state.passes_planned}" if state.passes_planned is not None else ""
    parts = [f"pass {state.passes_done}{planned}"]
    if state.error_median is not None:
        goal = f" of {100 * state.target_error:.3g} %" if state.target_error is not None else ""
        parts.append(f"error {100 * state.error_median:.3g} %{goal}")
    if state.error_p95 is not None:
        parts.append(f"p95 {100 * state.error_p95:.3g} %")
    if state.remaining_s is not None:
        parts.append(f"{state.remaining_s:.0f} s left")
    return ", ".join(parts)


def _summarise(dataset: xr.Dataset) -> None:
    """Print passes, time, error and the peak power of each pixel on stderr."""
    from rich.table import Table

    table = Table.grid(padding=(0, 2))

    def add(name: str, key: str, form: str, scale: float = 1.0) -> None:
        value = dataset.attrs.get(key)
        if isinstance(value, (int, float)):
            table.add_row(name, format(scale * value, form))

    add("passes", "passes", ".0f")
    add("time (s)", "elapsed_s", ".2f")
    add("median error (%)", "error_median", ".3g", 100.0)
    add("95th percentile error (%)", "error_p95", ".3g", 100.0)
    peaks = dataset["waveform"].max("time")
    if "pixel" in peaks.dims and peaks.size <= _LISTED_PIXELS:
        for name, peak in zip(peaks["pixel"].values, peaks.values, strict=True):
            table.add_row(f"peak power, {name} (W)", f"{peak:.4g}")
    else:
        table.add_row("highest peak power (W)", f"{float(peaks.max()):.4g}")
    _console().print(table, markup=False)


def _console() -> Console:
    from rich.console import Console

    return Console(stderr=True, highlight=False)
