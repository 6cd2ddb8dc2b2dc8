"""Directional wave spectra: systems of waves, their sums, and wind waves matched to given slope variances.

A spectrum Psi(kx, ky) [m^4] is the variance density of a frozen surface: Psi(k) = Psi(-k), and its integral over the
plane is the elevation variance. Psi does not contain the travel direction: waves travel towards the half plane of their
system's direction. Wind and waves travel towards the stated directions, in rad counter-clockwise from +x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import ArrayLike, FloatArray, IntArray, non_negative, positive

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""

SLOWEST_WAVENUMBER = 370.0
"""Wavenumber of the slowest gravity-capillary wave [rad/m], which defines the surface tension."""

_LARGEST_FRACTION = 0.75  # of the slope variance on one axis: by the angular density cos^2(phi)/pi
_NO_WAVES = 1e-6  # fraction of the given slope variance below which a spectrum is made flat instead of scaled


def phase_speed(k: ArrayLike) -> FloatArray:
    """Phase speed [m/s] of gravity-capillary waves with wavenumber `k` [rad/m], positive, in deep water."""
    wavenumber = np.asarray(k, dtype=np.float64)
    return np.asarray(np.sqrt(GRAVITY / wavenumber * (1 + (wavenumber / SLOWEST_WAVENUMBER) ** 2)))


def variances_along(covariance: FloatArray, direction: float) -> tuple[float, float]:
    """Slope variances along and across a `direction` [rad] from the covariance matrix in x and y, shape (2, 2)."""
    axis = np.array([np.cos(direction), np.sin(direction)])
    along = float(axis @ covariance @ axis)
    return along, float(np.trace(covariance)) - along


class WaveSpectrum(ABC):
    """Waves of one system, symmetric about its direction: integrals depend only on S(k) and the spreading Delta(k).

    A wave of wavenumber k travels along k if k . direction > 0, else against it.
    """

    direction: float

    @property
    @abstractmethod
    def peak_wavenumber(self) -> float:
        """Wavenumber of the spectral peak [rad/m]; infinite for a flat sea."""

    @abstractmethod
    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S [m^3] at wavenumbers `k` [rad/m], 0 at k <= 0.

        Its integral over k > 0 is the elevation variance.
        """

    @abstractmethod
    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances of the waves in a periodic patch.

        Returns psi dk^2 [m^2] at k = (ix, iy) dk; spectra with features narrower than dk integrate Psi over the cell.

        `ix`, `iy`: numbers of wave periods along x and y over the patch, shapes (I,) and (J,). `dk`: wavenumber spacing
        [rad/m]: 2 pi divided by the patch side.
        """

    @property
    def systems(self) -> tuple[WaveSpectrum, ...]:
        """Independent wave systems: this one."""
        return (self,)

    @abstractmethod
    def spreading(self, k: ArrayLike) -> FloatArray:
        """Anisotropy Delta(k) = 2 <cos 2 phi> [1], -2 to 2, at wavenumbers `k` [rad/m] above 0.

        The slope variance is k^2 S (1/2 +- Delta/4) along and across the direction, from which phi is measured;
        Elfouhaily et al. (1997) call Delta the upwind-crosswind ratio.
        """

    @property
    @abstractmethod
    def smooth_ranges(self) -> tuple[float, ...]:
        """Ascending wavenumbers [rad/m] between which S is smooth; it is negligible beyond the first and last."""

    def elevation_variance(self) -> float:
        """Elevation variance [m^2]."""
        k, weight = self.quadrature()
        return float(np.sum(self.omnidirectional(k) * weight))

    def slope_covariance(self) -> FloatArray:
        """Covariance matrix [1] of the slopes in x and y, shape (2, 2)."""
        along, across = self.slope_variance()
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        rotation = np.array([[cos, -sin], [sin, cos]])
        return np.asarray(rotation @ np.diag([along, across]) @ rotation.T)

    def slope_variance(self) -> tuple[float, float]:
        """Slope variances [1] along and across the direction."""
        k, weight = self.quadrature()
        curvature = self.omnidirectional(k) * k**2 * weight
        spreading = self.spreading(k)
        return float(np.sum(curvature * (0.5 + spreading / 4))), float(np.sum(curvature * (0.5 - spreading / 4)))

    def quadrature(self) -> tuple[FloatArray, FloatArray]:
        """Wavenumbers and weights [rad/m] of a midpoint rule in ln k over all waves."""
        count = 4000
        nodes, weights = [np.ones(1)], [np.zeros(1)]
        for low, high in pairwise(self.smooth_ranges):
            if low < high:
                step = np.log(high / low) / count
                k = low * np.exp(step * (np.arange(count) + 0.5))
                nodes.append(k)
                weights.append(k * step)
        return np.concatenate(nodes), np.concatenate(weights)


class CosineSpectrum(WaveSpectrum):
    """Spectrum with the angular density (1 + Delta cos 2 phi)/(2 pi), Delta -1 to 1, defined by S(k) and Delta(k)."""

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances Psi dk^2 [m^2]; see `WaveSpectrum.mode_variances`."""
        # S and Delta once for each integer ix^2 + iy^2 that occurs: a fifth of the waves in a large patch.
        square = ix**2 + iy[:, None] ** 2
        occurs = np.zeros(square.max() + 1, dtype=bool)
        occurs[square] = True
        occurs[0] = False
        distinct = np.flatnonzero(occurs)
        k = dk * np.sqrt(distinct)
        mean, modulation = np.zeros(occurs.size), np.zeros(occurs.size)
        mean[distinct] = self.omnidirectional(k) * dk**2 / (2 * np.pi * k)
        modulation[distinct] = mean[distinct] * self.spreading(k) / distinct
        # k^2 cos 2 phi in units of dk^2
        cos, sin = np.cos(2 * self.direction), np.sin(2 * self.direction)
        angle = (cos * ix**2 - cos * iy[:, None] ** 2) + (2 * sin * ix) * iy[:, None]
        variances = mean[square] + modulation[square] * angle
        # Where Delta is 1, rounding may make the density across the direction negative.
        return np.asarray(np.maximum(variances, 0))


@dataclass(frozen=True)
class SeaState:
    """Sum of independent wave systems, each with its own travel direction.

    Raises UserError if there is no component, or one is not a spectrum.

    `components`: at least one. The first determines `direction` and thus the axes of the slope variances.
    """

    components: tuple[WaveSpectrum, ...]
    direction: float = field(init=False)

    def __post_init__(self) -> None:
        components = tuple(self.components)
        if not components:
            raise UserError("components must hold at least one spectrum")
        for component in components:
            if not isinstance(component, WaveSpectrum):
                raise UserError(f"components holds {component!r} but every component must be a wave spectrum")
        object.__setattr__(self, "components", components)
        object.__setattr__(self, "direction", components[0].direction)

    @property
    def peak_wavenumber(self) -> float:
        """Peak wavenumber [rad/m] of the component with the highest waves."""
        return max(self.components, key=lambda component: component.elevation_variance()).peak_wavenumber

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        return np.asarray(sum(component.omnidirectional(k) for component in self.components))

    def elevation_variance(self) -> float:
        """Elevation variance [m^2]."""
        return sum(component.elevation_variance() for component in self.components)

    def slope_covariance(self) -> FloatArray:
        """Covariance matrix [1] of the slopes in x and y, shape (2, 2)."""
        return np.asarray(sum(component.slope_covariance() for component in self.components))

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances [m^2]; see `WaveSpectrum.mode_variances`."""
        return np.asarray(sum(component.mode_variances(ix, iy, dk) for component in self.components))

    def slope_variance(self) -> tuple[float, float]:
        """Slope variances [1] along and across the direction."""
        return variances_along(self.slope_covariance(), self.direction)

    @property
    def systems(self) -> tuple[WaveSpectrum, ...]:
        """Independent wave systems, in component order."""
        return self.components


@dataclass(frozen=True)
class MatchedSpectrum(CosineSpectrum):
    """Spectrum whose short waves are scaled so that all waves together have given slope variances.

    Resolved and unresolved waves of a mesh then add up to the same total at every resolution.

    `spectrum`: elfouhaily, Pierson-Moskowitz or JONSWAP. One with less than a millionth of the given variances, as in
    the lightest winds, is made flat. `upwind`, `crosswind`: slope variances [1] along and across the direction, not
    negative, such as Cox and Munk's. Their ratio is limited to a factor of 3 (cos^2 about the direction). Beyond it, as
    for Cox and Munk below 0.4 m/s, the larger one is reduced. `k_from`: waves with wavenumbers [rad/m] above this are
    scaled, positive. If the others alone have too much slope variance, or a ratio that scaling cannot correct, it is
    reduced in steps of a tenth. Below the longest wave all are scaled.

    With the fractions 1/2 +- Delta/4 of the slope variance k^2 S, factors s_u and s_c give
    S' = S (s_u (1/2 + Delta/4) + s_c (1/2 - Delta/4)) and Delta' = 2 (s_u (1/2 + Delta/4) - s_c (1/2 - Delta/4)) S/S',
    clipped to ``|Delta'| <= 1`` so that no wave has a negative density; s_u and s_c are found with the clipping.
    """

    spectrum: CosineSpectrum
    upwind: float
    crosswind: float
    k_from: float = 2 * np.pi
    direction: float = field(init=False)
    scaled_from: float = field(init=False)  #: Wavenumber above which waves are scaled [rad/m].
    scales: tuple[float, float] = field(init=False)  #: Factors along and across the direction [1].

    def __post_init__(self) -> None:
        if not isinstance(self.spectrum, CosineSpectrum):
            raise UserError(f"spectrum = {self.spectrum!r} must be one of wind waves")
        upwind, crosswind = non_negative("upwind", self.upwind), non_negative("crosswind", self.crosswind)
        k_from = positive("k_from", self.k_from)
        object.__setattr__(self, "direction", self.spectrum.direction)
        scales = None
        ratio = _LARGEST_FRACTION / (1 - _LARGEST_FRACTION)
        target = min(upwind, ratio * crosswind), min(crosswind, ratio * upwind)
        while scales is None:
            object.__setattr__(self, "scaled_from", k_from)
            scales = self._find_scales(*target)
            k_from *= 0.9
        object.__setattr__(self, "scales", scales)

    @property
    def peak_wavenumber(self) -> float:
        """Wavenumber at the unscaled spectrum's peak [rad/m]."""
        return self.spectrum.peak_wavenumber

    @property
    def smooth_ranges(self) -> tuple[float, ...]:
        """Wavenumbers [rad/m] of the unscaled spectrum, and the step at `scaled_from`."""
        ranges = self.spectrum.smooth_ranges
        if ranges and ranges[0] < self.scaled_from < ranges[-1]:
            ranges = tuple(sorted({*ranges, self.scaled_from}))
        return ranges

    def omnidirectional(self, k: ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S'(k) [m^3]; see `WaveSpectrum.omnidirectional`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        density = self.spectrum.omnidirectional(wavenumber)
        up, cross = self._fractions(np.where(wavenumber > 0, wavenumber, 1.0))
        return np.where(
            wavenumber > self.scaled_from, density * (self.scales[0] * up + self.scales[1] * cross), density
        )

    def spreading(self, k: ArrayLike) -> FloatArray:
        """Upwind-crosswind ratio Delta'(k) [1], -1 to 1; see `WaveSpectrum.spreading`."""
        wavenumber = np.asarray(k, dtype=np.float64)
        up, cross = self._fractions(wavenumber)
        fraction = _upwind_fraction(self.scales[0] * up, self.scales[1] * cross)
        return np.where(wavenumber > self.scaled_from, 4 * fraction - 2, 4 * up - 2)

    def _fractions(self, k: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Upwind and crosswind fractions of the unscaled slope variance."""
        up = 0.5 + self.spectrum.spreading(k) / 4
        return up, 1 - up

    def _find_scales(self, upwind: float, crosswind: float) -> tuple[float, float] | None:
        """Factors for waves above `scaled_from` that give the total slope variances, or None if there are none."""
        k, weight = self.quadrature()
        curvature = self.spectrum.omnidirectional(k) * k**2 * weight
        up, cross = (curvature * fraction for fraction in self._fractions(k))
        short = k > self.scaled_from
        left_up, left_cross = upwind - up[~short].sum(), crosswind - cross[~short].sum()
        if curvature.sum() <= _NO_WAVES * (upwind + crosswind) or min(upwind, crosswind) == 0:
            object.__setattr__(self, "scaled_from", 0.0)
            return 0.0, 0.0
        all_scaled = not np.any(curvature[~short] > 0)
        smallest = (1 - _LARGEST_FRACTION) / _LARGEST_FRACTION
        if not all_scaled and not (left_up > smallest * left_cross and left_cross > smallest * left_up):
            return None
        up, cross = up[short], cross[short]
        scale_up, scale_cross = left_up / up.sum(), left_cross / cross.sum()
        # Exact in one step without clipping; clipped waves have a fixed fraction, which the others compensate.
        for _ in range(1000):
            total = scale_up * up + scale_cross * cross
            fraction = _upwind_fraction(scale_up * up, scale_cross * cross)
            change_up, change_cross = left_up / np.sum(total * fraction), left_cross / np.sum(total * (1 - fraction))
            scale_up, scale_cross = float(scale_up * change_up), float(scale_cross * change_cross)
            if max(abs(change_up - 1), abs(change_cross - 1)) < 1e-13:
                break
        return scale_up, scale_cross


def _upwind_fraction(up: FloatArray, cross: FloatArray) -> FloatArray:
    """Upwind fraction of slope variances, within the limits of a non-negative angular density."""
    total = up + cross
    fraction = np.divide(up, total, out=np.full_like(total, 0.5), where=total > 0)
    return np.clip(fraction, 1 - _LARGEST_FRACTION, _LARGEST_FRACTION)


def facet_slope_variance(
    variance: FloatArray, ix: IntArray, iy: IntArray, period: float, cells: float, axis: float
) -> tuple[float, float]:
    """Return the slope variances [1] along and across an axis for the facets that sample waves.

    `variance`: elevation variances [m^2] of the waves, shape (len(iy), len(ix)); overwritten. `ix`, `iy`: their numbers
    of wavelengths along x and y over the period, from `realization.wave_numbers`. `period`, `cells`: period [m], and
    its length in cells, which may be broken. `axis`: direction [rad], counter-clockwise from +x.

    Facet slopes are forward differences along x and y, each with the transfer function 2 sin(k d/2)/d, d the cell side.
    Their covariance is for cells split along the diagonal from (i+1, j) to (i, j+1), averaged over both triangles in a
    cell. It is 4 sin(a) sin(b) cos(a - b)/d^2 with a = kx d/2, b = ky d/2. It matters only for winds oblique to the
    mesh.
    """
    variance[:, 1:] *= 2  # for the half plane kx < 0
    # sin(a) sin(b) cos(a - b) = sin(2a) sin(2b)/4 + sin(a)^2 sin(b)^2
    a, b = ix * np.pi / cells, iy * np.pi / cells
    square_a, square_b = np.sin(a) ** 2, np.sin(b) ** 2
    x, y = variance.sum(axis=0) @ square_a, variance.sum(axis=1) @ square_b
    xy = np.sin(2 * b) @ variance @ np.sin(2 * a) / 4 + square_b @ variance @ square_a
    return variances_along(np.array([[x, xy], [xy, y]]) * (2 * cells / period) ** 2, axis)
