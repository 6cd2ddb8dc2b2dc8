"""The retro-reflecting BSDF: sampled as its density says, the same both ways round, and never more than it receives."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain
from rows import each_case, each_row
from significance import assert_distribution, largest_z

OBLIQUE = np.array([0.5, -0.3, 0.6]) / np.linalg.norm([0.5, -0.3, 0.6])
GRAZING = np.array([0.95, 0.1, 0.15]) / np.linalg.norm([0.95, 0.1, 0.15])


def surface(**parameters):
    return mi.load_dict({"type": "retroreflector", **parameters})


def interaction(wi, count=1):
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(np.asarray(wi).tolist())
    return si


def value(bsdf, wi, wo):
    """Return BSDF times cosine for one direction in and one out."""
    return float(bsdf.eval(mi.BSDFContext(), interaction(wi), mi.Vector3f(np.asarray(wo).tolist()))[0][0])


def direction(theta, phi=0.0):
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


@each_case((OBLIQUE, 20.0, 0.0), (GRAZING, 8.0, 0.3), (OBLIQUE, 120.0, 0.5), (GRAZING, 120.0, 0.0))
def test_samples_follow_the_density(wi, width, share):
    parameters = {"type": "retroreflector", "width_deg": width, "diffuse_share": share}
    sample, pdf = BSDFAdapter("retroreflector", parameters, wi=wi.tolist())
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, res=181, ires=16, seed=4)
    assert_distribution(test)


def test_lobe_of_narrow_width_is_gaussian():
    """Peak R / (2 pi sigma^2) and e^-1/2 of it half the width away; a width read as a radius would give a quarter."""
    bsdf = surface(reflectance=0.8, width_deg=2.0)
    sigma = np.radians(1.0)
    peak = value(bsdf, OBLIQUE, OBLIQUE)
    assert peak == pytest.approx(0.8 / (2 * np.pi * sigma**2), rel=2e-4)
    # Across the plane of incidence, so that the cosine stays the same to second order.
    side = np.cross(OBLIQUE, [0, 0, 1])
    side /= np.linalg.norm(side)
    aside = np.cos(sigma) * OBLIQUE + np.sin(sigma) * side
    assert value(bsdf, OBLIQUE, aside) == pytest.approx(peak * np.exp(-0.5), rel=1e-3)


@each_row(5.0, 40.0, 180.0)
def test_is_reciprocal(width):
    bsdf = surface(width_deg=width, diffuse_share=0.2)
    for first, second in ((direction(0.2), direction(0.3, 0.1)), (direction(1.2, 1.0), direction(1.4, 1.3))):
        there = value(bsdf, first, second) / second[2]
        back = value(bsdf, second, first) / first[2]
        assert there == pytest.approx(back, rel=1e-4)
        assert there > 0


@each_case((0.0, 4.0, 0.0), (0.8, 4.0, 0.4), (1.5, 30.0, 0.2), (0.0, 180.0, 0.0))
def test_returns_no_more_than_the_reflectance(theta, width, share):
    """Mean weight of samples against midpoint quadrature of the values about the direction back."""
    bsdf = surface(reflectance=0.9, width_deg=width, diffuse_share=share)
    count = 400_000
    rng = mi.PCG32(count, initstate=7 + significance.seed_shift)
    wi = direction(theta)
    si = interaction(wi, count)
    first, pair = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    _, weight = bsdf.sample(mi.BSDFContext(), si, first, pair)
    weight = np.array(weight)[0]
    assert weight.max() <= 0.9 * (1 + 1e-5)
    # Rings of equal share of the lobe, to the far side, and of equal angle for the Lambertian part.
    gamma = np.pi * ((np.arange(2000) + 0.5) / 2000) ** 3
    dgamma = 3 * np.pi * ((np.arange(2000) + 0.5) / 2000) ** 2 / 2000
    azimuth = 2 * np.pi * (np.arange(96) + 0.5) / 96
    frame = np.stack([np.array([wi[2], 0, -wi[0]]), np.array([0.0, 1, 0]), wi])
    local = np.stack([np.outer(np.sin(gamma), np.cos(azimuth)), np.outer(np.sin(gamma), np.sin(azimuth))])
    wo = np.concatenate([local, np.broadcast_to(np.cos(gamma)[:, None], (1, *local.shape[1:]))]).reshape(3, -1).T
    values = bsdf.eval(mi.BSDFContext(), interaction(wi, len(wo)), mi.Vector3f((wo @ frame).T.copy()))
    albedo = np.sum(np.array(values)[0].reshape(2000, 96).mean(1) * 2 * np.pi * np.sin(gamma) * dgamma)
    error = weight.std() / np.sqrt(count)
    assert abs(weight.mean() - albedo) < largest_z(count) * error + 1e-3
    assert albedo <= 0.9 * (1 + 1e-3)
    if width == 4.0:
        # Half of a narrow lobe leaves at larger angles than it came, and is cut in proportion to the cosines.
        lost = (1 - share) * np.radians(width / 2) * np.tan(theta) / np.sqrt(2 * np.pi)
        assert albedo == pytest.approx(0.9 * (1 - lost), rel=2e-3)


def test_back_side_is_black_unless_twosided():
    bsdf, both = surface(), mi.load_dict({"type": "twosided", "front": {"type": "retroreflector"}})
    behind = -OBLIQUE
    assert value(bsdf, behind, behind) == 0
    assert value(both, behind, behind) == pytest.approx(value(bsdf, OBLIQUE, OBLIQUE))
