"""Bubbles behind a ship and below a windy sea: where they are, flights through them, and light in them."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from frequencies import assert_counts
from significance import assert_same

from mitransient_lidar.physics.water.bubbles import WindBubbles
from mitransient_lidar.transport.medium.bubbles import BubbleLayer, BubblePlume

PLUME, LAYER = BubblePlume(0.8, 3.0, -2.0, np.radians(35), 20.0, 6.0, 2.5), BubbleLayer(0.8, 1.2)


def inside(points):
    """Return which points lie in the plume, by its corners: 20 m towards 215 degrees, 6 m wide, 2.5 m deep."""
    offset = points[..., :2] - [3.0, -2.0]
    astern = offset @ [-np.cos(np.radians(35)), -np.sin(np.radians(35))]
    across = offset @ [-np.sin(np.radians(35)), np.cos(np.radians(35))]
    return (astern > 0) & (astern < 20) & (np.abs(across) < 3) & (points[..., 2] > -2.5)


def in_layer(points):
    return np.exp(np.minimum(points[..., 2], 0) / 1.2)


#: Bubbles, their density over 0.8/m, and the error of its sums in steps: the plume has edges.
BUBBLES = [pytest.param(PLUME, inside, 8e-3, id="plume"), pytest.param(LAYER, in_layer, 2e-5, id="layer")]


def rays(count=4000, seed=1):
    """Return points about the plume and directions, upward, downward and level, and the same for Dr.Jit."""
    rng = np.random.default_rng(seed)
    point = np.column_stack([rng.uniform(-25, 10, (count, 2)), rng.uniform(-4, 0.5, count)])
    direction = rng.normal(size=(count, 3))
    direction[: count // 4, 2] = 0
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return point, direction, mi.Point3f(point.T.copy()), mi.Vector3f(direction.T.copy())


def test_bubbles_are_astern_of_the_ship_and_fewer_deeper_down():
    point, _, lanes, _ = rays()
    np.testing.assert_array_equal(np.array(PLUME.holds(lanes)), inside(point))
    assert 0.05 < inside(point).mean() < 0.5
    np.testing.assert_allclose(np.array(LAYER.scattering_at(lanes)), 0.8 * in_layer(point), rtol=1e-5)


@pytest.mark.parametrize(("bubbles", "density", "error"), BUBBLES)
def test_optical_depth_is_the_integral_along_the_ray(bubbles, density, error):
    point, direction, lanes, vectors = rays()
    steps = (np.arange(8000) + 0.5) * (30.0 / 8000)
    found = np.array(bubbles.optical_depth(lanes, vectors, mi.Float(30.0)))
    for index in range(0, 4000, 40):
        expected = 0.8 * np.mean(density(point[index] + steps[:, None] * direction[index])) * 30.0
        assert found[index] == pytest.approx(expected, rel=2e-5, abs=error)


@pytest.mark.parametrize("bubbles", [PLUME, LAYER], ids=["plume", "layer"])
def test_flight_inverts_the_optical_depth(bubbles):
    _, _, lanes, vectors = rays()
    whole = np.array(bubbles.optical_depth(lanes, vectors, mi.Float(1e5)))
    distance = bubbles.distance(lanes, vectors, mi.Float(0.4))
    never, ends = whole < 0.4 - 1e-4, (whole > 0.4 + 1e-4) & (np.array(distance) < 1e4)
    assert np.isinf(np.array(distance))[never].all()
    back = np.array(bubbles.optical_depth(lanes, vectors, dr.minimum(distance, 1e5)))
    np.testing.assert_allclose(back[ends], 0.4, atol=2e-4)
    assert ends.sum() > 100
    assert never.sum() > 100


def test_deep_points_see_the_layer_above_them():
    """60 depths down there is no bubble, and on the way up all of them: 0.8 x 1.2 to the sea level."""
    point, up = mi.Point3f(0, 0, -72), mi.Vector3f(0, 0, 1)
    assert np.array(LAYER.optical_depth(point, up, mi.Float(72))).item() == pytest.approx(0.8 * 1.2, rel=1e-5)
    half = np.array(LAYER.distance(point, up, mi.Float(0.48))).item()
    assert half == pytest.approx(72 - 1.2 * np.log(2), rel=1e-5)
    assert np.isinf(np.array(LAYER.distance(point, -up, mi.Float(0.48))).item())


def drawn(water, flight, depth, seed=0, count=2**18):
    """Return how often each kind of scatterer is drawn at a depth."""
    point = dr.full(mi.Point3f, 0, count) + mi.Point3f(0, 0, -depth)
    rng = mi.PCG32(size=count, initstate=significance.seed_shift + seed)
    return np.bincount(np.array(water.scatterer_at(flight, point, rng)), minlength=water.column.count + 1)


def test_events_are_shared_by_water_and_bubbles_as_they_scatter():
    water = mi.load_dict(
        {"type": "layered_water", "attenuation": 0.5, "scattering": 0.3, "bubble_wind_speed": 15.0}
    ).water
    bubbles = WindBubbles.of_wind(15.0)
    assert water.plume == BubbleLayer(bubbles.scattering, bubbles.depth)
    for depth in (0.2, 1.5):
        share = np.array([0.3, bubbles.scattering * np.exp(-depth / bubbles.depth)])
        assert_counts(drawn(water, water.scattering_flight, depth), 2**18 * share / share.sum(), known=1)


def test_events_are_shared_by_water_and_bubbles_as_they_attenuate():
    """Bubbles of 1.5/m: in the attenuation of two layers, 0.5 and 0.9 of 2 and 2.4, and in their scattering."""
    water = mi.load_dict(
        {
            **{"type": "layered_water", "layer_tops": "0, 2", "attenuation": "0.5, 0.9", "scattering": "0.3, 0.6"},
            **{"backscattering": "0.006, 0.012", "plume_scattering": 1.5, "plume_x": 10.0, "plume_depth": 3.0},
        }
    ).water
    for flight, upper, lower in ((water.flight, 0.5, 0.9), (water.scattering_flight, 0.3, 0.6)):
        for depth, layer, coefficient in ((1.0, 0, upper), (2.5, 1, lower)):
            counts = drawn(water, flight, depth, layer)
            assert counts[1 - layer] == 0
            assert_counts(counts[[layer, 2]], 2**18 * np.array([coefficient, 1.5]) / (coefficient + 1.5), known=1)


#: Water whose bubbles have its phase function.
HG = {"phase_function": "hg", "phase_g": 0.9, "backscattering": 0.0}
ALIKE = {**HG, "plume_phase": {"type": "hg", "g": 0.9}}


def energies(lidar_scene, passes, integrator, film, *waters):
    engine = {"type": integrator, "paths_per_pass": 2**14}
    if integrator == "lidar_merging":
        engine["photons_per_pass"] = 2**14
    return [
        passes(lidar_scene(integrator=engine, water=water, film=film), 10, first_seed=100 * number).sum(axis=1)
        for number, water in enumerate(waters)
    ]


INTEGRATORS = [
    pytest.param("lidar_volpath", marks=pytest.mark.slow),
    pytest.param("lidar_merging", marks=pytest.mark.long),
]


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_layer_is_water_in_many_thin_layers(lidar_scene, passes, integrator):
    """Bubbles of the water's phase function against layers of 0.1 m with their mean: energies by gate agree."""
    scattering, depth = 0.5, 1.0
    tops = np.append(np.arange(0, 5, 0.1), 5.0)
    ends = np.append(tops[1:], 1e3)
    mean = scattering * depth * (np.exp(-tops / depth) - np.exp(-ends / depth)) / (ends - tops)
    fraction = 2 * scattering * WindBubbles.of_wind(10.0).radius / 3
    bubbles = {"bubble_void_fraction": fraction, "bubble_depth": depth}
    layers = {
        "layer_tops": ", ".join(f"{top:.6g}" for top in tops),
        "attenuation": ", ".join(f"{0.35 + b:.8g}" for b in mean),
        "scattering": ", ".join(f"{0.2 + b:.8g}" for b in mean),
    }
    waters = ({**ALIKE, "attenuation": 0.35, "scattering": 0.2, **bubbles}, {**HG, **layers})
    film = {"time_start_ns": 1415.0, "bin_width_ns": 10.0, "bin_count": 9}
    assert_same(*energies(lidar_scene, passes, integrator, film, *waters), error=0.02, bias=0.002)


def test_bubbles_of_waves_and_of_a_wake_are_alternatives():
    with pytest.raises(RuntimeError, match=r"plume_scattering = 0\.5 must be 0 with bubbles by"):
        mi.load_dict({"type": "layered_water", "bubble_wind_speed": 10.0, "plume_scattering": 0.5})
