"""Commands for studies that take several renders, and for the properties of waters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import (
    announced,
    check_figure,
    check_suffix,
    check_targets,
    scene_of,
    write_figure,
)
from mitransient_lidar.cli.messages import exit_if_interrupted, reporting
from mitransient_lidar.cli.options import (
    OUTPUT,
    RECEIVERS,
    Define,
    DrawingOnly,
    Instrument,
    MaxTime,
    Quiet,
    Scene,
    SceneOrResult,
    Seed,
    Sensor,
    numbers,
    pair,
    parameters,
    render_options,
)
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.interruption import DeferredInterrupt

TargetId = Annotated[str, typer.Option(help="Id of the shape that is the target.")]
Figure = Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; also writes the data as .nc.")]


def find_shots(
    scene: Scene,
    define: Define = None,
    at: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="A place [m], instead of a search. Repeatable.")
    ] = None,
    slope_sigmas: Annotated[float, typer.Option(help="Slopes to find, in standard deviations, greater than 0.")] = 2.0,
    count: Annotated[int, typer.Option(help="Places of each kind, 1 to 100.")] = 1,
    output: Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file to write.")] = OUTPUT
    / "find_shots.png",
    waveforms: Annotated[bool, typer.Option("--waveforms/--no-waveforms", help="Also render the shots.")] = True,
    max_time: Annotated[
        float | None,
        typer.Option(help="Stop before this many seconds, with fewer passes or waveforms (greater than 0)."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Find places of the sea where the beam meets given slopes.

    Lists places whose slope faces the lidar (towards, away), is level or sideways, and draws them.
    """
    params = parameters(define)
    places = [pair("--at", text) for text in at or []]
    check_figure(output)
    from mitransient_lidar.plots.studies.find_shots import plot_found_shots
    from mitransient_lidar.studies import find_shots as study

    with reporting(quiet) as progress:
        if places:
            found = study.shots_at(scene, places, params)
        else:
            found = study.find_shots(scene, params, slope_sigmas=slope_sigmas, count=count)
        options: dict[str, Any] = {"waveforms": waveforms, "max_time": max_time, "progress": progress}
        rendered = study.render_found_shots(scene, found, params, **options)
    typer.echo(f"{'kind':<10}{'aim_x':>10}{'aim_y':>10}{'along (deg)':>13}{'across (deg)':>14}")
    for shot in found:
        along, across = (math.degrees(math.atan(slope)) for slope in (shot.along, shot.across))
        typer.echo(f"{shot.kind:<10}{shot.x:>10.2f}{shot.y:>10.2f}{along:>13.2f}{across:>14.2f}")
    output.parent.mkdir(parents=True, exist_ok=True)
    with announced():
        plot_found_shots(rendered, output)
    for result in rendered.results[:1]:
        exit_if_interrupted(result)


@render_options(
    "components",
    target_error="Relative standard error of the median bin, instead of full passes (greater than 0).",
    max_time="Stop before this many seconds for all shots, with fewer passes or shots (greater than 0).",
    passes="Most passes of each shot (2 to 10000), 8 by default, 400 with a target error.",
)
def shots(
    scene: SceneOrResult,
    define: Define = None,
    instrument: Instrument = None,
    sensor: Sensor = None,
    count: Annotated[
        int | None, typer.Option(help="Number of shots at random places, 2 to 100 000; 20 by default.")
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="Place of a shot [m], instead of random ones. Repeatable.")
    ] = None,
    places: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="CSV file of places, columns x and y [m], instead of random ones."),
    ] = None,
    move_target: Annotated[
        bool, typer.Option("--move-target", help="Keep the target's place relative to the aim of each shot.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of random places, 0 to 2^53; 1 by default.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="NetCDF file of all shots.")] = OUTPUT / "shots.nc",
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Render a series of shots over one sea.

    Writes one file of all waveforms, with the true slope, height and depth at each place, which record, waveforms,
    retrieve and plot read.
    """
    if at and places is not None:
        raise UserError("--at and --places are alternatives: give one of them.")
    check_suffix("--output", output, ".nc")
    scene_of(scene, "shots")
    check_targets(output.parent, [output], scene)
    from mitransient_lidar import results
    from mitransient_lidar.rendering.again import is_result
    from mitransient_lidar.rendering.render import render_again
    from mitransient_lidar.rendering.shots import series as study

    given: Any = [pair("--at", text) for text in at] if at else None
    if places is not None:
        given = study.read_places(places)
    every = {"count": count, "positions": given, "move_target": move_target or None, "seed": seed}
    where = {name: value for name, value in every.items() if value is not None}
    if is_result(scene) and where:
        raise UserError(f"{scene} is a series with its own places: leave out {' and '.join(where)}.")
    if instrument is not None:
        if is_result(scene):
            raise UserError(f"{scene} has the lidar that it was rendered with: leave out --instrument.")
        options["instrument"] = instrument
    options["sensor"] = sensor
    default = {} if is_result(scene) else {"count": 20}
    render = render_again if is_result(scene) else study.render_shots
    with DeferredInterrupt(at_once=False):
        with reporting(quiet) as progress:
            series = render(scene, params=parameters(define), progress=progress, **{**default, **where}, **options)
        output.parent.mkdir(parents=True, exist_ok=True)
        with announced():
            results.save(series, output)
    if not quiet:
        _print(study.describe_shots(series))
    exit_if_interrupted(series)


def shot_statistics(
    scene: Scene,
    define: Define = None,
    count: Annotated[int, typer.Option(help="Number of shots, 2 to 100 000.")] = 200,
    max_time: Annotated[
        float | None, typer.Option(help="Stop before this many seconds, with fewer shots (greater than 0).")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of their places, 0 to 2^53.")] = 1,
    output: Figure = OUTPUT / "shot_statistics.png",
    quiet: Quiet = False,
) -> None:
    """Correlate the echoes of random shots with the sea's slopes."""
    check_figure(output, ".nc")
    from mitransient_lidar.plots.studies.shot_statistics import plot_shot_statistics
    from mitransient_lidar.studies import shot_statistics as study

    with reporting(quiet) as progress:
        shots = study.shot_statistics(
            scene, parameters(define), count=count, seed=seed, max_time=max_time, progress=progress
        )
    write_figure(shots, output, plot_shot_statistics)
    for name, value in study.slope_correlations(shots).items():
        typer.echo(f"correlation of {name} with the slope: {value:+.3f}")
    exit_if_interrupted(shots)


def target_signal(
    scene: Scene,
    define: Define = None,
    target_id: TargetId = "target",
    grid: Annotated[int, typer.Option(help="Places of the target along each axis, 1 to 15.")] = 1,
    max_offset: Annotated[
        float, typer.Option(help="Largest offset of these places along each axis [m], greater than 0.")
    ] = 2.0,
    passes: Annotated[int, typer.Option(help="Number of independent passes of each render, 16 to 100 000.")] = 64,
    max_time: Annotated[
        float | None,
        typer.Option(
            help="Stop before this many seconds, shared among the places, with fewer passes, 16 of each place or "
            "more (greater than 0)."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random numbers, -2^63 to 2^63 - 1.")] = 0,
    output: Figure = OUTPUT / "target_signal.png",
    quiet: Quiet = False,
) -> None:
    """Measure the signal of a target in each pixel.

    Renders the scene with and without the target on the same random numbers, and combines the pixels.
    """
    params = parameters(define)
    check_figure(output, ".nc")
    from mitransient_lidar.plots.studies.target_signal import plot_target_map, plot_target_signal
    from mitransient_lidar.studies import target_signal as study

    options: dict[str, Any] = {"target_id": target_id, "passes": passes, "max_time": max_time, "seed": seed}
    offsets = study.grid_offsets(grid, max_offset)
    with reporting(quiet) as progress:
        if grid == 1:
            found = study.target_signal(scene, params, progress=progress, **options)
        else:
            found = study.target_map(scene, params, x=offsets, y=offsets, progress=progress, **options)
    write_figure(found, output, plot_target_signal if grid == 1 else plot_target_map)
    _print(study.describe_target(found) if grid == 1 else study.describe_map(found))
    exit_if_interrupted(found)


def detect(
    scene: Scene,
    define: Define = None,
    receiver: Annotated[str, typer.Option(help=RECEIVERS)] = "apd",
    pfa: Annotated[float, typer.Option(help="Probability of false alarm, 1e-12 to 0.5.")] = 1e-3,
    pd: Annotated[
        float, typer.Option(help="Required probability of detection, above that of false alarm and below 1.")
    ] = 0.9,
    depths: Annotated[
        str | None,
        typer.Option(metavar="D1,D2,...", help="Further depths of the target [m], greater than 0, increasing."),
    ] = None,
    shots: Annotated[
        int, typer.Option(help="Number of simulated shots with and without the target, 100 to 100 000.")
    ] = 10_000,
    clutter: Annotated[
        int, typer.Option(help="Number of seas whose differences count as noise, 4 to 1000; 0: one known sea.")
    ] = 0,
    renders: Annotated[int, typer.Option(help="Renders of one sea, 3 to 1000; their spread gives the intervals.")] = 4,
    target_id: TargetId = "target",
    background_power_w: Annotated[
        float, typer.Option(help="Power of the daylight on each pixel [W], at least 0.")
    ] = 0.0,
    passes: Annotated[int, typer.Option(help="Number of independent passes of each render, 16 to 100 000.")] = 16,
    max_time: Annotated[
        float | None,
        typer.Option(
            help="Begin no further depth of --depths after this many seconds, and leave it out; the scene's own depth "
            "is always rendered (greater than 0)."
        ),
    ] = None,
    seed: Seed = 0,
    output: Figure = OUTPUT / "detection.png",
    quiet: Quiet = False,
) -> None:
    """Compute how well a target is detected.

    Compares one pixel, the sum and the best combination of pixels.
    """
    places = numbers("--depths", depths) if depths else []
    check_figure(output, ".nc")
    from mitransient_lidar.plots.studies.detection import plot_detection
    from mitransient_lidar.studies import detection as study

    with reporting(quiet) as progress:
        found = study.detect(
            scene,
            parameters(define),
            receiver=receiver,
            pfa=pfa,
            pd=pd,
            depths=places,
            shots=shots,
            clutter=clutter,
            renders=renders,
            target_id=target_id,
            background_power_w=background_power_w,
            passes=passes,
            max_time=max_time,
            seed=seed,
            progress=progress,
        )
    write_figure(found, output, plot_detection)
    _print(study.describe_detection(found))


def beam_spread(
    scene: Scene,
    depths: Annotated[
        str, typer.Option(metavar="D1,D2,...", help="Depths below the mean sea level [m], greater than 0.")
    ],
    define: Define = None,
    passes: Annotated[int, typer.Option(help="Number of independent passes of each render, 2 to 10 000.")] = 8,
    max_time: MaxTime = None,
    seed: Seed = 0,
    output: Figure = OUTPUT / "beam_spread.png",
    quiet: Quiet = False,
) -> None:
    """Measure the spread of the laser's light at depths.

    Horizontal spread, delays, and share of the light within the field of view.
    """
    wanted = numbers("--depths", depths)
    check_figure(output, ".nc")
    from mitransient_lidar.plots.studies.beam_spread import plot_beam_spread
    from mitransient_lidar.studies import beam_spread as study

    options: dict[str, Any] = {"passes": passes, "max_time": max_time, "seed": seed}
    with reporting(quiet) as progress:
        found = study.beam_spread(scene, wanted, parameters(define), progress=progress, **options)
    write_figure(found, output, plot_beam_spread)
    if not quiet:
        _print(study.describe_spread(found))
    exit_if_interrupted(found)


def estimate(
    scene: Scene,
    define: Define = None,
    instrument: Instrument = None,
    paths: Annotated[int, typer.Option(help="Number of paths of the light, 64 to 2^22.")] = 2**13,
    seed: Seed = 0,
    output: Figure = OUTPUT / "estimate.png",
) -> None:
    """Estimate the waveforms in a second, over a level sea and without targets.

    Lidar equation with sampled forward scattering: a first look, and a second opinion on a render.
    """
    check_figure(output, ".nc")
    from mitransient_lidar.plots.waveforms import plot_components
    from mitransient_lidar.studies import estimate as study

    found = study.estimate(scene, parameters(define), instrument=instrument, paths=paths, seed=seed)
    write_figure(found, output, plot_components)
    _print(study.describe_estimate(found))


def fov_sweep(
    scene: Scene,
    define: Define = None,
    fov_mrad: Annotated[
        str, typer.Option(metavar="F1,F2,...", help="Full angles of the fields of view [mrad], greater than 0.")
    ] = "2,5,10,20,50,100",
    min_depth: Annotated[
        float,
        typer.Option(help="Depth where the slope of the signal begins [m], at least 0 and below the surface echo."),
    ] = 1.0,
    max_depth: Annotated[
        float,
        typer.Option(help="Depth where it ends [m], greater than 0 and than --min-depth, above bottom and targets."),
    ] = 5.0,
    passes: Annotated[int, typer.Option(help="Number of independent passes of each render, 4 to 10 000.")] = 48,
    max_time: Annotated[
        float | None,
        typer.Option(
            help="Stop before this many seconds, without the widest fields of view, but with the narrowest one "
            "(greater than 0)."
        ),
    ] = None,
    seed: Seed = 0,
    output: Figure = OUTPUT / "fov_sweep.png",
    quiet: Quiet = False,
) -> None:
    """Measure the water's attenuation for several fields of view."""
    wanted = numbers("--fov-mrad", fov_mrad)
    check_figure(output, ".nc")
    from mitransient_lidar.plots.studies.fov_sweep import plot_fov_sweep
    from mitransient_lidar.studies import fov_sweep as study

    options: dict[str, Any] = {"min_depth": min_depth, "max_depth": max_depth, "passes": passes, "seed": seed}
    options["max_time"] = max_time
    with reporting(quiet) as progress:
        found = study.fov_sweep(scene, wanted, parameters(define), progress=progress, **options)
    write_figure(found, output, plot_fov_sweep)
    _print(study.describe_fov_sweep(found))
    exit_if_interrupted(found)


def scattering_orders(
    scene: Scene,
    define: Define = None,
    orders: Annotated[int, typer.Option(help="Number of orders to separate, 1 to 62.")] = 8,
    passes: Annotated[int, typer.Option(help="Number of independent passes of each render, 2 to 100 000.")] = 32,
    max_time: MaxTime = None,
    seed: Seed = 0,
    output: Figure = OUTPUT / "scattering_orders.png",
    quiet: Quiet = False,
) -> None:
    """Separate the received light by the number of scatterings.

    Each order is also separated by the number of reversals of the vertical direction: one, or several.
    """
    check_figure(output, ".nc")
    from mitransient_lidar.plots.studies.scattering_orders import plot_scattering_orders
    from mitransient_lidar.studies import scattering_orders as study

    options: dict[str, Any] = {"orders": orders, "passes": passes, "max_time": max_time, "seed": seed}
    with reporting(quiet) as progress:
        found = study.scattering_orders(scene, parameters(define), progress=progress, **options)
    write_figure(found, output, plot_scattering_orders)
    _print(study.describe_orders(found))
    exit_if_interrupted(found)


def water(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="jerlov, chlorophyll, kd, secchi, petzold, profile or pure.")
    ],
    value: Annotated[
        str | None,
        typer.Argument(
            metavar="VALUE",
            help="Jerlov type, chlorophyll [mg/m^3], Kd [1/m], Secchi depth [m], Petzold's clear, coastal or turbid, "
            "or a profile's file: .csv, .txt, .dat, .tsv or .nc.",
        ),
    ] = None,
    wavelength: Annotated[
        float, typer.Option(help="Wavelength [nm], 400 to 700; less of Jerlov's and Petzold's waters.")
    ] = 532.0,
    temperature: Annotated[float, typer.Option(help="Temperature [degrees Celsius], 0 to 30, for the indices.")] = 20.0,
    salinity: Annotated[float, typer.Option(help="Salinity [per mille], 0 to 40, for the indices.")] = 35.0,
    tolerance: Annotated[
        float, typer.Option(help="Largest relative error of layers that replace a profile, 1e-5 to 0.5.")
    ] = 0.01,
    output: DrawingOnly = None,
) -> None:
    """Print the optical properties of a water and its parameters."""
    from mitransient_lidar.plots.water import plot_water
    from mitransient_lidar.studies import water_report as study

    check_figure(output)
    lines = study.describe_water(kind, value, wavelength, temperature, salinity, tolerance)
    with announced():
        if output is not None:
            plot_water(kind, value, wavelength, temperature, salinity, tolerance, output)
        _print(lines)


def _print(lines: list[str]) -> None:
    typer.echo("\n".join(lines))
