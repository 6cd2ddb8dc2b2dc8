"""The published effects of waves on echoes (figures 10 and 11), in the scenes that ship.

They hold at the places of these scenes, on automatic cells, and for the highest points of the waveforms: at other
places of the same slopes a few facets make other echoes.
"""

import numpy as np
import pytest

import mitransient_lidar
from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading import scenes as loading
from mitransient_lidar.rendering.shots import truth as sea_map
from mitransient_lidar.studies.shots import highest_points

pytestmark = pytest.mark.long


#: Depth that a nanosecond stands for on the depth axis, at 20 degrees and index 1.34.
METRES_PER_NS = 1e-9 * C0 / (2 * 1.34) * np.sqrt(1 - (np.sin(np.radians(20)) / 1.34) ** 2)


@pytest.fixture(scope="module")
def surface_echoes():
    """Mean of the pixels' peaks [W], and time of each pixel's peak [ns], for the three shots."""
    found = []
    for number in (1, 2, 3):
        shot = mitransient_lidar.render(f"fig10_shot{number}", passes=24)
        heights, times = highest_points(shot, 1409.0, 1432.0)
        found.append((heights.mean(), times))
    return found


@pytest.fixture(scope="module")
def bottom_echoes():
    """Peak [W] and time [ns] of the red pixel's bottom echo, for the three shots."""
    found = []
    for number in (1, 2, 3):
        shot = mitransient_lidar.render(f"fig11_shot{number}", passes=24)
        heights, times = highest_points(shot, 1455.0, 1480.0)
        found.append((heights[0], times[0]))
    return found


def test_face_towards_the_lidar_is_four_to_five_times_brighter(surface_echoes):
    """The sum of the pixels' largest powers: 4.2 and 4.1."""
    first, second, third = (peak for peak, _ in surface_echoes)
    assert 4 < first / second < 5
    assert 4 < first / third < 5


def test_echoes_are_closest_in_shot_1_and_furthest_apart_in_shot_3(surface_echoes):
    apart = [times[:2].mean() - times[2:].mean() for _, times in surface_echoes]
    assert apart[0] < apart[1] - 1 < apart[2] - 2


def test_red_comes_before_green_as_the_sideways_slope_says(surface_echoes):
    """The sea rises to the left, where red looks: red's face is higher, and nearer."""
    scene = loading.open_scene("fig10_shot1").scene
    along, across = sea_map.SeaMap.of_scene(scene).slope_at(-59.52, 57.68)
    assert np.degrees(np.arctan([along, across])) == pytest.approx([1.9, 2.8], abs=0.1)
    red, green = surface_echoes[0][1][:2]
    assert 0.5 < green - red < 2


def test_bottom_echo_of_shot_3_is_stronger_and_a_tenth_of_a_metre_shallower(bottom_echoes):
    """In the red pixel alone, as the publication shows it: by 0.08 and 0.13 m; others by 0.02 to -0.11 m."""
    (first, first_ns), (second, second_ns), (third, third_ns) = bottom_echoes
    assert third > 1.05 * max(first, second)
    shallower = METRES_PER_NS * (np.mean([first_ns, second_ns]) - third_ns)
    assert 0.05 < shallower < 0.15
    assert third_ns < min(first_ns, second_ns) - 0.3
