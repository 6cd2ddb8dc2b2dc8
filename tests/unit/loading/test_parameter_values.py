"""Values of parameters, and ways to state a thing of which one is given."""

import json

import numpy as np
import pytest
from rows import each_case, each_row, must_refuse, refuses

from mitransient_lidar.loading.document import parse_document
from mitransient_lidar.loading.parameters import fill, value_of, with_value
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.water.water_types import water_of

PARAMETERS = {"layer_tops": "0, 3", "attenuation": "0.9, 0.5", "scattering": "0.25", "bottom_depth": "8"}
PARAMETERS |= {"layout": "2x2", "jerlov": "", "altitude": "nan"}


@each_row(
    ("bottom_depth", 8, "8.1"),
    ("bottom_depth[0]", 8, "8.1"),
    ("attenuation[1]", 0.5, "0.9, 8.1"),
    ("layer_tops[1]", 3, "0, 8.1"),
    # One value for all layers, as a whole and in one of them.
    ("scattering", 0.25, "8.1"),
    ("scattering[1]", 0.25, "0.25, 8.1"),
)
def test_numbers_are_found_by_name_and_one_changes(name, value, text):
    before = dict(PARAMETERS)
    assert value_of(PARAMETERS, name) == value
    changed = with_value(PARAMETERS, name, 8.1)
    assert changed == {**before, name.partition("[")[0]: text}
    assert before == PARAMETERS
    assert value_of(changed, name) == 8.1


@each_row(
    ("botom_depth", "'botom_depth' is not one of the scene: did you mean bottom_depth"),
    ("wind", "'wind' is not one of the scene: it has altitude, attenuation, bottom_depth"),
    ("attenuation[one]", r"'attenuation\[one\]' is not one of the scene"),
    ("attenuation[-1]", r"'attenuation\[-1\]' is not one of the scene"),
    ("attenuation", r"attenuation = '0.9, 0.5' is a list: name one of its elements attenuation\[0\] to"),
    ("attenuation[2]", r"attenuation\[2\]: the index must be 0 to 1, as attenuation = '0.9, 0.5'"),
    ("scattering[2]", r"scattering\[2\]: the index must be 0 to 1"),
    ("bottom_depth[1]", r"bottom_depth\[1\]: the index must be 0 to 0"),
    ("layout", "layout = '2x2' is not a number"),
    ("jerlov", "jerlov = '' is not a number"),
    # A value that is no finite number, in the scene or given.
    ("altitude", "altitude = nan must be finite"),
)
def test_others_are_refused(name, message):
    must_refuse(message, value_of, PARAMETERS, name)
    must_refuse(message, with_value, PARAMETERS, name, float("nan"))


OWN = """<scene version="3.0.0"><default name="deep" value="6"/>
<emitter type="lidar_transmitter"/><sensor type="multipixel_receiver"><film type="time_gated_film"/></sensor>
<shape type="ocean_surface" id="sea"><float name="wind_speed" value="2"/><medium type="layered_water" name="interior"/>
</shape>
<shape type="seabed" id="bottom"><float name="depth" value="$deep"/></shape>
<shape type="seabed" id="lower"/></scene>"""


def test_parameters_of_plugins_are_those_of_the_scene(tmp_path):
    """Without a ``<default>`` in the scene: of all plugins that have one of the name, or of one with an id."""
    path = tmp_path / "own.xml"
    path.write_text(OWN)
    given = {"altitude": 150, "wind_speed": 4.5, "lower.depth": 9, "depth": 7, "sea_kd": 0.1}
    values = json.loads(open_scene(path, given).attributes()["plugin_parameters"])
    assert values["lidar_transmitter"]["altitude"] == values["multipixel_receiver"]["altitude"] == 150
    assert (values["sea"]["wind_speed"], values["sea"]["interior"]["kd"]) == (4.5, "0.1")
    # The height for which the sea chooses its cells follows the lidar, unless it is given by the id of the sea.
    assert values["sea"]["altitude"] is None
    assert (values["bottom"]["depth"], values["lower"]["depth"]) == (7, 9)


def test_results_state_the_parameters_of_plugins(tmp_path):
    path = tmp_path / "own.xml"
    path.write_text(OWN)
    loaded = open_scene(path, {"sea.altitude": 90, "jerlov": "1C"})
    found = {name.partition(".")[2]: value for name, value in loaded.attributes().items() if name.startswith("scene.")}
    given = {"deep": "6", "wind_speed": "2", "jerlov": "1C", "altitude": "200", "sea.altitude": "90"}
    assert {name: found[name] for name in given} == given
    assert not {"attenuation", "kd", "sea_wind_speed", "seabed_depth"} & found.keys()
    assert value_of(loaded.parameters, "seabed.depth") == 6
    assert value_of(loaded.parameters, "bottom_depth") == value_of(loaded.parameters, "depth") == 6
    assert open_scene(loaded.source).parameters == loaded.parameters


@refuses(
    ({"sea.depth": 3}, "parameter 'sea.depth' is not one of scene own"),
    ({"hight": 3}, "parameter 'hight' is not one of scene own: it has deep, the parameters of its plugins"),
    ({"altitud": 3}, "parameter 'altitud' is not one of scene own: did you mean altitude"),
    ({"film": 3}, "parameter 'film' is not one of scene own"),
    ({"phase": "hg"}, "parameter 'phase' is not one of scene own: did you mean phase_g or .*phase_function"),
    ({"sea_wind_speed": 3, "wind_speed": 2}, "parameter wind_speed = 2 is used by nothing in scene own"),
)
def test_other_names_are_refused(params):
    fill(parse_document("own", OWN), params)


FLAT = {"spectrum": "flat"}


def load(scene="table1", **params):
    opened = open_scene(scene, {**FLAT, **params})
    loaded, parameters = opened.scene, opened.parameters
    water = next(shape.interior_medium().water for shape in loaded.shapes() if hasattr(shape, "sea"))
    return water, next(each for each in loaded.emitters() if hasattr(each, "pulse")), parameters


@each_row(
    *(("table1", "jerlov", "1C"), ("table1", "chlorophyll", "0.3"), ("table1", "kd", "0.1")),
    *(("table1", "secchi", "10"), ("table1", "petzold", "coastal"), ("table1", "pure", None)),
    ("ship_wake", "jerlov", "1C"),
)
def test_waters_by_name_are_those_of_the_command(scene, kind, value):
    water, _, parameters = load(scene, **{kind: "true" if value is None else value})
    expected = water_of(kind, value)
    for name in ("attenuation", "scattering", "backscattering"):
        assert getattr(water.column, name) == pytest.approx([getattr(expected, name)])
        assert parameters[name] == ""


def test_layers_of_named_waters():
    column = load(jerlov="1C, 5C", layer_tops="0, 3")[0].column
    np.testing.assert_array_equal(column.layer_tops, [0, 3])
    assert column.attenuation == pytest.approx([water_of("jerlov", name).attenuation for name in ("1C", "5C")])
    # A scene of layers with one water for all of them is that water.
    assert load("thin_layer", jerlov="1C")[0].column.attenuation == pytest.approx(
        [water_of("jerlov", "1C").attenuation]
    )


@each_case(("mrad", 1.0), ("fwhm_mrad", np.sqrt(8 * np.log(2)) / 2), ("1e2_mrad", 2.0))
def test_each_definition_of_the_divergence_replaces_the_default(name, width):
    _, transmitter, parameters = load(**{f"divergence_{name}": 7})
    assert transmitter.divergence == pytest.approx(7e-3 / width)
    assert [key for key in parameters if key.startswith("divergence") and parameters[key]] == [f"divergence_{name}"]


def test_a_given_start_of_the_gates_replaces_that_of_the_scene():
    """The film refuses both."""
    opened = open_scene("gated_mine", {**FLAT, "layout": "2x2", "gate_start_ns": 1500})
    assert opened.scene.sensors()[0].film().gates.start == 1500
    assert opened.parameters["gate_start_depth"] == ""
    assert open_scene(opened.source).parameters == opened.parameters


@refuses(
    ({"jerlov": "1C", "scattering": 0.1}, "scattering = '0.1' and jerlov = '1C' describe the same: give one of"),
    ({"jerlov": "1C", "kd": 0.1}, "jerlov = '1C' and kd = '0.1' describe the same: give one of them"),
    ({"divergence_mrad": 5, "divergence_1e2_mrad": 9}, "divergence_mrad = '5' and divergence_1e2_mrad = '9'"),
)
def test_two_ways_at_once_are_refused(params):
    load(**params)
