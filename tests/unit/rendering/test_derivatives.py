"""Names of parameters by which light is differentiated, the water they change, and labelled results."""

import numpy as np
import pytest
from rows import each_row, must_refuse, refuses

import mitransient_lidar
from mitransient_lidar import results
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.loading.scenes import choose_integrator, open_scene
from mitransient_lidar.physics.water.phase_table import DEFAULT_COUNT, DEFAULT_LOG_S0
from mitransient_lidar.rendering.derivatives import path_parameters

FEW = {"type": "lidar_merging", "paths_per_pass": 1024, "photons_per_pass": 1024}
LAYERS = {"layer_tops": "0, 3", "attenuation": "0.5, 0.3", "scattering": "0.3, 0", "backscattering": "0.01, 0"}
LAYERS |= {"spectrum": "flat"}


@pytest.fixture(scope="module")
def renderer():
    """Return the renderer of a scene with layers, the second without scattering."""
    session = open_scene("table1", LAYERS)
    return choose_integrator(session.scene, FEW).prepare(session.scene, session.sensor)


def test_layers_of_equal_water_stay_apart():
    """Layers of equal properties are traced as one, and differentiated each by itself."""
    session = open_scene(
        "table1", {**LAYERS, "attenuation": "0.3, 0.3", "scattering": "0.1", "backscattering": "0.001"}
    )
    renderer = choose_integrator(session.scene, FEW).prepare(session.scene, session.sensor)
    assert renderer.scene.water.column.count == 1
    assert len(path_parameters(renderer, "scattering")) == 2


@refuses(
    (["atenuation"], r"derivatives = 'atenuation' must be one of attenuation\[0\], .*did you mean attenuation"),
    (["attenuation[2]"], "must have the number of a layer, 0 to 1"),
    (["attenuation", "attenuation[1]"], r"attenuation\[1\] is given twice"),
    (["scattering[1]"], r"scattering\[1\]: the layer has scattering = 0"),
    (["phase_g"], "phase_g: the water has no phase function hg"),
    (["surface_reflectance"], "derivatives = 'surface_reflectance' must be one of"),
    ([3], "derivatives = 3 must be one of"),
    (5, "derivatives = 5 must be names of parameters"),
)
def test_unknown_names_are_refused(names, renderer):
    path_parameters(renderer, names)


@each_row({"phase_function": "petzold"}, {"phase_function": "hg", "phase_g": 0.9})
def test_backscattering_without_influence_is_refused(water, lidar_scene):
    scene = lidar_scene(integrator=FEW, water=water)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    must_refuse("backscattering: the light does not depend on it", path_parameters, renderer, ["backscattering"])


@pytest.mark.parametrize("phase_g", [0.0, 0.02, -0.3])
def test_derivative_by_a_mean_cosine_near_zero(lidar_scene, phase_g):
    """That of ln (1 - g^2) - 1.5 ln(1 + g^2 - 2 g cos), 3 cos at g = 0, where a step relative to g would be 0."""
    scene = lidar_scene(integrator=FEW, water={"phase_function": "hg", "phase_g": phase_g, "backscattering": 0.05})
    (parameter,) = path_parameters(scene.integrator().prepare(scene, scene.sensors()[0]), ["phase_g"])
    cosine = 1 - 2 * np.exp(DEFAULT_LOG_S0 * np.linspace(1, 0, DEFAULT_COUNT))
    expected = -2 * phase_g / (1 - phase_g**2) - 3 * (phase_g - cosine) / (1 + phase_g**2 - 2 * phase_g * cosine)
    np.testing.assert_allclose(parameter.perturbation.layers[0].by_angle, expected, atol=4e-3)
    assert parameter.perturbation.focusing is None or np.isfinite(parameter.perturbation.focusing).all()


def test_reflectance_of_a_bottom_that_is_not_diffuse_is_left_to_differences():
    session = open_scene("table1", {"bottom_model": "hapke", "spectrum": "flat"})
    renderer = choose_integrator(session.scene, FEW).prepare(session.scene, session.sensor)
    (parameter,) = path_parameters(renderer, ["bottom_reflectance"], others=session.parameters)
    assert (parameter.value, parameter.method) == (0.1, "central differences")
    with pytest.raises(UserError, match="bottom_reflectance must be of a solid that is diffuse"):
        path_parameters(renderer, ["bottom_reflectance"])


def test_phase_functions_stay_normalised(renderer):
    """The mean of d ln p over the function is 0, to the linear interpolation of the tables, and its spread is not."""
    (parameter,) = path_parameters(renderer, ["backscattering[0]"])
    slope = parameter.perturbation.layers[0].by_angle
    table = renderer.scene.water.layers.table(0)
    s = np.exp(DEFAULT_LOG_S0 * np.linspace(1, 0, DEFAULT_COUNT))
    weight = 4 * np.pi * table.eval_s(s) * s * table.step
    weight[[0, -1]] *= 0.5
    mean, spread = (weight @ slope) / weight.sum(), np.sqrt((weight @ slope**2) / weight.sum())
    assert abs(mean) < 2e-3 * spread
    # More light goes back, and less is in the peak.
    assert slope[-1] > 0 > slope[0]


@pytest.mark.slow
def test_results_with_derivatives(tmp_path):
    """Waveforms are those without derivatives; a file holds all, and is rendered again to the same bits."""
    few = {"type": "lidar_volpath", "paths_per_pass": 1024}
    options = {"params": LAYERS, "passes": 4, "seed": 5, "integrator": few}
    names = ["attenuation[0]", "bottom_depth", "bottom_reflectance"]
    shot = mitransient_lidar.render("table1", derivatives=names, **options)
    plain = mitransient_lidar.render("table1", **options)
    np.testing.assert_array_equal(shot["waveform"], plain["waveform"])
    assert shot["parameter"].values.tolist() == names
    assert shot["parameter_method"].values.tolist() == ["score", "central differences", "score"]
    assert shot["waveform_derivative"].dims == ("parameter", "pixel", "time")
    results.save(shot, tmp_path / "shot.nc")
    held = mitransient_lidar.open(tmp_path / "shot.nc")
    assert held.identical(shot)
    again = mitransient_lidar.render(tmp_path / "shot.nc")
    np.testing.assert_array_equal(again["waveform_derivative"], shot["waveform_derivative"])
    must_refuse("cannot store the variable", results.save, shot, tmp_path / "shot.exr")


@pytest.mark.slow
def test_series_of_shots_with_derivatives():
    """Each shot has its own derivatives, and the waveforms of a series without them."""
    places = [(0.0, 0.0), (4.0, 1.0)]
    options = {"positions": places, "passes": 2, "pass_share": 0.1}
    names = ["attenuation", "bottom_reflectance"]
    series = mitransient_lidar.render_shots("table1", derivatives=names, **options)
    plain = mitransient_lidar.render_shots("table1", **options)
    np.testing.assert_array_equal(series["waveform"], plain["waveform"])
    assert series["waveform_derivative"].dims == ("shot", "parameter", "pixel", "time")
    slopes = series["impulse_response_derivative"].sum(("pixel", "time"))
    assert np.all(slopes.sel(parameter="attenuation") < 0)
    assert np.all(slopes.sel(parameter="bottom_reflectance") > 0)
    with pytest.raises(UserError, match="derivatives = 'bottom_depth' must be one of"):
        mitransient_lidar.render_shots("table1", derivatives=["bottom_depth"], **options)
