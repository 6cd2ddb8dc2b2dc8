"""Automatic time axes against geometry, and the system attenuation of Gordon (1982)."""

import math

import numpy as np
import pytest
from oracles.refracted_path import refracted_path
from rows import each_row, must_refuse

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.axis_limits import Cone, LidarView, Solid, system_attenuation
from mitransient_lidar.physics.lidar.level_sea import LevelSea
from mitransient_lidar.physics.lidar.pose import Pose
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.layers import WaterColumn

NS = 1e9 / C0
N, GROUP = 1.34, 1.364


def cone(off_nadir_deg=20.0, half_mrad=15.0, altitude=200.0, x=0.0, is_round=True, aim=0.0):
    """A cone towards +x whose axis meets the sea level at `aim`, moved by x."""
    angle = math.radians(off_nadir_deg)
    sin, cos = math.sin(angle), math.cos(angle)
    axes = np.array([[sin, 0, -cos], [cos, 0, sin], [0, 1, 0]])
    pose = Pose(np.array([aim - altitude * sin / cos + x, 0.0, altitude]), *axes)
    return Cone(pose, (1e-3 * half_mrad, 1e-3 * half_mrad), is_round)


def water(attenuation=0.1, boundaries=(), indices=(N,), group=(GROUP,), tops=(0.0,)):
    values = np.broadcast_to(attenuation, len(tops)).astype(np.float64)
    column = WaterColumn(np.array(tops), values, 0 * values, 0 * values)
    return LevelSea(tuple(indices), tuple(boundaries), tuple(group)), column


def plane(depth, slope=0.0, size=5000.0, name="bottom"):
    corners = np.array([[x, y, -depth + slope * x] for x, y in [(-1, -1), (1, -1), (1, 1), (-1, 1)]], dtype=np.float64)
    corners[:, :2] *= size
    corners[:, 2] = -depth + slope * corners[:, 0]
    return Solid(name, corners[[[0, 1, 2], [0, 2, 3]]])


def lidar(view=None, beam=None, sea=None, heights=(0.0, 0.0), reach=5000.0, column=0.0):
    return LidarView(view or cone(), beam or cone(half_mrad=25.0), *(sea or water()), heights, reach, column)


@pytest.mark.parametrize("off_nadir_deg", [0.0, 20.0, 60.0, 85.0])
@pytest.mark.parametrize("crest", [0.0, 0.5])
def test_first_light_comes_from_a_crest_at_the_near_edge(off_nadir_deg, crest):
    found = lidar(cone(off_nadir_deg), cone(off_nadir_deg, 25.0), heights=(-crest, crest)).limits([])
    edge = math.radians(off_nadir_deg) - math.atan(15e-3)
    assert found.first_ns == pytest.approx(2 * NS * (200 - crest) / math.cos(max(edge, 0.0)), rel=1e-6)


@each_row((15.0, 500.0), (500.0, 15.0), (15.0, 15.0))
def test_light_is_that_of_directions_in_view_and_beam(view, beam):
    found = lidar(cone(45.0, view), cone(45.0, beam)).limits([plane(1.0)])
    for time, side in zip(found.surface_ns, (-1, 1), strict=True):
        edge = math.radians(45.0) + side * math.atan(15e-3)
        assert time == pytest.approx(2 * NS * 200 / math.cos(edge), rel=1e-4)


@pytest.mark.parametrize("depth", [0.5, 8.0, 60.0])
@pytest.mark.parametrize("off_nadir_deg", [0.0, 20.0, 80.0])
def test_last_light_comes_from_the_bottom_at_the_far_edge(off_nadir_deg, depth):
    """Two index layers: of the direct echo, both lengths in closed form; scattered light follows."""
    layers = water(boundaries=(4.0,), indices=(1.33, 1.35), group=(1.35, 1.37), tops=(0.0, 4.0))
    scene = lidar(cone(off_nadir_deg), cone(off_nadir_deg, 25.0), layers)
    sine = math.sin(math.radians(off_nadir_deg) + math.atan(15e-3))
    above = 200 / math.sqrt(1 - sine**2)
    upper, lower = min(depth, 4.0), max(depth - 4.0, 0.0)
    below = 1.35 * upper / math.sqrt(1 - (sine / 1.33) ** 2) + 1.37 * lower / math.sqrt(1 - (sine / 1.35) ** 2)
    direct = 2 * NS * (above + below)
    assert scene.limits([plane(depth)], direct=True).last_ns == pytest.approx(direct, rel=1e-6)
    later = min(8 * NS * below, 40 + 0.5 * NS * below)
    found = scene.limits([plane(depth)])
    assert found.last_ns == pytest.approx(direct + later, rel=1e-6)
    assert found.end == "after the echo of shape 'bottom'"


def test_a_receiver_beside_the_laser():
    """Laser and receiver 50 m apart along x, both aimed at x = 0: the times of rays refracted to the deepest point."""
    view, beam = cone(30.0, 5.0), cone(20.0, 5.0, altitude=150.0)
    found = lidar(view, beam).limits([plane(10.0)], direct=True)
    places = np.concatenate([one.places(-0.0, 1000.0) for one in (view, beam)])
    both = places[view.holds(places, 0.0) & beam.holds(places, 0.0)]
    points = np.column_stack([both, np.zeros(len(both))])
    ranges = [np.linalg.norm(points - one.pose.origin, axis=1) for one in (view, beam)]
    assert found.surface_ns[0] == pytest.approx(NS * (ranges[0] + ranges[1]).min(), abs=0.05)
    far = both[np.argmax(both[:, 0])]
    lengths = []
    for one, height in ((view, 200.0), (beam, 150.0)):
        theta, phi = refracted_path(float(np.hypot(*(far - one.pose.origin[:2]))), height, 10.0, N)
        lengths.append(float(height / np.cos(theta) + GROUP * 10.0 / np.cos(phi)))
    # That point lies above the bottom of the far edge; the axis may be longer, not shorter.
    assert NS * sum(lengths) - 0.5 < found.last_ns < NS * sum(lengths) + 25


@pytest.mark.parametrize(("half_mrad", "distance"), [(20.0, 0.0), (35.0, 2.0), (125.0, 10.0)])
def test_light_crosses_the_water_to_the_edge_of_the_view(half_mrad, distance):
    """A beam of 5 m, and views of 4, 7 and 25 m from 200 m: the way to the edge of the view counts up to 10 m."""
    found = [lidar(cone(0.0, half), cone(0.0, 25.0)).limits([plane(8.0)]).last_ns for half in (25.0, half_mrad)]
    direct = [lidar(cone(0.0, half), cone(0.0, 25.0)).limits([plane(8.0)], True).last_ns for half in (25.0, half_mrad)]
    assert found[1] - direct[1] - (found[0] - direct[0]) == pytest.approx(NS * GROUP * distance, abs=0.05)


def test_beam_and_view_without_a_common_place():
    """The legs of both, without the way between them, which `scene_checks` compares with the record."""
    view, beam = cone(0.0, 5.0), cone(0.0, 5.0, x=30.0)
    found = lidar(view, beam).limits([plane(8.0)])
    assert found.first_ns == pytest.approx(2 * NS * 200, rel=1e-6)
    assert found.surface_ns[1] == pytest.approx(2 * NS * 200 * math.hypot(1, 5e-3), rel=1e-6)


def test_the_depth_is_that_of_a_slope_in_view():
    """At nadir the view reaches 3 m, and scattered light 0.3 of the depth farther, to 8.7 m of a slope of 0.1."""
    found = lidar(cone(0.0), cone(0.0, 25.0)).limits([plane(8.0, 0.1)], direct=True)
    deepest = 8 + 0.1 * (3.2 + 3)
    water_ns = 2 * NS * GROUP * deepest / math.sqrt(1 - (15e-3 / N) ** 2)
    assert found.last_ns - found.surface_ns[1] < water_ns
    assert found.last_ns - found.surface_ns[1] > 2 * NS * GROUP * (8 + 0.1 * 3)


def test_a_solid_out_of_view_does_not_count():
    hole = np.array([[[50.0, 50, -90], [60, 50, -90], [60, 60, -90]]])
    scene = lidar(cone(0.0), cone(0.0, 25.0))
    alone = scene.limits([plane(8.0)])
    assert scene.limits([plane(8.0), Solid("hole", hole)]) == alone


def test_a_target_without_a_bottom_does_not_end_the_axis():
    target = np.array([[[-1.0, -1, -5], [1, -1, -5], [1, 1, -5]]])
    scene = lidar(cone(0.0), cone(0.0, 25.0), water(0.2))
    depth = 0.5 * math.log(1e6) / 0.2
    direct = (
        NS * 2 * (200 * math.hypot(1, 15e-3) + GROUP * depth / math.sqrt(1 - (math.sin(math.atan(15e-3)) / N) ** 2))
    )
    assert scene.limits([Solid("target", target)]).last_ns == pytest.approx(direct, rel=1e-4)
    assert scene.limits([]).end.startswith("at a depth of 34.5 m")
    assert scene.limits([Solid("target", target)], direct=True).end == "after the echo of shape 'target'"


def test_the_column_falls_through_layers():
    """exp(-2 K s) over 4 m of 0.5 and 10 m of 0.3 /m is 1e-3 of 1e-6 away; the rest is below."""
    _, layers = water((0.5, 0.3, 0.1), tops=(0.0, 4.0, 14.0))
    depth = 14 + (0.5 * math.log(1e6) - 5.0) / 0.1
    assert layers.depth_of(0.5 * math.log(1e6)) == pytest.approx(depth)
    assert layers.cumulative(depth) == pytest.approx(0.5 * math.log(1e6))
    assert water((0.5, 0.0), tops=(0.0, 4.0))[1].depth_of(10.0) == 4.0
    assert water(0.0)[1].depth_of(10.0) == 0.0


@each_row((0.2, True), (0.5, False))
def test_an_invisible_bottom(attenuation, is_seen):
    found = lidar(cone(0.0), cone(0.0, 25.0), water(attenuation)).limits([plane(40.0)])
    assert ("bottom" in found.end) == is_seen
    assert (found.last_ns > 2 * NS * (200 + GROUP * 40)) == is_seen


def test_a_scene_without_water():
    air = water(0.0, indices=(1.0,), group=(1.0,))
    plate = np.array([[[-50.0, -50, 20], [50, -50, 20], [50, 50, 30]], [[-50, -50, 20], [50, 50, 30], [-50, 50, 30]]])
    found = lidar(cone(0.0), cone(0.0, 25.0), air, column=None).limits([Solid("plate", plate)])
    assert 2 * NS * 170 < found.first_ns < 2 * NS * 175.1
    assert 2 * NS * 174.9 < found.last_ns < 2 * NS * 180.1


def test_a_target_above_the_sea_comes_first():
    tower = np.array([[[-1.0, -1, 12], [1, -1, 12], [1, 1, 12]]])
    found = lidar(cone(0.0), cone(0.0, 25.0)).limits([plane(8.0), Solid("tower", tower)])
    assert found.first_ns == pytest.approx(2 * NS * 188, rel=1e-6)


def test_light_towards_the_horizon_ends_with_the_scene():
    found = lidar(cone(88.0, 100.0, 15.0), cone(88.0, 100.0, 15.0), reach=600.0).limits([])
    assert found.surface_ns[1] == pytest.approx(2 * NS * math.hypot(600, 15), rel=1e-6)


def test_a_square_view_reaches_its_corners():
    square = lidar(cone(0.0, 100.0, is_round=False), cone(0.0, 500.0)).limits([])
    assert square.surface_ns[1] == pytest.approx(2 * NS * 200 * math.sqrt(1 + 2 * 0.01), rel=1e-4)


@each_row(
    (1396.2, 1552.0, 1.0, 1395.0, 160),
    (-7.0, 33.0, 0.5, -7.0, 80),
    (1396.2, 1552.0, 0.3, 1392.0, 540),
    (3.33562e6, 3.33577e6, 1.0, 3335620.0, 150),
)
def test_start_and_number_of_bins_are_readable(first, last, width, start, count):
    axis = TimeAxis.covering(first, last, width)
    assert (axis.start_ns, axis.bin_count) == (pytest.approx(start), count)
    assert axis.start_ns <= first < last <= axis.end_ns + 1e-9
    assert axis.start_ns / width == pytest.approx(round(axis.start_ns / width), abs=1e-9)


def test_a_given_number_wins():
    assert TimeAxis.covering(1396.2, 1552.0, 1.0, start_ns=1380.3) == TimeAxis(1380.3, 1.0, 175)
    assert TimeAxis.covering(1396.2, 1552.0, 1.0, bin_count=40) == TimeAxis(1395.0, 1.0, 40)
    assert TimeAxis.covering(1396.2, 1552.0, 1.0, start_ns=2000.0).bin_count == 5


@each_row(
    (0.3, 0.17, 0.0, 0.3, 1e-15),
    # Gordon: Kd beyond c R of 5 to 6. Here c R = 5, D = 2 R: exp(-8.5) = 2.0e-4 of c - Kd is left.
    (0.5, 0.1, 20.0, 0.1 + 0.4 * 2.035e-4, 1e-6),
    # c D = 1: exp(-0.85) = 0.42741; with the radius in place of the diameter it would be exp(-0.425) = 0.65377.
    (0.25, 0.05, 4.0, 0.05 + 0.2 * 0.42741, 1e-5),
)
def test_from_c_for_narrow_spots_to_kd_for_wide_ones(attenuation, kd, spot, expected, tolerance):
    assert system_attenuation(attenuation, kd, spot) == pytest.approx(expected, rel=tolerance)
    must_refuse(r"kd = 0\.6 must not exceed attenuation = ", system_attenuation, attenuation, [0.05, 0.6], 1)
