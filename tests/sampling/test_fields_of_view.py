"""Fields of view and beams: samples are inside, uniform or Gaussian as stated, and weights add up to solid angles."""

import logging
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from frequencies import assert_counts
from kernel_arrays import array
from rows import each_row
from scipy.spatial import cKDTree
from significance import largest_z

from mitransient_lidar.transport.rng import pass_streams
from mitransient_lidar.transport.sensor.fov_shapes import Polygon, Rectangle, Sector, Strip
from mitransient_lidar.transport.sensor.pixels import HexPixels, LayoutPixels, MappedPixels, ShapedPixels
from mitransient_lidar.transport.sensor.receiver import SensorSampler

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
    rng = mi.PCG32(count, initstate=seed + significance.seed_shift)
    return mi.Point2f(rng.next_float32(), rng.next_float32())


def area_by_cells(field, gx_edges, gy_edges, fine=40):
    """Return the area of a field in each cell of a grid, counted with fine x fine points a cell."""
    sub = (np.arange(fine) + 0.5) / fine
    x = (gx_edges[:-1, None] + np.diff(gx_edges)[:, None] * sub).ravel()
    y = (gy_edges[:-1, None] + np.diff(gy_edges)[:, None] * sub).ravel()
    angle_x, angle_y = np.meshgrid(x, y, indexing="ij")
    inside = np.array(field.contains(array(angle_x.ravel()), array(angle_y.ravel()))).reshape(len(x), len(y))
    cells = inside.reshape(len(gx_edges) - 1, fine, len(gy_edges) - 1, fine).mean(axis=(1, 3))
    return cells * np.diff(gx_edges)[:, None] * np.diff(gy_edges)[None, :]


@pytest.mark.parametrize("name", SHAPES)
def test_samples_are_uniform_inside_and_the_area_is_right(name):
    field = SHAPES[name]
    angle_x, angle_y = field.sample(random_points())
    inside = np.array(field.contains(angle_x * (1 - 1e-6), angle_y * (1 - 1e-6)))
    assert inside.mean() > 1 - 1e-4  # edges to rounding
    angle_x_min, angle_x_max, angle_y_min, angle_y_max = field.bounds()
    edges = np.linspace(angle_x_min, angle_x_max, 13), np.linspace(angle_y_min, angle_y_max, 13)
    area = area_by_cells(field, *edges)
    assert area.sum() == pytest.approx(field.area, rel=3e-3)
    whole = area > 0.999 * area.max()
    # Areas of cells that the border cuts have the resolution of the count; others are exact.
    counts = np.histogram2d(np.array(angle_x), np.array(angle_y), bins=edges)[0]
    expected = COUNT * area / field.area
    assert_counts(counts[whole], expected[whole])
    # A wrong normalisation would change the level of all complete cells.
    total = expected[whole].sum()
    assert abs(counts[whole].sum() - total) < largest_z(COUNT) * np.sqrt(total)


def test_strip_is_part_of_the_circle():
    radius = 15 * MRAD
    edges = np.array([-2, -0.5, 0, 0.5, 2]) * radius
    areas = [Strip(radius, low, high).area for low, high in pairwise(edges)]
    assert sum(areas) == pytest.approx(np.pi * radius**2)
    # Half the disc less the central band: R^2 (pi/3 - sqrt(3)/4), as in the published 1x4 receiver.
    assert areas[0] == pytest.approx(radius**2 * (np.pi / 3 - np.sqrt(3) / 4))


def test_layout_follows_the_convention():
    """Row 0 is the far edge (+angle_x), column 0 the left one (+angle_y); red and green are far, red left."""
    pixels = LayoutPixels("2x2", 30 * MRAD, "circle")
    centres = dict(zip(pixels.names, np.sign(pixels.centres()).tolist(), strict=True))
    assert centres == {"red": [1, 1], "green": [1, -1], "blue": [-1, 1], "black": [-1, -1]}
    strips = LayoutPixels("1x4", 30 * MRAD, "circle")
    assert strips.names == ["red", "green", "blue", "black"]
    assert np.all(np.diff(strips.centres()[:, 0]) < 0)
    np.testing.assert_allclose(strips.centres()[:, 1], 0, atol=1e-8)
    np.testing.assert_array_equal(strips.centres(), LayoutPixels("4x1", 30 * MRAD, "circle").centres())


@pytest.mark.parametrize("layout", ["2x2", "1x4", "5x3"])
def test_every_point_of_the_field_has_one_pixel(layout):
    pixels = LayoutPixels(layout, 30 * MRAD, "circle")
    angle_x, angle_y = pixels.sample(random_points())
    pixel, count = pixels.pixel_at(angle_x, angle_y, mi.Float(0.5))
    inside = np.array(count)
    assert np.mean(inside == 1) > 1 - 1e-5
    shares = np.bincount(np.array(pixel), minlength=pixels.count) / COUNT
    if layout == "1x4":
        outer = (np.pi / 3 - np.sqrt(3) / 4) / np.pi
        expected = np.array([outer, 0.5 - outer, 0.5 - outer, outer])
        assert_counts(shares * COUNT, expected * COUNT, known=1)


def test_overlapping_pixels_each_get_their_whole_field(caplog):
    with caplog.at_level(logging.WARNING):
        pixels = ShapedPixels([Sector(5 * MRAD), Sector(5 * MRAD, centre=(4 * MRAD, 0.0))], ["a", "b"])
    assert "'a' and 'b' overlap" in caplog.text
    angle_x, angle_y = pixels.sample(random_points())
    rng = mi.PCG32(COUNT, initstate=5 + significance.seed_shift)
    pixel, count = pixels.pixel_at(angle_x, angle_y, rng.next_float32())
    # Weight of a sample: pixels there over density, and the density is their number over the area.
    weight = np.array(dr.select(count > 0, count / (count / pixels.area), 0))
    for index, field in enumerate(pixels.fields):
        samples = weight * (np.array(pixel) == index)
        error = samples.std() / np.sqrt(COUNT)
        assert abs(samples.mean() - field.area) < largest_z(COUNT, 2) * error


@each_row(*SHAPES)
@each_row(0.1 * MRAD, 3 * MRAD)
def test_no_point_of_a_field_is_out_of_its_reach(reach, name):
    """Points up to `reach` from points of the field are near it, and few of those twice as far from all of them are."""
    field = SHAPES[name]
    rng = np.random.default_rng(8)
    inside = np.stack([np.array(g, dtype=np.float64) for g in field.sample(random_points(count=2**14))], axis=1)
    angle = rng.uniform(0, 2 * np.pi, len(inside))
    moved = inside + 0.999 * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert field.comes_near(*moved.T, reach).all()
    apart = rng.uniform(-25 * MRAD, 25 * MRAD, (4000, 2))
    distance, _ = cKDTree(inside).query(apart)
    # The surroundings of an edge, and of a corner, are taken wider by less than the reach.
    assert field.comes_near(*apart.T, reach)[distance > 2.5 * reach + 0.5 * MRAD].mean() < 0.02


def hexagon_outline(centre, side):
    """Return the corners of a hexagon with two of them along angle_x."""
    angles = np.radians(60 * np.arange(6))
    return [(centre[0] + side * np.cos(a), centre[1] + side * np.sin(a)) for a in angles]


@pytest.mark.parametrize("fill_factor", [pytest.param(1.0, marks=pytest.mark.slow), 0.4])
def test_hexagons_are_those_of_a_drawing(fill_factor):
    """Each of 19 against a polygon with its corners; alike in area, uniform inside."""
    pixels = HexPixels("hex19", 30 * MRAD, fill_factor)
    side = 15 * MRAD / np.sqrt(19) * np.sqrt(fill_factor)
    angle_x, angle_y = pixels.sample(random_points())
    pixel, count = (np.array(a) for a in pixels.pixel_at(angle_x, angle_y, mi.Float(0)))
    assert np.mean(count == 1) > 1 - 1e-5
    shares = np.bincount(pixel, minlength=19)
    assert_counts(shares, COUNT / 19, known=1)
    # Random points of the whole square fall into the hexagon that they are drawn in, or into none.
    rng = mi.PCG32(COUNT, initstate=9 + significance.seed_shift)
    x, y = (30 * MRAD * (rng.next_float32() - 0.5) for _ in range(2))
    pixel, count = (np.array(a) for a in pixels.pixel_at(x, y, mi.Float(0)))
    drawn = np.full(COUNT, -1)
    for index, centre in enumerate(pixels.centres()):
        polygon = Polygon(hexagon_outline(centre, side))
        assert polygon.area * 19 == pytest.approx(pixels.area, rel=1e-6)
        drawn[np.array(polygon.contains(x, y))] = index
        # Uniform: quarters of the hexagon, and its middle.
        inside = np.array(polygon.contains(angle_x, angle_y))
        here = np.stack([np.array(angle_x)[inside] - centre[0], np.array(angle_y)[inside] - centre[1]], axis=1)
        parts = [np.mean(here[:, 0] > 0), np.mean(here[:, 1] > 0), np.mean(np.abs(here[:, 0]) < 0.5 * side)]
        limit = largest_z(COUNT, 3 * 19) * 0.5 / np.sqrt(inside.sum())
        assert np.abs(np.array(parts) - [0.5, 0.5, 2 / 3]).max() < limit
    assert np.mean(drawn != np.where(count > 0, pixel.astype(int), -1)) < 1e-5


@pytest.mark.parametrize("layout", ["hex1", "hex7", "hex1027"])
def test_hexagons_fill_the_same_share_of_their_circle_whatever_their_number(layout):
    """3 sqrt(3) / (2 pi) of it, and the farthest corners lie on the circle."""
    pixels = HexPixels(layout, 30 * MRAD)
    assert pixels.area == pytest.approx(1.5 * np.sqrt(3) * (15 * MRAD) ** 2)
    angle_x, angle_y = (np.array(g, dtype=np.float64) for g in pixels.sample(random_points()))
    assert 14.9 * MRAD < np.hypot(angle_x, angle_y).max() <= 15.0001 * MRAD
    centres = pixels.centres()
    pixel, count = pixels.pixel_at(*(array(g) for g in centres.T), mi.Float(0))
    np.testing.assert_array_equal(np.array(pixel), np.arange(pixels.count))
    assert np.all(np.array(count) == 1)
    # Rows from far to near, and in a row from left (+angle_y) to right.
    order = np.lexsort((-np.round(centres[:, 1], 9), -np.round(centres[:, 0], 9)))
    np.testing.assert_array_equal(order, np.arange(pixels.count))


def test_a_map_has_a_pixel_for_each_label():
    """Labels 2, 5 and 9 in cells of 10 mrad x 7.5 mrad: row 0 is far, column 0 left (+angle_y)."""
    labels = np.array([[5, 5, 0, 2], [0, 9, 0, 2], [9, 9, 0, 0]])
    pixels = MappedPixels(labels, 30 * MRAD)
    assert pixels.names == ["label2", "label5", "label9"]
    assert pixels.area == pytest.approx(7 * 75 * MRAD**2)
    centres = [[5, -11.25], [10, 7.5], [-10 + 10 / 3, 3.75 + 2.5]]
    np.testing.assert_allclose(pixels.centres(), np.array(centres) * MRAD, atol=1e-12)
    angle_x, angle_y = pixels.sample(random_points())
    pixel, count = (np.array(a) for a in pixels.pixel_at(angle_x, angle_y, mi.Float(0)))
    assert np.mean(count == 1) > 1 - 1e-5
    edges = np.linspace(-15, 15, 7) * MRAD, np.linspace(-15, 15, 9) * MRAD
    counts = np.histogram2d(np.array(angle_x), np.array(angle_y), bins=edges)[0]
    expected = COUNT / 28 * np.repeat(np.repeat(labels[::-1, ::-1] > 0, 2, axis=0), 2, axis=1)
    lit = expected > 0
    assert counts[~lit].sum() <= 1e-5 * COUNT
    assert_counts(counts[lit], expected[lit])
    assert_counts(np.bincount(pixel, count), COUNT * np.array([2, 2, 3]) / 7)
    outside = pixels.pixel_at(array([0.0151, -0.0151, 0.0, 0.0]), array([0.0, 0.0, 0.0151, -0.0151]), mi.Float(0))
    assert np.all(np.array(outside[1]) == 0)


@pytest.mark.parametrize(("view_mrad", "aim_x"), [(2.0, 0.0), (15.0, 50.0), (30.0, 1.0)])
def test_view_weights_add_up_to_the_solid_angle(view_mrad, aim_x):
    """Half the samples follow the laser's footprint, centred or beside or outside of the view: no bias from it."""
    receiver = mi.load_dict({"type": "multipixel_receiver", "field_of_view_mrad": view_mrad}).receiver
    transmitter = mi.load_dict({"type": "lidar_transmitter", "aim_x": aim_x})
    view = SensorSampler(receiver, transmitter)
    start = view.sample(dr.arange(mi.UInt32, COUNT), COUNT, pass_streams(5, 0, COUNT))
    half = 0.5e-3 * view_mrad
    solid_angle = 2 * np.pi * (1 - 1 / np.sqrt(1 + half**2))
    collection = 0.025 * 0.9 * 0.9
    weight = np.array(start.weight, dtype=np.float64)
    # Quadrants of the circle have a quarter each; 1e-5 for rounding where all weights are alike.
    pixel, expected = np.array(start.pixel), 0.25 * collection * solid_angle
    for index in range(4):
        samples = weight * (pixel == index) * COUNT
        error = samples.std() / np.sqrt(COUNT)
        assert abs(samples.mean() - expected) < largest_z(COUNT, 4) * error + 1e-5 * expected
        assert error < 4e-3 * expected
    error = weight.std() * np.sqrt(COUNT)
    assert abs(weight.sum() - 4 * expected) < largest_z(COUNT) * error + 1e-5 * expected
