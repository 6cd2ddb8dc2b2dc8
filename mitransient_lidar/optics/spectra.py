"""Directional wave spectra under one name, and those made of others: a sea of several, and one matched to slopes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, non_negative, positive
from .swell import SwellSpectrum
from .wave_spectrum import AxialSpectrum, CosineSpectrum, IntArray, TravellingWaves, WaveSpectrum
from .wave_table import TabulatedSpectrum
from .wind_seas import ElfouhailySpectrum, JonswapSpectrum, PiersonMoskowitzSpectrum, inverse_wave_age

__all__ = [
    "AxialSpectrum",
    "CosineSpectrum",
    "ElfouhailySpectrum",
    "JonswapSpectrum",
    "MatchedSpectrum",
    "PiersonMoskowitzSpectrum",
    "SeaState",
    "SwellSpectrum",
    "TabulatedSpectrum",
    "WaveSpectrum",
    "inverse_wave_age",
]

_LARGEST_SHARE = 0.75  # of the slope variance on one axis: that of the angular density cos^2(phi)/pi
_NO_WAVES = 1e-6  # a spectrum with so little of the wanted slope variance is not blown up but flat


@dataclass(frozen=True)
class SeaState(WaveSpectrum):
    """Sum of independent wave systems, each with its own direction of travel.

    Parameters
    ----------
    components : tuple of WaveSpectrum
        At least one. `direction` of the sea is that of the first, and so are the axes of its slope variances.

    Raises
    ------
    ValueError
        If there is no component, or one is not a spectrum.
    """

    components: tuple[WaveSpectrum, ...]
    direction: float = field(init=False)

    def __post_init__(self) -> None:
        components = tuple(self.components)
        if not components:
            raise ValueError("components must hold at least one spectrum")
        for component in components:
            if not isinstance(component, WaveSpectrum):
                raise ValueError(f"components holds {component!r} but every component must be a wave spectrum")
        object.__setattr__(self, "components", components)
        object.__setattr__(self, "direction", components[0].direction)

    @property
    def peak_wavenumber(self) -> float:
        """Peak wavenumber [rad/m] of the component with the highest waves."""
        return max(self.components, key=lambda component: component.elevation_variance()).peak_wavenumber

    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        return np.asarray(sum(component.omnidirectional(k) for component in self.components))

    def directional(self, kx: npt.ArrayLike, ky: npt.ArrayLike) -> FloatArray:
        """Directional spectrum Psi [m^4]; see `WaveSpectrum.directional`."""
        return np.asarray(sum(component.directional(kx, ky) for component in self.components))

    def elevation_variance(self) -> float:
        """Variance of the elevation [m^2]."""
        return sum(component.elevation_variance() for component in self.components)

    def slope_covariance(self, k_max: float = np.inf) -> FloatArray:
        """Covariance matrix [1] of the slopes in x and y, shape (2, 2), of waves up to `k_max` [rad/m], above 0."""
        return np.asarray(sum(component.slope_covariance(k_max) for component in self.components))

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances [m^2]; see `WaveSpectrum.mode_variances`."""
        return np.asarray(sum(component.mode_variances(ix, iy, dk) for component in self.components))

    def travelling_parts(self) -> tuple[TravellingWaves, ...]:
        """Return the parts of all components, in their order."""
        return tuple(part for component in self.components for part in component.travelling_parts())


@dataclass(frozen=True)
class MatchedSpectrum(CosineSpectrum):
    """Spectrum whose short waves are scaled until the slope variances of all waves are given ones.

    Whichever part of the waves a mesh resolves, what it resolves and what it leaves add up to the same total.

    Parameters
    ----------
    spectrum : CosineSpectrum
        Elfouhaily, Pierson-Moskowitz or JONSWAP. One with less than a millionth of the wanted variances, as in the
        lightest winds, is made flat.
    upwind, crosswind : float
        Slope variances [1] along and across the direction, not negative, such as those of Cox and Munk. Waves cannot
        spread them by more than a factor of 3 (cos^2 about the direction): beyond it, as with Cox and Munk below
        0.4 m/s, the larger is missed, never exceeded.
    k_from : float
        Waves with wavenumbers [rad/m] above this are scaled, positive. Where the others alone have too much slope
        variance, or of a ratio that no scaling mends, it is lowered by tenths; below the longest wave all are scaled.

    Attributes
    ----------
    scaled_from : float
        The wavenumber above which waves are scaled [rad/m].
    scales : tuple of float
        Factors along and across the direction [1].

    Raises
    ------
    ValueError
        If a parameter lies outside its range.

    Notes
    -----
    With the shares 1/2 +- Delta/4 of the slope variance k^2 S, factors s_u and s_c give
    S' = S (s_u (1/2 + Delta/4) + s_c (1/2 - Delta/4)) and Delta' = 2 (s_u (1/2 + Delta/4) - s_c (1/2 - Delta/4)) S/S',
    clipped to |Delta'| <= 1 so that no wave has a negative density; s_u and s_c are found with the clipping.
    """

    spectrum: CosineSpectrum
    upwind: float
    crosswind: float
    k_from: float = 2 * np.pi
    direction: float = field(init=False)
    scaled_from: float = field(init=False)
    scales: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.spectrum, CosineSpectrum):
            raise ValueError(f"spectrum = {self.spectrum!r} must be one of wind waves")
        upwind, crosswind = non_negative("upwind", self.upwind), non_negative("crosswind", self.crosswind)
        k_from = positive("k_from", self.k_from)
        object.__setattr__(self, "direction", self.spectrum.direction)
        scales = None
        ratio = _LARGEST_SHARE / (1 - _LARGEST_SHARE)
        target = min(upwind, ratio * crosswind), min(crosswind, ratio * upwind)
        while scales is None:
            object.__setattr__(self, "scaled_from", k_from)
            scales = self._find_scales(*target)
            k_from *= 0.9
        object.__setattr__(self, "scales", scales)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber of the unscaled spectrum's peak [rad/m]."""
        return self.spectrum.peak_wavenumber

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """Wavenumbers [rad/m] of the unscaled spectrum, and the step at `scaled_from`."""
        ranges = self.spectrum.smooth_ranges
        if ranges and ranges[0] < self.scaled_from < ranges[-1]:
            ranges = tuple(sorted({*ranges, self.scaled_from}))
        return ranges

    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S'(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        density = self.spectrum.omnidirectional(wavenumber)
        up, cross = self._shares(np.where(wavenumber > 0, wavenumber, 1.0))
        return np.where(
            wavenumber > self.scaled_from, density * (self.scales[0] * up + self.scales[1] * cross), density
        )

    def spreading(self, k: npt.ArrayLike) -> FloatArray:
        """Upwind-crosswind ratio Delta'(k) [1], -1 to 1; see `AxialSpectrum.spreading`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        up, cross = self._shares(wavenumber)
        share = _upwind_share(self.scales[0] * up, self.scales[1] * cross)
        return np.where(wavenumber > self.scaled_from, 4 * share - 2, 4 * up - 2)

    def _shares(self, k: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shares of the unscaled slope variance up- and crosswind."""
        up = 0.5 + self.spectrum.spreading(k) / 4
        return up, 1 - up

    def _find_scales(self, upwind: float, crosswind: float) -> tuple[float, float] | None:
        """Factors that give the total slope variances, or None where no factors for waves above `scaled_from` do."""
        k, weight = self.quadrature()
        curvature = self.spectrum.omnidirectional(k) * k**2 * weight
        up, cross = (curvature * share for share in self._shares(k))
        short = k > self.scaled_from
        left_up, left_cross = upwind - up[~short].sum(), crosswind - cross[~short].sum()
        if curvature.sum() <= _NO_WAVES * (upwind + crosswind) or min(upwind, crosswind) == 0:
            object.__setattr__(self, "scaled_from", 0.0)
            return 0.0, 0.0
        all_scaled = not np.any(curvature[~short] > 0)
        smallest = (1 - _LARGEST_SHARE) / _LARGEST_SHARE
        if not all_scaled and not (left_up > smallest * left_cross and left_cross > smallest * left_up):
            return None
        up, cross = up[short], cross[short]
        scale_up, scale_cross = left_up / up.sum(), left_cross / cross.sum()
        # Exact at once where nothing is clipped; clipped waves keep a fixed share, and the others make up for it.
        for _ in range(1000):
            total = scale_up * up + scale_cross * cross
            share = _upwind_share(scale_up * up, scale_cross * cross)
            change_up, change_cross = left_up / np.sum(total * share), left_cross / np.sum(total * (1 - share))
            scale_up, scale_cross = float(scale_up * change_up), float(scale_cross * change_cross)
            if max(abs(change_up - 1), abs(change_cross - 1)) < 1e-13:
                break
        return scale_up, scale_cross


def _upwind_share(up: FloatArray, cross: FloatArray) -> FloatArray:
    """Upwind share of slope variances, within what an angular density that is nowhere negative can have."""
    total = up + cross
    share = np.divide(up, total, out=np.full_like(total, 0.5), where=total > 0)
    return np.clip(share, 1 - _LARGEST_SHARE, _LARGEST_SHARE)
