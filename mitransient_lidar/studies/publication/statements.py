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

from mitransient_lidar.core.files import replacing
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
    text = (resources.files(__package__) / "statements.csv").read_text("utf-8")
    return [
        _statement(row, found[row["measure"]]) for row in csv.DictReader(text.splitlines()) if row["figure"] == figure
    ]


def _statement(row: Mapping[str, str], found: Measured) -> Statement:
    """Return the statement in a table row."""
    texts = {name: text.format(**found.words) for name, text in row.items()}
    low, high = float(texts["low"]), float(texts["high"])
    return Statement(
        **{name: texts[name] for name in ("figure", "statement", "quantity", "published", "where", "places")},
        difference=texts["difference"],
        value=found.value,
        error=found.error,
        limits=(low, high),
        share=None if found.others is None else float(np.mean((found.others >= low) & (found.others <= high))),
    )


def write_statements(statements: Sequence[Statement], path: Path) -> None:
    """Write a CSV table of statements, in place of an existing file on success only."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(one.row() for one in statements)


def describe_statements(statements: Sequence[Statement]) -> list[str]:
    """Return the lines of a table: figure, whether it holds, value, error, published value, statement."""
    lines = [f"{'figure':<8}{'holds':<8}{'value':>10}{'error':>10}{'published':>18}  statement: quantity"]
    for one in statements:
        numbers = f"{one.value:>10.4g}{one.error:>10.2g}{one.published:>18}"
        lines.append(f"{one.figure:<8}{one.holds:<8}{numbers}  {one.statement}: {one.quantity}")
    return lines
