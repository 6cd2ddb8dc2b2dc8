"""Pulses, their kernels with the response of the receiver, and waveforms."""

from itertools import pairwise

import numpy as np
import pytest
from rows import each_row, must_refuse
from scipy.integrate import quad
from scipy.stats import exponnorm, norm

from mitransient_lidar.physics.lidar import pulse
from mitransient_lidar.physics.lidar.pulse import Pulse, waveform

SIGMA_5 = 5 / 2.3548200450309493


def test_gaussian_width_and_peak():
    pulse = Pulse.gaussian(5.0)
    step = 1e-4
    density = [np.diff(pulse.cumulative([t - step, t + step]))[0] / (2 * step) for t in (0, 2.5, -2.5)]
    # Peak of a Gaussian of unit energy is 1/(1.064467 FWHM).
    np.testing.assert_allclose(density, np.array([1, 0.5, 0.5]) / (1.064467 * 5), rtol=1e-6)
    assert pulse.cumulative(0.0) == pytest.approx(0.5)


def test_sampled_pulse_is_shifted_and_normalised():
    pulse = Pulse.sampled([10, 11, 14], [0, 6, 0])
    np.testing.assert_allclose(pulse.times_ns, [-1, 0, 3])
    # Triangle of base 4 and unit area
    np.testing.assert_allclose(pulse.power, [0, 0.5, 0])
    np.testing.assert_allclose(pulse.cumulative([-5, -1, 0, 3, 9]), [0, 0, 0.25, 1, 1])
    assert pulse.cumulative(1.5) == pytest.approx(0.25 + 1.5 * 0.375)


@each_row(
    ([10, 11, 14], [0, 6, 0], 2.0), ([0, 4], [1, 1], 4.0), ([0, 4], [0, 1], 2.0), ([0, 1, 3, 4], [0, 1, 1, 0], 3.0)
)
def test_width_of_few_samples(times, power, width):
    """Half of the maximum is crossed between samples: samples above it alone would give 0 and 2 ns."""
    assert Pulse.sampled(times, power).fwhm_ns == pytest.approx(width)


def test_pulse_file_of_an_oscilloscope(tmp_path, caplog):
    """The noise below 0 is cut off; a pulse of the wrong sign is refused."""
    path = tmp_path / "pulse.txt"
    path.write_bytes(b"Model;4711\r\nTime [s];CH1 (mV)\r\n-1e-9;-0,5\r\n0;0\r\n1e-9;40\r\n4e-9;0\r\n")
    pulse = Pulse.from_file(path)
    np.testing.assert_allclose(pulse.times_ns, [-2, -1, 0, 3], rtol=1e-12)
    np.testing.assert_allclose(pulse.power, [0, 0, 0.5, 0], rtol=1e-12)
    assert caplog.messages == [f"{path}: 1 of 4 samples are below 0, down to -0.013 of the largest one, and set to 0"]
    path.write_text("ns, V\n0, 0\n1, -1\n2, 0.1\n")
    must_refuse(r"pulse.txt has power = -1 with a largest one of 0.1: samples must not be", Pulse.from_file, path)


@each_row(0.1, 0.5, 5.0, 200.0)
@each_row(0.0, 1e-4, 2.0, 50.0)
def test_gaussian_kernel(response, bin_width):
    first, weights = Pulse.gaussian(5.0).kernel(bin_width, response)
    assert isinstance(first, int)
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    edges = (first + np.arange(weights.size + 1) - 0.5) * bin_width
    if response == 0 or response >= 2:
        late = exponnorm(response / SIGMA_5, scale=SIGMA_5) if response else norm(scale=SIGMA_5)
        reference = late.cdf(edges)
        np.testing.assert_allclose(weights, np.diff(reference), atol=2e-10)
    if bin_width < 1:
        # The centroid is delayed by the time constant.
        assert np.sum(weights * (edges[:-1] + edges[1:]) / 2) == pytest.approx(response, abs=1e-6)


@pytest.mark.parametrize("response", [0.3, 5.0, 500.0])
def test_sampled_kernel_with_response_matches_quadrature(response):
    pulse = Pulse.sampled([0, 1, 2.5, 6], [0.5, 3, 1, 0])
    first, weights = pulse.kernel(1.0, response)

    def arrived(t):
        lag = t - pulse.times_ns
        points = np.sort(lag[(lag > 0) & (lag < 30 * response)])
        parts = np.concatenate(([0], points, [30 * response]))

        def delayed(u):
            return pulse.cumulative(t - u) * np.exp(-u / response) / response

        return sum(quad(delayed, a, b, epsabs=1e-13)[0] for a, b in pairwise(parts))

    for m in (0, 1, 3, 8):
        expected = arrived(first + m + 0.5) - arrived(first + m - 0.5)
        assert weights[m] == pytest.approx(expected, abs=2e-9)
    assert weights.sum() == pytest.approx(1, abs=1e-9)


def test_waveform_of_one_echo():
    energy = np.zeros((2, 60))
    energy[1, 30] = 2e-12
    first, weights = Pulse.sampled([0, 1, 6], [0, 1, 0]).kernel(0.5)
    power = waveform(energy, 0.5, (first, weights))
    assert not power[0].any()
    # Causal order: the steep edge comes first, so most of the energy arrives after the echo's bin.
    np.testing.assert_allclose(power[1, 30 + first : 30 + first + weights.size], 2e-12 * weights / 0.5e-9)
    assert power[1, :30].sum() < power[1, 31:].sum()
    assert np.sum(power) * 0.5e-9 == pytest.approx(2e-12, rel=1e-12, abs=0)


@pytest.mark.parametrize("longest_direct", [2000, 0])
def test_waveform_matches_direct_sum_within_the_record(longest_direct, monkeypatch):
    monkeypatch.setattr(pulse, "_LONGEST_DIRECT", longest_direct)
    rng = np.random.default_rng(5)
    energy = rng.random((3, 20))
    kernel = (-7, rng.random(40))
    expected = np.zeros_like(energy)
    for t in range(20):
        for m, w in enumerate(kernel[1]):
            if 0 <= t - (m - 7) < 20:
                expected[:, t] += energy[:, t - (m - 7)] * w
    np.testing.assert_allclose(waveform(energy, 2.0, kernel), expected / 2e-9, rtol=1e-12)
    np.testing.assert_array_equal(waveform(energy, 2.0, (25, np.ones(3))), 0)


@each_row(1.0, -1.0)
def test_transforms_light_no_bins_that_no_energy_reaches(sign, monkeypatch):
    """Rounding of the largest power would be light before the surface that is the same in each pass."""
    monkeypatch.setattr(pulse, "_LONGEST_DIRECT", 0)
    energy = np.zeros((2, 300))
    energy[0, 100], energy[1, 200] = sign, np.nan
    power = waveform(energy, 1.0, (-10, np.linspace(1.0, 2.0, 31)))
    assert np.flatnonzero(power[0]).tolist() == list(range(90, 121))
    assert np.flatnonzero(np.isnan(power[1])).tolist() == list(range(190, 221))
