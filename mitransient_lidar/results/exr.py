"""Images of 32-bit floating-point numbers in OpenEXR files, and stacks of time bins in one image.

A file has one or more parts of scan lines, compressed with ZIP. A stack of time bins is one part whose layers are the
bins: the stack ``bin`` with the components ``Y`` and ``stderr`` becomes the channels ``bin0000.Y``,
``bin0000.stderr``, ``bin0001.Y`` and so on, with four digits or as many as the last bin needs. Beyond 1024 channels it
has several parts, named by their first channel.

The attributes are written twice: OpenEXR supports only integers and floats of 32 bits and no empty list, so a JSON
string (header attribute ``mitransientLidar``) stores them exactly; ``exrheader`` and other programs read the copies
under their own names. The attribute ``mitransientLidarSha256`` of each part is the checksum of that string and of the
channels: OpenEXR has none for its header, nor for blocks that ZIP cannot make smaller.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import OpenEXR

from mitransient_lidar.core.array_files import check_exr, damaged_file, largest_result
from mitransient_lidar.core.documents import parse_json
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import require_memory

_EXACT = "mitransientLidar"
_CHECKSUM = "mitransientLidarSha256"
_LAYER = re.compile(r"([A-Za-z]+)(\d{4,})\.(\w+)")
_LONGEST_NAME = 255  # bytes; OpenEXR silently drops attributes with longer names
#: Channels of a part: OpenImageIO reads no more, and OpenEXR takes a time that grows with their square.
_MOST_CHANNELS = 1024
_BYTES_PER_CHANNEL = 2500  #: Memory of a channel besides its values.
_INT32 = np.iinfo(np.int32)
_FLOAT32_MAX = float(np.finfo(np.float32).max)

Stacks = dict[str, dict[str, npt.NDArray[np.float32]]]


class Part(NamedTuple):
    """One image of a file."""

    name: str  #: Unique name of the part; empty in a file of one part.
    attributes: dict[str, Any]  #: The header; for writing, the output of `header`.
    channels: dict[str, npt.NDArray[np.float32]]  #: Channel name to values of shape (row, column).


def write(
    path: str | os.PathLike[str],
    stacks: Mapping[str, Mapping[str, npt.NDArray[Any]]],
    exact: Mapping[str, Any],
    readable: Mapping[str, Any],
) -> None:
    """Write stacks of time bins.

    Parameters
    ----------
    path : path
        File to write; an existing one is overwritten.
    stacks : mapping of str to mapping of str to array
        Stack name (letters) to component name to values of shape (row, column, time); stored as 32-bit floats.
    exact : mapping
        Metadata that `read` returns unchanged, of JSON types.
    readable : mapping of str to int, float, str or a list of those
        Header attributes for other programs. Integers and floats beyond 32 bits are written as text, empty lists are
        omitted.

    Raises
    ------
    UserError
        If so many channels do not fit into the memory.
    OSError
        If the file cannot be written.
    """
    channels: dict[str, npt.NDArray[np.float32]] = {}
    for stack, components in stacks.items():
        for component, values in components.items():
            # Bins first: every channel is one contiguous image.
            images = np.ascontiguousarray(np.moveaxis(np.asarray(values, dtype=np.float32), -1, 0))
            digits = max(4, len(str(len(images) - 1)))
            for index, image in enumerate(images):
                channels[f"{stack}{index:0{digits}d}.{component}"] = image
    names = sorted(channels)
    advice = "take fewer or wider bins, or a .nc file"
    require_memory(f"{len(names)} channels of an EXR file", _BYTES_PER_CHANNEL * len(names), advice)
    several = [names[first : first + _MOST_CHANNELS] for first in range(0, len(names), _MOST_CHANNELS)]
    shared = header(readable, exact)
    parts = [
        Part(
            chosen[0] if len(several) > 1 else "",
            shared if number == 0 else {},
            {name: channels[name] for name in chosen},
        )
        for number, chosen in enumerate(several)
    ]
    write_parts(path, parts)


def read(path: str | os.PathLike[str]) -> tuple[Stacks, dict[str, Any]]:
    """Read the stacks and the exact metadata from a file of `write`.

    Raises
    ------
    UserError
        If the file is damaged or truncated, holds no stack of time bins, or was not written by `write`.
    """
    parts = read_parts(path)
    exact = exact_metadata(path, parts[0].attributes)
    layers: dict[tuple[str, str], dict[int, npt.NDArray[np.float32]]] = {}
    for part in parts:
        for name, image in part.channels.items():
            if match := _LAYER.fullmatch(name):
                layers.setdefault((match[1], match[3]), {})[int(match[2])] = image
    stacks: Stacks = {}
    for (stack, component), by_bin in layers.items():
        if sorted(by_bin) != list(range(len(by_bin))):
            raise UserError(_damaged(path))
        stacks.setdefault(stack, {})[component] = np.stack([by_bin[index] for index in range(len(by_bin))], axis=-1)
    if not stacks:
        raise UserError(f"{path} holds no time bins.")
    return stacks, exact


def header(readable: Mapping[str, Any], exact: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the header attributes of a part from metadata as for `write`; `exact_metadata` returns `exact`."""
    attributes = {
        name: _plain(value)
        for name, value in readable.items()
        if value != [] and 0 < len(name.encode()) <= _LONGEST_NAME
    }
    if exact is not None:
        attributes[_EXACT] = json.dumps(exact)
    return attributes


def exact_metadata(path: str | os.PathLike[str], attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the exact metadata of a part.

    Raises
    ------
    UserError
        If they are missing or damaged.
    """
    foreign = f"{path} is an OpenEXR file, but not a result of mitransient-lidar."
    if _EXACT not in attributes:
        raise UserError(foreign)
    exact = parse_json(attributes[_EXACT], f"the header attribute {_EXACT} of {path}")
    if not isinstance(exact, dict):
        raise UserError(foreign)
    return exact


def write_parts(path: str | os.PathLike[str], parts: Sequence[Part]) -> None:
    """Write one or more images into one file, which is overwritten if it exists.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(
            [
                OpenEXR.Part({**part.attributes, _CHECKSUM: _checksum(part), **kind}, part.channels, part.name)
                for part in parts
            ]
        ) as file:
            file.write(os.fspath(path))
    except RuntimeError as error:
        raise OSError(str(error)) from error


def read_parts(path: str | os.PathLike[str]) -> list[Part]:
    """Read all images of a file.

    Raises
    ------
    UserError
        If the file is damaged, truncated, or larger than half of the memory, or a part has another checksum than its
        own. Files of other programs have none.
    """
    check_exr(path, _damaged(path), largest_result())
    with damaged_file(_damaged(path)), OpenEXR.File(os.fspath(path), separate_channels=True) as file:
        # Closing the file clears its dictionaries and frees the pixels.
        parts = [
            Part(
                str(part.header.get("name", "")),
                dict(part.header),
                {name: channel.pixels.copy() for name, channel in part.channels.items()},
            )
            for part in file.parts
        ]
    if not parts:
        raise UserError(_damaged(path))
    for part in parts:
        # OpenEXR returns an attribute of an unknown type as an object of its own.
        if not isinstance(part.attributes.get(_EXACT, ""), str):
            raise UserError(_damaged(path))
        checksum = _checksum(part)
        if part.attributes.get(_CHECKSUM, checksum) != checksum:
            raise UserError(f"{path} is damaged: its SHA-256 is another one than when it was written.")
    return parts


def _checksum(part: Part) -> str:
    """Return the SHA-256 of the exact metadata and of the channels of a part."""
    digest = hashlib.sha256(part.attributes.get(_EXACT, "").encode())
    for name, pixels in sorted(part.channels.items()):
        digest.update(f"{name} {pixels.dtype} {pixels.shape}".encode())
        digest.update(np.ascontiguousarray(pixels).data)
    return digest.hexdigest()


def _damaged(path: str | os.PathLike[str]) -> str:
    return f"{path} is damaged or truncated: its OpenEXR data cannot be read."


def _plain(value: Any) -> Any:
    """Replace numbers beyond 32 bits by text: OpenEXR would store 0 or infinity."""
    if isinstance(value, list):
        plain = [_plain(item) for item in value]
        return [str(item) for item in value] if any(isinstance(item, str) for item in plain) else plain
    if isinstance(value, int):
        return value if _INT32.min <= value <= _INT32.max else str(value)
    if isinstance(value, float) and _FLOAT32_MAX < abs(value) < np.inf:
        return str(value)
    return value
