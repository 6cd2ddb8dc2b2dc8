"""Poses of one lidar and of several shots."""

import numpy as np
import pytest

from mitransient_lidar.core.errors import UserError
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
