"""Dr.Jit side of tabulated phase functions: evaluation and sampling of a ``PowerLawTable``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitransient_lidar.optics.phase_table import PowerLawTable

#: Exponents closer to 1 than this are sampled as if this far: the density within a segment changes by 1e-5.
_SMALLEST_EXPONENT = 1e-3

#: s = sin^2(theta/2) of 2e-7 rad, below which float32 directions are the same.
_SMALLEST_S = 1e-14


class TabulatedPhase:
    """Evaluates and samples a phase function given as power laws in s = sin^2(theta/2).

    A segment is picked by Walker's alias method (two look-ups, whatever the size of the table), and s within it by the
    closed-form inverse of its power law, so that samples keep their accuracy in the forward peak.

    Parameters
    ----------
    table
        The phase function, normalised to 1 over the sphere.
    """

    def __init__(self, table: PowerLawTable) -> None:
        self.table = table
        segments = table.count - 1
        k = 1 - np.append(table.exponent[:segments], table.cap_exponent)
        k = np.where(np.abs(k) < _SMALLEST_EXPONENT, _SMALLEST_EXPONENT, k)
        accept, alias = _alias_table(np.append(np.diff(table.cdf), table.cdf[0]))
        self._log_s0 = float(table.log_s0)
        self._step = float(table.step)
        self._segments = segments
        self._log_value = mi.Float(np.log(table.value))
        self._exponent = mi.Float(table.exponent)
        self._k = mi.Float(k)
        # Growth of s^(1-m) over a segment; the cap begins at s = 0, from which log(v) / k follows with growth -1.
        self._growth = mi.Float(np.append(np.expm1(k[:segments] * table.step), -1.0))
        self._accept = mi.Float(accept)
        self._alias = mi.UInt32(alias)
        self._log_value_cap = float(np.log(table.value[0]))
        self._cap_exponent = float(table.cap_exponent)

    def eval(self, s: mi.Float) -> mi.Float:
        """Return the phase function [1/sr] at s = sin^2(theta/2)."""
        offset = dr.log(dr.maximum(s, _SMALLEST_S)) - self._log_s0
        # Bounded as an integer: lanes that do not ask may hold anything, NaN included.
        index = dr.minimum(mi.UInt32(dr.maximum(offset * (1 / self._step), 0)), self._segments - 1)
        log_value = dr.gather(mi.Float, self._log_value, index)
        exponent = dr.gather(mi.Float, self._exponent, index)
        inside = log_value - exponent * (offset - mi.Float(index) * self._step)
        return dr.exp(dr.select(offset < 0, self._log_value_cap - self._cap_exponent * offset, inside))

    def sample(self, u: mi.Float, v: mi.Float) -> mi.Float:
        """Map two uniform numbers to s = sin^2(theta/2) distributed as 4 pi times the phase function."""
        cells = self._segments + 1
        scaled = u * cells
        index = dr.minimum(mi.UInt32(scaled), self._segments)
        # The 24 bits of u leave 12 for the fraction: without more from v, improbable cells are drawn too often.
        fraction = scaled - mi.Float(index) + v * (cells * 2**-24)
        rejected = fraction >= dr.gather(mi.Float, self._accept, index)
        index = dr.gather(mi.UInt32, self._alias, index, rejected) | dr.select(rejected, 0, index)
        k = dr.gather(mi.Float, self._k, index)
        growth = dr.gather(mi.Float, self._growth, index)
        start = dr.select(index == self._segments, self._log_s0, self._log_s0 + mi.Float(index) * self._step)
        return dr.minimum(dr.exp(start + dr.log(dr.maximum(dr.fma(v, growth, 1), 1e-30)) / k), 1)


def half_angle(first: mi.Vector3f, second: mi.Vector3f) -> mi.Float:
    """Return s = sin^2(theta/2) of the angle between two unit vectors, exact for tiny angles (1 - cosine is not)."""
    return dr.minimum(0.25 * dr.squared_norm(first - second), 1)


def deflect(frame: mi.Frame3f, s: mi.Float, azimuth: mi.Float) -> mi.Vector3f:
    """Return the direction at s = sin^2(theta/2) and an azimuth [rad] about the frame's z axis."""
    sin_theta = 2 * dr.sqrt(s * (1 - s))
    sin, cos = dr.sincos(azimuth)
    return frame.to_world(mi.Vector3f(sin_theta * cos, sin_theta * sin, dr.fma(-2, s, 1)))


def henyey_greenstein(cosine: mi.Float, g: float) -> mi.Float:
    """Return the Henyey-Greenstein function [1/sr] of the cosine of the scattering angle."""
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
    # Whatever rounding leaves over is a full cell.
    scaled[small + large] = 1.0
    return scaled, alias
