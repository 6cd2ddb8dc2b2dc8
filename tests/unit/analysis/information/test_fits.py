"""Fits of a waveform in closed form: values, stated errors and their distribution, nuisances, and invalid input."""

import itertools

import numpy as np
import pytest
import xarray as xr
from closed_form_waveform import BIN, TIME, TRUTH, closed_form, noisy
from rows import each_row, refuses
from scipy.stats import chi2, kstest
from significance import FALSE_ALARM, largest_z

from mitransient_lidar.analysis.information.fits import WaveformFit
from mitransient_lidar.analysis.information.measured import measured
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.studies.fit import describe_fit, parameter_frame

#: Starts that are wrong by half.
WRONG = {name: value * factor for (name, value), factor in zip(TRUTH.items(), (0.5, 1.5, 0.5), strict=True)}


def fit(source, starts=None, bounds=None, model=closed_form, noise=None, **options):
    runs = {key: options.pop(key) for key in ("most_renders", "scale_errors") if key in options}
    found = measured(source, noise=noise)
    return WaveformFit(found, model, WRONG if starts is None else starts, bounds, **options).run(**runs)


def distance(fitted, truth=TRUTH):
    """Return the squared distance of the estimates from the truth in standard errors, by the stated covariance."""
    names = list(truth)
    error = fitted["value"].sel(parameter=names).values - np.array(list(truth.values()))
    return error @ np.linalg.solve(fitted["covariance"].sel(parameter=names, other_parameter=names).values, error)


def assert_chi_squared(distances, freedom):
    """Check mean and distribution of squared distances against those of chi-squared."""
    distances = np.array(distances)
    error = np.sqrt(2 * freedom / distances.size)
    assert abs(distances.mean() - freedom) < largest_z(10**4) * error, distances.mean()
    assert kstest(distances, chi2(freedom).cdf).pvalue > FALSE_ALARM


@pytest.mark.slow
def test_errors_that_neighbours_share_widen_the_covariance():
    """Errors smoothed over five samples, known by `error_inflation`: independent errors would be half as large."""
    random = np.random.default_rng(2)
    kernel = np.ones(5) / np.sqrt(5)
    lags = 1 - np.arange(5) / 5
    bins = [1, 2, 4, 8, 16, 32]
    inflation = [np.sqrt(1 + 2 * sum((1 - k / n) * lags[k] for k in range(1, min(n, 5)))) for n in bins]
    true = closed_form(TRUTH)["waveform"]
    fits = []
    for _ in range(16):
        errors = 0.002 * np.convolve(random.normal(size=TIME.size + 4), kernel, "valid")
        data = {"waveform": true + errors, "waveform_stderr": xr.full_like(true, 0.002)}
        attributes = {**BIN, "error_inflation_bins": bins, "error_inflation": inflation}
        fits.append(fit(xr.Dataset(data, attrs=attributes)))
    assert_chi_squared([distance(one) for one in fits], len(TRUTH))
    assert fits[0].attrs["freedom"] < 0.5 * TIME.size
    scores = np.array([one.attrs["chi_squared"] for one in fits]) - fits[0].attrs["expected"]
    spread = fits[0].attrs["expected"] * np.sqrt(2 / fits[0].attrs["freedom"])
    assert abs(scores.mean()) < largest_z(10**4) * spread / np.sqrt(len(fits))


@pytest.mark.slow
def test_unknown_scale_and_offset_are_recovered(tmp_path):
    """Counts that a CSV file holds at times of its own, 0.8 ns apart and 500.3 ns early; scattering is the scale's."""
    random = np.random.default_rng(3)
    times = np.arange(12.0, 150.0, 0.8)
    truth = {"attenuation": 0.2, "bottom_reflectance": 0.1, "scale": 5000.0, "time_offset_ns": -500.3}
    starts = {"attenuation": 0.3, "bottom_reflectance": 0.05}
    distances = []
    for _ in range(16):
        counts = 5000 * closed_form(TRUTH, times)["waveform"].values[0] + random.normal(0, 10, times.size)
        lines = (f"{time - 500.3:.6f},{count:.9g},10" for time, count in zip(times, counts, strict=True))
        (tmp_path / "counts.csv").write_text("\n".join(["time_ns,apd,apd_stderr", *lines]))
        fitted = fit(tmp_path / "counts.csv", starts)
        distances.append(distance(fitted, truth))
    assert_chi_squared(distances, len(truth))
    assert fitted["used"].values.sum() > 0.8 * times.size
    assert fitted["measured"].sizes == {"pixel": 1, "time": times.size}


@pytest.mark.slow
def test_noise_of_the_model_widens_the_covariance():
    """A model with the error of the data: the same for all values, as by common random numbers."""
    random = np.random.default_rng(5)
    distances = []
    for _ in range(20):
        errors = random.normal(0, 0.002, TIME.size)

        def model(values, errors=errors):
            exact = closed_form(values)
            return exact.assign(waveform=exact["waveform"] + errors, waveform_stderr=0 * exact["waveform"] + 0.002)

        fitted = fit(noisy(0.002, random), model=model)
        distances.append(distance(fitted))
    assert_chi_squared(distances, len(TRUTH))
    share = fitted["stderr_by_model"] / fitted["stderr"]
    np.testing.assert_allclose(share, np.sqrt(0.5), rtol=1e-6)


def assert_mean(distances):
    """Check the mean of squared distances, with its error from their scatter."""
    mean, error = np.mean(distances), np.std(distances, ddof=1) / np.sqrt(len(distances))
    assert abs(mean - len(TRUTH)) < largest_z(len(distances)) * error, mean


def of_passes(random, passes, shared, per_pass=0.01):
    """Return errors of the mean of passes, and of each pass, that one factor over all bins and single bins share."""
    light = closed_form(TRUTH)["waveform"].values[0]
    common = shared * random.normal(size=(passes, 1)) * light
    errors = common + per_pass * random.normal(size=(passes, light.size))
    return errors, {"waveform_stderr": (("pixel", "time"), errors.std(axis=0, ddof=1)[None] / np.sqrt(passes))}


def rendered(values, errors, stderr):
    """Return the closed form as if rendered in passes with given errors, each of which is a batch."""
    exact = closed_form(values)
    batches = exact["waveform"].values + errors[:, None]
    return exact.assign(
        waveform=exact["waveform"] + errors.mean(axis=0), waveform_batch=(("batch", "pixel", "time"), batches), **stderr
    ).assign_coords(batch_passes=("batch", np.ones(len(errors), dtype=int)))


@pytest.mark.slow
def test_errors_of_all_bins_that_agree_are_in_the_covariance():
    """A model of 16 passes whose errors are a common factor for the larger part, which only batches of passes show."""
    random = np.random.default_rng(9)
    distances = []
    for _ in range(60):
        own = of_passes(random, 16, 0.1)
        distances.append(
            distance(fit(noisy(0.002, random), TRUTH, model=lambda values, own=own: rendered(values, *own)))
        )
    assert_mean(distances)


@pytest.mark.slow
def test_standard_errors_from_few_passes_widen_the_covariance():
    """Data of 8 passes, whose own standard errors as weights gave mean squared distances of 5.9 to 9.1."""
    random = np.random.default_rng(10)
    distances = []
    for _ in range(100):
        data = rendered(TRUTH, *of_passes(random, 8, 0.01))
        distances.append(distance(fit(data.drop_vars("waveform_derivative"), TRUTH)))
    assert_mean(distances)


def test_exact_waveforms_are_fitted_far_within_their_errors_with_few_renders():
    """Near a render the model is taken as linear: last steps are not rendered."""
    fitted = fit(closed_form(TRUTH), noise=0.001)
    assert distance(fitted) < 0.02**2
    assert fitted.attrs["renders"] < 10
    assert fitted.attrs["converged"]
    assert fitted["parameter_units"].values.tolist() == ["1/m", "1/m", "1"]
    np.testing.assert_array_equal(fitted["start"], list(WRONG.values()))
    np.testing.assert_allclose(np.diag(fitted["correlation"]), 1)
    lines = describe_fit(fitted)
    assert lines[1].split()[0] == "attenuation"
    assert float(lines[1].split()[1]) == pytest.approx(0.2, rel=1e-3)
    assert lines[-1] == f"{fitted.attrs['renders']} renders"
    frame = parameter_frame(fitted)
    assert [*frame][:3] == ["parameter", "unit", "value"]
    assert [*frame["parameter"]] == list(TRUTH)


@pytest.mark.parametrize("deviation", [0.02, 0.0002])
def test_logarithms_lead_from_wrong_starts_to_the_solution_with_few_renders(deviation):
    """Every combination of half and of one and a half times the truth, against the fit from the truth."""
    found = measured(noisy(deviation, np.random.default_rng(12)))
    wanted = WaveformFit(found, closed_form, TRUTH).run()
    for factors in itertools.product((0.5, 1.5), repeat=len(TRUTH)):
        starts = {name: value * factor for (name, value), factor in zip(TRUTH.items(), factors, strict=True)}
        problem = WaveformFit(found, closed_form, starts)
        problem.approach()
        near = np.array([problem.values[name] for name in TRUTH])
        assert np.all(np.abs(near - wanted["value"]) < 0.1 * wanted["value"] + 3 * wanted["stderr"])
        assert problem.renders <= 6
        fitted = problem.run()
        assert fitted.attrs["converged"]
        assert fitted.attrs["renders"] <= 7
        np.testing.assert_array_equal(fitted["start"], list(starts.values()))
        off = (fitted["value"] - wanted["value"]).values
        assert off @ np.linalg.solve(wanted["covariance"].values, off) < 0.2**2


def test_bounds_are_kept():
    fitted = fit(closed_form(TRUTH), bounds={"attenuation": (0.05, 0.15)}, noise=0.002)
    assert 0.1499 <= fitted["value"].sel(parameter="attenuation") <= 0.15
    assert fitted["at_bound"].values.tolist() == [1, 0, 0]
    assert np.isnan(fitted["stderr"].values).tolist() == [True, False, False]
    assert any(text.startswith("attenuation is at its bound 0.15") for text in fitted.attrs["messages"])
    assert "unknown" in describe_fit(fitted)[1]


def test_errors_are_taken_from_residuals_where_they_are_unknown():
    """The reduced chi-squared is the variance of the noise, known to 11 % from 160 samples."""
    data = noisy(0.002, np.random.default_rng(6))
    known, unknown = fit(data), fit(data.drop_vars("waveform_stderr"))
    factor = np.sqrt(known.attrs["chi_squared"] / known.attrs["expected"])
    np.testing.assert_allclose(unknown["stderr"], factor * known["stderr"], rtol=3e-3)
    np.testing.assert_allclose(fit(data, scale_errors=True)["stderr"], unknown["stderr"], rtol=3e-3)
    assert np.isnan(unknown.attrs["probability"])
    assert any("errors of the waveforms are unknown" in text for text in unknown.attrs["messages"])


def test_impossible_steps_are_shortened_and_the_fit_goes_on():
    """A scene whose scattering must not exceed its attenuation, as of renders; a full first step does."""
    refused = []

    def model(values):
        if values["scattering"] > values["attenuation"]:
            refused.append(values)
            raise UserError("scattering must not exceed attenuation")
        return closed_form(values)

    starts = {"attenuation": 0.6, "scattering": 0.01, "bottom_reflectance": 0.02}
    fitted = fit(closed_form(TRUTH), starts, model=model, noise=0.002)
    assert refused
    assert fitted.attrs["converged"]
    np.testing.assert_allclose(fitted["value"], list(TRUTH.values()), rtol=1e-4)


@each_row(0, 1, 2, 3, 4)
def test_an_interrupted_fit_has_its_last_step(complete):
    """Ctrl-C in the render after so many, of an approach with a coarse model and of the fit that follows it."""
    renders = []

    def model(values):
        if len(renders) == complete:
            raise KeyboardInterrupt
        renders.append(values)
        return closed_form(values)

    def interrupted():
        problem = WaveformFit(measured(closed_form(TRUTH), noise=0.002), model, WRONG)
        problem.approach()
        if not problem.interrupted:
            problem.forget()
        return problem.run()

    if complete == 0:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        return
    fitted = interrupted()
    assert (fitted.attrs["interrupted"], fitted.attrs["converged"], fitted.attrs["renders"]) == (1, 0, complete)
    assert fitted.attrs["messages"][0].startswith("the fit has not converged in ")
    assert np.isfinite(fitted.attrs["chi_squared"])
    if complete == 4:
        np.testing.assert_allclose(fitted["value"], list(TRUTH.values()), rtol=0.1)


def test_some_pixels_are_fitted_by_their_names():
    data = noisy(0.002, np.random.default_rng(7), pixels=("a", "b", "c")).isel(pixel=[2, 0])

    def model(values):
        return closed_form(values, pixels=("a", "b", "c"))

    fitted = fit(data, model=model)
    assert fitted["fitted"]["pixel"].values.tolist() == ["c", "a"]
    assert abs(fitted["residual"]).max() < 6
    with pytest.raises(UserError, match="the scene has no pixel c: its pixels are a, b"):
        fit(data, model=lambda values: closed_form(values, pixels=("a", "b")))


@refuses(
    ({"starts": {**TRUTH, "bottom_reflectance": 1.2}}, "start of bottom_reflectance = 1.2 must lie between 0 and 1"),
    ({"starts": {"scale": 1.0}}, "start of scale: it is fixed"),
    ({"starts": {}}, "free = '' must name at least one parameter"),
    ({"starts": {"depth": 3.0}}, "no derivative by depth, only by attenuation, scattering, bottom_reflectance"),
    ({"bounds": {"attenuation": (0.4, 0.3)}}, "bounds of attenuation = 0.4, 0.3 must increase"),
    ({"bounds": {"scattered": (0, 1)}}, "bounds of scattered: it is not one of the free parameters attenuation"),
    ({"model": lambda values: closed_form(values, TIME + 500)}, "have 0 samples from 0 to 159 ns within the record"),
    ({"model": lambda values: closed_form(values).drop_vars("waveform_derivative")}, "no variable waveform_deriv"),
    ({"model": lambda values: np.inf * closed_form(values)}, "waveform of the model has 160 values"),
)
def test_invalid_input_is_refused(options):
    fit(noisy(0.002, np.random.default_rng(8)), **options)


def test_samples_without_value_or_error_are_left_out(tmp_path):
    lines = [
        f"{time},{light:.9g},0.002" for time, light in zip(TIME, closed_form(TRUTH)["waveform"][0].values, strict=True)
    ]
    lines[50], lines[60] = "50,,0.002", "60,7,"
    (tmp_path / "gaps.csv").write_text("\n".join(["time_ns,single,single_stderr", *lines]))
    fitted = fit(tmp_path / "gaps.csv", free_scale=False, free_time=False)
    np.testing.assert_allclose(fitted["value"], list(TRUTH.values()), rtol=1e-5)
    assert np.flatnonzero(fitted["used"][0] == 0).tolist() == [50, 60]
    assert fitted.attrs["expected"] == pytest.approx(TIME.size - 2 - len(TRUTH))
