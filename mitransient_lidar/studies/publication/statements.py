"""Statements in the publication, each with a measured quantity, its error, and whether it holds.

Their table, `statements.csv`, has the published value, the limits between which a statement holds, and texts in which
names in braces stand for words about the measured quantity.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mitransient_lidar.core.tables.written import table_lines, write_csv
from mitransient_lidar.core.validation import FloatArray

#: Column names in the written table.
COLUMNS = (
    *("figure", "statement", "quantity", "published", "value", "standard_error", "holds", "share", "where"),
    "difference",
)

#: Standard errors within which a quantity at a limit may lie on either side.
_MARGIN = 2.0


class Measured(NamedTuple):
    """Quantity in a statement: value, standard error, values at other locations if any, and words for its texts."""

    value: float
    error: float = 0.0
    others: FloatArray | None = None
    words: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Statement:
    """A statement in the publication, reworded, and the measured quantity."""

    #: Name of the figure, the statement, and the measured quantity with its unit.
    figure: str
    statement: str
    quantity: str
    published: str  #: Published value, empty without a number.
    #: Measured value and its standard error.
    value: float
    error: float
    limits: tuple[float, float]  #: Interval of the values for which the statement holds.
    where: str  #: Measure, place and mesh.
    share: float | None = None  #: Share of other locations for which it holds, None if no location was chosen.
    places: str = ""  #: Description of these locations.
    difference: str = ""  #: Reason for a difference from the publication.

    @property
    def holds(self) -> str:
        """``yes`` within the limits, and at half of the other locations or more; ``no``; ``partly`` between these.

        Partly is a value within the limits that holds at fewer locations, one outside that holds at half of them, and
        one that is less than two standard errors outside.
        """
        low, high = self.limits
        common = self.share is None or self.share >= 0.5
        if low <= self.value <= high:
            return "yes" if common else "partly"
        outside = max(low - self.value, self.value - high)
        near = outside <= _MARGIN * self.error or (self.share is not None and common)
        return "partly" if near and math.isfinite(self.value) else "no"

    def row(self) -> list[str]:
        """Return the column texts."""
        share = "" if self.share is None else f"{self.share:.2f}"
        where = (
            self.where if self.share is None else f"{self.where}; holds at {100 * self.share:.0f} % of {self.places}"
        )
        numbers = f"{self.value:.4g}", f"{self.error:.2g}"
        return [
            *(self.figure, self.statement, self.quantity, self.published, *numbers, self.holds, share, where),
            self.difference,
        ]


def statements_of(figure: str, found: Mapping[str, Measured]) -> list[Statement]:
    """Return a figure's statements in table order, with the found quantities by name."""
    table = (resources.files(__package__) / "statements.csv").read_text("utf-8")
    statements = []
    for row in csv.DictReader(table.splitlines()):
        if row["figure"] == figure:
            value, error, others, words = found[row["measure"]]
            texts = {name: text.format(**words) for name, text in row.items() if name != "measure"}
            low, high = float(texts.pop("low")), float(texts.pop("high"))
            share = None if others is None else float(np.mean((others >= low) & (others <= high)))
            statements.append(Statement(value=value, error=error, limits=(low, high), share=share, **texts))
    return statements


def write_statements(statements: Sequence[Statement], path: Path) -> None:
    """Write a CSV table of statements, in place of an existing file on success only."""
    import pandas as pd

    write_csv(pd.DataFrame([one.row() for one in statements], columns=COLUMNS), path)


def describe_statements(statements: Sequence[Statement]) -> list[str]:
    """Return the lines of a table: figure, whether it holds, value, error, published value, statement."""
    columns = (("figure", "<8"), ("holds", "<8"), ("value", ">10.4g"), ("error", ">10.2g"), ("published", ">18"))
    rows = [(one.figure, one.holds, one.value, one.error, one.published) for one in statements]
    texts = ["  statement: quantity", *(f"  {one.statement}: {one.quantity}" for one in statements)]
    return [line + text for line, text in zip(table_lines(columns, rows), texts, strict=True)]
