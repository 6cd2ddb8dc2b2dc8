"""Energy and time of shots: variances of echoes against closed forms, and what channels of a shot share."""

from dataclasses import replace

import numpy as np
from rows import each_row
from significance import largest_z

from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, photons_per_joule
from mitransient_lidar.physics.receiver.shot_jitter import ShotJitter, delayed

IDEAL = ReceiverChain(LinearDetector(1.0))
WIDTH, BINS, PHOTONS = 0.5, 240, 2e5
TIME = WIDTH * np.arange(BINS)
SIGMA = 2.0


def echoes(*times, photons=PHOTONS):
    """Powers of echoes of a number of photons each, at times [ns], shape (echo, time)."""
    shape = np.exp(-0.5 * ((TIME - np.array(times)[:, None]) / SIGMA) ** 2)
    return photons * shape / shape.sum(axis=1, keepdims=True) / (photons_per_joule(532.0) * WIDTH * 1e-9)


def centroids(signal, window=slice(None)):
    return (signal[..., window] * TIME[window]).sum(axis=-1) / signal[..., window].sum(axis=-1)


def jittered(**values):
    return replace(IDEAL, jitter=ShotJitter(**values))


def assert_variance(samples, variance):
    shots = len(samples)
    assert abs(samples.var(ddof=1) / variance - 1) < largest_z(shots) * np.sqrt(2 / shots), samples.var() / variance


def test_energy_of_an_echo():
    """Counts of the mean N have the variance N + (e N)^2; the background does not change."""
    shots, rms = 20_000, 0.05
    light, sky = echoes(60.0, photons=1000.0), 1e-9
    record = jittered(energy_rms=rms).apply(light, WIDTH, shots, 1, sky).signal[:, 0].astype(np.float64)
    steady = sky * photons_per_joule(532.0) * WIDTH * 1e-9
    total = record.sum(axis=1)
    mean, variance = 1000 + BINS * steady, 1000 + BINS * steady + (rms * 1000) ** 2
    assert abs(total.mean() - mean) < largest_z(shots) * np.sqrt(variance / shots)
    assert_variance(total, variance)
    dark = record[:, TIME < 40].sum(axis=1)
    assert_variance(dark, (TIME < 40).sum() * steady)


def test_trigger_is_common_to_channels_and_clocks_are_not():
    """Times of echoes: shot noise s^2/N, trigger and clock in each channel; the trigger cancels between channels."""
    shots, trigger, clock = 5000, 0.1, 0.06
    light = echoes(60.0, 63.0)
    # A delay by a part of a bin widens the echo, by the mean of f (1 - f) bins squared.
    noise = (SIGMA**2 + WIDTH**2 / 6) / PHOTONS
    found = centroids(jittered(trigger_ns=trigger).apply(light, WIDTH, shots, 2).signal.astype(np.float64))
    assert_variance(found[:, 0], trigger**2 + noise)
    assert_variance(found[:, 1] - found[:, 0], 2 * noise)
    found = centroids(jittered(clock_ns=clock).apply(light, WIDTH, shots, 3).signal.astype(np.float64))
    assert_variance(found[:, 1] - found[:, 0], 2 * clock**2 + 2 * noise)
    # Within a channel neither changes the time between surface and bottom.
    both = echoes(40.0) + echoes(80.0)
    record = jittered(trigger_ns=trigger, clock_ns=clock).apply(both, WIDTH, shots, 4).signal[:, 0].astype(np.float64)
    surface, bottom = centroids(record, slice(0, 120)), centroids(record, slice(120, None))
    assert_variance(surface, trigger**2 + clock**2 + noise)
    assert_variance(bottom - surface, 2 * noise)


def test_shots_of_a_series_have_their_own_trigger():
    light = np.stack([echoes(60.0, 63.0)] * 3)
    chain = jittered(trigger_ns=0.2, energy_rms=0.1)
    record = chain.apply(light, WIDTH, 1000, 6, series=True).signal.astype(np.float64)
    times, energy = centroids(record), record.sum(axis=-1)
    for values, error in ((times, 2e-2), (energy / PHOTONS, 2e-2)):
        within = np.abs((values[..., 0] - values[..., 0].mean()) - (values[..., 1] - values[..., 1].mean()))
        assert within.max() < 0.5 * error + 0.02
        between = np.corrcoef(values[:, :, 0].T)
        assert np.max(np.abs(between - np.eye(3))) < largest_z(1000, 3) / np.sqrt(1000)


def test_seed_of_what_channels_share():
    chain, light = jittered(trigger_ns=0.2), echoes(60.0)
    one, other = (centroids(chain.apply(light, WIDTH, 200, seed, common_seed=7).signal) for seed in (1, 2))
    # Only shot noise of 0.006 ns differs.
    assert np.abs(one - other).max() < 0.05
    assert np.abs(one - one.mean()).max() > 0.3
    repeated = chain.apply(light, WIDTH, 200, 1, common_seed=7).signal
    np.testing.assert_array_equal(centroids(repeated), one)


@each_row(-300.0, -7.25, -0.4, 0.0, 0.75, 3.0, 11.5, 300.0)
def test_delays_keep_energy_and_move_the_centroid(bins):
    light = echoes(60.0, 63.0)
    found = delayed(light, np.full((1, 2), bins))[0]
    if abs(bins) > BINS:
        assert not found.any()
        return
    np.testing.assert_allclose(found.sum(axis=1), light.sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(centroids(found), centroids(light) + WIDTH * bins, rtol=1e-9)


def test_edges_of_a_record_are_dark():
    ramp = np.arange(1.0, 5.0)[None]
    np.testing.assert_allclose(delayed(ramp, np.array([[1.5]]))[0, 0], [0, 0.5, 1.5, 2.5])
    np.testing.assert_allclose(delayed(ramp, np.array([[-2.5]]))[0, 0], [3.5, 2.0, 0, 0])
