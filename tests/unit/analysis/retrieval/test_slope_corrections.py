"""Rays through sloping surfaces, against Snell's law for vectors and pencils of traced rays."""

import math

import numpy as np
import pytest
from oracles.lidar_equation import cos_water

from mitransient_lidar.analysis.retrieval.surface_slope import SlopeRefraction, bottom_depth, bottom_gain, variances
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, snell

THETA, N = math.radians(20), 1.34
RANGE = 200 / math.cos(THETA)


def refract(ray, normal, ratio):
    """Refract unit rays, shape (..., 3), by keeping what is tangential: n1 d x m = n2 w x m."""
    tangent = ratio * (ray - np.sum(ray * normal, axis=-1, keepdims=True) * normal)
    into = np.sign(np.sum(ray * normal, axis=-1, keepdims=True))
    return tangent + into * np.sqrt(1 - np.sum(tangent**2, axis=-1, keepdims=True)) * normal


@pytest.mark.parametrize(("along", "across"), [(0, 0), (0.2, 0), (-0.15, 0.1), (0.05, -0.3)])
def test_refraction_keeps_the_tangential_part(along, across):
    normal = np.array([-along, -across, 1]) / math.sqrt(1 + along**2 + across**2)
    ray = np.array([math.sin(THETA), 0, -math.cos(THETA)])
    water = refract(ray, normal, 1 / N)
    found = SlopeRefraction.of(along, across, THETA, N)
    assert found.cos_vertical == pytest.approx(-water[2], abs=1e-12)
    assert found.cos_air == pytest.approx(-ray @ normal, abs=1e-12)
    assert found.cos_water == pytest.approx(-water @ normal, abs=1e-12)


def test_level_sea_is_the_lidar_equations():
    level = SlopeRefraction.of(0, 0, THETA, N)
    assert level.cos_vertical == pytest.approx(np.cos(snell(THETA, N)), abs=1e-12)
    system = LidarSystem(200, THETA, N, N, energy=1.0, aperture_area=1.0)
    expected = system.water_gain(8.0, THETA) * cos_water(system, THETA)
    assert bottom_gain(RANGE, 8 / level.cos_vertical, N, level) == pytest.approx(float(expected), rel=1e-12)


def test_gain_is_the_solid_angle_of_a_traced_pencil():
    """Rays from the bottom point through the tilted plane to an aperture across the ray, by finite differences."""
    along, across, path = 0.15, -0.2, 9.0
    normal = np.array([-along, -across, 1]) / math.sqrt(1 + along**2 + across**2)
    down = np.array([math.sin(THETA), 0, -math.cos(THETA)])
    up = -refract(down, normal, 1 / N)
    sides = np.linalg.svd(up[np.newaxis])[2][1:]
    step = 1e-5
    places = []
    for shift in (np.zeros(2), np.array([step, 0]), np.array([0, step])):
        ray = up + shift @ sides
        ray /= np.linalg.norm(ray)
        way = path * (up @ normal) / (ray @ normal)
        point = -path * up + way * ray
        out = refract(ray, normal, N)
        aperture = RANGE * -down
        places.append(point + out * ((aperture - point) @ -down) / (out @ -down))
    area = np.linalg.norm(np.cross(places[1] - places[0], places[2] - places[0]))
    found = SlopeRefraction.of(along, across, THETA, N)
    clear = bottom_gain(RANGE, path, N, found) / found.cos_vertical
    cosine, inside = float(found.cos_air), float(found.cos_water)
    s, p = (cosine - N * inside) / (cosine + N * inside), (N * cosine - inside) / (N * cosine + inside)
    transmittance = 1 - 0.5 * (s**2 + p**2)
    assert clear / transmittance**2 == pytest.approx(step**2 / area, rel=1e-4)


@pytest.mark.parametrize(("along", "height"), [(-0.15, 0.0), (0.0, 0.4), (0.2, -0.3)])
def test_depth_of_a_traced_ray(along, height):
    """A ray to the bottom at 8 m below the mean level, through a plane at a height of its own."""
    normal = np.array([-along, 0, 1]) / math.sqrt(1 + along**2)
    down = np.array([math.sin(THETA), 0, -math.cos(THETA)])
    reach = (200 - height) / math.cos(THETA)
    water = refract(down, normal, 1 / N)
    path = (height + 8.0) / -water[2]
    ray = SlopeRefraction.of(along, 0, THETA, N)
    assert bottom_depth(reach, path, 200, THETA, ray) == pytest.approx(8.0, abs=1e-10)
    level = bottom_depth(reach, path, 200, THETA, SlopeRefraction.of(0, 0, THETA, N))
    assert np.sign(np.round(level - 8.0, 9)) == np.sign(along)


def test_variances_by_slope_and_range_without_and_with_the_correction():
    """3 along - 2 across + range/10 of a level sea at 210 m: variances by hand, 0.0181 before."""

    def quantity(along, across, distance):
        return np.asarray(3 * along - 2 * across + 0.1 * (distance - 210) + np.zeros(1))

    sea = (0.04, 0.03, 0.1)
    for after, expected in (
        ((0.04, 0.02, 0.1), (0.0181, 0.0161)),
        ((0.044, 0.0, 0.0), (0.0181, 0.017424)),
        ((0.05, np.nan, 0.1), (0.0145, 0.0226)),
        ((0.03, np.nan, np.nan), (0.0144, 0.0081)),
    ):
        np.testing.assert_allclose(np.ravel(variances(quantity, 210.0, sea, after)), expected, rtol=1e-6)
    assert np.isinf(variances(quantity, 210.0, (np.inf, np.inf, np.inf), (1.0, 1.0, 1.0))[0])
    without, corrected = variances(quantity, 210.0, sea, (np.array([0.01, 0.2]), 0.0, 0.0))
    np.testing.assert_allclose(without, 0.0181, rtol=1e-6)
    np.testing.assert_allclose(corrected, [9e-4, 0.36], rtol=1e-6)
