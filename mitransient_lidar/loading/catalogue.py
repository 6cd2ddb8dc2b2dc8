"""Shipped scenes, and instruments: real lidars' transmitters and receivers by name, with sources of their parameters.

A scene is a Mitsuba XML file in ``mitransient_lidar.scenes``; its name is the file name without the suffix. Files
whose names begin with an underscore are parts that scenes include. An instrument is such a part in the folder
``instruments``: parameters (``<default>``), emitter and sensor. The first line of its first comment is the title. The
rest describes the instrument and numbers its sources as [1], [2], ... A parameter's comment on its own line refers to a
source, or reads "assumed" if there is none.
"""

from __future__ import annotations

import difflib
import importlib.resources
import os
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.dom import minidom

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import check_regular, read_text, replacing, together
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading import document as documents
from mitransient_lidar.loading.parameters import plugins_of, values_of, without_replaced
from mitransient_lidar.transport.sensor.pixels import LayoutPixels

#: End of the name of an instrument's infrared channel, beginning of the names of its parameters, and those of both.
_INFRARED, _OF_INFRARED, _OF_BOTH = "_infrared", "infrared.", ("altitude", "aim_x", "aim_y")

#: Scene parameters that fit its own lidar: the limits of the time axis, and the resolution of the sea.
_TIME_AXIS = ("time_start_ns", "bin_count")
_SEA = ("refined_size", "cell_size", "shortest_wave")


@dataclass(frozen=True)
class InstrumentParameter:
    """Parameter of an instrument: its name and value as in XML, and the comment that gives unit and source."""

    name: str
    value: str
    source: str

    @property
    def is_assumed(self) -> bool:
        """Whether the value is not published."""
        return "assumed" in self.source


@dataclass(frozen=True)
class Instrument:
    """A lidar's transmitter and receiver.

    `description` contains the sources; `channels` are the pixel names.
    """

    name: str
    title: str
    description: str
    parameters: tuple[InstrumentParameter, ...]
    channels: tuple[str, ...]


def instrument_names() -> list[str]:
    """Return the instrument names in alphabetical order."""
    return sorted(path.stem for path in (folder_of_scenes() / "instruments").glob("[!_]*.xml"))


def read_instrument(name: str) -> Instrument:
    """Return an instrument by its name; raise UserError if there is none."""
    path = _path(name)
    root = _own_part(path)
    title, _, description = _head(root).data.strip().partition("\n")
    parameters = tuple(_parameters(root))
    pixels = [tag for tag in root.getElementsByTagName("sensor") if tag.getAttribute("type") == "pixel_fov"]
    names = [tag.getAttribute("value") for pixel in pixels for tag in _named(pixel, "pixel_name")]
    if not names:
        layout = next(parameter.value for parameter in parameters if parameter.name == "layout")
        names = LayoutPixels(layout, 1e-3, "circle").names
    return Instrument(
        name=path.stem,
        title=title,
        description=textwrap.dedent(description).strip(),
        parameters=parameters,
        channels=tuple(names),
    )


def with_infrared(
    name: str | None, params: Mapping[str, Any] | None
) -> tuple[tuple[str, dict[str, Any]], tuple[str, dict[str, Any]]]:
    """Return names and parameters for an instrument's green and infrared channels.

    The infrared channel is an instrument of the same name with the end ``_infrared``. Both channels share the scene's
    parameters, the altitude and the aim. ``infrared.NAME`` is the parameter ``NAME`` for the infrared channel alone;
    other lidar parameters are the green channel's. Coefficients of the water are at 532 nm.

    Raises UserError if there is no such instrument, or it has no infrared channel.
    """
    known = [one.removesuffix(_INFRARED) for one in instrument_names() if one.endswith(_INFRARED)]
    if name is None or f"{_path(name).stem}{_INFRARED}" not in instrument_names():
        raise UserError(
            f"instrument = {shown(name)} has no infrared channel; instruments with one are {', '.join(known)}"
        )
    given, channel = dict(params or {}), name + _INFRARED
    own = {key: value for key, value in given.items() if not str(key).startswith(_OF_INFRARED)}
    of_lidar = documents.parameters_of(documents.read_document(_path(channel)).root).keys() - {*_OF_BOTH}
    other = {key: value for key, value in own.items() if key not in of_lidar}
    other |= {key.removeprefix(_OF_INFRARED): value for key, value in given.items() if key not in own}
    return (name, own), (channel, {"coefficients_nm": 532, **other})


def instrument_text(name: str) -> str:
    """Return the XML of an instrument, self-contained, to be included by a scene; raise UserError if there is none."""
    document = documents.read_document(_path(name))
    _drop_unused(document.root)
    return documents.text_of(document.root)


def receiver_text(name: str) -> str:
    """Return the TOML file of an instrument's receiver; raise UserError if there is no such instrument."""
    return read_text(_path(name).with_suffix(".toml"))


def mount(name: str, scene: documents.SceneDocument) -> documents.SceneDocument:
    """Replace a scene's laser and receiver by an instrument's.

    The scene keeps its film, with the instrument's time bins, its integrator, the point at which the lidar aims, and
    its other emitters. Limits of the time axis and resolution of the sea, which fit the scene's own lidar, return to
    their defaults. Parameters that have become unused are removed.

    Raises UserError if there is no such instrument.
    """
    path = _path(name)
    own, part = _own_part(path), documents.read_document(path).root
    scene = scene.copied()
    root = scene.root
    shared, former = documents.parameters_of(part), values_of(scene)
    values = {name: shared[name] for name in _TIME_AXIS} | documents.parameters_of(own)
    for plugin in plugins_of(scene):
        for size in {*_SEA} & plugin.settings.keys() if plugin.declared.name == "ocean_surface" else ():
            documents.drop_line(plugin.settings[size].element)
    films = [tag for tag in root.getElementsByTagName("film") if tag.getAttribute("type") == "time_gated_film"]
    for child in list(root.childNodes):
        if isinstance(child, minidom.Element) and (
            child.tagName == "sensor" or child.getAttribute("type") == "lidar_transmitter"
        ):
            root.removeChild(child)
    if films:
        _keep_film(films[0], part.getElementsByTagName("film")[0])
    document, first = root.ownerDocument, root.firstChild
    assert document is not None
    document.insertBefore(document.createComment(_head(own).data), root)
    # Of several defaults for a parameter, the first one counts.
    sources = {parameter.name: parameter.source for parameter in _parameters(own)}
    for key, value in values.items():
        default = document.createElement("default")
        default.setAttribute("name", key)
        default.setAttribute("value", value)
        root.insertBefore(document.createTextNode("\n    "), first)
        root.insertBefore(default, first)
        if sources.get(key):
            root.insertBefore(document.createTextNode("  "), first)
            root.insertBefore(document.createComment(f" {sources[key]} "), first)
    has_integrator = any(tag.parentNode is root for tag in root.getElementsByTagName("integrator"))
    for child in list(part.childNodes):
        if not (has_integrator and isinstance(child, minidom.Element) and child.tagName == "integrator"):
            root.appendChild(child)
    scene = replace(scene, parameters=documents.parameters_of(root) | values, instrument=name)
    for plugin in plugins_of(scene):
        for parameter, names in plugin.names():
            # Water and bottom are those at the laser's wavelength.
            if parameter.name in names and parameter.name in values and parameter.name not in plugin.settings:
                plugin.refer(parameter, parameter.name)
    _drop_unused(root)
    known = {key: former.get(key, value) for key, value in documents.parameters_of(root).items()} | values
    return without_replaced(replace(scene, parameters=known), values)


def _own_part(path: Path) -> minidom.Element:
    """Return the root of an instrument's file without its includes."""
    return documents.parse_part(read_text(path), path)


def _keep_film(film: minidom.Element, own: minidom.Element) -> None:
    """Replace an instrument's film by a scene's, with the parameters of the instrument's film."""
    for child in [node for node in own.childNodes if isinstance(node, minidom.Element)]:
        for former in _named(film, child.getAttribute("name")):
            film.removeChild(former)
        film.appendChild(child)
    assert own.parentNode is not None
    own.parentNode.replaceChild(film, own)


def _head(root: minidom.Element) -> minidom.Comment:
    """Return the comment at the head of an instrument's file."""
    assert root.parentNode is not None
    return next(node for node in root.parentNode.childNodes if isinstance(node, minidom.Comment))


def _named(parent: minidom.Element, name: str) -> list[minidom.Element]:
    """Return the children of an element that set a parameter."""
    children = (child for child in parent.childNodes if isinstance(child, minidom.Element))
    return [child for child in children if child.getAttribute("name") == name]


def _parameters(root: minidom.Element) -> Iterator[InstrumentParameter]:
    """Yield the parameters of an instrument's file, with the comments on their lines."""
    for default in root.getElementsByTagName("default"):
        comment = documents.comment_on_line(default)
        text = "" if comment is None else " ".join(comment.data.split())
        yield InstrumentParameter(default.getAttribute("name"), default.getAttribute("value"), text)


def _drop_unused(root: minidom.Element) -> None:
    """Remove the parameters of a scene that no element refers to, with the comments on their lines."""
    used = documents.SceneDocument("", root, parameters=documents.parameters_of(root)).used
    for default in root.getElementsByTagName("default"):
        if default.getAttribute("name") not in used:
            documents.drop_line(default)


def _path(name: str) -> Path:
    """Return the path of an instrument's file; raise UserError if there is none."""
    names = instrument_names()
    if not isinstance(name, str) or name not in names:
        close = difflib.get_close_matches(str(name), names, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}" if close else f"instruments are {', '.join(names)}"
        if Path(str(name)).suffix:
            hint = "a lidar of a file is a part of a scene, by <include>, and its receiver an argument of record"
        raise UserError(f"instrument = {shown(name)} is not known; {hint}")
    return folder_of_scenes() / "instruments" / f"{name}.xml"


def scene_names() -> list[str]:
    """Return the names of the shipped scenes in alphabetical order."""
    return sorted(path.stem for path in folder_of_scenes().glob("*.xml") if not path.name.startswith("_"))


def scene_path(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the path of a shipped scene, which has priority over a file with the same name, or of an XML file.

    Raises UserError if there is no such scene; the message lists shipped scenes with similar names.
    """
    names = scene_names()
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise UserError(f"scene = {shown(name_or_path)} must be the name of a shipped scene or the path of an XML file")
    if str(name_or_path) in names:
        return folder_of_scenes() / f"{name_or_path}.xml"
    path = Path(name_or_path)
    if path.is_dir():
        raise UserError(f"scene {str(name_or_path)!r} is a folder; give an XML file or the name of a shipped scene")
    if path.exists():
        check_regular(path)
        return path
    close = difflib.get_close_matches(path.stem, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}" if close else f"shipped scenes are {', '.join(names) or 'none'}"
    raise UserError(f"scene {str(name_or_path)!r} is neither a file nor a shipped scene; {hint}")


def scene_text(name: str | os.PathLike[str]) -> str:
    """Return the self-contained XML text of a scene, with included files in place.

    Name as in `scene_path`; format and further errors as in `loading.document`.
    """
    return documents.read_document(scene_path(name)).text


def scene_summary(name: str | os.PathLike[str]) -> str:
    """Return the first line of a scene's first comment, empty without a comment; name and errors as in `scene_path`."""
    comment, end, _ = read_text(scene_path(name)).partition("<!--")[2].partition("-->")
    return comment.strip().partition("\n")[0].strip() if end else ""


def scene_parameters(name: str | os.PathLike[str], *, by_id: bool = False) -> dict[str, str]:
    """Return names and values of a scene's parameters: its own (``<default>`` tags), and its plugins'.

    Values are texts, empty for parameters without one. With `by_id`, plugin parameters have their names with ids, too.
    Name and errors as in `scene_text`.
    """
    return values_of(documents.read_document(scene_path(name)), by_id=by_id)


def example_files() -> dict[str, Path]:
    """Return the files of the guides and the shipped flights, by their names."""
    folders = (folder_of_scenes() / "examples", folder_of_scenes() / "flights")
    return {path.name: path for folder in folders for path in sorted(folder.glob("*.*"))}


def copy_scene(
    name: str | os.PathLike[str], destination: str | os.PathLike[str] = ".", overwrite: bool = False
) -> Path:
    """Write a scene as one self-contained file, with copies of the files in its folder that it names.

    Raises UserError if there is no such scene, a file exists already, or one cannot be read or written. No file is
    written then.

    `name`: as in `scene_path`, or the name of a file in `example_files`. `destination`: folder, or path of the new
    file, which is returned. `overwrite`: whether to replace files.
    """
    source = example_files().get(str(name)) or scene_path(name)
    destination = Path(destination)
    target = destination / source.name if destination.is_dir() else destination
    copies = {target: source, **{target.parent / file.name: file for file in files_named_by(source)}}
    for copy, original in copies.items():
        if copy.exists() and copy.samefile(original):
            raise UserError(f"{copy} is the file to be copied: choose another place")
        if os.path.lexists(copy) and not overwrite:
            raise UserError(f"{copy} exists already: choose another place, or replace it with --overwrite")
    with together():
        for copy, original in copies.items():
            with replacing(copy) as temporary:
                if original.suffix == ".xml":
                    temporary.write_text(documents.read_document(original).text, encoding="utf-8")
                else:
                    shutil.copyfile(original, temporary)
    return target


def files_named_by(source: Path) -> list[Path]:
    """Return the files in the folder of a scene or flight that it names, and those that these name."""
    found, left = [source], [source]
    while left:
        file = left.pop()
        if file.suffix in (".xml", ".toml"):
            text = documents.read_document(file).text if file.suffix == ".xml" else read_text(file)
            near = (one for one in sorted(file.parent.iterdir()) if one.is_file() and one not in found)
            named = [one for one in near if f'"{one.name}"' in text]
            found += named
            left += named
    return found[1:]


def folder_of_scenes() -> Path:
    """Return the folder with the shipped scenes."""
    return Path(str(importlib.resources.files("mitransient_lidar.scenes")))
