"""Refraction at a level sea: angles, transmittance, focusing and times."""

import numpy as np
import pytest
from oracles.echo_times import bottom_time_ns, layered_time_ns

from mitransient_lidar.physics.lidar.level_sea import (
    fresnel,
    refract,
    refract_level,
    snell,
    solid_angle_per_area,
    surface_time_ns,
)

THETA, N, HEIGHT = np.radians(20), 1.34, 200.0


def test_refraction_of_a_ray_at_a_slope():
    """Sines of the angles to the normal are in the ratio of the index, and the ray stays in their plane."""
    down = np.array([np.sin(0.35), 0.1, -1.0])
    down /= np.linalg.norm(down)
    normal = np.array([-0.2, 0.1, 1.0])
    ray, unit = refract(down, normal, N), normal / np.linalg.norm(normal)
    assert np.linalg.norm(ray) == pytest.approx(1)
    np.testing.assert_allclose(np.cross(down, unit), N * np.cross(ray, unit), atol=1e-12)


def test_refraction_at_the_level_surface():
    down = np.array([[np.sin(THETA), 0, -np.cos(THETA)], [0, 0, -1], [0.6, -0.8, 0]])
    level = refract_level(down, N)
    np.testing.assert_allclose(level[0], [np.sin(snell(THETA, N)), 0, -np.cos(snell(THETA, N))], rtol=1e-14)
    np.testing.assert_allclose(level, refract(down, np.array([[0, 0, 2.0]]), N), atol=1e-14)


def test_fresnel():
    reflectance, transmittance = fresnel([0, THETA], N)
    np.testing.assert_allclose(reflectance, [0.021112, 0.021298], atol=5e-7)
    np.testing.assert_allclose(transmittance, [1 - 0.021112, 0.978702], atol=5e-7)
    # At Brewster's angle only s-polarised light is reflected: ((n^2 - 1)/(n^2 + 1))^2 / 2.
    assert fresnel(np.arctan(N), N)[0] == pytest.approx(0.5 * ((N**2 - 1) / (N**2 + 1)) ** 2, rel=1e-12)
    assert fresnel(np.pi / 2, N)[0] == pytest.approx(1)


def test_fresnel_from_below():
    inside = snell(THETA, N)
    assert fresnel(inside, 1 / N)[0] == pytest.approx(fresnel(THETA, N)[0], rel=1e-12)
    np.testing.assert_array_equal(fresnel(np.arcsin(1 / N) + np.array([1e-6, 0.3]), 1 / N)[0], [1, 1])


def test_solid_angle_is_the_jacobian_of_the_refracted_path():
    # Spread a small cone of directions in the water and measure the area it covers at the receiver, normal to the ray.
    phi, depth, step = snell(THETA, N), 8.0, 1e-5

    def offset(angle):
        return HEIGHT * np.tan(np.arcsin(N * np.sin(angle))) + depth * np.tan(angle)

    polar = np.cos(THETA) * (offset(phi + step) - offset(phi - step)) / (2 * step)
    sagittal = offset(phi) / np.sin(phi)
    assert solid_angle_per_area(HEIGHT, depth, THETA, N) == pytest.approx(1 / (polar * sagittal), rel=1e-8)


def test_echo_times():
    assert surface_time_ns(HEIGHT, THETA) == pytest.approx(1419.8860, abs=1e-4)
    depth = np.array([1, 2, 4, 8, 10, 16, 20])
    delay = bottom_time_ns(HEIGHT, depth, THETA, N, N) - surface_time_ns(HEIGHT, THETA)
    np.testing.assert_allclose(delay, [9.2458, 18.4915, 36.9830, 73.9660, 92.4576, 147.9321, 184.9151], atol=6e-5)
    # The group index changes the travel time but not the direction.
    delay = bottom_time_ns(HEIGHT, 1, THETA, N, 1.3638) - surface_time_ns(HEIGHT, THETA)
    assert delay == pytest.approx(9.40997, abs=1e-5)


def test_layers_add_up():
    total = bottom_time_ns(HEIGHT, 8, THETA, N, 1.36)
    assert layered_time_ns(HEIGHT, [3, 5], THETA, [N, N], [1.36, 1.36]) == pytest.approx(total, rel=1e-14)
    # A denser lower layer: its segment has sin(theta)/n of the layer itself.
    lower = 2e9 * 1.40 * 5 / np.sqrt(1 - (np.sin(THETA) / 1.38) ** 2) / 299792458
    mixed = layered_time_ns(HEIGHT, [3, 5], THETA, [N, 1.38], [1.36, 1.40])
    assert mixed == pytest.approx(bottom_time_ns(HEIGHT, 3, THETA, N, 1.36) + lower, rel=1e-14)
