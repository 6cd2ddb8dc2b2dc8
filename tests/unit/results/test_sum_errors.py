"""Errors of sums over bins: blocks at the end of a record, few passes, and records of very many bins."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm
from small_results import made
from synthetic_shots import ATTRIBUTES, SIGMA, SURFACE

from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.analysis.waveforms.column_fits import column_fit
from mitransient_lidar.analysis.waveforms.echo_detection import Records
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.rendering.accuracy import ErrorCorrelation
from mitransient_lidar.results.sum_errors import BlockCorrelation, SumErrors, with_correlation


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


def test_two_passes_make_no_errors_of_nearly_nothing():
    """The errors of neighbours of one pixel cancel by chance: means of 4 bins would have none, all bins be echoes."""
    time, deviation = 1385.5 + np.arange(400), 1e-9 * np.ones(400)
    cancel = (-1.0) ** np.add.outer(np.arange(400), np.arange(400))
    values = 2e-6 * norm.pdf(time, SURFACE, SIGMA) + 1e-7 * np.exp(-0.03 * (time - SURFACE)) * (time > SURFACE)
    for passes, least in ((2, 1.0), (100, 0.1)):
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
