"""Stages of the electronics, each alone, against closed forms."""

import numpy as np
import pytest
from rows import each_row, must_refuse
from scipy.stats import norm
from significance import largest_z

from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier, Readout


@pytest.mark.parametrize("response", ["single_pole", "gaussian"])
def test_low_pass_halves_the_power_at_the_bandwidth(response):
    width, frequency = 0.05, 100.0
    low_pass = Amplifier(1.0, bandwidth_mhz=frequency, response=response).low_pass(width)
    assert low_pass.weights.sum() == pytest.approx(1)
    # Charges in the middle of each part.
    t = 1e-3 * width / low_pass.parts * (low_pass.first + np.arange(low_pass.weights.size) + 0.5)  # us
    for f in (0.5 * frequency, frequency, 2 * frequency):
        gain = abs(np.sum(low_pass.weights * np.exp(-2j * np.pi * f * t))) ** 2
        ideal = 1 / (1 + (f / frequency) ** 2) if response == "single_pole" else 2 ** -((f / frequency) ** 2)
        assert gain == pytest.approx(ideal, rel=2e-3)
    delay = np.sum(low_pass.weights * t)
    assert delay == pytest.approx(1 / (2 * np.pi * frequency) if response == "single_pole" else 0, rel=1e-3, abs=1e-9)


@each_row(0.4, 1.0, 7.0)
@each_row("single_pole", "gaussian")
def test_samples_see_each_charge_once_and_in_its_time(response, width):
    """Steady light, an echo in one bin, and the bins that a sample depends on."""
    low_pass = Amplifier(1.0, bandwidth_mhz=100.0, response=response).low_pass(width)
    bins = 4 + low_pass.before + low_pass.after
    record = np.zeros((bins, bins + low_pass.before + low_pass.after))
    record[np.arange(bins), np.arange(bins) + low_pass.before] = 1
    matrix = low_pass.parts * low_pass.sampled(low_pass.divided(record), 1)  # of the echo's bin and the sample's
    sigma = np.sqrt(np.log(2)) / (2e-3 * np.pi * 100)
    for late in range(-low_pass.after, low_pass.before + 1):
        edges = np.array([late - 0.5, late + 0.5]) * width
        part = (
            norm.cdf(edges / sigma) if response == "gaussian" else -np.exp(-2e-3 * np.pi * 100 * np.maximum(edges, 0))
        )
        np.testing.assert_allclose(np.diagonal(matrix, late), np.diff(part)[0], atol=1e-9)
    others = np.triu(matrix, low_pass.before + 1) + np.tril(matrix, -low_pass.after - 1)
    assert np.abs(others).max() < 1e-12
    every = low_pass.parts * low_pass.sampled(low_pass.divided(record), 3)
    np.testing.assert_array_equal(every, matrix[:, ::3])
    # Records together are convolved as one of them alone, and shorter weights need fewer parts.
    drawn = np.random.default_rng(1).random((3, record.shape[1] * low_pass.parts))
    for lacking, weights in ((0, low_pass.weights), (1, low_pass.weights[1:])):
        alone = [np.convolve(one[: one.size - lacking], weights, "valid") for one in drawn]
        found = low_pass.sampled(drawn[:, : drawn.shape[1] - lacking], 2, weights)
        np.testing.assert_allclose(found, np.array(alone)[:, low_pass.start :: 2 * low_pass.parts], rtol=1e-12)


@each_row(0.1, 1.0, 4.0)
@each_row(("single_pole", np.pi / 2), ("gaussian", np.sqrt(np.pi / np.log(16))))
def test_thermal_noise_behind_the_bandwidth(response, factor, width):
    """4 k T/R times the equivalent noise bandwidth, 1.571 and 1.064 times that of half power, for bins of any width."""
    amplifier = Amplifier(50.0, load_ohm=50.0, temperature_k=300.0, bandwidth_mhz=100.0, response=response)
    deviation, weights = amplifier.noise(width, 2)
    density = 4 * 1.380649e-23 * 300 / 50
    assert deviation**2 / (50.0**2 * density * factor * 1e8) == pytest.approx(1, abs=1e-4)
    # Correlation after two bins, by the Fourier transform of the response's power.
    angle = 2e-3 * np.pi * 100 * 2 * width
    rho = np.exp(-angle) if response == "single_pole" else np.exp(-(angle**2) / (4 * np.log(2)))
    assert np.sum(weights**2) == pytest.approx(1)
    assert np.sum(weights[1:] * weights[:-1]) == pytest.approx(rho, abs=1e-6)


def test_amplifier_noise_without_a_low_pass_is_that_of_the_bins():
    # White noise averaged over 1 ns has the bandwidth of 500 MHz; 3 and 4 pA/sqrt(Hz) together are 5.
    density = 4 * 1.380649e-23 * 293.15 / (4e-12) ** 2
    amplifier = Amplifier(1e3, noise_pa_per_rthz=3.0, load_ohm=density)
    deviation, weights = amplifier.noise(1.0, 5)
    assert deviation == pytest.approx(1e3 * 5e-12 * np.sqrt(5e8))
    assert weights == np.ones(1)
    record = np.arange(6.0)
    np.testing.assert_array_equal(amplifier.low_pass(1.0).sampled(record, 1), record)


def test_logarithm():
    stage = LogAmplifier(0.3, 1e-3)
    assert stage.compress(np.array(1.0)) - stage.compress(np.array(0.1)) == pytest.approx(0.3, rel=1e-4)
    # Far above the knee: volts_per_decade log10(v/knee).
    assert stage.compress(np.array(1.0)) == pytest.approx(0.9, rel=1e-6)
    assert stage.compress(np.array(1e-6)) == pytest.approx(0.3e-6 / (2e-3 * np.log(10)), rel=1e-6)
    volts = np.array([-0.5, -1e-4, 0, 2e-3, 3.0])
    np.testing.assert_allclose(stage.expand(stage.compress(volts)), volts, rtol=1e-12)
    out, step = stage.compress(volts), 1e-6
    rise = (stage.expand(out + step) - stage.expand(out - step)) / (2 * step)
    np.testing.assert_allclose(stage.expansion(out), rise, rtol=1e-6)


def test_digitiser_rounds_and_saturates():
    stage = Readout(digitiser=Digitiser(3, 0.8, -0.1))  # codes at -0.1, 0, ... 0.6
    volts = np.array([-0.3, -0.151, -0.149, 0.04, 0.06, 0.649, 0.651, 2.0])
    samples, saturated = stage.read(volts)
    np.testing.assert_allclose(samples, [-0.1, -0.1, -0.1, 0.0, 0.1, 0.6, 0.6, 0.6], atol=1e-12)
    np.testing.assert_array_equal(saturated, [True, True, False, False, False, False, True, True])


def test_rounding_noise():
    step = 1e-2
    stage = Readout(digitiser=Digitiser(10, 1024 * step, -5 * step * 100))
    mean, sigma = np.array([0.0, 0.3337]), 0.9 * step
    expected = stage.expected(mean, np.full(2, sigma**2))
    np.testing.assert_allclose(expected.mean, mean, atol=1e-12)
    np.testing.assert_allclose(expected.variance, sigma**2 + step**2 / 12, rtol=1e-9)
    n = 100_000
    volts = mean + sigma * np.random.default_rng(1).standard_normal((n, 2))
    samples, saturated = stage.read(volts)
    assert not saturated.any()
    # The variance of n normal numbers has the relative error sqrt(2/n).
    limit = largest_z(n, 4) * np.sqrt(2 / n)
    assert np.max(np.abs(samples.var(axis=0) / expected.variance - 1)) < limit
    assert np.all(samples.var(axis=0) > sigma**2 * (1 + limit))


@each_row(-1.5, -0.9, 0.2, 0.95, 3.0)
def test_limits_of_the_amplifier(mean):
    # Censored normal distribution in closed form.
    sigma, a, b = 0.3, -1.0, 1.0
    low, high = (a - mean) / sigma, (b - mean) / sigma
    inside = norm.cdf(high) - norm.cdf(low)
    first = a * norm.cdf(low) + b * norm.sf(high) + mean * inside + sigma * (norm.pdf(low) - norm.pdf(high))
    second = a**2 * norm.cdf(low) + b**2 * norm.sf(high) + (mean**2 + sigma**2) * inside
    second += 2 * mean * sigma * (norm.pdf(low) - norm.pdf(high))
    second += sigma**2 * (low * norm.pdf(low) - high * norm.pdf(high))
    found = Readout(limit_v=1.0).expected(np.array([mean]), np.array([sigma**2]))
    assert found.mean[0] == pytest.approx(first, abs=1e-9)
    assert found.variance[0] == pytest.approx(second - first**2, abs=1e-9)
    assert found.saturation[0] == pytest.approx(norm.cdf(low) + norm.sf(high), abs=1e-12)


@each_row(-0.401, -2e-3, 0.0, 2e-3, 2e-2, 0.5, 0.798)
@each_row(None, LogAmplifier(0.3, 1e-3))
def test_samples_of_noise(logarithm, mean):
    # Closed forms, or the quadrature, against quantiles of the normal distribution.
    stage = Readout(0.8, logarithm, Digitiser(16, 1.2, -0.4))
    sigma = 4e-3
    volts = mean + sigma * norm.ppf((np.arange(400_000) + 0.5) / 400_000)
    samples, saturated = stage.read(volts)
    found = stage.expected(np.array([mean]), np.array([sigma**2]))
    assert found.mean[0] == pytest.approx(samples.mean(), abs=2e-5)
    assert found.variance[0] == pytest.approx(samples.var(), rel=1e-4, abs=1e-15)
    assert found.saturation[0] == pytest.approx(saturated.mean(), abs=1e-5)


def test_samples_fall_on_bins():
    assert Digitiser(8, 1.0).stride(0.3) == 1
    assert Digitiser(8, 1.0, sampling_ghz=1.0).stride(0.25) == 4
    assert Digitiser(8, 1.0, sampling_ghz=0.3).stride(1 / 0.3) == 1
    with pytest.raises(ValueError, match=r"sampling_ghz = 1 must give an integer number of bins of 0.3 ns .* 3.33333"):
        Digitiser(8, 1.0, sampling_ghz=1.0).stride(0.3)
    must_refuse("sampling_ghz = 2", lambda: Digitiser(8, 1.0, sampling_ghz=2.0).stride(1.0))
