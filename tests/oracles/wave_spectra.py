"""Directional spectra from S(k) and Delta(k), and the slopes of the facets that sample them."""

import numpy as np

from mitransient_lidar.physics.sea.realization import (
    Motion,
    heights_of,
    wave_coefficients,
    wave_numbers,
)
from mitransient_lidar.physics.sea.wave_spectrum import SeaState, facet_slope_variance
from mitransient_lidar.physics.sea.wind_spectra import SwellSpectrum


def directional(spectrum, kx, ky):
    """Return Psi [m^4] at wavenumber components [rad/m] that broadcast: half of the waves travel either way."""
    if isinstance(spectrum, SeaState):
        return sum(directional(component, kx, ky) for component in spectrum.components)
    if isinstance(spectrum, SwellSpectrum):
        return spectrum.directional(kx, ky)
    k = np.hypot(kx, ky)
    safe = np.where(k > 0, k, 1.0)
    along = (np.cos(spectrum.direction) * np.asarray(kx) + np.sin(spectrum.direction) * np.asarray(ky)) / safe
    angular = (1 + spectrum.spreading(safe) * (2 * along**2 - 1)) / (2 * np.pi)
    return np.where(k > 0, spectrum.omnidirectional(k) * angular / safe, 0)


def realise(spectrum, period, cells, seed, time=0.0, **motion):
    """Return the elevations [m] of waves of `wave_coefficients`, at a time [s], with other fields of `Motion`."""
    return heights_of(wave_coefficients(spectrum, period, cells, seed, Motion(time, **motion)))


def mesh_slope_variance(spectrum, period, cells, axis=None):
    """Return the expected slope variances of the facets of `realise` along and across an axis, or the direction."""
    ix, iy, dk = wave_numbers(period, cells)
    variance = spectrum.mode_variances(ix, iy, dk)
    variance[cells // 2, :] = variance[:, cells // 2] = 0
    return facet_slope_variance(variance, ix, iy, period, cells, spectrum.direction if axis is None else axis)
