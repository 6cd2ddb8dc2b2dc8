"""The sea's mesh: closed, periodic, with the slopes of its spectrum along and across any wind."""

import mitsuba as mi
import numpy as np
import pytest

from mitransient_lidar.optics.sea import ElfouhailySpectrum, cox_munk

CELLS = 32


def surface(**parameters):
    sea = {"type": "ocean_surface", **parameters, "interior": {"type": "layered_water"}}
    scene = mi.load_dict({"type": "scene", "sea": sea})
    return scene, next(shape for shape in scene.shapes() if hasattr(shape, "ripple_variance"))


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


def test_inner_edges_join_two_facets():
    """An edge with one facet, or with two of one sense, is a crack or a flipped facet through which light leaks."""
    vertices, faces = buffers(surface(resolution=CELLS)[1])
    assert len(vertices) == (CELLS + 1) ** 2
    assert len(faces) == 2 * CELLS**2
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    _, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    assert set(counts) == {1, 2}
    assert np.sum(counts == 1) == 4 * CELLS


def test_patch_is_periodic_and_centred():
    vertices, _ = buffers(surface(resolution=CELLS, size=20.0)[1])
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
    scene, shape = surface(resolution=CELLS, size=32.0)
    rng = np.random.default_rng(1)
    # Random points, and points on vertices and on edges of the grid.
    points = np.concatenate([rng.uniform(-15.9, 15.9, (100_000, 2)), rng.integers(-15, 15, (2000, 2))])
    points = np.concatenate([points, np.stack([rng.integers(-15, 15, 2000), rng.uniform(-15, 15, 2000)], axis=1)])
    origin = mi.Point3f(*(mi.Float(p) for p in points.T), 50.0)
    for height, down in ((50.0, -1.0), (-50.0, 1.0)):
        origin.z = height
        si = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, down)))
        assert np.all(np.array(si.is_valid()))
        np.testing.assert_allclose(np.array(si.sh_frame.n), np.array(si.n), atol=1e-6)
        assert np.all(np.array(si.n.z) > 0)
    assert shape.is_medium_transition()


@pytest.mark.parametrize("direction", [0.0, 30.0, 90.0, 200.0])
def test_ripples_lie_along_the_wind(direction):
    """The roughness axis u is the texture's: without coordinates it is arbitrary from facet to facet."""
    scene, _ = surface(wind_direction_deg=direction, resolution=CELLS)
    x, y = (mi.Float(p) for p in np.random.default_rng(2).uniform(-15, 15, (2, 1000)))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 50), mi.Vector3f(0, 0, -1)))
    along = np.array(si.sh_frame.s)
    angle = np.degrees(np.arctan2(along[1], along[0]))
    # Facets tilted by 0.2 turn the projected axis by up to 2 degrees.
    assert np.all(np.abs((angle - direction + 180) % 360 - 180) < 3)


@pytest.mark.parametrize("direction", [0.0, 30.0, 90.0])
@pytest.mark.parametrize("wind", [3.0, 6.0])
def test_facet_slopes_have_the_stated_variance_along_and_across_the_wind(wind, direction):
    """Over 64 seas; up- and crosswind exchanged is a factor of 1.5 to 2, a wrong facet filter 10 %."""
    cos, sin = np.cos(np.radians(direction)), np.sin(np.radians(direction))
    variances = []
    for seed in range(64):
        _, shape = surface(wind_speed=wind, wind_direction_deg=direction, surface_seed=seed, size=32.0, resolution=64)
        x, y = facet_slopes(shape)
        # The mean slope of a periodic patch is 0, so the mean square is the variance.
        variances.append((np.mean((cos * x + sin * y) ** 2), np.mean((cos * y - sin * x) ** 2)))
    variances = np.array(variances)
    error = variances.std(axis=0, ddof=1) / np.sqrt(len(variances))
    assert np.all(error < 0.03 * variances.mean(axis=0))
    assert np.all(np.abs(variances.mean(axis=0) - shape.resolved_variance) < 4 * error)


@pytest.mark.parametrize(
    ("asked", "total"),
    [
        ("cox_munk", sum(cox_munk(6.0))),
        ("spectrum", sum(ElfouhailySpectrum(6.0).slope_variance())),
        ("0.1", 0.1),
    ],
)
def test_waves_and_ripples_add_up_to_the_variance_that_was_asked_for(asked, total):
    _, shape = surface(wind_speed=6.0, slope_variance=asked, resolution=64)
    assert shape.slope_variance == pytest.approx(total, rel=1e-9)
    assert min(shape.ripple_variance) > 1e-4
    parameters = mi.traverse(shape)
    for axis, variance in zip("uv", shape.ripple_variance, strict=True):
        # Beckmann's alpha is sqrt(2) standard deviations of Gaussian slopes.
        assert parameters[f"bsdf.alpha_{axis}.value"][0] == pytest.approx(np.sqrt(2 * variance), rel=1e-6)


def test_a_mesh_rougher_than_asked_says_so():
    """All slopes are resolved at 1e-4: the ripples stop at their smallest, and the total is told as it is."""
    _, shape = surface(wind_speed=6.0, slope_variance="1e-4", resolution=64)
    assert shape.ripple_variance == (1e-5, 1e-5)
    assert shape.slope_variance == pytest.approx(sum(shape.resolved_variance) + 2e-5)
    assert shape.slope_variance > 0.005


def test_seeds_are_different_seas():
    heights = [buffers(surface(surface_seed=seed, resolution=CELLS)[1])[0][:, 2] for seed in (1, 2, 1)]
    np.testing.assert_array_equal(heights[0], heights[2])
    assert abs(np.corrcoef(heights[0], heights[1])[0, 1]) < 0.5
