"""Onset of the column signal after the surface: mean focusing by waves, and absorption."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.water.seawater import WAVELENGTH_RANGE, water_absorption, water_scattering
from mitransient_lidar.results.geometry import Attributes

_STEP, _BEFORE, _BEHIND = 0.02, 8.0, 64.0  # spacing and range of times in tables, in standard deviations of the blur
_SIGMAS = 24  # blurs of a table, up to the largest one
_SMALLEST = 0.01  # blur of a table over the largest one
_TYPICAL = 0.03  # rate of decay of a column in the green that is too short for a fit [1/ns]
_SHORT = 2.0  # widths of an echo in units of the column's decay from which on the column is part of the echo
_CLEAREST = 1e-3  # backscattering coefficient of the clearest sea water at 532 nm, that of its molecules [1/m]
_TURBID = 0.02  # that of turbid water in the near infrared [1/m]


@dataclass(frozen=True)
class Focusing:
    """Mean enhancement of echoes from the water by waves, as a result states it; see `double_passage`.

    Depths [m], ascending from 0, and factors [1], 1 at the surface: linear between them, constant below.
    """

    depths: FloatArray
    factors: FloatArray

    @classmethod
    def from_attributes(cls, attributes: Attributes) -> Focusing | None:
        """Read ``wave_focusing_depths`` [m] and ``wave_focusing`` of a result; None without them.

        Raises `UserError` if they are not lists of as many positive numbers, with ascending depths.
        """
        if "wave_focusing" not in attributes:
            return None
        lists = (attributes.get(name) for name in ("wave_focusing_depths", "wave_focusing"))
        try:
            depths, factors = (np.atleast_1d(np.asarray(one, dtype=np.float64)) for one in lists)
        except (TypeError, ValueError):
            raise UserError("wave_focusing and wave_focusing_depths must be lists of numbers") from None
        if depths.shape != factors.shape or depths.ndim != 1 or not (np.isfinite(depths) & (factors > 0)).all():
            raise UserError("wave_focusing and wave_focusing_depths must be lists of as many positive numbers")
        if depths[0] <= 0 or np.any(np.diff(depths) <= 0):
            raise UserError("wave_focusing_depths must be positive and ascending")
        return cls(np.append(0.0, depths), np.append(1.0, factors))

    def at(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the factor at depths below the surface [m]; 1 above it."""
        return np.asarray(np.interp(np.asarray(depth, dtype=np.float64), self.depths, self.factors))


@dataclass(frozen=True)
class Fading:
    """How a column's signal fades by pure-water absorption alone, as in the near infrared."""

    rate: float  #: Least rate of decay [1/ns].
    clearest: float  #: Backscattering coefficient of the clearest sea water [1/m].
    opaque: bool  #: Whether a column has faded within an echo of its surface.

    @classmethod
    def of(cls, wavelength_nm: float, metres_per_ns: float, echo_fwhm_ns: float) -> Fading:
        """Return the fading at a wavelength, for a path in the water per time [m/ns] and a width of echoes [ns]."""
        wavelength = float(np.clip(wavelength_nm, *WAVELENGTH_RANGE))
        rate = 2 * metres_per_ns * float(water_absorption(wavelength))
        opaque = rate * echo_fwhm_ns > _SHORT
        return cls(rate, 0.5 * float(water_scattering(wavelength)) if opaque else _CLEAREST, opaque)

    @property
    def typical_rate(self) -> float:
        """Typical rate of decay [1/ns]."""
        return max(self.rate, _TYPICAL)

    def delay(self, energy: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the light of an opaque column delays an echo that includes it, and its standard deviation [ns].

        The column's share of the light is uniformly distributed between clearest water and turbid water that
        backscatters 0.02 1/m. The column is as late as it decays on average.

        `energy`: that of the echo [unit of the record times s]. `column`: signal of the column at the surface per
        backscattering coefficient [unit m], 0 where it is not known.
        """
        if not self.opaque:
            return np.zeros(energy.shape), np.zeros(energy.shape)
        per_backscattering = np.nan_to_num(1e-9 * column / (self.rate * np.where(energy > 0, energy, np.nan)))
        known = per_backscattering > 0
        least, most = (np.minimum(per_backscattering * one, 1.0) for one in (self.clearest, _TURBID))
        most = np.where(known, most, 1.0)
        return 0.5 * (least + most) / self.rate, (most - least) / (np.sqrt(12) * self.rate)


@dataclass(frozen=True)
class ColumnOnset:
    """Signal F(u) of a column from u = 0 on, blurred by a Gaussian: F = 1, or the focusing of light by waves."""

    largest_sigma: float = 1.0  #: Largest standard deviation of the blur [ns].
    #: Times from the surface [ns], and F at them, linear between them.
    times: FloatArray = field(default_factory=lambda: np.zeros(1))
    factors: FloatArray = field(default_factory=lambda: np.ones(1))
    _tables: list[FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tables", self._tabulated() if self.times.size > 1 else [])

    @classmethod
    def of(cls, focusing: Focusing | None, depth_per_ns: float, largest_sigma: float) -> ColumnOnset:
        """Return the onset of a column with a focusing, if any, and the depth per time [m/ns]."""
        if focusing is None:
            return cls()
        return _tabulated(largest_sigma, tuple(focusing.depths / depth_per_ns), tuple(focusing.factors))

    @property
    def brightest_ns(self) -> float:
        """Time from the surface of the largest F [ns]."""
        return float(self.times[np.argmax(self.factors)])

    def at(self, time_ns: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the signal at times from the surface, blurred by standard deviations, and two derivatives by time.

        The derivative by the standard deviation is this times the second derivative by time.
        """
        z = time_ns / sigma
        if not self._tables:
            from scipy.special import ndtr

            first = np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * sigma)
            return ndtr(z), first, -z / sigma * first
        size, length = self._tables[0].shape
        row = np.clip(np.log(sigma / (_SMALLEST * self.largest_sigma)) / self._log_step, 0, size - 1.001)
        place = np.clip((z + _BEFORE) / _STEP, 0, length - 1.001)
        low, left = row.astype(np.intp), place.astype(np.intp)
        down, right = row - low, place - left
        corner = low * length + left
        near, far = (1 - down) * (1 - right), (1 - down) * right
        below, beyond = down * (1 - right), down * right
        value, first, second = (
            near * flat[corner]
            + far * flat[corner + 1]
            + below * flat[corner + length]
            + beyond * flat[corner + length + 1]
            for flat in (table.ravel() for table in self._tables)
        )
        return value, first / sigma, second / sigma**2

    @property
    def _log_step(self) -> float:
        """Distance of the logarithms of the blurs of tables."""
        return float(-np.log(_SMALLEST) / (_SIGMAS - 1))

    def _tabulated(self) -> list[FloatArray]:
        """Return the signal and its derivatives by time over the blur, shape (blurs, times)."""
        from scipy.special import ndtr

        sigma = _SMALLEST * self.largest_sigma * np.exp(self._log_step * np.arange(_SIGMAS))[:, np.newaxis]
        z = np.arange(-_BEFORE, _BEHIND, _STEP)
        density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
        value, first, second = (np.tile(one, (_SIGMAS, 1)) for one in (ndtr(z), density, -z * density))
        slopes = np.append(np.diff(self.factors) / np.diff(self.times), 0.0)
        # A bend of F is a ramp, whose blurred form has the distribution function as its derivative.
        for time, bend in zip(self.times, np.diff(slopes, prepend=0.0), strict=True):
            from_bend = z - time / sigma
            passed, density = ndtr(from_bend), np.exp(-0.5 * from_bend**2) / np.sqrt(2 * np.pi)
            value += bend * sigma * (from_bend * passed + density)
            first += bend * sigma * passed
            second += bend * sigma * density
        return [value, first, second]


@functools.lru_cache(maxsize=8)
def _tabulated(largest_sigma: float, times: tuple[float, ...], factors: tuple[float, ...]) -> ColumnOnset:
    """Return an onset whose tables serve all records of a focusing."""
    return ColumnOnset(largest_sigma, np.array(times), np.array(factors))
