"""The catalogue of scenes: names, copies, and what the shipped ones hold."""

import mitsuba as mi
import pytest
import references
from rows import each_row, must_refuse, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.document import read_document

SCENE = """<!-- Flat bottom at 8 m, wind 3 m/s.
     The second line. -->
<scene version="3.0.0">
  <!-- Another comment. -->
  <default name="wind_speed" value="3"/>
  <default name="bottom_depth" value="8.0"/>
  <include filename="_water.xml"/>
  <shape type="ply" id="water"><string name="filename" value="target.ply"/></shape>
</scene>
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "fig09.xml").write_text(SCENE)
    (folder / "fig10.xml").write_text('<scene version="3.0.0"/>')
    (folder / "_water.xml").write_text(
        '<scene version="3.0.0"><default name="profile" value="profile.csv"/></scene>', encoding="utf-8"
    )
    (folder / "water").mkdir()
    (folder / "target.ply").write_text("ply")
    (folder / "profile.csv").write_text("0 1")
    (folder / "unused.ply").write_text("ply")
    (folder / "__init__.py").write_text("")
    monkeypatch.setattr(catalogue, "folder_of_scenes", lambda: folder)
    return folder


def test_path_of_name_and_of_file(folder, tmp_path):
    assert catalogue.scene_path("fig09") == folder / "fig09.xml"
    own = tmp_path / "own.xml"
    own.write_text("<scene/>")
    assert catalogue.scene_path(str(own)) == own
    assert catalogue.scene_path(own) == own


@refuses(
    ("fig9", "scene 'fig9' is neither a file nor a shipped scene; did you mean fig09"),
    ("scenes/fig10.XML", "did you mean fig10"),
    ("zzz", "scene 'zzz' .*; shipped scenes are fig09, fig10"),
)
def test_unknown_scene(name, folder):
    catalogue.scene_path(name)


def test_first_default_wins_as_in_mitsuba(folder):
    twice = '<default name="wind_speed" value="3"/><default name="wind_speed" value="4"/>'
    (folder / "twice.xml").write_text(f'<scene version="3.0.0">{twice}</scene>')
    assert catalogue.scene_parameters("twice") == {"wind_speed": "3"}


def test_copy_is_one_scene_file_with_the_data_that_it_names(folder, tmp_path):
    target = tmp_path / "mine"
    target.mkdir()
    assert catalogue.copy_scene("fig09", target) == target / "fig09.xml"
    assert (target / "fig09.xml").read_text() == catalogue.scene_text("fig09")
    assert sorted(path.name for path in target.iterdir()) == ["fig09.xml", "profile.csv", "target.ply"]
    assert catalogue.scene_parameters(target / "fig09.xml") == catalogue.scene_parameters("fig09")


def test_files_of_the_guides_are_copied_with_the_data_that_they_name(tmp_path):
    for name in ("gated_target.xml", "own_receiver.toml", "semi_arc.toml", "shore.toml"):
        assert catalogue.copy_scene(name, tmp_path) == tmp_path / name
    copied = {path.name for path in tmp_path.iterdir()}
    shore = {"shore.toml", "shore.xml", "shore.tif", "shore_track.csv"}
    assert copied == {"gated_target.xml", "pyramid.ply", "own_receiver.toml", "amplifier.csv", "semi_arc.toml"} | shore
    for name in copied - {"gated_target.xml", "shore.xml"}:
        assert (tmp_path / name).read_bytes() == catalogue.example_files()[name].read_bytes()


def test_copy_overwrites_nothing(folder, tmp_path):
    (tmp_path / "target.ply").write_text("mine")
    must_refuse(r"target\.ply exists already", catalogue.copy_scene, "fig09", tmp_path)
    assert (tmp_path / "target.ply").read_text() == "mine"
    assert not (tmp_path / "fig09.xml").exists()


def test_a_scene_is_not_copied_onto_itself(folder, tmp_path):
    """A copy has no includes: the scene's own file would be lost."""
    copy = catalogue.copy_scene("fig09", tmp_path)
    with pytest.raises(UserError, match=r"fig09\.xml is the file to be copied: choose another place"):
        catalogue.copy_scene(copy, tmp_path, overwrite=True)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_figure_10_zooms_into_the_record_of_figure_11(number):
    zoom, whole = (catalogue.scene_parameters(catalogue.scene_path(f"fig{figure}_shot{number}")) for figure in (10, 11))
    assert {name for name in zoom if zoom[name] != whole[name]} <= {"time_start_ns", "bin_width_ns", "bin_count"}
    assert zoom.keys() == whole.keys()


SHIPPED = references.read(references.SCENES)


def test_parameters_are_those_of_the_reference():
    """Those of table1, and what every other scene has otherwise or lacks."""
    assert references.scene_parameters() == SHIPPED


@each_row(*SHIPPED)
def test_text_equals_the_file_with_its_includes(name):
    """Mitsuba reads the same plugins with the same parameters in the same order from both."""
    config = mi.parser.ParserConfig(mi.variant())
    text = catalogue.scene_text(name)
    states = (mi.parser.parse_file(config, str(catalogue.scene_path(name))), mi.parser.parse_string(config, text))
    file, flat = ([(str(node.type), str(node.props)) for node in state.nodes] for state in states)
    assert len(flat) >= 8
    assert flat == file
    assert "<include" not in text
    assert text.count("<scene") == text.count("</scene>") == 1
    assert text.count("<default") == len(read_document(catalogue.scene_path(name)).parameters)


def test_all_parameters_but_texts_have_a_unit():
    own = {name for scene in SHIPPED for name in read_document(catalogue.scene_path(scene)).parameters}
    assert {name for name in own if unit_of(name) is None} == {"layout"}
    given = {"bottom_depth": "m", "surface_time": "s", "sea.slope_x_deg": "degree", "gate_width_ns": "ns"}
    given |= {"plume_width": "m", "sphere_reflectance": "1", "kd": "1/m"}
    assert {name: unit_of(name) for name in given} == given
    assert unit_of("my_parameter") is None
