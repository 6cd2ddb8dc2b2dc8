"""Reflection by sediment: bottom reflectance by name, and Hapke's model, with opposition effect and two lobes.

A particle layer with the single-scattering albedo w reflects, at the phase angle g between the directions to source and
receiver, whose cosines with the normal are mu_i and mu_o,

    f = w / (4 pi (mu_i + mu_o)) ([1 + B(g)] p(g) + H(mu_i) H(mu_o) - 1)   [1/sr].

Hapke (2002), Icarus 157, 523, doi:10.1006/icar.2002.6853, without macroscopic roughness, porosity and coherent
backscattering; B(g) = B0 / (1 + tan(g/2) / h) of Hapke (1986), Icarus 67, 264, doi:10.1016/0019-1035(86)90108-9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import ArrayLike, Checked, FloatArray, checked, in_range, is_number, shown
from mitransient_lidar.physics.water.phase import read_columns

#: Bottoms and land in the order of their table columns.
_TABLES = {
    "bottom_reflectance.csv": ("coral_sand", "green_algae", "brown_algae", "red_algae"),
    "land_reflectance.csv": ("sand", "wet_sand", "asphalt", "concrete", "basalt", "limestone", "grass", "rush"),
}
BOTTOMS = tuple(name for names in _TABLES.values() for name in names)

_BISECTIONS = 52  #: Halvings of the albedo range that leave the rounding error.

#: Incidences at which energy is checked [deg]: the reflectance grows towards the horizon.
_CHECKED_DEG = (0.0, 45.0, 70.0, 80.0, 88.0)


@dataclass(frozen=True)
class HapkeSurface(Checked):
    """Reflection by a particle layer.

    Raises UserError if a value lies outside its range.
    """

    albedo: float = checked(in_range, 0, 1)  #: Single-scattering albedo w of the particles, 0 to 1.
    #: Asymmetry b of both lobes in the particles' phase function, 0 to 0.9.
    lobe_asymmetry: float = checked(in_range, 0, 0.9, default=0.0)
    #: Share of the lobe towards the source, 0 to 1: (1 + c)/2 with Hapke's c.
    backward_share: float = checked(in_range, 0, 1, default=0.5)
    #: Opposition effect B0, 0 to 3; above 1 shadows alone do not explain it.
    opposition_amplitude: float = checked(in_range, 0, 3, default=1.0)
    opposition_width: float = checked(in_range, 1e-3, 1, default=0.06)  #: Its half width h [rad], 0.001 to 1.

    def h_function(self, cosine: ArrayLike) -> FloatArray:
        """Return Hapke's approximation of Chandrasekhar's H function, within 1 %, at cosines 0 to 1."""
        x = np.maximum(np.asarray(cosine, dtype=np.float64), 1e-12)
        r0 = self.diffusive_reflectance
        return np.asarray(1 / (1 - self.albedo * x * (r0 + (0.5 - r0 * x) * np.log1p(1 / x))))

    @property
    def diffusive_reflectance(self) -> float:
        """The r0 = (1 - gamma) / (1 + gamma) of the H function, with gamma^2 = 1 - w."""
        gamma = math.sqrt(1 - self.albedo)
        return (1 - gamma) / (1 + gamma)

    def single_scattering(self, half_sine_squared: ArrayLike) -> FloatArray:
        """Return [1 + B(g)] p(g) at phase angles given by sin^2(g/2), 0 to 1. The mean of p over the sphere is 1."""
        s = np.asarray(half_sine_squared, dtype=np.float64)
        b = self.lobe_asymmetry
        with np.errstate(divide="ignore"):
            tangent = np.sqrt(s / (1 - s))
        surge = self.opposition_amplitude / (1 + tangent / self.opposition_width)
        backward, forward = ((1 - b * b) / ((1 - b) ** 2 + 4 * b * part) ** 1.5 for part in (s, 1 - s))
        return np.asarray((1 + surge) * (self.backward_share * backward + (1 - self.backward_share) * forward))

    def brdf(self, cos_in: ArrayLike, cos_out: ArrayLike, phase_angle: ArrayLike) -> FloatArray:
        """Return f [1/sr] at cosines of incidence and reflection, above 0 to 1, and phase angles [rad]."""
        mu_i, mu_o = (np.asarray(value, dtype=np.float64) for value in (cos_in, cos_out))
        once = self.single_scattering(np.sin(0.5 * np.asarray(phase_angle, dtype=np.float64)) ** 2)
        often = self.h_function(mu_i) * self.h_function(mu_o) - 1
        return np.asarray(self.albedo / (4 * np.pi * (mu_i + mu_o)) * (once + often))

    def reflectance(self, cos_in: float = 1.0) -> float:
        """Return the share of light that is reflected into the hemisphere, at an incidence cosine above 0 to 1."""
        # About the direction of the source, where the opposition effect peaks; azimuths from its plane.
        end, weights = _gauss_legendre(96)
        azimuth, azimuth_weights = _gauss_legendre(48)
        # From the vertical the horizon is at 90 degrees all around, and one azimuth serves.
        azimuth, azimuth_weights = (np.zeros(1), np.ones(1)) if cos_in == 1 else (np.pi * azimuth, azimuth_weights)
        # The angle where directions at an azimuth reach the horizon: cos_in + sin_in cos(azimuth) tan(angle) = 0.
        horizon = np.pi - np.arctan2(cos_in, math.sqrt(1 - cos_in**2) * np.cos(azimuth))
        # The cube gathers the angles at the peak.
        angle = horizon * end[:, None] ** 3
        solid_angle = np.sin(angle) * horizon * 3 * end[:, None] ** 2 * weights[:, None]
        cos_out = cos_in * np.cos(angle) + math.sqrt(1 - cos_in**2) * np.sin(angle) * np.cos(azimuth)
        inner = np.sum(self.brdf(cos_in, np.maximum(cos_out, 1e-12), angle) * cos_out * solid_angle, axis=0)
        return float(2 * np.pi * np.sum(inner * azimuth_weights))

    def of_albedo(self, name: str, value: float) -> HapkeSurface:
        """Return the surface with another albedo, 0 to 1; raise `UserError` if that reflects more than it receives."""
        found = replace(self, albedo=in_range(name, value, 0.0, 1.0))
        found.require_energy(f"{name} = {found.albedo:g}")
        return found

    def of_reflectance(self, name: str, value: float) -> HapkeSurface:
        """Return the surface with the single-scattering albedo that reflects a share of vertical light, 0 to 1.

        Raises UserError if particles of no albedo reflect so much, or the surface would reflect more than it receives
        at another angle. The message calls the value `name`.
        """
        wanted = in_range(name, value, 0.0, 1.0)
        low, high = 0.0, 1.0
        brightest = replace(self, albedo=high).reflectance()
        if wanted > brightest:
            raise UserError(f"{name} = {wanted:g} must be at most {brightest:.3g} with these particles")
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if replace(self, albedo=middle).reflectance() < wanted else (low, middle)
        found = replace(self, albedo=high)
        found.require_energy(f"{name} = {wanted:g}")
        return found

    def require_energy(self, what: str) -> None:
        """Raise `UserError`, naming `what`, if more light is reflected than arrives at any incidence to 88 degrees."""
        for angle in _CHECKED_DEG:
            share = self.reflectance(math.cos(math.radians(angle)))
            if share > 1:
                raise UserError(
                    f"{what} must be less with these particles: they would reflect {share:.4g} of the light that "
                    f"arrives at {angle:g} degrees"
                )


@cache
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights on 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (1 + nodes), 0.5 * weights


def bottom_reflectance(name: str, value: object, wavelength_nm: float = 532.0) -> float:
    """Return a bottom's reflectance given as a number or by name.

    Raises UserError if the value is none of these, or a number lies outside its range.

    `name`: name of the parameter, for messages. `value`: number from 0 to 1, or its text, or one of `BOTTOMS`.
    `wavelength_nm`: wavelength for a bottom by name [nm], 400 to 700 for coral sand and algae, 400 to 1100 for the
    others.

    Result: reflectance, 0 to 1; for a name linear between the values of the table, 10 nm apart.

    Irradiance reflectance of clean coral sand, the green alga Boodlea, brown algae (mean of Turbinaria and Sargassum)
    and red algae (mean of Porolithon and Corallinaceae), from figure 6 in Maritorena, Morel and Gentili (1994), Limnol.
    Oceanogr. 39, 1689, doi:10.4319/lo.1994.39.7.1689. Dry and wet sand from one beach, an old asphalt road, a light
    grey concrete road, weathered basalt, limestone, lawn grass and green salt-marsh rush: Kokaly et al. (2017), USGS
    Spectral Library Version 7, doi:10.3133/ds1035, measured in air. Single samples: other sands and plants differ by
    factors.
    """
    if not isinstance(value, str) or is_number(value):
        return in_range(name, value, 0.0, 1.0)
    if value not in BOTTOMS:
        raise UserError(f"{name} = {shown(value)} must be a number from 0 to 1, or one of {', '.join(BOTTOMS)}")
    file, names = next(table for table in _TABLES.items() if value in table[1])
    wavelengths, *reflectances = read_columns(file)
    low, high = wavelengths[0], wavelengths[-1]
    if not low <= wavelength_nm <= high:
        raise UserError(
            f"wavelength_nm = {wavelength_nm:g} must lie between {low:g} and {high:g} for {name} = {value!r}"
        )
    return float(np.interp(wavelength_nm, wavelengths, reflectances[names.index(value)]))
