"""Receivers from TOML files: channels, measured responses, and refusals."""

import math
from pathlib import Path

import numpy as np
import pytest
from rows import each_row, must_refuse, refuses
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.catalogue import instrument_names, read_instrument
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS, instrument_receiver, parse_receiver, receiver
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter

WHOLE = """
wavelength_nm = 515
pulse_repetition_khz = 35
gain = "auto"
[detector]
type = "photomultiplier"
quantum_efficiency = 0.2
dynode_gains = [5, 4, 4]
[amplifier]
transimpedance_ohm = 500
bandwidth_mhz = 250
[digitiser]
bits = 12
full_scale_v = 2
[channels.deep]
optical_density = 0.5
gain = 1
[channels.deep.detector]
type = "avalanche_photodiode"
quantum_efficiency = 0.6
gain = 100
ionisation_ratio = 0.02
"""


def parse(text):
    return parse_receiver(text, "own.toml", Path())


def test_every_key_reaches_its_stage():
    own = parse(WHOLE)
    assert own.pulse_repetition_khz == 35
    chain = own.of("shallow").chain
    assert chain.detector == LinearDetector.photomultiplier(0.2, (5, 4, 4))
    assert (chain.amplifier.transimpedance_ohm, chain.amplifier.bandwidth_mhz, chain.wavelength_nm) == (500, 250, 515)
    assert (chain.digitiser.bits, chain.digitiser.full_scale_v) == (12, 2)
    deep = own.of("deep")
    assert deep.chain.detector == LinearDetector.avalanche(0.6, 100, 0.02)
    assert deep.chain.amplifier == chain.amplifier
    assert (own.of("shallow").gain, own.of("shallow").optical_density) == ("auto", 0.0)
    assert (deep.gain, deep.optical_density) == (1, 0.5)


def test_a_preset_keeps_what_a_file_leaves_out():
    own = parse('preset = "apd"\n[amplifier]\nbandwidth_mhz = 100\n').default.chain
    preset = RECEIVERS["apd"]
    assert own.detector == preset.detector
    assert own.digitiser == preset.digitiser
    assert own.amplifier == Amplifier(10e3, noise_pa_per_rthz=3.0, bandwidth_mhz=100)


def test_dynodes_of_a_preset_are_replaced_with_gain_and_excess_noise():
    tube = RECEIVERS["pmt"].detector
    own = parse('preset = "pmt"\n[detector]\ndynode_gains = [5, 4, 4]\n').default.chain.detector
    assert (own.gain, own.dynode_gains) == (80, (5, 4, 4))
    assert own.excess_noise == LinearDetector.photomultiplier(0.2, (5, 4, 4)).excess_noise
    assert own == tube.with_dynodes((5, 4, 4))
    with pytest.raises(UserError, match="detector: gain = 80 follows from dynode_gains: give these"):
        parse('preset = "pmt"\n[detector]\ngain = 80\n')


def test_tails_jitter_and_overload_from_a_file():
    text = WHOLE.replace(
        "dynode_gains = [5, 4, 4]",
        "dynode_gains = [5, 4, 4]\ntail_fractions = [0.05, 0.01]\ntail_decays_ns = [100, 800]",
    )
    text = text.replace(
        "bandwidth_mhz = 250", "bandwidth_mhz = 250\ncoupling_ns = 2000\nlimit_v = 1.5\nrecovery_ns = 20"
    )
    own = parse(text + "[jitter]\nenergy_rms = 0.02\ntrigger_ns = 0.1\nclock_ns = 0.05\n")
    chain = own.default.chain
    assert (chain.detector.tail_fractions, chain.detector.tail_decays_ns) == ((0.05, 0.01), (100, 800))
    assert (chain.amplifier.coupling_ns, chain.amplifier.recovery_ns) == (2000, 20)
    assert chain.jitter == own.of("deep").chain.jitter == ShotJitter(0.02, 0.1, 0.05)
    # The tail is that of the tube, not of the diode of the deep channel.
    assert own.of("deep").chain.detector.tail_fractions == ()
    counter = 'preset = "spad"\n[detector]\nafterpulse_probability = 0.03\nafterpulse_decay_ns = 40'
    assert parse(counter).default.chain.detector == SinglePhotonDetector(
        0.5, 30.0, 100.0, afterpulse_probability=0.03, afterpulse_decay_ns=40
    )


def test_settings_replace_those_of_all_channels():
    own = parse(WHOLE).with_settings(0.5, None)
    assert (own.default.gain, own.of("deep").gain, own.of("deep").optical_density) == (0.5, 0.5, 0.5)
    # One of both is chosen, not both.
    other = parse(WHOLE).with_settings(None, "auto")
    assert (other.default.gain, other.default.optical_density) == (1.0, "auto")


def test_infrared_light_has_photons_of_its_own(caplog):
    """Twice as many in a joule at 1064 nm as at 532 nm; one that is made for the infrared is as it is."""
    green = parse(WHOLE)
    assert green.for_light(532.0) is green
    assert green.for_light(1064.0).of("deep").chain.wavelength_nm == 1064
    assert [f"the quantum efficiency of receiver {green.name} is that at 515 nm" in one for one in caplog.messages] == [
        True
    ]
    infrared = receiver("riegl_vq880g2_infrared")
    assert infrared.for_light(1064.0) is infrared


def test_every_instrument_has_a_receiver_with_sources():
    """Each number has a source or is marked as assumed, as in the file of the optics."""
    for name in instrument_names():
        own = instrument_receiver(name)
        assert own is not None
        assert own.name == name
        assert set(own.channels) <= set(read_instrument(name).channels)
    assert instrument_receiver("../table1") is None
    assert isinstance(receiver("icesat2_atlas").default.chain.detector, SinglePhotonDetector)


def test_atlas_counts_after_the_surface_what_it_was_seen_to_count():
    """ATL03 photons over calm, deep water: 244 594 of the surface, and these by nanoseconds after their mean."""
    edges = np.array([3, 5, 8, 13, 18, 24, 32, 60, 100, 125, 150, 175, 200, 225, 250, 300, 420])
    seen = np.array([2753, 874, 555, 1469, 147, 703, 144, 137, 226, 255, 374, 377, 376, 266, 261, 142]) / 244594
    detector = receiver("icesat2_atlas").default.chain.detector
    part, weak = 0.125, 1e-3
    time = np.arange(-8, 500, part)
    pulse = np.exp(-0.5 * (time / (1.5 / 2.3548)) ** 2)
    events = detector.with_tail(weak * pulse / pulse.sum(), np.zeros(1), part)
    counts, _ = detector.moments(events, part, 1)
    # What comes at once belongs to the surface.
    surface = time < 2.5
    time = time - np.average(time[surface], weights=counts[surface])
    share = np.histogram(time, edges, weights=counts)[0] / counts[time < 2.5].sum()
    np.testing.assert_allclose(share, seen, rtol=0.07)


@each_row(
    ("gain = ", "not a TOML file"),
    ('preset = "tube"', "preset = 'tube' must be one of"),
    ("gain = 1", "neither a preset nor a detector"),
    ('preset = "apd"\ncolour = 3', "'colour' is no key of own.toml: allowed are"),
    ('preset = "apd"\n[amplifier]\nohms = 3', "'ohms' is no key of own.toml: amplifier"),
    ('preset = "apd"\n[detector]\ntype = "eye"', "detector.type = 'eye' must be one of"),
    ('[detector]\ntype = "photodiode"', "detector has no quantum_efficiency"),
    ('preset = "apd"\n[amplifier]\nbandwidth_mhz = -1', "amplifier: bandwidth_mhz = -1"),
    ('preset = "apd"\n[channels]\ndeep = 3', "channels.deep = 3 must be a table"),
    ('preset = "apd"\n[channels.deep]\npreset = "pmt"', "'preset' is no key of own.toml: channels.deep"),
    ('preset = "apd"\n[channels.deep.digitiser]\nbits = 8', "digitiser of channel 'deep' must be that of all"),
    ('preset = "apd"\n[channels.deep.amplifier]\nbandwidth_mhz = 8', "amplifier of channel 'deep' must have the resp"),
    ('preset = "spad"\n[amplifier]\ntransimpedance_ohm = 8', "amplifier must be None behind"),
    ('preset = "apd"\n[amplifier]\nimpulse_response = 3', "impulse_response = 3 must be the name of a file"),
    ('preset = "apd"\n[amplifier]\nrecovery_ns = 20', "recovery_ns = 20 needs a limit_v of the amplifier"),
    ('preset = "apd"\n[detector]\ntail_fractions = 0.1', "detector: tail_fractions = 0.1 must be a list of num"),
    (
        'preset = "pmt"\n[detector]\nafterpulse_probability = 0.1',
        "'afterpulse_probability' is no key of own.toml: detector",
    ),
    ('preset = "apd"\n[channels.deep.jitter]\nclock_ns = 1', "'jitter' is no key of own.toml: channels.deep"),
    ('preset = "apd"\n[amplifier.limit_v]\nhigh = 3', "limit_v must be a value, not a table"),
)
def test_invalid_files_are_refused_in_one_sentence(text, message):
    with pytest.raises(UserError, match=message.replace("(", r"\(")) as error:
        parse(text)
    assert "\n" not in str(error.value)


def test_unknown_names_are_refused():
    must_refuse("receiver = 'tube' must be one of ideal", receiver, "tube")
    must_refuse("own", receiver, "own.toml")


def write_response(folder, times, values):
    rows = "\n".join(f"{t},{v}" for t, v in zip(times, values, strict=True))
    (folder / "response.csv").write_text(f"time_ns,response\n{rows}\n")


@refuses(
    (np.arange(5.0) + 1, [0, 1, 2, 1, 0], "must hold 0, the arrival of the light"),
    (np.arange(5.0), [0, 1, 2, 1, 1], "where it must be 0 within 2 %"),
    (np.arange(5.0), [0, -1, -2, -1, 0], "must have a positive area"),
)
def test_responses_without_zero_are_refused(times, values, tmp_path):
    write_response(tmp_path, times, values)
    parse_receiver('preset = "apd"\n[amplifier]\nimpulse_response = "response.csv"', "own.toml", tmp_path)


def test_a_measured_single_pole_is_the_single_pole(tmp_path):
    """Mean, variance and correlation of samples are those of the closed form with the same time constant."""
    bandwidth = 100.0
    tau = 1e3 / (2 * math.pi * bandwidth)
    times = np.concatenate([[-1e-3], np.linspace(0, 12 * tau, 4000)])
    write_response(tmp_path, times, np.where(times >= 0, np.exp(-times / tau), 0))
    text = 'preset = "apd"\n[amplifier]\nimpulse_response = "response.csv"'
    own = parse_receiver(text, "own.toml", tmp_path).default.chain
    pole = parse(f'preset = "apd"\n[amplifier]\nbandwidth_mhz = {bandwidth}').default.chain
    own, pole = (ReceiverChain(one.detector, one.amplifier) for one in (own, pole))
    power = np.zeros(60)
    power[20:23] = 1e-7
    for first, second in zip(own.expected(power, 1.0)[:2], pole.expected(power, 1.0)[:2], strict=True):
        np.testing.assert_allclose(first, second, rtol=0.01, atol=0.002 * second.max())
    noise, weights = own.amplifier.noise(1.0)
    expected, _ = pole.amplifier.noise(1.0)
    assert noise == pytest.approx(expected, rel=0.005)
    correlation = np.correlate(weights, weights, "full")[weights.size - 1 :]
    np.testing.assert_allclose(correlation[:4], np.exp(-np.arange(4) / tau), atol=0.01)


def test_samples_behind_a_measured_response_have_the_stated_moments(tmp_path):
    """A response with an undershoot, whose noise is anticorrelated."""
    times = np.linspace(-1, 12, 200)
    write_response(
        tmp_path, times, np.exp(-0.5 * ((times - 2) / 0.7) ** 2) - 0.2 * np.exp(-0.5 * ((times - 5) / 1) ** 2)
    )
    text = 'preset = "photodiode"\n[amplifier]\nimpulse_response = "response.csv"'
    chain = parse_receiver(text, "own.toml", tmp_path).default.chain
    chain = ReceiverChain(chain.detector, chain.amplifier)
    power = np.zeros(40)
    power[10:15] = 3e-7
    count = 4000
    drawn = chain.apply(power, 1.0, count, 3).signal.astype(float)
    expected = chain.expected(power, 1.0)
    z = (drawn.mean(axis=0) - expected.mean) / np.sqrt(expected.variance / count)
    assert np.abs(z).max() < largest_z(40)
    ratio = drawn.var(axis=0, ddof=1) / expected.variance
    assert ratio.max() < 1 + 6 * np.sqrt(2 / count)
    assert ratio.min() > 1 - 6 * np.sqrt(2 / count)
    # The mean is the light after the response, negative in the undershoot.
    assert expected.mean[16:22].min() < 0


def test_single_events_exceed_the_stated_height_in_one_of_a_thousand_records():
    """Dark counts alone, without the noise of the amplifier; the closed form is for one event in a bin."""
    detector = LinearDetector.avalanche(0.6, 150.0, 0.02, dark_current_na=2e-3)
    chain = ReceiverChain(detector, Amplifier(10e3, bandwidth_mhz=200.0))
    records, bins, width = 10_000, 160, 0.2
    height = float(chain.event_height(np.zeros(bins), width))
    highest = chain.apply(np.zeros(bins), width, records, 5).signal.max(axis=-1)
    # Two events in a response are higher; those between two samples, and before the record, lower.
    assert 0.2e-3 < np.mean(highest > height) < 2e-3
    # A photon counter reports single events as counts of 1.
    assert RECEIVERS["spad_array"].event_height(np.zeros(bins), width) == 1
