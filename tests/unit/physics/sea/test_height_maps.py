"""Height maps from every file format: orientation, positions, and rejected files."""

import logging
import warnings

import numpy as np
import OpenEXR
import pytest
import rasterio
import xarray as xr
from rows import each_row, must_refuse, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.sea.height_maps import HeightMap, read_height_map

# Rows go up in y, columns in x: a map without symmetry under rotation or mirroring, not square.
HEIGHTS = np.array([[0.0, 1, 2, 3], [10, 11, 12, 13], [20, 21, 22, 25]])
X, Y = np.array([-3.0, -1, 1, 3]), np.array([5.0, 5.5, 6])


def write_exr(path, channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(path))
    return path


def write_netcdf(path, heights, dims=("y", "x"), name="height", coords=None, **more):
    variables = {name: (dims, heights), **more}
    xr.Dataset(variables, coords).to_netcdf(path, engine="h5netcdf")
    return path


def write_npy(path, heights):
    np.save(path, heights)
    return path


def write_npz(path, **arrays):
    np.savez(path, **arrays)
    return path


def assert_is_the_map(read, x=X, y=Y):
    assert read.heights.dtype == np.float64
    np.testing.assert_array_equal(read.heights, HEIGHTS)
    np.testing.assert_allclose(read.x, x)
    np.testing.assert_allclose(read.y, y)


def test_npy_is_centred_on_the_origin(tmp_path):
    path = write_npy(tmp_path / "map.npy", HEIGHTS.astype(np.float32))
    # The size is that from the first to the last column, along x; cells are squares.
    assert_is_the_map(read_height_map(path, 6.0), y=[-2, 0, 2])
    assert_is_the_map(read_height_map(str(path), 6), y=[-2, 0, 2])


@each_row(np.float32, np.float16, np.uint32)
@each_row(("depth", []), ("Y", ["stderr"]), ("R", ["G", "B"]), ("Z", ["A"]), ("Y", ["R", "Z"]))
def test_top_row_of_an_exr_image_has_the_largest_y(wanted, others, kind, tmp_path):
    zeros = np.zeros(HEIGHTS.shape, dtype=kind)
    path = write_exr(tmp_path / "MAP.EXR", {wanted: HEIGHTS[::-1].astype(kind), **dict.fromkeys(others, zeros)})
    assert_is_the_map(read_height_map(path, 6.0), y=[-2, 0, 2])


def test_sample_returns_the_map_at_its_points_and_planes_between():
    # h = 2 + 3x - y + xy is bilinear.
    x, y = np.linspace(-3, 4, 8), np.linspace(10, 12, 5)
    surface = HeightMap(2 + 3 * x - y[:, None] + x * y[:, None], x, y)
    np.testing.assert_array_equal(surface.sample(x, y), surface.heights)
    east, north = np.array([-2.9, 0.3, 3.99]), np.array([10.0, 10.2, 11.99, 12])
    np.testing.assert_allclose(surface.sample(east, north), 2 + 3 * east - north[:, None] + east * north[:, None])
    # Outside the heights are those of the nearest point of the edge.
    outside = HeightMap(HEIGHTS, X, Y).sample([-100, -3, 0, 3, 100], [-100, 5.25, 100])
    np.testing.assert_array_equal(outside, [[0, 0, 1.5, 3, 3], [5, 5, 6.5, 8, 8], [20, 20, 21.5, 25, 25]])


def with_holes():
    heights = HEIGHTS.copy()
    heights[1, 3], heights[2, 0] = np.nan, -np.inf
    return heights


@each_row(
    (HEIGHTS, None, "has no positions of its heights: give the size of the map along x, in metres"),
    (HEIGHTS, 0, "size = 0 must be greater than 0"),
    *((bad, 1, "has heights of shape") for bad in (HEIGHTS[0], HEIGHTS[:1], HEIGHTS[:, :1], HEIGHTS[None])),
    (HEIGHTS + 0j, 1, "has heights of type complex128, but they must be real numbers"),
    (HEIGHTS.astype(str), 1, "has heights of type <U32, but they must be real numbers"),
    (with_holes(), 1, "has holes, 2 of 12 heights, the first in row 1 and column 3 counted from 0"),
)
def test_invalid_maps_are_rejected(heights, size, message, tmp_path):
    must_refuse(f"^[^\\n]*{message}[^\\n]*$", read_height_map, write_npy(tmp_path / "map.npy", heights), size)


@each_row(
    ({"x": X}, "has positions x only: it must have both x and y, or none"),
    ({"x": X[1:], "y": Y}, "has x of shape (3,), but its heights need (4,)"),
    ({"x": X, "y": np.stack([Y] * 4)}, "has y of shape (4, 3), but its heights need (3,)"),
    ({"x": X, "y": Y[::-1]}, "has y[0] = 6 and y[1] = 5.5: positions must increase"),
    ({"x": [0, np.nan, 2, 3], "y": Y}, "has x[1] = nan: positions must be finite"),
    ({"x": [0, 1, 2, 3.01], "y": Y}, "has x[2] and x[3] 1.01 apart, but 1.00333 on average: positions must"),
    ({"x": ["a", "b", "c", "d"], "y": Y}, "has x of type <U1, but they must be real numbers"),
)
def test_invalid_positions_are_rejected(positions, message, tmp_path):
    path = write_npz(tmp_path / "map.npz", heights=HEIGHTS, **positions)
    with pytest.raises(UserError) as error:
        read_height_map(path)
    assert message in str(error.value)


def test_files_without_one_map_are_rejected(tmp_path):
    path = write_npz(tmp_path / "map.npz", depths=HEIGHTS)
    must_refuse(r"map.npz must have an array heights, and may have x and y", read_height_map, path)
    path = write_exr(tmp_path / "map.exr", dict.fromkeys("AB", HEIGHTS.astype(np.float32)))
    must_refuse("has the channels A, B: it must have only one, or one called Y, R or Z", read_height_map, path)
    path = write_netcdf(tmp_path / "map.nc", HEIGHTS, name="a", b=(("y", "x"), HEIGHTS))
    must_refuse("has 2 variables that may be the heights", read_height_map, path)
    path = write_netcdf(tmp_path / "map.nc", HEIGHTS[0], dims=("x",), name="a")
    must_refuse("has 0 variables that may be the heights", read_height_map, path)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".exr", ".nc"])
def test_missing_and_damaged_files_are_rejected(tmp_path, suffix, capfd):
    path = tmp_path / f"map{suffix}"
    must_refuse(f"cannot read .*map{suffix}: No such file or directory", read_height_map, path, 6.0)
    writers = {
        ".npy": lambda: write_npy(path, HEIGHTS),
        ".npz": lambda: write_npz(path, heights=HEIGHTS),
        ".exr": lambda: write_exr(path, {"Y": HEIGHTS.astype(np.float32)}),
        ".nc": lambda: write_netcdf(path, HEIGHTS),
    }
    writers[suffix]()
    content = path.read_bytes()
    np.save(tmp_path / "objects.npy", np.array([[1, 2], [3, None]], dtype=object))
    pickled = (tmp_path / "objects.npy").read_bytes()
    for damaged in (content[: len(content) // 2], content[:-20], b"", b"neither of these\n" * 20, pickled):
        path.write_bytes(damaged)
        must_refuse(f"map{suffix} is damaged, or is not", read_height_map, path, 6.0)
    # There is no output besides the exception.
    assert capfd.readouterr() == ("", "")


HEADER = {"ncols": 4, "nrows": 3, "xllcorner": 499997, "yllcorner": 6000004.5, "cellsize": 2, "NODATA_value": -9999}


def write_ascii_grid(path, rows=HEIGHTS[::-1], **changes):
    """Write a grid whose cell centres are X + 500001 and, as its cells are squares, 6000005.5, ...7.5, ...9.5."""
    header = {name: value for name, value in {**HEADER, **changes}.items() if value is not None}
    lines = [f"{name:<14}{value}" for name, value in header.items()]
    path.write_text("\n".join([*lines, *(" ".join(map(str, row)) for row in rows), ""]))
    return path


@each_row(
    {},
    {"xllcorner": None, "xllcenter": 499998, "yllcorner": None, "yllcenter": 6000005.5},
    {"cellsize": None, "dx": 2, "dy": 2, "NODATA_value": None},
    {"cellsize": "2,0"},
)
def test_ascii_grid_is_placed_by_its_centre_or_a_point(changes, tmp_path, caplog):
    path = write_ascii_grid(tmp_path / "map.asc", **changes)
    with caplog.at_level(logging.INFO):
        read = read_height_map(path)
    assert_is_the_map(read, y=[-2, 0, 2])
    assert read.origin == (500001, 6000007.5)
    assert caplog.messages == [
        f"{path}: map of 4 x 3 cells, 6 x 4 m, heights from 0 to 25 m; x = y = 0 is its point (500001, 6000007.5), the"
        " centre; values in m (not stated), positive up (not stated), zero at mean sea level (not stated), 0 holes;"
        " positions in m (not stated), coordinate system not stated"
    ]
    moved = read_height_map(path, origin=(499999.0, 6000005.5))
    assert_is_the_map(moved, x=X + 2, y=[0, 2, 4])
    assert moved.origin == (499999.0, 6000005.5)


def test_origin_moves_positions_of_other_formats(tmp_path, caplog):
    path = write_npz(tmp_path / "map.npz", heights=HEIGHTS, x=X + 5e5, y=Y)
    assert_is_the_map(read_height_map(path, origin=(5e5, 5.5)), y=[-0.5, 0, 0.5])
    caplog.clear()
    assert_is_the_map(read_height_map(path), x=X + 5e5)
    assert "x from 499997 to 500003 and y from 5 to 6 m do not contain x = y = 0" in caplog.messages[0]


def test_holes_have_the_value_of_the_nearest_cell(tmp_path, caplog):
    rows = HEIGHTS[::-1].copy()
    rows[0, 0], rows[1, 3] = -9999, np.nan
    path = write_ascii_grid(tmp_path / "map.asc", rows)
    must_refuse(r"has holes, 2 of 12 heights, the first in row 1 and column 3.*unless map_", read_height_map, path)
    read = read_height_map(path, holes="fill")
    # Without the cell in row 2 and column 0, its neighbours are those to the right and below.
    assert read.heights[2, 0] in (HEIGHTS[2, 1], HEIGHTS[1, 0])
    assert read.heights[1, 3] in (HEIGHTS[1, 2], HEIGHTS[0, 3], HEIGHTS[2, 3])
    kept = np.isfinite(rows[::-1]) & (rows[::-1] != -9999)
    np.testing.assert_array_equal(read.heights[kept], HEIGHTS[kept])
    assert "2 of 12 heights are missing, filled from the nearest cells" in caplog.text


@refuses(
    ({"ncols": 5}, "has 12 values but must have ncols = 5 times nrows = 3"),
    ({"ncols": -4, "nrows": -3}, "ncols = -4 must lie between 1 and"),
    ({"nrows": None}, "must have nrows in its header, which has ncols, xllcorner, yllcorner, cellsize"),
    ({"xllcorner": None}, "must have xllcenter or xllcorner in its header"),
    ({"cellsize": 0}, "cellsize = 0 must be greater than 0"),
    ({"cellsize": "wide"}, "map.asc is damaged, or is not an ESRI ASCII grid: could not convert"),
    ({"rows": [["a"] * 12]}, "map.asc is damaged, or is not an ESRI ASCII grid"),
)
def test_invalid_ascii_grids_are_rejected(changes, tmp_path):
    read_height_map(write_ascii_grid(tmp_path / "map.asc", **changes))


@each_row(
    ({"size": 6.0}, r"size = 6.0 must not be given: .*map.asc has positions of its own"),
    ({"origin": (6000007.5, 500001)}, r"origin_x = 6000007.5 must lie within 10 km of .*map.asc, whose x is"),
    ({"origin": (5e5, 6010009.75)}, r"origin_y = 6010009.75 must lie within 10 km of .* is 6000005.5 to 6000009.5"),
)
def test_invalid_placements_are_rejected(options, message, tmp_path):
    must_refuse(message, read_height_map, write_ascii_grid(tmp_path / "map.asc"), **options)
    with pytest.raises(UserError, match=r"origin_x and origin_y must not be given: .*map.npy has no positions"):
        read_height_map(write_npy(tmp_path / "map.npy", HEIGHTS), 6.0, (0.0, 0.0))


def write_geotiff(path, heights=HEIGHTS[::-1], count=1, transform=(2, 0, 499997, 0, -2, 6000010.5), crs=32633, **tags):
    shape = {"height": heights.shape[0], "width": heights.shape[1], "count": count, "dtype": heights.dtype}
    place = {"crs": f"EPSG:{crs}", "transform": rasterio.Affine(*transform)} if transform else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        file = rasterio.open(path, "w", driver="GTiff", **shape, **place, nodata=tags.get("nodata"))
    with file:
        for band in range(count):
            file.write(heights, band + 1)
        file.scales, file.offsets = [tags.get("scale", 1.0)] * count, [tags.get("offset", 0.0)] * count
        file.units = [tags.get("unit", "")] * count
    return path


def test_geotiff_equals_the_ascii_grid(tmp_path):
    expected = read_height_map(write_ascii_grid(tmp_path / "map.asc"))
    south_up = {"heights": HEIGHTS, "transform": (2, 0, 499997, 0, 2, 6000004.5)}
    scaled = {"heights": (HEIGHTS[::-1] * 10 + 50).astype(np.int16), "scale": 0.1, "offset": -5.0, "unit": "metre"}
    for changes in ({}, {"heights": HEIGHTS[::-1].astype(np.float32)}, south_up, scaled):
        read = read_height_map(write_geotiff(tmp_path / "map.TIF", **changes))
        np.testing.assert_allclose(read.heights, HEIGHTS, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(read.x, expected.x)
        np.testing.assert_array_equal(read.y, expected.y)
        assert read.origin == expected.origin


@refuses(
    ({"count": 2}, "has 2 bands: a height map must have one"),
    ({"transform": None}, "has no map coordinates"),
    ({"transform": (2, 0.1, 499997, 0, -2, 6000010.5)}, "is rotated against its map coordinates"),
)
def test_unsuitable_geotiffs_are_rejected(changes, tmp_path):
    read_height_map(write_geotiff(tmp_path / "map.tif", **changes))


def test_geotiff_that_declares_a_million_rows_is_refused_before_it_is_read(tmp_path):
    options = {"count": 1, "dtype": "float32", "crs": 32633, "tiled": True, "sparse_ok": True, "bigtiff": "yes"}
    place = rasterio.Affine(1, 0, 500000, 0, -1, 6000000)
    shape = {"width": 10**5, "height": 10**6, "blockxsize": 4096, "blockysize": 4096}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", transform=place, **shape, **options):
        pass
    assert (tmp_path / "a.tif").stat().st_size < 10**6
    must_refuse(r"a.tif holds arrays of 7.629e\+05 MiB, and 256 MiB are the most", read_height_map, tmp_path / "a.tif")
