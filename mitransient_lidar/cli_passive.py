"""The command that renders pictures by daylight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli_studies import Define, Quiet, Scene, Seed
from mitransient_lidar.cli_support import parameters, positive, reporting, require, require_writable, sentences

_INTERRUPTED = 130  # what shells report after Ctrl-C


def passive(
    scene: Scene,
    define: Define = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", "--out", help="Folder for the results; created if missing.")
    ] = Path("."),
    frames: Annotated[int, typer.Option(help="Number of frames of moving pictures.")] = 1,
    frame_step: Annotated[float, typer.Option(help="Time between frames [s], by which the sea moves on.")] = 0.1,
    filter_width_nm: Annotated[
        float | None, typer.Option(help="Width of the receiver's filter [nm], for the power of the daylight.")
    ] = None,
    target_error: Annotated[float | None, typer.Option(help="Stop a frame at this relative standard error.")] = None,
    max_time: Annotated[float | None, typer.Option(help="Stop a frame after this many seconds.")] = None,
    passes: Annotated[int | None, typer.Option(help="Number of independent passes of a frame.")] = None,
    seed: Seed = 0,
    variant: Annotated[str | None, typer.Option(help="Mitsuba variant, e.g. llvm_ad_mono.")] = None,
    plot: Annotated[bool, typer.Option("--plot/--no-plot", help="Draw the picture, or animate the frames.")] = True,
    quiet: Quiet = False,
) -> None:
    """Render what SCENE looks like by daylight to DIR/<scene>_passive.nc, .exr and .png (.gif of frames)."""
    with sentences():
        require(1 <= frames <= 10_000, "--frames", frames, "1 to 10000")
        require(positive(frame_step), "--frame-step", frame_step, "above 0")
        width_is_valid = filter_width_nm is None or positive(filter_width_nm)
        require(width_is_valid, "--filter-width-nm", filter_width_nm, "above 0")
        require(target_error is None or positive(target_error), "--target-error", target_error, "above 0")
        require(max_time is None or positive(max_time), "--max-time", max_time, "above 0")
        require(passes is None or passes >= 2, "--passes", passes, "at least 2")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])

        from mitransient_lidar.resources import scene_path

        stem = output / f"{scene_path(scene).stem}_passive"
        suffixes = [".nc", ".exr", *([".png"] if plot else []), *([".gif"] if plot and frames > 1 else [])]
        targets = [stem.with_name(stem.name + suffix) for suffix in suffixes]
        require_writable(output, targets)

        from mitransient_lidar import passive as imaging
        from mitransient_lidar import passive_plots

        with reporting(quiet) as progress:
            picture = imaging.render_passive(
                scene,
                params,
                target_error=target_error,
                max_time=max_time,
                passes=passes,
                seed=seed,
                frames=frames,
                frame_step_s=frame_step,
                filter_width_nm=filter_width_nm,
                variant=variant,
                progress=progress,
            )
        output.mkdir(parents=True, exist_ok=True)
        is_imager = "row" in picture.dims
        for target in targets:
            if target.suffix == ".gif":
                if not is_imager:
                    continue
                passive_plots.animate_passive(picture, target)
            elif target.suffix == ".png":
                passive_plots.plot_passive(picture, target)
            else:
                imaging.save(picture, target)
            typer.echo(target)
        if not quiet:
            typer.echo(f"mean radiance: {picture.attrs['background_radiance']:.4g} W m^-2 sr^-1 nm^-1")
            if "background_power" in picture:
                typer.echo(f"mean power of a pixel: {float(picture['background_power'].mean()):.4g} W")
        if picture.attrs["interrupted"]:
            typer.echo("interrupted; what was rendered is kept.", err=True)
            raise typer.Exit(_INTERRUPTED)
