"""The scene of a result: its text, its files, and the values of all its plugin parameters.

A result has these attributes:

``scene_xml``
    Text of an XML scene with included files in place. The attributes ``scene.NAME`` are the values of its parameters,
    including the parameters that its plugins declare.
``scene_dict``
    Instead, a scene given as a dict, as JSON (`to_json`).
``instrument``
    Name of the instrument whose laser and receiver the XML contains in place of the scene's own.
``sensor``
    Id of the chosen receiver among several.
``scene_files``
    JSON list of the scene's files: ``plugin``, ``name`` as in the scene, absolute ``path``, ``sha256``.
``plugin_parameters``
    JSON object with the scene's objects and the integrator: ``type`` (for Mitsuba's own plugins ``class``) and values
    of all parameters, nested objects included; null for one that is not given and has no default, or is not used.
    ``used`` contains values that were chosen for automatic ones.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import itertools
import json
import os
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import drjit.scalar as ds
import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError, printable
from mitransient_lidar.core.files import check_regular, is_file_name, is_there, open_file
from mitransient_lidar.core.formats.documents import parse_json
from mitransient_lidar.core.parameters.catalogue import FILE_PARAMETERS, PLUGINS
from mitransient_lidar.core.validation import FloatArray, shown
from mitransient_lidar.loading import checks
from mitransient_lidar.loading.document import SceneDocument, Setting, parse_document
from mitransient_lidar.loading.frame import frame_origin
from mitransient_lidar.loading.parameters import values_of
from mitransient_lidar.transport.plugin_types import OwnPlugin

#: Largest image, volume or tensor that is stored, compressed and in memory [bytes].
_MOST_STORED, _MOST_IN_MEMORY = 2**20, 2**26


def to_json(value: Any) -> Any:
    """Return a dict scene's value in JSON types; raise TypeError for an unknown one."""
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
    if checks.is_transform(value):
        return {name: checks.matrix_of(getattr(value, name)).tolist() for name in ("matrix", "inverse_transpose")}
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
        of_texture = len(value["matrix"]) == 3
        kind, matrix = (mi.ScalarTransform3d, ds.Matrix3f64) if of_texture else (mi.ScalarTransform4d, ds.Matrix4f64)
        return kind(*(matrix(value[name]) for name in ("matrix", "inverse_transpose")))
    return {key: from_json(item) for key, item in value.items()}


def _stored(value: Any) -> dict[str, Any]:
    """Return an image, a volume or a tensor; raise TypeError if it is too large to be stored, or is not restored."""
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
    stream = mi.MemoryStream()
    volume.write(stream)
    return bytes(stream.raw_buffer())


def _restored(value: Mapping[str, Any]) -> Any:
    """Return the image, volume or tensor from `_stored`."""
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


_ORIGIN = np.zeros(3)  #: Origin of the scene's own frame.

#: Largest array of a Mitsuba object whose values are stored; others, such as vertices, are in the files.
_MOST_VALUES = 16


@dataclass(frozen=True)
class SceneSource:
    """The information that loads a scene again."""

    name: str  #: Scene name.
    text: str  #: XML with includes in place, or JSON of a dict.
    is_xml: bool  #: Whether the text is XML.
    #: Own parameters of an XML scene with their values as text; for a result also the parameters that its plugins
    #: declare.
    parameters: Mapping[str, str]
    #: Absolute path and SHA-256 of each file, by the plugin that reads it and its name in the scene.
    files: Mapping[tuple[str, str], tuple[str, str]]
    instrument: str = ""  #: Name of an XML scene's instrument; empty if its laser and receiver are its own.
    sensor: str = ""  #: Id of a receiver in the scene; empty for the first one.

    @classmethod
    def of_document(cls, document: SceneDocument, former: SceneSource | None = None) -> SceneSource:
        """Return an XML scene's source, with the files of the source that it was read from.

        Files that given parameters name are found as in any scene. Raises UserError for a file that is no regular one,
        or a damaged mesh.
        """
        files = _found(((plugin, setting.value) for plugin, setting in _files_of(document)), document.folders)
        if former is not None:
            files |= {file: found for file, found in former.files.items() if file[1] not in document.given.values()}
        sensor = former.sensor if former is not None else ""
        return cls(document.name, document.text, True, dict(document.parameters), files, document.instrument, sensor)

    @classmethod
    def of_dict(cls, scene: Mapping[str, Any]) -> SceneSource | None:
        """Return the source of a scene given as a dict, None if it holds loaded objects or other unknown values.

        Raises UserError as `of_document`.
        """
        files = _found(_files_of_dict(scene), checks.resource_folders(scene))
        try:
            return cls("scene", json.dumps(to_json(scene)), False, {}, files)
        except (RuntimeError, TypeError, ValueError):
            return None

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any], folder: Path | None = None) -> SceneSource:
        """Return the source that `attributes` has written.

        A missing or changed file is looked for by its name and SHA-256 in the result's `folder`, and in the working
        folder.

        Raises UserError if the attributes contain no scene, or are damaged, or the scene's name is no file name.
        """
        kinds = [kind for kind in ("xml", "dict") if f"scene_{kind}" in attributes]
        if not kinds:
            raise UserError(
                "the result does not hold its scene (attribute scene_xml or scene_dict): it was rendered from loaded "
                "objects, from images of more than 1 MiB that no file holds, or by an older release; render the scene "
                "itself"
            )
        prefix, kind = "scene.", f"scene_{kinds[0]}"
        parameters = {name[len(prefix) :]: value for name, value in attributes.items() if name.startswith(prefix)}
        texts = {kind: attributes[kind], **{f"{prefix}{name}": value for name, value in parameters.items()}}
        for name, value in texts.items():
            if not isinstance(value, str):
                raise UserError(f"the attribute {name} = {shown(value)} of the result is damaged: it must be a text")
        rows = json_attribute(attributes, "scene_files") if "scene_files" in attributes else []
        try:
            found = {(row["plugin"], row["name"]): (str(row["path"]), str(row["sha256"])) for row in rows}
        except (KeyError, TypeError) as error:
            raise UserError("the attribute scene_files of the result is damaged: it must be a list of files") from error
        folders = [Path()] if folder is None else [folder, Path()]
        files = {key: (_copy_of(*file, folders), file[1]) for key, file in found.items()}
        name = attributes.get("scene", "scene")
        instrument, sensor = (str(attributes.get(one, "")) for one in ("instrument", "sensor"))
        # Output names begin with it.
        if not is_file_name(name):
            raise UserError(
                f"the attribute scene = {shown(name)} of the result is damaged: it must be the name of a file, without "
                "folders and control characters"
            )
        return cls(name, attributes[kind], kinds[0] == "xml", parameters, files, instrument, sensor)

    @cached_property
    def values(self) -> dict[str, str]:
        """Values of all parameters in an XML scene as text: its own and those that its plugins declare."""
        return values_of(self.document()) if self.is_xml else {}

    def attributes(self) -> dict[str, str]:
        """Return the attributes of a result from which `from_attributes` returns this source."""
        values = values_of(self.document(), by_id=False) if self.is_xml else {}
        given = {**{name: value for name, value in values.items() if value}, **self.parameters}
        described = {f"scene.{name}": value for name, value in given.items()}
        described["scene_xml" if self.is_xml else "scene_dict"] = self.text
        described |= {name: one for name in ("instrument", "sensor") if (one := getattr(self, name))}
        if self.files:
            rows = [
                {"plugin": plugin, "name": name, "path": path, "sha256": digest}
                for (plugin, name), (path, digest) in self.files.items()
            ]
            described["scene_files"] = json.dumps(rows)
        return described

    def document(self) -> SceneDocument:
        """Return an XML scene's document, with its parameter values; raise UserError if it is damaged."""
        document = parse_document(self.name, self.text)
        parameters = {name: self.parameters.get(name, value) for name, value in document.parameters.items()}
        return replace(document, parameters=parameters, instrument=self.instrument)

    def place_files(self, document: SceneDocument) -> str:
        """Return a scene's XML without parameters, with the paths of its files.

        Raises UserError if a file is missing or has changed.
        """
        paths = {id(setting): str(folder) for setting, folder in document.paths.items()}
        for plugin, setting in _files_of(document):
            if (plugin, setting.value) in self.files:
                paths[id(setting)] = _unchanged(plugin, *self.files[plugin, setting.value])
        return document.filled(lambda setting: paths.get(id(setting), setting.value))

    def scene_dict(self) -> dict[str, Any]:
        """Return the scene given as a dict, with paths of its files; raise UserError if a file has changed."""

        def placed(part: dict[str, Any]) -> dict[str, Any]:
            found = {}
            for key, value in part.items():
                file = (str(part.get("type", "")), value)
                is_file = key in FILE_PARAMETERS and isinstance(value, str) and file in self.files
                nested = placed(value) if isinstance(value, dict) else value
                found[key] = _unchanged(file[0], *self.files[file]) if is_file else nested
            return found

        try:
            restored: dict[str, Any] = from_json(placed(parse_json(self.text, "the scene of the result")))
        except UserError:
            raise
        except (ValueError, TypeError, KeyError, AttributeError, RuntimeError, zlib.error) as error:
            raise UserError("the scene of the result is damaged: its text must be JSON of a scene") from error
        return restored


def json_attribute(attributes: Mapping[str, Any], name: str) -> Any:
    """Return a JSON attribute's value; raise UserError if it is missing or damaged."""
    if name not in attributes:
        raise UserError(f"the result has no attribute {name}, without which it is not rendered again")
    return parse_json(attributes[name], f"the attribute {name} of the result")


#: Objects, and the values that were chosen for their automatic parameters.
Used = Sequence[tuple[Any, Mapping[str, float]]]


def plugin_values(scene: mi.Scene, integrator: Any = None, used: Used = ()) -> str:
    """Return the attribute ``plugin_parameters`` of a loaded scene, with another integrator than its own."""
    from mitransient_lidar.plugins.bases import exposed

    own = scene.integrator()
    integrator = own if integrator is None else integrator
    origin = frame_origin(scene)
    described = {} if integrator is None else {"integrator": object_values(integrator, used=used)}
    objects = [(name, part) for name, part in exposed(scene)[1] if part is not own]
    return json.dumps({**described, **_named(objects, origin, used)})


def _named(objects: Iterable[tuple[str, mi.Object]], origin: FloatArray, used: Used) -> dict[str, Any]:
    """Return the objects' parameters by their ids or names, else by their plugins' names."""
    described: dict[str, Any] = {}
    for given, part in objects:
        values = object_values(part, origin, used)
        name = str(part.id() or given)
        # Mitsuba numbers objects without a name: _arg_0, object_1398.
        name = str(values.get("type", values.get("class"))) if re.match(r"_|object_\d", name) else name
        free = (f"{name}_{number}" for number in itertools.count(2))
        described[name if name not in described else next(other for other in free if other not in described)] = values
    return described


def object_values(part: mi.Object, origin: FloatArray = _ORIGIN, used: Used = ()) -> dict[str, Any]:
    """Return an object's parameters, and its nested objects, in JSON types.

    `origin` is the frame's origin in the scene [m]: positions are scene coordinates.
    """
    from mitransient_lidar.plugins.bases import exposed

    if not isinstance(part, OwnPlugin):
        values, objects = exposed(part)
        small = {name: _plain(value) for name, value in values.items() if dr.width(value) <= _MOST_VALUES}
        if isinstance(part, (mi.Shape, mi.Sensor)):
            small = {name: _in_scene(name, value, origin) for name, value in small.items()}
        # The members of a group lie about their instances.
        inner = _ORIGIN if part.class_name() == "ShapeGroup" else origin
        return {"class": part.class_name(), **small, **_named(objects, inner, used)}
    own = part.parameters
    objects = [(name, value) for name, value in own.items() if isinstance(value, mi.Object)]
    plain = {name: _plain(value) for name, value in own.items() if not isinstance(value, mi.Object)}
    known = ["type", *(each.name for each in PLUGINS[str(own["type"])] if each.name.isidentifier())]
    values = getattr(part, "used_values", None) or next((two for one, two in used if one is part), {})
    chosen = {"used": dict(values)} if values else {}
    return {**dict.fromkeys(known), **plain, **chosen, **_named(objects, origin, used)}


def _in_scene(name: str, value: Any, origin: FloatArray) -> Any:
    """Return a value of a Mitsuba shape or sensor with its positions in the scene, not in a frame there."""
    if not origin.any():
        return value
    if name == "to_world":
        moved = np.array(value)
        moved[:3, 3] += origin
        return moved.tolist()
    return (np.reshape(value, (-1, 3)) + origin).ravel().tolist() if name == "vertex_positions" else value


def _plain(value: Any) -> Any:
    """Return a parameter's value in JSON types: a number, a text, or a list; a transform as its matrix."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if checks.is_transform(value):
        return checks.matrix_of(value.matrix).tolist()
    try:
        array = np.array(value)
    except (RuntimeError, TypeError, ValueError):
        return str(value)
    if array.dtype.kind not in "biuf":
        return str(value)
    return array.item() if array.size == 1 else array.ravel().tolist()


def _files_of(document: SceneDocument) -> Iterator[tuple[str, Setting]]:
    """Yield the plugin and the attribute that names a file."""
    types = {id(one.element): one.value for one in document.settings if one.attribute == "type"}
    for setting in document.settings:
        tag = setting.element.tagName
        named = tag == "string" and setting.attribute == "value" and setting.owner in FILE_PARAMETERS
        if named or (tag == "spectrum" and setting.attribute == "filename"):
            yield types.get(id(setting.element.parentNode), ""), setting


def _files_of_dict(scene: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the plugin and the name of each file in a dict scene."""
    for key, value in scene.items():
        if isinstance(value, Mapping):
            yield from _files_of_dict(value)
        elif key in FILE_PARAMETERS and isinstance(value, (str, os.PathLike)):
            yield scene.get("type", ""), str(value)


def _found(references: Iterator[tuple[str, str]], folders: Sequence[Path]) -> dict[tuple[str, str], tuple[str, str]]:
    """Return path and SHA-256 of the files that exist, relative to the working folder.

    Files for Mitsuba's plugins are first looked for in the scene's folders and in Mitsuba's file resolver. Raises
    UserError if a file is no regular one, has control characters in its name, or is a damaged mesh.
    """
    files = {}
    searched = [*folders, *(Path(str(place)) for place in mi.file_resolver()), Path()]
    for plugin, name in references:
        places = [Path()] if plugin in PLUGINS else searched
        path = next((found for place in places if name and is_there(found := place / name)), None)
        if path is not None:
            path = path.resolve()
            files[plugin, name] = str(path), (digest := _sha256(path))
            _check_file(plugin, path, digest)
    return files


@functools.lru_cache(maxsize=64)
def _check_file(plugin: str, path: Path, _digest: str) -> None:
    """Raise UserError if the name of a file has control characters, which Mitsuba would print, or is damaged.

    A file with the same SHA-256 is checked once for a series of renders.
    """
    if printable(str(path)) != str(path):
        raise UserError(f"cannot read {path}: its name must have no control characters")
    if plugin in checks.PLY_PLUGINS:
        checks.check_ply(path)
    if plugin in checks.GRID_PLUGINS:
        checks.check_grid(path)


def _copy_of(path: str, digest: str, folders: Sequence[Path]) -> str:
    """Return a file's path; if it is missing or has another SHA-256, the path of its copy in one of some folders."""
    places = [Path(path), *(folder / Path(path).name for folder in folders)]
    same = (place for place in places if place.is_file() and _sha256(place) == digest)
    return str(next(same, places[0]).absolute())


def _unchanged(plugin: str, path: str, digest: str) -> str:
    """Return the path of a file; raise UserError if it is missing or its SHA-256 is another one."""
    if not is_there(Path(path)):
        raise UserError(f"{path} is missing, a file of the scene of the result: restore it, or render the scene anew")
    if _sha256(Path(path)) != digest:
        raise UserError(
            f"{path} has changed since the result was rendered (its SHA-256 is not {digest[:12]}...): restore it, or "
            "render the scene anew"
        )
    _check_file(plugin, Path(path), digest)
    return path


def _sha256(path: Path) -> str:
    """Return the SHA-256 of a file; raise UserError if it is no regular one."""
    check_regular(path)
    state = path.stat()
    return _hashed(path, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _hashed(path: Path, size: int, modified_ns: int) -> str:
    """Return a file's SHA-256 in a state, computed once in a series of renders."""
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
