"""Targets and bottoms: echoes against closed forms and quadrature, both integrators, and the published figures."""

import mitsuba as mi
import numpy as np
import pytest
from oracles.beam_average import echo_energies
from scipy.stats import t
from significance import FALSE_ALARM, largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.loading.scenes import load_scene
from mitransient_lidar.physics.lidar.lidar_equation import LidarSystem
from mitransient_lidar.physics.lidar.refraction import fresnel, refracted_path, solid_angle_per_area
from mitransient_lidar.physics.water.layers import WaterColumn

SIGMA = 5e-3
HEIGHT, OFF_NADIR, INDEX = 200.0, np.radians(20.0), 1.34
LIDAR = LidarSystem(HEIGHT, OFF_NADIR, 5e-3 * 0.81 * 0.9, 0.025, INDEX, INDEX)
ABSORPTION = 0.1
CLEAR = {"attenuation": ABSORPTION, "scattering": 0.0, "backscattering": 0.0}
#: One pixel, and a sea so smooth that it neither spreads light nor view.
ONE = {"rx": {"layout": "1x1"}, "sea": {"slope_variance": "2e-5"}, "water": CLEAR}
INTEGRATORS = ["lidar_merging", "lidar_volpath"]


def diffuse(value):
    return {"type": "diffuse", "reflectance": {"type": "spectrum", "value": value}}


def plate(x, y, z, half, bsdf, tilt=0.0):
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], tilt).scale(half)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def mean_and_error(samples):
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def assert_agree(first, second, floor):
    """Compare two sets of passes (passes, ...) by Student's t with Sidak's correction; `floor` is a relative bias."""
    (a, da), (b, db) = mean_and_error(first), mean_and_error(second)
    # What few large contributions make is not normal.
    used = (da < 0.05 * a) & (db < 0.05 * b)
    assert used.any()
    z = (np.abs(a - b) - floor * b)[used] / np.hypot(da, db)[used]
    worst = t.isf(0.5 * FALSE_ALARM / used.sum(), min(len(first), len(second)) - 1)
    assert z.max() < worst, (z.max(), worst, np.argwhere(used)[z.argmax()])


# Closed forms.


def gain(x, y, z):
    """Return what the lidar makes of a small target at (x, y, z) in still, clear water.

    Irradiance [J/m^2] across the ray that reaches it, received energy [J] per radiance and area across the ray, the
    direction (..., 3) from the target up along the ray, and the echo's time [ns]. A tube of rays from the laser has
    n^2 domega_w/dA of solid angle in the air per area under water, by reciprocity of the etendue.
    """
    lidar_x = -HEIGHT * np.tan(OFF_NADIR)
    east, north = x - lidar_x, y
    rho = np.hypot(east, north)
    theta, phi = refracted_path(rho, HEIGHT, -z, INDEX)
    towards = np.stack([-np.sin(phi) * east / rho, -np.sin(phi) * north / rho, np.cos(phi)], axis=-1)
    # Tangent-plane angles at which the ray leaves the laser; the beam is Gaussian in them.
    ray = np.stack([np.sin(theta) * east / rho, np.sin(theta) * north / rho, -np.cos(theta)], axis=-1)
    axis = np.array([np.sin(OFF_NADIR), 0.0, -np.cos(OFF_NADIR)])
    along = ray @ axis
    angle_x, angle_y = ray @ np.array([np.cos(OFF_NADIR), 0.0, np.sin(OFF_NADIR)]) / along, ray[..., 1] / along
    per_steradian = np.exp(-0.5 * (angle_x**2 + angle_y**2) / SIGMA**2) / (2 * np.pi * SIGMA**2) / along**3
    _, transmittance = fresnel(theta, INDEX)
    path = -z / np.cos(phi)
    one_way = transmittance * np.exp(-ABSORPTION * path) * solid_angle_per_area(HEIGHT, -z, theta, INDEX)
    time = 2e9 / C0 * (HEIGHT / np.cos(theta) + INDEX * path)
    return LIDAR.energy * per_steradian * INDEX**2 * one_way, LIDAR.aperture_area * one_way, towards, time


def grid(low, high, count):
    """Return midpoints and spacing."""
    step = (high - low) / count
    return low + step * (np.arange(count) + 0.5), step


def render_one(lidar_scene, passes, integrator, target, count=24, **more):
    film = {"time_start_ns": 1430.0, "bin_width_ns": 1.0, "bin_count": 120}
    options = {"type": integrator, "paths_per_pass": 2**16}
    scene = lidar_scene(integrator=options, film=film, bottom=None, extra={"target": target}, **{**ONE, **more})
    return passes(scene, count)[:, 0]


def test_quadrature_agrees_with_the_closed_form_of_the_bottom():
    (x, step), (y, _) = grid(-4.0, 8.0, 300), grid(-6.0, 6.0, 300)
    x, y = np.meshgrid(x, y)
    irradiance, received, towards, _ = gain(x, y, np.full_like(x, -8.0))
    energy = np.sum(0.3 / np.pi * irradiance * received * towards[..., 2] ** 2) * step**2
    column = WaterColumn.from_text(0, ABSORPTION, 0, 0)
    assert energy == pytest.approx(echo_energies(LIDAR, SIGMA, column, 0.0, 8.0, 0.3, (1e-5, 1e-5)).bottom, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_plate_that_fills_the_beam_is_a_bottom(lidar_scene, passes, integrator):
    column = WaterColumn.from_text(0, ABSORPTION, 0, 0)

    def seen(angle_x, angle_y):
        return angle_x**2 + angle_y**2 <= 15e-3**2

    expected = echo_energies(LIDAR, SIGMA, column, 0.0, 6.0, 0.3, (1e-5, 1e-5), seen).bottom
    energy = render_one(lidar_scene, passes, integrator, plate(1.6, 0, -6.0, 7.0, diffuse(0.3))).sum(axis=1)
    mean, error = mean_and_error(energy)
    assert error < 0.01 * expected
    assert abs(mean - expected) < largest_z(24) * error + 1e-3 * expected


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_sphere_in_clear_water(lidar_scene, passes, integrator):
    """Energy and mean time against quadrature over the sphere's lit cap, which is also the one that is seen."""
    centre, radius = np.array([1.5, 0.2, -5.0]), 0.6
    (cosine, dcos), (azimuth, dphi) = grid(-1.0, 1.0, 400), grid(0.0, 2 * np.pi, 400)
    cosine, azimuth = np.meshgrid(cosine, azimuth)
    sine = np.sqrt(1 - cosine**2)
    normal = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    irradiance, received, towards, time = gain(*np.moveaxis(centre + radius * normal, -1, 0))
    facing = np.maximum(np.sum(normal * towards, axis=-1), 0)
    energy = 0.3 / np.pi * irradiance * received * facing**2 * radius**2 * dcos * dphi
    sphere = {"type": "sphere", "center": centre.tolist(), "radius": radius, "bsdf": diffuse(0.3)}
    echo = render_one(lidar_scene, passes, integrator, sphere)
    mean, error = mean_and_error(echo.sum(axis=1))
    assert error < 0.01 * mean
    assert abs(mean - energy.sum()) < min(largest_z(24) * error + 2e-3 * mean, 0.02 * mean)
    # The echo lasts 1.5 ns rms; to its centre instead of its cap it would come 4 ns later.
    arrival = echo @ (1430.5 + np.arange(120)) / echo.sum(axis=1)
    assert abs(arrival.mean() - np.sum(time * energy) / energy.sum()) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_retroreflector_in_clear_water(lidar_scene, passes, integrator):
    """Straight back: reflectance over 2 pi sigma^2 per steradian, 170 times a Lambertian plate."""
    width, reflectance = 4.0, 0.5
    (x, step), (y, _) = grid(0.9, 1.9, 200), grid(-0.5, 0.5, 200)
    x, y = np.meshgrid(x, y)
    irradiance, received, towards, _ = gain(x, y, np.full_like(x, -5.0))
    peak = reflectance / (2 * np.pi * np.radians(width / 2) ** 2)
    expected = np.sum(irradiance * received * peak * towards[..., 2]) * step**2
    bsdf = {"type": "retroreflector", "reflectance": reflectance, "width_deg": width}
    mean, error = mean_and_error(
        render_one(lidar_scene, passes, integrator, plate(1.4, 0.0, -5.0, 0.5, bsdf)).sum(axis=1)
    )
    assert error < 0.015 * mean
    # Slopes of 0.003 turn light and view 0.001 rad apart, 0.1 % off the peak.
    assert abs(mean - expected) < largest_z(24) * error + 3e-3 * expected


# The integrators agree, shadows and edges included.

SAND = {"type": "seabed", "ripple_height": 0.06, "ripple_length": 0.4, "slope_x_deg": 8.0, "size": 100.0}
PATCHES = {"type": "seabed", "slope_x_deg": 6.0, "slope_y_deg": -3.0, "size": 100.0, "patches": "2 0 1 0.4; 3 1 1 0"}
CASES = {
    "cube": {"target": {"type": "cube", "bsdf": diffuse(0.4)}},
    "cylinder": {
        "target": {"type": "cylinder", "p0": [1.4, 0, -6], "p1": [1.4, 0, -4], "radius": 0.5, "bsdf": diffuse(0.4)}
    },
    "rough metal": {"target": plate(1.4, 0.1, -5.0, 0.8, {"type": "roughconductor", "alpha": 0.3}, tilt=10.0)},
    "half transparent": {
        "target": plate(1.4, 0.1, -5.0, 0.8, {"type": "mask", "opacity": 0.4, "nested": diffuse(0.5)})
    },
    "retroreflector": {
        "target": plate(
            1.4, 0.1, -5.0, 0.8, {"type": "retroreflector", "width_deg": 6.0, "diffuse_share": 0.2}, tilt=20.0
        )
    },
    "half buried": {"target": {"type": "sphere", "center": [2.2, 0, -8], "radius": 0.8, "bsdf": diffuse(0.4)}},
    "patches on a slope": {"bottom": PATCHES},
    "half buried in sand": {
        "bottom": SAND,
        "target": {"type": "sphere", "center": [2.2, 0, -7.8], "radius": 0.6, "bsdf": diffuse(0.4)},
    },
}
CASES["cube"]["target"]["to_world"] = (
    mi.ScalarTransform4f().translate([1.4, 0.1, -5.0]).rotate([1, 1, 0], 30.0).scale(0.45)
)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_integrators_agree(lidar_scene, passes, case):
    """Four pixels in bins of 10 ns, and all together."""
    film = {"time_start_ns": 1400.0, "bin_width_ns": 10.0, "bin_count": 14}
    extra = CASES[case]
    scenes = [
        lidar_scene(
            integrator={"type": integrator, "paths_per_pass": paths},
            film=film,
            sea={"slope_variance": "0.01"},
            extra=extra,
            bottom=None if "bottom" in extra else 8.0,
        )
        for integrator, paths in zip(INTEGRATORS, (2**15, 2**16), strict=True)
    ]
    merged, reference = passes(scenes[0], 10), passes(scenes[1], 10, first_seed=500)
    assert_agree(merged, reference, floor=0.005)
    assert_agree(merged.sum((1, 2))[:, None], reference.sum((1, 2))[:, None], floor=0.005)
    total, error = mean_and_error(reference.sum((1, 2)))
    assert error < 0.03 * total


# Published figures 13 and 14.


@pytest.fixture
def echo_of_target(passes):
    """Function: energies of the target's echo and of the water before it, (passes, pixels) each.

    The target's echo is what a render with it has more than one with the same seeds and the target far away.
    """
    bins = {"time_start_ns": 1440.0, "bin_width_ns": 20.0, "bin_count": 3}

    def measure(name):
        scenes = [load_scene(name, {**bins, "target_x": place})[0] for place in (0.0, 60.0)]
        here, away = (passes(scene, 8, first_seed=40) for scene in scenes)
        return here[..., 2] - away[..., 2], away[..., 0]

    return measure


@pytest.mark.slow
def test_figure_13_near_pixels_hold_the_target(echo_of_target):
    echo, _ = echo_of_target("fig13_2x2")
    mean, error = mean_and_error(echo)
    assert np.all(error[2:] < 0.1 * mean[2:])
    assert mean[2:].sum() > 0.9 * mean.sum()
    assert mean[2:].min() > 5 * mean[:2].max()


@pytest.mark.slow
def test_figure_14_black_is_nearly_as_strong_as_blue_in_less_backscatter(echo_of_target):
    echo, water = echo_of_target("fig14_1x4")
    mean, error = mean_and_error(echo)
    level, uncertainty = mean_and_error(water)
    assert np.all(uncertainty < 0.06 * level)
    # Outer strips have far less backscatter than the middle ones.
    assert max(level[0], level[3]) < 0.2 * min(level[1], level[2])
    assert mean[2:].sum() > 0.9 * mean.sum()
    ratio = mean[3] / mean[2]
    ratio_error = ratio * np.hypot(error[3] / mean[3], error[2] / mean[2])
    assert ratio_error < 0.08
    assert 0.75 - 2 * ratio_error < ratio < 1.25 + 2 * ratio_error


@pytest.mark.slow
def test_mine_echoes_at_its_depth_and_casts_a_shadow(passes):
    """Echo from 8.5 m, the top of the sphere, on the axis; of the bottom at 12 m a part is in its shadow."""
    bins = {"time_start_ns": 1490.0, "bin_width_ns": 2.0, "bin_count": 30}
    scenes = [load_scene("fig02_mine", {**bins, "target_x": place})[0] for place in (2.4, 60.0)]
    here, away = (passes(scene, 12)[:, 0] for scene in scenes)
    difference, error = mean_and_error(here - away)
    peak = 1491 + 2 * np.argmax(difference)
    # 1419.9 ns and 9.246 ns for each metre; half the beam's spread in time on either side.
    assert abs(peak - (1419.9 + 9.246 * 8.6)) < 3
    assert difference.max() > 10 * error[difference.argmax()]
    bottom = slice(15, 30)
    shadow = 1 - here[:, bottom].sum(axis=1) / away[:, bottom].sum(axis=1)
    # A disc of 0.5 m radius holds 1 - exp(-0.5^2 / (2 * 1.13^2)) = 9 % of a beam of 1.13 m standard deviation.
    assert 0.05 < shadow.mean() < 0.2
    assert shadow.std(ddof=1) / np.sqrt(12) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_shading_normals_decide_what_a_plate_receives(lidar_scene, passes, integrator, tmp_path):
    """A level plate with shading normals 40 degrees from the vertical: what it sends back goes with their cosine.

    Light comes down 14.8 degrees from the vertical. Were a photon's own cosine that of the shading normal, both plates
    would be equally bright.
    """
    tilt, incidence = np.radians(40.0), np.arcsin(np.sin(np.radians(20.0)) / 1.34)
    corners = ["v 0.9 -0.5 -5", "v 1.9 -0.5 -5", "v 1.9 0.5 -5", "v 0.9 0.5 -5"]
    energies = []
    for angle in (tilt, 0.0):
        path = tmp_path / f"plate{angle:.1f}.obj"
        faces = ["f 1//1 2//1 3//1", "f 1//1 3//1 4//1"]
        path.write_text("\n".join([*corners, f"vn {np.sin(angle)} 0 {np.cos(angle)}", *faces]))
        mesh = {"type": "obj", "filename": str(path), "bsdf": diffuse(0.3)}
        energies.append(mean_and_error(render_one(lidar_scene, passes, integrator, mesh).sum(axis=1)))
    (tilted, tilted_error), (level, level_error) = energies
    ratio, error = tilted / level, tilted / level * np.hypot(tilted_error / tilted, level_error / level)
    assert error < 0.02
    assert abs(ratio - np.cos(tilt + incidence) / np.cos(incidence)) < largest_z(24) * error
