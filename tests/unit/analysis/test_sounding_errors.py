"""Errors of soundings against exact rays, and orders of surveys against the limits of the standard."""

import numpy as np
import pytest

from mitransient_lidar.analysis.depth_uncertainty import SURVEY_ORDERS, order_met, shift_by_pointing, shift_by_slope

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
