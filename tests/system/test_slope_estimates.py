"""Slopes, bottoms and waters estimated from rendered shots, against what was rendered."""

import math

import numpy as np
import pytest
import xarray as xr
from oracles.lidar_equation import column_power
from rows import each_row

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.analysis.retrieval import retrieve
from mitransient_lidar.physics.lidar.lidar_geometry import LidarGeometry, LidarSystem
from mitransient_lidar.physics.lidar.pulse import Pulse, waveform
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.rendering.shots import series as shot_series

#: Slopes along and across.
TILTS = ((-0.15, 0.0), (0.0, 0.07), (0.15, -0.07))


@pytest.fixture(scope="module")
def planes(tmp_path_factory):
    """Shots of one water and bottom through plane sea surfaces that differ in slope alone: no wave focuses.

    After 6 passes a slope varies by 0.002 along and 0.004 across from seed to seed; after 2 some fits end elsewhere.
    """
    folder = tmp_path_factory.mktemp("planes")
    params = {"spectrum": "height_map", "slope_variance": 0.1, "bottom_depth": 10, "bottom_reflectance": 0.3}
    params |= {"attenuation": 0.45, "scattering": 0.05, "backscattering": 0.0015, "divergence_mrad": 4}
    # One record for all slopes.
    params |= {"time_start_ns": 1370, "bin_count": 260}
    lines = np.linspace(-20, 20, 81)
    shots = []
    for along, across in TILTS:
        name = str(folder / f"{along}.npz")
        np.savez(name, heights=along * lines + across * lines[:, np.newaxis], x=lines, y=lines)
        shots.append(mitransient_lidar.render("fig09_2x2", params={**params, "filename": name}, passes=6, seed=2))
    return xr.concat(shots, "shot", combine_attrs="override").assign_coords(shot=np.arange(len(shots)))


@pytest.mark.slow
def test_correction_halves_what_slope_does_to_the_bottom(planes):
    found = retrieve.bottom(planes, retrieve.surface_slopes(planes))
    energy, reflectance = np.log(found["bottom_energy"]), np.log(found["reflectance"])
    spread = float(energy.std())
    # 0.8 exp(-2 K s) is a tenth of a metre of path per 0.08 of slope: some percents at least.
    assert spread > 0.03
    assert float(reflectance.sel(correction="slope").std()) < 0.5 * spread
    assert float(reflectance.sel(correction="column").std()) < 0.5 * spread
    depth = found["depth_m"]
    assert float(depth.sel(correction="level").std()) > 0.04
    assert float(depth.sel(correction="slope").std()) < 0.5 * float(depth.sel(correction="level").std())
    np.testing.assert_allclose(depth.sel(correction="slope"), 10.0, atol=0.1)
    # Scale: the column's backscatter of 180 degrees is known from its level alone.
    np.testing.assert_allclose(found["reflectance"].sel(correction=["slope", "column"]), 0.3, rtol=0.2)


@pytest.fixture(scope="module", params=["2x2", "1x4"])
def sea(request):
    params = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15, "layout": request.param}
    return shot_series.render_shots("fig09_2x2", params, count=24, passes=2)


WATERS = {
    "jerlov IB": (0.0532, 0.124, 0.00196),
    "petzold coastal": (0.179, 0.219, 0.00293),
    "jerlov 1C": (0.0951, 0.432, 0.00944),
}


@each_row("name", WATERS)
def test_waters_in_closed_form(name):
    """Columns of the lidar equation, and Kd of an independent Monte Carlo study; nothing is rendered.

    In quasi-single scattering (Gordon 1982, doi:10.1364/AO.21.002996) the column in a wide view has the level of single
    scattering by bb and decays with a + bb; light scattered more often adds to it. For the sun at the zenith,
    Kirk (1984), doi:10.4319/lo.1984.29.2.0350, found Kd = sqrt(a^2 + 0.235 a b) for a phase function of Petzold: 3 to
    12 % above the relation of Lee, Du and Arnone (2005) that the retrieval uses. Limits are of size.
    """
    absorption, scattering, backscattering = WATERS[name]
    angle, index, group = math.radians(20), 1.34, 1.364
    system = LidarSystem(200.0, angle, index, group, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
    time = TimeAxis(1390.0, 0.5, 160)
    geometry = LidarGeometry(200.0, angle, index, group)
    depth = geometry.depth_of_time(time.centres_ns)
    water = WaterColumn([0.0], [absorption + scattering], [scattering], [backscattering])
    backward_phase = backscattering / (2 * math.pi * scattering)
    power = column_power(system, water, backward_phase, np.maximum(depth, 0), angle, "a+bb")
    # A surface echo of 0.2 pJ, all in one bin before the pulse.
    instant = np.where(depth > 0, power, 0)
    instant[np.argmax(depth > 0)] += 2e-13 / 0.5e-9
    pulsed = waveform(instant[np.newaxis] * 0.5e-9, 0.5, Pulse.gaussian(4.0).kernel(0.5))
    attributes = {"altitude": 200.0, "off_nadir_deg": 20.0, "refractive_index": index, "group_index": group}
    attributes |= {"pulse_fwhm_ns": 4.0, "pulse_energy_mj": 5.0, "aperture_area": 0.025, "divergence_mrad": 0.1}
    attributes |= {"field_of_view_mrad": 60.0}
    arrays = [pulsed * 0.5e-9, 0 * pulsed, pulsed, 1e-4 * pulsed + 1e-12]
    options = {"time": time, "pixel_names": ["all"], "pixel_centres_mrad": [(0.0, 0.0)], "attributes": attributes}
    found = retrieve.water(results.build(*arrays, **options), efficiency=0.81 * 0.9)
    assert float(found["column_attenuation"]) == pytest.approx(absorption + backscattering, rel=1e-3)
    assert absorption < float(found["absorption"]) < absorption + backscattering
    assert 0.75 * backscattering < float(found["backscattering"]) < 0.97 * backscattering
    kirk = math.sqrt(absorption**2 + 0.235 * absorption * scattering)
    assert 0.87 * kirk < float(found["kd"]) < 0.98 * kirk
