"""Tables of points: headings, separators, missing values, their own grids, and triangulation."""

import logging
import os

import numpy as np
import pytest
from rows import each_row, must_refuse, refuses

from mitransient_lidar.core.tables import text_tables
from mitransient_lidar.physics.sea.height_files import read_points
from mitransient_lidar.physics.sea.height_maps import read_height_map

POINTS = np.array([[1.0, 10.0, -3.0], [2.5, 11.0, -3.5], [4.0, 13.0, -4.0]])


@each_row(
    "1 10 -3\n2.5 11 -3.5\n4 13 -4\n",
    "1,10,-3,7\n2.5,11,-3.5,8\n4,13,-4,9\n",
    "# survey of a bay\nx;y;z\n1;10;-3\n\n2.5;11;-3.5\n4;13;-4\n",
    "//X Y Z\n1 10 -3\n2.5 11 -3.5\n4 13 -4\n",
    "\ufeffid,Northing [m],Easting [m],Elevation_m\n1,10,1,-3\n2,11,2.5,-3.5\n3,13,4,-4\n",
    "station,z,when,x,y\nA1,-3,2024-05-01,1,10\nA2,-3.5,2024-05-01,2.5,11\nA3,-4,2024-05-02,4,13\n",
    "x;y;z\n1;10;-3\n2,5;11;-3,5\n4;13;-4\n",
    '"x"\t"y"\t"z"\n"1"\t"10"\t"-3"\n"2,5"\t"11"\t"-3,5"\n"4"\t"13"\t"-4"\n',
    '"x","y","z"\n"1","10","-3"\n"2,5","11","-3,5"\n4,13,-4\n',
    " 1  10 -3 # first\n# second\n2,5 11 -3,5\n 4  13 -4\n",
    "x,y,z\n1,10,-3,\n2.5,11,-3.5,\n4,13,-4,\n",
    "x,y,z\nm,m,m\n1,10,-3\n2.5,11,-3.5\n4,13,-4\n",
)
def test_points_have_the_columns_that_their_heading_names(text, tmp_path):
    (tmp_path / "a.xyz").write_text(text, "utf-8")
    np.testing.assert_array_equal(read_points(tmp_path / "a.xyz")[0], POINTS)


@each_row("", "NA", "nan", "N/A", "#N/A", "null", "--", " ")
def test_points_without_a_height_are_left_out(missing, tmp_path, caplog):
    rows = "\n".join(f"{x},{y},{-5 if x + y else missing}" for x in range(4) for y in range(4))
    (tmp_path / "a.csv").write_text(f"x,y,z\n{rows}\n")
    assert np.isnan(read_points(tmp_path / "a.csv")[0][0, 2])
    assert read_height_map(tmp_path / "a.csv", holes="fill").heights.min() == -5
    assert f"{tmp_path}/a.csv: 1 of 16 points have no height and are left out" in caplog.messages


@refuses(
    ("", "has no rows of numbers"),
    ("1 2\n3 4\n", "is not a table of x, y, z: line 1 has 2 values, '1 2'"),
    ("1 2 3\n4 x 6\n", "is not a table of x, y, z: line 2 is '4 x 6'"),
    ("1 2 3\n4 5 6 7\n", "is not a table of x, y, z: line 2 is '4 5 6 7'"),
    ("x,y,z\n1,5,2,5,-3,2\n1,5,3,5,-3,2\n", "line 2 has 6 values, '1 5 2 5 -3 2'"),
    ("x,y,z\n1,5,2,-3\n", "line 2 has 4 values, '1 5 2 -3'"),
    ("name depth\n1 2\n", r"has no heading with known columns \(found: name, depth\): allowed are x, y, z"),
    ("1 2 3\n\n# a\n1 inf 3\n", "line 4: the point 1, inf, 3 must be finite"),
    ("1 2 3\n" * 7, "has more than 5 rows"),
    ("x,y,easting,z\n1,2,3,4\n", "has 2 columns x and easting that may be x: allowed is one"),
    ("x,y,z_std\n1,2,3\n", "has no column z or depth"),
    ("x_m,y_ft,z\n1,2,3\n", "has x in m and y in ft: they must be the same"),
)
def test_other_tables_are_refused(text, tmp_path, monkeypatch):
    monkeypatch.setattr(text_tables, "_MOST_ROWS", 5)
    (tmp_path / "a.csv").write_text(text)
    read_points(tmp_path / "a.csv")


def test_a_table_of_a_billion_points_is_refused_by_its_size(tmp_path):
    (tmp_path / "a.csv").touch()
    os.truncate(tmp_path / "a.csv", 30 * 10**9)
    must_refuse(r"a\.csv has 2\.861e\+04 MiB: a table may have 512 MiB", read_points, tmp_path / "a.csv")


def write_points(path, points):
    path.write_text("\n".join(" ".join(f"{one:.4f}" for one in row) for row in points))
    return path


def test_points_of_an_even_grid_are_its_cells(tmp_path):
    x, y = np.meshgrid(500000.0 + 2 * np.arange(5), 6000000.5 + 0.5 * np.arange(4))
    z = -np.arange(20.0).reshape(4, 5)
    order = np.random.default_rng(0).permutation(20)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)[order]
    read = read_height_map(write_points(tmp_path / "a.xyz", points))
    np.testing.assert_array_equal(read.heights, z)
    np.testing.assert_allclose(read.x, [-4, -2, 0, 2, 4], atol=1e-9)
    np.testing.assert_allclose(read.y, [-0.75, -0.25, 0.25, 0.75], atol=1e-9)
    assert read.origin == pytest.approx((500004, 6000001.25))
    assert read.covers([-4, -5.1, 0], [0, 0, 0.9]).tolist() == [True, False, True]
    # A missing point is a hole.
    path = write_points(tmp_path / "b.xyz", points[order != 7])
    must_refuse("has holes, 1 of 20 heights, the first in row 1 and column 2", read_height_map, path)


def test_scattered_points_are_interpolated_linearly(tmp_path, caplog):
    """A plane is exact, with positions as large as those of a map."""
    rng = np.random.default_rng(1)
    places = rng.uniform(0, 40, (2000, 2)) * [1.0, 0.5]
    places[:4] = [[0, 0], [40, 0], [0, 20], [40, 20]]
    z = -5 + 0.1 * places[:, 0] - 0.2 * places[:, 1]
    points = np.column_stack([np.round(places, 4) + np.array([5e5, 6e6]), z])
    caplog.set_level(logging.WARNING)
    read = read_height_map(write_points(tmp_path / "a.csv", points), origin=(500010.0, 6000005.0))
    # 2000 points on 800 m^2
    assert read.x[1] - read.x[0] == pytest.approx(np.sqrt(0.4), rel=1e-3)
    expected = -5 + 0.1 * (read.x + 10) - 0.2 * (read.y[:, None] + 5)
    np.testing.assert_allclose(read.heights, expected, atol=2e-4)
    assert not caplog.records
    coarse = read_height_map(tmp_path / "a.csv", origin=(500010.0, 6000005.0), cell=4.0)
    np.testing.assert_allclose(np.diff(coarse.x), 4.0)
    assert coarse.heights.shape == (6, 11)


def test_cells_outside_the_hull_are_holes_that_do_not_cover(tmp_path):
    rng = np.random.default_rng(2)
    places = rng.uniform(-10, 10, (3000, 2))
    places = places[np.hypot(*places.T) < 10]
    path = write_points(tmp_path / "a.txt", np.column_stack([places, np.full(len(places), -6.0)]))
    must_refuse("has holes", read_height_map, path)
    read = read_height_map(path, origin=(0.0, 0.0), holes="fill", values="heights")
    np.testing.assert_allclose(read.heights, -6.0)
    assert read.covers([0, 9, 9, 0], [0, 0, 9, 11]).tolist() == [True, True, False, False]
    assert read.covers(np.zeros((2, 3)), np.full((2, 3), np.nan)).tolist() == [[False] * 3] * 2


@refuses(
    ([[0, 0, 1], [1, 1, 1]], {}, "has 2 points: a height map needs at least 3"),
    ([[0, 0, 1], [1, 1, 1], [2, 2, 1], [3.5, 3.5, 1]], {}, "has points on a line"),
    (np.eye(3), {"cell": 0.6}, r"map_cell = 0.6 must be at most half of 1 m, the extent"),
    (np.eye(3), {"cell": 0.0}, "map_cell = 0 must be greater than 0"),
    (1e4 * np.eye(3), {"cell": 1.0}, r"holds arrays of 763.* MiB, and 256 MiB are the most"),
    (np.eye(3), {"size": 1.0}, "size = 1.0 must not be given"),
)
def test_points_that_are_no_map_are_refused(points, options, tmp_path):
    path = write_points(tmp_path / "a.xyz", points)
    read_height_map(path, **options)
