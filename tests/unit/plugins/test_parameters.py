"""Parameters that the objects of the plugins keep: every one of their manual pages, with its default."""

import gc
import importlib
import json
import math
import re

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.catalogue import PLUGINS as DECLARED
from mitransient_lidar.loading.scene_source import object_values, plugin_values
from mitransient_lidar.loading.scenes import as_user_error
from mitransient_lidar.loading.variants import PLUGIN_MODULES

#: Parameters without a value where no other parameter is given: alternatives, automatic ones and files.
WITHOUT_VALUE = {
    "layered_water": {
        *("jerlov", "chlorophyll", "kd", "secchi", "petzold", "wavelength_nm", "profile", "chi_p"),
        *("bubble_void_fraction", "bubble_depth", "coefficients_nm"),
    },
    "canopy": {"bending_azimuth_deg", "shoot_density"},
    "ocean_surface": {
        *("fetch", "inverse_wave_age", "filename", "altitude", "off_nadir_deg", "field_of_view_mrad", "interior"),
        *("divergence_mrad", "divergence_fwhm_mrad", "divergence_1e2_mrad", "foam_map", "origin_x", "origin_y"),
    },
    "seabed": {
        *("filename", "map_size", "map_values", "map_holes", "map_cell", "map_unit", "map_no_data", "origin_x"),
        *("origin_y", "patches"),
    },
    "lidar_transmitter": {
        *("to_world", "divergence_fwhm_mrad", "divergence_1e2_mrad", "divergence_across_mrad"),
        *("profile_file", "profile_mrad", "pulse_file"),
    },
    "pixel_fov": {
        *("inner_mrad", "start_deg", "extent_deg", "width_mrad", "height_mrad", "angle_x_min_mrad"),
        *("angle_x_max_mrad", "vertices_mrad", "pixel_name", "to_world", "blur_file", "blur_file_mrad"),
    },
    "multipixel_receiver": {
        *("imager", "pixel_map", "focal_length_mm", "pixel_pitch_um", "blur_file", "blur_file_mrad", "to_world")
    },
    "time_gated_film": {
        *("gate_start_ns", "gate_start_depth", "gate_width_ns", "gate_step_ns", "gate_rise_ns", "gate_fall_ns"),
        *("gate_start_range", "gate_jitter_ns", "gate_profile", "pulses"),
    },
    "sediment": {"single_scattering_albedo"},
    "lidar_merging": {"paths_per_pass", "photons_per_pass"},
    "fournier_forand": {"refractive_index", "junge_slope"},
}

PLUGINS = list(PLUGIN_MODULES)
#: What else is given where a number needs it.
RECTANGLE, SECTOR, STRIP = ({"shape": shape} for shape in ("rectangle", "sector", "strip"))
NEEDED = {
    "ellipse_deg": {"divergence_across_mrad": 2.0},
    "profile_mrad": {"beam_profile": "image", "profile_file": "image.npy"},
    "focal_length_mm": {"pixel_pitch_um": 10.0},
    "pixel_pitch_um": {"focal_length_mm": 100.0},
    "blur_file_mrad": {"blur_file": "image.npy"},
    "inner_mrad": {"shape": "ring"},
    **{"start_deg": SECTOR, "extent_deg": SECTOR, "width_mrad": RECTANGLE, "height_mrad": RECTANGLE},
    **{"angle_x_min_mrad": STRIP, "angle_x_max_mrad": STRIP},
    **{name: {"gate_count": 2} for name in ("gate_start_ns", "gate_start_depth", "gate_start_range")},
    **{
        name: {"gate_count": 2, "gate_start_ns": 1400.0}
        for name in ("gate_width_ns", "gate_step_ns", "gate_rise_ns", "gate_fall_ns", "gate_jitter_ns", "pulses")
    },
    "junge_slope": {"refractive_index": 1.1},
    "single_scattering_albedo": {"model": "hapke"},
}


def _values(plugin, folder):
    """Return the parameters of an object of a plugin for which only the required ones are given."""
    part = {"type": plugin}
    if plugin == "measured_phase":
        path = folder / "phase.csv"
        path.write_text("\n".join(f"{angle} {1 / angle}" for angle in range(5, 180, 5)))
        part["filename"] = str(path)
    return object_values(mi.load_dict(part))


@each_row(*PLUGINS)
def test_every_declared_parameter_is_kept_with_its_default(plugin, tmp_path):
    values = _values(plugin, tmp_path)
    declared = {each.name: each for each in DECLARED[plugin] if each.name.isidentifier()}
    assert values["type"] == plugin
    assert declared
    assert set(declared) <= set(values)
    assert {name for name, value in values.items() if value is None} == WITHOUT_VALUE.get(plugin, set())
    defaults = {name: each.default for name, each in declared.items() if each.default not in (None, "")}
    defaults = {name: default for name, default in defaults.items() if name != "model" and values[name] is not None}
    assert {name: values[name] for name in defaults} == defaults


@each_row(*PLUGINS)
def test_every_number_outside_its_range_is_refused(plugin, tmp_path, monkeypatch):
    """Below, above, and where a number has no end: the sentence names parameter and value, and what is allowed."""
    np.save(tmp_path / "image.npy", np.ones((4, 4)))
    monkeypatch.chdir(tmp_path)
    for each in DECLARED[plugin]:
        if each.kind not in ("float", "integer") and not each.is_list:
            continue
        beyond = [each.low - 0.1 * abs(each.low) - 1e-3, each.high + 0.1 * abs(each.high) + 1e-3, *[0.0] * each.above]
        whole = each.kind == "integer"
        wrong = [math.floor(value) if whole else value for value in beyond if np.isfinite(value)]
        wrong = [wrong[0], math.ceil(beyond[1])] if whole else [*wrong, math.nan, math.inf]
        needed = NEEDED.get(each.name, {})
        if (plugin, each.name) == ("fournier_forand", "refractive_index"):
            needed = {"junge_slope": 4.0}
        for value in wrong:
            given = str(value) if each.is_list else value
            with pytest.raises(UserError, match=rf"^{each.name} (=|holds) .* must ") as caught, as_user_error():
                mi.load_dict({"type": plugin, **needed, each.name: given})
            assert re.search("finite|must lie between|must be greater than 0|must not be negative", str(caught.value))
            assert f"{value:g}" in str(caught.value) or str(value) in str(caught.value)


@each_row(*PLUGINS)
def test_every_text_that_is_no_choice_is_refused(plugin):
    for each in DECLARED[plugin]:
        if each.choices:
            message = f"{each.name} = 'nonsense' must be one of {', '.join(each.choices)}"
            with pytest.raises(UserError, match=message), as_user_error():
                mi.load_dict({"type": plugin, each.name: "nonsense"})


def test_manual_pages_have_the_table_of_the_declared_parameters():
    pages = {
        match[1]: part.__doc__
        for name, _ in set(PLUGIN_MODULES.values())
        for part in vars(importlib.import_module(f"mitransient_lidar.plugins.{name}")).values()
        if isinstance(part, type) and (match := re.search(r"\(``(\w+)``\)", (part.__doc__ or "").partition("\n")[0]))
    }
    assert set(pages) == set(DECLARED) == set(PLUGINS)
    for plugin, page in pages.items():
        for each in DECLARED[plugin]:
            assert f"* - ``{each.name}``\n" in page
            assert each.meaning in page


def test_values_of_mitsubas_own_objects_are_kept():
    """A share of 0.25, the index of air for the outside, and our BSDF inside one of Mitsuba's."""
    bsdf = {"type": "twosided", "own": {"type": "retroreflector", "width_deg": 3.0}}
    parts = {
        "a": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.25}}},
        "b": {"type": "sphere", "radius": 2.0, "bsdf": bsdf},
    }
    scene = mi.load_dict({"type": "scene", **parts})
    values = json.loads(plugin_values(scene, mi.load_dict({"type": "lidar_volpath"})))
    assert set(values) == {"integrator", "a", "b"}
    assert values["integrator"]["max_scatterings"] == -1
    assert values["a"]["bsdf"]["reflectance"]["value"] == 0.25
    assert values["b"]["bsdf"]["own"]["width_deg"] == 3


def test_unknown_parameters_are_still_refused():
    """A plugin that reads all of its parameters does not hide one that it does not have."""
    with pytest.raises(RuntimeError, match="unreferenced property"):
        mi.load_dict({"type": "layered_water", "attenuaton": 0.5})
    assert mi.load_dict({"type": "layered_water", "secchi": "", "attenuation": ""}).parameters["attenuation"] == 0.3


def test_textures_of_every_kind_are_recorded(tmp_path):
    """Transforms of textures are 3x3: a scene with one ended in an error after its render."""
    mi.Bitmap(np.full((4, 4, 3), 128, dtype=np.uint8)).write(str(tmp_path / "grey.png"))
    turned = mi.ScalarTransform3d().rotate(30).scale([2, 3])
    bitmap = {"type": "bitmap", "filename": str(tmp_path / "grey.png"), "to_uv": turned}
    diffuse = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": turned}}
    for bsdf in (
        diffuse,
        {"type": "diffuse", "reflectance": bitmap},
        {"type": "mask", "opacity": {**bitmap, "raw": True}, "nested": diffuse},
        {"type": "bumpmap", "texture": {**bitmap, "raw": True}, "nested": diffuse},
        {"type": "normalmap", "normalmap": {**bitmap, "raw": True}, "nested": diffuse},
        {"type": "blendbsdf", "weight": {**bitmap, "raw": True}, "one": diffuse, "two": {"type": "diffuse"}},
    ):
        scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf}}, parallel=False)
        recorded = plugin_values(scene)
        matrices = [json.loads(found) for found in re.findall(r'to_uv": (\[\[.*?\]\])', recorded)]
        assert matrices, bsdf["type"]
        for matrix in matrices:
            np.testing.assert_allclose(matrix, [[3**0.5, -1.5, 0], [1, 1.5 * 3**0.5, 0], [0, 0, 1]], atol=1e-6)


def test_parameters_are_freed_when_their_object_is_made():
    """A circle kept them, and the objects in them, until the next garbage collection: kernels had other numbers."""
    gc.collect()
    gc.disable()
    try:
        made = mi.load_dict({"type": "seabed", "bsdf": {"type": "retroreflector"}})
        assert not [one for one in gc.get_objects() if type(one).__name__ == "DeclaredProperties"]
    finally:
        gc.enable()
    assert made.bsdf().parameters["width_deg"] == 2
