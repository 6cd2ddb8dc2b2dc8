"""Fit table: parameters, fitted waveforms, residuals, and sentences on what they do not determine."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.information.cramer_rao import Free
from mitransient_lidar.analysis.information.errors import Errors, refusal_of_unknown_noise
from mitransient_lidar.analysis.information.measured import Measured
from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.core.validation import FloatArray


class FittedSamples(NamedTuple):
    """Model samples at the end of a fit, each with the shape (pixel, time)."""

    mean: FloatArray  #: In the waveforms' unit.
    by_model: FloatArray  #: Variance by the model's Monte Carlo.
    noise: FloatArray | None  #: Waveform variance, None where it is unknown.
    weights: FloatArray  #: 1 over the standard deviation of the difference, 0 where a sample is not used.


def fit_table(
    found: Measured,
    free: Sequence[Free],
    values: Mapping[str, float],
    samples: FittedSamples,
    errors: Errors,
    units: Mapping[str, str],
    messages: Sequence[str],
) -> xr.Dataset:
    """Return a fit's parameters, waveforms and quality as `fits.WaveformFit.run` describes them, without its ending.

    Unknown noise is the residuals' noise: these are then divided by their own standard deviation, and the chi-squared
    is the expected one.
    """
    mean, by_model, noise, weights = samples
    names = list(values)
    residual = np.where(weights > 0, weights * (np.nan_to_num(found.values) - mean), np.nan)
    sentences = list(messages)
    if noise is None:
        # A sample's noise is independent of the next one's: it is left out of the unexplained part.
        shared = float(np.nansum(residual[:, 1:] * residual[:, :-1]))
        unexplained = max(shared, 0.0) / max(float(np.nansum(found.values[weights > 0] ** 2)), 1e-300)
        deviation = math.sqrt(errors.reduced) if errors.reduced > 0 else 1.0
        residual, errors = residual / deviation, replace(errors, chi_squared=errors.expected)
        refusal = refusal_of_unknown_noise(unexplained)
        sentences.append(
            "the errors of the waveforms are unknown: they are taken from the residuals, whose standard deviation is "
            f"{deviation:.3g}"
        )
    else:
        refusal = errors.refusal()
    sentences += [refusal] if refusal else []
    sentences += errors.messages(names, np.array(list(values.values())))
    stderr = np.full(mean.shape, np.nan) if noise is None else np.sqrt(noise)
    rows = {
        "measured": found.values,
        "measured_stderr": stderr,
        "fitted": mean,
        "fitted_stderr": np.sqrt(by_model),
        "residual": residual,
        "used": (weights > 0).astype(np.int8),
    }
    arrays = {name: found.labelled(array, name) for name, array in rows.items()}
    vectors = {
        "value": np.array(list(values.values())),
        "stderr": errors.stderr,
        "stderr_by_model": errors.by_model,
        "start": np.array([one.start for one in free]),
        "low": np.array([one.low for one in free]),
        "high": np.array([one.high for one in free]),
        "at_bound": errors.held.astype(np.int8),
    }
    matrices = {"covariance": errors.covariance, "correlation": errors.correlation}
    known = [units.get(name) or unit_of(re.sub(r"\[\d+\]$", "", name)) or "1" for name in names]
    return xr.Dataset(
        {
            **{name: ("parameter", vector) for name, vector in vectors.items()},
            **{name: (("parameter", "other_parameter"), matrix) for name, matrix in matrices.items()},
            **arrays,
        },
        {"parameter": names, "other_parameter": names, "parameter_units": ("parameter", known)},
        {
            "chi_squared": errors.chi_squared,
            "expected": errors.expected,
            "freedom": errors.freedom,
            "probability": math.nan if noise is None else errors.probability,
            "refused": int(bool(refusal)),
            "messages": sentences,
        },
    )
