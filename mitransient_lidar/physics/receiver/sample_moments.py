"""Mean and covariance of one record's samples, and their derivatives with respect to the light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite_array, non_negative, non_negative_array, positive
from mitransient_lidar.physics.receiver import detectors
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.electronics import LowPass

_STEP = 1e-3  # events in a cell, or share of the light on a linear detector, in a central difference


class SampleMoments(NamedTuple):
    """Moments of a record's samples before logarithm and converter.

    They are voltages [V], or without an amplifier electrons or counts per bin.
    """

    mean: FloatArray  #: Shape (sample,).
    covariance: FloatArray  #: Shape (sample, sample), with amplifier noise and rounding noise.
    saturation: FloatArray  #: Probability that a sample is saturated, shape (sample,).
    mean_derivatives: FloatArray  #: Derivatives of `mean` in each direction, shape (direction, sample).
    covariance_derivatives: FloatArray  #: Derivatives of `covariance`, shape (direction, sample, sample).


def sample_moments(
    chain: ReceiverChain, power: FloatArray, directions: FloatArray, bin_width_ns: float, background: float = 0.0
) -> SampleMoments:
    """Return mean and covariance of one record's samples, and their derivatives.

    Raises UserError if a number is out of range, or shapes disagree.

    `chain`: the receiver. `power`, shape (time,): mean optical power of the signal on the detector in each bin [W], not
    negative. `directions`, shape (direction, time): changes in the power per unit of a parameter [W/unit], of either
    sign. `bin_width_ns`: bin width [ns], positive. `background`: constant power added to the signal [W], not negative.

    Result: in `ReceiverChain.units`, and per parameter unit.

    The amplifier's low-pass, which filters its own noise and the shot noise alike, correlates neighbouring samples. So
    does the dead time of counters and cells; the covariance is exact for all of these. A converter adds an independent
    variance of step^2/12, after a logarithm times its squared inverse slope at the mean (see `Digitiser`). Derivatives
    are central differences of the closed forms, exact for linear detectors.
    """
    light, changes = non_negative_array("power", power), finite_array("directions", directions)
    width, sky = positive("bin_width_ns", bin_width_ns), non_negative("background", background)
    if light.ndim != 1 or light.size == 0:
        raise UserError(f"power of shape {light.shape} must be one record, of shape (time,)")
    if changes.ndim != 2 or changes.shape[1:] != light.shape:
        raise UserError(f"directions of shape {changes.shape} must have shape (direction, {light.size})")
    low_pass = chain.low_pass(width)
    weights = _weights(low_pass, light.size, chain.stride(width))
    mean, covariance = _detected(chain, light, width, sky, weights)
    means, covariances = np.zeros((len(changes), mean.size)), np.zeros((len(changes), mean.size, mean.size))
    for number, change in enumerate(changes):
        step = _step(chain, light, change, width / low_pass.parts * 1e-9)
        if step > 0:
            above = _detected(chain, light + step * change, width, sky, weights)
            below = _detected(chain, light - step * change, width, sky, weights)
            means[number], covariances[number] = ((up - low) / (2 * step) for up, low in zip(above, below, strict=True))
    saturation = np.zeros_like(mean)
    if chain.amplifier is not None:
        covariance = covariance + _amplifier_noise(chain, mean.size, width)
        readout = chain.readout(width)
        saturation = readout.expected(mean, np.diagonal(covariance)).saturation
        if readout.digitiser is not None:
            rounding = readout.digitiser.step_v**2 / 12
            slope = np.ones_like(mean)
            if readout.logarithm is not None:
                slope = readout.logarithm.expansion(readout.logarithm.compress(mean))
            covariance = covariance + np.diag(rounding * slope**2)
    return SampleMoments(mean, covariance, saturation, means, covariances)


def _weights(low_pass: LowPass, bins: int, stride: int) -> sparse.csr_matrix:
    """Return the weights of bin parts in samples, shape (sample, part)."""
    parts = (bins + low_pass.before + low_pass.after) * low_pass.parts
    size = low_pass.weights.size
    first = np.arange(low_pass.start, parts - size + 1, stride * low_pass.parts)
    columns = first[:, None] + np.arange(size)
    rows = np.repeat(np.arange(first.size), size)
    values = np.tile(low_pass.weights[::-1], first.size)
    return sparse.csr_matrix((values, (rows, columns.ravel())), shape=(first.size, parts))


def _detected(
    chain: ReceiverChain, power: FloatArray, width: float, background: float, weights: sparse.csr_matrix
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of samples by the detector's signal alone; the power may be negative."""
    events = chain.events(power, width, np.asarray(background))
    charge, covariances = chain.detector.moments(events, width / chain.low_pass(width).parts, events.size)
    lags = range(len(covariances))
    between = sparse.diags([*covariances, *covariances[1:]], [*lags, *(-lag for lag in lags[1:])], format="csr")
    volts = 1.0 if chain.amplifier is None else chain.volts_per_electron(width)
    mean = chain.coupled(weights @ charge * volts, width, np.asarray(background))
    covariance = (weights @ between @ weights.T).toarray() * volts**2
    if chain.amplifier is not None:
        step = width * chain.stride(width)
        covariance = chain.amplifier.coupled(chain.amplifier.coupled(covariance, step).T, step)
    return mean, covariance


def _step(chain: ReceiverChain, power: FloatArray, change: FloatArray, seconds: float) -> float:
    """Return the factor of a change in a central difference, 0 where nothing changes."""
    largest = float(np.abs(change).max())
    if largest == 0:
        return 0.0
    # Linear detectors have no error at any step; the largest loses the fewest digits.
    if isinstance(chain.detector, detectors.LinearDetector):
        return float(power.max() or 1.0) / largest
    photons = largest * seconds * detectors.photons_per_joule(chain.wavelength_nm)
    return _STEP * _cells(chain.detector) / photons


def _cells(detector: detectors.SiliconPhotomultiplier | detectors.SinglePhotonDetector) -> int:
    """Return the number of cells or channels that share the light."""
    return detector.channels if isinstance(detector, detectors.SinglePhotonDetector) else detector.cells


def _amplifier_noise(chain: ReceiverChain, samples: int, width: float) -> FloatArray:
    """Return the covariance of the amplifier's own noise."""
    from scipy.linalg import toeplitz

    assert chain.amplifier is not None
    deviation, weights = chain.amplifier.noise(width, chain.stride(width))
    correlation = np.correlate(weights, weights, "full")[weights.size - 1 :]
    column = np.zeros(samples)
    kept = min(samples, correlation.size)
    column[:kept] = correlation[:kept]
    return np.asarray(deviation**2 * toeplitz(column))
