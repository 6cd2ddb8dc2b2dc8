"""Reading of tables with up to ten million rows through pandas: survey points and trajectories."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.files import open_file
from mitransient_lidar.core.tables.headings import Column, Heading
from mitransient_lidar.core.tables.text_tables import MISSING, find_rows, is_number_or_missing, split_line
from mitransient_lidar.core.validation import FloatArray

#: Largest table [bytes], and most rows in it.
_LARGEST, _MOST_ROWS = 2**29, 10**7

#: Beginning of a table in which its heading and its separator are found [bytes].
_HEAD = 2**16

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
