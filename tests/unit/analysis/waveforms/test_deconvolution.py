"""Richardson-Lucy iteration: conservation of energy, resolution, and times from its result."""

import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.analysis.waveforms.deconvolution import deconvolution_offset, deconvolved_echo, richardson_lucy
from mitransient_lidar.analysis.waveforms.echo_detection import Records, find_echoes
from mitransient_lidar.analysis.waveforms.echo_shape import Template
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA, Pulse

DT = 0.5
TIME = (np.arange(300) + 0.5) * DT
PULSE = Pulse.gaussian(5.0)
KERNEL = PULSE.kernel(DT)
TEMPLATE = Template.of(PULSE, DT)
SIGMA = TEMPLATE.fwhm_ns / FWHM_PER_SIGMA


def echo(arrival, height=1.0):
    return height * np.exp(-0.5 * ((TIME - np.atleast_1d(arrival)[:, np.newaxis]) / SIGMA) ** 2)


def test_three_iterations_are_those_of_the_formula():
    """Written out with matrices, for a pulse that is not symmetric and reaches past the record's ends."""
    rng = np.random.default_rng(1)
    lags, weights = np.arange(-2, 4), np.array([0.1, 0.3, 0.25, 0.2, 0.1, 0.05])
    y = rng.random((2, 12))
    matrix = np.zeros((12, 12))
    for lag, weight in zip(lags, weights, strict=True):
        matrix += weight * np.eye(12, k=-lag)
    expected = np.repeat(y.mean(axis=1, keepdims=True), 12, axis=1)
    for _ in range(3):
        ratio = (y + 0.1) / (expected @ matrix.T + 0.1)
        expected = expected * (ratio @ matrix) / matrix.sum(axis=0)
    found = richardson_lucy(y, (-2, weights), offset=0.1, iterations=3)
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_energy_is_kept_and_the_result_is_nowhere_negative():
    rng = np.random.default_rng(2)
    y = echo([60.2, 90.7]) + 0.02 * rng.normal(size=(2, TIME.size))
    found = richardson_lucy(y, KERNEL, offset=0.02, iterations=30)
    assert (found >= 0).all()
    clean = richardson_lucy(echo([60.2, 90.7]), KERNEL, iterations=30)
    np.testing.assert_allclose(clean.sum(axis=1), echo([60.2, 90.7]).sum(axis=1), rtol=1e-6)


def test_echoes_that_the_record_merges_are_resolved():
    """0.85 pulse widths apart the record has one maximum."""
    record = echo(60.0) + echo(60.0 + 0.85 * TEMPLATE.fwhm_ns)
    between = slice(int(55 / DT), int(70 / DT))
    assert np.count_nonzero(np.diff(np.sign(np.diff(record[0, between]))) < 0) == 1
    sharp = richardson_lucy(record, KERNEL, iterations=200)[0, between]
    peaks = np.flatnonzero((sharp[1:-1] > sharp[:-2]) & (sharp[1:-1] >= sharp[2:])) + 1
    assert len(peaks) == 2
    assert TIME[between][peaks].tolist() == pytest.approx([60.0, 60.0 + 0.85 * TEMPLATE.fwhm_ns], abs=0.75)


@pytest.mark.parametrize("tau", [0.0, 1.5])
def test_time_without_noise_has_no_bias(tau):
    template, kernel = Template.of(PULSE, DT, tau), PULSE.kernel(DT, tau)
    arrivals = 60 + np.linspace(0, 0.5, 11)
    record = np.interp(TIME - arrivals[:, np.newaxis], template.time_ns, template.power, left=0, right=0)
    records = Records.of(record, TIME)
    found = find_echoes(records, template.fwhm_ns)
    sharp = richardson_lucy(record, kernel, iterations=50)
    echoes = deconvolved_echo(records, sharp, found.surface, template, found.flags[0], template.fwhm_ns)
    offset = deconvolution_offset(template, kernel, DT, template.fwhm_ns)
    assert abs(offset) < 0.05
    np.testing.assert_allclose(echoes.time_ns - offset, arrivals, atol=0.005)
    np.testing.assert_allclose(echoes.energy, record.sum(axis=1) * DT * 1e-9, rtol=0.02)
    assert (echoes.width_ns < 0.5 * template.fwhm_ns).all()


def test_errors_of_time_and_energy_are_those_of_the_noise_within_a_fifth():
    count, noise = 600, 0.02
    rng = np.random.default_rng(5)
    arrivals = 60 + rng.random(count)
    power = echo(arrivals) + noise * rng.normal(size=(count, TIME.size))
    records = Records.of(power, TIME, noise)
    # From early on, in one of 50 sets noise would be a first peak.
    found = find_echoes(records, TEMPLATE.fwhm_ns, earliest_ns=55)
    sharp = richardson_lucy(power, KERNEL, offset=noise, iterations=40)
    got = deconvolved_echo(records, sharp, found.surface, TEMPLATE, found.flags[0], TEMPLATE.fwhm_ns)
    truth = np.sqrt(2 * np.pi) * SIGMA * 1e-9
    for value, error in ((got.time_ns - arrivals, got.time_stderr), (got.energy - truth, got.energy_stderr)):
        assert abs((value / error).std(ddof=1) - 1) < 0.2 + largest_z(count, 2) / np.sqrt(2 * count)
    assert abs(np.mean(got.time_ns - arrivals)) < 0.01
