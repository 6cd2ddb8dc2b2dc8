"""Transmission of one gate of a gated receiver against time."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.headings import UNITLESS, Column
from mitransient_lidar.core.text_tables import read_time_samples
from mitransient_lidar.core.validation import FloatArray, in_range, non_negative, positive, time_samples
from mitransient_lidar.physics.piecewise_linear import first_crossing, integral

#: Full length of a raised-cosine edge over its 10-90 % time: sin^2 passes 0.1 and 0.9 at 0.2048 and 0.7952 of it.
_EDGE_PER_RISE = float(np.pi / (np.pi - 2 * np.arccos(0.8)))

#: Relative tolerance of the sum of half edges against the width, for rounded decimals.
_ROUNDING = 1e-9

_TRANSMISSION = Column("transmission", ("transmittance", "gate", "gain", "value"), UNITLESS)


@dataclass(frozen=True, eq=False)
class GateShape:
    """Transmission of a gate whose rising edge is half open at t = 0.

    Build one with `edges`, `sampled` or `from_file`.

    Parameters
    ----------
    width_ns : float
        Time between the half heights of the two edges [ns].
    rise_ns, fall_ns : float
        Times from 10 to 90 % of the rising edge and from 90 to 10 % of the falling one [ns].
    times_ns, values : ndarray, shape (S,)
        Samples of a measured gate, linear between them and 0 outside; empty for a gate with raised-cosine edges.

    Notes
    -----
    An edge of full length L is sin^2(pi u / (2 L)) for 0 <= u <= L, half open in its middle: smooth, of finite length,
    and with an integral in closed form, R(t) = (u - L/pi sin(pi u/L)) / 2 for u = t + L/2. A gate is the difference of
    two such edges, its integral the difference of theirs. Edges of 0 ns are sharp; the gate is then half open as bins
    are, [0, width).
    """

    width_ns: float
    rise_ns: float
    fall_ns: float
    times_ns: FloatArray
    values: FloatArray

    @classmethod
    def edges(cls, width_ns: float, rise_ns: float = 0.0, fall_ns: float = 0.0) -> GateShape:
        """Gate with raised-cosine edges.

        Parameters
        ----------
        width_ns : float
            Time between half heights [ns], greater than 0.
        rise_ns, fall_ns : float
            10-90 % times of the edges [ns], at least 0; the gate must reach 1 between them:
            rise_ns + fall_ns at most 1.18 width_ns.
        """
        width = positive("width_ns", width_ns)
        rise, fall = non_negative("rise_ns", rise_ns), non_negative("fall_ns", fall_ns)
        longest = 2 * width / _EDGE_PER_RISE
        if rise + fall > longest * (1 + _ROUNDING):
            raise UserError(
                f"rise_ns = {rise:g} and fall_ns = {fall:g} must add up to at most {longest:g} ns for a gate of "
                f"width_ns = {width:g} to open fully"
            )
        return cls(width, rise, fall, np.zeros(0), np.zeros(0))

    @classmethod
    def sampled(cls, times_ns: npt.ArrayLike, transmission: npt.ArrayLike) -> GateShape:
        """Measured gate; its width and edge times follow from the samples.

        Parameters
        ----------
        times_ns : array_like, shape (S,)
            Strictly increasing times [ns], at least 2. They are shifted so that the transmission first reaches half its
            maximum at 0.
        transmission : array_like, shape (S,)
            Transmission, 0 to 1, not all 0.
        """
        t, g = time_samples(times_ns, "transmission", transmission)
        for extreme in (g.min(), g.max()):
            in_range("transmission", extreme, 0, 1)
        if g.max() == 0:
            raise UserError("transmission must be greater than 0 somewhere")
        half = g.max() / 2
        opens, closes = first_crossing(t, g, half), -first_crossing(-t[::-1], g[::-1], half)
        if closes <= opens:
            raise UserError("transmission must stay above half its maximum for some time")
        rise = first_crossing(t, g, 1.8 * half) - first_crossing(t, g, 0.2 * half)
        fall = first_crossing(-t[::-1], g[::-1], 1.8 * half) - first_crossing(-t[::-1], g[::-1], 0.2 * half)
        return cls(float(closes - opens), float(rise), float(fall), t - opens, g)

    @classmethod
    def from_file(cls, path: str | PathLike[str]) -> GateShape:
        """Read a measured gate, times and transmissions as for `sampled`, from a text file.

        The columns are those of `core.text_tables.read_time_samples`; a transmission may be in %.
        """
        return cls.sampled(*read_time_samples(path, _TRANSMISSION))

    @property
    def span_ns(self) -> tuple[float, float]:
        """First and last time at which the transmission is above 0 [ns]."""
        if self.times_ns.size:
            return float(self.times_ns[0]), float(self.times_ns[-1])
        return -0.5 * _EDGE_PER_RISE * self.rise_ns, self.width_ns + 0.5 * _EDGE_PER_RISE * self.fall_ns

    def transmission(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Transmission, 0 to 1, at the times `t_ns` [ns] after the half height of the rising edge."""
        t = np.asarray(t_ns, dtype=np.float64)
        if self.times_ns.size:
            return np.asarray(np.interp(t, self.times_ns, self.values, left=0.0, right=0.0))
        return np.asarray(_edge(t, self.rise_ns) - _edge(t - self.width_ns, self.fall_ns))

    def open_time(self, t_ns: npt.ArrayLike) -> FloatArray:
        """Integral of the transmission [ns] up to the times `t_ns` [ns] after the half height of the rising edge."""
        t = np.asarray(t_ns, dtype=np.float64)
        if self.times_ns.size:
            return integral(self.times_ns, self.values, t)
        return np.asarray(_edge_integral(t, self.rise_ns) - _edge_integral(t - self.width_ns, self.fall_ns))


def _edge(t: FloatArray, rise: float) -> FloatArray:
    """Edge from 0 to 1, half open at t = 0."""
    length = _EDGE_PER_RISE * rise
    if length == 0:
        return np.asarray(np.where(t >= 0, 1.0, 0.0))
    return np.asarray(np.sin(0.5 * np.pi * np.clip(t / length + 0.5, 0, 1)) ** 2)


def _edge_integral(t: FloatArray, rise: float) -> FloatArray:
    """Integral of `_edge` up to t."""
    length = _EDGE_PER_RISE * rise
    if length == 0:
        return np.maximum(t, 0)
    u = np.clip(t / length + 0.5, 0, 1)
    return np.asarray(0.5 * length * (u - np.sin(np.pi * u) / np.pi) + np.maximum(t - 0.5 * length, 0))
