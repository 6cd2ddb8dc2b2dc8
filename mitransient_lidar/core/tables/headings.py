"""Headings of measured tables: column names, with units and wavelengths."""

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

_WAVELENGTH = re.compile(r"@?(\d{3,4}(?:\.\d+)?)(nm)?")
_LETTERS_AND_WAVELENGTH = re.compile(r"([a-z][a-z ]*?)[-@]?(\d{3,4}(?:\.\d+)?)(nm)?")

_SAME_WAVELENGTH = 0.05  #: Wavelengths that differ by less [nm] are the same.

_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "⁻": "-", "¹": "1", "^": None, "*": None, "·": None})

_METRIC = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "dm": 0.1}

_SURVEY_FOOT = 1200 / 3937  #: The foot of US surveys, 2e-6 longer than the international one [m].

#: Metres, and other units of length, in small letters without blanks and underscores.
METRES = {
    **_METRIC,
    "ft": 0.3048,
    "ftus": _SURVEY_FOOT,
    "fathom": 1.8288,
    **{
        f"{prefix}{name}": length
        for prefix, length in (("", 1.0), ("centi", 1e-2), ("milli", 1e-3), ("kilo", 1e3), ("deci", 0.1))
        for name in ("metre", "metres", "meter", "meters")
    },
    **dict.fromkeys(("feet", "foot", "ift", "ftint", "internationalfoot", "internationalfeet"), 0.3048),
    **dict.fromkeys(("usft", "us-ft", "sft", "ussurveyft", "footus", "feetus", "ussurveyfoot"), _SURVEY_FOOT),
    **dict.fromkeys(("ussurveyfeet", "surveyfoot", "surveyfeet", "usfoot", "usfeet"), _SURVEY_FOOT),
    **dict.fromkeys(("fathoms", "ftm", "fm"), 1.8288),
}

#: Coefficient units, 1/m.
PER_METRE = {
    **{f"1/{unit}": 1 / length for unit, length in _METRIC.items()},
    **{f"{unit}-1": 1 / length for unit, length in _METRIC.items()},
    "/m": 1.0,
    "perm": 1.0,
}

UNITLESS = {"1": 1.0, "-": 1.0, "%": 1e-2}  #: Ratio units.

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
    wavelength_nm: float  #: 0 if not given.

    @property
    def known_unit(self) -> bool:
        """Whether the column may have this unit."""
        return not self.unit or not self.column.units or self.unit in self.column.units

    @property
    def factor(self) -> float:
        """Factor from this unit to the first one of the column."""
        return self.column.units[self.unit] if self.unit and self.column.units else 1.0


def parse_heading(text: str, columns: Sequence[Column]) -> Heading | None:
    """Return a heading's meaning, None if it names no column."""
    words = _words(text)
    longest = max(len(name.split()) for column in columns for name in (column.name.replace("_", " "), *column.aliases))
    for count in range(min(len(words), longest), 0, -1):
        heading = _named(" ".join(words[:count]), words[count:], columns)
        if heading is not None:
            return heading
    # A unit alone, such as "ns", names the only column that it fits.
    unit = _unit(words)
    fitting = [column for column in columns if unit in column.units]
    return Heading(fitting[0], unit, 0.0) if len(fitting) == 1 and unit else None


def is_unit(text: str, column: Column) -> bool:
    """Return whether a cell below a heading may be the unit of the column; an empty one may."""
    unit = _unit(_words(text))
    return not unit or unit in column.units or (not column.units and unit[0].isalpha())


def read_headings(
    path: str | PathLike[str],
    names: Sequence[str],
    columns: Sequence[Column],
    ignored: Collection[str] = (),
    wavelength_nm: float | None = None,
) -> list[Heading | None]:
    """Return the meaning of each heading in a file.

    None stands for those without a name, with one of `ignored`, or at another wavelength than the one given. Raises
    `UserError` if a name or unit is unknown, a column is there twice, none has the wavelength given, or none is given
    and the columns have several.
    """
    headings = [parse_heading(name, columns) for name in names]
    for name, heading in zip(names, headings, strict=True):
        if heading is None and name and not _is_one_of(name, ignored):
            raise UserError(f"{path} has an unknown column {name!r} {_found_and_allowed(names, columns)}")
        if heading is not None and not heading.known_unit:
            raise UserError(f"{path} has an unknown unit in column {name!r} {_found_and_allowed(names, columns)}")
    used = _at_wavelength(path, headings, wavelength_nm)
    for column in columns:
        same = [name for name, heading in zip(names, used, strict=True) if heading and heading.column is column]
        if len(same) > 1:
            raise UserError(f"{path} has {len(same)} columns {' and '.join(same)} for {column.name}: allowed is one")
    others = [name for name, heading in zip(names, used, strict=True) if heading is None and name]
    if others:
        logger.info("%s: columns %s are not used", path, ", ".join(others))
    return used


def pick_columns(
    path: str | PathLike[str], names: Sequence[str], groups: Sequence[Sequence[Column]]
) -> list[tuple[int, Heading]]:
    """Return the index and meaning of the one heading for each column group; other headings do not matter.

    A name with words that are no unit, such as ``depth_uncertainty``, is another heading; in brackets they are a unit.
    Raises `UserError` if a group has no heading, several, or only some in an unknown unit.
    """
    columns = [column for group in groups for column in group]
    headings = [parse_heading(name, columns) for name in names]
    picked = []
    for group in groups:
        named = [(i, heading) for i, heading in enumerate(headings) if heading and heading.column in group]
        known = [(i, heading) for i, heading in named if heading.known_unit]
        wanted = " or ".join(column.name for column in group)
        if len(known) > 1:
            same = " and ".join(names[i] for i, _ in known)
            raise UserError(f"{path} has {len(known)} columns {same} that may be {wanted}: allowed is one")
        for i, _ in named if not known else ():
            if re.search(r"[\[(/]", names[i]):
                raise UserError(f"{path} has an unknown unit in column {names[i]!r} {_found_and_allowed(names, group)}")
        if not known:
            raise UserError(f"{path} has no column {wanted} {_found_and_allowed(names, columns)}")
        picked += known
    others = [name for i, name in enumerate(names) if name and i not in dict(picked)]
    if others:
        logger.info("%s: columns %s are not used", path, ", ".join(others))
    return picked


def _is_one_of(name: str, others: Collection[str]) -> bool:
    """Return whether a heading begins with one of the names, as ``temperature [degC]`` does."""
    words = _words(name)
    longest = max((len(other.split()) for other in others), default=0)
    return any(" ".join(words[:count]) in others for count in range(1, min(len(words), longest) + 1))


def _at_wavelength(
    path: str | PathLike[str], headings: Sequence[Heading | None], wavelength_nm: float | None
) -> list[Heading | None]:
    """Return the headings of one wavelength and those without, None for the others."""
    found = sorted({heading.wavelength_nm for heading in headings if heading and heading.wavelength_nm})
    if not found:
        return list(headings)
    text = ", ".join(f"{value:g}" for value in found)
    if wavelength_nm is None:
        if len(found) > 1:
            raise UserError(
                f"{path} has columns for {text} nm: the wavelength must be chosen, for a medium by wavelength_nm"
            )
        wavelength_nm = found[0]
    elif not any(abs(value - wavelength_nm) < _SAME_WAVELENGTH for value in found):
        raise UserError(f"{path} has no columns for {wavelength_nm:g} nm but must: its wavelengths are {text}")
    logger.info("%s: coefficients at %g nm", path, wavelength_nm)
    return [
        heading
        if heading and (not heading.wavelength_nm or abs(heading.wavelength_nm - wavelength_nm) < _SAME_WAVELENGTH)
        else None
        for heading in headings
    ]


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
    """Return the column with this name, with the wavelength and the unit in the remaining words."""
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
    unit = _unit(rest[1:] if wavelength and rest and rest[0] == "nm" else rest)
    return Heading(column, unit, float(wavelength or 0))


def _words(text: str) -> list[str]:
    """Split a heading at blanks, underscores and brackets, and a name from its unit at the first slash."""
    # Not by a pattern with blanks on both sides, whose time grows with the square of the number of blanks.
    plain = "/".join(part.strip() for part in text.lower().translate(_SPELLINGS).split("/"))
    words = [word.rstrip("/") for word in re.split(r"[\s_()\[\]{}\"',]+", plain)]
    words = [word for word in words if word not in ("", "in")]
    if words and "/" in words[0][1:] and words[0] not in ("1/m", "bb/b", "b/c", *PER_METRE):
        name, _, unit = words[0].partition("/")
        words[:1] = [name, unit]
    return words


def _unit(words: Sequence[str]) -> str:
    return "".join(words)
