"""The BSDF of sediment: the formula of `physics.water.sediments`, its samples, and what it refuses."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain
from rows import each_row
from significance import assert_distribution, largest_z

from mitransient_lidar.loading.scene_source import object_values
from mitransient_lidar.physics.water.sediments import HapkeSurface

OBLIQUE = np.array([0.5, -0.3, 0.6]) / np.linalg.norm([0.5, -0.3, 0.6])
GRAZING = np.array([0.95, 0.1, 0.15]) / np.linalg.norm([0.95, 0.1, 0.15])
PARTICLES = {"lobe_asymmetry": 0.5, "backward_share": 0.8, "opposition_amplitude": 1.0, "opposition_width": 0.05}


def sediment(**parameters):
    return mi.load_dict({"type": "sediment", "model": "hapke", **parameters})


def interaction(wi, count=1):
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(np.asarray(wi).tolist())
    return si


def upward(count, seed=3):
    """Return random directions above the surface, shape (count, 3)."""
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2])
    return directions


@pytest.mark.parametrize("wi", [OBLIQUE, GRAZING])
def test_value_is_that_of_the_formula(wi):
    """At random directions, and at some within a hundredth of a radian of the source."""
    surface = HapkeSurface(0.6, *PARTICLES.values())
    bsdf = sediment(single_scattering_albedo=0.6, **PARTICLES)
    close = wi + 0.01 * np.random.default_rng(5).normal(size=(100, 3))
    wo = np.concatenate([upward(1000), close / np.linalg.norm(close, axis=1, keepdims=True)])
    found = np.array(bsdf.eval(mi.BSDFContext(), interaction(wi, len(wo)), mi.Vector3f(wo.T.copy())))[0]
    # The angle from the difference of the directions: exact also where it is small.
    angle = 2 * np.arcsin(np.minimum(0.5 * np.linalg.norm(wo - wi, axis=1), 1))
    np.testing.assert_allclose(found, surface.brdf(wi[2], wo[:, 2], angle) * wo[:, 2], rtol=2e-4)


@pytest.mark.parametrize("wi", [OBLIQUE, GRAZING])
def test_samples_follow_the_density(wi):
    sample, pdf = BSDFAdapter("sediment", {"type": "sediment", "model": "hapke", **PARTICLES}, wi=wi.tolist())
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, res=181, ires=16, seed=4)
    assert_distribution(test)


@pytest.mark.parametrize("wi", [np.array([0.0, 0.0, 1.0]), OBLIQUE, GRAZING])
def test_samples_return_the_reflectance(wi):
    bsdf, count = sediment(reflectance=0.3, **PARTICLES), 400_000
    rng = mi.PCG32(count, initstate=7 + significance.seed_shift)
    pair = mi.Point2f(rng.next_float32(), rng.next_float32())
    _, weight = bsdf.sample(mi.BSDFContext(), interaction(wi, count), mi.Float(0), pair)
    weight = np.array(weight)[0]
    expected = bsdf.surface.reflectance(float(wi[2]))
    # The quadrature is known to 0.2 %.
    assert abs(weight.mean() - expected) < largest_z(count) * weight.std() / np.sqrt(count) + 2e-3 * expected
    if wi[2] == 1:
        assert expected == pytest.approx(0.3, rel=1e-9)


def test_back_side_is_black_unless_twosided():
    bsdf, both = sediment(), mi.load_dict({"type": "twosided", "front": {"type": "sediment", "model": "hapke"}})
    behind, up = mi.Vector3f((-OBLIQUE).tolist()), mi.Vector3f(OBLIQUE.tolist())
    context = mi.BSDFContext()
    assert bsdf.eval(context, interaction(-OBLIQUE), behind)[0][0] == 0
    front = bsdf.eval(context, interaction(OBLIQUE), up)[0][0]
    assert both.eval(context, interaction(-OBLIQUE), behind)[0][0] == pytest.approx(front)


@pytest.mark.parametrize(("reflectance", "expected"), [(0.3, 0.3), ("coral_sand", 0.4316)])
def test_lambertian_model_is_the_diffuse_surface_of_mitsuba(reflectance, expected):
    """With the name of its parameter, by which derivatives find it."""
    bsdf = mi.load_dict({"type": "sediment", "reflectance": reflectance, "wavelength_nm": 532.0})
    kept = mi.traverse(bsdf)
    assert list(kept.keys()) == ["reflectance.value"]
    assert np.array(kept["reflectance.value"]).item() == pytest.approx(expected, rel=1e-6)
    values = object_values(bsdf)
    assert (values["type"], values["model"], values["wavelength_nm"]) == ("sediment", "lambertian", 532)
    assert values["used"] == {"reflectance": pytest.approx(expected, rel=1e-6)}
    si, wo = interaction(OBLIQUE), mi.Vector3f(OBLIQUE.tolist())
    plain = mi.load_dict({"type": "diffuse", "reflectance": np.array(kept["reflectance.value"]).item()})
    for method in ("eval", "pdf"):
        seen, wanted = (getattr(one, method)(mi.BSDFContext(), si, wo) for one in (bsdf, plain))
        np.testing.assert_array_equal(np.array(seen), np.array(wanted))
    kept["reflectance.value"] = 0.2
    kept.update()
    assert np.array(bsdf.eval_diffuse_reflectance(si)).ravel()[0] == pytest.approx(0.2)


@each_row(
    ({"reflectance": "mud"}, "reflectance = 'mud' must be a number from 0 to 1, or one of coral_sand"),
    ({"single_scattering_albedo": 1.0}, "single_scattering_albedo = 1 must be less with these particles"),
    ({"reflectance": 0.2, "single_scattering_albedo": 0.5}, "reflectance = 0.2 and single_scattering_albedo = 0.5"),
    ({"model": "lambertian", "single_scattering_albedo": 0.5}, "single_scattering_albedo = 0.5 needs model"),
)
def test_invalid_input_is_refused(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        sediment(**parameters)
