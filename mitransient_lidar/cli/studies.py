"""Study commands: a public function, its figure with the data, and its lines; and instrument tables."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Annotated

import typer

from mitransient_lidar.cli.files import announced, check_figure, check_suffix, check_targets, write_netcdf
from mitransient_lidar.cli.generator import OUTPUT, Call, Commands, Quiet, function_at
from mitransient_lidar.cli.messages import exit_if_interrupted
from mitransient_lidar.core.options import Option

COMMANDS = Commands()

Figure = Annotated[Path, Option("PNG, PDF or SVG file; also writes the data as .nc")]

_DESIGN, _SURVEY = "Targets, designs and scattering", "Depths and their uncertainty"  #: Headings of the help.


def _study(
    heading: str,
    function: str,
    plot: str,
    describe: str,
    example: str,
    text: str,
    *,
    name: str = "",
    table: str = "",
    table_suffix: str = ".csv",
    has_data: bool = True,
) -> None:
    """Add the command of a study function at ``module:name``, whose files by default have its name, with a help text.

    `plot` is the function in ``plots`` that draws the result; `describe`, in the study's module, returns its lines;
    `table` writes another file, with the suffix `table_suffix`.
    """
    module, _, own = function.partition(":")
    suffixes = (".nc",) * has_data + (table_suffix,) * bool(table)

    def body(call: Call, output: Figure = OUTPUT / f"{name or own}.png", quiet: Quiet = False) -> None:
        check_figure(output, *suffixes)
        found = call()
        with announced(output.parent):
            function_at(f"plots.{plot}")(found, output)
            if has_data:
                write_netcdf(found, output.with_suffix(".nc"))
            if table:
                function_at(f"{module}:{table}")(found, output.with_suffix(table_suffix))
        typer.echo("\n".join(function_at(f"{module}:{describe}")(found)))
        for one in getattr(found, "results", [found])[:1]:
            exit_if_interrupted(one)

    body.__doc__ = text
    COMMANDS.add(heading, function, example, name=own.replace("_", "-"))(body)


_study(
    _DESIGN,
    "studies.shots:find_shots",
    "studies.shots:plot_found_shots",
    "describe_found_shots",
    "table1 --slope-sigmas 1.5",
    """Find sea locations where the beam meets given slopes.

    Lists and draws locations whose slope faces the lidar or turns away from it, is level, or sideways.
    """,
    has_data=False,
)
_study(
    _DESIGN,
    "studies.detection:detect",
    "studies.targets:plot_detection",
    "describe_detection",
    "fig13_2x2 --receiver pmt --depths 6,8,10",
    """Compute the detection probability of a target.

    Compares one pixel, the sum and the best combination of pixels. With --receiver none it measures the target's
    signal in each pixel: renders the scene with and without the target on the same random numbers.
    """,
    name="detection",
)
_study(
    _DESIGN,
    "studies.bounds:bounds",
    "studies.parameters:plot_bounds",
    "describe_bounds",
    "table1 --free attenuation,bottom_depth --over field_of_view_mrad=10,20,40",
    """Compute Cramer-Rao bounds of parameters from one shot, and rank designs.

    No unbiased estimate from one shot's record, with the receiver's noise, has a smaller standard deviation.
    Renders the scene with derivatives by the free parameters, for each combination of values.
    """,
    table="write_table",
)
_study(
    _DESIGN,
    "studies.light_classes:scattering",
    "studies.light:plot_scattering",
    "describe_scattering",
    "table1 --orders 4",
    """Measure how the water scatters the light: by order, with depth, or against the field of view.

    Separates the received light by scattering order, and each order by its vertical reversals: one, or several. With
    --depths: the horizontal spread of the laser beam, its delays, and its share within the field of view. With
    --fov-mrad: the water's attenuation at several fields of view.
    """,
)
_study(
    _SURVEY,
    "studies.forecast:forecast",
    "studies.depths:plot_forecast",
    "describe_forecast",
    "riegl_vq840g 1:12 --secchi 6 -D wind_speed=5",
    """Forecast where an instrument finds the bottom of a site, how well, and down to which depth.

    Computes a table of bottoms under waves, recorded with the receiver's noise, and maps of the site: probability
    that the bottom is found, TVU and THU at 95 %, IHO S-44 order, and deepest depth. Of a map it also writes a
    GeoTIFF with these bands.
    """,
    table="write_maps",
    table_suffix=".tif",
)


@COMMANDS.add(_SURVEY, "studies.depth_bias:depth_bias", "riegl_vq840g --winds 0,3 --depths 3,6")
def _depth_bias(
    call: Call,
    output: Annotated[Path | None, Option("NetCDF file, by default output/INSTRUMENT_depths.nc")] = None,
    figure: Annotated[Path | None, Option("PNG, PDF or SVG file: biases of all estimators against the angle")] = None,
    quiet: Quiet = False,
) -> None:
    """Measure the depth errors in an instrument's records.

    Renders the instrument over known bottoms at each angle, wind, water and depth, and records it with its
    receiver's noise. Measures the depths, and prints share found, bias, spread and stated error [cm] for the
    estimator gaussian. The file contains all estimators; echoes --correct reads it.
    """
    target = output or OUTPUT / f"{call.arguments['instrument']}_depths.nc"
    check_suffix("--output", target, ".nc")
    check_targets(target.parent, [target], call.arguments["scene"])
    check_figure(figure, option="--figure")
    from mitransient_lidar.studies.depth_bias import describe_depth_bias

    found = call()
    with announced(figure and figure.parent):
        write_netcdf(found, target)
        if figure is not None:
            function_at("plots.studies.depths:plot_depth_bias")(found, figure)
    typer.echo("\n".join(describe_depth_bias(found)))


@COMMANDS.add(_SURVEY, "studies.depth_bias:tpu", "riegl_vq840g --altitudes 100,150")
def _tpu(
    call: Call, output: Annotated[Path, Option("Folder for the files", form="DIR")] = OUTPUT, quiet: Quiet = False
) -> None:
    """Determine the vertical and horizontal uncertainty of an instrument's soundings.

    Renders the instrument over known bottoms at each altitude, angle, wind, water and depth. Writes a NetCDF file
    and figures with the uncertainties of single soundings, measured and corrected, and the IHO S-44 orders that
    they meet. CSV files for uncertainty tools contain fits of the part below the sea surface. Prints TVU at 95 %
    [cm] and the fits.
    """
    from mitransient_lidar.analysis.depth_uncertainty import write_fits
    from mitransient_lidar.loading.catalogue import read_instrument
    from mitransient_lidar.plots.studies.depths import plot_orders, plot_uncertainty
    from mitransient_lidar.studies.depth_bias import describe_tpu

    instrument = call.arguments["instrument"]
    read_instrument(instrument)
    target = output / f"{instrument}_tpu.nc"
    former = sorted(output.glob(f"{glob.escape(instrument)}_*m_*deg_*"))
    check_targets(output, [target, *former], call.arguments["scene"])
    found = call()
    with announced(output):
        write_netcdf(found, target)
        for height in found["altitude"].values:
            for angle in found["off_nadir_deg"].values:
                one = found.sel(altitude=height, off_nadir_deg=angle)
                if one["found"].isnull().all():  # no time was left
                    continue
                stem = f"{instrument}_{height:g}m_{angle:g}deg"
                plot_uncertainty(one, output / f"{stem}_tvu.png")
                plot_orders(one, output / f"{stem}_orders.png")
                for kind in one["correction"].values:
                    suffix = "" if kind == "none" else "_corrected"
                    write_fits(one.sel(correction=kind), "vertical", output / f"{stem}_tvu{suffix}.csv")
                write_fits(one, "horizontal", output / f"{stem}_thu.csv")
    typer.echo("\n".join(describe_tpu(found)))
