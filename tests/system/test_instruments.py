"""Instruments by name: listed, rendered over a shipped scene, recorded in the result and rendered again."""

import numpy as np
import pytest
from command_line import assert_refused, run
from rows import each_case, each_row
from significance import variance_limits

import mitransient_lidar
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms.echo_classes import EchoClass
from mitransient_lidar.analysis.waveforms.echo_table import extract
from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading import catalogue
from mitransient_lidar.results.attributes import split

FEW = {"type": "lidar_volpath", "paths_per_pass": 4096}
#: Its energies in 12 ns of an echo or of the water vary by 1 % from seed to seed.
STEADY = {"type": "lidar_merging", "paths_per_pass": 8192, "photons_per_pass": 8192}


def record(name):
    """Return parameters of a record that begins before the surface echo of the scene table1 and ends below 8 m."""
    given = {each.name: each.value for each in catalogue.read_instrument(name).parameters}
    altitude, angle = float(given["altitude"]), np.radians(float(given["off_nadir_deg"]))
    # The footprint of the mast's beam is 16 m long.
    before, length = (90, 300) if name == "published_mast" else (40, 170)
    start = 2e9 * altitude / np.cos(angle) / C0 - before
    return {"time_start_ns": start, "bin_count": round(length / float(given["bin_width_ns"]))}


def few(scene, integrator=FEW, **options):
    params = {"spectrum": "flat", **options.pop("params", {})}
    return mitransient_lidar.render(scene, params=params, integrator=integrator, passes=2, **options)


#: Scenes whose own lidar is a shipped instrument; the others are mounted on the first.
OWN = {"published_airborne": "table1", "published_mast": "fig04_mast"}


#: Of each kind: one pixel and many, a mast of a scene's own, and an orbit.
KINDS = ("published_mast", "icesat2_atlas", "riegl_vq840g", "teledyne_czmil", "riegl_vq880g2_infrared")


@each_case(
    *zip(
        [
            pytest.param(name, marks=pytest.mark.slow if name in KINDS else pytest.mark.long)
            for name in catalogue.instrument_names()
        ]
    )
)
def test_every_instrument_renders(name):
    """Surface and bottom return light at their times, in every channel; a scene's own lidar gives the same bits."""
    scene = OWN.get(name, "table1")
    result = few(scene, STEADY, instrument=name, params=record(name))
    assert result.attrs["instrument"] == name
    assert tuple(result["pixel"].values) == catalogue.read_instrument(name).channels
    assert np.isfinite(result["waveform"]).all()
    energy = result["impulse_response"]
    assert (energy.sum("time") > 0).all()
    if name.endswith("_infrared"):
        # The record ends 2 m below the surface, not at 8 m.
        assert energy.where(abs(energy["time"] - result.attrs["surface_time_ns"]) < 6).sum() > 0.999 * energy.sum()
    elif scene == "table1":
        # 8 m of water at this angle, timed with the group index.
        angle = np.arcsin(np.sin(np.radians(float(result.attrs["scene.off_nadir_deg"]))) / 1.34)
        bottom = result.attrs["surface_time_ns"] + 2e9 * 8 / np.cos(angle) * 1.364 / C0
        near = abs(energy["time"] - bottom) < 6
        above = abs(energy["time"] - bottom + 20) < 6
        # 5 to 10 times the water above.
        assert energy[:, near].sum() > 3 * energy[:, above].sum()
    if name in OWN:
        own = few(scene, STEADY, params=record(name))
        assert energy.values.tobytes() == own["impulse_response"].values.tobytes()
        assert "instrument" not in own.attrs


@pytest.mark.slow
def test_a_result_names_its_instrument_and_gives_the_same_bits():
    params = {**record("teledyne_czmil"), "bin_width_ns": 4, "bin_count": 40, "altitude": 380}
    first = few("table1", instrument="teledyne_czmil", params=params)
    again = mitransient_lidar.render(first)
    for name in ("impulse_response", "waveform"):
        assert first[name].values.tobytes() == again[name].values.tobytes()
    assert first.attrs["instrument"] == again.attrs["instrument"] == "teledyne_czmil"
    assert first.attrs["scene.altitude"] == again.attrs["scene.altitude"] == "380"


@pytest.mark.slow
def test_the_infrared_channel_gives_the_surface_above_shallow_bottoms():
    """Green echoes of surface and bottom merge in half a metre, 5 cm too shallow; both channels see the same waves."""
    params = {"wind_speed": 3, "bottom_depth": 0.5, "bottom_reflectance": 0.15, "infrared.off_nadir_deg": 0}
    options = {"instrument": "riegl_vq880g2", "infrared": True, "pass_share": 0.25}
    series = mitransient_lidar.render_shots("table1", params, count=8, passes=2, seed=3, **options)
    heights = series["true_surface_height"].values
    np.testing.assert_allclose(series["infrared_true_surface_height"], heights, atol=0.02)
    recorded = detect_waveforms(series, seed=5)
    green, infrared = split(recorded)
    assert green.attrs["receiver"] != infrared.attrs["receiver"] == "riegl_vq880g2_infrared"
    errors, stated = {}, {}
    for name, record in (("green", green), ("both", recorded)):
        bottom = extract(record).sel(echo="bottom").isel(pixel=0)
        assert (bottom["class"] == EchoClass.MERGED).sum() + (bottom["class"] == EchoClass.BOTTOM).sum() == 8
        errors[name] = bottom["depth_m"].values - series["true_bottom_depth_below_surface"].values
        stated[name] = np.hypot(bottom["depth_m_stderr"], bottom["depth_m_method_error"]).values
    assert np.sqrt(np.mean(errors["both"] ** 2)) < 0.5 * np.sqrt(np.mean(errors["green"] ** 2))
    assert np.median(stated["both"]) < 0.5 * np.median(stated["green"])
    assert np.mean((errors["both"] / stated["both"]) ** 2) < variance_limits(8)[1]
    few = mitransient_lidar.render_shots("table1", params, count=2, passes=2, **{**options, "pass_share": 1 / 64})
    again = mitransient_lidar.render(few)
    assert again["infrared_waveform"].values.tobytes() == few["infrared_waveform"].values.tobytes()


@each_row(
    (["render", "table1", "--infrared"], "--instrument = None has no infrared channel; instruments with one are"),
    (
        ["render", "table1", "--instrument", "riegl_vq840g", "--infrared"],
        "--instrument = 'riegl_vq840g' has no infrared channel; instruments with one are",
    ),
    (
        ["render", "table1", "--instrument", "riegl_vq880g2", "--infrared", "-D", "infrared.wavelength_nm=1550"],
        "wavelength_nm = 1550 must lie between 300 and 1100",
    ),
    (
        ["render", "table1", "--instrument", "riegl_vq880g2", "--infrared", "-D", "infrared.pulse_fwhm_ns="],
        "pulse_fwhm_ns = '' is empty",
    ),
    (["scenes", "instruments", "czmil"], "instrument = 'czmil' is not known; did you mean teledyne_czmil"),
    (["scenes", "instruments", "--xml"], "--xml needs the name of an instrument"),
    (["render", "table1", "--instrument", "eye"], "instrument = 'eye' is not known; instruments are icesat2_atlas"),
    (
        ["render", "table1", "--instrument", "teledyne_czmil", "-D", "layout=1x1"],
        "parameter 'layout' is not one of scene table1 with instrument teledyne_czmil",
    ),
    (
        ["render", "table1", "--instrument", "riegl_vq840g", "-D", "aperture=1"],
        "parameter 'aperture' is not one of scene table1 with instrument riegl_vq840g: did you mean aperture_area",
    ),
)
def test_wrong_input_is_refused(arguments, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(run(*arguments), sentence)
    assert not list(tmp_path.iterdir())
