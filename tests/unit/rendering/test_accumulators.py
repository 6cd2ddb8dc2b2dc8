"""Errors of sums over bins, and the memory that decides what a render keeps."""

from types import SimpleNamespace

import numpy as np
import pytest
import significance
import xarray as xr
from scipy.ndimage import gaussian_filter
from significance import largest_z

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.rendering.accumulators import PassAccumulator
from mitransient_lidar.rendering.accuracy import ErrorCorrelation, PassStatistics
from mitransient_lidar.results.sum_errors import SumErrors, with_correlation


def result_of(passes):
    """A result of the waveforms of some passes, shape (pass, pixel, time), in bins of 1 ns."""
    correlation, single = ErrorCorrelation(), PassStatistics()
    for values in passes:
        correlation.add(values)
        single.add(values)
    time = np.arange(passes.shape[-1]) + 0.5
    data = {"waveform": (("pixel", "time"), single.mean), "waveform_stderr": (("pixel", "time"), single.stderr)}
    return with_correlation(xr.Dataset(data, {"time": time}), *correlation.over(time))


def inflation_of(draw, passes=400):
    rng = np.random.default_rng(5)
    attributes = result_of(np.stack([draw(rng) for _ in range(passes)])).attrs
    return attributes["error_inflation_bins"], attributes["error_inflation"]


def test_errors_that_go_together_over_a_few_bins_grow_that_far():
    """Sums over runs of 4 equal bins: twice the quadrature sum from 4 bins on."""
    _, inflation = inflation_of(lambda rng: np.repeat(rng.normal(10, 1, (5, 32)), 4, axis=1))
    np.testing.assert_allclose(inflation[3:], 2, rtol=largest_z(400, 6) / np.sqrt(2 * 400))
    whole = np.repeat(np.random.default_rng(5).normal(10, 1, (400, 5, 32)), 4, axis=2)
    result = result_of(whole)
    for first, bins, shared in ((8, 4, 2), (10, 2, np.sqrt(2)), (11, 2, 1)):
        own = result["waveform_stderr"].values[:, first : first + bins]
        found = SumErrors.of(result).of_sum(own, np.ones(bins), first) / np.linalg.norm(own, axis=1)
        np.testing.assert_allclose(found, shared, rtol=largest_z(400, 6) / np.sqrt(400 * 5))


@pytest.mark.parametrize("bins", [300, 1300])
def test_errors_of_sums_over_any_bins_are_those_of_the_passes(bins):
    """One pixel, whose later errors alone are shared by neighbours: the median curve of the record does not serve."""
    rng = np.random.default_rng(8)
    smooth = np.exp(-0.5 * (np.arange(-24, 25) / 8.0) ** 2)
    noise = rng.normal(size=(40, bins))
    shared = np.apply_along_axis(np.convolve, 1, noise, smooth / np.linalg.norm(smooth), "same")
    passes = np.where(np.arange(bins) < 150, noise, shared)[:, np.newaxis] + 5
    result, by_curve = result_of(passes), []
    for first, count in [(0, bins), (17, 100), (150, 7), (202, 60)]:
        weights = rng.uniform(0.5, 1, count)
        sums = passes[:, 0, first : first + count] @ weights
        own = result["waveform_stderr"].values[:, first : first + count]
        errors, seen = SumErrors.of(result), sums.std(ddof=1) / np.sqrt(40)
        assert errors.of_sum(own, weights, first).item() == pytest.approx(seen, rel=1e-5 if bins < 512 else 0.05)
        by_curve.append(SumErrors(None, errors.curve).of_sum(own, weights, first).item() / seen)
    assert max(by_curve) > 1.3 or min(by_curve) < 0.7


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


@pytest.mark.parametrize("kept", ["histograms", "gates"])
def test_an_empty_record_is_an_error_and_dark_pixels_are_not(kept):
    """A value that is not finite is no empty record: it is reported with the result."""
    for values, empty in (([[0, 0], [0, 0]], True), ([[0, 0], [0, 1e-30]], False), ([[0, 0], [np.nan, 0]], False)):
        accumulator = PassAccumulator(SimpleNamespace(axis=TimeAxis(1390, 1, 150)), None, kept=kept)
        accumulator._received.add(np.array(values, dtype=float))
        if empty:
            with pytest.raises(UserError, match="no light returned between 1390 and 1540 ns in 8 passes"):
                accumulator.require_light(8)
        else:
            accumulator.require_light(8)


def test_the_bias_of_smoothing_is_estimated_in_spite_of_noise():
    """A spot of 8 pixels and one of 16, with noise of 20 % in each pixel and pass: smoothing widens them."""
    grid, smooth, passes = (96, 96), 1.5, 9
    place = np.hypot(*np.mgrid[-48:48, -48:48])
    image = np.stack([np.exp(-0.5 * (place / width) ** 2) for width in (8, 16)], axis=-1).reshape(-1, 2)
    scene = SimpleNamespace(receiver=SimpleNamespace(pixels=SimpleNamespace(grid=grid, count=96 * 96)))
    accumulator = PassAccumulator(scene, None, kept="direct", smooth=smooth)
    random = np.random.default_rng(5 + significance.seed_shift)
    for _ in range(passes):
        noisy = image * random.normal(1, 0.2, image.shape)
        accumulator.add(SimpleNamespace(record_length=2, energy=lambda noisy=noisy: noisy))
    smoothed = gaussian_filter(image.reshape(*grid, 2), smooth, axes=(0, 1)).reshape(image.shape)
    lit = smoothed > 0.05
    true = np.sqrt([np.mean(((smoothed - image)[lit[:, k], k] / smoothed[lit[:, k], k]) ** 2) for k in (0, 1)])
    assert true[0] > 3 * true[1]
    # The next order in (1.5 / 8)^2; the noise of the estimate is ten times less.
    np.testing.assert_allclose(accumulator._smoothing_bias(), true, rtol=0.12)
    # Smoothing keeps all light, and the noise falls by 2 sqrt(pi) sigma.
    assert accumulator.gates.mean.sum() == pytest.approx(image.sum(), rel=1e-2)
    ratio = np.sqrt(np.mean((accumulator.gates.stderr[lit] / smoothed[lit]) ** 2) * passes) / 0.2
    assert ratio * 2 * np.sqrt(np.pi) * smooth == pytest.approx(1, rel=0.1)
