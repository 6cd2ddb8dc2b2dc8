"""Tables of echoes as flat rows, and as CSV files."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.core.files import replacing

NUMBERS = ("time_ns", "depth_m", "amplitude", "energy", "width_ns")


def flag_names(flags: int) -> str:
    """Return the names of the `EchoFlag` in a sum of flags, separated by spaces; empty for 0."""
    return " ".join(str(flag.name).lower() for flag in EchoFlag if flags & flag)


def unknown_depth(echo: str, flags: int, has_surface: bool) -> str:
    """Return why the depth of an echo is unknown, given its sum of `EchoFlag` and whether its surface is known."""
    if flags & EchoFlag.NO_SURFACE_LIGHT:
        return "no surface light"
    if flags & EchoFlag.NO_ECHO:
        return "column too short or too noisy" if echo == "column" else f"no {echo} echo"
    if flags & EchoFlag.POOR_FIT:
        return "saturated" if flags & EchoFlag.SATURATED else "poor fit"
    return "no surface echo" if not has_surface else "signal below its own level"


def rows(table: xr.Dataset) -> tuple[list[str], Iterator[list[Any]]]:
    """Return column names and rows of a table of `echo_table.extract`, one row per waveform, estimator and echo.

    The columns are the dimensions, other coordinates such as ``angle_x``, ``angle_y`` and the truth of each shot, the
    quantities of the echo, ``flags`` as names, ``unknown_depth``, the reason for a depth of NaN, and ``attenuation``.
    """
    dims = [str(dim) for dim in table["time_ns"].dims]
    known = [
        str(name) for name, one in table.coords.items() if one.dims and name not in dims and one.dtype.kind in "if"
    ]
    extra = sorted(known, key=lambda name: not name.startswith("angle_"))
    numbers = [name + suffix for name in NUMBERS for suffix in ("", "_stderr")]
    numbers.insert(numbers.index("depth_m_stderr") + 1, "depth_m_method_error")
    columns = [
        *extra,
        *numbers,
        "flags",
        "unknown_depth",
        *(name for name in ("attenuation", "attenuation_stderr") if name in table),
    ]
    kept = [name for name in (*columns, "surface_time_ns") if name in table]
    wide = {name: table[name].broadcast_like(table["time_ns"]).transpose(*dims).values for name in kept}

    def lines() -> Iterator[list[Any]]:
        for place in np.ndindex(*(table.sizes[dim] for dim in dims)):
            labels = [table[dim].values[index] for dim, index in zip(dims, place, strict=True)]
            cells: dict[str, Any] = {name: float(values[place]) for name, values in wide.items()}
            flags, surface = int(cells["flags"]), cells.get("surface_time_ns", math.nan)
            reason = unknown_depth(str(labels[-1]), flags, math.isfinite(surface))
            cells |= {"flags": flag_names(flags), "unknown_depth": reason if math.isnan(cells["depth_m"]) else ""}
            yield [*labels, *(cells[name] for name in columns)]

    return [*dims, *columns], lines()


def save_csv(table: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write or replace a CSV file of a table of `echo_table.extract`, with empty cells for unknown values."""
    names, lines = rows(table)
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows([_cell(value) for value in line] for line in lines)


def _cell(value: Any) -> Any:
    """Return a float with nine digits, empty for NaN; other values unchanged."""
    if not isinstance(value, float):
        return value
    return "" if math.isnan(value) else f"{value:.9g}"
