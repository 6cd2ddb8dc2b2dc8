"""Numbers among the parameters of a scene, by name and index."""

import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.parameters import value_of, with_value

PARAMETERS = {
    "layer_tops": "0, 3",
    "attenuation": "0.9, 0.5",
    "scattering": "0.25",
    "bottom_depth": "8",
    "layout": "2x2",
    "jerlov": "",
    "altitude": "nan",
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bottom_depth", 8),
        ("bottom_depth[0]", 8),
        ("attenuation[1]", 0.5),
        ("layer_tops[1]", 3),
        ("scattering[1]", 0.25),
    ],
)
def test_numbers_are_found_by_name(name, value):
    assert value_of(PARAMETERS, name) == value


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bottom_depth", "8.1"),
        ("attenuation[1]", "0.9, 8.1"),
        ("layer_tops[1]", "0, 8.1"),
        # One value for all layers, as a whole and in one of them.
        ("scattering", "8.1"),
        ("scattering[1]", "0.25, 8.1"),
    ],
)
def test_one_number_changes(name, text):
    before = dict(PARAMETERS)
    changed = with_value(PARAMETERS, name, 8.1)
    assert changed == {**before, name.partition("[")[0]: text}
    assert before == PARAMETERS
    assert value_of(changed, name) == 8.1


def test_values_keep_all_digits():
    assert value_of(with_value(PARAMETERS, "bottom_depth", 0.1 + 0.2), "bottom_depth") == 0.1 + 0.2


@pytest.mark.parametrize(
    ("name", "message"),
    [
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
    ],
)
def test_others_are_refused(name, message):
    with pytest.raises(UserError, match=message):
        value_of(PARAMETERS, name)
    with pytest.raises(UserError, match=message):
        with_value(PARAMETERS, name, float("nan"))


def test_scenes_without_parameters_say_so():
    with pytest.raises(UserError, match="'attenuation' is not one of the scene: it has none"):
        value_of({}, "attenuation")
