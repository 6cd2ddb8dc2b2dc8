"""Scenes far from the origin, and plugins of Mitsuba."""

import json

import mitsuba as mi
import mitsuba_plugins
import numpy as np
import pytest
import significance
from rows import each_row
from same_bits import assert_same_bits

import mitransient_lidar
from mitransient_lidar.loading import catalogue, frame
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.rendering.shots.series import render_shots
from mitransient_lidar.studies.shots import find_shots
from mitransient_lidar.transport.scene_parts import find_receiver, lidar_sensor

#: As in map coordinates, a whole number of periods of the sea [m]; the other place is between its cells.
FAR, BETWEEN = (5e5, -9e5), (123456.789, -9876543.21)

#: Plugins of Mitsuba that stay where they are given: such scenes have no frame.
UNKNOWN = {"blender", "distant", "ellipsoids", "ellipsoidsmesh", "point"}


def moved(place, *more):
    """Return the transform to a place (x, y), after others."""
    to_world = mi.ScalarAffineTransform4d().translate([*place, 0])
    for one in more:
        to_world = to_world @ one
    return to_world


def scene_at(x, y, **parts):
    """Return a scene about a place with waves and a seabed with a hill, and parts."""
    aim = {"aim_x": x, "aim_y": y}
    return {
        "tx": {"type": "lidar_transmitter", **aim},
        "rx": {"type": "multipixel_receiver", "layout": "1x1", "film": {"type": "time_gated_film"}, **aim},
        "sea": {"type": "ocean_surface", "interior": {"type": "layered_water"}},
        "bottom": {"type": "seabed", "curvature": -0.1, "refined_size": 4, "centre_x": x, "centre_y": y},
        **parts,
    }


def ball(x, y):
    return {"type": "sphere", "center": [x + 0.25, y, -4.0], "radius": 0.5, "bsdf": {"type": "diffuse"}}


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [pytest.param("lidar_merging", marks=pytest.mark.long), "lidar_volpath"])
def test_far_scene_has_the_bits_of_that_at_the_origin(integrator):
    """Single precision alone loses 24 % of the beam through the sea there, and the bottom comes 4 ns too early."""
    few = {"type": integrator, "paths_per_pass": 4096}
    near, far = (
        mitransient_lidar.render(scene_at(*place, ball=ball(*place)), integrator=few, passes=2)
        for place in ((0.0, 0.0), FAR)
    )
    assert_same_bits(far, near)
    assert far.attrs["beam_outside_surface"] == near.attrs["beam_outside_surface"] == 0
    for name in ("receiver_pose", "transmitter_pose", "bottom_point"):
        apart = np.subtract(far.attrs[name], near.attrs[name])
        np.testing.assert_allclose(apart[:3], [*FAR, 0], atol=1e-6)
        np.testing.assert_allclose(apart[3:], 0)
    outlines = [json.loads(each.attrs["target_outlines"])[0] for each in (near, far)]
    for name in ("line", "seen", "shadow"):
        apart = np.subtract(*(np.reshape(each[name], (-1, 2)) for each in outlines[::-1]))
        np.testing.assert_allclose(apart, np.broadcast_to(FAR, apart.shape), atol=1e-3)
    parameters = json.loads(far.attrs["plugin_parameters"])
    np.testing.assert_allclose(np.array(parameters["ball"]["to_world"])[:2, 3], [FAR[0] + 0.25, FAR[1]])
    assert (parameters["tx"]["aim_x"], parameters["sea"]["used"]["centre_y"]) == FAR
    assert not any("frame" in name for part in parameters.values() if part for name in part)
    assert_same_bits(mitransient_lidar.render(far), far)


@pytest.mark.slow
def test_far_series_has_the_bits_and_the_truth_of_that_at_the_origin(tmp_path):
    """The bubbles behind a ship, the target and the bottom are about the first place; the sea is periodic."""
    series = []
    for x, y in ((0.0, 0.0), FAR):
        text = catalogue.scene_text("fig13_2x2")
        bottom = '<translate z="-$bottom_depth"/>'
        assert bottom in text
        path = tmp_path / f"scene_{x:g}.xml"
        path.write_text(text.replace(bottom, f'<translate x="{x}" y="{y}" z="-$bottom_depth"/>'), "utf-8")
        params = {"target_x": x, "target_y": y}
        places = [(x + 0.3, y), (x - 7.5, y + 4.2)]
        found = render_shots(path, params, positions=places, passes=2, pass_share=1 / 128)
        assert found.attrs["surface_edge_loss"] < 1e-3
        series.append(found)
        shots = find_shots(path, {**params, "aim_x": x, "aim_y": y}, waveforms=False).shots
        assert all(abs(shot.x - x) <= 256 and abs(shot.y - y) <= 256 for shot in shots)
    near, far = series
    for axis, apart in zip("xy", FAR, strict=True):
        np.testing.assert_allclose(far[f"aim_{axis}"] - near[f"aim_{axis}"], apart)
    # The frame is about the first place, to a metre: shots are the same to rounding.
    for name in near.coords:
        if str(name).startswith("true_"):
            np.testing.assert_allclose(far[name], near[name], atol=2e-4, err_msg=str(name))
    energy = [each["impulse_response"].sum("time").values for each in series]
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-3)


def shapes_at(place, folder):
    """Return one of each shape that is placed by ``to_world`` or by points, about a place (x, y)."""
    x, y = place
    (folder / "corner.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "line.txt").write_text("0 0 0 0.1\n1 0 0 0.1\n1 1 0 0.1\n2 1 0 0.1\n")
    mesh = mi.load_dict({"type": "obj", "filename": str(folder / "corner.obj")})
    mesh.write_ply(str(folder / "corner.ply"))
    turned = mi.ScalarAffineTransform4d().translate([0.5, 0, -3]).rotate([0, 0, 1], 30).scale([1, 2, 3])
    to_world = moved(place, turned)
    grid = mi.TensorXf(np.linspace(-1, 1, 27).reshape(3, 3, 3, 1).astype(np.float32))
    named = {name: {"type": name, "to_world": to_world} for name in ("cube", "cylinder", "disk", "rectangle", "sphere")}
    return {
        **named,
        **{
            name: {"type": name, "to_world": to_world, "filename": str(folder / f"corner.{name}")}
            for name in ("obj", "ply")
        },
        **{
            name: {"type": name, "to_world": moved(place), "filename": str(folder / "line.txt")}
            for name in ("bsplinecurve", "linearcurve")
        },
        "sdfgrid": {"type": "sdfgrid", "to_world": moved(place), "grid": grid},
        "ball": ball(x, y),
        "pile": {"type": "cylinder", "p0": [x, y, -2.0], "p1": [x + 0.5, y, -1.0], "radius": 0.3},
        "group": {"type": "shapegroup", "member": {"type": "sphere", "center": [2.0, 0, 0]}},
        "one": {"type": "instance", "to_world": to_world, "group": {"type": "ref", "id": "group"}},
    }


@pytest.mark.parametrize("place", [BETWEEN])
def test_every_shape_lies_in_the_frame(place, tmp_path):
    near, far = (
        open_scene(scene_at(*at, **shapes_at(at, tmp_path))).scene
        for at in (np.subtract(place, np.round(place)), place)
    )
    np.testing.assert_array_equal(frame.frame_origin(far), [*np.round(place), 0])
    for one, other in zip(near.shapes(), far.shapes(), strict=True):
        assert one.id() == other.id()
        if one.id() == "sea":
            continue
        for corner in ("min", "max"):
            pair = [np.array(getattr(each.bbox(), corner)) for each in (one, other)]
            np.testing.assert_allclose(pair[1], pair[0], rtol=2e-6, atol=1e-6, err_msg=one.id())


def test_every_plugin_of_mitsuba_has_a_known_place_or_none():
    """A scene with a plugin that nobody has thought of stays where it is."""
    placed = {
        mi.ObjectType.Shape,
        mi.ObjectType.Sensor,
        mi.ObjectType.Emitter,
        mi.ObjectType.Medium,
        mi.ObjectType.Volume,
    }
    kinds = {str(kind).removeprefix("ObjectType.") for kind in placed}
    found = {name for name, kind in mitsuba_plugins.installed().items() if kind in kinds}
    assert found - UNKNOWN <= {*frame._PLACED, *frame._WITHOUT_PLACE}
    assert len(found) > 30


def test_texture_of_a_far_seabed_stays_in_place():
    """Colours at points of a grid, of tiles of 0.7 m; a whole number of them lies between the two places."""
    tiles = mi.ScalarTransform3d().scale([1 / 1.4, 1 / 1.4]).translate([0.1, 0.2])
    pattern = {"type": "checkerboard", "to_uv": tiles}
    colours = []
    for x, y in ((0.0, 0.0), (1.4 * 357143, -1.4 * 642857)):
        bed = {"type": "seabed", "centre_x": x, "centre_y": y, "bsdf": {"type": "diffuse", "reflectance": pattern}}
        scene = open_scene(scene_at(x, y, bottom=bed)).scene
        bottom = next(shape for shape in scene.shapes() if shape.id() == "bottom")
        east, north = (mi.Float(each.ravel()) for each in np.meshgrid(*2 * [np.linspace(-3.03, 2.98, 41)]))
        at = [float(each) for each in np.subtract((x, y), frame.frame_origin(scene)[:2])]
        ray = mi.Ray3f(mi.Point3f(east + at[0], north + at[1], -1), mi.Vector3f(0, 0, -1))
        si = mi.load_dict({"type": "scene", "bottom": bottom}).ray_intersect(ray)
        colours.append(np.array(bottom.bsdf().eval_diffuse_reflectance(si)))
    assert colours[0].std() > 0.09
    np.testing.assert_array_equal(*colours)


@each_row("near", "loaded", "unknown")
def test_near_scenes_and_those_of_unknown_places_stay(stays):
    x, y = (240.0, -60.0) if stays == "near" else FAR
    sphere = ball(x, y)
    one = {"centers": [[x, y, -4]], "scales": [[1, 1, 1]], "quaternions": [[0, 0, 0, 1]]}
    one = {name: mi.TensorXf(np.array(values, np.float32)) for name, values in one.items()}
    parts = {"near": sphere, "loaded": mi.load_dict(sphere), "unknown": {"type": "ellipsoids", **one}}
    scene = open_scene(scene_at(x, y, part=parts[stays])).scene
    assert not frame.frame_origin(scene).any()
    assert find_receiver(lidar_sensor(scene)).pose.ground_point()[0] == pytest.approx(x)


#: Largest difference between the integrators that is no fault.
TOLERATED = 0.01

#: That of a target in the flank of the beam, which the page states: a sphere in place of the instance differs as much.
IN_FLANK = {"instance": 0.025, "shapegroup": 0.025}


def test_page_has_a_row_for_each_plugin_that_is_installed():
    page = mitsuba_plugins.read_page()
    assert page.keys() == mitsuba_plugins.installed().keys()
    figures = {name: row[2] for name, row in page.items() if row[0] == "works"}
    assert len(figures) > 40
    for name, figure in figures.items():
        ratio, error = map(float, figure.split(" ± "))
        assert abs(ratio - 1) < max(3 * error, IN_FLANK.get(name, TOLERATED)), name


@pytest.mark.slow
def test_plugins_are_refused_and_ignored_as_the_page_states():
    page = mitsuba_plugins.read_page()
    rows = {row.plugin: row for row in mitsuba_plugins.beside()}
    for plugin, (verdict, told, _) in page.items():
        if verdict == "works":
            continue
        row = rows.get(plugin) or mitsuba_plugins.refused(plugin, mitsuba_plugins.installed()[plugin])
        assert (row.verdict, row.told) == (verdict, told)
        assert verdict == "ignored" or told.count(". ") == 0


# Half a minute each: other tests have the common shapes, materials, bitmaps and phase functions.
@pytest.mark.long
@pytest.mark.parametrize("builder", mitsuba_plugins.GROUPS, ids=lambda builder: builder.__name__)
def test_plugins_that_work_return_the_light_of_the_reference(builder, tmp_path):
    page = mitsuba_plugins.read_page()
    found = list(mitsuba_plugins.working(builder(tmp_path), passes=16, share=1 / 8))
    assert [page[row.plugin][:2] for row in found] == [[row.verdict, row.told] for row in found]
    fast, reference = (np.transpose(passes) for passes in zip(*(row.passes for row in found), strict=True))
    significance.assert_same(fast, reference, error=0.03, bias=TOLERATED)
