"""Mean, covariance and derivatives of samples against simulated records."""

import numpy as np
import pytest
from differentiated import PHOTON
from rows import each_row
from significance import largest_z

from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser
from mitransient_lidar.physics.receiver.receiver_files import RECEIVERS
from mitransient_lidar.physics.receiver.sample_moments import sample_moments

T = np.arange(24.0)
PULSE = np.exp(-0.5 * ((T - 10) / 3) ** 2)
CHAINS = {
    "electrons": (RECEIVERS["ideal"], 40.0),
    "apd": (RECEIVERS["apd"], 2000.0),
    "pmt of 1 GHz": (RECEIVERS["pmt"], 200.0),
    "gaussian": (
        ReceiverChain(LinearDetector(1.0), Amplifier(1e5, 1.0, bandwidth_mhz=250.0, response="gaussian")),
        1e5,
    ),
    "sipm": (RECEIVERS["sipm"], 400.0),
    "counter": (ReceiverChain(SinglePhotonDetector(0.5, 3.5)), 0.6),
    "counters": (RECEIVERS["spad_array"], 20.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHAINS)
def test_covariance_is_that_of_records(name):
    """All elements of the covariance of 20 000 records, with standard errors from their fourth moments."""
    chain, photons = CHAINS[name]
    power = photons * PHOTON * (PULSE + 0.02)
    moments = sample_moments(chain, power, np.zeros((0, T.size)), 1.0, 0.1 * PHOTON)
    signal = chain.apply(power, 1.0, 20_000, 3, 0.1 * PHOTON).signal.astype(float)
    centred = signal - moments.mean
    error = signal.std(axis=0, ddof=1) / np.sqrt(len(signal))
    assert np.max(np.abs(centred.mean(axis=0)) / error) < largest_z(20_000, T.size)
    products = centred[:, :, None] * centred[:, None, :]
    spread = products.std(axis=0, ddof=1) / np.sqrt(len(signal))
    z = (products.mean(axis=0) - moments.covariance) / spread
    assert np.max(np.abs(z)) < largest_z(20_000, T.size**2)
    assert np.all(np.linalg.eigvalsh(moments.covariance) > -1e-12 * moments.covariance.max())


@each_row(*CHAINS)
def test_derivatives_are_those_of_the_closed_forms(name):
    """The gain by more light everywhere is that between two closed forms of `expected`, for mean and variance."""
    chain, photons = CHAINS[name]
    power = photons * PHOTON * (PULSE + 0.02)
    change = photons * PHOTON * (0.3 + np.cos(T))
    step = 5e-3
    # `expected` filters by Fourier transforms, which lose some digits.
    above, below = (
        chain._unlimited(np.maximum(power + sign * step * change, 0), 1.0, 0.1 * photons * PHOTON) for sign in (1, -1)
    )
    moments = sample_moments(chain, power, np.stack([change, 0 * change]), 1.0, 0.1 * photons * PHOTON)
    for number, found in enumerate((moments.mean_derivatives[0], np.diagonal(moments.covariance_derivatives[0]))):
        expected = (above[number] - below[number]) / (2 * step)
        np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
    assert not moments.mean_derivatives[1].any()
    assert not moments.covariance_derivatives[1].any()


def test_samples_are_taken_at_the_rate_of_the_converter():
    chain = ReceiverChain(LinearDetector(1.0), Amplifier(1e4, 1.0), digitiser=Digitiser(12, 1.0, sampling_ghz=0.5))
    moments = sample_moments(chain, PHOTON * PULSE, PHOTON * PULSE[None], 0.5)
    assert moments.covariance.shape == (6, 6)
    np.testing.assert_allclose(moments.mean, moments.mean_derivatives[0])
    assert np.argmax(moments.mean) == np.argmax(PULSE[::4])
