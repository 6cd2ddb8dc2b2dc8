"""Command for campaigns of many runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, check_writable
from mitransient_lidar.cli.messages import exit_if_failed, exit_if_interrupted, reporting
from mitransient_lidar.cli.options import Quiet
from mitransient_lidar.core.errors import UserError


def sweep(
    campaign: Annotated[
        Path,
        typer.Argument(metavar="CAMPAIGN", help="TOML file of a campaign, or the store of one to complete it."),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="Zarr store, by default beside the campaign; with --row .nc, with --show a figure."
        ),
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
            help="Runs that one process renders and writes, 1 to 1 000 000; by default a sixteenth of them, but 8 to "
            "1024."
        ),
    ] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Render runs that have failed again.")] = False,
    row: Annotated[
        int | None, typer.Option(help="Render the run of this number alone, from 0, to a NetCDF file.")
    ] = None,
    show: Annotated[
        bool, typer.Option("--show", help="Draw a sample of a store, its distributions and responses.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Render a campaign of many runs.

    Runs take other values of the scene's parameters, on the cores of this machine or on a Dask cluster, into one Zarr
    store. After an interruption, the same command goes on. Failed runs end it with exit code 1.
    docs/guide/campaigns.md describes the file.
    """
    _check_alternatives(workers, scheduler, row, show)
    if row is not None:
        path = output or campaign.with_name(f"{campaign.stem}_row{row}.nc")
        check_suffix("--output", path, ".nc")
        _render_row(campaign, row, path, quiet)
        return
    if show:
        _show(campaign, output or campaign.with_suffix(".png"))
        return
    from mitransient_lidar.campaigns import sweep as campaigns

    options: dict[str, Any] = {"workers": workers, "scheduler": scheduler, "retry_failed": retry_failed}
    if campaign.is_dir():
        if output is not None or shard_size is not None:
            given = "--output" if output is not None else "--shard-size"
            raise UserError(f"{given} is fixed in the store {campaign}: leave it out")
        store = campaign
        with reporting(quiet) as progress:
            campaigns.resume(store, progress=progress, **options)
    else:
        store = output or campaign.with_suffix(".zarr")
        check_writable(store.parent, [])
        with reporting(quiet) as progress:
            campaigns.sweep(campaign, store, shard_size=shard_size, progress=progress, **options)
    typer.echo(store)
    if not quiet:
        typer.echo("\n".join(campaigns.describe_campaign(store)))
    exit_if_failed(store)


def _check_alternatives(workers: int | None, scheduler: str | None, row: int | None, show: bool) -> None:
    """Raise `UserError` for options that exclude each other."""
    given = {"--workers": workers, "--scheduler": scheduler, "--row": row, "--show": show or None}
    used = [name for name, value in given.items() if value is not None]
    if len(used) > 1:
        raise UserError(f"{' and '.join(used[:2])} are alternatives: give one of them.")


def _render_row(campaign: Path, row: int, path: Path, quiet: bool) -> None:
    """Render one run to a NetCDF file."""
    from mitransient_lidar import results
    from mitransient_lidar.campaigns.sweep import render_row

    with reporting(quiet) as progress:
        series = render_row(campaign, row, progress=progress)
    path.parent.mkdir(parents=True, exist_ok=True)
    with announced():
        results.save(series, path)
    exit_if_interrupted(series)


def _show(store: Path, path: Path) -> None:
    """Draw a store."""
    check_figure(path)
    from mitransient_lidar.campaigns.store import open_campaign, reporting_damage
    from mitransient_lidar.campaigns.sweep import describe_campaign
    from mitransient_lidar.plots.campaigns import plot_campaign

    dataset = open_campaign(store)
    path.parent.mkdir(parents=True, exist_ok=True)
    with announced(), reporting_damage(store):
        plot_campaign(dataset, path)
    typer.echo("\n".join(describe_campaign(store)))
