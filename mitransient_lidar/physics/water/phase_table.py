"""Phase functions as power-law segments, evaluated and integrated in closed form, also from a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.tables.headings import Column
from mitransient_lidar.core.tables.text_tables import read_two_columns
from mitransient_lidar.core.validation import FloatArray, finite, finite_array, positive
from mitransient_lidar.physics.water.phase import (
    PhaseFunction,
    fournier_forand,
    fournier_forand_cdf,
    log_log_interpolation,
)

DEFAULT_LOG_S0 = float(np.log(1e-12))
DEFAULT_COUNT = 2048

#: Nodes in a function that is changed near 180 degrees, and the e^-1 width of the change there [rad].
_PEAK_COUNT, _PEAK_WIDTH = 16384, float(np.radians(6.0))


@dataclass(frozen=True, eq=False)
class PowerLawTable:
    """Phase function tabulated in s = sin^2(theta/2), a power of s between nodes.

    The nodes are uniform in ln s: ln s_i = log_s0 + i step for i = 0..N-1, and the last is s = 1 (180 degrees). Over
    all azimuths the solid angle is 4 pi ds, so 4 pi p is the probability density of s. On segment i, p = value_i
    (s/s_i)^-exponent_i; below s_0, p = value_0 (s/s_0)^-cap_exponent. Density, cumulative distribution and its inverse
    are closed forms of the same function, so that samples follow the density exactly.

    Forward peaks in natural water rise as a power of the angle over six decades. Uniform nodes in ln s resolve them,
    and a table in cos(theta) does not. The default, 2048 nodes from s = 1e-12 (theta = 2 microradian), has 51 nodes in
    the backward hemisphere, which spans only ln 2. There Fournier-Forand functions are interpolated to 2e-4. Narrow
    backward peaks need more nodes. With a weak backward Henyey-Greenstein lobe the error at 180 degrees is 3e-4 for g =
    0.3, 2e-3 for 0.5 and 2e-2 for 0.7, or 2e-3 for 0.7 with 8192 nodes.

    Build one with `from_function`, `from_values`, `fournier_forand` or `mixture`.
    """

    log_s0: float  #: ln s at the first node, negative.
    value: FloatArray  #: p at the nodes [1/sr], shape (N,).
    exponent: FloatArray  #: Power-law exponents of the segments; the last is 0 and unused, shape (N,).
    cdf: FloatArray  #: Probability below each node; cdf[0] belongs to the cap, and cdf[-1] = 1, shape (N,).
    cap_exponent: float  #: Exponent below s_0, less than 1.

    @classmethod
    def from_values(
        cls, values: npt.ArrayLike, log_s0: float = DEFAULT_LOG_S0, cap_probability: float | None = None
    ) -> PowerLawTable:
        """Build from p at the nodes, then normalise.

        Raises UserError if a value is not positive and finite, or the integral towards s = 0 diverges.

        `values`: p at nodes uniform in ln s from log_s0 to 0, in any common unit; positive; N at least 2, shape (N,).
        `log_s0`: ln s at the first node, negative. `cap_probability`: 4 pi int_0^s_0 p ds in the unit of `values`. By
        default the first segment's power law continues to s = 0.
        """
        p = finite_array("values", values)
        if p.ndim != 1 or p.size < 2:
            raise UserError(f"values of shape {p.shape} must be a list of at least 2 numbers")
        if np.any(p <= 0):
            raise UserError(f"values = {p.min():g} must be greater than 0 at every node")
        if finite("log_s0", log_s0) >= 0:
            raise UserError(f"log_s0 = {log_s0:g} must be negative")
        step = -log_s0 / (p.size - 1)
        s = np.exp(log_s0 + step * np.arange(p.size))
        exponent = np.append(-np.diff(np.log(p)) / step, 0.0)
        if cap_probability is None:
            # A peak that is flat except for rounding (Henyey-Greenstein) is finite at s = 0.
            cap_exponent = float(exponent[0]) if abs(exponent[0]) > 1e-6 else 0.0
            if cap_exponent >= 1:
                raise UserError(f"values rise as s^-{cap_exponent:g} towards s = 0 but the exponent must be below 1")
            cap = 4 * np.pi * p[0] * s[0] / (1 - cap_exponent)
        else:
            cap = finite("cap_probability", cap_probability)
            if cap <= 0:
                raise UserError(f"cap_probability = {cap:g} must be greater than 0")
            cap_exponent = float(1 - 4 * np.pi * p[0] * s[0] / cap)
        cdf = np.cumsum(np.concatenate(([cap], _segments(p, log_s0))))
        total = cdf[-1]
        return cls(float(log_s0), p / total, exponent, cdf / total, cap_exponent)

    @classmethod
    def from_function(
        cls,
        phase_function: PhaseFunction,
        count: int = DEFAULT_COUNT,
        log_s0: float = DEFAULT_LOG_S0,
        cap_probability: float | None = None,
    ) -> PowerLawTable:
        """Build from a function p(theta) [rad to 1/sr]; see `from_values`."""
        if count < 2:
            raise UserError(f"count = {count} must be at least 2")
        s = np.exp(finite("log_s0", log_s0) * np.linspace(1, 0, count))
        return cls.from_values(phase_function(_angle(s)), log_s0, cap_probability)

    @classmethod
    def fournier_forand(cls, n: float, mu: float, count: int = DEFAULT_COUNT) -> PowerLawTable:
        """Build a Fournier-Forand function, its cap taken from the closed-form cumulative distribution."""
        cap = fournier_forand_cdf(_angle(np.exp(DEFAULT_LOG_S0)), n, mu)
        return cls.from_function(lambda theta: fournier_forand(theta, n, mu), count, cap_probability=float(cap))

    @classmethod
    def mixture(cls, tables: Sequence[PowerLawTable], weights: npt.ArrayLike) -> PowerLawTable:
        """Build a weighted sum of phase functions.

        `tables`: the functions; the result has the nodes of the finest. `weights`: weights, such as scattering
        coefficients, at least 0 and not all 0.
        """
        factors = finite_array("weights", weights)
        if factors.shape != (len(tables),):
            raise UserError(f"weights of shape {factors.shape} must have one number for each of {len(tables)} tables")
        if np.any(factors < 0) or not np.any(factors > 0):
            raise UserError(f"weights = {factors.tolist()} must be at least 0, and not all of them 0")
        finest = max(tables, key=lambda table: table.count)
        s = finest._nodes()
        values = np.sum([factor * table.eval_s(s) for factor, table in zip(factors, tables, strict=True)], axis=0)
        below = [factor * table.cdf_s(s[0]) for factor, table in zip(factors, tables, strict=True)]
        return cls.from_values(values, finest.log_s0, float(np.sum(below)))

    def with_chi(self, chi: float) -> PowerLawTable:
        """Return the function with another value at 180 degrees and the same backscatter ratio.

        Between 90 and 180 degrees it is multiplied by A + B exp(-(1 - s)/w^2). Here 1 - s is about a quarter of the
        squared angle from 180 degrees, and 2 w is 6 degrees. At 170 degrees B counts by 6 %. Measured functions over
        their bb agree within 5 % from 90 to 170 degrees (Sullivan and Twardowski 2009, doi:10.1364/AO.48.006811).
        Nearer to 180 degrees they do not (Zhang et al. 2020, Appl. Opt. 59, C31). The ratio is kept within 0.05 % where
        the function has no peak of its own in the last 10 degrees.

        Raises UserError if A would be negative.

        `chi`: chi_p(pi) = (bb/b)/(2 pi p(pi)), greater than 0 (Boss and Pegau 2001, doi:10.1364/AO.40.005503).
        """
        count = max(self.count, _PEAK_COUNT)
        s = np.exp(self.log_s0 * np.linspace(1, 0, count))
        old = self.eval_s(s)
        backward = s > 0.5
        peak = np.exp(-(1 - s) / np.sin(_PEAK_WIDTH / 2) ** 2)
        ratio = self.backscatter_ratio
        # The fraction of the backscattering that has the peak's shape.
        in_peak, behind = (float(np.sum(_segments(p, self.log_s0)[backward[:-1]])) for p in (old * peak, old))
        in_peak /= behind
        wanted = ratio / (2 * np.pi * positive("chi", chi)) / old[-1]
        height = (wanted - 1) / (1 - in_peak)
        rest = 1 - height * in_peak
        if rest <= 0:
            least = ratio * in_peak / (2 * np.pi * old[-1])
            raise UserError(f"chi_p = {chi:g} makes the phase function negative: it must be greater than {least:.3g}")
        new = np.where(backward, old * (rest + height * peak), old)
        return self.from_values(new, self.log_s0, float(self.cdf_s(s[0])))

    @property
    def count(self) -> int:
        """Number of nodes N."""
        return int(self.value.size)

    @property
    def step(self) -> float:
        """Node spacing in ln s."""
        return -self.log_s0 / (self.count - 1)

    @property
    def mean_cosine(self) -> float:
        """Mean cosine g of the scattering angle."""
        s, m = self._nodes(), self.exponent[:-1]
        first_moment = np.sum(self.value[:-1] * s[:-1] ** 2 * self.step * _growth((2 - m) * self.step))
        first_moment += self.value[0] * s[0] ** 2 / (2 - self.cap_exponent)
        return float(1 - 2 * 4 * np.pi * first_moment)

    @property
    def backscatter_ratio(self) -> float:
        """Fraction scattered by more than 90 degrees."""
        return float(1 - self.cdf_s(0.5))

    def eval_s(self, s: npt.ArrayLike) -> FloatArray:
        """Phase function [1/sr] at s = sin^2(theta/2) in [0, 1]; 4 pi times this is the density of s."""
        i, offset, below = self._locate(s)
        slope = np.where(below, self.cap_exponent, self.exponent[i])
        with np.errstate(invalid="ignore"):
            return np.asarray(self.value[i] * np.where(slope == 0, 1, np.exp(-slope * offset)))

    def eval(self, theta: npt.ArrayLike) -> FloatArray:
        """Phase function [1/sr] at scattering angles `theta` [rad]."""
        return self.eval_s(np.sin(np.asarray(theta, dtype=np.float64) / 2) ** 2)

    def cdf_s(self, s: npt.ArrayLike) -> FloatArray:
        """Probability of scattering into [0, s]."""
        i, offset, below = self._locate(s)
        cap = self.cdf[0] * np.exp((1 - self.cap_exponent) * np.minimum(offset, 0))
        x = np.where(below, 0, offset)
        area = 4 * np.pi * self.value[i] * np.exp(self.log_s0 + i * self.step)
        inside = self.cdf[i] + area * x * _growth((1 - self.exponent[i]) * x)
        return np.asarray(np.where(below, cap, np.minimum(inside, 1)))

    def _nodes(self) -> FloatArray:
        """Return s at the nodes."""
        return np.asarray(np.exp(self.log_s0 + self.step * np.arange(self.count)))

    def _locate(self, s: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.bool_]]:
        """Return the segment, ln(s/s_i), and whether s lies in the cap."""
        with np.errstate(divide="ignore"):
            log_s = np.log(np.asarray(s, dtype=np.float64))
        finite_log = np.maximum(log_s, self.log_s0)
        i = np.clip(np.floor((finite_log - self.log_s0) / self.step).astype(np.intp), 0, self.count - 2)
        return i, log_s - (self.log_s0 + i * self.step), log_s < self.log_s0


def _segments(p: FloatArray, log_s0: float) -> FloatArray:
    """Return the integral over each segment of a phase function, a power of s between nodes uniform in ln s."""
    step = -log_s0 / (p.size - 1)
    s = np.exp(log_s0 + step * np.arange(p.size - 1))
    return np.asarray(4 * np.pi * p[:-1] * s * step * _growth(step + np.diff(np.log(p))))


def _growth(x: FloatArray) -> FloatArray:
    """Return (e^x - 1)/x, 1 at x = 0, which covers the logarithmic case of exponent 1."""
    return np.divide(np.expm1(x), x, out=np.ones_like(x), where=x != 0)


def _angle(s: npt.ArrayLike) -> FloatArray:
    """Return the scattering angle [rad]."""
    return np.asarray(2 * np.arcsin(np.sqrt(np.minimum(s, 1))))


_COUNT = 32768  #: Nodes of the fine table: 822 in the backward hemisphere, more than measurements have there.

_FEWEST_ANGLES = 10
_SMALLEST_LAST_DEG = 170.0

_DEGREES = {**dict.fromkeys(("degrees", "deg", "degree", "°"), 1.0), **dict.fromkeys(("rad", "radians"), 180 / np.pi)}
_ANGLE = Column("angle", ("theta", "scattering angle"), _DEGREES)
_VALUE = Column("value", ("p", "phase function", "beta", "beta tilde", "vsf", "volume scattering function"))


class PhaseOfFile(NamedTuple):
    """A phase function from a table."""

    table: PowerLawTable  #: The phase function, normalised to 1 over the sphere.
    integral: float  #: Integral of the given values over the sphere; 1 if they were normalised in 1/sr.


def read_phase_table(path: str | PathLike[str]) -> PhaseOfFile:
    """Read a phase function from a file.

    Returns the normalised phase function, and the integral by which the values were divided.

    Raises UserError if the file cannot be read or does not hold such a table (the message names the line), or if the
    values rise towards 0 so steeply that their integral diverges.

    `path`: text file with two columns, as `text_tables.read_table` reads it. Scattering angles are in degrees, or in
    rad if the heading states it. They increase within 0 to 180 degrees, with any spacing. At least 10 are needed, the
    last at 170 or more. The value is positive, in 1/sr or any other unit per solid angle (such as a volume scattering
    function).

    Between the angles ln p is linear in ln theta, as for `phase.petzold_average_particle`. Below the first angle the
    power law through the first two continues, or p is constant where the power law would decrease towards 0. If the
    first angle is 0, ln p is linear in theta^2 up to the second: flat at 0. Beyond the last angle p is constant. The
    result has 32768 nodes, 0.05 degree apart at 90 degrees but 0.4 at 165 and 3.3 at 180. Kinks are smoothed
    accordingly. A backward peak keeps its value at 180 degrees, but no shape narrower than 3 degrees.
    """
    theta, value = _read_columns(path)
    raw = _interpolation(path, theta, value)
    table = PowerLawTable.from_function(raw, _COUNT)
    return PhaseOfFile(table, float(raw(np.pi) / table.value[-1]))


def _interpolation(path: str | PathLike[str], theta: FloatArray, value: FloatArray) -> PhaseFunction:
    """Return the values as a function of the angle [rad], above 0."""
    positive, p = theta[theta > 0], value[theta > 0]
    log_theta, log_p = np.log(positive), np.log(p)
    power = float((log_p[1] - log_p[0]) / (log_theta[1] - log_theta[0]))
    if theta[0] == 0:
        # (p_0/p_1)^(1 - u^2) with u = theta/theta_1
        return log_log_interpolation(positive, p, lambda below: (np.log(value[0]) - log_p[0]) * -np.expm1(2 * below))
    if power <= -2:
        raise UserError(
            f"{path} rises as theta^{power:.3g} from {np.degrees(theta[1]):g} to {np.degrees(theta[0]):g} degrees, but"
            " the power must be above -2: its integral towards 0 would diverge"
        )
    return log_log_interpolation(positive, p, lambda below: min(power, 0.0) * below)


def _read_columns(path: str | PathLike[str]) -> tuple[FloatArray, FloatArray]:
    """Return angles [rad], shape (N,), and values, shape (N,)."""
    columns, lines, _ = read_two_columns(path, _ANGLE, _VALUE)
    angles, values = columns["angle"], columns["value"]
    last = None
    for number, angle, value in zip(lines, angles, values, strict=True):
        here = f"{path}, line {number}"
        if not 0 <= angle <= 180:
            raise UserError(f"{here}: angle = {angle:g} must lie between 0 and 180 degrees")
        if last is not None and angle <= last:
            raise UserError(f"{here}: angle = {angle:g} follows {last:g} but angles must increase")
        if not 0 < value < np.inf:
            raise UserError(f"{here}: value = {value:g} must be finite and greater than 0")
        last = angle
    if len(angles) < _FEWEST_ANGLES:
        raise UserError(f"{path} has {len(angles)} angles but must have at least {_FEWEST_ANGLES}")
    if angles[-1] < _SMALLEST_LAST_DEG:
        raise UserError(
            f"{path} ends at {angles[-1]:g} degrees but its last angle must be at least {_SMALLEST_LAST_DEG:g}"
        )
    return np.radians(angles), values
