"""Base classes of directional wave spectra.

A spectrum Psi(kx, ky) [m^4] is the variance density of a frozen surface: Psi(k) = Psi(-k), and its integral over the
plane is the elevation variance. Psi does not contain the direction of travel: waves travel towards the half plane of
the direction of their system.
Directions are those that wind and waves travel towards, in rad counter-clockwise from +x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, IntArray

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2]."""

SLOWEST_WAVENUMBER = 370.0
"""Wavenumber of the slowest gravity-capillary wave [rad/m], which defines the surface tension."""


def phase_speed(k: npt.ArrayLike) -> FloatArray:
    """Phase speed [m/s] of gravity-capillary waves of wavenumber `k` [rad/m], positive, in deep water."""
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
    def omnidirectional(self, k: npt.ArrayLike) -> FloatArray:
        """Omnidirectional elevation spectrum S [m^3] at wavenumbers `k` [rad/m], 0 at k <= 0.

        Its integral over k > 0 is the elevation variance.
        """

    @abstractmethod
    def mode_variances(self, ix: IntArray, iy: IntArray, dk: float) -> FloatArray:
        """Elevation variances of the waves of a periodic patch.

        Parameters
        ----------
        ix, iy : ndarray of int, shapes (I,) and (J,)
            Numbers of wave periods along x and y over the patch.
        dk : float
            Spacing of the wavenumbers [rad/m]: 2 pi over the side of the patch.

        Returns
        -------
        ndarray, shape (J, I)
            Psi dk^2 [m^2] at k = (ix, iy) dk; spectra with features narrower than dk integrate Psi over the cell.
        """

    @property
    def systems(self) -> tuple[WaveSpectrum, ...]:
        """Independent wave systems: this one."""
        return (self,)

    @abstractmethod
    def spreading(self, k: npt.ArrayLike) -> FloatArray:
        """Anisotropy Delta(k) = 2 <cos 2 phi> [1], -2 to 2, at wavenumbers `k` [rad/m] above 0.

        The slope variance is k^2 S (1/2 +- Delta/4) along and across the direction, from which phi is measured;
        Elfouhaily et al. (1997) call Delta the upwind-crosswind ratio.
        """

    @property
    @abstractmethod
    def smooth_ranges(self) -> tuple[float, ...]:
        """Ascending wavenumbers [rad/m] between which S is smooth; it is negligible beyond the first and last."""

    def elevation_variance(self) -> float:
        """Variance of the elevation [m^2]."""
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
        # S and Delta once for each integer ix^2 + iy^2 that occurs: a fifth of the waves of a large patch.
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
