"""Free flight and optical depth through layers against float64 arithmetic and exact transmittance."""

import numpy as np
import pytest
from frequencies import assert_uniform, misfit, uniform_counts
from kernel_arrays import array
from rows import each_row
from significance import largest_chi2

from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.transport.medium.free_flight import LayeredFlight

#: Edges are float32 numbers, so that NumPy and Dr.Jit place a depth on the same side of them.
COLUMNS = {
    "one": WaterColumn.from_text("0", "0.3", "0.15", "0.006"),
    "two": WaterColumn.from_text("0, 3", "0.9, 0.5", "0.7, 0.35", "0.014, 0.007"),
    "five": WaterColumn.from_text("0, 1, 2.5, 4, 7", "0.2, 1.5, 0.1, 0.8, 0.4", "0.1", "0.002"),
    "clear_between": WaterColumn.from_text("0, 2, 5", "0.3, 0, 0.6", "0", "0"),
    "thousand": WaterColumn.from_text(
        np.arange(1000) / 64, 0.3 + 0.2 * np.sin(np.arange(1000) * 0.05), np.full(1000, 0.05), np.full(1000, 0.001)
    ),
}
#: Vertical components of directions, positive downwards: steep, slanted, nearly and exactly horizontal.
DIRECTIONS = np.float32([1.0, 0.6, 1e-3, 0.0, -1e-6, -0.05, -1.0])
#: Depths of starts: a wave crest, the mean surface, inside layers, on an edge, in the last layer.
DEPTHS = [-0.5, 0.0, 0.7, 2.0, 3.0, 4.9, 12.0]


def rounding(column, depth, downward, length):
    """Return the error of optical depths from float32 depths: their rounding over the slope, times the range of c."""
    reach = np.abs(depth) + np.abs(downward) * length + column.layer_tops.max()
    blur = np.finfo(np.float32).eps * reach / np.maximum(np.abs(downward), np.finfo(np.float32).eps)
    # The error of a level ray is at most that of all its length in the wrong layer.
    return 4 * np.minimum(blur, length) * np.ptp(column.attenuation) * (downward != 0)


def rays(values):
    """Return depths, vertical components and `values` of rays from all depths in all directions, in float32."""
    grid = np.meshgrid(np.float32(DEPTHS), DIRECTIONS, values)
    return [one.ravel().astype(np.float32).astype(np.float64) for one in grid]


def exact(column, depth, downward, length):
    return column.optical_depth(depth, np.asarray(depth) + downward * np.asarray(length), length)


@each_row(*COLUMNS)
def test_optical_depth_is_the_sum_over_the_layers(name):
    """A difference of cumulative depths over the slope would be 0/0 for level rays, and noise below a slope of 1e-3."""
    column = COLUMNS[name]
    depth, downward, length = rays([0.01, 0.5, 3.0, 9.0])
    got = LayeredFlight(column).optical_depth(array(depth), array(downward), array(length))
    expected = exact(column, depth, downward, length)
    tolerance = 2e-5 * (expected + 0.1) + rounding(column, depth, downward, length)
    assert np.all(np.abs(np.array(got) - expected) <= tolerance)


@each_row(*COLUMNS)
def test_distance_inverts_the_optical_depth(name):
    column = COLUMNS[name]
    depth, downward, wanted = rays([1e-3, 0.1, 1.0, 4.0])
    flight = LayeredFlight(column)
    distance = np.array(flight.distance(array(depth), array(downward), array(wanted)), dtype=np.float64)
    reached = np.isfinite(distance)
    assert not np.any(np.isnan(distance))
    assert np.all(distance > 0)
    found = depth[reached], downward[reached], distance[reached]
    got = exact(column, *found)
    tolerance = 1e-4 * wanted[reached] + 2e-6 + rounding(column, *found)
    assert np.all(np.abs(got - wanted[reached]) <= tolerance)
    # Only level rays in clear water never reach an optical depth.
    never = (column.attenuation[column.layer_at(depth)] == 0) & (downward == 0)
    np.testing.assert_array_equal(~reached, never)


@pytest.mark.parametrize("name", COLUMNS)
def test_flights_follow_the_transmittance(name):
    """1 - transmittance of the sampled distance is uniform; a sampler that ignores an edge fails clearly."""
    column = COLUMNS[name]
    flight = LayeredFlight(column)
    random = np.random.default_rng(11)
    for depth, downward in ((0.0, 0.95), (6.0, -0.8), (-0.4, 0.3), (2.5, 1e-3), (1.7, 0.0)):
        drawn = -np.log(1 - random.random(4_000 if name == "thousand" else 50_000))
        distance = np.array(flight.distance(array(depth), array(downward), array(drawn)), dtype=np.float64)
        if name == "clear_between" and depth == 2.5:
            # Nearly level in the clear layer, 2.5 m above its lower edge: long, but finite.
            assert distance.min() >= 2.5 / downward * (1 - 1e-6)
        uniform = -np.expm1(-exact(column, float(np.float32(depth)), float(np.float32(downward)), distance))
        assert_uniform(uniform, 40)


def test_the_test_of_flights_sees_a_wrong_layer():
    """Negative control: distances of the first layer's attenuation alone."""
    drawn = -np.log(1 - np.random.default_rng(11).random(200_000))
    uniform = -np.expm1(-exact(COLUMNS["two"], 0.0, 0.95, drawn / 0.9))
    statistic, freedom = misfit(uniform_counts(uniform), 2000)
    assert statistic > largest_chi2(freedom - 1)


def test_light_that_ends_in_clear_water_goes_on_for_ever():
    column = WaterColumn.from_text("0, 2", "0.5, 0", "0", "0")
    flight = LayeredFlight(column)
    # 0.5 per metre over 2 m straight down is an optical depth of at most 1.
    distance = np.array(flight.distance(array([0, 0, 3]), array([1, 1, 1]), array([0.9, 1.1, 0.1])))
    np.testing.assert_allclose(distance, [1.8, np.inf, np.inf], rtol=1e-6)
    clear = LayeredFlight(WaterColumn.from_text("0", "0", "0", "0"))
    assert float(clear.distance(array(1), array(0.5), array(0.1))[0]) == np.inf
    assert float(clear.optical_depth(array(1), array(0.5), array(100))[0]) == 0


def test_clear_water_above_the_light_lets_it_out():
    flight = LayeredFlight(WaterColumn.from_text("0, 2", "0, 0.5", "0", "0"))
    distance = np.array(flight.distance(array([4, 4]), array([-1, -1]), array([0.9, 1.1])))
    np.testing.assert_allclose(distance, [1.8, np.inf], rtol=1e-6)


def test_equal_layers_are_one():
    one = LayeredFlight(WaterColumn.from_text("0", "0.4", "0.2", "0.01"))
    many = LayeredFlight(WaterColumn.from_text("0, 1, 1.5, 4", "0.4", "0.2", "0.01"))
    rng = np.random.default_rng(3)
    depth, downward, drawn = (array(v) for v in (6 * rng.random(1000), 2 * rng.random(1000) - 1, rng.random(1000)))
    first, second = (np.array(flight.distance(depth, downward, drawn)) for flight in (one, many))
    # Slopes down to 1e-3 in float32 depths of some metres.
    np.testing.assert_allclose(first, second, rtol=2e-3)
    assert np.median(np.abs(second / first - 1)) < 1e-6


@each_row(*COLUMNS)
def test_a_layer_owns_its_upper_edge_and_the_first_one_the_crests(name):
    column = COLUMNS[name]
    flight = LayeredFlight(column)
    layer_tops = column.layer_tops.astype(np.float32)
    depths = np.concatenate([layer_tops, np.nextafter(layer_tops[1:], np.float32(-1)), [-1.0, 1e4]]).astype(np.float32)
    expected = np.concatenate([np.arange(column.count), np.arange(column.count - 1), [0, column.count - 1]])
    layer = flight.layer_at(array(depths))
    np.testing.assert_array_equal(np.broadcast_to(np.array(layer), expected.shape), expected)
    np.testing.assert_allclose(np.array(flight.coefficient(layer)), column.attenuation[expected[: len(layer)]])
    np.testing.assert_allclose(np.array(flight.albedo(layer)), column.albedo[expected[: len(layer)]], rtol=1e-6)
