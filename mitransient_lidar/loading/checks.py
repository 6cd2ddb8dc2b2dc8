"""Checks of the values of a scene before Mitsuba reads it, and of the parameters that its plugins have."""

from __future__ import annotations

import difflib
import functools
import importlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import minidom

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.ranges import limits
from mitransient_lidar.core.validation import finite, in_range, integer, is_number, shown

#: Largest coordinate [m] and scale of a transform: 32-bit coordinates are accurate to 6 cm there.
LARGEST_COORDINATE = 1e6

#: Deepest nesting of the objects of a scene; Mitsuba's parser is recursive.
DEEPEST_NESTING = 64

#: Most characters of an attribute with the values of parameters in place.
_LONGEST_TEXT = 10**6

#: Name of a plugin, and endings of the libraries of plugins.
_TYPE, _LIBRARIES = re.compile(r"[A-Za-z0-9_]+"), (".so", ".dylib", ".dll")

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
}
#: Parameters of BSDFs that are shares of the light.
_SHARE = re.compile(r"(^|_)(reflectance|transmittance)$")


def check_depth(root: minidom.Element) -> None:
    """Raise `UserError` if elements are nested more deeply than `DEEPEST_NESTING`."""
    level, depth = [root], 0
    while level:
        depth += 1
        if depth > DEEPEST_NESTING:
            raise UserError(f"scene: its elements are nested more than {DEEPEST_NESTING} deep, which is the limit")
        level = [child for node in level for child in node.childNodes if isinstance(child, minidom.Element)]


def check_elements(root: minidom.Element, parameters: Mapping[str, str]) -> set[str]:
    """Check the numbers of an XML scene without includes, with the values of its parameters in place.

    Returns
    -------
    set of str
        Names of the parameters that the scene uses.

    Raises
    ------
    UserError
        If a number is not finite or not a number, a share of light is not within 0 to 1, a size is not positive, or a
        coordinate exceeds `LARGEST_COORDINATE`.
    """
    used: set[str] = set()
    for element in root.getElementsByTagName("*"):
        if element.tagName == "default":
            continue
        if element.tagName == "sensor" and element.parentNode is root and not element.getElementsByTagName("film"):
            raise UserError(f"film: sensor {element.getAttribute('id')!r} has none; add a time_gated_film inside it")
        for attribute, text in element.attributes.items():
            value, referred = with_values(text, parameters)
            used.update(referred)
            owner = element.getAttribute("name") or element.tagName
            own = owner if attribute == "value" else f"{owner} {attribute}"
            label = _Label(referred[0], parameters[referred[0]], text) if referred else _Label(own, text, text)
            if attribute in _NUMBERS.get(element.tagName, ()):
                _check_numbers(label, element.tagName, attribute, value)
            elif element.tagName in ("spectrum", "rgb") and attribute == "value":
                _check_spectrum(label, value)
            if attribute == "value" and element.tagName in ("float", "integer", "string"):
                for number in _numbers_in(value):
                    _check_range(label.name, owner, number)
            if attribute == "value" and _is_share(element):
                for word in re.split(r"[\s,]+", value.strip()):
                    in_range(label.name, word.rpartition(":")[2], 0, 1)
    return used


def check_types(root: minidom.Element, parameters: Mapping[str, str], folder: Path) -> None:
    """Check the types of the objects of an XML scene without includes, with the values of its parameters in place.

    Raises
    ------
    UserError
        If a type is not the name of a plugin, or a library of plugins lies where `check_libraries` forbids it: in the
        scene's folder, or in one that its ``<path>`` names.
    """
    elements = root.getElementsByTagName("*")
    types = [each.getAttribute("type") for each in elements if each.hasAttribute("type")]
    folders = [each.getAttribute("value") for each in elements if each.tagName == "path"]
    for text in types:
        check_type(with_values(text, parameters)[0])
    check_libraries(folder, *(folder / with_values(text, parameters)[0] for text in folders))


def check_type(plugin: object) -> None:
    """Raise `UserError` if the type of an object is not the name of a plugin: Mitsuba loads any path as a library."""
    if not isinstance(plugin, str) or not _TYPE.fullmatch(plugin):
        raise UserError(f"type = {shown(plugin)} must be the name of a plugin, of letters, digits and underscores")


def check_libraries(*folders: Path) -> None:
    """Raise `UserError` if a folder has a subfolder ``plugins`` with libraries.

    Mitsuba loads plugins from there, its own ones last: beside a scene, or in the current folder, they would run the
    code of whoever made the scene.
    """
    import mitsuba as mi

    own = Path(mi.__file__).parent.resolve()
    for folder in (*folders, *(Path(str(path)) for path in mi.file_resolver())):
        place = folder.resolve() / "plugins"
        if place.parent == own or not place.is_dir():
            continue
        for library in place.iterdir():
            if library.suffix in _LIBRARIES:
                raise UserError(f"{library} would run as a plugin of Mitsuba; remove it, or work in another folder")


def with_values(text: str, parameters: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return a text with parameters in place, the longest names first, and those that it refers to.

    Raises
    ------
    UserError
        If the text becomes longer than a million characters.
    """
    referred: list[str] = []
    while "$" in text and (found := [name for name in parameters if f"${name}" in text and name not in referred]):
        referred.append(max(found, key=len))
        text = text.replace(f"${referred[-1]}", parameters[referred[-1]])
        if len(text) > _LONGEST_TEXT:
            raise UserError(f"{referred[0]} = {shown(parameters[referred[0]])} has more than a million characters")
    return text, referred


def check_dict(scene: Mapping[str, Any]) -> None:
    """Check the values of a scene given as a dict; same rules and errors as `check_elements` and `check_types`."""
    check_libraries()
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
                if _SHARE.search(key) and _is_plain(value.get("value")):
                    _check_shares(label, value["value"])
            elif value is None or isinstance(value, (complex, bytes)):
                raise UserError(f"{label} = {shown(value)} must be a number, a text, a transform or an object")
            elif isinstance(value, (int, float, str)) and not isinstance(value, bool):
                if isinstance(value, float):
                    finite(label, value)
                for number in _numbers_in(str(value)):
                    _check_range(label, key, number)
                if _SHARE.search(key):
                    _check_shares(label, value)
            elif hasattr(value, "matrix"):
                _check_matrix(label, np.array(value.matrix, dtype=np.float64))


def unknown_parameters(message: str) -> str | None:
    """Return the sentence for Mitsuba's message about parameters that a plugin does not have, or about no plugin."""
    if found := re.search(r'unreferenced propert\w+ in [\w ]+ of type "(\w+)":((?:\s+- \w+ "[^"]+"[^"]*)+)', message):
        allowed = plugin_parameters(found[1])
        names = re.findall(r'- \w+ "([^"]+)"', found[2])
        close = [near for name in names for near in difflib.get_close_matches(name, allowed, n=1)]
        hint = f"did you mean {' and '.join(close)}" if close else f"it has {', '.join(allowed)}"
        return f"{found[1]}: there is no parameter {' or '.join(names)}" + (f"; {hint}" if allowed else "")
    if found := re.search(r'Plugin "([^"]*)" not found', message):
        close = difflib.get_close_matches(found[1], [*_plugin_modules(), *_OTHERS], n=2)
        return f"type = {found[1]!r} is not a plugin" + (f"; did you mean {' or '.join(close)}" if close else "")
    return None


@functools.cache
def plugin_parameters(plugin: str) -> list[str]:
    """Return the names of the parameters in the manual page of one of our plugins, empty for other plugins."""
    module = _plugin_modules().get(plugin)
    if module is None:
        return []
    pages = [page.__doc__ or "" for page in vars(importlib.import_module(module)).values() if isinstance(page, type)]
    names: list[str] = []
    for page in pages:
        rules = list(re.finditer(r"^ *(=+)  =[= ]+$", page, re.MULTILINE))
        if f"``{plugin}``" in page and len(rules) >= 3:
            start, width = rules[0].start(1) - page.rfind("\n", 0, rules[0].start(1)) - 1, len(rules[0][1])
            rows = page[rules[1].end() : rules[2].start()].splitlines()
            cells = ", ".join(row[start : start + width] for row in rows)
            names += re.findall(r"(?<![\w(.])[a-z]\w*(?![\w).])", cells)
    return list(dict.fromkeys(names))


#: Plugins of Mitsuba that lidar scenes use.
_OTHERS = ("rectangle", "sphere", "cylinder", "cube", "disk", "ply", "obj", "diffuse", "twosided", "dielectric", "hg")


def is_own_plugin(plugin: str) -> bool:
    """Return whether a plugin is one of ours."""
    return plugin in _plugin_modules()


def _plugin_modules() -> dict[str, str]:
    """Return the modules of our plugins by the plugins' names."""
    from mitransient_lidar.loading.variants import PLUGIN_MODULES

    return {name.rpartition(".")[2]: f"mitransient_lidar.plugins.{name}" for name in PLUGIN_MODULES}


@dataclass(frozen=True)
class _Label:
    """Name and value of what sets a number, a parameter of the scene or an attribute, and the attribute's text."""

    name: str
    value: str
    text: str

    def refusal(self, rule: str) -> UserError:
        """Return the error of a value that breaks a rule."""
        return UserError(f"{self.name} = {self.value if is_number(self.value) else shown(self.value)} {rule}")


def _check_numbers(label: _Label, tag: str, attribute: str, value: str) -> None:
    """Check the numbers of one attribute."""
    words = value.replace(",", " ").split()
    if not words:
        raise label.refusal("is empty: it must be a number")
    for word in words:
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


def _check_spectrum(label: _Label, value: str) -> None:
    """Check a spectrum, one number or ``wavelength:value`` pairs, or a colour, three numbers or ``#rrggbb``."""
    for word in value.replace(",", " ").split() or [""]:
        number = word.rpartition(":")[2]
        if not number.startswith("#") and not is_number(number):
            raise label.refusal("must be a number")
        if is_number(number) and not np.isfinite(float(number)):
            raise label.refusal("must be finite")


def _is_share(element: minidom.Element) -> bool:
    """Return whether an element is a reflectance or transmittance of a BSDF, but not a colour as ``#rrggbb``."""
    parent: Any = element.parentNode
    numeric = element.tagName in ("float", "spectrum", "rgb") and not element.getAttribute("value").startswith("#")
    return numeric and parent.tagName == "bsdf" and _SHARE.search(element.getAttribute("name")) is not None


def _is_plain(value: object) -> bool:
    """Return whether a value of a spectrum is a number or a list of numbers."""
    return isinstance(value, (int, float)) or (
        isinstance(value, (list, tuple)) and all(isinstance(item, (int, float)) for item in value)
    )


def _numbers_in(text: str) -> list[float]:
    """Return the numbers of a text that holds nothing else, empty for other texts."""
    words = text.replace(",", " ").split()
    return [float(word) for word in words] if all(map(is_number, words)) else []


def _check_range(label: str, name: str, number: float) -> None:
    """Check a number against the range of the parameter `name`."""
    if found := limits(name):
        in_range(label, number, *found)


def _check_shares(label: str, values: Any) -> None:
    for value in values if isinstance(values, (list, tuple)) else [values]:
        in_range(label, value, 0, 1)


def _check_matrix(label: str, matrix: Any) -> None:
    """Check the matrix of a transform."""
    if not np.isfinite(matrix).all():
        raise UserError(f"{label} holds {matrix[~np.isfinite(matrix)][0]}: every number of a transform must be finite")
    if np.abs(matrix).max() > LARGEST_COORDINATE:
        largest = matrix.flat[np.abs(matrix).argmax()]
        raise UserError(f"{label} holds {largest:g} but must lie between {-LARGEST_COORDINATE:g} and 1e+06")
    if matrix.shape == (4, 4) and np.linalg.det(matrix[:3, :3]) == 0:
        raise UserError(f"{label} has a scale of 0: the object would have no extent")
