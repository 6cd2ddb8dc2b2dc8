"""NetCDF files of labelled datasets."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Collection, Mapping
from typing import Any

import h5netcdf
import numpy as np
import xarray as xr
from xarray.backends import H5NetCDFStore

from mitransient_lidar.core.array_files import check_hdf5, check_size, damaged_file, largest_result
from mitransient_lidar.core.documents import parse_json
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.marks import LONGEST_TAIL
from mitransient_lidar.results.formats import attribute, picture_order

_CHECKSUM = b"mitransient-lidar sha256 "  # what the SHA-256 of a file follows at its end
_LISTS = "mitransient_lidar_lists"  # NetCDF attribute with the names of the attributes to read back as lists


def write_netcdf(dataset: xr.Dataset, path: str | os.PathLike[str], compressed: Collection[str]) -> None:
    """Write a dataset, with the large variables `compressed`, to a NetCDF-4 file; an existing one is overwritten.

    Attributes have the types that `formats.attribute` returns.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    dataset = dataset.drop_encoding()
    # NetCDF does not distinguish a list of one item from the item.
    dataset.attrs[_LISTS] = json.dumps([name for name, value in dataset.attrs.items() if isinstance(value, list)])
    # No fill value: CF forbids it for coordinates, and a NaN in the data is a value.
    encoding: dict[str, dict[str, Any]] = {str(name): {"_FillValue": None} for name in dataset.variables}
    for name in compressed:
        encoding[name] |= {"zlib": True, "complevel": 4, "shuffle": True}
    dump(dataset, path, encoding)


def dump(dataset: xr.Dataset, path: str | os.PathLike[str], encoding: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a dataset to a NetCDF-4 file by way of memory, because HDF5 ends the process where the disk is full.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        dataset.dump_to_store(H5NetCDFStore(file), encoding=encoding)
    with open(path, "wb") as output:
        output.write(buffer.getbuffer())
        output.write(_CHECKSUM + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())


def check_sum(path: str | os.PathLike[str]) -> bool:
    """Return whether a file ends in its checksum; raise `UserError` if in another one, before HDF5, which may hang.

    `dump` appends it to the HDF5 data, and commands a mark (`core.marks`). HDF5 does not read them, and removes them
    when another program changes the file.
    """
    length = len(_CHECKSUM) + 2 * hashlib.sha256().digest_size
    with open_file(path) as file:
        start = file.seek(max(file.seek(0, os.SEEK_END) - length - LONGEST_TAIL, 0))
        tail = file.read()
        if (place := tail.rfind(_CHECKSUM)) < 0:
            return False
        size, known = start + place, tail[place : place + length]
        file.seek(0)
        found = hashlib.sha256()
        while size and (block := file.read(min(size, 2**20))):
            found.update(block)
            size -= len(block)
    if known != _CHECKSUM + found.hexdigest().encode():
        raise UserError(f"{path} is damaged or truncated: its SHA-256 is another one than when it was written.")
    return True


def read_netcdf(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a file of `write_netcdf` into memory, images in picture order.

    Raises
    ------
    UserError
        If the file is damaged, truncated, or larger than half of the memory.
    """
    damaged = f"{path} is damaged or truncated: its NetCDF data cannot be read."
    check_sum(path)
    with damaged_file(damaged):
        check_hdf5(path)
    with (
        damaged_file(damaged),
        xr.open_dataset(path, engine="h5netcdf", decode_times=False) as file,
    ):
        check_size(path, file.nbytes, largest_result())
        dataset = file.load().drop_encoding()
        lists = parse_json(dataset.attrs.pop(_LISTS, "[]"), f"the attribute {_LISTS} of {path}")
        dataset.attrs = {
            str(name): np.atleast_1d(value).tolist() if name in lists else attribute(str(name), value)
            for name, value in dataset.attrs.items()
        }
        for name, coordinate in dataset.coords.items():
            if coordinate.dtype.kind == "O":
                dataset[name] = coordinate.astype(str)
    return picture_order(dataset)
