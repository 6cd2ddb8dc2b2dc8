"""Shots of a batch, and places to shoot at."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rows import each_case
from significance import assert_same, largest_z

from mitransient_lidar.loading import scenes
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.rendering.passes import pass_seed
from mitransient_lidar.rendering.shots.batches import ShotBatches, ShotPoses
from mitransient_lidar.studies import shots
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.rng import Lanes

PLACES = np.array([[0.0, 0.0], [17.3, -42.1], [-250.4, 130.2]])
RECORD = {"time_start_ns": 1380, "bin_count": 200}


def prepared(scene, params, integrator):
    session = open_scene(scene, params)
    chosen = choose_integrator(session.scene, integrator)
    return chosen.prepare(session.scene, session.sensor)


def looking(place, azimuth_deg, off_nadir_deg, height, roll_deg):
    """Return a pose that looks at a place on the mean sea level, turned about its axis."""
    azimuth, angle, roll = np.radians([azimuth_deg, off_nadir_deg, roll_deg])
    ahead, side = np.array([np.cos(azimuth), np.sin(azimuth), 0]), np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    up = np.array([0.0, 0.0, 1.0])
    axis, far = np.sin(angle) * ahead - np.cos(angle) * up, np.cos(angle) * ahead + np.sin(angle) * up
    turned = np.cos(roll) * far + np.sin(roll) * side, np.cos(roll) * side - np.sin(roll) * far
    return KernelPose(np.array([*place, 0.0]) - axis * height / np.cos(angle), axis, *turned)


@pytest.mark.long
@pytest.mark.parametrize("integrator", ["lidar_volpath", "lidar_merging"])
def test_poses_of_a_batch_give_what_single_shots_do(integrator, tmp_path):
    """Azimuths all round, other angles, heights and turned pixels, over waves, ripples of a wind and a sloping bottom.

    The sea is inclined, as on a long wave.

    Alone, each shot is rendered with a laser and a receiver in its pose, and not displaced.
    """
    params, scene = {"wind_speed": 6, "bottom_slope_deg": 4}, tmp_path / "inclined.xml"
    slopes = '<float name="slope_x_deg" value="5"/> <float name="slope_y_deg" value="-3"/>'
    level = Path("scenes/examples/survey_lidar.xml").read_text("utf-8")
    scene.write_text(level.replace('<medium type="layered_water"', slopes + '<medium type="layered_water"'), "utf-8")
    shots = [((17.3, -42.1), 130.0, 16.0, 290.0, 9.0), ((-50.4, 30.2), -77.0, 13.8, 312.0, -8.0)]
    given = [looking(*shot) for shot in shots]
    passes = {"lidar_merging": 16, "lidar_volpath": 24}[integrator]
    renderer = prepared(scene, params, integrator)
    share = {"lidar_merging": 2**12, "lidar_volpath": 2**15}[integrator] / renderer.paths
    batches = ShotBatches(renderer, (0.0, 0.0), passes, share, None, None, [])
    lengths = np.array([0.11, 0.07])
    poses = ShotPoses.of_receiver(renderer.scene, stacked(given)).delayed(lengths)
    np.testing.assert_allclose(poses.places, [shot[0] for shot in shots], atol=1e-9)
    seeds = [pass_seed(number, each) for number in range(len(shots)) for each in range(passes)]
    axis = renderer.scene.axis
    together = batches.at(poses)(passes).render_pass(seeds).histogram.energy()
    together = together.reshape(len(shots), passes, -1, axis.bin_count)
    later = (poses.extra_range(renderer.scene) - lengths) / 0.299792458
    for pose, delay, found in zip(given, later, together, strict=True):
        record = replace(axis, start_ns=axis.start_ns + delay)
        alone = alone_at(scene, params, pose, record, integrator).scaled(share)
        energy = np.array([alone.render_pass(1000 + seed).histogram.energy() for seed in range(passes)])
        edges = np.linspace(0, axis.bin_count, 14).astype(int)[:-1]
        pair = [np.add.reduceat(each, edges, axis=-1) for each in (found, energy)]
        assert_same(*pair, error=0.06, bias=0.01)


def stacked(given):
    """Return poses as one."""
    return KernelPose(
        *(np.array([getattr(pose, name) for pose in given]) for name in ("origin", "axis", "far", "left"))
    )


def alone_at(scene, params, pose, record, integrator):
    """Return the renderer of a scene with a laser and a receiver in a pose, which is not displaced."""
    session = open_scene(scene, params | {"aim_x": pose.ground_point()[0], "aim_y": pose.ground_point()[1]})
    session.scene.emitters()[0].pose = pose
    session.sensor.receiver = replace(session.sensor.receiver, pose=pose)
    return choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor, axis=record)


@pytest.mark.slow
def test_pose_over_a_plume_gives_what_a_single_shot_does():
    """From 300 m at 5 degrees from nadir, turned, over the wake.

    Bubbles in another frame shine where there are none, and those of the scene's own pose return others' light.
    """
    params, passes = {"plume_scattering": 1.0, "ship_x": 1.0, "ship_y": 3.0, "plume_width": 4.0}, 16
    pose = looking((1.0, -2.0), 130.0, 5.0, 300.0, 9.0)
    renderer = prepared("ship_wake", params, None)
    share = 2**12 / renderer.paths
    batches = ShotBatches(renderer, (0.0, 0.0), passes, share, None, None, [])
    assert batches.size == 1
    poses, axis = ShotPoses.of_receiver(renderer.scene, stacked([pose])), renderer.scene.axis
    (delay,) = poses.extra_range(renderer.scene) / 0.299792458
    alone = alone_at("ship_wake", params, pose, replace(axis, start_ns=axis.start_ns + delay), None).scaled(share)
    found, energy = (
        np.array([each.render_pass(first + seed).histogram.energy() for seed in range(passes)])
        for each, first in ((batches.at(poses)(1), 0), (alone, 1000))
    )
    edges = np.linspace(0, axis.bin_count, 14).astype(int)[:-1]
    assert_same(*(np.add.reduceat(each, edges, axis=-1) for each in (found, energy)), error=0.06, bias=0.01)


@pytest.mark.slow
def test_patches_of_the_bottom_lie_where_shots_see_them(tmp_path):
    """Both look at the edge of a bright patch, the second one turned, which had lost most of its light."""
    scene, passes = tmp_path / "patch.xml", 16
    text = Path("scenes/examples/survey_lidar.xml").read_text("utf-8")
    bright = '<shape type="seabed" id="patched"><float name="depth" value="5.9"/><float name="cell_size" value="1"/>'
    bright += '<string name="patches" value="-12 5 3 0.9"/></shape>'
    scene.write_text(text.replace("</scene>", bright + "</scene>"), "utf-8")
    params = {"spectrum": "flat", "bottom_depth": 9}
    given = [looking((-16.5, 5.0), 0.0, 20.0, 300.0, 0.0), looking((-8.3, 4.6), 150.0, 10.0, 300.0, 0.0)]
    renderer = prepared(scene, params, None)
    share = 2**12 / renderer.paths
    batches = ShotBatches(renderer, (0.0, 0.0), passes, share, None, None, [])
    poses, axis = ShotPoses.of_receiver(renderer.scene, stacked(given)), renderer.scene.axis
    seeds = [pass_seed(number, each) for number in range(2) for each in range(passes)]
    together = batches.at(poses)(passes).render_pass(seeds).histogram.energy().reshape(2, passes, -1)
    later = poses.extra_range(renderer.scene) / 0.299792458
    for pose, delay, found in zip(given, later, together, strict=True):
        record = replace(axis, start_ns=axis.start_ns + delay)
        alone = alone_at(scene, params, pose, record, None).scaled(share)
        energy = np.array([alone.render_pass(1000 + seed).histogram.energy().sum() for seed in range(passes)])
        assert_same(found.sum(axis=1, keepdims=True), energy[:, np.newaxis], error=0.06, bias=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("depth", "slope"), [(6.0, 0.0), (1.5, 4.0)])
def test_heights_of_shots_are_those_at_their_places(depth, slope):
    """Of the sea, and of a bottom below all troughs or one that rises above the sea, in the last of several passes."""
    params = {"wind_speed": 6, "bottom_depth": depth, "bottom_slope_deg": slope}
    renderer = prepared("scenes/examples/survey_lidar.xml", params, "lidar_merging")
    places, copies, points = PLACES[:2], 3, 1000
    batches = ShotBatches(renderer, (0.0, 0.0), copies, 0.01, None, None, [])
    heights, region = batches.at(ShotPoses(places))(copies).layout.cells.heights, renderer.layout.patches.region
    highest, lowest = renderer.scene.empty_heights
    assert (highest < lowest) == (slope == 0)
    x, y = (np.random.default_rng(1).uniform(region.low[axis], region.high[axis], points) for axis in (0, 1))
    for number, place in enumerate(places):
        aim = {"aim_x": place[0], "aim_y": place[1]}
        alone = prepared("scenes/examples/survey_lidar.xml", params | aim, "lidar_merging").scene
        down = mi.Ray3f(mi.Point3f(mi.Float(x + place[0]), mi.Float(y + place[1]), 5.0), mi.Vector3f(0, 0, -1))
        sea = alone.ray_intersect(down)
        bed = alone.ray_intersect(alone.spawn_ray(sea, down.d))
        assert np.all(alone.is_surface(sea.shape))
        last_pass = Lanes(len(places) * copies, dr.full(mi.UInt32, copies * number + copies - 1, points), mi.UInt32(0))
        found = last_pass.pick(heights)
        surface, _ = found.surface_at(mi.Float(x), mi.Float(y))
        assert np.std(sea.p.z) > 0.03
        # Cells of 14 cm.
        np.testing.assert_allclose(surface, sea.p.z, atol=0.02)
        np.testing.assert_allclose(found.bed_at(mi.Float(x), mi.Float(y)), bed.p.z, atol=0.01)


@each_case(pytest.param("lidar_merging", marks=pytest.mark.slow), pytest.param("lidar_volpath", marks=pytest.mark.long))
def test_a_level_scene_is_the_same_everywhere(integrator):
    """On common random numbers: rays left surfaces 9e-5 of their distance from the world's origin too far away."""
    energies = []
    for place in PLACES:
        params = {"spectrum": "flat", "aim_x": place[0], "aim_y": place[1], **RECORD}
        energies.append(
            prepared("table1", params, integrator).render_pass(1, paths=2**16).histogram.energy().sum(axis=0)
        )
    centre = [np.average(np.arange(60), weights=energy[100:160]) for energy in energies]
    total = [energy.sum() for energy in energies]
    # Paths are the same but for roundings: few are deflected otherwise. The offset had moved the bottom by 0.2 ns.
    np.testing.assert_allclose(centre, centre[0], atol=0.02)
    np.testing.assert_allclose(total, total[0], rtol=1e-3)


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
