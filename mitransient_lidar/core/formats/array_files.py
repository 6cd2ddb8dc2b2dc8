"""Reading of arrays from files (.npy, .npz, OpenEXR, NetCDF-4); damaged files are reported as invalid user input.

OpenEXR prints its own messages about damaged chunks, which only a change to the whole process could suppress: headers
and chunks are checked before. Format ("OpenEXR File Layout", https://openexr.com/en/latest/OpenEXRFileLayout.html):
signature and version; headers; tables with the positions of all chunks; chunks. A chunk is its first line, its data
size, and the data; in files with several parts, the part number stands before.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_regular, open_file
from mitransient_lidar.core.validation import usable_memory

if TYPE_CHECKING:
    import xarray as xr

LARGEST_ARRAY = 2**28  #: Largest arrays of a map, a table or an image that a scene names [bytes].

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


#: Lines per chunk, by compression number: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)

_ZIPS, _ZIP, _PXR24 = 2, 3, 5  #: Numbers of the compressions ZIPS, ZIP and PXR24, whose data are zlib data.

#: Version bits: a single tiled part, parts with samples at several depths, several parts.
_TILED, _DEEP, _SEVERAL = 0x200, 0x800, 0x1000

#: Bytes per sample for the types UINT, HALF and FLOAT, and within PXR24 data.
_SAMPLE_BYTES, _PXR24_BYTES = (4, 2, 4), (4, 2, 3)

_LONGEST_NAME, _LARGEST_HEADER = 255, 2**28  #: Longest name of an attribute or a channel, and largest header [bytes].


@dataclass(frozen=True)
class Part:
    """One image in a file: its header."""

    shape: tuple[int, int]  #: Lines, and pixels per line.
    first_line: int
    channels: int
    pixel_bytes: int  #: Bytes in all samples of a pixel.
    inflated_bytes: int  #: Bytes within the zlib data.
    compression: int
    chunks: int  #: Number of chunks.
    is_plain: bool  #: Whether it has scan lines of a known compression, with samples in all pixels.

    def check_chunk(self, file: IO[bytes], number: int) -> None:
        """Raise an error for a damaged chunk, at whose first line the file is."""
        lines = _LINES[self.compression]
        line, size = struct.unpack("<ii", file.read(8))
        pixels = min(lines, self.shape[0] - number * lines) * self.shape[1]
        whole, inflated = pixels * self.pixel_bytes, pixels * self.inflated_bytes
        data = file.read(size) if 0 < size <= whole else b""
        if line != self.first_line + number * lines or not data or len(data) != size:
            raise ValueError(f"chunk {number} is damaged")
        is_deflated = self.compression in (_ZIPS, _ZIP, _PXR24) and size < whole
        if is_deflated and len(zlib.decompressobj().decompress(data, inflated + 1)) != inflated:
            raise ValueError(f"chunk {number} is damaged")


def check_parts(path: str | os.PathLike[str], check_size: Callable[[float], None]) -> None:
    """Raise an error if scan line chunks are not where the file states, or do not decompress.

    Tiles are not checked, nor the data of other compressions than ZIP, ZIPS and PXR24. The bytes of the pixels of each
    part are checked before. Raises `ValueError`, `KeyError`, `IndexError`, `struct.error` or `zlib.error` if the file
    is damaged.
    """
    with open_file(path) as file:
        (version,) = struct.unpack("<4xI", file.read(8))
        several = bool(version & _SEVERAL)
        parts = [_part(_attributes(file), version)]
        while several and (attributes := _attributes(file)):
            parts.append(_part(attributes, version))
        for part in parts:
            check_size(4.0 * part.shape[0] * part.shape[1] * max(part.channels, 1))
        if not several and not parts[0].is_plain:
            return
        tables = [struct.unpack(f"<{part.chunks}Q", file.read(8 * part.chunks)) for part in parts]
        for index, (part, table) in enumerate(zip(parts, tables, strict=True)):
            for number, place in enumerate(table if part.is_plain else ()):
                file.seek(place)
                if several and struct.unpack("<i", file.read(4))[0] != index:
                    raise ValueError(f"chunk {number} is damaged")
                part.check_chunk(file, number)


def _attributes(file: IO[bytes]) -> dict[str, bytes]:
    """Return the attributes of the header at which a file is."""
    found = {}
    while name := _text(file):
        _text(file)  # its type
        (size,) = struct.unpack("<i", file.read(4))
        if not 0 <= size <= _LARGEST_HEADER:
            raise ValueError(f"the attribute {name} is damaged")
        found[name] = file.read(size)
    return found


def _text(file: IO[bytes]) -> str:
    """Return a text that ends in NUL."""
    found = b""
    while (byte := file.read(1)) != b"\0":
        if not byte or len(found) == _LONGEST_NAME:
            raise ValueError("a name does not end")
        found += byte
    return found.decode()


def _part(attributes: dict[str, bytes], version: int) -> Part:
    """Return a header's part."""
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    shape = bottom - top + 1, right - left + 1
    kinds, plain = _channels(attributes["channels"])
    compression = attributes["compression"][0]
    whole = sum(_SAMPLE_BYTES[kind] for kind in kinds)
    inflated = sum(_PXR24_BYTES[kind] for kind in kinds) if compression == _PXR24 else whole
    scan_lines = attributes.get("type", b"scanlineimage") == b"scanlineimage" and not version & (_TILED | _DEEP)
    known = compression < len(_LINES)
    if min(shape) < 1:
        raise ValueError("the image is empty")
    if version & _SEVERAL:
        (chunks,) = struct.unpack("<i", attributes["chunkCount"])
    else:
        chunks = -(-shape[0] // _LINES[compression]) if known else 0
    return Part(shape, top, len(kinds), whole, inflated, compression, chunks, plain and scan_lines and known)


def _channels(data: bytes) -> tuple[list[int], bool]:
    """Return the sample types of each channel in a list, and whether all have one in each pixel."""
    found, plain, place = [], True, 0
    while data[place]:
        end = data.index(b"\0", place)
        data[place:end].decode()
        kind, sampling_x, sampling_y = struct.unpack_from("<i4xii", data, end + 1)
        found.append(kind)
        plain = plain and sampling_x == sampling_y == 1
        place = end + 17
    return found, plain
