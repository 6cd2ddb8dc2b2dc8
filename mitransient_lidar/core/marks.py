"""Marks that identify a file's origin, where readers of its format skip them.

A mark is JSON text near the end of a file. PNG, GIF, PDF, SVG and HTML files have it in a comment, and MP4 files in a
free box. NetCDF and EXR files have it after the data, as their readers find the end of the data. It contains its own
position: it ceases to count once another program has changed the file's length.
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
LONGEST_TAIL = 2**16  # bytes at the end of a file that contain the mark and its end
_LONGEST = 2**15
_TEXT_OF_LENGTHS = bytes([1, *range(255, -1, -1), 0])  # ends GIF blocks whose lengths are characters in a text


def _png_chunk(text: bytes) -> bytes:
    data = b"tEXtComment\0" + text
    return struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))


#: Enclosure of a mark's text, by file suffix.
_FORMATS: dict[str, Callable[[bytes], bytes]] = {
    ".png": _png_chunk,
    ".gif": lambda text: b"!\xff\x0bmitransient" + text + _TEXT_OF_LENGTHS,
    ".mp4": lambda text: struct.pack(">I", 8 + len(text)) + b"free" + text,
    ".pdf": lambda text: b"%" + text + b"\n",
    **dict.fromkeys((".svg", ".html"), lambda text: b"<!--" + text + b"-->\n"),
    **dict.fromkeys((".nc", ".exr"), lambda text: text),
}

_ENDS = {".png": b"\0\0\0\0IEND", ".gif": b";", ".pdf": b"startxref"}  #: Bytes after the mark, by file suffix.


def holds_mark(path: Path) -> bool:
    """Return whether files with the suffix of a path contain marks."""
    return path.suffix.lower() in _FORMATS


def write_mark(path: Path, mark: Mapping[str, Any]) -> None:
    """Add a mark, in JSON types, to a complete file with a suffix as in `holds_mark`; raise OSError if that fails."""
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
    """Return a file's mark; None if it has none, is no regular file, or another program has changed it."""
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
