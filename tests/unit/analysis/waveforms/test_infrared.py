"""Surface and land in the near infrared, where the light of the water is part of the surface's echo."""

import numpy as np
import pytest
import xarray as xr
from rows import each_row, must_refuse
from scipy.stats import exponnorm, norm

from mitransient_lidar import results
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.echo_classes import EchoClass
from mitransient_lidar.analysis.waveforms.surface_times import SurfaceLevel, check_surface, infrared_level
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.results.geometry import LinesOfSight

C, N, N_GROUP, ALTITUDE, FWHM = 1e-9 * C0, 1.33027, 1.34644, 600.0, 2.0
#: Absorption of water at 1064 nm [1/m]: Kou et al. 1993.
ABSORPTION = 14.4
DT, BINS, SIGMA = 0.25, 240, FWHM / FWHM_PER_SIGMA
SURFACE = 2 * ALTITUDE / C
START = SURFACE - 35
EDGES = START + DT * np.arange(BINS + 1)
#: Energy of a white plane over pi [J].
UNIT = 1e-5 * 0.729 * 0.01 / ALTITUDE**2 / np.pi
ATTRIBUTES = {
    **{
        "altitude": ALTITUDE,
        "off_nadir_deg": 0.0,
        "refractive_index": N,
        "group_index": N_GROUP,
        "pulse_fwhm_ns": FWHM,
    },
    **{"pulse_energy_mj": 0.01, "aperture_area": 0.01, "field_of_view_mrad": 0.9, "divergence_mrad": 0.15},
    **{"surface_time_ns": SURFACE, "surface_heights_m": [-0.3, 0.3], "two_way_efficiency": 0.729},
    "wavelength_nm": 1064.0,
}


def echo(height, glint, backscattering=0.0):
    """Power of a plane at a height [m], of a reflectance times pi, with water of a backscattering coefficient below."""
    at, rate = SURFACE - 2 / C * height, ABSORPTION * C / N_GROUP
    column = backscattering / 2 * C0 / (2 * N_GROUP) * 0.96 / N**2
    behind = exponnorm.cdf(EDGES, 1 / (rate * SIGMA), loc=at, scale=SIGMA) * column / rate * 1e-9
    return UNIT / (DT * 1e-9) * np.maximum(np.diff(glint * norm.cdf(EDGES, at, SIGMA) + behind), 0)


def shots(powers):
    """A result with one shot for each row of powers [W]."""
    values = np.asarray(powers)
    base = results.build(
        *(one * values[:1] * DT * 1e-9 for one in (1, 0)),
        *(one * values[:1] for one in (1, 0)),
        time=TimeAxis(START, DT, BINS),
        pixel_names=["single"],
        pixel_centres_mrad=np.zeros((1, 2)),
        attributes=ATTRIBUTES,
    )
    zero, one = np.zeros(1), np.ones(1)
    lines = LinesOfSight(zero, zero, zero, SURFACE * one, zero, C / (2 * N_GROUP) * one, one)
    data = (("shot", "pixel", "time"), values[:, np.newaxis], {"units": "W"})
    coordinates = {"pixel": base["pixel"], "time": base["time"], "shot": np.arange(len(values))}
    return xr.Dataset({"waveform": data}, coordinates, base.attrs).assign_coords(lines.coordinates(("pixel",), (1,)))


def heights(table):
    """Return heights of the surface, and their standard deviations by noise and water [m]."""
    time = table["surface_time_ns"].values[:, 0]
    return (SURFACE - time) * C / 2, table["surface_time_ns_stderr"].values[:, 0] * C / 2


@each_row(-0.2, 0.0, 0.25)
def test_the_surface_is_found_without_noise(height):
    """Of glint, of both, and of the water's light alone, which comes 4.7 cm of air later: no column, no bottom."""
    powers = [echo(height, *light) for light in ((0.1, 0.003), (1e-5, 0.003), (0.0, 0.003), (0.0, 0.02))]
    table = echo_table.extract(shots(powers), noise=1e-6 * np.max(powers[-1])).isel(pixel=0)
    assert (table["class"].sel(echo="surface") == EchoClass.SURFACE).all()
    assert (table["class"].sel(echo=["column", "target", "bottom"]) == EchoClass.NONE).all()
    assert np.isnan(table["attenuation"]).all()
    found, error = heights(table.expand_dims("pixel", -1))
    np.testing.assert_allclose(found, height, atol=0.026)
    np.testing.assert_allclose(found[0], height, atol=2e-3)
    assert (np.abs(found - height) < 2 * error + 5e-4).all()


def test_the_surface_is_found_in_recorded_noise():
    """Errors of glint by noise alone have the stated size; land above the sea is none of it."""
    powers = [echo(0.1, 0.1, 0.003)] * 200 + [echo(2.0, 0.3)] * 5
    table = echo_table.extract(detect_waveforms(shots(powers), "riegl_vq880g2_infrared", gain=0.01, seed=3))
    table = table.isel(pixel=[0])
    found, error = heights(table)
    kinds = table["class"].isel(pixel=0)
    assert (kinds.sel(echo="surface")[:200] == EchoClass.SURFACE).all()
    assert (kinds.sel(echo="bottom")[200:] == EchoClass.LAND).all()
    np.testing.assert_allclose(table["depth_m"].isel(pixel=0).sel(echo="bottom")[200:], -2.0, atol=0.01)
    z = (found[:200] - 0.1) / error[:200]
    assert abs(found[:200].mean() - 0.1) < 2e-3
    assert np.mean(z**2) == pytest.approx(1, abs=4 * np.sqrt(2 / 200))


def test_the_surface_of_the_infrared_is_the_level_of_green_waveforms():
    """At 20 degrees a height h comes 2 h/(c cos(20 deg)) earlier, as the level sea does; land gives no level."""
    infrared = shots([echo(0.2, 0.1), echo(-0.1, 0.1), echo(3.0, 0.3)])
    table = echo_table.extract(infrared, noise=1e-3 * infrared["waveform"].max().item())
    angle, two = np.radians(20.0), np.ones(2)
    lines = LinesOfSight(0 * two, np.array([0.0, 1e-3]), angle * two, 4260 * two, 0 * two, 0.11 * two, 0.5 * two)
    green = xr.Dataset(attrs={"divergence_mrad": 0.0, "surface_heights_m": [-0.3, 0.3]})
    level = infrared_level(table, infrared, green, lines, 6)
    expected = 4260 - np.array([0.2, -0.1]) / (C / 2 * np.cos(angle))
    np.testing.assert_allclose(level.time_ns[:4], np.repeat(expected, 2), atol=0.04)
    assert np.isnan(level.time_ns[4:]).all()
    # The second pixel is 0.64 m away, over which waves rise.
    assert level.stderr_ns[1] * C / 2 > 0.02 > level.stderr_ns[0] * C / 2


def test_a_level_counts_by_its_error():
    """Weights are inverse variances, 1 to 4 here; each of both alone is what it is."""
    level = SurfaceLevel(np.array([10.0, 10.0, np.nan, np.nan]), np.array([0.2, 0.2, np.nan, np.nan]))
    time, noise, method = np.array([[11.0], [np.nan], [11.0], [np.nan]]), 0.24, 0.32
    mean, by_noise, by_method = level.combined(time, np.full((4, 1), noise), np.full((4, 1), method))
    np.testing.assert_allclose(mean[:, 0], [10 + 0.04 / 0.2, 10, 11, np.nan])
    total = np.hypot(by_noise, by_method)[:, 0]
    np.testing.assert_allclose(total[:3], [np.sqrt(0.032), 0.2, 0.4])


def test_corrections_of_another_surface_are_refused():
    green, infrared = (xr.Dataset(attrs=attributes) for attributes in ({}, {"infrared_surface": 1}))
    check_surface(green, infrared=False)
    check_surface(infrared, infrared=True)
    with pytest.raises(
        UserError, match="from green light, but depths count from infrared light: take one of depth-bias"
    ):
        check_surface(green, infrared=True)
    must_refuse("from infrared light, but depths count from green light", check_surface, infrared, infrared=False)
