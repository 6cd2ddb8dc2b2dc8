"""Values for the parameters of XML scenes."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import shown
from mitransient_lidar.loading.document import SceneDocument

_COEFFICIENTS = ("attenuation", "scattering", "backscattering")

#: Parameters of scenes that describe the same thing in several ways.
_ALTERNATIVES: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("divergence_mrad",), ("divergence_fwhm_mrad",), ("divergence_1e2_mrad",)),
    (_COEFFICIENTS, ("jerlov",), ("chlorophyll",), ("kd",), ("secchi",), ("petzold",), ("pure",), ("profile",)),
    (("layer_tops",), ("profile",)),
)


def fill(document: SceneDocument, params: Mapping[str, Any] | None) -> SceneDocument:
    """Return a scene with given values of parameters in place of its own.

    Raises
    ------
    UserError
        If the scene has no such parameter or uses it nowhere, or a value is empty or of another type.
    """
    scene = f"{document.name} with instrument {document.instrument}" if document.instrument else document.name
    known, given = document.parameters, {}
    for name, value in (params or {}).items():
        if name not in known:
            close = difflib.get_close_matches(str(name), known, n=3)
            hint = f"did you mean {' or '.join(close)}" if close else f"it has {', '.join(sorted(known))}"
            raise UserError(f"parameter {name!r} is not one of scene {scene}: {hint}")
        given[name] = _text(name, value)
        if not given[name].strip() and known[name].strip():
            raise UserError(f"{name} = {given[name]!r} is empty: it must have a value, as {known[name]}")
    filled = replace(document, parameters={**without_alternatives(known, given), **given}, given=given)
    if unused := [name for name in given if name not in filled.used]:
        raise UserError(f"parameter {unused[0]} = {given[unused[0]]} is used by nothing in scene {document.name}")
    return filled


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
