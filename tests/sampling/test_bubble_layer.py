"""Bubbles below a windy sea: optical depths and flights through the layer, and light in it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from frequencies import assert_counts
from significance import assert_same

from mitransient_lidar.physics.water.bubbles import WindBubbles
from mitransient_lidar.transport.medium.bubble_layer import BubbleLayer

LAYER = BubbleLayer(0.8, 1.2)


def rays(count=4000, seed=1):
    """Return heights from crests to 8 m down, vertical components, and the same for Dr.Jit; some rays are level."""
    rng = np.random.default_rng(seed)
    z = np.concatenate([rng.uniform(-8, 0.5, count - 100), np.zeros(100)])
    vertical = rng.uniform(-1, 1, count)
    vertical[: count // 8] = 0
    vertical[count // 8 : count // 4] *= 1e-3
    direction = np.stack([np.sqrt(1 - vertical**2), np.zeros(count), vertical])
    return z, vertical, mi.Point3f(0, 0, mi.Float(z)), mi.Vector3f(direction)


def density(z):
    return 0.8 * np.exp(np.minimum(z, 0) / 1.2)


def test_coefficient_falls_below_the_sea_level_and_is_even_above_it():
    z, _, points, _ = rays()
    np.testing.assert_allclose(np.array(LAYER.scattering_at(points)), density(z), rtol=1e-5)


def test_optical_depth_is_the_integral_along_the_ray():
    z, vertical, points, directions = rays()
    length = np.random.default_rng(2).uniform(0.01, 10, z.size)
    found = np.array(LAYER.optical_depth(points, directions, mi.Float(length)))
    steps = (np.arange(2000) + 0.5) / 2000
    expected = [np.mean(density(a + steps * s * v)) * s for a, v, s in zip(z, vertical, length, strict=True)]
    # The kink at the sea level costs the midpoint rule a little.
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-6)


def test_flight_inverts_the_optical_depth():
    _, _, points, directions = rays()
    whole = np.array(LAYER.optical_depth(points, directions, mi.Float(1e5)))
    distance = LAYER.distance(points, directions, mi.Float(0.4))
    found, never = np.array(distance), whole < 0.4 * (1 - 1e-5)
    assert np.all(np.isinf(found[never]))
    ends = (whole > 0.4 * (1 + 1e-5)) & (found < 1e4)
    back = np.array(LAYER.optical_depth(points, directions, dr.minimum(distance, 1e5)))
    np.testing.assert_allclose(back[ends], 0.4, rtol=2e-4)
    assert ends.sum() > 2000
    assert never.sum() > 200


def test_deep_points_see_the_layer_above_them():
    """60 depths down there is no bubble, and on the way up all of them: 0.8 x 1.2 to the sea level."""
    point, up = mi.Point3f(0, 0, -72), mi.Vector3f(0, 0, 1)
    assert np.array(LAYER.optical_depth(point, up, mi.Float(72))).item() == pytest.approx(0.8 * 1.2, rel=1e-5)
    half = np.array(LAYER.distance(point, up, mi.Float(0.48))).item()
    assert half == pytest.approx(72 - 1.2 * np.log(2), rel=1e-5)
    assert np.isinf(np.array(LAYER.distance(point, -up, mi.Float(0.48))).item())


def test_events_are_shared_by_water_and_bubbles_as_they_scatter():
    water = mi.load_dict(
        {"type": "layered_water", "attenuation": 0.5, "scattering": 0.3, "bubble_wind_speed": 15.0}
    ).water
    bubbles, count = WindBubbles.of_wind(15.0), 2**18
    assert water.plume == BubbleLayer(bubbles.scattering, bubbles.depth)
    for depth in (0.2, 1.5):
        point = dr.full(mi.Point3f, 0, count) + mi.Point3f(0, 0, -depth)
        rng = mi.PCG32(size=count, initstate=significance.seed_shift)
        drawn = np.bincount(np.array(water.scatterer_at(water.scattering_flight, point, rng)), minlength=2)
        local = bubbles.scattering * np.exp(-depth / bubbles.depth)
        assert_counts(drawn, count * np.array([0.3, local]) / (0.3 + local), known=1)


@pytest.mark.parametrize(
    "integrator",
    [pytest.param("lidar_volpath", marks=pytest.mark.long), pytest.param("lidar_merging", marks=pytest.mark.slow)],
)
def test_layer_is_water_in_many_thin_layers(lidar_scene, passes, integrator):
    """Bubbles of the water's phase function against layers of 0.1 m with their mean: energies by gate agree."""
    scattering, depth = 0.5, 1.0
    tops = np.append(np.arange(0, 5, 0.1), 5.0)
    ends = np.append(tops[1:], 1e3)
    mean = scattering * depth * (np.exp(-tops / depth) - np.exp(-ends / depth)) / (ends - tops)
    fraction = 2 * scattering * WindBubbles.of_wind(10.0).radius / 3
    hg = {"phase_function": "hg", "phase_g": 0.9, "backscattering": 0.0}
    bubbles = {"bubble_void_fraction": fraction, "bubble_depth": depth, "plume_phase": {"type": "hg", "g": 0.9}}
    layers = {
        "layer_tops": ", ".join(f"{top:.6g}" for top in tops),
        "attenuation": ", ".join(f"{0.35 + b:.8g}" for b in mean),
        "scattering": ", ".join(f"{0.2 + b:.8g}" for b in mean),
    }
    waters = ({**hg, "attenuation": 0.35, "scattering": 0.2, **bubbles}, {**hg, **layers})
    engine = {"type": integrator, "paths_per_pass": 2**14}
    if integrator == "lidar_merging":
        engine["photons_per_pass"] = 2**14
    film = {"time_start_ns": 1415.0, "bin_width_ns": 10.0, "bin_count": 9}
    energy = [
        passes(lidar_scene(integrator=engine, water=water, film=film), 10, first_seed=100 * number).sum(axis=1)
        for number, water in enumerate(waters)
    ]
    assert_same(energy[0], energy[1], error=0.02, bias=0.002)


def test_bubbles_of_waves_and_of_a_wake_are_alternatives():
    with pytest.raises(RuntimeError, match=r"plume_scattering = 0\.5 must be 0 with bubbles of"):
        mi.load_dict({"type": "layered_water", "bubble_wind_speed": 10.0, "plume_scattering": 0.5})
