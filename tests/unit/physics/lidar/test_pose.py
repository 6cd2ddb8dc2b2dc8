"""Poses, and refraction at level and inclined surfaces."""

import numpy as np
import pytest
from oracles.echo_times import bottom_time_ns, layered_time_ns

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.level_sea import (
    fresnel,
    refract,
    refract_level,
    snell,
    solid_angle_per_area,
    surface_time_ns,
)
from mitransient_lidar.physics.lidar.pose import Pose


def shots(count):
    rng = np.random.default_rng(5)
    axis = rng.normal([0, 0, -5], 1, (count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    far = np.cross(axis, rng.normal(size=(count, 3)))
    far /= np.linalg.norm(far, axis=1, keepdims=True)
    origin = rng.uniform([-50, -50, 100], [50, 50, 300], (count, 3))
    return Pose(origin, axis, far, np.cross(far, axis))


def test_axis_meets_the_sea_level_at_the_aim():
    pose = Pose.from_angles(200.0, 30.0, 5.0, -3.0)
    np.testing.assert_allclose(pose.ground_point(), [5, -3, 0], atol=1e-9)
    assert pose.ground_range == pytest.approx(200 / np.cos(np.radians(30)))
    assert pose.off_nadir_deg == pytest.approx(30)
    assert float(pose.azimuth) == 0
    many = shots(6)
    assert many.ground_point()[:, 2] == pytest.approx(np.zeros(6), abs=1e-9)
    along = many.ground_point() - many.origin
    np.testing.assert_allclose(np.cross(along, many.axis), 0, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(along[:, 1], along[:, 0]), many.azimuth, atol=1e-12)


@pytest.mark.parametrize("pose", [Pose.from_angles(100.0, 20.0), shots(1).part(0)])
def test_angles_are_those_of_directions(pose):
    """A point at the distance 1 along the axis is displaced by the angles along far and left."""
    angles = np.random.default_rng(2).uniform(-0.5, 0.5, (3, 4, 2))
    np.testing.assert_allclose(pose.angles_of(7 * pose.directions(angles)), angles, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(pose.directions(angles), axis=-1), 1)
    expected = pose.axis + 0.1 * pose.far - 0.2 * pose.left
    np.testing.assert_allclose(pose.rays(np.array([0.1, -0.2])), expected)


def test_rotations_and_displacements_move_what_a_pose_sees():
    pose, angles = Pose.from_angles(150.0, 40.0), np.array([[0.02, -0.01]])
    turn = np.radians([10.0, 200.0])
    rotation = np.zeros((2, 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(turn)
    rotation[:, 1, 0], rotation[:, 0, 1], rotation[:, 2, 2] = np.sin(turn), -np.sin(turn), 1
    moved = pose.moved(rotation, np.array([[1.0, 2, 0], [0, 0, 5]]))
    np.testing.assert_allclose(moved.azimuth, [turn[0], turn[1] - 2 * np.pi], atol=1e-12)
    for row in range(2):
        one = moved.part(row)
        np.testing.assert_allclose(one.frame @ one.frame.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(one.directions(angles), pose.directions(angles) @ rotation[row].T, atol=1e-12)


def test_matrices_with_shear_are_refused():
    pose = Pose.from_angles(200.0, 20.0, 1.0, 2.0)
    matrix = np.eye(4)
    matrix[:3] = np.stack([3 * pose.left, 3 * pose.far, 3 * pose.axis, pose.origin], axis=1)
    np.testing.assert_allclose(Pose.from_matrix("to_world", matrix).frame, pose.frame, atol=1e-12)
    matrix[0, 1] += 1
    with pytest.raises(UserError, match="to_world must be a rotation and a translation"):
        Pose.from_matrix("to_world", matrix)


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
