"""Where to shoot: slopes under the beam, the picture of them, and how echoes go with them."""

import math
from itertools import pairwise

import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.loading import scenes
from mitransient_lidar.studies import shots

WAVES = {"wind_speed": 6, "bottom_depth": 5, "field_of_view_mrad": 15}


@pytest.fixture(scope="module")
def sea():
    return shots.SeaMap.of_scene(scenes.open_scene("fig09_2x2", WAVES).scene)


@pytest.mark.slow
def test_slopes_are_means_over_the_footprint(sea):
    """Against random points of a Gaussian of the footprint's mean radius, 1.1 m, on the heights themselves."""
    rng = np.random.default_rng(4)
    spacing = sea.x[1] - sea.x[0]
    radius = 1.064 / math.sqrt(math.cos(math.radians(20)))
    for x, y in ((sea.x[200], sea.y[10]), (sea.x[470], sea.y[333])):
        i, j = (np.rint((place + rng.normal(0, radius, 40_000) - lines[0]) / spacing).astype(int) % len(lines)
                for place, lines in ((x, sea.x), (y, sea.y)))  # fmt: skip
        right = (sea.heights[j, (i + 1) % len(sea.x)] - sea.heights[j, i - 1]) / (2 * spacing)
        up = (sea.heights[(j + 1) % len(sea.y), i] - sea.heights[j - 1, i]) / (2 * spacing)
        for drawn, mean in zip((right, up), sea.slope_at(x, y), strict=True):
            assert abs(drawn.mean() - mean) < largest_z(drawn.size, 4) * drawn.std() / 200 + 0.002


@pytest.mark.slow
def test_each_kind_of_shot_has_the_slope_that_it_is_named_for(sea):
    found = shots.find_shots("fig09_2x2", WAVES, slope_sigmas=1.5, count=3, waveforms=False).shots
    assert [shot.kind for shot in found] == [kind for kind in shots.SLOPE_KINDS for _ in range(3)]
    spread = sea.along.std(), sea.across.std()
    for shot in found:
        wanted = shots.SLOPE_KINDS[shot.kind]
        assert shot.along == pytest.approx(1.5 * wanted[0] * spread[0], abs=0.1 * spread[0])
        assert shot.across == pytest.approx(1.5 * wanted[1] * spread[1], abs=0.1 * spread[1])
        assert sea.slope_at(shot.x, shot.y) == pytest.approx((shot.along, shot.across))
    for first, second in pairwise(found):
        if first.kind == second.kind:
            assert math.hypot(first.x - second.x, first.y - second.y) > 4


@pytest.mark.slow
def test_depth_bias_is_that_of_a_ray_through_the_slope():
    """A ray traced with vectors through a tilted plane that meets it at the mean level, down to the bottom."""
    for slope in (-0.12, 0.0, 0.05):
        normal = np.array([-slope, 1.0]) / math.hypot(slope, 1)
        ray = np.array([math.sin(0.35), -math.cos(0.35)])
        cosine = -ray @ normal
        down = ray / 1.34 + (cosine / 1.34 - math.sqrt(1 - (1 - cosine**2) / 1.34**2)) * normal
        level = math.cos(math.asin(math.sin(0.35) / 1.34))
        expected = 5.0 / -down[1] * level - 5.0
        assert shots.depth_bias(np.array([slope]), 5.0, 0.35, 1.34)[0] == pytest.approx(expected, abs=1e-12)
    assert shots.depth_bias(np.array([-0.1]), 5.0, 0.35, 1.34)[0] < -0.03
