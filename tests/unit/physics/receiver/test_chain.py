"""Receiver chains: 10 000 shots against the closed form, and that against numbers made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver import chain as receiver_chain
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import (
    LinearDetector,
    SiliconPhotomultiplier,
    SinglePhotonDetector,
    photons_per_joule,
)
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser, LogAmplifier
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS

SHOTS = 10_000
ELECTRON = 1.602176634e-19
PHOTON = 6.62607015e-34 * 299792458 / 532e-9  # J


def power(bins=64, scale=1.0):
    t = np.arange(bins)
    water = np.where(t > 12, np.exp(-(t - 12) / 20), 0)
    pulse = 5 * np.exp(-0.5 * ((t - 12) / 2) ** 2) + np.exp(-0.5 * ((t - 45) / 2) ** 2)
    return scale * np.stack([pulse + water + 0.3, 0.3 * (pulse + water) + 0.2])


def assert_expected(record, expected, shots=SHOTS, fewest=-np.inf):
    """Compare shots with mean, variance and saturation, in samples that have `fewest` counts or more."""
    limit = largest_z(shots, 3 * expected.mean.size)
    error = np.sqrt(np.maximum(expected.saturation * (1 - expected.saturation), 1e-3) / shots)
    assert np.max(np.abs(record.saturated.mean(axis=0) - expected.saturation) / error) < limit
    # Where all but a few samples are at a limit, those few make the variance.
    often = (expected.mean * shots >= fewest) & ((1 - expected.saturation) * shots > 100)
    samples = record.signal.astype(np.float64)[:, often]
    mean, variance = expected.mean[often], expected.variance[often]
    found = samples.var(axis=0, ddof=1)
    fourth = ((samples - samples.mean(axis=0)) ** 4).mean(axis=0)
    rounding = 1e-6 * np.max(np.abs(mean))  # of 32 bits
    z = (samples.mean(axis=0) - mean) / np.sqrt(variance / shots + rounding**2)
    assert np.max(np.abs(z)) < limit
    error = np.sqrt((fourth - found**2) / shots + rounding**4)
    assert np.max(np.abs(found - variance) / error) < limit


DIODE = LinearDetector(0.6)
BRIGHT = 2e-6  # W: some thousand photoelectrons a bin
STAGES = {
    "photons": (ReceiverChain(DIODE), 1e-8),
    "dark": (ReceiverChain(LinearDetector(0.6, dark_current_na=3.0, leakage_current_na=5.0)), 0.0),
    "avalanche": (ReceiverChain(LinearDetector.avalanche(0.6, 100.0, 0.02)), 1e-8),
    "tube": (ReceiverChain(LinearDetector.photomultiplier(0.2, [5.0, 4.0, 4.0])), 1e-7),
    "cells": (ReceiverChain(SiliconPhotomultiplier(0.3, 200, 10.0, 0.1, 1e6, 1e6, 0.1)), 3e-8),
    "counter": (ReceiverChain(SinglePhotonDetector(0.5, 10.0, 1e6)), 3e-10),
    "paralysed counter": (ReceiverChain(SinglePhotonDetector(0.5, 10.0, paralyzable=True)), 1e-10),
    "four counters": (ReceiverChain(SinglePhotonDetector(0.5, 10.0, 1e6, channels=4)), 1e-9),
    "amplifier": (ReceiverChain(DIODE, Amplifier(1e4, 5.0, load_ohm=1e3)), 0.0),
    "amplifier and pole": (ReceiverChain(DIODE, Amplifier(1e4, 5.0, bandwidth_mhz=80.0)), 0.0),
    "photons and Gaussian": (ReceiverChain(DIODE, Amplifier(1e4, bandwidth_mhz=80.0, response="gaussian")), 1e-8),
    "cells and pole": (
        ReceiverChain(SiliconPhotomultiplier(0.3, 300, 9.0, 0.1), Amplifier(1e4, bandwidth_mhz=60.0)),
        3e-8,
    ),
    "limit": (ReceiverChain(DIODE, Amplifier(1e4, 5.0, limit_v=9e-3)), BRIGHT),
    "digitiser": (ReceiverChain(DIODE, Amplifier(1e4, 5.0), digitiser=Digitiser(8, 0.1, -0.02)), BRIGHT),
    "coarse digitiser": (ReceiverChain(DIODE, Amplifier(1e4, 9.0), digitiser=Digitiser(5, 0.03, 0.0)), BRIGHT),
    "logarithm": (ReceiverChain(DIODE, Amplifier(1e4, 5.0), LogAmplifier(0.2, 2e-3)), BRIGHT),
    "together": (
        ReceiverChain(
            LinearDetector.avalanche(0.6, 20.0, 0.02, 0.1, 10.0),
            Amplifier(2e3, 20.0, load_ohm=1e4, bandwidth_mhz=120.0, limit_v=0.15),
            LogAmplifier(0.2, 2e-3),
            Digitiser(12, 0.6, -0.1, sampling_ghz=0.5),
        ),
        BRIGHT,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGES)
def test_stages_alone_and_together(name):
    chain, scale = STAGES[name]
    light = power(scale=scale)
    fewest = 100 if isinstance(chain.detector, SinglePhotonDetector) else -np.inf
    assert_expected(chain.apply(light, 1.0, SHOTS, 11, 3e-10), chain.expected(light, 1.0, 3e-10), fewest=fewest)


def test_signal_and_shot_noise_by_hand():
    # Steady light: signal R = P eta e/(h nu) M, shot noise 2 e R M F per Hz over the noise bandwidth pi/2 f.
    gain, noise, ohm, frequency = 50.0, 2.96, 1e4, 40e6
    detector = LinearDetector(0.6, gain, noise)
    chain = ReceiverChain(detector, Amplifier(ohm, 4.0, bandwidth_mhz=40.0))
    expected = chain.expected(np.full(3000, 1e-8), 0.02, 2e-9)
    current = 1.2e-8 * 0.6 * ELECTRON / PHOTON
    density = 2 * ELECTRON * current * gain**2 * noise + (4e-12) ** 2
    assert expected.mean[-1] == pytest.approx(current * gain * ohm, rel=1e-6)
    assert expected.variance[-1] == pytest.approx(density * np.pi / 2 * frequency * ohm**2, rel=4e-3)
    # The background is not signal.
    snr = chain.snr(np.full(3000, 1e-8), 0.02, 2e-9)[-1]
    assert snr == pytest.approx(current / 1.2 * gain / np.sqrt(density * np.pi / 2 * frequency), rel=4e-3)
    # Before the record there is the background alone: the first bin has not risen, its noise has.
    assert expected.mean[0] < 0.25 * expected.mean[-1]
    dark = chain.expected(np.zeros(600), 0.02, 2e-9)
    np.testing.assert_allclose(dark.variance, dark.variance[-1], rtol=1e-9)


@pytest.mark.parametrize("response", ["single_pole", "gaussian"])
@pytest.mark.parametrize("width", [2.0, 0.2])
def test_noise_of_steady_light_does_not_depend_on_the_bins(width, response):
    """2 q I F times the noise bandwidth, and the same with the amplifier's density, to the 0.5 % of the parts."""
    detector = LinearDetector(0.6, 50.0, 2.96)
    chain = ReceiverChain(detector, Amplifier(1e4, 4.0, bandwidth_mhz=200.0, response=response))
    middle = math.ceil(20 / width)
    light = np.full(2 * middle, 1e-7)
    current = 1e-7 * 0.6 * ELECTRON / PHOTON
    density = 2 * ELECTRON * current * 50**2 * 2.96 + (4e-12) ** 2
    factor = np.pi / 2 if response == "single_pole" else np.sqrt(np.pi / np.log(16))
    expected = chain.expected(light, width).variance[middle]
    assert expected == pytest.approx(density * factor * 200e6 * 1e4**2, rel=6e-3, abs=0)
    # Shots agree: of n normal samples the variance has the relative error sqrt(2/n).
    shots = 4000
    found = chain.apply(light, width, shots, 21).signal[:, middle].astype(np.float64).var(ddof=1)
    assert abs(found / expected - 1) < largest_z(shots, 4) * np.sqrt(2 / shots)


def test_every_record_has_its_own_background():
    chain = replace(RECEIVERS["pmt"], digitiser=Digitiser(10, 1.0, -0.05, sampling_ghz=0.25))
    mean = chain.expected(np.zeros((2, 3, 30)), 1.0, 1e-7 * np.arange(6).reshape(2, 3)).mean
    assert mean.shape == (2, 3, 8)
    np.testing.assert_allclose(np.diff(mean[..., 4].ravel()), mean[0, 1, 4] - mean[0, 0, 4])
    assert np.all(chain.snr(np.zeros((2, 3, 30)), 1.0, 1e-7 * np.arange(6).reshape(2, 3)) == 0)
    stuck = ReceiverChain(DIODE, Amplifier(1e4, 5.0, limit_v=1e-3))
    assert np.isnan(stuck.snr([1e-4], 1.0)[0])


def test_seeds_repeat_and_blocks_of_shots_differ(monkeypatch):
    monkeypatch.setattr(receiver_chain, "_BLOCK", 2**11)
    chain, light = RECEIVERS["apd"], power(scale=1e-7)
    one, two, three = (chain.apply(light, 1.0, 40, seed).signal for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, two)
    assert len(np.unique(np.concatenate([one[:, 0], three[:, 0]]), axis=0)) == 80


def test_fitting_gain_and_attenuation_in_closed_form():
    """Shot noise alone: N photons reach N + 6 sqrt(N) electrons, and N/a + 6 sqrt(N/a) are those of the limit."""
    bins, limit = 1.0, 0.5
    chain = ReceiverChain(LinearDetector(1.0), Amplifier(1e3, limit_v=limit))
    volts = 1e3 * 1.602176634e-19 / 1e-9
    capacity = limit / volts
    photons = np.array([[0.01, 4.0], [2.0, 0.3]]) * capacity
    power = photons * 6.62607015e-34 * 299792458 / 532e-9 / 1e-9
    most = 4 * capacity
    assert chain.fitting_gain(power, bins) == pytest.approx(capacity / (most + 6 * np.sqrt(most)))
    root = -3 + np.sqrt(9 + capacity)
    assert chain.fitting_attenuation(power, bins) == pytest.approx(most / root**2, rel=1e-5)
    # A background counts, and samples that are left out do not.
    assert chain.fitting_gain(power, bins, samples=slice(0, 1)) == pytest.approx(
        capacity / (2 * capacity + 6 * np.sqrt(2 * capacity))
    )
    more = chain.fitting_attenuation(power, bins, background=power[0, 1])
    assert more == pytest.approx(2 * most / root**2, rel=1e-5)
    assert chain.fitting_attenuation(0.1 * power, bins) == chain.fitting_gain(0.1 * power, bins) == 1


def test_gain_of_a_photomultiplier_is_that_of_its_dynodes():
    """The excess noise of the tube grows, and the amplifier's noise stays: the largest gain is a root of both."""
    limit, noise = 0.5, Amplifier(1e3, noise_pa_per_rthz=30.0, bandwidth_mhz=100.0)
    tube = LinearDetector.photomultiplier(0.2, (5.0, 4.0, 4.0), largest_current_ma=1e3 * limit / 1e3)
    chain = ReceiverChain(tube, noise)
    lower = chain.with_gain(0.125)
    assert lower.amplifier == chain.amplifier
    np.testing.assert_allclose(lower.detector.dynode_gains, (2.5, 2.0, 2.0))
    assert lower.detector.gain == pytest.approx(10.0)
    # 1 + 1/2.5 + 1/5 + 1/10
    assert lower.detector.excess_noise == pytest.approx(1.7)
    # The largest current saturates, 0.5 mA or 0.5 V here, ten times exceeded.
    light = np.full(400, 10 * limit / 1e3 / (tube.gain * 0.2 * 1.602176634e-19 * photons_per_joule(532.0)))
    assert chain.expected(light, 1.0).saturation[200] == pytest.approx(1)
    factor = chain.fitting_gain(light, 1.0)
    fitted = chain.with_gain(factor)
    assert fitted.expected(light, 1.0).saturation.max() < 1e-8
    unlimited = replace(fitted, detector=replace(fitted.detector, largest_current_ma=np.inf))
    mean, variance = (float(each[200]) for each in unlimited.expected(light, 1.0)[:2])
    assert mean + 6 * np.sqrt(variance) == pytest.approx(limit, rel=1e-6)
    with pytest.raises(UserError, match=r"gain = 0.001 must be above 0.0156, for gains of all dynodes above 1"):
        chain.with_gain(1e-3)
    assert chain.fitting_gain(1e4 * light, 1.0) == 0
    with pytest.raises(ValueError, match="largest_current_ma = 0 must be greater than 0"):
        LinearDetector.photomultiplier(0.2, (5.0,), largest_current_ma=0.0)


def test_noise_of_the_avalanche_photodiode():
    """Data sheet of C30902EH: 15 nA, and 0.23 pA per root Hz, whose square is 2 e (I + i M^2 F), at a gain of 150."""
    diode = RECEIVERS["apd"].detector
    assert diode.leakage_current_na + diode.gain * diode.dark_current_na == pytest.approx(15, rel=0.01)
    current = 1e-9 * (diode.leakage_current_na + diode.dark_current_na * diode.gain**2 * diode.excess_noise)
    assert np.sqrt(2 * 1.602176634e-19 * current) == pytest.approx(0.23e-12, rel=0.01)
