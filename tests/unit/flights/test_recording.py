"""Records of the pulses of a flight: automatic settings of the receiver, and errors of renders."""

import numpy as np
import significance
import xarray as xr
from scipy.stats import t
from significance import largest_count

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.recording import chosen_settings, pooled_errors, record, saturated_pulses

FLIGHT = {"scene": "flight", "platform": {}, "scanner": {}, "pulses": {"rate_hz": 100}}


def rendered(instrument, pixels, *peaks):
    """Return echoes of these peak powers [W], one a pulse, in all pixels, of which the second has a third."""
    time = np.arange(80) + 0.5
    share = np.where(np.arange(len(pixels)) == 1, 1 / 3, 1.0)[:, None]
    power = np.array(peaks)[:, None, None] * share * np.exp(-0.5 * ((time - 30) / 2.2) ** 2)
    return xr.Dataset(
        {"waveform": (("shot", "pixel", "time"), power, {"units": "W"})},
        {"pixel": pixels, "time": ("time", time, {"units": "ns"}), "shot": np.arange(len(peaks))},
        {"time_start_ns": 0.0, "bin_width_ns": 1.0, "instrument": instrument},
    )


def test_all_pulses_have_the_gain_of_the_pilots():
    plan, pixels = FlightPlan.of_file(FLIGHT), ["red", "green"]
    bright, dim = (rendered("published_airborne", pixels, *peaks) for peaks in ((1e-4, 3e-5), (2e-5, 1e-5)))
    settings = chosen_settings(xr.concat([dim, bright], "shot"), plan)
    gain = detect_waveforms(bright).attrs["gain"]
    assert settings == {"receiver_gain_0": gain, "receiver_density_0": 0.0}
    assert 0 < gain < 0.5 * detect_waveforms(dim).attrs["gain"]
    inputs = {"pulse": np.array([3, 4]), **{name: np.full(2, value) for name, value in settings.items()}}
    recorded = [record(series, plan, inputs) for series in (bright, dim)]
    assert [one.attrs["gain"] for one in recorded] == [gain, gain]
    assert not recorded[0]["saturated"].any()
    # Amplitudes of two batches are those of their light.
    high, low = (one["signal_mean"].max("time").values for one in recorded)
    np.testing.assert_allclose(low[0] / high[0], 0.2, rtol=0.02)
    # A pulse brighter than all pilots saturates.
    assert record(rendered("published_airborne", pixels, 3e-4), plan, inputs)["saturated"].any()


def test_pulses_that_saturate_are_counted():
    """Three pulses of the peak power that just fits a gain, a third more, and a third less, in one of two pixels."""
    pixels = ["red", "green"]
    fits = detect_waveforms(rendered("", pixels, 1e-4), "apd", gain="auto").attrs["gain"]
    pilots = rendered("", pixels, 1e-4, 1.5e-4, 0.7e-4)
    for gain, count in ((0.9 * fits, 1), (2 * fits, 3), ("auto", 0)):
        plan = FlightPlan.of_file({**FLIGHT, "receiver": {"chain": "apd", "gain": gain}})
        settings = chosen_settings(pilots, plan)
        assert bool(settings) == (gain == "auto")
        assert saturated_pulses(pilots, plan, settings) == count


def test_the_brightest_twentieth_of_the_pilots_saturates_without_effect_on_the_gain():
    """Of 40 pulses two may saturate: however bright they are, and in whichever pixel, the third one has the range."""
    plan, pixels = FlightPlan.of_file({**FLIGHT, "receiver": {"chain": "apd", "gain": "auto"}}), ["red", "green"]
    peaks = np.geomspace(1e-5, 1e-4, 38)
    for glints in ((1.5e-4, 2e-4), (1e-2, 1e-1)):
        pilots = rendered("", pixels, *glints, *peaks)
        settings = chosen_settings(pilots, plan)
        assert settings["receiver_gain_0"] == chosen_settings(rendered("", pixels, 1e-4), plan)["receiver_gain_0"]
        assert saturated_pulses(pilots, plan, settings) == 2
    assert detect_waveforms(pilots, "apd", gain="auto").attrs["saturating_share"] == 0.05
    # Fewer than twenty pulses have none to spare.
    few = rendered("", pixels, *glints)
    assert saturated_pulses(few, plan, chosen_settings(few, plan)) == 0


def test_each_channel_has_its_own_gain():
    """The deep pixel has a third of the light, and about three times the gain."""
    plan, pixels = FlightPlan.of_file(FLIGHT), ["shallow_0", "deep"]
    series = rendered("teledyne_czmil", pixels, 1e-2)
    settings = chosen_settings(series, plan)
    assert settings.keys() == {f"receiver_{name}_{number}" for name in ("gain", "density") for number in (0, 1)}
    inputs = {"pulse": np.array([0]), **{name: np.array([value]) for name, value in settings.items()}}
    assert record(series, plan, inputs).attrs["gain"] == detect_waveforms(series).attrs["gain"]
    assert settings["receiver_gain_1"] > 1.5 * settings["receiver_gain_0"]


def test_pooled_errors_are_those_of_counted_paths():
    """An echo over a dim column and its tail, as means of 8 passes with Poisson numbers of paths of equal weights."""
    rng = np.random.default_rng(5 + significance.seed_shift)
    time = np.arange(120)
    paths = 4 + 400 * np.exp(-0.5 * ((time - 60) / 4) ** 2)
    passes = rng.poisson(paths, (8, 400, 2, 120)) / paths.max()
    waveform, stderr = (
        xr.DataArray(values, dims=("shot", "pixel", "time"))
        for values in (passes.mean(axis=0), passes.std(axis=0, ddof=1) / np.sqrt(8))
    )
    found = pooled_errors(waveform, stderr, np.full(400, 8)).values
    true = np.sqrt(paths / 8) / paths.max()
    ratio = np.sqrt(np.mean(((waveform.values - paths / paths.max()) / found) ** 2, axis=(0, 1)))
    assert np.all((ratio[20:100] > 0.75) & (ratio[20:100] < 1.02))
    assert found[..., 60].mean() < 1.25 * true[60]


def test_pooled_errors_keep_noise_of_few_passes_from_being_echoes():
    """Means of 6 passes about a column: 5 of their own standard errors are exceeded by one bin in 240 (Student's t)."""
    rng = np.random.default_rng(4 + significance.seed_shift)
    column = np.exp(-0.05 * np.arange(120))
    passes = column * (1 + 0.3 * rng.standard_normal((6, 500, 2, 120)))
    waveform, stderr = (
        xr.DataArray(values, dims=("shot", "pixel", "time"))
        for values in (passes.mean(axis=0), passes.std(axis=0, ddof=1) / np.sqrt(6))
    )
    found = pooled_errors(waveform, stderr, np.full(500, 6))
    assert np.all(found >= stderr)
    off = np.abs(waveform - column)
    bins = off.size
    assert np.count_nonzero(off > 5 * stderr) > 0.5 * bins * 2 * t.sf(5, 5)
    assert np.count_nonzero(off > 5 * found) <= largest_count(bins, 2 * t.sf(5, 20))
    # They are true ones on average, but for what the larger of two errors adds.
    assert 1.0 < float(np.sqrt(np.mean((found / column) ** 2))) / (0.3 / np.sqrt(6)) < 1.25


def test_errors_of_two_passes_hide_no_echo():
    """Passes whose echoes differ by 8 %: own errors of two of them are over twice the true ones in one shot of 20."""
    rng = np.random.default_rng(6 + significance.seed_shift)
    echo = 0.1 + np.exp(-0.5 * ((np.arange(120) - 60) / 3) ** 2)
    passes = echo * (1 + 0.08 * rng.standard_normal((2, 256, 1, 1)))
    waveform, stderr = (
        xr.DataArray(values, dims=("shot", "pixel", "time"))
        for values in (passes.mean(axis=0), passes.std(axis=0, ddof=1) / np.sqrt(2))
    )
    found = pooled_errors(waveform, stderr, np.full(256, 2)).values[..., 60] / echo[60]
    true = 0.08 / np.sqrt(2)
    assert np.mean(stderr.values[..., 60] > 2 * true * echo[60]) > 0.02
    assert np.all((found > 0.75 * true) & (found < 1.5 * true))
    # A shot of more passes has errors of its own beside them.
    mixed = pooled_errors(waveform, stderr, np.where(np.arange(256) == 3, 8, 2))
    assert np.all(mixed.values[3] >= stderr.values[3])
