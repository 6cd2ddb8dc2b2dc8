"""Light maps below a level sea against renders of one."""

import numpy as np
import pytest
import significance
from rows import must_refuse, refuses

import mitransient_lidar
from mitransient_lidar.core.errors import UserError

LEVEL = {"spectrum": "flat"}


def look(scene, params, **options):
    return mitransient_lidar.render(scene, params, light="level", components=True, **options)


def by_origin(dataset, origin):
    """Return energies of an origin by pixel, their standard errors, and mean times [ns]."""
    energy = dataset["impulse_response_by_origin"].sel(origin=origin)
    error = np.sqrt((dataset["impulse_response_by_origin_stderr"].sel(origin=origin) ** 2).sum("time"))
    total = energy.sum("time")
    return total.values, error.values, ((energy * energy["time"]).sum("time") / total).values


@pytest.mark.slow
@pytest.mark.parametrize(
    ("params", "water"),
    [
        # The last one has these pixels, too.
        pytest.param({"layout": "2x2"}, 0.02, marks=pytest.mark.long),
        pytest.param({"layout": "1x1", "field_of_view_mrad": 5, "divergence_mrad": 0.5}, 0.02, marks=pytest.mark.long),
        pytest.param(
            *({"layout": "1x4", "off_nadir_deg": 5, "wind_speed": 10, "wind_direction_deg": 60}, 0.02),
            marks=pytest.mark.long,
        ),
        ({"layout": "2x2", "wind_speed": 6, "wind_direction_deg": 150, "slope_distribution": "gram_charlier"}, 0.02),
    ],
    ids=["four", "narrow", "strips", "skewed slopes"],
)
def test_level_sea_agrees_with_renders(params, water):
    """Levels and times of each pixel; the water lacks light that turned twice."""
    params = {**LEVEL, **params}
    few = {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14}
    rendered = mitransient_lidar.render("table1", params=params, integrator=few, passes=12, components=True, seed=3)
    found = look("table1", params, passes=32, seed=significance.seed_shift)
    for origin, bias, shift in (("surface", 0.012, 0.05), ("water", water, 0.3), ("bottom", 0.01, 0.1)):
        energy, error, time = by_origin(found, origin)
        wanted, spread, arrival = by_origin(rendered, origin)
        # 32 and twelve passes, the largest of four pixels.
        limit = significance.largest_z(12, 4) * np.hypot(error, spread)
        assert np.all(abs(energy - wanted) < limit + bias * wanted), origin
        assert np.all(abs(time - arrival) < shift + 8 * limit / wanted), origin


def test_first_look_has_eight_passes_and_is_rendered_again():
    found = look("table1", {**LEVEL, "jerlov": "1C"})
    assert (found.attrs["light"], found.attrs["passes"]) == ("level", 8)
    np.testing.assert_allclose(found["waveform_by_origin"].sum("origin"), found["waveform"], rtol=1e-12)
    np.testing.assert_array_equal(mitransient_lidar.render(found)["waveform"], found["waveform"])


@refuses(
    ("table1", {"altitude": -3}, "the lidar is under water"),
    ("table1", {"off_nadir_deg": 60}, "more than 45 degrees from nadir"),
    ("table1", {"scattering": 2.5, "attenuation": 3}, "light scatters 21 times on its way"),
    ("ship_wake", {}, "its water has bubbles"),
    ("fresh_water_lens", {}, "several refractive indices"),
)
def test_scenes_that_the_model_is_not_for(scene, params):
    look(scene, params)


def test_series_and_derivatives_need_other_light():
    with pytest.raises(UserError, match="light = 'level' must be one of merging, maps"):
        mitransient_lidar.render_shots("table1", LEVEL, count=2, light="level")
    must_refuse("light = 'level' has no derivatives", look, "table1", LEVEL, derivatives="attenuation")


@pytest.mark.slow
def test_images_have_rays_for_each_pixel():
    """They had the 1024 rays of a single waveform for 4096 pixels; sums agree with a level sea's merged light."""
    gates = {"gate_start_ns": 1425, "gate_width_ns": 8, "gate_step_ns": 10, "gate_count": 6}
    params = {**LEVEL, **gates, "layout": "64x64"}
    image = mitransient_lidar.render("table1", params, light="level", passes=8)
    assert image.attrs["error_median"] < 0.2
    merged = mitransient_lidar.render("table1", params | {"layout": "1x1"}, light="merging", passes=16)
    total, error = image["gate_energy"].sum(("row", "column")), image["gate_energy_stderr"]
    error = np.hypot(np.sqrt((error**2).sum(("row", "column"))), merged["gate_energy_stderr"].squeeze())
    difference = total - merged["gate_energy"].squeeze()
    assert (np.abs(difference) < 0.01 * total + significance.largest_z(6) * error).all()
