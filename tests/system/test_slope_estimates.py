"""Slopes, bottoms and waters estimated from rendered shots, against what was rendered."""

import numpy as np
import pytest
import xarray as xr

import mitransient_lidar
from mitransient_lidar.analysis.retrieval import retrieve
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
