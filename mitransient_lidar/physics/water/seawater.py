"""Refractive index, group index, absorption and scattering of pure sea water.

Every function takes numbers or arrays that broadcast and returns an array of their shape.
"""

from __future__ import annotations

import numpy as np

from mitransient_lidar.core.constants import AVOGADRO, BOLTZMANN
from mitransient_lidar.core.validation import ArrayLike, FloatArray, finite_array, in_range
from mitransient_lidar.physics.water.phase import read_columns

WAVELENGTH_RANGE = (400.0, 1100.0)
"""Wavelengths [nm] of all formulas and tables in this module."""

VISIBLE_RANGE = (400.0, 700.0)
"""Wavelengths [nm] of Quan and Fry's index; beyond it pure water has Daimon and Masumura's index."""

_TEMPERATURE_RANGE = (0.0, 30.0)  # degrees C
_SALINITY_RANGE = (0.0, 40.0)  # per mille; the index was fitted up to 35 and is extrapolated linearly

DEPOLARISATION = 0.039
"""Depolarisation ratio of light scattered by water (Farinato and Rowell 1976, as taken by Zhang, Hu and He 2009)."""

_MOLAR_MASS = 0.018  # of water, kg/mol

#: Strengths and squared wavelengths of the resonances [um^2] of pure water at 20 degrees C (Daimon and Masumura 2007,
#: Table 2).
_RESONANCES = (
    (5.684027565e-1, 5.101829712e-3),
    (1.726177391e-1, 1.821153936e-2),
    (2.086189578e-2, 2.620722293e-2),
    (1.130748688e-1, 1.069792721e1),
)


def refractive_index(wavelength_nm: ArrayLike, temperature: ArrayLike = 20.0, salinity: ArrayLike = 35.0) -> FloatArray:
    """Refractive index of sea water relative to air.

    `wavelength_nm`: wavelength [nm], 400 to 1100. `temperature`: temperature [degrees C], 0 to 30. `salinity`: salinity
    [per mille], 0 to 40.

    Result: index [1], in the broadcast shape.

    Up to 700 nm Quan and Fry (1995), Appl. Opt. 34, 3477, doi:10.1364/AO.34.003477. Beyond, their formula is not valid:
    at 1064 nm its index for pure water is 0.001 too high, and its group index 0.005 too low. There pure water at 20
    degrees C has Daimon and Masumura's index (2007), Appl. Opt. 46, 3811, doi:10.1364/AO.46.003811, valid to 1129 nm,
    divided by the index of air (Ciddor 1996). The change with temperature and salinity, 0.006 for sea water,
    extrapolates Quan and Fry's formula. At 700 nm the two indices differ by 4e-5, the group indices by 2e-4. The index
    relative to air determines refraction at the surface; the simulator uses the index 1 for air.
    """
    lam, t, s = _state(wavelength_nm, temperature, salinity)
    visible = _quan_fry(lam, t, s)
    return np.asarray(np.where(lam <= VISIBLE_RANGE[1], visible, visible - _quan_fry(lam, 20, 0) + _pure_index(lam)))


def group_index(wavelength_nm: ArrayLike, temperature: ArrayLike = 20.0, salinity: ArrayLike = 35.0) -> FloatArray:
    """Group index of sea water relative to air, which determines travel times.

    `wavelength_nm`, `temperature`, `salinity`: as in `refractive_index`.

    Result: n - wavelength dn/dwavelength [1], in the broadcast shape, with the derivative of the same formulas. Travel
    times are too short by 0.03 % in all media alike, since air has the index 1 here.
    """
    lam, t, s = _state(wavelength_nm, temperature, salinity)
    visible = _quan_fry(lam, t, s) - lam * _quan_fry_slope(lam, t, s)
    pure_slope = (_pure_index(lam + 0.1) - _pure_index(lam - 0.1)) / 0.2
    pure = _pure_index(lam) - lam * pure_slope - (_quan_fry(lam, 20, 0) - lam * _quan_fry_slope(lam, 20, 0))
    return np.asarray(np.where(lam <= VISIBLE_RANGE[1], visible, visible + pure))


def water_absorption(wavelength_nm: ArrayLike) -> FloatArray:
    """Absorption coefficient of pure water.

    Returns the absorption [1/m], linear between tabulated values, 2.5 nm apart up to 700 nm and 1 to 3 nm from 705 nm.
    The effects of salt and temperature, which matter in the red and infrared, are neglected. A later compilation (WOPP
    v3 of 2016) gives 2 % more at 532 nm.

    `wavelength_nm`: wavelength [nm], 400 to 1100.

    Up to 700 nm Table 3 in Pope and Fry (1997), Appl. Opt. 36, 8710, doi:10.1364/AO.36.008710, measured at 22 degrees
    C. From 705 nm Kou, Labrie and Chylek (1993), Appl. Opt. 32, 3531, doi:10.1364/AO.32.003531: 14.4 1/m at 1064 nm,
    like Kedenburg et al. (2012), doi:10.1364/OME.2.001588; Segelstein's compilation (1981) has 15.1 1/m. At 700 nm
    Kou's value is 7 % above Pope and Fry's. Hale and Querry's table (1973) has no values between 1000 and 1200 nm: a
    line between these would give 61 1/m at 1064 nm.
    """
    nodes, values = read_columns("water_absorption.csv")
    return np.asarray(np.interp(_within("wavelength_nm", wavelength_nm, WAVELENGTH_RANGE), nodes, values))


def water_scattering(
    wavelength_nm: ArrayLike,
    temperature: ArrayLike = 20.0,
    salinity: ArrayLike = 35.0,
    depolarisation: float = DEPOLARISATION,
) -> FloatArray:
    """Scattering coefficient of sea water without particles.

    Half of it is backscattering, since `water_phase_function` is symmetric.

    Returns the scattering [1/m], of the broadcast shape; its authors report agreement with Morel's measurements within
    2 %.

    `wavelength_nm`, `temperature`, `salinity`: as in `refractive_index`. `depolarisation`: depolarisation ratio, 0 to
    0.2.

    Zhang, Hu and He (2009), Opt. Express 17, 5698, doi:10.1364/OE.17.005698: density and salt concentration
    fluctuations, with UNESCO's equation of state (1981) and the `refractive_index` relative to vacuum. Beyond 700 nm no
    measurements confirm it; 1.1e-4 1/m at 1064 nm does not matter beside the absorption.
    """
    lam, t, s = _state(wavelength_nm, temperature, salinity)
    delta = in_range("depolarisation", depolarisation, 0, 0.2)
    air = _air_index(lam)
    n = refractive_index(lam, t, s) * air
    dn_ds = (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2 + 0.01155 / lam) * air

    # rho d(n^2)/d(rho)
    compression = (n**2 - 1) * (1 + 2 / 3 * (n**2 + 2) * (n / 3 - 1 / (3 * n)) ** 2)
    by_density = 0.5 * BOLTZMANN * (t + 273.15) * _compressibility(t, s) * compression**2
    by_salt = 2 * n**2 * dn_ds**2 * s * _MOLAR_MASS / (_density(t, s) * -_activity_slope(t, s) * AVOGADRO)

    beta_90 = np.pi**2 / (lam * 1e-9) ** 4 * (by_density + by_salt) * (6 + 6 * delta) / (6 - 7 * delta)
    return np.asarray(8 * np.pi / 3 * beta_90 * (2 + delta) / (1 + delta))


def water_phase_function(theta: ArrayLike, depolarisation: float = DEPOLARISATION) -> FloatArray:
    """Phase function of water molecules, 3 / (4 pi (3 + p)) (1 + p cos^2(theta)) with p = (1 - delta) / (1 + delta).

    Returns the phase function [1/sr], in the shape of `theta`.

    `theta`: scattering angle [rad], 0 to pi. `depolarisation`: depolarisation ratio delta, 0 to 0.2: 0 is Rayleigh's
    function, 0.09 was Morel's value.
    """
    delta = in_range("depolarisation", depolarisation, 0, 0.2)
    p = (1 - delta) / (1 + delta)
    return np.asarray(3 / (4 * np.pi * (3 + p)) * (1 + p * np.cos(np.asarray(theta, dtype=np.float64)) ** 2))


def _state(
    wavelength_nm: ArrayLike, temperature: ArrayLike, salinity: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return valid wavelength, temperature and salinity."""
    return (
        _within("wavelength_nm", wavelength_nm, WAVELENGTH_RANGE),
        _within("temperature", temperature, _TEMPERATURE_RANGE),
        _within("salinity", salinity, _SALINITY_RANGE),
    )


def _within(name: str, values: ArrayLike, limits: tuple[float, float]) -> FloatArray:
    """Return finite values within limits."""
    array = finite_array(name, values)
    for bad in array[(array < limits[0]) | (array > limits[1])][:1]:
        in_range(name, bad, *limits)
    return array


def _quan_fry(lam: FloatArray, t: FloatArray | float, s: FloatArray | float) -> FloatArray:
    """Quan and Fry's index (1995) relative to air."""
    by_salinity = (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2 + 0.01155 / lam) * s
    by_colour = (15.868 - 0.00423 * t) / lam - 4382 / lam**2 + 1.1455e6 / lam**3
    return np.asarray(1.31405 - 2.02e-6 * t**2 + by_salinity + by_colour)


def _quan_fry_slope(lam: FloatArray, t: FloatArray | float, s: FloatArray | float) -> FloatArray:
    """Return the derivative of `_quan_fry` with respect to the wavelength [1/nm]."""
    return np.asarray(-(15.868 + 0.01155 * s - 0.00423 * t) / lam**2 + 2 * 4382 / lam**3 - 3 * 1.1455e6 / lam**4)


def _pure_index(lam: FloatArray) -> FloatArray:
    """Index of pure water at 20 degrees C by Daimon and Masumura (2007), relative to air."""
    square = (1e-3 * lam) ** 2
    return np.asarray(np.sqrt(1 + sum(a * square / (square - b) for a, b in _RESONANCES)) / _air_index(lam))


def _air_index(lam: FloatArray) -> FloatArray:
    """Index of air by Ciddor (1996), doi:10.1364/AO.35.001566, with the wavelength in nm."""
    square = (1000 / lam) ** 2
    return np.asarray(1 + (5792105 / (238.0185 - square) + 167917 / (57.362 - square)) * 1e-8)


def _polynomial(t: FloatArray, *coefficients: float) -> FloatArray:
    """Return a polynomial with the coefficients in ascending order."""
    return np.asarray(np.polynomial.polynomial.polyval(t, coefficients))


def _compressibility(t: FloatArray, s: FloatArray) -> FloatArray:
    """Isothermal compressibility [1/Pa] at the surface: the inverse of UNESCO's secant bulk modulus [bar]."""
    modulus = _polynomial(t, 19652.21, 148.4206, -2.327105, 1.360477e-2, -5.155288e-5)
    modulus = modulus + _polynomial(t, 54.6746, -0.603459, 1.09987e-2, -6.167e-5) * s
    modulus = modulus + _polynomial(t, 7.944e-2, 1.6483e-2, -5.3009e-4) * s**1.5
    return np.asarray(1e-5 / modulus)


def _density(t: FloatArray, s: FloatArray) -> FloatArray:
    """Density [kg/m^3] at the surface (UNESCO 1981)."""
    density = _polynomial(t, 999.842594, 6.793952e-2, -9.09529e-3, 1.001685e-4, -1.120083e-6, 6.536332e-9)
    density = density + _polynomial(t, 0.824493, -4.0899e-3, 7.6438e-5, -8.2467e-7, 5.3875e-9) * s
    return np.asarray(density + _polynomial(t, -5.72466e-3, 1.0227e-4, -1.6546e-6) * s**1.5 + 4.8314e-4 * s**2)


def _activity_slope(t: FloatArray, s: FloatArray) -> FloatArray:
    """Return the derivative of the logarithmic water activity with respect to salinity (Millero and Leung 1976)."""
    slope = _polynomial(t, -5.58651e-4, 2.40452e-7, -3.12165e-9, 2.40808e-11)
    slope = slope + 1.5 * _polynomial(t, 1.79613e-5, -9.9422e-8, 2.08919e-9, -1.39872e-11) * np.sqrt(s)
    return np.asarray(slope + 2 * _polynomial(t, -2.31065e-6, -1.37674e-9, -1.93316e-11) * s)
