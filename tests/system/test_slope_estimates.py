"""Slopes, bottoms and waters estimated from rendered shots, against what was rendered."""

import math

import numpy as np
import pytest
import xarray as xr

import mitransient_lidar
from mitransient_lidar import estimates, resources, shot_series
from mitransient_lidar.optics.known_waters import InherentProperties

TILTS = ((-0.15, 0.0), (-0.075, 0.07), (0.0, 0.0), (0.075, -0.07), (0.15, 0.0))


@pytest.fixture(scope="module")
def planes(tmp_path_factory):
    """Shots of one water and bottom through plane sea surfaces that differ in slope alone: no wave focuses."""
    folder = tmp_path_factory.mktemp("planes")
    text = resources.scene_text("fig09_2x2")
    surface = '<string  name="spectrum"           value="$spectrum"/>'
    assert surface in text
    text = text.replace(surface, f'{surface}<string name="filename" value="$map"/>')
    text = text.replace('<scene version="3.0.0">', '<scene version="3.0.0"><default name="map" value=""/>')
    (folder / "plane.xml").write_text(text, "utf-8")
    params = {"spectrum": "height_map", "slope_variance": 0.1, "bottom_depth": 10, "bottom_reflectivity": 0.3}
    params |= {"attenuation": 0.45, "scattering": 0.05, "backscattering": 0.0015, "divergence_mrad": 4}
    lines = np.linspace(-20, 20, 81)
    shots = []
    for along, across in TILTS:
        name = str(folder / f"{along}.npz")
        np.savez(name, heights=along * lines + across * lines[:, np.newaxis], x=lines, y=lines)
        shots.append(
            mitransient_lidar.render(str(folder / "plane.xml"), params={**params, "map": name}, passes=3, seed=2)
        )
    return xr.concat(shots, "shot", combine_attrs="override").assign_coords(shot=np.arange(len(shots)))


def test_slopes_of_planes(planes):
    """Within 0.05: the steep face away leaves little echo, and pixels cut the beam where it is uneven."""
    found = estimates.surface_slopes(planes)
    along, across = np.array(TILTS).T
    np.testing.assert_allclose(found["slope_along"], along, atol=0.05)
    np.testing.assert_allclose(found["slope_across"], across, atol=0.02)
    np.testing.assert_allclose(found["surface_height"], 0, atol=0.05)


def test_correction_halves_what_slope_does_to_the_bottom(planes):
    found = estimates.bottom(planes, estimates.surface_slopes(planes))
    energy, reflectivity = np.log(found["bottom_energy"]), np.log(found["reflectivity"])
    spread = float(energy.std())
    # 0.8 exp(-2 K s) is a tenth of a metre of path per 0.08 of slope: some percents at least.
    assert spread > 0.03
    assert float(reflectivity.sel(correction="slope").std()) < 0.5 * spread
    assert float(reflectivity.sel(correction="column").std()) < 0.5 * spread
    depth = found["depth_m"]
    assert float(depth.sel(correction="level").std()) > 0.04
    assert float(depth.sel(correction="slope").std()) < 0.5 * float(depth.sel(correction="level").std())
    np.testing.assert_allclose(depth.sel(correction="slope"), 10.0, atol=0.1)
    # Scale: the column's backscatter of 180 degrees is known from its level alone.
    np.testing.assert_allclose(found["reflectivity"].sel(correction=["slope", "column"]), 0.3, rtol=0.2)


@pytest.fixture(scope="module")
def sea():
    params = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15, "layout": "1x4"}
    return shot_series.render_shots("fig09_2x2", params, count=20, passes=2)


def test_slopes_on_a_sea(sea):
    """200 shots had a correlation of 0.83: with 20, Fisher's z lies 4.3 of its standard errors below once in 1e5."""
    found = estimates.surface_slopes(sea, slope_deviation=tuple(sea.attrs["slope_deviation"]))
    truth, guess = sea["true_slope_along"].values, found["slope_along"].values
    correlation = float(np.corrcoef(truth, guess)[0, 1])
    assert math.atanh(correlation) > math.atanh(0.83) - 4.3 / math.sqrt(20 - 3)
    # The whole sea's slopes are 3.1 degrees; knowing none of them errs by as much.
    assert np.sqrt(np.mean((guess - truth) ** 2)) < np.sqrt(np.mean(truth**2))
    assert np.isfinite(guess).all()
    assert np.allclose(found["slope_across"], 0)


def test_the_column_takes_out_what_the_sea_does_to_the_bottom(sea):
    """Its energy varies by 8 %, by focusing more than by slope; the ratio to the column was left with 1.4 %."""
    slopes = estimates.surface_slopes(sea, slope_deviation=tuple(sea.attrs["slope_deviation"]))
    found = estimates.bottom(sea, slopes)
    spread = float(np.log(found["bottom_energy"]).std())
    assert float(np.log(found["reflectivity"].sel(correction="column")).std()) < 0.5 * spread
    assert float(found["reflectivity"].sel(correction="column").mean()) == pytest.approx(0.1, rel=0.1)
    depth = found["depth_m"]
    assert float(depth.sel(correction="slope").std()) < 0.7 * float(depth.sel(correction="level").std())


@pytest.mark.parametrize(
    ("absorption", "scattering", "backscattering"),
    [(0.0532, 0.124, 0.00196), (0.179, 0.219, 0.00293), (0.0951, 0.432, 0.00944)],
    ids=["jerlov IB", "petzold coastal", "jerlov 1C"],
)
def test_waters(absorption, scattering, backscattering):
    """Kd and bb within 25 %: ten waters came within 13 and 10 % with many passes. Of c no more than bounds."""
    params = {"attenuation": absorption + scattering, "scattering": scattering, "backscattering": backscattering}
    params |= {"bottom_depth": 60, "time_start_ns": 1395, "bin_count": 104}
    found = estimates.water(mitransient_lidar.render("fig09_1x1", params=params, passes=4, seed=4))
    kd = InherentProperties(absorption, scattering, backscattering).kd
    assert float(found["kd"]) == pytest.approx(kd, rel=0.25)
    assert float(found["backscattering"]) == pytest.approx(backscattering, rel=0.25)
    assert found["attenuation_low"] < absorption + scattering < found["attenuation_high"]
