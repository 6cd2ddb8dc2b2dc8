"""Axes, signs and orders of rotations of HELIOS++, worked out by hand.

HELIOS++ 2 (``InterpolatedMovingPlatform``, ``Directions``, ``Rotation``): x is to the right, y forward and z up; a
rotation by a positive angle is counterclockwise seen against its axis. The default ``rotationSpec``, ARINC 705,
turns by the pitch about (1, 0, 0), then by the roll about (0, 1, 0), then by the yaw about (0, 0, -1). With p, r and h:

    pitch: (x, y, z) -> (x, y cos p - z sin p, y sin p + z cos p)
    roll:  (x, y, z) -> (x cos r + z sin r, y, -x sin r + z cos r)
    yaw:   (x, y, z) -> (x cos h + y sin h, -x sin h + y cos h, z)
"""

import numpy as np
from rows import each_row

from mitransient_lidar.flights.poses.mounting import Mounting, pulse_poses
from mitransient_lidar.flights.poses.platforms import platform_of
from mitransient_lidar.flights.poses.scanner import Fixed, Oscillating, Palmer
from mitransient_lidar.flights.poses.trajectory import Trajectory

R2, R3, R6 = np.sqrt([2.0, 3.0, 6.0])

NADIR, AHEAD_30, RIGHT_45 = Fixed(), Fixed(nadir_angle_deg=30), Fixed(nadir_angle_deg=45, azimuth_deg=90)

POSES = [
    # Level, north: down.
    ((0, 0, 0), NADIR, (0, 0, -1)),
    # East, beam (0, 1/2, -R3/2): yaw gives x = y sin 90 = 1/2, y = y cos 90 = 0. A yaw to the left would give -1/2.
    ((0, 0, 90), AHEAD_30, (1 / 2, 0, -R3 / 2)),
    # Right side down: x = z sin 30 = -1/2, z = z cos 30: to the left.
    ((30, 0, 0), NADIR, (-1 / 2, 0, -R3 / 2)),
    # Nose up: y = -z sin 30 = 1/2: forward.
    ((0, 30, 0), NADIR, (0, 1 / 2, -R3 / 2)),
    # Pitch first, (0, 1/2, -R3/2); then roll, x = z sin 30 = -R3/4, z = z cos 30 = -3/4.
    # Roll first, as in inertial navigation, would give (-1/2, R3/4, -3/4).
    ((30, 30, 0), NADIR, (-R3 / 4, 1 / 2, -3 / 4)),
    # Pitch gives (0, 1/2, -R3/2), yaw x = y sin 45 = R2/4 and y = y cos 45 = R2/4.
    ((0, 30, 45), NADIR, (R2 / 4, R2 / 4, -R3 / 2)),
    # Left side down gives (1/2, 0, -R3/2), yaw x = x cos 270 = 0 and y = -x sin 270 = 1/2: north, right of west.
    ((-30, 0, 270), NADIR, (0, 1 / 2, -R3 / 2)),
    # Beam (0, 1/2, -R3/2). Pitch: y = 1/2 R3/2 + R3/2 1/2 = R3/2, z = 1/2 1/2 - R3/2 R3/2 = -1/2.
    # Roll: x = z sin 60 = -R3/4, z = z cos 60 = -1/4. Yaw by 180: x and y change their signs.
    ((60, 30, 180), AHEAD_30, (R3 / 4, -R3 / 2, -1 / 4)),
    # Beam (R2/2, 0, -R2/2). Yaw: x = x cos 30 = R6/4, y = -x sin 30 = -R2/4.
    ((0, 0, 30), RIGHT_45, (R6 / 4, -R2 / 4, -R2 / 2)),
    # Roll: x = R2/2 R2/2 - R2/2 R2/2 = 0, z = -R2/2 R2/2 - R2/2 R2/2 = -1: the roll brings the beam down.
    ((45, 0, 60), RIGHT_45, (0, 0, -1)),
]


def _turned(axis, angle_deg, vector):
    """Rodrigues' formula: a vector turned counterclockwise seen against an axis."""
    axis, vector, angle = np.asarray(axis, float), np.asarray(vector, float), np.radians(angle_deg)
    along = axis * (axis @ vector)
    return along + np.cos(angle) * (vector - along) + np.sin(angle) * np.cross(axis, vector)


def _platform(roll, pitch, yaw, vector):
    """Turn a vector as ARINC 705 of HELIOS++ does."""
    turned = _turned((0, 1, 0), roll, _turned((1, 0, 0), pitch, vector))
    return _turned((0, 0, -1), yaw, turned)


@each_row(*POSES)
def test_beams_of_arinc_705(angles, scanner, expected, tmp_path):
    file = tmp_path / "flight.trj"
    roll, pitch, yaw = angles
    file.write_text(f"0, {roll}, {pitch}, {yaw}, 0, 0, 400\n1, {roll}, {pitch}, {yaw}, 0, 60, 400\n")
    trajectory = platform_of({"kind": "csv", "file": "flight.trj"}).trajectory(tmp_path)
    poses = pulse_poses(trajectory, Mounting(), scanner, [0.5])
    np.testing.assert_allclose(poses.axis, [expected], atol=1e-14)
    np.testing.assert_allclose(poses.origin, [(0, 30, 400)], atol=1e-12)


def test_beams_of_canonical():
    # Yaw about z acts first, counterclockwise, then pitch about y, then roll about x. Beam (0, 1/2, -R3/2):
    # yaw 90: (-1/2, 0, -R3/2); pitch 30: x = -1/2 R3/2 - R3/2 1/2 = -R3/2, z = 1/2 1/2 - R3/2 R3/2 = -1/2;
    # roll 90: (x, -z, y) = (-R3/2, 1/2, 0).
    trajectory = Trajectory([0, 1], np.zeros((2, 3)), [90, 90], [30, 30], [90, 90], rotation_spec="CANONICAL")
    np.testing.assert_allclose(
        pulse_poses(trajectory, Mounting(), AHEAD_30, [0.5]).axis, [(-R3 / 2, 1 / 2, 0)], atol=1e-14
    )


def test_order_of_inertial_navigation():
    # Roll first, (-1/2, 0, -R3/2); then pitch, y = -z sin 30 = R3/4, z = z cos 30 = -3/4.
    trajectory = Trajectory([0, 1], np.zeros((2, 3)), [30, 30], [30, 30], [0, 0])
    axis = pulse_poses(trajectory, Mounting(), NADIR, [0.5]).axis
    np.testing.assert_allclose(axis, [(-1 / 2, R3 / 4, -3 / 4)], atol=1e-14)


def test_same_pulses_as_helios():
    """Cone and mirror of HELIOS++ on the mount of its aircraft: our scanner with a yaw of 180 degrees.

    The beam of HELIOS++ is (0, 1, 0) in its scanner, turned by the cone about x and then about y, or by the
    mirror about x; the mount turns it by -90 degrees about x, then by 90 about z.
    """
    rng = np.random.default_rng(5)
    roll, pitch, yaw = rng.uniform([[-20], [-20], [0]], [[20], [20], [360]], (3, 40))
    times = np.arange(40) / 1000
    trajectory = Trajectory(times, np.zeros((40, 3)), roll, pitch, yaw, rotation_spec="ARINC 705")
    scanners = {
        "cone": Palmer(nadir_angle_deg=20, rate_hz=70, phase_deg=90),
        "mirror": Oscillating(half_angle_deg=20, rate_hz=70),
    }
    for kind, scanner in scanners.items():
        found = pulse_poses(trajectory, Mounting(yaw_deg=180), scanner, times).axis
        for k, time in enumerate(times):
            angle = 20 if kind == "cone" else 20 * np.sin(2 * np.pi * 70 * time)
            beam = _turned((1, 0, 0), angle, (0, 1, 0))
            if kind == "cone":
                beam = _turned((0, 1, 0), 360 * 70 * time, beam)
            mounted = _turned((0, 0, 1), 90, _turned((1, 0, 0), -90, beam))
            np.testing.assert_allclose(found[k], _platform(roll[k], pitch[k], yaw[k], mounted), atol=1e-13)
