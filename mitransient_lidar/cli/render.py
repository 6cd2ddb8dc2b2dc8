"""Commands that render a scene with the laser, shot by shot or by daylight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitransient_lidar.cli import files
from mitransient_lidar.cli.generator import OUTPUT, Call, Commands, Quiet, function_at
from mitransient_lidar.cli.messages import exit_if_interrupted, summarise
from mitransient_lidar.core.errors import UserError, WriteError
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.options import Option

if TYPE_CHECKING:
    import xarray as xr

COMMANDS = Commands()

Folder = Annotated[Path, Option("Folder for the files; created if missing")]


@COMMANDS.add("Render", "rendering.render:render", "table1 -D wind_speed=5 --target-error 0.05")
def _render(
    call: Call,
    output: Folder = OUTPUT,
    plot: Annotated[bool, Option("Draw waveforms, pixels and gates")] = True,
    gif: Annotated[bool, Option("Also write a gate animation")] = False,
    mp4: Annotated[bool, Option("Also write a gate movie, by ffmpeg")] = False,
    html: Annotated[bool, Option("Also write a page that shows the gates in a browser")] = False,
    quiet: Quiet = False,
) -> None:
    """Render the waveforms and gates of a scene.

    Writes DIR/<scene>.exr, .nc, .png and _layout.png (the pixels on the sea), and prints the paths. A scene with
    gates gives <scene>_gates.exr, _gates.png and _depth.png as well, or instead where memory is short. Light by
    origin and derivatives are in the .nc file, and drawn in _components.png and _derivatives.png; batches of passes
    are in the .nc file. The files appear together or not at all. Ctrl-C, SIGTERM and SIGHUP keep the completed
    passes, from the second one on.
    """
    scene = call.arguments["scene"]
    name, text, _ = files.scene_of(scene, "render")
    # Checked before the render: films with gates have the parameter gate_count.
    if (gif or mp4 or html) and "gate_count" not in text:
        raise UserError(f"{scene} has no gates to show: its film needs a gate_count, or cut some with gates")
    targets = [output / f"{name}{ending}" for ending in (".exr", ".nc", *((".png", "_layout.png") if plot else ()))]
    targets += [output / f"{name}_components.png"] if plot and call.arguments["components"] else []
    targets += [output / f"{name}_derivatives.png"] if plot and call.arguments["derivatives"] else []
    gates = files.GateFiles.of(output, name, drawings=plot, gif=gif, mp4=mp4, html=html)
    files.check_targets(output, [*targets, *gates.names()], scene)
    with DeferredInterrupt(at_once=False):
        dataset = call()
        if "waveform" not in dataset:
            targets = [output / f"{name}.nc"]
        with files.announced(output):
            for target in targets:
                _write(dataset, target)
            if "gate_energy" in dataset:
                gates.write(dataset, dataset, quiet)
    if not quiet:
        summarise(dataset)
    exit_if_interrupted(dataset)


#: Functions that draw a result, by their file name endings.
_DRAWINGS = {
    "_components": "plots.waveforms:plot_components",
    "_derivatives": "plots.waveforms:plot_derivatives",
    "_layout": "plots.layout:plot_layout",
    "": "plots.waveforms:plot_waveforms",
}


def _write(dataset: xr.Dataset, target: Path) -> None:
    """Write a result or its figure, but no EXR file beyond the memory, and no layout of pixels that miss the sea."""
    from mitransient_lidar import results
    from mitransient_lidar.results.attributes import split

    if target.suffix != ".nc":
        dataset, _ = split(dataset)
    dispensable = {".exr": "EXR file"}.get(target.suffix, "drawing of the pixels" * target.stem.endswith("_layout"))
    try:
        if target.suffix == ".exr":
            results.save(dataset.drop_dims(["gate", "origin", "parameter", "batch"], errors="ignore"), target)
        elif target.suffix == ".nc":
            results.save(dataset, target)
        else:
            function_at(next(_DRAWINGS[end] for end in _DRAWINGS if target.stem.endswith(end)))(dataset, target)
    except WriteError:
        raise
    except UserError as error:
        if not dispensable:
            raise
        typer.echo(f"no {dispensable}: {error}", err=True)


@COMMANDS.add(
    "Render",
    "rendering.shots.series:render_shots",
    "table1 --count 20 --passes 4 -o output/shots.nc",
    defaults={"count": None, "seed": None},
)
def _shots(
    call: Call,
    places: Annotated[
        Path | None, Option("CSV file with shot locations, columns x and y [m], instead of random ones", form="FILE")
    ] = None,
    output: Annotated[Path, Option("NetCDF file for all shots")] = OUTPUT / "shots.nc",
    figure: Annotated[
        Path | None, Option("PNG, PDF or SVG file of the echoes against the slopes; also writes these data as .nc")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Render a series of shots over one sea.

    Writes one file with all waveforms, and the true slope, height and depth at each location, which record, echoes,
    retrieve and view read. With --figure it also correlates the echoes with the sea's slopes.
    """
    scene, given = call.arguments["scene"], call.arguments
    ways = {"--at": given["positions"], "--places": places, "--count": given["count"]}
    if len(used := [name for name, value in ways.items() if value]) > 1:
        raise UserError(f"{' and '.join(used[:2])} are alternatives: give one of them")
    files.check_suffix("--output", output, ".nc")
    files.check_figure(figure, ".nc", option="--figure")
    if figure is not None and figure.with_suffix(".nc") == output:
        raise UserError(f"--figure {figure} has its data in {output}, which holds the shots: give it another name")
    files.scene_of(scene, "shots")
    files.check_targets(output.parent, [output], scene)
    from mitransient_lidar import results
    from mitransient_lidar.plots.studies.shots import plot_shot_statistics
    from mitransient_lidar.rendering.again import is_result
    from mitransient_lidar.rendering.shots import series as study
    from mitransient_lidar.studies import shots as statistics

    if places is not None:
        given = {**given, "positions": study.read_places(places)}
    if is_result(scene):
        own = {name: given[name] for name in ("count", "positions", "move_target", "seed")}
        if where := [call.flags[name].lstrip("-") for name, value in own.items() if value]:
            raise UserError(f"{scene} is a series with its own places: leave out {' and '.join(where)}")
        if given["instrument"] is not None:
            raise UserError(f"{scene} has the lidar that it was rendered with: leave out --instrument")
    else:
        given = {"count": 20, **{name: value for name, value in given.items() if value is not None}}
    with DeferredInterrupt(at_once=False):
        series = _again(replace(call, arguments=given))()
        with files.announced(output.parent, figure and figure.parent):
            results.save(series, output)
            if figure is not None:
                measured = statistics.shot_statistics(series)
                plot_shot_statistics(measured, figure)
                files.write_netcdf(measured, figure.with_suffix(".nc"))
    if not quiet:
        typer.echo("\n".join(study.describe_shots(series)))
    if figure is not None:
        typer.echo("\n".join(statistics.describe_statistics(measured)))
    exit_if_interrupted(series)


@COMMANDS.add(
    "Render",
    "rendering.shots.frames:render_frames",
    "gated_mine --frames 4 --pulse-rate 100 --pass-share 0.1",
    defaults={name: None for name in ("pulse_rate_hz", "frames", "gate_order", "readout_s", "speed", "heading_deg")}
    | {"passes": None},
)
def _frames(
    call: Call,
    output: Folder = OUTPUT,
    plot: Annotated[bool, Option("Draw the mean over the frames")] = True,
    quiet: Quiet = False,
) -> None:
    """Render frames of gate images, each with its own pulses.

    Each gate in each frame has its own pulses, between which waves and platform move. Writes
    DIR/<scene>_frames.nc, and the mean over the frames as <scene>_frames_gates.exr, _gates.png and _depth.png.
    Ctrl-C keeps the completed frames.
    """
    scene = call.arguments["scene"]
    name, _, _ = files.scene_of(scene, "frames")
    target, gates = output / f"{name}_frames.nc", files.GateFiles.of(output, f"{name}_frames", drawings=plot)
    files.check_targets(output, [target, *gates.names()], scene)
    with DeferredInterrupt(at_once=False):
        frames = _again(call)()
        with files.announced(output):
            _write(frames, target)
            gates.write(frames, None, quiet)
    exit_if_interrupted(frames)


@COMMANDS.add(
    "Render",
    "rendering.passive:render_passive",
    "passive_sea --frames 10",
    defaults={"frames": None, "frame_step_s": None},
)
def _passive(
    call: Call,
    output: Folder = OUTPUT,
    plot: Annotated[bool, Option("Draw the image, or animate the frames")] = True,
    quiet: Quiet = False,
) -> None:
    """Render an image by daylight.

    Writes DIR/<scene>_passive.nc, .exr and .png (.gif of frames), and prints the paths. The limits of error, time
    and passes hold for each frame.
    """
    scene, frames = call.arguments["scene"], call.arguments["frames"]
    name, _, former = files.scene_of(scene, "passive")
    is_animation = (frames or len(former.get("frame_passes", [0]))) > 1
    suffixes = [".nc", ".exr", *([".png"] if plot else []), *([".gif"] if plot and is_animation else [])]
    targets = [output / f"{name}_passive{suffix}" for suffix in suffixes]
    files.check_targets(output, targets, scene)
    from mitransient_lidar.plots.gates.images import animate_passive, plot_passive
    from mitransient_lidar.results import save

    with DeferredInterrupt(at_once=False):
        image = _again(call)()
        writers: dict[str, Any] = {".gif": animate_passive, ".png": plot_passive}
        with files.announced(output):
            for target in targets:
                if target.suffix != ".gif" or "row" in image.dims:
                    writers.get(target.suffix, save)(image, target)
    if not quiet:
        typer.echo(f"mean radiance: {image.attrs['background_radiance']:.4g} W m^-2 sr^-1 nm^-1")
        if "background_power" in image:
            typer.echo(f"mean power per pixel: {float(image['background_power'].mean()):.4g} W")
    exit_if_interrupted(image)


def _again(call: Call) -> Call:
    """Return a call without the arguments not given, with the function that renders a result again for a result."""
    from mitransient_lidar.rendering.again import is_result
    from mitransient_lidar.rendering.render import render_again

    given = {name: value for name, value in call.arguments.items() if value is not None}
    if not is_result(given["scene"]):
        return replace(call, arguments=given)
    given["result"] = given.pop("scene")
    return replace(
        call, function=render_again, arguments={name: one for name, one in given.items() if one is not False}
    )
