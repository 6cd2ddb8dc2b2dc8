"""Reading of arrays from .npy, .npz, OpenEXR and NetCDF-4 files; damaged files are reported as invalid user input."""

from __future__ import annotations

import contextlib
import io
import os
import zipfile
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError

EXR_SIGNATURE = b"\x76\x2f\x31\x01"  #: The first four bytes of every OpenEXR file.

Array = npt.NDArray[Any]


class Variable(NamedTuple):
    """One variable of a NetCDF file."""

    dims: tuple[str, ...]  #: Names of its dimensions.
    values: Array
    is_coordinate: bool
    units: str  #: Its attribute ``units``, "" if it has none.


def readable_suffix(path: Path, suffixes: Collection[str], kind: str) -> str:
    """Return the suffix of a file in lower case; `kind` is the kind of file, for the message.

    Raises
    ------
    UserError
        If the suffix is not one of `suffixes`, or the file cannot be opened.
    """
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise UserError(f"cannot read {path}: the name of a {kind} must end in {', '.join(suffixes)}.")
    try:
        path.open("rb").close()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}.") from error
    return suffix


def read_npy(path: Path) -> Array:
    """Read an array in NumPy's format; pickled objects are rejected."""
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path} is damaged, or is not one array of numbers in NumPy's format.") from error


def read_npz(path: Path, names: Collection[str]) -> dict[str, Array]:
    """Read those arrays of an archive in NumPy's format that have one of the names."""
    try:
        with path.open("rb") as file, np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in names if name in archive}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged, or is not an archive of arrays in NumPy's format.") from error


def read_exr(path: Path) -> dict[str, Array]:
    """Read the channels of the first image of an OpenEXR file, each of shape (row, column) with the top row first."""
    import OpenEXR

    damaged = f"{path} is damaged, or is not an OpenEXR file: its image cannot be read."
    with path.open("rb") as file:
        # OpenEXR prints its own message for a file of another format.
        if file.read(len(EXR_SIGNATURE)) != EXR_SIGNATURE:
            raise UserError(damaged)
    with silence_openexr():
        try:
            with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
                return {name: channel.pixels.copy() for name, channel in file.channels().items()}
        except (RuntimeError, ValueError) as error:
            raise UserError(damaged) from error


def read_netcdf(path: Path) -> dict[str, Variable]:
    """Read the variables of a NetCDF-4 file, coordinates included; times are not decoded."""
    import xarray as xr

    try:
        dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} is damaged, or is not a NetCDF-4 file.") from error
    return {
        str(name): Variable(
            dims=tuple(map(str, variable.dims)),
            values=variable.values,
            is_coordinate=name in dataset.coords,
            units=str(variable.attrs.get("units", "")),
        )
        for name, variable in dataset.variables.items()
    }


@contextlib.contextmanager
def silence_openexr() -> Iterator[None]:
    """Suppress messages that OpenEXR prints from C (file descriptor 2) and from Python (stdout)."""
    saved = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
