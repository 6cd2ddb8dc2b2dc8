"""Reading of arrays from files (.npy, .npz, OpenEXR, NetCDF-4); damaged files are reported as invalid user input."""

from __future__ import annotations

import contextlib
import math
import os
import zipfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_regular, open_file
from mitransient_lidar.core.formats.exr_chunks import check_parts
from mitransient_lidar.core.validation import usable_memory

if TYPE_CHECKING:
    import xarray as xr

#: Largest arrays of a map, a table or an image that a scene names [bytes].
LARGEST_ARRAY = 2**28

EXR_SIGNATURE = b"\x76\x2f\x31\x01"  #: First four bytes in every OpenEXR file.

Array = npt.NDArray[Any]


def readable_suffix(path: Path, suffixes: Collection[str], kind: str) -> str:
    """Return a file's suffix in lower case; `kind` is the file kind, for the message.

    Raises `UserError` if the suffix is not one of `suffixes`, or the file cannot be opened, or is no regular one.
    """
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise UserError(f"cannot read {path}: the name of a {kind} must end in {', '.join(suffixes)}")
    open_file(path).close()
    return suffix


def read_npy(path: Path) -> Array:
    """Read an array in NumPy's format; pickled objects are rejected."""
    with damaged_file(f"{path} is damaged, or is not one array of numbers in NumPy's format."), open_file(path) as file:
        return _read_array(path, file)


def read_npz(path: Path, names: Collection[str]) -> dict[str, Array]:
    """Read the arrays with some names from an archive in NumPy's format."""
    found = {}
    with (
        damaged_file(f"{path} is damaged, or is not an archive of arrays in NumPy's format."),
        open_file(path) as opened,
        zipfile.ZipFile(opened) as archive,
    ):
        held = archive.namelist()
        for name in [name for name in names if f"{name}.npy" in held]:
            with archive.open(f"{name}.npy") as file:
                found[name] = _read_array(path, file)
    return found


def _read_array(path: Path, file: IO[bytes]) -> Array:
    """Read an array in NumPy's format; raise `UserError` by its header if it is larger than `LARGEST_ARRAY`."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = readers[np.lib.format.read_magic(file)](file)
    if any(size < 0 for size in shape):
        raise ValueError(f"shape {shape}")  # some NumPy versions read it
    check_size(path, math.prod(shape) * dtype.itemsize)
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


def check_size(path: str | os.PathLike[str], size: float, most: int = LARGEST_ARRAY) -> None:
    """Raise `UserError` if the arrays of a file have more bytes than allowed, which may be many times its own."""
    if size > most:
        sizes = f"{size / 2**20:.4g} MiB, and {most / 2**20:.4g} MiB are the most for a file of this kind"
        raise UserError(f"{path} holds arrays of {sizes}")


def largest_result() -> int:
    """Return the size of the largest result arrays that are read: half this process's memory [bytes]."""
    return int(usable_memory())


@contextlib.contextmanager
def damaged_file(sentence: str) -> Iterator[None]:
    """Convert errors by a reader of foreign files to a `UserError` with a sentence.

    Damaged headers make NumPy's parser raise almost any exception: SyntaxError, TokenError, OverflowError, ...
    """
    try:
        yield
    except (UserError, MemoryError):
        raise
    except Exception as error:
        raise UserError(sentence) from error


def read_exr(path: Path) -> dict[str, Array]:
    """Read the channels in an OpenEXR file's first image, each with the shape (row, column), top row first."""
    import OpenEXR

    damaged = f"{path} is damaged, or is not an OpenEXR file: its image cannot be read."
    with open_file(path) as file:
        # OpenEXR prints its own message for a file of another format.
        if file.read(len(EXR_SIGNATURE)) != EXR_SIGNATURE:
            raise UserError(damaged)
    check_exr(path, damaged, LARGEST_ARRAY)
    with damaged_file(damaged), OpenEXR.File(os.fspath(path), separate_channels=True) as image:
        return {name: channel.pixels.copy() for name, channel in image.channels().items()}


def check_exr(path: str | os.PathLike[str], damaged: str, most: int) -> None:
    """Raise `UserError` if an OpenEXR file is damaged, or has more bytes of pixels than allowed by its headers."""
    check_regular(path)
    with damaged_file(damaged):
        check_parts(path, lambda size: check_size(path, size, most))


def check_hdf5(path: str | os.PathLike[str]) -> None:
    """Raise `UserError` if an HDF5 file takes values or groups from other files, before any is read.

    A dataset may have its values in other files ("external storage", which may be a device), or in datasets in other
    files ("virtual"). A link may lead into another file.
    """
    import h5py

    check_regular(path)
    groups, seen = [h5py.File(path, "r")], set()
    with groups[0]:
        while groups:
            group = groups.pop()
            for name in group:
                link = group.get(name, getlink=True)
                if isinstance(link, h5py.ExternalLink):
                    raise UserError(f"{path} holds a link {name!r} into another file: it must hold all that it needs")
                part = group[name] if isinstance(link, h5py.HardLink) else None
                if isinstance(part, h5py.Dataset) and (part.external or part.is_virtual):
                    raise UserError(f"{path} has {name!r} in other files: it must hold all values that it needs")
                # Links may lead back to a group above.
                if isinstance(part, h5py.Group) and (at := h5py.h5o.get_info(part.id).addr) not in seen:
                    seen.add(at)
                    groups.append(part)


def read_netcdf(path: Path) -> xr.Dataset:
    """Read a NetCDF-4 file; times are not decoded.

    Attributes of its variables include ``_FillValue`` and ``missing_value``, which are NaN in the values.
    """
    import xarray as xr

    damaged = f"{path} is damaged, or is not a NetCDF-4 file."
    with damaged_file(damaged):
        check_hdf5(path)
    with damaged_file(damaged), xr.open_dataset(path, engine="h5netcdf", decode_times=False) as file:
        check_size(path, file.nbytes)
        dataset = file.load()
    for variable in dataset.variables.values():
        variable.attrs = {"units": "", **variable.encoding, **variable.attrs}
    return dataset
