"""Beam spread function of the oracles against quadrature, and an independent walk of small steps."""

import dataclasses

import numpy as np
import pytest
from oracles.beam_spread import BeamSpread
from scipy import stats
from scipy.integrate import quad
from significance import largest_z

from mitransient_lidar.core.constants import C0

BEAM = BeamSpread(depth=8.0, absorption=0.15, scattering=1.0, mean_cosine=0.98, group_index=1.34)
UNEVEN = dataclasses.replace(BEAM, mean_fourth_angle=5e-3)


def test_numbers_by_hand():
    # b z = 8, <Theta^2> = 0.04: mu = (z/v) 0.08, sigma^2 = (z/v)^2 0.32^2/24, r^2 = 0.32 64/3.
    transit = 8 * 1.34 / C0
    assert BEAM.mean_delay == pytest.approx(0.08 * transit)
    assert BEAM.delay_variance == pytest.approx(0.1024 / 24 * transit**2, rel=1e-12, abs=0)
    assert BEAM.radius_rms == pytest.approx(2.612789, rel=1e-6)
    assert BEAM.unscattered == pytest.approx(1.01039e-4, rel=1e-5)


@pytest.mark.parametrize("beam", [BEAM, UNEVEN])
@pytest.mark.parametrize("radius", [0.5, 3.0, 1e4])
def test_encircled_is_the_integral_over_all_delays(beam, radius):
    """Gamma-distributed delays, absorption along the detours, and a Gaussian spot that grows with the delay."""
    mean, variance = beam.mean_delay, beam.delay_variance
    density = stats.gamma(mean**2 / variance, scale=variance / mean).pdf

    def integrand(u):
        # The substitution u^4 = tau removes the singularity at 0.
        tau = u**4 * mean
        inside = -np.expm1(-3 * radius**2 / (4 * beam.speed * tau * beam.depth))
        return density(tau) * np.exp(-beam.absorption * beam.speed * tau) * inside * 4 * u**3 * mean

    total = quad(integrand, 1e-9, 4, limit=200)[0] * -np.expm1(-8.0) * np.exp(-beam.absorption * beam.depth)
    assert beam.encircled(radius) == pytest.approx(total, rel=1e-6)


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
    assert abs(deviation(radius_square, beam.radius_rms**2)) < limit
    # The term in <Theta^4> is a third of the other one here, so leaving it out would show.
    even = dataclasses.replace(beam, mean_fourth_angle=0.0)
    assert deviation((delay - even.mean_delay) ** 2, even.delay_variance) > 10
