"""Continuous profiles: from files, and as layers whose optical depths are those of the linear profile."""

import numpy as np
import pytest
import xarray as xr
from rows import each_case, each_row, must_refuse, refuses
from scipy.integrate import quad

from mitransient_lidar.physics.water.profiles import BACKSCATTERING_FLOOR, COEFFICIENT_FLOOR, Profile, read_profile

# a and b do not change alike, bb/b neither; the first node lies below the surface.
DEPTH = np.array([0.5, 2.0, 3.0, 3.2, 6.0, 11.0, 14.0])
A = np.array([0.10, 0.12, 0.40, 0.15, 0.15, 0.05, 0.05])
B = np.array([0.20, 0.80, 0.60, 0.10, 0.30, 0.02, 0.02])
BB = np.array([0.004, 0.008, 0.012, 0.001, 0.006, 0.001, 0.001])
WATER = {"a": A, "b": B, "c": A + B, "omega": B / (A + B)}


@pytest.fixture
def profile():
    return Profile(DEPTH, A, B, BB)


@pytest.fixture
def noisy():
    """A thousand nodes whose values scatter by less and by more than a tolerance of 1 %."""
    rng = np.random.default_rng(3)
    z = np.linspace(0, 40, 1000)
    b = np.exp(np.where(z < 20, 0.003, 0.02) * rng.standard_normal(z.size) - z / 20)
    return Profile(z, 0.2 * b, b, 0.02 * b)


def write_csv(path, columns, heading="# a station"):
    names, rows = ", ".join(columns), zip(*columns.values(), strict=True)
    path.write_text("\n".join([heading, names, *(", ".join(repr(float(v)) for v in row) for row in rows)]))
    return path


def deviations(profile, tolerance):
    """Return deviations of layers from the profile at many depths over the tolerance, shape (3, depths)."""
    water = profile.layers(tolerance)
    z = np.sort(np.append(np.linspace(0, profile.depth[-1] * 1.2, 40_001), np.nextafter(water.layer_tops[1:], 0)))
    layer = water.layer_at(z)
    pairs = (
        (profile.attenuation, water.attenuation, COEFFICIENT_FLOOR),
        (profile.scattering, water.scattering, COEFFICIENT_FLOOR),
        (profile.backscattering, water.backscattering, BACKSCATTERING_FLOOR),
    )
    truths = [(np.interp(z, profile.depth, nodes), means[layer], floor) for nodes, means, floor in pairs]
    return np.array([np.abs(mean - q) / (tolerance * np.maximum(q, floor)) for q, mean, floor in truths])


@pytest.mark.parametrize("tolerance", [0.2, 0.01, 0.002])
def test_optical_depth_is_exact_at_every_edge(profile, tolerance):
    """Values from the layers' centres instead of means miss the edges in layers that cross a node."""
    water = profile.layers(tolerance)
    coefficients = (
        (profile.attenuation, water.attenuation),
        (profile.scattering, water.scattering),
        (profile.backscattering, water.backscattering),
    )
    layer_tops = np.append(water.layer_tops, 20.0)
    some = np.unique(np.append(np.arange(0, water.count, 1 + water.count // 40), water.count - 1))
    for nodes, means in coefficients:
        for i in some:
            knots = DEPTH[(layer_tops[i] < DEPTH) & (layer_tops[i + 1] > DEPTH)]
            area, _ = quad(
                lambda z, q=nodes: np.interp(z, DEPTH, q), layer_tops[i], layer_tops[i + 1], points=knots, epsrel=1e-12
            )
            assert means[i] * (layer_tops[i + 1] - layer_tops[i]) == pytest.approx(area, rel=1e-9)
    total, _ = quad(lambda z: np.interp(z, DEPTH, A + B), 0, 20, points=DEPTH, epsrel=1e-12, limit=200)
    assert water.cumulative(20.0) == pytest.approx(total, rel=1e-10)


@pytest.mark.parametrize("tolerance", [0.2, 0.01, 0.002])
def test_layers_keep_the_tolerance_and_use_it(profile, noisy, tolerance):
    for water in (profile, noisy):
        worst = deviations(water, tolerance).max()
        assert worst == pytest.approx(1, abs=2e-2)
        assert worst <= 1 + 1e-6


def test_clear_water_needs_the_floors():
    """Towards 0 a relative tolerance alone would never end."""
    profile = Profile([0, 4, 8], [0.05, 0.05, 0], [0.1, 0, 0], [0.002, 0, 0])
    assert profile.layers(0.01).count < 1000
    assert deviations(profile, 0.01).max() <= 1 + 1e-6


@each_row(2, 50, 1000)
@each_row(1, -1)
def test_fewest_layers_of_a_straight_profile(order, nodes):
    """A layer may span a ratio of 1 + 2 tolerance; collinear nodes change nothing. The last layer has no end."""
    z = np.linspace(0, 10, nodes)
    b = np.linspace(0.1, 0.8, nodes)[::order]
    count = Profile(z, b, b, 0.02 * b).layers(0.01).count
    assert count == np.ceil(np.log(8) / np.log(1.02)) + 1


def test_a_steep_profile_has_layers_of_finite_thickness():
    water = Profile([0, 3, 3 + 1e-9, 5], [0.4, 0.4, 0.1, 0.1], [0.5, 0.5, 0.4, 0.4], [0.01] * 4).layers()
    np.testing.assert_allclose(water.layer_tops, [0, 3, 3 + 1e-9], atol=2e-4)
    assert water.cumulative(5.0) == pytest.approx(0.9 * 3 + 0.5 * 2, rel=1e-6)


@each_row("ab", "ac", "bc", "a,omega", "b,omega", "c,omega", "abc", "ab,omega", "bc,omega", "abc,omega")
def test_every_pair_gives_the_same_water(names, tmp_path):
    letters, _, omega = names.partition(",")
    chosen = [*letters, omega] if omega else list(letters)
    given = {"depth": DEPTH, **{name: WATER[name] for name in chosen}, "bb": BB}
    read = read_profile(write_csv(tmp_path / "water.csv", given))
    np.testing.assert_array_equal(read.depth, DEPTH)
    np.testing.assert_allclose(read.absorption, A, rtol=1e-12)
    np.testing.assert_allclose(read.scattering, B, rtol=1e-12)
    np.testing.assert_allclose(read.attenuation, A + B, rtol=1e-12)
    np.testing.assert_array_equal(read.backscattering, BB)


def test_backscattering_by_ratio_and_by_default(tmp_path):
    given = {"depth": DEPTH, "a": A, "b": B}
    path = write_csv(tmp_path / "water.csv", {**given, "bb_ratio": BB / B})
    np.testing.assert_allclose(read_profile(path).backscattering, BB, rtol=1e-12)
    # Petzold's average particle
    np.testing.assert_allclose(read_profile(write_csv(path, given)).backscattering, 0.0183 * B, rtol=1e-12)


def test_csv_and_netcdf_give_the_same_layers(tmp_path, profile):
    columns = {"c": A + B, "b": B, "bb": BB}
    csv = write_csv(tmp_path / "water.csv", {"depth": DEPTH, **columns})
    netcdf = tmp_path / "water.nc"
    variables = {name: ("depth", values) for name, values in columns.items()}
    # Variables over other dimensions than the depth are ignored.
    xr.Dataset({**variables, "station": 7}, {"depth": DEPTH}).to_netcdf(netcdf, engine="h5netcdf")
    expected = profile.layers()
    for path in (csv, str(netcdf)):
        water = read_profile(path).layers()
        for name in ("layer_tops", "attenuation", "scattering", "backscattering"):
            np.testing.assert_allclose(getattr(water, name), getattr(expected, name), rtol=1e-7)


@each_row(
    "z,a,b,bb\n0,0.1,0.2,0.01\n-1.5,0.2,0.4,0.02\n-4,0.1,0.2,0.01\n",
    "Station 7\n\nbb532;depth_m;c(532) 1/m;T;a532\n0,01;4;0,3;12,5;0,1\n0,02;1,5;0,6;12;0,2\n0,01;0;0,3;12;0,1\n",
    "\ufeffDepth [cm]\tb\ta\tbb/b\r\n0\t0.2\t0.1\t0.05\r\n150\t0.4\t0.2\t0.05\r\n400\t0.2\t0.1\t0.05\r\n",
    "# probe 3\ndepth a     b bb\nm  1/m   1/m   1/m\n0 0.1 0.2 0.01\n1.5 0.2 0.4 0.02\n4 0.1 0.2 0.01\n",
    "depth,omega,c,bb\n0,0.666666666666666667,0.3,0.01\n1.5,0.666666666666666667,0.6,0.02\n2,-9999,1,1\n4,0.666666666666666667,.3,.01",
    "depth,a,b,bb\n4,0.1,0.2,0.01\n1.5,0.1,0.3,0.01\n1.5,0.3,0.5,0.03\n0,0.1,0.2,0.01\n1,nan,1,1\n",
)
def test_the_same_profile_in_any_form(text, tmp_path):
    path = tmp_path / "water.txt"
    path.write_bytes(text.encode())
    read = read_profile(path)
    np.testing.assert_allclose(read.depth, [0, 1.5, 4], rtol=1e-15)
    np.testing.assert_allclose(read.absorption, [0.1, 0.2, 0.1], rtol=1e-14)
    np.testing.assert_allclose(read.scattering, [0.2, 0.4, 0.2], rtol=1e-14)
    np.testing.assert_allclose(read.backscattering, [0.01, 0.02, 0.01], rtol=1e-14)


def test_one_of_several_wavelengths_is_read(tmp_path):
    path = tmp_path / "water.csv"
    path.write_text("depth,a488,a531.5,b488,b531.5,bb\n0,1,2,3,4,0.5\n5,1,2,3,4,0.5\n")
    read = read_profile(path, 531.5)
    np.testing.assert_array_equal(read.absorption, [2, 2])
    np.testing.assert_array_equal(read.scattering, [4, 4])
    np.testing.assert_array_equal(read.backscattering, [0.5, 0.5])
    must_refuse(r"has no columns for 532 nm but must: its wavelengths are 488, 531.5", read_profile, path, 532.0)


def test_units_of_netcdf_variables(tmp_path):
    path = tmp_path / "water.nc"
    units = {"depth": "cm", "a": "m-1", "b": "km**-1"}
    values = {"depth": [0.0, 300.0], "a": [0.1, 0.2], "b": [100.0, 200.0]}
    variables = {name: ("depth", values[name], {"units": unit}) for name, unit in units.items()}
    xr.Dataset(variables).to_netcdf(path, engine="h5netcdf")
    read = read_profile(path)
    np.testing.assert_allclose(read.depth, [0, 3], rtol=1e-15)
    np.testing.assert_allclose(read.scattering, read.absorption, rtol=1e-15)
    xr.Dataset({**variables, "a": ("depth", values["a"], {"units": "W"})}).to_netcdf(path, engine="h5netcdf")
    must_refuse(r"water.nc has an unknown unit in column 'a \[W\]'", read_profile, path)


@refuses(
    ("", r"water.csv has no heading with known columns \(found: none\): allowed are depth, z \[m, cm, "),
    ("a,b\n0,0\n0,0", "has the columns a, b: needed are depth or z and two of a, b, c, omega"),
    ("depth,z,a,b\n0,0,0,0", "has the columns depth, z, a, b: needed are depth or z and two"),
    ("depth,c,bb\n0,1,0\n1,1,0", "has the columns depth, c, bb: needed are depth or z and two of a, b, c, omega"),
    ("depth,a,b,bbp\n0,0,0,0\n", r"unknown column 'bbp' \(found: depth, a, b, bbp\): .* a, b, c, bb \[1/m, .*\]"),
    ("depth,a,b,bb,bb_ratio\n0,0,0,0,0\n", "columns bb and bb_ratio, but must have only one"),
    ("depth,a,b\n0,1,1\n", "has 1 depths but a profile must have at least 2"),
    ("depth,a,b\n# x\n0,1,1\n1,1\n", r"water.csv, line 4 has 2 values but must have 3, one for each column$"),
    ("z,a,b\n-1,1,1\n1,1,1\n", "line 2: z = -1 must not be negative, unless all z are heights of at most 0"),
    ("depth,a,b\n-1,1,1\n1,1,1\n", "line 2: depth = -1 must not be negative"),
    ("z,a,b\n0,1,1\n-2,1,1\n-9999,1,1\n", "line 4: 1 depths of 9999 m, far from all others, must not stand for"),
    ("depth_km,a,b\n0,1,1\n13,1,1\n", "line 3: 1 depths of 13000 m, beyond 12000 m, must not stand for missing"),
    ("depth,a,b\n0,1,1\n\n2,1,1\n1,inf,1\n", "line 5: a = inf must be finite"),
    ("depth,a,b\n0,1,1\n2,-0.1,1\n", "line 3: a = -0.1 must not be negative"),
    ("depth,b,c\n0,1,1\n2,0.4,0.3\n", "line 3: b = 0.4 1/m must not exceed c = 0.3 1/m"),
    ("depth,a,c\n0,1,1\n2,0.4,0.3\n", "line 3: a = 0.4 1/m must not exceed c = 0.3 1/m"),
    ("depth,a,b,bb\n0,1,1,0\n2,1,0.4,0.5\n", "line 3: bb = 0.5 1/m must not exceed b = 0.4 1/m"),
    ("depth,a,b,bb_ratio\n0,1,1,0\n2,1,0.4,1.1\n", "line 3: bb_ratio = 1.1 must lie between 0 and 1"),
    ("depth,c,omega\n0,1,1.01\n2,1,1\n", "line 2: omega = 1.01 must lie between 0 and 1"),
    ("depth,a,omega\n0,1,1\n2,1,1\n", "line 2: omega = 1 must be below 1 if b is to follow from a = 1 1/m"),
    ("depth,b,omega\n0,1,0\n2,1,1\n", "line 2: omega = 0 must be greater than 0 if a is to follow from b = 1 1/m"),
    ("depth,a,b,c\n0,1,1,2\n2,1,1,2.1\n", "line 3: c = 2.1 contradicts a = 1 and b = 1, which give 2"),
    ("depth,b,c,omega\n0,1,2,0.5\n2,1,2,0.55\n", "line 3: omega = 0.55 contradicts b = 1 and c = 2, which give"),
)
def test_invalid_csv_files_are_rejected(text, tmp_path):
    path = tmp_path / "water.csv"
    path.write_text(text)
    read_profile(path)


def test_rounded_decimals_do_not_contradict(tmp_path):
    path = tmp_path / "water.csv"
    path.write_text("depth,a,b,c,omega\n0,0.16,0.155,0.31,0.49\n1,0,0,0,0.3")
    read = read_profile(path)
    np.testing.assert_allclose(read.attenuation, [0.315, 0])


@each_case(("down", 1, "z"), ("up", -1, "z"), ("Up", -1, "depth"), ("down", 1, "depth"))
def test_direction_of_netcdf_depths(positive, sign, name, tmp_path):
    """A vertical coordinate upwards from the bottom, of positive numbers, would be taken as depths."""
    path = tmp_path / "water.nc"
    water = {one: (name, [0.2, 0.3]) for one in "ab"}
    xr.Dataset(water, {name: (name, [0.0, 4.0 * sign], {"positive": positive})}).to_netcdf(path, engine="h5netcdf")
    np.testing.assert_array_equal(read_profile(path).depth, [0, 4])
    xr.Dataset(water, {name: (name, [0.0, -4.0 * sign], {"positive": positive})}).to_netcdf(path, engine="h5netcdf")
    must_refuse("depth = -4 must not be negative", read_profile, path)


def test_depths_in_feet_of_us_surveys(tmp_path):
    (tmp_path / "water.csv").write_text("Depth (ftUS);a;b\n0;0,1;0,2\n3937;0,1;NA\n3937;0,3;0,2\n")
    np.testing.assert_allclose(read_profile(tmp_path / "water.csv").depth, [0, 1200], rtol=1e-15)


def test_invalid_netcdf_files_are_rejected(tmp_path):
    path = tmp_path / "water.nc"

    def write(coords=None, **columns):
        xr.Dataset({name: ("depth", v) for name, v in columns.items()}, coords).to_netcdf(path, engine="h5netcdf")
        return path

    depth = {"depth": [0.0, 1.0]}
    with pytest.raises(ValueError, match=r"water.nc, index 1 of depth: a = -0.1 must not be negative"):
        read_profile(write(depth, a=[0.1, -0.1], b=[0.1, 0.1]))
    with pytest.raises(ValueError, match=r"water.nc has an unknown column 'BX'"):
        read_profile(write(depth, a=[0.1, 0.1], b=[0.1, 0.1], BX=[0.1, 0.1]))
    must_refuse(r"columns a, b: needed are depth or z and two", read_profile, write(a=[0.1, 0.1], b=[0.1, 0.1]))
    with pytest.raises(ValueError, match=r"water.nc has a of type .*, but it must hold real numbers"):
        read_profile(write(depth, a=["x", "y"], b=[0.1, 0.1]))
    path.write_bytes(b"no NetCDF")
    must_refuse(r"water.nc is damaged, or is not a NetCDF-4 file", read_profile, path)


@refuses(
    (([0], [1], [1], [0]), r"depth of shape \(1,\) must be a list of one value per depth, of 2 depths or more"),
    (([0, 1], [1, 1, 1], [1, 1], [0, 0]), r"absorption of shape \(3,\) must be a list of one value per depth"),
    (([0, 1], [1, np.nan], [1, 1], [0, 0]), "absorption holds nan"),
    (([0, 1], [1, -1], [1, 1], [0, 0]), r"absorption = -1 must not be negative, in row 1 counted from 0\.$"),
    (([1, 0], [1, 1], [1, 1], [0, 0]), "depth = 0 m follows 1 m but depths must increase, in row 1"),
    (([0, 1], [1, 1], [1, 1], [0, 2]), "bb = 2 1/m must not exceed b = 1 1/m, in row 1"),
)
def test_bad_arrays_are_rejected(arguments):
    Profile(*arguments)
