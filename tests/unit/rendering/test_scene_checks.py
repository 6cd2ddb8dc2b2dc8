"""Checks of scenes before they are rendered: refusals, and warnings with their numbers."""

import logging
import re

import mitsuba as mi
import numpy as np
import pytest
from oracles.echo_times import bottom_time_ns
from rows import each_case, must_refuse, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.level_sea import snell
from mitransient_lidar.rendering.scene_checks import check_scene

THETA, N = np.radians(20), 1.34
TO_WORLD = mi.ScalarTransform4f()
UP = {"to_world": TO_WORLD.look_at([0, 0, 200], [10, 0, 400], [0, 1, 0])}
BALL = {"type": "sphere", "radius": 0.5}


def check(scene, caplog, integrator="lidar_merging"):
    renderer = mi.load_dict({"type": integrator}).prepare(scene, scene.sensors()[0])
    with caplog.at_level(logging.INFO, "mitransient_lidar.rendering.scene_checks"):
        check_scene(renderer.probe)
    return [record.getMessage() for record in caplog.records]


def numbers(message):
    return [float(value) for value in re.findall(r"(?<![\w.])-?\d+\.?\d*", message)]


def on_axis(z):
    """x at which the axis of the default lidar passes a height under water [m]."""
    return -z * np.tan(snell(THETA, N))


@pytest.mark.slow
def test_echo_after_the_record_is_told_with_its_arrival(lidar_scene, caplog):
    (message,) = check(lidar_scene(bottom=30.0), caplog)
    assert "shape 'bottom'" in message
    arrival, end, bins = numbers(message)
    assert arrival == pytest.approx(bottom_time_ns(200, 30, THETA, N, N), abs=1)
    assert end == 1390 + 160
    assert arrival + 5 < 1390 + bins < arrival + 20
    caplog.clear()
    assert check(lidar_scene(bottom=30.0, film={"bin_count": int(bins)}), caplog) == []


@pytest.mark.parametrize(("centre", "told"), [(0.0, "rises through the sea surface")])
def test_solid_in_the_air_is_told_as_that(lidar_scene, caplog, centre, told):
    """A cube of 1 m hides its own foot from a lidar at nadir, and the sea below it: the sea is not too small."""
    nadir, cube = {"off_nadir_deg": 0.0}, TO_WORLD.translate([0, 0, centre]).scale(0.5)
    box = {"type": "cube", "to_world": cube, "bsdf": {"type": "diffuse"}}
    scene = lidar_scene(tx=nadir, rx=nadir, film={"time_start_ns": 1300.0}, extra={"box": box})
    (message,) = check(scene, caplog)
    assert told in message
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    assert renderer.probe.echoes.missed_beam == 0


@pytest.mark.slow
def test_echo_before_the_record_is_told(lidar_scene, caplog):
    """A ball at 2 m, and a record from just above the bottom."""
    extra = {"ball": BALL | {"center": [on_axis(-2), 0, -2]}}
    start = float(bottom_time_ns(200, 6, THETA, N, N))
    (message,) = check(lidar_scene(film={"time_start_ns": start}, extra=extra), caplog)
    assert "shape 'ball'" in message
    assert numbers(message)[0] == pytest.approx(bottom_time_ns(200, 1.6, THETA, N, N), abs=2)
    assert "lower time_start_ns" in message


@pytest.mark.slow
@pytest.mark.parametrize(("target", "distance"), [([1e6, 0, -6], 1e6 - 0.5 - 1.584), ([1.5, -30, -2], 29.5)])
def test_target_out_of_view_is_told_with_its_distance(lidar_scene, caplog, target, distance):
    (message,) = check(lidar_scene(extra={"ball": BALL | {"center": target}}), caplog)
    found, x, y, z = numbers(message)
    assert "shape 'ball' lies out of view" in message
    assert found == pytest.approx(distance, rel=1e-6, abs=0.06)
    assert (x, y, z) == (pytest.approx(on_axis(z), abs=0.06), 0, target[2])


@pytest.mark.slow
@each_case(
    {"extra": {"ball": BALL | {"center": [5.2, 0, -6]}}},
    {"extra": {"ball": BALL | {"center": [3.2, 0, -6]}}, "tx": {"divergence_mrad": 0.5}},
    {"rx": {"ring": {"type": "pixel_fov", "shape": "sector", "field_of_view_mrad": 40.0, "inner_mrad": 30.0}}},
    {"bottom": None},
)
def test_legitimate_scenes_pass_in_silence(parts, lidar_scene, caplog):
    assert check(lidar_scene(**parts), caplog) == []


@pytest.mark.slow
def test_axes_that_do_not_meet_are_told(lidar_scene, caplog):
    """The beam's radius is half the divergence, over the slant range of 200 m / cos 20."""
    (message,) = check(lidar_scene(rx={"aim_x": 2.0}), caplog)
    apart, ratio, radius, least = numbers(message)
    assert (apart, least) == (2, 2)
    assert radius == pytest.approx(0.005 * 200 / np.cos(THETA), rel=5e-3)
    assert ratio == pytest.approx(2 / radius, rel=0.05)


@pytest.mark.slow
@refuses(
    ({"rx": UP}, "no pixel sees the sea or a solid: the receiver looks above the horizon"),
    ({"rx": UP, "tx": UP}, "laser and receiver look above the horizon"),
    ({"rx": {"aim_x": 900.0}, "sea": {"centre_x": 0.0, "size": 1000.0}}, r"receiver looks at the sea level from"),
    ({"rx": {"aim_x": 60.0}}, r"beam and field of view do not overlap: they are 5\d\.\d m apart on the sea level"),
    ({"film": {"time_start_ns": 1620.0}}, "starts the record after every echo: it must be less than 149"),
)
def test_scenes_that_return_no_light_are_refused(parts, lidar_scene, caplog):
    check(lidar_scene(**parts), caplog)


@pytest.mark.parametrize(("flips", "inwards"), [(False, False), (False, True)])
def test_closed_mesh_with_faces_inwards_is_told(lidar_scene, caplog, tmp_path, inwards, flips):
    mesh = mi.load_dict({"type": "cube"})
    buffers = mi.traverse(mesh)
    faces = np.array(buffers["faces"]).reshape(-1, 3)
    buffers["faces"] = mi.UInt32((faces[:, ::-1] if inwards else faces).ravel())
    buffers.update()
    mesh.write_ply(str(tmp_path / "box.ply"))
    box = {"type": "ply", "id": "box", "filename": str(tmp_path / "box.ply"), "flip_normals": flips}
    box |= {"to_world": TO_WORLD.translate([on_axis(-5.0), 0, -5]), "face_normals": True}
    warnings = check(lidar_scene(extra={"box": {**box, "bsdf": {"type": "diffuse"}}}), caplog)
    assert ["faces of shape 'box' point inwards" in one for one in warnings] == [True] * (inwards != flips)
    caplog.clear()
    twosided = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    assert check(lidar_scene(extra={"box": {**box, "bsdf": twosided}}), caplog) == []


@each_case((-1, False, UserError), (-1, True, 0), (1, True, 1), (1, False, 0))
def test_sphere_inside_out_is_refused_or_told(mirror, flips, outcome, lidar_scene, caplog):
    place = TO_WORLD.translate([on_axis(-5.0), 0, -5]).scale([mirror * 0.5, 0.5, 0.5])
    scene = lidar_scene(extra={"ball": {"type": "sphere", "to_world": place, "flip_normals": flips}})
    if outcome is UserError:
        must_refuse("to_world of sphere 'ball' mirrors it", check, scene, caplog)
        return
    assert ["faces of shape 'ball' point inwards" in one for one in check(scene, caplog)] == [True] * outcome


def test_mirrored_mesh_with_its_own_normals_is_not_told(lidar_scene, caplog):
    place = TO_WORLD.translate([on_axis(-5.0), 0, -5]).scale([-0.5, 0.5, 0.5])
    assert check(lidar_scene(extra={"box": {"type": "cube", "to_world": place}}), caplog) == []


@pytest.mark.parametrize(("water", "laser", "fits"), [(532, 515, False), (515, 515, True), (532, 532.1, True)])
def test_water_by_name_has_the_wavelength_of_the_laser(lidar_scene, water, laser, fits):
    of_water = {"chlorophyll": 0.5, "wavelength_nm": water}
    scene = lidar_scene(integrator={"type": "lidar_merging"}, tx={"wavelength_nm": laser}, water=of_water)
    if fits:
        scene.integrator().prepare(scene, scene.sensors()[0])
        return
    sentence = "wavelength_nm = 532 of the water must be that of the lidar_transmitter, 515"
    must_refuse(sentence, lambda: scene.integrator().prepare(scene, scene.sensors()[0]))


@pytest.mark.parametrize(("laser", "group", "refused"), [(1064, "", True), (515, "", False), (1064, 1.36, False)])
def test_numbers_of_green_water_are_for_green_lasers(lidar_scene, laser, group, refused):
    """Coefficients and both indices as numbers are those at any wavelength."""
    of_water = {"attenuation": 14.5} | ({"group_index": group} if group else {})
    scene = lidar_scene(tx={"wavelength_nm": laser}, water=of_water | ({} if group else {"refractive_index": 1.34}))
    if refused:
        scene = lidar_scene(tx={"wavelength_nm": laser})
        with pytest.raises(UserError, match="wavelength_nm = 532 of the water must be that of the lidar_transmitter"):
            scene.integrator().prepare(scene, scene.sensors()[0])
    else:
        scene.integrator().prepare(scene, scene.sensors()[0])
