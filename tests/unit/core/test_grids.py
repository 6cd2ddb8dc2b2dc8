"""Grids in map coordinates: BAG files, and coordinate systems beside ASCII grids."""

import h5py
import numpy as np
import pyproj
import pytest
from array_inputs import write_bag
from rows import must_refuse, refuses

from mitransient_lidar.core.maps import read_bag
from mitransient_lidar.physics.sea.height_maps import read_height_map

HEIGHTS = np.array([[-1.0, -2, -3], [-4, -5, 1e6]])


@pytest.mark.parametrize("corners", [None, "499999,5999998.5 500005,6000001.5"], ids=["centres", "edges"])
def test_bag_has_its_first_row_in_the_south(tmp_path, corners):
    changes = {} if corners is None else {"corners": corners}
    path = write_bag(tmp_path / "a.bag", HEIGHTS, (500000.0, 5999999.25), (2.0, 1.5), **changes)
    grid = read_bag(path)
    np.testing.assert_array_equal(grid.values, np.where(HEIGHTS == 1e6, np.nan, HEIGHTS))
    assert grid.centre == (500002.0, 6000000.0)
    np.testing.assert_array_equal(grid.positions["x"], [-2.0, 0.0, 2.0])
    np.testing.assert_array_equal(grid.positions["y"], [-0.75, 0.75])


@refuses(
    ({"corners": "0,0 7,1"}, r"has 3 cells along x, but corners that are 7 cells apart"),
    ({"corners": "0 1"}, "has no map coordinates"),
    ({"system": pyproj.CRS(4326).to_wkt("WKT1_GDAL")}, "has coordinates in degrees"),
    ({"system": pyproj.CRS(4326).to_wkt("WKT2_2019")}, "has coordinates in degrees"),
)
def test_bag_with_other_metadata_is_refused(changes, tmp_path):
    write_bag(tmp_path / "a.bag", HEIGHTS, (0.0, 0.0), (1.0, 1.0), **changes)
    read_bag(tmp_path / "a.bag")


def test_bag_states_its_datum_and_is_positive_up(tmp_path):
    depth = 'VERT_CS["Mean Lower Low Water Depth",VERT_DATUM["MLLW",2005],UNIT["metre",1],AXIS["Depth",DOWN]]'
    stated = read_bag(write_bag(tmp_path / "a.bag", HEIGHTS, (5e5, 6e6), (1.0, 1.0), datum=depth)).stated
    assert (stated.unit, stated.is_down, stated.position_unit) == ("m", False, "metre")
    assert stated.system.datum == "Mean Lower Low Water Depth"


def test_bag_without_one_grid_is_refused(tmp_path, capfd):
    path = tmp_path / "a.bag"
    path.write_bytes(b"not HDF5")
    must_refuse("is damaged", read_bag, path)
    for change in ("varres_refinements", "elevation", "metadata"):
        write_bag(path, HEIGHTS, (0.0, 0.0), (1.0, 1.0))
        with h5py.File(path, "a") as file:
            file["BAG_root"].pop(change, None)
            file["BAG_root"][change] = [1, 2]
            if change == "varres_refinements":
                file["BAG_root/varres_metadata"] = [1, 2]
        must_refuse(r"is damaged, or is not a Bathymetric .* of one resolution|has no map coordinates", read_bag, path)
    assert capfd.readouterr() == ("", "")


def test_bag_that_declares_a_million_rows_is_refused_before_it_is_read(tmp_path):
    path = write_bag(tmp_path / "a.bag", HEIGHTS, (0.0, 0.0), (1.0, 1.0))
    with h5py.File(path, "a") as file:
        del file["BAG_root/elevation"]
        file["BAG_root"].create_dataset("elevation", (10**6, 10**6), "f4", chunks=(1000, 1000))
    assert path.stat().st_size < 10**5
    must_refuse(r"holds arrays of 7\.629e\+06 MiB, and 256 MiB are the most", read_bag, path)


def test_bag_is_a_height_map_about_its_centre(tmp_path):
    write_bag(tmp_path / "a.bag", HEIGHTS[:, :2], (500000.0, 6000000.0), (2.0, 1.0))
    read = read_height_map(tmp_path / "a.bag")
    np.testing.assert_array_equal(read.heights, HEIGHTS[:, :2])
    np.testing.assert_array_equal(read.x, [-1, 1])
    assert read.origin == (500001.0, 6000000.5)
