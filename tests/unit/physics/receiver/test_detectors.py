"""Detectors and dead time: closed forms against hand-made numbers, published formulas and realisations."""

import numpy as np
import pytest
from rows import each_case, each_row
from significance import largest_z

from mitransient_lidar.physics.receiver import dead_time
from mitransient_lidar.physics.receiver.detectors import (
    LinearDetector,
    SiliconPhotomultiplier,
    SinglePhotonDetector,
    avalanche_excess_noise,
    dynode_excess_noise,
    photons_per_joule,
)


def assert_moments(samples, mean, variance):
    """Compare realisations (first axis) with mean and variance by z-scores; the fourth moment is the samples' own."""
    n = len(samples)
    found_mean, found = samples.mean(axis=0), samples.var(axis=0, ddof=1)
    fourth = ((samples - found_mean) ** 4).mean(axis=0)
    limit = largest_z(n, 2 * np.size(found_mean))
    assert np.max(np.abs(found_mean - mean) / np.sqrt(variance / n)) < limit
    assert np.max(np.abs(found - variance) / np.sqrt((fourth - found**2) / n)) < limit


def test_photons_of_green_light():
    assert photons_per_joule(532.0) == pytest.approx(2.67815e18, rel=1e-5)


def test_excess_noise_of_avalanche():
    # Limits of McIntyre's formula: one carrier, and both alike; 0.02 * 150 + 0.98 * (2 - 1/150) between them.
    assert avalanche_excess_noise(20, 0) == pytest.approx(1.95)
    assert avalanche_excess_noise(20, 1) == pytest.approx(20)
    assert avalanche_excess_noise(150, 0.02) == pytest.approx(4.953467, rel=1e-6)
    assert avalanche_excess_noise(1, 0.3) == pytest.approx(1)


def test_excess_noise_of_dynodes_against_a_cascade():
    assert dynode_excess_noise([4.0] * 20) == pytest.approx(4 / 3, rel=1e-9)
    gains = [6.0, 3.0, 2.5]
    random = np.random.default_rng(1)
    electrons = np.ones(200_000, dtype=np.int64)
    for gain in gains:
        electrons = random.poisson(gain * electrons)
    tube = LinearDetector.photomultiplier(0.2, gains)
    assert tube.gain == 45
    assert_moments(electrons, 45.0, 45.0**2 * (tube.excess_noise - 1))


@each_row(
    (LinearDetector(0.5), 1.0, 1.0, 0.0),
    (LinearDetector.avalanche(0.5, 100.0, 0.02), 100.0, 3.9502, 0.0),
    (LinearDetector.photomultiplier(0.5, [5.0, 5.0]), 25.0, 1.24, 0.0),
    # 1.602177 nA are 10 electrons a ns.
    (LinearDetector(0.5, dark_current_na=1.602177, leakage_current_na=16.02177), 1.0, 1.0, 200.0),
)
def test_linear_detectors(detector, gain, noise, leakage):
    photons = np.array([[4.0, 40.0, 400.0]])
    events = detector.event_means(photons, 2.0)
    np.testing.assert_allclose(events, 0.5 * photons + (20 if leakage else 0), rtol=1e-6)
    mean, variance = gain * events + leakage, gain**2 * noise * events + leakage
    found_mean, found = detector.moments(events, 2.0, 5)
    np.testing.assert_allclose(found_mean, mean, rtol=1e-6)
    np.testing.assert_allclose(found[0], variance, rtol=1e-6)
    assert len(found) == 1
    assert_moments(detector.sample(events, 2.0, 10_000, np.random.default_rng(2)), mean, variance)


def test_silicon_photomultiplier_saturates():
    detector = SiliconPhotomultiplier(0.4, 400, 20.0, gain=1e6)
    events = detector.event_means(np.array([0.0, 500.0, 0.0]), 1.0)
    assert events[1] == pytest.approx(200)
    # 200 events on 400 cells: 400 (1 - exp(-1/2)) fire, a binomial number.
    fired = -np.expm1(-0.5)
    mean, covariances = detector.moments(events, 1.0, 2)
    np.testing.assert_allclose(mean, [0, 400e6 * fired, 0])
    np.testing.assert_allclose(covariances[0], [0, 400e12 * fired * (1 - fired), 0])
    samples = detector.sample(events, 1.0, 10_000, np.random.default_rng(3))
    assert_moments(samples[:, 1] / 1e6, 400 * fired, 400 * fired * (1 - fired))


def test_crosstalk_is_borel_distributed():
    detector = SiliconPhotomultiplier(1.0, 10**8, 20.0, crosstalk=0.3, gain_spread=0.2)
    events = np.array([30.0])
    direct = -np.log(0.7)  # mean avalanches that one sets off
    mean = 30 / (1 - direct)
    # Compound Poisson: 1/(1-L)^3 is the second moment of the Borel distribution; then 0.2^2 for each avalanche.
    variance = 30 / (1 - direct) ** 3 + 0.04 * mean
    found_mean, found = detector.moments(events, 1.0, 1)
    np.testing.assert_allclose([found_mean[0], found[0][0]], [mean, variance], rtol=1e-5)
    assert_moments(detector.sample(events, 1.0, 20_000, np.random.default_rng(4))[:, 0], mean, variance)


def test_probability_of_crosstalk():
    detector = SiliconPhotomultiplier(1.0, 10**8, 20.0, crosstalk=0.2)
    count = detector.sample(np.array([0.02]), 1.0, 400_000, np.random.default_rng(5))[:, 0]
    one, some = np.count_nonzero(count == 1), np.count_nonzero(count)
    # exp(-0.02) 0.02 0.8 of all shots have one avalanche; those with any: 1 - exp(-0.02).
    share = np.exp(-0.02) * 0.016 / -np.expm1(-0.02)
    assert abs(one - some * share) / np.sqrt(some * share * (1 - share)) < largest_z(some)


def varying_light(bins=90, peak=0.8):
    t = np.arange(bins)
    return peak * np.exp(-0.5 * ((t - 20) / 6) ** 2) + 0.1 + 0.2 * (t > 50)


@pytest.mark.slow
@each_case(
    SinglePhotonDetector(1.0, 7.0),
    SinglePhotonDetector(1.0, 7.5),
    SinglePhotonDetector(1.0, 7.2, paralyzable=True),
    SiliconPhotomultiplier(1.0, 25, 7.3),
    SiliconPhotomultiplier(1.0, 25, 7.3, crosstalk=0.2, gain=3.0, gain_spread=0.3),
)
def test_geiger_detectors_against_realisations(detector):
    events = varying_light() * getattr(detector, "cells", 1)
    samples = detector.sample(np.stack([events, 0.5 * events]), 1.0, 10_000, np.random.default_rng(6))
    mean, covariances = detector.moments(np.stack([events, 0.5 * events]), 1.0, 20)
    assert_moments(samples, mean, covariances[0])
    centred = samples - samples.mean(axis=0)
    for lag in (1, 6, 7, 8, 9, 15):
        products = centred[..., :-lag] * centred[..., lag:]
        z = (products.mean(axis=0) - covariances[lag]) / (products.std(axis=0) / np.sqrt(len(samples)))
        # Pairs of counts that are rare are not normally distributed.
        often = len(samples) * mean[..., :-lag] * mean[..., lag:] > 50
        assert np.max(np.abs(z[often])) < largest_z(len(samples), often.sum()), lag


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize("rate", [5e6, 60e6])
def test_steady_counts_against_published_formula(rate, paralyzable):
    dead, bins = 40.0, 1600
    detector = SinglePhotonDetector(1.0, dead, paralyzable=paralyzable)
    events = np.full(bins, rate * 1e-9)
    counts = detector.sample(events, 1.0, 3000, np.random.default_rng(7))[:, -1000:].sum(axis=1)
    x = rate * dead * 1e-9
    # W. Feller (1948), "On probability problems in the theory of counters"; J. W. Mueller, Nucl. Instrum. Methods 112,
    # 47 (1973), doi:10.1016/0029-554X(73)90773-8, for a detector that has been live for a long time.
    if paralyzable:
        mean = rate * 1e-6 * np.exp(-x)
        variance = mean - 2 * mean * x * np.exp(-x) + (x * np.exp(-x)) ** 2
    else:
        mean = rate * 1e-6 / (1 + x)
        # 1/(1+x)^3 and a constant
        variance = mean / (1 + x) ** 2 + x**2 * (6 + 4 * x + x**2) / (6 * (1 + x) ** 4)
    assert_moments(counts, mean, variance)
    # The closed form of the bins, summed over pairs of bins, in the steady state.
    means, covariances = detector.moments(events, 1.0, 1000)
    assert means[-1000:].sum() == pytest.approx(mean, rel=1e-3)
    total = sum((1 if lag == 0 else 2) * one[-1000 + lag :].sum() for lag, one in enumerate(covariances))
    assert total == pytest.approx(variance, rel=5e-3)


@each_row(1.0, 3.0, 3.2, 3.8)
@each_row(0.01, 0.5, 1.9, 6.0)
def test_steady_rate_is_exact_in_strong_light(events, dead_ns):
    """Feller (1948). With events in the middle of their bins, 1.9 a bin would lose 3.8 and 25 % of the counts."""
    x = events * dead_ns
    light = np.full(2000, events)
    for detector, expected in (
        (SinglePhotonDetector(1.0, dead_ns), events / (1 + x)),
        (SinglePhotonDetector(1.0, dead_ns, paralyzable=True), events * np.exp(-x)),
        (SiliconPhotomultiplier(1.0, 1, dead_ns), events / (1 + x)),
    ):
        # The gated start rings for some hundred bins.
        assert detector.moments(light, 1.0, 1)[0][-500:].mean() == pytest.approx(expected, rel=1e-5)


def test_first_photon_histogram():
    events = varying_light(peak=0.4)
    fired, live = dead_time.firing_probability(events, dead_time.dead_bins(1e6, 1.0))
    before = np.concatenate(([0], np.cumsum(events)[:-1]))
    np.testing.assert_allclose(live, np.exp(-before), rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(fired, np.exp(-before) * (1 - np.exp(-events)), rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("dead", [5.5, 12.0, 1e6])
def test_counts_of_live_shots_give_the_events(dead):
    """Coates (1968): the events are -ln(1 - counts/live), in realisations, too."""
    events = varying_light(peak=0.4)
    _, live = dead_time.firing_probability(events, dead_time.dead_bins(dead, 1.0))
    shots = 20_000
    counts = SinglePhotonDetector(1.0, dead).sample(events, 1.0, shots, np.random.default_rng(8)).sum(axis=0)
    # A binomial fraction p of the live shots has the error sqrt(p (1-p)/live); of -ln(1-p) it is sqrt(p/((1-p) live)).
    error = np.sqrt(np.expm1(events) / (shots * live))
    kept = counts > 200
    found = -np.log1p(-counts[kept] / (shots * live[kept]))
    assert np.max(np.abs(found - events[kept]) / error[kept]) < largest_z(shots, kept.sum())
    # Without the correction the histogram is far off.
    assert np.max(np.abs(counts / shots - events)[kept] / error[kept]) > 20
