"""Number tables that come with the package, and log-log interpolation of phase functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import resources

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray

PhaseFunction = Callable[[npt.ArrayLike], FloatArray]
"""Function from scattering angles [rad] to the phase function [1/sr]."""


@cache
def read_columns(filename: str) -> FloatArray:
    """Return the columns of a CSV file in this folder, shape (columns, rows), read-only."""
    text = resources.files("mitransient_lidar.physics.water").joinpath(filename).read_text("utf-8")
    columns = np.loadtxt(text.splitlines(), delimiter=",", unpack=True)
    columns.flags.writeable = False
    return columns


def log_log_interpolation(
    theta: FloatArray, values: FloatArray, extrapolation: Callable[[FloatArray], FloatArray]
) -> PhaseFunction:
    """Interpolate positive values so that ln p is linear in ln theta.

    `theta`: angles [rad], increasing, above 0, shape (N,). `values`: values, above 0, shape (N,). `extrapolation`:
    change in ln p below the first angle, as a function of ln(theta/theta[0]).
    """
    log_theta, log_p = np.log(theta), np.log(values)

    def interpolated(angle: npt.ArrayLike) -> FloatArray:
        with np.errstate(divide="ignore"):
            x = np.log(np.asarray(angle, dtype=np.float64))
        below = extrapolation(np.minimum(x - log_theta[0], 0))
        return np.asarray(np.exp(np.interp(x, log_theta, log_p) + below))

    return interpolated


def log_log_phase(degrees: FloatArray, values: FloatArray, power: float | None = None) -> PhaseFunction:
    """Interpolate a table so that ln p is linear in ln theta, and normalise it.

    `degrees`: scattering angles [deg], increasing, the first above 0 and the last 180, shape (N,). `values`: the phase
    function in any unit per solid angle, above 0, shape (N,). `power`: below the first angle p ~ theta^power, above -2.
    By default the power between the first two angles.
    """
    log_theta, log_p = np.log(np.radians(degrees)), np.log(values)
    slope = (log_p[1] - log_p[0]) / (log_theta[1] - log_theta[0]) if power is None else power
    raw = log_log_interpolation(np.radians(degrees), values, lambda below: slope * below)

    # Gauss-Legendre between the nodes in ln(theta), plus the power law's own integral below the first
    nodes, weights = np.polynomial.legendre.leggauss(8)
    half = np.diff(log_theta)[:, None] / 2
    theta = np.exp(log_theta[:-1, None] + half * (1 + nodes))
    total = np.sum(2 * np.pi * raw(theta) * np.sin(theta) * theta * weights * half)
    total += 2 * np.pi * values[0] * np.radians(degrees[0]) ** 2 / (2 + slope)
    return lambda angle: np.asarray(raw(angle) / total)
