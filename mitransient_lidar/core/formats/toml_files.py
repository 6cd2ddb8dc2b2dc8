"""TOML files and their tables."""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping
from typing import Any

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.documents import check_nesting, too_deep
from mitransient_lidar.core.validation import shown


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
