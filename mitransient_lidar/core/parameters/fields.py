"""Declaration of a plugin's parameters: one line each, from which reading, refusals, records and the manual follow."""

from __future__ import annotations

import ast
import math
import re
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite, integer, number_list, number_within

AUTO = "auto"  #: Text that leaves the choice of a value to the scene.
GREEN_LASERS = (510.0, 540.0)  #: Wavelengths [nm] of lasers for which values at 532 nm stand.


def is_green(wavelength_nm: float | None) -> bool:
    """Return whether values at 532 nm stand for a wavelength [nm]; None is 532 nm."""
    return wavelength_nm is None or GREEN_LASERS[0] <= wavelength_nm <= GREEN_LASERS[1]


@dataclass(frozen=True)
class Parameter:
    """A plugin parameter."""

    #: Name, type as in the manual (``float``, ``integer``, ``boolean``, ``string``, or kind of an object), meaning.
    name: str
    kind: str
    meaning: str
    default: Any = None  #: Value where none is given; None without one.
    unit: str = ""  #: Unit as in data files, ``1`` of a plain number; empty for texts.
    #: Range of a number, or of each number in a list.
    low: float = -math.inf
    high: float = math.inf
    above: bool = False  #: Whether `low`, which is then 0, is itself outside the range.
    choices: tuple[str, ...] = ()  #: Allowed texts; empty for any.
    is_list: bool = False  #: Whether the value is a text of numbers, one for each layer or one for all.
    #: Whether ``auto`` leaves the choice to the scene, and whether an empty text counts as not given.
    may_be_auto: bool = False
    may_be_empty: bool = False
    is_file: bool = False  #: Whether the value is a file name.
    #: Whether its name alone means a parameter in other plugins, so that only one with an id or its plugin's name
    #: reaches it.
    by_id: bool = False
    of_green: bool = False  #: Whether `default` holds for green lasers alone (`is_green`).
    otherwise: str = ""  #: Rule without a value where `default` does not state it.

    def checked(self, value: Any) -> Any:
        """Return a value of this parameter: a float, an integer or a truth value within its range; others as given.

        Raises `UserError` if it is not allowed; the sentence names the parameter, the value and the allowed values.
        """
        if value is None or (self.may_be_auto and value == AUTO) or self.is_list:
            return value
        if self.choices and value not in self.choices:
            raise UserError(f"{self.name} = {value!r} must be one of {', '.join(self.choices)}")
        if self.kind == "integer":
            if isinstance(value, str) and self.may_be_auto:
                value = int(value) if value.strip().isdecimal() else finite(self.name, value)
            return integer(self.name, value, int(self.low), int(self.high))
        if self.kind == "boolean":
            if str(value).lower() not in ("true", "false"):
                raise UserError(f"{self.name} = {value!r} must be true or false")
            return str(value).lower() == "true"
        return self.number(value) if self.kind == "float" else value

    def number(self, value: object) -> float:
        """Return a number within the range; else raise ``UserError``."""
        return number_within(self.name, value, self.low, self.high, above=self.above)

    def per_layer(self, given: Any, layers: int) -> FloatArray:
        """Return one number per layer from a list with one for all or one for each; else raise ``UserError``."""
        values = number_list(self.name, given)
        if values.size not in (1, layers):
            raise UserError(f"{self.name} has {values.size} values but must have 1 or {layers}, one a layer")
        for value in values:
            self.number(value)
        return np.broadcast_to(values, layers)

    @property
    def text(self) -> str:
        """The default as in XML; empty without one."""
        if self.default is None:
            return ""
        return f"{self.default:.15g}" if isinstance(self.default, float) else str(self.default).lower()

    @property
    def tag(self) -> str:
        """Element of XML that sets the value: a text where it may be one that is no number."""
        return "string" if self.may_be_auto or self.may_be_empty or self.kind == "boolean" else self.kind

    @property
    def allowed(self) -> str:
        """Allowed values, for the manual."""
        if self.choices:
            return ", ".join(f"``{each}``" for each in self.choices)
        low, high = (_shown(float(limit)) for limit in (self.low, self.high))
        numbers = f"{low} to {high}"
        if self.above:
            numbers = f"above {low}" + (f" to {high}" if self.high < math.inf else "")
        elif self.high == math.inf:
            numbers = "" if self.low == -math.inf else f"at least {low}"
        unit = "" if self.unit in ("", "1") else f"{numbers and ' '}{self.unit}"
        return f"{numbers}{unit}" + (f", or ``{AUTO}``" if self.may_be_auto else "")


@dataclass(frozen=True)
class Plugin:
    """A plugin's name, its parameters in manual order, and those that describe one thing in several ways.

    Each entry in `alternatives` lists the ways, and each way the names of its parameters; ``a nested sensor`` means an
    object of this kind.
    """

    name: str
    parameters: tuple[Parameter, ...]
    alternatives: tuple[tuple[tuple[str, ...], ...], ...] = ()

    def __getitem__(self, name: str) -> Parameter:
        """Return a parameter by name."""
        return next(each for each in self.parameters if each.name == name)

    def __iter__(self) -> Iterator[Parameter]:
        """Yield the parameters."""
        return iter(self.parameters)

    def replaced(self, given: Collection[str]) -> set[str]:
        """Return the parameter names that given ones replace, as they describe the same."""
        return {
            name
            for ways in self.alternatives
            for chosen in ways
            if not set(chosen).isdisjoint(given)
            for way in ways
            for name in way
            if name not in given and name not in chosen
        }

    def check_ways(self, given: Mapping[str, Any]) -> None:
        """Raise `UserError` if given values describe one thing in several ways."""
        for ways in self.alternatives:
            chosen = [next((name for name in way if name in given), "") for way in ways]
            told = [
                f"{name} = {given[name]!r}" if isinstance(given[name], (str, int, float)) else name
                for name in filter(None, chosen)
            ]
            if len(told) > 1:
                raise UserError(f"{self.name}: {' and '.join(told)} describe the same: give one of them")

    def reader(self, get: Callable[[str, Any], Any]) -> Read:
        """Return the reader of values that a function (name, default) -> value gives."""
        return Read(self, get)

    def table(self) -> str:
        """Return the manual's table in reStructuredText."""
        lines = [".. list-table::", "   :header-rows: 1", "   :widths: auto", ""]
        rows = [("Parameter", "Type", "Meaning")]
        for each in self.parameters:
            default = each.otherwise or ("" if each.default in (None, "") else f"``{_shown(each.default)}``")
            told = [each.meaning, each.allowed and f"Allowed: {each.allowed}", default and f"Default: {default}"]
            rows.append((f"``{each.name}``", each.kind, ". ".join(filter(None, told))))
        for row in rows:
            lines += [f"   {'* - ' if not number else '  - '}{cell}".rstrip() for number, cell in enumerate(row)]
        return "\n".join(lines)

    def manual(self, text: str, kind: str) -> str:
        """Return the manual of a plugin of a kind, in whose text ``.. parameters::`` and ``.. example::`` stand.

        The example, a dict, is the last part; it is shown in XML, too.
        """
        prose, _, given = text.replace(".. parameters::", self.table().replace("\n", "\n    ")).partition(
            ".. example::"
        )
        blocks = {"xml": self._xml(kind, ast.literal_eval(given.strip())), "python": textwrap.dedent(given).strip()}
        parts = [f".. code-block:: {name}\n\n{textwrap.indent(block, ' ' * 8)}\n" for name, block in blocks.items()]
        return prose + "\n    ".join(parts) + "    "

    def _xml(self, kind: str, values: Mapping[str, Any]) -> str:
        """Return the XML of an object of a kind with values; of an object in it, its type alone."""
        # The water is the interior of the sea.
        names = {one: ' name="interior"' if one == "medium" else "" for one in (kind, "medium", "film")}
        lines = []
        for name, value in values.items():
            if isinstance(value, dict):
                inner = next((one.kind for one in self if one.name == name), name)
                lines.append(f'    <{inner}{names[inner]} type="{value["type"]}"/>')
            elif name != "type":
                lines.append(f'    <{self[name].tag} name="{name}" value="{_shown(value)}"/>')
        start = f'<{kind} type="{self.name}"{names[kind]}'
        return "\n".join([f"{start}>", *lines, f"</{kind}>"]) if lines else f"{start}/>"


def plugin(name: str, *parameters: Parameter, alternatives: tuple[tuple[tuple[str, ...], ...], ...] = ()) -> Plugin:
    """Return a plugin's declaration."""
    return Plugin(name, parameters, alternatives)


@dataclass(frozen=True)
class Read:
    """Reader of a plugin's values: each is checked as it is declared."""

    plugin: Plugin
    get: Callable[[str, Any], Any]

    def __call__(self, name: str, default: Any = None) -> Any:
        """Return the value of a parameter, else the declared default, or the given one."""
        parameter = self.plugin[name]
        return parameter.checked(self.get(name, parameter.default if default is None else default))

    def given(self, *names: str) -> list[str]:
        """Return those parameters that have a value."""
        return [name for name in names if self.get(name, None) not in (None, "")]


def _shown(value: Any) -> str:
    """Return a value's text in the manual."""
    if isinstance(value, bool):
        return str(value).lower()
    return re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}") if isinstance(value, float) else str(value)


def number(
    name: str, default: float | str | None, unit: str, low: float, high: float, meaning: str, **more: Any
) -> Parameter:
    """Return a number, in a unit and a range."""
    return Parameter(name, "float", meaning, default, unit, low, high, may_be_auto=default == AUTO, **more)


def count(name: str, default: int | str | None, low: int, high: int, meaning: str, **more: Any) -> Parameter:
    """Return an integer in a range."""
    return Parameter(name, "integer", meaning, default, "1", low, high, may_be_auto=default == AUTO, **more)


def numbers(name: str, default: Any, unit: str, low: float, high: float, meaning: str, **more: Any) -> Parameter:
    """Return a text of numbers, one for each layer or one for all, which may be empty."""
    more = {"may_be_empty": True, **more}
    return Parameter(name, "string", meaning, default, unit, low, high, is_list=True, **more)


def text(name: str, default: str | None, meaning: str, choices: tuple[str, ...] = (), **more: Any) -> Parameter:
    """Return a text, one of some choices where there are any."""
    return Parameter(name, "string", meaning, default, choices=choices, **more)


def switch(name: str, default: bool | None, meaning: str, **more: Any) -> Parameter:
    """Return a parameter that is true or false."""
    return Parameter(name, "boolean", meaning, default, **more)


def file(name: str, meaning: str, **more: Any) -> Parameter:
    """Return a file's name."""
    return Parameter(name, "string", meaning, is_file=True, **more)


def nested(name: str, kind: str, meaning: str) -> Parameter:
    """Return an object inside the plugin; a name in brackets for any."""
    return Parameter(name, kind, meaning)
