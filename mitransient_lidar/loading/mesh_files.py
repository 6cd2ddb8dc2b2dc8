"""Checks of PLY files and grids before Mitsuba reads them: it trusts their counts and face indices.

A PLY file (Turk, 1994, "The PLY polygon file format") has a header that lists elements with counts and properties, and
their values as text or as binary records. Mitsuba reads lists of three alone, so that all records of an element have
one length, and names the vertices ``vertex`` and the triangles ``face``.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError, printable
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import damaged_file
from mitransient_lidar.core.validation import FloatArray

#: Plugins that read PLY files, and those that read grids.
PLY_PLUGINS, GRID_PLUGINS = ("ply", "ellipsoids", "ellipsoidsmesh"), ("gridvolume", "sdfgrid")

#: Grid header: mark and version, number type, cells along x, y, z, channels, bounding box.
_GRID_HEADER = struct.Struct("<3sB5i6f")

#: NumPy types by their names in a header.
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("half", "float16"), "f2"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "long": "i8",
    "ulong": "u8",
}

#: NumPy byte orders by file format; text has none.
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

#: Longest header and header line [bytes].
_LONGEST_HEADER, _LONGEST_LINE = 2**20, 2**12

#: Records that are checked at a time.
_AT_ONCE = 2**17


class _Element(NamedTuple):
    """Record kind in a file: its name, their number, their value types, and which values are in lists."""

    name: str
    number: int
    types: list[str]
    listed: list[bool]


def check_ply(path: Path) -> None:
    """Raise `UserError` if a PLY file is damaged, its length contradicts its header, or a face lacks a vertex."""
    damaged = f"{path} is damaged, or is not a PLY file of triangles."
    with damaged_file(damaged), open_file(path) as file:
        order, elements = _header(file)
        counts = {element.name: element.number for element in elements}
        if len(counts) < len(elements) or not all(element.types for element in elements):
            raise UserError(damaged)
        words = (word for line in file for word in line.split())
        for element in elements:
            for values in _binary(file, element, order) if order else _of_text(words, element):
                if element.name == "face":
                    _check_faces(path, values[:, element.listed], counts.get("vertex", 0))


def check_grid(path: Path) -> None:
    """Raise `UserError` if the numbers in a file for Mitsuba's ``gridvolume`` differ from its header."""
    with damaged_file(f"{path} is damaged, or is not a grid of Mitsuba."), open_file(path) as file:
        _, _, _, *counts, channels = _GRID_HEADER.unpack(file.read(_GRID_HEADER.size))[:7]
        size = 4 * math.prod(counts) * channels + _GRID_HEADER.size
        if min(*counts, channels) < 1 or size != path.stat().st_size:
            told = " x ".join(map(str, counts))
            raise UserError(
                f"{path} has {path.stat().st_size} bytes, and says that it holds {told} cells of {channels} numbers, "
                f"which would need {size}"
            )


def _check_faces(path: Path, indices: FloatArray, vertices: int) -> None:
    """Raise `UserError` for an index of a face without a vertex."""
    # Not by index < 0 or index >= vertices, which are false for NaN.
    for index in indices[~((indices >= 0) & (indices < vertices))][:1]:
        raise UserError(f"{path} has a face with the vertex {index:.15g}, and the vertices 0 to {vertices - 1} alone")


def _header(file: BinaryIO) -> tuple[str, list[_Element]]:
    """Return the byte order of a file, empty for text, and its elements; raise ValueError or KeyError for others."""
    order, elements = "", list[_Element]()
    while file.tell() < _LONGEST_HEADER:
        line = file.readline(_LONGEST_LINE).decode("utf-8", "replace").rstrip("\r\n")
        # Mitsuba prints unknown names.
        if printable(line, kept="\t") != line:
            raise ValueError(line)
        match line.split():
            case ["format", name, "1.0"]:
                order = _FORMATS[name]
            case ["element", name, count]:
                elements.append(_Element(name, int(count), [], []))
            case ["property", "list", length, item, _]:
                elements[-1].types.extend([_TYPES[length], *[_TYPES[item]] * 3])
                elements[-1].listed.extend([False, True, True, True])
            case ["property", kind, _]:
                elements[-1].types.append(_TYPES[kind])
                elements[-1].listed.append(False)
            case ["end_header"]:
                return order, elements
            case [] | ["ply"] | ["comment", *_]:
                pass
            case other:
                raise ValueError(other)
    raise ValueError("no end of the header")


def _binary(file: BinaryIO, element: _Element, order: str) -> Iterator[FloatArray]:
    """Yield the values of records, shape (records, values); raise ValueError where the file ends too early."""
    record = np.dtype([(str(i), order + kind) for i, kind in enumerate(element.types)])
    for first in range(0, element.number, _AT_ONCE):
        count = min(_AT_ONCE, element.number - first)
        values = np.frombuffer(file.read(count * record.itemsize), dtype=record, count=count)
        yield np.stack([values[name].astype(np.float64) for name in record.names or ()], axis=-1)


def _of_text(words: Iterator[bytes], element: _Element) -> Iterator[FloatArray]:
    """Yield record values as `_binary`, from the words of a text."""
    width = len(element.types)
    for first in range(0, element.number, _AT_ONCE):
        count = min(_AT_ONCE, element.number - first)
        yield np.array(list(itertools.islice(words, count * width))).astype(np.float64).reshape(count, width)
