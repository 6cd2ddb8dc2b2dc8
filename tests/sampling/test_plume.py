"""Bubbles behind a ship: the box that they fill, flights through it, and what they do to a signal."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import significance
from frequencies import assert_counts
from significance import assert_same, largest_z, mean_and_error

from mitransient_lidar.transport.medium.bubble_plume import BubblePlume

PLUME = BubblePlume(0.8, 3.0, -2.0, np.radians(35), 20.0, 6.0, 2.5)


def rays(count=4000, seed=1):
    """Return points about the plume and directions, upward, downward and level."""
    rng = np.random.default_rng(seed)
    point = np.column_stack([rng.uniform(-25, 10, (count, 2)), rng.uniform(-4, 0.5, count)])
    direction = rng.normal(size=(count, 3))
    direction[: count // 4, 2] = 0
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return point, direction, mi.Point3f(point.T.copy()), mi.Vector3f(direction.T.copy())


def inside(points):
    """Return which points lie in the plume, by its corners: 20 m towards 215 degrees, 6 m wide, 2.5 m deep."""
    offset = points[..., :2] - [3.0, -2.0]
    astern = offset @ [-np.cos(np.radians(35)), -np.sin(np.radians(35))]
    across = offset @ [-np.sin(np.radians(35)), np.cos(np.radians(35))]
    return (astern > 0) & (astern < 20) & (np.abs(across) < 3) & (points[..., 2] > -2.5)


def test_plume_lies_astern_of_the_ship():
    point, _, lanes, _ = rays()
    np.testing.assert_array_equal(np.array(PLUME.holds(lanes)), inside(point))
    assert 0.05 < inside(point).mean() < 0.5


def test_optical_depth_is_that_of_the_points_inside():
    point, direction, lanes, vectors = rays()
    steps = (np.arange(8000) + 0.5) * (30.0 / 8000)
    depth = np.array(PLUME.optical_depth(lanes, vectors, mi.Float(30.0)))
    for index in range(0, 4000, 40):
        on_ray = point[index] + steps[:, None] * direction[index]
        assert depth[index] == pytest.approx(0.8 * inside(on_ray).sum() * 30.0 / 8000, abs=0.8 * 0.01)


def test_flight_inverts_the_optical_depth():
    _, _, lanes, vectors = rays()
    whole = PLUME.optical_depth(lanes, vectors, mi.Float(1e4))
    drawn = mi.Float(0.4)
    distance = PLUME.distance(lanes, vectors, drawn)
    np.testing.assert_array_equal(np.isinf(np.array(distance)), np.array(whole) <= 0.4)
    ends = np.array(whole) > 0.4 + 1e-4
    back = np.array(PLUME.optical_depth(lanes, vectors, dr.minimum(distance, 1e4)))
    np.testing.assert_allclose(back[ends], 0.4, atol=2e-4)
    assert ends.sum() > 100


def test_events_are_shared_by_water_and_bubbles_as_they_attenuate():
    """Bubbles of 1.5/m: in the attenuation of two layers, 0.5 and 0.9 of 2 and 2.4, and in their scattering."""
    water = mi.load_dict(
        {
            **{"type": "layered_water", "layer_tops": "0, 2", "attenuation": "0.5, 0.9", "scattering": "0.3, 0.6"},
            **{"backscattering": "0.006, 0.012", "plume_scattering": 1.5, "plume_x": 10.0, "plume_depth": 3.0},
        }
    ).water
    count = 2**18
    for flight, upper, lower in ((water.flight, 0.5, 0.9), (water.scattering_flight, 0.3, 0.6)):
        for depth, number, coefficient in ((1.0, 0, upper), (2.5, 1, lower)):
            point = dr.full(mi.Point3f, 0, count) + mi.Point3f(0, 0, -depth)
            rng = mi.PCG32(size=count, initstate=significance.seed_shift + number)
            drawn = np.array(water.scatterer_at(flight, point, rng))
            expected = np.zeros(3)
            expected[[number, 2]] = count * np.array([coefficient, 1.5]) / (coefficient + 1.5)
            counts = np.bincount(drawn, minlength=3)
            assert counts[1 - number] == 0
            assert_counts(counts[[number, 2]], expected[[number, 2]], known=1)


@pytest.mark.parametrize(
    "integrator",
    [pytest.param("lidar_volpath", marks=pytest.mark.long), pytest.param("lidar_merging", marks=pytest.mark.slow)],
)
def test_plume_that_fills_the_water_is_water_that_scatters_more(lidar_scene, passes, integrator):
    """Half of the scattering from bubbles: mean energies by gate agree with all of it from the water."""
    hg = {"phase_function": "hg", "phase_g": 0.9, "backscattering": 0.0}
    bubbles = {"plume_scattering": 0.2, "plume_length": 1e3, "plume_width": 1e3, "plume_depth": 99.0, "plume_x": 500.0}
    waters = (
        {**hg, "attenuation": 0.35, "scattering": 0.2, **bubbles, "plume_phase": {"type": "hg", "g": 0.9}},
        {**hg, "attenuation": 0.55, "scattering": 0.4},
    )
    # Ten passes find a factor of 3 %.
    engine = {"type": integrator, "paths_per_pass": 2**14}
    if integrator == "lidar_merging":
        engine["photons_per_pass"] = 2**14
    film = {"time_start_ns": 1400.0, "bin_width_ns": 20.0, "bin_count": 6}
    energy = [
        passes(lidar_scene(integrator=engine, water=water, film=film), 10, first_seed=100 * number).sum(axis=1)
        for number, water in enumerate(waters)
    ]
    assert_same(energy[0][:, :5], energy[1][:, :5], error=0.02)


@pytest.mark.long
def test_bubbles_brighten_the_water_that_they_fill_and_darken_the_bottom(lidar_scene, passes):
    """A plume across the beam, 2 m deep: more backscatter down to 2 m (18.5 ns), less light from below."""
    engine = {"type": "lidar_merging"}
    bubbles = {"plume_scattering": 1.0, "plume_x": 50.0, "plume_depth": 2.0, "plume_width": 30.0}
    clear, wake = (passes(lidar_scene(integrator=engine, water=water), 8).sum(axis=1) for water in ({}, bubbles))
    upper, lower = slice(34, 46), slice(56, 95)  # 1424 to 1436 ns and 1446 to 1485 ns
    limit = largest_z(8, 2)
    for gate, factor in ((upper, 2), (lower, 0.95)):
        brighter, error = mean_and_error(np.sign(factor - 1) * (wake - factor * clear)[:, gate].sum(axis=1))
        assert brighter > limit * error
