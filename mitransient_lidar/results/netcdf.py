"""NetCDF files for labelled datasets.

A file has at most 40 attributes of its own, numbers and texts, and so has the group ``infrared`` of a result with two
channels (`results.attributes`). The attribute ``mitransient_lidar`` is a text of JSON
with all others, lists among them, which `read` restores.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import check_hdf5, check_size, damaged_file, largest_result
from mitransient_lidar.core.formats.documents import parse_json
from mitransient_lidar.core.marks import LONGEST_TAIL
from mitransient_lidar.physics.receiver.electronics import Digitiser
from mitransient_lidar.results.attributes import INFRARED, attribute, join, shown, split

#: Beginning of this package's files, and the mark before their SHA-256 at the end.
SIGNATURE, _CHECKSUM = b"\x89HDF\r\n\x1a\n", b"mitransient-lidar sha256 "

#: Attribute with the JSON of those that are not file attributes.
OTHERS = "mitransient_lidar"

_SMALL = 4096  # bytes of a variable that is not worth compressing
_ROUNDING = 1e-2  # of a converter step, by which a signal may differ from a code


def write(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a dataset to a NetCDF-4 file; an existing one is overwritten.

    It goes by way of memory, because HDF5 ends the process where the disk is full. Signals behind a converter are
    written as its codes. Raises `ValueError` if an attribute is no number, text or list of one of these. Raises
    `OSError` if the file cannot be written.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    green, infrared = split(dataset)
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        for group, one in ((file, green), (INFRARED, infrared)):
            if one is not None:
                own = file.create_group(group) if isinstance(group, str) else group
                stored, encoding = _stored(one)
                stored.dump_to_store(H5NetCDFStore(own), encoding=encoding)
    with Path(path).open("wb") as output:
        output.write(buffer.getbuffer())
        output.write(_CHECKSUM + hashlib.sha256(buffer.getbuffer()).hexdigest().encode())


def _stored(dataset: xr.Dataset) -> tuple[xr.Dataset, dict[str, dict[str, Any]]]:
    """Return a dataset as it is stored in a file or a group, and the encoding of its variables."""
    dataset = dataset.drop_encoding()
    attributes = {str(name): attribute(str(name), value) for name, value in dataset.attrs.items()}
    dataset.attrs = shown(attributes)
    # All names, in their order: without a value, those that the file has itself.
    others = {name: None if name in dataset.attrs else value for name, value in attributes.items()}
    dataset.attrs[OTHERS] = json.dumps(others)
    # No fill value: CF forbids it for coordinates, and a NaN in the data is a value.
    encoding: dict[str, dict[str, Any]] = {str(name): {"_FillValue": None} for name in dataset.variables}
    for name, values in dataset.variables.items():
        if values.dtype.kind in "fiub" and values.nbytes > _SMALL:
            encoding[str(name)] |= {"zlib": True, "complevel": 4, "shuffle": True}
    if "signal" in dataset:
        encoding["signal"] |= _codes(dataset["signal"].values, attributes)
    return dataset, encoding


def _codes(signal: np.ndarray[Any, Any], attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the encoding of signals [V] as codes of the converter in the attributes; empty for other values."""
    names = ("receiver.digitiser.bits", "receiver.digitiser.full_scale_v", "receiver.digitiser.low_v")
    if not set(names) <= attributes.keys():
        return {}
    bits, full_scale, low = (attributes[name] for name in names)
    digitiser = Digitiser(int(bits), float(full_scale), float(low))
    codes = (signal[np.isfinite(signal)] - digitiser.low_v) / digitiser.step_v
    if np.any(np.abs(codes - np.rint(codes)) > _ROUNDING):
        return {}  # such as a mean over shots
    # The highest number of the type, which no code has, is the one for missing values.
    kind = np.dtype("uint16" if digitiser.bits < 16 else "uint32")
    scale = {"scale_factor": digitiser.step_v, "add_offset": digitiser.low_v}
    return {"dtype": kind, "_FillValue": int(np.iinfo(kind).max), **scale}


def check_sum(path: str | os.PathLike[str]) -> bool:
    """Return whether a file ends in its checksum; raise `UserError` if in another one, before HDF5, which may hang.

    `write` appends it to the HDF5 data, and commands a mark (`core.marks`). HDF5 does not read them, and removes them
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
        raise UserError(f"{path} is damaged or truncated: its SHA-256 is another one than when it was written")
    return True


def read(path: str | os.PathLike[str]) -> tuple[xr.Dataset, bool]:
    """Read a NetCDF-4 file into memory, and return whether another program than `write` has written it.

    Raises `UserError` if the file is damaged, truncated, or larger than half of the memory.
    """
    import h5py

    damaged = f"{path} is damaged or truncated: its NetCDF data cannot be read."
    check_sum(path)
    with damaged_file(damaged):
        check_hdf5(path)
    dataset, foreign = _group(path, None, damaged)
    with h5py.File(path, "r") as file:
        has_infrared = isinstance(file.get(INFRARED), h5py.Group)
    if not foreign and has_infrared:
        dataset = join(dataset, _group(path, INFRARED, damaged)[0])
    return dataset, foreign


def _group(path: str | os.PathLike[str], group: str | None, damaged: str) -> tuple[xr.Dataset, bool]:
    """Return the dataset of a file, or of a group in it, and whether another program has written it."""
    with damaged_file(damaged), xr.open_dataset(path, group=group, engine="h5netcdf", decode_times=False) as file:
        check_size(path, file.nbytes, largest_result())
        dataset = file.load().drop_encoding()
        foreign = OTHERS not in dataset.attrs
        others = parse_json(dataset.attrs.pop(OTHERS, "{}"), f"the attribute {OTHERS} of {path}")
        own = {str(name): value for name, value in dataset.attrs.items()}
        # Another program may have removed or added some since.
        named = {name: own.get(name, value) for name, value in dict(others).items() if name in own or value is not None}
        for name, coordinate in dataset.coords.items():
            if coordinate.dtype.kind == "O":
                dataset[name] = coordinate.astype(str)
    try:
        dataset.attrs = {name: attribute(name, value) for name, value in {**named, **own}.items()}
    except ValueError as error:
        raise UserError(f"{path} is not of mitransient-lidar: {error}") from error
    return dataset, foreign
