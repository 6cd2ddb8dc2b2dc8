"""Evaluation and sampling of phase functions given as a ``PowerLawTable``."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.transport.opaque import aligned

#: Exponents are kept this far from 1 when sampled; the density within a segment changes by 1e-5.
_SMALLEST_EXPONENT = 1e-3

_SMALLEST_S = 1e-14  #: s = sin^2(theta/2) of 2e-7 rad, below which float32 directions are the same.

#: Largest node spacing in ln s, change in ln p between nodes, and first node for which a series replaces logarithm and
#: exponential and the cap below the first node (2 microradian) is uniform: both are exact to float32.
_SHORT_STEP, _SMALL_CHANGE, _SMALL_CAP = 0.02, 0.2, 1.1e-12


class TabulatedPhase:
    """Evaluates and samples phase functions given as power laws in s = sin^2(theta/2).

    A segment is drawn by Walker's alias method (two look-ups for any table size), and s within it by its inverse power
    law. Samples are thus accurate in the forward peak.

    `tables`: phase functions, each normalised to 1 over the sphere, all with the same nodes. Lanes select theirs by
    number.
    """

    def __init__(self, *tables: PowerLawTable) -> None:
        self.table = tables[0]
        self.count = len(tables)
        self._log_s0 = float(self.table.log_s0)
        self._step = float(self.table.step)
        self._nodes = self.table.count
        self.has_short_tables = all(is_short(table) for table in tables)
        records = [_records(table, self.has_short_tables) for table in tables]
        # For each cell: threshold and alias, the power law for sampling, and for evaluation.
        self._choice, self._law, self._value = (
            aligned(mi.Float, np.concatenate([record[i] for record in records])) for i in range(3)
        )

    def eval(self, s: mi.Float, number: mi.UInt32 | int = 0) -> mi.Float:
        """Return a phase function [1/sr] at s = sin^2(theta/2)."""
        offset = dr.log(dr.maximum(s, _SMALLEST_S)) - self._log_s0
        # Clamped after conversion to an integer: inactive lanes may hold NaN.
        cell = dr.minimum(mi.UInt32(dr.maximum(offset * (1 / self._step), 0)), self._nodes - 2)
        cell = dr.select(offset < 0, self._nodes - 1, cell)
        exponent, log_value = dr.gather(mi.Vector2f, self._value, cell + number * self._nodes)
        start = dr.select(cell == self._nodes - 1, 0, mi.Float(cell) * self._step)
        return dr.exp(log_value - exponent * (offset - start))

    def sample(self, u: mi.Float, v: mi.Float, number: mi.UInt32 | int = 0) -> tuple[mi.Float, mi.Float]:
        """Map two uniform numbers to s = sin^2(theta/2) distributed as 4 pi times a phase function, and its value."""
        scaled = u * self._nodes
        cell = dr.minimum(mi.UInt32(scaled), self._nodes - 1)
        # The 24 bits of u leave 12 for the fraction: without more from v, improbable cells are drawn too often.
        fraction = scaled - mi.Float(cell) + v * (self._nodes * 2**-24)
        accept, alias = dr.gather(mi.Vector2f, self._choice, cell + number * self._nodes)
        cell = dr.select(fraction < accept, cell, mi.UInt32(alias))
        law = dr.gather(mi.Vector4f, self._law, cell + number * self._nodes)
        if self.has_short_tables:
            return _within_short_segment(law, v, self._step)
        start, value, growth, inverse_k = law
        # From the start of the cell s grows by `part` to the power of 1/k = 1/(1-m), and so p = s^-m by part/s.
        part = dr.maximum(dr.fma(v, growth, 1), 1e-30)
        beyond = dr.exp(dr.log(part) * inverse_k)
        return dr.minimum(start * beyond, 1), value * part / beyond


@dataclass(frozen=True)
class NumberedPhase:
    """Phase functions in a `TabulatedPhase`, one per lane, with the methods of Mitsuba's phase functions."""

    functions: TabulatedPhase
    number: mi.UInt32

    def eval_pdf(
        self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Return the phase function [1/sr] of a direction, as value and density."""
        value = self.functions.eval(half_angle(-mei.wi, wo), self.number)
        return mi.Spectrum(value), value

    def sample(
        self,
        ctx: mi.PhaseFunctionContext,
        mei: mi.MediumInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Vector3f, mi.Spectrum, mi.Float]:
        """Sample a direction distributed as the phase function."""
        s, value = self.functions.sample(sample1, sample2.x, self.number)
        wo = deflect(mi.Frame3f(-mei.wi), s, dr.two_pi * sample2.y)
        return wo, mi.Spectrum(1), value


def is_short(table: PowerLawTable) -> bool:
    """Return whether s and p change so little over each segment that a series can replace its power law."""
    change = float(np.abs(table.exponent[:-1]).max()) * table.step
    return table.step <= _SHORT_STEP and change <= _SMALL_CHANGE and np.exp(table.log_s0) <= _SMALL_CAP


def _within_short_segment(law: mi.Vector4f, v: mi.Float, step: float) -> tuple[mi.Float, mi.Float]:
    """Map a uniform number to s and p in a cell, given its start, its p there, k = 1 - m and whether it is the cap.

    ln s grows by y = ln(1 + v (e^x - 1)) / k with x = k step, here to the third power of x in units of the step.
    """
    start, value, k, cap = law
    x = k * step
    y = step * v * dr.fma(0.5 * x * (1 - v), dr.fma(x, (1 - 2 * v) * (1 / 3), 1), 1)
    z = (k - 1) * y
    beyond = dr.fma(y, dr.fma(y, dr.fma(y, 1 / 6, 1 / 2), 1), 1)
    fall = dr.fma(z, dr.fma(z, dr.fma(z, dr.fma(z, dr.fma(z, 1 / 120, 1 / 24), 1 / 6), 1 / 2), 1), 1)
    even = cap > 0
    return dr.minimum(start * dr.select(even, v, beyond), 1), value * dr.select(even, 1, fall)


def _records(table: PowerLawTable, short: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (threshold, alias), the sampled law, and (exponent, ln p) for each segment and, last, for the cap.

    The law is (s, p, k, whether it is the cap) of short segments, and (s, p, growth, 1/k) otherwise.
    """
    segments = table.count - 1
    start = np.exp(table.log_s0 + table.step * np.append(np.arange(segments), 0))
    choice = np.column_stack(_alias_table(np.append(np.diff(table.cdf), table.cdf[0])))
    if short:
        exponent = np.append(table.exponent[:segments], 0.0)
        value = np.append(table.value[:segments], table.cdf[0] / (4 * np.pi * start[0]))
        law = np.column_stack([start, value, 1 - exponent, np.arange(table.count) == segments])
        return choice, law, np.column_stack([exponent, np.log(value)])
    exponent = np.append(table.exponent[:segments], table.cap_exponent)
    k = 1 - exponent
    k = np.where(np.abs(k) < _SMALLEST_EXPONENT, _SMALLEST_EXPONENT, k)
    # Growth of s^k over a segment; the cap goes from s_0 down to 0, with growth -1.
    growth = np.append(np.expm1(k[:segments] * table.step), -1.0)
    value = np.append(table.value[:segments], table.value[0])
    return choice, np.column_stack([start, value, growth, 1 / k]), np.column_stack([exponent, np.log(value)])


def half_angle(first: mi.Vector3f, second: mi.Vector3f) -> mi.Float:
    """Return s = sin^2(theta/2) of the angle between two unit vectors, exact for tiny angles (1 - cosine is not)."""
    return dr.minimum(0.25 * dr.squared_norm(first - second), 1)


def deflect(frame: mi.Frame3f, s: mi.Float, azimuth: mi.Float) -> mi.Vector3f:
    """Return the direction at s = sin^2(theta/2) and an azimuth [rad] about the frame's z axis."""
    sin_theta = 2 * dr.sqrt(s * (1 - s))
    sin, cos = dr.sincos(azimuth)
    return frame.to_world(mi.Vector3f(sin_theta * cos, sin_theta * sin, dr.fma(-2, s, 1)))


def henyey_greenstein(cosine: mi.Float, g: float) -> mi.Float:
    """Return the Henyey-Greenstein function [1/sr] of the scattering angle's cosine."""
    base = 1 + g * g - 2 * g * cosine
    return (1 - g * g) / (4 * np.pi) * dr.rcp(base * dr.sqrt(base))


def sample_henyey_greenstein(u: mi.Float, g: float) -> mi.Float:
    """Map a uniform number to the cosine of a scattering angle distributed as the Henyey-Greenstein function."""
    if abs(g) < 1e-3:
        return 1 - 2 * u
    ratio = (1 - g * g) / (1 - g + 2 * g * u)
    return dr.clip((1 + g * g - ratio * ratio) / (2 * g), -1, 1)


def _alias_table(probability: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Walker's thresholds and aliases of a discrete distribution (Vose 1991, doi:10.1109/32.92917)."""
    count = len(probability)
    scaled = probability / probability.sum() * count
    alias = np.arange(count)
    small, large = list(np.flatnonzero(scaled < 1)), list(np.flatnonzero(scaled >= 1))
    while small and large:
        low, high = small.pop(), large[-1]
        alias[low] = high
        scaled[high] -= 1 - scaled[low]
        if scaled[high] < 1:
            small.append(large.pop())
    # Cells left by rounding are full.
    scaled[small + large] = 1.0
    return scaled, alias
