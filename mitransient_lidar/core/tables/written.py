"""Tables as printed lines, and as CSV files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from mitransient_lidar.core.files import replacing

if TYPE_CHECKING:
    import pandas as pd


def table_lines(columns: Sequence[tuple[str, str]], rows: Iterable[Iterable[Any]]) -> list[str]:
    """Return a table's heading and rows as lines.

    `columns`: heading and format of each, such as ``>10.2f``: side, width with the blanks before it, and digits.
    `rows`: numbers, or texts in their places; a row's cells may end before the heading's.
    """
    places = [re.sub(r"(?<=\d)[,.a-z%].*", "", form) for _, form in columns]

    def line(cells: Iterable[Any]) -> str:
        return "".join(
            format(cell, place if isinstance(cell, str) else form)
            for cell, (_, form), place in zip(cells, columns, places, strict=False)
        )

    return [line(head for head, _ in columns), *map(line, rows)]


def aligned_lines(rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> list[str]:
    """Return text rows as lines, two blanks between the columns; the columns number `right` are right-aligned."""
    rows = [*rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sides = [">" if number in right else "<" for number in range(len(widths))]
    return [
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)).rstrip()
        for row in rows
    ]


def write_csv(
    frames: pd.DataFrame | Iterator[pd.DataFrame],
    path: str | os.PathLike[str],
    digits: int | None = None,
    unknown: str = "",
) -> None:
    """Write or replace a CSV file: numbers of so many digits, or all, and a word for NaN; no index.

    Further frames add rows, under the columns of the first one. Raises `UserError` if the file cannot be written.
    """
    form = None if digits is None else f"%.{digits}g"
    columns = None
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        for frame in frames if isinstance(frames, Iterator) else [frames]:
            heading = columns is None
            columns = frame.columns if heading else columns
            frame.to_csv(
                file,
                columns=columns,
                header=heading,
                index=False,
                float_format=form,
                na_rep=unknown,
                lineterminator="\n",
            )
