"""Statements in the publication, each with a measured quantity, its error, and whether it holds.

Their table, `statements.csv`, has the published value, the limits between which a statement holds, and texts in which
names in braces stand for words about the measured quantity.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mitransient_lidar.analysis.information.errors import jackknife_error
from mitransient_lidar.core.tables.written import table_lines, write_csv
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.studies.shots import highest_of

#: Column names in the written table.
COLUMNS = (
    *("figure", "statement", "quantity", "published", "value", "standard_error", "holds", "share", "where"),
    "difference",
)

_MARGIN = 2.0  #: Standard errors within which a quantity at a limit may lie on either side.


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


_FIRST, _LAST = 0.1, 0.9  #: Shares of an echo's height between which its rise is measured.

#: Distance of a change from its expected time, and lag of the differences that give its curvature [ns].
_REACH_NS, _LAG_NS = 9.0, 1.0


@dataclass(frozen=True)
class Waveform:
    """Power [W] in the pixels, shape (pixel, time), at times [ns], and its parts by light origin."""

    time: FloatArray
    power: FloatArray
    parts: dict[str, FloatArray] = field(default_factory=dict)

    def inside(self, gate: tuple[float, float]) -> FloatArray:
        """Return the mean power [W] of the pixels in a gate [ns], shape (pixel,)."""
        return np.asarray(self.power[:, self._bins(gate)].mean(axis=1))

    def highest(self, gate: tuple[float, float], origin: str = "") -> tuple[FloatArray, FloatArray]:
        """Return height [W] and time [ns] of each pixel's highest point in a gate [ns], as `highest_points`."""
        power = self.parts[origin] if origin else self.power
        return highest_of(self.time, power, np.flatnonzero(self._bins(gate)))

    def total(self) -> Waveform:
        """Return the waveform of all pixels together."""
        parts = {name: part.sum(axis=0, keepdims=True) for name, part in self.parts.items()}
        return Waveform(self.time, self.power.sum(axis=0, keepdims=True), parts)

    def _bins(self, gate: tuple[float, float]) -> FloatArray:
        return np.asarray((self.time >= gate[0]) & (self.time <= gate[1]))


@dataclass(frozen=True)
class Series:
    """Power [W], shape (shot, pixel, time), in renders with independent random numbers at one or several locations."""

    time: FloatArray
    power: FloatArray
    parts: dict[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.power)

    def __getitem__(self, shot: int) -> Waveform:
        return self._mean(np.arange(len(self)) == shot)

    def mean(self) -> Waveform:
        """Return the mean over the shots."""
        return self._mean(np.full(len(self), True))

    def without(self, shot: int) -> Waveform:
        """Return the mean over the other shots."""
        return self._mean(np.arange(len(self)) != shot)

    def each(self, measure: Callable[[Waveform], float]) -> FloatArray:
        """Return a measure for each shot, shape (shot,)."""
        return np.array([measure(self[shot]) for shot in range(len(self))])

    def _mean(self, chosen: FloatArray) -> Waveform:
        parts = {name: part[chosen].mean(axis=0) for name, part in self.parts.items()}
        return Waveform(self.time, self.power[chosen].mean(axis=0), parts)


def estimate(measure: Callable[..., float], *series: Series) -> tuple[float, float]:
    """Return a measure of the series' means, and its standard error by the jackknife over the shots in each.

    The series are independent.
    """
    means = [one.mean() for one in series]
    variance = 0.0
    for number, one in enumerate(series):
        left_out = [measure(*means[:number], one.without(shot), *means[number + 1 :]) for shot in range(len(one))]
        variance += jackknife_error(np.array(left_out)) ** 2
    return float(measure(*means)), float(np.sqrt(variance))


def crossing(time: FloatArray, values: FloatArray, level: float) -> float:
    """Return the first time at which values rise through a level, by linear interpolation; NaN without one."""
    above = np.flatnonzero((values[:-1] < level) & (values[1:] >= level))
    if len(above) == 0:
        return float("nan")
    first = above[0]
    share = (level - values[first]) / (values[first + 1] - values[first])
    return float(time[first] + share * (time[first + 1] - time[first]))


def rise_time(waveform: Waveform, pixel: int, gate: tuple[float, float]) -> float:
    """Return the time from 10 to 90 % of a pixel's highest point in a gate [ns], on its leading edge."""
    height, top = (values[pixel] for values in waveform.highest(gate))
    rising = (waveform.time >= gate[0]) & (waveform.time <= top)
    time, power = waveform.time[rising], waveform.power[pixel, rising]
    return crossing(time, power, _LAST * height) - crossing(time, power, _FIRST * height)


def half_width(waveform: Waveform, pixel: int, gate: tuple[float, float]) -> float:
    """Return the full width at half of a pixel's highest point in a gate [ns]."""
    height, top = (values[pixel] for values in waveform.highest(gate))
    inside = (waveform.time >= gate[0]) & (waveform.time <= gate[1])
    before, after = inside & (waveform.time <= top), inside & (waveform.time >= top)
    first = crossing(-waveform.time[before][::-1], -waveform.power[pixel, before][::-1], -0.5 * height)
    last = crossing(waveform.time[after], -waveform.power[pixel, after], -0.5 * height)
    return last + first  # the first one has the opposite sign


def decay(waveform: Waveform, gate: tuple[float, float]) -> tuple[float, float]:
    """Return the rate of an exponential fitted to the power of all pixels in a gate [1/ns], and the rms residual [1].

    The fit uses least squares in the logarithm, and the residual is logarithmic.
    """
    inside = (waveform.time >= gate[0]) & (waveform.time <= gate[1])
    time, logarithm = waveform.time[inside], np.log(waveform.power.sum(axis=0)[inside])
    line = np.polyfit(time, logarithm, 1)
    return float(-line[0]), float(np.sqrt(np.mean((logarithm - np.polyval(line, time)) ** 2)))


def change(waveform: Waveform, pixel: int, middle: float) -> tuple[float, float]:
    """Return start and stop of a fall to a slower decay [ns], in a pixel's waveform; NaN beside the expected time.

    The start is where the decay steepens fastest, the stop where it flattens fastest: the extremes of the logarithmic
    power's second derivative. A small step that a Gaussian smears has them one standard deviation before and after its
    middle; an exponential adds nothing. The expected time `middle` [ns] is known to 9 ns.
    """
    time = waveform.time
    lag = max(1, round(_LAG_NS / (time[1] - time[0])))
    near = np.flatnonzero(np.abs(time - middle) <= _REACH_NS)
    near = near[(near >= lag) & (near < len(time) - lag)]
    power = waveform.power[pixel, near[0] - lag : near[-1] + lag + 1]
    if np.any(power <= 0):
        return float("nan"), float("nan")
    logarithm = np.log(power)
    curvature = logarithm[2 * lag :] - 2 * logarithm[lag:-lag] + logarithm[: -2 * lag]
    bins = np.arange(1, len(near) - 1)
    stop = highest_of(time[near], curvature[None], bins)[1][0]
    before = bins[time[near][bins] < stop] if np.isfinite(stop) else bins
    start = highest_of(time[near], -curvature[None], before)[1][0] if len(before) > 2 else float("nan")
    return float(start), float(stop)


def duration(waveform: Waveform, pixel: int, middle: float) -> float:
    """Return the time from the start to the stop of a `change` [ns]."""
    start, stop = change(waveform, pixel, middle)
    return stop - start


def far_after_near(waveform: Waveform, gate: tuple[float, float], origin: str = "") -> float:
    """Return the delay of the far pixels' mean highest point after the near pixels' [ns]."""
    times = waveform.highest(gate, origin)[1]
    return float(times[:2].mean() - times[2:].mean())


def near_share(waveform: Waveform) -> float:
    """Return the share of blue and black in the energy that the target reflects."""
    energy = waveform.parts["target"].sum(axis=1)
    return float(energy[2:].sum() / energy.sum())
