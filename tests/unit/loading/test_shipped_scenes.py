"""Shipped scenes: parameters, files that differ, and self-contained texts."""

import mitsuba as mi
import references
from rows import each_row

from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.loading import catalogue
from mitransient_lidar.loading.document import read_document

SHIPPED = references.read(references.SCENES)


def test_parameters_are_those_of_the_reference():
    """Those of table1, and what every other scene has otherwise or lacks."""
    assert references.scene_parameters() == SHIPPED


@each_row(*zip(SHIPPED))
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
