"""Optical blur: where light falls on the detector, against the integral of the point-spread function over pixels."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from frequencies import assert_counts
from rows import each_case
from scipy.special import erf
from significance import assert_same, largest_z

from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.sensor.receiver import MeasuredPointSpread, SensorSampler

MRAD = 1e-3
COUNT = 2**20
COLLECTION = 0.025 * 0.9 * 0.9
SQUARE = {"layout": "4x4", "field_of_view_mrad": 16.0, "field_of_view_shape": "square", "imager": False}


def energies(receiver, transmitter):
    """Return each pixel's share of a Gaussian spot in the laser's place, its standard error, and the sampler."""
    plugin = mi.load_dict({"type": "multipixel_receiver", **receiver})
    view = SensorSampler(plugin.receiver, mi.load_dict({"type": "lidar_transmitter", **transmitter}))
    start = view.sample(dr.arange(mi.UInt32, COUNT), COUNT, pass_streams(11, 0, COUNT))
    angle_x, angle_y, _ = plugin.receiver.pose.tangent(start.direction)
    x, y = (angle_x - view.centre[0]) / view.sigma, (angle_y - view.centre[1]) / view.sigma
    spot = dr.exp(-0.5 * (x * x + y * y)) / (2 * np.pi * view.sigma**2)
    # Divided by the solid angle per area of the tangent plane, so that the spot sums to 1.
    per_area = (1 + angle_x * angle_x + angle_y * angle_y) ** 1.5
    sample = np.array(start.weight * spot * per_area, dtype=np.float64) * COUNT / COLLECTION
    pixel = np.array(start.pixel)
    count = plugin.receiver.pixels.count
    mean = np.bincount(pixel, sample, count) / COUNT
    error = np.sqrt((np.bincount(pixel, sample**2, count) / COUNT - mean**2) / COUNT)
    return mean, error, view


def gaussian_shares(centre, sigma, edges):
    """Return the shares of a round Gaussian in rectangles between edges [mrad], from far to near and left to right."""
    x, y = (np.diff(0.5 * erf((edges - g) / (np.sqrt(2) * sigma))) for g in centre)
    return x[::-1, None] * y[::-1]


@each_case(
    (0.1, 0.7, 1.5, True),  # nearly a point, off the middle
    (4.0, 0.7, 3.0, True),  # beam and blur alike
    (0.1, 2.1, 4.0, True),  # 9.9 mrad off the axis: only blur brings the light into the field of view
    (10.0, 4.2, 2.0, False),  # 20 mrad off the axis: too little to sample the footprint
)
def test_gaussian_blur_spreads_a_beam_as_its_integral_over_pixels(divergence, shift, blur, footprint):
    mean, error, view = energies({**SQUARE, "blur_mrad": blur}, {"divergence_mrad": divergence, "aim_y": shift})
    assert view.use_footprint == footprint
    centre = 1e3 * view.centre
    expected = gaussian_shares(centre, np.hypot(0.5 * divergence, blur), np.linspace(-8, 8, 5)).ravel()
    known = (expected > 0.01 * expected.sum()) & (error < 0.03 * expected)
    assert expected[known].sum() > 0.9 * expected.sum()
    assert np.all(np.abs(mean - expected)[known] < largest_z(COUNT, 16) * error[known])


def test_what_leaves_the_field_of_view_is_lost_and_no_more():
    """A field of view of 8 sigma keeps everything; one whose edge is at the beam keeps half."""
    narrow = {"divergence_mrad": 0.2}
    wide, error, _ = energies({"layout": "2x2", "field_of_view_mrad": 16.0, "blur_mrad": 1.0}, narrow)
    assert np.all(np.abs(wide - 0.25) < largest_z(COUNT, 4) * error)
    assert np.all(error < 2e-3)
    edge = {
        "a": {"type": "pixel_fov", "shape": "rectangle", "width_mrad": 40.0, "height_mrad": 20.0, "angle_x_mrad": 10.0}
    }
    half, error, _ = energies({**edge, "blur_mrad": 1.0}, narrow)
    assert abs(half[0] - 0.5) < largest_z(COUNT) * error[0]
    assert error[0] < 5e-3


def test_measured_blur_puts_light_where_the_image_does(tmp_path):
    """Three of four parts on the far left and one in the middle: row 0 is +angle_x, column 0 is +angle_y."""
    image = np.zeros((5, 5))
    image[0, 0], image[2, 2] = 3.0, 1.0
    np.save(tmp_path / "psf.npy", image)
    receiver = {"layout": "3x3", "field_of_view_mrad": 6.0, "field_of_view_shape": "square"}
    blur = {"blur_file": str(tmp_path / "psf.npy"), "blur_file_mrad": 5.5}
    share, error, _ = energies({**receiver, **blur}, {"divergence_mrad": 0.01})
    assert np.all(np.abs(share - [0.75, 0, 0, 0, 0.25, 0, 0, 0, 0]) <= largest_z(COUNT, 9) * error)
    assert np.all(error < 4e-3)


@pytest.mark.slow
def test_a_pixel_looks_where_its_light_comes_from(tmp_path):
    """Light is moved by (+3, -5) mrad: a pixel on the axis sees what is at (-3, +5), with or without a laser there."""
    image = np.zeros((15, 15))
    image[4, 12] = 1.0
    np.save(tmp_path / "psf.npy", image)
    blur = {"blur_file": str(tmp_path / "psf.npy"), "blur_file_mrad": 15.0}
    for aim_y in (0.0, 30.0):
        receiver = mi.load_dict({"type": "pixel_fov", "field_of_view_mrad": 0.2, **blur}).receiver
        view = SensorSampler(receiver, mi.load_dict({"type": "lidar_transmitter", "aim_y": aim_y}))
        start = view.sample(dr.arange(mi.UInt32, COUNT), COUNT, pass_streams(2, 0, COUNT))
        seen = np.array(start.weight) > 0
        angle_x, angle_y, _ = (np.array(g, dtype=np.float64)[seen] for g in receiver.pose.tangent(start.direction))
        for g, expected in ((angle_x, -3e-3), (angle_y, 5e-3)):
            assert np.ptp(g) < 1.3e-3
            assert abs(g.mean() - expected) < 1e-6 + largest_z(g.size) * g.std() / np.sqrt(g.size)


def test_displacements_follow_the_measured_image():
    """Cells of an image that is taller than wide, in each its share of the light, uniform inside."""
    values = np.random.default_rng(4).uniform(0, 1, (12, 7)) * (np.arange(7) % 3 != 1)
    values[0] = values[-1] = 0
    rng = mi.PCG32(COUNT, initstate=6 + significance.seed_shift)
    angle_x, angle_y = MeasuredPointSpread(values, 7 * MRAD).sample(mi.Point2f(rng.next_float32(), rng.next_float32()))
    fine = np.histogram2d(
        -np.array(angle_x), -np.array(angle_y), bins=(24, 14), range=((-6e-3, 6e-3), (-3.5e-3, 3.5e-3))
    )[0]
    expected = COUNT * np.repeat(np.repeat(values / values.sum() / 4, 2, axis=0), 2, axis=1)
    lit = expected > 50
    assert fine[expected == 0].sum() <= 1e-4 * COUNT  # edges to rounding
    assert_counts(fine[lit], expected[lit])


def test_rays_for_mitsubas_integrators_are_blurred():
    """Of a small pixel the rays are as wide as the blur, and carry the pixel's solid angle."""
    pixel = {"type": "pixel_fov", "field_of_view_mrad": 0.1, "blur_mrad": 3.0}
    plugin = mi.load_dict(pixel)
    rng = mi.PCG32(COUNT, initstate=1 + significance.seed_shift)
    u, v = (mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(2))
    ray, weight = plugin.sample_ray(0.0, mi.Float(0.5), u, v)
    angle_x, angle_y, _ = (np.array(g, dtype=np.float64) for g in plugin.receiver.pose.tangent(ray.d))
    for g in (angle_x, angle_y):
        assert g.std() == pytest.approx(3e-3, rel=largest_z(COUNT, 2) / np.sqrt(2 * COUNT) + 1e-4)
    assert np.array(weight).mean() == pytest.approx(COLLECTION * np.pi * 0.05e-3**2, rel=1e-3, abs=0)


@pytest.mark.long
def test_a_blurred_receiver_sees_the_sharp_image_convolved(lidar_scene, passes):
    """Bottom and water, all scattering and waves of light included: 1x3 pixels against a fine sharp imager."""
    # Beyond the field lies light that is 14 mrad, 4.7 sigma, from the nearest pixel: 1e-6 of it is seen.
    pixels, field, sigma = 40, 40.0, 3.0
    sharp = {"layout": f"{pixels}x{pixels}", "field_of_view_mrad": field, "field_of_view_shape": "square"}
    blurred = {"layout": "3x3", "field_of_view_mrad": 12.0, "field_of_view_shape": "square", "imager": False}
    kind = {
        "integrator": {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14},
        "tx": {"divergence_mrad": 4.0},
        "film": {"bin_width_ns": 160.0, "bin_count": 1},
        "sea": {"slope_variance": "0.02"},
    }
    image = passes(lidar_scene(rx=sharp, **kind), 12)[..., 0]
    measured = passes(lidar_scene(rx={**blurred, "blur_mrad": sigma}, **kind), 12, 100)[..., 0]
    ticks = (np.arange(pixels) + 0.5) * field / pixels - 0.5 * field
    edges = np.linspace(-6, 6, 4)
    share = np.diff(0.5 * erf((edges[:, None] - ticks) / (np.sqrt(2) * sigma)), axis=0)
    expected = np.einsum("ax,by,pxy->pab", share[::-1, ::-1], share[::-1, ::-1], image).reshape(12, 9)
    # Light within a cell of 1 mrad counts at its middle: up to 1 / 24 mrad^2 more variance than 9 + 4 mrad^2.
    assert_same(measured, expected, error=0.01, bias=4e-3)
