import numpy as np
import pytest
import significance
from rows import each_row, refuses
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.poses.platforms import platform_of
from mitransient_lidar.flights.poses.trajectory import Trajectory

LINES = {"kind": "lines", "start": [10, 20], "heading_deg": 30, "speed": 50, "height": 200, "length": 500}


def _trajectory(times, yaw=None, **others):
    zeros = np.zeros(len(times))
    return Trajectory(times, np.zeros((len(times), 3)), zeros, zeros, zeros if yaw is None else yaw, **others)


def test_interpolation_is_linear_and_exact_at_the_records():
    position = np.array([(0, 0, 100), (10, 40, 100), (10, 80, 120)])
    trajectory = Trajectory([0, 1, 3], position, [0, 2, -2], [1, 1, 5], [0, 10, 20])
    poses = trajectory.at([0, 0.25, 1, 2, 3])
    np.testing.assert_allclose(
        poses.position, [(0, 0, 100), (2.5, 10, 100), (10, 40, 100), (10, 60, 110), (10, 80, 120)]
    )
    np.testing.assert_allclose(poses.roll_deg, [0, 0.5, 2, 0, -2])
    np.testing.assert_allclose(poses.pitch_deg, [1, 1, 1, 3, 5])
    np.testing.assert_allclose(poses.yaw_deg, [0, 2.5, 10, 15, 20])
    np.testing.assert_array_equal(poses.line, 0)


def smooth_motion(time):
    """Return a turn of 500 m at 60 m/s with a heave of 1 m/s^2, and its roll, pitch and heading [deg]."""
    turned = 60 * time / 500
    heave = 2.5 * np.sin(2 * np.pi * time / 10)
    position = np.column_stack([500 * (1 - np.cos(turned)), 500 * np.sin(turned), 300 + heave])
    roll, pitch = 36 + 2 * np.sin(2 * np.pi * time / 8), np.sin(2 * np.pi * time / 10)
    return position, roll, pitch, np.degrees(turned) % 360


@pytest.mark.parametrize(("interval", "of_position", "of_angles"), [(1.0, 3e-3, 0.02), (0.5, 2e-4, 1e-3)])
def test_splines_follow_a_smooth_motion(interval, of_position, of_angles):
    """Straight lines between records of 1 s are off by 0.9 m in the turn, 0.1 m in height and 0.15 degrees of roll."""
    records, time = np.arange(0, 61 + interval / 2, interval), np.linspace(0, 60, 5001)
    position, *angles = smooth_motion(time)
    errors = {}
    for kind in ("linear", "cubic"):
        poses = Trajectory(records, *smooth_motion(records), interpolation=kind).at(time)
        found = poses.roll_deg, poses.pitch_deg, poses.yaw_deg
        inner = (time > 5 * interval) & (time < 60 - 4 * interval)
        errors[kind] = (
            np.abs(poses.position - position)[inner].max(),
            max(np.abs((one - true + 180) % 360 - 180)[inner].max() for one, true in zip(found, angles, strict=True)),
            # Ends have a record less beside them.
            np.abs(poses.position - position).max(),
        )
    assert errors["cubic"][0] < of_position
    assert errors["cubic"][1] < of_angles
    assert errors["cubic"][2] < 0.2 * errors["linear"][2]
    # In a turn of the radius r, a chord of the length v dt is (v dt)^2 / 8 r away.
    assert errors["linear"][0] > 0.9 * (60 * interval) ** 2 / (8 * 500)


def test_splines_end_where_records_are_far_apart():
    """Waypoints, and a gap between two flight lines: straight lines, which the records beside do not feel."""
    time = np.array([0, 10, 20, 20.5, 21, 21.5, 22, 40, 40.5, 41, 41.5])
    x = np.array([0, 100, 0, 10, 20, 30, 40, 900, 890, 880, 870])
    zeros = np.zeros(time.size)
    records = time, np.column_stack([x, zeros, zeros]), zeros, zeros, zeros
    times = np.array([3, 15, 20.25, 21.9, 30, 40.1, 41.2])
    linear, cubic = (Trajectory(*records, interpolation=kind).at(times) for kind in ("linear", "cubic"))
    np.testing.assert_allclose(cubic.position, linear.position, atol=1e-9)
    np.testing.assert_allclose(cubic.position[:, 0], [30, 50, 5, 38, 40 + 860 * 8 / 18, 898, 876], atol=1e-9)


def test_headings_pass_north_the_short_way():
    yaw = _trajectory([0, 1, 2, 3], [350, 10, -10, 710]).at([0, 0.25, 0.5, 0.75, 1.75, 2.5]).yaw_deg
    # 350 to 10 is 20 degrees to the right; 10 to -10 is 20 to the left; -10 and 710 are the same.
    np.testing.assert_allclose((yaw + 180) % 360 - 180, [-10, -5, 0, 5, -5, -10], atol=1e-12)


def test_parallel_lines_alternate():
    trajectory = platform_of({**LINES, "count": 3, "spacing": 40, "turn_s": 20, "crab_deg": 3}).trajectory()
    np.testing.assert_allclose(trajectory.lines, [(0, 10), (30, 40), (60, 70)])
    poses = trajectory.at([0, 10, 30, 40, 60, 65])
    # Course 30: ahead is (1/2, sqrt(3)/2), and the next line 40 m to the right, (sqrt(3)/2, -1/2).
    ahead, right = np.array([0.5, np.sqrt(0.75)]), np.array([np.sqrt(0.75), -0.5])
    start = np.array([10, 20])
    expected = [start, start + 500 * ahead, start + 500 * ahead + 40 * right, start + 40 * right]
    expected += [start + 80 * right, start + 80 * right + 250 * ahead]
    np.testing.assert_allclose(poses.position[:, :2], expected, atol=1e-10)
    np.testing.assert_array_equal(poses.position[:, 2], 200)
    np.testing.assert_allclose(poses.yaw_deg, [33, 33, 213, 213, 33, 33])
    np.testing.assert_array_equal(poses.line, [0, 0, 1, 1, 2, 2])
    one_way = platform_of({**LINES, "count": 2, "spacing": 40, "turn_s": 20, "alternate": False}).trajectory().at([30])
    np.testing.assert_allclose(one_way.position[0, :2], start + 40 * right, atol=1e-10)


def _without(given, name, **others):
    return {key: value for key, value in given.items() if key != name} | others


def test_pulses_begin_with_each_line():
    trajectory = platform_of({**LINES, "count": 2, "spacing": 40, "turn_s": 0.35}).trajectory()
    times = trajectory.pulse_times(10)
    # 10 s at 10 Hz, both ends included: 0.1 s does not divide the turn.
    assert times.size == 202
    np.testing.assert_allclose(times[:101], np.arange(101) / 10)
    np.testing.assert_allclose(times[101:], 10.35 + np.arange(101) / 10)
    assert (trajectory.at(times).line == np.repeat([0, 1], 101)).all()


def test_noise_of_attitudes_is_stationary_with_its_correlation():
    """4000 lines of one correlation time each: independent pairs of attitudes at its ends."""
    count, deviations = 4000, np.array([2.0, 1.0, 0.5])
    noise = dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), deviations, strict=True))
    noise |= {"correlation_s": 3.0, "seed": 7 + significance.seed_shift}
    given = _without(
        LINES, "length", duration_s=3.0, count=count, spacing=1, alternate=False, pitch_deg=4.0, noise=noise
    )
    trajectory = platform_of(given).trajectory()
    poses = [trajectory.at(trajectory.lines[:, end]) for end in (0, 1)]
    angles = [np.stack([one.roll_deg, one.pitch_deg - 4, (one.yaw_deg - 30 + 180) % 360 - 180]) for one in poses]
    first, last = (one / deviations[:, None] for one in angles)
    limit = largest_z(count, 12)
    for unit in (first, last):
        assert (np.abs(unit.mean(axis=1)) < limit / np.sqrt(count)).all()
        # The square of a normal number has the variance 2.
        assert (np.abs((unit**2).mean(axis=1) - 1) < limit * np.sqrt(2 / count)).all()
    # exp(-1) after a correlation time; the product of two normal numbers has the variance 1 + correlation^2.
    kept = np.exp(-1)
    assert (np.abs((first * last).mean(axis=1) - kept) < largest_z(count, 3) * np.sqrt((1 + kept**2) / count)).all()
    crossed = (first * np.roll(first, 1, axis=0)).mean(axis=1)
    assert (np.abs(crossed) < largest_z(count, 3) / np.sqrt(count)).all()


@refuses(
    ([0, 1, 0.5, 2], None, r"record 3 of a trajectory: time = 0.5 s must be later than .* before, 1.0 s"),
    ([0, 1, 1], None, "record 3 of a trajectory"),
    ([0, 1, 2], [0, np.nan, 0], "record 2 of a trajectory: yaw = nan must be a number from -1e\\+12 to 1e\\+12"),
    ([0, np.inf], None, "record 2 of a trajectory: time = inf"),
    ([0, 1], ["north", "east"], r"yaw_deg = \['north', 'east'\] must hold numbers only"),
    ([0], None, "number of records of 1: it must be at least 2"),
    ([0, 1], [0, 1, 2], r"yaw_deg has the shape \(3,\): it must be \(2,\)"),
)
def test_invalid_records(times, yaw):
    _trajectory(times, yaw)


@each_row(-0.1, 1.5, 4.1)
def test_times_on_no_line_are_refused(time):
    trajectory = _trajectory(np.arange(5), lines=[(0, 1), (2, 4)])
    with pytest.raises(UserError, match=rf"time = {time:g} s \(number 2\) is on no flight line: .* 0 to 1 s, 2 to 4 s"):
        trajectory.at([0.5, time])


@refuses(
    ({}, r"\[platform\] has no kind"),
    ({"kind": "kite"}, "kind = 'kite' of a platform must be one of lines, mast, csv, sbet"),
    ({**LINES, "duration_s": 3}, "must have either length or duration_s"),
    (_without(LINES, "length"), "must have either length or duration_s"),
    ({**LINES, "count": 2}, "has no spacing"),
    ({**LINES, "noise": {"roll_deg": 1, "correlation_s": 1e-7}}, "noise.correlation_s = 1e-07 must be at least"),
)
def test_invalid_platforms(given):
    platform_of(given).trajectory()
