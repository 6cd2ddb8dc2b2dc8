"""Tables of echoes as flat lines, and as CSV files."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.optics.echoes import EchoFlag

NUMBERS = ("time_ns", "depth_m", "amplitude", "energy", "width_ns")


def flag_names(flags: int) -> str:
    """Return the names of the `EchoFlag` in a sum of flags, separated by spaces; empty for 0."""
    return " ".join(str(flag.name).lower() for flag in EchoFlag if flags & flag)


def rows(table: xr.Dataset) -> tuple[list[str], Iterator[list[Any]]]:
    """Return a table of echoes as a flat one.

    Parameters
    ----------
    table : xarray.Dataset
        What `waveforms.extract` returned.

    Returns
    -------
    names : list of str
        Of the columns: dimensions, ``gx`` and ``gy``, numbers of the echo, ``flags`` as names, ``attenuation``.
    lines : iterator of lists
        One a waveform, estimator and echo.
    """
    dims = [str(dim) for dim in table["time_ns"].dims]
    extra = [name for name in ("gx", "gy") if name in table.coords]
    numbers = [name + suffix for name in NUMBERS for suffix in ("", "_stderr")]
    whole_ = [name for name in ("attenuation", "attenuation_stderr") if name in table]
    names = [*dims, *extra, *numbers, "flags", *whole_]
    wide = {
        name: table[name].broadcast_like(table["time_ns"]).transpose(*dims).values
        for name in (*extra, *numbers, "flags", *whole_)
    }

    def lines() -> Iterator[list[Any]]:
        for place in np.ndindex(*(table.sizes[dim] for dim in dims)):
            labels = [table[dim].values[index] for dim, index in zip(dims, place, strict=True)]
            values = [flag_names(int(wide[n][place])) if n == "flags" else float(wide[n][place]) for n in wide]
            yield [*labels, *values]

    return names, lines()


def save_csv(table: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a table of echoes to a CSV file, one line a waveform, estimator and echo; unknown numbers stay empty.

    Parameters
    ----------
    table : xarray.Dataset
        What `waveforms.extract` returned.
    path : path
        File to write; an existing one is replaced.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    names, lines = rows(table)
    with results.replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for line in lines:
            writer.writerow([_cell(value) for value in line])


def _cell(value: Any) -> Any:
    """Return a number with nine digits, empty for NaN, anything else as it is."""
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.9g}"
    return value
