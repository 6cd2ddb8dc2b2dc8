"""Radiance by daylight against closed forms and published values: plates, glints, mirrored sky, deep water, waves."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracles.half_space import phase_moments, water_leaving_reflectance
from rows import each_case
from scipy.integrate import quad
from significance import largest_error, largest_z

from mitransient_lidar.physics.lidar.level_sea import fresnel, snell
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters
from mitransient_lidar.transport.paths.path import ConnectedPath
from mitransient_lidar.transport.rng import pass_streams

N = 1.34
SMOOTH = {"spectrum": "flat", "slope_variance": "2e-5"}
CLEAR = {"attenuation": 1e-6, "scattering": 0.0, "backscattering": 0.0}


def build(*, sun=None, sky=None, rx=None, sea=None, water=None, depth=None, rho=0.5, integrator=None, extra=None):
    scene = {
        "type": "scene",
        "integrator": {"type": "passive_volpath", "paths_per_pass": 2**14, **(integrator or {})},
        "rx": {
            "type": "multipixel_receiver",
            "film": {"type": "time_gated_film"},
            **{"field_of_view_mrad": 1.0, "off_nadir_deg": 0.0, **(rx or {})},
            **({} if "pixel_map" in (rx or {}) else {"layout": "1x1"}),
        },
        "sea": {
            "type": "ocean_surface",
            "interior": {"type": "layered_water", "refractive_index": N, **(water or CLEAR)},
            **(sea or SMOOTH),
        },
        **(extra or {}),
    }
    if sun is not None:
        scene["sun"] = {"type": "sun", "irradiance": 1.0, **sun}
    if sky is not None:
        scene["sky"] = {"type": "sky", "distribution": "uniform", **sky}
    if depth is not None:
        scene["plate"] = plate(depth, rho, 500)
    # Not optimised: that would make one shape of plates.
    return mi.load_dict(scene, optimize=False)


def plate(depth, rho, half, y=0.0):
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, y, -depth]).scale([500, half, 1]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": rho}},
    }


def passes(scene, count):
    """Return radiances of independent passes, shape (passes, pixels)."""
    images = [np.array(scene.integrator().render(scene, seed=seed), dtype=np.float64) for seed in range(count)]
    return np.array(images).reshape(count, -1)


def agrees(samples, expected, comparisons=1, bias=0.0):
    """Assert that the mean of the first pixel is as expected, or within a relative bias of it."""
    error = samples[:, 0].std(ddof=1) / np.sqrt(len(samples))
    difference = abs(samples[:, 0].mean() - expected)
    assert difference < largest_z(len(samples), comparisons) * error + bias * expected, (difference, error, expected)
    return error / expected


@pytest.mark.slow
@pytest.mark.parametrize(("zenith", "off_nadir", "rho"), [(0.0, 15.0, 0.9), (40.0, 35.0, 0.9)])
def test_a_plate_just_below_the_surface(zenith, off_nadir, rho):
    """E cos(theta) T(theta) rho / pi, raised by what the sea's underside returns, times T(view) / n^2.

    Without n^2 it would be 1.8 times as bright, without the returned light up to 1.7 times darker.
    """
    scene = build(sun={"zenith_deg": zenith, "azimuth_deg": 90.0}, rx={"off_nadir_deg": off_nadir}, depth=0.02, rho=rho)
    returned = quad(lambda angle: fresnel(angle, 1 / N)[0] * np.sin(2 * angle), 0, np.pi / 2, points=[np.arcsin(1 / N)])
    sun, view = np.radians(zenith), np.radians(off_nadir)
    below = np.cos(sun) * fresnel(sun, N)[1] * rho / np.pi / (1 - rho * returned[0])
    # Ripples of 2e-5 change Fresnel's factors by as much, at 60 degrees.
    error = agrees(passes(scene, 12), below * fresnel(view, N)[1] / N**2, 3, bias=2e-4)
    assert error < largest_error(12, 1.7e-3)


@pytest.mark.slow
@each_case(
    (SMOOTH, {}),
    (SMOOTH, {"layer_tops": "0, 0.5", "attenuation": "0.3, 0.6", "refractive_index": "1.33, 1.37"}),
    ({"spectrum": "flat", "wind_speed": 3.0}, {}),
)
def test_where_nothing_absorbs_everything_is_as_bright_as_the_sky(sea, layers):
    """A white bottom and water that only scatters: whatever light does, it has come from a sky of radiance 1.

    All that is lost is what ripples send from one facet to another, which is not followed: 2.1 % at 3 m/s.
    """
    water = {"attenuation": 0.3, "backscattering": 0.01, **layers}
    scene = build(
        sky={"irradiance": np.pi},
        water={**water, "scattering": water["attenuation"]},
        sea=sea,
        rx={"off_nadir_deg": 20.0},
        depth=2.0,
        rho=1.0,
        integrator={"guiding_probability": 0.02},
    )
    expected = 1.0
    if "wind_speed" in sea:
        (surface,) = (shape for shape in scene.shapes() if hasattr(shape, "sea"))
        above, below, seen = (crossing(surface.bsdf(), *side) for side in ((1, None), (-1, None), (1, 20.0)))
        assert 1 - sum(seen) < 1e-4 < 4e-3 < 1 - sum(above) < 6e-3 < 9e-3 < 1 - sum(below) < 13e-3
        # Light in the water comes back until it leaves it; radiance below is larger by n^2.
        expected = seen[0] + seen[1] * above[1] / (N**2 * (1 - below[0]))
        assert expected == pytest.approx(0.979, abs=1e-3)
    assert agrees(passes(scene, 12), expected, 3, bias=5e-4) < 3e-3


def crossing(bsdf, side, off_normal_deg):
    """Return the shares of the energy that a surface reflects and transmits, for light from an angle or from all."""
    rng = mi.PCG32(2**20, initstate=1)
    pairs = [mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(2)]
    si = dr.zeros(mi.SurfaceInteraction3f, 2**20)
    si.wi = mi.warp.square_to_cosine_hemisphere(pairs[0])
    if off_normal_deg is not None:
        si.wi = mi.Vector3f(np.sin(np.radians(off_normal_deg)).item(), 0, np.cos(np.radians(off_normal_deg)).item())
    si.wi.z *= side
    context = mi.BSDFContext(mi.TransportMode.Importance)
    sample, weight = bsdf.sample(context, si, rng.next_float32(), pairs[1])
    energy, reflected = np.array(weight).ravel(), np.array(sample.wo.z * side > 0)
    return energy[reflected].sum() / energy.size, energy[~reflected].sum() / energy.size


@pytest.mark.slow
@each_case((30.0, 180.0, 20.0, 6.0, 0.0), (35.0, 10.0, 30.0, 4.0, 90.0))
def test_sun_glint_of_gaussian_slopes(zenith, azimuth, view, wind, wind_azimuth):
    """Cox and Munk 1954, equation 9: L = E rho(omega) p(slope) / (4 cos(view) cos^4(tilt))."""
    scene = build(
        sun={"zenith_deg": zenith, "azimuth_deg": azimuth},
        sea={"spectrum": "flat", "wind_speed": wind, "wind_direction_deg": wind_azimuth},
        rx={"off_nadir_deg": view, "field_of_view_mrad": 0.1},
        depth=0.5,
        rho=0.0,
    )
    expected = glint_radiance(zenith, azimuth, view, wind, wind_azimuth)
    # Facets in the shadow of others, which the formula leaves out, and the sun's disc: below a thousandth here.
    assert agrees(passes(scene, 4), expected, 3, bias=1.5e-3) < 1e-3


def glint_radiance(zenith, azimuth, view, wind, wind_azimuth):
    """Return the radiance [1/sr] of the glint of a sun of unit irradiance, by Cox and Munk; angles in degrees."""
    to_sun, to_receiver = direction(zenith, azimuth), direction(view, 180.0)
    half = (to_sun + to_receiver) / np.linalg.norm(to_sun + to_receiver)
    slope = -half[:2] / half[2]
    along = np.array([np.cos(np.radians(wind_azimuth)), np.sin(np.radians(wind_azimuth))])
    up, across = slope @ along, slope @ [-along[1], along[0]]
    variance_up, variance_across = 3.16e-3 * wind, 0.003 + 1.92e-3 * wind
    exponent = up**2 / variance_up + across**2 / variance_across
    density = np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(variance_up * variance_across))
    reflectance = fresnel(np.arccos(half @ to_sun), N)[0]
    return float(reflectance * density / (4 * to_receiver[2] * half[2] ** 4))


def direction(zenith, azimuth):
    zenith, azimuth = np.radians(zenith), np.radians(azimuth)
    return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


@pytest.mark.parametrize("view", [0.0, 70.0])
def test_a_level_sea_mirrors_the_sky(view):
    """Fresnel's reflectance times the sky's radiance; 53 degrees is Brewster's angle, far below 4 times 2 %."""
    scene = build(sky={"irradiance": np.pi}, rx={"off_nadir_deg": view, "field_of_view_mrad": 0.1}, depth=0.5, rho=0.0)
    expected = float(fresnel(np.radians(view), N)[0])
    assert agrees(passes(scene, 4), expected, 3, bias=1e-3) < 1e-3


@pytest.mark.slow
def test_a_level_sea_mirrors_the_sky_where_it_is_seen():
    """The clear sky opposite to the view, near the sun's azimuth and away from it."""
    sky = {"distribution": "clear", "irradiance": 1.0, "sun_zenith_deg": 50.0}
    view = np.radians(40.0)
    for azimuth in (0.0, 180.0):
        scene = build(
            sky={**sky, "sun_azimuth_deg": azimuth},
            rx={"off_nadir_deg": 40.0, "field_of_view_mrad": 0.1},
            depth=0.5,
            rho=0.0,
        )
        mirrored = mi.Vector3f(float(np.sin(view)), 0, float(np.cos(view)))
        radiance = float(next(e for e in scene.emitters() if hasattr(e, "sun")).radiance(mirrored)[0])
        agrees(passes(scene, 4), float(fresnel(view, N)[0]) * radiance, 2, bias=2e-3)


WATER = {"attenuation": 1.0, "scattering": 0.9, "backscattering": 0.9 * 0.0183}


@pytest.mark.slow
@pytest.mark.parametrize(("zenith", "view"), [(50.0, 25.0)])
def test_light_scattered_once(zenith, view):
    """L = E T cos / mu_s b p / (c (1/mu_s + 1/mu_v) mu_v) T / n^2 of uniform water, with directions refracted by n."""
    scene = build(
        sun={"zenith_deg": zenith, "azimuth_deg": 0.0},
        rx={"off_nadir_deg": view},
        water=WATER,
        sea={"spectrum": "flat", "slope_variance": "2e-4"},
        integrator={"max_scatterings": 1},
    )
    sun, seen = np.radians(zenith), np.radians(view)
    mu_s, mu_v = np.cos(snell(sun, N)), np.cos(snell(seen, N))
    # The light goes down away from the sun, which is ahead; what is seen goes up and back.
    down = np.array([-np.sin(sun) / N, 0, -mu_s])
    up = np.array([-np.sin(seen) / N, 0, mu_v])
    phase = fournier_forand(np.arccos(down @ up), *fournier_forand_parameters(0.0183))
    below = np.cos(sun) * fresnel(sun, N)[1] / mu_s * 0.9 * phase / (1 / mu_s + 1 / mu_v) / mu_v
    # Reflected at the underside first, in a few thousandths, and the ripples.
    assert agrees(passes(scene, 12), float(below * fresnel(seen, N)[1] / N**2), 2, bias=6e-3) < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("albedo", [0.9])
def test_deep_water_under_an_even_sky(albedo):
    """Remote-sensing reflectance of Fournier-Forand water, bb/b 0.0183, against discrete ordinates."""
    scene = build(
        sky={"irradiance": 1.0},
        water={"attenuation": 1.0, "scattering": albedo, "backscattering": 0.0183 * albedo},
        integrator={"paths_per_pass": 2**15},
    )
    parameters = fournier_forand_parameters(0.0183)
    moments = phase_moments(lambda angle: fournier_forand(angle, *parameters), 129)
    leaving = passes(scene, 12) - float(fresnel(0.0, N)[0]) / np.pi
    # The discrete ordinates are right to 3e-4; ripples of 2e-5 change little.
    agrees(leaving, float(water_leaving_reflectance(albedo, moments, N)), 2, bias=1e-3)


@each_case(
    pytest.param("rayleigh", 0.9, 4.85e-2, 0.015, marks=pytest.mark.slow),
    pytest.param("rayleigh", 0.2, 1.72e-3, 0.044, marks=pytest.mark.long),
    # 8 s.
    pytest.param("petzold", 0.9, 6.99e-3, 0.063, marks=pytest.mark.long),
    pytest.param("petzold", 0.2, 5.47e-5, 0.060, marks=pytest.mark.long),
)
def test_canonical_problems_1_and_2(phase, albedo, expected, spread):
    """Mobley et al. 1993 (doi:10.1364/AO.32.007484), problems 1 and 2: upward radiance at the nadir, one attenuation
    length down.

    Rayleigh's and Petzold's phase functions, sun at 60 degrees, black sky; mean and relative spread of the models.
    """
    depth = 1.0
    ratio = {"rayleigh": 0.5, "petzold": 0.01826}[phase]
    water = {"attenuation": 1.0, "scattering": albedo, "backscattering": ratio * albedo, "phase": {"type": phase}}
    scene = build(
        # Of 0.02 to 0.6 for Petzold's, 0.1 has the fewest bright paths; 0.3 has a pass of three times the mean in 60.
        sun={"zenith_deg": 60.0},
        water=water,
        integrator={"guiding_probability": 0.05 if ratio > 0.1 else 0.1},
    )
    renderer = scene.integrator().prepare(scene, scene.sensors()[0])
    count, found = 2**14 if ratio > 0.1 else 2**17, []
    for seed in range(8):
        pose, every = renderer.scene.receiver_pose, dr.full(mi.Bool, True, count)
        path = ConnectedPath.start(renderer.scene, pose, mi.Point2f(0, 0), mi.Float(1), every)
        path.point, path.in_water = mi.Point3f(0, 0, -depth), mi.Bool(True)
        weight = dr.full(mi.Float, 1 / count, count)
        record = renderer.follow(path, pass_streams(seed, 4, count), weight)
        found.append([float(record.found[0])])
    error = agrees(np.array(found), expected, 4, bias=spread)
    assert error < largest_error(8, 0.004 if ratio > 0.1 else 0.018)
