"""Irradiance of a clear sky, what a level sea lets in, and what a pixel detects of it."""

import numpy as np
import pytest

from mitransient_lidar.optics import daylight
from mitransient_lidar.optics.refraction import fresnel


def test_the_sun_of_the_standard_atmosphere():
    """ASTM G173-03: zenith angle 48.19 deg, aerosol 0.084 at 500 nm, ozone 0.3438 atm cm.

    Its table gives 1.2595 of 1.734 outside the atmosphere at 541 nm, and 1.3657 of 1.874 at 545 nm.
    """
    sky = daylight.clear_sky(48.19, aerosol_optical_depth=0.0742, angstrom_exponent=1.3, ozone_cm=0.3438)
    # At 532 nm a hundredth less: Rayleigh scattering goes with the fourth power.
    assert sky.direct_normal / 1.90 == pytest.approx(0.727 * 0.993, rel=0.01)
    assert sky.direct == pytest.approx(sky.direct_normal * np.cos(np.radians(48.19)))


def test_without_an_atmosphere_there_is_no_sky():
    sky = daylight.clear_sky(30.0, aerosol_optical_depth=0.0, ozone_cm=0.0, pressure_hpa=0.0)
    assert sky.diffuse == 0
    assert sky.direct_normal == pytest.approx(1.90)


def test_what_rayleigh_scatters_goes_half_up_and_half_down():
    """Without aerosol and ozone, to the half that the model allots, short of the power 0.95 in it."""
    sky = daylight.clear_sky(20.0, aerosol_optical_depth=0.0, ozone_cm=0.0)
    missing = 1.90 * np.cos(np.radians(20)) - sky.direct
    assert sky.diffuse == pytest.approx(0.475 * missing, rel=0.01)


def test_the_sky_s_share_grows_as_the_sun_sinks():
    share = [s.diffuse / (s.diffuse + s.direct) for s in map(daylight.clear_sky, (0.0, 30.0, 60.0, 75.0, 89.0))]
    assert np.all(np.diff(share) > 0)
    # Gregg and Carder 1990: about a sixth of visible light with a high sun in clear maritime air, all at the horizon.
    assert 0.12 < share[0] < 0.2
    assert share[-1] > 0.8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"zenith_deg": 90.0}, "zenith_deg = 90 must lie between 0 and 89"),
        ({"zenith_deg": 10.0, "aerosol_optical_depth": -1.0}, "aerosol_optical_depth = -1 must lie"),
        ({"zenith_deg": 10.0, "angstrom_exponent": 4.0}, "angstrom_exponent = 4 must lie"),
        ({"zenith_deg": 10.0, "ozone_cm": 3.0}, "ozone_cm = 3 must lie"),
        ({"zenith_deg": 10.0, "pressure_hpa": float("nan")}, "pressure_hpa = nan must be finite"),
    ],
)
def test_mistakes(options, message):
    with pytest.raises(ValueError, match=message):
        daylight.clear_sky(**options)


def test_level_sea():
    assert daylight.level_transmittance([0.0, 20.0], 1.34) == pytest.approx([1 - 0.021112, 0.978702], abs=1e-6)
    # By Monte Carlo, and the usual 6.6 to 6.8 %.
    rng = np.random.default_rng(1)
    reflected = fresnel(np.arccos(np.sqrt(rng.random(10**6))), 1.34)[0]
    error = reflected.std() / 1e3
    assert abs(1 - daylight.diffuse_transmittance(1.34) - reflected.mean()) < 4.5 * error
    assert daylight.diffuse_transmittance(1.34) == pytest.approx(0.9325, abs=5e-4)


def test_background_power_and_its_photoelectrons():
    """10 mW m^-2 sr^-1 nm^-1 on 1 mrad^2 and 0.025 m^2 through 1 nm: 0.25 nW; a photon of 532 nm has 3.734e-19 J."""
    power = daylight.background_power([0.01, 0.02], 0.025e-6, 1.0)
    assert power == pytest.approx([2.5e-10, 5e-10])
    assert daylight.photoelectron_rate(power[0], 0.5) == pytest.approx(0.5 * 2.5e-10 / 3.73394e-19, rel=1e-4)
    with pytest.raises(ValueError, match="filter_width_nm = 0 must be greater than 0"):
        daylight.background_power(0.01, 1e-8, 0.0)
    with pytest.raises(ValueError, match="quantum_efficiency = 2 must lie between 0 and 1"):
        daylight.photoelectron_rate(1e-9, 2.0)


def test_sun_radiance():
    """The sun's disc has 6.8e-5 sr."""
    assert daylight.sun_radiance(1.0) == pytest.approx(1 / 6.80e-5, rel=2e-3)
