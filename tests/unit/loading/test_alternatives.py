"""Parameters of scenes that describe one thing in several ways."""

import numpy as np
import pytest
from rows import each_row, refuses

from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.water.water_types import water_of

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


@pytest.mark.parametrize(
    ("name", "width"), [("mrad", 1.0), ("fwhm_mrad", np.sqrt(8 * np.log(2)) / 2), ("1e2_mrad", 2.0)]
)
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
