"""Fits of recorded shots in unknown units and at unknown times: search of the time, receivers, and misfits."""

import numpy as np
import pytest
import xarray as xr
from closed_form_waveform import METRES_PER_NS, SURFACE_NS

import mitransient_lidar
from mitransient_lidar.analysis.information.alignment import behind_bandwidth, light_duration
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.core.errors import UserError

TRUTH = {"attenuation": 0.25, "bottom_reflectance": 0.1, "bottom_depth": 6.0}
TIME = np.arange(0.0, 150.0, 0.5)
SCALE, SHIFT = 37.0, 1300.0


def rows_of(c, rho, depth):
    """Return surface echo, column and bottom echo of pulses of 3 ns [W]."""

    def echo(t):
        return np.exp(-0.5 * ((TIME - t) / 1.3) ** 2)

    end = SURFACE_NS + depth / METRES_PER_NS
    z = np.maximum(TIME - SURFACE_NS, 0) * METRES_PER_NS
    edges = 1 / (1 + np.exp(-(TIME - SURFACE_NS))) / (1 + np.exp(np.clip(TIME - end, -99, 99)))
    column = 0.3 * np.exp(-2 * c * z) * edges
    return 1e-6 * (echo(SURFACE_NS) + column + 20 * rho * np.exp(-2 * c * depth) * echo(end))


def model(values):
    point = np.array([values[name] for name in TRUTH])
    steps = 1e-4 * point * np.eye(3)
    slopes = [(rows_of(*(point + step)) - rows_of(*(point - step))) / (2 * step.sum()) for step in steps]
    data = {
        "waveform": (("pixel", "time"), rows_of(*point)[None], {"units": "W"}),
        "waveform_derivative": (("parameter", "pixel", "time"), np.array(slopes)[:, None]),
    }
    coords = {"pixel": ["single"], "time": TIME, "parameter": list(TRUTH)}
    return xr.Dataset(data, coords, {"time_start_ns": -0.25, "bin_width_ns": 0.5})


def write(path, signal, times):
    """Write a shot in some unit at its own times."""
    dark = np.median(signal[:20])
    lines = [f"{t + SHIFT:.2f},{SCALE * (v - dark):.7g}" for t, v in zip(times, signal, strict=True)]
    path.write_text("\n".join(["time_ns,anything", *lines]))
    return path


def shot(path, receiver="riegl_vq840g", seed=1):
    recorded = detect_waveforms(model(TRUTH), receiver, seed=seed, gain="auto")
    return write(path, recorded["signal"].values.ravel(), recorded["time"].values)


def fit(path, factors, **options):
    start = {name: value * factor for (name, value), factor in zip(TRUTH.items(), factors, strict=True)}
    start |= options.pop("start", {})
    return mitransient_lidar.fit(path, model, options.pop("free", list(TRUTH)), start=start, **options)


@pytest.mark.parametrize("factors", [(0.6, 1.5, 0.75)])
def test_a_shifted_and_scaled_shot_is_found_from_wrong_starts(factors, tmp_path):
    """Depths wrong by a quarter: the fit aligned one echo alone, with a chi-squared of 30 times its mean."""
    fitted = fit(shot(tmp_path / "shot.csv"), factors, receiver="riegl_vq840g")
    assert fitted.attrs["converged"]
    z = (fitted["value"].values[:3] - list(TRUTH.values())) / fitted["stderr"].values[:3]
    assert np.abs(z).max() < 4, z
    assert fitted["value"].sel(parameter="time_offset_ns") == pytest.approx(SHIFT, abs=0.2)
    assert fitted.attrs["probability"] > 1e-4


def test_light_lasts_to_the_bottom_however_bright_the_surface_is():
    """The bottom at 1/200 of the surface, or in another pixel alone: EAARL-B was searched for by its surface."""
    lit = np.zeros((2, 100))
    lit[0, [10, 60]] = 1.0, 0.005
    assert light_duration(np.arange(100.0), lit) == 50
    lit[:, 60] = 0, 1e-5
    assert light_duration(np.arange(100.0), lit) == 50


def test_the_squares_of_stored_residuals_are_the_chi_squared(tmp_path):
    """With noise of the receiver, of the user, and unknown: the last one had those of other units."""
    path = shot(tmp_path / "shot.csv")
    for options in ({"receiver": "riegl_vq840g"}, {"noise": 0.05}, {}):
        fitted = fit(path, (1, 1, 1), **options)
        assert float(np.nansum(fitted["residual"] ** 2)) == pytest.approx(fitted.attrs["chi_squared"], rel=1e-9)
        assert int(fitted["used"].sum()) == np.isfinite(fitted["residual"]).sum()


def test_errors_grow_with_a_misfit_and_a_bad_fit_is_refused(tmp_path):
    """Noise stated 1.5 and 4 times too small, of the same samples: the errors are those of the noise that they have."""
    random, light = np.random.default_rng(3), 1e6 * model(TRUTH)["waveform"].values[0]
    path = write(tmp_path / "shot.csv", light + random.normal(0, 0.01, TIME.size), TIME)
    right, small, smallest = (fit(path, (1, 1, 1), noise=SCALE * 0.01 / by) for by in (1, 1.5, 4))
    np.testing.assert_allclose(small["stderr"], right["stderr"], rtol=0.15)
    np.testing.assert_allclose(smallest["stderr"], right["stderr"], rtol=0.15)
    assert [one.attrs["refused"] for one in (right, small, smallest)] == [0, 0, 1]
    assert [one.attrs["converged"] for one in (right, small, smallest)] == [1, 1, 0]
    assert any("stated errors are multiplied" in text for text in small.attrs["messages"])
    assert any("the fit is refused: chi-squared is 1" in text for text in smallest.attrs["messages"])


def test_a_scene_that_does_not_explain_waveforms_of_unknown_noise_is_refused(tmp_path):
    """Two echoes of which the model has one: no noise is known, but more than a tenth of the squares is left."""
    other = rows_of(*TRUTH.values()) + np.roll(rows_of(*TRUTH.values()), 40)
    fitted = fit(write(tmp_path / "shot.csv", 1e6 * other, TIME), (1, 1, 1))
    assert fitted.attrs["refused"] == 1
    assert any("of the squares of the samples, more than 10 %" in text for text in fitted.attrs["messages"])
    # Noise alone, of more than a tenth of the squares, is none of its faults.
    light = 1e6 * model(TRUTH)["waveform"].values[0]
    noisy = light + np.random.default_rng(2).normal(0, 0.5 * np.sqrt(np.mean(light**2)), TIME.size)

    def of_depth(values):
        return model({**TRUTH, **values}).sel(parameter=["bottom_depth"])

    path = write(tmp_path / "noisy.csv", noisy, TIME)
    fitted = mitransient_lidar.fit(path, of_depth, "bottom_depth", start={"bottom_depth": 6.0})
    assert fitted.attrs["refused"] == 0


def test_the_bandwidth_of_a_receiver_is_fitted(tmp_path):
    """A single pole of 80 MHz, from a start of 100 MHz: parameters and bandwidth within their errors."""
    behind = behind_bandwidth(model)({**TRUTH, "bandwidth_mhz": 80.0})["waveform"].values[0]
    random = np.random.default_rng(5)
    path = write(tmp_path / "shot.csv", 1e6 * behind + random.normal(0, 0.003, TIME.size), TIME)
    fitted = fit(path, (0.8, 1.2, 0.9), free=[*TRUTH, "bandwidth_mhz"], noise=0.003 * SCALE)
    assert fitted.attrs["converged"]
    truth = [*TRUTH.values(), 80.0]
    assert np.abs((fitted["value"].values[:4] - truth) / fitted["stderr"].values[:4]).max() < 4
    # Without it, the response is taken for the scene's.
    assert fit(path, (1, 1, 1), noise=0.003 * SCALE).attrs["refused"] == 1
    with pytest.raises(UserError, match="alternatives"):
        fit(path, (1, 1, 1), free=[*TRUTH, "bandwidth_mhz"], receiver="apd")
    # A scene of which nothing is free has no derivatives.
    alone = behind_bandwidth(lambda _: model(TRUTH).drop_dims("parameter"))({"bandwidth_mhz": 80.0})
    assert alone["waveform_derivative"].sizes["parameter"] == 1
