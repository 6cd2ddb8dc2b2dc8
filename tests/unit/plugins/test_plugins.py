"""Plugins: errors of their constructors, examples of their manual pages, and use with Mitsuba's own plugins."""

import ast
import importlib
import logging
import re

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import scenes, variants
from mitransient_lidar.transport.scene_parts import find_lidar_scene

SHEAR = mi.ScalarTransform4f([[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 10], [0, 0, 0, 1]])
CIRCLE = {"type": "pixel_fov", "field_of_view_mrad": 10.0}

#: Particles with an orientation.
FLAKES = {"type": "sggx", "S": {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 6), np.float32))}}
#: What is refused by each plugin, and a part of the sentence.
REFUSED = {
    "lidar_transmitter": [
        ({"altitude": -0.05}, "altitude = -0.05 must lie between 0.1 and 1e+06, or -1000 and"),
        ({"altitude": -1.0, "off_nadir_deg": 181.0}, "must lie between 0 and 180"),
        ({"divergence_mrad": 1.0, "divergence_1e2_mrad": 2.0}, "divergence_mrad = 1.0 and divergence_1e2_mrad = 2.0"),
        ({"ellipse_deg": 20.0}, "ellipse_deg needs divergence_across_mrad"),
        ({"divergence_fwhm_mrad": 2.0, "divergence_across_mrad": 2.0}, "divergence_across_mrad goes with"),
        ({"profile_mrad": 2.0}, "profile_mrad does not go with beam_profile = 'gaussian'"),
        ({"beam_profile": "image"}, "profile_file is missing"),
        ({"beam_profile": "image", "profile_file": "nowhere.npy"}, "profile_mrad is missing: beam_profile = 'image'"),
        ({"beam_profile": "image", "divergence_mrad": 5.0}, "divergence_mrad does not go with beam_profile = 'image'"),
        (
            {"beam_profile": "image", "profile_file": "nowhere.npy", "profile_mrad": 5.0},
            "profile_file = 'nowhere.npy': cannot read nowhere.npy: No such file or directory",
        ),
        ({"beam_profile": "image", "profile_file": "beam.jpg", "profile_mrad": 5.0}, "a grey image must end in"),
        ({"pulse_file": "nowhere.txt"}, "cannot read nowhere.txt: No such file or directory"),
        ({"to_world": SHEAR}, "to_world must be a rotation"),
        ({"to_world": mi.ScalarTransform4f(), "altitude": 3.0}, "altitude = 3.0 and to_world describe the same"),
        ({"power": 5.0}, "power"),
        ({"to_world": 1.0}, "to_world is of type float: it must be of type transform"),
    ],
    "layered_water": [
        ({"jerlov": "1C", "attenuation": 0.3}, "attenuation = 0.3 and jerlov = '1C' describe the same"),
        ({"jerlov": "1C", "secchi": 5.0}, "jerlov = '1C' and secchi = 5.0 describe the same: give one"),
        ({"jerlov": "2C"}, "jerlov = '2C': water_type = '2C' must be one of I, IA"),
        ({"kd": "0.1, 0.2"}, "kd has 2 values but must have 1"),
        ({"kd": 0.1, "wavelength_nm": 500.0}, "kd = 0.1: wavelength_nm = 500 must be 532, or 700 to 1100"),
        ({"wavelength_nm": 450.0}, "wavelength_nm = 450 needs attenuation, or chlorophyll: the default 0.3 1/m is"),
        ({"wavelength_nm": 1550.0}, "wavelength_nm = 1550 must lie between 300 and 1100"),
        ({"wavelength_nm": 350.0, "attenuation": 1.0}, "wavelength_nm = 350 must lie between 400 and 1100"),
        ({"secchi": "deep"}, "secchi = 'deep': value = 'deep' must be a number"),
        ({"pure": "maybe"}, "pure = 'maybe' must be true or false"),
        ({"profile": "a.csv", "layer_tops": "0"}, "layer_tops = '0' and profile = 'a.csv' describe the same"),
        ({"scattering": 0.4}, "scattering = 0.4 must not exceed attenuation = 0.3"),
        ({"backscattering": 0.2}, "backscattering = 0.2 must not exceed scattering = 0.15"),
        (
            {"phase_function": "hg", "layer_tops": "0, 2", "scattering": "0.1, 0.2", "backscattering": "0, 0, 0"},
            "backscattering has 3 values",
        ),
        ({"layer_tops": "0, 4, 3"}, "layers out of order"),
        ({"layer_tops": "1, 2"}, "first layer must start at 0"),
        ({"attenuation": "0.3, 0.4, 0.5", "layer_tops": "0, 1"}, "attenuation has 3 values"),
        ({"a": {"type": "petzold"}, "b": {"type": "petzold"}}, "nested phase functions"),
        ({"flakes": FLAKES}, "its phase function 'flakes', SGGXPhaseFunction, depends on the orientation"),
    ],
    "pixel_fov": [
        ({"shape": "ring", "inner_mrad": 40.0}, "inner_mrad = 40 must lie between 0 and 30"),
        ({"shape": "strip", "angle_x_min_mrad": 20.0}, "angle_x_min_mrad = 20 must lie between"),
        ({"shape": "polygon"}, "at least three corners"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 1 1, 2 2"}, "lie on one line"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 4 3, 4 0, 0 2"}, "must not cross each other"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 4 4, 4 0, 0 4"}, "must not cross each other"),
        # An edge that reverses, a spike, a repeated corner, corners on an edge and at a corner, and overlapping edges.
        ({"shape": "polygon", "vertices_mrad": "0 0, 6 2, 3 1, 0 4"}, "nor touch or overlap"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 3 1, 6 2, 3 1, 0 4"}, "nor touch or overlap"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 4 0, 4 0, 0 4"}, "nor touch or overlap"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 6 0, 6 6, 3 0, 0 6"}, "nor touch or overlap"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 2 2, 4 0, 4 4, 2 2, 0 4"}, "nor touch or overlap"),
        ({"shape": "polygon", "vertices_mrad": "0 0, 6 0, 6 4, 4 4, 4 0, 2 0, 2 4, 0 4"}, "nor touch or overlap"),
        ({"shape": "strip", "angle_x_min_mrad": 5.0, "angle_x_max_mrad": 4.0}, "angle_x_max_mrad = 4 must lie"),
    ],
    "time_gated_film": [({"bin_count": 10.5}, "bin_count = 10.5 must be an integer")],
    "ocean_surface": [
        ({"surface_seed": "x"}, "surface_seed = 'x' must be an integer"),
        ({"slope_variance": "some"}, "slope_variance = 'some' must be"),
        ({"slope_variance": "2"}, "slope_variance = 2 must lie between"),
        ({"cell_size": "fine"}, "cell_size = 'fine' must be a number"),
        ({"cell_size": 0.001}, "refined_size = 32 with cell_size = 0.001 needs 32000 cells per side"),
        ({"refined_size": 2000.0, "cell_size": 0.25}, "refined_size = 2000 with cell_size = 0.25 needs 8000 cells"),
        ({"spectrum": "jonswap"}, "fetch is missing: the spectrum 'jonswap' needs it"),
        ({"fetch": 1e4, "inverse_wave_age": 2.0}, "fetch = 10000.0 and inverse_wave_age = 2.0 describe"),
        ({"spectrum": "flat", "swell_height": 1.0}, "needs a spectrum of waves, not 'flat'"),
        ({"spectrum": "height_map"}, "filename is missing"),
        ({"spectrum": "height_map", "filename": "none.npy", "map_size": 9.0}, "cannot read none.npy: No such file or"),
    ],
    "fournier_forand": [
        ({"junge_slope": 6.0, "refractive_index": 1.1}, "junge_slope = 6 must lie between"),
        ({"junge_slope": 3.5}, "both refractive_index and junge_slope"),
    ],
    "multipixel_receiver": [
        ({"layout": "2by2"}, "layout = '2by2' must be rows x columns"),
        ({"layout": "0x2"}, "layout = '0x2'"),
        ({"layout": "9999x9999"}, "at most 4194304"),
        ({"layout": "2x2", "a": CIRCLE}, "layout = '2x2' and a nested sensor describe"),
        ({"a": {"type": "perspective"}}, "nested sensors must be pixel_fov"),
        ({"a": {"type": "layered_water"}}, "multipixel_receiver: a medium inside it would"),
        ({"fill_factor": 0.5, "a": CIRCLE}, "fill_factor = 0.5 and a nested sensor"),
        ({"layout": "hex8"}, "layout = 'hex8' must have 1, 7, 19, 37, 61, ... hexagons"),
        ({"layout": "hex0"}, "layout = 'hex0' must have"),
        ({"layout": "hex1049617"}, "has 1049617 pixels; allowed are at most 1048576"),
        ({"layout": "hex7", "imager": True}, "imager = True is for layouts of rows x col"),
        ({"layout": "hex7", "field_of_view_shape": "square"}, "field_of_view_shape = 'square' is for layouts of rows"),
        ({"pixel_map": "a.png", "layout": "2x2"}, "layout = '2x2' and pixel_map = 'a.png'"),
        ({"pixel_map": "a.png", "fill_factor": 0.5}, "fill_factor = 0.5 and pixel_map = 'a.png'"),
        ({"blur_mrad": 1.0, "blur_file": "a.npy"}, "blur_mrad = 1.0 and blur_file = 'a.npy'"),
        ({"blur_file": "a.npy"}, "blur_file_mrad is missing"),
        ({"blur_file_mrad": 2.0}, "blur_file_mrad is the size of blur_file, which is missing"),
        ({"blur_file": "none.npy", "blur_file_mrad": 2.0}, "blur_file = 'none.npy': cannot read none.npy: No such"),
    ],
    "sky": [({"a": {"type": "homogeneous"}}, "sky: a medium inside it would have no effect")],
    "lidar_volpat": [({}, "lidar_volpat")],
}


@each_row(*[(plugin, *row) for plugin, rows in REFUSED.items() for row in rows])
def test_invalid_parameters_are_named_in_one_sentence(plugin, given, message):
    with pytest.raises(UserError, match=re.escape(message)) as caught, scenes.as_user_error():
        mi.load_dict({"type": plugin, **given})
    assert "\n" not in str(caught.value)
    assert "Traceback" not in str(caught.value)


def test_overlapping_pixels_are_warned_of_and_names_must_differ(caplog):
    with caplog.at_level(logging.WARNING):
        mi.load_dict({"type": "multipixel_receiver", "a": CIRCLE, "b": {**CIRCLE, "angle_x_mrad": 4.0}})
    assert "'pixel0' and 'pixel1' overlap" in caplog.text
    with pytest.raises(RuntimeError, match="names must differ"):
        mi.load_dict({"type": "multipixel_receiver", "a": {**CIRCLE, "pixel_name": "x"},
                      "b": {**CIRCLE, "angle_x_mrad": 20.0, "pixel_name": "x"}})  # fmt: skip


def test_defaults_are_the_published_system():
    transmitter = mi.load_dict({"type": "lidar_transmitter"})
    receiver = mi.load_dict({"type": "multipixel_receiver"}).receiver
    column = mi.load_dict({"type": "layered_water"}).water.column
    assert (transmitter.pulse_energy, transmitter.divergence, transmitter.pulse.fwhm_ns) == (5e-3, 10e-3, 5.0)
    assert transmitter.optical_efficiency == 0.9
    optics = receiver.optics
    assert (optics.aperture_area, optics.optical_efficiency) == (0.025, 0.9)
    assert optics.two_way_atmospheric_transmittance == 0.9
    assert receiver.pixels.layout == "2x2"
    np.testing.assert_allclose(transmitter.pose.origin, [-200 * np.tan(np.radians(20)), 0, 200])
    assert (column.attenuation[0], column.scattering[0], column.backscattering[0]) == (0.3, 0.15, 0.006)


@pytest.mark.slow
@pytest.mark.parametrize("name", variants.PLUGIN_MODULES)
def test_examples_in_the_manual_load(name, tmp_path, monkeypatch):
    # The file that an example reads: an isotropic phase function.
    (tmp_path / "harbour.csv").write_text("".join(f"{angle}, 0.0796\n" for angle in range(0, 181, 10)))
    monkeypatch.chdir(tmp_path)
    classes = vars(importlib.import_module(f"mitransient_lidar.plugins.{variants.PLUGIN_MODULES[name][0]}")).values()
    (manual,) = (c.__doc__ for c in classes if isinstance(c, type) and f"(``{name}``)" in (c.__doc__ or ""))
    xml, python = re.search(r"code-block:: xml\n(.*?)\.\. code-block:: python\n(.*)", manual, re.DOTALL).groups()
    load = ast.literal_eval(python.strip())
    assert load["type"] == name
    mi.load_dict(load)
    if "<film" in xml and "<sensor" not in xml:
        return  # a film loads inside a sensor only, and the sensors' examples hold one
    if "<phase" in xml:
        xml = f'<medium type="layered_water" name="interior">{xml}</medium>'
    if "<medium" in xml and "<shape" not in xml:
        xml = f'<shape type="ocean_surface">{xml}</shape>'
    mi.load_string(f'<scene version="3.0.0">{xml}</scene>')


def scene(**parts):
    return mi.load_dict(
        {
            "type": "scene",
            "tx": {"type": "lidar_transmitter"},
            "rx": {"type": "multipixel_receiver", "film": {"type": "time_gated_film"}},
            "sea": {"type": "ocean_surface", "spectrum": "flat", "interior": {"type": "layered_water"}},
            **parts,
        }
    )


FILM = {"film": {"type": "time_gated_film"}}
FLAT = {"type": "ocean_surface", "spectrum": "flat"}
UNDER_WATER = {
    "tx": {"type": "lidar_transmitter", "altitude": -0.2, "aim_x": 80.0},
    "rx": {"type": "multipixel_receiver", "altitude": -0.2, "aim_x": 80.0, **FILM},
}
LAYERED = {
    "type": "ocean_surface",
    "spectrum": "flat",
    "interior": {
        "type": "layered_water",
        "layer_tops": "0, 5",
        "refractive_index": "1.33, 1.34",
        "group_index": "1.36",
    },
}
#: A trough of 0.6 m above the lidar.
HIGH_WAVES = {"type": "ocean_surface", "spectrum": "pierson_moskowitz", "wind_speed": 15.0}
HIGH_WAVES["interior"] = {"type": "layered_water"}


@refuses(
    ({"rx": {"type": "perspective"}}, "multipixel_receiver or pixel_fov"),
    ({"rx": {"type": "multipixel_receiver"}}, "time_gated_film"),
    ({"tx": {"type": "constant"}}, "exactly one lidar_transmitter"),
    ({"tx2": {"type": "lidar_transmitter"}}, "has 2 of which 2"),
    ({"sea": FLAT}, "needs a layered_water"),
    ({"sea": {**FLAT, "interior": {"type": "homogeneous"}}}, "must be layered_water"),
    ({"sea": {**FLAT, "exterior": {"type": "layered_water"}}}, "interior medium"),
    ({"more": {"type": "sphere", "interior": {"type": "layered_water", "attenuation": 1.0}}}, "allowed is one"),
    ({"tx": {"type": "lidar_transmitter", "to_world": mi.ScalarTransform4f().translate([0, 0, -3])}}, "altitude"),
    ({"tx": {"type": "lidar_transmitter", "altitude": -3.0}}, r"at z = -3 m and 200 m must both be above the mean sea"),
    ({**UNDER_WATER, "sea": LAYERED}, "refractive_index changes with depth: a lidar under water needs one index"),
    ({**UNDER_WATER, "sea": HIGH_WAVES}, r"altitude = -0.2 must be below the surface of the waves, whose lowest"),
)
def test_scenes_that_are_no_lidar_scenes_are_refused(parts):
    loaded = scene(**parts)
    find_lidar_scene(loaded, loaded.sensors()[0])


def test_other_integrators_see_the_layers():
    """Mitsuba's volumetric path tracers use null collisions up to the largest attenuation."""
    water = mi.load_dict(
        {"type": "layered_water", "layer_tops": "0, 3", "attenuation": "0.9, 0.5", "scattering": "0.6, 0.2"}
    )
    mei = mi.MediumInteraction3f()
    mei.p = mi.Point3f(0, 0, mi.Float([-1.0, -4.0]))
    scattering, null, total = (np.array(c).ravel() for c in water.get_scattering_coefficients(mei))
    np.testing.assert_allclose(scattering, [0.6, 0.2], rtol=1e-6)
    np.testing.assert_allclose(total, [0.9, 0.5], rtol=1e-6)
    np.testing.assert_allclose(null + total, np.array(water.get_majorant(mei)).ravel()[0], rtol=1e-6)


def test_the_default_water_follows_the_wavelength_and_numbers_stay(caplog):
    """Kou et al. 1993 and half of the particles' scattering at 1064 nm; a green laser keeps the values at 532 nm."""
    plain, green, red = (
        mi.load_dict({"type": "layered_water", **({"wavelength_nm": nm} if nm else {})}).water for nm in (0, 515, 1064)
    )
    assert (green.refractive_index, green.group_index) == (plain.refractive_index, plain.group_index) == (1.34, 1.364)
    assert green.column.attenuation == plain.column.attenuation == 0.3
    assert (red.refractive_index, red.group_index) == pytest.approx((1.3303, 1.3464), abs=1e-4)
    assert red.column.attenuation == pytest.approx(14.369 + 0.075, abs=2e-3)
    assert (*red.column.scattering, *red.column.backscattering) == pytest.approx((0.075, 0.003))
    part = mi.load_dict({"type": "layered_water", "wavelength_nm": 1064.0, "attenuation": 15.0}).water
    assert (*part.column.attenuation, *part.column.scattering) == pytest.approx((15.0, 0.075))
    assert caplog.messages == []
    kept = mi.load_dict({"type": "layered_water", "attenuation": 0.3, "wavelength_nm": 1064.0}).water
    assert (kept.column.attenuation, kept.refractive_index) == (0.3, red.refractive_index)
    sentence = "attenuation - scattering = 0.225 1/m is less than pure water absorbs at wavelength_nm = 1064, 14.4 1/m"
    assert [sentence in one for one in caplog.messages] == [True]


@pytest.mark.parametrize("scattering", [0.004, "0.004, 0.1", 0.0])
def test_water_of_a_phase_function_needs_no_backscattering(scattering):
    """It follows from the function: neither its default of 0.006 nor a given value refuses little scattering."""
    layers = {"layer_tops": "0, 3"} if isinstance(scattering, str) else {}
    for phase in ({"phase_function": "hg"}, {"phase_function": "petzold"}, {"own": {"type": "hg", "g": 0.9}}):
        for back in ({}, {"backscattering": 0.01}):
            mi.load_dict({"type": "layered_water", "scattering": scattering, **layers, **phase, **back})
