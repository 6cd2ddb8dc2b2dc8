"""XML, JSON and TOML documents by others: only those that contain nothing but elements, numbers and texts."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Collection, Mapping
from typing import Any
from xml.parsers import expat

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import shown

#: Deepest nesting of lists and tables in a JSON or TOML document; functions that walk it are recursive.
_DEEPEST = 100
_NESTED = (list, tuple, Mapping)


def check_xml(text: str | bytes, name: object) -> None:
    """Raise `UserError` if an XML document is not well-formed, or contains more than elements, attributes and comments.

    A DOCTYPE, its own entities and processing instructions are refused where they begin, before anything is expanded.
    An entity may become any element, and grow without limit. `name` is the document's name in the message.
    """
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = _refusing(name, "a DOCTYPE")
    parser.EntityDeclHandler = _refusing(name, "an entity")
    parser.ProcessingInstructionHandler = _refusing(name, "a processing instruction")
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, UnicodeEncodeError) as error:
        raise UserError(f"{name} is not well-formed XML: {error}") from error


def _refusing(name: object, what: str) -> Callable[..., None]:
    """Return the handler that refuses a part of a document."""

    def refuse(*_: object) -> None:
        raise UserError(f"{name} holds {what}: it must hold elements, attributes and comments only")

    return refuse


def parse_json(text: Any, name: str) -> Any:
    """Return a JSON text's value; raise `UserError` for another text, or one that is nested too deeply."""
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise too_deep(name) from error
    except (TypeError, ValueError) as error:
        raise UserError(f"{name} is damaged: it must be a text of JSON") from error
    check_nesting(value, name)
    return value


def check_nesting(value: Any, name: object) -> None:
    """Raise `UserError` if lists and tables are nested more than 100 deep."""
    level = [value]
    for _ in range(_DEEPEST + 1):
        lists = [part.values() if isinstance(part, Mapping) else part for part in level if isinstance(part, _NESTED)]
        level = [one for part in lists for one in part]
        if not level:
            return
    raise too_deep(name)


def too_deep(name: object) -> UserError:
    """Return the error of a document whose lists and tables are nested too deeply."""
    return UserError(f"{name} is nested more than {_DEEPEST} deep, which is the limit")


def parse_toml(text: str, name: object) -> dict[str, Any]:
    """Return the contents of a TOML file; raise `UserError`, with the file's name, for another text."""
    try:
        given = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{name} is not a TOML file: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise too_deep(name) from error
    check_nesting(given, name)
    return given


def check_keys(where: str, given: Mapping[str, Any], known: Collection[str]) -> None:
    """Raise `UserError` for a key that a table, such as ``[design]`` or ``a campaign``, may not have."""
    for name in given:
        if name not in known:
            raise UserError(f"{shown(name)} is no key of {where}: allowed are {', '.join(known)}")


def required(where: str, given: Mapping[str, Any], name: str) -> Any:
    """Return the value of a key; raise `UserError` if the table does not have it."""
    if name not in given:
        raise UserError(f"{where} has no {name}: it must have it")
    return given[name]


def table(where: str, given: object) -> Mapping[str, Any]:
    """Return a table; raise `UserError` if the value is another."""
    if not isinstance(given, Mapping):
        raise UserError(f"{where} = {shown(given)} must be a table")
    return given
