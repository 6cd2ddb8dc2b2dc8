"""Parts of the merging integrator, its bits and its kernels; its light is tested by closed forms and agreement."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from significance import assert_equal, assert_same, largest_chi2, largest_error, largest_z, mean_and_error

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.transport.merging import renderer as merging_renderer
from mitransient_lidar.transport.merging.cells import RefractedProfile, WaterCells
from mitransient_lidar.transport.merging.layout import MergingLayout, MergingOptions
from mitransient_lidar.transport.merging.patches import SolidPatches, foreshortening, solids_of_several_levels
from mitransient_lidar.transport.merging.region import Region, SurfaceHeights
from mitransient_lidar.transport.merging.rings import BeamRings
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.scene_parts import find_lidar_scene

MERGING = {"type": "lidar_merging"}
FEW = {**MERGING, "paths_per_pass": 2**13, "photons_per_pass": 2**13}
#: Waves in the water that scatters most of the published scenes' light more than once.
WAVES = {"spectrum": "elfouhaily", "wind_speed": 3.0, "slope_variance": "cox_munk"}


def plate(x, y, z, half, tilt=0.0, **bsdf):
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], tilt).scale(half)
    diffuse = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.3}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or diffuse}


@pytest.mark.slow
def test_cells_of_any_width_and_beam_give_finite_light(lidar_scene, passes):
    """Areas of rings overflowed; and beams of kilometres had cells in which level light grew by factors of 1e8."""
    for width in (1e-30, 1e4):
        found = passes(lidar_scene(integrator={**FEW, "cell_size": width}), 2)
        assert np.isfinite(found).all()
        assert found.sum() > 0
    high, film = {"altitude": 1.2e5}, {"time_start_ns": 8.5e5, "bin_width_ns": 1000.0, "bin_count": 20}
    merged, reference = (
        passes(lidar_scene(integrator=integrator, tx=high, rx=high, film=film, bottom=None), 4)
        for integrator in (FEW, {})
    )
    # The fast one has a standard error of about one.
    assert 0 < merged.sum() < 30 * reference.sum()
    with pytest.raises(UserError, match=r"the beam is 4\.26e\+04 m wide on the sea, more than 1000"):
        passes(lidar_scene(integrator=MERGING, tx={"altitude": 1e6, "divergence_mrad": 20.0}, rx={"altitude": 1e6}), 1)


@pytest.mark.slow
def test_only_what_is_not_merged_is_left_to_the_reference(lidar_scene, passes):
    """Over a level sea without mirrors nothing is left; a mirror under water leaves what it shows."""
    complement_only = {"complement_only": True, "paths_per_pass": 2**16}
    assert passes(lidar_scene(integrator=complement_only), 2).sum() == 0
    mirror = lidar_scene(integrator=complement_only, extra={"target": plate(0.0, 0.0, -5.0, 1.0, type="conductor")})
    assert passes(mirror, 2).sum() > 0


@pytest.mark.slow
def test_same_seed_same_bits_and_pixels_sum_to_the_whole(lidar_scene, passes):
    four = passes(lidar_scene(integrator=FEW, sea=WAVES), 2, 5)
    again = passes(lidar_scene(integrator=FEW, sea=WAVES), 2, 5)
    np.testing.assert_array_equal(four, again)
    single = passes(lidar_scene(integrator=FEW, sea=WAVES, rx={"layout": "1x1"}), 2, 5)
    np.testing.assert_allclose(four.sum(axis=1), single[:, 0], rtol=1e-12, atol=1e-30)
    assert not np.array_equal(four[0], four[1])


@pytest.fixture
def wavy_sea(lidar_scene):
    scene = lidar_scene(integrator=MERGING, sea=WAVES)
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    region = Region.of_probe(Probe(lidar))
    return lidar, region


def test_region_holds_beam_and_view_and_no_more_than_half_as_much_again(wavy_sea):
    """Field of view of 30 mrad at 212.8 m: 6.4 m across, and 1 / cos(20 deg) of that along x."""
    _, region = wavy_sea
    for size, seen in zip(region.size, (6.39 / np.cos(np.radians(20)), 6.39), strict=True):
        assert seen < size < 1.6 * seen


@pytest.mark.slow
def test_points_are_as_dense_above_a_bottom_that_lies_higher_than_a_trough_elsewhere(lidar_scene):
    """Waves of 10 m/s reach 1.5 m below the mean sea level somewhere on the sea, a bottom is at 1.25 m."""
    pose = {"altitude": 20.0, "off_nadir_deg": 0.0}
    sea = {"spectrum": "elfouhaily", "wind_speed": 10.0, "shoaling": "none"}
    scene = lidar_scene(integrator=MERGING, tx=pose, rx=pose, sea=sea, bottom=1.25)
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    assert min(float(surface.bbox().min.z) for surface in lidar.surfaces) < -1.25
    region = Region.of_probe(Probe(lidar))
    assert region.track_length(lidar) == pytest.approx(1.25, rel=0.01)


def test_heights_are_those_of_the_mesh(wavy_sea):
    lidar, region = wavy_sea
    heights = SurfaceHeights(lidar, region, 8.0)
    rng = np.random.default_rng(2)
    x, y = (rng.uniform(region.low[axis], region.high[axis], 4096) for axis in (0, 1))
    down = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), 5), mi.Vector3f(0, 0, -1))
    true = np.array(lidar.mitsuba_scene.ray_intersect(down).p.z)
    assert true.std() > 0.03
    surface, slope = (np.array(values) for values in heights.surface_at(mi.Float(x), mi.Float(y)))
    # Cells are of 1.6 cm; those at the edges of facets have the slope of one of them.
    assert np.abs(surface - true).max() < 0.005
    assert np.median(np.abs(surface - true)) < 1e-6
    beyond = mi.Ray3f(mi.Point3f(mi.Float(x + 1e-3), mi.Float(y), 5), mi.Vector3f(0, 0, -1))
    rise = (np.array(lidar.mitsuba_scene.ray_intersect(beyond).p.z) - true) / 1e-3
    assert np.median(np.abs(slope[0] - rise)) < 1e-3
    # Under the beam, too, 2 m beside the region.
    np.testing.assert_allclose(np.array(heights.bed_at(mi.Float(x + 2), mi.Float(y))), -8, atol=1e-5)


def test_beds_are_found_where_refracted_light_is(lidar_scene):
    """A beam of centimetres enters the water 2 m beside where it meets a bottom that falls by 20 degrees."""
    sand = {"type": "seabed", "slope_x_deg": 20.0, "size": 100.0}
    narrow = {"tx": {"divergence_mrad": 0.1}, "rx": {"field_of_view_mrad": 0.3}}
    scene = lidar_scene(integrator=MERGING, bottom=None, extra={"bottom": sand}, **narrow)
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    heights = SurfaceHeights(lidar, Region.of_probe(Probe(lidar)), 8.0)
    down = mi.Ray3f(mi.Point3f(2.0, 0.1, -0.5), mi.Vector3f(0, 0, -1))
    true = float(lidar.mitsuba_scene.ray_intersect(down).p.z[0])
    assert float(heights.bed_at(mi.Float(2.0), mi.Float(0.1))[0]) == pytest.approx(true, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [[0.3, 0.9, 0.99, 0.4]])
@pytest.mark.parametrize("direction", [None, [-0.3, 0.2, 0.933]])
def test_points_fall_into_cells_by_their_volume(wavy_sea, shift, direction):
    """Uniform in a column of water below the waves: as many in each cell as its volume says, the topmost included."""
    lidar, region = wavy_sea
    heights = SurfaceHeights(lidar, region, 8.0)
    rings = BeamRings(lidar.transmitter.pose, 0.5, 1.34)
    # So wide a beam has the same light everywhere.
    profile = RefractedProfile(lidar, (1e4, 1e4))
    cells = WaterCells(rings, heights, profile, 0.4, 0.2, 0.25, 0.1, 4.0).of_pass(mi.Point4f(shift))
    rng, count, depth = np.random.default_rng(7), 2**21, 1.5
    lean = lidar.transmitter.pose.axis[0] / 1.34
    lean /= np.sqrt(1 - lean**2)
    below, y = rng.uniform(0, depth, count), rng.uniform(-2.0, 2.0, count)
    x = rng.uniform(-2.0, 2.0, count)
    z = np.array(heights.surface_at(mi.Float(x), mi.Float(y))[0]) - below
    points = mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(z))
    cell = cells.locate(points, *(() if direction is None else (mi.Vector3f(direction), mi.Bool(True))))
    bucket, tag, volume = (np.array(a) for a in (cell.bucket, cell.tag, cell.volume_of_unscattered))
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
    assert np.sum(z**2) < 1.3 * largest_chi2(z.size)


@pytest.mark.parametrize("height", [None, 0.03], ids=["on a plate", "on a bottom below it"])
def test_inverse_share_counts_edges_in_full(lidar_scene, height):
    """Points uniform on a plate, or on the bottom: for each patch the mean inverse share times their share is 1.

    On the bottom, what a plate hides that lies 3 cm above it makes patches of its own.
    """
    half, bottom = 0.31, -8.0
    extra = {"target": plate(0.1, 0.05, -4.0 if height is None else bottom + height, half)}
    scene = lidar_scene(integrator=MERGING, extra=extra)
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    region = Region.of_probe(Probe(lidar))
    width, count, side = 0.1, 2**18, half if height is None else 0.7
    rings, shift = BeamRings(lidar.transmitter.pose, 1.0, 1.34), mi.Point2f(0.37, 0.61)
    patches = SolidPatches(lidar, region, rings, 8.0, width).of_pass(lidar, shift)
    rng = pass_streams(3, 0, count)
    x, y = (side * (2 * rng.next_float32() - 1) for _ in range(2))
    ray = mi.Ray3f(
        mi.Point3f(x + 0.1, y + 0.05, -3 if height is None else bottom + 0.5 * height), mi.Vector3f(0, 0, -1)
    )
    si = scene.ray_intersect(ray)
    patch = patches.locate(si)
    share = patches.inverse_share(patch, si.shape, rng, si.is_valid())
    patches_of_points = np.array(patch.tag).astype(np.uint64) << 32 | np.array(patch.bucket)
    _, first, inverse, number = np.unique(patches_of_points, return_index=True, return_inverse=True, return_counts=True)
    covered = number / count * (2 * side) ** 2 / np.array(patch.area, dtype=np.float64)[first]
    mean = np.bincount(inverse, np.array(share, dtype=np.float64)) / number
    # Of slivers too few points are known, and of patches beyond the points only parts. The number of draws up to the
    # first hit has the variance (1 - s)/s^2.
    beyond = np.maximum(np.abs(x), np.abs(y)) > (1.0 if height is None else 0.7) * side
    known = (number > 1000) & (np.bincount(inverse, beyond) == 0)
    z = (mean * covered - 1)[known] / np.sqrt((2 - np.minimum(covered, 1)) / number)[known]
    assert known.sum() > 30
    assert np.abs(z).max() < largest_z(10**6, z.size)
    # Without it, edges would be missed.
    assert covered[known].mean() < 0.9


def test_light_on_curved_sides_is_merged_in_full(lidar_scene):
    """On the steep sides of a sphere, which curve within a patch: the irradiance is that of parallel light.

    Merged without regard to the slopes at either place it is 0.72 +- 0.04 of that.
    """
    ball = {"type": "sphere", "center": [0.0, 0.0, -4.0], "radius": 0.1, "bsdf": {"type": "diffuse"}}
    scene = lidar_scene(integrator=MERGING, extra={"target": ball})
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    solids = SolidPatches(lidar, Region.of_probe(Probe(lidar)), BeamRings(lidar.transmitter.pose, 1.0, 1.34), 8.0, 0.1)
    numbers, count, down, ratios = np.random.default_rng(5), 2**12, mi.Vector3f(0, 0, -1), []
    for batch in range(16):
        patches = solids.of_pass(lidar, mi.Point2f(numbers.uniform(size=(2, 1))))
        rng, found = pass_streams(batch, 0, count), []
        for _ in range(2):
            x, y = (0.1 * (2 * rng.next_float32() - 1) for _ in range(2))
            si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, -3), down))
            patch = patches.locate(si)
            share = patches.inverse_share(patch, si.shape, rng, si.is_valid())
            values = np.array(
                [patch.area / share, foreshortening(dr.abs(dr.dot(si.n, down)), patch.cosine), si.n.z], np.float64
            )
            number = np.array(patch.tag).astype(np.uint64) << 32 | np.array(patch.bucket)
            steep = np.array((si.p.z > -4.5) & (patch.axis != 2))
            found.append((number[steep], values[:, steep]))
        (light, (_, lit, _)), (seen, (area, view, slope)) = found
        # Rays of light and of view are as dense: energies are in units of one of light, areas of one across the rays.
        patch, inverse = np.unique(seen, return_inverse=True)
        place = np.searchsorted(patch, light)
        known = patch[np.minimum(place, len(patch) - 1)] == light
        energy = np.bincount(place[known], 1 / lit[known], len(patch))
        ratios.append(np.sum(energy[inverse] * view / area) * 0.2**2 / count / np.sum(slope))
    assert_equal(np.array(ratios), 1.0, error=0.02)


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
    """A number of a pass, its seed or that of its paths, that is part of a kernel would compile it again."""
    scene = lidar_scene(integrator={"type": integrator, "paths_per_pass": 2**12}, water={"scattering": 0.2})
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    renderer.render_pass(0)
    found = []
    for seed, paths in ((1, 2**12), (2, 2**11)):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            renderer.render_pass(seed, paths=paths)
            found.append([kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT])
    assert found[0] == found[1]
    assert len(found[0]) > 0


#: Water of two refractive indices.
STRATA = {"layer_tops": "0, 2", "attenuation": "0.6, 0.3", "scattering": "0.35, 0.15", "backscattering": "0.007, 0.003"}
STRATA |= {"refractive_index": "1.337, 1.342", "group_index": "1.358, 1.365"}
OTHER_STRATA = {"layer_tops": "0, 3", "attenuation": "0.5, 0.3", "refractive_index": "1.33, 1.34"}
OTHER_STRATA |= {"group_index": "1.35, 1.37"}
OTHER_STRATA |= {"plume_scattering": 0.7, "plume_width": 6, "plume_depth": 1.5, "ship_x": 1}


def kernels_of_pass(scene, sensor, integrator):
    renderer = choose_integrator(scene, integrator).prepare(scene, sensor)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        renderer.render_pass(1, paths=2**12)
        found = {kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT}
    assert found
    return found


#: Changes of numbers alone.
NUMBERS = {"attenuation": 0.3, "scattering": 0.21, "bottom_depth": 7.5, "bottom_reflectance": 0.2}
NUMBERS |= {"altitude": 230, "off_nadir_deg": 17, "pulse_energy_mj": 3, "pulse_fwhm_ns": 4, "bubble_wind_speed": 11}


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_merging", "lidar_volpath"])
@pytest.mark.parametrize(
    ("name", "parameters", "changes"),
    [
        pytest.param("table1", {"bubble_wind_speed": 9}, NUMBERS, marks=pytest.mark.long),
        pytest.param("table1", {}, {"wind_speed": 4, "surface_seed": 3}, marks=pytest.mark.long),
        pytest.param("table1", {}, {"time_start_ns": 1310, "bin_count": 270}, marks=pytest.mark.long),
        pytest.param("table1", {}, {"divergence_mrad": 8, "field_of_view_mrad": 28}, marks=pytest.mark.long),
        pytest.param(
            "table1", {"layout": "hex7"}, {"field_of_view_mrad": 20, "group_index": 1.36}, marks=pytest.mark.long
        ),
        # Its bottom has an opposition effect.
        ("ship_wake", {**STRATA, "bottom_model": "hapke"}, {**OTHER_STRATA, "lobe_asymmetry": 0.2}),
    ],
    ids=lambda value: next(iter(value), "none") if isinstance(value, dict) else value,
)
def test_scenes_share_their_kernels(name, parameters, changes, integrator):
    """Parameters that are numbers of a kernel would compile it again in every run of a campaign."""
    found = []
    for params in (parameters, parameters, {**parameters, **changes}):
        session = open_scene(name, {"time_start_ns": 1300, "bin_count": 300, **params})
        found.append(kernels_of_pass(session.scene, session.sensor, integrator))
    assert found[2] <= found[0] | found[1]


#: Kinds of pixels, the first two in the slow tier.
RECEIVERS = ["hexagons with gaps", "measured blur"]
RECEIVERS += [pytest.param(kind, marks=pytest.mark.long) for kind in ("gaps", "blur", "map")]


@pytest.mark.slow
@pytest.mark.parametrize("kind", RECEIVERS)
def test_receivers_share_their_kernels(lidar_scene, tmp_path, kind):
    found = []
    for number, share in enumerate((0.5, 0.5, 0.7)):
        image = tmp_path / f"image{number}.npy"
        np.save(image, np.random.default_rng(number).integers(1, 5, (9, 9)))
        receiver = {
            "gaps": {"layout": "4x4", "fill_factor": share, "field_of_view_mrad": 40 * share},
            "hexagons with gaps": {"layout": "hex7", "fill_factor": share},
            "blur": {"layout": "4x4", "blur_mrad": share},
            "measured blur": {"layout": "4x4", "blur_file": str(image), "blur_file_mrad": share},
            "map": {"pixel_map": str(image), "field_of_view_mrad": 40 * share},
        }[kind]
        scene = lidar_scene(rx=receiver)
        found.append(kernels_of_pass(scene, scene.sensors()[0], "lidar_volpath"))
    assert found[2] <= found[0] | found[1]


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
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    region = Region.of_probe(Probe(lidar))
    assert [shape.id() for shape in solids_of_several_levels(lidar, region)] == ["levels"]


@pytest.mark.slow
def test_light_is_not_merged_across_the_levels_of_a_mesh(lidar_scene, passes, two_levels):
    """Light on the bottom under the plate would be seen on the plate, and late: 28 ns after the plate's echo."""
    water = {"attenuation": 0.1, "scattering": 0.05, "backscattering": 0.002}
    means, errors = [], []
    for integrator in (FEW, {}):
        scene = lidar_scene(integrator=integrator, bottom=None, water=water, extra={"levels": two_levels})
        energy = passes(scene, 8).sum(axis=1)[:, 50:130].reshape(8, 16, 5).sum(axis=-1)
        means.append(energy.mean(axis=0))
        errors.append(energy.std(axis=0, ddof=1) / np.sqrt(8))
    z = (means[0] - means[1]) / np.hypot(*errors)
    assert np.all(np.abs(z) < largest_z(8, z.size)), z
    assert np.median(errors[1] / means[1]) < largest_error(8, 0.02)
    assert np.median(errors[0] / means[0]) < largest_error(8, 0.03)


@pytest.mark.slow
def test_every_pixel_of_an_image_has_the_light_of_the_water():
    """One path a pixel, whose places are the same in all passes: those that are merged must not be."""
    wide = {"divergence_mrad": 150, "attenuation": 0.6, "scattering": 0.5, "bottom_reflectance": 0}
    view = {"layout": "64x64", "field_of_view_shape": "square", "spectrum": "flat"}
    session = open_scene("fig09_2x2", {**view, **wide})
    few = {**FEW, "paths_per_pass": 64 * 64}
    renderer = choose_integrator(session.scene, few).prepare(session.scene, session.sensor)
    light = np.array([renderer.render_pass(seed).histogram.energy()[..., 20:80].sum(axis=-1) for seed in range(16)])
    row, column = np.mgrid[:64, :64]
    for kind in (row + column, row, column, row + column // 2, row // 2 + column):
        found, other = (light[:, kind % 2 == parity].mean(axis=1) for parity in (0, 1))
        mean, error = mean_and_error(found - other)
        assert abs(mean) < largest_z(16, 5) * error
        assert error < 0.1 * light.mean()


@pytest.mark.slow
def test_every_second_path_of_an_image_stands_for_two(monkeypatch):
    """The light of water and bottom is that of all paths; without the weight, the water would have half of it."""
    session = open_scene("fig09_2x2", {"layout": "64x64", "spectrum": "flat"})
    sums = []
    for every, seed in ((1, 0), (2, 100)):
        monkeypatch.setattr(merging_renderer, "_EVERY_IN_IMAGES", every)
        renderer = choose_integrator(session.scene, FEW).prepare(session.scene, session.sensor)
        passes = [renderer.render_pass(seed + number).histogram.energy().sum(axis=(0, 1)) for number in range(10)]
        # Water and bottom, and narrower parts of both.
        sums.append(np.add.reduceat(np.array(passes), np.arange(0, len(passes[0]), 16), axis=1))
    means, errors = zip(*map(mean_and_error, sums), strict=True)
    lit = (means[0] > 0) & (means[1] > 0)
    z = (means[1] - means[0])[lit] / np.hypot(*errors)[lit]
    assert np.abs(z).max() < largest_z(10, lit.sum())


@pytest.mark.slow
def test_cells_wider_than_light_patterns_keep_their_mean():
    """Water at 1.5 to 3 m below waves from 0.35 m, with cells of 0.1 m: without the enhancement it is 5 % low."""
    water = {"attenuation": "0.1", "scattering": "0.02", "backscattering": "0.001"}
    params = {"layout": "1x1", "shortest_wave": "0.35", "cell_size": "0.05", **water}
    session = open_scene("fig09_2x2", params)
    found = []
    for integrator in ({**MERGING, "cell_size": 0.1}, {"type": "lidar_volpath", "paths_per_pass": 2**16}):
        renderer = choose_integrator(session.scene, integrator).prepare(session.scene, session.sensor)
        depth = (renderer.scene.axis.centres_ns - renderer.probe.echoes.surface_ns.mean()) / 9.246
        used = (depth > 1.5) & (depth <= 3)
        passes = [renderer.render_pass(seed).histogram.energy().ravel()[used].sum() for seed in range(32)]
        found.append(np.array(passes)[:, np.newaxis])
    assert_same(*found, error=0.007)


def test_sides_are_those_of_the_cells_about_the_beam(wavy_sea):
    """Sides by depth against areas of cells that contain points of the beam, in cells of one pass."""
    lidar, _ = wavy_sea
    cells = MergingLayout.of_probe(Probe(lidar), MergingOptions()).cells
    rng = np.random.default_rng(3)
    angles = rng.normal(scale=float(lidar.transmitter.angular_spread) * 213, size=(2, 2**14))
    for depth in (1.0, 4.0):
        above = cells.depth_of(cells.layer_at(mi.Float(depth)) - 0.5)
        x, y = (mi.Float(side) for side in angles)
        sector = cells.rings.sector(x, y, cells.rings.core(above), cells.widths(above), mi.Point2f(0.3, 0.6))
        squares = np.array(cells.rings.area(sector) * cells.rings.cosine)
        assert cells.sides(np.array([depth]))[0] == pytest.approx(np.sqrt(squares.mean()), rel=0.03)
