"""Fields of view and beams: samples are inside, uniform or Gaussian as stated, and weights add up to solid angles."""

import logging
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2

from mitransient_lidar.transport.fields import Polygon, Rectangle, Sector, Strip
from mitransient_lidar.transport.pixels import LayoutPixels, ShapedPixels
from mitransient_lidar.transport.receiving import ViewSampler
from mitransient_lidar.transport.streams import pass_streams

MRAD = 1e-3
SHAPES = {
    "circle": Sector(15 * MRAD, centre=(2 * MRAD, -3 * MRAD)),
    "ring": Sector(15 * MRAD, 9 * MRAD),
    "sector": Sector(15 * MRAD, 4 * MRAD, np.radians(200.0), np.radians(250.0)),
    "rectangle": Rectangle(-4 * MRAD, 9 * MRAD, -1 * MRAD, 2 * MRAD),
    "strip": Strip(15 * MRAD, 7.5 * MRAD, 30 * MRAD),
    "inner_strip": Strip(15 * MRAD, -7.5 * MRAD, 0.0),
    "triangle": Polygon([(0, 0), (8 * MRAD, 1 * MRAD), (2 * MRAD, 9 * MRAD)]),
    "concave": Polygon([(0, 0), (10 * MRAD, 0), (10 * MRAD, 10 * MRAD), (5 * MRAD, 2 * MRAD), (0, 10 * MRAD)]),
}
COUNT = 2**20


def random_points(seed=1, count=COUNT):
    rng = mi.PCG32(count, initstate=seed)
    return mi.Point2f(rng.next_float32(), rng.next_float32())


def area_by_cells(field, gx_edges, gy_edges, fine=40):
    """Return the area of a field in each cell of a grid, counted with fine x fine points a cell."""
    sub = (np.arange(fine) + 0.5) / fine
    x = (gx_edges[:-1, None] + np.diff(gx_edges)[:, None] * sub).ravel()
    y = (gy_edges[:-1, None] + np.diff(gy_edges)[:, None] * sub).ravel()
    gx, gy = np.meshgrid(x, y, indexing="ij")
    inside = np.array(field.contains(mi.Float(gx.ravel()), mi.Float(gy.ravel()))).reshape(len(x), len(y))
    cells = inside.reshape(len(gx_edges) - 1, fine, len(gy_edges) - 1, fine).mean(axis=(1, 3))
    return cells * np.diff(gx_edges)[:, None] * np.diff(gy_edges)[None, :]


@pytest.mark.parametrize("name", SHAPES)
def test_samples_are_uniform_inside_and_the_area_is_right(name):
    field = SHAPES[name]
    gx, gy = field.sample(random_points())
    inside = np.array(field.contains(gx * (1 - 1e-6), gy * (1 - 1e-6)))
    assert inside.mean() > 1 - 1e-4  # edges to rounding
    gx_min, gx_max, gy_min, gy_max = field.bounds()
    edges = np.linspace(gx_min, gx_max, 13), np.linspace(gy_min, gy_max, 13)
    area = area_by_cells(field, *edges)
    assert area.sum() == pytest.approx(field.area, rel=3e-3)
    whole = area > 0.999 * area.max()
    # Cells that the border cuts are known to the fineness of their count; whole ones exactly.
    counts = np.histogram2d(np.array(gx), np.array(gy), bins=edges)[0]
    expected = COUNT * area / field.area
    statistic = np.sum((counts - expected)[whole] ** 2 / expected[whole])
    assert chi2.sf(statistic, whole.sum()) > 1e-4
    # A wrong normalisation shows in the level of the whole cells together.
    total = expected[whole].sum()
    assert abs(counts[whole].sum() - total) < 4 * np.sqrt(total)


def test_strip_is_part_of_the_circle():
    radius = 15 * MRAD
    edges = np.array([-2, -0.5, 0, 0.5, 2]) * radius
    areas = [Strip(radius, low, high).area for low, high in pairwise(edges)]
    assert sum(areas) == pytest.approx(np.pi * radius**2)
    # Half the disc less the central band: R^2 (pi/3 - sqrt(3)/4), as in the published 1x4 receiver.
    assert areas[0] == pytest.approx(radius**2 * (np.pi / 3 - np.sqrt(3) / 4))


def test_layout_follows_the_convention():
    """Row 0 is the far edge (+gx), column 0 the -gy edge; red and green are far, red on the -gy side."""
    pixels = LayoutPixels("2x2", 30 * MRAD, "circle")
    centres = dict(zip(pixels.names, np.sign(pixels.centres()).tolist(), strict=True))
    assert centres == {"red": [1, -1], "green": [1, 1], "blue": [-1, -1], "black": [-1, 1]}
    strips = LayoutPixels("1x4", 30 * MRAD, "circle")
    assert strips.names == ["red", "green", "blue", "black"]
    assert np.all(np.diff(strips.centres()[:, 0]) < 0)
    np.testing.assert_allclose(strips.centres()[:, 1], 0, atol=1e-8)
    np.testing.assert_array_equal(strips.centres(), LayoutPixels("4x1", 30 * MRAD, "circle").centres())


@pytest.mark.parametrize("layout", ["2x2", "1x4", "5x3"])
def test_every_point_of_the_field_has_one_pixel(layout):
    pixels = LayoutPixels(layout, 30 * MRAD, "circle")
    gx, gy = pixels.sample(random_points())
    pixel, count = pixels.pixel_at(gx, gy, mi.Float(0.5))
    inside = np.array(count)
    assert np.mean(inside == 1) > 1 - 1e-5
    shares = np.bincount(np.array(pixel), minlength=pixels.count) / COUNT
    if layout == "1x4":
        outer = (np.pi / 3 - np.sqrt(3) / 4) / np.pi
        expected = np.array([outer, 0.5 - outer, 0.5 - outer, outer])
        assert np.all(np.abs(shares - expected) < 4 * np.sqrt(expected / COUNT))


def test_overlapping_pixels_each_get_their_whole_field(caplog):
    with caplog.at_level(logging.WARNING):
        pixels = ShapedPixels([Sector(5 * MRAD), Sector(5 * MRAD, centre=(4 * MRAD, 0.0))], ["a", "b"])
    assert "'a' and 'b' overlap" in caplog.text
    gx, gy = pixels.sample(random_points())
    rng = mi.PCG32(COUNT, initstate=5)
    pixel, count = pixels.pixel_at(gx, gy, rng.next_float32())
    # Weight of a sample: pixels there over density, and the density is their number over the area.
    weight = np.array(dr.select(count > 0, count / (count / pixels.area), 0))
    for index, field in enumerate(pixels.fields):
        samples = weight * (np.array(pixel) == index)
        error = samples.std() / np.sqrt(COUNT)
        assert abs(samples.mean() - field.area) < 4 * error


def test_neighbours_are_no_overlap(caplog):
    ShapedPixels([Strip(5 * MRAD, -5 * MRAD, 0.0), Strip(5 * MRAD, 0.0, 5 * MRAD)], ["near", "far"])
    assert caplog.text == ""


@pytest.mark.parametrize("view_mrad", [2.0, 15.0, 30.0, 60.0])
@pytest.mark.parametrize("shot_x", [0.0, 1.0, 50.0])
def test_view_weights_add_up_to_the_solid_angle(view_mrad, shot_x):
    """Half the samples follow the laser's footprint, centred or beside or outside of the view: no bias from it."""
    receiver = mi.load_dict({"type": "multipixel_receiver", "field_of_view_mrad": view_mrad}).receiver
    transmitter = mi.load_dict({"type": "lidar_transmitter", "shot_x": shot_x})
    view = ViewSampler(receiver, transmitter)
    start = view.sample(dr.arange(mi.UInt32, COUNT), COUNT, pass_streams(5, 0, COUNT))
    half = 0.5e-3 * view_mrad
    solid_angle = 2 * np.pi * (1 - 1 / np.sqrt(1 + half**2))
    collection = 0.025 * 0.9 * 0.9
    weight = np.array(start.weight, dtype=np.float64)
    assert weight.sum() == pytest.approx(collection * solid_angle, rel=2e-3)
    # Quadrants of the circle have a quarter each.
    quarters = np.bincount(np.array(start.pixel), weight, 4) / weight.sum()
    np.testing.assert_allclose(quarters, 0.25, atol=2e-3)


@pytest.mark.parametrize("profile", ["gaussian", "top_hat"])
def test_beam_samples_follow_its_density(profile):
    beam = mi.load_dict({"type": "lidar_transmitter", "beam_profile": profile, "divergence_mrad": 10.0})
    gx, gy = (np.array(g) for g in beam.sample_tangent(random_points()))
    edges = np.linspace(-12, 12, 25) * MRAD
    counts = np.histogram2d(gx, gy, bins=(edges, edges))[0]
    middle = (edges[:-1] + edges[1:]) / 2
    sub = (np.arange(8) + 0.5) / 8 - 0.5
    fine = (middle[:, None] + sub * (edges[1] - edges[0])).ravel()
    x, y = np.meshgrid(fine, fine, indexing="ij")
    density = np.array(beam.tangent_density(mi.Float(x.ravel()), mi.Float(y.ravel()))).reshape(24, 8, 24, 8)
    expected = COUNT * density.mean(axis=(1, 3)) * (edges[1] - edges[0]) ** 2
    used = expected > 50
    if profile == "top_hat":
        used &= density.min(axis=(1, 3)) == density.max(axis=(1, 3))  # cells that the rim does not cut
    statistic = np.sum((counts - expected)[used] ** 2 / expected[used])
    assert chi2.sf(statistic, used.sum()) > 1e-4


@pytest.mark.parametrize("profile", ["gaussian", "top_hat"])
def test_intensity_integrates_to_the_energy(profile):
    """Over solid angle, at a divergence where (1 + g^2)^(-3/2) matters: 5 mJ times the efficiency of 0.9."""
    beam = mi.load_dict({"type": "lidar_transmitter", "beam_profile": profile, "divergence_mrad": 400.0})
    ticks = (np.arange(1500) + 0.5) / 1500 * 2.6 - 1.3
    gx, gy = (g.ravel() for g in np.meshgrid(ticks, ticks))
    intensity = np.array(beam.intensity(beam.pose.direction(mi.Float(gx), mi.Float(gy))), dtype=np.float64)
    energy = np.sum(intensity * (1 + gx**2 + gy**2) ** -1.5) * (ticks[1] - ticks[0]) ** 2
    assert energy == pytest.approx(4.5e-3, rel=1e-3)


def test_divergence_definitions_describe_one_beam():
    """Sigma 5 mrad: e^-1/2 full width 10, full width at half maximum 11.774, e^-2 full width 20 mrad."""
    for name, value in (("divergence_mrad", 10.0), ("divergence_fwhm_mrad", 11.7741), ("divergence_1e2_mrad", 20.0)):
        beam = mi.load_dict({"type": "lidar_transmitter", name: value})
        ratio = beam.tangent_density(mi.Float(5e-3), mi.Float(0)) / beam.tangent_density(mi.Float(0), mi.Float(0))
        assert float(ratio[0]) == pytest.approx(np.exp(-0.5), rel=1e-4)
