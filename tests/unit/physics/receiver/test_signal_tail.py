"""Delayed events: tails and afterpulses against closed forms, in every function that uses a receiver."""

from dataclasses import replace

import numpy as np
import pytest
from rows import each_row
from significance import largest_z

from mitransient_lidar.analysis.detection import statistics
from mitransient_lidar.physics.receiver import sample_moments
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import (
    LinearDetector,
    SiliconPhotomultiplier,
    SinglePhotonDetector,
    photons_per_joule,
)
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS

FRACTIONS, DECAYS, DELAYS = (0.02, 0.05), (30.0, 90.0), (0.0, 24.5)
TUBE = LinearDetector.photomultiplier(
    0.2, [5.0, 4.0], tail_fractions=FRACTIONS, tail_decays_ns=DECAYS, tail_delays_ns=DELAYS
)
PER_PHOTON = 1e9 / photons_per_joule(532.0)  # W in 1 ns


def flash(photons, at=20, bins=400):
    light = np.zeros(bins)
    light[at] = photons * PER_PHOTON
    return light


def tail(bins, at=20):
    """Events per event of a flash in the middle of a bin, later in bins of 1 ns: integrals of the exponentials."""
    edges = np.arange(bins + 1) - (at + 0.5)
    found = np.zeros(bins)
    for fraction, decay, delay in zip(FRACTIONS, DECAYS, DELAYS, strict=True):
        # A delay by a fraction of a bin is one by the bins before and after it.
        for bins_late, share in ((int(delay), 1 - delay % 1), (int(delay) + 1, delay % 1)):
            risen = 1 - np.exp(-np.maximum(edges - bins_late, 0) / decay)
            found += fraction * share * np.diff(risen)
    return found


@pytest.mark.slow
def test_mean_and_variance_of_a_flash():
    """10 000 records: mean M mu and variance M^2 F mu of the flash, of its two tails and of the background."""
    shots, photons, sky = 10_000, 5000.0, 2.0
    chain, light = ReceiverChain(TUBE), flash(photons)
    own = np.zeros(400)
    own[20] = 1
    # Steady light has its tail, too.
    events = 0.2 * photons * (own + tail(400)) + 0.2 * sky * (1 + sum(FRACTIONS))
    expected = chain.expected(light, 1.0, sky * PER_PHOTON)
    np.testing.assert_allclose(expected.mean, 20 * events, rtol=1e-9)
    np.testing.assert_allclose(expected.variance, 400 * TUBE.excess_noise * events, rtol=1e-9)
    record = chain.apply(light, 1.0, shots, 5, sky * PER_PHOTON).signal.astype(np.float64)
    variance = 400 * TUBE.excess_noise * events
    limit = largest_z(shots, 800)
    assert np.max(np.abs(record.mean(axis=0) - 20 * events) / np.sqrt(variance / shots)) < limit
    found = record.var(axis=0, ddof=1)
    fourth = ((record - record.mean(axis=0)) ** 4).mean(axis=0)
    assert np.max(np.abs(found - variance) / np.sqrt((fourth - found**2) / shots)) < limit


def test_height_behind_an_echo():
    # The stated rule: a tail of 1e-3 of the peak needs the fraction 1e-3 tau / w, w the energy over the peak.
    time = np.arange(2000.0)
    echo = np.exp(-0.5 * ((time - 100) / 2.5) ** 2)
    width = np.sqrt(2 * np.pi) * 2.5
    detector = LinearDetector(1.0, tail_fractions=(1e-3 * 500 / width,), tail_decays_ns=(500.0,))
    mean = ReceiverChain(detector).expected(1e-6 * echo, 1.0).mean
    peak = ReceiverChain(LinearDetector(1.0)).expected(1e-6 * echo, 1.0).mean[100]
    # Extrapolated from far behind the echo to its time; 0.5 (2.5/500)^2 more, as the echo has a width.
    assert mean[400] * np.exp(300 / 500) / peak == pytest.approx(1e-3 * (1 + 0.5 * (2.5 / 500) ** 2), rel=1e-6)


@each_row("ideal", "apd", "pmt_log", "sipm", "spad_array")
def test_every_function_sees_the_tail(name):
    """Closed forms of records, of detection and of bounds agree on the mean; the tail is in the samples after 60 ns."""
    plain = RECEIVERS[name]
    chain = replace(plain, detector=replace(plain.detector, tail_fractions=(0.1,), tail_decays_ns=(80.0,)))
    light = flash(5000.0, bins=200)
    mean = chain.expected(light, 1.0, 1e-12).mean
    rise = (mean - plain.expected(light, 1.0, 1e-12).mean)[80:]
    assert np.all(rise > 0)
    # Per nanosecond, 1/80 less.
    if name in ("ideal", "apd"):
        np.testing.assert_allclose(rise[1:] / rise[:-1], np.exp(-1 / 80), rtol=1e-4)
    found = statistics.sample_moments(chain, light[None], 1.0, slice(80, 100), np.array([1e-12]))
    np.testing.assert_allclose(found.mean[0], mean[80:100])
    if chain.digitiser is None:
        bound = sample_moments.sample_moments(chain, light, light[None], 1.0, 1e-12)
        np.testing.assert_allclose(bound.mean, mean, rtol=1e-9)
    if name == "apd":
        # The derivative for a factor of the light holds the tail, too.
        bound = sample_moments.sample_moments(chain, light, light[None], 1.0)
        dark = chain.expected(0 * light, 1.0).mean
        bright = chain.expected(0.01 * light, 1.0).mean
        np.testing.assert_allclose(0.01 * bound.mean_derivatives[0], bright - dark, atol=1e-9)


def test_afterpulses_of_cells_follow_those_that_fire():
    # 1000 cells, a mean of 3 events in each: 1 - exp(-3) of them fire, and have afterpulses.
    cells = SiliconPhotomultiplier(0.5, 1000, 10.0, tail_fractions=(0.05,), tail_decays_ns=(20.0,))
    events = ReceiverChain(cells).events(flash(6000.0)[None], 1.0, np.zeros(1))[0]
    later = 0.05 * 1000 * (1 - np.exp(-3)) * (np.exp(-0.5 / 20) - np.exp(-1.5 / 20))
    assert events[21] == pytest.approx(later)
    assert events[21:].sum() == pytest.approx(0.05 * 1000 * (1 - np.exp(-3)) * np.exp(-0.5 / 20), rel=1e-4)


# Dead for the rest of its bin and 9.5 bins of 1 ns: 10 bins.
#: Dead for ten bins after a counted_flash, whose first event is a fiftieth of a bin late.
COUNTER = SinglePhotonDetector(0.5, 9.98, afterpulse_probability=0.2, afterpulse_decay_ns=15.0)


def counted_flash(bins):
    events = np.zeros(bins)
    events[0] = 50.0  # a certain count
    return events


def test_number_and_time_of_the_afterpulses_of_one_count():
    """20 000 records: p / (1 - p) afterpulses of the variance p / (1 - p)^2, the first one exponentially late."""
    shots, p, bins = 20_000, 0.2, 600
    counts = COUNTER.sample(counted_flash(bins), 1.0, shots, np.random.default_rng(3))
    number = counts.sum(axis=1) - 1
    # Each count is followed by another one with the probability p: a geometric distribution.
    mean, variance = p / (1 - p), p / (1 - p) ** 2
    fourth = variance**2 * (9 + (1 - p) ** 2 / p)
    limit = largest_z(shots, 2)
    assert abs(number.mean() - mean) < limit * np.sqrt(variance / shots)
    assert abs(number.var() - variance) < limit * np.sqrt((fourth - variance**2) / shots)
    # No second afterpulse is within the dead time after the first possible one.
    expected = np.where(np.arange(20) >= 10, p * (np.exp(-(np.arange(20) - 10) / 15) * -np.expm1(-1 / 15)), 0)
    found = counts[:, :20].mean(axis=0)[1:]
    error = np.sqrt(np.maximum(expected[1:] * (1 - expected[1:]), 1e-12) / shots)
    assert np.max(np.abs(found - expected[1:]) / error) < largest_z(shots, 19)
    np.testing.assert_allclose(COUNTER.moments(counted_flash(bins), 1.0, 1)[0][1:20], expected[1:], atol=1e-12)
    assert COUNTER.moments(counted_flash(bins), 1.0, 1)[0].sum() - 1 == pytest.approx(mean, rel=1e-6)


@pytest.mark.parametrize(("dead_ns", "channels"), [(9.5, 1), (7.3, 1)])
def test_moments_in_changing_light(dead_ns, channels):
    shots = 20_000
    t = np.arange(80)
    events = channels * (0.02 + 0.8 * np.exp(-0.5 * ((t - 12) / 2) ** 2) + 0.2 * np.exp(-0.5 * ((t - 45) / 2) ** 2))
    counter = SinglePhotonDetector(0.5, dead_ns, channels=channels, afterpulse_probability=0.3, afterpulse_decay_ns=8.0)
    mean, covariances = counter.moments(events, 1.0, 25)
    counts = counter.sample(events, 1.0, shots, np.random.default_rng(4))
    limit = largest_z(shots, 26 * 80)
    assert np.max(np.abs(counts.mean(axis=0) - mean) / np.sqrt(covariances[0] / shots)) < limit
    centred = counts - mean
    for lag, covariance in enumerate(covariances):
        products = centred[:, : len(t) - lag] * centred[:, lag:]
        # Where both bins count together in few records, their mean is not normally distributed.
        often = shots * (covariance + mean[: len(t) - lag] * mean[lag:]) > 100
        error = products.std(axis=0) / np.sqrt(shots)
        assert np.all(np.abs(products.mean(axis=0) - covariance)[often] < limit * error[often]), lag
