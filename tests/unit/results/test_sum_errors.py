"""Errors of sums over bins: blocks at the end of a record, few passes, and records of very many bins."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import significance
import xarray as xr
from scipy.ndimage import gaussian_filter1d
from scipy.stats import norm, t
from significance import largest_count
from small_results import made
from synthetic_shots import ATTRIBUTES, BINS, DT, SIGMA, START, SURFACE, waveform

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.column_fits import column_fit
from mitransient_lidar.analysis.waveforms.echo_detection import Records
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.rendering.accuracy import ErrorCorrelation
from mitransient_lidar.results.sum_errors import BlockCorrelation, SumErrors, pooled_errors, with_correlation


def record(values, deviation, step=1.0, **attributes):
    """A result of one pixel with these values [W] and standard errors."""
    return made(values[None], deviation[None], start=1385.0, step=step, **{**ATTRIBUTES, **attributes})


@pytest.mark.parametrize("bins", [1000, 1027, 1100])
def test_bins_belong_to_their_block_at_the_end_of_a_record(bins):
    """Blocks of 2 or 3 bins, the last one shorter; all errors are shared, so that those of sums add up."""
    correlation, time = ErrorCorrelation(), 3e4 + 0.1 * np.arange(bins)
    passes = np.random.default_rng(3).normal(size=(20, 4, 1)) * np.ones(bins)
    for values in passes:
        correlation.add(values)
    middles, found = correlation.over(time)
    zero = xr.DataArray(np.ones((4, bins)), dims=("pixel", "time"))
    dataset = xr.Dataset({"waveform": zero, "waveform_stderr": zero}, {"time": time})
    one = with_correlation(dataset, middles, found)
    errors, joined = SumErrors.of(one), SumErrors.of(xr.concat([one, one], "shot"))
    np.testing.assert_allclose(joined.shared.correlation, errors.shared.correlation)
    np.testing.assert_array_equal(errors.shared.block, np.arange(bins) // -(-bins // 512))
    for count in range(2, 8):
        assert errors.of_sum(np.ones(count), np.ones(count), bins - count) == pytest.approx(count, rel=1e-5)
    # The same from sums over bins of their own, one of them moved to the end.
    places = np.stack([np.arange(bins - 6, bins), np.minimum(np.arange(bins - 3, bins + 3), bins - 1)])
    scaled = np.array([[1.0] * 6, [1.0] * 3 + [0.0] * 3])
    np.testing.assert_allclose(errors.shared.variances(scaled, places), [36, 9], rtol=1e-5)


def test_few_passes_make_no_errors_of_nearly_nothing():
    """The errors of neighbours of one pixel cancel by chance: means of 4 bins would have none, all bins be echoes."""
    time, deviation = 1385.5 + np.arange(400), 1e-9 * np.ones(400)
    cancel = (-1.0) ** np.add.outer(np.arange(400), np.arange(400))
    values = 2e-6 * norm.pdf(time, SURFACE, SIGMA) + 1e-7 * np.exp(-0.03 * (time - SURFACE)) * (time > SURFACE)
    for passes, least in ((4, 1.0), (100, 0.1)):
        dataset = with_correlation(record(values, deviation, passes=passes), time, cancel)
        found = Waveforms.from_dataset(dataset, None, None, None, None)
        np.testing.assert_allclose(found.noise, least * 1e-9, rtol=1e-6)
    shared = BlockCorrelation(2 * np.eye(400) - 1, np.arange(400))
    records = replace(Records.of(values[np.newaxis], time, 1e-9), shared=shared)
    fit = column_fit(records, [SURFACE + 10], [SURFACE + 60], [SURFACE])
    assert np.isfinite([fit.level, fit.decay, fit.correlation]).all()


def test_a_record_of_very_many_bins_needs_little_memory():
    """200 000 bins, whose correlations would be 320 GB."""
    bins, step = 200_000, 0.5
    time, blocks = 1385 + step * (np.arange(bins) + 0.5), np.arange(0, bins, 391)
    values = 2e-4 * norm.pdf(time, SURFACE, SIGMA) + 1e-4 * norm.pdf(time, SURFACE + 70, SIGMA)
    correlation = 0.9 ** np.abs(np.subtract.outer(*2 * [np.arange(blocks.size)]))
    middles = np.add.reduceat(time, blocks) / np.diff(np.append(blocks, bins))
    tracemalloc.start()
    dataset = with_correlation(record(values, 1e-2 * values + 1e-9, step, passes=20), middles, correlation)
    table = echo_table.extract(dataset)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.2e9
    np.testing.assert_allclose(table["time_ns"].sel(echo="bottom"), SURFACE + 70, atol=0.05)


def test_correlations_of_another_kind_are_refused():
    middles = 1385.0 + np.arange(20)
    one = with_correlation(record(np.ones(60), np.ones(60)), middles, np.eye(20))
    for damaged, message in (
        (one.rename(other_error_time="other"), r"over \{'error_time': 20, 'other': 20\}: it must be square"),
        (one.isel(error_time=slice(0)), "'error_time': 0.*it must be square"),
        (one.isel(other_error_time=[0, 1]), "'other_error_time': 2.*it must be square"),
        (one.assign(error_correlation=one["error_correlation"] * np.nan), "error_correlation that is not of finite"),
        (one.assign_coords(error_time=["x"] * 20), "error_time that is not of finite numbers"),
        (one.drop_vars("time").assign_coords(time=60 * ["x"]), "result has time that is not of finite numbers"),
    ):
        with pytest.raises(UserError, match=message):
            SumErrors.of(damaged)


def of_passes(passes):
    """A series of shots of these passes, shape (pass, shot, pixel, time)."""
    dims, count = ("shot", "pixel", "time"), len(passes)
    light = {"waveform": (dims, passes.mean(axis=0))}
    light["waveform_stderr"] = dims, passes.std(axis=0, ddof=1) / np.sqrt(count)
    shots = passes.shape[1]
    return xr.Dataset(light, {"shot": np.arange(shots), "shot_passes": ("shot", np.full(shots, count))})


def test_pooled_errors_are_those_of_counted_paths():
    """An echo over a dim column and its tail, as means of 8 passes with Poisson numbers of paths of equal weights."""
    rng = np.random.default_rng(5 + significance.seed_shift)
    time = np.arange(120)
    paths = 4 + 400 * np.exp(-0.5 * ((time - 60) / 4) ** 2)
    passes = rng.poisson(paths, (8, 400, 2, 120)) / paths.max()
    series = of_passes(passes)
    found = pooled_errors(series, few=False).values
    true = np.sqrt(paths / 8) / paths.max()
    ratio = np.sqrt(np.mean(((series["waveform"].values - paths / paths.max()) / found) ** 2, axis=(0, 1)))
    assert np.all((ratio[20:100] > 0.75) & (ratio[20:100] < 1.02))
    assert found[..., 60].mean() < 1.25 * true[60]


def test_pooled_errors_keep_noise_of_few_passes_from_being_echoes():
    """Means of 6 passes about a column: 5 of their own standard errors are exceeded by one bin in 240 (Student's t)."""
    rng = np.random.default_rng(4 + significance.seed_shift)
    column = np.exp(-0.05 * np.arange(120))
    passes = column * (1 + 0.3 * rng.standard_normal((6, 500, 2, 120)))
    series = of_passes(passes)
    found, stderr = pooled_errors(series, few=False), series["waveform_stderr"]
    assert np.all(found >= stderr)
    off = np.abs(series["waveform"] - column)
    bins = off.size
    assert np.count_nonzero(off > 5 * stderr) > 0.5 * bins * 2 * t.sf(5, 5)
    assert np.count_nonzero(off > 5 * found) <= largest_count(bins, 2 * t.sf(5, 20))
    # They are true ones on average, but for what the larger of two errors adds.
    assert 1.0 < float(np.sqrt(np.mean((found / column) ** 2))) / (0.3 / np.sqrt(6)) < 1.25


def test_errors_of_two_passes_hide_no_echo():
    """Passes whose echoes differ by 8 %: own errors of two of them are over twice the true ones in one shot of 20."""
    rng = np.random.default_rng(6 + significance.seed_shift)
    echo = 0.1 + np.exp(-0.5 * ((np.arange(120) - 60) / 3) ** 2)
    passes = echo * (1 + 0.08 * rng.standard_normal((2, 256, 1, 1)))
    series = of_passes(passes)
    stderr = series["waveform_stderr"]
    found = pooled_errors(series, few=True).values[..., 60] / echo[60]
    true = 0.08 / np.sqrt(2)
    assert np.mean(stderr.values[..., 60] > 2 * true * echo[60]) > 0.02
    assert np.all((found > 0.75 * true) & (found < 1.5 * true))
    # A shot of more passes keeps its own errors, and is the only one with others beside it.
    mixed = series.assign_coords(shot_passes=("shot", np.where(np.arange(256) == 3, 8, 2)))
    changed = [(pooled_errors(mixed, few=few) != stderr).any(["pixel", "time"]).values for few in (True, False)]
    np.testing.assert_array_equal(changed, [np.arange(256) != 3, np.arange(256) == 3])


def test_ripples_of_two_passes_are_no_bottoms():
    """Columns without a bottom, whose passes differ by 15 % over the width of the pulse."""
    rng = np.random.default_rng(8 + significance.seed_shift)
    noise = gaussian_filter1d(rng.standard_normal((2, 32, 1, BINS)), SIGMA / DT, axis=-1)
    passes = waveform(depth=60.0, factor=3.0) * (1 + 0.15 * noise / noise.std())
    one = made(passes[0, 0], 0.0, start=START, step=DT, **ATTRIBUTES, passes=2)
    series = of_passes(passes).assign_coords(one.coords).assign_attrs(one.attrs)
    series["waveform"].attrs = one["waveform"].attrs
    # Own errors make 21 to 26 of them.
    assert np.count_nonzero(np.isfinite(echo_table.extract(series)["depth_m"].sel(echo="bottom"))) <= 4
    recorded = detect_waveforms(series, "apd", optical_density=2)
    linear = (recorded["signal_mean_stderr"] / recorded["signal_mean"]).isel(time=slice(150, 200))
    assert float(linear.std("shot").mean() / linear.mean()) < 0.1
