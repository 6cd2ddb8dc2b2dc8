"""Geometry of scenes, and lines of sight of pixels."""

import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading.scenes import open_scene
from mitransient_lidar.rendering.describe import lines_of_sight
from mitransient_lidar.rendering.geometry import scene_geometry, thinned
from mitransient_lidar.transport.scene_parts import find_lidar_scene

HEIGHT, OFF_NADIR, INDEX, DEPTH = 200.0, np.radians(20.0), 1.34, 8.0
STILL = {"wind_speed": 0}


def of_scene(name="table1", **params):
    return scene_geometry(open_scene(name, STILL | params))


def bundle(geometry, name):
    return next(one for one in geometry.bundles if name in one.name)


def x_of(theta, *layers):
    """Return where a ray at an angle from the vertical, from above x = 0, is below layers (thickness, index) [m]."""
    sine = np.sin(theta)
    start = -HEIGHT * np.tan(OFF_NADIR) + HEIGHT * np.tan(theta)
    return start + sum(thickness * np.tan(np.arcsin(sine / index)) for thickness, index in layers)


def test_the_beam_passes_the_footprint_and_reaches_the_bottom_by_snells_law():
    geometry = of_scene()
    beam = bundle(geometry, "61 %")
    assert beam.angles == pytest.approx((10e-3, 10e-3), rel=1e-6)
    loop = beam.loops[0]
    assert loop[0] == pytest.approx(np.tile(geometry.lidar["laser"], (loop.shape[1], 1)))
    # Tangent-plane angles of +-5 mrad away from the axis and back.
    far, near = (OFF_NADIR + sign * np.arctan(5e-3) for sign in (1, -1))
    for level, layers in ((1, ()), (2, ((DEPTH, INDEX),))):
        assert loop[level, :, 2] == pytest.approx(-DEPTH * (level - 1), abs=1e-3)
        assert loop[level, :, 0].max() == pytest.approx(x_of(far, *layers), abs=2e-3)
        assert loop[level, :, 0].min() == pytest.approx(x_of(near, *layers), abs=2e-3)
    along, across = beam.size(1)
    assert along == pytest.approx(x_of(far) - x_of(near), abs=2e-3)
    assert across == pytest.approx(10e-3 * HEIGHT / np.cos(OFF_NADIR), rel=1e-3)
    # An unrefracted beam would be 1.1 m farther, far beyond the tolerance.
    assert x_of(far, (DEPTH, 1.0)) - x_of(far, (DEPTH, INDEX)) > 0.7


def test_pixels_share_the_view_and_the_box_holds_their_footprints():
    geometry = of_scene()
    pixels = [one for one in geometry.bundles if one.kind == "pixel"]
    assert [one.name for one in pixels] == ["pixel red", "pixel green", "pixel blue", "pixel black"]
    middles = [one.loops[0][-1, :, :2].mean(axis=0) for one in pixels]
    centre = np.mean(middles, axis=0)
    # Red and green are far (+x), red and blue left (+y).
    assert [tuple(middle > centre) for middle in middles] == [(1, 1), (1, 0), (0, 1), (0, 0)]
    low, high = geometry.box
    for one in geometry.bundles:
        for loop in one.loops:
            assert np.all((loop[1:] > low) & (loop[1:] < high))
    sea, bottom = geometry.reliefs
    assert (sea.is_sea, bottom.is_sea) == (True, False)
    assert sea.z == pytest.approx(np.zeros((129, 129)), abs=1e-3)
    assert bottom.z == pytest.approx(np.full((129, 129), -DEPTH), abs=1e-3)
    assert bottom.reflectance == pytest.approx(np.full((129, 129), 0.1), rel=1e-6)


def test_rays_bend_at_the_boundary_of_index_layers():
    """The lens of fresh water ends 2 m deep."""
    geometry = of_scene("fresh_water_lens")
    scene = open_scene("fresh_water_lens", STILL)
    water = next(one.interior_medium().water for one in scene.scene.shapes() if one.is_medium_transition())
    fresh, salt = map(float, water.index_layers.refractive_index)
    loop = bundle(geometry, "61 %").loops[0]
    far = OFF_NADIR + np.arctan(5e-3)
    assert loop[2, :, 2] == pytest.approx(-2.0, abs=1e-3)
    assert loop[2, :, 0].max() == pytest.approx(x_of(far, (2.0, fresh)), abs=2e-3)
    assert loop[3, :, 0].max() == pytest.approx(x_of(far, (2.0, fresh), (DEPTH - 2.0, salt)), abs=2e-3)
    assert geometry.layers == pytest.approx(np.array([[2.0, 0.6, 0.3]]))


@pytest.mark.slow
def test_rays_end_on_targets_and_reliefs_have_patches(lidar_scene):
    extra = {
        "ball": {"type": "sphere", "center": [1.0, 0.0, -4.0], "radius": 0.8},
        "sand": {"type": "seabed", "depth": 6.0, "reflectance": 0.2, "patches": "2 1 0.5 0.4", "centre_x": 2.0},
    }
    geometry = scene_geometry(open_scene(lidar_scene(bottom=None, extra=extra)))
    (ball,) = geometry.solids
    assert np.linalg.norm(ball.points - [1.0, 0.0, -4.0], axis=1) == pytest.approx(0.8, abs=1e-3)
    assert (ball.name, ball.share) == ("ball", 1.0)
    assert ball.reflectance == pytest.approx(0.5, abs=0.01)  # of Mitsuba's default BSDF
    # Corners of triangles are neighbours on the sphere.
    corners = ball.points[ball.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max() < 0.25
    bottom = next(one for one in geometry.reliefs if one.name == "sand")
    x, y = np.meshgrid(bottom.x, bottom.y)
    distance = np.hypot(x - 2.0, y - 1.0)
    assert bottom.reflectance[distance < 0.4] == pytest.approx(0.4, abs=1e-6)
    assert bottom.reflectance[distance > 0.6] == pytest.approx(0.2, abs=1e-6)
    ends = np.concatenate([loop[-1] for one in geometry.bundles for loop in one.loops])
    on_ball = ends[:, 2] > -5.5
    assert np.any(on_ball)
    assert np.linalg.norm(ends[on_ball] - [1.0, 0.0, -4.0], axis=1) == pytest.approx(0.8, abs=2e-3)
    assert ends[~on_ball, 2] == pytest.approx(-6.0, abs=1e-3)


def test_a_far_scene_is_drawn_in_its_own_coordinates():
    near, far = of_scene(), of_scene(aim_x=400.0, aim_y=-300.0)
    moved = [400.0, -300.0, 0.0]
    assert far.box == pytest.approx(near.box + moved, abs=2e-3)
    assert far.lidar["receiver"] == pytest.approx(near.lidar["receiver"] + moved, abs=1e-6)
    assert bundle(far, "61 %").loops[0] == pytest.approx(bundle(near, "61 %").loops[0] + moved, abs=3e-3)
    assert far.reliefs[1].x == pytest.approx(near.reliefs[1].x + 400.0, abs=2e-3)


def test_many_triangles_are_thinned():
    side = 101
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 10, side), np.linspace(0, 10, side)))
    points = np.stack([x, y, np.sin(x)], axis=1)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 1, corner + side], 1), corner[:, None] + [1, side + 1, side]])
    few, kept = thinned(faces, points, 2000)
    assert 500 < len(few) <= 2000
    # Points that are left are points of the mesh, over all of it.
    assert np.abs(kept[:, 2] - np.sin(kept[:, 0])).max() < 1e-12
    assert np.ptp(kept, axis=0)[:2].min() > 9.0
    # Of many leaves, whole ones are left.
    leaves = np.arange(3 * 3000).reshape(-1, 3)
    places = np.random.default_rng(1).uniform(size=(9000, 3))
    few, kept = thinned(leaves, places, 1000)
    assert len(few) == 1000
    assert {tuple(row) for row in kept[few].reshape(-1, 9)} <= {tuple(row) for row in places[leaves].reshape(-1, 9)}


def test_a_lidar_under_water_has_straight_rays(lidar_scene):
    below = {"to_world": mi.ScalarTransform4f().look_at([0, 0, -2], [0, 0, -6], [1, 0, 0])}
    geometry = scene_geometry(open_scene(lidar_scene(tx=below, rx=below)))
    for one in geometry.bundles:
        for loop in one.loops:
            ways = loop[-1] - loop[0]
            cosine = -ways[:, 2] / np.linalg.norm(ways, axis=1)
            assert np.degrees(np.arccos(cosine)).max() < 5.0
            assert loop[-1, :, 2] == pytest.approx(-8.0, abs=1e-2)


def test_an_imager_has_its_view_and_lines_between_its_pixels():
    geometry = of_scene(layout="128x128")
    kinds = [(one.kind, one.name) for one in geometry.bundles]
    assert kinds[:2] == [("pixel", "field of view of 16384 pixels"), ("lines", "lines between blocks of 8 × 8 pixels")]
    view, lines = geometry.bundles[:2]
    # Those at the rim of the circle have no length.
    assert len(lines.loops) == 2 * 15
    # The lines end within the circle of the view.
    assert lines.size(1) == pytest.approx(view.size(1), rel=0.02)


N, GROUP = 1.34, 1.364
METRE = 1e9 / C0  # time of a metre in air [ns]


def sights(build, tx=None, rx=None):
    scene = build(tx=tx, rx=rx, water={"group_index": GROUP})
    lidar = find_lidar_scene(scene, scene.sensors()[0])
    return lines_of_sight(lidar), lidar


@pytest.mark.slow
def test_small_pixels_look_along_their_centres(lidar_scene):
    """16 384 pixels: time and scale of depth at the angle of each centre, shares of a Gaussian beam."""
    found, lidar = sights(
        lidar_scene, rx={"layout": "128x128", "field_of_view_mrad": 20, "field_of_view_shape": "square"}
    )
    x, y = lidar.receiver.pixels.centres().T
    cosine = (np.cos(np.radians(20)) - np.sin(np.radians(20)) * x) / np.sqrt(1 + x**2 + y**2)
    np.testing.assert_allclose(np.cos(found.off_nadir), cosine, atol=1e-5)
    # The mean over a pixel's light lies within a third of the pixel's side, 0.05 mrad, from its centre.
    np.testing.assert_allclose(found.surface_time, 2 * METRE * 200 / cosine, atol=0.03)
    water = np.sqrt(1 - (1 - cosine**2) / N**2)
    np.testing.assert_allclose(found.depth_per_ns, water / (2 * GROUP * METRE), rtol=1e-5)
    edges = np.linspace(-0.01, 0.01, 129) / 5e-3
    side = np.diff(norm.cdf(edges))
    shares = np.outer(side, side).ravel()
    assert found.beam_share.sum() == pytest.approx(shares.sum(), rel=1e-3)
    bright = shares > 0.1 * shares.max()
    error = np.abs(found.beam_share / shares - 1)[bright]
    # Each pixel has a few rays, of which those near its edge may count in the next.
    assert error.max() < 0.2
    assert np.sqrt(np.mean(error**2)) < 0.1


def test_a_wide_pixel_looks_where_its_light_is(lidar_scene):
    """Quarters of a view about a Gaussian beam: means of the half-normal distribution, sqrt(2/pi) sigma."""
    found, _ = sights(lidar_scene, rx={"layout": "2x2", "field_of_view_mrad": 60, "field_of_view_shape": "square"})
    mean = np.sqrt(2 / np.pi) * 5e-3
    np.testing.assert_allclose(found.sight_x, mean * np.array([1, 1, -1, -1]), rtol=2e-3)
    np.testing.assert_allclose(np.abs(found.sight_y), mean, rtol=2e-3)
    np.testing.assert_allclose(found.beam_share, 0.25, rtol=2e-3)


@pytest.mark.parametrize("place", [(-50.0, 25.0, 190.0), (10.0, -30.0, 240.0)])
def test_laser_and_receiver_apart(lidar_scene, place):
    """A pencil beam, seen by a wide pixel elsewhere: paths of least time from the points that it lights."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f().look_at(origin=list(place), target=[0, 0, 0], up=[0, 0, 1])
    found, _ = sights(
        lidar_scene, tx={"divergence_mrad": 0.05}, rx={"to_world": to_world, "layout": "1x1", "field_of_view_mrad": 50}
    )
    sine = np.sin(np.radians(20))
    slope = sine / np.sqrt(N**2 - sine**2)
    receiver = np.array(place)
    for depth in (0.0, 2.0, 8.0):
        point = np.array([depth * slope, 0.0, -depth])
        out = 200 / np.cos(np.radians(20)) + GROUP * depth * np.sqrt(1 + slope**2)
        across = np.linalg.norm(receiver[:2] - point[:2])

        def bend(r, across=across, depth=depth):
            """Lengths in air and water of a path that crosses the surface at a distance from the point."""
            return np.hypot(receiver[2], across - r), np.hypot(depth, r)

        crossing = minimize_scalar(
            lambda r: bend(r)[0] + N * bend(r)[1], bounds=(0, across), method="bounded", options={"xatol": 1e-9}
        ).x
        air, water = bend(crossing if depth else 0.0)
        expected = METRE * (out + air + GROUP * water)
        assert found.surface_time[0] + depth / found.depth_per_ns[0] == pytest.approx(expected, abs=0.02)  # 2 mm
