"""Commands of tables of an instrument: the errors of its depths, and the uncertainties of its soundings."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, check_targets, write_netcdf
from mitransient_lidar.cli.generator import Call, Command
from mitransient_lidar.cli.options import OUTPUT, Quiet


def _depth_bias(
    call: Call,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="NetCDF file; output/INSTRUMENT_depths.nc by default.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="PNG, PDF or SVG file of the biases of all estimators against the angle.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Write the table of an instrument, and draw its biases."""
    target = output or OUTPUT / f"{call.arguments['instrument']}_depths.nc"
    check_suffix("--output", target, ".nc")
    check_targets(target.parent, [target], call.arguments["scene"])
    check_figure(figure, option="--figure")
    from mitransient_lidar.studies.depth_bias import describe_depth_bias

    found = call()
    with announced():
        write_netcdf(found, target)
        if figure is not None:
            from mitransient_lidar.plots.studies.depths import plot_depth_bias

            figure.parent.mkdir(parents=True, exist_ok=True)
            plot_depth_bias(found, figure)
    typer.echo("\n".join(describe_depth_bias(found)))


def _tpu(
    call: Call,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the files.")] = OUTPUT,
    quiet: Quiet = False,
) -> None:
    """Write the uncertainties of an instrument, with figures and fits of each altitude and angle."""
    from mitransient_lidar.analysis.depth_uncertainty import write_fits
    from mitransient_lidar.loading.instruments import read_instrument
    from mitransient_lidar.plots.studies.depths import plot_orders, plot_uncertainty
    from mitransient_lidar.studies.tpu import describe_tpu

    instrument = call.arguments["instrument"]
    read_instrument(instrument)
    target = output / f"{instrument}_tpu.nc"
    former = sorted(output.glob(f"{glob.escape(instrument)}_*m_*deg_*"))
    check_targets(output, [target, *former], call.arguments["scene"])
    found = call()
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
    typer.echo("\n".join(describe_tpu(found)))


COMMANDS = {
    "depth-bias": Command(
        "Study",
        "studies.depth_bias:depth_bias",
        _depth_bias,
        """Measure the errors of the depths in an instrument's records.

        Renders the instrument over known bottoms, by angle, wind, water and depth, records it with the noise of its
        receiver, measures the depths, and prints share found, bias, spread and stated error of the estimator gaussian
        [cm]. The file holds all estimators; echoes --correct takes it.
        """,
    ),
    "tpu": Command(
        "Study",
        "studies.tpu:tpu",
        _tpu,
        """Determine the vertical and horizontal uncertainty of an instrument's soundings.

        Renders the instrument over known bottoms, by altitude, angle, wind, water and depth, and writes uncertainties
        of single soundings, measured and corrected, and the orders of IHO S-44 that they meet as NetCDF file, figures,
        and the fits of the part below the sea surface as CSV files for uncertainty tools. Prints TVU at 95 % [cm] and
        the fits.
        """,
    ),
}
