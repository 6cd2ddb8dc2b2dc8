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


def rows(table: xr.Dataset) -> tuple[list[str], Iterator[list[Any]]]:
    """Return column names and rows of a table of `echo_table.extract`, one row per waveform, estimator and echo.

    The columns are the dimensions, ``angle_x`` and ``angle_y``, the quantities of the echo, ``flags`` as names, and
    ``attenuation``.
    """
    dims = [str(dim) for dim in table["time_ns"].dims]
    extra = [name for name in ("angle_x", "angle_y") if name in table.coords]
    numbers = [name + suffix for name in NUMBERS for suffix in ("", "_stderr")]
    columns = [*extra, *numbers, "flags", *(name for name in ("attenuation", "attenuation_stderr") if name in table)]
    wide = {name: table[name].broadcast_like(table["time_ns"]).transpose(*dims).values for name in columns}

    def lines() -> Iterator[list[Any]]:
        for place in np.ndindex(*(table.sizes[dim] for dim in dims)):
            labels = [table[dim].values[index] for dim, index in zip(dims, place, strict=True)]
            values = [flag_names(int(wide[n][place])) if n == "flags" else float(wide[n][place]) for n in wide]
            yield [*labels, *values]

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
