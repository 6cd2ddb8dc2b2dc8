"""Values for the parameters of XML scenes."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from xml.dom import minidom

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import PLUGINS, declared
from mitransient_lidar.core.parameters.fields import Parameter, Plugin, is_green
from mitransient_lidar.core.validation import finite, is_number, shown
from mitransient_lidar.loading.document import SceneDocument, Setting, drop_line, parameters_of
from mitransient_lidar.physics.water.seawater import WAVELENGTH_RANGE
from mitransient_lidar.physics.water.water_types import default_water

#: Mitsuba plugins that lidar scenes use.
_OTHERS = ("rectangle", "sphere", "cylinder", "cube", "disk", "ply", "obj", "diffuse", "twosided", "dielectric", "hg")

#: XML elements that set a plugin parameter, which are the parameter kinds.
_TAGS = ("float", "integer", "boolean", "string")

_LIDAR = ("lidar_transmitter", "multipixel_receiver", "pixel_fov")  #: Plugins that an instrument brings.


@dataclass(frozen=True)
class ScenePlugin:
    """A plugin from this package in a scene."""

    element: minidom.Element  #: Element of the plugin.
    declared: Plugin  #: Declaration of its parameters.
    settings: Mapping[str, Setting]  #: Attributes that set parameters, by parameter name.
    ids: tuple[str, ...]  #: Ids of the plugin and of the objects around it, and the plugin's name.
    is_fixed: bool  #: Whether its parameters are an instrument's, and have no names.

    def names(self) -> Iterator[tuple[Parameter, list[str]]]:
        """Yield the parameters with their names: their own, unless it stands for others, and behind an id."""
        prefixes = [f"{one}{end}" for one in self.ids for end in "._"]
        for one in () if self.is_fixed else self.declared:
            if one.kind in _TAGS:
                yield one, [f"{prefix}{one.name}" for prefix in (prefixes if one.by_id else ["", *prefixes])]

    def value(self, parameter: Parameter) -> str:
        """Return a parameter's value as text, with scene parameters in place; empty without one."""
        setting = self.settings.get(parameter.name)
        if setting is not None and setting.value != "":
            return setting.value
        # The plugin's choices at another wavelength are no scene values.
        if parameter.name in self._replaced:
            return ""
        given = self.settings.get("wavelength_nm")
        if parameter.of_green and given and is_number(given.value) and not is_green(nm := float(given.value)):
            chosen = default_water(nm) if WAVELENGTH_RANGE[0] <= nm <= WAVELENGTH_RANGE[1] else {}
            return f"{chosen[parameter.name]:.6g}" if parameter.name in chosen else ""
        return parameter.text

    @cached_property
    def _replaced(self) -> set[str]:
        """Names of parameters that others describe, which are given: values, or objects by their names and kinds."""
        children = [one for one in self.element.childNodes if isinstance(one, minidom.Element)]
        objects = [one for one in children if one.tagName not in _TAGS]
        given = [name for name, one in self.settings.items() if one.value != ""]
        return self.declared.replaced(
            [*given, *(one.getAttribute("name") for one in objects), *(f"a nested {one.tagName}" for one in objects)]
        )

    def refer(self, parameter: Parameter, name: str) -> str:
        """Take a parameter from the scene parameter with a name; return the text of its former value."""
        setting, document = self.settings.get(parameter.name), self.element.ownerDocument
        assert document is not None
        element = document.createElement(parameter.tag)
        element.setAttribute("name", parameter.name)
        element.setAttribute("value", f"${name}")
        if setting is None:
            self.element.appendChild(element)
            return parameter.text
        self.element.replaceChild(element, setting.element)
        return setting.template


def plugins_of(document: SceneDocument) -> list[ScenePlugin]:
    """Return the plugins from this package in a scene."""
    settings: dict[int, dict[str, Setting]] = {}
    for one in document.settings:
        if one.attribute == "value" and one.element.tagName in _TAGS:
            settings.setdefault(id(one.element.parentNode), {})[one.owner] = one
    found = []
    for one in document.settings:
        if one.attribute == "type" and one.value in PLUGINS:
            ids: list[str] = []
            node: Any = one.element
            while isinstance(node, minidom.Element):
                ids.append(node.getAttribute("id"))
                node = node.parentNode
            own, is_fixed = settings.get(id(one.element), {}), bool(document.instrument) and one.value in _LIDAR
            found.append(ScenePlugin(one.element, PLUGINS[one.value], own, (*filter(None, ids), one.value), is_fixed))
    return found


def values_of(document: SceneDocument, *, by_id: bool = True) -> dict[str, str]:
    """Return the values of all parameters in a scene as text: its own, and those that its plugins declare.

    They are empty for parameters without a value, and have names with ids, too, unless `by_id` is false.
    """
    found: dict[str, str] = {}
    for plugin in plugins_of(document):
        for parameter, names in plugin.names():
            value = plugin.value(parameter)
            for name in names if by_id else {parameter.name}.intersection(names):
                found[name] = found.get(name) or value
    return {**document.parameters, **{name: found[name] for name in found if name not in document.parameters}}


def fill(document: SceneDocument, params: Mapping[str, Any] | None) -> SceneDocument:
    """Return a scene with given parameter values in place of its own.

    These are the scene's own parameters, and its plugins': ``wind_speed`` for all plugins that have one, or
    ``sea.wind_speed`` (in formulas ``sea_wind_speed``) for the one with this id, and for those inside it, or
    ``sediment.model`` for all plugins with this name.

    Raises UserError if the scene has no such parameter or uses it nowhere, or a value is empty or of another type.
    """
    if not params:
        return document
    known = values_of(document)
    check_known(params, known, document)
    given = {name: _text(name, value) for name, value in params.items()}
    for name, value in given.items():
        if not value.strip() and known[name].strip():
            raise UserError(f"{name} = {value!r} is empty: it must have a value, as {known[name]}")
    document = _with_declared(document, [name for name in given if name not in document.parameters])
    filled = without_replaced(replace(document, parameters={**document.parameters, **given}, given=given), given)
    if unused := [name for name in given if name not in filled.used]:
        raise UserError(f"parameter {unused[0]} = {given[unused[0]]} is used by nothing in scene {document.name}")
    return filled


def check_known(names: Iterable[object], known: Collection[str], document: SceneDocument) -> None:
    """Raise `UserError` for a name that is not among the known parameters of a scene."""
    scene = f"{document.name} with instrument {document.instrument}" if document.instrument else document.name
    for name in names:
        if name not in known:
            hint = _closest(name, known, document.parameters)
            raise UserError(f"parameter {name!r} is not one of scene {scene}: {hint}")


def _with_declared(document: SceneDocument, names: Sequence[str]) -> SceneDocument:
    """Return a scene that has parameters of its plugins as its own, with the values that they have."""
    if not names:
        return document
    document = document.copied()
    root: Any = document.root
    values: dict[str, list[str]] = {name: [] for name in names}
    for plugin in plugins_of(document):
        for parameter, known in plugin.names():
            # The name with an id is for its plugin alone.
            if chosen := max(set(known).intersection(names), key=len, default=None):
                values[chosen].append(plugin.refer(parameter, chosen))
    for name, former in values.items():
        default = root.ownerDocument.createElement("default")
        default.setAttribute("name", name)
        default.setAttribute("value", value := next(filter(None, former), ""))
        # Before its use, and after the parameters that its value refers to.
        others = root.getElementsByTagName("default") if "$" in value else []
        root.insertBefore(default, others[-1].nextSibling if others else root.firstChild)
    return replace(document, parameters={**parameters_of(root), **document.parameters})


def without_replaced(document: SceneDocument, given: Mapping[str, str]) -> SceneDocument:
    """Return a scene without values that describe the same as given ones; plugins refuse two of them.

    Scene parameters that set such values are empty.
    """
    replaced: list[Setting] = []
    for plugin in plugins_of(document):
        set_by = {name: one for name, one in plugin.settings.items() if one.value != ""}
        chosen = [name for name, one in set_by.items() if not set(given).isdisjoint(one.referred)]
        replaced += [set_by[name] for name in plugin.declared.replaced(chosen) & set_by.keys()]
    emptied = {name: "" for one in replaced for name in one.referred}
    document = replace(document, parameters={**document.parameters, **emptied})
    literal = [one.element for one in replaced if not one.referred]
    if literal:
        former = document.root.getElementsByTagName("*")
        document = document.copied()
        for one, copy in zip(former, document.root.getElementsByTagName("*"), strict=True):
            if any(one is each for each in literal):
                drop_line(copy)
    return document


def unknown_parameters(message: str) -> str | None:
    """Return the sentence for Mitsuba's message about parameters that a plugin does not have, or about no plugin."""
    if found := re.search(r'unreferenced propert\w+ in [\w ]+ of type "(\w+)":((?:\s+- \w+ "[^"]+"[^"]*)+)', message):
        plugin = PLUGINS.get(found[1])
        allowed = [each.name for each in plugin or () if each.name.isidentifier()]
        names = re.findall(r'- \w+ "([^"]+)"', found[2])
        close = [near for name in names for near in difflib.get_close_matches(name, allowed, n=1)]
        hint = f"did you mean {' and '.join(close)}" if close else f"it has {', '.join(allowed)}"
        return f"{found[1]}: there is no parameter {' or '.join(names)}" + (f"; {hint}" if allowed else "")
    if found := re.search(r'Plugin "([^"]*)" not found', message):
        close = difflib.get_close_matches(found[1], [*PLUGINS, *_OTHERS], n=2)
        return f"type = {found[1]!r} is not a plugin" + (f"; did you mean {' or '.join(close)}" if close else "")
    return None


def value_of(parameters: Mapping[str, str], name: str) -> float:
    """Return a number's value among a scene's parameters, in the unit of `core.parameters.catalogue.unit_of`.

    Raises UserError if there is no such parameter or element, it is a list and `name` has no index, or it is no finite
    number.

    `parameters`: scene parameters with their values as text. `name`: parameter name; for a list, such as "0.9, 0.5",
    with the index of an element from 0 on (``attenuation[1]``). A list with one value holds for every layer of
    ``layer_tops``, and has their indices, too.
    """
    words, index = _words(parameters, name)
    return finite(name, words[index])


def with_value(parameters: Mapping[str, str], name: str, value: float) -> dict[str, str]:
    """Return a copy of a scene's parameters in which the number `name`, as in `value_of`, has another value.

    A list with one value that holds for several layers gets one value for each.
    """
    words, index = _words(parameters, name)
    words[index] = repr(finite(name, value))
    return {**parameters, parameter_of(name): ", ".join(words)}


def parameter_of(name: str) -> str:
    """Return the name of the parameter that contains a number: without the element's index."""
    return name.partition("[")[0]


def _words(parameters: Mapping[str, str], name: str) -> tuple[list[str], int]:
    """Return a parameter's numbers as text, and the index of the one with a name."""
    known = parameter_of(name)
    index = re.fullmatch(r"\[(\d{1,9})\]", name[len(known) :])
    if known not in parameters or (index is None and known != name):
        raise UserError(f"parameter {name!r} is not one of the scene: {_closest(known, parameters)}")
    text = parameters[known]
    words = text.replace(",", " ").split()
    if not words or not all(is_number(word) for word in words):
        raise UserError(f"parameter {name} = {shown(text)} is not a number")
    layers = len(parameters.get("layer_tops", "").replace(",", " ").split())
    if len(words) == 1 and index is not None and any(one.is_list for one in declared(known)):
        words *= max(layers, 1)
    if index is None and len(words) > 1:
        last = f"{name}[{len(words) - 1}]"
        raise UserError(f"parameter {name} = {shown(text)} is a list: name one of its elements {name}[0] to {last}")
    number = 0 if index is None else int(index[1])
    if number >= len(words):
        raise UserError(f"parameter {name}: the index must be 0 to {len(words) - 1}, as {known} = {shown(text)}")
    return words, number


def _closest(name: object, known: Collection[str], own: Collection[str] = ()) -> str:
    """Return a hint about an unknown name: close or longer known names, or the scene's own, if any."""
    alike = [one for one in known if ("." in one) == ("." in str(name))]
    longer = [one for one in alike if one.startswith(f"{name}_")]
    close = list(dict.fromkeys([*difflib.get_close_matches(str(name), alike, n=3), *longer[:3]]))
    listed = [*sorted(own), "the parameters of its plugins"] if len(own) < len(known) and own else sorted(known)
    return f"did you mean {' or '.join(close)}" if close else f"it has {', '.join(listed) or 'none'}"


def check_params(params: object) -> None:
    """Raise `UserError` if parameters of a scene are not given as a dict."""
    if params is not None and not isinstance(params, Mapping):
        raise UserError(f"params = {shown(params)} must be a dict of names and values")


def _text(name: str, value: Any) -> str:
    """Return a parameter's value as in XML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(name, item) for item in value)
    if not isinstance(value, (str, int, float, np.number, os.PathLike)):
        raise UserError(f"{name} = {shown(value)} must be a number, a text or a list of them")
    return str(value)
