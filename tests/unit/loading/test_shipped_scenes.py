"""Shipped scenes: parameters, files that differ, and self-contained texts."""

import difflib
import itertools

import mitsuba as mi
import pytest

from mitransient_lidar.core.parameters.catalogue import unit_of
from mitransient_lidar.loading import catalogue, scenes
from mitransient_lidar.loading.document import read_document

#: Parameters of table1: those of the scene, and what its plugins have.
TABLE = {
    **{"pulse_energy_mj": "5", "pulse_fwhm_ns": "5", "divergence_mrad": "10"},
    **{"divergence_fwhm_mrad": "", "divergence_1e2_mrad": "", "wavelength_nm": "532"},
    **{"optical_efficiency": "0.9", "field_of_view_mrad": "30", "layout": "2x2", "aperture_area": "0.025"},
    **{"two_way_atmospheric_transmittance": "0.9", "response_time_ns": "0"},
    **{"altitude": "200", "off_nadir_deg": "20", "aim_x": "0", "aim_y": "0"},
    **{"time_start_ns": "auto", "bin_width_ns": "1", "bin_count": "auto"},
    **{"wind_speed": "3", "wind_direction_deg": "0", "spectrum": "elfouhaily", "slope_variance": "cox_munk"},
    **{"slope_distribution": "gaussian", "ripple_focusing": "true"},
    **{"surface_seed": "1", "surface_time": "0", "surface_slope_x_deg": "0", "surface_slope_y_deg": "0"},
    **{"surface_refined_size": "auto", "surface_cell_size": "auto"},
    **{"surface_shortest_wave": "auto", "surface_size": "auto"},
    **{"refractive_index": "1.34", "group_index": "1.364", "layer_tops": "0"},
    **{"attenuation": "0.3", "scattering": "0.15", "backscattering": "0.006", "water_scattering": "", "chi_p": ""},
    **dict.fromkeys(("jerlov", "chlorophyll", "kd", "secchi", "petzold", "pure", "profile"), ""),
    **{"phase_function": "fournier_forand", "phase_g": "0.924"},
    **{"bubble_wind_speed": "0", "bubble_void_fraction": "", "bubble_depth": ""},
    **{"bottom_depth": "8", "bottom_reflectance": "0.1"},
    **{"bottom_model": "lambertian", "lobe_asymmetry": "0", "backward_share": "0.5"},
    **{"opposition_amplitude": "1", "opposition_width": "0.06"},
}

INDEX = {"group_index": "1.34"}
SPHERE = {"target_y": "0", "target_size": "1", "target_reflectance": "0.1"}
SHOT = {**INDEX, "field_of_view_mrad": "15", "wind_speed": "6", "bottom_depth": "5"}
FINE = {"bin_width_ns": "0.25", "bin_count": "200"}
PLACES = (("-59.52", "57.68"), ("54.78", "-34.15"), ("-0.79", "-23.09"))
SQUARE = {
    **{**INDEX, "field_of_view_mrad": "35", "surface_seed": "8", "bottom_depth": "12"},
    **{"target_x": "0", "target_y": "0", "target_depth": "8", "target_size": "1.5", "target_reflectance": "0.1"},
}
LAYERS = {
    **{**INDEX, "field_of_view_mrad": "35", "layer_tops": "0, 3"},
    **{"attenuation": "0.9, 0.5", "scattering": "0.45, 0.25", "backscattering": "0.018, 0.010"},
}
GATES = {
    **{**INDEX, "divergence_mrad": "12", "field_of_view_mrad": "20", "layout": "128x128", "bin_width_ns": "0.5"},
    **{"blur_mrad": "0", "gate_rise_ns": "0", "gate_fall_ns": "0", "pulses": "1"},
    **{"surface_cell_size": "0.03", "surface_shortest_wave": "0.13"},
}

#: Parameters of each scene that table1 lacks or has with another value.
OWN = {
    "table1": {},
    "fig02_mine": {
        **{**INDEX, **SPHERE, "layout": "1x1"},
        **{"target_x": "2.4", "target_depth": "9", "bottom_depth": "12"},
    },
    "fig04_mast": {
        **{**INDEX, "divergence_mrad": "5", "field_of_view_mrad": "10", "altitude": "15", "off_nadir_deg": "84.6"},
        **{"target_depth": "1", "target_x": "1.11", "target_tilt_deg": "48", "target_reflectance": "0.3"},
    },
    "fig09_1x1": {**INDEX, "layout": "1x1"},
    "fig09_2x2": INDEX,
    **{f"fig10_shot{i}": {**SHOT, **FINE, "aim_x": x, "aim_y": y} for i, (x, y) in enumerate(PLACES, 1)},
    **{f"fig11_shot{i}": {**SHOT, "aim_x": x, "aim_y": y} for i, (x, y) in enumerate(PLACES, 1)},
    "fig13_2x2": SQUARE,
    "fig14_1x4": {**SQUARE, "layout": "1x4"},
    "fig15_1x1": {**LAYERS, "layout": "1x1"},
    "fig15_2x2": LAYERS,
    "flight": {
        **{"wind_speed": "6", "bottom_depth": "6", "bottom_reflectance": "0.15"},
        **{"bottom_slope_x_deg": "1", "bottom_slope_y_deg": "0", "bottom_ripple_height": "0.1"},
        **{"bottom_ripple_length": "6", "bottom_refined_size": "160", "bottom_size": "400"},
        **{"cube_x": "0", "cube_y": "0", "cube_depth": "5.5", "cube_size": "1", "cube_reflectance": "0.3"},
    },
    "fresh_water_lens": {
        **{"refractive_index": "1.33667, 1.34240", "group_index": "1.35839, 1.36476", "layer_tops": "0, 2"},
        **{"attenuation": "0.6, 0.3", "scattering": "0.35, 0.15", "backscattering": "0.007, 0.003"},
    },
    "gated_mine": {
        **{**GATES, "gate_start_depth": "4.4", "gate_width_ns": "5", "gate_step_ns": "2", "gate_count": "20"},
        **{"wind_speed": "1", "surface_refined_size": "12"},
        **{**SPHERE, "target_x": "1.5", "target_y": "-0.5", "target_depth": "6", "target_reflectance": "0.25"},
        **{"plate_x": "2.2", "plate_y": "1.2", "plate_size": "1.2", "plate_tilt_deg": "10", "plate_height": "0.2"},
        **{"plate_reflectance": "0.6", "bottom_reflectance": "0.3"},
        **{"ripple_height": "0.15", "ripple_length": "0.8", "ripple_bearing_deg": "60"},
    },
    "gated_waves": {
        **{**GATES, "gate_start_depth": "1.44", "gate_width_ns": "10", "gate_step_ns": "17.88", "gate_count": "3"},
        **{"off_nadir_deg": "0", "wind_speed": "4"},
        **{"surface_refined_size": "10"},
        **{"depth_left": "2", "depth_middle": "4", "depth_right": "6", "step_reflectance": "0.5"},
    },
    "nepheloid_layer": {
        **{"layer_tops": "0, 6.5", "attenuation": "0.398, 2.190"},
        **{"scattering": "0.219, 1.824", "backscattering": "0.00293, 0.03643"},
    },
    "passive_sea": {
        **{**INDEX, "divergence_mrad": "160", "field_of_view_mrad": "240", "layout": "128x128", "off_nadir_deg": "35"},
        **{"bin_width_ns": "10", "wind_speed": "6"},
        **{
            "surface_refined_size": "100",
            "surface_cell_size": "0.2",
            "surface_shortest_wave": "0.8",
            "bottom_reflectance": "0.3",
        },
        **{"sun_zenith_deg": "40", "sun_azimuth_deg": "70"},
        **{"plate_x": "3", "plate_y": "10", "plate_depth": "7.9", "plate_size": "8", "plate_reflectance": "0.9"},
        **{"sphere_x": "1", "sphere_y": "-10", "sphere_depth": "4", "sphere_size": "4", "sphere_reflectance": "0.03"},
    },
    "ship_wake": {
        **{**INDEX, "wake_speed": "6", "ship_length": "20", "ship_bearing_deg": "90", "ship_x": "0", "ship_y": "60"},
        **{"plume_scattering": "0.5", "plume_width": "8", "plume_depth": "2"},
    },
    "thin_layer": {
        **{"layer_tops": "0, 4, 4.4", "attenuation": "0.229, 2.649, 0.229"},
        **{"scattering": "0.170, 2.429, 0.170", "backscattering": "0.00237, 0.01190, 0.00237"},
    },
}

#: Parameters of particles of the flat bottom.
PARTICLES = {"bottom_model", "lobe_asymmetry", "backward_share", "opposition_amplitude", "opposition_width"}

#: The steps of gated_waves replace the bottom, as a seabed does elsewhere.
MISSING = {
    "gated_waves": {"bottom_depth", "bottom_reflectance", *PARTICLES},
    **dict.fromkeys(("flight", "gated_mine"), PARTICLES),
}


def test_every_scene_is_listed():
    assert catalogue.scene_names() == sorted(OWN)


@pytest.mark.parametrize("name", OWN)
def test_parameters(name):
    table = {key: value for key, value in TABLE.items() if key not in MISSING.get(name, ())}
    expected, found = {**table, **OWN[name]}, catalogue.scene_parameters(name, by_id=True)
    assert {key: found.get(key) for key in expected} == expected
    assert MISSING.get(name, set()).isdisjoint(found)


def test_a_copy_is_short():
    """Parameters are named where a scene differs from the defaults, or where Mitsuba's own loader should reach them."""
    assert len(catalogue.scene_text("table1").splitlines()) <= 40
    assert max(len(read_document(catalogue.scene_path(name)).parameters) for name in OWN) <= 20


@pytest.mark.parametrize("name", OWN)
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
    image = {"layout": "2x2", "surface_cell_size": "0.5"} if OWN[name].get("layout") == "128x128" else {}
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
    assert [name for name in OWN if "gate_count" in catalogue.scene_text(name)] == ["gated_mine", "gated_waves"]


def test_scenes_share_few_lines():
    """No two scene files have more than eleven successive lines in common."""
    lines = {
        name: [" ".join(line.split()) for line in catalogue.scene_path(name).read_text("utf-8").splitlines() if line]
        for name in OWN
    }
    for first, second in itertools.combinations(lines, 2):
        matcher = difflib.SequenceMatcher(None, lines[first], lines[second], autojunk=False)
        assert matcher.find_longest_match().size <= 11, (first, second)


def test_all_parameters_but_texts_have_a_unit():
    own = {name for scene in OWN for name in read_document(catalogue.scene_path(scene)).parameters}
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
