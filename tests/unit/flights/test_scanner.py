import numpy as np
import pytest
from rows import each_row, refuses

from mitransient_lidar.flights.poses.mounting import Mounting, pulse_poses
from mitransient_lidar.flights.poses.scanner import Scanner
from mitransient_lidar.flights.poses.trajectory import Trajectory

PALMER = {"kind": "palmer", "nadir_angle_deg": 20.0, "rate_hz": 50.0}
ARC = {"kind": "semi_arc", "nadir_angle_deg": 20.0, "rate_hz": 10.0}
MIRROR = {"kind": "oscillating", "half_angle_deg": 20.0, "rate_hz": 10.0}
RASTER = {"kind": "raster", "along_deg": [60, 80], "across_deg": [-10, 10], "lines": 3, "points": 5, "rate_hz": 2.0}
FIXED = {"kind": "fixed", "nadir_angle_deg": 30.0, "azimuth_deg": 40.0}
ALL = [PALMER, ARC, MIRROR, RASTER, FIXED]


def _azimuth_deg(axis):
    return np.degrees(np.arctan2(axis[:, 0], axis[:, 1]))


@each_row(*ALL)
@each_row("scan", "platform")
def test_sides_are_orthonormal(pixels, given):
    axis, far, left = Scanner.of_table({**given, "pixels": pixels}).directions(np.linspace(0, 1, 401))
    for one in (axis, far, left):
        np.testing.assert_allclose(np.linalg.norm(one, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(np.sum(axis * far, axis=1), 0, atol=1e-14)
    np.testing.assert_allclose(np.cross(far, axis), left, atol=1e-14)


@pytest.mark.parametrize("given", [PALMER, ARC])
def test_circles_and_arcs_have_a_constant_angle_from_the_nadir(given):
    axis, far, _ = Scanner.of_table(given).directions(np.linspace(0, 3, 1001))
    np.testing.assert_allclose(axis[:, 2], -np.cos(np.radians(20)), atol=1e-15)
    # Far goes up along the meridian of the beam: its vertical component is the sine of the angle from the nadir.
    np.testing.assert_allclose(far[:, 2], np.sin(np.radians(20)), atol=1e-15)


def test_palmer_turns_clockwise_at_its_rate_from_its_phase():
    # 50 circles a second: a quarter in 5 ms. From 90 degrees (right): backward, left, forward.
    axis = Scanner.of_table({**PALMER, "phase_deg": 90}).directions([0, 0.005, 0.010, 0.015]).axis
    sin = np.sin(np.radians(20))
    np.testing.assert_allclose(axis[:, :2], np.array([(1, 0), (0, -1), (-1, 0), (0, 1)]) * sin, atol=1e-14)
    back = Scanner.of_table({**PALMER, "rate_hz": -50.0}).directions([0.005]).axis
    np.testing.assert_allclose(back[0, :2], (-sin, 0), atol=1e-14)


@each_row(
    ("triangular", [90, 135, 180, 135, 90, 45, 0, 45]),
    ("sinusoidal", 90 + 90 * np.sin(np.arange(8) * np.pi / 4)),
    ("sawtooth", [0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5]),
)
def test_semi_arc_to_the_right(wave, expected):
    scanner = Scanner.of_table({**ARC, "centre_deg": 90, "wave": wave})
    np.testing.assert_allclose(_azimuth_deg(scanner.directions(np.arange(8) / 80).axis), expected, atol=1e-11)


@pytest.mark.parametrize(("wave", "eighth"), [("sinusoidal", 20 * np.sqrt(0.5)), ("triangular", 10)])
def test_oscillating_mirror(wave, eighth):
    axis, far, _ = Scanner.of_table({**MIRROR, "wave": wave}).directions([0.0125, 0.025, 0.075])
    np.testing.assert_allclose(np.degrees(np.arctan2(axis[:, 0], -axis[:, 2])), [eighth, 20, -20], atol=1e-12)
    np.testing.assert_array_equal(axis[:, 1].round(15), 0)
    # Far points away from the nadir on both sides.
    assert (np.sign(far[:, 0]) == np.sign(axis[:, 0])).all()
    assert (far[:, 2] > 0).all()


def test_raster_visits_each_point_in_turn():
    # 15 points in half a second.
    axis = Scanner.of_table(RASTER).directions(np.arange(16) / 30).axis
    along = np.degrees(np.arctan2(axis[:, 1], -axis[:, 2]))
    np.testing.assert_allclose(along, [*np.repeat([60, 70, 80], 5), 60], atol=1e-12)
    across = np.degrees(np.arcsin(axis[:, 0]))
    np.testing.assert_allclose(across, [*np.tile([-10, -5, 0, 5, 10], 3), -10], atol=1e-12)


@each_row(0.0, 302_400.123, 604_799.0, 340_000_000.25, 1.38e9 + 0.1, 1.38e9 + 0.7654321)
@each_row(1000.0, 200_000.0)
def test_raster_keeps_its_points_at_gps_times(rate, start):
    """Times since 1980 are rounded by 0.1 us, a fiftieth of the interval of 200 kHz."""
    scanner = Scanner.of_table({**RASTER, "lines": 20, "points": 50, "rate_hz": rate / 1000})
    line = Trajectory(np.array([start, start + 1.0]), np.zeros((2, 3)), *np.zeros((3, 2)))
    times = line.pulse_times(rate)
    assert len(times) == rate + 1
    rasters = scanner.directions(times[:-1]).axis.round(9).reshape(-1, 1000, 3)
    assert len(np.unique(rasters[0], axis=0)) == 1000
    assert np.all(rasters == rasters[0])


def test_every_line_of_a_flight_begins_with_a_whole_point():
    """The second line begins at a time that the rounding puts before or after a point: by chance, pulse by pulse."""
    start, rate = 1.38e9, 200_000.0
    lines = np.array([[start, start + 0.01], [start + 0.1 + 0.999 / rate, start + 0.11 + 0.999 / rate]])
    flown = Trajectory(np.array([start, start + 1.0]), np.zeros((2, 3)), *np.zeros((3, 2)), lines=lines)
    scanner = Scanner.of_table({**RASTER, "lines": 20, "points": 50, "rate_hz": rate / 1000})
    poses = pulse_poses(flown, Mounting(), scanner, flown.pulse_times(rate))
    for line in (0, 1):
        assert len(np.unique(poses.axis[poses.line == line][:1000].round(9), axis=0)) == 1000


@refuses(
    ({}, "has no kind"),
    ({"kind": ["palmer"]}, r"kind = \['palmer'\] of a scanner must be one of"),
    ({"kind": "spiral"}, "kind = 'spiral' of a scanner must be one of palmer, semi_arc"),
    ({**RASTER, "lines": 10**5, "points": 10**5}, "must be at most 1000000000"),
)
def test_invalid_scanners(given):
    Scanner.of_table(given)
