"""What files need so that a labelled dataset comes back exactly: its labels as JSON, and NetCDF files."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.errors import UserError

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"  #: The first eight bytes of every NetCDF-4 file.

_LISTS = "mitransient_lidar_lists"  # NetCDF attribute that names the attributes to read back as lists


def read_signature(path: str | os.PathLike[str]) -> bytes:
    """Return the first eight bytes of a file, which tell its kind.

    Raises
    ------
    UserError
        If it cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return file.read(len(HDF5_SIGNATURE))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}.") from error


def describe_coordinates(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the coordinates of a dataset in the kinds that JSON holds, for `coordinates`."""
    return {
        str(name): {
            "dims": list(coordinate.dims),
            "kind": "str" if coordinate.dtype.kind in "UO" else coordinate.dtype.name,
            "values": coordinate.values.tolist(),
            "attributes": coordinate.attrs,
        }
        for name, coordinate in dataset.coords.items()
    }


def coordinates(described: Mapping[str, Any]) -> dict[str, Any]:
    """Return coordinates for `xarray.Dataset` from what `describe_coordinates` returned.

    Raises
    ------
    KeyError, TypeError, ValueError
        If they are not what it returned.
    """
    return {
        name: (item["dims"], np.array(item["values"], dtype=item["kind"]), item["attributes"])
        for name, item in described.items()
    }


def write_netcdf(dataset: xr.Dataset, path: str | os.PathLike[str], compressed: Collection[str]) -> None:
    """Write a dataset to a NetCDF-4 file.

    Parameters
    ----------
    dataset : xarray.Dataset
        Its attributes are of the kinds that `attribute` returns.
    path : path
        File to write; an existing one is overwritten.
    compressed : collection of str
        Names of the large variables.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    dataset = dataset.drop_encoding()
    # NetCDF cannot tell a list of one item from the item.
    dataset.attrs[_LISTS] = json.dumps([name for name, value in dataset.attrs.items() if isinstance(value, list)])
    # No fill value: CF forbids it for coordinates, and a NaN in the data means what it says.
    encoding: dict[str, dict[str, Any]] = {str(name): {"_FillValue": None} for name in dataset.variables}
    for name in compressed:
        encoding[name] |= {"zlib": True, "complevel": 4, "shuffle": True}
    dataset.to_netcdf(path, engine="h5netcdf", encoding=encoding)


def read_netcdf(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read what `write_netcdf` has written, into memory.

    Raises
    ------
    UserError
        If the file is damaged or truncated.
    """
    try:
        dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
        lists = json.loads(dataset.attrs.pop(_LISTS, "[]"))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path} is damaged or truncated: its NetCDF data cannot be read.") from error
    dataset = dataset.drop_encoding()
    dataset.attrs = {
        str(name): np.atleast_1d(value).tolist() if name in lists else attribute(str(name), value)
        for name, value in dataset.attrs.items()
    }
    for name, coordinate in dataset.coords.items():
        if coordinate.dtype.kind == "O":
            dataset[name] = coordinate.astype(str)
    return dataset


def attribute(name: str, value: Any) -> int | float | str | list[int] | list[float] | list[str]:
    """Turn an attribute into the Python kinds that both file formats return unchanged.

    Raises
    ------
    ValueError
        If it is no int, float, str or list of one of those.
    """
    if isinstance(value, (tuple, list, np.ndarray)):
        items = [attribute(name, item) for item in value]
        if {type(item) for item in items} == {int, float}:
            items = [float(item) for item in items]  # type: ignore[arg-type]
        if len({type(item) for item in items}) <= 1 and not any(isinstance(item, list) for item in items):
            return items  # type: ignore[return-value]
    elif isinstance(value, (bool, int, np.bool_, np.integer)):
        if -(2**63) <= int(value) < 2**63:
            return int(value)
    elif isinstance(value, (float, np.floating)):
        return float(value)
    elif isinstance(value, (str, Path)):
        return text(value)
    raise ValueError(f"attribute {name} = {value!r} must be a 64-bit int, a float, a str or a list of one of those.")


def text(value: str | Path) -> str:
    """Replace what UTF-8 or NetCDF cannot hold: bytes of undecodable file names, and NUL."""
    return str(value).replace("\0", "\ufffd").encode("utf-8", "replace").decode("utf-8")
