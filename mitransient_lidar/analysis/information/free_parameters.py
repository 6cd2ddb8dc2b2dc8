"""Free parameters in a fit: starts, bounds, and the fitted numbers in place of their values."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import limits
from mitransient_lidar.core.validation import finite

SCALE, TIME_OFFSET = "scale", "time_offset_ns"


@dataclass(frozen=True)
class Free:
    """Free parameter: start, and lowest and highest value; fitted as its logarithm where it is positive."""

    name: str
    start: float
    low: float
    high: float

    @property
    def is_logarithm(self) -> bool:
        """Whether the parameter is positive, so that its logarithm is fitted and steps are relative."""
        return self.low >= 0 and self.start > 0

    def internal(self, value: float) -> float:
        """Return the fitted number for a value: 1 for starts, so that a first step may change all by their size."""
        if not self.is_logarithm:
            return value
        return 1 + math.log(value / self.start) if value > 0 else -math.inf

    def is_bound(self, value: float) -> bool:
        """Return whether a value is one of the bounds within a fit's accuracy."""
        return any(abs(value - end) <= max(1e-3 * abs(end), 1e-6 * abs(self.start)) for end in self._finite_ends)

    @property
    def _finite_ends(self) -> list[float]:
        return [end for end in (self.low, self.high) if math.isfinite(end)]

    def value(self, internal: float) -> float:
        """Return the value of a fitted number."""
        return self.start * math.exp(internal - 1) if self.is_logarithm else internal


def free_parameters(starts: Mapping[str, float], bounds: Mapping[str, tuple[float, float]] | None = None) -> list[Free]:
    """Return free parameters with their bounds, by default the ranges of their names.

    Raises `UserError` if bounds belong to no free parameter or do not increase, or a start is not between them.
    """
    given = dict(bounds or {})
    found = []
    for name, start in starts.items():
        base = re.sub(r"\[\d+\]$", "", name)
        usual = limits(base) or (-math.inf, math.inf)
        low, high = given.pop(name, (0.0, math.inf) if name == SCALE else usual)
        if not low < high:
            raise UserError(f"bounds of {name} = {low:g}, {high:g} must increase")
        if not low <= finite(f"start of {name}", start) <= high:
            raise UserError(f"start of {name} = {start:g} must lie between {low:g} and {high:g}")
        found.append(Free(name, float(start), float(low), float(high)))
    if given:
        raise UserError(f"bounds of {next(iter(given))}: it is not one of the free parameters {', '.join(starts)}")
    return found
