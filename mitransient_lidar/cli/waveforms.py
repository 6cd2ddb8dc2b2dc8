"""The command that lists the echoes in a result's waveforms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mitransient_lidar.cli.files import announced, check_suffix
from mitransient_lidar.cli.messages import name_subject
from mitransient_lidar.core.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

_MOST_LINES = 200  # of a printed table
_MOST_WAVEFORMS = 16  # whose layers are printed


def waveforms(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="EXR or NetCDF file of a result, or NetCDF file of recorded shots.")
    ],
    table: Annotated[bool, typer.Option("--table/--no-table", help="Print the echoes.")] = True,
    output: Annotated[Path | None, typer.Option("--csv", metavar="OUT", help="CSV file to write.")] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            "--estimator",
            help="threshold, leading_edge, peak, centroid, gaussian (the default) or deconvolution; repeat it for "
            "several estimators.",
        ),
    ] = None,
    threshold: Annotated[
        float, typer.Option(help="Standard deviations of the noise above which a signal counts, greater than 0.")
    ] = 5.0,
    contrast: Annotated[
        float, typer.Option(help="Share of the signal that an echo in the water must add, at least 0 and below 1.")
    ] = 0.05,
    layers: Annotated[int, typer.Option(help="Number of changes in the column to test for, 0 to 8.")] = 0,
    mean_surface: Annotated[
        bool, typer.Option("--mean-surface", help="Depths from the mean surface, not from each pixel's surface echo.")
    ] = False,
    correct: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Subtract the mean errors of a table of depth-bias from the depths; auto for the shipped one of the "
            "result's instrument.",
        ),
    ] = None,
    wind_speed: Annotated[
        float | None,
        typer.Option(help="Wind speed of the corrections [m/s], at least 0; that of the scene by default."),
    ] = None,
) -> None:
    """Measure the echoes in the waveforms of a result.

    Lists time, depth, amplitude, energy and width of surface, column, target and bottom echo of every pixel. Errors are
    those by noise, of depths also by the method.
    """
    if output is not None:
        check_suffix("--csv", output, ".csv")
    elif not table:
        raise UserError("--no-table leaves nothing to do: give --csv OUT as well.")
    if correct is not None and mean_surface:
        raise UserError("--correct and --mean-surface are alternatives: corrections are of depths from surface echoes.")
    if wind_speed is not None and correct is None:
        raise UserError(f"--wind-speed {wind_speed:g} needs --correct.")
    from mitransient_lidar import results
    from mitransient_lidar.analysis.waveforms import csv_tables, depth_correction
    from mitransient_lidar.analysis.waveforms import echo_table as measuring

    dataset = results.dataset_of("FILE", file, "waveforms", "signals")
    instrument = str(dataset.attrs.get("instrument", ""))
    corrections = None if correct is None else depth_correction.corrections_for(instrument, correct)
    found = measuring.extract(
        dataset,
        estimator or ["gaussian"],
        threshold=threshold,
        contrast=contrast,
        layers=layers,
        depth_from="mean" if mean_surface else "echo",
    )
    if corrections is not None:
        found = depth_correction.correct_depths(found, corrections, wind_speed)
    name_subject(file, dataset.attrs)
    if table:
        _print(found)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        with announced():
            csv_tables.save_csv(found, output)


def _print(found: xr.Dataset) -> None:
    """Print the echoes and the properties of the columns."""
    from rich.console import Console
    from rich.table import Table

    from mitransient_lidar.analysis.waveforms import csv_tables

    names, lines = csv_tables.rows(found)
    labels = [name for name in names[: names.index("echo") + 1] if name != "estimator" or found.sizes["estimator"] > 1]
    unit = {"amplitude": found["amplitude"].attrs["units"], "energy": found["energy"].attrs["units"]}
    heads = {"time_ns": "time (ns)", "depth_m": "depth (m)", "width_ns": "width (ns)"}
    heads |= {name: f"{name} ({of})" if of else name for name, of in unit.items()}
    table = Table(box=None, padding=(0, 1), header_style=None)
    for name in labels:
        table.add_column(name)
    for name in csv_tables.NUMBERS:
        table.add_column(heads[name], justify="right")
    table.add_column("flags")
    table.add_column("depth unknown")
    left_out = 0
    for line in lines:
        cells = dict(zip(names, line, strict=True))
        # Of missing echoes, only surface and bottom are listed.
        if "no_echo" in cells["flags"] and cells["echo"] not in ("surface", "bottom"):
            continue
        if table.row_count >= _MOST_LINES:
            left_out += 1
            continue
        # The printed error of a depth includes that of the method.
        cells["depth_m_stderr"] = math.hypot(cells["depth_m_stderr"], cells["depth_m_method_error"])
        numbers = [_with_error(cells[name], cells[f"{name}_stderr"]) for name in csv_tables.NUMBERS]
        table.add_row(*(str(cells[name]) for name in labels), *numbers, cells["flags"], cells["unknown_depth"])
    # A fixed width keeps the lines unfolded.
    Console(highlight=False, width=240, markup=False).print(table)
    if left_out:
        typer.echo(f"{left_out} more lines: write them all with --csv OUT.")
    _print_columns(found)


def _print_columns(found: xr.Dataset) -> None:
    """Print attenuations, and the changes in the columns if tested for."""
    import numpy as np

    values = found["attenuation"].values.ravel()
    if np.isfinite(values).any():
        text = f"attenuation of the column (1/m): median {np.nanmedian(values):.4f}"
        if values.size > 1:
            text += f", from {np.nanmin(values):.4f} to {np.nanmax(values):.4f}"
        typer.echo(text)
    if "layer" not in found.dims or values.size > _MOST_WAVEFORMS:
        return
    layers: Any = found[["layer_depth_m", "layer_p_value", "layer_step"]]
    dims = list(found["attenuation"].dims)
    for place in np.ndindex(*(found.sizes[dim] for dim in dims)):
        one = layers.isel(dict(zip(dims, place, strict=True)))
        label = " ".join(str(found[dim].values[index]) for dim, index in zip(dims, place, strict=True))
        for depth, chance, step in zip(*(one[name].values for name in one.data_vars), strict=True):
            if np.isfinite(depth):
                change = f"signal {100 * np.expm1(step):+.0f} %, p = {max(chance, 1e-99):.1e}"
                typer.echo(f"{label}: change at {depth:.2f} m, {change}")


def _with_error(value: float, error: float) -> str:
    """Return a number with its standard error, or a dash."""
    if math.isnan(value):
        return "-"
    if not math.isfinite(error) or error <= 0:
        return f"{value:.5g}"
    small = abs(value) < 1e-3 or abs(value) >= 1e6
    if small:
        return f"{value:.3e} +- {error:.0e}"
    return f"{value:.{min(max(1 - math.floor(math.log10(error)), 0), 3)}f} +- {error:.2g}"
