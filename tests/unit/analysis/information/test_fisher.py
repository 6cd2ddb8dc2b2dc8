"""Fisher information of records and its bounds, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from differentiated import PHOTON, result
from rows import refuses
from significance import largest_chi2, largest_z

from mitransient_lidar.analysis.information.cramer_rao import bounds
from mitransient_lidar.analysis.information.fisher import fisher_information
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.physics.receiver.chain import ReceiverChain
from mitransient_lidar.physics.receiver.detectors import LinearDetector, SinglePhotonDetector
from mitransient_lidar.physics.receiver.electronics import Amplifier, Digitiser

ELECTRON = 1.602176634e-19
T = np.arange(60.0)
#: Voltage of a photon a bin, and noise of an amplifier that is limited by its bins alone.
VOLTS = ELECTRON / 1e-9 * 1e4
WHITE = ReceiverChain(LinearDetector(1.0), Amplifier(1e4, 1e4))
DEVIATION = 1e4 * 1e-12 * 1e4 * np.sqrt(0.5e9)
#: Photons a bin of an exponential decay, and its derivatives by height and rate.
HEIGHT, RATE = 2000.0, 0.1
DECAY = HEIGHT * np.exp(-RATE * T)
BY_NAME = {"height": DECAY / HEIGHT, "rate": -T * DECAY}


def decay(photons=1.0, **options):
    slopes = {name: photons * PHOTON * one for name, one in BY_NAME.items()}
    return result(photons * PHOTON * DECAY, slopes, **options)


def pulse(height, sigma=4.0, centre=30.0):
    """Return photons a bin of a Gaussian pulse of a height, and the derivative by its time."""
    shape = height * np.exp(-0.5 * ((T - centre) / sigma) ** 2)
    return shape, shape * (T - centre) / sigma**2


def test_decay_in_white_noise():
    """Amplifier noise, 1e9 times the variance of the shot noise: sums of products over the variance."""
    found = fisher_information(decay(), WHITE)
    slopes = VOLTS * np.stack([*BY_NAME.values()])
    by_hand = slopes @ slopes.T / DEVIATION**2
    np.testing.assert_allclose(found["information"], by_hand, rtol=1e-4)
    bound = np.sqrt(np.diagonal(np.linalg.inv(by_hand)))
    np.testing.assert_allclose(found["bound"], bound, rtol=1e-4)
    np.testing.assert_allclose(found["bound_known"], np.diagonal(by_hand) ** -0.5, rtol=1e-4)
    # With x = exp(-2 rate), sums of x^n, n x^n and n^2 x^n; those beyond the record are 5e-4 of the last.
    x = np.exp(-2 * RATE)
    sums = 1 / (1 - x), x / (1 - x) ** 2, x * (1 + x) / (1 - x) ** 3
    correlation = sums[1] / np.sqrt(sums[0] * sums[2])
    assert float(found["correlation"][0, 1]) == pytest.approx(correlation, abs=1e-3)


def test_time_offset_is_the_difference_of_bins():
    """A pulse that comes a bin later less one that comes a bin earlier, over two bins; the height is uncorrelated."""
    shape, later, earlier = (pulse(300.0, centre=centre)[0] for centre in (30, 31, 29))
    light = result(PHOTON * shape, {"height": PHOTON * shape})
    found = fisher_information(light, "ideal", nuisances={"time_offset": np.inf})
    information = np.sum((0.5 * (later - earlier)) ** 2 / shape)
    assert float(found["bound"].sel(parameter="time_offset")) == pytest.approx(information**-0.5, rel=1e-4)
    assert found["parameter_units"].values.tolist() == ["1/m", "ns"]


def test_samples_correlated_by_a_single_pole():
    """Amplifier noise is an autoregression of first order; its inverse covariance is that of its innovations."""
    chain = ReceiverChain(LinearDetector(1.0), Amplifier(1e4, 1e4, bandwidth_mhz=150.0))
    data = decay()
    found = fisher_information(data, chain)
    recorded = [detect_waveforms(data.assign(waveform=abs(one)), chain) for one in data["waveform_derivative"]]
    slopes = np.stack([one["signal_mean"].values[0] for one in recorded]) * np.array([[1], [-1]])
    step = 2 * np.pi * 0.15
    innovation = (slopes[:, 1:] - np.exp(-step) * slopes[:, :-1]) / np.sqrt(1 - np.exp(-2 * step))
    whitened = np.concatenate([slopes[:, :1], innovation], axis=1)
    deviation = 1e4 * 1e-12 * 1e4 * np.sqrt(0.5e6 * np.pi * 150)
    np.testing.assert_allclose(found["information"], whitened @ whitened.T / deviation**2, rtol=1e-4)


def test_information_in_the_variance_of_shot_noise():
    """20 electrons a bin without correlation: m_a m_b/v + v_a v_b/(2 v^2) v the variance of both noises."""
    chain = ReceiverChain(LinearDetector(1.0), Amplifier(1e4, 0.03))
    found = fisher_information(decay(photons=0.01), chain)
    slopes = 0.01 * VOLTS * np.stack([*BY_NAME.values()])
    variance = VOLTS**2 * 0.01 * DECAY + (3e-6 * DEVIATION) ** 2
    assert 0.2 < (3e-6 * DEVIATION) ** 2 / (VOLTS**2 * 20) < 5
    of_variance = 0.5 * (VOLTS * slopes / variance) @ (VOLTS * slopes / variance).T
    np.testing.assert_allclose(found["information"], slopes / variance @ slopes.T + of_variance, rtol=1e-6)
    share = np.diagonal(of_variance) / np.diagonal(found["information"].values)
    np.testing.assert_allclose(found["variance_share"], share, rtol=1e-6)


def test_rounding_and_saturation():
    """Coarse rounding adds step^2/12; samples above the limit carry nothing."""
    coarse = replace(WHITE, digitiser=Digitiser(8, 256 * 2 * DEVIATION, -128 * 2 * DEVIATION))
    data = decay(photons=1e4)
    ratio = fisher_information(data, WHITE)["information"] / fisher_information(data, coarse)["information"]
    np.testing.assert_allclose(ratio, 1 + 4 / 12, rtol=1e-3)
    limit = 1e4 * VOLTS * DECAY[9] + 2 * DEVIATION
    clipped = ReceiverChain(WHITE.detector, Amplifier(1e4, 1e4, limit_v=limit))
    found = fisher_information(data, clipped)
    saturation = detect_waveforms(data, clipped)["saturation"][0].values
    lost = int(np.count_nonzero(saturation > 0.05))
    assert 5 < lost < 30
    assert float(found["lost_samples"][0]) == pytest.approx(lost / T.size)
    slopes = 1e4 * VOLTS * np.stack([*BY_NAME.values()])[:, saturation <= 0.05]
    np.testing.assert_allclose(found["information"], slopes @ slopes.T / DEVIATION**2, rtol=1e-3)


def test_fits_of_counts_scatter_as_the_bound(record_property):
    """Maximum likelihood of 400 records of Poisson counts: sum of squares in units of the bound is chi-squared."""
    data = decay()
    found = fisher_information(data, "ideal")
    counts = detect_waveforms(data, "ideal", shots=400, seed=5)["signal"].values[:, 0]
    truth, information = np.array([HEIGHT, RATE]), found["information"].values
    fits = np.empty((400, 2))
    for number, record in enumerate(counts):
        height, rate = truth
        for _ in range(6):  # Fisher's scoring, for the Poisson likelihood
            mean = height * np.exp(-rate * T)
            slopes = np.stack([mean / height, -T * mean])
            score = slopes @ (record / mean - 1)
            height, rate = np.array([height, rate]) + np.linalg.solve((slopes / mean) @ slopes.T, score)
        fits[number] = height, rate
    error = fits - truth
    squares = np.einsum("ia,ab,ib->", error, information, error)
    record_property("chi2_per_freedom", float(squares / 800))
    assert squares < largest_chi2(800)
    # The scatter is no smaller, either: sums of 800 squares have the standard error sqrt(2 / 800).
    assert squares > 800 * (1 - largest_z(800) * np.sqrt(2 / 800))


def test_noise_of_one_render_is_reported():
    """Errors of derivatives add their square over the variance: exact for Poisson counts without correlation."""
    error = 0.05 * np.abs(BY_NAME["rate"]).max()
    found = fisher_information(decay(errors={"rate": PHOTON * error}), "ideal")
    share = np.sum(error**2 / DECAY) / np.sum(BY_NAME["rate"] ** 2 / DECAY)
    np.testing.assert_allclose(found["monte_carlo_share"], [0, share], rtol=1e-9)
    assert "adds" in found.attrs["remarks"]
    assert "information about rate: its bound is too low" in found.attrs["remarks"]


@pytest.mark.slow
def test_noise_of_renders_does_not_count_as_information():
    """Derivatives with correlated errors, 80 times: the mean over the trials is the matrix without errors."""
    random = np.random.default_rng(4)
    exact = fisher_information(decay(), "ideal")["information"].values
    spread = 0.08 * np.abs(BY_NAME["rate"]).max()
    trials, naive = np.empty((80, 2, 2)), np.empty((80, 2, 2))
    for number in range(80):
        renders = []
        for _ in range(3):
            noise = spread * random.normal(size=T.size)
            # Both derivatives come from the same paths.
            slopes = {"height": BY_NAME["height"] + noise / 5000, "rate": BY_NAME["rate"] + noise}
            renders.append(result(PHOTON * DECAY, {name: PHOTON * one for name, one in slopes.items()}))
        found = fisher_information(renders, "ideal")
        trials[number] = found["information"].values
        naive[number] = fisher_information(renders[0], "ideal")["information"].values
    z = (trials.mean(axis=0) - exact) / (trials.std(axis=0, ddof=1) / np.sqrt(80))
    assert np.max(np.abs(z)) < largest_z(80, 4)
    bias = (naive.mean(axis=0) - exact) / (naive.std(axis=0, ddof=1) / np.sqrt(80))
    assert np.min(np.diagonal(bias)) > largest_z(80, 2)


@pytest.mark.slow
def test_error_of_a_bound_by_renders():
    """The jackknife's error of bounds of three noisy renders has the scatter of bounds between trials."""
    random = np.random.default_rng(8)
    bounds, errors = [], []
    for _ in range(40):
        renders = []
        for _ in range(4):
            slopes = {name: one * (1 + 0.05 * random.normal(size=T.size)) for name, one in BY_NAME.items()}
            renders.append(result(PHOTON * DECAY, {name: PHOTON * one for name, one in slopes.items()}))
        found = fisher_information(renders, "ideal")
        assert found["bound_left_out"].sizes == {"render": 4, "parameter": 2}
        bounds.append(found["bound"].values)
        errors.append(found["bound_stderr"].values)
    scatter = np.std(bounds, axis=0, ddof=1)
    stated = np.sqrt(np.mean(np.square(errors), axis=0))
    # Two standard errors of 40 and 120 degrees of freedom; the jackknife overstates by some per cent (Efron, Stein).
    assert np.all(stated > scatter * (1 - largest_z(40) * np.sqrt(1 / 80 + 1 / 240)))
    assert np.all(stated < scatter * (1.1 + largest_z(40) * np.sqrt(1 / 80 + 1 / 240)))


def test_known_scale_narrows_the_bound():
    """A scale that is known to s is a measurement of it: between unknown and known."""
    light = PHOTON * DECAY
    slopes = {"rate": PHOTON * BY_NAME["rate"]}

    def bound(**nuisances):
        found = fisher_information(result(light, slopes), "ideal", nuisances=nuisances)
        return float(found["bound"].sel(parameter="rate"))

    f = fisher_information(decay(), "ideal")["information"].values * np.outer([HEIGHT, 1], [HEIGHT, 1])
    for known in (np.inf, 0.01, 1e-9):
        expected = np.linalg.inv(f + np.diag([known**-2, 0]))[1, 1] ** 0.5
        assert bound(scale=known) == pytest.approx(expected, rel=1e-6)
    assert bound() == pytest.approx(f[1, 1] ** -0.5)


def test_counter_with_dead_time():
    """Steady light on a counter: the counts of a renewal process give the rate to the deviation of their number.

    For m bins, rate r and dead time d the number has the variance N (1 - d N/m)^2, and the mean m r/(1 + r d): the
    information about ln r is m r/(1 + r d), that of one Poisson event a count.
    """
    bins = 500
    light = np.full(bins, 0.02 * PHOTON)
    chain = ReceiverChain(SinglePhotonDetector(1.0, 5.5))
    found = fisher_information(result(light, {"log_rate": light}), chain)
    counts = float(detect_waveforms(result(light, {"log_rate": light}), chain)["signal_mean"].sum())
    # Bins of 2 % differ from continuous time by some of 2 %.
    assert float(found["information"][0, 0]) == pytest.approx(counts, rel=0.02)


def test_parameters_without_influence_and_degenerate_pairs():
    slopes = {"height": PHOTON * BY_NAME["height"], "twice": 2 * PHOTON * BY_NAME["height"], "none": 0 * T}
    found = fisher_information(result(PHOTON * DECAY, {**slopes, "rate": PHOTON * BY_NAME["rate"]}), "ideal")
    remarks = found.attrs["remarks"].splitlines()
    assert "none has no influence on the record: no bound" in remarks
    assert "height and twice cannot be told apart by the record: no bounds" in remarks
    assert np.isinf(found["bound"].values[:3]).all()
    nearly = {"height": BY_NAME["height"], "nearly": BY_NAME["height"] * (1 + 0.02 * np.sin(T))}
    found = fisher_information(result(PHOTON * DECAY, {name: PHOTON * one for name, one in nearly.items()}), "ideal")
    assert np.isfinite(found["bound"]).all()
    assert "height and nearly have a correlation of -0.99" in found.attrs["remarks"]


@refuses(
    (lambda data: data.drop_vars("waveform_derivative"), {}, "has no waveform_derivative"),
    (lambda data: data.assign(waveform_derivative=np.nan * data["waveform_derivative"]), {}, "not finite"),
    (lambda data: [data, data.assign_coords(time=data["time"] + 1)], {}, "the renders differ in time"),
    (lambda data: [], {}, "must hold at least one result"),
    (lambda data: data, {"nuisances": {"phase": 1.0}}, "nuisance = 'phase' must be one of time_offset, scale"),
    (lambda data: data, {"nuisances": {"scale": 0.0}}, "scale = 0.0 must be a standard deviation above 0"),
    (lambda data: data.assign(waveform_derivative=0 * data["waveform_derivative"]), {}, "no information"),
)
def test_invalid_input(change, options):
    fisher_information(change(decay()), **{"chain": "ideal", **options})


def test_bounds_of_two_parameters_in_closed_form():
    """1/sqrt(F_aa (1 - r^2)) for a correlation r of the derivatives, and -r for the estimates, in any units."""
    r = 0.6
    matrix = np.array([[4.0, r * 2 * 1e6], [r * 2 * 1e6, 1e12]])
    found = bounds(matrix, ["a", "b"])
    np.testing.assert_allclose(found.bound_known, [0.5, 1e-6])
    np.testing.assert_allclose(found.bound, [0.5 / 0.8, 1e-6 / 0.8])
    np.testing.assert_allclose(found.correlation, [[1, -r], [-r, 1]])
    assert found.smallest == pytest.approx(1 - r)
    assert found.remarks == []


def test_parameters_beside_a_degenerate_pair_keep_their_bounds():
    matrix = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 25.0]])
    found = bounds(matrix, ["a", "b", "c"])
    np.testing.assert_allclose(found.bound, [np.inf, np.inf, 0.2])
    assert np.isnan(found.correlation[0]).all()
    assert found.remarks == ["a and b cannot be told apart by the record: no bounds"]


def test_a_matrix_that_noise_makes_indefinite_is_no_degeneracy():
    found = bounds(np.array([[1.0, 1.1], [1.1, 1.0]]), ["a", "b"])
    assert np.isinf(found.bound).all()
    (remark,) = found.remarks
    assert remark.startswith("the noise of the render hides what the record tells about a and b (eigenvalue -0.1")
    found = bounds(np.zeros((2, 2)), ["a", "b"])
    assert np.isinf(found.bound).all()
    assert found.remarks == [f"{name} has no influence on the record: no bound" for name in "ab"]
