"""Ripples on tilted facets against a count of normals, and the limits in which slopes add."""

import itertools

import numpy as np
import pytest
from oracles.two_scale import two_scale_ratio
from significance import largest_z

FACETS, RIPPLES = (0.012, 0.007), (0.008, 0.0075)


@pytest.mark.slow
def test_ratio_against_normals_drawn_at_random():
    """Two million facets with one ripple each: the area whose normal lies within 1.5 degrees of the ray."""
    rng = np.random.default_rng(7)
    count = 2_000_000
    slope = rng.normal(size=(count, 2)) * np.sqrt(FACETS)
    ripple = rng.normal(size=(count, 2)) * np.sqrt(RIPPLES)
    n = np.column_stack([-slope, np.ones(count)])
    area = np.linalg.norm(n, axis=1)  # of a facet over one square metre
    n /= area[:, None]
    s = np.column_stack([np.ones(count), np.zeros(count), slope[:, 0]])
    s -= np.sum(s * n, axis=1, keepdims=True) * n
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    m = n - ripple[:, [0]] * s - ripple[:, [1]] * np.cross(n, s)
    stretch = np.linalg.norm(m, axis=1)  # area of a ripple over its part of the facet
    half, total = np.radians(1.5), np.add(FACETS, RIPPLES)
    for theta, azimuth in itertools.product((0.0, 0.18, 0.35), (0.0, 1.1, 3.0)):
        ray = np.array([-np.sin(theta) * np.cos(azimuth), -np.sin(theta) * np.sin(azimuth), np.cos(theta)])
        within = m @ ray > np.cos(half) * stretch
        found = np.where(within, area * stretch, 0)
        tilt = np.tan(theta) * np.array([np.cos(azimuth), np.sin(azimuth)])
        gaussian = np.exp(-0.5 * np.sum(tilt**2 / total)) / (2 * np.pi * np.sqrt(np.prod(total))) / np.cos(theta) ** 4
        expected = gaussian * two_scale_ratio(FACETS, RIPPLES, theta, azimuth) * 2 * np.pi * (1 - np.cos(half))
        error = found.std() / np.sqrt(count)
        # The density is not quite even over the cone: up to 0.5 % at 20 degrees.
        assert abs(found.mean() - expected) < largest_z(count, 9) * error + 0.005 * expected
        assert error < 0.05 * expected


def test_slopes_add_when_facets_or_ripples_are_almost_flat():
    assert two_scale_ratio((1e-7, 1e-7), (0.01, 0.01), 0.3) == pytest.approx(1, abs=1e-4)
    # Ripples of 3 mrad about facets that the quadrature resolves.
    assert two_scale_ratio((0.01, 0.01), (4e-4, 4e-4), 0.2) == pytest.approx(1, abs=0.02)


def test_tail_is_brighter_and_the_middle_less_so():
    """Light wind at 20 degrees, where the slope that reflects is 3.7 standard deviations."""
    light = two_scale_ratio((0.00647, 0.00353), (0.00301, 0.00523), np.radians(20))
    assert 1.15 < light < 1.3
    assert 0.95 < two_scale_ratio((0.0145, 0.0092), (0.0171, 0.0130), np.radians(20)) < 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.0, 0.01), RIPPLES, 0.1), "facet_variance = 0 must be greater than 0"),
        ((FACETS, (0.01, -1.0), 0.1), "ripple_variance = -1 must be greater than 0"),
        ((FACETS, RIPPLES, 1.3), "theta = 1.3 must lie between 0 and 1.2"),
    ],
)
def test_bad_parameters_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        two_scale_ratio(*arguments)
