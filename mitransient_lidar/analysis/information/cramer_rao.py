"""Lower bounds of standard deviations from a Fisher information matrix, and parameters that have none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.validation import FloatArray

#: Eigenvalue of the unit-diagonal matrix below which parameters are indistinguishable.
SINGULAR = 1e-8
#: Correlation between two estimates above which they are named.
CORRELATED = 0.999

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
