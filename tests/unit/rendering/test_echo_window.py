"""Lines of sight of pixels: against closed forms, paths of least time, and averages over the light in a pixel."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from mitransient_lidar.core.constants import C0
from mitransient_lidar.rendering.describe import lines_of_sight
from mitransient_lidar.transport.scene_parts import find_lidar_scene

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
