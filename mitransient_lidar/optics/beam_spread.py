"""Spreading of a narrow beam in water by multiple small-angle scattering, in space and in time.

The beam starts at the origin along z as an infinitely short pulse of unit energy. It is looked at in the plane
z = depth as a function of the distance r from its axis and of the delay tau after the unscattered light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite, finite_array, in_range, non_negative, positive
from .water import C0


@dataclass(frozen=True)
class BeamSpread:
    """Beam spread function with time dispersion of one depth in homogeneous water.

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
        Mean fourth power <Theta^4> of the scattering angle [rad^4], at least 0. It widens the delays by how much single
        scatterings differ; the default, 0, is the limit of many weak ones, in which k = 1.5.

    Raises
    ------
    ValueError
        If a parameter lies outside its range.

    Notes
    -----
    McLean, Freeman and Walker (1998), Appl. Opt. 37, 4701, doi:10.1364/AO.37.004701: the irradiance is

        exp(-c z) delta(r) delta(tau) + (1 - exp(-b z)) exp(-a (z + v tau)) G(tau) h(r, tau),

    with a gamma density G of the delays and a Gaussian h of mean square radius 4 v tau z/3. Mean and variance of G are
    exact in the small-angle approximation, where they hold for all light, and follow from <Theta^2> = 2 (1 - g), the
    mean of 2 (1 - cos Theta).

    It needs small angles and small delays: b z (1 - g) well below 1. The moments are those of all light but G belongs
    to the scattered part, so that the mean delay of the energy comes out too small by the factor 1 - exp(-b z).

    Sea water scatters so unevenly that its moments say little about most of its light, and the shape of G less. Walks
    in three dimensions with Henyey-Greenstein scattering show it (z = 8 m, a z of 1.2 and 2.4, b z from 1.2 to 10, g
    from 0.924 to 0.99). The transmittance is 1 to 6 % too high up to b z (1 - g) = 0.24 and 13 to 20 % at 0.6 to 0.7.
    The energy within z/2 of the axis is right to 10 %, that within z/8 about half of what it should be. Light within
    z/2 is late by only 0.2 to 0.4 times `mean_delay`, but all of it together, without absorption, by 1.25 to 1.4 times.
    Adding <Theta^4> does not help there: the variance remains 3 times too small, and far too much light is drawn to the
    axis.
    """

    depth: float
    absorption: float
    scattering: float
    mean_cosine: float
    group_index: float = 1.34
    mean_fourth_angle: float = 0.0

    def __post_init__(self) -> None:
        for name in ("depth", "scattering"):
            object.__setattr__(self, name, positive(name, getattr(self, name)))
        for name in ("absorption", "mean_fourth_angle"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name)))
        if not 0 <= finite("mean_cosine", self.mean_cosine) < 1:
            raise ValueError(f"mean_cosine = {self.mean_cosine:g} must be at least 0 and below 1")
        in_range("group_index", self.group_index, 1, np.inf)

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
        """Share of the energy that reaches the plane without any scattering, exp(-c z)."""
        return float(np.exp(-(self.absorption + self.scattering) * self.depth))

    @property
    def transmittance(self) -> float:
        """Share of the energy that crosses the plane scattered.

        (1 - exp(-b z)) exp(-a z) (1 + a v/beta)^-k: the last factor, the Laplace transform of G at the rate a v, is the
        absorption on the detours.
        """
        shape, rate = self._gamma
        direct = -np.expm1(-self.scattering * self.depth) * np.exp(-self.absorption * self.depth)
        return float(direct * (1 + self.absorption * self.speed / rate) ** -shape)

    @property
    def mean_delay(self) -> float:
        """Mean of G [s]: b <Theta^2> z^2/(4 v), the mean delay of all light for small angles, without absorption."""
        return self.scattering * self.mean_square_angle * self.depth**2 / (4 * self.speed)

    @property
    def mean_delay_bounded(self) -> float:
        """Mean delay [s] that stays below z/v: (z/v) (1 - (1 - exp(-x))/x) with x = b z (1 - g).

        Equation 4 of the paper. It is the distance by which light that has travelled a path z lags behind in depth,
        over v: exact for every phase function. Light that reaches the plane at all has travelled further, and is late
        by more. Both agree for small x; this one is smaller by the share x/3.
        """
        x = self.scattering * self.depth * (1 - self.mean_cosine)
        return float(self.depth / self.speed * (1 + np.expm1(-x) / x))

    @property
    def delay_variance(self) -> float:
        """Variance of G [s^2]: (b <Theta^2>)^2 z^4/(24 v^2) + b <Theta^4> z^3/(12 v^2)."""
        many = (self.scattering * self.mean_square_angle) ** 2 * self.depth**4 / 24
        few = self.scattering * self.mean_fourth_angle * self.depth**3 / 12
        return (many + few) / self.speed**2

    @property
    def radius_rms(self) -> float:
        """Root-mean-square radius of all light in the plane without absorption [m]: sqrt(b <Theta^2> z^3/3)."""
        return float(np.sqrt(self.scattering * self.mean_square_angle * self.depth**3 / 3))

    def delay_density(self, tau: npt.ArrayLike) -> FloatArray:
        """Probability density of the delay, before absorption.

        Parameters
        ----------
        tau : array_like
            Delay after the unscattered light [s].

        Returns
        -------
        ndarray
            G(tau) = beta^k tau^(k-1) exp(-beta tau)/Gamma(k) [1/s] with k = mean^2/variance and beta = mean/variance,
            of the shape of `tau`; 0 for tau <= 0.
        """
        from scipy.special import gammaln

        shape, rate = self._gamma
        delay = finite_array("tau", tau)
        # In units of 1/beta, so that no power of nanoseconds underflows.
        scaled = np.where(delay > 0, rate * delay, 1.0)
        density = rate * np.exp((shape - 1) * np.log(scaled) - scaled - gammaln(shape))
        return np.asarray(np.where(delay > 0, density, 0.0))

    def irradiance(self, radius: npt.ArrayLike, tau: npt.ArrayLike) -> FloatArray:
        """Irradiance of the scattered light per unit energy of the pulse.

        Parameters
        ----------
        radius : array_like
            Distance r from the axis [m], at least 0.
        tau : array_like
            Delay after the unscattered light [s]; it broadcasts with `radius`.

        Returns
        -------
        ndarray
            (1 - exp(-b z)) exp(-a (z + v tau)) G(tau) h(r, tau) [1/(m^2 s)]; 0 for tau <= 0.

        Raises
        ------
        ValueError
            If a radius is negative.
        """
        r, delay = _radii(radius), finite_array("tau", tau)
        stretch = self.speed * np.where(delay > 0, delay, 1.0)
        spot = 3 / (4 * np.pi * stretch * self.depth) * np.exp(-3 * r**2 / (4 * stretch * self.depth))
        loss = -np.expm1(-self.scattering * self.depth) * np.exp(-self.absorption * (self.depth + stretch))
        return np.asarray(loss * self.delay_density(delay) * spot)

    def fluence(self, radius: npt.ArrayLike) -> FloatArray:
        """Irradiance of the scattered light integrated over all delays, per unit energy of the pulse.

        Parameters
        ----------
        radius : array_like
            Distance r from the axis [m], at least 0.

        Returns
        -------
        ndarray
            T p 3/(4 pi v z) 2 (x/2)^(k-1) K_(k-1)(x)/Gamma(k) [1/m^2], of the shape of `radius`. T is the
            transmittance, p = beta + a v, x = r sqrt(3 p/(v z)), K a modified Bessel function. Infinite at r = 0 if
            k <= 1.

        Raises
        ------
        ValueError
            If a radius is negative.
        """
        shape, _ = self._gamma
        x = self._reduced(radius)
        scale = self.transmittance * self._decay * 3 / (4 * np.pi * self.speed * self.depth)
        return np.asarray(np.where((x == 0) & (shape <= 1), np.inf, scale * _bessel_tail(shape - 1, x, shape)))

    def encircled(self, radius: npt.ArrayLike) -> FloatArray:
        """Scattered energy that crosses the plane within a circle about the axis, per unit energy of the pulse.

        Parameters
        ----------
        radius : array_like
            Radius R of the circle [m], at least 0.

        Returns
        -------
        ndarray
            T (1 - 2 (x/2)^k K_k(x)/Gamma(k)) with x of `fluence` at R, from 0 to T, the transmittance. The unscattered
            light comes on top.

        Raises
        ------
        ValueError
            If a radius is negative.
        """
        shape, _ = self._gamma
        x = self._reduced(radius)
        return np.asarray(self.transmittance * (1 - _bessel_tail(shape, x, shape)))

    def small_angle_laplace(self, rate: npt.ArrayLike) -> FloatArray:
        """Laplace transform of the delays of all light in the limit of many weak scatterings, exact for small angles.

        Parameters
        ----------
        rate : array_like
            Variable s of the transform [1/s], at least 0.

        Returns
        -------
        ndarray
            E[exp(-s tau)] = sech(z sqrt(s b <Theta^2>/(2 v))), of the shape of `rate`. The gamma density of
            `mean_fourth_angle` = 0 agrees with it to second order in s.

        Raises
        ------
        ValueError
            If a rate is negative.

        Notes
        -----
        The direction does a plane Brownian motion along z and the detour is half its squared length, added up along z.
        Each of the two axes contributes the square root of 1/cosh (the Cameron-Martin formula).
        """
        s = finite_array("rate", rate)
        if np.any(s < 0):
            raise ValueError(f"rate = {s.min():g} must not be negative")
        diffusion = self.scattering * self.mean_square_angle / (2 * self.speed)
        return np.asarray(1 / np.cosh(self.depth * np.sqrt(s * diffusion)))

    @property
    def _gamma(self) -> tuple[float, float]:
        """Shape k and rate beta [1/s] of the gamma density."""
        mean, variance = self.mean_delay, self.delay_variance
        return mean**2 / variance, mean / variance

    @property
    def _decay(self) -> float:
        """Rate p [1/s] at which scattered light fades with the delay."""
        return self._gamma[1] + self.absorption * self.speed

    def _reduced(self, radius: npt.ArrayLike) -> FloatArray:
        """Argument x of the Bessel functions."""
        return np.asarray(_radii(radius) * np.sqrt(3 * self._decay / (self.speed * self.depth)))


def _bessel_tail(order: float, x: FloatArray, shape: float) -> FloatArray:
    """2 (x/2)^order K_order(x)/Gamma(shape): the integral of t^(order-1) exp(-t - x^2/(4 t)) dt, over Gamma(shape)."""
    from scipy.special import gamma, kv

    # K is infinite at 0 but the product has a limit for order > 0, which so small an argument yields.
    half = np.maximum(x, 1e-100) / 2
    return np.asarray(2 * half**order * kv(order, 2 * half) / gamma(shape))


def _radii(radius: npt.ArrayLike) -> FloatArray:
    r = finite_array("radius", radius)
    if np.any(r < 0):
        raise ValueError(f"radius = {r.min():g} must not be negative")
    return r
