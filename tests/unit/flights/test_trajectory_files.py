import numpy as np
import pyproj
import pytest
from rows import each_case, each_row, must_refuse, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.poses.platforms import platform_of
from mitransient_lidar.flights.poses.trajectory import read_sbet_records, read_text_records

ROWS = np.array([(0, 1, 2, 350, 10, 20, 400), (0.5, 1.5, 2, 355, 12, 30, 401), (1.25, 2, -2, 5, 14, 40, 402)])
NAMES = ("t", "roll", "pitch", "yaw", "x", "y", "z")


def _write(path, heading, order, separator=","):
    lines = [separator.join(f"{row[NAMES.index(name)]!r}" for name in order) for row in ROWS.tolist()]
    path.write_text("\n".join([*heading, *lines, ""]))
    return path


@each_row(
        ([], NAMES, ","),
        (['#HEADER: "t", "roll", "pitch", "yaw", "x", "y", "z"'], NAMES, ", "),
        (["# a comment", "#TIME_COLUMN: 0", '#HEADER: "t", "x", "y", "z", "yaw", "roll", "pitch"'],
         ("t", "x", "y", "z", "yaw", "roll", "pitch"), ","),
        (["#TIME_COLUMN: 6"], (*NAMES[1:], "t"), ","),
        (["#TIME_COLUMN: 3", '#HEADER: "x","y","z","when","roll","pitch","yaw"'],
         ("x", "y", "z", "t", "roll", "pitch", "yaw"), ","),
        (["time_s;x_m;y_m;z_m;roll_deg;pitch_deg;heading_deg"],
         ("t", "x", "y", "z", "roll", "pitch", "yaw"), ";"),
        (["t x y z yaw roll pitch"], ("t", "x", "y", "z", "yaw", "roll", "pitch"), " "),)  # fmt: skip
def test_text_in_any_order(heading, order, separator, tmp_path):
    records = read_text_records(_write(tmp_path / "flight.trj", heading, order, separator))
    found = np.column_stack([records.time_s, records.roll_deg, records.pitch_deg, records.yaw_deg, records.position])
    np.testing.assert_array_equal(found, ROWS)


def test_units_and_decimal_commas_of_text(tmp_path):
    """Milliseconds, radians and feet as a spreadsheet writes them; in metres z would be 3.28 times as high."""
    rows = ROWS / [1e-3, *[180 / np.pi] * 3, 1200 / 3937, 1200 / 3937, 0.3048]
    text = "\n".join(";".join(f"{one:.12f}".replace(".", ",") for one in row) for row in rows)
    heading = '"time_ms";"roll [rad]";"pitch (rad)";heading/rad;x_ftUS;Northing (US survey feet);"z in ft"'
    (tmp_path / "flight.csv").write_text(f"{heading}\n{text}\n")
    records = read_text_records(tmp_path / "flight.csv")
    found = np.column_stack([records.time_s, records.roll_deg, records.pitch_deg, records.yaw_deg, records.position])
    np.testing.assert_allclose(found, ROWS, rtol=0, atol=1e-9)


def test_files_of_a_plan_have_an_origin_and_lines(tmp_path):
    _write(tmp_path / "flight.trj", [], NAMES)
    given = {"kind": "csv", "file": "flight.trj", "origin": [10, 20, 100], "lines_s": [[0, 0.5], [1, 1.25]]}
    trajectory = platform_of(given).trajectory(tmp_path)
    np.testing.assert_array_equal(trajectory.position, ROWS[:, 4:] - (10, 20, 100))
    assert trajectory.rotation_spec == "ARINC 705"
    np.testing.assert_array_equal(trajectory.at([0.25, 1.25]).line, [0, 1])


@refuses(
    ("0,0,0,0,0,0,0\n\n1,0,0,0,0,0,0\n0.5,0,0,0,0,0,0\n", r"line 4: time = 0.5 s must be later .* before, 1.0 s"),
    ("0,0,0,0,0,0,0\n1,0,0,nan,0,0,0\n", "line 2: yaw = nan must be a number from -1e\\+12 to 1e\\+12"),
    ("0,0,0,0,0,0,0\n1,0,0,0,0,0\n", "line 2: z = nan must be a number"),
    ("0,0,0,0,0,0,0\n1,0,0,east,0,0,0\n", "is not a table of t, roll, .*: line 2 is '1,0,0,east,0,0,0'"),
    (
        "t,roll,pitch,course,x,y,z\n0,0,0,0,0,0,0\n",
        r"unknown column 'course' .*: allowed are t \[s, ms, us\], roll, pitch, yaw \[deg, rad\]",
    ),
    ("t,roll,pitch,x,y,z\n0,0,0,0,0,0\n", "columns t, roll, pitch, x, y, z: it must have yaw, and each of"),
    ("#TIME_COLUMN: first\n0,0,0,0,0,0,0\n", "TIME_COLUMN = 'first' must be an integer"),
    ("0,0,0,0,0,0,0\n", "number of records of 1: it must be at least 2"),
    ("", "has no rows of numbers"),
    ("t,roll_grad,pitch,yaw,x,y,z\n0,0,0,0,0,0,0\n", r"unknown unit in column 'roll_grad' .*\[deg, rad\]"),
)
def test_invalid_text(text, tmp_path):
    path = tmp_path / "flight.csv"
    path.write_text(text)
    read_text_records(path)


@refuses(({"kind": "csv", "file": "none.csv"}, "cannot read .*none.csv"))
def test_invalid_tables(given, tmp_path):
    _write(tmp_path / "flight.trj", [], NAMES)
    platform_of(given).trajectory(tmp_path)


def _sbet(path, longitude_deg, latitude_deg, heading_deg=0.0, wander_deg=0.0):
    """Write records of an SBET file 5 ms apart."""
    data = np.zeros((len(longitude_deg), 17))
    data[:, 0] = 345600 + 0.005 * np.arange(len(data))
    data[:, 1], data[:, 2], data[:, 3] = np.radians(latitude_deg), np.radians(longitude_deg), 400.5
    data[:, 7], data[:, 8] = np.radians(1.5), np.radians(-2.5)
    data[:, 9], data[:, 10] = np.radians(heading_deg + wander_deg), np.radians(wander_deg)
    data.astype("<f8").tofile(path)
    return data


def test_sbet_positions_and_attitudes(tmp_path):
    longitude, latitude = np.array([15.0, 15.5, 16.0]), np.array([60.0, 60.1, 60.2])
    data = _sbet(tmp_path / "flight.sbet", longitude, latitude, heading_deg=70.0, wander_deg=25.0)
    trajectory = platform_of(
        {"kind": "sbet", "file": "flight.sbet", "epsg": 32633, "origin": [5e5, 6e6, 30]}
    ).trajectory(tmp_path)
    x, y = pyproj.Proj(32633)(longitude, latitude)
    np.testing.assert_allclose(trajectory.position, np.column_stack([x - 5e5, y - 6e6, np.full(3, 370.5)]), atol=1e-6)
    np.testing.assert_array_equal(trajectory.time_s, data[:, 0])
    np.testing.assert_allclose(trajectory.roll_deg, 1.5)
    np.testing.assert_allclose(trajectory.pitch_deg, -2.5)
    # On the central meridian of the zone, 15 degrees, grid north is true north.
    assert trajectory.yaw_deg[0] == pytest.approx(70.0, abs=1e-9)
    assert trajectory.rotation_spec == "aerospace"


@each_row((32633, 60.0), (3006, 60.0), (3035, 60.0), (3413, 70.0), (2180, 60.0), (32661, 84.0))
def test_sbet_headings_are_those_of_the_grid(epsg, north, tmp_path):
    """A metre along a geodesic with the true heading goes along the heading of the grid."""
    longitude, latitude, heading = (
        np.array([14.0, 17.0, 19.5]),
        north + np.array([0.0, 0.6, 1.1]),
        np.array([10.0, 130, 275]),
    )
    _sbet(tmp_path / "flight.sbet", longitude, latitude, heading)
    yaw = read_sbet_records(tmp_path / "flight.sbet", epsg).yaw_deg
    to_grid = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform
    ahead_longitude, ahead_latitude, _ = pyproj.Geod(ellps="WGS84").fwd(longitude, latitude, heading, np.ones(3))
    (x, y), (ahead_x, ahead_y) = to_grid(longitude, latitude), to_grid(ahead_longitude, ahead_latitude)
    expected = np.degrees(np.arctan2(ahead_x - x, ahead_y - y))
    # Conformal projections keep the angle; the Lambert projection 3035 of equal areas distorts it by up to a degree.
    difference = (yaw - expected + 180) % 360 - 180
    np.testing.assert_allclose(difference, 0, atol=1.0 if epsg == 3035 else 1e-5)


def test_meridian_convergence_of_utm(tmp_path):
    """Closed form on a sphere, tan(convergence) = tan(longitude from the meridian) sin(latitude).

    On the ellipsoid the terms differ from the third order on, by eta^2 = 0.0067 cos^2(latitude) times the cube of the
    difference in longitude: 3e-7 rad at 2 degrees.
    """
    longitude, latitude = np.array([13.0, 15.0, 17.0]), np.array([60.0, 60.0, -35.0])
    _sbet(tmp_path / "flight.sbet", longitude, latitude, heading_deg=90.0)
    yaw = read_sbet_records(tmp_path / "flight.sbet", 32633).yaw_deg
    convergence = np.arctan(np.tan(np.radians(longitude - 15)) * np.sin(np.radians(latitude)))
    np.testing.assert_allclose(np.radians(90 - yaw), convergence, atol=3e-7)


def test_truncated_sbet(tmp_path):
    _sbet(tmp_path / "flight.sbet", np.full(3, 15.0), np.full(3, 60.0))
    data = (tmp_path / "flight.sbet").read_bytes()
    (tmp_path / "flight.sbet").write_bytes(data[:-8])
    with pytest.raises(UserError, match="has 400 bytes, but an SBET file must have a multiple of 136"):
        read_sbet_records(tmp_path / "flight.sbet", 32633)


@refuses(
    (1, 0, 0.0, "record 2: time = 0.0 s must be later than that of the record before, 345600.0 s"),
    (2, 8, np.nan, "record 3: pitch = nan must be a number from -1e\\+12 to 1e\\+12"),
    (1, 1, 60.0, "record 2: latitude = 60 and longitude = 0.261799 must be radians"),
)
def test_invalid_sbet(row, column, value, tmp_path):
    data = _sbet(tmp_path / "flight.sbet", np.full(3, 15.0), np.full(3, 60.0))
    data[row, column] = value
    data.tofile(tmp_path / "flight.sbet")
    read_sbet_records(tmp_path / "flight.sbet", 32633)


@refuses(
    (999999, "epsg = 999999 is no coordinate system that pyproj knows"),
    (4326, r"epsg = 4326 \(WGS 84\) must be projected coordinates in metres, east and north"),
    (2263, "epsg = 2263 .* must be projected coordinates in metres"),
    (2053, "epsg = 2053 .* must be projected coordinates in metres, east and north"),
)
def test_invalid_coordinate_systems(epsg, tmp_path):
    _sbet(tmp_path / "flight.sbet", np.full(3, 15.0), np.full(3, 60.0))
    read_sbet_records(tmp_path / "flight.sbet", epsg)


@each_case((15.0, 60.0, 3857, "2"), (-170.0, -52.0, 3035, "nan"))
def test_sbet_where_the_projection_has_another_scale(longitude, latitude, epsg, scale, tmp_path):
    _sbet(tmp_path / "flight.sbet", np.full(3, longitude), np.full(3, latitude))
    message = (
        rf"record 1: latitude = {latitude:g} and longitude = {longitude:g} deg must .*; its scale there is {scale}"
    )
    must_refuse(message, read_sbet_records, tmp_path / "flight.sbet", epsg)
