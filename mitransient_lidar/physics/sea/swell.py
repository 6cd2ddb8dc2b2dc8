"""Swell spectrum: long waves with nearly one length and direction, from a distant storm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray, finite, in_range, non_negative, positive
from mitransient_lidar.physics.sea.wave_spectrum import WaveSpectrum

_REACH = 6.0  # half width of the hump in standard deviations, which neglects 2e-9 of it


@dataclass(frozen=True)
class SwellSpectrum(WaveSpectrum):
    """Swell as a Gaussian hump in wavenumber and in direction."""

    #: Significant wave height [m], 0 to a fifteenth of the wavelength: steeper seas break (DNV-RP-C205; a single wave
    #: breaks at a seventh).
    height: float
    #: Mean wavelength [m], positive. In a realisation it is rounded to a fraction of the period, and swell more than
    #: twice as long as the period is missing.
    wavelength: float
    direction: float = 0.0  #: Mean travel direction [rad], counter-clockwise from +x.
    relative_bandwidth: float = 0.1  #: Standard deviation of the wavenumber over its mean [1], above 0 up to 0.3.
    directional_spread: float = 0.15  #: Standard deviation of the direction [rad], above 0 up to 0.6.

    def __post_init__(self) -> None:
        wavelength = positive("wavelength", self.wavelength)
        height = non_negative("height", self.height)
        if height > wavelength / 15:
            raise UserError(
                f"height = {height:g} must not exceed {wavelength / 15:.3g} m, a fifteenth of the wavelength (breaking)"
            )
        finite("direction", self.direction)
        in_range("relative_bandwidth", positive("relative_bandwidth", self.relative_bandwidth), 0, 0.3)
        in_range("directional_spread", positive("directional_spread", self.directional_spread), 0, 0.6)

    @property
    def peak_wavenumber(self) -> float:
        """Mean wavenumber [rad/m]."""
        return 2 * np.pi / self.wavelength

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """First and last wavenumber [rad/m] in the hump."""
        reach = _REACH * self.relative_bandwidth
        return self.peak_wavenumber * max(1 - reach, 1e-6), self.peak_wavenumber * (1 + reach)

    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        low, high = self.smooth_ranges
        width = self.relative_bandwidth * self.peak_wavenumber
        # Normalised over k > 0 only
        positive_part = 0.5 * (1 + math.erf(1 / (self.relative_bandwidth * math.sqrt(2))))
        scale = (self.height / 4) ** 2 / (positive_part * math.sqrt(2 * math.pi) * width)
        hump = scale * np.exp(-(((wavenumber - self.peak_wavenumber) / width) ** 2) / 2)
        return np.asarray(np.where((wavenumber > low) & (wavenumber < high), hump, 0))

    def spreading(self, k: npt.ArrayLike) -> FloatArray:
        """Anisotropy Delta [1], the same for all waves; see `WaveSpectrum.spreading`."""
        angle, weight = self._angles(2000)
        return np.full(np.shape(k), 2 * float(np.sum(weight * np.cos(2 * angle))))

    def directional(self, kx: npt.ArrayLike, ky: npt.ArrayLike) -> FloatArray:
        """Directional spectrum Psi [m^4] at wavenumber components [rad/m] that broadcast, equal for opposite waves."""
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        along = cos * np.asarray(kx) + sin * np.asarray(ky)
        across = cos * np.asarray(ky) - sin * np.asarray(kx)
        k = np.hypot(along, across)
        # On a frozen surface waves against the direction are the same.
        angle = np.arctan2(across, np.abs(along))
        sigma = self.directional_spread
        norm = math.sqrt(2 * math.pi) * sigma * math.erf(math.pi / (2 * math.sqrt(2) * sigma))
        density = 0.5 * np.exp(-((angle / sigma) ** 2) / 2) / norm
        return np.asarray(self.omnidirectional(k) * density / np.where(k > 0, k, 1.0))

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances [m^2] as of `WaveSpectrum.mode_variances`, integrated over cells for a narrow hump."""
        peak = self.peak_wavenumber
        width = self.relative_bandwidth * peak
        if dk <= min(width, self.directional_spread * peak):
            return np.asarray(self.directional(ix * dk, iy[:, None] * dk) * dk**2)
        # Each point of the hump is assigned to the nearest wave, which conserves the variance.
        angle, angle_weight = self._angles(self._count(self.directional_spread * peak, dk))
        count = self._count(width, dk)
        low, high = self.smooth_ranges
        k = low + (high - low) * (np.arange(count) + 0.5) / count
        hump = self.omnidirectional(k)
        hump *= (self.height / 4) ** 2 / hump.sum() if self.height > 0 else 0
        nearest_x = np.rint(k[:, None] * np.cos(angle + self.direction) / dk).astype(np.int64)
        nearest_y = np.rint(k[:, None] * np.sin(angle + self.direction) / dk).astype(np.int64)
        reach = int(max(np.abs(nearest_x).max(), np.abs(nearest_y).max()))
        side = 2 * reach + 1
        cell = (nearest_y + reach) * side + nearest_x + reach
        sums = np.bincount(cell.ravel(), np.outer(hump, angle_weight).ravel(), side**2).reshape(side, side)
        frozen = 0.5 * (sums + sums[::-1, ::-1])
        variances = frozen[np.clip(iy, -reach, reach)[:, None] + reach, np.clip(ix, -reach, reach) + reach]
        return np.where((np.abs(iy)[:, None] <= reach) & (np.abs(ix) <= reach), variances, 0)

    def _angles(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Angles from the direction [rad] and midpoint rule weights with unit sum."""
        reach = min(_REACH * self.directional_spread, np.pi / 2)
        angle = reach * ((2 * np.arange(count) + 1) / count - 1)
        weight = np.exp(-((angle / self.directional_spread) ** 2) / 2)
        return angle, weight / weight.sum()

    @staticmethod
    def _count(width: float, dk: float) -> int:
        """Points across a hump: at least 4 per standard deviation `width` [rad/m] and 32 per cell."""
        return math.ceil(2 * _REACH * max(4.0, 32 * width / dk))
