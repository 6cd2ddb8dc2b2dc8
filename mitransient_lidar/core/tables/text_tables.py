"""Reading of measured tables from text files, with line numbers in error messages; large ones through pandas."""

from __future__ import annotations

import contextlib
import csv
import itertools
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file, read_text
from mitransient_lidar.core.tables.headings import (
    TIME,
    Column,
    Heading,
    is_unit,
    parse_heading,
    read_headings,
    unknown_columns,
)
from mitransient_lidar.core.validation import FloatArray, IntArray

logger = logging.getLogger(__name__)

#: Words for a missing value, in small letters: pandas' own, and dashes.
MISSING = frozenset({"", "nan", "-nan", "na", "n/a", "<na>", "#n/a", "#na", "null", "none", "-", "--", "---"})

_FILL_VALUES = (-99.0, -999.0, -9999.0, -99999.0, -9.99e-29)  #: Values that instruments write for missing ones.

_MOST_LINES = 10**6  #: Most lines in a table.
_LINES_FOR_WIDTH = 10_000  #: Lines in which the number of columns shows.
_LONGEST_HEAD = 2**16  #: Characters of the lines above the first row in which the heading is looked for.
_SHORTEST_RECORD = 1e-3  #: Times [ns] without a unit that span less are probably seconds.

_COMMENT = re.compile(r"(#(?!N/?A)|%|//|!)[#%/!]*\s*")
_INLINE_COMMENT = re.compile(r"#(?!N/?A).*")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")

_BETWEEN_NAMES = re.compile(r"\s+(?![\[(]|1/\w|m\^?-1|in\s)")  #: Blanks in a heading that do not stand before a unit.


class Table(NamedTuple):
    """Number columns from a text file."""

    columns: dict[str, FloatArray]  #: Values by the names of their columns, in their first units, shape (rows,).
    lines: list[int]  #: Line number of each row, counted from 1.
    without_unit: frozenset[str]  #: Names of the columns whose unit is not given.


class Line(NamedTuple):
    """A file's line that is not empty."""

    number: int
    text: str  #: Without the comment mark.
    separator: str  #: Semicolon, tab, comma, or empty for blanks.
    cells: list[str]  #: Numbers with a decimal point.
    has_decimal_commas: bool

    def heading(self, width: int) -> list[str]:
        """Return the cells; names with blanks inside are joined if that makes their number `width`."""
        if self.separator or len(self.cells) <= width:
            return self.cells
        splits = (re.split(blanks, self.text) for blanks in (r"\s{2,}", _BETWEEN_NAMES))
        return next((cells for cells in splits if len(cells) == width), self.cells)


def read_table(
    path: str | PathLike[str],
    columns: Sequence[Column],
    ignored: Collection[str] = (),
    wavelength_nm: float | None = None,
    positional: bool = False,
) -> Table:
    """Read a table from a text file as an instrument or a spreadsheet writes it.

    Above the rows there may be text lines. The first one that names two or more columns is the heading. It may be a
    comment, and the line below it may give the units. Cells are separated by semicolons, tabs, commas or blanks.
    Between semicolons and tabs, a comma in a number is the decimal point. Comments follow a #, or begin their line with
    %, // or !. Rows with missing values (empty, nan, na, n/a, null, none, dashes) are left out with a warning in the
    log. Raises `UserError` if the file cannot be read or is not text; a name, unit or wavelength is unknown, or a
    column is there twice; or a line does not contain one number for each column.

    `path`: text file in UTF-8; a byte order mark may precede it. `columns`: columns that the file may have. `ignored`:
    names of other columns that it may have, in lower case; the log reports that they are not used. `wavelength_nm`:
    wavelength [nm] of the columns, if the file has several. `positional`: whether a file without heading has exactly
    `columns`, in their order and first units.
    """
    text = read_text(path)
    if (count := text.count("\n")) > _MOST_LINES:
        raise UserError(f"{path} has {count} lines: a table may have {_MOST_LINES}")
    lines, comments = split_lines(text)
    width = _width(lines)
    start = next((i for i, line in enumerate(lines) if len(line.cells) == width and _is_row(line)), len(lines))
    names, start = _find_heading(lines, comments, start, width, columns)
    headings: Sequence[Heading | None]
    if names:
        names, start = _with_units(names, lines, start, columns)
        headings = read_headings(path, names, columns, ignored, wavelength_nm)
    else:
        start = _without_heading(path, lines, start, width, columns, positional)
        headings = [Heading(column, "", 0.0) for column in columns]
    rows = lines[start:]
    table = _values(path, rows, names, headings)
    kept = complete_rows(path, table, [f"line {line.number}" for line in rows])
    return Table(
        {name: column[kept] for name, column in table.items()},
        [rows[row].number for row in kept],
        frozenset(heading.column.name for heading in headings if heading is not None and not heading.unit),
    )


def find_rows(
    path: str | PathLike[str], text: str, columns: Sequence[Column], others: Sequence[Column], names: list[str]
) -> tuple[list[str], list[Line]]:
    """Return the names in the heading at the beginning of a table, and its rows.

    A heading, whose names are `names` if they are given elsewhere, has two or more of `columns` and `others`, and any
    further ones. Without one, the names are empty, and the first columns are `columns`.
    """
    lines, comments = split_lines(text)
    width = _width(lines)
    start = next((i for i, line in enumerate(lines) if len(line.cells) == width and _is_mostly_numbers(line)), 0)
    if not names:
        names, start = _find_heading(lines, comments, start, width, (*columns, *others))
        if names:
            names, start = _with_units(names, lines, start, (*columns, *others))
        else:
            start = _without_heading(path, lines, start, width, columns, True)
    return names, lines[start:]


def read_two_columns(path: str | PathLike[str], first: Column, second: Column) -> Table:
    """Read two columns as `read_table` does; without a heading they are in this order and in their first units."""
    return read_table(path, (first, second), positional=True)


def read_time_samples(path: str | PathLike[str], quantity: Column) -> tuple[FloatArray, FloatArray]:
    """Read times [ns] and the values of a quantity, in any order below a heading, or in this order without one.

    Raises `UserError` as `read_table`; or if the unit of time is not given and the record is shorter than a picosecond
    in ns.
    """
    table = read_two_columns(path, TIME, quantity)
    times, values = table.columns["time"], table.columns[quantity.name]
    if times.size > 1 and "time" in table.without_unit and np.ptp(times) < _SHORTEST_RECORD:
        raise UserError(
            f"{path} has times from {times.min():g} to {times.max():g} without a unit, too short for ns: the heading"
            " must name it, such as time_s"
        )
    return times, values


def complete_rows(path: str | PathLike[str], columns: Mapping[str, FloatArray], places: Sequence[str]) -> IntArray:
    """Return the indices of the rows without NaN; warn about the others, with the first one's position."""
    missing = np.zeros(len(places), dtype=bool)
    for values in columns.values():
        missing |= np.isnan(values)
    if missing.any():
        first = places[int(np.argmax(missing))]
        logger.warning(
            "%s: %d of %d rows left out for missing values, the first in %s", path, missing.sum(), len(places), first
        )
    return np.flatnonzero(~missing)


def split_lines(text: str) -> tuple[list[Line], list[Line]]:
    """Return the lines of a text that are not empty, and its comments."""
    lines: list[Line] = []
    comments: list[Line] = []
    for number, line in enumerate(text.splitlines(), start=1):
        mark = _COMMENT.match(line)
        content = line[mark.end() :] if mark else _INLINE_COMMENT.sub("", line)
        if content.strip(" \t,;"):
            (comments if mark else lines).append(split_line(number, content.strip(" ")))
    return lines, comments


def split_line(number: int, text: str) -> Line:
    """Split a line into cells."""
    has_tab = "\t" in text
    # Next to a tab or blank a comma separates; inside a number between tabs or blanks it is the decimal point.
    has_comma = re.search(r",(\s|$)|\s,", text) if has_tab else "," in text and not _has_decimal_commas(text)
    separator = ";" if ";" in text else "," if has_comma else "\t" if has_tab else ""
    cells = text.split(separator or None)
    if separator and '"' in text:
        with contextlib.suppress(csv.Error):
            cells = next(csv.reader([text], delimiter=separator))
    cells = [cell.strip(" \t\"'") for cell in cells]
    # Between commas, only a cell in quotation marks has one.
    numbers = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
    return Line(number, text, separator, numbers, numbers != cells)


def _has_decimal_commas(text: str) -> bool:
    """Return whether the cells between blanks, more than one, are numbers of which some have a decimal comma."""
    cells = text.split()
    numbers = [_number(cell) is not None or _DECIMAL_COMMA.fullmatch(cell) is not None for cell in cells]
    return len(cells) > 1 and all(numbers)


def _width(lines: Sequence[Line]) -> int:
    """Return the most common number of cells in lines that hold mostly numbers, 0 if there are none."""
    counts = Counter(len(line.cells) for line in lines[:_LINES_FOR_WIDTH] if _is_mostly_numbers(line))
    return counts.most_common(1)[0][0] if counts else 0


def _is_mostly_numbers(line: Line) -> bool:
    """Return whether more than half the cells are numbers or missing values, and not all of them missing."""
    numbers = sum(_number(cell) is not None for cell in line.cells)
    missing = sum(cell.lower() in MISSING for cell in line.cells) if numbers < len(line.cells) else 0
    return numbers > 0 and 2 * (numbers + missing) > len(line.cells)


def _is_row(line: Line) -> bool:
    """Return whether all cells are numbers or missing values, and not all of them missing."""
    return all(map(is_number_or_missing, line.cells)) and any(_number(cell) is not None for cell in line.cells)


def _find_heading(
    lines: Sequence[Line], comments: Sequence[Line], start: int, width: int, columns: Sequence[Column]
) -> tuple[list[str], int]:
    """Return the names in the heading and the index of the line below it; no names and `start` if there is none."""
    searched = 0
    for i, line in enumerate(lines[:start]):
        if (searched := searched + len(line.text)) > _LONGEST_HEAD:
            break
        names = line.heading(width)
        known = sum(parse_heading(name, columns) is not None for name in names)
        if (
            known > 1
            and (len(names) in (width, known) or not width)
            and not any(map(is_number_or_missing, filter(None, names)))
        ):
            return names, i + 1
    for line in comments:
        names = line.heading(width)
        if len(names) == width > 1 and sum(parse_heading(name, columns) is not None for name in names) > 1:
            below = sum(other.number < line.number for other in lines)
            if below <= start:
                return names, below
    return [], start


def _with_units(
    names: list[str], lines: Sequence[Line], start: int, columns: Sequence[Column]
) -> tuple[list[str], int]:
    """Return the names with the units in the line below them, and the first row's index."""
    cells = lines[start].cells if start < len(lines) else []
    if len(cells) != len(names) or all(map(is_number_or_missing, cells)):
        return names, start
    named = [(name, parse_heading(name, columns), cell) for name, cell in zip(names, cells, strict=True)]
    if not all(is_unit(cell, heading.column) for _, heading, cell in named if heading):
        return names, start
    full = [f"{name} [{cell}]" if heading and cell and not heading.unit else name for name, heading, cell in named]
    return full, start + 1


def _without_heading(
    path: str | PathLike[str],
    lines: Sequence[Line],
    start: int,
    width: int,
    columns: Sequence[Column],
    positional: bool,
) -> int:
    """Return the index of the first row in a file without heading; refuse unknown headings."""
    row = lines[start] if start < len(lines) else None
    for i, line in enumerate(lines[:start]):
        if _number(line.cells[0]) is not None and len(line.cells) == width:
            start = i
            break
        names = line.heading(width)
        if row is None or (len(names) == width and line.separator == row.separator):
            raise unknown_columns(path, names, columns)
    if not positional:
        raise unknown_columns(path, [], columns)
    if start < len(lines):
        logger.info("%s: no heading, read as %s", path, " and ".join(_with_first_unit(column) for column in columns))
    return start


def _values(
    path: str | PathLike[str], rows: Sequence[Line], names: Sequence[str], headings: Sequence[Heading | None]
) -> dict[str, FloatArray]:
    """Return the values of each column in its first unit, NaN where one is missing."""
    for line in rows:
        if len(line.cells) != len(headings):
            raise _invalid_line(path, line, names, headings, None)
    values = {}
    for i, heading in enumerate(headings):
        if heading is None:
            continue
        try:
            column = np.array([float(line.cells[i]) for line in rows], dtype=np.float64)
        except ValueError:
            column = np.full(len(rows), np.nan)
            for row, line in enumerate(rows):
                number = _number(line.cells[i])
                if number is not None:
                    column[row] = number
                elif not is_number_or_missing(line.cells[i]):
                    raise _invalid_line(path, line, names, headings, i) from None
        if heading.column.fill_values:
            column[np.isin(column, _FILL_VALUES)] = np.nan
        values[heading.column.name] = column * heading.factor
    return values


def _invalid_line(
    path: str | PathLike[str], line: Line, names: Sequence[str], headings: Sequence[Heading | None], column: int | None
) -> UserError:
    """Return the error for a line with a wrong number of cells, or with one in `column` that is no number."""
    where = f"{path}, line {line.number}"
    if not names:
        wanted = " and ".join(_with_first_unit(heading.column) for heading in headings if heading)
        return UserError(f"{where}: {' '.join(line.cells)!r} must be two numbers, {wanted}")
    if column is None:
        return UserError(f"{where} has {len(line.cells)} values but must have {len(names)}, one for each column")
    return UserError(f"{where}: {names[column]} = {line.cells[column]!r} must be a number")


def _with_first_unit(column: Column) -> str:
    """Return the name of a column with the unit that holds without a heading."""
    unit = next(iter(column.units), "")
    return f"{column.name} in {unit}" if unit.isalpha() else column.name


def _number(cell: str) -> float | None:
    """Return a cell as a number, or None."""
    try:
        return float(cell)
    except ValueError:
        return None


def is_number_or_missing(cell: str) -> bool:
    """Return whether a cell of a table is a number, or stands for a missing one."""
    return cell.lower() in MISSING or _number(cell) is not None


_LARGEST, _MOST_ROWS = 2**29, 10**7  #: Largest table [bytes], and most rows in it.
_HEAD = 2**16  #: Beginning of a table in which its heading and its separator are found [bytes].

#: Chooses table columns by the names in its heading, empty without one: their indices and meanings.
Choice = Callable[[list[str]], list[tuple[int, Heading]]]


class LongTable(NamedTuple):
    """Columns of numbers, in the order in which they were chosen."""

    values: FloatArray  #: As in the file, shape (rows, columns); NaN where one is missing.
    headings: list[Heading]
    path: Path
    first_line: int  #: Line number of the first row, counted from 1.

    def line(self, row: int) -> int:
        """Return a row's line number."""
        with open_file(self.path) as file:
            numbered = itertools.islice(enumerate(file, 1), self.first_line - 1, None)
            return next(itertools.islice((n for n, line in numbered if line.partition(b"#")[0].strip()), row, None))


def read_head(path: Path) -> str:
    """Return the first 64 KiB of a text, without a line that they cut.

    Raises `UserError` if the file cannot be read, or is larger than 512 MiB.
    """
    with open_file(path) as file:
        size, head = os.fstat(file.fileno()).st_size, file.read(_HEAD)
    if size > _LARGEST:
        raise UserError(f"{path} has {size / 2**20:.4g} MiB: a table may have {_LARGEST / 2**20:g} MiB")
    text = head.decode("utf-8-sig", "replace")
    return text if size <= _HEAD else text[: text.rfind("\n") + 1]


def read_long_table(
    path: Path, columns: Sequence[Column], others: Sequence[Column], choose: Choice, names: list[str]
) -> LongTable:
    """Read a table of numbers, with a heading or without.

    Cells are separated by semicolons, tabs, commas or blanks. Numbers have a decimal point or, unless commas separate,
    a decimal comma; they may stand in quotation marks. Comments follow a #; above the rows, they may begin with %, //
    or ! as well, and one of them may be the heading. Missing values are pandas' own, such as an empty cell or NA.

    Without a heading, the first columns are `columns`; these and `others` identify a line as a heading, unless `names`
    stand elsewhere. `choose` chooses columns by the names. Raises `UserError` if the file is no text in UTF-8, is
    larger than 512 MiB or has more than 10^7 rows, no row, other columns, or entries that are no numbers.
    """
    import pandas as pd

    names, rows = find_rows(path, read_head(path), columns, others, names)
    if not rows:
        raise UserError(f"{path} has no rows of numbers")
    chosen = choose(names)
    width, separator = len(rows[0].cells), rows[0].separator
    what = f"{path} is not a table of {', '.join(column.name for column in columns)}"
    named = width - (rows[0].cells[-1] == "" and width == len(names) + 1)  # a separator may end each row
    if width < 1 + max(i for i, _ in chosen) or (names and named != len(names)):
        raise UserError(f"{what}: line {rows[0].number} has {width} values, {' '.join(rows[0].cells)[:80]!r}")
    order = [i for i, _ in chosen]
    try:
        with open_file(path) as file:
            frame = pd.read_csv(
                file,
                sep=separator or r"\s+",
                decimal="," if any(row.has_decimal_commas for row in rows) else ".",
                header=None,
                index_col=False,
                skiprows=rows[0].number - 1,
                nrows=_MOST_ROWS + 1,
                comment="#",
                skipinitialspace=True,
                na_values=sorted({word.upper() for word in MISSING} | MISSING),
                dtype=dict.fromkeys(order, np.float64),
                low_memory=False,  # otherwise pandas warns about columns with numbers and words
                encoding="utf-8-sig",
            )
    except (ValueError, OverflowError) as error:  # pandas' errors are ValueErrors
        where = _faulty_line(path, rows[0].number, order, width) or " ".join(str(error).split())[:200]
        raise UserError(f"{what}: {where}") from error
    if len(frame) > _MOST_ROWS:
        raise UserError(f"{path} has more than {_MOST_ROWS} rows, the most of a table")
    return LongTable(frame[order].to_numpy(), [one for _, one in chosen], path, rows[0].number)


def _faulty_line(path: Path, first: int, order: Sequence[int], width: int) -> str:
    """Return the number and the text of the first line whose cells are too many, or no numbers in the columns `order`.

    An empty text, if there is none.
    """
    with open_file(path) as file:
        for number, text in itertools.islice(enumerate(file, 1), first - 1, None):
            line = split_line(number, text.decode("utf-8", "replace").partition("#")[0].strip())
            if len(line.cells) > width or not all(
                is_number_or_missing(line.cells[i]) for i in order if i < len(line.cells)
            ):
                return f"line {number} is {line.text[:80]!r}"
    return ""
