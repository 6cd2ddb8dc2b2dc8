"""Echo tables as pandas frames, as printed lines, and as CSV files."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.waveforms.echo_detection import EchoClass, EchoFlag
from mitransient_lidar.core.tables.written import aligned_lines, write_csv

if TYPE_CHECKING:
    import pandas as pd

#: Most lines of a printed table, and most waveforms whose layers are printed.
_MOST_LINES, _MOST_WAVEFORMS = 200, 16

NUMBERS = ("time_ns", "depth_m", "amplitude", "energy", "width_ns")


def flag_names(flags: int) -> str:
    """Return the `EchoFlag` names in a sum of flags, separated by spaces; empty for 0."""
    return " ".join(str(flag.name).lower() for flag in EchoFlag if flags & flag)


def unknown_depth(echo: str, flags: int, has_surface: bool) -> str:
    """Return why an echo's depth is unknown, given its sum of `EchoFlag` and whether its surface is known."""
    if flags & EchoFlag.NO_SURFACE_LIGHT:
        return "no surface light"
    if flags & EchoFlag.NO_ECHO:
        return "column too short or too noisy" if echo == "column" else f"no {echo} echo"
    if flags & EchoFlag.POOR_FIT:
        return "saturated" if flags & EchoFlag.SATURATED else "poor fit"
    return "no surface echo" if not has_surface else "signal below its own level"


def echo_frame(table: xr.Dataset) -> pd.DataFrame:
    """Return a table of `echo_table.extract` with one row per waveform, estimator and echo.

    The columns are the dimensions, other coordinates such as ``angle_x``, ``angle_y`` and each shot's truth, and the
    echo's quantities. ``class`` and ``flags`` are names, ``unknown_depth`` is the reason for a NaN depth,
    ``attenuation`` the column's.
    """
    dims = [str(dim) for dim in table["time_ns"].dims]
    known = [
        str(name) for name, one in table.coords.items() if one.dims and name not in dims and one.dtype.kind in "if"
    ]
    extra = sorted(known, key=lambda name: not name.startswith("angle_"))
    numbers = [name + suffix for name in NUMBERS for suffix in ("", "_stderr")]
    numbers.insert(numbers.index("depth_m_stderr") + 1, "depth_m_method_error")
    attenuation = [name for name in ("attenuation", "attenuation_stderr") if name in table]
    surface = [name for name in ("surface_time_ns",) if name in table]
    known_as = [name for name in ("class",) if name in table]
    frame = table[[*extra, *numbers, *known_as, "flags", *attenuation, *surface]].to_dataframe(dims).reset_index()
    has_surface = np.isfinite(frame.get("surface_time_ns", math.nan * frame["flags"]))
    reasons = map(unknown_depth, frame["echo"], frame["flags"], has_surface)
    frame["unknown_depth"] = np.where(frame["depth_m"].isna(), [*reasons], "")
    frame["flags"] = frame["flags"].map(flag_names)
    for name in known_as:
        frame[name] = frame[name].map(lambda one: str(EchoClass(one).name).lower())
    return frame[[*dims, *extra, *numbers, *known_as, "flags", "unknown_depth", *attenuation]]


def save_csv(tables: xr.Dataset | Iterable[xr.Dataset], path: str | os.PathLike[str]) -> None:
    """Write or replace a CSV file with one or more tables from `echo_table.extract`; unknown values are empty cells.

    Further tables add rows with the columns of the first one; one of them is in memory at a time.
    """
    write_csv(map(echo_frame, [tables] if isinstance(tables, xr.Dataset) else tables), path, digits=9)


def describe_echoes(found: xr.Dataset) -> list[str]:
    """Return the lines of an echo table, and the column properties."""
    frame = echo_frame(found)
    # Of missing echoes, only surface and bottom are listed; the printed error of a depth includes that of the method.
    frame = frame[~frame["flags"].str.contains("no_echo") | frame["echo"].isin(["surface", "bottom"])]
    frame["depth_m_stderr"] = np.hypot(frame["depth_m_stderr"], frame["depth_m_method_error"])
    names = [str(dim) for dim in found["time_ns"].dims]
    labels = [name for name in names if name != "estimator" or found.sizes["estimator"] > 1]
    unit = {"amplitude": found["amplitude"].attrs["units"], "energy": found["energy"].attrs["units"]}
    heads = {"time_ns": "time (ns)", "depth_m": "depth (m)", "width_ns": "width (ns)"}
    heads |= {name: f"{name} ({of})" if of else name for name, of in unit.items()}
    rows = [[*labels, *(heads[name] for name in NUMBERS), "class", "flags", "depth unknown"]]
    for cells in frame[:_MOST_LINES].to_dict("records"):
        numbers = [_with_error(cells[name], cells[f"{name}_stderr"]) for name in NUMBERS]
        rows.append(
            [*(str(cells[name]) for name in labels), *numbers, cells["class"], cells["flags"], cells["unknown_depth"]]
        )
    listed = aligned_lines(rows, right=range(len(labels), len(labels) + len(NUMBERS)))
    if len(frame) > _MOST_LINES:
        listed.append(f"{len(frame) - _MOST_LINES} more lines: write them all with --csv OUT.")
    return listed + _columns(found)


def _columns(found: xr.Dataset) -> list[str]:
    """Return lines on attenuations, and the changes in the columns if tested for."""
    listed = []
    if "merged_below_m" in found.attrs:
        listed.append(
            f"surface and bottom merge where the water is less than {found.attrs['merged_below_m']:.2f} m deep"
        )
    values = found["attenuation"].values.ravel()
    if np.isfinite(values).any():
        text = f"attenuation of the column (1/m): median {np.nanmedian(values):.4f}"
        if values.size > 1:
            text += f", from {np.nanmin(values):.4f} to {np.nanmax(values):.4f}"
        listed.append(text)
    if "layer" not in found.dims or values.size > _MOST_WAVEFORMS:
        return listed
    layers: Any = found[["layer_depth_m", "layer_p_value", "layer_step"]]
    dims = list(found["attenuation"].dims)
    for place in np.ndindex(*(found.sizes[dim] for dim in dims)):
        one = layers.isel(dict(zip(dims, place, strict=True)))
        label = " ".join(str(found[dim].values[index]) for dim, index in zip(dims, place, strict=True))
        for depth, chance, step in zip(*(one[name].values for name in one.data_vars), strict=True):
            if np.isfinite(depth):
                change = f"signal {100 * np.expm1(step):+.0f} %, p = {max(chance, 1e-99):.1e}"
                listed.append(f"{label}: change at {depth:.2f} m, {change}")
    return listed


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
