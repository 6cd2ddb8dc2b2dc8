"""Uncertainties of depths, and errors of soundings."""

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import nnls

from mitransient_lidar.analysis.depth_uncertainty import (
    SURVEY_ORDERS,
    TrajectoryErrors,
    non_negative_line,
    order_met,
    shift_by_pointing,
    shift_by_slope,
    sounding_uncertainty,
    write_fits,
)
from mitransient_lidar.analysis.waveforms.depth_correction import AXES

WINDS, WATERS, DEPTHS = [1.0, 3.0, 5.0, 7.0, 9.0], ["III", "1C", "3C", "5C", "7C", "9C"], np.array([2.0, 4.0, 8.0])
SLOPE = 0.05


def table(corrected=True):
    """Errors sqrt(a^2 + (b d)^2) of the first channel, a rising with wind and b with water; twice that of the second.

    Bias and spread are 0.6 and 0.8 of it, and half and a quarter of them after correction.
    """
    axes = dict(zip(AXES, ([20.0], WINDS, WATERS, DEPTHS), strict=True))
    grid = xr.Dataset(coords={**axes, "estimator": ["gaussian"], "pixel": ["first", "second"]})
    a = 0.01 * grid["wind_speed"]
    b = 0.002 * (1 + xr.DataArray(np.arange(6), dims="water"))
    channel = xr.DataArray([1.0, 2.0], dims="pixel")
    error = channel * np.hypot(a, b * grid["depth"]) * xr.ones_like(grid["off_nadir_deg"])
    error = error.expand_dims(estimator=1).transpose(*AXES, "estimator", "pixel")
    one = xr.ones_like(error)
    data = {"bias": -0.6 * error, "spread": 0.8 * error, "found": one, "error": 0.1 * one, "snr": one.isel(estimator=0)}
    if corrected:
        data |= {"corrected_bias": 0.3 * error, "corrected_spread": 0.4 * error}
    for name in ("slope_along", "slope_across"):
        data[name] = SLOPE * one.isel(estimator=0, pixel=0, drop=True)
    attributes = {"instrument": "made", "altitude": 500.0, "refractive_index": 1.34, "divergence_mrad": 0.4}
    return xr.Dataset(data).assign_coords(grid.coords).assign_attrs(attributes)


def test_fit_is_the_non_negative_least_squares_of_another_solver():
    random = np.random.default_rng(1)
    kinds = set()
    for _ in range(300):
        x, y = random.uniform(0, 10, 4), random.normal(0.3, 1.0, 4)
        found = non_negative_line(x, y)
        expected, _ = nnls(np.stack([np.ones(4), x], axis=1), y)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        kinds.add((expected[0] > 0, expected[1] > 0))
    assert len(kinds) == 4
    assert non_negative_line([1.0, 2.0, 5.0], [7.0, np.nan, 15.0]) == pytest.approx((5.0, 2.0))
    assert non_negative_line([1.0, 2.0], [np.nan, 3.0]) == (3.0, 0.0)
    assert np.isnan(non_negative_line([1.0, 2.0], [np.nan, np.nan])).all()


def test_fits_return_the_law_that_errors_follow():
    found = sounding_uncertainty(table())
    for wind in WINDS:
        for number, water in enumerate(WATERS):
            cell = found.sel(wind_speed=wind, water=water, off_nadir_deg=20)
            np.testing.assert_allclose(cell["vertical_a"], np.array([1, 0.5]) * 0.01 * wind, rtol=1e-9)
            np.testing.assert_allclose(cell["vertical_b"], np.array([1, 0.5]) * 0.002 * (1 + number), rtol=1e-9)
    assert np.abs(found["vertical_residual"]).max() < 1e-12
    assert set(found["channel"].values.flat) == {"first"}


def test_totals_are_sums_of_squares_with_the_factors_of_normal_errors():
    """Without waves and beam, and at nadir, the totals are those of position and pointing."""
    made = table(corrected=False).assign_coords(off_nadir_deg=[0.0])
    made.attrs["divergence_mrad"] = 1e-9
    made["slope_along"][:], made["slope_across"][:] = 0.0, 0.0
    trajectory = TrajectoryErrors(pointing_mrad=0.2, position_m=0.03, height_m=0.04)
    found = sounding_uncertainty(made, trajectory).isel(correction=0, off_nadir_deg=0)
    assert found.sizes["depth"] == 3
    vertical = found["subaqueous_vertical"]
    np.testing.assert_allclose(found["tvu"], 1.96 * np.sqrt(vertical**2 + 0.04**2))
    pointing = 2e-4 * (500 + DEPTHS / 1.34)
    expected = 2.45 * np.sqrt(pointing**2 + 0.03**2)
    np.testing.assert_allclose(found["thu"].isel(wind_speed=0, water=0), expected, rtol=1e-9)
    # Errors of 1 cm and 9 cm at the shallowest depth, and 13 cm at the deepest.
    orders = found["order"].values
    assert SURVEY_ORDERS[orders[0, 0, 0]].name == "exclusive"
    assert SURVEY_ORDERS[orders[-1, -1, -1]].name == "1a/1b"


def test_horizontal_part_has_refraction_by_slopes_and_the_beam():
    found = sounding_uncertainty(table()).isel(off_nadir_deg=0, wind_speed=2, water=0)
    theta = np.radians(20)
    water = np.arcsin(np.sin(theta) / 1.34)
    turn = 1 - np.cos(theta) / (1.34 * np.cos(water))
    beam = 0.5 * 0.4e-3 * 500
    along = np.hypot(SLOPE * turn / np.cos(water) ** 2 * DEPTHS, beam / np.cos(theta) ** 2)
    across = np.hypot(SLOPE * turn * DEPTHS, beam / np.cos(theta))
    np.testing.assert_allclose(found["subaqueous_horizontal"], np.sqrt(0.5 * (along**2 + across**2)))
    line = np.polyfit(DEPTHS, found["subaqueous_horizontal"], 1)
    np.testing.assert_allclose([found["horizontal_b"], found["horizontal_a"]], line)


def test_lost_bottoms_have_no_uncertainty():
    made = table()
    place = {"wind_speed": 4, "water": 5, "depth": 2}
    made["found"][{**place, "pixel": 0}] = 0.4
    found = sounding_uncertainty(made)
    # The second channel still finds it, with twice the error.
    assert found["channel"].isel(place).item() == "second"
    assert found["subaqueous_vertical"].isel({**place, "correction": 0}).item() == pytest.approx(
        2 * np.hypot(0.09, 0.012 * 8)
    )
    made["found"][place] = 0.4
    found = sounding_uncertainty(made).isel(wind_speed=4, water=5, off_nadir_deg=0)
    lost = found.isel(depth=2)
    assert np.isnan(lost["tvu"]).all()
    assert np.isnan(lost["thu"])
    assert (lost["order"] == -1).all()
    assert lost["channel"].item() == ""
    np.testing.assert_allclose(found["vertical_a"], [0.09, 0.045])
    for first, constant in ((1, np.array([1, 0.5]) * np.hypot(0.09, 0.012 * 2)), (0, [np.nan, np.nan])):
        made["found"][{**place, "depth": slice(first, 3)}] = 0.0
        found = sounding_uncertainty(made).isel(wind_speed=4, water=5, off_nadir_deg=0)
        np.testing.assert_allclose(found["vertical_a"], constant)
        np.testing.assert_allclose(found["vertical_b"], 0 * np.asarray(constant))


def test_file_of_fits_has_the_rows_that_uncertainty_tools_take_by_their_number(tmp_path):
    """Row 6 w + k belongs to the wind w of five and the water k of six."""
    found = sounding_uncertainty(table()).isel(off_nadir_deg=0)
    write_fits(found.sel(correction="none"), "vertical", tmp_path / "fits.csv")
    lines = (tmp_path / "fits.csv").read_text().splitlines()
    assert lines[0] == "Wind,JerlovType,a,b"
    assert len(lines) == 31
    assert [lines[1], lines[1 + 6 * 2 + 3]] == ["1,III,0.01,0.002", "5,5C,0.05,0.008"]
    assert lines[30].startswith("9,9C,0.09,")


INDEX = 1.34
STEP = 1e-5


def refracted(direction, normal):
    """Direction in the water of a ray, by the law of refraction for vectors; the normal points up."""
    cos_air = -direction @ normal
    cos_water = np.sqrt(1 - (1 - cos_air**2) / INDEX**2)
    return direction / INDEX + (cos_air / INDEX - cos_water) * normal


def on_bottom(off_nadir, depth, slope_x=0.0, slope_y=0.0):
    """Place where the ray through the origin of a tilted plane meets a level bottom."""
    normal = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    ray = refracted(np.array([np.sin(off_nadir), 0.0, -np.cos(off_nadir)]), normal)
    return depth / -ray[2] * ray[:2]


@pytest.mark.parametrize("degrees", [0, 10, 20, 40])
def test_shift_by_slope_is_that_of_a_ray_through_a_tilted_plane(degrees):
    off_nadir, depth = np.radians(degrees), 7.0
    along, across = shift_by_slope(off_nadir, INDEX)
    # Central differences err by the square of the step only. The sign does not matter for a standard deviation.
    difference_x = on_bottom(off_nadir, depth, STEP) - on_bottom(off_nadir, depth, -STEP)
    difference_y = on_bottom(off_nadir, depth, 0.0, STEP) - on_bottom(off_nadir, depth, 0.0, -STEP)
    assert abs(difference_x[0]) / (2 * STEP * depth) == pytest.approx(along, rel=1e-8)
    assert abs(difference_y[1]) / (2 * STEP * depth) == pytest.approx(across, rel=1e-8)
    assert degrees or along == pytest.approx(1 - 1 / INDEX)


@pytest.mark.parametrize("degrees", [0, 15, 35])
def test_shift_by_pointing_is_that_of_turned_rays_of_the_same_lengths(degrees):
    height, depth = 300.0, np.array([2.0, 9.0])
    angle = np.radians(degrees)
    cos_water = np.sqrt(1 - (np.sin(angle) / INDEX) ** 2)
    level = np.array([0.0, 0.0, 1.0])

    def end(tilt_along, tilt_across, lengths):
        """End of a ray in air and water of given lengths, at a place where the turned axis is measured."""
        turned = angle + tilt_along
        ray = np.array([np.sin(turned), 0.0, -np.cos(turned)])
        ray = np.array([ray[0] * np.cos(tilt_across), np.sin(tilt_across), ray[2] * np.cos(tilt_across)])
        below = refracted(ray, level)
        return height * level + lengths[0] * ray + lengths[1] * below

    along, across, up = shift_by_pointing(angle, height, depth, INDEX)
    for number, one in enumerate(depth):
        lengths = height / np.cos(angle), one / cos_water
        by_angle = (end(STEP, 0.0, lengths) - end(-STEP, 0.0, lengths)) / (2 * STEP)
        sideways = (end(0.0, STEP, lengths) - end(0.0, -STEP, lengths)) / (2 * STEP)
        assert by_angle[2] == pytest.approx(up[number], rel=1e-8, abs=1e-6)
        assert sideways[1] == pytest.approx(across[number], rel=1e-8)
        # The place is that of the turned ray on the level sea and the level bottom.
        places = []
        for turn in (STEP, -STEP):
            sea = height * np.tan(angle + turn)
            water = np.arcsin(np.sin(angle + turn) / INDEX)
            places.append(sea + one * np.tan(water))
        assert (places[0] - places[1]) / (2 * STEP) == pytest.approx(along[number], rel=1e-8)


def test_orders_at_their_limits():
    """Table 1 of S-44: at 10 m special order allows sqrt(0.25^2 + 0.075^2) = 0.2610 m, order 1 allows 5.5 m across."""
    names = [one.name for one in SURVEY_ORDERS]
    limits = {"exclusive": 0.167705, "special": 0.261008, "1a/1b": 0.516624, "2": 1.026109}
    for place, name in enumerate(names):
        assert float(SURVEY_ORDERS[place].largest_tvu(10.0)) == pytest.approx(limits[name], abs=1e-6)
        assert order_met(10.0, limits[name] - 1e-5, 0.5) == place
        assert order_met(10.0, limits[name] + 1e-5, 0.5) == place + 1
    np.testing.assert_array_equal(
        order_met(10.0, 0.1, [0.99, 1.01, 2.01, 5.49, 5.51, 20.9, 21.1]), [0, 1, 2, 2, 3, 3, 4]
    )
    np.testing.assert_array_equal(order_met([1.0, 2.0], [np.nan, 0.1], [0.1, np.nan]), [-1, -1])
