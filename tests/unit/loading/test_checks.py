"""Scenes that would make Mitsuba load a library of their author."""

import itertools
import json
import os

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row, must_refuse, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scene_source import SceneSource
from mitransient_lidar.loading.scenes import choose_integrator, open_scene

#: A library outside, reached from each folder in which Mitsuba looks for plugins.
PATH = "../" * 12 + "elsewhere/evil"
NOT_A_NAME = r"^type = .*evil.* must be the name of a plugin, of letters, digits and underscores$"


def scene_file(folder, old, new):
    path = folder / "scene.xml"
    path.write_text(catalogue.scene_text("table1").replace(old, new, 1), "utf-8")
    return path


@each_row(PATH, "/elsewhere/evil", "evil.so", "", "evil\n")
def test_types_that_are_paths_are_refused(value, tmp_path):
    written = scene_file(tmp_path, '<integrator type="lidar_merging"/>', f'<integrator type="{value}"/>')
    must_refuse("must be the name of a plugin", open_scene, written)
    with pytest.raises(UserError, match="must be the name of a plugin"):
        open_scene({"sea": {"type": "ocean_surface", "interior": {"type": value}}})


def test_folders_of_a_scene_are_not_kept_for_others(tmp_path):
    """Mitsuba looks for files, and for libraries of plugins, in all folders that it knows."""
    before = [str(path) for path in mi.file_resolver()]
    part = f'<path value="{tmp_path}"/><integrator type="lidar_merging"/>'
    open_scene(scene_file(tmp_path, '<integrator type="lidar_merging"/>', part))
    assert [str(path) for path in mi.file_resolver()] == before


@refuses(
    ({"scene_xml": 3}, "the attribute scene_xml = 3 of the result is damaged: it must be a text"),
    ({"scene_xml": "<scene/>", "scene.depth": [1, 2]}, r"scene.depth = \[1, 2\] of the result is damaged"),
    ({"scene_xml": "<scene/>", "scene_files": "[3]"}, "scene_files of the result is damaged"),
    ({"scene_xml": "<scene/>", "scene_files": "{"}, "scene_files of the result is damaged"),
    ({"scene_xml": "<scene>"}, "is not well-formed XML"),
    ({"scene_dict": "[" * 10**5}, "the scene of the result is nested more than 100 deep"),
    ({"scene_dict": "[1]"}, "its text must be JSON of a scene"),
    ({"scene_dict": '{"to_world": {"matrix": 3, "inverse_transpose": []}}'}, "its text must be JSON of a scene"),
    ({}, "does not hold its scene"),
)
def test_damaged_records_are_refused(attributes):
    open_scene(SceneSource.from_attributes(attributes))


def stranger(folder, name, text):
    """Write a file into a folder in which a library of a stranger lies beside ``plugins``, and return its path."""
    (folder / "plugins").mkdir(parents=True, exist_ok=True)
    (folder / "evil.so").write_bytes(b"not a library")
    (folder / name).write_text(text)
    return folder / name


PART = '<scene version="3.0.0"><shape type="../evil"/></scene>'


def test_an_entity_that_becomes_an_include_is_refused(tmp_path):
    """Its file was never checked, and Mitsuba loaded the library that it names."""
    stranger(tmp_path, "part.xml", PART)
    entity = """<!DOCTYPE scene [<!ENTITY e "&#60;include filename='part.xml'/>">]>"""
    with pytest.raises(UserError, match="holds a DOCTYPE: it must hold elements, attributes and comments only"):
        open_scene(stranger(tmp_path, "a.xml", f'{entity}<scene version="3.0.0">&e;</scene>'))


@pytest.mark.parametrize("tag", ["include", "default name='a' value='b'/><include"])
def test_includes_in_results_are_refused(tmp_path, tag):
    part = stranger(tmp_path, "part.xml", PART)
    text = f'<scene version="3.0.0"><{tag} filename="{part}"/></scene>'
    with pytest.raises(UserError, match=r"includes .*part.xml': only the file of a scene may include others"):
        open_scene(SceneSource.from_attributes({"scene_xml": text}))


def test_a_part_that_is_an_include_is_refused(tmp_path):
    """Mitsuba takes the root of a part as it is, unless it is a scene."""
    stranger(tmp_path, "deep.xml", PART)
    stranger(tmp_path, "part.xml", '<include version="3.0.0" filename="deep.xml"/>')
    with pytest.raises(UserError, match=r"includes 'deep.xml': only the file of a scene may include others"):
        open_scene(stranger(tmp_path, "a.xml", '<scene version="3.0.0"><include filename="part.xml"/></scene>'))


@pytest.mark.parametrize("root", ['<shape version="3.0.0" type="../evil"/>', '<scene version="3.0.0" type="../evil"/>'])
def test_the_type_of_the_root_is_checked(tmp_path, root):
    must_refuse(r"has a root element .*: it must be <scene>", open_scene, stranger(tmp_path, "a.xml", root))


def test_a_path_within_another_path_is_refused(tmp_path):
    """Mitsuba looks for a folder in those before, too: libraries of a/b would have been loaded."""
    stranger(tmp_path / "a" / "b", "x", "")
    text = '<scene version="3.0.0"><path value="a"/><path value="b"/><shape type="evil"/></scene>'
    must_refuse("path = 'b' is no folder in", open_scene, stranger(tmp_path, "a.xml", text))


def test_libraries_in_resources_of_a_dict_or_the_current_folder_are_refused(tmp_path, monkeypatch):
    """It may be another one than that in which the process began, and Mitsuba looks there last."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "evil.so").write_bytes(b"not a library")
    scene = {"type": "scene", "folder": {"type": "resources", "path": str(tmp_path)}, "shape": {"type": "evil"}}
    record = SceneSource.from_attributes({"scene_dict": json.dumps(scene)})
    for one in (scene, record):
        must_refuse(r"evil.so would run as a plugin of Mitsuba", open_scene, one)
    with pytest.raises(UserError, match="path = 'nowhere' of resources must be a folder"):
        open_scene({**scene, "folder": {"type": "resources", "path": "nowhere"}})
    monkeypatch.chdir(tmp_path)
    must_refuse(r"evil.so would run as a plugin of Mitsuba", open_scene, {"type": "scene", "shape": {"type": "evil"}})


@each_row("blender", "serialized", "irregular", "polarizer", "homogeneous", "point")
def test_plugins_that_a_lidar_scene_cannot_have_are_refused(plugin, tmp_path):
    with pytest.raises(UserError, match=f"type = '{plugin}' is not loaded"):
        open_scene({"type": "scene", "shape": {"type": plugin, "filename": "a"}})
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0"><shape type="{plugin}"/></scene>')
    must_refuse(f"type = '{plugin}' is not loaded", open_scene, path)


@pytest.mark.parametrize("given", ['value="400:0.1, 700:0.3"', 'filename="a.spd"'])
def test_spectra_by_wavelength_are_refused(given, tmp_path):
    """Mitsuba takes their luminance: 0.204 where the value at 532 nm is 0.188."""
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="sphere"><bsdf type="diffuse">'
        f'<spectrum name="reflectance" {given}/></bsdf></shape></scene>'
    )
    must_refuse("must be one number, the value at the laser's wavelength", open_scene, path)
    name, _, value = given.replace('"', "").partition("=")
    value = [(400.0, 0.1), (700.0, 0.3)] if name == "value" else value
    reflectance = {"type": "spectrum", name: value}
    with pytest.raises(UserError, match="must be one number, the value at the laser's wavelength"):
        open_scene({"shape": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": reflectance}}})


def test_a_dict_with_tensors_is_loaded_twice():
    """Mitsuba empties the tensors of which it makes textures."""
    bitmap = {"type": "bitmap", "data": mi.TensorXf(np.full((2, 2, 1), 0.5, np.float32)), "raw": True}
    scene = {"shape": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": bitmap}}}
    for _ in range(2):
        assert open_scene(scene).scene.shapes()


@each_row("../../elsewhere/important", "/tmp/a", "a/b", "", "..", "a\nb", "\x1b[2J", "x" * 300, 3)
def test_the_name_of_the_scene_of_a_result_is_that_of_a_file(name):
    """Files of the result's repetition begin with it: a path led out of the folder of ``-o``."""
    with pytest.raises(UserError, match=r"the attribute scene = .* of the result is damaged") as caught:
        SceneSource.from_attributes({"scene": name, "scene_xml": "<scene/>"})
    assert str(caught.value).isprintable()


def test_a_pipe_that_mitsuba_would_read_is_refused(tmp_path, monkeypatch):
    """In the folder of the scene, in one that it names, in the current one, and of a texture and a mesh."""
    (tmp_path / "other").mkdir()
    (tmp_path / "here").mkdir()
    for folder in ("", "other", "here"):
        os.mkfifo(tmp_path / folder / f"pipe{folder}")
    monkeypatch.chdir(tmp_path / "here")
    parts = (
        '<shape type="ply"><string name="filename" value="{}"/></shape>',
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="{}"/></texture>'
        "</bsdf>",
    )
    for folder, part in itertools.product(("", "other", "here"), parts):
        text = f'<scene version="3.0.0"><path value="other"/>{part.format(f"pipe{folder}")}</scene>'
        (tmp_path / "a.xml").write_text(text)
        must_refuse(f"pipe{folder}: it is a named pipe", open_scene, tmp_path / "a.xml")
    given = {"type": "scene", "mesh": {"type": "ply", "filename": "pipehere"}}
    for one in (given, SceneSource.from_attributes({"scene_dict": json.dumps(given)})):
        must_refuse("pipehere: it is a named pipe", open_scene, one)
    with pytest.raises(UserError, match="pipehere: it is a named pipe"):
        choose_integrator(open_scene({"type": "scene"}).scene, {**given, "type": "lidar_merging"})


def test_names_of_files_that_mitsuba_would_print_are_refused(tmp_path):
    path = tmp_path / "a\x1b]0;title\x07.ply"
    path.write_text("ply\n")
    with pytest.raises(UserError, match="its name must have no control characters") as caught:
        open_scene({"type": "scene", "mesh": {"type": "ply", "filename": str(path)}})
    assert str(caught.value).isprintable()


def test_names_of_files_are_texts_and_types_are_checked_with_parameters_in_place(tmp_path):
    with pytest.raises(UserError, match=r"profile_file = 1.0 must be a text, the name of a file"):
        open_scene({"type": "scene", "laser": {"type": "lidar_transmitter", "profile_file": 1.0}}, None)
    text = '<default name="kind" value="lidar_merging"/><integrator type="$kind"/>'
    with pytest.raises(UserError, match=NOT_A_NAME):
        open_scene(scene_file(tmp_path, '<integrator type="lidar_merging"/>', text), {"kind": PATH})


def test_integrators_of_a_command_are_names():
    scene = open_scene("table1").scene
    for wanted in (PATH, {"type": PATH}, {"type": "lidar_volpath", "nested": {"type": PATH}}):
        must_refuse(NOT_A_NAME, choose_integrator, scene, wanted)


@pytest.mark.parametrize("place", ["beside the scene", "named by the scene"])
@pytest.mark.parametrize("library", ["diffuse.so", "roughdielectric.dylib"])
def test_libraries_of_plugins_beside_a_scene_are_refused(tmp_path, place, library):
    """That of the smooth Lambertian surface would be loaded instead of Mitsuba's own."""
    folder = tmp_path / "scene" if place == "beside the scene" else tmp_path / "other"
    (folder / "plugins").mkdir(parents=True)
    (tmp_path / "scene").mkdir(exist_ok=True)
    written = scene_file(tmp_path / "scene", "</scene>", '<path value="../other"/></scene>')
    if place == "beside the scene":
        written = scene_file(tmp_path / "scene", "", "")
    open_scene(written)
    (folder / "plugins" / library).write_bytes(b"")
    must_refuse(rf"{library} would run as a plugin of Mitsuba; remove it", open_scene, written)
