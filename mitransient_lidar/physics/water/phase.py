"""Scattering phase functions of particles in water: closed forms, and those that Petzold measured.

All are normalised to 2 pi int_0^pi p(theta) sin(theta) dtheta = 1, in 1/sr. In formulas s = sin^2(theta/2), so that
cos(theta) = 1 - 2 s and the solid angle between two cones is 4 pi ds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import resources

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import ArrayLike, FloatArray, finite, in_range

PhaseFunction = Callable[[ArrayLike], FloatArray]
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

    def interpolated(angle: ArrayLike) -> FloatArray:
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


_SLOPE_RANGE = (3.0001, 4.9999)
"""Junge slopes mu in the one-parameter Fournier-Forand family."""

_BISECTIONS = 52
"""Halvings of this range that leave the rounding error."""


def fournier_forand(theta: ArrayLike, n: float, mu: float) -> FloatArray:
    """Fournier-Forand phase function.

    `theta`: scattering angle [rad], 0 to pi. `n`: real refractive index of the particles relative to water, above 1.
    `mu`: slope of the hyperbolic (Junge) size distribution, 3 < mu < 5.

    Result: phase function [1/sr], in the shape of `theta`; infinite at theta = 0.

    Fournier and Forand (1994), Ocean Optics XII, Proc. SPIE 2258, 194, in the form of Fournier and Jonasz (1999),
    Proc. SPIE 3761, 62. Near delta = 1 (theta about 10 degrees) both numerators vanish to second order and are replaced
    by binomial series in delta - 1.
    """
    nu, scale = _ff_shape(n, mu)
    s = _half_angle(theta)
    delta = s / scale
    back = 1 / scale  # delta at 180 degrees
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        power = delta**nu
        core = nu * (1 - delta) - (1 - power) + (delta * (1 - power) - nu * (1 - delta)) / s
        core = core / (1 - delta) ** 2
        near = np.abs(delta - 1) < 0.05
        eps = np.where(near, delta - 1, 0)
        core = np.where(near, _binomial_tail(nu, eps) - _binomial_tail(nu + 1, eps) / s, core)
        core = np.where(s > 0, core / (4 * np.pi * power), np.inf)
    # 3 cos^2(theta) - 1 with cos(theta) = 1 - 2 s
    tail = (1 - back**nu) * (3 * (1 - 2 * s) ** 2 - 1) / (16 * np.pi * (back - 1) * back**nu)
    return np.asarray(core + tail)


def fournier_forand_cdf(theta: ArrayLike, n: float, mu: float) -> FloatArray:
    """Fraction of light scattered by less than `theta` with a Fournier-Forand phase function.

    Returns cumulative fraction, 0 at 0 and 1 at pi. Fournier and Jonasz (1999), Proc. SPIE 3761, 62.

    `theta`: scattering angle [rad], 0 to pi. `n`, `mu`: as in `fournier_forand`.
    """
    nu, scale = _ff_shape(n, mu)
    s = _half_angle(theta)
    back = 1 / scale
    with np.errstate(divide="ignore", invalid="ignore"):
        log_delta = np.log(s / scale)
        core = (_power_ratio(nu + 1, log_delta) - s * _power_ratio(nu, log_delta)) * np.exp(-nu * log_delta)
    tail = (1 - back**nu) * (1 - 2 * s) * 4 * s * (1 - s) / (8 * (back - 1) * back**nu)
    return np.asarray(np.where(s > 0, core + tail, 0))


def fournier_forand_backscatter_ratio(n: float, mu: float) -> float:
    """Backscattered fraction bb/b of a Fournier-Forand phase function, in closed form (Fournier and Jonasz 1999)."""
    return float(1 - fournier_forand_cdf(np.pi / 2, n, mu))


def fournier_forand_parameters(backscatter_ratio: float) -> tuple[float, float]:
    """Index and slope of the Fournier-Forand phase function with a given bb/b.

    Raises UserError if no member of the family has this ratio.

    `backscatter_ratio`: bb/b, from 3.4e-8 to 0.4999, the range of slopes mu from 3.0001 to 4.9999.

    Returns `n`, `mu`: parameters for `fournier_forand`, on the line n = 1.01 + 0.1542 (mu - 3).

    The line comes from Mobley, Sundman and Boss (2002), Appl. Opt. 41, 1035, doi:10.1364/AO.41.001035.
    """

    def ratio(mu: float) -> float:
        return fournier_forand_backscatter_ratio(_ffbb_index(mu), mu)

    low, high = _SLOPE_RANGE
    wanted = in_range("backscatter_ratio", backscatter_ratio, ratio(low), ratio(high))
    # Bisection: scipy.optimize would take longer to import than the scene to load.
    for _ in range(_BISECTIONS):
        mu = 0.5 * (low + high)
        low, high = (mu, high) if ratio(mu) < wanted else (low, mu)
    return _ffbb_index(mu), mu


def henyey_greenstein_backscatter_ratio(g: float) -> float:
    """Backscattered fraction of a Henyey-Greenstein function: (1-g)/(2g) ((1+g)/sqrt(1+g^2) - 1), or 1/2 at g = 0."""
    if not -1 < finite("g", g) < 1:
        raise UserError(f"g = {g:g} must lie between -1 and 1, both excluded")
    root = np.hypot(1, g)
    # ((1+g) - root)/g = 2/((1+g) + root), which has no 0/0 at g = 0
    return float((1 - g) / (root * (1 + g + root)))


def petzold_average_particle() -> PhaseFunction:
    """Petzold's average-particle phase function as a function of angle [rad].

    Returns the function from angles [rad] to p [1/sr], normalised to 1. Between the tabulated angles ln p is linear in
    ln theta; below 0.1 degree p ~ theta^-1.346.

    Table 2 in Mobley et al. (1993), Appl. Opt. 32, 7484, doi:10.1364/AO.32.007484, derived from Petzold (1972), SIO
    Ref. 72-78. With this interpolation the raw table integrates to 0.9929, by which it is divided. The mean cosine is
    0.9241 and bb/b = 0.01826; linear interpolation of p, as in the paper, integrates to 1.0200 instead.
    """
    degrees, values = read_columns("petzold_average_particle.csv")
    return log_log_phase(degrees, values, power=-1.346)


def _half_angle(theta: ArrayLike) -> FloatArray:
    """Return s = sin^2(theta/2)."""
    return np.asarray(np.sin(np.asarray(theta, dtype=np.float64) / 2) ** 2)


def _ff_shape(n: float, mu: float) -> tuple[float, float]:
    """Return the exponent nu and the s at which delta = 1."""
    if not 3 < finite("mu", mu) < 5:
        raise UserError(f"mu = {mu:g} must lie between 3 and 5, both excluded")
    if not 1 < finite("n", n) < 1 + 2 / np.sqrt(3):
        raise UserError(f"n = {n:g} must be above 1 and below 2.15")
    return (3 - mu) / 2, 0.75 * (n - 1) ** 2


def _ffbb_index(mu: float) -> float:
    """Return the index on the line of Mobley, Sundman and Boss."""
    return 1.01 + 0.1542 * (mu - 3)


def _binomial_tail(a: float, eps: FloatArray) -> FloatArray:
    """((1 + eps)^a - 1 - a eps) / eps^2 as a series for abs(eps) < 0.05."""
    total = np.zeros_like(eps)
    for k in range(14, 1, -1):
        binomial = float(np.prod([(a - j) / (j + 1) for j in range(k)]))
        total = total * eps + binomial
    return total


def _power_ratio(a: float, log_delta: FloatArray) -> FloatArray:
    """(1 - delta^a) / (1 - delta), which tends to a at delta = 1."""
    return np.asarray(np.where(log_delta == 0, a, np.expm1(a * log_delta) / np.expm1(log_delta)))


PETZOLD_WATERS = {
    "clear": (0.114, 0.037),
    "coastal": (0.179, 0.219),
    "turbid": (0.366, 1.824),
    "autec_7": (0.082, 0.117),
    "autec_9": (0.122, 0.043),
    "haoce_5": (0.195, 0.275),
    "nuc_2200": (0.337, 1.583),
    "nuc_2240": (0.125, 1.205),
}
"""Absorption and scattering (a, b) [1/m] of Petzold's waters at 530 nm, including pure water."""


def petzold_water(name: str) -> PhaseFunction:
    """Phase function of one of Petzold's waters as a function of angle [rad].

    Returns the function from angles [rad], 0 to pi, to p [1/sr], normalised to 1; infinite at 0. Between the tabulated
    angles ln p is linear in ln theta. Below 0.1 degree the power law through the first two angles continues, with
    exponents from -1.19 to -1.60.

    Raises UserError if the name is unknown.

    `name`: ``clear`` (station AUTEC 8, Tongue of the Ocean, Bahamas), ``coastal`` (HAOCE 11, channel off Santa
    Catalina, California), ``turbid`` (NUC 2040, San Diego harbour), or another station: ``autec_7``, ``autec_9``,
    ``haoce_5`` (Avalon Cove, Catalina), ``nuc_2200`` or ``nuc_2240``.

    Petzold (1972), Volume scattering functions for selected ocean waters, Scripps Institution of Oceanography, SIO Ref.
    72-78, measured in green light (a 75 nm band about 514 nm). Molecules and particles were measured together: do not
    add scattering by sea water. There are no measurements below 0.17 degree, in the harbour below 0.09, where the
    report extrapolates with a power law.

    With this interpolation the tables of ``clear``, ``coastal`` and ``turbid`` integrate to 0.0372, 0.2189 and 1.820
    1/m. The report's own sums are 0.0373, 0.2193 and 1.824. Mean cosines are 0.871, 0.947 and 0.920, and bb/b is
    0.0442, 0.0134 and 0.0200.
    """
    if name not in PETZOLD_WATERS:
        raise UserError(f"name = {name!r} must be one of {', '.join(PETZOLD_WATERS)}")
    columns = read_columns("petzold_waters.csv")
    return log_log_phase(columns[0], columns[1 + list(PETZOLD_WATERS).index(name)])
