"""Layout of a scene as attributes of its result: outlines of pixels, beam and targets."""

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracles.refracted_path import refracted_path

from mitransient_lidar.rendering.describe import describe_layout
from mitransient_lidar.transport.laser import enclosed_area
from mitransient_lidar.transport.medium.water import refract
from mitransient_lidar.transport.probe import Probe, axis_on_bottom
from mitransient_lidar.transport.scene_parts import find_lidar_scene

HALF = 15.0  # mrad
SECTOR = {"type": "pixel_fov", "shape": "sector", "field_of_view_mrad": 30.0, "inner_mrad": 12.0}
TRIANGLE = {"type": "pixel_fov", "shape": "polygon", "vertices_mrad": "20 0, 26 -3, 26 3"}


def described(scene):
    return describe_layout(Probe(find_lidar_scene(scene, scene.sensors()[0])))


def lines(text):
    return [[np.array(line).reshape(-1, 2) for line in pixel] for pixel in json.loads(text)]


@pytest.mark.slow
def test_outlines_enclose_the_areas_of_the_pixels(lidar_scene):
    """Holes turn the other way round, so that signed areas add up."""
    quarters = lines(described(lidar_scene())["pixel_outlines"])
    assert [len(pixel) for pixel in quarters] == [1, 1, 1, 1]
    for (line,), (far, left) in zip(quarters, [(1, 1), (1, -1), (-1, 1), (-1, -1)], strict=True):
        assert abs(enclosed_area(line)) == pytest.approx(np.pi * HALF**2 / 4, rel=3e-3)
        assert np.all(line * [far, left] > -0.02)
    nested = {"a": SECTOR | {"extent_deg": 90.0}, "b": SECTOR | {"start_deg": 90.0, "extent_deg": 270.0}, "c": TRIANGLE}
    first, second, triangle = lines(described(lidar_scene(rx=nested))["pixel_outlines"])
    ring = np.pi * (HALF**2 - 6**2)
    assert abs(enclosed_area(first[0])) == pytest.approx(ring / 4, rel=3e-3)
    assert abs(enclosed_area(second[0])) == pytest.approx(3 * ring / 4, rel=3e-3)
    assert first[0].min() > -0.02  # from +angle_x to +angle_y
    assert abs(enclosed_area(triangle[0])) == pytest.approx(18, rel=3e-3)
    outlines = lines(described(lidar_scene(rx={"a": SECTOR | {"shape": "ring"}}))["pixel_outlines"])[0]
    assert len(outlines) == 2
    assert abs(sum(enclosed_area(line) for line in outlines)) == pytest.approx(ring, rel=3e-3)


def test_targets_are_described_and_bottoms_are_not(lidar_scene, tmp_path):
    turn = mi.ScalarTransform4f().translate([0.5, 1, -5]).rotate([0, 0, 1], 45).scale(float(np.sqrt(0.5)))
    extra = {
        "ball": {"type": "sphere", "center": [-1, 2, -6], "radius": 0.5},
        "plate": {"type": "rectangle", "to_world": turn},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([1, -1, -7]).scale([0.5, 1, 0.25])},
        "far_away": {"type": "sphere", "center": [50, 0, -6]},
        "group": {"type": "shapegroup", "ball": {"type": "sphere"}},
        "copy": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": mi.ScalarTransform4f().translate([1, 2, -4]).scale(0.25),
        },
        "stalk": {"type": "linearcurve", "filename": str(tmp_path / "stalk.txt")},
    }
    (tmp_path / "stalk.txt").write_text("0 -1 -3 0.1\n1 -1 -3 0.1\n")
    targets = json.loads(described(lidar_scene(extra=extra))["target_outlines"])
    by_depth = {round(target["z"][1], 2): np.reshape(target["line"], (-1, 2)) for target in targets}
    assert sorted(by_depth) == [-6.75, -5.5, -5.0, -3.75, -2.9]
    np.testing.assert_allclose(np.hypot(*(by_depth[-5.5] - [-1, 2]).T), 0.5, rtol=5e-3)
    np.testing.assert_allclose(np.hypot(*(by_depth[-3.75] - [1, 2]).T), 0.25, rtol=5e-3)
    ends = by_depth[-2.9].min(axis=0), by_depth[-2.9].max(axis=0)
    np.testing.assert_allclose(ends, [[-0.1, -1.1], [1.1, -0.9]], atol=0.02)
    corners = {tuple(np.round(point, 2)) for point in by_depth[-5.0]}
    assert corners == {(1.5, 1.0), (-0.5, 1.0), (0.5, 2.0), (0.5, 0.0)}
    np.testing.assert_allclose([by_depth[-6.75].min(axis=0), by_depth[-6.75].max(axis=0)], [[0.5, -2], [1.5, 0]])


def traced_axis(scene):
    """Return where the receiver's axis meets the sea and then a solid, with the scene's own facets and normals [m]."""
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    pose = lidar.receiver.pose
    down = mi.Vector3f(pose.axis.tolist())
    first = scene.ray_intersect(mi.Ray3f(mi.Point3f(pose.origin.tolist()), down))
    below = -dr.normalize(refract(-down, first.n, 1 / lidar.refractive_index))
    second = scene.ray_intersect(first.spawn_ray(below))
    return np.array(first.p).ravel(), np.array(second.p).ravel()


ROTATED = {"to_world": mi.ScalarTransform4f().look_at([40, 72.794, 200], [3, 1, 0], [0, 0, 1])}


@pytest.mark.slow
@pytest.mark.parametrize("pose", [{}, {"off_nadir_deg": 45.0, "aim_x": 3.0}, ROTATED], ids=["20", "45", "any"])
@pytest.mark.parametrize("bottom", ["level", "tilted"])
def test_bottom_point_is_where_a_ray_through_the_scene_ends(lidar_scene, pose, bottom):
    """To a millimetre, through the mesh of a flat sea."""
    seabed = {"bottom": {"type": "seabed", "depth": 9.0, "slope_x_deg": 8.0, "slope_y_deg": -5.0}}
    scene = lidar_scene(tx=pose, rx=pose, **({"bottom": None, "extra": seabed} if bottom == "tilted" else {}))
    _, expected = traced_axis(scene)
    assert expected[2] < -5
    np.testing.assert_allclose(described(scene)["bottom_point"], expected, atol=1e-3)


def test_bottom_is_every_wide_solid_and_no_other(lidar_scene):
    """A step of two plates; a pipe that is longer than the bottom, a mine, and a plate in a view wider than it."""
    place = mi.ScalarTransform4f
    near = {"type": "rectangle", "to_world": place().translate([-30, 0, -6]).scale(30)}
    far = {"type": "rectangle", "to_world": place().translate([0, 0, -8]).scale(100), "bsdf": {"type": "conductor"}}
    pipe = {"type": "cylinder", "p0": [-300, 3, -5], "p1": [300, 3, -5], "radius": 0.3}
    mine = {"type": "sphere", "center": [1.0, 0, -4], "radius": 0.5}
    extra = {"far": far, "near": near, "pipe": pipe, "mine": mine}
    narrow = lidar_scene(bottom=None, extra=extra, rx={"field_of_view_mrad": 1.0})
    scene = find_lidar_scene(narrow, narrow.sensors()[0])
    assert sorted(solid.id() for solid in scene.bottoms) == ["far", "near"]
    assert sorted(solid.id() for solid in scene.targets) == ["mine", "pipe"]
    # Past mine and pipe, on either side of the step, and beside everything.
    shifts = np.array([(0.0, 0.0, 0.0), (0.0, 3.0 - 1e-3, 0.0), (-5.0, 0.0, 0.0), (500.0, 0.0, 0.0)])
    points = axis_on_bottom(scene, scene.receiver.pose.origin + shifts, scene.receiver.pose.axis)
    np.testing.assert_allclose(points[:, 2], [-8, -8, -6, np.nan], atol=1e-3)
    np.testing.assert_allclose(points[0, :2], [2.1119, 0], atol=1e-3)
    wide = lidar_scene(bottom=None, extra={"mine": mine})
    assert find_lidar_scene(wide, wide.sensors()[0]).bottoms == []


def test_index_layers_bend_the_axis(lidar_scene):
    """tan of asin(sin(20 deg) / n) over 3 m and 5 m."""
    layers = {"layer_tops": "0, 3", "attenuation": "0.3, 0.3", "scattering": "0.15, 0.15"}
    layers |= {"backscattering": "0.006, 0.006", "refractive_index": "1.334, 1.6"}
    attributes = described(lidar_scene(water=layers))
    np.testing.assert_allclose(attributes["index_layers"], [1.334, 1.6])
    np.testing.assert_allclose(attributes["index_boundaries"], [3.0])
    sines = np.sin(np.radians(20)) / np.array([1.334, 1.6])
    expected = float(np.array([3.0, 5.0]) @ np.tan(np.arcsin(sines)))
    np.testing.assert_allclose(attributes["bottom_point"], [expected, 0, -8], atol=1e-3)


def test_targets_are_seen_and_shadowed_along_refracted_rays(lidar_scene):
    """A level plate: its corners cross the sea and end on the bottom as single rays do."""
    plate = mi.ScalarTransform4f().translate([1.5, 0, -6]).scale(0.5)
    extra = {"plate": {"type": "rectangle", "to_world": plate}}
    (target,) = json.loads(described(lidar_scene(tx={"aim_x": 1.0}, extra=extra))["target_outlines"])
    corners = np.array([[x, y] for x in (1.0, 2.0) for y in (-0.5, 0.5)])
    for name, aim, depth in (("seen", 0.0, 0), ("shadow", 1.0, 8)):
        lidar = np.array([aim - 200 * np.tan(np.radians(20)), 0])
        distance = np.linalg.norm(corners - lidar, axis=1)
        theta, phi = refracted_path(distance, 200.0, 6.0, 1.34)
        reach = 200 * np.tan(theta) + depth * np.tan(phi)
        line = np.reshape(target[name], (-1, 2))
        for corner in lidar + (corners - lidar) * (reach / distance)[:, None]:
            assert np.hypot(*(line - corner).T).min() < 1e-3


def test_targets_belong_to_the_view_at_their_depth(lidar_scene):
    """At 60 degrees off nadir and 30 m depth the view lies 25.4 m beyond its place on the sea."""
    pose = {"off_nadir_deg": 60.0}
    extra = {
        "in_view": {"type": "sphere", "center": [25.4, 0, -30]},
        "below_the_footprint": {"type": "sphere", "center": [0, 0, -30]},
    }
    scene = lidar_scene(tx=pose, rx=pose | {"field_of_view_mrad": 10.0}, bottom=40.0, extra=extra)
    targets = json.loads(described(scene)["target_outlines"])
    assert [target["id"] for target in targets] == ["in_view"]
    seen = np.reshape(targets[0]["seen"], (-1, 2))
    np.testing.assert_allclose(0.5 * (seen.min(axis=0) + seen.max(axis=0)), [0, 0], atol=0.2)
