"""Spreading of a narrow beam in water by multiple small-angle scattering, in space and in time.

The beam starts at the origin along z as an infinitely short pulse of unit energy. Its distribution is given in the
plane z = depth against the distance r from the axis and the delay tau after the unscattered light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import gamma, kv

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import FloatArray


@dataclass(frozen=True)
class BeamSpread:
    """Beam spread function with time dispersion at one depth in homogeneous water.

    Parameters
    ----------
    depth : float
        Distance z from the start of the beam to the plane [m], above 0.
    absorption : float
        Absorption coefficient a [1/m], at least 0.
    scattering : float
        Scattering coefficient b [1/m], above 0.
    mean_cosine : float
        Mean cosine g of the phase function, at least 0 and below 1.
    group_index : float
        Group index of the water n_g, which sets the speed v = c0/n_g, at least 1.
    mean_fourth_angle : float
        Mean fourth power <Theta^4> of the scattering angle [rad^4], at least 0. It adds the spread of single
        scatterings to the variance of the delays; the default, 0, is the limit of many weak ones, in which k = 1.5.

    Notes
    -----
    McLean, Freeman and Walker (1998), Appl. Opt. 37, 4701, doi:10.1364/AO.37.004701: the irradiance is

        exp(-c z) delta(r) delta(tau) + (1 - exp(-b z)) exp(-a (z + v tau)) G(tau) h(r, tau),

    with a gamma density G of the delays (shape k = mean^2/variance, rate beta = mean/variance) and a Gaussian h of mean
    square radius 4 v tau z/3. Mean and variance of G are exact in the small-angle approximation, where they hold for
    all light, and follow from <Theta^2> = 2 (1 - g), the mean of 2 (1 - cos Theta).

    The model requires small angles and small delays: b z (1 - g) well below 1. The moments are those of all light but G
    belongs to the scattered part, so that the mean delay of the energy is too small by the factor 1 - exp(-b z).

    The moments of phase functions of sea water are dominated by rare large angles and describe most of the light
    poorly, and the shape of G even less. Random walks in three dimensions with Henyey-Greenstein scattering (z = 8 m,
    a z of 1.2 and 2.4, b z from 1.2 to 10, g from 0.924 to 0.99) show the errors. The transmittance is 1 to 6 % too
    high up to b z (1 - g) = 0.24 and 13 to 20 % at 0.6 to 0.7. The energy within z/2 of the axis is correct to 10 %,
    that within z/8 about half of the true value. The true delay of light within z/2 is only 0.2 to 0.4 times
    `mean_delay`, but that of all light, without absorption, 1.25 to 1.4 times. Adding <Theta^4> is no remedy: the
    variance remains 3 times too small, and far too much light is concentrated on the axis.
    """

    depth: float
    absorption: float
    scattering: float
    mean_cosine: float
    group_index: float = 1.34
    mean_fourth_angle: float = 0.0

    @property
    def speed(self) -> float:
        """Speed of the pulse in the water v = c0/n_g [m/s]."""
        return C0 / self.group_index

    @property
    def mean_square_angle(self) -> float:
        """Mean square scattering angle <Theta^2> = 2 (1 - g) [rad^2]."""
        return 2 * (1 - self.mean_cosine)

    @property
    def unscattered(self) -> float:
        """Fraction of the energy that reaches the plane unscattered, exp(-c z)."""
        return float(np.exp(-(self.absorption + self.scattering) * self.depth))

    @property
    def transmittance(self) -> float:
        """Fraction of the energy that crosses the plane scattered, (1 - exp(-b z)) exp(-a z) (1 + a v/beta)^-k.

        The last factor, the Laplace transform of G at the rate a v, is the absorption on the detours.
        """
        shape, rate = self._gamma
        direct = -np.expm1(-self.scattering * self.depth) * np.exp(-self.absorption * self.depth)
        return float(direct * (1 + self.absorption * self.speed / rate) ** -shape)

    @property
    def mean_delay(self) -> float:
        """Mean of G [s]: b <Theta^2> z^2/(4 v), the mean delay of all light for small angles, without absorption."""
        return self.scattering * self.mean_square_angle * self.depth**2 / (4 * self.speed)

    @property
    def delay_variance(self) -> float:
        """Variance of G [s^2]: (b <Theta^2>)^2 z^4/(24 v^2) + b <Theta^4> z^3/(12 v^2)."""
        many = (self.scattering * self.mean_square_angle) ** 2 * self.depth**4 / 24
        few = self.scattering * self.mean_fourth_angle * self.depth**3 / 12
        return (many + few) / self.speed**2

    def encircled(self, radius: npt.ArrayLike) -> FloatArray:
        """Scattered energy that crosses the plane within a circle about the axis, per unit energy of the pulse.

        Parameters
        ----------
        radius : array_like
            Radius R of the circle [m], at least 0.

        Returns
        -------
        ndarray
            T (1 - 2 (x/2)^k K_k(x)/Gamma(k)), from 0 to T, without the unscattered light. T is the transmittance,
            x = R sqrt(3 (beta + a v)/(v z)), K a modified Bessel function.
        """
        shape, rate = self._gamma
        decay = rate + self.absorption * self.speed
        x = np.asarray(radius, dtype=np.float64) * np.sqrt(3 * decay / (self.speed * self.depth))
        # K is infinite at 0, but the product has a limit, which a very small argument gives.
        half = np.maximum(x, 1e-100) / 2
        outside = 2 * half**shape * kv(shape, 2 * half) / gamma(shape)
        return np.asarray(self.transmittance * (1 - outside))

    @property
    def radius_rms(self) -> float:
        """Root-mean-square radius of all light in the plane without absorption [m]: sqrt(b <Theta^2> z^3/3)."""
        return float(np.sqrt(self.scattering * self.mean_square_angle * self.depth**3 / 3))

    @property
    def _gamma(self) -> tuple[float, float]:
        """Shape k and rate beta [1/s] of the gamma density."""
        mean, variance = self.mean_delay, self.delay_variance
        return mean**2 / variance, mean / variance
