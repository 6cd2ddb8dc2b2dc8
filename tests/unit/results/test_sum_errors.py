"""Errors of renders with few passes, from neighbouring bins and shots."""

import numpy as np
import significance
import xarray as xr
from scipy.ndimage import gaussian_filter1d
from scipy.stats import t
from significance import largest_count
from small_results import made
from synthetic_shots import ATTRIBUTES, BINS, DT, SIGMA, START, waveform

from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.analysis.waveforms import echo_table
from mitransient_lidar.results.sum_errors import pooled_errors


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
