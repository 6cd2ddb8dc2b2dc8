"""Poses, fields of view, film and transmitter as Mitsuba plugins: axes, solid angles, and points on edges."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rows import each_row
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.transport.pose import KernelPose
from mitransient_lidar.transport.rng import pass_streams, stratified_point

COUNT = 2**20
COLLECTION = 0.025 * 0.9 * 0.9


def uniform_pair(count=COUNT, seed=1):
    rng = mi.PCG32(count, initstate=seed)
    return mi.Point2f(rng.next_float32(), rng.next_float32())


@pytest.mark.parametrize("angle", [0.0, 20.0, 75.0])
def test_gx_points_away_from_nadir_and_gy_along_y(angle):
    """With angle_x towards nadir the echo would arrive in the far pixels first."""
    pose = KernelPose.from_angles(200.0, angle, 3.0, -2.0)
    frame = np.stack([pose.left, pose.far, pose.axis])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(pose.ground_point(), [3.0, -2.0, 0.0], atol=1e-9)
    far, left, axis = (np.array(pose.direction(*g)).ravel() for g in ((0.01, 0.0), (0.0, 0.01), (0.0, 0.0)))
    assert np.arctan2(np.hypot(*far[:2]), -far[2]) - np.radians(angle) == pytest.approx(np.arctan(0.01), abs=1e-6)
    assert far[0] > axis[0]
    assert left[1] == pytest.approx(0.01 / np.hypot(1, 0.01), rel=1e-6)
    np.testing.assert_allclose(axis, [np.sin(np.radians(angle)), 0, -np.cos(np.radians(angle))], atol=1e-7)


def test_a_reflected_pose_is_refused():
    """Its +angle_y would be on the right."""
    look = mi.ScalarTransform4f().look_at(origin=[-70, 0, 200], target=[0, 0, 0], up=[0, 0, 1])
    with pytest.raises(
        RuntimeError, match="to_world must be a rotation and a translation, without shear or reflection"
    ):
        mi.load_dict({"type": "multipixel_receiver", "to_world": look @ mi.ScalarTransform4f().scale([-1, 1, 1])})


@each_row(
    # 0.8 rad across: the tangent-plane area alone would be 12 % and 15 % too large.
    ({"type": "multipixel_receiver", "field_of_view_mrad": 800.0}, 2 * np.pi * (1 - 1 / np.hypot(1, 0.4))),
    (
        {"type": "multipixel_receiver", "field_of_view_mrad": 800.0, "field_of_view_shape": "square"},
        4 * np.arcsin(0.4**2 / (1 + 0.4**2)),
    ),
    (
        {"type": "pixel_fov", "shape": "ring", "field_of_view_mrad": 800.0, "inner_mrad": 400.0},
        2 * np.pi * (1 / np.hypot(1, 0.2) - 1 / np.hypot(1, 0.4)),
    ),
)
def test_rays_for_mitsubas_integrators_carry_aperture_and_solid_angle(sensor, solid_angle):
    plugin = mi.load_dict(sensor)
    ray, weight = plugin.sample_ray(0.0, mi.Float(0.5), uniform_pair(), mi.Point2f(0.5))
    weight = np.array(weight).ravel().astype(np.float64)
    assert abs(weight.mean() - COLLECTION * solid_angle) < largest_z(COUNT) * weight.std() / np.sqrt(COUNT)
    assert weight.std() / np.sqrt(COUNT) < 1e-3 * weight.mean()
    np.testing.assert_allclose(np.array(ray.o)[:, 0], plugin.receiver.pose.origin, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(np.array(ray.d), axis=0), 1, atol=1e-6)


@each_row(4096, 5000)
def test_stratified_points_cover_the_square_evenly(count):
    """In 16 x 16 cells 4096 points fall 16 into each, and of 5000 nearly as many: random ones would spread by 4."""
    points = np.array(stratified_point(dr.arange(mi.UInt32, count), count, pass_streams(1, 0, count)))
    assert points.min() >= 0
    assert points.max() < 1
    counts = np.histogram2d(*points, bins=(16, 16), range=((0, 1), (0, 1)))[0]
    assert np.abs(counts - count / 256).max() < 2 if count == 5000 else counts.std() == 0


def test_foreign_integrators_are_refused():
    with pytest.raises(UserError, match="use the integrator lidar_merging or lidar_volpath"):
        mi.load_dict({"type": "time_gated_film"}).create_block()
