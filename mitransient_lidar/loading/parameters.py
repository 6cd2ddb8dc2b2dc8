"""Values for the parameters of XML scenes."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any
from xml.dom import minidom

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import PLUGINS
from mitransient_lidar.core.parameters.fields import Parameter
from mitransient_lidar.core.validation import finite, is_number, shown
from mitransient_lidar.loading.document import SceneDocument, parameters_of

#: Plugins of Mitsuba that lidar scenes use.
_OTHERS = ("rectangle", "sphere", "cylinder", "cube", "disk", "ply", "obj", "diffuse", "twosided", "dielectric", "hg")

#: Elements of XML that set a parameter of a plugin, which are the kinds of parameters.
_TAGS = ("float", "integer", "boolean", "string")

#: Plugins that an instrument brings.
_LIDAR = ("lidar_transmitter", "multipixel_receiver", "pixel_fov", "time_gated_film")

_COEFFICIENTS = ("attenuation", "scattering", "backscattering")

#: Parameters of scenes that describe the same thing in several ways.
_ALTERNATIVES: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("divergence_mrad",), ("divergence_fwhm_mrad",), ("divergence_1e2_mrad",)),
    (_COEFFICIENTS, ("jerlov",), ("chlorophyll",), ("kd",), ("secchi",), ("petzold",), ("pure",), ("profile",)),
    (("layer_tops",), ("profile",)),
)


def fill(document: SceneDocument, params: Mapping[str, Any] | None) -> SceneDocument:
    """Return a scene with given values of parameters in place of its own.

    These are the scene's own parameters, and those of its plugins: ``wind_speed`` of all plugins that have one, or
    ``sea.wind_speed`` of the one with this id.

    Raises
    ------
    UserError
        If the scene has no such parameter or uses it nowhere, or a value is empty or of another type.
    """
    scene = f"{document.name} with instrument {document.instrument}" if document.instrument else document.name
    document = _with_declared(document, [name for name in params or {} if name not in document.parameters])
    known, given = document.parameters, {}
    for name, value in (params or {}).items():
        if name not in known:
            declared = {one.name for part in _own_plugins(document) for one in PLUGINS[part.getAttribute("type")]}
            hint = _closest(name, known, declared)
            raise UserError(f"parameter {name!r} is not one of scene {scene}: {hint}")
        given[name] = _text(name, value)
        if not given[name].strip() and known[name].strip():
            raise UserError(f"{name} = {given[name]!r} is empty: it must have a value, as {known[name]}")
    filled = replace(document, parameters={**without_alternatives(known, given), **given}, given=given)
    if unused := [name for name in given if name not in filled.used]:
        raise UserError(f"parameter {unused[0]} = {given[unused[0]]} is used by nothing in scene {document.name}")
    return filled


def _with_declared(document: SceneDocument, names: Sequence[str]) -> SceneDocument:
    """Return a scene that has parameters of its plugins as its own, with the values that they have."""
    if not any(_declared(element, name) for element in _own_plugins(document) for name in names):
        return document
    found = document.copied()
    for name in names:
        chosen = [(element, one) for element in _own_plugins(found) if (one := _declared(element, name)) is not None]
        values = [_refer(element, one, name) for element, one in chosen]
        if chosen:
            root: Any = found.root
            default = root.ownerDocument.createElement("default")
            default.setAttribute("name", name)
            default.setAttribute("value", next((value for value in values if value), ""))
            others = root.getElementsByTagName("default")
            root.insertBefore(default, others[-1].nextSibling if others else root.firstChild)
            found = replace(found, parameters={**document.parameters, **parameters_of(found.root)})
    return found


def _own_plugins(document: SceneDocument) -> list[minidom.Element]:
    """Return the elements of a scene that are plugins of this package; the lidar of an instrument is as it is."""
    fixed = _LIDAR if document.instrument else ()
    types = [one for one in document.settings if one.attribute == "type"]
    return [one.element for one in types if one.value in PLUGINS and one.value not in fixed]


def _declared(element: minidom.Element, name: str) -> Parameter | None:
    """Return the parameter of a plugin that a name, or an id and a name, stands for."""
    part, _, own = str(name).rpartition(".")
    if part and part != element.getAttribute("id"):
        return None
    plugin = PLUGINS.get(element.getAttribute("type"), ())
    return next((one for one in plugin if one.name == own and one.kind in _TAGS), None)


def _refer(element: minidom.Element, parameter: Parameter, name: str) -> str:
    """Make a plugin take a parameter from that of the scene with a name; return the value that it had."""
    settings = [one for one in element.childNodes if isinstance(one, minidom.Element) and one.tagName in _TAGS]
    setting = next((one for one in settings if one.getAttribute("name") == parameter.name), None)
    if setting is None:
        assert element.ownerDocument is not None
        setting = element.ownerDocument.createElement(parameter.kind)
        setting.setAttribute("name", parameter.name)
        setting.setAttribute("value", "" if parameter.default is None else _text(parameter.name, parameter.default))
        element.appendChild(setting)
    value = setting.getAttribute("value")
    setting.setAttribute("value", f"${name}")
    return value


def without_alternatives(parameters: Mapping[str, str], given: Mapping[str, str]) -> dict[str, str]:
    """Return parameters of a scene with empty values where given ones replace them; plugins refuse two of them."""
    kept = dict(parameters)
    names = {name for name, value in given.items() if value != ""}
    for alternatives in _ALTERNATIVES:
        for chosen in alternatives:
            if not names.isdisjoint(chosen):
                others = {name for one in alternatives for name in one} - names - set(chosen)
                kept |= {name: "" for name in others if name in kept}
    return kept


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
    """Return the value of a number among the parameters of a scene, in the unit of `core.parameters.catalogue.unit_of`.

    Parameters
    ----------
    parameters
        Parameters of a scene with their values as text.
    name
        Name of a parameter; of a list, such as "0.9, 0.5", with the index of an element from 0 on (``attenuation[1]``).
        A list of one value holds for every layer of ``layer_tops``, and has their indices, too.

    Raises
    ------
    UserError
        If there is no such parameter or element, it is a list and `name` has no index, or it is no finite number.
    """
    words, index = _words(parameters, name)
    return finite(name, words[index])


def with_value(parameters: Mapping[str, str], name: str, value: float) -> dict[str, str]:
    """Return a copy of the parameters of a scene in which the number `name` of `value_of` has another value.

    A list of one value that holds for several layers gets one value for each of them.
    """
    words, index = _words(parameters, name)
    words[index] = repr(finite(name, value))
    return {**parameters, parameter_of(name): ", ".join(words)}


def parameter_of(name: str) -> str:
    """Return the name of the parameter that holds a number: without the index of an element."""
    return name.partition("[")[0]


def _words(parameters: Mapping[str, str], name: str) -> tuple[list[str], int]:
    """Return the numbers of a parameter as text, and the index of the one with a name."""
    known = parameter_of(name)
    index = re.fullmatch(r"\[(\d{1,9})\]", name[len(known) :])
    if known not in parameters or (index is None and known != name):
        raise UserError(f"parameter {name!r} is not one of the scene: {_closest(known, parameters)}")
    text = parameters[known]
    words = text.replace(",", " ").split()
    if not words or not all(is_number(word) for word in words):
        raise UserError(f"parameter {name} = {shown(text)} is not a number")
    layers = len(parameters.get("layer_tops", "").replace(",", " ").split())
    if known in (*_COEFFICIENTS, "water_scattering") and len(words) == 1 and index is not None:
        words *= max(layers, 1)
    if index is None and len(words) > 1:
        last = f"{name}[{len(words) - 1}]"
        raise UserError(f"parameter {name} = {shown(text)} is a list: name one of its elements {name}[0] to {last}")
    number = 0 if index is None else int(index[1])
    if number >= len(words):
        raise UserError(f"parameter {name}: the index must be 0 to {len(words) - 1}, as {known} = {shown(text)}")
    return words, number


def _closest(name: object, known: Mapping[str, str], others: Collection[str] = ()) -> str:
    """Return what to say of an unknown name: the names that are close to it, or all known ones."""
    close = difflib.get_close_matches(str(name), [*known, *others], n=3)
    return f"did you mean {' or '.join(close)}" if close else f"it has {', '.join(sorted(known)) or 'none'}"


def check_params(params: object) -> None:
    """Raise `UserError` if parameters of a scene are not given as a dict."""
    if params is not None and not isinstance(params, Mapping):
        raise UserError(f"params = {shown(params)} must be a dict of names and values")


def _text(name: str, value: Any) -> str:
    """Return the value of a parameter as in XML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(name, item) for item in value)
    if not isinstance(value, (str, int, float, np.number, os.PathLike)):
        raise UserError(f"{name} = {shown(value)} must be a number, a text or a list of them")
    return str(value)
