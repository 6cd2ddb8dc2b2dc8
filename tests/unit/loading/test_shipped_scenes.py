"""Shipped scenes: parameters, files that differ, and self-contained texts."""

import difflib
import itertools

import mitsuba as mi
import pytest
import references

from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.loading import catalogue, scenes
from mitransient_lidar.loading.document import read_document

SHIPPED = references.read(references.SCENES)


def test_parameters_are_those_of_the_reference():
    """Those of table1, and what every other scene has otherwise or lacks."""
    assert references.scene_parameters() == SHIPPED


def test_a_copy_is_short():
    """Parameters are named where a scene differs from the defaults, or where Mitsuba's own loader should reach them."""
    assert len(catalogue.scene_text("table1").splitlines()) <= 40
    assert max(len(read_document(catalogue.scene_path(name)).parameters) for name in SHIPPED) <= 20


@pytest.mark.parametrize("name", SHIPPED)
def test_text_equals_the_file_with_its_includes(name):
    """Mitsuba reads the same plugins with the same parameters in the same order from both."""
    config = mi.parser.ParserConfig(mi.variant())
    text = catalogue.scene_text(name)
    states = (mi.parser.parse_file(config, str(catalogue.scene_path(name))), mi.parser.parse_string(config, text))
    file, flat = ([(str(node.type), str(node.props)) for node in state.nodes] for state in states)
    assert len(flat) >= 9
    assert flat == file
    assert "<include" not in text
    assert text.count("<scene") == text.count("</scene>") == 1
    assert text.count("<default") == len(read_document(catalogue.scene_path(name)).parameters)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fig04_mast", "gated_mine", "ship_wake"])
def test_copy_loads_to_the_same_scene(name, tmp_path):
    image = {"layout": "2x2", "surface_cell_size": "0.5"} if SHIPPED[name].get("layout") == "128x128" else {}
    opened = scenes.open_scene(name, image)
    included, parameters = opened.scene, opened.parameters
    opened = scenes.open_scene(catalogue.copy_scene(name, tmp_path), image)
    flat, again = opened.scene, opened.parameters
    assert list(tmp_path.iterdir()) == [tmp_path / f"{name}.xml"]
    assert again == parameters
    for kind in ("shapes", "emitters", "sensors"):
        first, second = ([(item.id(), str(item)) for item in getattr(scene, kind)()] for scene in (included, flat))
        assert first == second
    assert str(flat.integrator()) == str(included.integrator())


def test_gates_are_named_in_the_text_of_gated_scenes_alone():
    assert [name for name in SHIPPED if "gate_count" in catalogue.scene_text(name)] == ["gated_mine", "gated_waves"]


def test_scenes_share_few_lines():
    """No two scene files have more than eleven successive lines in common."""
    lines = {
        name: [" ".join(line.split()) for line in catalogue.scene_path(name).read_text("utf-8").splitlines() if line]
        for name in SHIPPED
    }
    for first, second in itertools.combinations(lines, 2):
        matcher = difflib.SequenceMatcher(None, lines[first], lines[second], autojunk=False)
        assert matcher.find_longest_match().size <= 11, (first, second)


def test_all_parameters_but_texts_have_a_unit():
    own = {name for scene in SHIPPED for name in read_document(catalogue.scene_path(scene)).parameters}
    assert {name for name in own if unit_of(name) is None} == {"layout"}
    given = {
        "bottom_depth": "m",
        "surface_time": "s",
        "sea.slope_x_deg": "degree",
        "gate_width_ns": "ns",
        "plume_width": "m",
        "sphere_reflectance": "1",
        "kd": "1/m",
    }
    assert {name: unit_of(name) for name in given} == given
    assert unit_of("my_parameter") is None
