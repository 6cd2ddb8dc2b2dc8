"""Sun and sky as emitters: their irradiance, their shapes, and what Mitsuba's own integrators make of them."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from rows import each_case
from significance import largest_z

COUNT = 2**20


def random_points(seed):
    rng = mi.PCG32(COUNT, initstate=seed + significance.seed_shift)
    return mi.Point2f(rng.next_float32(), rng.next_float32())


def unit(zenith, azimuth):
    zenith, azimuth = np.radians(zenith), np.radians(azimuth)
    level = np.sin(zenith)
    return mi.Vector3f([float(level * np.cos(azimuth)), float(level * np.sin(azimuth)), float(np.cos(zenith))])


def radiance(emitter, zenith, azimuth):
    return float(emitter.radiance(unit(zenith, azimuth))[0])


@each_case(
    {"distribution": "uniform"},
    {"distribution": "overcast"},
    {"sun_zenith_deg": 0.0},
    {"sun_zenith_deg": 40.0, "sun_azimuth_deg": 30.0},
    {"sun_zenith_deg": 85.0},
)
def test_the_sky_gives_its_irradiance(sky):
    """Over directions even in solid angle: neither the normalisation's quadrature nor the plugin's own samples."""
    emitter = mi.load_dict({"type": "sky", "irradiance": 0.7, **sky})
    direction = mi.warp.square_to_uniform_hemisphere(random_points(1))
    value = np.array(emitter.radiance(direction) * direction.z, dtype=np.float64) * 2 * np.pi
    assert abs(value.mean() - 0.7) < largest_z(COUNT, 10) * value.std() / np.sqrt(COUNT)
    drawn, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f), random_points(2))
    value = np.array(weight[0] * drawn.d.z, dtype=np.float64)
    assert abs(value.mean() - 0.7) < largest_z(COUNT, 10) * value.std() / np.sqrt(COUNT) + 1e-5
    assert radiance(emitter, 91.0, 0.0) == 0


def test_shapes_of_skies():
    uniform = mi.load_dict({"type": "sky", "distribution": "uniform", "irradiance": np.pi})
    assert radiance(uniform, 70.0, 10.0) == pytest.approx(1, rel=1e-5)
    overcast = mi.load_dict({"type": "sky", "distribution": "overcast", "irradiance": 1.0})
    # Zenith of the cardioidal sky: 9 / (7 pi).
    assert radiance(overcast, 0.0, 0.0) == pytest.approx(9 / (7 * np.pi), rel=1e-5)
    assert radiance(overcast, 60.0, 200.0) == pytest.approx(6 / (7 * np.pi), rel=1e-5)
    clear = mi.load_dict({"type": "sky", "irradiance": 1.0, "sun_zenith_deg": 40.0, "sun_azimuth_deg": 90.0})
    # Harrison and Coombes at two directions by hand: 50 deg opposite the sun, and 10 deg off it.
    values = [radiance(clear, 10.0, 270.0), radiance(clear, 50.0, 90.0)]
    angles, zeniths = np.radians([50.0, 10.0]), np.radians([10.0, 50.0])
    around = 1.63 + 53.7 * np.exp(-5.49 * angles) + 2.04 * np.cos(angles) ** 2 * np.cos(np.radians(40))
    shape = around * (1 - np.exp(-0.19 / np.cos(zeniths)))
    assert values[1] / values[0] == pytest.approx(shape[1] / shape[0], rel=1e-4)
    # Published for it: brighter at the horizon than overhead, brightest at the sun.
    assert radiance(clear, 85.0, 270.0) > 2 * radiance(clear, 30.0, 270.0)


def test_the_sun_is_an_even_disc():
    sun = mi.load_dict({"type": "sun", "zenith_deg": 40.0, "azimuth_deg": 120.0, "irradiance": 1.3})
    direction = sun.sample(random_points(3))
    axis = np.array(unit(40.0, 120.0), dtype=np.float64).ravel()
    drawn = np.array(direction, dtype=np.float64)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=0), 1, atol=2e-7)
    # Across the axis: sin^2 of the angle is even up to that of the edge.
    across = drawn - axis[:, None] * (axis @ drawn)
    share = np.sum(across**2, axis=0) / np.sin(np.radians(0.2666)) ** 2
    assert share.max() < 1.001
    limit = largest_z(COUNT, 4) / np.sqrt(COUNT)
    assert abs(share.mean() - 0.5) < limit * np.sqrt(1 / 12) + 1e-4
    assert np.all(np.abs(across.mean(axis=1)) < limit * np.radians(0.2666) / 2 + 2e-8)
    # The disc's radiance times its solid angle is the irradiance.
    level = float(sun.radiance(unit(40.1, 120.0))[0])
    assert level * np.pi * np.sin(np.radians(0.2666)) ** 2 == pytest.approx(1.3, rel=1e-5)
    assert radiance(sun, 40.3, 120.0) == 0
    assert sun.sampled_irradiance == pytest.approx(1.3, rel=1e-4)


def test_mitsubas_path_tracer_sees_a_plate_in_sun_and_sky():
    """A level white plate in the air: (E_sun cos + E_sky) rho / pi."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov": 5,
                "to_world": mi.ScalarTransform4f().look_at([0, -2, 5], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "luminance"},
            },
            "plate": {
                "type": "rectangle",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.5}},
            },
            "sun": {"type": "sun", "zenith_deg": 60.0, "irradiance": 1.2},
            "sky": {"type": "sky", "distribution": "overcast", "irradiance": 0.3},
        }
    )
    image = np.array(mi.render(scene, spp=1024, seed=3 + significance.seed_shift), dtype=np.float64)
    expected = (1.2 * 0.5 + 0.3) * 0.5 / np.pi
    assert abs(image.mean() - expected) < largest_z(64) * image.std() / 8 + 1e-5
    assert image.std() / 8 < 0.01 * expected


@each_case(
    ({"type": "sky", "distribution": "overcast"}, "irradiance is missing"),
    ({"type": "sky", "distribution": "uniform", "irradiance": 1.0, "sun_zenith_deg": 3.0}, "leave it out"),
)
def test_invalid_input_is_refused(plugin, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict(plugin)
