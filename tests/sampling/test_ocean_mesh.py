"""The sea's mesh: closed, periodic, with the slopes of its spectrum along and across any wind."""

import mitsuba as mi
import numpy as np
import pytest
from kernel_arrays import array, vector
from rows import each_case
from significance import assert_equal, assert_same

from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.physics.sea.cox_munk import cox_munk
from mitransient_lidar.physics.sea.wind_spectra import ElfouhailySpectrum

CELLS = 32
#: A patch of one period, without surround.
PATCH = {"refined_size": 32.0, "size": 32.0, "cell_size": 32.0 / CELLS}


def surface(**parameters):
    sea = {"type": "ocean_surface", **parameters, "interior": {"type": "layered_water"}}
    scene = mi.load_dict({"type": "scene", "sea": sea})
    return scene, next(shape for shape in scene.shapes() if hasattr(shape, "sea"))


def buffers(shape):
    parameters = mi.traverse(shape)
    vertices = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    return vertices, np.array(parameters["faces"]).reshape(-1, 3)


def facet_slopes(shape):
    """Return slopes (dz/dx, dz/dy) of all facets."""
    vertices, faces = buffers(shape)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert np.all(normal[:, 2] > 0)
    return -normal[:, 0] / normal[:, 2], -normal[:, 1] / normal[:, 2]


@pytest.mark.parametrize("size", [32.0, 500.0])
def test_inner_edges_join_two_facets(size):
    """An edge with one facet, or with two of one sense, is a crack or a flipped facet through which light leaks."""
    vertices, faces = buffers(surface(**PATCH | {"size": size})[1])
    side = round(np.sqrt(len(vertices))) - 1
    assert (side == CELLS) == (size == 32.0)
    assert len(vertices) == (side + 1) ** 2
    assert len(faces) == 2 * side**2
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    _, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    assert set(counts) == {1, 2}
    assert np.sum(counts == 1) == 4 * side


def test_patch_is_periodic_and_centred():
    vertices, _ = buffers(surface(refined_size=20.0, size=20.0, period=20.0, cell_size=20.0 / CELLS)[1])
    grid = vertices.reshape(CELLS + 1, CELLS + 1, 3)
    np.testing.assert_array_equal(grid[0, :, 2], grid[-1, :, 2])
    np.testing.assert_array_equal(grid[:, 0, 2], grid[:, -1, 2])
    assert vertices[:, :2].min() == pytest.approx(-10)
    assert vertices[:, :2].max() == pytest.approx(10)
    # The mean sea level is z = 0: the spectrum has no constant term.
    assert abs(grid[:-1, :-1, 2].mean()) < 1e-6
    assert grid[..., 2].std() > 0.01


def test_rays_find_no_hole_and_facets_are_flat():
    """Interpolated normals would make other slopes than the facets', and lose energy."""
    scene, shape = surface(**PATCH)
    rng = np.random.default_rng(1)
    # Random points, and points on vertices and on edges of the grid.
    points = np.concatenate([rng.uniform(-15.9, 15.9, (100_000, 2)), rng.integers(-15, 15, (2000, 2))])
    points = np.concatenate([points, np.stack([rng.integers(-15, 15, 2000), rng.uniform(-15, 15, 2000)], axis=1)])
    origin = mi.Point3f(*(array(p) for p in points.T), 50.0)
    for height, down in ((50.0, -1.0), (-50.0, 1.0)):
        origin.z = height
        si = scene.ray_intersect(mi.Ray3f(origin, vector((0, 0, down))))
        assert np.all(np.array(si.is_valid()))
        np.testing.assert_allclose(np.array(si.sh_frame.n), np.array(si.n), atol=1e-6)
        assert np.all(np.array(si.n.z) > 0)
    assert shape.is_medium_transition()


@pytest.mark.parametrize("direction", [0.0, 30.0, 90.0, 200.0])
def test_ripples_lie_along_the_wind(direction):
    """The roughness axis u is the texture's: without coordinates it is arbitrary from facet to facet."""
    scene, _ = surface(wind_direction_deg=direction, **PATCH)
    x, y = (array(p) for p in np.random.default_rng(2).uniform(-15, 15, (2, 1000)))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 50), mi.Vector3f(0, 0, -1)))
    along = np.array(si.sh_frame.s)
    angle = np.degrees(np.arctan2(along[1], along[0]))
    # Facets tilted by 0.2 turn the projected axis by up to 2 degrees.
    assert np.all(np.abs((angle - direction + 180) % 360 - 180) < 3)


@pytest.mark.slow
def test_facet_slopes_have_the_stated_variance_along_and_across_the_wind():
    """Over 120 seas; up- and crosswind exchanged is a factor of 1.5 to 2, a wrong facet filter 10 %."""
    ratios = []
    for seed in range(120):
        wind, direction = (3.0, 6.0)[seed % 2], (0.0, 30.0, 90.0)[seed % 3]
        cos, sin = np.cos(np.radians(direction)), np.sin(np.radians(direction))
        _, shape = surface(
            wind_speed=wind, wind_direction_deg=direction, surface_seed=seed, period=32.0, **PATCH | {"cell_size": 0.5}
        )
        x, y = facet_slopes(shape)
        # The mean slope of a periodic patch is 0, so the mean square is the variance.
        variances = np.array([np.mean((cos * x + sin * y) ** 2), np.mean((cos * y - sin * x) ** 2)])
        ratios.append(variances / shape.sea.resolved_variance)
    assert_equal(ratios, [1, 1], error=0.012)


@each_case(("cox_munk", sum(cox_munk(6.0))), ("spectrum", sum(ElfouhailySpectrum(6.0).slope_variance())), ("0.1", 0.1))
def test_waves_and_ripples_add_up_to_the_variance_that_was_asked_for(asked, total):
    _, shape = surface(wind_speed=6.0, slope_variance=asked, **PATCH)
    assert shape.sea.slope_variance == pytest.approx(total, rel=1e-9)
    assert min(shape.sea.ripple_variance) > 1e-4
    parameters = mi.traverse(shape)
    for axis, variance in zip("uv", shape.sea.ripple_variance, strict=True):
        # Beckmann's alpha is sqrt(2) standard deviations of Gaussian slopes.
        assert parameters[f"bsdf.alpha_{axis}.value"][0] == pytest.approx(np.sqrt(2 * variance), rel=1e-6)


@pytest.mark.slow
def test_cells_are_chosen_by_footprint_and_range():
    """A twelfth of the beam's standard deviation: 1.06 m at 200 m and 20 degrees."""
    lidar = {"altitude": 200.0, "off_nadir_deg": 20.0, "divergence_mrad": 10.0, "field_of_view_mrad": 30.0}
    sea = surface(**lidar)[1].sea
    assert 0.8 * 1.064 / 12 < sea.cell_size <= 1.064 / 12
    assert 2 * 3.44 < sea.refined_size < 32
    near = surface(**lidar | {"altitude": 20.0})[1].sea
    assert 0.016 < near.cell_size <= 0.02  # the smallest
    assert near.shortest_wave == pytest.approx(0.1064, rel=1e-3)
    mast = surface(**lidar | {"altitude": 10.0, "off_nadir_deg": 84.6, "field_of_view_mrad": 10.0})[1].sea
    # The field of view reaches from 97 to 116 m, and 1.5 times the beam's divergence from 93 to 126 m.
    assert 2 * 20 < mast.refined_size < 80


def test_height_maps_become_surfaces(tmp_path):
    """A plane that rises by 0.1 along x: its slope is resolved, and the ripples are what is missing to the total."""
    x = np.linspace(-10, 10, 81)
    np.save(tmp_path / "plane.npy", np.tile(0.1 * x, (81, 1)))
    scene, shape = surface(
        spectrum="height_map", filename=str(tmp_path / "plane.npy"), map_size=20.0, slope_variance="0.02", size=60.0
    )
    assert shape.sea.resolved_variance == pytest.approx((0.01, 0.0), abs=1e-6)
    assert shape.sea.ripple_variance == pytest.approx((1e-5, 0.01), abs=1e-5)
    x = np.random.default_rng(1).uniform(-28, 28, 1000)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(array(x), 3.3, 50.0), mi.Vector3f(0, 0, -1)))
    np.testing.assert_allclose(np.array(si.p.z), 0.1 * np.clip(x, -10, 10), atol=0.03)


def test_swell_and_wake_lie_on_the_sea():
    flat = {"wind_speed": 0.0, "refined_size": 32.0, "cell_size": 0.5, "size": 200.0}
    swell = surface(swell_height=0.8, swell_wavelength=20.0, period=512.0, **flat)[1]
    grid = swell.sea.waves.parts[0].heights
    assert 4 * grid.std() == pytest.approx(0.8, rel=0.15)  # one sea of a narrow spectrum
    wake = surface(spectrum="flat", wake_speed=5.0, wake_length=20.0, refined_size=32.0, cell_size=0.5, size=200.0)[1]
    vertices, _ = buffers(wake)
    behind, ahead = vertices[vertices[:, 0] < -15], vertices[vertices[:, 0] > 15]
    assert np.abs(behind[:, 2]).max() > 0.02
    assert np.abs(ahead[:, 2]).max() < 0.001
    both = surface(wake_speed=5.0, wake_length=20.0, refined_size=32.0, cell_size=0.5, size=200.0)[1]
    alone = surface(refined_size=32.0, cell_size=0.5, size=200.0)[1]
    np.testing.assert_allclose(buffers(both)[0][:, 2] - buffers(alone)[0][:, 2], vertices[:, 2], atol=1e-6)


def test_time_moves_the_sea_downwind():
    """After 0.5 s waves of the peak have moved by 1.8 m: shifting the first sea by that fits better than not at all."""
    seas = [
        surface(time=time, wind_speed=3.0, refined_size=32.0, size=32.0, cell_size=0.25)[1].sea for time in (0.0, 0.5)
    ]
    first, later = (sea.waves.parts[0].heights for sea in seas)
    correlation = [np.sum(later * np.roll(first, shift, axis=1)) for shift in range(-16, 17)]
    moved = 0.25 * (np.argmax(correlation) - 16)
    assert 1.0 < moved < 2.2


@pytest.mark.slow
def test_any_mesh_with_water_below_it_is_a_sea(lidar_scene, passes, tmp_path):
    """The sea written to a PLY file and read by Mitsuba's plugin: the same paths, the same energies."""
    sea = {"ripple_focusing": False, "spectrum": "elfouhaily", "slope_variance": "cox_munk", "refined_size": 16.0}
    sea |= {"cell_size": 0.25, "size": 100.0}
    own = lidar_scene(sea=sea, integrator={"paths_per_pass": 2**14})
    shape = next(shape for shape in own.shapes() if hasattr(shape, "sea"))
    shape.write_ply(str(tmp_path / "sea.ply"))
    alpha = np.sqrt(2 * np.array(shape.sea.ripple_variance))
    ripples = {"type": "roughdielectric", "distribution": "beckmann", "int_ior": 1.34, "ext_ior": 1.0}
    read = {
        "type": "ply",
        "filename": str(tmp_path / "sea.ply"),
        "face_normals": True,
        "bsdf": {**ripples, "alpha_u": float(alpha[0]), "alpha_v": float(alpha[1])},
        "interior": {"type": "layered_water", "refractive_index": 1.34, "group_index": 1.34},
    }
    other = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "lidar_volpath", "paths_per_pass": 2**14},
            "tx": {"type": "lidar_transmitter"},
            "rx": {
                "type": "multipixel_receiver",
                "film": {"type": "time_gated_film", "time_start_ns": 1390.0, "bin_width_ns": 1.0, "bin_count": 160},
            },
            "sea": read,
            "bottom": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, -8.0]).scale(500),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.1}},
            },
        }
    )
    first, second = passes(own, 8).sum(axis=(1, 2)), passes(other, 8, first_seed=50).sum(axis=(1, 2))
    assert_same(first, second, error=0.05)


@pytest.mark.slow
def test_sea_takes_its_automatic_values_from_the_lidar(lidar_scene):
    """The same mesh and ripples however the scene was loaded; bits of a render depend on nothing else."""
    scene = {
        "tx": {"divergence_mrad": 5.0, "aim_x": 5.0, "altitude": 100.0},
        "rx": {"aim_x": 5.0, "altitude": 100.0, "field_of_view_mrad": 10.0},
    }
    automatic = lidar_scene(**scene, sea={"spectrum": "elfouhaily", "wind_speed": 2.0})
    explicit = lidar_scene(
        **scene,
        sea={
            **{"spectrum": "elfouhaily", "wind_speed": 2.0, "centre_x": 5.0, "centre_y": 0.0},
            **{"altitude": 100.0, "divergence_1e2_mrad": 10.0, "field_of_view_mrad": 10.0},
        },
    )
    before = next(shape for shape in automatic.shapes() if hasattr(shape, "sea")).sea.cell_size
    parts = []
    for loaded in (automatic, explicit):
        open_scene(loaded)
        shape = next(shape for shape in loaded.shapes() if hasattr(shape, "sea"))
        parameters = mi.traverse(shape)
        names = ("vertex_positions", "vertex_texcoords", "faces", "bsdf.alpha_u.value", "bsdf.alpha_v.value")
        rays = mi.Ray3f(mi.Point3f(array(np.linspace(-3, 12, 31)), 0.3, 20.0), mi.Vector3f(0, 0, -1))
        parts.append([*(np.array(parameters[name]) for name in names), np.array(loaded.ray_intersect(rays).t)])
        assert shape.sea.cell_size < 2.5e-3 * 107 / 12 < before
    for first, second in zip(*parts, strict=True):
        np.testing.assert_array_equal(first, second)
