"""Headings of measured tables: names of columns, with units and wavelengths."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import NamedTuple

from mitransient_lidar.core.errors import UserError

logger = logging.getLogger(__name__)

_WAVELENGTH = re.compile(r"@?(\d{3,4})(nm)?")
_LETTERS_AND_WAVELENGTH = re.compile(r"([a-z][a-z ]*?)[-@]?(\d{3,4})(nm)?")

_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "⁻": "-", "¹": "1", "^": None, "*": None, "·": None})

_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048}

#: Metres, and their other names.
METRES = {**_LENGTHS, **dict.fromkeys(("metre", "metres", "meter", "meters"), 1.0), "feet": 0.3048}

#: Units of coefficients, 1/m.
PER_METRE = {
    **{f"1/{unit}": 1 / length for unit, length in _LENGTHS.items() if unit != "ft"},
    **{f"{unit}-1": 1 / length for unit, length in _LENGTHS.items() if unit != "ft"},
    "/m": 1.0,
    "perm": 1.0,
}

#: Units of ratios.
UNITLESS = {"1": 1.0, "-": 1.0, "%": 1e-2}

_NANOSECONDS = {"ns": 1.0, "ps": 1e-3, "us": 1e3, "ms": 1e6, "s": 1e9}


@dataclass(frozen=True)
class Column:
    """Column of a table, and how its heading may read.

    Case does not matter, and blanks, underscores and brackets separate name, wavelength and unit: ``depth_m``,
    ``t [ps]``, ``c(532) 1/m``, ``t / ns``.
    """

    name: str
    aliases: tuple[str, ...] = ()  #: Other names, in lower case with blanks.
    #: Units with their factors to the first one, which holds if the heading has none; empty if any unit will do.
    units: Mapping[str, float] = field(default_factory=dict)
    spectral: bool = False  #: Whether the name may have a wavelength [nm], as in ``a532``.
    fill_values: bool = False  #: Whether -999, -9999 and the like stand for missing values.


TIME = Column("time", ("t", "times"), {**_NANOSECONDS, **dict.fromkeys(("sec", "second", "seconds"), 1e9)})
"""Times [ns]."""


class Heading(NamedTuple):
    """Meaning of a heading."""

    column: Column
    unit: str  #: "" if not given.
    wavelength: str  #: In nm, "" if not given.

    @property
    def known_unit(self) -> bool:
        """Whether the column may have this unit."""
        return not self.unit or not self.column.units or self.unit in self.column.units

    @property
    def factor(self) -> float:
        """Factor from this unit to the first one of the column."""
        return self.column.units[self.unit] if self.unit and self.column.units else 1.0


def parse_heading(text: str, columns: Sequence[Column]) -> Heading | None:
    """Return the meaning of a heading, None if it names none of the columns."""
    words = _words(text)
    for count in range(len(words), 0, -1):
        heading = _named(" ".join(words[:count]), words[count:], columns)
        if heading is not None:
            return heading
    # A unit alone, such as "ns", names the only column that it fits.
    unit = _unit(words)
    fitting = [column for column in columns if unit in column.units]
    return Heading(fitting[0], unit, "") if len(fitting) == 1 and unit else None


def is_unit(text: str, column: Column) -> bool:
    """Return whether a cell below a heading may be the unit of the column; an empty one may."""
    unit = _unit(_words(text))
    return not unit or unit in column.units or (not column.units and unit[0].isalpha())


def read_headings(
    path: str | PathLike[str], names: Sequence[str], columns: Sequence[Column], ignored: Collection[str] = ()
) -> list[Heading | None]:
    """Return the meaning of each heading of a file; None for those without a name or with one of `ignored`.

    Raises
    ------
    UserError
        If a name or unit is unknown, a column is there twice, or the columns belong to several wavelengths.
    """
    headings = [parse_heading(name, columns) for name in names]
    others = [name for name, heading in zip(names, headings, strict=True) if heading is None and name]
    for name in others:
        if not any(" ".join(_words(name)[:count]) in ignored for count in range(1, len(_words(name)) + 1)):
            raise UserError(f"{path} has an unknown column {name!r} {_found_and_allowed(names, columns)}")
    named = [(name, heading) for name, heading in zip(names, headings, strict=True) if heading is not None]
    for name, heading in named:
        if not heading.known_unit:
            raise UserError(f"{path} has an unknown unit in column {name!r} {_found_and_allowed(names, columns)}")
    for column in columns:
        same = [name for name, heading in named if heading.column is column]
        if len(same) > 1:
            raise UserError(f"{path} has {len(same)} columns {' and '.join(same)} for {column.name}: allowed is one.")
    wavelengths = {heading.wavelength: name for name, heading in named if heading.wavelength}
    if len(wavelengths) > 1:
        raise UserError(
            f"{path} has columns for {' and '.join(wavelengths)} nm, {' and '.join(wavelengths.values())}:"
            " allowed is one wavelength."
        )
    for wavelength in wavelengths:
        logger.info("%s: coefficients at %s nm", path, wavelength)
    if others:
        logger.info("%s: columns %s are not used", path, ", ".join(others))
    return headings


def unknown_columns(path: str | PathLike[str], names: Sequence[str], columns: Sequence[Column]) -> UserError:
    """Return the error for headings none of which is known."""
    return UserError(f"{path} has no heading with known columns {_found_and_allowed(names, columns)}")


def _found_and_allowed(names: Sequence[str], columns: Sequence[Column]) -> str:
    """Return the columns of a file and those allowed, for messages."""
    allowed = []
    for units, group in itertools.groupby(columns, key=lambda column: column.units):
        spellings: dict[float, str] = {}
        for unit, factor in units.items():
            spellings.setdefault(factor, unit)
        text = ", ".join(column.name for column in group)
        allowed.append(f"{text} [{', '.join(spellings.values())}]" if spellings else text)
    found = ", ".join(name for name in names if name) or "none"
    return f"(found: {found}): allowed are {', '.join(allowed)}."


def _named(name: str, rest: Sequence[str], columns: Sequence[Column]) -> Heading | None:
    """Return the column of this name, with the wavelength and the unit of the remaining words."""
    for column in columns:
        names = (column.name.replace("_", " "), *column.aliases)
        if name in names:
            wavelength = _WAVELENGTH.fullmatch(rest[0]) if column.spectral and rest else None
            return _with_wavelength(column, wavelength[1] if wavelength else "", rest[1:] if wavelength else rest)
        attached = _LETTERS_AND_WAVELENGTH.fullmatch(name) if column.spectral else None
        if attached and attached[1] in names:
            return _with_wavelength(column, attached[2], rest)
    return None


def _with_wavelength(column: Column, wavelength: str, rest: Sequence[str]) -> Heading:
    return Heading(column, _unit(rest[1:] if wavelength and rest and rest[0] == "nm" else rest), wavelength)


def _words(text: str) -> list[str]:
    """Split a heading at blanks, underscores and brackets, and a name from its unit at the first slash."""
    plain = re.sub(r"\s*/\s*", "/", text.strip().lower().translate(_SPELLINGS))
    words = [word.rstrip("/") for word in re.split(r"[\s_()\[\]{}\"',]+", plain)]
    words = [word for word in words if word not in ("", "in")]
    if words and "/" in words[0][1:] and words[0] not in ("1/m", "bb/b", "b/c", *PER_METRE):
        name, _, unit = words[0].partition("/")
        words[:1] = [name, unit]
    return words


def _unit(words: Sequence[str]) -> str:
    return "".join(words)
