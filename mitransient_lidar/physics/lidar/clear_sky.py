"""Daylight at the sea at 532 nm: irradiance by sun and sky under a clear sky, and background power per pixel.

Irradiances and radiances are spectral, per nanometre; zenith angles are degrees from the vertical.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.fields import is_green
from mitransient_lidar.core.validation import ArrayLike, FloatArray, finite_array, in_range, positive

SUN_RADIUS_DEG = 0.2666  #: Sun's angular radius [deg].
LARGEST_SUN_ZENITH_DEG = 89.0  #: Largest sun zenith angle [deg].

#: Extraterrestrial irradiance [W m^-2 nm^-1]: mean over 527 to 537 nm in Gregg and Carder's table. Fraunhofer lines
#: change it by up to 4 % within a nanometre.
_SOLAR_CONSTANT = 1.90

_OZONE_ABSORPTION = 0.0662  #: Ozone absorption [1/cm], same table, at 532 nm.

#: Single-scattering albedo of maritime aerosol at 80 % relative humidity (equation 36, air mass type 1).
_AEROSOL_ALBEDO = 0.993

_SEA_LEVEL_PRESSURE = 1013.25  #: Pressure [hPa] for the Rayleigh optical depth.


class ClearSkyIrradiance(NamedTuple):
    """Irradiance at the sea under a clear sky [W m^-2 nm^-1]."""

    direct_normal: float  #: Sun, on a plane normal to its rays.
    direct: float  #: Sun, on a horizontal plane.
    diffuse: float  #: Sky, on a horizontal plane.


def clear_sky_irradiance(
    zenith_deg: float,
    *,
    aerosol_optical_depth: float = 0.1,
    angstrom_exponent: float = 1.0,
    ozone_cm: float = 0.3,
    pressure_hpa: float = _SEA_LEVEL_PRESSURE,
    wavelength_nm: float = 532.0,
) -> ClearSkyIrradiance:
    """Irradiance by sun and sky at 532 nm on the sea under a clear sky.

    `zenith_deg`: sun zenith angle [deg], 0 to 89. `aerosol_optical_depth`: aerosol optical depth at 550 nm, 0 to 5.
    `angstrom_exponent`: exponent of its decrease with wavelength, -1 to 3; it also sets the aerosol's scattering
    asymmetry. `ozone_cm`: ozone column [atm cm], 0 to 1. `pressure_hpa`: pressure at sea level [hPa], 0 (no Rayleigh
    scattering) to 1100. `wavelength_nm`: wavelength [nm] that the irradiance must represent, 510 to 540.

    Gregg and Carder's model (1990, doi:10.4319/lo.1990.35.8.1657) for cloudless maritime atmospheres, at one
    wavelength; the aerosol is given by its optical depth instead of visibility and winds. Its rms error against
    measured spectra is 6.6 %. Air mass: Kasten and Young (1989, doi:10.1364/AO.28.004735). As in the original model,
    light that the sea reflects and the sky scatters back is left out. The sun is at its mean distance.
    """
    if not is_green(wavelength_nm):
        raise UserError(f"wavelength_nm = {wavelength_nm:g} needs irradiance: the clear-sky model covers 532 nm alone")
    zenith = in_range("zenith_deg", zenith_deg, 0.0, LARGEST_SUN_ZENITH_DEG)
    depth = in_range("aerosol_optical_depth", aerosol_optical_depth, 0.0, 5.0)
    exponent = in_range("angstrom_exponent", angstrom_exponent, -1.0, 3.0)
    ozone = in_range("ozone_cm", ozone_cm, 0.0, 1.0)
    pressure = in_range("pressure_hpa", pressure_hpa, 0.0, 1100.0)
    cosine = float(np.cos(np.radians(zenith)))
    air_mass = 1 / (cosine + 0.50572 * (96.07995 - zenith) ** -1.6364)
    ozone_mass = 1.0035 / np.sqrt(cosine**2 + 0.007)
    lam = 1e-3 * 532.0  # micrometres
    rayleigh = np.exp(-air_mass * pressure / _SEA_LEVEL_PRESSURE / (115.6406 * lam**4 - 1.335 * lam**2))
    aerosol = depth * (lam / 0.55) ** -exponent * air_mass
    absorbed, scattered = np.exp(-(1 - _AEROSOL_ALBEDO) * aerosol), np.exp(-_AEROSOL_ALBEDO * aerosol)
    below_ozone = _SOLAR_CONSTANT * np.exp(-_OZONE_ABSORPTION * ozone * ozone_mass)
    normal = below_ozone * rayleigh * absorbed * scattered
    from_air = 0.5 * (1 - rayleigh**0.95)
    from_aerosol = rayleigh**1.5 * (1 - scattered) * _forward_fraction(cosine, exponent)
    diffuse = below_ozone * cosine * absorbed * (from_air + from_aerosol)
    return ClearSkyIrradiance(float(normal), float(normal * cosine), float(diffuse))


def _forward_fraction(cosine: float, exponent: float) -> float:
    """Fraction of aerosol scattering that is directed downwards (Gregg and Carder 1990, equations 20 to 26)."""
    asymmetry = 0.65 if exponent > 1.2 else 0.82 - 0.14167 * max(exponent, 0.0)
    log = np.log(1 - asymmetry)
    first = log * (1.459 + log * (0.1595 + log * 0.4129))
    second = log * (0.0783 + log * (-0.3824 - log * 0.5874))
    return float(1 - 0.5 * np.exp((first + second * cosine) * cosine))


def background_power(radiance: ArrayLike, etendue: ArrayLike, filter_width_nm: float) -> FloatArray:
    """Daylight power on a detector [W], the product of the arguments.

    `radiance`: radiance [W m^-2 sr^-1 nm^-1]. `etendue`: open aperture area times pixel solid angle times transmittance
    of optics and air [m^2 sr]. `filter_width_nm`: filter width [nm], positive: its integral over its peak, which is
    part of the transmittance.
    """
    width = positive("filter_width_nm", filter_width_nm)
    return np.asarray(finite_array("radiance", radiance) * finite_array("etendue", etendue) * width)
