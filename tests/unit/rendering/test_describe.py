"""Layout of a scene as attributes of its result: outlines of pixels, beam and targets."""

import json

import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.rendering.describe import describe_layout
from mitransient_lidar.transport.laser.beam_profiles import enclosed_area
from mitransient_lidar.transport.scene import LidarScene

HALF = 15.0  # mrad
SECTOR = {"type": "pixel_fov", "shape": "sector", "field_of_view_mrad": 30.0, "inner_mrad": 12.0}
TRIANGLE = {"type": "pixel_fov", "shape": "polygon", "vertices_mrad": "20 0, 26 -3, 26 3"}


def described(scene):
    return describe_layout(LidarScene.from_scene(scene, scene.sensors()[0]))


def lines(text):
    return [[np.array(line).reshape(-1, 2) for line in pixel] for pixel in json.loads(text)]


def test_outlines_enclose_the_areas_of_the_pixels(lidar_scene):
    """Holes turn the other way round, so that signed areas add up."""
    quarters = lines(described(lidar_scene())["pixel_outlines"])
    assert [len(pixel) for pixel in quarters] == [1, 1, 1, 1]
    for (line,), (far, left) in zip(quarters, [(1, -1), (1, 1), (-1, -1), (-1, 1)], strict=True):
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


def test_arcs_are_smooth_and_texts_short(lidar_scene):
    text = described(lidar_scene(rx={"layout": "1x1"}))["pixel_outlines"]
    ((line,),) = lines(text)
    np.testing.assert_allclose(np.hypot(*line.T), HALF, rtol=1e-3)
    chords = np.hypot(*np.diff(line, axis=0).T)
    assert chords.max() < 2.5  # the sagitta of such a chord is a thousandth of the diameter
    assert len(text) < 2500


def test_beam_outlines_are_where_the_irradiance_says(lidar_scene):
    shape = {"divergence_mrad": 12.0, "divergence_across_mrad": 4.0, "ellipse_deg": 90.0}
    rim, outer = json.loads(described(lidar_scene(tx=shape))["beam_outlines"])
    for outline, share, scale in ((rim, np.exp(-0.5), 1), (outer, np.exp(-2), 2)):
        assert outline["share"] == pytest.approx(share, abs=1e-4)
        (line,) = lines(json.dumps([outline["lines"]]))[0]
        # Turned by 90 degrees: the long axis, half of 12 mrad, lies along angle_y.
        np.testing.assert_allclose(np.hypot(line[:, 0] / 2, line[:, 1] / 6), scale, rtol=5e-3)
    (edge,) = json.loads(described(lidar_scene(tx={"beam_profile": "top_hat"}))["beam_outlines"])
    assert edge["share"] == 1
    np.testing.assert_allclose(np.hypot(*np.reshape(edge["lines"][0], (-1, 2)).T), 5, rtol=1e-3)


def test_targets_are_described_and_bottoms_are_not(lidar_scene):
    turn = mi.ScalarTransform4f().translate([0.5, 1, -5]).rotate([0, 0, 1], 45).scale(float(np.sqrt(0.5)))
    extra = {
        "ball": {"type": "sphere", "center": [-1, 2, -6], "radius": 0.5},
        "plate": {"type": "rectangle", "to_world": turn},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([1, -1, -7]).scale([0.5, 1, 0.25])},
        "far_away": {"type": "sphere", "center": [50, 0, -6]},
    }
    targets = json.loads(described(lidar_scene(extra=extra))["target_outlines"])
    by_depth = {round(target["z"][1], 2): np.reshape(target["line"], (-1, 2)) for target in targets}
    assert sorted(by_depth) == [-6.75, -5.5, -5.0]
    np.testing.assert_allclose(np.hypot(*(by_depth[-5.5] - [-1, 2]).T), 0.5, rtol=5e-3)
    corners = {tuple(np.round(point, 2)) for point in by_depth[-5.0]}
    assert corners == {(1.5, 1.0), (-0.5, 1.0), (0.5, 2.0), (0.5, 0.0)}
    np.testing.assert_allclose([by_depth[-6.75].min(axis=0), by_depth[-6.75].max(axis=0)], [[0.5, -2], [1.5, 0]])


def test_upright_plate_is_a_line(lidar_scene):
    upright = mi.ScalarTransform4f().translate([0, 0, -6]).rotate([1, 0, 0], 90)
    extra = {"plate": {"type": "rectangle", "to_world": upright}}
    (target,) = json.loads(described(lidar_scene(extra=extra))["target_outlines"])
    np.testing.assert_allclose(np.sort(np.unique(np.reshape(target["line"], (-1, 2))[:, 0])), [-1, 1], atol=1e-3)
    np.testing.assert_allclose(target["z"], [-7, -5], atol=1e-3)
