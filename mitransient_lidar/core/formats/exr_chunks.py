"""Headers and chunks of OpenEXR files, checked before OpenEXR reads them.

OpenEXR prints its own messages about damaged chunks, which only a change to the whole process could suppress. Format
("OpenEXR File Layout", https://openexr.com/en/latest/OpenEXRFileLayout.html): signature and version; headers; tables
with the positions of all chunks; chunks. A chunk is its first line, its data size, and the data; in files with several
parts, the part number stands before.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

from mitransient_lidar.core.files import open_file

#: Lines per chunk, by compression number: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)

_ZIPS, _ZIP, _PXR24 = 2, 3, 5  #: Numbers of the compressions ZIPS, ZIP and PXR24, whose data are zlib data.

#: Version bits: a single tiled part, parts with samples at several depths, several parts.
_TILED, _DEEP, _SEVERAL = 0x200, 0x800, 0x1000

#: Bytes per sample for the types UINT, HALF and FLOAT, and within PXR24 data.
_SAMPLE_BYTES, _PXR24_BYTES = (4, 2, 4), (4, 2, 3)

#: Longest name of an attribute or a channel, and largest header [bytes].
_LONGEST_NAME, _LARGEST_HEADER = 255, 2**28


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
