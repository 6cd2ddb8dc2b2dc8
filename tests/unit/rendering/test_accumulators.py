"""Errors of sums over neighbouring bins, and the memory that decides what a render keeps."""

from types import SimpleNamespace

import numpy as np
import pytest
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.accumulators import GateAccumulator, WaveformAccumulator
from mitransient_lidar.rendering.accuracy import ErrorInflation, PassStatistics


def inflation_of(draw, passes=400):
    inflation, single = ErrorInflation(), PassStatistics()
    rng = np.random.default_rng(5)
    for _ in range(passes):
        values = draw(rng)
        inflation.add(values)
        single.add(values)
    return inflation.over(single.mean, single.stderr)


def test_errors_of_independent_bins_do_not_grow():
    bins, inflation = inflation_of(lambda rng: rng.normal(10, 1, (5, 50)))
    assert bins == [1, 2, 4, 8, 16, 32]
    # A standard deviation from 400 passes is known to 3.5 %; the median is over 5 blocks or more.
    np.testing.assert_allclose(inflation, 1, rtol=largest_z(400, 6) / np.sqrt(2 * 400))


def test_errors_of_bins_that_go_together_grow_with_their_number():
    bins, inflation = inflation_of(lambda rng: 10 + rng.normal(0, 1, (5, 1)) * np.ones((5, 64)))
    np.testing.assert_allclose(inflation, np.sqrt(bins), rtol=1e-9)


def test_errors_that_go_together_over_a_few_bins_grow_that_far():
    """Sums over runs of 4 equal bins: twice the quadrature sum from 4 bins on."""
    _, inflation = inflation_of(lambda rng: np.repeat(rng.normal(10, 1, (5, 32)), 4, axis=1))
    np.testing.assert_allclose(inflation[:3], [1, np.sqrt(2), 2], rtol=1e-9)
    np.testing.assert_allclose(inflation[3:], 2, rtol=largest_z(400, 6) / np.sqrt(2 * 400))


def test_dark_blocks_do_not_count():
    def draw(rng):
        values = rng.normal(10, 1, (1, 8))
        values[:, 4:] = 1e-9 * rng.normal(10, 1)
        return values

    assert inflation_of(draw)[1][1:] == pytest.approx([1, 1, 1], rel=largest_z(400, 3) / np.sqrt(2 * 400))


def test_statistics_of_part_of_the_pixels():
    statistics = PassStatistics()
    for values in np.random.default_rng(2).normal(size=(6, 9, 4)):
        statistics.add(values)
    np.testing.assert_array_equal(statistics.stderr_of(slice(None, None, 2)), statistics.stderr[::2])


@pytest.mark.parametrize(("kind", "statistics"), [(WaveformAccumulator, "_energy"), (GateAccumulator, "gates")])
def test_an_empty_record_is_an_error_and_dark_pixels_are_not(kind, statistics):
    """A value that is not finite is no empty record: it is reported with the result."""
    for values, empty in (([[0, 0], [0, 0]], True), ([[0, 0], [0, 1e-30]], False), ([[0, 0], [np.nan, 0]], False)):
        accumulator = kind.__new__(kind)
        accumulator.scene = SimpleNamespace(axis=TimeAxis(1390, 1, 150))
        setattr(accumulator, statistics, PassStatistics())
        getattr(accumulator, statistics).add(np.array(values, dtype=float))
        if empty:
            with pytest.raises(UserError, match="no light returned between 1390 and 1540 ns in 8 passes"):
                accumulator.require_light(8)
        else:
            accumulator.require_light(8)
