"""Targets and bottoms: echoes against closed forms and quadrature, both integrators, and the published figures."""

import functools

import mitsuba as mi
import numpy as np
import pytest
import significance
from oracles.beam_average import echo_energies
from oracles.refracted_path import refracted_path
from rows import each_case
from significance import largest_z, mean_and_error

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.level_sea import LidarSystem, fresnel, solid_angle_per_area
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.sediments import HapkeSurface

SIGMA = 5e-3
HEIGHT, OFF_NADIR, INDEX = 200.0, np.radians(20.0), 1.34
LIDAR = LidarSystem(HEIGHT, OFF_NADIR, INDEX, INDEX, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
ABSORPTION = 0.1
CLEAR = {"attenuation": ABSORPTION, "scattering": 0.0, "backscattering": 0.0}
#: One pixel, and a sea so smooth that it neither spreads light nor view.
ONE = {"rx": {"layout": "1x1"}, "sea": {"slope_variance": "2e-5"}, "water": CLEAR}
INTEGRATORS = ["lidar_merging", "lidar_volpath"]
#: A pass of either costs about as much.
FEW = {
    "lidar_merging": {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13},
    "lidar_volpath": {"type": "lidar_volpath", "paths_per_pass": 2**14},
}


def diffuse(value):
    return {"type": "diffuse", "reflectance": {"type": "spectrum", "value": value}}


def plate(x, y, z, half, bsdf, tilt=0.0):
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([0, 1, 0], tilt).scale(half)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def gain(x, y, z, lidar=LIDAR, sigma=SIGMA):
    """Return what the lidar makes of a small target at (x, y, z) in still, clear water.

    Irradiance [J/m^2] across the ray that reaches it, received energy [J] per radiance and area across the ray, the
    direction (..., 3) from the target up along the ray, and the echo's time [ns]. A tube of rays from the laser has
    n^2 domega_w/dA of solid angle in the air per area under water, by reciprocity of the etendue.
    """
    height, off_nadir = lidar.height, lidar.off_nadir
    lidar_x = -height * np.tan(off_nadir)
    east, north = x - lidar_x, y
    rho = np.hypot(east, north)
    theta, phi = refracted_path(rho, height, -z, INDEX)
    towards = np.stack([-np.sin(phi) * east / rho, -np.sin(phi) * north / rho, np.cos(phi)], axis=-1)
    # Tangent-plane angles at which the ray leaves the laser; the beam is Gaussian in them.
    ray = np.stack([np.sin(theta) * east / rho, np.sin(theta) * north / rho, -np.cos(theta)], axis=-1)
    axis = np.array([np.sin(off_nadir), 0.0, -np.cos(off_nadir)])
    along = ray @ axis
    angle_x, angle_y = ray @ np.array([np.cos(off_nadir), 0.0, np.sin(off_nadir)]) / along, ray[..., 1] / along
    per_steradian = np.exp(-0.5 * (angle_x**2 + angle_y**2) / sigma**2) / (2 * np.pi * sigma**2) / along**3
    _, transmittance = fresnel(theta, INDEX)
    path = -z / np.cos(phi)
    one_way = transmittance * np.exp(-ABSORPTION * path) * solid_angle_per_area(height, -z, theta, INDEX)
    time = 2e9 / C0 * (height / np.cos(theta) + INDEX * path)
    return lidar.energy * per_steradian * INDEX**2 * one_way, lidar.aperture_area * one_way, towards, time


def grid(low, high, count):
    step = (high - low) / count
    return low + step * (np.arange(count) + 0.5), step


def render_one(lidar_scene, passes, integrator, target, start=1430.0, **more):
    film = {"time_start_ns": start, "bin_width_ns": 0.25, "bin_count": 480}
    scene = lidar_scene(integrator=FEW[integrator], film=film, bottom=None, extra={"target": target}, **{**ONE, **more})
    return passes(scene, 16)[:, 0]


def test_quadrature_agrees_with_the_closed_form_of_the_bottom():
    (x, step), (y, _) = grid(-4.0, 8.0, 300), grid(-6.0, 6.0, 300)
    x, y = np.meshgrid(x, y)
    irradiance, received, towards, _ = gain(x, y, np.full_like(x, -8.0))
    energy = np.sum(0.3 / np.pi * irradiance * received * towards[..., 2] ** 2) * step**2
    column = WaterColumn.from_text(0, ABSORPTION, 0, 0)
    assert energy == pytest.approx(
        echo_energies(LIDAR, SIGMA, column, 0.0, 8.0, 0.3, (1e-5, 1e-5)).bottom, rel=1e-4, abs=0
    )


OBLIQUE = LidarSystem(97.5, np.radians(54.0), INDEX, INDEX, energy=5e-3 * 0.81 * 0.9, aperture_area=0.025)
#: Lidar, beam [rad], centre [m] and radius of a sphere: on the beam's axis, steep beside it, and wider than the beam.
SPHERES = {
    "small": (LIDAR, SIGMA, (1.5, 0.2, -5.0), 0.6),
    "large": (OBLIQUE, SIGMA, (1.0, 0.0, -1.95), 1.45),
    "large in a narrow beam": (OBLIQUE, 5e-4, (1.5, 0.0, -1.95), 1.45),
    "in a narrow beam": (LIDAR, 5e-4, (2.375, 0.0, -9.0), 0.5),
}
#: In the slow tier.
STEEPEST = "large in a narrow beam"


@functools.cache
def echo_of(sphere):
    """Return energies [J] and times [ns] of the echo of a sphere, by places on it; the sum is right to 1e-4."""
    lidar, sigma, centre, radius = SPHERES[sphere]
    (cosine, dcos), (azimuth, dphi) = grid(-1.0, 1.0, 400), grid(0.0, 2 * np.pi, 400)
    cosine, azimuth = np.meshgrid(cosine, azimuth)
    sine = np.sqrt(1 - cosine**2)
    normal = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    irradiance, received, towards, time = gain(*np.moveaxis(centre + radius * normal, -1, 0), lidar, sigma)
    facing = np.maximum(np.sum(normal * towards, axis=-1), 0)
    return 0.3 / np.pi * irradiance * received * facing**2 * radius**2 * dcos * dphi, time


@pytest.mark.parametrize("integrator", INTEGRATORS)
@each_case(
    *zip([pytest.param(name, marks=pytest.mark.slow if name == STEEPEST else pytest.mark.long) for name in SPHERES])
)
def test_sphere_in_clear_water(sphere, lidar_scene, passes, integrator):
    """Energy and mean time against quadrature over the sphere's lit cap, which is also the one that is seen."""
    (lidar, sigma, centre, radius), (energy, time) = SPHERES[sphere], echo_of(sphere)
    pose = {"altitude": lidar.height, "off_nadir_deg": float(np.degrees(lidar.off_nadir))}
    start = np.floor(time[energy > 0].min() - 10)
    echo = render_one(
        *(lidar_scene, passes, integrator),
        {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": diffuse(0.3)},
        start,
        tx={**pose, "divergence_mrad": 2e3 * sigma},
        rx={**pose, "layout": "1x1"},
    )
    significance.assert_equal(echo.sum(axis=1), energy.sum(), error=0.02, bias=3e-3)
    # The small one's echo lasts 1.5 ns rms; to its centre instead of its cap it would come 4 ns later.
    arrival = echo @ (start + 0.25 * (0.5 + np.arange(480))) / echo.sum(axis=1)
    assert abs(arrival.mean() - np.sum(time * energy) / energy.sum()) < 0.1


@pytest.mark.long
def test_cylinder_as_narrow_as_the_patches_of_its_light(lidar_scene, passes):
    """A cylinder across the look direction, 0.6 m wide, with patches of 0.5 m: quadrature over its lit half.

    Where patches lay along x on all that is steeper than 45 degrees, light was spread evenly over them: -6 %.
    """
    radius, half, centre = 0.3, 0.6, np.array([5.0 * np.tan(np.arcsin(np.sin(OFF_NADIR) / INDEX)), 0.1, -5.0])
    (angle, dangle), (y, dy) = grid(0.0, 2 * np.pi, 400), grid(-half, half, 200)
    angle, y = np.meshgrid(angle, y)
    normal = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    places = centre + radius * normal + y[..., np.newaxis] * np.array([0.0, 1.0, 0.0])
    irradiance, received, towards, _ = gain(*np.moveaxis(places, -1, 0))
    facing = np.maximum(np.sum(normal * towards, axis=-1), 0)
    expected = np.sum(0.3 / np.pi * irradiance * received * facing**2) * radius * dangle * dy
    ends = {name: [centre[0], centre[1] + shift, centre[2]] for name, shift in (("p0", -half), ("p1", half))}
    cylinder = {"type": "cylinder", **ends, "radius": radius, "bsdf": {"type": "twosided", "bsdf": diffuse(0.3)}}
    scene = lidar_scene(
        **{**ONE, "rx": {"layout": "1x1", "field_of_view_mrad": 50.0}},
        integrator={"type": "lidar_merging", "paths_per_pass": 2**14, "cell_size": 0.15},
        film={"time_start_ns": 1430.0, "bin_width_ns": 120.0, "bin_count": 1},
        bottom=None,
        extra={"target": cylinder},
    )
    energy = passes(scene, 40).sum(axis=(1, 2))
    significance.assert_equal(energy, expected, error=0.009, bias=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_retroreflector_in_clear_water(lidar_scene, passes, integrator):
    """Straight back: reflectance over 2 pi sigma^2 per steradian, 170 times a Lambertian plate."""
    width, reflectance = 4.0, 0.5
    (x, step), (y, _) = grid(0.9, 1.9, 200), grid(-0.5, 0.5, 200)
    x, y = np.meshgrid(x, y)
    irradiance, received, towards, _ = gain(x, y, np.full_like(x, -5.0))
    peak = reflectance / (2 * np.pi * np.radians(width / 2) ** 2)
    expected = np.sum(irradiance * received * peak * towards[..., 2]) * step**2
    bsdf = {"type": "retroreflector", "reflectance": reflectance, "width_deg": width}
    energy = render_one(lidar_scene, passes, integrator, plate(1.4, 0.0, -5.0, 0.5, bsdf)).sum(axis=1)
    # Slopes of 0.003 turn light and view 0.001 rad apart, 0.1 % off the peak.
    significance.assert_equal(energy, expected, error=0.03, bias=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_volpath", pytest.param("lidar_merging", marks=pytest.mark.long)])
def test_opposition_effect_brightens_a_level_bottom(lidar_scene, passes, integrator):
    """Over a Lambertian bottom of the same reflectance: pi f / R for light that goes back as it came."""
    particles, reflectance = {"lobe_asymmetry": 0.3, "backward_share": 0.7, "opposition_width": 0.3}, 0.2
    surface = HapkeSurface(0.0, 0.3, 0.7, 1.0, 0.3).of_reflectance("reflectance", reflectance)
    cosine = np.sqrt(1 - (np.sin(OFF_NADIR) / INDEX) ** 2)
    expected = np.pi * surface.brdf(cosine, cosine, 0.0) / reflectance
    energies = []
    for number, model in enumerate(("hapke", "lambertian")):
        scene = lidar_scene(
            **ONE,
            integrator=FEW[integrator],
            film={"time_start_ns": 1430.0, "bin_width_ns": 120.0, "bin_count": 1},
            bottom=None,
            extra={
                "bottom": {
                    "type": "rectangle",
                    "to_world": mi.ScalarTransform4f().translate([0, 0, -8]).scale(500),
                    "bsdf": {"type": "sediment", "model": model, "reflectance": reflectance, **particles},
                }
            },
        )
        energies.append(mean_and_error(passes(scene, 16, first_seed=100 * number).sum(axis=(1, 2))))
    (bright, bright_error), (even, even_error) = energies
    ratio, error = bright / even, bright / even * np.hypot(bright_error / bright, even_error / even)
    assert error < 0.02 * ratio
    # Slopes of 0.003 turn light and view 0.001 rad apart, 0.1 % of the peak's height, and the beam is 0.008 rad wide.
    assert abs(ratio - expected) < largest_z(16) * error + 2e-3 * expected
    assert expected > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["lidar_merging", pytest.param("lidar_volpath", marks=pytest.mark.long)])
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
    assert abs(ratio - np.cos(tilt + incidence) / np.cos(incidence)) < largest_z(16) * error
