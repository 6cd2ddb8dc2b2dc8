"""Fits of scenes with replaced renders: values of parameters and layers, seeds, passes, and the command."""

import numpy as np
import pytest
import xarray as xr
from closed_form_waveform import TRUTH, closed_form, noisy
from rows import must_refuse, refuses

import mitransient_lidar
from mitransient_lidar.rendering.passes import Progress
from mitransient_lidar.studies import fit as study

NAMES = ["attenuation", "bottom_reflectance"]


@pytest.fixture
def renders(monkeypatch):
    """Options of all renders, which return the waveform in closed form with an error of 0.006 / sqrt(passes)."""
    found = []

    def render(scene, *, params, derivatives, passes, **options):
        found.append({"scene": scene, "params": params, "passes": passes, **options})
        values = {name: float(params[name]) for name in derivatives}
        exact = closed_form(values, pixels=("red",)).sel(parameter=list(derivatives))
        return exact.assign(waveform_stderr=xr.full_like(exact["waveform"], 0.006 / np.sqrt(passes)))

    monkeypatch.setattr(study, "render", render)
    return found


def test_starts_are_those_of_the_scene_and_seeds_differ_from_the_result(renders):
    data = noisy(0.01, np.random.default_rng(2), pixels=("red",)).assign_attrs(seed=5)
    states = []
    fitted = mitransient_lidar.fit(data, "table1", NAMES, params={"wind_speed": 2}, progress=states.append)
    assert fitted["start"].values.tolist() == [0.3, 0.1]
    params = {"wind_speed": 2, "attenuation": "0.3", "bottom_reflectance": "0.1"}
    options = {"passes": 4, "batches": 4, "seed": 6, "instrument": None}
    assert renders[0] == {"scene": "table1", "params": params, **options}
    assert {one["seed"] for one in renders} == {6}
    assert [one["passes"] for one in renders] == sorted(one["passes"] for one in renders)
    assert len(renders) == fitted.attrs["renders"] == states[-1].done
    assert isinstance(states[0], Progress)
    assert fitted.attrs["scene"] == "table1"
    error = fitted["value"].values - [TRUTH[name] for name in NAMES]
    assert np.abs(error / fitted["stderr"]).max() < 6
    must_refuse("seed = 5 is that of the result", mitransient_lidar.fit, data, "table1", NAMES, seed=5)


def test_options_change_the_fit(renders):
    """Errors by the residuals are the stated ones times the root of chi-squared; a free time is a further parameter."""
    data = noisy(0.01, np.random.default_rng(4), pixels=("red",))
    plain, scaled, timed = (
        mitransient_lidar.fit(data, "table1", NAMES, **one)
        for one in ({}, {"scale_errors": True}, {"free_time": True, "free_scale": False})
    )
    assert plain["parameter"].values.tolist() == NAMES
    assert timed["parameter"].values.tolist() == [*NAMES, "time_offset_ns"]
    np.testing.assert_array_equal(plain["value"], scaled["value"])
    ratio = (scaled["stderr"] / plain["stderr"]).values
    assert ratio[0] == pytest.approx(ratio[1])
    assert abs(ratio[0] - 1) > 1e-3


@pytest.mark.parametrize(("deviation", "passes"), [(0.01, 16), (0.003, 40), (0.0005, 256)])
def test_passes_make_the_error_of_the_model_small_against_the_data(deviation, passes, renders, caplog):
    """A variance of (0.006)^2 / passes is at most a tenth of that of the data, up to 256 passes."""
    data = noisy(deviation, np.random.default_rng(3), pixels=("red",))
    fitted = mitransient_lidar.fit(data, "table1", NAMES)
    assert fitted.attrs["passes"] == passes
    assert renders[-1]["passes"] == passes
    assert ("takes 1440 passes, 256 are rendered" in caplog.text) == (passes == 256)
    assert mitransient_lidar.fit(data, "table1", NAMES, passes=4).attrs["passes"] == 4


def model_of(scene, names, between_bins=False, **params):
    return study._RenderedModel(scene, params, None, names, 4, 1, None, between_bins=between_bins)


def test_values_of_layers_are_set_in_their_list_and_fixed_coefficients_bound_free_ones():
    """A fit ended where the attenuation would have fallen below the scattering, since such a step is refused."""
    assert model_of("fig15_2x2", ["attenuation[1]"]).bounds() == {"attenuation[1]": (0.25, 1000.0)}
    assert model_of("table1", ["scattering"], attenuation=0.5).bounds() == {"scattering": (0.0, 0.5)}
    assert model_of("table1", ["attenuation", "scattering"]).bounds() == {}
    assert model_of("table1", ["attenuation"], scattering="0.1, 0.2").bounds() == {}
    model = model_of("fig15_2x2", ["attenuation[1]"], wind_speed=3)
    assert model.starts({}) == {"attenuation[1]": 0.5}
    assert model.with_values({"attenuation[1]": 0.4}) == {"wind_speed": 3, "attenuation": "0.9, 0.4"}
    assert model.with_values({"attenuation[0]": 1.0, "attenuation[1]": 0.4})["attenuation"] == "1.0, 0.4"


@pytest.mark.parametrize(("width", "given"), [(0.5, None), (0.5, 0.25), (0.1, None)])
def test_light_is_known_between_bins(width, given, monkeypatch, caplog):
    """Of pulses of 0.6 ns in bins of 0.5 ns, splines give another waveform: bins become narrower, or a line says so."""
    renders = []

    def render(scene, *, params, **options):
        renders.append(params.get("bin_width_ns", width))
        return closed_form({"attenuation": 0.3}).assign_attrs(bin_width_ns=renders[-1], pulse_fwhm_ns=0.6)

    monkeypatch.setattr(study, "render", render)
    others = {} if given is None else {"bin_width_ns": given}
    model_of("table1", ["attenuation"], between_bins=True, **others)({"attenuation": 0.3})
    model_of("table1", ["attenuation"], **others)({"attenuation": 0.3})
    first = width if given is None else given
    assert renders == ([first, 0.12, first] if width == 0.5 and given is None else [first, first])
    assert ("set bin_width_ns to 0.12 or less" in caplog.text) == (given is not None)


@refuses(
    (["bottom_deep"], {}, "parameter 'bottom_deep' is not one of the scene: did you mean bottom_depth"),
    ([], {}, "must name one or more parameters"),
    (["attenuation", "attenuation"], {}, "names attenuation twice"),
    (["attenuation"], {"params": {"attenuation": "0.9, 0.5"}}, r"name one of its elements attenuation\[0\]"),
    (["attenuation[2]"], {}, r"parameter attenuation\[2\]: the index must be 0 to 0"),
    (["bin_count"], {}, "parameter bin_count = 'auto' is not a number"),
    (["attenuation"], {"free_scale": True, "start": {"scale": -1}}, "start of scale = -1 must lie between 0 and"),
    (["attenuation"], {"start": {"attenuatoin": 1}}, "start of attenuatoin: it is not one of the free"),
)
def test_invalid_parameters_are_refused(free, options, renders):
    data = noisy(0.01, np.random.default_rng(4), pixels=("red",))
    mitransient_lidar.fit(data, "table1", free, **options)


def test_the_time_ends_a_fit_before_it_converges(monkeypatch, caplog):
    """Renders take a second each: no step is tried from 1.5 s on, and the last values are the result."""
    now = [0.0]

    def model(values):
        now[0] += 1
        return closed_form(values)

    monkeypatch.setattr(study.time, "perf_counter", lambda: now[0])
    start = {name: 1.3 * value for name, value in TRUTH.items()}
    fitted = mitransient_lidar.fit(closed_form(TRUTH), model, list(TRUTH), start=start, noise=0.01, max_time=1.5)
    assert now[0] == 2
    assert fitted.attrs["renders"] == 2
    assert not fitted.attrs["converged"]
    assert "max_time = 1.5 s ended the fit after 2 renders, before convergence" in caplog.text
    assert np.all(np.isfinite(fitted["value"]) & np.isfinite(fitted["stderr"]))
