"""Points of echoes: geometry against closed forms, errors against random errors of all inputs, and refusals."""

import math

import numpy as np
import pytest
import xarray as xr
from rows import must_refuse, refuses
from scipy.spatial.transform import Rotation
from significance import largest_chi2, largest_z
from synthetic_shots import DEPTH, THETA, N, result

from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.analysis.waveforms.echo_table import extract
from mitransient_lidar.core.constants import C0
from mitransient_lidar.flights.positions import PointClass, fit_surface, positions
from mitransient_lidar.flights.refracted_paths import PoseErrors
from mitransient_lidar.flights.sea_surface import SurfaceModel
from mitransient_lidar.physics.lidar.pose import Pose

GROUP = 1.364
INDICES = {"refractive_index": N, "group_index": GROUP}
NO_ERRORS = PoseErrors(0, 0, 0, 0, 0, 0)
ANGLE_X, ANGLE_Y = 3e-3 * np.array([1.0, 1, -1, -1]), 3e-3 * np.array([1.0, -1, 1, -1])


def poses(shots, seed=0, height=200.0, off_nadir=20.0):
    """Poses of pulses in all directions about the vertical, as a mapping."""
    rng = np.random.default_rng(seed)
    heading = Rotation.from_rotvec(rng.uniform(0, 2 * np.pi, (shots, 1)) * [0, 0, 1])
    angle = np.radians(off_nadir) * rng.uniform(0.2, 1.0, shots)
    zero = np.zeros(shots)
    origin = np.column_stack([rng.uniform(-50, 50, (shots, 2)), height + rng.normal(0, 5, shots)])
    axis = heading.apply(np.column_stack([np.sin(angle), zero, -np.cos(angle)]))
    far = heading.apply(np.column_stack([np.cos(angle), zero, np.sin(angle)]))
    left = heading.apply(np.column_stack([zero, zero + 1, zero]))
    return {"origin": origin, "axis": axis, "far": far, "left": left}


def sights(given, angle_x=ANGLE_X, angle_y=ANGLE_Y):
    """Unit directions of the pixels, shape (shots, pixels, 3)."""
    axis, far, left = (given[name][:, None] for name in ("axis", "far", "left"))
    ray = axis + angle_x[:, None] * far + angle_y[:, None] * left
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def echoes(distance, depth, target=None, **errors):
    """Echoes from distances in air and depths of a level sea [m], shape (shots, pixels); NaN for no echo.

    The surface echo arrives later than the surface, for which the other pixels of the shot count, too.
    """
    distance, depth = np.asarray(distance, dtype=float), np.asarray(depth, dtype=float)
    nothing = np.full(depth.shape, np.nan)
    target = nothing if target is None else target
    depths = np.stack([np.where(np.isnan(distance), np.nan, 0.01), nothing, target, depth], axis=-1)
    flags = np.where(np.isnan(depths), int(EchoFlag.NO_ECHO), 0)
    flags[..., 1] = 0
    four = ("shot", "pixel", "echo")
    known = np.where(np.isnan(depths), np.nan, 1.0)
    surface = np.where(np.isnan(distance), np.nan, 1.0)
    return xr.Dataset(
        {
            "depth_m": (four, depths),
            "depth_m_stderr": (four, known * errors.get("noise", 0.0)),
            "depth_m_method_error": (four, known * errors.get("method", 0.0)),
            "time_ns_stderr": (four, known * errors.get("time_ns", 0.0)),
            "amplitude": (four, known * [3.0, 4.0, 5.0, 6.0], {"units": "W"}),
            "flags": (four, flags),
            "surface_time_ns": (four[:2], 2e9 * distance / C0),
            "surface_time_ns_stderr": (four[:2], surface * errors.get("surface_ns", 0.0)),
            "surface_time_ns_method_error": (four[:2], surface * errors.get("place_ns", 0.0)),
        },
        coords={"echo": ["surface", "column", "target", "bottom"]},
        attrs={"surface_heights_m": [0.0, 0.0]},
    )


def located(made, *, origin, axis, far, left, **options):
    """Points of pulses whose poses are given by vectors."""
    return positions(made, Pose(origin, axis, far, left), **options)


def found(points, kind):
    return np.stack([points[name].values[points["kind"].values == kind] for name in "xyz"], axis=-1)


def refracted(ray, normal):
    """Refracted directions by their angles in the plane of incidence, shape (n, 3)."""
    ray, up = np.asarray(ray), np.asarray(normal) / np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.arccos(-(ray * up).sum(axis=1, keepdims=True))
    side = ray + np.cos(angle) * up
    inner = np.arcsin(np.sin(angle) / N)
    return np.sin(inner) * side / np.linalg.norm(side, axis=1, keepdims=True) - np.cos(inner) * up


def test_pixels_lie_on_the_side_that_their_angles_name():
    """With +angle_y to the right, the points would be mirrored about the axis."""
    given = {  # looking north and down: the far side is north, the left one west
        "origin": np.array([[0.0, 0.0, 100.0]]),
        "axis": np.array([[0.0, math.sin(0.3), -math.cos(0.3)]]),
        "far": np.array([[0.0, math.cos(0.3), math.sin(0.3)]]),
        "left": np.array([[-1.0, 0.0, 0.0]]),
    }
    ray = sights(given, np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.01, 0.0]))
    made = echoes(100 / -ray[..., 2], np.full((1, 3), 5.0))
    points = located(made, **given, angle_x=[0.01, 0, 0], angle_y=[0, 0.01, 0], **INDICES)
    for kind in (PointClass.SURFACE, PointClass.BOTTOM):
        far, left, middle = found(points, kind)
        assert far[1] - middle[1] > 0.9
        assert left[0] - middle[0] < -0.9
        # In the water, the line to the left bends about an axis that is turned by a hundredth.
        np.testing.assert_allclose([far[0], left[1]], [middle[0], middle[1]], atol=1e-4)


def plane_case(slope=(0.07, -0.04), shots=12):
    """Poses over a plane sea of points, its echoes and the true bottom points."""
    given = poses(shots, seed=2)
    ray = sights(given).reshape(-1, 3)
    origin = np.repeat(given["origin"], 4, axis=0)
    normal = np.array([-slope[0], -slope[1], 1.0])
    distance = -(origin @ normal) / (ray @ normal)
    length = np.random.default_rng(3).uniform(2, 20, len(ray))
    place = origin + distance[:, None] * ray
    bottom = place + length[:, None] * refracted(ray, np.broadcast_to(normal, ray.shape))
    depth = length * np.sqrt(1 - (1 - ray[:, 2] ** 2) / N**2)
    made = echoes(distance.reshape(shots, 4), depth.reshape(shots, 4))
    rng = np.random.default_rng(4)
    spots = np.repeat(place[:, :2], 6, axis=0) + rng.uniform(-0.5, 0.5, (6 * len(place), 2))
    table = np.column_stack([spots, spots @ slope, np.full(len(spots), 1e-7), np.zeros(len(spots))])
    sea = SurfaceModel(0.0, 0.0, 1.0, 0.1, 1.0, table, 0.0)
    return given, made, bottom, sea, length, ray


def test_points_under_a_plane_sea_are_exact():
    given, made, bottom, sea, length, ray = plane_case()
    angles = {"angle_x": ANGLE_X, "angle_y": ANGLE_Y, "time_s": np.zeros(12)}
    exact = located(made, **given, **angles, **INDICES, surface=sea)
    np.testing.assert_allclose(found(exact, PointClass.BOTTOM), bottom, atol=1e-7)
    # As if level, they lie beside by about slope (1 - cos(theta)/(n cos(theta_w))) s.
    level = located(made, **given, **angles, **INDICES)
    beside = np.linalg.norm(found(level, PointClass.BOTTOM) - bottom, axis=1)
    theta, inner = np.arccos(-ray[:, 2]), np.arcsin(np.sin(np.arccos(-ray[:, 2])) / N)
    np.testing.assert_allclose(
        beside, math.hypot(0.07, 0.04) * (1 - np.cos(theta) / N / np.cos(inner)) * length, rtol=0.2
    )


@pytest.mark.parametrize("planes", [False, True], ids=["level", "planes"])
def test_standard_deviations_are_those_of_random_errors(planes):
    """All inputs err at random; the spread of points that are traced without linearisation is the stated one."""
    draws, rng = 20_000, np.random.default_rng(5)
    given = poses(1, seed=6)
    angle_x, angle_y = np.array([4e-3]), np.array([-6e-3])
    ray, origin = sights(given, angle_x, angle_y)[0, 0], given["origin"][0]
    own_range, length, prior = -origin[2] / ray[2], 12.0, 0.05
    cos_level = math.sqrt(1 - (1 - ray[2] ** 2) / N**2)
    errors, forward = PoseErrors(0.01, 0.02, 0.03, 0.04, 0.05, 0.02), np.array([0.3, 0.9, 0.1])
    noise, by_place, late, method = 0.06, 0.03, 0.045, 0.1  # [m]
    per_ns = 0.5e-9 * C0
    made = echoes(
        *([[own_range]], [[length * cos_level]]),
        **{"surface_ns": noise / per_ns, "place_ns": by_place / per_ns, "time_ns": late / per_ns, "method": method},
    )
    spot = origin + own_range * ray
    sea = SurfaceModel(slope_deviation=prior)
    if planes:
        around = spot[:2] + rng.uniform(-1, 1, (8, 2))
        height = (around - spot[:2]) @ [0.06, 0.03] + 0.2
        table = np.column_stack([around, height, np.full(8, 0.1), np.zeros(8)])
        sea = SurfaceModel(0.0, 0.0, 0.3, prior, 2.0, table, 0.05)
    height, slope, height_error, slope_error = (values[0] for values in sea.at(spot[None, :2], np.zeros(1)))
    options = {"angle_x": angle_x, "angle_y": angle_y, "forward": forward, "time_s": [0.0], "errors": errors}
    points = located(made, **given, **options, **INDICES, surface=sea, view_x=1e-3, view_y=2e-3)

    def normal(*shape):
        return rng.normal(size=(draws, *shape))

    # What part of the method error of the depth is not that of the surface's arrival and of slopes.
    facet = np.array([*-slope, 1.0])
    step = 1e-5
    inside = length + (own_range - (height - spot[2] + own_range * ray @ facet) / (ray @ facet)) / GROUP * planes
    by_slopes = [
        prior
        * inside
        * (np.diff(refracted([ray, ray], [facet - step * one, facet + step * one]), axis=0)[0, 2])
        / step
        / 2
        for one in np.eye(3)[:2]
    ]
    rest = math.sqrt(method**2 - (by_place * cos_level / GROUP) ** 2 - np.sum(np.square(by_slopes)))

    along = np.array([*forward[:2], 0.0]) / np.hypot(*forward[:2])
    turn = np.radians([errors.roll_deg, errors.pitch_deg, errors.heading_deg]) * normal(3)
    sight = Rotation.from_rotvec(turn @ [along, np.cross([0, 0, 1], along), [0, 0, 1]]).apply(ray)
    start = origin + normal(3) * [errors.horizontal_m, errors.horizontal_m, errors.height_m]
    calibration = errors.range_m * normal()
    arrival = own_range + GROUP * length + late * normal() + calibration
    if planes:
        # The mean plane; slopes that err turn the ray only, which is all to first order.
        level = start - np.column_stack([np.tile(spot[:2], (draws, 1)), height + height_error * normal()])
        air = -(level @ facet) / (sight @ facet)
    else:
        air = own_range + noise * normal() + by_place * normal() + calibration
    water = (arrival - air) / GROUP + rest / cos_level * normal()
    # Light from elsewhere in the pixel, at the same height.
    seen = sight + 1e-3 * normal(1) * given["far"] + 2e-3 * normal(1) * given["left"]
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    top = start + (air * sight[:, 2] / seen[:, 2])[:, None] * seen
    tilted = np.column_stack([-(slope + slope_error * normal(2)), np.ones(draws)])
    samples = {PointClass.BOTTOM: top + water[:, None] * refracted(seen, tilted)}
    if not planes:
        samples[PointClass.SURFACE] = top
    for kind, sample in samples.items():
        stated = points.isel(point=points["kind"].values == kind)
        for name, column in zip(("x_uncertainty", "y_uncertainty", "vertical_uncertainty"), sample.T, strict=True):
            ratio = column.var(ddof=1) / stated[name].item() ** 2
            # The variance of normal numbers has a relative standard error of sqrt(2/(n - 1)).
            assert abs(ratio - 1) < largest_z(draws) * math.sqrt(2 / (draws - 1)), (kind, name, ratio)
        assert stated["horizontal_uncertainty"].item() == pytest.approx(
            math.hypot(stated["x_uncertainty"].item(), stated["y_uncertainty"].item())
        )


def mixed():
    """A shot of four pixels: surface, object and bottom; the bottom alone; the surface alone; and nothing."""
    distance = np.array([[210.0, 210.0, 210.0, np.nan]])
    made = echoes(distance, np.array([[8.0, 8.0, np.nan, np.nan]]), np.array([[5.0, np.nan, np.nan, np.nan]]))
    made["flags"][0, 1, 0] = int(EchoFlag.NO_ECHO)
    return made


def test_waveforms_without_an_echo_keep_a_point_where_they_look():
    given = poses(1)
    sea = SurfaceModel(level=0.4, height_deviation=0.2)
    points = located(mixed(), **given, angle_x=ANGLE_X, angle_y=ANGLE_Y, **INDICES, surface=sea, errors=NO_ERRORS)
    for name, expected in {
        "kind": [41, 43, 40, 40, 41, 45],
        "pixel": [0, 0, 0, 1, 2, 3],
        "return_number": [1, 2, 3, 1, 1, 1],
        "number_of_returns": [3, 3, 3, 1, 1, 1],
        "intensity": [3, 5, 6, 6, 3, np.nan],
        "depth": [0, 5, 8, 8, 0, np.nan],
    }.items():
        np.testing.assert_array_equal(points[name].values, expected, err_msg=name)
    ray = sights(given)[0, 3]
    silent = found(points, PointClass.NO_ECHO)[0]
    np.testing.assert_allclose(silent, given["origin"][0] + (0.4 - given["origin"][0, 2]) / ray[2] * ray, atol=1e-9)
    # Known but for the waves: a height that is off by its deviation moves the point along the line of sight.
    for name, error in (("vertical", 0.2), ("horizontal", 0.2 * math.hypot(ray[0], ray[1]) / -ray[2])):
        assert float(points[f"{name}_uncertainty"][-1]) == pytest.approx(error, rel=1e-12)


def test_one_echo_of_many_pixels_in_rows_and_columns_is_where_it_is_as_one_of_pixels():
    given, values = poses(3), np.full((3, 4), 6.0)
    made = echoes(given["origin"][:, 2:] / -sights(given)[..., 2], values)
    expected = located(made, **given, angle_x=ANGLE_X, angle_y=ANGLE_Y, **INDICES)
    grid = made.assign_coords(row=("pixel", [0, 0, 1, 1]), column=("pixel", [0, 1, 0, 1]))
    grid = grid.set_index(pixel=("row", "column")).unstack("pixel")
    image = located(grid, **given, angle_x=ANGLE_X.reshape(2, 2), angle_y=ANGLE_Y.reshape(2, 2), **INDICES)
    xr.testing.assert_identical(image, expected)


def test_points_of_measured_waveforms_are_the_true_ones_within_their_errors():
    made = extract(result().assign_attrs(surface_slope_variance=0.0))
    given = {
        "origin": np.array([[-200 * math.tan(THETA), 0.0, 200.0]]),
        "axis": np.array([[math.sin(THETA), 0.0, -math.cos(THETA)]]),
        "far": np.array([[math.cos(THETA), 0.0, math.sin(THETA)]]),
        "left": np.array([[0.0, 1.0, 0.0]]),
    }
    angles = {name: 1e-3 * made[name].values for name in ("angle_x", "angle_y")}
    points = located(made.expand_dims("shot"), **given, **angles, refractive_index=N, group_index=N)
    for kind, height in ((PointClass.SURFACE, 0.0), (PointClass.BOTTOM, -DEPTH)):
        own = points.isel(point=points["kind"].values == kind)
        assert own.sizes["point"] == 4
        error = np.abs(own["z"].values - height)
        assert np.all(error < 4 * own["vertical_uncertainty"].values), error
        assert np.all(own["vertical_uncertainty"].values < 0.2)


def test_the_level_of_the_sea_is_known_within_its_error():
    errors, levels = np.random.default_rng(7).uniform(0.02, 0.2, 400), []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        z = 0.35 + 0.1 * rng.normal(size=400) + errors * rng.normal(size=400)
        spots = np.column_stack([rng.uniform(0, 100, (400, 2)), z])
        levels.append(SurfaceModel.fit(spots, errors, np.zeros(400), slope_deviation=0.05, radius=0))
    z_values = np.array([(one.level - 0.35) / one.level_error for one in levels])
    assert abs(z_values.mean()) < largest_z(10**6) / math.sqrt(60)
    assert (z_values**2).sum() < largest_chi2(60)
    # One standard deviation of its error above.
    assert 0.1 < np.mean([one.height_deviation for one in levels]) < 0.112


def test_few_surface_echoes_do_not_flatten_the_sea():
    """Of 60 pulses over waves of 0.1 m two have a surface echo, 4 cm apart, and the others an onset, to 5 cm.

    Bottoms 1 m below were behind a level plane with an error of 2 cm, and thus 0.23 of the wave's height too low.
    """
    count, noise = 60, 0.05
    rng, given = np.random.default_rng(4), poses(60)
    down, zero = -sights(given, np.zeros(1), np.zeros(1))[..., 2], np.zeros(1)
    waves = np.append([0.0, 0.04], 0.1 * rng.normal(size=count - 2))[:, None]
    late = noise * rng.normal(size=(count, 1))
    cosine = np.sqrt(1 - (1 - down**2) / N**2)
    # A late surface echo takes from the path in the water.
    distance = (given["origin"][:, 2:] - waves) / down + late
    made = echoes(distance, 1 + waves - late * cosine / GROUP, surface_ns=noise / (0.5e-9 * C0))
    options = {**given, "angle_x": zero, "angle_y": zero, **INDICES, "errors": NO_ERRORS, "time_s": np.arange(60.0)}
    points = located(made, **options)
    few = points.isel(point=(points["kind"].values == PointClass.SURFACE) & (points["shot"].values < 2))
    few["z"].values[:] = [0.0, 0.04]
    sea = fit_surface(few.assign(vertical_uncertainty=0 * few["z"] + 0.01), 1e-3)
    points = located(made, **options, surface=sea)
    bottom = points.isel(point=(points["kind"].values == PointClass.BOTTOM) & (points["shot"].values > 1))
    error = bottom["z"].values + 1
    assert np.sqrt(np.mean((error / bottom["vertical_uncertainty"].values) ** 2)) < 1.3
    assert np.sqrt(np.mean(error**2)) < 0.018


def linear_waves(seed, spacing, error):
    """Surface points over random waves of 3 to 40 m: points, true height and slopes at them."""
    rng = np.random.default_rng(seed)
    count = 60
    k = 2 * np.pi / np.exp(rng.uniform(np.log(3), np.log(40), count))
    bearing = rng.normal(0, 0.6, count)
    size = 0.1 / k / np.sqrt(count)  # all waves are equally steep
    wave = np.stack([k * np.cos(bearing), k * np.sin(bearing)])
    spots = rng.uniform(0, 40, (int((40 / spacing) ** 2), 2))
    phase = spots @ wave + rng.uniform(0, 2 * np.pi, count)
    height, slope = np.cos(phase) @ size, -(np.sin(phase) * size) @ wave.T
    z = height + error * rng.normal(size=len(spots))
    return np.column_stack([spots, z]), height, slope


@pytest.mark.parametrize(("spacing", "error", "largest"), [(0.5, 0.03, 0.5), (1.0, 0.08, 0.85)])
def test_planes_follow_long_waves_and_state_their_errors(spacing, error, largest):
    spots, height, slope = linear_waves(8, spacing, error)
    deviation = slope.std()
    sea = SurfaceModel.fit(spots, np.full(len(spots), error), np.zeros(len(spots)), slope_deviation=deviation)
    middle = np.all((spots[:, :2] > 3) & (spots[:, :2] < 37), axis=1)
    facets = sea.at(spots[middle, :2], np.zeros(middle.sum()))
    wrong = facets.slope - slope[middle]
    assert wrong.std() < largest * deviation, wrong.std() / deviation
    assert 0.6 < wrong.std() / np.sqrt(np.mean(facets.slope_error**2)) < 1.5
    off = facets.height - height[middle]
    assert 0.6 < off.std() / np.sqrt(np.mean(facets.height_error**2)) < 1.5
    assert off.std() < error


def test_planes_bring_bottom_points_nearer_and_state_how_near():
    """Lines of sight straight down, through the true slopes of linear waves, to 10 m below the surface."""
    spots, height, slope = linear_waves(11, 0.7, 0.0)
    count, noise, length = len(spots), 0.03, 10.0
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    given = {"origin": spots * [1, 1, 0] + [0, 0, 300.0], "axis": down, "far": [[1.0, 0, 0]] * count}
    given["left"] = np.cross(given["far"], down)
    normal = np.column_stack([-slope, np.ones(count)])
    truth = np.column_stack([spots[:, :2], height]) + length * refracted(down + 1e-12 * normal, normal)
    late = noise * np.random.default_rng(12).normal(size=count)
    # A late surface echo takes from the path in the water.
    made = echoes((300 - height + late)[:, None], (length - late / GROUP)[:, None], surface_ns=noise / (0.5e-9 * C0))
    options = {**given, "angle_x": 0.0, "angle_y": 0.0, **INDICES, "errors": NO_ERRORS, "time_s": np.zeros(count)}
    first = SurfaceModel(slope_deviation=slope.std())
    sea = fit_surface(located(made, **options, surface=first), slope.std())
    inner = np.all((spots[:, :2] > 3) & (spots[:, :2] < 37), axis=1)
    wrong = []
    for surface in (first, sea):
        points = located(made, **options, surface=surface)
        own = points.isel(point=points["kind"].values == PointClass.BOTTOM).isel(point=inner)
        beside = np.stack([own["x"].values, own["y"].values], axis=-1) - truth[inner, :2]
        wrong.append(np.sqrt((beside**2).sum(axis=1).mean()))
        assert 0.6 < wrong[-1] / np.sqrt(np.mean(own["horizontal_uncertainty"].values ** 2)) < 1.5
    assert wrong[1] < 0.6 * wrong[0], wrong


def test_the_sea_is_fitted_to_surface_points():
    given, waves = poses(200), 0.1 * np.random.default_rng(9).normal(size=(200, 1))
    ray = sights(given)
    made = echoes((given["origin"][:, 2:] - 0.5 - waves) / -ray[..., 2], np.full((200, 4), 9.0))
    points = located(made, **given, angle_x=ANGLE_X, angle_y=ANGLE_Y, **INDICES, time_s=0.01 * np.arange(200))
    sea = fit_surface(points, 0.05)
    assert sea.points is not None
    assert len(sea.points) == 800
    assert abs(sea.level - 0.5 - waves.mean()) < largest_z(10**6) * sea.level_error
    must_refuse("planes need the times of the pulses, gps_time", fit_surface, points.drop_vars("gps_time"), 0.05)
    must_refuse("no surface echo", fit_surface, points.isel(point=points["kind"].values == PointClass.BOTTOM), 0.05)


@refuses(
    ({"origin": np.zeros((2, 3))}, r"origin of shape \(2, 3\) must have the shape \(1, 3\)"),
    ({"far": [[0.0, 1.0, 1.0]]}, "axis, far and left of pulse 0 must be orthonormal"),
    ({"origin": [[0.0, np.nan, 1.0]]}, "origin holds nan"),
    ({"axis": [[1.0, 0, 0]], "far": [[0.0, 0, 1]], "left": [[0.0, 1, 0]]}, "must descend to the sea"),
    ({"angle_x": [0.0, 1.0]}, r"angle_x of shape \(2,\) must broadcast to \(1, 4\)"),
    ({"refractive_index": 0.9}, "refractive_index = 0.9 must lie between 1 and 2"),
    ({"group_index": 4.0}, "group_index = 4 must lie between 1 and 3"),
    ({"view_x": -1e-3}, "view_x and view_y must not be negative, but one is -0.001"),
    ({"time_s": [0.0, 1.0]}, "must have one time for each of 1 pulses"),
    ({"errors": PoseErrors(roll_deg=0.1)}, "the forward axis of the platform must be given"),
    ({"forward": [0.0, 0.0, 1.0]}, "forward of pulse 0 must not be vertical"),
    ({"surface": SurfaceModel(points=np.zeros((1, 5)), radius=1.0)}, "give time_s"),
)
def test_wrong_input_is_refused(changes):
    options = {**poses(1), "angle_x": ANGLE_X, "angle_y": ANGLE_Y, **INDICES}
    located(mixed(), **{**options, **changes})
