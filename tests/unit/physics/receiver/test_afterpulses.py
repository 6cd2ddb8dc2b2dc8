"""Afterpulses of photon counters: numbers and times against closed forms, moments against realisations."""

import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.physics.receiver.detectors import SinglePhotonDetector

# Dead for the rest of its bin and 9.5 bins of 1 ns: 10 bins.
#: Dead for ten bins after a flash, whose first event is a fiftieth of a bin late.
COUNTER = SinglePhotonDetector(0.5, 9.98, afterpulse_probability=0.2, afterpulse_decay_ns=15.0)


def flash(bins):
    events = np.zeros(bins)
    events[0] = 50.0  # a certain count
    return events


def test_number_and_time_of_the_afterpulses_of_one_count():
    """20 000 records: p / (1 - p) afterpulses of the variance p / (1 - p)^2, the first one exponentially late."""
    shots, p, bins = 20_000, 0.2, 600
    counts = COUNTER.sample(flash(bins), 1.0, shots, np.random.default_rng(3))
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
    np.testing.assert_allclose(COUNTER.moments(flash(bins), 1.0, 1)[0][1:20], expected[1:], atol=1e-12)
    assert COUNTER.moments(flash(bins), 1.0, 1)[0].sum() - 1 == pytest.approx(mean, rel=1e-6)


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
