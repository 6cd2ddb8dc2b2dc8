"""Reading of waveforms to fit: results, signals and tables, and their errors."""

import numpy as np
import pytest
import xarray as xr
from closed_form_waveform import TIME, TRUTH, closed_form, noisy
from rows import must_refuse, refuses
from scipy.special import ndtr
from significance import largest_z

from mitransient_lidar import results
from mitransient_lidar.analysis.information.errors import noise_of_mean
from mitransient_lidar.analysis.information.measured import batch_deviations, correlation, measured, predict
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.receiver.electronics import Digitiser
from mitransient_lidar.results import save

TABLE = "time_ns,a,a_stderr,b,b_stderr\n1.0,2,0.1,4,0.2\n1.5,3,0.1,,0.2\n2.5,5,0.1,6,0.2\n"


def test_a_table_has_pixels_errors_and_missing_values(tmp_path):
    (tmp_path / "some.csv").write_text(TABLE)
    found = measured(tmp_path / "some.csv")
    np.testing.assert_array_equal(found.time_ns, [1, 1.5, 2.5])
    np.testing.assert_array_equal(found.values, [[2, 3, 5], [4, np.nan, 6]])
    np.testing.assert_array_equal(found.stderr, [[0.1] * 3, [0.2] * 3])
    assert found.template["pixel"].values.tolist() == ["a", "b"]
    assert not found.calibrated
    np.testing.assert_array_equal(measured(tmp_path / "some.csv", noise=3).stderr, np.full((2, 3), 3))


@refuses(
    ("", "must begin with a heading of time_ns"),
    ("t,a\n1,2\n2,3", "must begin with a heading of time_ns"),
    ("time_ns,a,a\n1,2,3\n2,3,4", "two columns 'a'"),
    ("time_ns" + 2 * 10**5 * ",a" + "\n1,2", "two columns 'a'"),
    ("time_ns," + 2 * 10**5 * " " + "a\n1,2", "is not a CSV file"),
    ("time_ns,a\n1,2", "has 1 rows of numbers: it must have 2 or more"),
    ("time_ns,a\n1,2\n2", "row 3 has 1 values but must have 2"),
    ("time_ns,a\n1,2\n2,x", "row 3: a = 'x' must be a number"),
    ("time_ns,a\n1,2\n,3", "row 3: time_ns = '' must be a number"),
    ("time_ns,a\n1,2\n2,inf", "row 3: a = inf must be finite"),
    ("time_ns,a\n2,2\n1,3", "time_ns = 2, 1: it must increase strictly"),
    ("time_ns,a,b,a_stderr\n1,2,3,1\n2,2,3,1", "the column b_stderr is missing"),
    ("time_ns,a,a_stderr\n1,2,1\n2,2,0", "a_stderr = 0: it must be greater than 0"),
)
def test_invalid_tables_are_refused(text, tmp_path):
    (tmp_path / "some.csv").write_text(text)
    measured(tmp_path / "some.csv")


def test_a_result_has_its_own_errors(tmp_path):
    data = noisy(0.01, np.random.default_rng(1))
    light = data.assign(impulse_response=data["waveform"], impulse_response_stderr=data["waveform_stderr"])
    results.save(light, tmp_path / "result.nc")
    found = measured(tmp_path / "result.nc")
    np.testing.assert_array_equal(found.values, data["waveform"])
    np.testing.assert_array_equal(found.stderr, data["waveform_stderr"])
    assert found.calibrated
    must_refuse("receiver is that of a signal or a table", measured, light, receiver="apd")
    with pytest.raises(UserError, match="source is another dataset, but must have waveforms over time or signals"):
        measured(xr.Dataset({"energy": data["waveform"]}))


def test_a_signal_is_the_mean_of_its_records(tmp_path):
    recorded = detect_waveforms(closed_form(TRUTH, power=3e-7), "apd", shots=5, background_power=1e-9)
    save(recorded, tmp_path / "signals.nc")
    found = measured(tmp_path / "signals.nc")
    np.testing.assert_allclose(found.values, recorded["signal"].mean("shot"), rtol=1e-5)
    assert found.shots == 5
    assert found.receiver.backgrounds.tolist() == [1e-9]
    # A sample that one record has not stored is missing: the mean of the others would be that of the high ones.
    gap = recorded["signal"].where((recorded["shot"] != 2) | (recorded["time"] != 20))
    assert np.flatnonzero(np.isnan(measured(recorded.assign(signal=gap)).values[0])).tolist() == [20]
    must_refuse(r"noise = 0\.1 is that of the receiver", measured, recorded, noise=0.1)
    del recorded.attrs["receiver"]
    must_refuse("the signal does not name its receiver", measured, recorded)


@pytest.mark.parametrize("receiver", ["apd", "pmt_log", "spad"])
def test_predictions_behind_a_receiver_are_its_closed_form(receiver):
    """Mean and variance are those of the record, and derivatives differences of means of other parameters."""
    light = closed_form(TRUTH, power=3e-7)
    recorded = detect_waveforms(light, receiver, background_power=1e-9)
    found = measured(recorded)
    one = predict(found, light, list(TRUTH))
    np.testing.assert_allclose(one.mean, recorded["signal_mean"])
    np.testing.assert_allclose(np.sqrt(one.noise_variance), recorded["signal_deviation"])
    for number, name in enumerate(TRUTH):
        means = [
            detect_waveforms(closed_form({**TRUTH, name: factor * TRUTH[name]}, power=3e-7), receiver,
                             background_power=1e-9)["signal_mean"].values
            for factor in (1.001, 0.999)
        ]  # fmt: skip
        slope = (means[0] - means[1]) / (0.002 * TRUTH[name])
        np.testing.assert_allclose(one.derivative[number], slope, atol=2e-3 * np.abs(slope).max())


@pytest.mark.parametrize("noise", [0.0, 0.15])
def test_noise_of_the_mean_of_many_records_holds_rounding(noise):
    """Mean square over voltages of the error of a mean of 10^6 records behind a converter, in steps of it."""
    converter = Digitiser(8, 256.0, -128.0)
    volts = (np.arange(100) + 0.5) / 100
    codes = np.arange(-6, 8)
    upper, lower = (ndtr((codes + edge - volts[:, np.newaxis]) / max(noise, 1e-9)) for edge in (0.5, -0.5))
    wanted = np.mean(((upper - lower) @ codes - volts) ** 2)
    variance = np.array([noise**2 + 1 / 12])
    assert noise_of_mean(variance, converter, 10**6)[0] == pytest.approx(max(wanted, variance[0] / 1e6), rel=0.05)
    assert noise_of_mean(variance, converter, 1) == variance


def in_batches(dataset, deviations, passes):
    """Return a result with batches of passes that deviate from the mean, shape (batch, pixel, time)."""
    means = (("batch", "pixel", "time"), dataset["waveform"].values + deviations)
    return dataset.assign(waveform_batch=means).assign_coords(batch_passes=("batch", passes))


def test_batches_of_passes_give_the_covariance_of_the_mean():
    """Of batches of one pass each, it is the sample covariance over the number of passes."""
    deviations = np.random.default_rng(2).normal(size=(6, 1, TIME.size))
    deviations -= deviations.mean(axis=0)
    found = batch_deviations(in_batches(closed_form(TRUTH), deviations, np.ones(6, dtype=int)), ("pixel", "time"))
    np.testing.assert_allclose(np.einsum("bpi,bpj->ij", found, found), np.cov(deviations[:, 0].T) / 6, atol=1e-12)
    assert batch_deviations(closed_form(TRUTH), ("pixel", "time")) is None


def test_batches_of_unequal_numbers_of_passes_are_weighted():
    """Means of 1 to 3 passes: the expected outer products are the variance of the mean of all passes, 1/8 of one."""
    random, passes = np.random.default_rng(3), np.array([3, 2, 2, 1])
    means = random.normal(size=(4, 1, 40_000)) / np.sqrt(passes)[:, None, None]
    light = xr.Dataset({"waveform": (("pixel", "time"), np.average(means, axis=0, weights=passes))})
    found = batch_deviations(in_batches(light, means - light["waveform"].values, passes), ("pixel", "time"))
    variances = np.sum(found[:, 0] ** 2, axis=0)
    assert abs(variances.mean() - 1 / 8) < largest_z(variances.size) * variances.std() / np.sqrt(variances.size)


def test_batches_of_passes_are_taken_through_the_receiver():
    """Batches that deviate as by another attenuation change the record by the derivative."""
    light, step = closed_form(TRUTH, power=3e-7, pixels=("a", "b")), 1e-3
    other = step * light["waveform_derivative"].sel(parameter="attenuation").values
    found = measured(detect_waveforms(light, "apd", background_power=1e-9))
    one = predict(found, in_batches(light, np.stack([other, -other]), [4, 4]), list(TRUTH))
    slope = step * one.derivative[0] * 0.5 * np.sqrt(2)
    np.testing.assert_allclose(one.batches, [slope, -slope], atol=2e-3 * np.abs(slope).max())


def test_correlations_have_the_inflation_that_they_follow_from():
    """The inflation of means of 1 to 64 bins of a render of `table1`, with a pulse of 5 ns."""
    bins, inflation = [1, 2, 4, 8, 16, 32, 64], [1.0, 1.398, 1.894, 2.385, 2.653, 2.819, 2.958]
    lags = correlation({"error_inflation_bins": bins, "error_inflation": inflation})
    assert lags.size == 64
    for count, expected in zip(bins, inflation, strict=True):
        k = np.arange(1, count)
        assert np.sqrt(1 + 2 * np.sum((1 - k / count) * lags[1:count])) == pytest.approx(expected)
    np.testing.assert_array_equal(correlation({}), [1])
