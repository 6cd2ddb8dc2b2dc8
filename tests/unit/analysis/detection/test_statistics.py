"""Statistics of detection, and receiver operating characteristics of drawn shots."""

import numpy as np
import pytest
from rows import refuses
from scipy.stats import binom, chi2, norm, pearson3
from significance import FALSE_ALARM, largest_z

from mitransient_lidar.analysis.detection.matched_filter import delay_bound, delays
from mitransient_lidar.analysis.detection.statistics import (
    Cases,
    Statistic,
    area_under_curve,
    binomial_rates,
    clutter_covariance,
    exceedance,
    matched_weights,
    sample_moments,
    within_range,
)
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS

T = np.arange(60)
LIGHT = 4e-8 * (0.2 + np.exp(-0.5 * ((T - 40) / 4) ** 2))
GATE = slice(34, 44)

LOGARITHM = ReceiverChain(
    LinearDetector(0.5, 100.0, 1.5), Amplifier(2e3, 5.0, bandwidth_mhz=150.0), LogAmplifier(0.2, 1e-3)
)
SAMPLED = ReceiverChain(
    LinearDetector(0.5, 100.0, 1.5),
    Amplifier(2e4, 5.0, bandwidth_mhz=80.0, response="gaussian"),
    digitiser=Digitiser(12, 1.0, -0.1, sampling_ghz=0.5),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("chain", "gate", "scale"),
    [
        (RECEIVERS["apd"], GATE, 1.0),
        (RECEIVERS["sipm"], GATE, 1.0),
        (RECEIVERS["ideal"], GATE, 1.0),
        (LOGARITHM, GATE, 10.0),
        (SAMPLED, slice(15, 22), 1.0),
    ],
    ids=["apd", "sipm", "ideal", "logarithm", "sampled"],
)
def test_moments_are_those_of_drawn_shots(chain, gate, scale):
    light = scale * np.array([LIGHT, 0.5 * LIGHT])
    shots = 8000
    drawn = chain.apply(light, 1.0, shots, 5, 1e-9).signal[..., gate].astype(float)
    found = sample_moments(chain, light, 1.0, gate, 1e-9)
    samples = drawn.shape[-1]
    assert found.covariance.shape == (2, samples, samples)
    for i in range(2):
        variance = np.diag(found.covariance[i])
        limit = largest_z(shots, 2 * samples**2 * 5)
        assert np.max(np.abs(drawn[:, i].mean(axis=0) - found.mean[i]) / np.sqrt(variance / shots)) < limit
        # Of normal samples, with a tenth for the fourth moments of what is not quite normal.
        error = 1.1 * np.sqrt((np.outer(variance, variance) + found.covariance[i] ** 2) / shots)
        assert np.max(np.abs(np.cov(drawn[:, i].T) - found.covariance[i]) / error) < limit


def test_range_is_kept_by_less_gain():
    chain = RECEIVERS["apd"]
    assert within_range(chain, LIGHT, 1.0, GATE) is chain
    strong = within_range(chain, 100 * LIGHT, 1.0, GATE)
    assert strong.amplifier.transimpedance_ohm < 0.5 * chain.amplifier.transimpedance_ohm
    assert np.max(strong.expected(100 * LIGHT, 1.0).saturation[GATE]) < 1e-8
    # Only as much less as it takes: two tenths more saturate.
    assert np.max(strong.with_gain(1.2).expected(100 * LIGHT, 1.0).saturation[GATE]) > 1e-4
    assert within_range(RECEIVERS["ideal"], 100 * LIGHT, 1.0, GATE) is RECEIVERS["ideal"]


def one_case(rise, covariance, factor=1.0):
    null = np.zeros((1, len(rise)))
    return Cases(null, covariance[None], null + rise, factor * covariance[None])


def test_probability_of_detection_in_closed_form():
    """3.0902 + 1.2816 standard deviations are found with 0.9 at a false alarm of 0.001."""
    statistic = one_case(np.array([3.0, 4.0]) * 4.3718 / 5, np.eye(2)).statistic()
    assert statistic.deflection == pytest.approx(4.3718)
    assert float(statistic.detection(1e-3)) == pytest.approx(0.9, abs=1e-5)
    assert statistic.area() == pytest.approx(norm.cdf(4.3718 / np.sqrt(2)))


@pytest.mark.parametrize("skewness", [-0.4, 0.3, 0.6])
def test_skewed_sums_have_a_pearson_distribution(skewness):
    """Probabilities from 1e-3 to 0.999, each within 5 %."""
    one = Statistic(np.ones((1, 1)), np.zeros(1), 1.0, 2.0, 2.0, 3.0, skewness, skewness)
    for alarm in (0.3, 0.01, 1e-3):
        assert pearson3.sf((one.threshold(alarm) - 1) / 2, skewness) == pytest.approx(alarm, rel=0.05)
        missed = pearson3.cdf((one.threshold(alarm) - 2) / 3, skewness)
        assert 1 - one.detection(alarm) == pytest.approx(missed, rel=0.05)


def test_no_other_weights_do_better():
    random = np.random.default_rng(1)
    root = random.normal(size=(5, 5))
    covariance, rise = root @ root.T, random.normal(size=5)
    assert matched_weights(np.array([1.0, 0.0]), np.array([[1.0, 0.6], [0.6, 1.0]])) == pytest.approx([1, -0.6])
    best = one_case(rise, covariance).statistic().deflection
    assert best == pytest.approx(np.sqrt(rise @ np.linalg.inv(covariance) @ rise))
    for weights in random.normal(size=(500, 5)):
        assert weights @ rise / np.sqrt(weights @ covariance @ weights) < best


@pytest.mark.slow
def test_no_sea_is_judged_by_weights_that_have_seen_it():
    """Weights of 8 seas in 10 samples fit them: their own spread is below that on new seas."""
    random = np.random.default_rng(3)
    root = random.normal(size=(10, 10))
    noise = np.repeat(0.01 * np.eye(10)[None], 9, axis=0)
    stated, new, own = [], [], []
    for _ in range(150):
        seas = random.normal(size=(9, 10)) @ root
        statistic = Cases(seas, noise, seas + 1, noise).statistic()
        stated.append(statistic.null_sd**2)
        learnt = Cases(seas, noise, seas + 1, noise).others(0)
        weights = learnt.weights()
        new.append(weights @ (root.T @ root + noise[0]) @ weights)
        own.append(np.var(learnt.null_mean @ weights, ddof=1) + 0.01 * weights @ weights)
    difference = np.array(stated) - np.array(new)
    # The mean of 8 seas is not known either, which adds an eighth at most.
    limit = largest_z(150) * difference.std(ddof=1) / np.sqrt(150)
    assert -limit < difference.mean() < 0.125 * np.mean(new) + limit
    gap = np.array(new) - np.array(own)
    assert gap.mean() > largest_z(150) * gap.std(ddof=1) / np.sqrt(150)


def test_clutter_of_many_cases_is_their_covariance():
    random = np.random.default_rng(5)
    truth = np.array([[4.0, 1.5], [1.5, 1.0]])
    found = clutter_covariance(random.multivariate_normal([1, 2], truth, 20000))
    np.testing.assert_allclose(found, truth, rtol=0.06)


def test_clutter_of_few_cases_has_no_blind_direction():
    kept = []
    for few in np.random.default_rng(6).normal(size=(100, 4, 12)):
        found, sample = clutter_covariance(few), np.cov(few.T)
        np.testing.assert_allclose(np.diag(found), few.var(axis=0, ddof=1))
        assert np.linalg.eigvalsh(sample)[0] < 1e-10
        assert np.linalg.eigvalsh(found)[0] > 1e-4
        beside = ~np.eye(12, dtype=bool)
        kept.append(np.abs(found[beside]).mean() / np.abs(sample[beside]).mean())
    # Independent samples: more than half of their chance correlations is taken off.
    assert np.mean(kept) + largest_z(100) * np.std(kept, ddof=1) / 10 < 0.5


STEPS = np.linspace(-3, 3, 31)
NOISE = 0.02


def echoes(steps, width=3.0):
    return np.exp(-0.5 * ((T[:40] - 20 - np.asarray(steps)[:, None]) / width) ** 2)


def test_bound_of_the_delay_in_closed_form():
    """White noise n a sample of 1 ns: the integral of s'^2 of a Gaussian of width w is sqrt(pi)/(2 w)."""
    bound = delay_bound(echoes(STEPS), STEPS, NOISE**2 * np.eye(40))
    assert bound == pytest.approx(NOISE / np.sqrt(np.sqrt(np.pi) / (2 * 3.0)), rel=0.005)


def test_delays_reach_the_bound():
    random = np.random.default_rng(8)
    shots = 4000
    true = 0.73
    records = 2.5 * echoes([true]) + random.normal(0, NOISE, (shots, 40))
    found = delays(records, echoes(STEPS), STEPS, NOISE**2 * np.eye(40))
    bound = delay_bound(2.5 * echoes(STEPS), STEPS, NOISE**2 * np.eye(40))
    # The parabola through steps of a fifteenth of the echo's width is off by less than 1e-3 ns.
    assert abs(found.mean() - true) < largest_z(shots) * bound / np.sqrt(shots) + 1e-3
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], shots - 1) / (shots - 1)
    assert 0.97 * low < found.var(ddof=1) / bound**2 < 1.03 * high


@refuses(
    (lambda: sample_moments(RECEIVERS["apd"], -LIGHT, 1.0, GATE), "must not be negative"),
    (lambda: delays(np.ones((2, 40)), echoes(STEPS), STEPS, np.ones((40, 40))), "must be positive definite"),
    (lambda: matched_weights(np.zeros(2), np.eye(2)), "signal must not be 0"),
    (lambda: matched_weights(np.array([1.0, 0.0]), np.ones((2, 2))), "covariance must be positive definite"),
)
def test_invalid_input(call):
    call()


def test_rates_have_the_published_intervals():
    """Table values of Clopper and Pearson; without a success the limit solves (1 - p)^10 = 0.025."""
    found = binomial_rates([0, 5, 10], 10)
    np.testing.assert_allclose(found.rate, [0, 0.5, 1])
    np.testing.assert_allclose(found.low, [0, 0.1871, 0.6915], atol=5e-5)
    np.testing.assert_allclose(found.high, [0.3085, 0.8129, 1], atol=5e-5)
    np.testing.assert_array_equal(exceedance([3.0, 1.0, 2.0, 2.0], [0.0, 2.0, 9.0]).rate, [1, 0.25, 0])


@pytest.mark.parametrize("truth", [0.001, 0.1, 0.5])
def test_rates_are_covered_at_least_as_often_as_said(truth):
    count = np.arange(301)
    found = binomial_rates(count, 300, confidence=0.9)
    covered = (found.low <= truth) & (truth <= found.high)
    share = binom.pmf(count, 300, truth)[covered].sum()
    assert 0.9 <= share < 1 - 0.05 * (truth > 0.01)


def test_area_of_five_shots_by_hand():
    """Of six pairs (1, 2) alone is wrong; the components are 1/2, 1, 1 with the target, and 1, 2/3 without it."""
    found = area_under_curve([0, 2], [1, 3, 4])
    assert found.value == pytest.approx(5 / 6)
    assert found.stderr == pytest.approx(np.sqrt((1 / 12) / 3 + (1 / 18) / 2))
    # Ties count half.
    assert area_under_curve([1, 1, 2], [1, 2]).value == pytest.approx((0.5 + 0.5 + 0 + 1 + 1 + 0.5) / 6)


@pytest.mark.slow
def test_standard_error_of_the_area_is_its_spread():
    random = np.random.default_rng(7)
    found = [area_under_curve(random.normal(0, 1, 60), random.normal(1, 1, 90)) for _ in range(600)]
    ratio = np.var([one.value for one in found], ddof=1) / np.mean([one.stderr**2 for one in found])
    # The area is close to normal, so that its variance over 600 trials goes with chi-squared; 5 % for what is not.
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 599) / 599
    assert 0.95 * low < ratio < 1.05 * high


def test_area_without_an_error_has_a_limit():
    """20 independent pairs are all separated with 5 % probability where the probability of one is 0.05^(1/20)."""
    found = area_under_curve(np.arange(20), 100 + np.arange(30))
    assert (found.value, found.stderr, found.high) == (1, 0, 1)
    assert found.low == pytest.approx(0.05**0.05)
    assert area_under_curve(100 + np.arange(20), np.arange(30)).high == pytest.approx(1 - 0.05**0.05)
