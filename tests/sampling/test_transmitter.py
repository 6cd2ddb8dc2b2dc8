"""The laser as Mitsuba sees it: rays, connections and widths; its tangent plane is in test_fields_of_view."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from frequencies import assert_uniform
from mitsuba.chi2 import ChiSquareTest, SphericalDomain
from rows import each_row
from significance import assert_distribution, largest_z

SIGMA = 0.2  # wide enough for (1 + g^2)^(-3/2) to matter


def laser(**parameters):
    return mi.load_dict({"type": "lidar_transmitter", **parameters})


def sample_rays(beam, count=2**20):
    rng = mi.PCG32(count, initstate=11 + significance.seed_shift)
    pair = mi.Point2f(rng.next_float32(), rng.next_float32())
    ray, weight = beam.sample_ray(0.0, mi.Float(0.5), mi.Point2f(0.5), pair)
    return np.array(ray.o, dtype=np.float64), np.array(ray.d, dtype=np.float64), np.array(weight).ravel()


def sphere_test(beam, density):
    def sample(u):
        return beam.sample_ray(0.0, mi.Float(0.5), mi.Point2f(0.5), mi.Point2f(u[0], u[1]))[0].d

    return ChiSquareTest(SphericalDomain(), sample, density, 2, sample_count=1_000_000, res=101, ires=16, seed=5)


def test_rays_follow_the_intensity():
    """Over the sphere, which the beam leaves towards -z at 20 degrees off nadir: samples against J/sr over J."""
    beam = laser(divergence_mrad=2e3 * SIGMA)
    assert_distribution(sphere_test(beam, lambda d: beam.intensity(d) / beam.energy))


def test_chi_squared_sees_the_missing_jacobian(tmp_path, monkeypatch):
    """Negative control: without cos^-3 the density is that of the tangent plane, not of solid angle."""
    monkeypatch.chdir(tmp_path)  # a rejected test leaves chi2_data.py behind
    beam = laser(divergence_mrad=2e3 * SIGMA)

    def density(d):
        angle_x, angle_y, cos_axis = beam.pose.tangent(d)
        return dr.select(cos_axis > 0, beam.tangent_density(angle_x, angle_y), 0)

    assert not sphere_test(beam, density).run(significance.FALSE_ALARM, quiet=True)


@pytest.mark.parametrize(("profile", "angle"), [("gaussian", 20.0), ("top_hat", 0.0), ("top_hat", 60.0)])
def test_rays_leave_the_laser_about_its_axis(profile, angle):
    """Mean and width of the tangent-plane angles; +angle_x is away from nadir, i.e. the ray rises with angle_x."""
    half = 5e-3
    beam = laser(altitude=200.0, off_nadir_deg=angle, beam_profile=profile, divergence_mrad=2e3 * half)
    origin, direction, weight = sample_rays(beam)
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    np.testing.assert_allclose(origin.reshape(3, -1)[:, 0], [-200 * sin / cos, 0, 200], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=0), 1, atol=3e-7)
    np.testing.assert_allclose(weight, 4.5e-3, rtol=1e-6)
    along = np.array([sin, 0, -cos]) @ direction
    angle_x, angle_y = np.array([cos, 0, sin]) @ direction / along, direction[1] / along
    count = angle_x.size
    # E[g^2] of a disc of this radius is half^2 / 4; fourth moments half^4 / 8 (disc) and 3 sigma^4.
    square, fourth = (half**2, 3 * half**4) if profile == "gaussian" else (half**2 / 4, half**4 / 8)
    for g in (angle_x, angle_y):
        assert abs(g.mean()) < largest_z(count, 5) * np.sqrt(square / count)
        assert abs(np.mean(g**2) - square) < largest_z(count, 5) * np.sqrt((fourth - square**2) / count)
    assert abs(np.mean(angle_x * angle_y)) < largest_z(count, 5) * square / np.sqrt(count)
    radius = np.hypot(angle_x, angle_y) / half
    if profile == "gaussian":
        assert_uniform(-np.expm1(-0.5 * radius**2))
    else:
        assert radius.max() < 1 + 1e-4  # the rim, to float32 directions
        assert_uniform(np.clip(radius, 0, 1) ** 2)


@pytest.mark.parametrize("share_of_peak", [0.5, np.exp(-2), np.exp(-0.5)])
def test_each_width_is_where_the_irradiance_says(share_of_peak):
    """At half of the stated full angle the beam has fallen to the share that defines it: 1/2, e^-2, e^-1/2."""
    name = {0.5: "divergence_fwhm_mrad", np.exp(-2): "divergence_1e2_mrad"}.get(share_of_peak, "divergence_mrad")
    beam = laser(**{name: 7.0})
    edge, peak = (beam.tangent_density(mi.Float(0.0), mi.Float(g)) for g in (3.5e-3, 0.0))
    assert np.array(edge / peak)[0] == pytest.approx(share_of_peak, rel=1e-5)
    # Its energy: the share outside that circle is the same as the share of the peak, for a Gaussian.
    _, direction, _ = sample_rays(beam)
    tangent = np.array(beam.pose.tangent(mi.Vector3f(*(mi.Float(d) for d in direction)))[:2], dtype=np.float64)
    outside = np.mean(np.hypot(*tangent) > 3.5e-3)
    count = direction.shape[1]
    limit = largest_z(count) * np.sqrt(share_of_peak * (1 - share_of_peak) / count)
    assert abs(outside - share_of_peak) < limit


@each_row("divergence_mrad", "divergence_fwhm_mrad", "divergence_1e2_mrad")
def test_every_width_of_a_top_hat_is_its_full_angle(name):
    """Its irradiance falls from the peak to 0 at the edge, past every share of the peak."""
    beam = laser(beam_profile="top_hat", **{name: 7.0})
    inside, outside = (np.array(beam.tangent_density(mi.Float(0.0), mi.Float(g)))[0] for g in (3.499e-3, 3.501e-3))
    assert inside == pytest.approx(1 / (np.pi * 3.5e-3**2), rel=1e-5)
    assert outside == 0
    assert beam.divergence == pytest.approx(7e-3)


@pytest.mark.parametrize("profile", ["gaussian", "top_hat"])
def test_connection_is_intensity_over_distance_squared(profile):
    beam = laser(altitude=50.0, off_nadir_deg=30.0, beam_profile=profile, divergence_mrad=400.0)
    points = np.random.default_rng(6).uniform([-15, -15, -10], [15, 15, 10], (2000, 3))
    it = mi.Interaction3f()
    it.p = mi.Point3f(*(mi.Float(p) for p in points.T))
    ds, irradiance = beam.sample_direction(it, mi.Point2f(0.5))
    origin = np.array([-50 * np.tan(np.pi / 6), 0, 50])
    offset = origin - points
    distance = np.linalg.norm(offset, axis=1)
    np.testing.assert_allclose(np.array(ds.dist), distance, rtol=1e-6)
    np.testing.assert_allclose(np.array(ds.d).T, offset / distance[:, None], atol=1e-6)
    cosine = -offset @ np.array([0.5, 0, -np.sqrt(0.75)]) / distance
    tangent2 = 1 / cosine**2 - 1
    if profile == "gaussian":
        density = np.exp(-tangent2 / (2 * SIGMA**2)) / (2 * np.pi * SIGMA**2)
    else:
        density = np.where(tangent2 < SIGMA**2, 1 / (np.pi * SIGMA**2), 0)
        assert 0.1 < np.mean(density > 0) < 0.9
    clear = np.abs(np.sqrt(tangent2) - SIGMA) > 1e-4
    expected = 4.5e-3 * density / cosine**3 / distance**2
    value = np.array(irradiance).ravel()
    np.testing.assert_allclose(value[clear], expected[clear], rtol=1e-4)
    np.testing.assert_array_equal(value, np.array(beam.eval_direction(it, ds)).ravel())
    assert np.all(np.array(beam.pdf_direction(it, ds)) == 0)
