"""The command that measures the errors of an instrument's depths, for corrections."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import check_suffix, check_targets, write_netcdf
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.cli.options import RECEIVERS, Define, Quiet, Seed, numbers, parameters
from mitransient_lidar.core.errors import UserError


def depth_bias(
    instrument: Annotated[str, typer.Argument(metavar="INSTRUMENT", help="Name of the instrument.")],
    define: Define = None,
    angles: Annotated[
        str | None, typer.Option(metavar="DEGREES", help="Angles from nadir; the instrument's and 5 more by default.")
    ] = None,
    winds: Annotated[str, typer.Option(metavar="M/S", help="Wind speeds; 0 for a level sea with ripples.")] = "0,3,6",
    waters: Annotated[str, typer.Option(metavar="TYPES", help="Jerlov types from clear to turbid.")] = "IB,1C,5C",
    depths: Annotated[str, typer.Option(metavar="M", help="Depths of the bottom.")] = "3,6,10",
    scene: Annotated[str, typer.Option(help="Scene whose sea, water and bottom count.")] = "table1",
    receiver: Annotated[str | None, typer.Option(help=f"{RECEIVERS} By default the instrument's.")] = None,
    shots: Annotated[int, typer.Option(help="Random places of a sea with waves.")] = 12,
    records: Annotated[int, typer.Option(help="Records with noise of each place.")] = 5,
    corrections: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="Table of another seed to also correct the depths by; auto for the shipped one."
        ),
    ] = None,
    seed: Seed = 1,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="NetCDF file; INSTRUMENT_depths.nc by default.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the errors of the depths in an instrument's records.

    Renders the instrument over known bottoms, by angle, wind, water and depth, records it with the noise of its
    receiver, measures the depths, and prints share found, bias, spread and stated error of the estimator gaussian [cm].
    The file holds all estimators; waveforms --correct takes it.
    """
    target = output or Path(f"{instrument}_depths.nc")
    check_suffix("--output", target, ".nc")
    check_targets(target.parent, [target], scene)
    named = [name.strip() for name in waters.split(",") if name.strip()]
    if not named:
        raise UserError(f"--waters {waters} must be Jerlov types, as in IB,1C")
    lists: dict[str, Any] = {"winds": numbers("--winds", winds), "depths": numbers("--depths", depths)}
    if angles is not None:
        lists["angles_deg"] = numbers("--angles", angles)
    from mitransient_lidar.analysis.waveforms.depth_correction import corrections_for
    from mitransient_lidar.studies import depth_bias as study

    former = None if corrections is None else corrections_for(instrument, corrections)
    with reporting(quiet) as progress:
        found = study.depth_bias(
            instrument,
            parameters(define),
            scene=scene,
            waters=named,
            receiver=receiver,
            shots=shots,
            records=records,
            seed=seed,
            corrections=former,
            progress=progress,
            **lists,
        )
    write_netcdf(found, target)
    typer.echo("\n".join(study.describe_depth_bias(found)))
