"""The bottom: heights, patches, cells and errors."""

import mitsuba as mi
import numpy as np
import pyproj
import pytest
import xarray as xr
from kernel_arrays import array
from rows import each_row


def load(**parameters):
    return mi.load_dict({"type": "seabed", **parameters})


def look_down(shape, x, y):
    """Return heights [m], reflectances and normals under points (x, y), as rays find them."""
    scene = mi.load_dict({"type": "scene", "shape": shape})
    x, y = (array(values) for values in (x, y))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 50.0), mi.Vector3f(0, 0, -1)))
    reflectance = si.bsdf().eval_diffuse_reflectance(si)
    return np.array(si.p)[2], np.array(reflectance)[0], np.array(si.n).T


def test_plain_bottom_is_two_triangles_that_face_up():
    shape = load(depth=6.5, reflectance=0.25)
    assert shape.face_count() == 2
    z, reflectance, normal = look_down(shape, [0.0, 300.0, -499.0], [0.0, -40.0, 499.0])
    np.testing.assert_allclose(z, -6.5)
    np.testing.assert_allclose(reflectance, 0.25, rtol=1e-6)
    np.testing.assert_allclose(normal, np.tile([0, 0, 1], (3, 1)), atol=1e-6)


def test_slopes_rise_towards_positive_x_and_y():
    z, _, normal = look_down(load(slope_x_deg=10.0, slope_y_deg=-5.0), [3.0, 0.0], [0.0, 4.0])
    np.testing.assert_allclose(z, [-8 + 3 * np.tan(np.radians(10)), -8 - 4 * np.tan(np.radians(5))], rtol=1e-5)
    # A slope that rises towards +x faces -x.
    assert normal[0, 0] < 0 < normal[0, 1]


def test_depth_is_that_at_the_origin_wherever_the_middle_lies():
    z, _, _ = look_down(load(slope_x_deg=10.0, centre_x=20.0, size=100.0), [20.0, 0.0], [0.0, 0.0])
    np.testing.assert_allclose(z, [-8 + 20 * np.tan(np.radians(10)), -8], rtol=1e-5)


def test_bowl_rises_with_the_square_of_the_distance_and_ends_with_the_fine_square():
    shape = load(curvature=0.04, centre_x=1.0, refined_size=20.0)
    z, _, _ = look_down(shape, [1.0, 4.0, 1.0, 101.0], [0.0, 0.0, 5.0, 0.0])
    np.testing.assert_allclose(z, [-8, -8 + 0.02 * 9, -8 + 0.02 * 25, -8 + 0.02 * 100], atol=1e-3)
    mound, _, _ = look_down(load(curvature=-0.04), [3.0], [0.0])
    np.testing.assert_allclose(mound, -8 - 0.02 * 9, atol=1e-3)


@pytest.mark.slow
def test_ripples_have_their_height_length_and_bearing():
    shape = load(ripple_height=0.1, ripple_length=0.5, ripple_bearing_deg=90.0)
    y = np.arange(-2, 2, 0.0625)
    z, _, _ = look_down(shape, np.full_like(y, 0.31), y)
    np.testing.assert_allclose(z, -8 + 0.05 * np.cos(2 * np.pi * y / 0.5), atol=1e-4)
    along, _, _ = look_down(shape, np.arange(-2, 2, 0.1), np.full(40, 0.25))
    assert np.ptp(along) < 1e-4


def test_height_map_is_added(tmp_path):
    x, y = np.linspace(-3, 4, 29), np.linspace(10, 13, 13)
    heights = 0.5 * x - 0.25 * y[:, None]
    np.savez(tmp_path / "map.npz", heights=heights, x=x, y=y)
    z, _, _ = look_down(load(filename=str(tmp_path / "map.npz"), depth=4.0), [0.2, 3.9, 60.0], [11.1, 12.8, 11.5])
    # Beyond the map the heights of its edge continue.
    expected = [-4 + 0.1 - 2.775, -4 + 1.95 - 3.2, -4 + 2 - 2.875]
    np.testing.assert_allclose(z, expected, atol=1e-3)


def test_the_same_map_is_at_the_same_depth_in_every_format(tmp_path):
    """With positions of its own or without, it is a map of heights above the sea: the default depth is 0, not 8 m."""
    heights, x = np.full((5, 5), -7.25), np.arange(5.0) - 2
    np.save(tmp_path / "map.npy", heights)
    np.savez(tmp_path / "map.npz", heights=heights, x=x, y=x)
    header = "ncols 5\nnrows 5\nxllcenter -2\nyllcenter -2\ncellsize 1\n"
    (tmp_path / "map.asc").write_text(header + " ".join(["-7.25"] * 25))
    xr.Dataset({"height": (("y", "x"), heights)}, {"x": x, "y": x}).to_netcdf(tmp_path / "map.nc", engine="h5netcdf")
    for suffix, more in ((".npy", {"map_size": 4.0}), (".npz", {}), (".asc", {}), (".nc", {})):
        shape = load(filename=str(tmp_path / f"map{suffix}"), **more)
        np.testing.assert_allclose(look_down(shape, [0.0, 1.5], [0.0, -1.5])[0], -7.25)


def test_unit_and_missing_values_of_a_map_are_given(tmp_path):
    np.savetxt(tmp_path / "map.csv", [[x, y, 10 if x + y else -999] for x in range(5) for y in range(5)], delimiter=",")
    given = {"map_values": "depths", "map_unit": "ft", "map_no_data": -999.0, "map_holes": "fill"}
    shape = load(filename=str(tmp_path / "map.csv"), **given)
    np.testing.assert_allclose(look_down(shape, [0.0, -2.0], [0.0, -2.0])[0], -3.048)


GRID = """ncols 5
nrows 3
xllcorner 512340.25
yllcorner 6543209.75
cellsize 2
NODATA_value -99
7 7 7 8 9
7 -99 7 8 9
5 6 7 8 9
"""


def test_surveyed_depths_are_those_below_the_sea_level(tmp_path):
    """Origins are kept to the millimetre: those of 32 bits would be off by up to a quarter of a metre."""
    path = tmp_path / "survey.asc"
    path.write_text(GRID)
    survey = {"filename": str(path), "map_values": "depths", "map_holes": "fill"}
    shape = load(**survey)
    assert shape.bottom.depth == 0
    assert shape.bottom.terrain.origin == (512345.25, 6543212.75)
    np.testing.assert_allclose(look_down(shape, [0.0, 3.0, -4.0], [0.0, 1.0, -2.0])[0], [-7, -8.5, -5], atol=1e-6)
    moved = load(**survey, origin_x=512349.125, origin_y=6543211.125)
    # The middle of the fine square is that of the map, 3.875 m west and 1.625 m north of the new origin.
    assert moved.bottom.centre == (-3.875, 1.625)
    np.testing.assert_allclose(look_down(moved, [0.0, -3.875], [0.0, 1.625])[0], [-8.9375, -7], atol=1e-6)
    assert load(**survey, origin_x=512349.125, origin_y=6543211.125, refined_size=4.0).bottom.centre == (0, 0)


@pytest.mark.slow
def test_patches_have_their_reflectance_and_area():
    shape = load(patches="0 0 1 0.4; 3, -1, 0.5, 0; 0.5 0 0.3 0.9", reflectance=0.2)
    _, reflectance, _ = look_down(shape, [-0.5, 0.5, 3.0, 5.0, 0.0], [0.0, 0.0, -1.0, 5.0, 1.2])
    np.testing.assert_allclose(reflectance, [0.4, 0.9, 0, 0.2, 0.2], atol=1e-6)
    # Mean over a square of 4 m around one disc of radius 1 m.
    side = np.linspace(-1.995, 1.995, 400)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    _, reflectance, _ = look_down(load(patches="0 0 1 0.4", reflectance=0.2), x, y)
    assert reflectance.mean() == pytest.approx(0.2 + 0.2 * np.pi / 16, rel=2e-3)


@each_row(
    ({"ripple_height": 0.1}, "ripple_height = 0.1 must be at most 0.3 of ripple_length = 0.2"),
    ({"ripple_height": 0.01, "cell_size": 0.1}, "cell_size = 0.1 must be at most a quarter of ripple_length"),
    ({"cell_size": 0.001}, "size = 20 with cell_size = 0.001 needs 20000 cells a side: allowed are 2048"),
    ({"map_size": 4.0}, "map_size = 4.0 needs a height map"),
    ({"origin_y": 4.0}, "origin_y = 4.0 needs a height map"),
    ({"map_holes": "fill"}, "map_holes = fill needs a height map"),
    ({"filename": "any.asc", "origin_x": 4.0}, "origin_x = 4.0 and origin_y = None must be given together"),
    ({"filename": "nowhere.npy", "map_size": 4.0}, "cannot read nowhere.npy: No such file"),
    ({"patches": "0 0 1 1.3"}, "patches: reflectance of number 1 = 1.3 must lie between 0 and 1"),
    ({"patches": "0 0 1 0.3; 2 2 0 0.1"}, "patches: radius of number 2 = 0 must be greater than 0"),
    ({"patches": "0 0 1"}, "patches: '0 0 1' must be four numbers, x y radius reflectance"),
    ({"patches": "0 0 a 0.1"}, "patches: radius of number 1 = 'a' must be a number"),
    ({"patches": "9 0 2 0.1", "refined_size": 20.0}, r"patches: number 1 reaches 11 m from \(0, 0\), but must"),
)
def test_invalid_parameters_are_named(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        load(**parameters)


def test_map_of_land_alone_is_told_unless_it_says_that_it_is(tmp_path, caplog):
    np.save(tmp_path / "map.npy", np.array([[2.0, 3.0], [4.0, 5.0]]))
    for given, told in (({}, 1), ({"map_values": "heights"}, 0), ({"map_values": "depths"}, 0), ({"depth": 3.0}, 0)):
        caplog.clear()
        load(filename=str(tmp_path / "map.npy"), map_size=1.0, **given)
        assert caplog.text.count("is land alone, from 2 m above the sea on") == told


def test_maps_with_coordinate_systems_are_read_again_and_again(tmp_path):
    """Mitsuba reads shapes in threads of its own, in which pyproj took a context that it had destroyed: a crash."""
    for name in ("one", "other"):
        (tmp_path / f"{name}.asc").write_text(
            "ncols 2\nnrows 2\nxllcorner 5e5\nyllcorner 6e6\ncellsize 9\n-4 -5\n-6 -7\n"
        )
        (tmp_path / f"{name}.prj").write_text(pyproj.CRS(32633).to_wkt("WKT1_ESRI"))
    beds = {name: {"type": "seabed", "filename": str(tmp_path / f"{name}.asc")} for name in ("one", "other")}
    for _ in range(8):
        assert len(mi.load_dict({"type": "scene", **beds}).shapes()) == 2
