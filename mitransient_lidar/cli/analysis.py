"""Commands that compute from a result: gates, signals, echoes, estimates and fits."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mitransient_lidar.cli.files import GateFiles, announced, check_figure, check_suffix, check_targets, write_netcdf
from mitransient_lidar.cli.generator import OUTPUT, Call, Channel, Commands, Lidar, Quiet, Waveforms, waveform_selection
from mitransient_lidar.cli.messages import exit_if_interrupted, name_subject, reporting
from mitransient_lidar.cli.overwriting import draws_again
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.options import Option
from mitransient_lidar.core.tables.written import write_csv

if TYPE_CHECKING:
    import xarray as xr

    from mitransient_lidar.results.files import Given

COMMANDS = Commands()

_REFUSED = 1  # exit code of a fit that is refused


@COMMANDS.add(
    "Analyse results",
    "results.gate_stack:train_from_options",
    "output/table1.nc --start-depth 1 --width-ns 5 --count 8",
)
def _gates(
    call: Call,
    stack: Annotated[
        Path, Option("An EXR or NetCDF result, a gate stack or frames of a camera", form="STACK", is_argument=True)
    ],
    output: Annotated[Path | None, Option("Folder for the files, by default the folder of STACK")] = None,
    plot: Annotated[bool, Option("Draw all gates, and the depths seen in them")] = True,
    sequence: Annotated[bool, Option("Also write numbered EXR files, one for each gate")] = False,
    tiff: Annotated[bool, Option("Also write a 16-bit TIFF file, one page per frame and gate")] = False,
    images: Annotated[bool, Option("Also write numbered 16-bit PNG files, one per frame and gate")] = False,
    gif: Annotated[bool, Option("Also write an animation")] = False,
    mp4: Annotated[bool, Option("Also write a movie, by ffmpeg")] = False,
    html: Annotated[bool, Option("Also write a page that shows the gates in a browser")] = False,
    quiet: Quiet = False,
) -> None:
    """Cut gates from a result.

    Writes DIR/<stack>_gates.exr, _gates.png and _depth.png, and prints the paths. A STACK with gates gives
    <stack>_cut_gates.exr and so on. Without a start, its own gates or camera frames are written and drawn. TIFF
    and PNG images contain the digital numbers of frames, or energies from 0 to 65535.
    """
    from mitransient_lidar import results
    from mitransient_lidar.analysis.gates import cut as gating
    from mitransient_lidar.results.gate_stack import has_frames

    count = call.arguments["count"]
    starts = [call.arguments[name] for name in ("start_ns", "start_depth_m", "start_range_m")]
    given = {"--width-ns": call.arguments["width_ns"], "--step-ns": call.arguments["step_ns"]}
    given["--count"] = None if count == 1 else count
    with reporting(quiet):
        result = results.dataset_of("FILE", stack, "result", "gates", "frames")
        is_record = has_frames(result)
        has_gates = is_record or "gate_energy" in result
        is_cut = not has_gates or any(one is not None for one in starts)
        stem = stack.stem.removesuffix("_gates") + ("_cut" if has_gates and is_cut else "")
        wanted = {"drawings": plot, "sequence": sequence, "tiff": tiff, "images": images}
        files = GateFiles.of(output or stack.parent, stem, **wanted, gif=gif, mp4=mp4, html=html)
        if not is_cut:
            draws_again(stack)
        files.check()
        if is_record and is_cut:
            raise UserError(f"{stack} holds frames of a camera: cut the gates of the result, and record these")
        named = [f"{option} {value:g}" for option, value in given.items() if value is not None]
        if named and not is_cut:
            raise UserError(f"{named[0]} needs --start-ns, --start-depth or --start-range, where the first gate begins")
        cut = result
        if is_cut:
            with call.named():
                train = call.function(result.attrs, **call.arguments)
            cut = gating.cut_gates(result, train)
    name_subject(stack, result.attrs, quiet)
    with reporting(quiet):
        files.write(cut, result, quiet)


@COMMANDS.add("Analyse results", "analysis.receiver:detect_waveforms", "output/table1.nc --receiver apd --gain auto")
def _record(
    call: Call,
    file: Annotated[Path, Option("An EXR or NetCDF result: a shot, a series, or gates", form="FILE", is_argument=True)],
    output: Annotated[Path | None, Option("NetCDF file to write, by default FILE_recorded.nc")] = None,
    quiet: Quiet = False,
) -> None:
    """Record the waveforms of a result with a receiver, or its gates with a camera.

    Writes the signals with the noise of detector and electronics, which echoes and view read, and prints how much
    is saturated. With a converter they are its codes, with scale_factor and add_offset for volts. With auto, the
    gain or the filter is chosen so that nothing saturates. A camera gives the digital numbers of frames, with the
    mean, deviation, signal-to-noise ratio and saturation of each pixel and gate.
    """
    target = output or file.with_name(f"{file.stem}_recorded.nc")
    check_suffix("--output", target, ".nc")
    from mitransient_lidar import results
    from mitransient_lidar.analysis import recorded as analysis

    with reporting(quiet):
        result = results.dataset_of("FILE", file, "result", "gates")
    recorded = call(result)
    name_subject(file, result.attrs, quiet)
    write_netcdf(recorded, target)
    for line in analysis.describe_recording(recorded):
        typer.echo(line)


@COMMANDS.add(
    "Analyse results",
    "analysis.waveforms.echo_table:extract",
    "output/table1_recorded.nc --csv echoes.csv",
    defaults={"estimators": None},
)
def _echoes(
    call: Call,
    file: Annotated[
        Path,
        Option(
            "EXR or NetCDF file of a result, or NetCDF file of recorded shots; or waveforms in LAS, LAZ or "
            "PulseWaves (.pls)",
            form="FILE",
            is_argument=True,
        ),
    ],
    table: Annotated[bool, Option("Print the echoes")] = True,
    output: Annotated[Path | None, Option("CSV file to write", form="OUT", flag="--csv")] = None,
    mean_surface: Annotated[bool, Option("Depths from the mean surface, not from each pixel's surface echo")] = False,
    correct: Annotated[
        str | None,
        Option(
            "Subtract the mean errors in a depth-bias table from the depths; auto for the shipped table of the "
            "result's instrument",
            form="FILE",
        ),
    ] = None,
    wind_speed: Annotated[
        float | None, Option("Wind speed for the corrections [m/s] (at least 0), by default the scene's")
    ] = None,
    waveforms: Waveforms = None,
    channel: Channel = None,
    lidar: Lidar = None,
    quiet: Quiet = False,
) -> None:
    """Measure the echoes in the waveforms of a result.

    Lists time, depth, amplitude, energy and width of surface, column, target and bottom echo of every pixel. Errors
    include noise, and for depths the method, too.
    """
    if output is not None:
        check_suffix("--csv", output, ".csv")
    elif not table:
        raise UserError("--no-table leaves nothing to do: give --csv OUT as well")
    if correct is not None and mean_surface:
        raise UserError("--correct and --mean-surface are alternatives: corrections are of depths from surface echoes")
    if wind_speed is not None and correct is None:
        raise UserError(f"--wind-speed {wind_speed:g} needs --correct")
    from mitransient_lidar import results
    from mitransient_lidar.analysis.waveforms import csv_tables, depth_correction, surface_times
    from mitransient_lidar.results.attributes import INFRARED
    from mitransient_lidar.results.waveform_files import waveform_chunks

    selection = waveform_selection(file, waveforms, channel, lidar)
    parts = waveform_chunks(file, **selection) if selection else iter([file])
    estimators = call.arguments["estimators"] or ["gaussian"]

    def measured(part: Given) -> xr.Dataset:
        dataset = results.dataset_of("FILE", part, "waveforms", "signals")
        instrument = str(dataset.attrs.get("instrument", ""))
        corrections = None if correct is None else depth_correction.corrections_for(instrument, correct)
        if corrections is not None:
            surface_times.check_surface(corrections, INFRARED in dataset.attrs)
        found: xr.Dataset = call(dataset, estimators=estimators, depth_from="mean" if mean_surface else "echo")
        if corrections is not None:
            found = depth_correction.correct_depths(found, corrections, wind_speed)
        return found

    first = measured(next(parts))
    if not selection:
        name_subject(file, first.attrs, quiet)
    if table:
        typer.echo("\n".join(csv_tables.describe_echoes(first)))
    if output is not None:
        with announced(output.parent):
            csv_tables.save_csv(itertools.chain([first], map(measured, parts)), output)
    elif selection and next(parts, None) is not None:
        typer.echo(f"these are the first {first.sizes['shot']} waveforms: write the echoes of all with --csv OUT")


@COMMANDS.add("Analyse results", "analysis.retrieval.retrieve:retrieve", "output/table1.nc")
def _retrieve(
    call: Call,
    file: Annotated[
        Path, Option("An EXR or NetCDF result: one shot or a series of shots", form="FILE", is_argument=True)
    ],
    output: Annotated[Path | None, Option("NetCDF file for all estimates")] = None,
    figure: Annotated[Path | None, Option("PNG, PDF or SVG file for a series: estimates against the truth")] = None,
    quiet: Quiet = False,
) -> None:
    """Retrieve slopes, bottom and water from a result.

    Estimates the sea's slope, the bottom's depth and reflectance, and the water's attenuation from the echoes of
    FILE; for a series, those of each shot beside the truth.
    """
    if output is not None:
        check_suffix("--output", output, ".nc")
    check_figure(figure, option="--figure")
    from mitransient_lidar import results
    from mitransient_lidar.analysis.retrieval.retrieval_table import describe_retrieval

    dataset = results.dataset_of("FILE", file, "result")
    if figure is not None and "true_slope_along" not in dataset.coords:
        raise UserError(f"--figure {figure} needs a series of shots with true slopes, but {file} is none")
    found = call(dataset)
    name_subject(file, dataset.attrs, quiet)
    typer.echo("\n".join(describe_retrieval(found)))
    if output is not None:
        write_netcdf(found, output)
    if figure is not None:
        from mitransient_lidar.plots.studies.shots import plot_retrieval

        with announced(figure.parent):
            plot_retrieval(found, figure)


@COMMANDS.add("Analyse results", "studies.fit:fit", "output/table1.nc --free attenuation,bottom_reflectance")
def _fit(
    call: Call,
    file: Annotated[
        Path,
        Option(
            "Result or recorded signal (.nc, .exr); a CSV file with the column time_ns and one for each pixel; or "
            "waveforms in LAS, LAZ or PulseWaves (.pls), whose mean is fitted",
            form="FILE",
            is_argument=True,
        ),
    ],
    output: Annotated[Path, Option("Folder of the files", form="DIR")] = OUTPUT,
    waveforms: Waveforms = None,
    channel: Channel = None,
    lidar: Lidar = None,
    quiet: Quiet = False,
) -> None:
    """Fit scene parameters to waveforms.

    Weighted least squares with the derivatives of renders. Prints values with standard errors, and writes fit.nc
    (with covariance, fitted waveform and residuals), fit.csv and fit.png. A fit is refused if its chi-squared
    exceeds 5 times the expected one, or, with unknown noise, if it leaves 10 % of the samples' sum of squares.
    Refused fits are printed and written with exit code 1. Ctrl-C ends the fit at its last step, which is printed
    and written (exit code 130).
    """
    targets = [output / f"fit.{kind}" for kind in ("nc", "csv", "png")]
    check_targets(output, targets, str(file))
    from mitransient_lidar import results
    from mitransient_lidar.plots.studies.parameters import plot_fit
    from mitransient_lidar.studies import fit as study

    selection = waveform_selection(file, waveforms, channel, lidar)
    source = results.open(file, **selection) if selection else file
    with DeferredInterrupt(at_once=False):
        fitted = call(source)
        with announced(output):
            write_netcdf(fitted, targets[0])
            write_csv(study.parameter_frame(fitted), targets[1], unknown="nan")
            plot_fit(fitted, targets[2])
    typer.echo("\n".join(study.describe_fit(fitted)))
    exit_if_interrupted(fitted)
    if fitted.attrs["refused"]:
        raise typer.Exit(_REFUSED)
