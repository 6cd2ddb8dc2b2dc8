"""Rates of alarms, the area under their curve, and their intervals."""

import numpy as np
import pytest
from scipy.stats import binom, chi2
from significance import FALSE_ALARM

from mitransient_lidar.analysis.detection.statistics import area_under_curve, binomial_rates, exceedance


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
