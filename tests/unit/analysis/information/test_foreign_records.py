"""Fits of recorded shots in unknown units and at unknown times: search of the time, receivers, and misfits."""

import numpy as np
import pytest
import xarray as xr
from closed_form_waveform import METRES_PER_NS, SURFACE_NS

import mitransient_lidar
from mitransient_lidar.analysis.information.bandwidth import BehindBandwidth, _behind
from mitransient_lidar.analysis.receiver import detect_waveforms

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
    """Return the waveform and its derivatives by differences."""
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
    """Write a recorded shot of the truth."""
    recorded = detect_waveforms(model(TRUTH), receiver, seed=seed, gain="auto")
    return write(path, recorded["signal"].values.ravel(), recorded["time"].values)


def fit(path, factors, **options):
    start = {name: value * factor for (name, value), factor in zip(TRUTH.items(), factors, strict=True)}
    start |= options.pop("start", {})
    return mitransient_lidar.fit(path, model, options.pop("free", list(TRUTH)), start=start, **options)


@pytest.mark.parametrize("factors", [(0.6, 1.5, 0.75), (1.5, 0.6, 1.25), (1.5, 1.5, 0.8)])
def test_a_shifted_and_scaled_shot_is_found_from_wrong_starts(factors, tmp_path):
    """Depths wrong by a quarter: the fit aligned one echo alone, with a chi-squared of 30 times its mean."""
    fitted = fit(shot(tmp_path / "shot.csv"), factors, receiver="riegl_vq840g")
    assert fitted.attrs["converged"]
    z = (fitted["value"].values[:3] - list(TRUTH.values())) / fitted["stderr"].values[:3]
    assert np.abs(z).max() < 4, z
    assert fitted["value"].sel(parameter="time_offset_ns") == pytest.approx(SHIFT, abs=0.2)
    assert fitted.attrs["probability"] > 1e-4
