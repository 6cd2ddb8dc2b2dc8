"""Commands with many renders: campaigns, flights, and the published figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, check_targets, write_netcdf
from mitransient_lidar.cli.generator import OUTPUT, Call, Commands, Quiet
from mitransient_lidar.cli.messages import exit_if_failed, exit_if_interrupted
from mitransient_lidar.cli.overwriting import replace_freely
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.marks import read_mark
from mitransient_lidar.core.options import Option

COMMANDS = Commands()


@COMMANDS.add("Render", "campaigns.sweep:campaign", "bottoms.toml --workers 4")
def _campaign(
    call: Call,
    output: Annotated[
        Path | None,
        Option("Zarr store, by default beside the campaign; a NetCDF file with --row, a figure with --show"),
    ] = None,
    row: Annotated[int | None, Option("Render only the run with this number, from 0, to a NetCDF file")] = None,
    show: Annotated[bool, Option("Draw a sample of the store, its distributions and responses")] = False,
    quiet: Quiet = False,
) -> None:
    """Render a campaign of many runs.

    Each run has its own values of scene parameters. Runs use this machine's cores or a Dask cluster, and fill one
    Zarr store. After an interruption, the same command goes on. Failed runs end it with exit code 1.
    The documentation's guide Campaigns describes the file.
    """
    campaign = Path(call.arguments["campaign"])
    given = {name: call.arguments[name] for name in ("workers", "scheduler")} | {"row": row, "show": show or None}
    used = [f"--{name}" for name, value in given.items() if value is not None]
    if row is not None or show:
        used += [call.flags[name] for name in ("light", "shard_size", "retry_failed") if call.arguments[name]]
    if len(used) > 1:
        raise UserError(f"{' and '.join(used[:2])} are alternatives: give one of them")
    if row is not None:
        path = output or campaign.with_name(f"{campaign.stem}_row{row}.nc")
        check_suffix("--output", path, ".nc")
        from mitransient_lidar.campaigns.sweep import render_row

        series = replace(call, function=render_row, arguments={}, flags={"row": "--row"})(campaign, row)
        write_netcdf(series, path)
        exit_if_interrupted(series)
        return
    if show:
        _show(campaign, output or campaign.with_suffix(".png"))
        return
    from mitransient_lidar.campaigns import sweep as campaigns

    store = campaign if campaign.is_dir() else output or campaign.with_suffix(".zarr")
    if campaign.is_dir():
        given = {f"--{name.replace('_', '-')}": call.arguments[name] for name in ("light", "shard_size")}
        for name in [name for name, value in {"--output": output, **given}.items() if value is not None][:1]:
            raise UserError(f"{name} is fixed in the store {campaign}: leave it out")
        kept = {name: call.arguments[name] for name in ("workers", "scheduler", "retry_failed")}
        replace(call, function=campaigns.resume, arguments=kept)(store)
    else:
        check_targets(store.parent, [])
        call(store=store)
    typer.echo(store)
    if not quiet:
        typer.echo("\n".join(campaigns.describe_campaign(store)))
    exit_if_failed(store)


def _show(store: Path, path: Path) -> None:
    """Draw a store."""
    check_figure(path)
    from mitransient_lidar.campaigns.store import open_campaign, reporting_damage
    from mitransient_lidar.campaigns.sweep import describe_campaign
    from mitransient_lidar.plots.campaigns import plot_campaign

    dataset = open_campaign(store)
    with announced(path.parent), reporting_damage(store):
        plot_campaign(dataset, path)
    typer.echo("\n".join(describe_campaign(store)))


@COMMANDS.add("Render", "flights.fly:fly", "palmer")
def _fly(
    call: Call,
    output: Annotated[Path | None, Option("Folder for the files, by default output/FLIGHT", form="DIR")] = None,
    quiet: Quiet = False,
) -> None:
    """Render the pulses of a flight, and write the points and waveforms that its receiver finds.

    Writes points.laz, waveforms.las with waveforms.wdp, pictures, and the store flight.zarr with all pulses.
    Prints the points' height errors against the truth [cm]. After an interruption, the same command goes
    on. Failed pulses end it with exit code 1. The documentation's guide Flights describes the file.
    """
    folder = output or OUTPUT / Path(call.arguments["flight"]).stem
    from mitransient_lidar.campaigns.store import Store
    from mitransient_lidar.flights.fly import STORE
    from mitransient_lidar.flights.products import Flown, describe_points
    from mitransient_lidar.plots.point_clouds import plot_flight

    written = [folder / name for name in ("points.laz", "waveforms.las", "waveforms.wdp")]
    files = [*written, folder / "flight.png", folder / "profile.png"]
    if (folder / STORE).is_dir():  # which goes on only if it is of this flight
        replace_freely(path for path in files if _is_of_a_flight(path))
    check_targets(folder, files)
    points = call(folder=folder)
    for path in (*written, *plot_flight(Flown.of(Store(folder / STORE)), points, folder)):
        typer.echo(path)
    typer.echo("\n".join(describe_points(points)))
    exit_if_failed(folder / STORE)


def _is_of_a_flight(path: Path) -> bool:
    """Return whether a command has written a flight's points, waveforms or pictures."""
    from mitransient_lidar.flights.las_header import is_simulated

    return (read_mark(path) or {}).get("command") == "fly" or is_simulated(path)
