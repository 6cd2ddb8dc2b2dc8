"""The published effects of waves on echoes (figures 10 and 11), in the scenes that ship.

They hold at the places of these scenes, on automatic cells, and for the highest points of the waveforms: at other
places of the same slopes a few facets make other echoes.
"""

import numpy as np
import pytest

import mitransient_lidar
from mitransient_lidar.loading import scenes as loading
from mitransient_lidar.rendering.shots import truth as sea_map
from mitransient_lidar.studies.shot_statistics import highest_points

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def surface_echoes():
    """Mean of the pixels' peaks [W], and time of each pixel's peak [ns], for the three shots."""
    found = []
    for number in (1, 2, 3):
        shot = mitransient_lidar.render(f"fig10_shot{number}", passes=24)
        heights, times = highest_points(shot, 1409.0, 1432.0)
        found.append((heights.mean(), times))
    return found


def test_face_towards_the_lidar_is_four_to_five_times_brighter(surface_echoes):
    """The sum of the pixels' largest powers: 4.2 and 4.1."""
    first, second, third = (peak for peak, _ in surface_echoes)
    assert 4 < first / second < 5
    assert 4 < first / third < 5


def test_red_comes_before_green_as_the_sideways_slope_says(surface_echoes):
    """The sea rises to the left, where red looks: red's face is higher, and nearer."""
    scene = loading.open_scene("fig10_shot1").scene
    along, across = sea_map.SeaMap.of_scene(scene).slope_at(-59.52, 57.68)
    assert np.degrees(np.arctan([along, across])) == pytest.approx([1.9, 2.8], abs=0.1)
    red, green = surface_echoes[0][1][:2]
    assert 0.5 < green - red < 2
