"""Free parameters, and lower bounds of their standard deviations from a Fisher information matrix, if they exist."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import limits
from mitransient_lidar.core.validation import FloatArray, finite

SINGULAR = 1e-8  #: Eigenvalue of the unit-diagonal matrix below which parameters are indistinguishable.
CORRELATED = 0.999  #: Correlation between two estimates above which they are named.

_INVOLVED = 1e-3  # component of an eigenvector from which on a parameter belongs to it


class Bounds(NamedTuple):
    """Cramer-Rao bounds of unbiased estimates, in the parameters' units."""

    bound: FloatArray  #: Standard deviation with all parameters unknown, shape (parameter,); infinite without one.
    bound_known: FloatArray  #: With all other parameters known.
    correlation: FloatArray  #: Estimate correlation, shape (parameter, parameter); NaN without a bound.
    smallest: float  #: Smallest eigenvalue of the unit-diagonal matrix, for the parameters with information.
    remarks: list[str]  #: Sentences on parameters that the record does not determine, or not apart.


def bounds(information: FloatArray, names: Sequence[str]) -> Bounds:
    """Return the Cramer-Rao bounds from a Fisher information matrix, and remarks with the parameters' names.

    The matrix is symmetric; an estimate may have negative eigenvalues.

    Notes
    -----
    The square root of the inverse's diagonal (S. M. Kay, Fundamentals of Statistical Signal Processing, volume 1, 1993,
    equation 3.20). The matrix is scaled to unit diagonal before it is inverted, so that units do not matter. A
    parameter without information has an infinite bound. So have the parameters of an eigenvector whose eigenvalue is
    below `SINGULAR`, as only their other combinations are determined; negative eigenvalues come from render noise.
    """
    count = len(names)
    diagonal = np.diagonal(information)
    alive = diagonal > 0
    remarks = [f"{names[i]} has no influence on the record: no bound" for i in np.flatnonzero(~alive).tolist()]
    known = np.full(count, np.inf)
    known[alive] = diagonal[alive] ** -0.5
    bound, correlation = np.full(count, np.inf), np.full((count, count), np.nan)
    if not alive.any():
        return Bounds(bound, known, correlation, 0.0, remarks)
    scale = known[alive]
    values, vectors = np.linalg.eigh(information[np.ix_(alive, alive)] * np.outer(scale, scale))
    lost = values < SINGULAR
    for value, vector in zip(values[lost], vectors.T[lost], strict=True):
        involved = [names[i] for i in np.flatnonzero(alive)[np.abs(vector) > _INVOLVED].tolist()]
        if value > -SINGULAR:
            remarks.append(f"{_listed(involved)} cannot be told apart by the record: no bounds")
        else:
            remarks.append(
                f"the noise of the render hides what the record tells about {_listed(involved)} (eigenvalue "
                f"{value:.2g} of the scaled information): no bounds, render more passes"
            )
    inverse = (vectors[:, ~lost] / values[~lost]) @ vectors[:, ~lost].T
    determined = np.all(np.abs(vectors[:, lost]) <= _INVOLVED, axis=1)
    places = np.flatnonzero(alive)[determined].tolist()
    inverse = inverse[np.ix_(determined, determined)]
    relative = np.sqrt(np.diagonal(inverse))
    bound[places] = relative * scale[determined]
    correlation[np.ix_(places, places)] = np.clip(inverse / np.outer(relative, relative), -1, 1)
    for i, first in enumerate(places):
        for second in places[i + 1 :]:
            if abs(correlation[first, second]) > CORRELATED:
                remarks.append(
                    f"the estimates of {names[first]} and {names[second]} have a correlation of "
                    f"{correlation[first, second]:.6f}: the record hardly tells them apart"
                )
    return Bounds(bound, known, correlation, float(values[0]), remarks)


def _listed(names: Sequence[str]) -> str:
    """Return names as a phrase."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


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
