"""Self-contained text of scene files that include others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.dom import minidom
from xml.parsers.expat import ExpatError
from xml.sax.saxutils import quoteattr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import read_text
from mitransient_lidar.loading.checks import check_depth

#: Most files that a scene and its parts include.
_MOST_FILES = 256


@dataclass
class _Default:
    """The ``<default>`` of a parameter with the comments above it ("" for a blank line) and on its line."""

    element: minidom.Element
    above: list[str]
    same_line: str = ""


def parse_scene(text: str, path: Path | str) -> minidom.Element:
    """Return the root element of a scene file's text; raise UserError if it is malformed or nested too deeply."""
    try:
        root = minidom.parseString(text).documentElement
    except ExpatError as error:
        raise UserError(f"scene {path} is not well-formed XML: {error}.") from error
    assert root is not None
    check_depth(root)
    return root


def flat_text(path: Path) -> str:
    """Return the text of a scene file with all included files in place.

    Parameters
    ----------
    path : pathlib.Path
        Scene file. Names of included files are relative to the file that names them and contain no parameters.

    Returns
    -------
    str
        The file's own text if it includes no other. Otherwise indented XML with parameters before objects. Each
        parameter has one ``<default>``: at the place of its last declaration, with the value of its first one, which
        is the one that Mitsuba uses, and with the first comment on the line of any of them.

    Raises
    ------
    UserError
        If a file is missing, unreadable, not well-formed XML, or includes itself, or there are more than 256.
    """
    text = read_text(path)
    return text_of(expanded(path)) if "<include" in text else text


def text_of(root: minidom.Element) -> str:
    """Return the text of a scene without includes in the format of `flat_text`."""
    assert root.parentNode is not None
    head = [node.toxml() for node in root.parentNode.childNodes if isinstance(node, minidom.Comment)]
    defaults: list[_Default] = []
    objects = _content(root, defaults)
    parameters: list[str] = []
    for default in _unique(defaults):
        parameters += [*default.above, _element(default.element)[0] + default.same_line]
    if objects[:1] != [""]:
        objects.insert(0, "")
    return "\n".join([*head, *_element(root, [*parameters, *objects, ""]), ""])


def expanded(path: Path, includers: tuple[Path, ...] = (), count: list[int] | None = None) -> minidom.Element:
    """Return the root element of a scene file, with includes replaced by what Mitsuba takes from them.

    Format and errors as for `flat_text`; `count` holds the number of files that are included so far.
    """
    root = parse_scene(read_text(path), path)
    count = [0] if count is None else count
    files = (path.resolve(), *includers)
    for include in root.getElementsByTagName("include"):
        name = include.getAttribute("filename")
        part = next((found for file in files if (found := file.parent / name).is_file()), None)
        if part is None:
            raise UserError(f"scene {path} includes {name!r}, which is not found in {path.parent}.")
        if part.resolve() in files:
            raise UserError(f"scene {path} includes {name!r}, which includes it in turn.")
        count[0] += 1
        if count[0] > _MOST_FILES:
            raise UserError(f"scene {files[-1]} includes more than {_MOST_FILES} files, which is the limit.")
        included = expanded(part, files, count)
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


def _content(parent: minidom.Element, defaults: list[_Default]) -> list[str]:
    """Return the lines within an element, "" for a blank one, and append its parameters to ``defaults`` instead."""
    lines: list[str] = []
    above: list[str] = []
    latest: _Default | None = None
    line_breaks = 0
    for node in parent.childNodes:
        if not isinstance(node, (minidom.Comment, minidom.Element)):
            line_breaks += (node.nodeValue or "").count("\n")
            continue
        if line_breaks > 1:
            above.append("")
        if isinstance(node, minidom.Comment) and line_breaks == 0 and not above and (latest or lines):
            if latest:
                latest.same_line += f"  {node.toxml()}"
            else:
                lines[-1] += f"  {node.toxml()}"
        elif isinstance(node, minidom.Comment):
            above.append(node.toxml())
        else:
            latest = None
            if node.tagName == "default":
                latest = _Default(node, above)
                defaults.append(latest)
            else:
                lines += [*above, *_element(node, _content(node, defaults))]
            above = []
        line_breaks = 0
    return lines + above


def _unique(defaults: list[_Default]) -> list[_Default]:
    """Return one default per parameter; see `flat_text` for its place, value and comment."""
    # A value that refers to another parameter must stay behind the first declaration of that one.
    in_order = any("$" in item.element.getAttribute("value") for item in defaults)
    declarations: dict[str, list[_Default]] = {}
    for item in defaults:
        name = item.element.getAttribute("name")
        earlier = declarations.get(name, []) if in_order else declarations.pop(name, [])
        declarations[name] = [*earlier, item]
    kept = []
    for same in declarations.values():
        first, last = same[0], same[-1]
        same_line = next((item.same_line for item in same if item.same_line), "")
        above = first.above if first is last or in_order else [*last.above, *filter(None, first.above)]
        kept.append(_Default(first.element, above, same_line))
    return kept


def _element(element: minidom.Element, content: Sequence[str] = ()) -> list[str]:
    """Return the lines of an element with its content indented."""
    start = f"<{element.tagName}" + "".join(f" {name}={quoteattr(value)}" for name, value in element.attributes.items())
    if not content:
        return [f"{start}/>"]
    return [f"{start}>", *(line and f"    {line}" for line in content), f"</{element.tagName}>"]
