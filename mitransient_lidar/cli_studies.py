"""Commands that study a scene, a sea or a water beyond one render."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli_support import (
    counting,
    keep_drawing,
    numbers,
    parameters,
    place,
    positive,
    prepare_drawing,
    require,
    sentences,
)

Scene = Annotated[str, typer.Argument(metavar="SCENE", help="Name of a shipped scene or path of an XML file.")]
Define = Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Set a scene parameter.")]
Seed = Annotated[int, typer.Option(help="Seed of the random numbers.")]
Drawing = Annotated[Path, typer.Option("-o", "--output", help="PNG, PDF or SVG file; a .nc lies beside it.")]
MaybeDrawing = Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file; a .nc beside it.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but results and errors.")]


def shots(
    scene: Scene,
    define: Define = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", metavar="X,Y", help="A place [m] instead of a search.")
    ] = None,
    steepness: Annotated[float, typer.Option(help="Slopes to find, in standard deviations.")] = 2.0,
    count: Annotated[int, typer.Option(help="Places of each kind.")] = 1,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="PNG, PDF or SVG file to draw.")] = None,
    waveforms: Annotated[bool, typer.Option("--waveforms/--no-waveforms", help="Render the shots, too.")] = True,
) -> None:
    """List places on the sea by the slope the beam meets there (towards, level, away, sideways), and draw them."""
    with sentences():
        require(positive(steepness), "--steepness", steepness, "above 0")
        require(1 <= count <= 100, "--count", count, "1 to 100")
        params = parameters(define or [])
        places = [place(text) for text in at or []]

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


def survey(
    scene: Scene,
    define: Define = None,
    count: Annotated[int, typer.Option(help="Number of shots.")] = 200,
    seed: Annotated[int, typer.Option(help="Seed of their places.")] = 1,
    output: Drawing = Path("survey.png"),
    quiet: Quiet = False,
) -> None:
    """Render shots at random places of the sea and show how their echoes go with the slope they meet."""
    with sentences():
        require(2 <= count <= 100_000, "--count", count, "2 to 100000")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])
        prepare_drawing(output)

        from mitransient_lidar import survey as surveying

        with counting(quiet, "shot") as progress:
            shots = surveying.survey(scene, params, count=count, seed=seed, progress=progress)
        correlations = keep_drawing(shots, output, surveying.plot_survey)
        for name, value in correlations.items():
            typer.echo(f"correlation of {name} with the slope: {value:+.3f}")


def spread(
    scene: Scene,
    depths: Annotated[str, typer.Option(metavar="D1,D2,...", help="Depths below the mean sea level [m].")],
    define: Define = None,
    passes: Annotated[int, typer.Option(help="Number of independent passes.")] = 8,
    seed: Seed = 0,
    output: Drawing = Path("spread.png"),
    quiet: Quiet = False,
) -> None:
    """Show how far the laser's light has spread at depths, sideways and in time, and what share the receiver sees."""
    with sentences():
        require(2 <= passes <= 10_000, "--passes", passes, "2 to 10000")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])
        wanted = numbers("--depths", depths)
        prepare_drawing(output)

        from mitransient_lidar import beam_spread
        from mitransient_lidar.beam_spread_plots import plot_beam_spread

        with counting(quiet, "pass") as progress:
            found = beam_spread.beam_spread(scene, wanted, params, passes=passes, seed=seed, progress=progress)
        keep_drawing(found, output, plot_beam_spread)
        if not quiet:
            for line in beam_spread.describe_spread(found):
                typer.echo(line)


def orders(
    scene: Scene,
    define: Define = None,
    count: Annotated[int, typer.Option("--orders", help="Orders to tell apart.")] = 8,
    passes: Annotated[int, typer.Option(help="Number of passes.")] = 32,
    seed: Seed = 0,
    output: MaybeDrawing = None,
    quiet: Quiet = False,
) -> None:
    """Tell how often the received light was scattered, and how much of it turned more than once."""
    with sentences():
        require(1 <= count <= 62, "--orders", count, "1 to 62")
        require(2 <= passes <= 100_000, "--passes", passes, "2 to 100000")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])
        prepare_drawing(output)

        from mitransient_lidar import scattering_orders

        with counting(quiet, "pass") as progress:
            found = scattering_orders.scattering_orders(
                scene, params, orders=count, passes=passes, seed=seed, progress=progress
            )
        if output is not None:
            keep_drawing(found, output, scattering_orders.plot_orders)
        typer.echo(f"{'order':<8}{'energy (J)':>22}{'share (%)':>12}{'several turns (%)':>20}")
        for name, energy, error, share, several in scattering_orders.shares(found):
            known = f"{energy:.3e} +- {error:.0e}"
            typer.echo(f"{name:<8}{known:>22}{100 * share:>12.3f}{100 * several:>20.3f}")


def views(
    scene: Scene,
    define: Define = None,
    fields: Annotated[
        str, typer.Option(metavar="F1,F2,...", help="Full angles of the fields of view in mrad.")
    ] = "2,5,10,20,50,100",
    from_depth: Annotated[float, typer.Option("--from", help="Depth in m from which the slope is measured.")] = 1.0,
    to_depth: Annotated[float, typer.Option("--to", help="Depth in m to which it is measured.")] = 5.0,
    passes: Annotated[int, typer.Option(help="Number of independent passes for each field.")] = 48,
    seed: Seed = 0,
    output: Drawing = Path("views.png"),
    quiet: Quiet = False,
) -> None:
    """Show how the slope of the column signal goes with the field of view, between c and a."""
    with sentences():
        require(4 <= passes <= 10_000, "--passes", passes, "4 to 10000")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])
        wanted = numbers("--fields", fields)
        prepare_drawing(output)

        from mitransient_lidar import column_views

        depths = {"from_depth": from_depth, "to_depth": to_depth}
        with counting(quiet, "pass") as progress:
            found = column_views.views(scene, wanted, params, **depths, passes=passes, seed=seed, progress=progress)
        keep_drawing(found, output, column_views.plot_views)
        for line in column_views.describe_views(found):
            typer.echo(line)


def target(
    scene: Scene,
    define: Define = None,
    shape: Annotated[str, typer.Option("--id", help="The id of the shape that is the target.")] = "target",
    grid: Annotated[int, typer.Option(help="Places along each axis to move the target to, 1 to 15.")] = 1,
    reach: Annotated[float, typer.Option(help="How far the outermost places are from the middle [m].")] = 2.0,
    passes: Annotated[int, typer.Option(help="Number of passes of each render.")] = 64,
    seed: Seed = 0,
    output: MaybeDrawing = None,
    quiet: Quiet = False,
) -> None:
    """Measure a target's own signal: with and without it on the same random numbers, by pixel and best combined."""
    with sentences():
        require(1 <= grid <= 15, "--grid", grid, "1 to 15")
        require(positive(reach), "--reach", reach, "above 0")
        require(16 <= passes <= 100_000, "--passes", passes, "16 to 100000")
        require(seed >= 0, "--seed", seed, "0 or above")
        params = parameters(define or [])
        prepare_drawing(output)

        from mitransient_lidar import target_plots, target_signal

        options: dict[str, Any] = {"target": shape, "passes": passes, "seed": seed}
        lines: list[str]
        draw: Any
        if grid > 1:
            offsets = [reach * (2 * i / (grid - 1) - 1) for i in range(grid)]
            with counting(quiet, "place") as progress:
                found = target_signal.target_map(scene, params, x=offsets, y=offsets, progress=progress, **options)
            lines, draw = target_signal.describe_map(found), target_plots.plot_map
        else:
            with counting(quiet, "pass") as progress:
                found = target_signal.target_signal(scene, params, progress=progress, **options)
            lines, draw = target_signal.describe_target(found), target_plots.plot_target
        if output is not None:
            keep_drawing(found, output, draw)
        for line in lines:
            typer.echo(line)


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
    with sentences():
        from mitransient_lidar import water_kinds

        lines = water_kinds.describe_water(kind, value, wavelength, temperature, salinity, tolerance)
        if output is not None:
            water_kinds.plot_water(kind, value, wavelength, temperature, salinity, tolerance, output)
            lines.append(str(output))
        for line in lines:
            typer.echo(line)


#: In the order in which the help lists them.
COMMANDS = (shots, survey, target, spread, orders, views, water)
