from dataclasses import replace

import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.flights.poses.mounting import Mounting, pixel_turns, pulse_poses
from mitransient_lidar.flights.poses.scanner import Fixed, Oscillating, Palmer
from mitransient_lidar.flights.poses.trajectory import Trajectory
from mitransient_lidar.physics.lidar.pose import Pose


def _level(heading_deg=0.0, roll_deg=0.0, pitch_deg=0.0, height=200.0):
    position = [(5, 7, height), (5, 7, height)]
    return Trajectory([0, 1], position, [roll_deg] * 2, [pitch_deg] * 2, [heading_deg] * 2)


def _ground(poses):
    """Where pulses meet the mean sea level, from the point below the scanner [m]."""
    return (poses.axis * (-poses.origin[:, 2] / poses.axis[:, 2])[:, None])[:, :2]


def test_level_flight_has_circles_on_the_sea():
    times = np.linspace(0, 0.1, 97)
    poses = pulse_poses(_level(heading_deg=40), Mounting(), Palmer(nadir_angle_deg=20, rate_hz=50), times)
    radius = 200 * np.tan(np.radians(20))
    np.testing.assert_allclose(np.linalg.norm(_ground(poses), axis=1), radius, rtol=1e-13)
    # The first pulse goes forward, at the azimuth 40.
    azimuth = np.radians(40)
    np.testing.assert_allclose(_ground(poses)[0], radius * np.array([np.sin(azimuth), np.cos(azimuth)]), rtol=1e-13)


@each_row(
    (_level(roll_deg=np.degrees(np.arctan(0.1))), Mounting(), (-20, 0)),
    (_level(pitch_deg=np.degrees(np.arctan(0.1))), Mounting(), (0, 20)),
    (_level(), Mounting(roll_deg=np.degrees(np.arctan(0.1))), (-20, 0)),
    (_level(), Mounting(pitch_deg=np.degrees(np.arctan(0.1))), (0, 20)),
    # East: left is north.
    (_level(heading_deg=90), Mounting(roll_deg=np.degrees(np.arctan(0.1))), (0, 20)),
    (_level(heading_deg=90), Mounting(pitch_deg=np.degrees(np.arctan(0.1))), (20, 0)),
    # The pitch of the mounting is turned by its yaw to the right.
    (_level(), Mounting(pitch_deg=np.degrees(np.arctan(0.1)), yaw_deg=90), (20, 0)),
    # Equal angles of platform and mounting add up: tan(2 arctan 0.1) = 0.2 / 0.99.
    (_level(pitch_deg=np.degrees(np.arctan(0.1))), Mounting(pitch_deg=np.degrees(np.arctan(0.1))), (0, 40 / 0.99)),
)
def test_signs_of_roll_pitch_and_yaw(trajectory, mounting, expected):
    np.testing.assert_allclose(_ground(pulse_poses(trajectory, mounting, Fixed(), [0.5])), [expected], atol=1e-11)


def test_lever_arm_turns_with_the_platform():
    # 1 m right, 2 m forward, 3 m up. East: right is south. Right side down by 90 degrees: right is down, up is right.
    mounting = Mounting(lever_arm=(1, 2, 3))
    for trajectory, expected in (
        (_level(), (6, 9, 203)),
        (_level(heading_deg=90), (7, 6, 203)),
        (_level(roll_deg=90), (8, 9, 199)),
    ):
        np.testing.assert_allclose(pulse_poses(trajectory, mounting, Fixed(), [0.5]).origin, [expected], atol=1e-12)


def test_pixels_turn_with_the_platform():
    # East, a pulse to the right (south): far is away from the nadir, south and up; left is east, along the flight.
    poses = pulse_poses(_level(heading_deg=90), Mounting(), Fixed(nadir_angle_deg=30, azimuth_deg=90), [0.5])
    sin, cos = 0.5, np.sqrt(0.75)
    np.testing.assert_allclose(poses.axis, [(0, -sin, -cos)], atol=1e-15)
    np.testing.assert_allclose(poses.far, [(0, -cos, sin)], atol=1e-15)
    np.testing.assert_allclose(poses.left, [(1, 0, 0)], atol=1e-15)


def test_turns_of_pixels_are_those_to_the_plane_of_incidence():
    trajectory, scan = _level(heading_deg=90), Palmer(nadir_angle_deg=20, rate_hz=1)
    times = np.array([0.0, 0.1, 0.25, 0.5, 0.75])
    poses = pulse_poses(trajectory, Mounting(), scan, times)
    np.testing.assert_array_equal(pixel_turns(poses), 0)
    # The scan goes clockwise from above: pixels that stay are turned to the left of it, seen along the pulse.
    poses = pulse_poses(trajectory, Mounting(), replace(scan, pixels="platform"), times)
    np.testing.assert_array_equal(pixel_turns(poses), [0, 40, 90, 180, -90])
    # 3 degrees to the left of the scanner's nadir, which the roll turns 5 degrees to the right.
    poses = pulse_poses(_level(roll_deg=-5), Mounting(), Fixed(nadir_angle_deg=3, azimuth_deg=-90), [0.5])
    np.testing.assert_array_equal(pixel_turns(poses), [180])
    np.testing.assert_array_equal(
        pixel_turns(Pose(*np.array([[[0, 0, 9]], [[0, 0, -1]], [[0, 1, 0]], [[1, 0, 0]]]))), [0]
    )


@pytest.mark.parametrize("heading_deg", [0.0, 77.0, 300.0])
def test_scan_angle_is_from_the_vertical_to_the_right(heading_deg):
    # A mirror at 20 degrees to both sides; with the right side down by 3, all pulses go 3 degrees to the left.
    scanner = Oscillating(half_angle_deg=20, rate_hz=1)
    for trajectory, expected in (
        (_level(heading_deg), [20, -20]),
        (_level(heading_deg, roll_deg=3), [17, -23]),
        # A pitch of 60 degrees halves the depth of a pulse, not its way to the side.
        (_level(heading_deg, pitch_deg=60), np.degrees(np.arctan(np.tan(np.radians(20)) / 0.5)) * np.array([1, -1])),
    ):
        poses = pulse_poses(trajectory, Mounting(), scanner, [0.25, 0.75])
        np.testing.assert_allclose(poses.scan_angle_deg, expected, atol=1e-11)
