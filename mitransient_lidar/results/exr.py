"""OpenEXR files for datasets: parts with 32-bit floating-point channels, compressed with ZIP, and their metadata.

- Time bins are the layers in one part. The stack ``bin`` with the components ``Y`` and ``stderr`` becomes the channels
  ``bin0000.Y``, ``bin0000.stderr``, ``bin0001.Y`` and so on. They have four digits, or as many as the last bin needs.
  More than 1024 channels fill several parts, named by their first channel.
- Gates, and daylight frames, are one part each, named ``gate000`` (four digits from 1000 gates on) or ``frame0000``,
  with the channels ``Y`` and ``Y.stderr``. Camera gates have their frames' moments (``Y``, their mean, ``Y.deviation``,
  ...), and each frame's digital numbers (``frame0000.Y``, ``frame0000.saturated``). Every part has the header
  attributes ``gateStartNs``, ``gateWidthNs`` and, if known, ``gateDepthM``, or ``timeS``. A sequence is a folder with
  one file per gate, numbered like the parts.

Coordinates of more than 131 072 pixels are the last part, ``coordinates``, with the halves of their 64-bit numbers as
integers (``angle_x.low``, ``angle_x.high``). Pixels without a grid form an image one row high. Dimensions, coordinates
and attributes are written twice. OpenEXR supports only 32-bit integers and floats and no empty list, so a JSON string
(header attribute ``mitransientLidar``) stores them exactly; ``exrheader`` and other programs read copies of the numbers
and texts that most readers need. The attribute ``mitransientLidarSha256`` in each part is the checksum of that string
and of the channels: OpenEXR has none for its header, nor for blocks that ZIP cannot make smaller.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import OpenEXR
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing, together
from mitransient_lidar.core.formats.array_files import check_exr, damaged_file, largest_result
from mitransient_lidar.core.formats.documents import parse_json
from mitransient_lidar.core.validation import require_memory
from mitransient_lidar.results.attributes import attribute, shown

_LOG = logging.getLogger(__name__)

_EXACT, _CHECKSUM = "mitransientLidar", "mitransientLidarSha256"
_IDENTITY = "gateStackId"  # header attribute, equal in all files of a sequence and different between sequences
_LAYER = re.compile(r"([A-Za-z]+)(\d{4,})\.(\w+)")
_NUMBERED = re.compile(r"(.+)_gate(\d{3,})\.exr", re.IGNORECASE | re.DOTALL)
_LONGEST_NAME = 255  # bytes; OpenEXR silently drops attributes with longer names
#: Channels in a part: OpenImageIO reads no more, and OpenEXR needs a time that grows with their square.
_MOST_CHANNELS = 1024
_BYTES_PER_CHANNEL = 2500  #: Memory per channel besides its values.
_MOST_LISTED = 2**17  #: Most values of a coordinate in the JSON string; more are channels of a part of their own.
_COORDINATES, _HALVES = "coordinates", ("low", "high")
_INT32 = np.iinfo(np.int32)
_FLOAT32_MAX = float(np.finfo(np.float32).max)

#: Stack and component of the variables over time bins.
_LAYERS = {
    "impulse_response": ("bin", "Y"),
    "impulse_response_stderr": ("bin", "stderr"),
    "waveform": ("wave", "Y"),
    "waveform_stderr": ("wave", "stderr"),
}


class _Images(NamedTuple):
    """Datasets whose images along a dimension are parts."""

    dim: str
    digits: int  #: Fewest digits in a part's number.
    channels: dict[str, str]  #: Channel for each variable.
    header: dict[str, str]  #: Header attribute for each coordinate over the dimension.


_OF_GATES = {"gate_start": "gateStartNs", "gate_width": "gateWidthNs", "gate_depth": "gateDepthM"}
_IMAGES = {
    "gates": _Images("gate", 3, {"gate_energy": "Y", "gate_energy_stderr": "Y.stderr"}, _OF_GATES),
    "frames": _Images("gate", 3, {}, _OF_GATES),
    "radiance": _Images("frame", 4, {"radiance": "Y", "radiance_stderr": "Y.stderr"}, {"time_s": "timeS"}),
}

#: Channels for frame moments, and components for each frame's values.
_MOMENTS = {"signal_mean": "Y", "signal_mean_stderr": "Y.stderr", "signal_deviation": "Y.deviation"}
_MOMENTS |= {"snr": "Y.snr", "saturation": "Y.saturation", "dark_level": "Y.dark"}
_OF_FRAMES = {"signal": "Y", "saturated": "saturated"}


class Part(NamedTuple):
    """One image in a file."""

    name: str  #: Unique part name; empty in a file with one part.
    attributes: dict[str, Any]  #: The header; for writing, in types that OpenEXR stores.
    channels: dict[str, npt.NDArray[Any]]  #: Channel name to values with the shape (row, column).


def parts_of(dataset: xr.Dataset, path: str | os.PathLike[str], content: str, *, sequence: bool = False) -> list[Part]:
    """Return a dataset with ``waveforms``, ``gates`` or ``radiance`` as parts for a file or a file sequence.

    Raises `UserError` if the dataset has variables that the file cannot store, or so many channels do not fit into the
    memory.
    """
    types = {name: dataset[name].dtype.name for name in _OF_FRAMES if name in dataset}
    if content == "frames":
        dataset = _split_frames(dataset, path)
    kind = _kind(content, dataset.data_vars)
    variables = _LAYERS if kind is None else kind.channels
    if extra := [str(name) for name in dataset.data_vars if name not in variables]:
        raise UserError(f"cannot write {path}: an EXR file cannot store the variable {extra[0]}; use a .nc file")
    dataset = dataset.assign_attrs({str(name): attribute(str(name), value) for name, value in dataset.attrs.items()})
    # Text of many numbers would take several times the memory.
    large = {
        name: one
        for name, one in dataset.coords.items()
        if kind is not None and not sequence and one.size > _MOST_LISTED and one.dtype == float and one.ndim == 2
    }
    exact = {
        "content": content,
        "is_sequence": sequence,
        **({"types": types} if types else {}),
        "dims": list(next(iter(dataset.data_vars.values())).dims),
        "attributes": dataset.attrs,
        "variables": {name: dataset[name].attrs for name in variables},
        "coordinates": {
            str(name): {
                "dims": list(coordinate.dims),
                "kind": "str" if coordinate.dtype.kind in "UO" else coordinate.dtype.name,
                "values": None if name in large else coordinate.values.tolist(),
                "attributes": coordinate.attrs,
            }
            for name, coordinate in dataset.coords.items()
        },
    }
    readable = {f"lidar.{name}": value for name, value in shown(dataset.attrs).items() if name != "scene_xml"}
    if "pixel" in dataset.coords:
        readable["pixelNames"] = [str(name) for name in dataset["pixel"].values]
    if kind is None:
        readable |= {"timeStartNs": dataset.attrs["time_start_ns"], "binWidthNs": dataset.attrs["bin_width_ns"]}
        return _layers(dataset, exact, readable)
    channels = {name: image for one in large.values() for name, image in _halves(one).items()}
    return _images(dataset, exact, readable, kind) + ([Part(_COORDINATES, {}, channels)] if large else [])


def _halves(coordinate: xr.DataArray) -> dict[str, npt.NDArray[Any]]:
    """Return the channels of a coordinate over rows and columns: both halves of its 64-bit numbers."""
    halves = np.ascontiguousarray(coordinate.values, "<f8").view("<u4").reshape(*coordinate.shape, 2)
    return {f"{coordinate.name}.{half}": np.ascontiguousarray(halves[..., i]) for i, half in enumerate(_HALVES)}


def _from_halves(name: str, channels: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    """Return a coordinate's values from `_halves`."""
    halves = np.stack([channels[f"{name}.{half}"].astype("<u4") for half in _HALVES], axis=-1)
    return halves.view("<f8")[..., 0].astype(np.float64)


def _kind(content: str, variables: Iterable[Any]) -> _Images | None:
    """Return how a content's images are stored, None for waveforms."""
    if content != "frames":
        return _IMAGES.get(content)
    names = [str(name) for name in variables]
    frames = {
        name: f"frame{name.removeprefix(of)}.{component}"
        for of, component in _OF_FRAMES.items()
        for name in names
        if name.removeprefix(of).isdigit()
    }
    moments = {name: channel for name, channel in _MOMENTS.items() if name in names}
    return _IMAGES["frames"]._replace(channels=moments | frames)


def _split_frames(dataset: xr.Dataset, path: str | os.PathLike[str]) -> xr.Dataset:
    """Return a camera's frames with a variable for each frame, all over the pixels and gates."""
    if "frame" in dataset["signal_mean"].dims or 2 * dataset.sizes["frame"] > _MOST_CHANNELS - len(_MOMENTS):
        raise UserError(
            f"cannot write {path}: an EXR file holds up to {(_MOST_CHANNELS - len(_MOMENTS)) // 2} frames of one sea; "
            "use a .nc or .tif file"
        )
    like = dataset["signal_mean"]
    values: dict[str, xr.DataArray] = {name: dataset[name] for name in map(str, dataset) if name not in _OF_FRAMES}
    if "dark_level" in values:
        values["dark_level"] = values["dark_level"].broadcast_like(like).assign_attrs(dataset["dark_level"].attrs)
    for name in _OF_FRAMES:
        for number, frame in enumerate(dataset[name]):
            values[f"{name}{number:04d}"] = frame.drop_vars("frame").assign_attrs(dataset[name].attrs)
    values = {name: one.transpose(*like.dims) for name, one in values.items()}
    return xr.Dataset(values, dataset.coords, dataset.attrs)


def _joined_frames(dataset: xr.Dataset, types: Mapping[str, str]) -> xr.Dataset:
    """Return frames from `_split_frames` in their original form; `types` are their value types."""
    found = {}
    for name in _OF_FRAMES:
        parts = [dataset[f"{name}{number:04d}"] for number in range(dataset.sizes["frame"])]
        found[name] = xr.concat(parts, dataset["frame"]).astype(types[name]).assign_attrs(parts[0].attrs)
    rest = dataset.drop_vars([name for name in dataset if str(name) not in _MOMENTS])
    if "dark_level" in rest:
        rest["dark_level"] = rest["dark_level"].isel(gate=0)
    return rest.assign(found)


def _layers(dataset: xr.Dataset, exact: Mapping[str, Any], readable: Mapping[str, Any]) -> list[Part]:
    """Return time bins as layers in one part, or in several for many channels."""
    channels: dict[str, npt.NDArray[np.float32]] = {}
    for name, (stack, component) in _LAYERS.items():
        # Bins first: every channel is one contiguous image.
        images = _pictures(dataset[name].values, -1)
        digits = max(4, len(str(len(images) - 1)))
        for index, image in enumerate(images):
            channels[f"{stack}{index:0{digits}d}.{component}"] = image
    names = sorted(channels)
    advice = "take fewer or wider bins, or a .nc file"
    require_memory(f"{len(names)} channels of an EXR file", _BYTES_PER_CHANNEL * len(names), advice)
    chosen = [names[first : first + _MOST_CHANNELS] for first in range(0, len(names), _MOST_CHANNELS)]
    several = [{name: channels[name] for name in part} for part in chosen]
    shared = {**_header(readable), _EXACT: json.dumps(exact)}
    one = len(several) == 1
    return [Part("" if one else next(iter(own)), {} if i else shared, own) for i, own in enumerate(several)]


def _images(dataset: xr.Dataset, exact: Mapping[str, Any], readable: Mapping[str, Any], kind: _Images) -> list[Part]:
    """Return images as parts, with readable attributes in the first one, or in a sequence's every part."""
    single = kind.dim not in dataset.dims
    stack = dataset.expand_dims(kind.dim) if single else dataset
    images = {name: _pictures(stack[name].transpose(kind.dim, ...).values, 0) for name in kind.channels}
    text = json.dumps(exact)
    identity = hashlib.sha256(text.encode())
    for values in images.values():
        identity.update(values.data)
    count = stack.sizes[kind.dim]
    digits = kind.digits if count < 10**kind.digits else max(kind.digits + 1, len(str(count - 1)))
    parts = []
    for index in range(count):
        own: dict[str, Any] = {
            key: float(stack[name].values[index])
            for name, key in kind.header.items()
            if name in stack.coords and not single and np.isfinite(stack[name].values[index])
        }
        own[_IDENTITY] = identity.hexdigest()
        described = {**_header(readable), **own} if exact["is_sequence"] or index == 0 else own
        channels = {channel: images[name][index] for name, channel in kind.channels.items()}
        name = "" if single else f"{kind.dim}{index:0{digits}d}"
        parts.append(Part(name, described | ({_EXACT: text} if index == 0 else {}), channels))
    return parts


def _pictures(values: npt.NDArray[Any], axis: int) -> npt.NDArray[np.float32]:
    """Return values as contiguous images (axis, row, column); pixels without a grid are an image one row high."""
    moved = np.moveaxis(values, axis, 0)
    if moved.dtype == np.float32 and moved.ndim == 3 and moved.flags.c_contiguous:
        return moved
    images = np.empty(moved.shape, np.float32)
    # One after the other, without further arrays of the whole size.
    for image, own in zip(images, moved, strict=True):
        image[...] = own
    return images if images.ndim == 3 else images[:, np.newaxis]


def write_sequence(stack: xr.Dataset, folder: Path, stem: str) -> None:
    """Write a gate stack as numbered files in a folder, one per gate: ``<stem>_gate000.exr`` and so on.

    The folder is created if it is missing, and existing files with the same names are replaced. The first file is
    written last, so that `read` rejects an interrupted sequence. Raises `UserError` if `stem` is no file name, or a
    file cannot be written.
    """
    if not stem or Path(stem).name != stem:
        raise UserError(f"stem = {stem!r} must be the start of a file name, without folders")
    parts = parts_of(stack.drop_dims("parameter", errors="ignore"), folder, "gates", sequence=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror}") from error
    paths = [folder / f"{stem}_{part.name}.exr" for part in parts]
    with together():
        for path, part in zip(paths, parts, strict=True):
            with replacing(path) as temporary:
                write(temporary, [part])
    similar = {path for path in folder.iterdir() if (number := _NUMBERED.fullmatch(path.name)) and number[1] == stem}
    if stale := sorted(similar - set(paths)):
        _LOG.warning("%s does not belong to this sequence of %d gates, but has a similar name", stale[0], len(paths))


def write(path: str | os.PathLike[str], parts: Sequence[Part]) -> None:
    """Write one or more images into one file, which is overwritten if it exists.

    Raises `OSError` if the file cannot be written.
    """
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        stored = [
            OpenEXR.Part({**part.attributes, _CHECKSUM: _checksum(part), **kind}, part.channels, part.name)
            for part in parts
        ]
        with OpenEXR.File(stored) as file:
            file.write(os.fspath(path))
    except RuntimeError as error:
        raise OSError(str(error)) from error


def read(path: Path) -> xr.Dataset:
    """Read a dataset from a file, a sequence's first file, or a folder with one sequence.

    Raises `UserError` if a file is missing, damaged or truncated, or was not written by this package.
    """
    if path.is_dir():
        path = _first_of_folder(path)
    parts = read_parts(path)
    number = _NUMBERED.fullmatch(path.name)
    if number and int(number[2]) > 0 and len(parts) == 1 and _IDENTITY in parts[0].attributes:
        first = f"{number[1]}_gate{0:0{len(number[2])}d}.exr"
        raise UserError(f"{path} is gate {int(number[2])} of a sequence: open the folder or the first file, {first}")
    text = parts[0].attributes.get(_EXACT, "null")
    exact = parse_json(text, f"the header attribute {_EXACT} of {path}")
    if not isinstance(exact, dict):
        raise UserError(f"{path} is an OpenEXR file, but not a result of mitransient-lidar")
    try:
        kind = _kind(exact.get("content", ""), exact["variables"])
        images = _of_layers(path, parts) if kind is None else _of_images(path, parts, exact, kind)
        for name, item in exact["coordinates"].items():
            if item["values"] is None:
                item["values"] = _from_halves(name, next(one.channels for one in parts if one.name == _COORDINATES))
        found = _labelled(images, exact)
        return found if exact["content"] != "frames" else _joined_frames(found, exact["types"])
    except UserError:
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: its metadata and its images disagree") from error


def _of_layers(path: Path, parts: Sequence[Part]) -> dict[str, npt.NDArray[Any]]:
    """Return variables' values over time bins, (row, column, time)."""
    layers: dict[tuple[str, str], dict[int, npt.NDArray[np.float32]]] = {}
    for part in parts:
        for name, image in part.channels.items():
            if match := _LAYER.fullmatch(name):
                layers.setdefault((match[1], match[3]), {})[int(match[2])] = image
    for by_bin in layers.values():
        if sorted(by_bin) != list(range(len(by_bin))):
            raise UserError(_damaged(path))
    return {
        name: np.stack([layers[key][index] for index in range(len(layers[key]))], axis=-1)
        for name, key in _LAYERS.items()
    }


def _of_images(
    path: Path, parts: list[Part], exact: Mapping[str, Any], kind: _Images
) -> dict[str, npt.NDArray[np.float32]]:
    """Return the values of variables with one part per image, (..., row, column) with the dimension of the parts."""
    along, parts = kind.dim in exact["dims"], [part for part in parts if part.name != _COORDINATES]
    count = len(exact["coordinates"][next(iter(kind.header))]["values"]) if along else 1
    if exact["is_sequence"] and count > 1:
        parts = parts + _later_files(path, count)
    if len(parts) != count:
        raise UserError(f"{path} is damaged or truncated: {len(parts)} of its {count} {kind.dim}s can be read")
    if len({part.attributes[_IDENTITY] for part in parts}) != 1:
        raise UserError(f"{path} is damaged: its {count} {kind.dim}s belong to different stacks")
    axis = exact["dims"].index(kind.dim) if along else 0
    found = {}
    for name, channel in kind.channels.items():
        images = np.stack([part.channels[channel] for part in parts])
        found[name] = np.moveaxis(images, 0, -1 if axis else 0) if along else images[0]
    return found


def _labelled(images: Mapping[str, npt.NDArray[Any]], exact: Mapping[str, Any]) -> xr.Dataset:
    """Return the dataset for images by variable; images without a grid lose their row."""
    dims = tuple(exact["dims"])
    coordinates = {
        name: (item["dims"], np.array(item["values"], dtype=item["kind"]), item["attributes"])
        for name, item in exact["coordinates"].items()
    }
    data = {}
    for name, image in images.items():
        values = image if image.ndim == len(dims) else image.squeeze(axis=1 if dims[0] == "frame" else 0)
        data[name] = (dims, values.astype(np.float64), exact["variables"][name])
    return xr.Dataset(data, coordinates, exact["attributes"])


def _later_files(first: Path, count: int) -> list[Part]:
    """Return a sequence's images after the first file; raise `UserError` if a file is missing or damaged."""
    number = _NUMBERED.fullmatch(first.name)
    if number is None or int(number[2]) != 0:
        raise UserError(f"{first} is the first of {count} files of a sequence: its name must end in _gate000.exr")
    parts: list[Part] = []
    for index in range(1, count):
        path = first.with_name(f"{number[1]}_gate{index:0{len(number[2])}d}{first.suffix}")
        if not path.is_file():
            raise UserError(f"cannot read {path}: gate {index} of the {count} gates of the sequence is missing")
        parts += read_parts(path)
    return parts


def _first_of_folder(folder: Path) -> Path:
    try:
        numbers = {path: _NUMBERED.fullmatch(path.name) for path in sorted(folder.iterdir())}
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror}") from error
    firsts = [path for path, number in numbers.items() if number and int(number[2]) == 0]
    if len(firsts) == 1:
        return firsts[0]
    if firsts:
        names = ", ".join(path.name for path in firsts[:3])
        raise UserError(f"{folder} holds {len(firsts)} sequences of gates: open the first file of one ({names})")
    raise UserError(f"{folder} holds no sequence of gates: its first file would end in _gate000.exr")


def read_parts(path: str | os.PathLike[str]) -> list[Part]:
    """Read all images in a file.

    Raises `UserError` if the file is damaged, truncated, or larger than half of the memory, or a part has another
    checksum than its own. Files by other programs have none.
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
        # OpenEXR returns an attribute with an unknown type as an object of its own.
        if not isinstance(part.attributes.get(_EXACT, ""), str):
            raise UserError(_damaged(path))
        checksum = _checksum(part)
        if part.attributes.get(_CHECKSUM, checksum) != checksum:
            raise UserError(f"{path} is damaged: its SHA-256 is another one than when it was written")
    return parts


def _header(readable: Mapping[str, Any]) -> dict[str, Any]:
    """Return the header attributes for other programs: text for numbers beyond 32 bits, and no empty lists."""
    named = {name: value for name, value in readable.items() if value != [] and len(name.encode()) <= _LONGEST_NAME}
    return {name: _plain(value) for name, value in named.items()}


def _checksum(part: Part) -> str:
    """Return the SHA-256 over a part's exact metadata and channels."""
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
