"""Shipped scenes."""

import pytest

from mitransient_lidar import resources
from mitransient_lidar.errors import UserError

SCENE = """<!-- Flat bottom at 8 m, wind 3 m/s.
     The second line. -->
<scene version="3.0.0">
  <!-- Another comment. -->
  <default name="wind_speed" value="3"/>
  <default name="bottom_depth" value="8.0"/>
  <include filename="_water.xml"/>
  <shape type="ply"><string name="filename" value="target.ply"/></shape>
</scene>
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "fig09.xml").write_text(SCENE)
    (folder / "fig10.xml").write_text('<scene version="3.0.0"/>')
    (folder / "_water.xml").write_text('<scene version="3.0.0"><string value="profile.csv"/></scene>')
    (folder / "target.ply").write_text("ply")
    (folder / "profile.csv").write_text("0 1")
    (folder / "unused.ply").write_text("ply")
    (folder / "__init__.py").write_text("")
    monkeypatch.setattr(resources, "_folder", lambda: folder)
    return folder


def test_names_leave_out_parts(folder):
    assert resources.scene_names() == ["fig09", "fig10"]


def test_path_of_name_and_of_file(folder, tmp_path):
    assert resources.scene_path("fig09") == folder / "fig09.xml"
    own = tmp_path / "own.xml"
    own.write_text("<scene/>")
    assert resources.scene_path(str(own)) == own
    assert resources.scene_path(own) == own


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("fig9", "scene 'fig9' is neither a file nor a shipped scene; did you mean fig09"),
        ("scenes/fig10.XML", "did you mean fig10"),
        ("zzz", "scene 'zzz' .*; shipped scenes are fig09, fig10"),
    ],
)
def test_unknown_scene(folder, name, sentence):
    with pytest.raises(UserError, match=sentence):
        resources.scene_path(name)


def test_folder_is_no_scene(folder):
    with pytest.raises(UserError, match="is a folder"):
        resources.scene_path(folder)


def test_summary_and_parameters(folder):
    assert resources.scene_summary("fig09") == "Flat bottom at 8 m, wind 3 m/s."
    assert resources.scene_summary("fig10") == ""
    assert resources.scene_parameters("fig09") == {"wind_speed": "3", "bottom_depth": "8.0"}
    assert list(resources.scene_parameters(folder / "fig09.xml")) == ["wind_speed", "bottom_depth"]


def test_text_that_is_no_xml_or_no_text(folder):
    (folder / "bad.xml").write_text("<scene>")
    with pytest.raises(UserError, match=r"scene bad is not well-formed XML: .*line 1"):
        resources.scene_parameters("bad")
    (folder / "bad.xml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not a UTF-8 text file"):
        resources.scene_text("bad")


def test_copy_takes_along_what_the_scene_refers_to(folder, tmp_path):
    target = tmp_path / "mine"
    target.mkdir()
    assert resources.copy_scene("fig09", target) == target / "fig09.xml"
    assert (target / "fig09.xml").read_text() == SCENE
    assert sorted(path.name for path in target.iterdir()) == ["_water.xml", "fig09.xml", "profile.csv", "target.ply"]


def test_copy_to_a_new_name(folder, tmp_path):
    assert resources.copy_scene("fig10", tmp_path / "new.xml") == tmp_path / "new.xml"
    assert (tmp_path / "new.xml").is_file()


def test_copy_overwrites_nothing(folder, tmp_path):
    (tmp_path / "target.ply").write_text("mine")
    with pytest.raises(UserError, match=r"target\.ply exists already"):
        resources.copy_scene("fig09", tmp_path)
    assert (tmp_path / "target.ply").read_text() == "mine"
    assert not (tmp_path / "fig09.xml").exists()


def test_copy_into_a_missing_folder(folder, tmp_path):
    with pytest.raises(UserError, match=r"cannot write .*missing.*No such file"):
        resources.copy_scene("fig10", tmp_path / "missing" / "a.xml")


def test_shipped_scenes_are_found_and_described():
    names = resources.scene_names()
    assert "fig09_2x2" in names
    for name in names:
        assert resources.scene_path(name).is_file()
        assert resources.scene_summary(name), name
        resources.scene_parameters(name)
