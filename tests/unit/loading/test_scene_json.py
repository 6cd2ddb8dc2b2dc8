"""What a scene of Python objects holds beside numbers and texts is stored, and restored in every bit."""

import json

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import open_scene

NUMBERS = np.random.default_rng(1).random((4, 4, 4, 1), np.float32)
COLOURS = np.uint8(255 * NUMBERS[..., 0].reshape(8, 2, 4)[..., :3])
BOX = mi.ScalarTransform4f().translate([0, 0, -5])


def volume(**given):
    return {"type": "volume", "volume": {"type": "gridvolume", "raw": True, **given}}


@each_row(
    {"type": "bitmap", "bitmap": mi.Bitmap(NUMBERS[0]), "raw": True},
    {"type": "bitmap", "bitmap": mi.Bitmap(NUMBERS[0]).convert(component_format=mi.Struct.Type.Float16)},
    {"type": "bitmap", "bitmap": mi.Bitmap(COLOURS), "wrap_mode": "mirror"},
    {"type": "bitmap", "data": mi.TensorXf(NUMBERS[0]), "raw": True},
    {"type": "checkerboard", "color0": 0.2, "color1": {"type": "bitmap", "bitmap": mi.Bitmap(COLOURS)}},
    volume(grid=mi.VolumeGrid(NUMBERS), to_world=mi.ScalarTransform4f().scale(2)),
    volume(data=mi.TensorXf(NUMBERS)),
)
def test_textures_of_python_are_restored(texture):
    solid = {"type": "cube", "to_world": BOX, "bsdf": {"type": "diffuse", "reflectance": texture}}
    loaded = open_scene({"solid": solid})
    again = open_scene(SceneSource.from_attributes(loaded.source.attributes()))
    values = [dict(mi.traverse(one.scene)) for one in (loaded, again)]
    assert list(values[0]) == list(values[1])
    for name, value in values[0].items():
        np.testing.assert_array_equal(np.array(value), np.array(values[1][name]), err_msg=name)


def test_a_grid_of_distances_is_restored():
    grid = {"type": "sdfgrid", "grid": mi.TensorXf(NUMBERS - 0.5), "to_world": BOX}
    loaded = open_scene({"solid": grid})
    again = open_scene(SceneSource.from_attributes(loaded.source.attributes()))
    found = [np.array(mi.traverse(one.scene)["solid.grid"]) for one in (loaded, again)]
    np.testing.assert_array_equal(*found)


def test_large_images_and_damaged_ones_are_refused():
    noise = np.random.default_rng(1).random((600, 600, 1), np.float32)
    scene = {"type": "bitmap", "bitmap": mi.Bitmap(noise), "raw": True}
    assert SceneSource.of_dict({"image": scene}) is None
    scene["bitmap"] = mi.Bitmap(NUMBERS[0])
    stored = json.loads(SceneSource.of_dict({"image": scene}).text)
    for damage in ({"data": "AAAA"}, {"shape": [5, 5, 1]}, {"dtype": "O"}, {"pixel_format": "None"}, {"data": "*"}):
        text = json.dumps({"image": {**scene, "bitmap": {**stored["image"]["bitmap"], **damage}}})
        with pytest.raises(UserError, match="the scene of the result is damaged"):
            open_scene(SceneSource.from_attributes({"scene_dict": text}))
