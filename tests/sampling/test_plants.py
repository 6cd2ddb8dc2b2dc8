"""Plants: leaves as their BSDF says, and gaps of a canopy as their closed form."""

import mitsuba as mi
import numpy as np
import pytest
import significance
from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain
from significance import assert_distribution, assert_equal

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.plants import Canopy

OBLIQUE = np.array([0.5, -0.3, -0.6]) / np.linalg.norm([0.5, -0.3, 0.6])
#: Canopies of about 4000 leaves, and what is the same of the closed form.
LEAVES = {"form": "leaves", "leaf_width": 0.05}
BLADES = {"form": "blades", "leaf_width": 0.02, "bending_deg": 40.0}


def canopy(seed, **parameters):
    shape = {"type": "canopy", "depth": 5.0, "leaf_area_index": 1.0, "size": 4.0, "seed": seed, **parameters}
    return mi.load_dict({"type": "scene", "plants": shape}, parallel=False)


def gaps(scene, zenith, seed):
    """Return the share of rays at an angle to the vertical that reach the bottom in the middle of a canopy."""
    rng = np.random.default_rng(seed)
    places = np.append(rng.uniform(-1, 1, (20_000, 2)), np.full((20_000, 1), -5.0), axis=1)
    azimuth = rng.uniform(0, 2 * np.pi)
    up = np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    rays = mi.Ray3f(mi.Point3f((places + 3 * up).T.copy()), mi.Vector3f((-up).tolist()))
    rays.maxt = 3.0
    return 1 - np.array(scene.ray_test(rays)).mean()


@pytest.mark.parametrize("zenith", [0.0, 0.6])
@pytest.mark.parametrize("form", [LEAVES, BLADES])
def test_gaps_of_a_canopy(form, zenith):
    """Each canopy is one sample: rays through one canopy meet the same leaves."""
    seeds = np.arange(24) + significance.seed_shift
    shares = np.array([gaps(canopy(int(seed), **form), zenith, seed) for seed in seeds])
    bending = np.radians(form["bending_deg"]) if "bending_deg" in form else None
    expected = Canopy(1.0, 0.5, form["leaf_width"], bending).gap_probability(zenith)
    assert_equal(shares, expected, error=0.012)


def test_leaf_area_is_that_of_the_index():
    for form in (LEAVES, BLADES, {**BLADES, "shoot_density": 20.0}):
        mesh = canopy(1, **form, height=0.3).shapes()[0]
        assert float(mesh.surface_area()[0]) == pytest.approx(16.0, rel=2e-3)
        assert float(mesh.bbox().max.z) == pytest.approx(-4.7, abs=0.04)


def test_shoots_hold_their_blades():
    feet, _, _ = Canopy(1.0, 0.5, 0.02, 0.7, shoot_density=20.0).leaves(4.0, 1)
    assert len(np.unique(feet, axis=0)) == 320


def test_stands_on_a_bottom():
    bottom = {"type": "seabed", "depth": 5.0, "slope_x_deg": 20.0}
    scene = mi.load_dict(
        {
            "type": "scene",
            "bottom": bottom,
            "plants": {"type": "canopy", "ground": {"type": "ref", "id": "bottom"}, "size": 4.0, "centre_x": 3.0},
        },
        parallel=False,
    )
    plants = next(shape for shape in scene.shapes() if shape.id() == "plants")
    vertices = np.array(mi.traverse(plants)["vertex_positions"]).reshape(-1, 4, 3)
    feet = vertices[:, :2].mean(axis=1)
    assert np.allclose(feet[:, 2], -5 + feet[:, 0] * np.tan(np.radians(20)), atol=1e-5)
    assert feet[:, 0].min() == pytest.approx(1, abs=0.05)
    assert len(scene.shapes()) == 2


@pytest.mark.parametrize("wi", [OBLIQUE, -OBLIQUE])
def test_samples_of_a_leaf_follow_the_density(wi):
    parameters = {"type": "leaf", "reflectance": 0.2, "transmittance": 0.5}
    sample, pdf = BSDFAdapter("leaf", parameters, wi=wi.tolist())
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, res=61, ires=16, seed=4)
    assert_distribution(test)


def test_leaf_returns_its_shares():
    leaf, si = mi.load_dict({"type": "leaf", "reflectance": 0.2, "transmittance": 0.5}), mi.SurfaceInteraction3f()
    for side in (1.0, -1.0):
        si.wi = mi.Vector3f(0.6, 0.0, 0.8 * side)
        for towards, share in ((side, 0.2), (-side, 0.5)):
            value = leaf.eval(mi.BSDFContext(), si, mi.Vector3f(0.0, 0.6, 0.8 * towards))
            assert float(value[0][0]) == pytest.approx(share / np.pi * 0.8, rel=1e-6)


def test_refuses_other_plants():
    for parameters, said in (
        ({"height": 6.0}, "height = 6 of plants lets them rise"),
        ({"leaf_width": 0.6}, "leaf_width = 0.6 must be at most height = 0.5"),
        ({"form": "leaves", "shoot_density": 3.0}, "shoot_density = 3 needs blades"),
        ({"shoot_density": 1e4}, "shoot_density = 10000 must be at most"),
        ({"leaf_width": 1e-6}, "leaves of leaf_area_index = 1"),
        ({"reflectance": 0.6, "transmittance": 0.6}, "must be at most 1 together"),
        ({"ground": {"type": "rectangle"}}, "the nested shape must be one seabed"),
    ):
        with pytest.raises((UserError, RuntimeError), match=said):
            canopy(1, **parameters)
