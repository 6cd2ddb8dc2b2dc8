"""Stated errors of sums over bins beside the spread of forty renders."""

import numpy as np
import pytest
import xarray as xr
from significance import variance_limits

from mitransient_lidar.rendering.accuracy import ErrorCorrelation, PassStatistics
from mitransient_lidar.rendering.render import render
from mitransient_lidar.results.sum_errors import SumErrors, with_correlation

RENDERS, PASSES = 40, 4
#: One-way path in the water of a bin [m/ns].
METRES = 0.299792458 / 2 / 1.34


def group(passes, time):
    """The result of some passes, shape (pass, pixel, time)."""
    single, correlation = PassStatistics(), ErrorCorrelation()
    for values in passes:
        single.add(values)
        correlation.add(values)
    data = {"waveform": (("pixel", "time"), single.mean), "waveform_stderr": (("pixel", "time"), single.stderr)}
    return with_correlation(xr.Dataset(data, {"time": time}), *correlation.over(time))


def variance_ratios(results, windows):
    """Variance of sums over windows of several renders over the mean square of the stated errors, for each window."""
    sums, stated = [], []
    for result in results:
        errors = SumErrors.of(result)
        mean, own = result["waveform"].values, result["waveform_stderr"].values
        parts = [slice(first, first + count) for first, count in windows]
        sums.append([mean[:, part].sum(axis=1) for part in parts])
        found = [errors.of_sum(own[:, part], np.ones(part.stop - part.start), part.start) for part in parts]
        stated.append(np.square(found))
    return np.var(sums, axis=0, ddof=1).mean(axis=1) / np.mean(stated, axis=(0, 2))


@pytest.mark.long
@pytest.mark.parametrize(
    "params",
    [
        pytest.param({}, id="default"),
        pytest.param({"jerlov": "5C", "off_nadir_deg": "0", "bottom_depth": "5"}, id="turbid"),
        pytest.param({"bottom_depth": "12", "attenuation": "0.1", "scattering": "0.06"}, id="clear"),
    ],
)
def test_stated_errors_of_sums_are_those_of_forty_renders(params):
    """Windows of 3 to 7 m between surface and bottom."""
    count = RENDERS * PASSES
    result = render("table1", passes=count, batches=count, pass_share=1 / 32, seed=3, params=params)
    time = result["time"].values
    passes = result["waveform_batch"].transpose("batch", "pixel", "time").values
    renders = [group(passes[at : at + PASSES], time) for at in range(0, count, PASSES)]
    first, last = np.searchsorted(time, [result.attrs["window_start_ns"], result.attrs["window_end_ns"]])
    step = METRES * (time[1] - time[0])
    windows = []
    for metres in (3, 5, 7):
        bins = min(round(metres / step), last - first)
        windows += [(int(at), bins) for at in np.linspace(first, last - bins, 5)]
    ratios = variance_ratios(renders, windows)
    # Pixels are independent; stated variances have the freedom of the passes, which widens the interval.
    freedom = passes.shape[1] / (1 / (RENDERS - 1) + 1 / (RENDERS * (PASSES - 1)))
    low, high = variance_limits(freedom, len(windows))
    assert np.all((ratios > low) & (ratios < high))
