"""Surveys: headings and separators of tables of points, grids of BAG files, and refused files."""

import logging
import os

import h5py
import numpy as np
import pytest
from array_inputs import write_bag

from mitransient_lidar.core import survey_files
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.survey_files import read_bag, read_points
from mitransient_lidar.physics.sea.height_maps import read_height_map

POINTS = np.array([[1.0, 10.0, -3.0], [2.5, 11.0, -3.5], [4.0, 13.0, -4.0]])


@pytest.mark.parametrize(
    "text",
    [
        "1 10 -3\n2.5 11 -3.5\n4 13 -4\n",
        "1,10,-3,7\n2.5,11,-3.5,8\n4,13,-4,9\n",
        "# survey of a bay\nx;y;z\n1;10;-3\n\n2.5;11;-3.5\n4;13;-4\n",
        "//X Y Z\n1 10 -3\n2.5 11 -3.5\n4 13 -4\n",
        "\ufeffid,Northing [m],Easting [m],Elevation_m\n1,10,1,-3\n2,11,2.5,-3.5\n3,13,4,-4\n",
        "x\ty\tdepth\n1\t10\t-3\n9\t9\tnan\n2.5\t11\t-3.5\n4\t13\t-4\n",
    ],
)
def test_points_have_the_columns_that_their_heading_names(tmp_path, text):
    (tmp_path / "a.xyz").write_text(text, "utf-8")
    np.testing.assert_array_equal(read_points(tmp_path / "a.xyz"), POINTS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no points"),
        ("# nothing\n", "has no points"),
        ("1 2\n3 4\n", "is not a table of points x, y and z"),
        ("1 2 3\n4 x 6\n", "is not a table of points x, y and z"),
        ("name depth\n1 2\n", "line 1: 'name depth' must be numbers, or names x, y and z"),
        ("lon,lat,z\n1,2,3\n", "has columns of degrees"),
        ("1 inf 3\n", "has the point 1, inf, 3: points must be finite"),
        ("1 2 3\n" * 7, "has more than 5 points"),
    ],
)
def test_other_tables_are_refused(tmp_path, monkeypatch, text, message):
    monkeypatch.setattr(survey_files, "_MOST_POINTS", 5)
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(UserError, match=message):
        read_points(tmp_path / "a.csv")


def test_a_table_of_a_billion_points_is_refused_by_its_size(tmp_path):
    (tmp_path / "a.csv").touch()
    os.truncate(tmp_path / "a.csv", 30 * 10**9)
    with pytest.raises(UserError, match=r"a\.csv has 2\.861e\+04 MiB: a table of points may have 512 MiB"):
        read_points(tmp_path / "a.csv")


HEIGHTS = np.array([[-1.0, -2, -3], [-4, -5, 1e6]])


@pytest.mark.parametrize("corners", [None, "499999,5999998.5 500005,6000001.5"], ids=["centres", "edges"])
def test_bag_has_its_first_row_in_the_south(tmp_path, corners):
    changes = {} if corners is None else {"corners": corners}
    path = write_bag(tmp_path / "a.bag", HEIGHTS, (500000.0, 5999999.25), (2.0, 1.5), **changes)
    grid = read_bag(path)
    np.testing.assert_array_equal(grid.values, np.where(HEIGHTS == 1e6, np.nan, HEIGHTS))
    assert grid.first == (500000.0, 5999999.25)
    assert grid.cell == (2.0, 1.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"corners": "0,0 7,1"}, r"has 3 cells along x, but corners that are 7 cells apart"),
        ({"corners": "0 1"}, "is damaged, or is not a Bathymetric Attributed Grid"),
        ({"system": "GEOGCS[]"}, "has coordinates in degrees"),
        ({"head": "<!DOCTYPE a [<!ENTITY b 'c'>]>"}, "its metadata holds a DOCTYPE"),
    ],
)
def test_bag_with_other_metadata_is_refused(tmp_path, changes, message):
    write_bag(tmp_path / "a.bag", HEIGHTS, (0.0, 0.0), (1.0, 1.0), **changes)
    with pytest.raises(UserError, match=message):
        read_bag(tmp_path / "a.bag")


def test_bag_without_one_grid_is_refused(tmp_path):
    path = tmp_path / "a.bag"
    path.write_bytes(b"not HDF5")
    with pytest.raises(UserError, match="is damaged"):
        read_bag(path)
    for change, message in (("varres_refinements", "variable resolution"), ("elevation", "is damaged")):
        write_bag(path, HEIGHTS, (0.0, 0.0), (1.0, 1.0))
        with h5py.File(path, "a") as file:
            file["BAG_root"].pop(change, None)
            file["BAG_root"][change] = [1, 2]
        with pytest.raises(UserError, match=message):
            read_bag(path)


def test_bag_that_declares_a_million_rows_is_refused_before_it_is_read(tmp_path):
    path = write_bag(tmp_path / "a.bag", HEIGHTS, (0.0, 0.0), (1.0, 1.0))
    with h5py.File(path, "a") as file:
        del file["BAG_root/elevation"]
        file["BAG_root"].create_dataset("elevation", (10**6, 10**6), "f4", chunks=(1000, 1000))
    assert path.stat().st_size < 10**5
    with pytest.raises(UserError, match=r"holds arrays of 7\.629e\+06 MiB, and 256 MiB are the most"):
        read_bag(path)


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
    with pytest.raises(UserError, match="has holes, 1 of 20 heights, the first in row 1 and column 2"):
        read_height_map(path)


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
    with pytest.raises(UserError, match="has holes"):
        read_height_map(path)
    read = read_height_map(path, origin=(0.0, 0.0), holes="fill", values="heights")
    np.testing.assert_allclose(read.heights, -6.0)
    assert read.covers([0, 9, 9, 0], [0, 0, 9, 11]).tolist() == [True, True, False, False]
    assert read.covers(np.zeros((2, 3)), np.full((2, 3), np.nan)).tolist() == [[False] * 3] * 2


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        ([[0, 0, 1], [1, 1, 1]], {}, "has 2 points: a height map needs at least 3"),
        ([[0, 0, 1], [1, 1, 1], [2, 2, 1], [3.5, 3.5, 1]], {}, "has points on a line"),
        (np.eye(3), {"cell": 0.6}, r"map_cell = 0.6 must be at most half of 1 m, the extent"),
        (np.eye(3), {"cell": 0.0}, "map_cell = 0 must be greater than 0"),
        (1e4 * np.eye(3), {"cell": 1.0}, r"holds arrays of 763.* MiB, and 256 MiB are the most"),
        (np.eye(3), {"size": 1.0}, "size = 1.0 must not be given"),
    ],
)
def test_points_that_are_no_map_are_refused(tmp_path, points, options, message):
    path = write_points(tmp_path / "a.xyz", points)
    with pytest.raises(UserError, match=message):
        read_height_map(path, **options)


def test_a_cell_of_another_file_is_refused(tmp_path):
    write_bag(tmp_path / "a.bag", HEIGHTS, (0.0, 0.0), (1.0, 1.0))
    with pytest.raises(UserError, match=r"map_cell = 1.0 must not be given: .* is not a table of points"):
        read_height_map(tmp_path / "a.bag", cell=1.0)


def test_bag_is_a_height_map_about_its_centre(tmp_path):
    write_bag(tmp_path / "a.bag", HEIGHTS[:, :2], (500000.0, 6000000.0), (2.0, 1.0))
    read = read_height_map(tmp_path / "a.bag")
    np.testing.assert_array_equal(read.heights, HEIGHTS[:, :2])
    np.testing.assert_array_equal(read.x, [-1, 1])
    assert read.origin == (500001.0, 6000000.5)
