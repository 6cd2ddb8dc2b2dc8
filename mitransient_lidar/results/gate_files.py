"""Files of gate stacks, the datasets of `results.gate_stack`.

An EXR file has one part per gate, named ``gate000``, ``gate001`` and so on (four digits from 1000 gates on), with the
channels ``Y`` and ``Y.stderr``. Pixels without a grid form an image one row high. Every part has the header attributes
``gateStartNs``, ``gateWidthNs`` and, if known, ``gateDepthM``; the first part also has all other metadata of the stack.
A sequence is a folder of files with one part each, numbered like the parts.

Precision is that of the files of `results.dataset`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import replacing, together
from mitransient_lidar.results import exr, netcdf, sum_errors
from mitransient_lidar.results.formats import attribute, describe, input_format, labelled, output_format
from mitransient_lidar.results.schema import check_attributes, check_coordinates

_LOG = logging.getLogger(__name__)

_CHANNELS = {"gate_energy": "Y", "gate_energy_stderr": "Y.stderr"}
_OF_BINS = ("time", "origin", "batch", *sum_errors.DIMS)  # dimensions of results with time bins alone
_SLOPES = "gate_energy_derivative"
_HEADER = {"gate_start": "gateStartNs", "gate_width": "gateWidthNs", "gate_depth": "gateDepthM"}
_IDENTITY = "gateStackId"  # header attribute, equal in all files of a sequence and different between sequences
_NUMBERED = re.compile(r"(.+)_gate(\d{3,})\.exr", re.IGNORECASE | re.DOTALL)


def check_stack(dataset: xr.Dataset) -> xr.Dataset:
    """Return the gates of a dataset, with their derivatives if it has any, without its time bins; ``gate`` is last.

    Raises
    ------
    UserError
        If it has no gates, or dimensions other than (row, column, gate) or (pixel, gate).
    """
    if missing := [name for name in _CHANNELS if name not in dataset]:
        raise UserError(f"the dataset is no gate stack: it has no variable {missing[0]}.")
    energy = dataset["gate_energy"]
    pixels = next((names for names in (("row", "column"), ("pixel",)) if {*names, "gate"} == set(energy.dims)), None)
    if pixels is None or energy.size == 0 or set(dataset["gate_energy_stderr"].dims) != set(energy.dims):
        raise UserError(
            f"the dataset is no gate stack: gate_energy has the shape {dict(energy.sizes)}, but must have the "
            "dimensions (row, column, gate) or (pixel, gate), like gate_energy_stderr, and must not be empty."
        )
    needed = {"gate_start": {"gate"}, "gate_width": {"gate"}, "angle_x": {*pixels}, "angle_y": {*pixels}}
    for name, dims in needed.items():
        if name not in dataset.coords or set(dataset[name].dims) != dims:
            raise UserError(f"the dataset is no gate stack: it has no coordinate {name} over ({', '.join(dims)}).")
    check_attributes("the gate stack", dataset.attrs)
    check_coordinates("the gate stack", dataset, "gate_energy")
    stack = dataset.drop_dims(_OF_BINS, errors="ignore")
    return (stack if _SLOPES in stack else _without_slopes(stack)).transpose(..., *pixels, "gate")


def save_stack(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a gate stack to an EXR (``.exr``) or NetCDF file (``.nc``) atomically; an existing file is replaced.

    Time bins are not written, nor derivatives to EXR files; use `results.save` for both.

    Raises
    ------
    UserError
        If the file name ends otherwise, the dataset is no gate stack, or the file cannot be written.
    """
    path = Path(path)
    exr_file = output_format(path) == "exr"
    stack = _writable(dataset, path, exr_file=exr_file)
    with replacing(path) as temporary:
        if exr_file:
            exr.write_parts(temporary, _parts(stack, is_sequence=False))
        else:
            netcdf.write_netcdf(stack, temporary, tuple(_CHANNELS))


def save_sequence(dataset: xr.Dataset, folder: str | os.PathLike[str], stem: str) -> list[Path]:
    """Write a gate stack as numbered EXR files, one per gate, and return their paths: ``<stem>_gate000.exr`` and so on.

    The first file is written last, so that `open_stack` rejects an interrupted sequence.

    Parameters
    ----------
    dataset : xarray.Dataset
        A gate stack. Time bins and derivatives are not written.
    folder : path
        Output folder, created if missing. Existing files of the same names are replaced.
    stem : str
        Start of the file names, without folders.

    Raises
    ------
    UserError
        If the dataset is no gate stack, `stem` is no file name, or a file cannot be written.
    """
    folder = Path(folder)
    if not stem or Path(stem).name != stem:
        raise UserError(f"stem = {stem!r} must be the start of a file name, without folders.")
    stack = _writable(dataset, folder, exr_file=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror}.") from error
    parts = _parts(stack, is_sequence=True)
    paths = [folder / f"{stem}_{part.name}.exr" for part in parts]
    with together():
        for path, part in zip(paths, parts, strict=True):
            with replacing(path) as temporary:
                exr.write_parts(temporary, [part])
    similar = {path for path in folder.iterdir() if (number := _NUMBERED.fullmatch(path.name)) and number[1] == stem}
    if stale := sorted(similar - set(paths)):
        _LOG.warning("%s does not belong to this sequence of %d gates, but has a similar name", stale[0], len(paths))
    return paths


def open_stack(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a gate stack into memory; values from EXR files have 32 bits.

    Parameters
    ----------
    path : path
        An EXR or NetCDF file of `save_stack`, the first file of a sequence, or a folder with one sequence.

    Raises
    ------
    UserError
        If a file is missing, damaged, truncated, or no gate stack of this package.
    """
    path = Path(path)
    if path.is_dir():
        path = _first_of_folder(path)
    if input_format(path) == "exr":
        return _read_exr(path)
    dataset = netcdf.read_netcdf(path)
    try:
        return check_stack(dataset)
    except UserError as error:
        raise UserError(f"{path} is a NetCDF file, but holds no gate stack of mitransient-lidar.") from error


def _writable(dataset: xr.Dataset, path: Path, *, exr_file: bool) -> xr.Dataset:
    try:
        stack = check_stack(dataset)
    except UserError as error:
        raise UserError(f"cannot write {path}: {error}") from error
    if exr_file:
        stack = _without_slopes(stack)
    if exr_file and (extra := [str(name) for name in stack.data_vars if name not in _CHANNELS]):
        raise UserError(f"cannot write {path}: an EXR file cannot store the variable {extra[0]}; use a .nc file.")
    return stack.assign_attrs({name: attribute(name, value) for name, value in stack.attrs.items()})


def _without_slopes(stack: xr.Dataset) -> xr.Dataset:
    """Return a stack without derivatives and their parameters."""
    return stack.drop_dims("parameter", errors="ignore")


def _parts(stack: xr.Dataset, *, is_sequence: bool) -> list[exr.Part]:
    """Return the images of a stack, with readable attributes in the first one, or in all of a sequence."""
    images = {name: _images(stack[name].values) for name in _CHANNELS}
    count = len(images["gate_energy"])
    metadata, readable = describe(stack, tuple(_CHANNELS))
    exact = {"content": "gates", "is_sequence": is_sequence, **metadata}
    identity = hashlib.sha256(json.dumps(exact).encode())
    for values in images.values():
        identity.update(values.tobytes())
    parts = []
    digits = 3 if count < 1000 else max(4, len(str(count - 1)))
    for index in range(count):
        header: dict[str, Any] = {
            key: float(stack[name].values[index])
            for name, key in _HEADER.items()
            if name in stack.coords and np.isfinite(stack[name].values[index])
        }
        header[_IDENTITY] = identity.hexdigest()
        parts.append(
            exr.Part(
                f"gate{index:0{digits}d}",
                exr.header(readable | header if is_sequence or index == 0 else header, exact if index == 0 else None),
                {channel: images[name][index] for name, channel in _CHANNELS.items()},
            )
        )
    return parts


def _images(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return values over (row, column, gate) or (pixel, gate) as images (gate, row, column)."""
    images = np.moveaxis(values.astype(np.float32), -1, 0)
    return np.ascontiguousarray(images if images.ndim == 3 else images[:, np.newaxis])


def _read_exr(path: Path) -> xr.Dataset:
    parts = exr.read_parts(path)
    number = _NUMBERED.fullmatch(path.name)
    if number and int(number[2]) > 0 and len(parts) == 1 and _IDENTITY in parts[0].attributes:
        first = f"{number[1]}_gate{0:0{len(number[2])}d}.exr"
        raise UserError(f"{path} is gate {int(number[2])} of a sequence: open the folder or the first file, {first}.")
    exact = exr.exact_metadata(path, parts[0].attributes)
    if exact.get("content") != "gates":
        raise UserError(f"{path} holds no gates, but a result with time bins: cut gates from it first.")
    try:
        count = len(exact["coordinates"]["gate_start"]["values"])
        if exact["is_sequence"] and count > 1:
            parts += _later_files(path, count)
        if len(parts) != count:
            raise UserError(f"{path} is damaged or truncated: {len(parts)} of its {count} gates can be read.")
        if len({part.attributes[_IDENTITY] for part in parts}) != 1:
            raise UserError(f"{path} is damaged: its {count} gates belong to different stacks.")
        images = {name: np.stack([part.channels[channel] for part in parts], -1) for name, channel in _CHANNELS.items()}
        return labelled(images, exact)
    except UserError:
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is damaged: its metadata and its images disagree.") from error


def _later_files(first: Path, count: int) -> list[exr.Part]:
    """Return the images of a sequence after the first file; raise `UserError` if a file is missing or damaged."""
    number = _NUMBERED.fullmatch(first.name)
    if number is None or int(number[2]) != 0:
        raise UserError(f"{first} is the first of {count} files of a sequence: its name must end in _gate000.exr.")
    parts: list[exr.Part] = []
    for index in range(1, count):
        path = first.with_name(f"{number[1]}_gate{index:0{len(number[2])}d}{first.suffix}")
        if not path.is_file():
            raise UserError(f"cannot read {path}: gate {index} of the {count} gates of the sequence is missing.")
        parts += exr.read_parts(path)
    return parts


def _first_of_folder(folder: Path) -> Path:
    try:
        numbers = {path: _NUMBERED.fullmatch(path.name) for path in sorted(folder.iterdir())}
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror}.") from error
    firsts = [path for path, number in numbers.items() if number and int(number[2]) == 0]
    if len(firsts) == 1:
        return firsts[0]
    if firsts:
        names = ", ".join(path.name for path in firsts[:3])
        raise UserError(f"{folder} holds {len(firsts)} sequences of gates: open the first file of one ({names}).")
    raise UserError(f"{folder} holds no sequence of gates: its first file would end in _gate000.exr.")
