"""Solids that coincide in a face with a bottom, the sea or each other."""

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport import contacts
from mitransient_lidar.transport.scene_parts import find_lidar_scene

BOTTOM = -8.0


def solid(kind, size, *centre, turn=0.0, **more):
    place = mi.ScalarTransform4f().translate(list(centre)).rotate([0, 1, 0], turn).scale(size)
    return {"type": kind, "to_world": place, **more}


@pytest.fixture(scope="module")
def ply(tmp_path_factory):
    path = tmp_path_factory.mktemp("meshes") / "plate.ply"
    mesh = mi.load_dict(solid("rectangle", 0.4, 0, 0, BOTTOM))
    mesh.write_ply(str(path))
    return str(path)


def moves(scene):
    """Return by how much the parts of a scene are moved [mm], of those that are."""
    before = {shape.id(): np.array(shape.bbox().min) for shape in scene.shapes()}
    found = find_lidar_scene(scene, scene.sensors()[0])
    after = {shape.id(): np.array(shape.bbox().min) for shape in scene.shapes()}
    return found, {name: 1e3 * (after[name] - before[name]) for name in before if (after[name] != before[name]).any()}


#: Shapes, and in which directions they are moved by 0.1 mm; those on others by 0.1 mm more.
CASES = {
    "plate on the bottom": ({"a": solid("rectangle", 0.4, 0, 0, BOTTOM)}, {"a": (0, 0, 1)}),
    "turned over": ({"a": solid("rectangle", 0.4, 0, 0, BOTTOM, turn=180.0)}, {"a": (0, 0, 1)}),
    "cube on the bottom": ({"a": solid("cube", 0.4, 0, 0, BOTTOM + 0.4)}, {"a": (0, 0, 1)}),
    "cube flush with the bottom": ({"a": solid("cube", 0.4, 0, 0, BOTTOM - 0.4)}, {"a": (0, 0, 1)}),
    "stack and row": (
        {
            "a": solid("cube", 0.5, 0, 0, BOTTOM + 0.5),
            "b": solid("cube", 0.5, 0, 0, BOTTOM + 1.5),
            "c": solid("cube", 0.3, 0.8, 0, BOTTOM + 0.3),
        },
        {"a": (0, 0, 1), "b": (0, 0, 2), "c": (1, 0, 1)},
    ),
    "plate on the side of a cube": (
        {"a": solid("rectangle", 0.2, 0.5, 0, -4, turn=90.0), "b": solid("cube", 0.5, 0, 0, -4)},
        {"a": (1, 0, 0)},
    ),
    "back to back": (
        {"a": solid("rectangle", 0.5, 0, 0, -4), "b": solid("rectangle", 0.5, 0, 0, -4, turn=180.0)},
        {"a": (0, 0, 1)},
    ),
    "one in the other, both on the bottom": (
        {"a": solid("cube", 0.5, 0, 0, BOTTOM + 0.5), "b": solid("cube", 0.4, 0.2, 0, BOTTOM + 0.4)},
        {"a": (0, 0, 1), "b": (0, 0, 1)},
    ),
    "apart": ({"a": solid("rectangle", 0.4, 0, 0, BOTTOM + 1e-4), "b": solid("sphere", 1.0, 0, 3, BOTTOM + 1)}, {}),
}


@pytest.mark.parametrize("name", CASES)
def test_solids_that_touch_are_moved_apart_once(lidar_scene, name):
    extra, wanted = CASES[name]
    scene = lidar_scene(extra=extra)
    found, moved = moves(scene)
    assert moved.keys() == wanted.keys()
    for one, steps in wanted.items():
        np.testing.assert_allclose(moved[one], 0.11 * np.array(steps), atol=0.02)
    assert moves(scene)[1] == {}
    ray = mi.Ray3f(mi.Point3f(0.05, 0.1, -1), mi.Vector3f(0, 0, -1))
    met = found.ray_intersect(ray).shape[0].id()
    assert met == ("b" if name in ("stack and row", "plate on the side of a cube") else "a")


def test_meshes_and_instances_that_lie_on_the_bottom_are_seen(lidar_scene, ply):
    group = {"type": "shapegroup", "plate": solid("rectangle", 1.0, 0, 0, 0)}
    instance = solid("instance", 0.4, 2, 0, BOTTOM, group={"type": "ref", "id": "group"})
    extra = {"mesh": {"type": "ply", "filename": ply}, "group": group, "instance": instance}
    _, moved = moves(lidar_scene(extra=extra))
    assert {name: tuple(by.round(1)) for name, by in moved.items()} == {"mesh": (0, 0, 0.1), "instance": (0, 0, 0.1)}


@each_row(
    ({"a": solid("rectangle", 0.4, 0, 0, 0)}, ("a", "sea"), "the surface of the water"),
    ({"a": solid("cube", 0.4, 0, 0, -0.4)}, ("a", "sea"), "the surface of the water"),
    ({name: solid("rectangle", 0.4, 0, 0, -4) for name in "ab"}, "ab", "not defined which one is seen"),
    ({"a": solid("cube", 0.4, 0, 0, -4), "b": solid("cube", 0.4, 0.3, 0, -4)}, "ab", "not defined which one"),
)
def test_solids_that_coincide_without_order_are_refused(extra, names, reason, lidar_scene):
    with pytest.raises(UserError, match=f"shapes '.*' and '.*' coincide in a face.*{reason}") as refusal:
        moves(lidar_scene(extra=extra))
    assert all(repr(name) in str(refusal.value) for name in names)


def test_many_solids_are_compared_in_few_scenes(lidar_scene, monkeypatch):
    count, built, real = 60, [], contacts.scene_of_shapes
    monkeypatch.setattr(contacts, "scene_of_shapes", lambda *parts: built.append(parts) or real(*parts))
    places = np.random.default_rng(5).permutation(100)[:count]
    cubes = {
        f"cube{number}": solid("cube", 0.05, 0.12 * (place // 10), 0.12 * (place % 10), BOTTOM + 0.05)
        for number, place in enumerate(places)
    }
    _, moved = moves(lidar_scene(extra=cubes))
    assert moved.keys() == cubes.keys()
    np.testing.assert_allclose([*moved.values()], [(0, 0, 0.11)] * count, atol=0.02)
    assert len(built) < 30
