"""File formats of results, and metadata in the types that both formats return unchanged."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.array_files import EXR_SIGNATURE
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file

Format = Literal["exr", "netcdf"]

#: Dimension of an image, its description, and the angle that is largest in its first place, as seen from the lidar.
IMAGE_AXES = {
    "row": ("row of the image, 0 farthest from nadir", "angle_x"),
    "column": ("column of the image, 0 leftmost as seen from the lidar", "angle_y"),
}

#: Attributes that are a list over the pixels where they differ.
PER_PIXEL = ("gain", "optical_density", "background_power_w", "fitting_gain", "fitting_optical_density")

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"  # the first eight bytes of a NetCDF-4 file


def output_format(path: Path) -> Format:
    """Return the format that a file name ends with.

    Raises
    ------
    UserError
        If the name ends in neither ``.exr`` nor ``.nc``.
    """
    suffix = path.suffix.lower()
    if suffix not in (".exr", ".nc"):
        raise UserError(f"cannot write {path}: the file name must end in .exr or .nc.")
    return "exr" if suffix == ".exr" else "netcdf"


def input_format(path: str | os.PathLike[str]) -> Format:
    """Return the format of a file by its signature, whatever its name.

    Raises
    ------
    UserError
        If the file cannot be read or has another format.
    """
    with open_file(path) as file:
        signature = file.read(len(_HDF5_SIGNATURE))
    if signature.startswith(EXR_SIGNATURE):
        return "exr"
    if signature == _HDF5_SIGNATURE:
        return "netcdf"
    raise UserError(f"{path} is neither an EXR nor a NetCDF-4 file.")


def describe(dataset: xr.Dataset, variables: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the metadata of variables of one shape, as JSON types for `labelled`, and as attributes for readers."""
    exact = {
        "dims": list(dataset[variables[0]].dims),
        "attributes": dataset.attrs,
        "variables": {name: dataset[name].attrs for name in variables},
        "coordinates": {
            str(name): {
                "dims": list(coordinate.dims),
                "kind": "str" if coordinate.dtype.kind in "UO" else coordinate.dtype.name,
                "values": coordinate.values.tolist(),
                "attributes": coordinate.attrs,
            }
            for name, coordinate in dataset.coords.items()
        },
    }
    readable = {f"lidar.{name}": value for name, value in dataset.attrs.items()}
    if "pixel" in dataset.coords:
        readable["pixelNames"] = [str(name) for name in dataset["pixel"].values]
    return exact, readable


def labelled(images: Mapping[str, npt.NDArray[Any]], exact: Mapping[str, Any]) -> xr.Dataset:
    """Return the dataset of images (row, column, ...) by variable with the metadata of `describe`, in picture order.

    Raises
    ------
    AttributeError, IndexError, KeyError, TypeError, ValueError
        If metadata and images disagree.
    """
    dims = tuple(exact["dims"])
    dataset = xr.Dataset(
        {
            name: (dims, (image if len(dims) == 3 else image[0]).astype(np.float64), exact["variables"][name])
            for name, image in images.items()
        },
        {
            name: (item["dims"], np.array(item["values"], dtype=item["kind"]), item["attributes"])
            for name, item in exact["coordinates"].items()
        },
        exact["attributes"],
    )
    return picture_order(dataset)


def picture_order(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset in the order of a picture taken from the lidar: row 0 far, column 0 left.

    The coordinates `angle_x` and `angle_y` show its order: versions up to 0.1 had the right edge in column 0. Datasets
    without an image, or in this order, are returned as they are.
    """
    for dim, (description, name) in IMAGE_AXES.items():
        if dim not in dataset.dims or dim not in dataset.variables.get(name, xr.Variable((), 0)).dims:
            continue
        angle = dataset[name]
        if angle.sizes[dim] < 2 or not bool((angle.diff(dim) > 0).all()):
            continue
        shape = tuple(dataset.sizes.get(axis, 1) for axis in IMAGE_AXES)
        lists = {
            key: np.flip(np.reshape(dataset.attrs[key], shape), list(IMAGE_AXES).index(dim)).ravel().tolist()
            for key in PER_PIXEL
            if key in dataset.attrs and np.size(dataset.attrs[key]) == math.prod(shape)
        }
        numbers = np.arange(dataset.sizes[dim])
        numbered = dim in dataset.coords and np.array_equal(dataset[dim].values, numbers)
        dataset = dataset.isel({dim: slice(None, None, -1)}).assign_attrs(lists)
        if numbered:
            dataset = dataset.assign_coords({dim: (dim, numbers, {"units": "1", "long_name": description})})
    return dataset


def attribute(name: str, value: Any) -> int | float | str | list[int] | list[float] | list[str]:
    """Convert an attribute to a Python type that both file formats return unchanged.

    Raises
    ------
    ValueError
        If it is no int, float, str or list of one of those.
    """
    if isinstance(value, (tuple, list, np.ndarray)):
        items = [attribute(name, item) for item in value]
        if {type(item) for item in items} == {int, float}:
            items = [float(item) for item in items]  # type: ignore[arg-type]
        if len({type(item) for item in items}) <= 1 and not any(isinstance(item, list) for item in items):
            return items  # type: ignore[return-value]
    elif isinstance(value, (bool, int, np.bool_, np.integer)):
        if -(2**63) <= int(value) < 2**63:
            return int(value)
    elif isinstance(value, (float, np.floating)):
        return float(value)
    elif isinstance(value, (str, Path)):
        return text(value)
    raise ValueError(f"attribute {name} = {value!r} must be a 64-bit int, a float, a str or a list of one of those.")


def text(value: str | Path) -> str:
    """Replace what UTF-8 or NetCDF cannot store: bytes of undecodable file names, and NUL."""
    return str(value).replace("\0", "\ufffd").encode("utf-8", "replace").decode("utf-8")
