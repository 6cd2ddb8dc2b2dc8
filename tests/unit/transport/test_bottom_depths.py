"""Depths of bottoms below places, and objects within plugins."""

import math

import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.sea.shoaling import ShoalingHeights
from mitransient_lidar.transport.scene_parts import seas_of
from mitransient_lidar.transport.solids import bottom_depths

SLOPE = {"type": "seabed", "depth": 2.0, "slope_x_deg": np.degrees(np.arctan(0.1)), "size": 80.0}
PIER = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([-10, 0, 0]).scale([1, 1, 5])}


def sea_over(solids, aim_x=0.0, **parameters):
    sea = {"type": "ocean_surface", "wind_speed": 8.0, "interior": {"type": "layered_water"}, **parameters}
    parts = {
        "transmitter": {"type": "lidar_transmitter", "aim_x": aim_x},
        "receiver": {"type": "multipixel_receiver", "aim_x": aim_x, "film": {"type": "time_gated_film"}},
        "surface": sea,
        **solids,
    }
    scene = open_scene({"type": "scene", **parts}).scene
    return scene, seas_of(scene)[0]


def vertices(shape):
    return np.array(mi.traverse(shape)["vertex_positions"], dtype=np.float64).reshape(-1, 3)


@pytest.mark.parametrize("bottom", ["slope", "mesh"])
def test_depths_are_those_of_rendered_bottoms(bottom):
    """Targets and piers do not count, and beyond a bottom its edge continues."""
    solids = {"bottom": SLOPE, "pier": PIER}
    if bottom == "mesh":
        plane = mi.ScalarTransform4f().translate([0, 0, -2]).rotate([0, 1, 0], -np.degrees(np.arctan(0.1)))
        solids["bottom"] = {"type": "rectangle", "to_world": plane.scale(40 * float(np.hypot(1, 0.1)))}
    scene, sea = sea_over(solids)
    depths = bottom_depths(scene)
    assert depths.least == pytest.approx(-2.0, abs=0.05)
    x, y = np.array([-100.0, -30.0, -10.0, 0.0, 10.0, 25.0]), np.array([-3.0, 0.0, 90.0])
    expected = 2.0 - 0.1 * np.clip(x, -40, 40)
    np.testing.assert_allclose(depths.sample(x, y), np.broadcast_to(expected, (3, 6)), atol=0.02)
    assert isinstance(sea.sea.waves, ShoalingHeights)
    x, _, z = vertices(sea).T
    assert not np.any(z[x > 20.1])
    assert np.all(z[x < 19.9] > -2.0 + 0.1 * x[x < 19.9])
    assert np.std(z[x < 15]) > 0.05


def test_far_scenes_have_the_same_sea():
    """Objects lie in a frame about the aim there, and the sea's waves do not."""
    near, far = (sea_over({"bottom": {**SLOPE, "depth": 2.0 + 0.1 * x, "centre_x": x}}, x)[1] for x in (0.0, 1024.0))
    for sea in (near, far):
        x, _, z = vertices(sea).T
        assert not np.any(z[x > 20.1])
        assert np.std(z[x < 15]) > 0.05


def test_waves_know_the_bottom_only_where_it_limits_them():
    flat = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.5]).scale(500)}
    deep = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -4.0]).scale(500)}
    for bottom, given, follows in ((flat, {}, True), (flat, {"shoaling": "none"}, False), (deep, {}, False)):
        assert isinstance(sea_over({"bottom": bottom}, **given)[1].sea.waves, ShoalingHeights) == follows
    scene, sea = sea_over({"bottom": flat})
    assert 4 * np.std(vertices(sea)[:, 2]) < 0.3
    assert sea.used_values["shoaling"] == "bottom"
    assert float(scene.bbox().min.z) == pytest.approx(-0.5)


SEABED = {"type": "seabed", "depth": 8.0, "size": 20.0}
WATER = {"type": "ocean_surface", "spectrum": "flat", "interior": {"type": "layered_water", "plume_scattering": 1.0}}


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["hg", "petzold", "fournier_forand"])
def test_no_plugin_calls_the_loader(monkeypatch, phase):
    """A loader within the loader replaces the file resolver that other threads use: 1 in 10 processes then failed."""

    def refuse(*_, **__):
        raise AssertionError("load_dict within the constructor of a plugin")

    load_file = mi.load_file
    monkeypatch.setattr(mi, "load_dict", refuse)
    assert open_scene("table1", {"phase_function": phase, "spectrum": "flat"}).scene.shapes()
    assert load_file(str(catalogue.scene_path("ship_wake")), ship_x="0").shapes()


def test_seabed_and_bubbles_are_made_without_the_loader(monkeypatch):
    """They hold a texture and a phase function of their own."""
    for description in (SEABED, WATER):
        load_dict = mi.load_dict
        with monkeypatch.context() as patch:
            patch.setattr(mi, "load_dict", lambda *_, **__: pytest.fail("a plugin calls the loader"))
            assert load_dict(description).bbox().valid()


def test_all_loading_is_serial(monkeypatch):
    """Mitsuba's own plugins are found in one thread."""
    asked = []
    instantiate = mi.parser.instantiate
    monkeypatch.setattr(
        mi.parser, "instantiate", lambda config, parsed: asked.append(config.parallel) or instantiate(config, parsed)
    )
    open_scene("table1", {"spectrum": "flat"})
    assert asked == [False]


def test_no_ray_passes_between_the_faces_of_a_bottom():
    """Of these places 55 lie on edges that single rays miss."""
    slope = math.radians(5.0)
    scene, _ = sea_over({"bottom": {"type": "seabed", "depth": 5.0, "slope_x_deg": 5.0, "size": 80.0}})
    lines = 0.02 * np.arange(-700, 700)
    expected = np.broadcast_to(5.0 - math.tan(slope) * lines, (lines.size,) * 2)
    np.testing.assert_allclose(bottom_depths(scene).sample(lines, lines), expected, atol=1e-3)
