"""Files for all datasets in this package: one `open`, one `save`, and one way to take a dataset or its path.

EXR files round the values to 32 bits and store everything else exactly; NetCDF files store everything exactly.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Union

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path, open_file, replacing
from mitransient_lidar.core.formats import array_files
from mitransient_lidar.core.formats.documents import parse_json
from mitransient_lidar.core.marks import LONGEST_TAIL
from mitransient_lidar.core.validation import shown
from mitransient_lidar.physics.receiver.electronics import Digitiser
from mitransient_lidar.results import exr, image_files, sum_errors, waveform_files
from mitransient_lidar.results.attributes import INFRARED, attribute, check_attributes, check_coordinates, join, split
from mitransient_lidar.results.attributes import shown as of_other_programs
from mitransient_lidar.results.dataset import LIGHT, check_axes
from mitransient_lidar.results.gate_stack import check_stack, has_frames

#: Beginning of this package's files, and the mark before their SHA-256 at the end.
SIGNATURE, _CHECKSUM = b"\x89HDF\r\n\x1a\n", b"mitransient-lidar sha256 "

OTHERS = "mitransient_lidar"  #: Attribute with the JSON of those that are not file attributes.

#: Datasets that are written to the disk directly [bytes], and reserved space over their size.
_LARGE, _RESERVED = 2**28, 1.1

_SMALL = 4096  # bytes of a variable that is not worth compressing
_ROUNDING = 1e-2  # of a converter step, by which a signal may differ from a code


def write_netcdf(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a dataset to a NetCDF-4 file; an existing one is overwritten.

    HDF5 ends the process where the disk is full. Files therefore go by way of memory, and the disk space of large ones
    is reserved first. Signals behind a converter are written as its codes. Raises `ValueError` if an attribute is no
    number, text or list of one of these. Raises `OSError` if the file cannot be written.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    green, infrared = split(dataset)
    is_large = dataset.nbytes > _LARGE and hasattr(os, "posix_fallocate")
    with Path(path).open("w+b") as output:
        buffer = output if is_large else io.BytesIO()
        with h5netcdf.File(buffer, "w") as file:
            if is_large:  # HDF5 cuts the file to its length
                os.posix_fallocate(output.fileno(), 0, round(_RESERVED * dataset.nbytes))
            for group, one in ((file, green), (INFRARED, infrared)):
                if one is not None:
                    own = file.create_group(group) if isinstance(group, str) else group
                    stored, encoding = _stored(one)
                    stored.dump_to_store(H5NetCDFStore(own), encoding=encoding)
        if not isinstance(buffer, io.BytesIO):
            output.seek(0)
            checksum = hashlib.file_digest(output, "sha256")
        else:
            checksum = hashlib.sha256(buffer.getbuffer())
            output.write(buffer.getbuffer())
        output.write(_CHECKSUM + checksum.hexdigest().encode())


def _stored(dataset: xr.Dataset) -> tuple[xr.Dataset, dict[str, dict[str, Any]]]:
    """Return a dataset as it is stored in a file or a group, and its variables' encoding."""
    dataset = dataset.drop_encoding()
    attributes = {str(name): attribute(str(name), value) for name, value in dataset.attrs.items()}
    dataset.attrs = of_other_programs(attributes)
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
    """Return the encoding for signals [V] as the converter's codes in the attributes; empty for other values."""
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

    `write_netcdf` appends it to the HDF5 data, and commands a mark (`core.marks`). HDF5 does not read them, and removes
    them when another program changes the file.
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


def read_netcdf(path: str | os.PathLike[str]) -> tuple[xr.Dataset, bool]:
    """Read a NetCDF-4 file into memory, and return whether another program than `write_netcdf` has written it.

    Raises `UserError` if the file is damaged, truncated, or larger than half of the memory.
    """
    import h5py

    damaged = f"{path} is damaged or truncated: its NetCDF data cannot be read."
    check_sum(path)
    with array_files.damaged_file(damaged):
        array_files.check_hdf5(path)
    dataset, foreign = _group(path, None, damaged)
    with h5py.File(path, "r") as file:
        has_infrared = isinstance(file.get(INFRARED), h5py.Group)
    if not foreign and has_infrared:
        dataset = join(dataset, _group(path, INFRARED, damaged)[0])
    return dataset, foreign


def _group(path: str | os.PathLike[str], group: str | None, damaged: str) -> tuple[xr.Dataset, bool]:
    """Return the dataset in a file, or in a group in it, and whether another program has written it."""
    with (
        array_files.damaged_file(damaged),
        xr.open_dataset(path, group=group, engine="h5netcdf", decode_times=False) as file,
    ):
        array_files.check_size(path, file.nbytes, array_files.largest_result())
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


#: Names of the dataset kinds, and variables that identify each.
_KINDS = {
    "result": ("waveforms of a render", LIGHT),
    "waveforms": ("waveforms over time", ("waveform",)),
    "signals": ("signals of a receiver", ("signal",)),
    "frames": ("frames of a gated camera", ("signal", "signal_mean", "gate_start")),
    "gates": ("a gate stack", ("gate_energy", "gate_energy_stderr")),
    "radiance": ("images by daylight", ("radiance", "radiance_stderr")),
    "echoes": ("a table of echoes", ("depth_m", "flags")),
    "corrections": ("a table of depth errors", ("bias", "spread", "found", "noise_error", "attenuation")),
    "bounds": ("bounds of parameters", ("bound", "bound_known", "ratio")),
    "points": ("points of a flight", ("x", "y", "z", "kind")),
    "campaign": ("the store of a campaign", ("status", "error")),
}

Given = Union["xr.Dataset", str, os.PathLike[str]]


def open(path: str | os.PathLike[str], **selection: Any) -> xr.Dataset:
    """Read a dataset into memory from a file that `save` wrote, or from a folder with a gate sequence.

    Other programs' waveforms over time are read from NetCDF-4 files, too. The content shows the format, not the name.
    Only .las, .laz, .pls and .wvs files are read by `waveform_files.read_waveforms`, with its `selection`.

    Raises
    ------
    UserError
        If the file is missing, damaged, truncated, or not of this package, or its times or attributes are invalid.
    """
    path = checked_path("path", path)
    if waveform_files.is_waveform_file(path):
        return waveform_files.read_waveforms(path, **selection)
    if given := [name for name, value in selection.items() if value is not None]:
        raise UserError(f"{given[0]} is for LAS, LAZ and PulseWaves files, and {path} is none")
    foreign = False
    if path.is_dir() or is_exr(path):
        dataset = exr.read(path)
    else:
        dataset, foreign = read_netcdf(path)
    found = kinds_of(dataset)
    if foreign and not found:
        raise UserError(f"{path} is a NetCDF file, but not of mitransient-lidar")
    for kind, name in (("waveforms", "waveform"), ("signals", "signal")):
        if kind in found and "campaign" not in found:
            check_axes(path, dataset, name)
    if "gates" in found:
        check_stack(dataset, path)
    if "frames" in found:
        check_attributes(path, dataset.attrs)
        check_coordinates(path, dataset, "signal_mean")
    return dataset


def save(dataset: xr.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a dataset to a file atomically; an existing file is replaced.

    `dataset`: any dataset of this package for a NetCDF file; a result without further variables, a gate stack or images
    by daylight for an EXR file. `path`: its suffix is the format: ``.nc`` is NetCDF-4, ``.exr`` OpenEXR; for gates and
    frames ``.tif`` and ``.png`` are 16-bit images, which `open` does not read (`image_files.write`). Without a suffix,
    a gate stack becomes a sequence of EXR files ``<path>_gate000.exr`` and so on, one per gate.

    Raises `UserError` if the suffix is another one, the format cannot store the dataset, or the file cannot be written.
    """
    if not isinstance(dataset, xr.Dataset):
        raise UserError(f"dataset = {shown(dataset)} must be a dataset, an xarray.Dataset")
    path = checked_path("path", path)
    if not path.suffix:
        exr.write_sequence(check_stack(dataset), path.parent, path.name)
        return
    if (suffix := path.suffix.lower()) in image_files.SUFFIXES:
        image_files.write(dataset, path)
        return
    if suffix not in (".exr", ".nc"):
        raise UserError(f"cannot write {path}: the file name must end in .exr, .nc, .tif or .png")
    with replacing(path) as temporary:
        if suffix == ".nc":
            try:
                write_netcdf(dataset, temporary)
            except UserError:
                raise
            except ValueError as error:
                raise UserError(f"cannot write {path}: {error}") from error
        else:
            exr.write(temporary, _exr_parts(dataset, path))


def _exr_parts(dataset: xr.Dataset, path: Path) -> list[exr.Part]:
    """Return a dataset as parts of an EXR file; raise `UserError` if it is none that such a file stores."""
    found = kinds_of(dataset)
    if "shot" in dataset.dims:
        raise UserError(f"cannot write {path}: an EXR file holds a single shot; use a .nc file")
    if INFRARED in dataset.attrs:
        raise UserError(f"cannot write {path}: an EXR file holds no infrared channel; use a .nc file")
    if "result" in found:
        # The attributes have the curve of sum errors in its place.
        return exr.parts_of(dataset.drop_dims(sum_errors.DIMS, errors="ignore"), path, "waveforms")
    if "gates" in found:
        return exr.parts_of(check_stack(dataset).drop_dims("parameter", errors="ignore"), path, "gates")
    if "frames" in found:
        return exr.parts_of(dataset, path, "frames")
    if "radiance" in found:
        images = dataset.drop_vars(["etendue", "background_power"], errors="ignore")
        return exr.parts_of(images, path, "radiance")
    stored = _listed(("result", "gates", "frames", "radiance"))
    raise UserError(f"cannot write {path}: an EXR file holds {stored}; use a .nc file")


def is_exr(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is an EXR file, not a NetCDF-4 one; raise `UserError` if it is neither."""
    with open_file(path) as file:
        signature = file.read(len(SIGNATURE))
    if not signature.startswith(array_files.EXR_SIGNATURE) and signature != SIGNATURE:
        raise UserError(f"{path} is neither an EXR nor a NetCDF-4 file")
    return signature.startswith(array_files.EXR_SIGNATURE)


def kinds_of(dataset: xr.Dataset) -> set[str]:
    """Return a dataset's kinds: ``result``, ``waveforms``, ``signals``, ``frames``, ``gates``, ..."""
    found = {kind for kind, (_, variables) in _KINDS.items() if all(name in dataset for name in variables)}
    return found - {"signals" if has_frames(dataset) else "frames"}


def dataset_of(name: str, given: Given, *kinds: str, **selection: Any) -> xr.Dataset:
    """Return a dataset with a kind from `kinds_of`, given itself, or by its path for `open` with `selection`.

    Raises `UserError`, with the parameter's name, if it is neither, or of none of these kinds, or the file cannot be
    read.
    """
    if isinstance(given, xr.Dataset):
        dataset, place = given, name
    elif isinstance(given, (str, os.PathLike)) and str(given):
        dataset, place = open(given, **selection), str(given)
    else:
        raise UserError(f"{name} = {shown(given)} must be a dataset with {_listed(kinds)}, or the path of its file")
    found = kinds_of(dataset)
    if not found.intersection(kinds):
        own = f"holds {_KINDS[next(kind for kind in _KINDS if kind in found)][0]}" if found else "is another dataset"
        must = "must have" if place == name else f"{name} must have"
        raise UserError(f"{place} {own}, but {must} {_listed(kinds)}")
    return dataset


def _listed(kinds: Iterable[str]) -> str:
    """Return dataset kinds' names, the last one after "or"."""
    *first, last = (_KINDS[kind][0] for kind in kinds)
    return f"{', '.join(first)} or {last}" if first else last
