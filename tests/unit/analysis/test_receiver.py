"""Recorded shots of a result: labels, values, provenance and invalid input."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from rows import must_refuse, refuses
from significance import largest_z
from small_results import made

from mitransient_lidar import results
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.recorded import describe_recording
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS, Channel, ReceiverChannels
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter
from mitransient_lidar.results import save

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
    names, centres = ["red", "green", "blue", "black"][:pixels], np.arange(2 * pixels).reshape(-1, 2)
    about = {"scene": "fig09", "layout": "2x2", "surface_time_ns": 1407.0, **attributes}
    return made(wave, names=names, centres=centres, grid=grid, **about)


def test_shots_of_pixels():
    dataset = make()
    shots = detect_waveforms(dataset, CHAIN, shots=400, seed=3)
    again, other = (detect_waveforms(dataset, CHAIN, shots=400, seed=seed)["signal"] for seed in (3, 2))
    assert shots["signal"].equals(again)
    assert not shots["signal"].equals(other)
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
    assert np.max(np.abs(spread.values - 1)) < largest_z(400, 160) * np.sqrt(1 / 800)
    z = (shots["signal"].mean("shot") - shots["signal_mean"]) / shots["signal_deviation"] * 20
    assert np.max(np.abs(z.values)) < largest_z(400, 160)
    assert not shots["saturated"].any()
    found = (shots["signal_mean"] - shots["signal_mean"][:, 0]) / shots["signal_deviation"]
    np.testing.assert_allclose(shots["snr"], found, atol=0.01)


def test_provenance():
    shots = detect_waveforms(make(), CHAIN, shots=2, seed=9, background_power=1e-9)
    attributes = shots.attrs
    wanted = {"scene": "fig09", "surface_time_ns": 1407.0, "noise_seed": 9, "shots": 2, "background_power_w": 1e-9}
    wanted |= {"receiver.detector": "LinearDetector", "receiver.detector.gain": 50.0, "receiver.source": "made up"}
    wanted |= {"receiver.amplifier.bandwidth_mhz": 200.0, "receiver.digitiser.bits": 12}
    assert wanted.items() <= attributes.items()
    assert all(isinstance(value, (int, float, str, list)) for value in attributes.values())
    named = detect_waveforms(make(), "spad", shots=1)
    assert named.attrs["receiver"] == "spad"
    assert named.attrs["receiver.detector.paralyzable"] == 0
    assert named["signal"].attrs["units"] == "1"
    assert set(np.unique(named["signal"])) <= {0.0, 1.0}


def test_shots_of_an_imager():
    shots = detect_waveforms(make(grid=(2, 2)), CHAIN, shots=5, background_power=np.array([[0, 0], [0, 1e-7]]))
    assert shots["signal"].dims == ("shot", "row", "column", "time")
    assert shots["signal"].shape == (5, 2, 2, 40)
    dark = shots["signal_mean"].isel(time=0).values.ravel()
    assert dark[3] > 10 * np.max(np.abs(dark[:3]))
    assert shots.attrs["background_power_w"] == [0, 0, 0, 1e-7]
    light = xr.DataArray([1e-7, 0.0], dims="column", coords={"column": [0, 1]})
    labelled = detect_waveforms(make(grid=(2, 2)), CHAIN, background_power=light)
    assert labelled.attrs["background_power_w"] == [1e-7, 0, 1e-7, 0]


def test_sampling_rate_thins_the_time():
    chain = ReceiverChain(CHAIN.detector, CHAIN.amplifier, digitiser=Digitiser(12, 1.0, -0.1, sampling_ghz=0.5))
    shots = detect_waveforms(make(), chain, shots=2)
    np.testing.assert_allclose(shots["time"], 1400.25 + 2.0 * np.arange(10))
    # The edges of the samples: so that time_start_ns + (i + 1/2) bin_width_ns is the time.
    assert (shots.attrs["time_start_ns"], shots.attrs["bin_width_ns"]) == (1399.25, 2.0)


def test_warning_of_smoothing_twice(caplog):
    with caplog.at_level(logging.WARNING):
        detect_waveforms(make(response_time_ns=0.0), CHAIN)
        detect_waveforms(make(response_time_ns=2.0), RECEIVERS["ideal"])
        assert not caplog.records
        detect_waveforms(make(response_time_ns=2.0), CHAIN)
    assert "response time already" in caplog.text


def series(*scales):
    """Return shots of the result at several strengths, with a truth of each."""
    shots = xr.concat([make() * scale for scale in scales], "shot").assign_attrs(make().attrs)
    return shots.assign_coords(shot=np.arange(len(scales)) + 3, true_slope_along=("shot", 0.1 * np.array(scales)))


def test_errors_of_a_render_are_those_of_the_mean_signal():
    """Behind a linear chain, an error of 30 % of the light is 30 % of the mean signal."""
    dataset = make()
    dataset["waveform_stderr"] = 0.3 * dataset["waveform"]
    shots = detect_waveforms(dataset, CHAIN, seed=3)
    dark = detect_waveforms((0 * dataset).assign_attrs(dataset.attrs), CHAIN)["signal_mean"]
    np.testing.assert_allclose(shots["signal_mean_stderr"], 0.3 * (shots["signal_mean"] - dark), rtol=1e-6, atol=1e-12)
    assert "signal_mean_stderr" not in detect_waveforms(dataset.drop_vars("waveform_stderr"), CHAIN)


@pytest.mark.parametrize("repeats", [1, 2])
def test_peaks_within_the_error_of_a_render_are_no_echoes(repeats):
    """A render whose single paths make a peak behind the bottom: all records of the shot show it."""
    time = np.arange(300)
    wave = np.exp(-0.5 * ((time - 60) / 4) ** 2) + 0.5 * np.exp(-0.5 * ((time - 160) / 4) ** 2)
    peak = 0.05 * np.exp(-0.5 * ((time - 240) / 4) ** 2)
    about = {"scene": "made up", "layout": "1x1", "altitude": 0.5e-9 * 299792458 * 1430, "off_nadir_deg": 0.0}
    about |= {"refractive_index": 1.34, "group_index": 1.36, "surface_time_ns": 1430.0, "pulse_fwhm_ns": 4.7}
    one = made(1e-6 * (wave + peak)[None], 1e-6 * peak[None], names=["single"], **about)
    dataset = one
    if repeats > 1:
        dataset = xr.concat([one] * repeats, "shot").assign_attrs(one.attrs).assign_coords(shot=np.arange(repeats))
    shots = detect_waveforms(dataset, CHAIN, shots=30 // repeats, seed=1)
    bottom = echo_table.extract(shots).sel(echo="bottom")["time_ns"]
    assert np.all(np.abs(bottom - bottom.median()) < 1)
    assert float(bottom.median()) == pytest.approx(1480, abs=2)
    behind = echo_table.extract(shots.drop_vars("signal_mean_stderr")).sel(echo="bottom")["time_ns"]
    assert float(behind.median()) == pytest.approx(1520, abs=2)


def test_every_shot_of_a_series_is_recorded():
    shots = detect_waveforms(series(1.0, 0.5, 0.2), CHAIN, seed=3, background_power=[0, 0, 0, 1e-7])
    assert shots["signal"].dims == shots["signal_mean"].dims == ("shot", "pixel", "time")
    np.testing.assert_array_equal(shots["shot"], [3, 4, 5])
    np.testing.assert_allclose(shots["true_slope_along"], [0.1, 0.05, 0.02])
    alone = detect_waveforms(make() * 0.5, CHAIN, background_power=[0, 0, 0, 1e-7])["signal_mean"]
    np.testing.assert_allclose(shots["signal_mean"][1], alone)
    z = (shots["signal"] - shots["signal_mean"]) / shots["signal_deviation"]
    assert np.abs(z.values).max() < largest_z(10**6, z.size)


def test_trigger_and_energy_of_channels_with_own_receivers():
    """Channels that are drawn one by one share energy and trigger of a shot; the clocks are their own."""
    bright = (1e7 * make(bins=60)).assign_attrs(make(bins=60).attrs)
    chain = ReceiverChain(LinearDetector(1.0), jitter=ShotJitter(energy_rms=0.1, trigger_ns=0.3))
    other = replace(chain, detector=LinearDetector(0.5))
    both = ReceiverChannels(Channel(chain), {"green": Channel(other)})
    shots = detect_waveforms(bright, both, shots=300, seed=5)
    assert shots.attrs["receiver.jitter.trigger_ns"] == 0.3
    energy = shots["signal"].sum("time")
    time = (shots["signal"] * shots["time"]).sum("time") / energy
    energy, time = energy / energy.mean("shot"), time - time.mean("shot")
    # 1e10 photons and more: shot noise of 1e-5 and of 0.02 ps.
    for values, spread in ((energy, 0.1), (time, 0.3)):
        assert float(np.abs(values - values.isel(pixel=0)).max()) < 2e-3
        assert abs(float(values.isel(pixel=0).std()) / spread - 1) < largest_z(300) / np.sqrt(600)
    clocks = replace(chain, jitter=ShotJitter(clock_ns=0.3))
    both = ReceiverChannels(Channel(clocks), {"green": Channel(replace(other, jitter=clocks.jitter))})
    shots = detect_waveforms(bright, both, shots=300, seed=5)
    time = (shots["signal"] * shots["time"]).sum("time") / shots["signal"].sum("time")
    assert np.max(np.abs(np.corrcoef(time.T) - np.eye(4))) < largest_z(300, 6) / np.sqrt(300)
    with pytest.raises(UserError, match="jitter of channel 'green' must be that of all channels"):
        ReceiverChannels(Channel(clocks), {"green": Channel(other)})


def test_tails_are_in_the_records_of_every_channel():
    dataset = make(bins=200)
    plain = ReceiverChain(LinearDetector(1.0))
    tailed = replace(plain, detector=LinearDetector(1.0, tail_fractions=(0.1,), tail_decays_ns=(50.0,)))
    shots = detect_waveforms(dataset, ReceiverChannels(Channel(plain), {"black": Channel(tailed)}), shots=2)
    behind = shots["signal_mean"].isel(time=slice(60, None))
    # 14 times the width of the echo behind it; 0.1 exp(-t / 50 ns) of its charge is still to come.
    np.testing.assert_allclose(behind.isel(pixel=slice(0, 3)), 0, atol=1e-9)
    charge = float(shots["signal_mean"].sel(pixel="green").sum())
    later = 0.1 * 2 * charge * np.exp(-(60 - 0.5 - 15) * 0.5 / 50)
    reach = 1 - np.exp(-140 * 0.5 / 50)
    assert float(behind.sel(pixel="black").sum()) == pytest.approx(later * reach, rel=1e-3)
    assert shots.attrs["receiver.channels.black.detector.tail_fractions"] == [0.1]


def test_records_of_a_shot_of_a_series_follow_each_other():
    shots = detect_waveforms(series(1.0, 0.2), CHAIN, shots=200, seed=3)
    assert shots.sizes["shot"] == 400
    np.testing.assert_array_equal(shots["shot"], np.arange(400))
    np.testing.assert_allclose(shots["true_slope_along"], np.repeat([0.1, 0.02], 200))
    z = (shots["signal"] - shots["signal_mean"]) / shots["signal_deviation"]
    means = np.sqrt(200) * z.values.reshape(2, 200, -1).mean(axis=1)
    assert np.abs(means).max() < largest_z(200, means.size)
    # Noise of each record is its own.
    assert np.abs(np.corrcoef(z.values.reshape(400, -1))[np.triu_indices(400, 1)]).max() < 0.6


@pytest.mark.parametrize("scale", [1.0, 60.0])
def test_shares_of_saturation_are_the_expected_ones(scale):
    """The brightest pixel of the stronger light peaks at 3 V, above the range of 0.9 V, the weakest at 0.8 V."""
    shots = detect_waveforms(make() * scale, CHAIN, shots=500, seed=5)
    expected = shots["saturation"]
    count = 500 * expected.sizes["time"]
    error = np.sqrt((expected * (1 - expected)).mean("time") / count)
    difference = shots["saturated_samples"] - expected.mean("time")
    assert np.all(np.abs(difference) <= largest_z(10**6, 4) * error + 1e-9)
    np.testing.assert_allclose(shots["saturated_shots"], shots["saturated"].any("time").mean("shot"))
    lines = describe_recording(shots)
    if scale == 1.0:
        assert lines[1:] == ["no sample is saturated"]
    else:
        assert shots["saturated_samples"][0] < 0.01 < 0.2 < shots["saturated_samples"][3]
        assert lines[1].startswith("100 % of the shots have saturated samples: a filter of optical density ")
        assert lines[5].startswith("saturated in black: 100 % of the shots, ")


def top_reached(shots):
    """Return the highest mean with 6 standard deviations, over the top of the range of 0.9 V less a step."""
    return float((shots["signal_mean"] + 6 * shots["signal_deviation"]).max()) / (0.9 - 1 / 4096)


def test_automatic_filter_is_the_least_without_saturation(caplog):
    strong = make() * 30
    chosen = detect_waveforms(strong, CHAIN, optical_density="auto")
    density = chosen.attrs["optical_density"]
    assert (chosen.attrs["chosen"], chosen.attrs["gain"]) == ("optical_density", 1.0)
    assert 10 * density == pytest.approx(round(10 * density))
    assert not caplog.records
    # Rounding of the digitiser adds to the deviation.
    assert top_reached(chosen) < 1.001
    less = detect_waveforms(strong, CHAIN, optical_density=density - 0.1)
    assert top_reached(less) > 1
    assert less.attrs["fitting_optical_density"] == density
    plain = detect_waveforms(strong, CHAIN)
    assert f"a filter of optical density {density:.1f} (factor {10**density:.3g})" in caplog.text
    assert plain.attrs["fitting_optical_density"] == density
    assert describe_recording(chosen)[0] == f"1 shot, receiver custom, gain 1, optical density {density:.4g} (auto)"


def test_automatic_gain_is_the_largest_without_saturation():
    strong = series(30.0, 1.0)
    chosen = detect_waveforms(strong, CHAIN, gain="auto")
    gain = chosen.attrs["gain"]
    assert top_reached(chosen) == pytest.approx(1, abs=1e-3)
    assert chosen.attrs["receiver.amplifier.transimpedance_ohm"] == pytest.approx(1e4 * gain)
    assert detect_waveforms(strong, CHAIN).attrs["fitting_gain"] == gain
    assert detect_waveforms(strong, CHAIN, gain=gain).equals(chosen)
    assert detect_waveforms(make(), CHAIN, gain="auto").attrs["gain"] == 1
    # The filter needs as much again for a lower gain, and the gain none behind the filter.
    behind = detect_waveforms(strong, CHAIN, gain=gain, optical_density=1.0)
    assert (behind.attrs["fitting_gain"] > gain, behind.attrs["fitting_optical_density"]) == (True, 0.0)


def test_records_without_advice_are_the_same():
    strong = make()
    strong["waveform"] *= 1e3
    with_advice, without = (detect_waveforms(strong, CHAIN, seed=2, gain=0.5, advice=one) for one in (True, False))
    xr.testing.assert_equal(without, with_advice)
    told = {name for name in with_advice.attrs if name not in without.attrs}
    assert told == {"fitting_gain", "fitting_optical_density", "saturating_share"}
    chosen = [detect_waveforms(strong, CHAIN, seed=2, gain="auto", advice=one) for one in (True, False)]
    xr.testing.assert_equal(*chosen)
    assert chosen[0].attrs["gain"] == chosen[1].attrs["gain"] == chosen[1].attrs["fitting_gain"] < 1


def test_filter_attenuates_signal_and_background():
    plain = detect_waveforms(make(), CHAIN, background_power=1e-8)
    dimmed = detect_waveforms(make() * 10, CHAIN, background_power=1e-7, optical_density=1.0)
    np.testing.assert_allclose(dimmed["signal_mean"], plain["signal_mean"])
    advice = [
        detect_waveforms(make() * 30 * by, CHAIN, background_power=by * 5e-6, optical_density=np.log10(by))
        for by in (1, 10)
    ]
    assert advice[0].attrs["fitting_gain"] == pytest.approx(advice[1].attrs["fitting_gain"], rel=1e-6)
    assert advice[0].attrs["fitting_gain"] < 1


def without(dataset, *, attribute):
    dataset.attrs.pop(attribute)
    return dataset


def changed(value):
    dataset = make()
    dataset["waveform"].values[1, 2] = value
    return dataset


@refuses(
    (lambda: detect_waveforms(make().drop_vars("waveform"), CHAIN), "another dataset, but must have waveforms"),
    (lambda: detect_waveforms(make().transpose("time", "pixel"), CHAIN), r"dimensions \('time', 'pixel'\)"),
    (lambda: detect_waveforms(make().drop_vars("time"), CHAIN), "no coordinate time"),
    (lambda: detect_waveforms(make().drop_vars("pixel"), CHAIN), "no coordinate pixel"),
    (lambda: detect_waveforms(without(make(bins=1), attribute="bin_width_ns"), CHAIN), "no attribute bin_width_ns"),
    (lambda: detect_waveforms(changed(np.nan), CHAIN), "waveform has 1 values that are not finite"),
    (lambda: detect_waveforms(changed(-1e-9), CHAIN), "waveform holds -1e-09 W"),
    (lambda: detect_waveforms(make(), ReceiverChain(SinglePhotonDetector(0.5, 0.1))), "dead_time_ns = 0.1"),
    *(
        (lambda chain=chain, options=options: detect_waveforms(make(), chain, **options), message)
        for chain, options, message in (
            (CHAIN, {"gain": "auto", "optical_density": "auto"}, "are alternatives"),
            ("ideal", {"gain": "auto"}, "gain = 'auto' needs a receiver with an amplifier"),
            ("spad", {"optical_density": "auto"}, "optical_density = 'auto' needs a receiver"),
            ("spad", {"gain": 2}, "gain = 2 needs an amplifier"),
            (CHAIN, {"gain": "most"}, "gain = 'most' must be a number"),
            (CHAIN.with_gain(1e6), {"optical_density": "auto"}, "optical_density = 'auto' finds no filter"),
            (CHAIN, {"background_power": -1.0}, "background_power = -1 must not be negative"),
            (CHAIN, {"background_power": [1e-9, 1e-9]}, r"shape \(2,\); .* \(4,\)"),
            (CHAIN, {"background_power": "sun"}, "background_power = 'sun'"),
            (CHAIN, {"background_power": xr.DataArray([1.0], dims="gate")}, r"has the dimensions \('gate',\)"),
            (replace(CHAIN, digitiser=Digitiser(8, 1.0, 0.0, 0.8)), {}, "sampling_ghz = 0.8"),
        )
    ),
)
def test_invalid_input(call):
    call()


def two_channels(**of_blue):
    own = Channel(CHAIN, 0.5)
    return ReceiverChannels(own, {"blue": Channel(CHAIN, **of_blue)}, pulse_repetition_khz=10.0, name="two")


def test_file_with_a_channel_of_no_pixel_is_refused(tmp_path):
    own = tmp_path / "own.toml"
    own.write_text('preset = "apd"\n[channels.deep]\ngain = 2\n')
    with pytest.raises(UserError, match=r"own.toml: channels.deep is for no pixel: the result has the pixels red, "):
        detect_waveforms(make(), str(own))
    own.write_text('preset = "apd"\n[channels.red]\ngain = 2\n')
    assert "receiver.channels.red.amplifier.transimpedance_ohm" in detect_waveforms(make(), str(own)).attrs


def test_channels_have_their_own_gain_and_filter():
    recorded = detect_waveforms(make(), two_channels(gain=1.0, optical_density=1.0), shots=3, seed=4)
    assert recorded["pixel"].values.tolist() == ["red", "green", "blue", "black"]
    wanted = {"gain": [0.5, 0.5, 1.0, 0.5], "optical_density": [0.0, 0.0, 1.0, 0.0], "receiver.detector.gain": 50.0}
    wanted |= {f"receiver.channels.{name}.amplifier.transimpedance_ohm": v for name, v in (("blue", 1e4), ("red", 5e3))}
    wanted |= {"receiver": "two", "pulse_repetition_khz": 10.0}
    assert {name: recorded.attrs[name] for name in wanted} == wanted
    whole = detect_waveforms(make(), CHAIN)
    dark = whole["signal_mean"].min("time")
    above = (recorded["signal_mean"] - dark).sum("time") / (whole["signal_mean"] - dark).sum("time")
    np.testing.assert_allclose(above, [0.5, 0.5, 0.1, 0.5], rtol=0.02)
    # The same light and noise as without channels, but for the gain.
    assert "gain 0.5 to 1, optical density 0 to 1" in describe_recording(recorded)[0]


def test_a_channel_that_is_named_has_an_automatic_gain_of_its_own():
    strong = make().assign(waveform=make()["waveform"] * 300)
    both = detect_waveforms(strong, ReceiverChannels(Channel(CHAIN, "auto")))
    apart = detect_waveforms(strong, ReceiverChannels(Channel(CHAIN, "auto"), {"red": Channel(CHAIN, "auto")}))
    assert not apart["saturated"].any()
    assert apart.attrs["gain"][0] > 2 * both.attrs["gain"]
    assert apart.attrs["gain"][1:] == [both.attrs["gain"]] * 3


def test_the_receiver_of_the_instrument_is_the_default():
    own = detect_waveforms(make(instrument="riegl_vq840g"))
    assert own.attrs["receiver"] == "riegl_vq840g"
    assert own.attrs["receiver.amplifier.bandwidth_mhz"] == 300
    assert detect_waveforms(make()).attrs["receiver"] == "apd"
    must_refuse(r"chain = 'eye' must be one of ideal, .*apd", detect_waveforms, make(), "eye")


def test_a_record_behind_a_measured_response_is_written(tmp_path):
    times = np.linspace(-1, 8, 60)
    response = (tuple(times.tolist()), tuple(np.exp(-0.5 * (times - 2) ** 2).tolist()))
    chain = ReceiverChain(CHAIN.detector, Amplifier(1e4, 3.0, impulse_response=response))
    recorded = detect_waveforms(make(instrument="of my own"), chain)
    assert recorded.attrs["receiver.amplifier.impulse_response"] == "60 samples, -1 to 8 ns"
    assert float((recorded["receiver_response"] * recorded["lag"]).sum()) == pytest.approx(2, abs=0.05)
    save(recorded, tmp_path / "measured.nc")
    assert results.open(tmp_path / "measured.nc")["lag"].size == recorded["lag"].size
    # An instrument without a receiver has the usual one.
    assert detect_waveforms(make(instrument="of my own")).attrs["receiver"] == "apd"


def test_codes_in_a_file_are_volts_by_their_attributes(tmp_path):
    recorded = detect_waveforms(make(), CHAIN, shots=5)
    path = tmp_path / "codes.nc"
    save(recorded, path)
    with xr.open_dataset(path, engine="h5netcdf", mask_and_scale=False) as raw:
        codes = raw["signal"]
        assert codes.dtype == np.uint16
        assert codes.values.max() < 4096
        volts = codes.values * codes.attrs["scale_factor"] + codes.attrs["add_offset"]
    np.testing.assert_allclose(volts, recorded["signal"].values, atol=1e-6)
    np.testing.assert_allclose(results.open(path)["signal"].values, recorded["signal"].values, atol=1e-6)
    # A mean over shots is not of codes.
    save(recorded.assign(signal=recorded["signal"].mean("shot", keep_attrs=True)), path)
    np.testing.assert_array_equal(results.open(path)["signal"], recorded["signal"].mean("shot"))


def test_blocks_above_a_threshold_are_stored(tmp_path):
    """Two samples before and four after each one above 20 mV are those of the whole record, the others are missing."""
    blocks = replace(CHAIN, digitiser=replace(CHAIN.digitiser, block_threshold_v=0.02, block_before=2, block_after=4))
    light = {"shots": 30, "seed": 3, "background_power": 2e-8}
    whole, recorded = (detect_waveforms(make(), chain, **light) for chain in (CHAIN, blocks))
    dark = whole["signal_mean"].isel(time=slice(0, 3)).mean("time").values
    np.testing.assert_allclose(recorded["dark_level"], dark, atol=1e-4)
    for shot, pixel in np.ndindex(30, 4):
        samples = whole["signal"].values[shot, pixel]
        wanted = np.full(samples.size, np.nan)
        for place in np.flatnonzero(samples > recorded["block_level"].values[pixel]):
            own = slice(max(place - 2, 0), place + 5)
            wanted[own] = samples[own]
        np.testing.assert_array_equal(recorded["signal"].values[shot, pixel], wanted)
    stored = recorded["signal"].notnull()
    assert 0.2 < float(stored.mean()) < 0.8
    assert not recorded["saturated"].where(~stored, False).any()
    assert "of the samples are stored in blocks" in "\n".join(describe_recording(recorded))
    save(recorded, tmp_path / "blocks.nc")
    np.testing.assert_allclose(results.open(tmp_path / "blocks.nc")["signal"], recorded["signal"], atol=1e-6)
