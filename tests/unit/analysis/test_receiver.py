"""Recorded shots of a result: labels, values, provenance and invalid input."""

import logging

import numpy as np
import pytest
import xarray as xr

from mitransient_lidar import results
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser
from mitransient_lidar.physics.receiver.presets import RECEIVERS, ReceiverChain

PHOTON = 6.62607015e-34 * 299792458 / 532e-9  # J
CHAIN = ReceiverChain(
    LinearDetector.avalanche(0.6, 50.0, 0.02),
    Amplifier(1e4, 3.0, bandwidth_mhz=200.0),
    digitiser=Digitiser(12, 1.0, -0.1),
    source="made up",
)


def make(grid=None, pixels=4, bins=40, **attributes):
    t = np.arange(bins)
    wave = 1e-7 * (1 + np.arange(pixels))[:, None] * np.exp(-0.5 * ((t - 15) / 3) ** 2)
    return results.build(
        1e-9 * wave,
        np.zeros_like(wave),
        wave,
        np.zeros_like(wave),
        time=TimeAxis(1400.0, 0.5, bins),
        pixel_names=["red", "green", "blue", "black"][:pixels],
        pixel_centres_mrad=np.arange(2 * pixels).reshape(-1, 2),
        grid=grid,
        attributes={"scene": "fig09", "layout": "2x2", "surface_time_ns": 1407.0, **attributes},
    )


def test_shots_of_pixels():
    dataset = make()
    shots = detect_waveforms(dataset, CHAIN, shots=400, seed=3)
    assert shots["signal"].dims == ("shot", "pixel", "time")
    assert shots["snr"].dims == ("pixel", "time")
    assert shots["signal"].attrs["units"] == "V"
    for name in ("pixel", "angle_x", "angle_y", "time"):
        xr.testing.assert_identical(
            shots[name].drop_vars(shots[name].coords), dataset[name].drop_vars(dataset[name].coords)
        )
    # 0.6 e/(h nu) 50 1e4 V per W; the low-pass keeps the area, and delays by 0.8 ns: less than two bins.
    volts = 0.6 * 1.602176634e-19 / PHOTON * 50 * 1e4 * dataset["waveform"].values
    mean = shots["signal"].mean("shot").values
    np.testing.assert_allclose(mean.sum(axis=1), volts.sum(axis=1), rtol=0.02)
    assert np.all((mean.argmax(axis=1) >= 16) & (mean.argmax(axis=1) <= 18))
    spread = shots["signal"].std("shot", ddof=1) / shots["signal_deviation"]
    # The standard deviation of n normal numbers has the relative error sqrt(1/(2 n)); 160 comparisons.
    assert np.max(np.abs(spread.values - 1)) < 6 * np.sqrt(1 / 800)
    z = (shots["signal"].mean("shot") - shots["signal_mean"]) / shots["signal_deviation"] * 20
    assert np.max(np.abs(z.values)) < 6
    assert not shots["saturated"].any()
    found = (shots["signal_mean"] - shots["signal_mean"][:, 0]) / shots["signal_deviation"]
    np.testing.assert_allclose(shots["snr"], found, atol=0.01)


def test_provenance():
    shots = detect_waveforms(make(), CHAIN, shots=2, seed=9, background_power=1e-9)
    attributes = shots.attrs
    assert attributes["scene"] == "fig09"
    assert attributes["surface_time_ns"] == 1407.0
    assert (attributes["noise_seed"], attributes["shots"], attributes["background_power_w"]) == (9, 2, 1e-9)
    assert attributes["receiver.detector"] == "LinearDetector"
    assert attributes["receiver.detector.gain"] == 50.0
    assert attributes["receiver.amplifier.bandwidth_mhz"] == 200.0
    assert attributes["receiver.digitiser.bits"] == 12
    assert attributes["receiver.source"] == "made up"
    assert all(isinstance(value, (int, float, str, list)) for value in attributes.values())
    named = detect_waveforms(make(), "spad", shots=1)
    assert named.attrs["receiver"] == "spad"
    assert named.attrs["receiver.detector.paralyzable"] == 0
    assert named["signal"].attrs["units"] == "1"
    assert set(np.unique(named["signal"])) <= {0.0, 1.0}


def test_file_round_trip(tmp_path):
    shots = detect_waveforms(make(), CHAIN, shots=3)
    shots.to_netcdf(tmp_path / "shots.nc", engine="h5netcdf")
    again = xr.load_dataset(tmp_path / "shots.nc", engine="h5netcdf", decode_times=False)
    xr.testing.assert_equal(again, shots)
    assert again["saturated"].dtype == bool


def test_shots_of_an_imager():
    shots = detect_waveforms(make(grid=(2, 2)), CHAIN, shots=5, background_power=np.array([[0, 0], [0, 1e-7]]))
    assert shots["signal"].dims == ("shot", "row", "column", "time")
    assert shots["signal"].shape == (5, 2, 2, 40)
    dark = shots["signal_mean"].isel(time=0).values.ravel()
    assert dark[3] > 10 * np.max(np.abs(dark[:3]))
    assert shots.attrs["background_power_w"] == [0, 0, 0, 1e-7]


def test_labelled_background():
    light = xr.DataArray([1e-7, 0.0], dims="column", coords={"column": [0, 1]})
    shots = detect_waveforms(make(grid=(2, 2)), CHAIN, background_power=light)
    assert shots.attrs["background_power_w"] == [1e-7, 0, 1e-7, 0]


def test_sampling_rate_thins_the_time():
    chain = ReceiverChain(CHAIN.detector, CHAIN.amplifier, digitiser=Digitiser(12, 1.0, -0.1, sampling_ghz=0.5))
    shots = detect_waveforms(make(), chain, shots=2)
    np.testing.assert_allclose(shots["time"], 1400.25 + 2.0 * np.arange(10))
    # The edges of the samples: so that time_start_ns + (i + 1/2) bin_width_ns is the time.
    assert (shots.attrs["time_start_ns"], shots.attrs["bin_width_ns"]) == (1399.25, 2.0)


def test_seed_decides():
    one, two, three = (detect_waveforms(make(), CHAIN, shots=3, seed=seed) for seed in (1, 1, 2))
    xr.testing.assert_identical(one, two)
    assert not one["signal"].equals(three["signal"])


def test_bin_width_from_the_time_coordinate():
    shots = detect_waveforms(without(make(), attribute="bin_width_ns"), CHAIN)
    xr.testing.assert_identical(shots["signal"], detect_waveforms(make(), CHAIN)["signal"])


def test_warning_of_smoothing_twice(caplog):
    with caplog.at_level(logging.WARNING):
        detect_waveforms(make(response_time_ns=0.0), CHAIN)
        detect_waveforms(make(response_time_ns=2.0), RECEIVERS["ideal"])
        assert not caplog.records
        detect_waveforms(make(response_time_ns=2.0), CHAIN)
    assert "response time already" in caplog.text


def without(dataset, *, attribute):
    dataset.attrs.pop(attribute)
    return dataset


def changed(value):
    dataset = make()
    dataset["waveform"].values[1, 2] = value
    return dataset


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: detect_waveforms(make(), "pmtt"), "chain = 'pmtt' must be .*apd"),
        (lambda: detect_waveforms(make().drop_vars("waveform"), CHAIN), "no variable waveform"),
        (lambda: detect_waveforms(make().transpose("time", "pixel"), CHAIN), r"dimensions \('time', 'pixel'\)"),
        (lambda: detect_waveforms(make().drop_vars("time"), CHAIN), "no coordinate time"),
        (lambda: detect_waveforms(make().drop_vars("pixel"), CHAIN), "no coordinate pixel"),
        (lambda: detect_waveforms(without(make(bins=1), attribute="bin_width_ns"), CHAIN), "no attribute bin_width_ns"),
        (lambda: detect_waveforms(changed(np.nan), CHAIN), "waveform has 1 values that are not finite"),
        (lambda: detect_waveforms(changed(-1e-9), CHAIN), "waveform holds -1e-09 W"),
        (lambda: detect_waveforms(make(), CHAIN, shots=0), "shots = 0"),
        (lambda: detect_waveforms(make(), CHAIN, seed=-1), "seed = -1"),
        (lambda: detect_waveforms(make(), CHAIN, background_power=-1.0), "background = -1 must not be negative"),
        (lambda: detect_waveforms(make(), CHAIN, background_power=[1e-9, 1e-9]), r"shape \(2,\); .* \(4,\)"),
        (lambda: detect_waveforms(make(), CHAIN, background_power="sun"), "background_power = 'sun'"),
        (
            lambda: detect_waveforms(make(), CHAIN, background_power=xr.DataArray([1.0], dims="gate")),
            r"background_power has the dimensions \('gate',\)",
        ),
        (lambda: detect_waveforms(make(), ReceiverChain(SinglePhotonDetector(0.5, 0.1))), "dead_time_ns = 0.1"),
        (
            lambda: detect_waveforms(
                make(), ReceiverChain(CHAIN.detector, CHAIN.amplifier, None, Digitiser(8, 1.0, 0.0, 0.8))
            ),
            "sampling_ghz = 0.8",
        ),
    ],
)
def test_invalid_input(call, message):
    with pytest.raises(UserError, match=message):
        call()
