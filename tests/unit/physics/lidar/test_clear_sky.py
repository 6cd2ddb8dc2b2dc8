"""Irradiance of a clear sky, and the background power of a pixel."""

import numpy as np
import pytest

from mitransient_lidar.physics.lidar.clear_sky import background_power, clear_sky_irradiance


def test_sun_of_the_standard_atmosphere():
    """ASTM G173-03: zenith angle 48.19 deg, aerosol 0.084 at 500 nm, ozone 0.3438 atm cm.

    Its table gives 1.2595 of 1.734 outside the atmosphere at 541 nm, and 1.3657 of 1.874 at 545 nm.
    """
    sky = clear_sky_irradiance(48.19, aerosol_optical_depth=0.0742, angstrom_exponent=1.3, ozone_cm=0.3438)
    # 1 % less at 532 nm: Rayleigh scattering is proportional to the inverse fourth power of the wavelength.
    assert sky.direct_normal / 1.90 == pytest.approx(0.727 * 0.993, rel=0.01)
    assert sky.direct == pytest.approx(sky.direct_normal * np.cos(np.radians(48.19)))


def test_no_sky_without_an_atmosphere():
    sky = clear_sky_irradiance(30.0, aerosol_optical_depth=0.0, ozone_cm=0.0, pressure_hpa=0.0)
    assert sky.diffuse == 0
    assert sky.direct_normal == pytest.approx(1.90)


def test_half_of_rayleigh_scattering_goes_down():
    """Without aerosol and ozone, the model gives one half, except for its power 0.95."""
    sky = clear_sky_irradiance(20.0, aerosol_optical_depth=0.0, ozone_cm=0.0)
    missing = 1.90 * np.cos(np.radians(20)) - sky.direct
    assert sky.diffuse == pytest.approx(0.475 * missing, rel=0.01)


def test_sky_fraction_grows_with_the_zenith_angle():
    share = [s.diffuse / (s.diffuse + s.direct) for s in map(clear_sky_irradiance, (0.0, 30.0, 60.0, 75.0, 89.0))]
    assert np.all(np.diff(share) > 0)
    # Gregg and Carder 1990: about a sixth of visible light with a high sun in clear maritime air, all at the horizon.
    assert 0.12 < share[0] < 0.2
    assert share[-1] > 0.8


def test_background_power():
    """10 mW m^-2 sr^-1 nm^-1 on 1 mrad^2 and 0.025 m^2 through 1 nm: 0.25 nW."""
    assert background_power([0.01, 0.02], 0.025e-6, 1.0) == pytest.approx([2.5e-10, 5e-10], rel=1e-12, abs=0)


def test_aerosols_scatter_forwards_by_the_published_fraction():
    """Equations 20 to 26 of Gregg and Carder (1990) by hand: 0.791115 for an asymmetry of 0.65 at 60 degrees."""
    sky = clear_sky_irradiance(60.0, aerosol_optical_depth=0.2, angstrom_exponent=1.3, ozone_cm=0.0, pressure_hpa=0.0)
    # A single-scattering albedo of 0.993 leaves the share T^0.007 of the light to be scattered or not.
    through = sky.direct_normal / 1.90
    assert sky.diffuse == pytest.approx(0.791115 * 0.95 * (through**0.007 - through), rel=1e-5)
