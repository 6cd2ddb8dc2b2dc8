"""Files for all datasets in this package: one `open`, one `save`, and one way to take a dataset or its path.

EXR files round the values to 32 bits and store everything else exactly; NetCDF files store everything exactly.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Union

import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import checked_path, open_file, replacing
from mitransient_lidar.core.formats.array_files import EXR_SIGNATURE
from mitransient_lidar.core.validation import shown
from mitransient_lidar.results import exr, image_files, netcdf, sum_errors, waveform_files
from mitransient_lidar.results.attributes import INFRARED, check_attributes, check_coordinates
from mitransient_lidar.results.dataset import LIGHT, check_axes
from mitransient_lidar.results.gate_stack import check_stack, has_frames

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
    """Read a dataset into memory from a file of `save`, or from a folder with a sequence of gates.

    Waveforms over time of other programs are read from NetCDF-4 files, too. The content shows the format, not the name;
    but .las, .laz, .pls and .wvs files are read by `waveform_files.read_waveforms`, with its `selection`.

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
        dataset, foreign = netcdf.read(path)
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

    Parameters
    ----------
    dataset : xarray.Dataset
        Any dataset of this package for a NetCDF file; a result without further variables, a gate stack or images by
        daylight for an EXR file.
    path : path
        Its suffix is the format: ``.nc`` is NetCDF-4, ``.exr`` OpenEXR; for gates and frames ``.tif`` and ``.png`` are
        16-bit images, which `open` does not read (`image_files.write`). Without a suffix, a gate stack becomes a
        sequence of EXR files ``<path>_gate000.exr`` and so on, one per gate.

    Raises
    ------
    UserError
        If the suffix is another one, the format cannot store the dataset, or the file cannot be written.
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
                netcdf.write(dataset, temporary)
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
        signature = file.read(len(netcdf.SIGNATURE))
    if not signature.startswith(EXR_SIGNATURE) and signature != netcdf.SIGNATURE:
        raise UserError(f"{path} is neither an EXR nor a NetCDF-4 file")
    return signature.startswith(EXR_SIGNATURE)


def kinds_of(dataset: xr.Dataset) -> set[str]:
    """Return the kinds of a dataset: ``result``, ``waveforms``, ``signals``, ``frames``, ``gates``, ..."""
    found = {kind for kind, (_, variables) in _KINDS.items() if all(name in dataset for name in variables)}
    return found - {"signals" if has_frames(dataset) else "frames"}


def dataset_of(name: str, given: Given, *kinds: str, **selection: Any) -> xr.Dataset:
    """Return a dataset of one of the kinds from `kinds_of`, given itself, or by its path for `open` with `selection`.

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
    """Return the names of dataset kinds, the last one after "or"."""
    *first, last = (_KINDS[kind][0] for kind in kinds)
    return f"{', '.join(first)} or {last}" if first else last
