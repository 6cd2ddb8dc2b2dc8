"""Forecasts of sites: maps from tables in closed form, sentences, refusals, and a small forecast with its light."""

import numpy as np
import pytest
import rasterio
import xarray as xr
from rows import each_case, refuses

from mitransient_lidar.studies import forecast as study
from mitransient_lidar.studies.forecast import describe_forecast, forecast, write_maps

#: Depth times Kd at which half of the bottoms are found, and the width of the fall.
HALF, WIDTH = 1.6, 0.1


def chance(depth, kd):
    return 1 / (1 + np.exp((np.asarray(depth) * kd - HALF) / WIDTH))


@pytest.fixture
def tables(monkeypatch):
    """Tables of bottoms that are found by the product of depth and Kd, with errors of a hundredth of the depth."""

    class Bottoms:
        def __init__(self, instrument, scene, params, *_):
            self.kd = {"kd": params.get("kd"), "secchi": params and 1.6 / params.get("secchi", 8.0)}
            self.kd = self.kd["kd"] or self.kd["secchi"]

        def table(self, site, further, corrections):
            low, high = site.min(), further * site.max()
            depth = np.append(np.arange(low, high, 0.1), high)
            dims = ("off_nadir_deg", "wind_speed", "water", "depth", "estimator", "pixel")
            errors = {"bias": 0.01 * depth, "spread": 0 * depth, "error": 0.01 * depth, "found": chance(depth, self.kd)}
            data = {name: (dims, values.reshape(1, 1, 1, -1, 1, 1)) for name, values in errors.items()}
            data |= {name: (dims[:4], np.zeros((1, 1, 1, depth.size))) for name in ("slope_along", "slope_across")}
            attributes = {"instrument": "it", "altitude": 150.0, "refractive_index": 1.34, "divergence_mrad": 2.0}
            coords = {"off_nadir_deg": [20.0], "wind_speed": [5.0], "water": [0], "depth": depth}
            coords |= {"estimator": ["gaussian"], "pixel": ["single"]}
            return xr.Dataset(data, coords, {**attributes, "off_nadir_deg": 20.0, "wind_speed": 5.0, "gain": 0.5})

    monkeypatch.setattr(study, "_Bottoms", Bottoms)


def geotiff(path, values, cell=2.0, corner=(500000.0, 6500000.0)):
    """Write values with the northernmost row first, in EPSG:32633."""
    values = np.asarray(values, np.float32)
    place = rasterio.Affine(cell, 0, corner[0], 0, -cell, corner[1])
    about = {"crs": "EPSG:32633", "transform": place, "nodata": -9999.0, "dtype": "float32", "count": 1}
    with rasterio.open(path, "w", driver="GTiff", width=values.shape[1], height=values.shape[0], **about) as file:
        file.write(values, 1)
    return path


@pytest.fixture
def site(tmp_path):
    """Land, a cell without data, a shallow one, and depths of 2 to 12 m; water rises to the east."""
    heights = [[1.0, -9999.0, -0.2, -2.0], [-4.0, -6.0, -8.0, -12.0]]
    waters = [[0.1, 0.15, 0.2, 0.3], [0.1, 0.15, 0.2, 0.3]]
    return geotiff(tmp_path / "site.tif", heights), geotiff(tmp_path / "kd.tif", waters)


def test_a_map_has_the_numbers_of_depth_and_water(tables, site, tmp_path):
    found = forecast("riegl_vq840g", site[0], kd=site[1])
    # Rows run to the north: the first is the southern one.
    depth, kd = np.array([4.0, 6.0, 8.0, 12.0]), np.array([0.1, 0.15, 0.2, 0.3])
    np.testing.assert_allclose(found["found"].values[0], chance(depth, kd), atol=0.01)
    np.testing.assert_allclose(found["deepest"].values[0], HALF / kd, rtol=0.005)
    # Half or more: with 12 m x 0.3 1/m and 8 m x 0.2 1/m at the limit and beyond.
    assert np.isfinite(found["tvu"].values[0, :2]).all()
    assert np.isnan(found["tvu"].values[0, 3])
    np.testing.assert_array_equal(found["order"].values[1], [-2, np.nan, np.nan, 0])
    assert np.isnan(found["found"].values[1, :3]).all()
    lines = describe_forecast(found)
    assert "1 of 8 cells are land" in lines
    assert "1 of 8 cells are shallower than 0.5 m" in lines
    assert "1 of 8 cells have no data" in lines
    assert lines[-1].endswith("beyond 5.3 to 16.0 m the bottom is lost")
    write_maps(found, tmp_path / "maps.tif")
    with rasterio.open(tmp_path / "maps.tif") as file, rasterio.open(site[0]) as given:
        assert file.descriptions == ("found", "tvu", "thu", "order", "deepest")
        assert (file.transform, file.crs) == (given.transform, given.crs)
        np.testing.assert_allclose(file.read(1)[::-1], found["found"].values, rtol=1e-6)


def test_a_range_of_depths(tables):
    found = forecast("riegl_vq840g", "2:10", secchi=8)
    assert describe_forecast(found)[-1] == (
        f"{100 * np.mean(found['depth'] <= 8):.0f} % of the range of depths meets order 1a/1b; "
        "beyond 8.0 m the bottom is lost"
    )
    # The bias alone, and the default errors of pointing and height, as the TVU's formula has them.
    at = found.sel(depth=5, method="nearest")
    up = 1e-4 * (150 * np.tan(np.radians(20)))
    assert float(at["tvu"]) == pytest.approx(1.96 * np.hypot(0.01 * float(at["depth"]), np.hypot(0.05, up)), rel=0.02)


@each_case(
    ("2:4", {}, "; the bottom is found down to the deepest place, 4.0 m"),
    ("9:15", {}, "the bottom is found nowhere in the range of depths"),
    ("2:4", {"height_m": 0.4}, "no part of the range of depths meets order 1a/1b, and 100 % order 2; "),
    ("2:4", {"height_m": 2.0}, "no part of the range of depths meets any order; "),
)
def test_sentences_of_the_extremes(site, options, sentence, tables):
    assert sentence in describe_forecast(forecast("riegl_vq840g", site, secchi=8, **options))[-1]


@refuses(
    ("no:3", {}, "site = 'no:3' must be a map, or a range of depths such as 1:20"),
    ("0.1:0.3", {}, "must be deeper than 0.5 m somewhere, but is 0.3 m deep"),
    ("1:3", {"kd": 0.1, "values": "depths"}, "values = 'depths' needs a map: site = '1:3' is a range of depths"),
    ("1:3", {"kd": 0.1, "secchi": 5}, "secchi = 5 and kd = 0.1 are alternatives: give one of them"),
    ("1:3", {"kd": "map.tif"}, "must be a number, unless the site is a map"),
    ("1:3", {"params": {"bottom_depth": 2}}, "parameter bottom_depth follows from the site: leave it out"),
    ("1:3", {"instrument": "riegl_vq880g2_infrared"}, "has wavelength_nm = 1064: forecasts are of green light"),
    ("map", {"kd": "far"}, "must cover cells of the site that are deeper than"),
)
def test_refusals(site, options, tables, tmp_path):
    if site == "map":
        site = geotiff(tmp_path / "site.tif", [[-4.0, -6.0], [-8.0, -12.0]])
        options = {"kd": geotiff(tmp_path / "far.tif", [[0.1, 0.1], [0.1, 0.1]], corner=(600000.0, 6500000.0))}
    forecast(**{"instrument": "riegl_vq840g", "site": site, **options})


@pytest.mark.slow
def test_raised_bottoms_have_the_light_of_their_depth():
    """Displacing a bottom of 9 m by 3 m the wrong way would leave no echo where 6 m have theirs."""
    params = {"jerlov": "III", "wind_speed": 4}
    options = ("published_airborne", "table1", params, None, 6, 1, 3)
    raised, own = study._Bottoms(*options), study._Bottoms(*options)
    one, other = raised._by_maps([6.0], 9.0), own._by_maps([6.0], 6.0)
    energy = [float(series["impulse_response"].sum()) for series in (one, other)]
    assert energy[0] == pytest.approx(energy[1], rel=0.02)
    time = [series["waveform"].sum("pixel") for series in (one, other)]
    echo = [float(series.mean("shot").idxmax("time")) for series in time]
    assert abs(echo[0] - echo[1]) < 1.5


@pytest.mark.slow
def test_an_interrupted_render_ends_the_forecast(monkeypatch):
    monkeypatch.setattr(study, "render_shots", lambda *_, **__: xr.Dataset(attrs={"interrupted": 1}))
    with pytest.raises(KeyboardInterrupt):
        study._Bottoms("published_airborne", "table1", {"jerlov": "III"}, None, 6, 1, 3)._merged(9.0)


@pytest.mark.slow
def test_a_forecast_finds_shallow_bottoms_and_loses_deep_ones():
    found = forecast("riegl_vq840g", "2:25", {"jerlov": "3C", "wind_speed": 4}, shots=8, records=1)
    shares = found["table_found"].values[0]
    assert shares[0] == 1
    assert shares[np.isfinite(shares)][-1] == 0
    assert 4 < float(found["deepest"][0]) < 15
