"""Checks of scene values, PLY files and grids before Mitsuba reads them: it trusts their counts and face indices.

A PLY file (Turk, 1994, "The PLY polygon file format") has a header that lists elements with counts and properties.
Their values follow as text or as binary records. Mitsuba reads lists of three alone, so that all records for an element
have one length. It names the vertices ``vertex`` and the triangles ``face``.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError, printable
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.formats.array_files import damaged_file
from mitransient_lidar.core.parameters.catalogue import FILE_PARAMETERS, limits
from mitransient_lidar.core.parameters.lidar import LARGEST_COORDINATE
from mitransient_lidar.core.validation import FloatArray, finite, in_range, integer, is_number, shown
from mitransient_lidar.loading.document import DEEPEST_NESTING, SceneDocument, Setting

#: Name of a plugin, and endings of plugin libraries.
_TYPE, _LIBRARIES = re.compile(r"[A-Za-z0-9_]+"), (".so", ".dylib", ".dll")

#: Refused Mitsuba plugins, and the reasons.
_REFUSED = {
    "blender": "it reads places of the memory",
    "serialized": "its indices are not checked; convert the mesh to PLY or OBJ",
    "hair": "it needs colours; give fibres a diffuse or roughdielectric bsdf",
    **dict.fromkeys(
        ("circular", "measured_polarized", "polarizer", "retarder"), "light of a lidar scene has no polarisation"
    ),
    **dict.fromkeys(
        ("blackbody", "d65", "irregular", "measured", "regular", "specfilm"),
        "it depends on the wavelength, and a lidar scene has one; give values at that wavelength as numbers",
    ),
    **dict.fromkeys(
        ("heterogeneous", "homogeneous"), "the medium of a lidar scene is layered_water, the interior of its sea"
    ),
    **dict.fromkeys(
        ("area", "constant", "directional", "directionalarea", "envmap", "point", "projector", "spot"),
        "the light of a lidar scene comes from one lidar_transmitter, and for images by daylight from sun and sky",
    ),
    **dict.fromkeys(("sunsky", "timed_sunsky"), "it needs colours; use sun and sky"),
}

_COORDINATES = ("x", "y", "z", "value")
#: Attributes that hold one number or several, by the tag of the element.
_NUMBERS = {
    "float": ("value",),
    "integer": ("value",),
    "point": _COORDINATES,
    "vector": _COORDINATES,
    "translate": _COORDINATES,
    "scale": _COORDINATES,
    "rotate": ("x", "y", "z", "angle"),
    "lookat": ("origin", "target", "up"),
    "look_at": ("origin", "target", "up"),
    "matrix": ("value",),
    "spectrum": ("value",),
    "rgb": ("value",),
}
#: Rule of spectra, which Mitsuba would replace by their luminance.
_AT_ONE_WAVELENGTH = "must be one number, the value at the laser's wavelength: others would be averaged by colour"


def check(document: SceneDocument) -> None:
    """Check the object types and the numbers in an XML scene, with its parameter values in place.

    Raises UserError if the root is no scene; a type is not the name of a plugin; a plugin library lies in a folder of
    `document.folders` where `check_libraries` forbids it; a number is not finite, not a number or out of its declared
    range, a size is not positive, a coordinate exceeds `LARGEST_COORDINATE`, or a sensor has no film.
    """
    root = document.root
    if root.tagName != "scene" or root.getAttribute("type") not in ("", "scene"):
        what = f"<{root.tagName}>" if root.tagName != "scene" else f"of type {root.getAttribute('type')!r}"
        raise UserError(f"scene {document.name} has a root element {what}: it must be <scene>")
    for setting in document.settings:
        if setting.attribute == "type":
            check_type(setting.value)
    check_libraries(*document.folders)
    for element in document.root.getElementsByTagName("sensor"):
        if element.parentNode is document.root and not element.getElementsByTagName("film"):
            raise UserError(f"film: sensor {element.getAttribute('id')!r} has none; add a time_gated_film inside it")
    for setting in document.settings:
        _check_setting(setting, document.parameters)


def _check_setting(setting: Setting, parameters: Mapping[str, str]) -> None:
    """Check the numbers in an element's attribute."""
    element, attribute, value, owner = setting.element, setting.attribute, setting.value, setting.owner
    own = owner if attribute == "value" else f"{owner} {attribute}"
    first = setting.referred[:1]
    label = _Label(first[0] if first else own, parameters[first[0]] if first else setting.template, setting.template)
    if attribute in _NUMBERS.get(element.tagName, ()):
        _check_numbers(label, element.tagName, attribute, value)
    elif element.tagName == "spectrum" and attribute == "filename":
        raise label.refusal(_AT_ONE_WAVELENGTH)
    if attribute == "value" and element.tagName in ("float", "integer", "string", "spectrum", "rgb"):
        parent: Any = element.parentNode
        given = float(value) if element.tagName in ("float", "integer") else value
        _check_value(label.name, owner, parent.getAttribute("type"), given)


def check_type(plugin: object) -> None:
    """Raise `UserError` if an object has a plugin that is refused, or no name of one: Mitsuba loads any path."""
    if not isinstance(plugin, str) or not _TYPE.fullmatch(plugin):
        raise UserError(f"type = {shown(plugin)} must be the name of a plugin, of letters, digits and underscores")
    if plugin in _REFUSED:
        raise UserError(f"type = {plugin!r} is not loaded: {_REFUSED[plugin]}")


def check_libraries(*folders: Path) -> None:
    """Raise `UserError` if a folder has a subfolder ``plugins`` with libraries.

    Mitsuba loads plugins from there, its own ones last: beside a scene, or in the current folder, they would run the
    scene author's code.
    """
    own = Path(mi.__file__).parent.resolve()
    for folder in (*folders, Path(), *(Path(str(path)) for path in mi.file_resolver())):
        place = folder.resolve() / "plugins"
        if place.parent == own or not place.is_dir():
            continue
        for library in place.iterdir():
            if library.suffix in _LIBRARIES:
                raise UserError(f"{library} would run as a plugin of Mitsuba; remove it, or work in another folder")


def resource_folders(scene: Mapping[str, Any]) -> list[Path]:
    """Return the folders that objects of the type ``resources`` name in a dict, the one that Mitsuba looks in first.

    Raises UserError if one is no folder: Mitsuba would look for it in the others, too.
    """
    found: list[Path] = []
    for value in scene.values():
        if isinstance(value, Mapping) and value.get("type") == "resources":
            path = value.get("path")
            if not isinstance(path, str) or not Path(path).is_dir():
                raise UserError(f"path = {shown(path)} of resources must be a folder")
            found.insert(0, Path(path))
    return found


def check_dict(scene: Mapping[str, Any]) -> None:
    """Check the values of a scene given as a dict; same rules and errors as `check`."""
    check_libraries(*resource_folders(scene))
    pending: list[tuple[str, Mapping[str, Any], int]] = [("", scene, 1)]
    while pending:
        path, part, depth = pending.pop()
        if depth > DEEPEST_NESTING:
            raise UserError(f"scene: its objects are nested more than {DEEPEST_NESTING} deep, which is the limit")
        for key, value in part.items():
            label = f"{path}{key}"
            if not isinstance(key, str):
                raise UserError(f"scene: the key {shown(key)} must be a name")
            if key == "type":
                check_type(value)
            if isinstance(value, Mapping):
                pending.append((f"{label}.", value, depth + 1))
                given = value.get("filename", value.get("value", ()))
                numbers = given if isinstance(given, (list, tuple)) else [given]
                if all(isinstance(one, (int, float)) for one in numbers):
                    _check_value(label, key, str(part.get("type")), numbers)
                elif value.get("type") == "spectrum":
                    raise UserError(f"{label} = {shown(given)} {_AT_ONE_WAVELENGTH}")
            elif value is None or isinstance(value, (complex, bytes)):
                raise UserError(f"{label} = {shown(value)} must be a number, a text, a transform or an object")
            elif isinstance(value, (int, float, str, list, tuple)) and not isinstance(value, bool):
                if isinstance(value, float):
                    finite(label, value)
                _check_value(label, key, str(part.get("type")), value)
            elif is_transform(value):
                _check_matrix(label, matrix_of(value.matrix))


@dataclass(frozen=True)
class _Label:
    """Name and value of a setting for a number, a scene parameter or an attribute, and the attribute's text."""

    name: str
    value: str
    text: str

    def refusal(self, rule: str) -> UserError:
        """Return the error of a value that breaks a rule."""
        return UserError(f"{self.name} = {self.value if is_number(self.value) else shown(self.value)} {rule}")


def _check_numbers(label: _Label, tag: str, attribute: str, value: str) -> None:
    """Check the numbers of one attribute; a colour may be ``#rrggbb``."""
    words = value.replace(",", " ").split()
    if not words:
        raise label.refusal("is empty: it must be a number")
    for word in words:
        if tag in ("spectrum", "rgb"):
            if ":" in word:
                raise label.refusal(_AT_ONE_WAVELENGTH)
            if word.startswith("#"):
                continue
        if not is_number(word):
            if is_number(label.value) and float(label.value) < 0:
                raise label.refusal(f"must not be negative: the scene uses it as {label.text}")
            raise label.refusal(
                "must be a number" if "$" not in word else "refers to an unknown parameter of the scene"
            )
        if not np.isfinite(float(word)):
            raise label.refusal("must be finite")
        if tag == "integer":
            if not re.fullmatch(r"[+-]?\d+", word):
                raise label.refusal("must be an integer, written without decimal point and exponent")
            integer(label.name, int(word), -(2**63), 2**63 - 1)
        elif tag in ("translate", "lookat", "look_at", "scale") and abs(float(word)) > LARGEST_COORDINATE:
            raise label.refusal(f"must lie between {-LARGEST_COORDINATE:g} and {LARGEST_COORDINATE:g}")
        elif tag == "scale" and (float(word) == 0 or (float(word) < 0 and attribute == "value")):
            raise label.refusal("must be greater than 0: it is the size of a shape")
    if len(words) > 1 and tag in ("float", "integer"):
        raise label.refusal("must be one number")


def _check_value(label: str, name: str, plugin: str, value: Any) -> None:
    """Check a value, the numbers in a list, or in a text that contains nothing else, as a plugin declares them."""
    if name in FILE_PARAMETERS and isinstance(value, (int, float)):
        raise UserError(f"{label} = {value} must be a text, the name of a file")
    numbers = value if isinstance(value, (list, tuple)) else str(value).replace(",", " ").split()
    if (found := limits(name, plugin)) and all(is_number(str(one)) for one in numbers):
        for number in numbers:
            in_range(label, number, *found)


def is_transform(value: object) -> bool:
    """Return whether a value is a transform; arrays of Dr.Jit have a `matrix`, too."""
    return hasattr(value, "matrix") and hasattr(value, "inverse_transpose")


def matrix_of(matrix: Any) -> FloatArray:
    """Return a Dr.Jit matrix as an array: 4x4 for transforms, 3x3 for texture transforms."""
    # Dr.Jit pads the rows of a 3x3 matrix with plain numbers, and NumPy would read the padding as numbers.
    size = range(len(matrix))
    return np.array([[np.array(matrix[row, column]).item() for column in size] for row in size], dtype=np.float64)


def _check_matrix(label: str, matrix: Any) -> None:
    """Check a transform's matrix."""
    if not np.isfinite(matrix).all():
        raise UserError(f"{label} holds {matrix[~np.isfinite(matrix)][0]}: every number of a transform must be finite")
    if np.abs(matrix).max() > LARGEST_COORDINATE:
        largest = matrix.flat[np.abs(matrix).argmax()]
        limit = f"lie between {-LARGEST_COORDINATE:g} and {LARGEST_COORDINATE:g}"
        raise UserError(f"{label} holds {largest:g} but must {limit}")
    if matrix.shape == (4, 4) and np.linalg.det(matrix[:3, :3]) == 0:
        raise UserError(f"{label} has a scale of 0: the object would have no extent")


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

_LONGEST_HEADER, _LONGEST_LINE = 2**20, 2**12  #: Longest header and header line [bytes].
_AT_ONCE = 2**17  #: Records that are checked at a time.


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
