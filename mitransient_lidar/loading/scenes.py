"""Loading of scenes, with error messages of one sentence."""

from __future__ import annotations

import contextlib
import difflib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.dom import minidom

import numpy as np

from mitransient_lidar.core.errors import UserError, is_interruption, raise_if_out_of_memory
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.checks import check_dict, check_elements, check_types, unknown_parameters
from mitransient_lidar.loading.includes import flat_text, parse_scene, text_of
from mitransient_lidar.loading.instruments import mount
from mitransient_lidar.loading.scene_record import SceneRecord

if TYPE_CHECKING:
    import mitsuba as mi

#: Options of Mitsuba's loaders. Optimisation would merge a bottom and a target of one material into a shape without a
#: name; loading in several threads saves no time.
_LOADING = {"parallel": False, "optimize": False}

_COEFFICIENTS = ("attenuation", "scattering", "backscattering")

#: Parameters of scenes that describe the same thing in several ways.
_ALTERNATIVES: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("divergence_mrad",), ("divergence_fwhm_mrad",), ("divergence_1e2_mrad",)),
    (_COEFFICIENTS, ("jerlov",), ("chlorophyll",), ("kd",), ("secchi",), ("petzold",), ("pure",), ("profile",)),
    (("water_scattering",), ("pure",)),
    (("layer_tops",), ("profile",)),
)


@dataclass(frozen=True)
class LoadedScene:
    """A loaded scene, its name, the parameters of an XML scene with their values as text, and what loads it again.

    The record is None for a scene from loaded objects.
    """

    scene: mi.Scene
    name: str
    parameters: dict[str, str]
    record: SceneRecord | None


def load_scene(
    scene: Any, params: Mapping[str, Any] | None = None, instrument: str | None = None
) -> tuple[mi.Scene, str, dict[str, str]]:
    """Return scene, name and parameters of `load`, which also gives parameters and errors."""
    loaded = load(scene, params, instrument)
    return loaded.scene, loaded.name, loaded.parameters


def load(scene: Any, params: Mapping[str, Any] | None = None, instrument: str | None = None) -> LoadedScene:
    """Load a scene.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of an XML file, dict for ``mitsuba.load_dict``, a loaded scene, or the record of a
        scene.
    params
        Values for the ``<default>`` parameters of an XML scene, and of the instrument.
    instrument
        Name of the instrument whose laser and receiver replace those of an XML scene; see `instruments.mount`.

    Raises
    ------
    UserError
        If there is no such scene or instrument, a parameter is unknown, not used or empty, a value is invalid, a part
        is missing, or a file of a record is missing or has changed.
    """
    import mitsuba as mi

    from mitransient_lidar.transport.scene import fit_seas

    check_params(params)
    if isinstance(scene, mi.Scene):
        _no_parameters(params, instrument, "a loaded scene")
        loaded = LoadedScene(scene, scene.id() or "scene", {}, None)
    elif isinstance(scene, Mapping) or (isinstance(scene, SceneRecord) and not scene.is_xml):
        _no_parameters(params, instrument, "a dict")
        loaded = _load_dict(scene)
    elif isinstance(scene, SceneRecord):
        loaded = _load_xml(scene.name, scene.text, params, scene, instrument)
    elif isinstance(scene, (str, os.PathLike)):
        path = catalogue.scene_path(scene)
        loaded = _load_xml(path.stem, flat_text(path), params, path, instrument)
    else:
        raise UserError(f"scene = {shown(scene)} must be a shipped name, a path, a dict or a loaded scene")
    fit_seas(loaded.scene)
    return loaded


def _load_dict(scene: Mapping[str, Any] | SceneRecord) -> LoadedScene:
    """Load a scene given as a dict, or its record."""
    import mitsuba as mi

    given = scene.scene_dict() if isinstance(scene, SceneRecord) else scene
    check_dict(given)
    record = scene if isinstance(scene, SceneRecord) else SceneRecord.of_dict(scene)
    with as_user_error(), _placeholder_seas():
        loaded = mi.load_dict({"type": "scene", **given}, **_LOADING)
    return LoadedScene(loaded, "scene", {}, record)


def _load_xml(
    name: str, text: str, params: Mapping[str, Any] | None, source: Path | SceneRecord, instrument: str | None
) -> LoadedScene:
    """Load an XML scene, whose text has no includes, from its file or its record, with an instrument or its own one."""
    import mitsuba as mi

    root = parse_scene(text, source if isinstance(source, Path) else name)
    former = source.instrument if isinstance(source, SceneRecord) else ""
    own: dict[str, str] = {}
    if instrument is not None:
        own = mount(instrument, root)
        text = text_of(root)
    known = catalogue.parameters_of(root)
    if isinstance(source, SceneRecord):
        known = {key: source.parameters.get(key, value) for key, value in known.items()} | own
    _empty_alternatives(known, own)
    parameters, given = _filled(f"{name} with instrument {instrument}" if instrument else name, known, params)
    folder = source.parent if isinstance(source, Path) else Path()
    check_types(root, parameters, folder)
    used = check_elements(root, parameters)
    if unused := [key for key in given if key not in used]:
        raise UserError(f"parameter {unused[0]} = {given[unused[0]]} is used by nothing in scene {name}")
    record = SceneRecord.of_xml(name, text, root, parameters, folder, instrument or former)
    if isinstance(source, SceneRecord):
        # Files that given parameters name are found as in any scene.
        kept = {file: found for file, found in source.files.items() if file[1] not in given.values()}
        record = replace(record, files={**record.files, **kept})
    is_file = isinstance(source, Path) and instrument is None
    if not is_file:
        record.place_files(root, parameters)
    # Mitsuba refuses parameters that nothing uses; a part that is missing is told instead.
    referred = used if is_file else check_elements(root, parameters)
    values = {key: value for key, value in parameters.items() if key in referred}
    with as_user_error({key: value for key, value in given.items() if key in used}, root), _placeholder_seas():
        if is_file:
            loaded = mi.load_file(str(source), **_LOADING, **values)
        else:
            loaded = mi.load_string(root.toxml(), **_LOADING, **values)
    if not isinstance(loaded, mi.Scene):
        raise UserError(f"scene {name} holds a {type(loaded).__name__}: its root element must be <scene>")
    if unused := [key for key in parameters if key not in used]:
        _tell_missing_part(loaded, unused)
    return LoadedScene(loaded, name, parameters, record)


def check_params(params: object) -> None:
    """Raise `UserError` if parameters of a scene are not given as a dict."""
    if params is not None and not isinstance(params, Mapping):
        raise UserError(f"params = {shown(params)} must be a dict of names and values")


def _filled(
    scene: str, known: Mapping[str, str], params: Mapping[str, Any] | None
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the parameters of an XML scene, `known` with defaults, with their values as text, and the given ones."""
    parameters, given = dict(known), {}
    for name, value in (params or {}).items():
        if name not in parameters:
            close = difflib.get_close_matches(str(name), parameters, n=3)
            hint = f"did you mean {' or '.join(close)}" if close else f"it has {', '.join(sorted(parameters))}"
            raise UserError(f"parameter {name!r} is not one of scene {scene}: {hint}")
        given[name] = _text(name, value)
        if not given[name].strip() and parameters[name].strip():
            raise UserError(f"{name} = {given[name]!r} is empty: it must have a value, as {parameters[name]}")
    _empty_alternatives(parameters, given)
    return {**parameters, **given}, given


def _tell_missing_part(scene: mi.Scene, unused: list[str]) -> None:
    """Raise `UserError` if the scene lacks the part that the parameters which nothing uses are for."""
    present = {
        "sensor": bool(scene.sensors()),
        "emitter": bool(scene.emitters()),
        "medium below a sea surface": any(shape.is_medium_transition() for shape in scene.shapes()),
    }
    for part, there in present.items():
        if not there:
            listed = ", ".join(unused[:4]) + (", ..." if len(unused) > 4 else "")
            raise UserError(f"{part}: the scene has none, and its parameters {listed} are used by nothing")


@contextlib.contextmanager
def _placeholder_seas() -> Iterator[None]:
    """Load seas as level planes: their meshes are made once the lidar is known."""
    from mitransient_lidar.plugins.ocean_surface import OceanSurface

    OceanSurface.is_placeholder = True
    try:
        yield
    finally:
        OceanSurface.is_placeholder = False


@contextlib.contextmanager
def as_user_error(given: Mapping[str, str] | None = None, root: minidom.Element | None = None) -> Iterator[None]:
    """Convert a ``RuntimeError`` of Mitsuba's parser to a `UserError` of one sentence.

    Mitsuba wraps an exception of a Python plugin, with its traceback, in a ``RuntimeError``. A wrapped ``UserError`` or
    Ctrl-C is unwrapped; any other wrapped exception is a bug and keeps its traceback. `given` are the scene's
    parameters that the user has set, and `root` its root element: where a message names a parameter of a plugin that
    one of them sets under another name, that name is added.
    """
    try:
        yield
    except RuntimeError as error:
        if is_interruption(error):
            raise KeyboardInterrupt from error
        raise_if_out_of_memory(error)
        text = str(error)
        if wrapped := re.findall(r"UserError: (.*)", text):
            message = " ".join(wrapped[-1].split())
            raise UserError(message + _set_by(message, given or {}, root)) from error
        if empty := re.search(r'failed to instantiate shape plugin of type "(\w+)": jit_var', text):
            raise UserError(f"a shape of type {empty[1]} has no faces: its mesh must have at least one") from error
        if "Traceback (most recent call last)" in text:
            raise
        text = re.sub(r"\[\w+(\.cpp:\d+)?\] ", "", text)
        raise UserError(unknown_parameters(text) or " ".join(text.split())) from error


def _set_by(message: str, given: Mapping[str, str], root: minidom.Element | None) -> str:
    """Return the addition to a message about a plugin's parameter that a parameter of another name sets."""
    named = re.match(r"(\w+)\b", message)
    if root is None or named is None or named[1] in given:
        return ""
    for element in root.getElementsByTagName("*"):
        reference = re.fullmatch(r"-?\$(\w+)", element.getAttribute("value"))
        if reference and element.getAttribute("name") == named[1] and reference[1] in given:
            return f" ({named[1]} is set by {reference[1]} = {given[reference[1]]})"
    return ""


def _empty_alternatives(parameters: dict[str, str], params: Mapping[str, str]) -> None:
    """Empty the defaults of a scene that given parameters replace; plugins refuse two that are given."""
    given = {name for name, value in params.items() if value != ""}
    for alternatives in _ALTERNATIVES:
        for chosen in alternatives:
            if given.isdisjoint(chosen):
                continue
            others = {name for names in alternatives for name in names} - given - set(chosen)
            parameters.update({name: "" for name in others if name in parameters})


def _text(name: str, value: Any) -> str:
    """Return the value of a parameter as in XML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(name, item) for item in value)
    if not isinstance(value, (str, int, float, np.number, os.PathLike)):
        raise UserError(f"{name} = {shown(value)} must be a number, a text or a list of them")
    return str(value)


def _no_parameters(params: Mapping[str, Any] | None, instrument: str | None, what: str) -> None:
    if instrument is not None:
        raise UserError(f"instrument = {shown(instrument)} needs an XML scene, not {what}")
    if params:
        raise UserError(f"params = {sorted(params)} need an XML scene; {what} has no <default> parameters to fill")
