"""Scenes as documents: includes, parameters, and scenes of Python in JSON."""

import json

import mitsuba as mi
import numpy as np
import pytest
from rows import each_case, each_row, must_refuse

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import catalogue, scenes
from mitransient_lidar.loading.document import read_document
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import open_scene

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<!-- A level sea -->
<!--
  Over a bottom.
-->
<scene version="3.0.0">

    <default name="radius" value="2"/>
    <!-- Chosen here -->
    <default name="grey" value="0.5"/>  <!-- light &amp; dark -->

    <include filename="parts/ball.xml"/>
    <!-- Below -->
    <shape type="rectangle" id="floor">
        <include name="bsdf" filename="parts/matt.xml"/>
    </shape>
    <!-- The end -->
</scene>
"""

BALL = """<!-- Shared part -->
<scene version="3.0.0">

    <!-- All parameters -->

    <!-- Ball -->
    <default name="radius" value="1"/>  <!-- m -->
    <default name="depth"  value="3"/>
    <default name="grey"   value="0.1"/>  <!-- reflectance -->

    <include filename="point.xml"/>

    <shape type="sphere" id="ball">
        <!-- Nearly "round" -->
        <float name="radius" value="$radius"/>  <!-- half
            the diameter -->
        <point name="center" x="0" y="0" z="-$depth"/>
    </shape>

</scene>
"""

POINT = '<scene version="3.0.0"><default name="power" value="7"/></scene>'

MATT = """<bsdf version="3.0.0" type="diffuse">
  <!-- Matt -->
  <default name="gain" value="1"/>
  <spectrum name="reflectance" value="$grey"/>
</bsdf>
"""

FLAT = """<!-- A level sea -->
<!--
  Over a bottom.
-->
<scene version="3.0.0">

    <default name="radius" value="2"/>  <!-- m -->
    <!-- Chosen here -->
    <default name="grey" value="0.5"/>  <!-- light &amp; dark -->

    <!-- All parameters -->

    <!-- Ball -->
    <default name="depth" value="3"/>

    <default name="power" value="7"/>

    <shape type="sphere" id="ball">
        <!-- Nearly "round" -->
        <float name="radius" value="$radius"/>  <!-- half
            the diameter -->
        <point name="center" x="0" y="0" z="-$depth"/>
    </shape>

    <!-- Below -->
    <shape type="rectangle" id="floor">
        <bsdf type="diffuse" name="bsdf">
  <!-- Matt -->
  <default name="gain" value="1"/>
  <spectrum name="reflectance" value="$grey"/>
</bsdf>
    </shape>
    <!-- The end -->
</scene>
"""


@pytest.fixture
def scene(tmp_path):
    parts = {"ball.xml": BALL, "matt.xml": MATT, "point.xml": POINT}
    (tmp_path / "parts").mkdir()
    for name, text in parts.items():
        (tmp_path / "parts" / name).write_text(text, "utf-8")
    path = tmp_path / "own.xml"
    path.write_text(SCENE, "utf-8")
    return path


def test_text_with_includes_in_place(scene):
    assert read_document(scene).text == FLAT
    assert catalogue.scene_parameters(scene) == {"radius": "2", "depth": "3", "grey": "0.5", "power": "7", "gain": "1"}


def test_mitsuba_reads_the_same(scene):
    config = mi.parser.ParserConfig(mi.variant())
    for given in ({}, {"radius": "5", "grey": "0.2"}):
        own = mi.parser.parse_string(config, read_document(scene).text, **given)
        states = (mi.parser.parse_file(config, str(scene), **given), own)
        first, second = ([(node.type, str(node.props)) for node in state.nodes] for state in states)
        assert first == second
        assert f'"radius" -> {given.get("radius", "2")}' in first[1][1]


def test_value_that_refers_to_a_parameter_follows_it(scene):
    text = """<scene version="3.0.0">
    <default name="a" value="1"/>
    <default name="b" value="$a"/>  <!-- as a -->
    <include filename="part.xml"/>
    <shape type="sphere"><float name="radius" value="$b"/></shape>
</scene>"""
    part = '<scene version="3.0.0"><default name="b" value="2"/><default name="a" value="2"/> <!-- m --></scene>'
    scene.write_text(text, "utf-8")
    scene.with_name("part.xml").write_text(part, "utf-8")
    assert list(catalogue.scene_parameters(scene).items()) == [("a", "1"), ("b", "$a")]
    assert '<default name="a" value="1"/>  <!-- m -->\n    <default name="b" value="$a"/>  <!-- as a -->' in (
        read_document(scene).text
    )
    config = mi.parser.ParserConfig(mi.variant())
    assert mi.parser.parse_string(config, read_document(scene).text, a="9").nodes[1].props["radius"] == 9


def test_part_beside_the_including_file_is_found(scene):
    """Mitsuba looks in the folder of the part first, then in those of the files that include it."""
    (scene.parent / "parts" / "point.xml").rename(scene.with_name("point.xml"))
    assert read_document(scene).text == FLAT


@each_case(
    ("own.xml", '<scene><include filename="gone.xml"/></scene>', r"own\.xml includes 'gone\.xml', which is not"),
    ("own.xml", "<scene><include/></scene>", "own.xml includes '', which is not found"),
    ("parts/matt.xml", '<bsdf><include filename="ball.xml"/>', r"scene .*matt\.xml is not well-formed XML"),
    ("parts/point.xml", '<scene><include filename="ball.xml"/></scene>', r"includes 'ball\.xml', which includes"),
    ("parts/point.xml", b"\xff\xfe\x00", r"point\.xml is not a text file in UTF-8"),
)
def test_wrong_includes(part, text, sentence, scene):
    (scene.parent / part).write_bytes(text if isinstance(text, bytes) else text.encode())
    for use in (read_document, catalogue.scene_parameters, catalogue.copy_scene, scenes.open_scene):
        must_refuse(sentence, use, scene)


def test_includes_that_double_are_refused_at_once(tmp_path):
    """27 files that include the next one twice are 134 million parts."""
    for number in range(27):
        part = f'<include filename="{number + 1}.xml"/>'
        (tmp_path / f"{number}.xml").write_text(f'<scene version="3.0.0">{part}{part}</scene>')
    (tmp_path / "27.xml").write_text('<scene version="3.0.0"/>')
    for use in (read_document, catalogue.scene_parameters, scenes.open_scene):
        must_refuse(r"scene .*0\.xml includes more than 256 files, which is the limit", use, tmp_path / "0.xml")


def test_parameters_that_double_are_refused_at_once(tmp_path):
    """40 parameters that name the next one twice are a text of a terabyte."""
    parameters = [f'<default name="p{n:02}" value="$p{n + 1:02},$p{n + 1:02}"/>' for n in range(40)]
    shape = '<default name="p40" value="1"/><shape type="sphere"><float name="radius" value="$p00"/></shape>'
    (tmp_path / "bomb.xml").write_text(f'<scene version="3.0.0">{"".join(parameters)}{shape}</scene>')
    must_refuse(r"p00 = .* has more than a million characters", scenes.open_scene, tmp_path / "bomb.xml")


@pytest.mark.parametrize("folder", ["maps", "$x"])
def test_dollar_signs_in_values_are_taken_as_they_are(tmp_path, monkeypatch, folder):
    """A file name with the name of a parameter in it, in a folder of such a name, also where a result holds it."""
    path, own = tmp_path / folder / "share$x$ depth.npy", tmp_path / folder / "own.xml"
    path.parent.mkdir()
    monkeypatch.chdir(path.parent)
    np.save(path, np.full((3, 3), -4.0))
    text = """<scene version="3.0.0"><default name="x" value="2"/><default name="depth" value="$x"/>
        <default name="file" value="none.npy"/><shape type="seabed" id="bottom"><float name="depth" value="$depth"/>
        <string name="filename" value="$file"/><float name="map_size" value="$x"/></shape></scene>"""
    own.write_text(text)
    for given in (path.name, str(path)):
        loaded = scenes.open_scene(own, {"file": given})
        for again in (loaded, scenes.open_scene(loaded.source)):
            assert again.scene.shapes()[0].parameters["filename"] == str(path)
            assert again.scene.bbox().max.z == pytest.approx(-6)
            assert again.source.parameters["file"] == given
    own.write_text(text.replace('value="$depth"', 'value="$dept"'))
    must_refuse(r"depth = '\$dept' refers to an unknown parameter of the scene", scenes.open_scene, own)


def test_folders_of_a_scene_are_those_beside_it(tmp_path, monkeypatch):
    for folder in ("scene/a", "here/a"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "scene" / "own.xml").write_text('<scene version="3.0.0"><path value="a"/></scene>')
    monkeypatch.chdir(tmp_path / "here")
    assert read_document(tmp_path / "scene" / "own.xml").folders[0] == (tmp_path / "scene" / "a").resolve()


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
