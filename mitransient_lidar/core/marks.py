"""Marks that tell what made a file, in a place that readers of its format skip.

A mark is text of JSON near the end of a file: in a comment of PNG, GIF, PDF, SVG and HTML files, in a free box of MP4
files, and behind the data of NetCDF and EXR files, whose readers know where the data end. It holds its own position, so
that it no longer counts once another program has changed the length of the file.
"""

from __future__ import annotations

import json
import os
import stat
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_KEY = b"mitransient-lidar made this file: "
LONGEST_TAIL = 2**16  # bytes at the end of a file that hold the mark and what follows it
_LONGEST = 2**15
_TEXT_OF_LENGTHS = bytes([1, *range(255, -1, -1), 0])  # ends blocks of a GIF whose lengths are characters of a text


def _png_chunk(text: bytes) -> bytes:
    data = b"tEXtComment\0" + text
    return struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))


#: What encloses the text of a mark, by the suffix of the file.
_FORMATS: dict[str, Callable[[bytes], bytes]] = {
    ".png": _png_chunk,
    ".gif": lambda text: b"!\xff\x0bmitransient" + text + _TEXT_OF_LENGTHS,
    ".mp4": lambda text: struct.pack(">I", 8 + len(text)) + b"free" + text,
    ".pdf": lambda text: b"%" + text + b"\n",
    **dict.fromkeys((".svg", ".html"), lambda text: b"<!--" + text + b"-->\n"),
    **dict.fromkeys((".nc", ".exr"), lambda text: text),
}

#: What follows the mark, by the suffix of the file.
_ENDS = {".png": b"\0\0\0\0IEND", ".gif": b";", ".pdf": b"startxref"}


def holds_mark(path: Path) -> bool:
    """Return whether files of the suffix of a path hold marks."""
    return path.suffix.lower() in _FORMATS


def write_mark(path: Path, mark: Mapping[str, Any]) -> None:
    """Add a mark, of types of JSON, to a complete file of a suffix that `holds_mark`; raise OSError if that fails."""
    suffix = path.suffix.lower()
    enclosed = _FORMATS[suffix]
    with path.open("r+b") as file:
        length = file.seek(0, os.SEEK_END)
        start = file.seek(max(length - LONGEST_TAIL, 0))
        tail = file.read()
        cut = max(tail.rfind(_ENDS[suffix]), 0) if suffix in _ENDS else len(tail)
        position = start + cut + enclosed(_KEY).index(_KEY)
        text = json.dumps({**mark, "position": position})
        if len(text) > _LONGEST:
            text = json.dumps({**mark, "parameters": {}, "options": {}, "position": position})
        file.seek(start + cut)
        # A comment of SVG and HTML holds no two hyphens in a row.
        file.write(enclosed(_KEY + text.replace("--", "-\\u002d").encode()) + tail[cut:])


def read_mark(path: Path) -> dict[str, Any] | None:
    """Return the mark of a file; None if it has none, is no regular file, or has been changed by another program."""
    try:
        if not holds_mark(path) or not stat.S_ISREG(path.stat().st_mode):
            return None
        with path.open("rb") as file:
            start = file.seek(max(file.seek(0, os.SEEK_END) - LONGEST_TAIL, 0))
            tail = file.read(LONGEST_TAIL)
        place = tail.rfind(_KEY)
        text = tail[place + len(_KEY) :].decode("ascii", "replace") if place >= 0 else ""
        mark, _ = json.JSONDecoder().raw_decode(text)
    except (OSError, ValueError, RecursionError):
        return None
    return mark if isinstance(mark, dict) and mark.get("position") == start + place else None
