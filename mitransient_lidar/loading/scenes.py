"""Loading of scenes, with error messages of one sentence."""

from __future__ import annotations

import contextlib
import difflib
import os
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from mitransient_lidar.core.errors import UserError, is_interruption
from mitransient_lidar.loading import catalogue

if TYPE_CHECKING:
    import mitsuba as mi


def load_scene(scene: Any, params: Mapping[str, Any] | None = None) -> tuple[mi.Scene, str, dict[str, str]]:
    """Load a scene.

    Parameters
    ----------
    scene
        Name of a shipped scene, path of an XML file, dict for ``mitsuba.load_dict``, or a loaded scene.
    params
        Values for the ``<default>`` parameters of an XML scene.

    Returns
    -------
    scene, name, parameters
        The loaded scene, its name, and the parameters of an XML scene with their values as text.

    Raises
    ------
    UserError
        If there is no such scene, a parameter is unknown, or a plugin rejects a value.
    """
    import mitsuba as mi

    if isinstance(scene, mi.Scene):
        _no_parameters(params, "a loaded scene")
        return scene, scene.id() or "scene", {}
    if isinstance(scene, Mapping):
        _no_parameters(params, "a dict")
        with as_user_error():
            return mi.load_dict({"type": "scene", **scene}, optimize=False), "scene", {}
    if not isinstance(scene, (str, os.PathLike)):
        raise UserError(f"scene = {scene!r} must be a shipped name, a path, a dict or a loaded scene")
    path = catalogue.scene_path(scene)
    parameters = {**catalogue.scene_parameters(path)}
    for name, value in (params or {}).items():
        if name not in parameters:
            close = difflib.get_close_matches(name, parameters, n=3)
            hint = f"did you mean {' or '.join(close)}" if close else f"it has {', '.join(sorted(parameters))}"
            raise UserError(f"parameter {name!r} is not one of scene {path.stem}: {hint}")
        parameters[name] = _text(value)
    with as_user_error():
        # Optimisation would merge a bottom and a target of one material into a shape without a name.
        return mi.load_file(str(path), optimize=False, **parameters), path.stem, parameters


@contextlib.contextmanager
def as_user_error() -> Iterator[None]:
    """Convert a ``RuntimeError`` of Mitsuba's parser to a `UserError` of one sentence.

    Mitsuba wraps an exception of a Python plugin, with its traceback, in a ``RuntimeError``. A wrapped ``UserError`` or
    Ctrl-C is unwrapped; any other wrapped exception is a bug and keeps its traceback.
    """
    try:
        yield
    except RuntimeError as error:
        if is_interruption(error):
            raise KeyboardInterrupt from error
        text = str(error)
        if wrapped := re.findall(r"UserError: (.*)", text):
            raise UserError(" ".join(wrapped[-1].split())) from error
        if empty := re.search(r'failed to instantiate shape plugin of type "(\w+)": jit_var', text):
            raise UserError(f"a shape of type {empty[1]} has no faces: its mesh must have at least one") from error
        if "Traceback (most recent call last)" in text:
            raise
        raise UserError(" ".join(re.sub(r"\[\w+(\.cpp:\d+)?\] ", "", text).split())) from error


def _text(value: Any) -> str:
    """Return the value of a parameter as in XML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return ", ".join(str(item) for item in value)
    return str(value)


def _no_parameters(params: Mapping[str, Any] | None, what: str) -> None:
    if params:
        raise UserError(f"params = {sorted(params)} need an XML scene; {what} has no <default> parameters to fill")
