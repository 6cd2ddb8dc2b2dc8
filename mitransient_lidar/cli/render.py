"""Commands that render a scene with the laser or by daylight."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitransient_lidar.cli.files import GateFiles, announced, check_targets, scene_of
from mitransient_lidar.cli.messages import exit_if_interrupted, reporting, summarise
from mitransient_lidar.cli.options import (
    OUTPUT,
    Define,
    Instrument,
    Quiet,
    SceneOrResult,
    Sensor,
    parameters,
    render_options,
)
from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.core.interruption import DeferredInterrupt

if TYPE_CHECKING:
    import xarray as xr

Folder = Annotated[Path, typer.Option("-o", "--output", help="Folder for the files; created if missing.")]


@render_options(
    *("target_error", "target_quantile", "max_time", "passes", "seed", "max_memory", "components", "derivatives"),
    *("batches", "variant"),
)
def render(
    scene: SceneOrResult,
    define: Define = None,
    output: Folder = OUTPUT,
    instrument: Instrument = None,
    sensor: Sensor = None,
    integrator: Annotated[str | None, typer.Option(help="Integrator to use instead of the scene's.")] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw waveforms, pixels and gates.")] = True,
    gif: Annotated[bool, typer.Option("--gif", help="Also write an animation of the gates.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="Also write a movie of the gates, by ffmpeg.")] = False,
    html: Annotated[bool, typer.Option("--html", help="Also write a page that shows the gates in a browser.")] = False,
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Render the waveforms and gates of a scene.

    Writes DIR/<scene>.exr, .nc, .png and _layout.png (the pixels on the sea), and prints the paths. A scene with gates
    gives <scene>_gates.exr, _gates.png and _depth.png as well, or instead where memory is short. Light by origin and
    derivatives are in the .nc file, and drawn in _components.png and _derivatives.png; batches of passes are in the .nc
    file. The files appear together or not at all. Ctrl-C, SIGTERM and SIGHUP keep the completed passes, from the second
    one on.
    """
    params = parameters(define)
    name, text, _ = scene_of(scene, "render")
    # Checked before the render: films with gates have the parameter gate_count.
    if (gif or mp4 or html) and "gate_count" not in text:
        raise UserError(f"{scene} has no gates to show: its film needs a gate_count, or cut some with gates.")
    targets = [output / f"{name}{ending}" for ending in (".exr", ".nc", *((".png", "_layout.png") if plot else ()))]
    targets += [output / f"{name}_components.png"] if plot and options["components"] else []
    targets += [output / f"{name}_derivatives.png"] if plot and options["derivatives"] else []
    gates = GateFiles.of(output, name, drawings=plot, gif=gif, mp4=mp4, html=html)
    check_targets(output, [*targets, *gates.names()], scene)
    from mitransient_lidar.rendering import render as rendering

    with DeferredInterrupt(at_once=False):
        with reporting(quiet) as progress:
            chosen: dict[str, Any] = {"instrument": instrument, "sensor": sensor, "integrator": integrator}
            dataset = rendering.render(scene, params=params, progress=progress, **chosen, **options)
        output.mkdir(parents=True, exist_ok=True)
        if "waveform" not in dataset:
            targets = [output / f"{name}.nc"]
        with announced():
            for target in targets:
                _write(dataset, target)
            if "gate_energy" in dataset:
                gates.write(dataset, dataset, quiet)
    if not quiet:
        summarise(dataset)
    exit_if_interrupted(dataset)


def _write(dataset: xr.Dataset, target: Path) -> None:
    """Write a result or a figure of it, except EXR files beyond the memory, and a layout of pixels beside the sea."""
    from mitransient_lidar import results

    if target.suffix == ".exr":
        try:
            results.save(dataset.drop_dims(["gate", "origin", "parameter", "batch"], errors="ignore"), target)
        except WriteError:
            raise
        except UserError as error:
            typer.echo(f"no EXR file: {error}", err=True)
    elif target.suffix == ".nc":
        results.save(dataset, target)
    elif target.stem.endswith("_components"):
        from mitransient_lidar.plots.waveforms import plot_components

        plot_components(dataset, target)
    elif target.stem.endswith("_derivatives"):
        from mitransient_lidar.plots.derivatives import plot_derivatives

        plot_derivatives(dataset, target)
    elif not target.stem.endswith("_layout"):
        from mitransient_lidar.plots.waveforms import plot_waveforms

        plot_waveforms(dataset, target)
    else:
        from mitransient_lidar.plots.layout import plot_layout

        try:
            plot_layout(dataset, target)
        except WriteError:
            raise
        except UserError as error:
            typer.echo(f"no drawing of the pixels: {error}", err=True)


@render_options("target_error", "target_quantile", "max_time", "passes", "seed", "variant")
def passive(
    scene: SceneOrResult,
    define: Define = None,
    output: Folder = OUTPUT,
    sensor: Sensor = None,
    frames: Annotated[
        int | None, typer.Option(help="Number of frames of an animation, 1 to 10 000; 1 by default.")
    ] = None,
    frame_step: Annotated[
        float | None, typer.Option(help="Time between frames [s], greater than 0; 0.1 by default.")
    ] = None,
    filter_width_nm: Annotated[
        float | None,
        typer.Option(help="Width of the receiver's filter [nm], greater than 0, for the power of the daylight."),
    ] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw the image, or animate the frames.")] = True,
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Render an image by daylight.

    Writes DIR/<scene>_passive.nc, .exr and .png (.gif of frames), and prints the paths. The limits of error, time and
    passes hold for each frame.
    """
    params = parameters(define)
    name, _, former = scene_of(scene, "passive")
    is_animation = (frames or len(former.get("frame_passes", [0]))) > 1
    suffixes = [".nc", ".exr", *([".png"] if plot else []), *([".gif"] if plot and is_animation else [])]
    targets = [output / f"{name}_passive{suffix}" for suffix in suffixes]
    check_targets(output, targets, scene)
    from mitransient_lidar.plots import passive as passive_plots
    from mitransient_lidar.rendering.again import is_result
    from mitransient_lidar.rendering.passive import render_passive
    from mitransient_lidar.rendering.render import render_again
    from mitransient_lidar.results import save

    series = {"sensor": sensor, "frames": frames, "frame_step_s": frame_step, "filter_width_nm": filter_width_nm}
    options |= {option: value for option, value in series.items() if value is not None}
    with DeferredInterrupt(at_once=False):
        with reporting(quiet) as progress:
            image = (render_again if is_result(scene) else render_passive)(
                scene, params=params, progress=progress, **options
            )
        output.mkdir(parents=True, exist_ok=True)
        writers: dict[str, Callable[[xr.Dataset, Path], object]] = {
            ".gif": passive_plots.animate_passive,
            ".png": passive_plots.plot_passive,
        }
        with announced():
            for target in targets:
                if target.suffix != ".gif" or "row" in image.dims:
                    writers.get(target.suffix, save)(image, target)
    if not quiet:
        typer.echo(f"mean radiance: {image.attrs['background_radiance']:.4g} W m^-2 sr^-1 nm^-1")
        if "background_power" in image:
            typer.echo(f"mean power of a pixel: {float(image['background_power'].mean()):.4g} W")
    exit_if_interrupted(image)
