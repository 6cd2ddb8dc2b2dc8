"""Values of a dict scene in JSON types, and back.

A transform is {"matrix": 4x4, "inverse_transpose": 4x4}, with 3x3 numbers for a texture. An image, a volume or a tensor
without a file is {"stored": its type, "data": its bytes, compressed, as base 64 text} with shape and format.
"""

from __future__ import annotations

import base64
import os
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mitransient_lidar.loading.checks import is_transform, matrix_of

if TYPE_CHECKING:
    import mitsuba as mi

#: Largest image, volume or tensor that is stored, compressed and in memory [bytes].
_MOST_STORED, _MOST_IN_MEMORY = 2**20, 2**26


def to_json(value: Any) -> Any:
    """Return a dict scene's value in JSON types; raise TypeError for an unknown one."""
    import mitsuba as mi

    if isinstance(value, Mapping):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (np.bool_, np.integer, np.floating)):
        return value.item()
    if isinstance(value, os.PathLike):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    if is_transform(value):
        return {name: matrix_of(getattr(value, name)).tolist() for name in ("matrix", "inverse_transpose")}
    if isinstance(value, (mi.Bitmap, mi.VolumeGrid, mi.TensorXf)):
        return _stored(value)
    array = np.array(value)
    if array.shape == (3,) and array.dtype.kind in "fiu":
        return array.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def from_json(value: Any) -> Any:
    """Return a dict scene's value from `to_json`."""
    if isinstance(value, list):
        return [tuple(item) if isinstance(item, list) else item for item in value]
    if not isinstance(value, dict):
        return value
    if isinstance(value.get("stored"), str):
        return _restored(value)
    if set(value) == {"matrix", "inverse_transpose"}:
        import drjit.scalar as ds
        import mitsuba as mi

        of_texture = len(value["matrix"]) == 3
        kind, matrix = (mi.ScalarTransform3d, ds.Matrix3f64) if of_texture else (mi.ScalarTransform4d, ds.Matrix4f64)
        return kind(*(matrix(value[name]) for name in ("matrix", "inverse_transpose")))
    return {key: from_json(item) for key, item in value.items()}


def _stored(value: Any) -> dict[str, Any]:
    """Return an image, a volume or a tensor; raise TypeError if it is too large to be stored, or is not restored."""
    import mitsuba as mi

    array = np.array(value)
    data = zlib.compress(array.tobytes())
    if array.nbytes > _MOST_IN_MEMORY or len(data) > _MOST_STORED:
        raise TypeError(f"{type(value).__name__} of {array.nbytes} bytes is too large to be stored")
    described: dict[str, Any] = {"stored": type(value).__name__, "shape": array.shape, "dtype": array.dtype.str}
    if isinstance(value, mi.Bitmap):
        described |= {"pixel_format": value.pixel_format().name, "srgb_gamma": value.srgb_gamma()}
        described |= {"premultiplied_alpha": value.premultiplied_alpha()}
    elif isinstance(value, mi.VolumeGrid) and _file_of(value) != _file_of(mi.VolumeGrid(array)):
        raise TypeError("a VolumeGrid with a box of its own cannot be stored")
    return {**described, "data": base64.b64encode(data).decode("ascii")}


def _file_of(volume: mi.VolumeGrid) -> bytes:
    """Return the bytes of a volume's file."""
    import mitsuba as mi

    stream = mi.MemoryStream()
    volume.write(stream)
    return bytes(stream.raw_buffer())


def _restored(value: Mapping[str, Any]) -> Any:
    """Return the image, volume or tensor from `_stored`."""
    import mitsuba as mi

    raw = zlib.decompressobj().decompress(base64.b64decode(value["data"], validate=True), _MOST_IN_MEMORY)
    array = np.frombuffer(raw, value["dtype"]).reshape(value["shape"])
    if value["stored"] == "VolumeGrid":
        return mi.VolumeGrid(array)
    if value["stored"] == "TensorXf":
        return mi.TensorXf(array)
    bitmap = mi.Bitmap(array.copy(), getattr(mi.Bitmap.PixelFormat, value["pixel_format"]))
    bitmap.set_srgb_gamma(value["srgb_gamma"])
    bitmap.set_premultiplied_alpha(value["premultiplied_alpha"])
    return bitmap
