"""Instruments: their data, the scenes that they are mounted in, and the table in the documentation."""

import re

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row, must_refuse, refuses

from mitransient_lidar.analysis.waveforms.depth_correction import corrections_for
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading import catalogue, scenes

NAMES = (
    *("icesat2_atlas", "leica_chiroptera4x", "leica_chiroptera4x_infrared", "leica_hawkeye4x_deep", "optech_titan"),
    *("optech_titan_infrared", "published_airborne", "published_mast", "riegl_vq840g", "riegl_vq840gl"),
    *("riegl_vq880g2", "riegl_vq880g2_infrared", "teledyne_czmil", "teledyne_czmil_infrared", "usgs_eaarl_b"),
)

#: Parameters that every instrument has; beam and view may be given in several ways.
NEEDED = {
    *("altitude", "off_nadir_deg", "wavelength_nm", "pulse_energy_mj", "pulse_fwhm_ns", "bin_width_ns"),
    *("aperture_area", "optical_efficiency", "response_time_ns"),
}

FLAT = {"spectrum": "flat"}

#: A sea alone, to which an instrument adds the lidar.
SEA = """<scene version="3.0.0">
    <default name="wind_speed" value="3"/>
    {lidar}
    <shape type="ocean_surface">
        <string name="spectrum" value="flat"/>
        <float name="wind_speed" value="$wind_speed"/>
        <medium type="layered_water" name="interior"/>
    </shape>
</scene>"""


def parts(loaded):
    transmitter = next(each for each in loaded.emitters() if hasattr(each, "pulse"))
    (sensor,) = loaded.sensors()
    return transmitter, sensor.receiver


def values(name):
    return {each.name: each.value for each in catalogue.read_instrument(name).parameters if each.value}


@each_row(*NAMES)
def test_every_value_that_is_needed_has_a_source_or_is_assumed(name):
    instrument, given = catalogue.read_instrument(name), values(name)
    assert given.keys() >= NEEDED
    assert len([key for key in given if key.startswith("divergence")]) == 1
    assert "field_of_view_mrad" in given or "shallow_view_mrad" in given
    assert instrument.title
    listed = set(re.findall(r"^\[(\d)\]", instrument.description, re.MULTILINE))
    cited = set()
    for parameter in instrument.parameters:
        if parameter.value:
            references = set(re.findall(r"\[(\d)\]", parameter.source))
            assert references or parameter.is_assumed, parameter
            cited |= references
    cited |= set(re.findall(r"\[(\d)\]", re.sub(r"^\[\d\]", "", instrument.description, flags=re.MULTILINE)))
    cited |= set(re.findall(r"as in \[(\d)\]", catalogue.instrument_text(name)))
    assert cited == listed


@each_row(*NAMES)
def test_the_loaded_lidar_has_the_values_of_the_file(name):
    given = {key: float(value) for key, value in values(name).items() if key != "layout"}
    transmitter, receiver = parts(scenes.open_scene("table1", FLAT, name).scene)
    assert transmitter.pulse_energy == pytest.approx(1e-3 * given["pulse_energy_mj"])
    assert transmitter.wavelength_nm == given["wavelength_nm"]
    assert transmitter.pulse.fwhm_ns == pytest.approx(given["pulse_fwhm_ns"])
    beam = given.get("divergence_mrad", given.get("divergence_1e2_mrad", 0) / 2)  # 2 sigma, and 4 sigma
    assert transmitter.divergence == pytest.approx(1e-3 * beam)
    view = max(value for key, value in given.items() if key.endswith("view_mrad"))
    assert receiver.pixels.field_of_view == pytest.approx(1e-3 * view)
    assert tuple(receiver.pixels.names) == catalogue.read_instrument(name).channels
    for pose in (transmitter.pose, receiver.pose):
        assert pose.origin[2] == pytest.approx(given["altitude"])
        assert np.degrees(np.arccos(-pose.axis[2])) == pytest.approx(given["off_nadir_deg"], abs=1e-3)


def test_values_of_the_user_win():
    own = {**FLAT, "altitude": 90, "divergence_mrad": 3, "shallow_view_mrad": 10}
    opened = scenes.open_scene("table1", own, "teledyne_czmil")
    loaded, parameters = opened.scene, opened.parameters
    transmitter, receiver = parts(loaded)
    assert transmitter.divergence == pytest.approx(3e-3)
    assert parameters["divergence_1e2_mrad"] == ""
    assert receiver.pose.origin[2] == pytest.approx(90)
    assert receiver.pixels.fields[1].outer == pytest.approx(5e-3)


def test_the_scene_keeps_gates_integrator_place_and_target():
    params = {"aim_y": 3, "target_depth": 5, **FLAT}
    loaded = scenes.open_scene("gated_mine", params, "riegl_vq840g")
    assert loaded.parameters["gate_count"] == "20"
    assert loaded.parameters["aim_y"] == "3"
    assert loaded.source.instrument == "riegl_vq840g"
    assert loaded.scene.integrator().parameters["cell_size"] == 0.015
    assert {"blur_mrad", "field_of_view_shape"}.isdisjoint(loaded.parameters)
    film = loaded.scene.sensors()[0].film()
    assert film.parameters["gate_count"] == 20
    assert film.parameters["bin_width_ns"] == 0.5


def test_the_lidar_keeps_its_aim_and_the_water_has_its_wavelength(tmp_path):
    path = tmp_path / "sea.xml"
    path.write_text(SEA.format(lidar='<emitter type="lidar_transmitter"><float name="aim_x" value="3"/></emitter>'))
    loaded = scenes.open_scene(path, None, "leica_chiroptera4x")
    assert loaded.parameters["aim_x"] == "3"
    assert parts(loaded.scene)[1].pose.nearby_point()[0] == pytest.approx(3, abs=0.01)
    (surface,) = loaded.scene.shapes()
    assert surface.interior_medium().parameters["wavelength_nm"] == 515


def test_the_printed_xml_is_included_by_a_scene(tmp_path):
    (tmp_path / "instrument.xml").write_text(catalogue.instrument_text("teledyne_czmil"))
    path = tmp_path / "sea.xml"
    path.write_text(SEA.format(lidar='<include filename="instrument.xml"/>'))
    ours, plain = scenes.open_scene(path).scene, mi.load_file(str(path), optimize=False)
    mounted = scenes.open_scene("table1", FLAT, "teledyne_czmil").scene
    for loaded in (ours, plain):
        for part, expected in zip(parts(loaded), parts(mounted), strict=True):
            assert part.pose.origin == pytest.approx(expected.pose.origin)
        assert str(loaded.sensors()[0]) == str(mounted.sensors()[0])


def test_files_of_the_scene_are_found_with_an_instrument(tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    sphere = mi.load_dict({"type": "cube"})
    sphere.write_ply(str(tmp_path / "own" / "rock.ply"))
    rock = '<shape type="ply" id="rock"><string name="filename" value="rock.ply"/></shape>'
    path = tmp_path / "own" / "sea.xml"
    path.write_text(SEA.format(lidar=rock))
    monkeypatch.chdir(tmp_path)
    loaded = scenes.open_scene(path, None, "riegl_vq840g").scene
    assert "rock" in [shape.id() for shape in loaded.shapes()]


@each_row(
    ("riegl_vq840", "instrument = 'riegl_vq840' is not known; did you mean riegl_vq840g"),
    ("own.xml", "instrument = 'own.xml' is not known; a lidar of a file is a part of a scene, by <include>"),
    ("zzz", "instrument = 'zzz' is not known; instruments are icesat2_atlas, .*, usgs_eaarl_b"),
    (5, "instrument = 5 is not known"),
    ("../instruments/riegl_vq840g", "is not known"),
)
def test_unknown_instruments_are_refused(name, sentence):
    for call in (catalogue.read_instrument, catalogue.instrument_text):
        must_refuse(sentence, call, name)
    must_refuse(sentence, scenes.open_scene, "table1", None, name)


@refuses(
    ("table1", {"layout": "1x1"}, "parameter 'layout' is not one of scene table1 with instrument teledyne_czmil"),
    ({"type": "scene"}, None, "instrument = 'teledyne_czmil' needs an XML scene, not a dict"),
    ("loaded", None, "not a loaded scene"),
)
def test_what_an_instrument_does_not_fit_is_refused(scene, params):
    scenes.open_scene(mi.load_dict({"type": "scene"}) if scene == "loaded" else scene, params, "teledyne_czmil")


def test_parameters_of_an_infrared_channel():
    """Scene, altitude and aim are shared; the lidar's own parameters are not."""
    given = {"wind_speed": 3, "altitude": 400, "pulse_fwhm_ns": 2, "time_start_ns": 9, "infrared.off_nadir_deg": 5}
    (name, own), (channel, other) = catalogue.with_infrared("riegl_vq880g2", given)
    assert (name, channel) == ("riegl_vq880g2", "riegl_vq880g2_infrared")
    assert own == {"wind_speed": 3, "altitude": 400, "pulse_fwhm_ns": 2, "time_start_ns": 9}
    assert other == {"wind_speed": 3, "altitude": 400, "off_nadir_deg": 5, "coefficients_nm": 532}
    loaded = scenes.open_scene("fresh_water_lens", {**FLAT, **other}, channel).scene
    (water,) = [shape.interior_medium() for shape in loaded.shapes() if shape.interior_medium() is not None]
    # Layers given at 532 nm absorb as pure water does at 1064 nm.
    assert (water.water.column.absorption > 14.3).all()
    for refused in (None, "riegl_vq840g", "riegl_vq880g2_infrared"):
        with pytest.raises(UserError, match=r"has no infrared channel; instruments with one are .*riegl_vq880g2"):
            catalogue.with_infrared(refused, {})


def test_shipped_corrections_are_of_their_instrument():
    tables = sorted((catalogue.folder_of_scenes() / "instruments").glob("*_depths.nc"))
    assert tables
    for path in tables:
        name = path.stem.removesuffix("_depths")
        table = corrections_for(name, "auto")
        assert table.attrs["instrument"] == name
        assert tuple(table["pixel"].values) == catalogue.read_instrument(name).channels
        assert np.isfinite(table["bias"].sel(estimator="gaussian", wind_speed=0)).any()
