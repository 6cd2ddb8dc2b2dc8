"""Records of the pulses of a flight: automatic settings of the receiver."""

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.flights.plan import FlightPlan
from mitransient_lidar.flights.recording import chosen_settings, record, saturated_pulses

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
