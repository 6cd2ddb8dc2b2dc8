"""Detection and measurement of echoes in waveforms: bias, standard errors and flags."""

from dataclasses import replace

import numpy as np
import pytest
from rows import each_row, refuses
from scipy.stats import exponnorm, norm
from significance import largest_count, largest_z

from mitransient_lidar.analysis.waveforms import echo_estimators
from mitransient_lidar.analysis.waveforms.column_fits import column_fit
from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag, Records, find_echoes
from mitransient_lidar.analysis.waveforms.echo_shape import Template
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA, Pulse
from mitransient_lidar.results.sum_errors import BlockCorrelation

DT = 0.5
TIME = (np.arange(400) + 0.5) * DT
FWHM = 5.0
SIGMA = FWHM / FWHM_PER_SIGMA
PULSE = Pulse.gaussian(FWHM)
TEMPLATE = Template.of(PULSE, DT)
EDGES = np.arange(401) * DT


def echoes(arrivals, amplitude=1.0, sigma=SIGMA, tau=0.0):
    """Means over the bins of echoes of a Gaussian pulse, from cumulative distributions of another library."""
    arrivals = np.atleast_1d(arrivals)[:, np.newaxis]
    if tau:
        shares = np.diff(exponnorm.cdf(EDGES, tau / sigma, loc=arrivals, scale=sigma), axis=1)
    else:
        shares = np.diff(norm.cdf(EDGES, arrivals, sigma), axis=1)
    return amplitude * np.sqrt(2 * np.pi) * sigma / DT * shares


def column(start, end=np.inf, level=1.0, decay=0.035, sigma=SIGMA):
    """An exponential from `start` to `end`, blurred by a Gaussian, at the bins' centres."""

    def onset(at):
        return level / decay * exponnorm.pdf(TIME, 1 / (decay * sigma), loc=at, scale=sigma)

    return onset(start) - (np.exp(-decay * (end - start)) * onset(end) if np.isfinite(end) else 0)


def read(method, records, template, width, place, flags):
    window = echo_estimators.Window.around(records, place, width)
    top = echo_estimators.summit(window, flags)

    def time_of(window, top):
        if method == "centroid":
            return echo_estimators.centroid(window, top.time_ns, width)
        if method == "peak":
            return top.time_ns, top.time_stderr
        fraction = float(method)
        return echo_estimators.leading_edge(window, top, template, fraction)

    offset = 0.0
    if method in ("centroid", "peak"):
        offset = echo_estimators.calibrate(time_of, template, records.bin_ns, width)
    time, error = time_of(window, top)
    return time - offset, error


def test_template_is_the_pulse_averaged_over_bins_and_after_the_response():
    # Convolution adds variances: that of a bin is dt^2/12. Its full width follows for an almost Gaussian shape.
    assert Template.of(PULSE, 0.5).fwhm_ns == pytest.approx(
        FWHM_PER_SIGMA * np.hypot(SIGMA, 0.5 / np.sqrt(12)), rel=1e-4
    )
    tailed = Template.of(PULSE, 0.5, response_time_ns=1.5)
    shape = exponnorm(1.5 / SIGMA, scale=SIGMA)
    expected = shape.cdf(tailed.time_ns + 0.25) - shape.cdf(tailed.time_ns - 0.25)
    np.testing.assert_allclose(tailed.power, expected / expected.max(), atol=2e-4)
    assert tailed.time_ns[np.argmax(tailed.power)] == pytest.approx(tailed.time_ns[np.argmax(expected)], abs=0.03)


@each_row("peak", "centroid", "0.1", "0.5", "0.8")
@each_row(0.0, 1.5)
def test_times_of_isolated_echoes_have_no_bias(tau, method):
    """Arrivals at all parts of a bin. Taking bin centres for left edges would give 0.25 ns, the response 1.5 ns."""
    arrivals = 60 + np.linspace(0, 1, 21)
    template = Template.of(PULSE, DT, tau)
    records = Records.of(echoes(arrivals, tau=tau), TIME)
    found = find_echoes(records, template.fwhm_ns)
    time, _ = read(method, records, template, template.fwhm_ns, found.surface, found.flags[0])
    np.testing.assert_allclose(time, arrivals, atol=0.02)


def test_amplitude_width_and_energy_of_an_isolated_echo():
    records = Records.of(echoes([60.1, 60.3], amplitude=2.0), TIME)
    window = echo_estimators.Window.around(records, np.array([120, 120]), TEMPLATE.fwhm_ns)
    top = echo_estimators.summit(window, np.zeros(2, int))
    # Averaging over the bins lowers and widens the summit.
    sigma = np.hypot(SIGMA, DT / np.sqrt(12))
    np.testing.assert_allclose(top.width_ns, FWHM_PER_SIGMA * sigma, rtol=1e-3)
    np.testing.assert_allclose(top.amplitude, 2.0 * SIGMA / sigma, rtol=1e-3)
    energy, _ = echo_estimators.gate_energy(window, top.time_ns, TEMPLATE.fwhm_ns)
    np.testing.assert_allclose(energy, 2.0 * np.sqrt(2 * np.pi) * SIGMA * 1e-9, rtol=1e-3)


@pytest.mark.parametrize("method", ["peak", "threshold"])
def test_errors_are_those_of_the_noise(method):
    count, noise = 800, 0.02
    rng = np.random.default_rng(7)
    arrivals = 60 + rng.random(count)
    records = Records.of(echoes(arrivals) + noise * rng.normal(size=(count, TIME.size)), TIME, noise)
    # From early on, in one of 100 sets noise would be a first peak.
    found = find_echoes(records, TEMPLATE.fwhm_ns, earliest_ns=55)
    width = TEMPLATE.fwhm_ns
    window = echo_estimators.Window.around(records, found.surface, width)
    top = echo_estimators.summit(window, found.flags[0])
    if method in ("amplitude", "width"):
        sigma = np.hypot(SIGMA, DT / np.sqrt(12))
        name, truth = ("amplitude", SIGMA / sigma) if method == "amplitude" else ("width_ns", FWHM_PER_SIGMA * sigma)
        value, error = getattr(top, name), getattr(top, name.removesuffix("_ns") + "_stderr")
    elif method == "energy":
        value, error = echo_estimators.gate_energy(window, top.time_ns, width)
        truth = np.sqrt(2 * np.pi) * SIGMA * 1e-9
    elif method == "threshold":
        level = np.full(count, 0.2)
        value, error = echo_estimators.crossing(window, top, level, np.zeros(count), TEMPLATE)
        truth = arrivals
    else:
        value, error = read(method, records, TEMPLATE, width, found.surface, found.flags[0])
        truth = arrivals
    z = (value - truth) / error
    assert np.isfinite(z).all()
    # Standard error of a standard deviation of normal numbers: 1/sqrt(2 n). Samples taken by their height share noise
    # with what they are compared with, which costs up to 5 %.
    assert abs(z.std(ddof=1) - 1) < largest_z(count, 2) / np.sqrt(2 * count) + 0.05
    assert abs(z.mean()) < largest_z(count, 2) / np.sqrt(count) + 0.1


def test_errors_of_energies_and_columns_have_the_correlation_of_samples():
    """Errors seen in 1500 records whose noise a filter of 6 ns shares; independent samples would have half of them."""
    rng = np.random.default_rng(5)
    kernel = np.ones(12) / np.sqrt(12)
    signal = echoes([60.0]) + 0.4 * np.exp(-0.02 * TIME) * (TIME > 80)
    noise = np.apply_along_axis(np.convolve, 1, rng.normal(size=(1500, TIME.size + 11)), kernel, "valid")
    records = Records.of(signal + 0.01 * noise, TIME, 0.01)
    bins = np.arange(TIME.size)
    shared = np.clip(1 - np.abs(np.subtract.outer(bins, bins)) / 12, 0, 1)
    records = replace(records, shared=BlockCorrelation(shared, bins))
    top = echo_estimators.Window.around(records, np.full(1500, 120), 6.0)
    ends = np.full(1500, 90.0), np.full(1500, 190.0), np.full(1500, 80.0)
    fit = column_fit(records, *ends)
    weights = np.ones(top.power.shape)
    pairs = [(np.sum(top.power, axis=1), top.error_of_sum(weights)), (fit.decay, fit.decay_stderr)]
    for found, stated in [*pairs, (fit.level, fit.level_stderr)]:
        np.testing.assert_allclose(found.std() / np.median(stated), 1, atol=largest_z(1500) / np.sqrt(2 * 1500))


def test_surface_target_and_bottom_are_found_on_a_column():
    signal = column(40, 120) + echoes(40, 0.3)[0] + echoes(85.2, 0.3)[0] + echoes(120.1, 2.0)[0]
    found = find_echoes(Records.of(signal[np.newaxis], TIME), FWHM)
    assert TIME[found.bins[1][0]] == pytest.approx(85.2, abs=DT)
    assert TIME[found.bins[2][0]] == pytest.approx(120.1, abs=DT)
    assert 40 < TIME[found.surface[0]] < 48  # the peak is the column's
    assert (found.flags[0], found.flags[1], found.flags[2]) == ([0], [0], [0])


def test_a_column_is_no_echo_nor_is_a_step_down_in_it():
    smooth = column(40)
    step = column(40, 80) + column(80, level=0.4 * np.exp(-0.035 * 40))
    found = find_echoes(Records.of(np.stack([smooth, step]), TIME), FWHM)
    assert found.bins[2].tolist() == [-1, -1]
    assert found.flags[2].tolist() == [EchoFlag.NO_ECHO] * 2


def test_a_ripple_on_the_rise_of_scattered_light_is_no_bottom():
    """Pixels beside the beam: light reaches them late, by scattering, and fades; a bottom below it is found."""
    later = np.maximum(TIME - 40, 0) / 20
    rise = 2 * later**2 * np.exp(2 - 2 * later) + echoes(46.0, 0.2)[0]
    signal = np.stack([rise, rise + echoes(150.0, 1.0)[0]])
    found = find_echoes(Records.of(signal, TIME, 0.004), FWHM, latest_ns=40.0)
    assert found.bins[2][0] == -1
    assert TIME[found.bins[2][1]] == pytest.approx(150, abs=DT)


def test_a_wide_hump_beside_the_beam_is_no_bottom_but_a_stretched_echo_is_one():
    """Light scattered to a pixel without a surface echo, in noise of a sixtieth; without its shape, 157 would be."""
    rng = np.random.default_rng(4)
    noise = 1 / 60 * rng.normal(size=(200, TIME.size))
    for wider, most, least in ((7.0, 60, 0), (2.0, 200, 195), (1.0, 200, 200)):
        signal = np.exp(-0.5 * ((TIME - 90) / (wider * SIGMA)) ** 2) + noise
        found = find_echoes(Records.of(signal, TIME, 1 / 60), FWHM, latest_ns=40.0)
        assert least <= np.count_nonzero(found.bins[2] >= 0) <= most
    # A clipped echo has a flat summit.
    flat = np.minimum(30 * np.exp(-0.5 * ((TIME - 90) / SIGMA) ** 2), 1)[np.newaxis]
    assert find_echoes(Records.of(flat, TIME, 0.001), FWHM, latest_ns=40.0).bins[2][0] >= 0


def test_a_bottom_at_any_distance_from_the_surface_is_one_echo():
    """Near the surface another criterion holds, whose border cuts through some of the echoes."""
    arrivals = np.arange(55, 90, 0.25)
    signal = [column(40, at) + echoes(40, 0.3)[0] + echoes(at, 2.0)[0] for at in arrivals]
    found = find_echoes(Records.of(np.stack(signal), TIME), FWHM)
    assert found.bins[1].tolist() == [-1] * arrivals.size
    # The end of the column shifts the peak.
    np.testing.assert_allclose(TIME[found.bins[2]], arrivals, atol=1.5 * DT)


@each_row(
    *[(0.02, 0.5, 2.5, 12), (0.02, 0.5, 2.5, 20), (0.02, 0.5, 2.5, 30), (0.1, 2, 5, 12), (0.1, 2, 5, 20)],
    *[(0.02, 0.4, 0.9, 20), (0.02, 0.4, 0.9, 30)],  # as high as the column
)
def test_waves_make_no_targets_and_do_not_hide_one(decay, focused, height, delay):
    """A depth at which waves focus the light of a shot; a target there, and one that is two pulses above the bottom."""
    bottom = 80 + delay
    smooth = column(40, bottom, decay=decay) + echoes(40, 0.6)[0]
    bright = smooth * (1 + focused * np.exp(-0.5 * ((TIME - 40 - delay) / 3) ** 2)) + echoes(bottom, 2.0)[0]
    target = smooth + echoes(40 + delay, height * np.exp(-decay * delay))[0] + echoes(bottom, 2.0)[0]
    cube = smooth + echoes([bottom - 2 * FWHM, bottom], 1.0).sum(axis=0)
    records = Records.of(np.stack([bright, target, cube]), TIME)
    level, waves = (find_echoes(records, FWHM, waves=waves) for waves in (False, True))
    assert level.bins[1][0] >= 0
    assert waves.bins[1][0] == -1
    for found in (level, waves):
        np.testing.assert_allclose(TIME[found.bins[1][1:]], [40 + delay, bottom - 2 * FWHM], atol=0.5 * FWHM)
        np.testing.assert_allclose(TIME[found.bins[2]], bottom, atol=0.5 * FWHM)


def test_a_weak_bottom_is_found_as_often_as_its_signal_allows_and_noise_hardly_ever():
    rng = np.random.default_rng(3)
    noise = 0.02
    clean = column(40, 120) + echoes(120.0, 0.5)[0]
    noisy = clean + noise * rng.normal(size=(500, TIME.size))
    found = find_echoes(Records.of(noisy, TIME, noise), FWHM)
    assert np.mean(np.abs(TIME[found.bins[2]] - 120) < 3) > 0.99
    dark = find_echoes(Records.of(noise * rng.normal(size=(2000, TIME.size)), TIME, noise), FWHM)
    # Some 130 independent values of 5 sigma, each with the chance 2.9e-7.
    assert np.count_nonzero(dark.surface >= 0) <= largest_count(2000, 130 * 2.9e-7)
    assert (dark.flags[0][dark.surface < 0] == EchoFlag.NO_ECHO).all()


def test_light_scattered_behind_a_bottom_does_not_hide_it():
    """A bottom with a tail of 20 ns: interpolated to the signal 1.5 widths behind it, a third would be found."""
    noise, count, decay = 0.04, 1000, 0.012
    fine = np.arange(-40, 160, 0.05)
    blur = np.exp(-0.5 * (np.arange(-10, 10, 0.05) / SIGMA) ** 2)
    tail = np.convolve(np.where(fine > 0, np.exp(-np.maximum(fine, 0) / 20), 0), blur / blur.sum(), "same")
    bottom = 0.5 * np.interp(TIME - 120, fine, tail)
    surface = echoes(20.0, 3.0)[0]
    rng = np.random.default_rng(8)
    shares = []
    for signal in (column(20.0, 120.0, decay=decay) + surface + bottom, column(20.0, decay=decay) + surface):
        found = find_echoes(Records.of(signal + noise * rng.normal(size=(count, TIME.size)), TIME, noise), FWHM)
        exists = found.bins[2] >= 0
        near = exists & (np.abs(TIME[found.bins[2]] - 122) < 6)
        assert np.mean(exists & ~near) < 0.004
        shares.append(near.mean())
    assert shares[0] > 0.5
    assert shares[1] < 0.004


def test_echoes_nearer_than_a_pulse_are_flagged_as_merged():
    resolved = echoes(60, 1.0)[0] + echoes(60 + 1.3 * FWHM, 1.0)[0]
    near = echoes(60, 1.0)[0] + echoes(60 + 1.1 * FWHM, 1.0)[0]
    single = echoes(60, 1.0)[0]
    hidden = echoes(60, 1.0)[0] + echoes(60 + 0.6 * FWHM, 1.0)[0]
    found = find_echoes(Records.of(np.stack([resolved, near, single, hidden]), TIME), FWHM)
    assert (found.bins[2] >= 0).tolist() == [True, True, False, False]
    merged = EchoFlag.MERGED
    assert (found.flags[0] & merged).astype(bool).tolist() == [False, True, False, True]
    assert (found.flags[2] & merged).astype(bool).tolist() == [False, True, False, True]


@refuses(
    ((np.ones((1, 9)), np.arange(8), 0.0), r"waveforms of shape \(1, 9\) must have the shape \(n, 8\)"),
    ((np.ones((1, 8)), np.arange(8)[::-1], 0.0), "time_ns must increase in equal steps"),
    ((np.ones((1, 8)), np.arange(8) ** 2, 0.0), "time_ns must increase in equal steps"),
    ((np.ones((1, 3)), np.arange(3), 0.0), "at least 8 times"),
    ((np.full((1, 8), np.nan), np.arange(8), 0.0), "waveforms holds nan"),
    ((np.ones((1, 8)), np.arange(8), -1.0), "noise = -1 must not be negative"),
    ((np.ones((2, 8)), np.arange(8), np.ones((2, 4))), "noise of shape"),
)
def test_invalid_records(arguments):
    Records.of(*arguments)


@refuses(
    ({"threshold": 0}, "threshold = 0 must be greater than 0"),
    ({"contrast": 1.0}, "contrast = 1 must be at least 0 and below 1"),
    ({"echo_fwhm_ns": -1.0}, "echo_fwhm_ns = -1 must be greater than 0"),
)
def test_invalid_detection_options(options):
    find_echoes(Records.of(echoes(60.0), TIME), **{"echo_fwhm_ns": FWHM, **options})
