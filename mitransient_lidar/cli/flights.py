"""The command that flies a lidar along a trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import check_writable
from mitransient_lidar.cli.messages import exit_if_failed, reporting
from mitransient_lidar.cli.options import OUTPUT, Quiet
from mitransient_lidar.cli.overwriting import replace_freely
from mitransient_lidar.core.marks import read_mark


def fly(
    flight: Annotated[
        str, typer.Argument(metavar="FLIGHT", help="TOML file of a flight, or the name of a shipped one.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder of the files; output/FLIGHT by default."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes on this machine, 1 to 1024; by default one for each processor that may be used."),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A running Dask scheduler instead, as tcp://host:8786.")
    ] = None,
    shard_size: Annotated[
        int | None,
        typer.Option(
            help="Pulses that one process renders and writes, 1 to 1 000 000; by default an eighth of them, but "
            "512 to 1024."
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Render the pulses of a flight, and write the points and waveforms that its receiver finds.

    Writes points.laz, waveforms.las with waveforms.wdp, pictures, and the store flight.zarr of all pulses, and prints
    the errors of the points' heights against the truth [cm]. After an interruption, the same command goes on. Failed
    pulses end it with exit code 1. docs/guide/flights.md describes the file.
    """
    folder = output or OUTPUT / Path(flight).stem
    from mitransient_lidar.campaigns.store import Store
    from mitransient_lidar.flights.fly import STORE
    from mitransient_lidar.flights.fly import fly as render_flight
    from mitransient_lidar.flights.products import Flown, describe_points
    from mitransient_lidar.plots.point_clouds import plot_flight

    files = [folder / name for name in ("points.laz", "waveforms.las", "waveforms.wdp", "flight.png", "profile.png")]
    if (folder / STORE).is_dir():  # which goes on only if it is of this flight
        replace_freely(path for path in files if _is_of_a_flight(path))
    check_writable(folder, files)
    with reporting(quiet) as progress:
        points = render_flight(
            flight, folder, workers=workers, scheduler=scheduler, shard_size=shard_size, progress=progress
        )
    flown = Flown.of(Store(folder / STORE))
    for name in ("points.laz", "waveforms.las", "waveforms.wdp"):
        typer.echo(folder / name)
    for path in plot_flight(flown, points, folder):
        typer.echo(path)
    typer.echo("\n".join(describe_points(points)))
    exit_if_failed(folder / STORE)


def _is_of_a_flight(path: Path) -> bool:
    """Return whether a command has written a file of points, waveforms or pictures of a flight."""
    from mitransient_lidar.flights.las_header import is_simulated

    return (read_mark(path) or {}).get("command") == "fly" or is_simulated(path)
