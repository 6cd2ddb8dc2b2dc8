"""Corners of the surface's two lobes that test_surface leaves: facets in the dark, depth 0, and wind at any angle."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from kernel_arrays import vector
from mitsuba.chi2 import ChiSquareTest, SphericalDomain
from rows import each_row
from scipy.stats import norm
from significance import assert_distribution, largest_z

from mitransient_lidar.transport.paths.refracted_connection import RefractedLaserSampler
from mitransient_lidar.transport.pose import KernelPose

COUNT = 2**20


def lobe_at(angle, slope_variance=0.02, altitude=200.0):
    pose = KernelPose.from_angles(altitude, angle)
    parts = {"refractive_index": 1.34, "slope_variance": slope_variance, "index_layers": None}
    return RefractedLaserSampler(SimpleNamespace(transmitter_pose=pose, **parts))


def random_points(seed):
    rng = mi.PCG32(COUNT, initstate=seed + significance.seed_shift)
    return mi.Point2f(rng.next_float32(), rng.next_float32())


@each_row(0.0, 20.0, 40.0)
@each_row(((0.0, 0.0, 0.0),), ((3.0, -2.0, 0.0),), ((0.0, 0.0, 0.2),))
def test_at_the_surface_the_laser_is_straight_ahead(point, angle):
    """At z = 0, and in a crest above it: the line to the laser, refracted where the point is."""
    lobe = lobe_at(angle)
    laser = lobe.direction_from(mi.Point3f(vector(point)))
    line = KernelPose.from_angles(200.0, angle).origin - np.array([point[0], point[1], 0.0])
    line /= np.linalg.norm(line)
    np.testing.assert_allclose(np.array(laser.in_air).ravel(), line, atol=2e-6)
    water = line / 1.34
    water[2] = np.sqrt(1 - water[0] ** 2 - water[1] ** 2)
    np.testing.assert_allclose(np.array(laser.in_water).ravel(), water, atol=2e-6)


@pytest.mark.parametrize(("angle", "variance"), [pytest.param(60.0, 0.06, marks=pytest.mark.slow), (85.0, 0.15)])
def test_density_integrates_to_the_lit_share(angle, variance):
    """Facets that turn away from the laser make no direction: what they lack is the share of samples of density 0."""
    lobe = lobe_at(angle, variance)
    laser = lobe.direction_from(mi.Point3f(vector((0.0, 0.0, -4.0))))
    lit = np.array(lobe.sample(laser, random_points(8))[1]) > 0
    # Slope of a facet along the azimuth of the laser, of variance s^2 / 2, beyond which it sees the laser's back.
    in_air = np.array(laser.in_air, dtype=np.float64).ravel()
    expected = norm.cdf(in_air[2] / np.hypot(*in_air[:2]), scale=np.sqrt(variance / 2))
    assert abs(lit.mean() - expected) < largest_z(COUNT) * np.sqrt(expected * (1 - expected) / COUNT) + 1e-6
    # Midpoint quadrature over the sphere in cos(theta), phi.
    cosine = (np.arange(2000) + 0.5) / 1000 - 1
    phi = (np.arange(2000) + 0.5) / 2000 * 2 * np.pi
    z, phi = (a.ravel() for a in np.meshgrid(cosine, phi))
    r = np.sqrt(1 - z * z)
    direction = vector((r * np.cos(phi), r * np.sin(phi), z))
    density = np.array(lobe.pdf(laser, direction), dtype=np.float64)
    assert np.all(np.isfinite(density))
    assert np.all(density >= 0)
    assert density.mean() * 4 * np.pi == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("angle", [20.0, 85.0])
def test_sampled_directions_are_those_of_snells_law_at_their_facet(angle):
    """n (w x m) = i x m for the facet m that is drawn, and w points up through it."""
    lobe = lobe_at(angle, 0.03)
    laser = lobe.direction_from(mi.Point3f(vector((0.0, 0.0, -4.0))))
    direction, pdf = (np.array(a, dtype=np.float64) for a in lobe.sample(laser, random_points(9)))
    in_air = np.array(laser.in_air, dtype=np.float64).ravel()
    lit = pdf > 0
    half = 1.34 * direction[:, lit] - in_air[:, None]
    normal = half / np.linalg.norm(half, axis=0)
    residual = 1.34 * np.cross(direction[:, lit].T, normal.T) - np.cross(in_air, normal.T)
    assert np.abs(residual).max() < 1e-6
    assert np.all(np.sum(direction[:, lit] * normal, axis=0) > np.sqrt(1 - 1 / 1.34**2) - 1e-6)
    # Slopes of these facets have the variance asked for, half along each axis.
    if angle <= 60:
        slopes = normal[:2] / normal[2]
        limit = largest_z(COUNT, 4) / np.sqrt(COUNT)
        np.testing.assert_allclose(np.var(slopes, axis=1), 0.015, atol=limit * 0.015 * np.sqrt(2) + 1e-5)
        np.testing.assert_allclose(np.mean(slopes, axis=1), 0, atol=limit * np.sqrt(0.015) + 1e-5)


def ripples(**parameters):
    scene = mi.load_dict(
        {"type": "scene", "sea": {"type": "ocean_surface", **parameters, "interior": {"type": "layered_water"}}}
    )
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.2, 5.0), mi.Vector3f(0, 0, -1)))
    assert np.allclose(np.array(si.n).ravel(), [0, 0, 1])
    # The pointer from si.bsdf() does not keep the scene alive, and calls through it would return zeros.
    return si, scene.shapes()[0].bsdf()


def turned(vector, degrees):
    sin, cos = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    x, y, z = vector
    return np.array([cos * x - sin * y, sin * x + cos * y, z])


def unit(vector):
    return np.asarray(vector) / np.linalg.norm(vector)


@pytest.mark.parametrize("wind", [30.0, 225.0])
@pytest.mark.parametrize("wi", [[0.34, 0.1, 0.93], [0.2, -0.15, -0.95]])
def test_ripples_turn_with_the_wind(wind, wi):
    """All directions turned with the wind: the same BSDF, in reflection and in refraction."""
    rng = np.random.default_rng(7)
    wo = rng.normal(size=(3, 4000))
    wo[2] *= 3
    wo /= np.linalg.norm(wo, axis=0)
    context = mi.BSDFContext()
    values = []
    for degrees in (0.0, wind):
        si, bsdf = ripples(spectrum="flat", wind_speed=10.0, wind_direction_deg=degrees)
        si.wi = si.to_local(vector(turned(unit(wi), degrees)))
        out = si.to_local(vector(turned(wo, degrees)))
        values.append(np.array(bsdf.eval(context, si, out)).ravel()[-wo.shape[1] :])
    assert np.mean(values[0] > 1e-3) > 0.02
    np.testing.assert_allclose(values[1], values[0], rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("wi", [[0.34, 0.1, 0.93], [0.2, -0.15, -0.95]])
def test_ripples_sample_their_density_and_keep_the_energy(wi):
    si, bsdf = ripples(spectrum="flat", wind_speed=10.0, wind_direction_deg=30.0)
    si.wi = si.to_local(vector(unit(wi)))
    context = mi.BSDFContext()

    def sample(u):
        drawn, weight = bsdf.sample(context, si, u[0], mi.Point2f(u[1], u[2]))
        # A few in a million are reflected through the surface: their weight is 0, and eval and pdf say 0.
        return si.to_world(drawn.wo), dr.select(weight[0] > 0, mi.Float(1), 0)

    def density(wo):
        return bsdf.pdf(context, si, si.to_local(wo))

    test = ChiSquareTest(SphericalDomain(), sample, density, 3, sample_count=1_000_000, res=151, ires=8, seed=2)
    assert_distribution(test)
    assert test.pdf_sum > 0.99  # not the agreement of nothing with nothing
    # In importance mode, where little but masking is lost.
    context.mode = mi.TransportMode.Importance
    rng = mi.PCG32(2**18, initstate=1 + significance.seed_shift)
    first, pair = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    assert 0.99 < np.array(bsdf.sample(context, si, first, pair)[1]).mean() <= 1
