"""Commands that measure the errors of an instrument's depths, for corrections, and its uncertainties."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, check_targets, write_netcdf
from mitransient_lidar.cli.messages import reporting
from mitransient_lidar.cli.options import OUTPUT, RECEIVERS, Define, Quiet, numbers, parameters
from mitransient_lidar.core.errors import UserError

_WINDS = "Wind speeds, at least 0, ascending; 0 for a level sea with ripples."
SeaTime = Annotated[
    float | None,
    typer.Option(help="Render no sea after this many seconds; those left out are NaN in the table (greater than 0)."),
]
Places = Annotated[int, typer.Option(help="Random places of a sea with waves, or renders of a level sea, 2 to 10 000.")]
SeaSeed = Annotated[int, typer.Option(help="Seed of the random numbers, 0 to 2^31.")]


def depth_bias(
    instrument: Annotated[str, typer.Argument(metavar="INSTRUMENT", help="Name of the instrument.")],
    define: Define = None,
    angles: Annotated[
        str | None,
        typer.Option(
            metavar="DEGREES", help="Angles from nadir, at least 0, ascending; the instrument's and 5 more by default."
        ),
    ] = None,
    winds: Annotated[str, typer.Option(metavar="M/S", help=_WINDS)] = "0,3,6",
    ripples: Annotated[
        str, typer.Option(metavar="M/S", help="Winds whose ripples level seas have, greater than 0, ascending.")
    ] = "3,6",
    waters: Annotated[str, typer.Option(metavar="TYPES", help="Jerlov types from clear to turbid.")] = "IB,1C,5C",
    depths: Annotated[
        str, typer.Option(metavar="M", help="Depths of the bottom, greater than 0, ascending.")
    ] = "3,6,10",
    scene: Annotated[str, typer.Option(help="Scene whose sea, water and bottom count.")] = "table1",
    receiver: Annotated[str | None, typer.Option(help=f"{RECEIVERS} By default the instrument's.")] = None,
    shots: Places = 12,
    records: Annotated[int, typer.Option(help="Records with noise of each place, 1 to 10 000.")] = 5,
    target_error: Annotated[
        float,
        typer.Option(help="Relative standard error of a render over waves; of a level sea 0.6 of it (greater than 0)."),
    ] = 0.05,
    corrections: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="Table of another seed to also correct the depths by; auto for the shipped one."
        ),
    ] = None,
    max_time: SeaTime = None,
    seed: SeaSeed = 1,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="NetCDF file; output/INSTRUMENT_depths.nc by default.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="PNG, PDF or SVG file of the biases of all estimators against the angle.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the errors of the depths in an instrument's records.

    Renders the instrument over known bottoms, by angle, wind, water and depth, records it with the noise of its
    receiver, measures the depths, and prints share found, bias, spread and stated error of the estimator gaussian [cm].
    The file holds all estimators; waveforms --correct takes it.
    """
    target = output or OUTPUT / f"{instrument}_depths.nc"
    check_suffix("--output", target, ".nc")
    check_targets(target.parent, [target], scene)
    check_figure(figure, option="--figure")
    named = _waters(waters)
    lists: dict[str, Any] = {"winds": numbers("--winds", winds), "depths": numbers("--depths", depths)}
    lists["ripples"] = numbers("--ripples", ripples)
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
            target_error=target_error,
            max_time=max_time,
            seed=seed,
            corrections=former,
            progress=progress,
            **lists,
        )
    with announced():
        write_netcdf(found, target)
        if figure is not None:
            from mitransient_lidar.plots.studies.depth_bias import plot_depth_bias

            figure.parent.mkdir(parents=True, exist_ok=True)
            plot_depth_bias(found, figure)
    typer.echo("\n".join(study.describe_depth_bias(found)))


def tpu(
    instrument: Annotated[str, typer.Argument(metavar="INSTRUMENT", help="Name of the instrument.")],
    define: Define = None,
    altitudes: Annotated[
        str | None,
        typer.Option(metavar="M", help="Heights of the lidar, greater than 0, ascending; the instrument's by default."),
    ] = None,
    angles: Annotated[
        str | None,
        typer.Option(metavar="DEGREES", help="Angles from nadir, at least 0, ascending; the instrument's by default."),
    ] = None,
    winds: Annotated[str, typer.Option(metavar="M/S", help=_WINDS)] = ("1,3,5,7,9"),
    waters: Annotated[str, typer.Option(metavar="TYPES", help="Jerlov types from clear to turbid.")] = (
        "III,1C,3C,5C,7C,9C"
    ),
    depths: Annotated[
        str, typer.Option(metavar="M", help="Depths of the bottom, greater than 0, ascending.")
    ] = "1,1.5,3,6,10",
    scene: Annotated[str, typer.Option(help="Scene whose sea, water and bottom count.")] = "table1",
    receiver: Annotated[str | None, typer.Option(help=f"{RECEIVERS} By default the instrument's.")] = None,
    estimator: Annotated[str, typer.Option(help="Estimator of depths, as of waveforms.")] = "gaussian",
    shots: Places = 12,
    records: Annotated[int, typer.Option(help="Records with noise of each place, 1 to 10 000.")] = 4,
    corrections: Annotated[
        str,
        typer.Option(metavar="FILE", help="Table of depth-bias to also correct the depths by, auto or none."),
    ] = "auto",
    pointing_mrad: Annotated[
        float, typer.Option(help="Standard deviation of the beam's direction, each axis, at least 0.")
    ] = 0.1,
    position_m: Annotated[
        float, typer.Option(help="Standard deviation of the horizontal position, each axis, at least 0.")
    ] = 0.05,
    height_m: Annotated[
        float, typer.Option(help="Standard deviation of the height of the sea surface, at least 0.")
    ] = 0.05,
    max_time: SeaTime = None,
    seed: SeaSeed = 1,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the files.")] = OUTPUT,
    quiet: Quiet = False,
) -> None:
    """Determine the vertical and horizontal uncertainty of an instrument's soundings.

    Renders the instrument over known bottoms, by altitude, angle, wind, water and depth, and writes uncertainties of
    single soundings, measured and corrected, and the orders of IHO S-44 that they meet as NetCDF file, figures, and the
    fits of the part below the sea surface as CSV files for uncertainty tools. Prints TVU at 95 % [cm] and the fits.
    """
    from mitransient_lidar.analysis.depth_uncertainty import TrajectoryErrors, write_fits
    from mitransient_lidar.analysis.waveforms.depth_correction import corrections_for
    from mitransient_lidar.loading.instruments import read_instrument
    from mitransient_lidar.plots.studies.depth_uncertainty import plot_orders, plot_uncertainty
    from mitransient_lidar.studies import depth_uncertainty as study

    read_instrument(instrument)
    target = output / f"{instrument}_tpu.nc"
    check_targets(output, [target, *sorted(output.glob(f"{glob.escape(instrument)}_*m_*deg_*"))], scene)
    lists: dict[str, Any] = {"winds": numbers("--winds", winds), "depths": numbers("--depths", depths)}
    if angles is not None:
        lists["angles_deg"] = numbers("--angles", angles)
    if altitudes is not None:
        lists["altitudes"] = numbers("--altitudes", altitudes)
    with reporting(quiet) as progress:
        found = study.depth_uncertainty(
            instrument,
            parameters(define),
            waters=_waters(waters),
            trajectory=TrajectoryErrors(pointing_mrad, position_m, height_m),
            estimator=estimator,
            shots=shots,
            records=records,
            scene=scene,
            receiver=receiver,
            max_time=max_time,
            seed=seed,
            corrections=None if corrections == "none" else corrections_for(instrument, corrections),
            progress=progress,
            **lists,
        )
    output.mkdir(parents=True, exist_ok=True)
    with announced():
        write_netcdf(found, target)
        for height in found["altitude"].values:
            for angle in found["off_nadir_deg"].values:
                one = found.sel(altitude=height, off_nadir_deg=angle)
                if one["found"].isnull().all():  # for lack of time
                    continue
                stem = f"{instrument}_{height:g}m_{angle:g}deg"
                plot_uncertainty(one, output / f"{stem}_tvu.png")
                plot_orders(one, output / f"{stem}_orders.png")
                for kind in one["correction"].values:
                    suffix = "" if kind == "none" else "_corrected"
                    write_fits(one.sel(correction=kind), "vertical", output / f"{stem}_tvu{suffix}.csv")
                write_fits(one, "horizontal", output / f"{stem}_thu.csv")
    typer.echo("\n".join(study.describe_depth_uncertainty(found)))


def _waters(text: str) -> list[str]:
    """Return the names of waters, separated by commas."""
    named = [name.strip() for name in text.split(",") if name.strip()]
    if not named:
        raise UserError(f"--waters {text} must be Jerlov types, as in IB,1C")
    return named
