"""XML scene documents: an element tree without includes, its parameters, and its attribute values.

A scene goes one way. A document is read from a file or a source, and an instrument may be mounted (`catalogue.mount`).
Its parameters are filled (`parameters.fill`), its values checked (`checks.check`) and recorded (`scene_source`), and
Mitsuba loads it (`scenes.open_scene`). Each step takes the previous step's document.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from xml.dom import minidom

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import is_there, read_text
from mitransient_lidar.core.formats.documents import check_xml
from mitransient_lidar.core.validation import shown

_MOST_FILES = 256  #: Most files that a scene and its parts include.
DEEPEST_NESTING = 64  #: Deepest nesting of scene objects; Mitsuba's parser is recursive.

#: Represents a dollar sign that is part of a value in the text that Mitsuba parses; there every other dollar sign
#: begins a parameter.
DOLLAR = "\ue024"

_LONGEST_TEXT = 10**6  #: Most characters in an attribute with its parameter values in place.


class Setting(NamedTuple):
    """Element attribute: its text, the text with parameters in place, and the names of those parameters."""

    element: minidom.Element
    attribute: str
    template: str
    value: str
    referred: tuple[str, ...]

    @property
    def owner(self) -> str:
        """Name of the plugin parameter that the element sets, else its tag."""
        return self.element.getAttribute("name") or self.element.tagName


@dataclass(frozen=True)
class SceneDocument:
    """An XML scene without includes."""

    name: str  #: Scene name.
    root: minidom.Element  #: Root element; it is not changed.
    folder: Path = Path()  #: Folder that file names refer to.
    #: Values of its own parameters (``<default>``), as text.
    parameters: Mapping[str, str] = field(default_factory=dict)
    given: Mapping[str, str] = field(default_factory=dict)  #: Those that the user has given.
    instrument: str = ""  #: Name of the instrument whose laser and receiver the scene has; empty if they are its own.
    source: str | None = None  #: Text of the file, if the document is as it was read.

    def copied(self) -> SceneDocument:
        """Return a scene whose root is a copy, to be changed."""
        assert self.root.ownerDocument is not None
        document = self.root.ownerDocument.cloneNode(True)
        assert isinstance(document, minidom.Document)
        assert document.documentElement is not None
        return replace(self, root=document.documentElement, source=None)

    @cached_property
    def text(self) -> str:
        """Text of the scene, with included files as they are in place, but for parameters that are repeated."""
        return text_of(self.root) if self.source is None else self.source

    @cached_property
    def settings(self) -> list[Setting]:
        """Attributes of all elements but ``<default>``, with parameter values in place.

        Defaults may refer to other parameters; other values are taken as they are.
        """
        found, defaults = [], parameters_of(self.root)
        values = {
            name: value if value == defaults.get(name) else value.replace("$", DOLLAR)
            for name, value in self.parameters.items()
        }
        for element in self.root.getElementsByTagName("*"):
            if element.tagName != "default":
                for attribute, template in element.attributes.items():
                    value, referred = _resolved(template, values)
                    found.append(Setting(element, attribute, template, value.replace(DOLLAR, "$"), tuple(referred)))
        return found

    @cached_property
    def paths(self) -> dict[int, Path]:
        """Folders in the elements ``<path>``, absolute, by the ids of their settings; raise UserError without one.

        Mitsuba would look for a relative one in those before, too.
        """
        found = {}
        for setting in self.settings:
            if setting.element.tagName == "path" and setting.attribute == "value":
                places = (self.folder / setting.value, Path(setting.value))
                if not (folders := [place.resolve() for place in places if place.is_dir()]):
                    raise UserError(f"path = {setting.value!r} is no folder in {self.folder}")
                found[id(setting)] = folders[0]
        return found

    @property
    def folders(self) -> list[Path]:
        """Folders in which Mitsuba finds files and plugins of the scene, in its order."""
        return [*reversed(self.paths.values()), self.folder]

    @cached_property
    def used(self) -> set[str]:
        """Names of the parameters that an attribute refers to."""
        return {name for setting in self.settings for name in setting.referred}

    def filled(self, replaced: Callable[[Setting], str]) -> str:
        """Return the XML of the scene without parameters and comments, with the attributes that a function returns.

        Elements stay on their lines. Mitsuba gets this text alone: an ``<include>``, whose file no check has seen, is
        refused.
        """
        _refuse_includes(self.root, self.name)
        # The root's own attributes have no parameters.
        values = {id(self.root): dict(self.root.attributes.items())}
        for setting in self.settings:
            value = replaced(setting).replace("$", DOLLAR)
            values.setdefault(id(setting.element), {})[setting.attribute] = value
        return _written(self.root, values)


def read_document(path: Path) -> SceneDocument:
    """Read a scene file with all included files in place.

    Names of included files are relative to the file that names them and contain no parameters.

    Raises UserError if a file is missing, unreadable, not well-formed XML, or includes itself, or there are more than
    256.
    """
    text = read_text(path)
    if parse_part(text, path).getElementsByTagName("include"):
        root = _expanded(path)
        _drop_repeated(root)
        text = text_of(root)
    return parse_document(path.stem, text, path)


def parse_document(name: str, text: str, path: Path | None = None) -> SceneDocument:
    """Return the document of a text; raise UserError if it is malformed, nested too deeply, or includes a file."""
    root = parse_part(text, path or name)
    _refuse_includes(root, path or name)
    return SceneDocument(name, root, path.parent if path else Path(), parameters_of(root), source=text)


def _refuse_includes(root: minidom.Element, place: Path | str) -> None:
    """Raise `UserError` if an element within a root includes a file, or the root does."""
    for include in [root] if root.tagName == "include" else root.getElementsByTagName("include"):
        name = include.getAttribute("filename")
        raise UserError(f"scene {place} includes {name!r}: only the file of a scene may include others")


def parameters_of(root: minidom.Element) -> dict[str, str]:
    """Return names and default values of the parameters in an XML scene without includes, in their order."""
    parameters: dict[str, str] = {}
    for tag in root.getElementsByTagName("default"):
        parameters.setdefault(tag.getAttribute("name"), tag.getAttribute("value"))
    return parameters


def comment_on_line(element: minidom.Element) -> minidom.Comment | None:
    """Return the comment behind an element on its line."""
    node = element.nextSibling
    if isinstance(node, minidom.Text) and "\n" not in node.data:
        node = node.nextSibling
    return node if isinstance(node, minidom.Comment) else None


def drop_line(element: minidom.Element) -> None:
    """Remove an element, the comment on its line, and the space before both."""
    parent: Any = element.parentNode
    space = element.previousSibling
    for node in (comment_on_line(element), space if isinstance(space, minidom.Text) else None, element):
        if node is not None:
            parent.removeChild(node)


def _drop_repeated(root: minidom.Element) -> None:
    """Leave the first ``<default>`` of each parameter, whose value Mitsuba uses, with the first comment on its line."""
    kept: dict[str, minidom.Element] = {}
    for default in list(root.getElementsByTagName("default")):
        if (first := kept.setdefault(default.getAttribute("name"), default)) is not default:
            comment = comment_on_line(default)
            drop_line(default)
            if comment is not None and comment_on_line(first) is None:
                parent: Any = first.parentNode
                for node in (comment, parent.ownerDocument.createTextNode("  ")):
                    parent.insertBefore(node, first.nextSibling)


def _resolved(text: str, parameters: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return a text with parameters in place, the longest names first, and those that it refers to.

    Raises UserError if the text becomes longer than a million characters.
    """
    referred: list[str] = []
    while "$" in text and (found := [name for name in parameters if f"${name}" in text and name not in referred]):
        referred.append(max(found, key=len))
        text = text.replace(f"${referred[-1]}", parameters[referred[-1]])
        if len(text) > _LONGEST_TEXT:
            raise UserError(f"{referred[0]} = {shown(parameters[referred[0]])} has more than a million characters")
    return text, referred


def parse_part(text: str, place: Path | str) -> minidom.Element:
    """Return the root element of a scene or part text; raise UserError as `parse_document`."""
    check_xml(text, f"scene {place}")
    root = minidom.parseString(text).documentElement
    assert root is not None
    level, depth = [root], 0
    while level:
        depth += 1
        if depth > DEEPEST_NESTING:
            raise UserError(f"scene: its elements are nested more than {DEEPEST_NESTING} deep, which is the limit")
        level = [child for node in level for child in node.childNodes if isinstance(child, minidom.Element)]
    return root


def text_of(root: minidom.Element) -> str:
    """Return the text of a scene, with the comments above it, and single blank lines."""
    assert root.parentNode is not None
    head = [node.toxml() for node in root.parentNode.childNodes if isinstance(node, minidom.Comment)]
    return re.sub(r"\n{3,}", "\n\n", re.sub(r"[ \t]+\n", "\n", "\n".join([*head, _written(root), ""])))


def _written(node: minidom.Node, values: Mapping[int, Mapping[str, str]] | None = None) -> str:
    """Return a node's XML; with element attributes by their ids, without parameters and comments."""
    if not isinstance(node, minidom.Element):
        text: str = node.toxml() if values is None else "\n" * (node.nodeValue or "").count("\n")
        return text
    if values is not None and node.tagName == "default":
        return ""
    from xml.sax.saxutils import quoteattr  # imports the network's modules, which takes 0.04 s

    attributes = node.attributes if values is None else values.get(id(node), {})
    start = f"<{node.tagName}" + "".join(f" {name}={quoteattr(value)}" for name, value in attributes.items())
    content = "".join(_written(child, values) for child in node.childNodes)
    return f"{start}>{content}</{node.tagName}>" if content else f"{start}/>"


def _expanded(path: Path, includers: tuple[Path, ...] = (), count: list[int] | None = None) -> minidom.Element:
    """Return a scene file's root element, with the parts that Mitsuba uses in place of includes.

    `count` contains the number of files included so far.
    """
    root = parse_part(read_text(path), path)
    count = [0] if count is None else count
    files = (path.resolve(), *includers)
    for include in root.getElementsByTagName("include"):
        name = include.getAttribute("filename")
        part = next((found for file in files if is_there(found := file.parent / name)), None)
        if part is None:
            raise UserError(f"scene {path} includes {name!r}, which is not found in {path.parent}")
        if part.resolve() in files:
            raise UserError(f"scene {path} includes {name!r}, which includes it in turn")
        count[0] += 1
        if count[0] > _MOST_FILES:
            raise UserError(f"scene {files[-1]} includes more than {_MOST_FILES} files, which is the limit")
        included = _expanded(part, files, count)
        content = list(included.childNodes)
        if included.tagName != "scene":
            included.removeAttribute("version")
            if include.hasAttribute("name"):
                included.setAttribute("name", include.getAttribute("name"))
            content = [included]
        parent = include.parentNode
        assert isinstance(parent, minidom.Element)
        for node in content:
            parent.insertBefore(node, include)
        parent.removeChild(include)
    return root
