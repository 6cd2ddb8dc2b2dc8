"""The merging integrator against closed forms and against the unidirectional reference."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin, echo_energies
from scipy.stats import norm
from significance import FALSE_ALARM, largest_error, largest_z

from mitransient_lidar.analysis.comparison import pooled_relative_variance
from mitransient_lidar.physics.lidar.lidar_equation import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters, henyey_greenstein
from mitransient_lidar.rendering.session import choose_integrator, open_scene
from mitransient_lidar.transport.merging.cells import Region, SurfaceHeights, WaterCells, WaterGrid
from mitransient_lidar.transport.merging.patches import SolidPatches, solids_of_several_levels
from mitransient_lidar.transport.merging.rings import BeamRings
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene import LidarScene
from mitransient_lidar.transport.sensor.receiver import SensorSampler

MERGING = {"type": "lidar_merging"}
#: Standard deviations of a wide and a narrow beam [rad].
SIGMA, NARROW = 5e-3, 1e-4
LIDAR = LidarSystem(200.0, np.radians(20.0), 5e-3 * 0.81 * 0.9, 0.025, 1.34, 1.34)
CLEAR = {"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0}
#: Waves in the water that scatters most of the published scenes' light more than once.
WAVES = {"spectrum": "elfouhaily", "wind_speed": 3.0, "slope_variance": "cox_munk"}


def quadrant(row, column, half=15e-3):
    """Return the predicate of one pixel of the 2x2 receiver with a circular field of view."""
    return lambda angle_x, angle_y: (
        (angle_x**2 + angle_y**2 <= half**2) & ((angle_x > 0) == (row == 0)) & ((angle_y > 0) == (column == 1))
    )


FIELDS = [quadrant(0, 0), quadrant(0, 1), quadrant(1, 0), quadrant(1, 1)]


def mean_and_error(samples):
    """Return the mean over the passes (first axis) and its standard error."""
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def assert_same(first, second, *, floor=0.0, largest=0.1):
    """Compare per bin two sets of passes by z-test with Sidak's correction; `floor` is a relative bias to allow.

    The bias is blur, so it may also come from a neighbouring bin: at the steep beginning of the surface echo it does.
    Bins with a relative error above `largest` are left out: few large contributions make them, which are not normal.
    """
    (a, da), (b, db) = mean_and_error(first), mean_and_error(second)
    used = (da > 0) & (da < largest * a) & (db > 0) & (db < largest * b)
    if a.ndim == 2:
        # Over few passes a bin's own error is small where its large contributions are missing.
        da, db = (a * np.sqrt(pooled_relative_variance(mean, error**2)) for mean, error in ((a, da), (b, db)))
    padded = np.pad(b, [(0, 0)] * (b.ndim - 1) + [(1, 1)])
    around = np.maximum(np.maximum(padded[..., :-2], padded[..., 2:]), b)
    z = (np.abs(a - b) - floor * around)[used] / np.hypot(da, db)[used]
    # Standard errors from few passes are uncertain themselves: Student's t, taken as normal with its variance.
    freedom = min(len(first), len(second)) - 1
    z *= np.sqrt((freedom - 2) / freedom)
    assert used.any()
    worst = norm.isf(0.5 * FALSE_ALARM / used.sum())
    assert z.max() < worst, (z.max(), worst, np.argwhere(used)[z.argmax()])


# Closed forms: single scattering and bottom, where the light has no other way.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "water"),
    [
        (SIGMA, CLEAR),
        (SIGMA, {"layer_tops": "0, 2", "attenuation": "0.3, 0.05", "scattering": "0", "backscattering": "0"}),
        (NARROW, CLEAR),
    ],
)
def test_bottom_level(lidar_scene, passes, z_score, sigma, water):
    tx, film = {"divergence_mrad": 2e3 * sigma}, {"time_start_ns": 1450.0}
    count = 24 if sigma == SIGMA else 48
    energy = passes(lidar_scene(integrator=MERGING, tx=tx, water=water, film=film), count).sum(-1)
    column = WaterColumn.from_text(water.get("layer_tops", 0), water["attenuation"], 0, 0)
    expected = np.array([echo_energies(LIDAR, sigma, column, 0.0, 8.0, 0.1, (1e-4, 1e-4), f).bottom for f in FIELDS])
    z, relative = z_score(np.column_stack([energy, energy.sum(1)]), np.append(expected, expected.sum()))
    assert np.all(relative < 0.01)
    assert np.all(np.abs(z) < largest_z(count, z.size)), z


@pytest.mark.slow
def test_bottom_in_bins(lidar_scene, passes):
    edges = 1484.0 + 2.0 * np.arange(10)
    film = {"time_start_ns": edges[0], "bin_width_ns": 2.0, "bin_count": 9}
    scene = lidar_scene(integrator=MERGING, film=film, sea={"slope_variance": "2e-5"}, water=CLEAR)
    mean, error = mean_and_error(passes(scene, 24))
    column = WaterColumn.from_text(0, 0.1, 0, 0)
    expected = np.array([bottom_energy_per_bin(edges, LIDAR, SIGMA, column, 8.0, 0.1, f) for f in FIELDS])
    strong = expected > 0.02 * expected.max()
    assert np.all(
        np.abs(mean - expected)[strong] < (largest_z(24, strong.sum()) * error + 0.002 * expected.max())[strong]
    )
    assert np.all(error[strong] < 0.05 * mean[strong])


@pytest.mark.slow
@pytest.mark.parametrize(("phase", "sigma"), [("fournier_forand", SIGMA), ("fournier_forand", NARROW), ("hg", SIGMA)])
def test_single_scattering_column(lidar_scene, passes, phase, sigma):
    """So little scattering that nothing scatters twice; attenuation 0.3 /m is absorption."""
    backward = {"fournier_forand": fournier_forand(np.pi, *fournier_forand_parameters(0.04))}
    backward["hg"] = henyey_greenstein(np.pi, 0.924)
    check_column(lidar_scene, passes, {"phase_function": phase}, 0.3, 1.5e-5, 6e-7, float(backward[phase]), sigma)


@pytest.mark.slow
def test_single_scattering_column_in_layers(lidar_scene, passes):
    backward = [float(fournier_forand(np.pi, *fournier_forand_parameters(ratio))) for ratio in (0.02, 0.04)]
    values = "0.5, 0.3", "2e-5, 2e-5", "4e-7, 8e-7"
    check_column(lidar_scene, passes, {"layer_tops": "0, 3"}, *values, backward)


def check_column(lidar_scene, passes, water, attenuation, scattering, backscattering, backward, sigma=SIGMA):
    edges = 1430.0 + 5.0 * np.arange(13)
    coefficients = {"attenuation": attenuation, "scattering": scattering, "backscattering": backscattering}
    film = {"time_start_ns": edges[0], "bin_width_ns": 5.0, "bin_count": 12}
    tx = {"divergence_mrad": 2e3 * sigma}
    scene = lidar_scene(integrator=MERGING, tx=tx, film=film, water={**water, **coefficients}, bottom=None)
    energy = passes(scene, 24)
    energy = np.concatenate([energy, energy.sum(axis=2, keepdims=True)], axis=2)
    mean, error = mean_and_error(energy)
    column = WaterColumn.from_text(water.get("layer_tops", 0), attenuation, scattering, backscattering)
    expected = np.array([column_energy_per_bin(edges, LIDAR, sigma, column, backward, 30.0, f) for f in FIELDS])
    expected = np.concatenate([expected, expected.sum(axis=1, keepdims=True)], axis=1)
    assert np.all(error < 0.02 * mean)
    # The grid of the closed form adds 5e-4, the blur over cells 1e-3.
    assert np.all(np.abs(mean / expected - 1) < largest_z(24, mean.size) * error / mean + 1.5e-3), mean / expected


@pytest.mark.slow
def test_phase_function_counts_the_angle_between_the_directions(lidar_scene, passes):
    """Receiver 150 m from the laser: light turns by 145 instead of 180 degrees, where HG 0.9 differs by 9 %."""
    water = {"attenuation": 0.3, "scattering": 1e-5, "backscattering": 1e-6, "phase_function": "hg", "phase_g": 0.9}
    scenes = [
        lidar_scene(
            integrator={"type": integrator, "paths_per_pass": 2**17},
            tx={"off_nadir_deg": 0.0},
            rx={"to_world": mi.ScalarTransform4f().look_at([150.0, 0, 200], [0, 0, 0], [0, 0, 1])},
            film={"time_start_ns": 1500.0, "bin_count": 30, "bin_width_ns": 5.0},
            water={**water, "scattering": scattering, "backscattering": 0.1 * scattering},
            bottom=None,
        )
        for integrator, scattering in (("lidar_merging", 1e-3), ("lidar_volpath", 1e-3))
    ]
    merged, reference = (passes(scene, count) for scene, count in zip(scenes, (16, 24), strict=True))
    assert_same(merged.sum(-1), reference.sum(-1), floor=1e-3)
    assert np.all(mean_and_error(reference.sum((1, 2)))[1] < 0.03 * reference.sum((1, 2)).mean())


# The other integrator: multiple scattering, waves, targets, layers.


def plate(x, y, z, half, tilt=0.0, **bsdf):
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], tilt).scale(half)
    diffuse = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.3}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or diffuse}


SPHERE = {"type": "sphere", "center": [0.3, 0.2, -5.0], "radius": 0.5, "bsdf": {"type": "diffuse"}}
LAYERS = {"layer_tops": "0, 3", "attenuation": "0.9, 0.5", "scattering": "0.7, 0.35", "backscattering": "0.014, 0.007"}
BUBBLES = {"plume_scattering": 1.5, "plume_width": 3.0, "plume_depth": 2.0, "plume_bearing_deg": 60.0, "plume_x": 1.0}
CASES = {
    "waves": {"sea": WAVES},
    "bubbles": {"sea": WAVES, "water": BUBBLES},
    "layers": {"sea": WAVES, "water": LAYERS},
    "plate": {"extra": {"target": plate(0.4, 0.3, -5.0, 0.6)}},
    "tilted plate": {"extra": {"target": plate(0.4, 0.3, -5.0, 0.8, tilt=35.0)}},
    "sphere": {"extra": {"target": SPHERE}},
    "tilted bottom": {"bottom": None, "extra": {"target": plate(0.0, 0.0, -8.0, 200.0, tilt=12.0)}},
    "partly transparent": {
        "extra": {"target": plate(*(0.0, 0.0, -4.0, 1.0), type="mask", opacity=0.4, nested={"type": "diffuse"})}
    },
    "mirror": {"extra": {"target": plate(0.0, 0.0, -5.0, 1.0, type="conductor")}},
    "plate in the air": {"extra": {"target": plate(0.5, 0.5, 1.0, 0.7)}},
    "through the surface": {"extra": {"target": plate(0.5, 0.5, 0.0, 0.7, tilt=80.0)}},
    "receiver aside": {
        "rx": {"to_world": mi.ScalarTransform4f().look_at([-40.0, 30.0, 200], [0, 0, 0], [0, 0, 1])},
        "film": {"time_start_ns": 1370.0},
    },
    "50 m aside over waves": {
        "rx": {"to_world": mi.ScalarTransform4f().look_at([-40.0, 50.0, 190.0], [0, 0, 0], [0, 0, 1])},
        **{"sea": WAVES, "film": {"time_start_ns": 1370.0}},
    },
    "1 m aside over waves": {
        "tx": {"altitude": 20.0, "off_nadir_deg": 15.0},
        "rx": {"altitude": 20.0, "off_nadir_deg": 15.0, "aim_y": 1.0, "field_of_view_mrad": 120.0},
        **{"sea": WAVES, "film": {"time_start_ns": 120.0, "bin_width_ns": 4.0, "bin_count": 40}},
    },
    "receiver straight down over waves": {
        "rx": {"altitude": 180.0, "off_nadir_deg": 0.0, "field_of_view_mrad": 40.0},
        **{"sea": WAVES, "film": {"time_start_ns": 1290.0}},
    },
    "axis 8 mrad aside over waves": {"rx": {"off_nadir_deg": 20.5, "aim_x": 1.86}, "sea": WAVES},
    "from orbit over waves": {
        "tx": {"altitude": 5e5, "off_nadir_deg": 20.0, "divergence_mrad": 0.004, "pulse_energy_mj": 1e3},
        "rx": {"altitude": 5e5, "off_nadir_deg": 20.0, "field_of_view_mrad": 0.012, "aperture_area": 10.0},
        **{"sea": WAVES, "film": {"time_start_ns": 3549700.0, "bin_width_ns": 4.0}},
    },
    "narrow beam over waves": {
        **{"tx": {"divergence_mrad": 0.5}, "rx": {"field_of_view_mrad": 20.0}, "sea": WAVES, "bottom": 4.0},
    },
    "narrow beam in turbid water": {
        **{"tx": {"divergence_mrad": 0.5}, "rx": {"field_of_view_mrad": 20.0}, "bottom": 2.0},
        "water": {"attenuation": 1.0, "scattering": 0.8, "backscattering": 0.016},
    },
    "mast at 60 degrees": {
        "tx": {"altitude": 20.0, "off_nadir_deg": 60.0, "divergence_mrad": 2.0},
        "rx": {"altitude": 20.0, "off_nadir_deg": 60.0, "field_of_view_mrad": 20.0},
        **{"sea": WAVES, "film": {"time_start_ns": 250.0}, "bottom": 3.0},
    },
    "turbid": {"water": {"attenuation": 1.0, "scattering": 0.8, "backscattering": 0.016}, "bottom": 4.0},
}
#: Relative standard error of the reference's energy, from three sets of 16 passes.
TOTAL_ERROR = {
    "waves": 0.0032,
    "bubbles": 0.0075,
    "layers": 0.0087,
    "plate": 0.0043,
    "tilted plate": 0.0033,
    "sphere": 0.0042,
    "tilted bottom": 0.0040,
    "partly transparent": 0.0116,
    "mirror": 0.0389,
    "plate in the air": 0.00043,
    "through the surface": 0.0025,
    "receiver aside": 0.0025,
    "50 m aside over waves": 0.0026,
    "1 m aside over waves": 0.015,
    "receiver straight down over waves": 0.0006,
    "axis 8 mrad aside over waves": 0.0027,
    "from orbit over waves": 0.0040,
    "narrow beam over waves": 0.0089,
    "narrow beam in turbid water": 0.02,
    "mast at 60 degrees": 0.01,
    "turbid": 0.0089,
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_both_integrators_agree(lidar_scene, passes, case):
    """Bins of 2 ns of the four pixels, a few hundred in all; the blur of cells under waves is allowed 0.5 %."""
    film = {"time_start_ns": 1400.0, "bin_width_ns": 2.0, "bin_count": 70, **CASES[case].get("film", {})}
    scenes = [
        lidar_scene(integrator=integrator, **{"sea": {"slope_variance": "0.01"}, **CASES[case], "film": film})
        for integrator in (MERGING, {"paths_per_pass": 2**16})
    ]
    merged, reference = passes(scenes[0], 10), passes(scenes[1], 16, first_seed=1000)
    assert_same(merged, reference, floor=0.005)
    gates = merged.sum(axis=2), reference.sum(axis=2)
    assert_same(*gates, floor=0.005)
    total = reference.sum(axis=(1, 2))
    assert mean_and_error(total)[1] < largest_error(16, TOTAL_ERROR[case]) * total.mean()


@pytest.mark.slow
def test_bias_under_waves_falls_with_the_cells(lidar_scene, passes):
    """Waves focus beam and view alike, and wide cells blur both: a deficit that small cells do not have."""
    film = {"time_start_ns": 1420.0, "bin_width_ns": 30.0, "bin_count": 1}
    sea = {**WAVES, "shortest_wave": 0.5, "cell_size": 0.1}
    reference = passes(lidar_scene(integrator={"paths_per_pass": 2**20}, sea=sea, film=film, bottom=None), 12)
    level, error = mean_and_error(reference.sum(axis=(1, 2)))
    bias = []
    for width in (0.1, 0.0125):
        merged = passes(lidar_scene(integrator={**MERGING, "cell_size": width}, sea=sea, film=film, bottom=None), 10)
        mean, merged_error = mean_and_error(merged.sum(axis=(1, 2)))
        bias.append(mean / level - 1)
        assert np.hypot(error, merged_error) < 0.0025 * level
    assert bias[0] < -0.012
    assert abs(bias[1]) < 0.006


@pytest.mark.slow
def test_only_what_is_not_merged_is_left_to_the_reference(lidar_scene, passes):
    """Over a level sea without mirrors nothing is left; a mirror under water leaves what it shows."""
    complement_only = {"complement_only": True, "paths_per_pass": 2**16}
    assert passes(lidar_scene(integrator=complement_only), 2).sum() == 0
    mirror = lidar_scene(integrator=complement_only, extra=CASES["mirror"]["extra"])
    assert passes(mirror, 2).sum() > 0


# Statistics.


@pytest.mark.slow
def test_same_seed_same_bits_and_pixels_sum_to_the_whole(lidar_scene, passes):
    four = passes(lidar_scene(integrator=MERGING, sea=WAVES), 2, 5)
    again = passes(lidar_scene(integrator=MERGING, sea=WAVES), 2, 5)
    np.testing.assert_array_equal(four, again)
    single = passes(lidar_scene(integrator=MERGING, sea=WAVES, rx={"layout": "1x1"}), 2, 5)
    np.testing.assert_allclose(four.sum(axis=1), single[:, 0], rtol=1e-12, atol=1e-30)
    assert not np.array_equal(four[0], four[1])


# Parts.


@pytest.fixture
def wavy_sea(lidar_scene):
    scene = lidar_scene(integrator=MERGING, sea=WAVES)
    lidar = LidarScene.from_scene(scene, scene.sensors()[0])
    region = Region.of_scene(lidar, SensorSampler(lidar.receiver, lidar.transmitter))
    return lidar, region


def test_region_holds_beam_and_view_and_no_more_than_half_as_much_again(wavy_sea):
    """Field of view of 30 mrad at 212.8 m: 6.4 m across, and 1 / cos(20 deg) of that along x."""
    _, region = wavy_sea
    for size, seen in zip(region.size, (6.39 / np.cos(np.radians(20)), 6.39), strict=True):
        assert seen < size < 1.6 * seen


def test_track_length_is_the_slanted_way_to_the_bottom(wavy_sea):
    lidar, region = wavy_sea
    slanted = 8.0 / np.cos(np.arcsin(np.sin(np.radians(20)) / 1.34))
    assert region.track_length(lidar) == pytest.approx(slanted, rel=0.05)


def test_heights_are_those_of_the_mesh(wavy_sea):
    lidar, region = wavy_sea
    heights = SurfaceHeights(lidar, region)
    rng = np.random.default_rng(2)
    x, y = (rng.uniform(region.low[axis], region.high[axis], 4096) for axis in (0, 1))
    down = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), 5), mi.Vector3f(0, 0, -1))
    true = np.array(lidar.mitsuba_scene.ray_intersect(down).p.z)
    assert true.std() > 0.03
    assert np.abs(np.array(heights.at(mi.Float(x), mi.Float(y))) - true).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("shift", [[0.0, 0.0, 0.0], [0.3, 0.9, 0.99]])
def test_points_fall_into_cells_by_their_volume(wavy_sea, shift):
    """Uniform in a column of water below the waves: as many in each cell as its volume says, the topmost included."""
    lidar, region = wavy_sea
    heights = SurfaceHeights(lidar, region)
    rings = BeamRings(lidar.transmitter.pose, 0.5, 1.34)
    cells = WaterCells(WaterGrid(rings, heights, 0.4, 0.2, 0.25, 4.0), mi.Point3f(shift))
    rng, count, depth = np.random.default_rng(7), 2**21, 1.5
    lean = lidar.transmitter.pose.axis[0] / 1.34
    lean /= np.sqrt(1 - lean**2)
    below, y = rng.uniform(0, depth, count), rng.uniform(-2.0, 2.0, count)
    x = rng.uniform(-2.0, 2.0, count)
    z = np.array(heights.at(mi.Float(x), mi.Float(y))) - below
    bucket, tag, volume = (np.array(a) for a in cells.locate(mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(z))))
    _, index, inverse, number = np.unique(
        bucket.astype(np.uint64) << 32 | tag, return_index=True, return_inverse=True, return_counts=True
    )
    # Cells that the sampled column does not cut: points of the cell stay clear of its faces.
    u = x - lean * below
    inner = np.ones(len(number), dtype=bool)
    for value, low, high in ((u, -1.4, 1.4), (y, -1.4, 1.4), (below, -1.0, depth - 0.3)):
        inside = (value > low) & (value < high)
        inner &= np.bincount(inverse, ~inside, len(number)) == 0
    expected = count * volume[index] / (depth * 16.0)
    z = (number - expected)[inner] / np.sqrt(expected[inner])
    assert inner.sum() > 50
    assert np.abs(z).max() < largest_z(10**6, z.size)
    # The table of heights is made of small steps, with which uniform points are not quite uniform below it.
    assert 0.8 < z.std() < 1.3


def test_inverse_share_counts_edges_in_full(lidar_scene):
    """Points uniform on a plate: the mean of inverse share / patch area, times its area, is its number of patches."""
    half = 0.31
    scene = lidar_scene(integrator=MERGING, extra={"target": plate(0.1, 0.05, -4.0, half)})
    lidar = LidarScene.from_scene(scene, scene.sensors()[0])
    region = Region.of_scene(lidar, SensorSampler(lidar.receiver, lidar.transmitter))
    width, count = 0.1, 2**18
    rings, shift = BeamRings(lidar.transmitter.pose, 1.0, 1.34), mi.Point2f(0.37, 0.61)
    patches = SolidPatches(lidar, region, rings, 8.0, width, shift)
    rng = pass_streams(3, 0, count)
    x, y = (half * (2 * rng.next_float32() - 1) for _ in range(2))
    ray = mi.Ray3f(mi.Point3f(x + 0.1, y + 0.05, -3), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    patch = patches.locate(si)
    share = patches.inverse_share(patch, si.shape, rng, si.is_valid())
    values = np.array(share / patch.area, dtype=np.float64) * (2 * half) ** 2
    touched = len(np.unique(np.array(patch.tag).astype(np.uint64) << 32 | np.array(patch.bucket)))
    assert abs(values.mean() - touched) < 4 * values.std() / np.sqrt(count)
    # Without it, edges would be missed.
    assert np.array(1 / patch.area).mean() * (2 * half) ** 2 < 0.9 * touched


@pytest.mark.slow
def test_narrow_view_in_a_wide_beam_draws_light_where_it_looks(lidar_scene, passes):
    """A tenth of the beam's width in view: the same mean as photons drawn by the beam alone, with less noise."""
    scene = lidar_scene(
        integrator={**MERGING, "cell_size": 0.02}, tx={"divergence_mrad": 40.0}, rx={"field_of_view_mrad": 6.0}
    )
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    energies = []
    for use_view in (True, False):
        assert renderer._beam.use_view
        renderer._beam.use_view = use_view
        energies.append(np.array([renderer.render_pass(seed).histogram.energy().sum() for seed in range(16)]))
    energy, plain = energies
    assert_same(energy[:, None], plain[:, None])
    assert energy.std() < 0.7 * plain.std()


@pytest.mark.slow
def test_crowded_passes_make_room_and_lose_nothing(lidar_scene, passes):
    """Room for a tenth of what is needed: the pass is repeated with more, and gives the same bits."""
    scene = lidar_scene(integrator={**MERGING, "paths_per_pass": 2**14, "photons_per_pass": 2**14})
    whole = passes(scene, 1, 3)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    layout = renderer.layout
    layout.light_segments = layout.sensor_segments = layout.hits = 0.1
    np.testing.assert_array_equal(renderer.render_pass(3).histogram.energy(), whole[0])
    assert layout.light_segments > 1
    dr.sync_thread()


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_merging", "lidar_volpath"])
def test_passes_share_their_kernels(lidar_scene, integrator):
    """A number that differs between passes and is part of a kernel would compile it again in every pass."""
    scene = lidar_scene(integrator={"type": integrator, "paths_per_pass": 2**12}, water={"scattering": 0.2})
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    renderer.render_pass(0)
    found = []
    for seed in (1, 2):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.render_pass(seed)
            found.append([kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT])
    assert found[0] == found[1]
    assert len(found[0]) > 0


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_merging", "lidar_volpath"])
@pytest.mark.parametrize(
    "parameters",
    [
        {"attenuation": 0.3, "scattering": 0.21, "bottom_depth": 7.5, "bottom_reflectance": 0.2},
        {"wind_speed": 4, "surface_seed": 3},
        {"time_start_ns": 1310, "bin_count": 270},
        {"altitude": 230, "off_nadir_deg": 17, "pulse_energy_mj": 3, "pulse_fwhm_ns": 4},
        {"divergence_mrad": 8, "field_of_view_mrad": 28, "aperture_area": 0.02},
    ],
    ids=lambda parameters: next(iter(parameters)),
)
def test_scenes_share_their_kernels(parameters, integrator):
    """Parameters that are numbers of a kernel would compile it again in every run of a campaign."""
    found = []
    for params in ({}, {}, parameters):
        session = open_scene("table1", {"time_start_ns": 1300, "bin_count": 300, **params})
        renderer = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.render_pass(1, paths=2**12)
            found.append({kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT})
    assert found[2] <= found[0] | found[1]
    assert len(found[2]) > 0


@pytest.fixture
def two_levels(tmp_path):
    """Mesh of a wide bottom at 8 m and, 3 m above it, a plate of 4 m."""
    square = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [f"v {half * x} {half * y} {z}" for half, z in ((500, -8), (2, -5)) for x, y in square]
    lines = [*corners, "f 1 2 3", "f 1 3 4", "f 5 6 7", "f 5 7 8"]
    path = tmp_path / "levels.obj"
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path), "bsdf": {"type": "twosided", "inner": {"type": "diffuse"}}}


def test_levels_of_one_mesh_are_distinguished(lidar_scene, two_levels):
    flat = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -9]).scale(500)}
    scene = lidar_scene(integrator=MERGING, bottom=None, extra={"levels": two_levels, "flat": flat})
    lidar = LidarScene.from_scene(scene, scene.sensors()[0])
    region = Region.of_scene(lidar, SensorSampler(lidar.receiver, lidar.transmitter))
    assert [shape.id() for shape in solids_of_several_levels(lidar, region)] == ["levels"]


@pytest.mark.slow
def test_light_is_not_merged_across_the_levels_of_a_mesh(lidar_scene, passes, two_levels):
    """Light on the bottom under the plate would be seen on the plate, and late: 28 ns after the plate's echo."""
    water = {"attenuation": 0.1, "scattering": 0.05, "backscattering": 0.002}
    means, errors = [], []
    for kind in ("lidar_merging", "lidar_volpath"):
        scene = lidar_scene(integrator={"type": kind}, bottom=None, water=water, extra={"levels": two_levels})
        energy = passes(scene, 12).sum(axis=1)[:, 50:130:1].reshape(12, 16, 5).sum(axis=-1)
        means.append(energy.mean(axis=0))
        errors.append(energy.std(axis=0, ddof=1) / np.sqrt(12))
    z = (means[0] - means[1]) / np.hypot(*errors)
    assert np.all(np.abs(z) < largest_z(12, z.size)), z
    assert np.median(errors[1] / means[1]) < 0.02
