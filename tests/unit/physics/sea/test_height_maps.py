"""Height maps from every file format: orientation, positions, and rejected files."""

import numpy as np
import OpenEXR
import pytest
import xarray as xr

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


def test_npz_with_and_without_positions(tmp_path):
    path = write_npz(tmp_path / "map.npz", heights=HEIGHTS, x=X, y=Y)
    assert_is_the_map(read_height_map(path))
    path = write_npz(tmp_path / "map.npz", heights=HEIGHTS.astype(int))
    assert_is_the_map(read_height_map(path, 6.0), y=[-2, 0, 2])


@pytest.mark.parametrize("kind", [np.float32, np.float16, np.uint32])
@pytest.mark.parametrize(
    ("wanted", "others"), [("depth", []), ("Y", ["stderr"]), ("R", ["G", "B"]), ("Z", ["A"]), ("Y", ["R", "Z"])]
)
def test_top_row_of_an_exr_image_has_the_largest_y(tmp_path, kind, wanted, others):
    zeros = np.zeros(HEIGHTS.shape, dtype=kind)
    path = write_exr(tmp_path / "MAP.EXR", {wanted: HEIGHTS[::-1].astype(kind), **dict.fromkeys(others, zeros)})
    assert_is_the_map(read_height_map(path, 6.0), y=[-2, 0, 2])


@pytest.mark.parametrize("name", ["height", "elevation", "sea"])
@pytest.mark.parametrize("dims", [("y", "x"), ("x", "y")])
def test_netcdf_with_coordinates_in_either_order(tmp_path, name, dims):
    values = HEIGHTS if dims == ("y", "x") else HEIGHTS.T
    more = {"mask": (dims, np.zeros(values.shape))} if name != "sea" else {"time": ((), 1.0)}
    path = write_netcdf(tmp_path / "map.nc", values, dims, name, {"x": X, "y": Y}, **more)
    assert_is_the_map(read_height_map(path))


def test_netcdf_without_coordinates_needs_a_size(tmp_path):
    path = write_netcdf(tmp_path / "map.nc", HEIGHTS, ("row", "column"))
    assert_is_the_map(read_height_map(path, 6.0), y=[-2, 0, 2])
    with pytest.raises(ValueError, match=r"map.nc has no positions of its heights: give the size"):
        read_height_map(path)


def test_sample_returns_the_map_at_its_points_and_planes_between():
    # h = 2 + 3x - y + xy is bilinear.
    x, y = np.linspace(-3, 4, 8), np.linspace(10, 12, 5)
    surface = HeightMap(2 + 3 * x - y[:, None] + x * y[:, None], x, y)
    np.testing.assert_array_equal(surface.sample(x, y), surface.heights)
    east, north = np.array([-2.9, 0.3, 3.99]), np.array([10.0, 10.2, 11.99, 12])
    np.testing.assert_allclose(surface.sample(east, north), 2 + 3 * east - north[:, None] + east * north[:, None])


def test_sample_outside_has_the_height_of_the_nearest_point_of_the_edge():
    surface = HeightMap(HEIGHTS, X, Y)
    np.testing.assert_array_equal(
        surface.sample([-100, -3, 0, 3, 100], [-100, 5.25, 100]),
        [[0, 0, 1.5, 3, 3], [5, 5, 6.5, 8, 8], [20, 20, 21.5, 25, 25]],
    )


def with_holes():
    heights = HEIGHTS.copy()
    heights[1, 3], heights[2, 0] = np.nan, -np.inf
    return heights


@pytest.mark.parametrize(
    ("heights", "size", "message"),
    [
        (HEIGHTS, None, "has no positions of its heights: give the size of the map along x, in metres."),
        (HEIGHTS, 0, "size = 0 must be greater than 0"),
        (HEIGHTS, np.nan, "size = nan must be finite"),
        (HEIGHTS[0], 1, "has heights of shape (4,), but must have at least 2 rows and 2 columns."),
        (HEIGHTS[:1], 1, "has heights of shape (1, 4), but must have at least 2 rows and 2 columns."),
        (HEIGHTS[:, :1], 1, "has heights of shape (3, 1), but must have at least 2 rows and 2 columns."),
        (HEIGHTS[None], 1, "has heights of shape (1, 3, 4), but must have at least 2 rows and 2 columns."),
        (HEIGHTS + 0j, 1, "has heights of type complex128, but they must be real numbers."),
        (HEIGHTS.astype(str), 1, "has heights of type <U32, but they must be real numbers."),
        (with_holes(), 1, "has holes, 2 of 12 heights, the first in row 1 and column 3 counted from 0"),
    ],
)
def test_invalid_maps_are_rejected(tmp_path, heights, size, message):
    path = write_npy(tmp_path / "map.npy", heights)
    with pytest.raises(UserError) as error:
        read_height_map(path, size)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_holes_of_an_image_are_counted_from_the_smallest_y(tmp_path):
    image = HEIGHTS[::-1].astype(np.float32)
    image[0, 1] = np.nan
    path = write_exr(tmp_path / "map.exr", {"Y": image})
    with pytest.raises(ValueError, match="1 of 12 heights, the first in row 2 and column 1"):
        read_height_map(path, 6.0)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ({"x": X}, "has positions x only: it must have both x and y, or none."),
        ({"x": X[1:], "y": Y}, "has x of shape (3,), but its heights need (4,)."),
        ({"x": X, "y": np.stack([Y] * 4)}, "has y of shape (4, 3), but its heights need (3,)."),
        ({"x": X, "y": Y[::-1]}, "has y[0] = 6 and y[1] = 5.5: positions must increase."),
        ({"x": [0, np.nan, 2, 3], "y": Y}, "has x[1] = nan: positions must be finite."),
        ({"x": [0, 1, 2, np.inf], "y": Y}, "has x[3] = inf: positions must be finite."),
        ({"x": [0, 1, 2, 3.01], "y": Y}, "has x[2] and x[3] 1.01 apart, but 1.00333 on average: positions must"),
        ({"x": ["a", "b", "c", "d"], "y": Y}, "has x of type <U1, but they must be real numbers."),
    ],
)
def test_invalid_positions_are_rejected(tmp_path, positions, message):
    path = write_npz(tmp_path / "map.npz", heights=HEIGHTS, **positions)
    with pytest.raises(UserError) as error:
        read_height_map(path)
    assert message in str(error.value)


def test_positions_may_be_rounded(tmp_path):
    path = write_npz(tmp_path / "map.npz", heights=HEIGHTS, x=[0, 1 / 3, 0.6665, 1], y=Y)
    assert read_height_map(path).x[2] == 0.6665


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_a_size_with_positions_is_rejected(tmp_path, suffix):
    path = tmp_path / f"map{suffix}"
    if suffix == ".nc":
        write_netcdf(path, HEIGHTS, coords={"x": X, "y": Y})
    else:
        write_npz(path, heights=HEIGHTS, x=X, y=Y)
    with pytest.raises(ValueError, match=r"size = 6 must not be given: .*map.* has positions of its own"):
        read_height_map(path, 6)


def test_files_without_one_map_are_rejected(tmp_path):
    path = write_npz(tmp_path / "map.npz", depths=HEIGHTS)
    with pytest.raises(ValueError, match=r"map.npz must have an array heights, and may have x and y"):
        read_height_map(path)
    path = write_exr(tmp_path / "map.exr", dict.fromkeys("AB", HEIGHTS.astype(np.float32)))
    with pytest.raises(ValueError, match="has the channels A, B: it must have only one, or one called Y, R or Z"):
        read_height_map(path)
    path = write_netcdf(tmp_path / "map.nc", HEIGHTS, name="a", b=(("y", "x"), HEIGHTS))
    with pytest.raises(ValueError, match="has 2 variables that may be the heights"):
        read_height_map(path)
    path = write_netcdf(tmp_path / "map.nc", HEIGHTS[0], dims=("x",), name="a")
    with pytest.raises(ValueError, match="has 0 variables that may be the heights"):
        read_height_map(path)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".exr", ".nc"])
def test_missing_and_damaged_files_are_rejected(tmp_path, suffix, capfd):
    path = tmp_path / f"map{suffix}"
    with pytest.raises(ValueError, match=f"cannot read .*map{suffix}: No such file or directory"):
        read_height_map(path, 6.0)
    writers = {
        ".npy": lambda: write_npy(path, HEIGHTS),
        ".npz": lambda: write_npz(path, heights=HEIGHTS),
        ".exr": lambda: write_exr(path, {"Y": HEIGHTS.astype(np.float32)}),
        ".nc": lambda: write_netcdf(path, HEIGHTS),
    }
    writers[suffix]()
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], content[:-20], b"", b"neither of these\n" * 20):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"map{suffix} is damaged, or is not"):
            read_height_map(path, 6.0)
    # There is no output besides the exception.
    assert capfd.readouterr() == ("", "")


def test_pickled_objects_are_never_loaded(tmp_path):
    path = write_npy(tmp_path / "map.npy", np.array([[1, 2], [3, None]], dtype=object))
    with pytest.raises(ValueError, match=r"map.npy is damaged, or is not one array of numbers"):
        read_height_map(path, 6.0)


def test_other_suffixes_are_rejected(tmp_path):
    with pytest.raises(ValueError, match=r"map.tif: the name of a height map must end in .npy, .npz, .exr, .nc"):
        read_height_map(tmp_path / "map.tif")
