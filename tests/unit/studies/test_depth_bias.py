"""Tables of errors of depths: which cells are rendered, and refusals."""

import contextlib
import time

import numpy as np
import pytest
import xarray as xr
from rows import must_refuse

from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.rendering.passes import Progress
from mitransient_lidar.studies import depth_bias as study
from mitransient_lidar.studies.depth_bias import tpu


@pytest.fixture
def rendered(monkeypatch):
    """Depths that are rendered: waves uncover 0.1 m, the surface hides 0.2 m, and bottoms from 6 m on are lost."""
    depths = []
    geometry = {"altitude": 150.0, "refractive_index": 1.34, "divergence_mrad": 1.0}

    def render(scene, given, **options):
        depths.append(given["bottom_depth"])
        truth = np.full(3, np.nan if given["bottom_depth"] == 0.1 else given["bottom_depth"])
        coords = {"pixel": ["single"], "true_bottom_depth_below_surface": ("shot", truth)}
        return xr.Dataset(coords=coords, attrs={"depth": given["bottom_depth"], **geometry})

    def cell(recorded, estimators, corrections):
        found = float(0.2 < recorded.attrs["depth"] < 6)
        numbers = {name: np.full((1, 1), 0.1) for name in ("bias", "spread", "error", "z")}
        numbers |= dict.fromkeys(("flagged", "bright_found", "hidden"), np.zeros((1, 1)))
        numbers |= {"found": np.full((1, 1), found), "wrong": np.zeros((1, 1)), "snr": np.full(1, 9.0)}
        return {**numbers, "attenuation": 0.2, "slope_along": 0.05, "slope_across": 0.04}

    monkeypatch.setattr(study, "render_shots", render)
    monkeypatch.setattr(study, "detect_waveforms", lambda result, *options: result)
    monkeypatch.setattr(study, "_cell", cell)
    monkeypatch.setattr(study, "_check_counts", lambda recorded: None)
    return depths


def test_bottoms_below_a_lost_one_are_not_rendered(rendered):
    states = []
    options = {"angles_deg": [20.0], "winds": [0.0, 3.0], "waters": ["IB"], "estimators": ["gaussian"]}
    options["ripples"] = [5.0]
    table = study.depth_bias("riegl_vq840g", depths=[0.1, 0.2, 3, 6, 8, 10], progress=states.append, **options)
    # A bottom that the surface hides is no lost one.
    assert rendered == 2 * [0.1, 0.2, 3, 6]
    one = table.isel(off_nadir_deg=0, wind_speed=1, water=0, estimator=0, pixel=0)
    np.testing.assert_array_equal(one["found"], [0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(one["wrong"], 0)
    np.testing.assert_array_equal(one["bias"], [np.nan, 0.1, 0.1, 0.1, np.nan, np.nan])
    assert [state.done for state in states] == list(range(1, 13))
    np.testing.assert_allclose(table["attenuation"].values[0, 0, 0], [np.nan, 0.2, 0.2, 0.2, np.nan, np.nan])
    assert table.attrs["altitude"] == 150


def test_level_seas_are_rendered_as_often_as_waves_have_places(rendered, monkeypatch):
    """A single render has an error that its records share."""
    options, winds = [], []

    def noted(scene, given, *, render=study.render_shots, **rest):
        options.append(rest)
        winds.append((given["wind_speed"], given.get("spectrum")))
        return render(scene, given, **rest)

    monkeypatch.setattr(study, "render_shots", noted)
    seas = {"angles_deg": [20.0], "winds": [0.0, 3.0], "waters": ["IB"], "estimators": ["gaussian"], "depths": [3.0]}
    table = study.depth_bias("riegl_vq840g", shots=4, target_error=0.05, **seas)
    assert [one["target_error"] for one in options] == pytest.approx([0.03, 0.03, 0.05])
    assert winds == [(3.0, "flat"), (6.0, "flat"), (3.0, None)]
    assert table["wind_speed"].values.tolist() == [0, 0, 3]
    assert table["ripples"].values.tolist() == [3, 6, 3]
    assert options[0]["positions"] == options[1]["positions"] == 4 * [(0.0, 0.0)]
    assert options[2]["count"] == 4
    assert table.attrs["level_renders"] == 4
    must_refuse("target_error = 0 must be greater than 0", study.depth_bias, "riegl_vq840g", target_error=0.0, **seas)


def test_bottoms_that_errors_of_the_render_hide_are_counted(monkeypatch):
    """Of four shots of one pixel one is faint, one found, one flagged, and one is found without the render's error."""

    def echoes(recorded, estimators):
        assert estimators == ["gaussian"]
        depth = np.array([np.nan, 5.1, 5.2, np.nan if "signal_mean_stderr" in recorded else 5.3])
        flags = np.where(np.isnan(depth), int(EchoFlag.NO_ECHO), [0, 0, int(EchoFlag.SCATTERED_LIGHT), 0])
        dims = ("shot", "pixel", "estimator", "echo")
        data = {"depth_m": (dims, depth.reshape(4, 1, 1, 1)), "flags": (dims, flags.reshape(4, 1, 1, 1))}
        return xr.Dataset(data, {"echo": ["bottom"], "pixel": ["single"], "estimator": ["gaussian"]})

    monkeypatch.setattr(study, "extract", echoes)
    recorded = xr.Dataset({"signal_mean_stderr": ("time", np.zeros(3))})
    bright = np.array([[False], [True], [True], [True]])
    shares = study._shares(recorded, echoes(recorded, ["gaussian"]), np.full(4, 5.0), bright)
    assert {name: values.item() for name, values in shares.items()} == pytest.approx(
        {"flagged": 1 / 4, "bright": 3 / 4, "bright_found": 2 / 3, "hidden": 1 / 4}
    )


def test_records_of_single_photons_are_refused():
    """Photon counters with less than a count in every sample, not electrons without noise, nor volts."""
    sentence = r"receiver = 'icesat2_atlas' must give at least 1 count .* gives 0.8"
    for units, event, brightest in (("1", 1.0, 1.5), ("1", 0.0, 0.8), ("V", 0.01, 0.8), ("1", 1.0, 0.8)):
        signal = xr.DataArray(np.zeros(3), dims="time", attrs={"units": units})
        data = {"signal": signal, "signal_mean": ("time", [0.0, brightest, 0.1]), "event_height": ("pixel", [event])}
        refused = units == "1" and event > 0 and brightest < 1
        with pytest.raises(UserError, match=sentence) if refused else contextlib.nullcontext():
            study._check_counts(xr.Dataset(data, attrs={"receiver": "icesat2_atlas"}))


def test_seas_after_the_time_are_nan_and_named(rendered, monkeypatch, caplog):
    """Four of six seas in 3.5 s; a bottom below a lost one needs no render, and stays one that is not found."""
    # Each render takes a second.
    monkeypatch.setattr(time, "perf_counter", lambda: float(len(rendered)))
    options = {"angles_deg": [20.0], "winds": [3.0], "estimators": ["gaussian"]}
    table = study.depth_bias("riegl_vq840g", waters=["IB", "1C"], depths=[3, 6, 8], max_time=2.5, **options)
    one = table.isel(off_nadir_deg=0, wind_speed=0, estimator=0, pixel=0)
    np.testing.assert_array_equal(one["found"], [[1, 0, 0], [1, np.nan, np.nan]])
    np.testing.assert_array_equal(one["wrong"], [[0, 0, 0], [0, np.nan, np.nan]])
    np.testing.assert_array_equal(one["bias"], [[0.1, 0.1, np.nan], [0.1, np.nan, np.nan]])
    assert table.attrs["seas_left_out"] == 2
    assert "max_time = 2.5 s ended after 4 of 6 seas" in caplog.text
    assert len(study.describe_depth_bias(table)) == 1 + 4
    found = tpu("riegl_vq840g", altitudes=[100, 200, 300], waters=["IB"], depths=[3], corrections=None, max_time=2.5)
    assert found["altitude"].values.tolist() == [100]
    assert found.attrs["seas_left_out"] == 3 * 5 - 3


def test_uncertainty_refuses_wrong_input_before_it_renders(rendered):
    for options, message in (
        ({"estimator": "eye"}, "estimator = 'eye' must be one of threshold"),
        ({"params": {"altitude": "high"}}, "altitude = 'high' must be a number"),
    ):
        must_refuse(message, tpu, "riegl_vq840g", **options)
    assert not rendered


def test_uncertainty_reports_the_cells_of_all_altitudes(monkeypatch):
    """Progress counts two altitudes of three cells; the table of each is that of its own height."""
    heights = []

    def table(instrument, params, *, progress, **options):
        heights.append(params["altitude"])
        for done in (1, 2, 3):
            progress(Progress(done, 3, "render"))
        shape = (1, 1, 1, 3, 1, 1)
        dims = ("off_nadir_deg", "wind_speed", "water", "depth", "estimator", "pixel")
        names = ("bias", "spread", "found", "error")
        data = {name: (dims, np.full(shape, 1e-4 * params["altitude"] + (name == "found"))) for name in names}
        data["snr"] = (dims[:4] + dims[5:], np.ones(shape[:5]))
        data |= {name: (dims[:4], np.zeros(shape[:4])) for name in ("slope_along", "slope_across")}
        coords = {"off_nadir_deg": [0.0], "wind_speed": [0.0], "water": ["IB"], "depth": [1.0, 2.0, 4.0]}
        attributes = {"instrument": instrument, "refractive_index": 1.34, "divergence_mrad": 1.0, "seas_left_out": 0}
        return xr.Dataset(data, {**coords, "estimator": ["gaussian"], "pixel": ["single"]}, {**attributes, **params})

    monkeypatch.setattr("mitransient_lidar.studies.depth_bias.depth_bias", table)
    states = []
    errors = {"pointing_mrad": 0.0, "position_m": 2.0, "height_m": 5.0}
    found = tpu("riegl_vq840g", altitudes=[100, 400], corrections=None, **errors, progress=states.append)
    assert heights == [100, 400]
    assert [(state.done, state.planned) for state in states] == [(done, 6) for done in range(1, 7)]
    assert states[-1].remaining_s == 0
    vertical = found["subaqueous_vertical"].isel(correction=0, depth=0)
    np.testing.assert_allclose(vertical.values.ravel(), np.hypot([0.01, 0.04], [0.01, 0.04]))
    assert "altitude" not in found.attrs
    # The height counts in the vertical, the position in the horizontal.
    np.testing.assert_allclose(found["tvu"].isel(correction=0, depth=0), 1.96 * np.hypot(5, vertical), rtol=1e-3)
    assert found["thu"].min() > 2.4 * 2
