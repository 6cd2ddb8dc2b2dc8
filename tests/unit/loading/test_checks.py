"""Scenes that would make Mitsuba load a library of their author."""

import subprocess
import sys

import mitsuba as mi
import pytest

import mitransient_lidar
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.scene_record import SceneRecord
from mitransient_lidar.loading.scenes import load_scene
from mitransient_lidar.rendering.session import choose_integrator

#: A library outside, reached from each folder in which Mitsuba looks for plugins.
PATH = "../" * 12 + "elsewhere/evil"
NOT_A_NAME = r"^type = .*evil.* must be the name of a plugin, of letters, digits and underscores$"


def scene_file(folder, old, new):
    path = folder / "scene.xml"
    path.write_text(catalogue.scene_text("table1").replace(old, new, 1), "utf-8")
    return path


@pytest.mark.parametrize("value", [PATH, "/elsewhere/evil", "evil.so", "", "evil\n"])
def test_types_that_are_paths_are_refused(tmp_path, value):
    written = scene_file(tmp_path, '<integrator type="lidar_merging"/>', f'<integrator type="{value}"/>')
    with pytest.raises(UserError, match="must be the name of a plugin"):
        load_scene(written)
    with pytest.raises(UserError, match="must be the name of a plugin"):
        load_scene({"sea": {"type": "ocean_surface", "interior": {"type": value}}})


def test_folders_of_a_scene_are_not_kept_for_others(tmp_path):
    """Mitsuba looks for files, and for libraries of plugins, in all folders that it knows."""
    before = [str(path) for path in mi.file_resolver()]
    part = f'<path value="{tmp_path}"/><integrator type="lidar_merging"/>'
    load_scene(scene_file(tmp_path, '<integrator type="lidar_merging"/>', part))
    assert [str(path) for path in mi.file_resolver()] == before


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"scene_xml": 3}, "the attribute scene_xml = 3 of the result is damaged: it must be a text"),
        ({"scene_xml": "<scene/>", "scene.depth": [1, 2]}, r"scene.depth = \[1, 2\] of the result is damaged"),
        ({"scene_xml": "<scene/>", "scene_files": "[3]"}, "scene_files of the result is damaged"),
        ({"scene_xml": "<scene/>", "scene_files": "{"}, "scene_files of the result is damaged"),
        ({"scene_xml": "<scene>"}, "is not well-formed XML"),
        ({"scene_dict": "[" * 10**5}, "its text must be JSON of a scene"),
        ({"scene_dict": "[1]"}, "its text must be JSON of a scene"),
        ({"scene_dict": '{"to_world": {"matrix": 3, "inverse_transpose": []}}'}, "its text must be JSON of a scene"),
        ({}, "does not hold its scene"),
    ],
)
def test_damaged_records_are_refused(attributes, message):
    with pytest.raises(UserError, match=message):
        load_scene(SceneRecord.from_attributes(attributes))


def test_types_are_checked_with_parameters_in_place(tmp_path):
    text = '<default name="kind" value="lidar_merging"/><integrator type="$kind"/>'
    written = scene_file(tmp_path, '<integrator type="lidar_merging"/>', text)
    with pytest.raises(UserError, match=NOT_A_NAME):
        load_scene(written, {"kind": PATH})


@pytest.mark.slow
def test_types_of_results_are_checked(tmp_path):
    text = '<default name="kind" value="lidar_merging"/><integrator type="$kind"/>'
    written = scene_file(tmp_path, '<integrator type="lidar_merging"/>', text)
    result = mitransient_lidar.render(written, passes=2, params={"layout": "1x1"})
    for name, old, new in (("scene_xml", 'type="$kind"', f'type="{PATH}"'), ("scene.kind", "lidar_merging", PATH)):
        hostile = result.copy()
        assert old in hostile.attrs[name]
        hostile.attrs[name] = hostile.attrs[name].replace(old, new)
        with pytest.raises(UserError, match=NOT_A_NAME):
            mitransient_lidar.render(hostile, passes=2)


def test_integrators_of_a_command_are_names():
    scene = load_scene("table1")[0]
    for wanted in (PATH, {"type": PATH}, {"type": "lidar_volpath", "nested": {"type": PATH}}):
        with pytest.raises(UserError, match=NOT_A_NAME):
            choose_integrator(scene, wanted)


@pytest.mark.parametrize("place", ["beside the scene", "named by the scene"])
@pytest.mark.parametrize("library", ["diffuse.so", "roughdielectric.dylib", "new.dll"])
def test_libraries_of_plugins_beside_a_scene_are_refused(tmp_path, place, library):
    """That of the smooth Lambertian surface would be loaded instead of Mitsuba's own."""
    folder = tmp_path / "scene" if place == "beside the scene" else tmp_path / "other"
    (folder / "plugins").mkdir(parents=True)
    (tmp_path / "scene").mkdir(exist_ok=True)
    written = scene_file(tmp_path / "scene", "</scene>", '<path value="../other"/></scene>')
    if place == "beside the scene":
        written = scene_file(tmp_path / "scene", "", "")
    load_scene(written)
    (folder / "plugins" / library).write_bytes(b"")
    with pytest.raises(UserError, match=rf"{library} would run as a plugin of Mitsuba; remove it"):
        load_scene(written)


@pytest.mark.slow
def test_libraries_of_plugins_in_the_current_folder_are_refused(tmp_path):
    """Mitsuba looks for files in the folder in which a process starts, too."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "diffuse.so").write_bytes(b"")
    command = [sys.executable, "-m", "mitransient_lidar", "render", "table1", "-o", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "diffuse.so would run as a plugin of Mitsuba" in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()
