"""Sun and sky at the sea at 532 nm: irradiances of a clear sky, what a level sea lets in, and background power.

Irradiances and radiances are spectral, per nanometre; zenith angles are degrees from the vertical.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, in_range, non_negative, positive
from .refraction import fresnel
from .water import C0

#: Wavelength of the clear-sky model [nm].
WAVELENGTH_NM = 532.0

#: Angular radius of the sun [deg].
SUN_RADIUS_DEG = 0.2666

#: Largest zenith angle of the sun [deg].
LARGEST_SUN_ZENITH_DEG = 89.0

PLANCK = 6.62607015e-34  #: Planck constant [J s].

#: Extraterrestrial irradiance [W m^-2 nm^-1]: mean over 527 to 537 nm of the table of Gregg and Carder. Fraunhofer
#: lines make it 4 % more or less within a nanometre.
_SOLAR_CONSTANT = 1.90

#: Absorption of ozone [1/cm], same table, at 532 nm.
_OZONE_ABSORPTION = 0.0662

#: Single-scattering albedo of maritime aerosol at a relative humidity of 80 % (their equation 36, air mass type 1).
_AEROSOL_ALBEDO = 0.993

#: Pressure [hPa] to which their Rayleigh optical depth belongs.
_SEA_LEVEL_PRESSURE = 1013.25


@dataclass(frozen=True)
class ClearSky:
    """Irradiance at the sea under a clear sky [W m^-2 nm^-1].

    Attributes
    ----------
    direct_normal
        Of the sun, on a plane normal to its rays.
    direct
        Of the sun, on a level plane.
    diffuse
        Of the sky, on a level plane.
    """

    direct_normal: float
    direct: float
    diffuse: float


def clear_sky(
    zenith_deg: float,
    *,
    aerosol_optical_depth: float = 0.1,
    angstrom_exponent: float = 1.0,
    ozone_cm: float = 0.3,
    pressure_hpa: float = _SEA_LEVEL_PRESSURE,
) -> ClearSky:
    """Return the irradiance of sun and sky at 532 nm on the sea under a clear sky.

    Parameters
    ----------
    zenith_deg : float
        Zenith angle of the sun [deg], 0 to 89.
    aerosol_optical_depth : float
        Optical depth of the aerosol at 550 nm, 0 to 5.
    angstrom_exponent : float
        How it falls with the wavelength, -1 to 3; it sets the aerosol's asymmetry, too.
    ozone_cm : float
        Ozone [atm cm], 0 to 1.
    pressure_hpa : float
        Pressure at sea level [hPa], 0 (no Rayleigh scattering) to 1100.

    Returns
    -------
    ClearSky

    Raises
    ------
    ValueError
        If a parameter is out of range.

    Notes
    -----
    The model of Gregg and Carder (1990, doi:10.4319/lo.1990.35.8.1657) for cloudless maritime atmospheres, at one
    wavelength and with the aerosol given by its optical depth instead of visibility and winds. They found 6.6 % (rms)
    against measured spectra. The air mass is that of Kasten and Young (1989, doi:10.1364/AO.28.004735). Light that the
    sea reflects and the sky sends back is left out, as in their model; the distance to the sun is its mean.
    """
    zenith = in_range("zenith_deg", zenith_deg, 0.0, LARGEST_SUN_ZENITH_DEG)
    depth = in_range("aerosol_optical_depth", aerosol_optical_depth, 0.0, 5.0)
    exponent = in_range("angstrom_exponent", angstrom_exponent, -1.0, 3.0)
    ozone = in_range("ozone_cm", ozone_cm, 0.0, 1.0)
    pressure = in_range("pressure_hpa", pressure_hpa, 0.0, 1100.0)
    cosine = float(np.cos(np.radians(zenith)))
    air_mass = 1 / (cosine + 0.50572 * (96.07995 - zenith) ** -1.6364)
    ozone_mass = 1.0035 / np.sqrt(cosine**2 + 0.007)
    micrometres = 1e-3 * WAVELENGTH_NM
    rayleigh = np.exp(-air_mass * pressure / _SEA_LEVEL_PRESSURE / (115.6406 * micrometres**4 - 1.335 * micrometres**2))
    through_ozone = np.exp(-_OZONE_ABSORPTION * ozone * ozone_mass)
    aerosol = depth * (micrometres / 0.55) ** -exponent * air_mass
    absorbed, scattered = np.exp(-(1 - _AEROSOL_ALBEDO) * aerosol), np.exp(-_AEROSOL_ALBEDO * aerosol)
    outside = _SOLAR_CONSTANT * through_ozone
    normal = outside * rayleigh * absorbed * scattered
    from_air = 0.5 * (1 - rayleigh**0.95)
    from_aerosol = rayleigh**1.5 * (1 - scattered) * _forward_share(cosine, exponent)
    diffuse = outside * cosine * absorbed * (from_air + from_aerosol)
    return ClearSky(float(normal), float(normal * cosine), float(diffuse))


def _forward_share(cosine: float, exponent: float) -> float:
    """Return the share of what aerosol scatters that comes down (Gregg and Carder 1990, equations 20 to 26)."""
    asymmetry = 0.65 if exponent > 1.2 else 0.82 - 0.14167 * max(exponent, 0.0)
    log = np.log(1 - asymmetry)
    first = log * (1.459 + log * (0.1595 + log * 0.4129))
    second = log * (0.0783 + log * (-0.3824 - log * 0.5874))
    return float(1 - 0.5 * np.exp((first + second * cosine) * cosine))


def level_transmittance(zenith_deg: npt.ArrayLike, n: float) -> FloatArray:
    """Share of the irradiance of a source that a level sea of relative index `n` lets in.

    Parameters
    ----------
    zenith_deg : array_like
        Zenith angle of the source [deg], 0 to 90.
    n : float
        Refractive index of the water.

    Returns
    -------
    ndarray
        Fresnel transmittance of unpolarised light.
    """
    return fresnel(np.radians(finite_array("zenith_deg", zenith_deg)), n)[1]


def diffuse_transmittance(n: float) -> float:
    """Share of the irradiance of an even sky that a level sea of relative index `n` lets in; 0.934 for 1.34.

    The integral of the Fresnel transmittance over the sky, weighted by the cosine.
    """
    nodes, weights = np.polynomial.legendre.leggauss(200)
    angle = 0.25 * np.pi * (nodes + 1)
    return float(0.25 * np.pi * np.sum(weights * np.sin(2 * angle) * fresnel(angle, n)[1]))


def background_power(radiance: npt.ArrayLike, etendue: npt.ArrayLike, filter_width_nm: float) -> FloatArray:
    """Power of daylight that a pixel detects: P = L (A Omega eta) dlambda.

    Parameters
    ----------
    radiance : array_like
        Radiance L [W m^-2 sr^-1 nm^-1].
    etendue : array_like
        Open area of the aperture times solid angle of the pixel times transmittance of optics and air [m^2 sr].
    filter_width_nm : float
        Width dlambda [nm] of the filter, positive: its integral over its peak, which is part of the transmittance.

    Returns
    -------
    ndarray
        Power [W].
    """
    width = positive("filter_width_nm", filter_width_nm)
    return np.asarray(finite_array("radiance", radiance) * finite_array("etendue", etendue) * width)


def photoelectron_rate(
    power: npt.ArrayLike, quantum_efficiency: float, wavelength_nm: float = WAVELENGTH_NM
) -> FloatArray:
    """Return how many photoelectrons a second a power frees.

    Parameters
    ----------
    power : array_like
        Detected power [W].
    quantum_efficiency : float
        Photoelectrons per photon, 0 to 1.
    wavelength_nm : float
        Vacuum wavelength [nm], positive.

    Returns
    -------
    ndarray
        Rate P eta lambda / (h c) [1/s].
    """
    efficiency = in_range("quantum_efficiency", quantum_efficiency, 0.0, 1.0)
    wavelength = 1e-9 * positive("wavelength_nm", wavelength_nm)
    return np.asarray(finite_array("power", power) * efficiency * wavelength / (PLANCK * C0))


def sun_radiance(irradiance: float, radius_deg: float = SUN_RADIUS_DEG) -> float:
    """Radiance [W m^-2 sr^-1 nm^-1] of an even sun that gives an irradiance normal to its rays: E / (pi sin^2 r)."""
    radius = np.radians(in_range("radius_deg", positive("radius_deg", radius_deg), 0.0, 45.0))
    return float(non_negative("irradiance", irradiance) / (np.pi * np.sin(radius) ** 2))
