"""Petzold's three measured waters as phase functions, and the reading of tables that come with the package."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources

import numpy as np
import numpy.typing as npt

from .checks import FloatArray

PETZOLD_WATERS = {"clear": (0.114, 0.037), "coastal": (0.179, 0.219), "turbid": (0.366, 1.824)}
"""Absorption and scattering (a, b) [1/m] of Petzold's waters at 530 nm, the water's own included."""


def petzold_water(name: str) -> Callable[[npt.ArrayLike], FloatArray]:
    """Phase function of one of Petzold's waters as a function of the angle [rad].

    Parameters
    ----------
    name : str
        ``clear`` (Tongue of the Ocean, Bahamas), ``coastal`` (channel off Santa Catalina, California) or ``turbid``
        (San Diego harbour).

    Returns
    -------
    callable
        Maps angles [rad], 0 to pi, to p [1/sr], normalised to 1; infinite at 0. Between the tabulated angles ln p is
        linear in ln theta; below 0.1 degree p goes on with the power of the first two: -1.191, -1.546 and -1.338.

    Raises
    ------
    ValueError
        If the name is unknown.

    Notes
    -----
    Petzold (1972), Volume scattering functions for selected ocean waters, Scripps Institution of Oceanography, SIO Ref.
    72-78: stations AUTEC 8, HAOCE 11 and NUC 2040, seen in green light (a band of 75 nm about 514 nm). The water as a
    whole was measured, molecules and particles together: do not add the scattering of sea water. Below 0.17 degree, in
    the harbour below 0.09, nothing was measured, and the report goes on with a power law.

    Under this interpolation the tables integrate to 0.0372, 0.2189 and 1.820 1/m, the report's own sums being 0.0373,
    0.2193 and 1.824. Mean cosines are 0.871, 0.947 and 0.920, and bb/b is 0.0442, 0.0134 and 0.0200.
    """
    if name not in PETZOLD_WATERS:
        raise ValueError(f"name = {name!r} must be one of {', '.join(PETZOLD_WATERS)}")
    columns = read_columns("petzold_waters.csv")
    return log_log_phase(columns[0], columns[1 + list(PETZOLD_WATERS).index(name)])


def read_columns(filename: str) -> FloatArray:
    """Return the columns of a table that comes with this package, shape (columns, rows)."""
    text = resources.files("mitransient_lidar.optics").joinpath(filename).read_text("utf-8")
    return np.loadtxt(text.splitlines(), delimiter=",", unpack=True)


def log_log_phase(
    degrees: FloatArray, values: FloatArray, power: float | None = None
) -> Callable[[npt.ArrayLike], FloatArray]:
    """Interpolate a table so that ln p is linear in ln theta, and normalise it.

    Parameters
    ----------
    degrees : ndarray, shape (N,)
        Scattering angles [deg], increasing, the first above 0 and the last 180.
    values : ndarray, shape (N,)
        The phase function in any unit per solid angle, above 0.
    power : float, optional
        Below the first angle p ~ theta^power, above -2. By default the power between the first two angles.

    Returns
    -------
    callable
        Maps angles [rad] to p [1/sr].
    """
    log_theta, log_p = np.log(np.radians(degrees)), np.log(values)
    slope = (log_p[1] - log_p[0]) / (log_theta[1] - log_theta[0]) if power is None else power

    def raw(theta: npt.ArrayLike) -> FloatArray:
        with np.errstate(divide="ignore"):
            x = np.log(np.asarray(theta, dtype=np.float64))
        below = np.minimum(x - log_theta[0], 0)
        return np.asarray(np.exp(np.interp(x, log_theta, log_p) + slope * below))

    # Gauss-Legendre between the nodes in ln(theta), plus the power law's own integral below the first
    nodes, weights = np.polynomial.legendre.leggauss(8)
    half = np.diff(log_theta)[:, None] / 2
    theta = np.exp(log_theta[:-1, None] + half * (1 + nodes))
    total = np.sum(2 * np.pi * raw(theta) * np.sin(theta) * theta * weights * half)
    total += 2 * np.pi * values[0] * np.radians(degrees[0]) ** 2 / (2 + slope)
    return lambda angle: np.asarray(raw(angle) / total)
