"""Beam spread function against quadrature, an independent walk of small steps, and exact moments."""

import dataclasses

import numpy as np
import pytest
from oracles.beam_spread import delay_density, delay_laplace, fluence, irradiance, radius_rms
from scipy.integrate import quad
from significance import largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.small_angle import BeamSpread

NS = 1e-9
BEAM = BeamSpread(depth=8.0, absorption=0.15, scattering=1.0, mean_cosine=0.98, group_index=1.34)
UNEVEN = dataclasses.replace(BEAM, mean_fourth_angle=5e-3)
CLEAR = dataclasses.replace(BEAM, absorption=0.0)


def moment(beam, power):
    """Moment of the delays in units of the mean; the substitution u^4 = tau removes the singularity at 0."""
    mean = beam.mean_delay
    return quad(lambda u: delay_density(beam, u**4 * mean) * mean * 4 * u**3 * u ** (4 * power), 0, 4, limit=200)[0]


@pytest.mark.parametrize("beam", [BEAM, UNEVEN])
def test_delay_density(beam):
    assert moment(beam, 0) == pytest.approx(1, rel=1e-7)
    assert moment(beam, 1) == pytest.approx(1, rel=1e-7)
    assert moment(beam, 2) - 1 == pytest.approx(beam.delay_variance / beam.mean_delay**2, rel=1e-6)
    assert np.array_equal(delay_density(beam, [-1 * NS, 0.0]), [0, 0])


def test_numbers_by_hand():
    # b z = 8, <Theta^2> = 0.04: mu = (z/v) 0.08, sigma^2 = (z/v)^2 0.32^2/24, r^2 = 0.32 64/3.
    transit = 8 * 1.34 / C0
    assert BEAM.mean_delay == pytest.approx(0.08 * transit)
    assert BEAM.delay_variance == pytest.approx(0.1024 / 24 * transit**2, rel=1e-12, abs=0)
    assert BEAM.mean_delay**2 / BEAM.delay_variance == pytest.approx(1.5)
    assert radius_rms(BEAM) == pytest.approx(2.612789, rel=1e-6)
    assert BEAM.unscattered == pytest.approx(1.01039e-4, rel=1e-5)


@pytest.mark.parametrize("delay", [0.3 * NS, 3 * NS])
def test_spot_at_one_delay(delay):
    density = delay_density(CLEAR, delay) * (1 - np.exp(-8))
    stretch = C0 / 1.34 * delay
    reach = 12 * np.sqrt(stretch * 8)
    total = quad(lambda r: irradiance(CLEAR, r, delay) * 2 * np.pi * r, 0, reach)[0]
    square = quad(lambda r: irradiance(CLEAR, r, delay) * 2 * np.pi * r**3, 0, reach)[0]
    assert total == pytest.approx(density, rel=1e-8)
    assert square / total == pytest.approx(4 * stretch * 8 / 3, rel=1e-8)


@pytest.mark.parametrize("beam", [BEAM, UNEVEN])
@pytest.mark.parametrize("radius", [0.2, 1.5, 6.0])
def test_fluence_is_the_irradiance_over_all_delays(beam, radius):
    mean = beam.mean_delay
    total = quad(lambda u: irradiance(beam, radius, u**4 * mean) * mean * 4 * u**3, 0, 4, limit=200)[0]
    assert fluence(beam, radius) == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("beam", [BEAM, UNEVEN])
@pytest.mark.parametrize("radius", [0.5, 3.0, 40.0])
def test_encircled_is_the_fluence_over_a_circle(beam, radius):
    # r = u^4: the fluence of the uneven beam (k < 1) is singular on the axis.
    top = radius**0.25
    total = quad(lambda u: fluence(beam, u**4) * 2 * np.pi * u**4 * 4 * u**3, 1e-9, top, limit=200)[0]
    assert beam.encircled(radius) == pytest.approx(total, rel=1e-6)


def test_encircled_limits():
    assert BEAM.encircled(0.0) == pytest.approx(0, abs=1e-12)
    assert BEAM.encircled(1e4) == pytest.approx(BEAM.transmittance, rel=1e-12)


def test_on_the_axis():
    # Van de Hulst and Kattawar (1994): the mean delay on the axis is (z/v) b z <Theta^2>/12, a third of the total mean.
    mean = CLEAR.mean_delay
    first = quad(lambda u: irradiance(CLEAR, 0, u**4 * mean) * mean * 4 * u**7 * mean, 0, 4, limit=200)[0]
    assert first / fluence(CLEAR, 0) == pytest.approx(8 * 1.34 / C0 * 0.32 / 12, rel=1e-6, abs=0)
    assert UNEVEN.mean_delay**2 < UNEVEN.delay_variance
    assert fluence(UNEVEN, 0) == np.inf


def test_transmittance_absorbs_on_detours():
    beam = dataclasses.replace(BEAM, absorption=0.8)
    mean, decay = beam.mean_delay, 0.8 * C0 / 1.34
    late = quad(lambda u: delay_density(beam, u**4 * mean) * mean * 4 * u**3 * np.exp(-decay * u**4 * mean), 0, 4)[0]
    assert late < 0.7
    assert beam.transmittance == pytest.approx((1 - np.exp(-8)) * np.exp(-6.4) * late, rel=1e-6)
    assert CLEAR.transmittance == pytest.approx(1 - np.exp(-8), rel=1e-12)


def test_gamma_agrees_with_the_exact_transform_to_second_order():
    def difference(x):
        s = x / BEAM.mean_delay
        gamma = (1 + x * BEAM.delay_variance / BEAM.mean_delay**2) ** -1.5
        return float(delay_laplace(BEAM, s)) - gamma

    # Third order: the difference grows 8-fold when s doubles, to the next order in s.
    assert abs(difference(0.02)) < 1e-5
    assert difference(0.02) / difference(0.01) == pytest.approx(8, rel=0.05)


def test_moments_of_the_exact_transform():
    h = 0.01
    value = delay_laplace(BEAM, np.arange(4) * h / BEAM.mean_delay)
    # One-sided differences of second order in h.
    first = (-1.5 * value[0] + 2 * value[1] - 0.5 * value[2]) / h
    second = (2 * value[0] - 5 * value[1] + 4 * value[2] - value[3]) / h**2
    assert -first == pytest.approx(1, rel=1e-3)
    assert second - first**2 == pytest.approx(2 / 3, rel=5e-3)


def test_small_step_walk():
    """Exponential flights and Gaussian deflections in the small-angle limit have the moments of the closed forms."""
    rng = np.random.default_rng(20240611)
    count, z, b, square = 200_000, 8.0, 1.5, 2 * (1 - 0.98)
    # Two Gaussian angles of variance <Theta^2>/2 each have <Theta^4> = 2 <Theta^2>^2.
    beam = BeamSpread(z, 0.15, b, 0.98, group_index=1.34, mean_fourth_angle=2 * square**2)
    depth, detour = np.zeros(count), np.zeros(count)
    place, angle = np.zeros((2, count)), np.zeros((2, count))
    while np.any(depth < z):
        step = np.minimum(rng.exponential(1 / b, count), z - depth)
        place += angle * step
        detour += np.sum(angle**2, axis=0) / 2 * step
        depth += step
        angle += rng.normal(0, np.sqrt(square / 2), (2, count))
    delay = detour / beam.speed
    radius_square = np.sum(place**2, axis=0)

    def deviation(samples, expected):
        return (samples.mean() - expected) / (samples.std() / np.sqrt(count))

    limit = largest_z(count, 3)
    assert abs(deviation(delay, beam.mean_delay)) < limit
    assert abs(deviation((delay - beam.mean_delay) ** 2, beam.delay_variance)) < limit
    assert abs(deviation(radius_square, radius_rms(beam) ** 2)) < limit
    # The term in <Theta^4> is a third of the other one here, so leaving it out would show.
    even = dataclasses.replace(beam, mean_fourth_angle=0.0)
    assert deviation((delay - even.mean_delay) ** 2, even.delay_variance) > 10


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("depth", 0, "depth = 0 must be greater than 0"),
        ("absorption", -0.1, "absorption = -0.1 must not be negative"),
        ("scattering", 0, "scattering = 0 must be greater than 0"),
        ("mean_cosine", 1, "mean_cosine = 1 must be at least 0 and below 1"),
        ("mean_cosine", -0.2, "mean_cosine = -0.2 must be at least 0 and below 1"),
        ("group_index", 0.9, "group_index = 0.9 must be at least 1"),
        ("mean_fourth_angle", -1, "mean_fourth_angle = -1 must not be negative"),
        ("depth", "deep", "depth = 'deep' must be a number"),
    ],
)
def test_rejected_parameters(name, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(BEAM, **{name: value})


def test_negative_radii_are_rejected():
    with pytest.raises(ValueError, match="radius = -1 must not be negative"):
        BEAM.encircled([1.0, -1.0])
