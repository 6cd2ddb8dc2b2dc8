"""Plans: tables of files whose keys a class declares, from which reading, refusals and documentation follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, ClassVar, Self, TypeVar, get_args, get_origin

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.formats.documents import check_keys, required, table
from mitransient_lidar.core.options import Option, declared, documented_parameters, parts
from mitransient_lidar.core.validation import finite_array, shown

_P = TypeVar("_P", bound="Plan")


@dataclass(frozen=True)
class Plan:
    """Base of frozen dataclasses whose fields have types and an `Option` in their annotations.

    Values are checked and converted when an object is made, and documented as parameters. None stays where it is the
    default. Fields without an `Option` are not checked, and are no keys of a file.
    """

    _kinds: ClassVar[Mapping[str, tuple[Any, Option]]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._kinds = declared(cls)
        own = {name: option for name, (_, option) in cls._kinds.items() if name in cls.__annotations__}
        cls.__doc__ = documented_parameters(cls.__doc__ or "", own)

    def __post_init__(self) -> None:
        for one in fields(self):
            if one.name in self._kinds:
                value = _checked(one, getattr(self, one.name), one.name, *self._kinds[one.name])
                object.__setattr__(self, one.name, value)

    @classmethod
    def keys(cls) -> list[str]:
        """Return a table's keys, in their order."""
        return [one.name for one in fields(cls) if one.name in cls._kinds]

    @classmethod
    def of(cls, given: object, where: str = "", prefix: str = "", **others: Any) -> Self:
        """Return the object for a table in a file.

        In messages the table is `where`, such as ``[design]``, and names of values begin with `prefix`, such as
        ``design.``. `others` are fields that are no keys. Raises `UserError` if it is no table, a key is unknown or
        missing, or a value is not allowed.
        """
        where = where or f"[{cls.__name__.lower()}]"
        values = table(where, given)
        check_keys(where, values, cls.keys())
        found = {}
        for one in fields(cls):
            if one.name in values:
                found[one.name] = _checked(one, values[one.name], f"{prefix}{one.name}", *cls._kinds[one.name])
            elif one.name in cls._kinds and one.default is MISSING and one.default_factory is MISSING:
                required(where, values, one.name)
        return cls(**found, **others)


def of_kind(name: str, given: object, kinds: Mapping[str, type[_P]]) -> _P:
    """Return the object for a plan table whose ``kind`` names its class; raise `UserError` as `Plan.of`."""
    values = dict(table(name, given))
    kind = required(f"[{name}]", values, "kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise UserError(f"kind = {shown(kind)} of a {name} must be one of {', '.join(kinds)}")
    return kinds[kind].of({key: value for key, value in values.items() if key != "kind"}, f"a {name} of kind {kind!r}")


def one_of(name: str, value: Any, allowed: Any) -> Any:
    """Return a text; raise `UserError` unless it is one of those allowed."""
    if not isinstance(value, str) or value not in allowed:
        raise UserError(f"{name} = {shown(value)} must be one of {', '.join(allowed)}")
    return value


def _checked(field: Field[Any], value: Any, name: str, kind: Any, option: Option) -> Any:
    """Return a typed value, or its field's default; raise `UserError` for another."""
    default = field.default
    if type(value) is type(default) and value == default:
        return value
    kinds = parts(kind)
    words = [one for one in kinds if isinstance(one, str)]
    if value is not None and isinstance(value, str) and value in words:
        return value
    if bool in kinds:
        if not isinstance(value, bool):
            raise UserError(f"{name} = {shown(value)} must be true or false")
        return value
    if int in kinds or float in kinds:
        if words and (isinstance(value, (bool, str)) or not isinstance(value, (int, float, np.number))):
            raise UserError(f"{name} = {shown(value)} must be a number or {' or '.join(words)}")
        return option.number(name, value, int in kinds)
    return one_of(name, value, words) if words else _composed(name, value, kinds[0], option)


def _composed(name: str, value: Any, kind: Any, option: Option) -> Any:
    """Return a table, a list, a text, or an object of another class."""
    if isinstance(kind, type) and issubclass(kind, Plan):
        return value if isinstance(value, kind) else kind.of(table(name, value), f"[{name}]", f"{name}.")
    if get_origin(kind) is tuple and {str, float} & {*get_args(kind)}:
        return _list(name, value, get_args(kind), option)
    if get_origin(kind) is not None and issubclass(get_origin(kind), Mapping):
        return table(name, value)
    if kind is str and not isinstance(value, str):
        raise UserError(f"{name} = {shown(value)} must be {option.form or 'a name'}")
    return value


def _list(name: str, value: Any, kinds: tuple[Any, ...], option: Option) -> tuple[Any, ...]:
    """Return a list of texts, or of numbers that may be as many as their types."""
    if str in kinds:
        names = [value] if isinstance(value, str) else value
        if not isinstance(names, (list, tuple)) or not all(isinstance(one, str) for one in names):
            raise UserError(f"{name} = {shown(value)} must be a list of names")
        return tuple(names)
    ends = finite_array(name, value)
    if ends.ndim != 1 or (Ellipsis not in kinds and ends.size != len(kinds)):
        raise UserError(f"{name} = {shown(value)} must be {option.form or 'a list of numbers'}")
    return tuple(option.number(name, end) for end in ends.tolist())
