"""The command line ``mitransient-lidar``: render, plot, compare, scenes, info, bench, and the studies.

Mistakes of the user's end with one sentence on stderr and exit code 2, interruptions with exit code 130. Results go to
stdout, everything else to stderr. Modules that take long to import are imported by the commands that need them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitransient_lidar import cli_detect, cli_estimates, cli_gates, cli_passive, cli_studies, cli_waveforms
from mitransient_lidar._version import __version__
from mitransient_lidar.cli_gates import GateFiles
from mitransient_lidar.cli_support import (
    draw,
    parameters,
    positive,
    reporting,
    require,
    require_writable,
    sentences,
    summarise,
)
from mitransient_lidar.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

_INTERRUPTED = 130  # what shells report after Ctrl-C
_DIFFERENT = 1

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
    max_memory: Annotated[
        float | None, typer.Option(help="Memory for histograms [GB]; by default 2. With less, gates alone are kept.")
    ] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw waveforms, pixels and gates.")] = True,
    gif: Annotated[bool, typer.Option("--gif", help="Write an animation of the gates, too.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="Write a movie of the gates, too; needs ffmpeg.")] = False,
    html: Annotated[bool, typer.Option("--html", help="Write a page to look at the gates in a browser, too.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but the paths and errors.")] = False,
) -> None:
    """Render SCENE to DIR/<scene>.exr, .nc, .png and _layout.png (the pixels on the sea), and print their paths.

    A scene with gates gives <scene>_gates.exr, _gates.png and _depth.png as well, or instead where memory is short.
    """
    with sentences():
        require(target_error is None or positive(target_error), "--target-error", target_error, "above 0")
        require(max_time is None or positive(max_time), "--max-time", max_time, "above 0")
        require(passes is None or passes >= 2, "--passes", passes, "at least 2")
        require(seed >= 0, "--seed", seed, "0 or above")
        require(max_memory is None or positive(max_memory), "--max-memory", max_memory, "above 0")
        params = parameters(define or [])

        from mitransient_lidar.resources import scene_path

        name = scene_path(scene).stem
        # Before a long render: a scene whose film has gates names their number.
        if (gif or mp4 or html) and "gate_count" not in scene_path(scene).read_text(encoding="utf-8"):
            raise UserError(f"{scene} has no gates to show: its film needs a gate_count, or cut some with gates.")
        drawings = {output / f"{name}.png": "plot_waveforms", output / f"{name}_layout.png": "plot_layout"}
        targets = [output / f"{name}.exr", output / f"{name}.nc", *(drawings if plot else ())]
        wanted = {"drawings": plot, "gif": gif, "mp4": mp4, "html": html}
        gates = GateFiles(output, name, frozenset(kind for kind, on in wanted.items() if on))
        require_writable(output, [*targets, *gates.names()])

        from mitransient_lidar import gate_files, rendering

        with reporting(quiet) as progress:
            dataset = rendering.render(
                scene,
                params=params,
                integrator=integrator,
                target_error=target_error,
                max_time=max_time,
                passes=passes,
                seed=seed,
                max_memory=max_memory,
                variant=variant,
                progress=progress,
            )
        output.mkdir(parents=True, exist_ok=True)
        if "waveform" in dataset:
            for target in targets:
                if _write(dataset, target, drawings.get(target)):
                    typer.echo(target)
        else:
            gate_files.save_stack(dataset, output / f"{name}.nc")
            typer.echo(output / f"{name}.nc")
        if "gate_energy" in dataset:
            gates.write(dataset, dataset, quiet)
        if not quiet:
            summarise(dataset)
        if dataset.attrs.get("interrupted"):
            typer.echo(f"interrupted after {dataset.attrs.get('passes')} passes; what was rendered is kept.", err=True)
            raise typer.Exit(_INTERRUPTED)


def _write(dataset: xr.Dataset, target: Path, drawing: str | None) -> bool:
    """Write a result or a drawing of it; return False for pixels that do not look at the sea."""
    from mitransient_lidar import results

    if drawing is None:
        if target.suffix == ".exr":
            dataset = dataset.drop_dims("gate", errors="ignore")
        results.save(dataset, target)
        return True
    try:
        draw(dataset, target, drawing)
    except UserError as error:
        if drawing != "plot_layout":
            raise
        typer.echo(f"no drawing of the pixels: {error}", err=True)
        return False
    return True


@app.command()
def plot(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")] = None,
    log: Annotated[bool, typer.Option("--log", help="Logarithmic power axis only.")] = False,
    linear: Annotated[bool, typer.Option("--linear", help="Linear power axis only.")] = False,
    layout: Annotated[
        bool, typer.Option("--layout", help="Draw pixels, beam and targets on the sea instead, to FILE_layout.png.")
    ] = False,
) -> None:
    """Draw the waveforms of FILE, beside it unless -o says otherwise, and print the path."""
    with sentences():
        if layout and (log or linear):
            raise UserError("--layout does not go with --log or --linear: a layout has no power axis.")

        from mitransient_lidar import results

        if layout:
            from mitransient_lidar.layout_plot import plot_layout

            target = output or file.with_name(f"{file.stem}_layout.png")
            plot_layout(results.open(file), target)
        else:
            from mitransient_lidar.plotting import plot_waveforms

            target = output or file.with_suffix(".png")
            plot_waveforms(results.open(file), target, "both" if log == linear else "log" if log else "linear")
        typer.echo(target)


for _study in (
    *cli_studies.COMMANDS,
    *cli_detect.COMMANDS,
    *cli_gates.COMMANDS,
    cli_passive.passive,
    *cli_waveforms.COMMANDS,
    *cli_estimates.COMMANDS,
):
    app.command()(_study)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(metavar="FILE", help="An EXR or NetCDF result.")],
    second: Annotated[Path, typer.Argument(metavar="OTHER", help="A result with the same pixels and time bins.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")] = None,
) -> None:
    """Say whether FILE and OTHER agree within their standard errors, and draw both; exit code 1 if they do not."""
    with sentences():
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
    with sentences():
        from mitransient_lidar import resources

        names = resources.scene_names()
        width = max(map(len, names), default=0)
        for name in names:
            typer.echo(f"{name:{width}}  {resources.scene_summary(name)}".rstrip())


@scenes_app.command("show")
def show_scene(name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")]) -> None:
    """Print the XML of a scene."""
    with sentences():
        from mitransient_lidar.resources import scene_text

        typer.echo(scene_text(name), nl=False)


@scenes_app.command("copy")
def copy_scene(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a shipped scene.")],
    destination: Annotated[Path, typer.Argument(metavar="[DEST]", help="Folder, or path of the new file.")] = Path("."),
) -> None:
    """Copy a scene, in order to change it, and print the new path. Nothing is overwritten."""
    with sentences():
        from mitransient_lidar import resources

        typer.echo(resources.copy_scene(name, destination))


@app.command()
def info() -> None:
    """Print versions, the Mitsuba variant, and where LLVM was found."""
    with sentences():
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
    images: Annotated[bool, typer.Option("--images", help="A gate of 4 to 65536 pixels to 10 % instead.")] = False,
) -> None:
    """Measure the time to a given accuracy."""
    with sentences():
        if images:
            from mitransient_lidar import bench_images

            bench_images.run(json=json)
            return
        require(target_error is None or positive(target_error), "--target-error", target_error, "above 0")

        from mitransient_lidar import bench as benchmark

        benchmark.run(quick=quick, json=json, case=case, target_error=target_error)
