"""Behind strong echoes: the baseline behind a coupling capacitor, and the time for which an amplifier is blind."""

from dataclasses import replace

import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, photons_per_joule
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier, Readout
from mitransient_lidar.physics.receiver.sample_moments import sample_moments

ELECTRON = 1.602176634e-19
OHM, COUPLING = 1e4, 300.0
AMPLIFIER = Amplifier(OHM, 3.0, bandwidth_mhz=100.0, coupling_ns=COUPLING)
CHAIN = ReceiverChain(LinearDetector(1.0, leakage_current_na=100.0), AMPLIFIER)


def echo(photons, at=30.0, sigma=2.0, bins=200):
    shape = np.exp(-0.5 * ((np.arange(bins) - at) / sigma) ** 2)
    return photons * shape / shape.sum() / (photons_per_joule(532.0) * 1e-9)


def test_baseline_behind_an_echo():
    """A charge Q leaves -R Q / tau, which recovers as exp(-t / tau); steady light leaves nothing."""
    photons = 1e6
    mean = CHAIN.expected(echo(photons), 1.0, 1e-8).mean
    delay = np.arange(200.0) - 30 - 1e3 / (2 * np.pi * 100)
    drop = OHM * photons * ELECTRON / (COUPLING * 1e-9)
    # 1 + s^2 / (2 tau^2) for the widths of echo and pole, and 0.3 % / 12 for samples that are 1 ns apart.
    np.testing.assert_allclose(mean[80:], -drop * np.exp(-delay[80:] / COUPLING), rtol=1e-4)
    np.testing.assert_allclose(mean[:15], 0, atol=1e-9 * drop)
    direct = replace(CHAIN, amplifier=replace(AMPLIFIER, coupling_ns=None)).expected(echo(photons), 1.0, 1e-8).mean
    current = 1e-8 * photons_per_joule(532.0) * ELECTRON + 1e-7
    np.testing.assert_allclose(direct[:15], OHM * current, rtol=1e-9)


@pytest.mark.slow
def test_records_behind_a_capacitor():
    """Mean and variance of 10 000 records in closed form, and those of the bounds, whose covariance is exact."""
    shots, light = 10_000, echo(3e4)
    expected = CHAIN.expected(light, 1.0, 1e-8)
    record = CHAIN.apply(light, 1.0, shots, 3, 1e-8).signal.astype(np.float64)
    limit = largest_z(shots, 400)
    assert np.max(np.abs(record.mean(axis=0) - expected.mean) / np.sqrt(expected.variance / shots)) < limit
    found = record.var(axis=0, ddof=1)
    assert np.max(np.abs(found / expected.variance - 1)) < limit * np.sqrt(2 / shots)
    exact = sample_moments(CHAIN, light, light[None], 1.0, 1e-8)
    np.testing.assert_allclose(exact.mean, expected.mean, atol=1e-12)
    # The stated neglect: a share of the response time (1.6 ns) over 300 ns of the signal's own variance.
    ratio = np.diagonal(exact.covariance) / expected.variance
    assert np.all((ratio > 1 - 2 * 1.6 / 300) & (ratio < 1.0 + 1e-9))


def test_a_clipped_echo_leaves_its_whole_baseline():
    limited = replace(CHAIN, amplifier=replace(AMPLIFIER, limit_v=0.05))
    plain, clipped = (chain.expected(echo(1e6), 1.0) for chain in (CHAIN, limited))
    assert clipped.saturation[30] == 1
    np.testing.assert_allclose(clipped.mean[60:], plain.mean[60:], rtol=1e-6)


def test_blind_after_an_overload():
    """A sample above the limit holds the 12 samples after it there; the logarithm and the converter follow."""
    volts = np.zeros((2, 60))
    volts[0, 20:25], volts[1, 30] = 2.0, 0.9
    stage = Readout(1.0, LogAmplifier(0.3, 1e-3), Digitiser(12, 1.2, -0.1), hold=12)
    samples, saturated = stage.read(volts)
    np.testing.assert_array_equal(np.flatnonzero(saturated[0]), np.arange(20, 37))
    assert not saturated[1].any()
    np.testing.assert_allclose(samples[0, 20:37], stage.read(np.full(1, 1.0))[0][0])
    np.testing.assert_allclose(samples[0, 37:], 0, atol=3e-4)


def test_moments_of_samples_after_an_overload():
    """Certain overloads: exact. Chances of an overload of 1/2 in one sample: 10 000 records have the stated moments."""
    shots, sigma = 10_000, 0.01
    mean = np.full(40, 0.5)
    mean[10], mean[25] = 2.0, 1.0
    stage = Readout(1.0, hold=5)
    expected = stage.expected(mean, np.full(40, sigma**2))
    samples, saturated = stage.read(mean + sigma * np.random.default_rng(6).standard_normal((shots, 40)))
    assert np.all(expected.saturation[10:16] == 1)
    np.testing.assert_array_equal(expected.mean[10:16], 1.0)
    np.testing.assert_allclose(expected.saturation[25:31], 0.5)
    error = np.sqrt(np.maximum(expected.saturation * (1 - expected.saturation), 1e-9) / shots)
    limit = largest_z(shots, 80)
    assert np.max(np.abs(saturated.mean(axis=0) - expected.saturation) / error) < limit
    varying = expected.variance > 1e-12
    z = (samples.mean(axis=0) - expected.mean)[varying] / np.sqrt(expected.variance[varying] / shots)
    assert np.max(np.abs(z)) < limit
    fourth = ((samples - samples.mean(axis=0)) ** 4).mean(axis=0)[varying]
    found = samples.var(axis=0, ddof=1)[varying]
    spread = np.sqrt(np.maximum(fourth - found**2, (1e-3 * expected.variance[varying]) ** 2) / shots)
    held = np.isin(np.flatnonzero(varying), np.arange(26, 31))
    assert np.max((np.abs(found - expected.variance[varying]) / spread)[~held]) < limit
    # p (1 - p) is largest at 1/2: a share p + d of the records lowers it by 4 d^2.
    np.testing.assert_allclose(found[held], expected.variance[varying][held], rtol=limit**2 / shots)
