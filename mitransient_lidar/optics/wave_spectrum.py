"""Directional spectra of sea waves: what all offer, and what those symmetric about their direction share.

A spectrum Psi(kx, ky) [m^4] is the variance density of a frozen surface: Psi(k) = Psi(-k), and its integral over the
whole plane is the elevation variance. Which way the waves run, Psi cannot tell; `WaveSpectrum.travelling_parts` does.
Directions are those that wind and waves run towards, in rad counter-clockwise from +x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Protocol

import numpy as np
import numpy.typing as npt

from .checks import FloatArray

IntArray = npt.NDArray[np.int64]

GRAVITY = 9.81
SLOWEST_WAVENUMBER = 370.0
"""Wavenumber of the slowest gravity-capillary wave [rad/m], which stands for the surface tension."""


def phase_speed(k: npt.ArrayLike) -> FloatArray:
    """Phase speed [m/s] of gravity-capillary waves of wavenumber `k` [rad/m], positive, in deep water."""
    wavenumber = np.asarray(k, dtype=np.float64)
    return np.asarray(np.sqrt(GRAVITY / wavenumber * (1 + (wavenumber / SLOWEST_WAVENUMBER) ** 2)))


def variances_along(covariance: FloatArray, direction: float) -> tuple[float, float]:
    """Variances (along, across) a `direction` [rad] of slopes with the covariance matrix, shape (2, 2), in x and y."""
    axis = np.array([np.cos(direction), np.sin(direction)])
    along = float(axis @ covariance @ axis)
    return along, float(np.trace(covariance)) - along


class TravellingWaves(Protocol):
    """Waves that all run towards the half plane of one direction."""

    @property
    def direction(self) -> float:
        """Direction [rad] counter-clockwise from +x: a wave of wavenumber k runs along k where k . direction > 0."""

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """See `WaveSpectrum.mode_variances`."""


class WaveSpectrum(ABC):
    """Directional wave spectrum."""

    direction: float

    @property
    @abstractmethod
    def peak_wavenumber(self) -> float:
        """Wavenumber of the spectral peak [rad/m]; infinite for a flat sea."""

    @abstractmethod
    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S(k) [m^3]; its integral over k > 0 is the elevation variance.

        Parameters
        ----------
        k : array_like
            Wavenumber [rad/m]; S is 0 at k <= 0.

        Returns
        -------
        ndarray
            S, of the shape of `k`.
        """

    @abstractmethod
    def directional(self, kx: npt.ArrayLike, ky: npt.ArrayLike) -> FloatArray:
        """Directional spectrum Psi [m^4]; its integral over the whole (kx, ky) plane is the elevation variance.

        Parameters
        ----------
        kx, ky : array_like
            Wavenumber components [rad/m].

        Returns
        -------
        ndarray
            Psi, of the broadcast shape. Opposite waves count alike: a frozen surface cannot tell them apart.
        """

    @abstractmethod
    def elevation_variance(self) -> float:
        """Variance of the elevation [m^2]."""

    @abstractmethod
    def slope_covariance(self, k_max: float = np.inf) -> FloatArray:
        """Covariance matrix [1] of the slopes in x and y, shape (2, 2), of waves up to `k_max` [rad/m], above 0."""

    def slope_variance(self, k_max: float = np.inf) -> tuple[float, float]:
        """Slope variances [1] (along, across) the direction of all waves with wavenumbers up to `k_max` [rad/m]."""
        return variances_along(self.slope_covariance(k_max), self.direction)

    def significant_wave_height(self) -> float:
        """Four standard deviations of the elevation [m]."""
        return 4 * float(np.sqrt(self.elevation_variance()))

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances of the waves that a periodic patch has room for.

        Parameters
        ----------
        ix, iy : ndarray of int, shapes (I,) and (J,)
            Periods of the waves along x and y over the patch.
        dk : float
            Spacing of their wavenumbers [rad/m]: 2 pi over the side of the patch.

        Returns
        -------
        ndarray, shape (J, I)
            Psi dk^2 [m^2] at k = (ix, iy) dk; spectra with features narrower than dk integrate Psi over the cell.
        """
        return np.asarray(self.directional(ix * dk, iy[:, None] * dk) * dk**2)

    def travelling_parts(self) -> tuple[TravellingWaves, ...]:
        """Independent parts that make up the sea, each with one half plane that its waves run to."""
        return (self,)


class AxialSpectrum(WaveSpectrum):
    """Spectrum symmetric about its direction; its integrals need only S(k) and the spreading Delta(k)."""

    @abstractmethod
    def spreading(self, k: npt.ArrayLike) -> FloatArray:
        """Anisotropy Delta(k) = 2 <cos 2 phi> [1]: the slope variance is k^2 S (1/2 +- Delta/4) along and across.

        Parameters
        ----------
        k : array_like
            Wavenumber [rad/m], positive.

        Returns
        -------
        ndarray
            Delta, -2 to 2, of the shape of `k`. phi is the angle from the direction; Elfouhaily et al. (1997) call
            Delta the upwind-crosswind ratio.
        """

    @property
    @abstractmethod
    def smooth_ranges(self) -> tuple[float, ...]:
        """Ascending wavenumbers [rad/m] between which S is smooth; it is negligible beyond the first and last."""

    def elevation_variance(self) -> float:
        """Variance of the elevation [m^2]."""
        k, weight = self.quadrature()
        return float(np.sum(self.omnidirectional(k) * weight))

    def slope_covariance(self, k_max: float = np.inf) -> FloatArray:
        """Covariance matrix [1] of the slopes in x and y, shape (2, 2), of waves up to `k_max` [rad/m], above 0."""
        along, across = self.slope_variance(k_max)
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        turn = np.array([[cos, -sin], [sin, cos]])
        return np.asarray(turn @ np.diag([along, across]) @ turn.T)

    def slope_variance(self, k_max: float = np.inf) -> tuple[float, float]:
        """Slope variances [1] (along, across) the direction of all waves with wavenumbers up to `k_max` [rad/m]."""
        check_k_max(k_max)
        k, weight = self.quadrature(k_max)
        curvature = self.omnidirectional(k) * k**2 * weight
        spreading = self.spreading(k)
        return float(np.sum(curvature * (0.5 + spreading / 4))), float(np.sum(curvature * (0.5 - spreading / 4)))

    def quadrature(self, k_max: float = np.inf) -> tuple[FloatArray, FloatArray]:
        """Wavenumbers and weights [rad/m] of a midpoint rule in ln k over all waves up to `k_max` [rad/m]."""
        count = 4000
        nodes, weights = [np.ones(1)], [np.zeros(1)]
        for low, end in pairwise(self.smooth_ranges):
            high = min(end, k_max)
            if low < high:
                step = np.log(high / low) / count
                k = low * np.exp(step * (np.arange(count) + 0.5))
                nodes.append(k)
                weights.append(k * step)
        return np.concatenate(nodes), np.concatenate(weights)


class CosineSpectrum(AxialSpectrum):
    """Spectrum with the angular density (1 + Delta cos 2 phi)/(2 pi), |Delta| <= 1: S(k) and Delta(k) are all of it."""

    def directional(self, kx: npt.ArrayLike, ky: npt.ArrayLike) -> FloatArray:
        """Directional spectrum Psi [m^4]; see `WaveSpectrum.directional`. It is 0 at the origin."""
        k = np.hypot(kx, ky)
        safe = np.where(k > 0, k, 1.0)
        along = (np.cos(self.direction) * np.asarray(kx) + np.sin(self.direction) * np.asarray(ky)) / safe
        angular = (1 + self.spreading(safe) * (2 * along**2 - 1)) / (2 * np.pi)
        return np.asarray(np.where(k > 0, self.omnidirectional(k) * angular / safe, 0))

    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances Psi dk^2 [m^2]; see `WaveSpectrum.mode_variances`."""
        # S and Delta once for each whole number ix^2 + iy^2 that occurs: a fifth of the waves of a large patch.
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
        # Where Delta is 1, rounding leaves the density across the direction on either side of 0.
        return np.asarray(np.maximum(variances, 0))


def check_k_max(k_max: float) -> None:
    """Reject an upper wavenumber that is not above 0; infinity is allowed."""
    if not k_max > 0:
        raise ValueError(f"k_max = {k_max:g} must be greater than 0")
