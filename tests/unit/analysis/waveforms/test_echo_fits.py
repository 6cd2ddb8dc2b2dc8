"""Fits to waveforms: bias and standard errors in synthetic records."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.stats import exponnorm
from significance import largest_count, largest_z
from synthetic_shots import on_axis

from mitransient_lidar.analysis.waveforms.column_fits import change_points, column_fit
from mitransient_lidar.analysis.waveforms.column_onset import ColumnOnset, Focusing
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag, Records
from mitransient_lidar.analysis.waveforms.echo_fits import gaussian_echo, gaussian_surface
from mitransient_lidar.analysis.waveforms.echo_shape import EchoShape, Template
from mitransient_lidar.analysis.waveforms.echo_table import extract
from mitransient_lidar.physics.lidar.pulse import Pulse

TIME = (np.arange(400) + 0.5) * 0.5
SIGMA = 3.3
WIDTH = SIGMA * np.sqrt(8 * np.log(2))
DECAY = 0.035
SURFACE, BOTTOM = 60.1, 134.3
COUNT = 800
SHAPE = EchoShape.gaussian(WIDTH)


def onset(at, level=1.0, decay=DECAY):
    """A column that begins at a time, blurred: an exponential decay convolved with a Gaussian."""
    return level / decay * exponnorm.pdf(TIME, 1 / (decay * SIGMA), loc=at, scale=SIGMA)


def gauss(at, height):
    return height * np.exp(-0.5 * ((TIME - at) / SIGMA) ** 2)


def waveform(surface=0.4, bottom=2.0):
    column = onset(SURFACE) - np.exp(-DECAY * (BOTTOM - SURFACE)) * onset(BOTTOM)
    return column + gauss(SURFACE, surface) + gauss(BOTTOM, bottom)


def noisy(signal, noise, count=COUNT, seed=11):
    rng = np.random.default_rng(seed)
    return Records.of(signal + noise * rng.normal(size=(count, TIME.size)), TIME, noise)


def assert_true(values, errors, truth, bias=0.0):
    """Values scatter about the truth as their errors say; `bias` is what the model is known to miss."""
    z = (values - truth) / errors
    assert np.isfinite(z).all()
    assert abs(z.std(ddof=1) - 1) < largest_z(z.size, 2) / np.sqrt(2 * z.size)
    assert abs(values.mean() - truth) < bias + largest_z(z.size, 2) * errors.mean() / np.sqrt(z.size)


def test_surface_and_column_are_separated():
    """The peak of this signal is 3 ns after the surface."""
    signal = waveform()
    peak = int(np.argmax(signal[:200]))
    assert TIME[peak] - SURFACE > 2
    bins, flags = np.full(COUNT, peak), np.zeros(COUNT, int)
    found = gaussian_surface(noisy(signal, 0.01), bins, WIDTH, DECAY, flags, SHAPE)
    assert not found.flags.any()
    assert_true(found.time_ns, found.time_stderr, SURFACE, bias=0.01)
    assert_true(found.amplitude, found.amplitude_stderr, 0.4, bias=0.002)
    assert_true(found.width_ns, found.width_stderr, WIDTH, bias=0.01)
    assert_true(found.energy, found.energy_stderr, 0.4 * np.sqrt(2 * np.pi) * SIGMA * 1e-9, bias=2e-11)


@pytest.mark.parametrize(("height", "noise"), [(0.0, 0.03), (0.2, 0.03), (0.2, 0.01)])
def test_a_surface_low_beside_its_column_has_one_time_with_a_true_error(height, noise):
    """Without a height the surface is 1 to 2 ns earlier and fits alike: choosing gave two groups with 5 to 60 errors.

    The height is the same in all records and unknown to each, so that errors are true over heights, not in each: the
    root mean square of error over stated error is 0.6 to 2.2.
    """
    signal = onset(SURFACE) + gauss(SURFACE, height)
    bins, flags = np.full(300, int(np.argmax(signal))), np.zeros(300, int)
    found = gaussian_surface(noisy(signal, noise, 300), bins, WIDTH, DECAY, flags, SHAPE)
    error = found.time_ns - SURFACE
    assert 0.5 < np.sqrt(np.mean((error / found.time_stderr) ** 2)) < 2.7
    assert np.median(found.time_stderr) < 1.0
    if height == 0:
        # Those that took noise for a height were a second group, 1.6 ns late.
        assert np.count_nonzero(error > 1.4) <= largest_count(300, 0.01)
        assert np.count_nonzero(found.amplitude / found.amplitude_stderr > 3) <= largest_count(300, 0.005)


@pytest.mark.parametrize("known", [True, False])
def test_surfaces_of_turbid_water_have_true_times(known):
    """The level counts at the peak, where it is a third of that at the surface, and a decay may be a typical one."""
    fast = 0.15
    signal, bins, flags = onset(SURFACE, decay=fast), np.full(300, 0), np.zeros(300, int)
    bins[:] = np.argmax(signal)
    late = TIME[bins[0]] - SURFACE
    level = np.full(300, np.exp(-fast * late) if known else np.nan), np.full(300, 0.2 * np.exp(-fast * late))
    rate, error = (fast, 0.02) if known else (0.03, 1.0)
    found = gaussian_surface(noisy(signal, 0.003, 300), bins, WIDTH, rate, flags, SHAPE, level=level, decay_error=error)
    z = (found.time_ns - SURFACE) / found.time_stderr
    assert np.sqrt(np.mean(z**2)) < 1.8


def test_a_bright_echo_near_a_surface_does_not_delay_it():
    """Two echo widths behind the surface, its rise was the surface's peak, 4 ns late with an error of 0.6 ns."""
    signal = waveform(0.4, 0.0) + gauss(SURFACE + 2.2 * WIDTH, 5.0)
    bins, flags = np.full(200, int(np.argmin(np.abs(TIME - SURFACE)))), np.zeros(200, int)
    following = np.full(200, int(np.argmax(signal)))
    found = gaussian_surface(noisy(signal, 0.01, 200), bins, WIDTH, DECAY, flags, SHAPE, following=following)
    assert np.sqrt(np.mean(((found.time_ns - SURFACE) / found.time_stderr) ** 2)) < 2.7
    assert np.median(found.time_stderr) < 1.0


def test_bottom_on_the_column_that_it_ends():
    signal = waveform()
    bins, flags = np.full(COUNT, int(np.argmin(np.abs(TIME - BOTTOM)))), np.zeros(COUNT, int)
    found = gaussian_echo(noisy(signal, 0.02), bins, WIDTH, DECAY, flags, SHAPE, after=bins - 150)
    assert not found.flags.any()
    # The step in the column of the model lacks the factor exp((k s)^2/2) = 1.007 of a blurred exponential.
    assert_true(found.time_ns, found.time_stderr, BOTTOM, bias=0.005)
    assert_true(found.amplitude, found.amplitude_stderr, 2.0, bias=0.005)
    assert_true(found.width_ns, found.width_stderr, WIDTH, bias=0.005)


def test_times_without_noise_have_no_bias_at_any_position_in_a_bin():
    arrivals = 100 + np.linspace(0, 0.5, 11)
    records = Records.of(np.stack([gauss(at, 1.0) for at in arrivals]), TIME)
    bins = np.argmin(np.abs(TIME - arrivals[:, np.newaxis]), axis=1)
    found = gaussian_echo(records, bins, WIDTH, 0.0, np.zeros(11, int), SHAPE)
    np.testing.assert_allclose(found.time_ns, arrivals, atol=0.002)
    np.testing.assert_allclose(found.width_ns, WIDTH, rtol=1e-3)


def test_echoes_with_the_tail_of_a_receiver_have_true_times_heights_and_energies():
    """A single Gaussian would be 2 ns late."""
    template = Template.of(Pulse.gaussian(WIDTH), 0.5, 4.0)
    shape = EchoShape.of(template)
    at = 100.2
    signal = 3.0 * np.interp(TIME, at + template.time_ns, template.power, left=0, right=0)
    bins, flags = np.full(COUNT, int(np.argmax(signal))), np.zeros(COUNT, int)
    records, width = noisy(signal, 0.03), template.fwhm_ns
    for found in (
        gaussian_echo(records, bins, width, 0.02, flags, shape),
        gaussian_surface(records, bins, width, 0.02, flags, shape),
    ):
        # A sum of Gaussians is within 1 % of the template.
        assert_true(found.time_ns, found.time_stderr, at, bias=0.03)
        assert found.amplitude.mean() == pytest.approx(3.0, rel=0.02)
        assert found.energy.mean() == pytest.approx(np.trapezoid(signal, TIME) * 1e-9, rel=0.03)
        assert found.width_ns.mean() == pytest.approx(width, rel=0.03)


def test_a_column_that_waves_focus_does_not_delay_the_surface():
    """The signal is brightest 7 ns after the surface; without the focusing in the model, the surface is 4 ns late."""
    fine = np.arange(-40, 240, 0.01)
    focusing = Focusing(np.array([0.0, 0.5, 1.0, 2.0, 30.0]), np.array([1.0, 3.7, 2.1, 1.5, 1.0]))
    shape = np.where(fine >= 0, focusing.at(0.106 * fine) * np.exp(-DECAY * fine), 0)
    blur = np.exp(-0.5 * (np.arange(-20, 20, 0.01) / SIGMA) ** 2)
    column = np.convolve(shape, blur / blur.sum(), "same")
    signal = np.interp(TIME, fine + SURFACE, column)
    bins, flags = np.full(300, int(np.argmax(signal))), np.zeros(300, int)
    late = TIME[bins[0]] - SURFACE
    level = np.full(300, np.exp(-DECAY * late)), np.full(300, 0.2)
    onset = ColumnOnset.of(focusing, 0.106, SHAPE.sigma_of(3 * WIDTH))
    for glint in (0.0, 1.0):
        records = noisy(signal + gauss(SURFACE, glint), 0.05, 300)
        found = gaussian_surface(records, bins, WIDTH, DECAY, flags, SHAPE, onset, level)
        assert np.sqrt(np.mean(((found.time_ns - SURFACE) / found.time_stderr) ** 2)) < 1.8
    plain = gaussian_surface(records, bins, WIDTH, DECAY, flags, SHAPE)
    assert np.mean(plain.time_ns) - SURFACE > 2


def test_missing_echoes_are_nan_and_poor_fits_are_flagged():
    flags = np.array([int(EchoFlag.NO_ECHO), 0])
    records = Records.of(np.stack([gauss(60, 1.0), np.full(TIME.size, -1.0)]), TIME, 0.1)
    for found in (
        gaussian_echo(records, np.array([-1, 120]), WIDTH, 0.0, flags, SHAPE),
        gaussian_surface(records, np.array([-1, 120]), WIDTH, 0.03, flags, SHAPE),
    ):
        assert np.isnan(found.time_ns).all()
        assert found.flags.tolist() == [EchoFlag.NO_ECHO, EchoFlag.POOR_FIT]


def test_column_fit_finds_level_and_decay_also_from_samples_in_the_noise():
    """At the end the signal is a third of the noise: a line through logarithms would be bent."""
    gain = np.linspace(1.0, 0.8, TIME.size)[np.newaxis]
    signal = gain[0] * np.exp(-0.05 * (TIME - 50))
    records = noisy(signal, 0.02)
    every = np.ones(COUNT)
    found = column_fit(records, 60 * every, 140 * every, 50 * every, gain)
    assert_true(found.decay, found.decay_stderr, 0.05)
    assert_true(found.level, found.level_stderr, 1.0)
    # chi2/f has the mean 1 and the variance 2/f.
    assert abs(found.chi2.mean() - 1) < largest_z(COUNT, 2) * np.sqrt(2 / (found.bins[0] - 2) / COUNT)
    correlation = np.corrcoef(found.level, found.decay)[0, 1]
    assert correlation == pytest.approx(found.correlation.mean(), abs=largest_z(COUNT, 2) / np.sqrt(COUNT))


@pytest.mark.slow
def test_change_points_raise_false_alarms_no_more_often_than_they_say():
    count = 4000
    records = noisy(np.exp(-0.03 * (TIME - 50)), 0.02, count)
    every = np.ones(count)
    found = change_points(records, 50 * every, 120 * every, model_error=0.0)
    for level in (0.2, 0.05, 0.01):
        alarms = np.mean(found.p_value[:, 0] < level)
        assert alarms < level + largest_z(count, 3) * np.sqrt(level / count)
    # The bound is not idle: the places are correlated, which makes it a few times too careful, not a hundred times.
    assert np.mean(found.p_value[:, 0] < 0.2) > 0.02


def test_change_points_find_layers_where_they_are():
    change = 90.0
    above = np.exp(-0.05 * (TIME - 50))
    below = 0.6 * np.exp(-0.05 * (change - 50)) * np.exp(-0.02 * (TIME - change))
    records = noisy(np.where(change > TIME, above, below), 0.003, 200)
    every = np.ones(200)
    found = change_points(records, 50 * every, 140 * every, layers=2)
    assert (found.p_value[:, 0] < 1e-6).all()
    np.testing.assert_allclose(found.time_ns[:, 0], change, atol=1.0)
    assert found.step[:, 0].mean() == pytest.approx(np.log(0.6), abs=0.02)
    assert found.decay_before[:, 0].mean() == pytest.approx(0.05, abs=1e-3)
    assert found.decay_after[:, 0].mean() == pytest.approx(0.02, abs=1e-3)
    assert np.mean(found.p_value[:, 1] < 0.01) < 0.05


def test_coarse_samples_of_short_pulses_determine_a_bottom():
    """Echoes of 1.2 ns in samples of 1 ns, of which a span of echo widths holds no more than parameters."""
    time, sigma = np.arange(120) + 0.5, 0.53
    places = 60 + np.random.default_rng(5).uniform(0, 1, COUNT)
    signal = np.exp(-0.5 * ((time - places[:, np.newaxis]) / sigma) ** 2) + 0.02 * (time < places[:, np.newaxis])
    records = Records.of(signal + 0.02 * np.random.default_rng(6).normal(size=signal.shape), time, 0.02)
    width = sigma * np.sqrt(8 * np.log(2))
    found = gaussian_echo(
        records, np.argmax(signal, axis=1), width, 0.0, np.zeros(COUNT, int), EchoShape.gaussian(width)
    )
    z = (found.time_ns - places) / found.time_stderr
    assert np.isfinite(z).mean() > 0.99
    assert abs(np.nanmean(z)) < largest_z(COUNT) / np.sqrt(COUNT) + 0.1
    assert 0.8 < np.nanstd(z) < 1.2


def test_light_that_waves_focus_within_a_column_is_not_the_surface():
    """Five of 720 records of `table1`, 2 m deep under a wind of 6 m/s, whose depths were 0.3 to 0.5 m short."""
    records = xr.open_dataset(Path(__file__).with_name("focused_columns.nc"))
    bottom = extract(records).sel(echo="bottom").squeeze("pixel")
    error = np.hypot(bottom.depth_m_stderr, bottom.depth_m_method_error)
    assert (np.abs(bottom.depth_m - records.true_bottom_depth_below_surface) < 3 * error).all()


@pytest.mark.parametrize("depth", [0.85, 0.95, 1.2])
def test_bottom_near_a_bright_surface_echo_is_no_later(depth):
    """Two to three echo widths behind a bright surface, whose tail would count as a column before the bottom."""
    near, far = (
        float(extract(on_axis(depth=d, glint=3e-10), depth_from="mean")["depth_m"].sel(echo="bottom")[0]) - d
        for d in (depth, 3.0)
    )
    assert near == pytest.approx(far, abs=0.004)
