"""Jackknife estimates of standard errors (Efron and Stein 1981, doi:10.1214/aos/1176345462)."""

from __future__ import annotations

import math

import numpy as np

from mitransient_lidar.core.validation import FloatArray


def jackknife_error(values: FloatArray) -> float:
    """Return an estimate's standard error from its values without each of the groups, shape (groups,)."""
    count = len(values)
    return math.sqrt((count - 1) / count * float(np.sum((values - values.mean()) ** 2)))
