"""Fast estimate of echoes, against quadratures without scattering and moments of scattered paths."""

import numpy as np
import pytest
import significance
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin, surface_energy_per_bin
from oracles.phase import henyey_greenstein

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.echo_estimate import EchoEstimate
from mitransient_lidar.physics.lidar.lidar_geometry import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable

SYSTEM = LidarSystem(200.0, np.radians(20), 1.34, 1.364, energy=3e-3, aperture_area=0.02)
SIGMA, EDGES = 5e-3, 1380 + 4.0 * np.arange(36)
LAYERS = WaterColumn([0.0, 3.0], [0.2, 0.1], [1e-9, 2e-9], [1e-11, 4e-11])
PHASES = [PowerLawTable.from_function(lambda theta, g=g: henyey_greenstein(theta, g)) for g in (0.7, 0.5)]
FLAT = np.diag([1e-12, 1e-12])


def beam(rng, count=2**10):
    return SIGMA * rng.standard_normal((count, 2))


def binned(light, inside):
    """Return energies by time bin of light within half of a field of view."""
    light = [np.broadcast_to(each, np.broadcast_shapes(*(one.shape for one in light))) for each in light]
    seen = inside(light[0], light[1])
    return np.histogram(light[2][seen], EDGES, weights=light[3][seen])[0]


def far(x, y):
    return (np.hypot(x, y) < 15e-3) & (x > 0)


def records(model, kind, passes=16):
    found = []
    for number in range(passes):
        rng = np.random.default_rng([number, significance.seed_shift])
        points = beam(rng)
        if kind == "surface":
            found.append(binned(model.surface(points), far))
        else:
            found.append(binned(model.water_and_bottom(points, 80, rng)[kind == "bottom"], far))
    return np.array(found)


def test_surface_follows_the_slopes_in_their_directions():
    along, across = 0.02, 0.012
    expected = surface_energy_per_bin(EDGES, SYSTEM, SIGMA, (along, across), far)
    model = EchoEstimate(SYSTEM, LAYERS, PHASES, np.diag([along, across]), 8.0, 0.15)
    found, strong = records(model, "surface"), expected > 0.02 * expected.max()
    significance.assert_equal(found[:, strong], expected[strong], error=0.012, bias=1e-3)


@pytest.mark.parametrize("kind", ["water"])
def test_levels_and_times_without_scattering(kind):
    """Layers that scatter next to nothing: gain, attenuation, backscatter of each layer, cosines."""
    model = EchoEstimate(SYSTEM, LAYERS, PHASES, FLAT, 8.0, 0.15)
    if kind == "bottom":
        expected = bottom_energy_per_bin(EDGES, SYSTEM, SIGMA, LAYERS, 8.0, 0.15, far)
    else:
        backward = [float(henyey_greenstein(np.pi, g)) for g in (0.7, 0.5)]
        expected = column_energy_per_bin(EDGES, SYSTEM, SIGMA, LAYERS, backward, 8.0, far)
    found, strong = records(model, kind), expected > 0.02 * expected.max()
    significance.assert_equal(found[:, strong], expected[strong], error=0.012, bias=3e-3)


def test_scattering_shifts_and_delays_by_its_moments():
    """Straight down, on both ways: mean square of the shift 2 b <tan^2> z^3/3, mean delay b <1/cos - 1> z^2/v."""
    b, a, depth = 0.2, 0.05, 10.0
    system = LidarSystem(1e6, 0.0, 1.34, 1.364, energy=1.0, aperture_area=1.0)
    phase = PowerLawTable.from_function(lambda theta: henyey_greenstein(theta, 0.99))
    model = EchoEstimate(system, WaterColumn([0.0], [a + b], [b], [1e-4]), [phase], FLAT, depth, 0.1)
    theta = np.linspace(0, np.radians(80), 200_001)
    density = 2 * np.pi * henyey_greenstein(theta, 0.99) * np.sin(theta)
    tan2, detour = (np.trapezoid(density * each, theta) for each in (np.tan(theta) ** 2, 1 / np.cos(theta) - 1))
    speed, samples = 1e-9 * C0 / 1.364, []
    for number in range(16):
        rng = np.random.default_rng([number, significance.seed_shift])
        light = model.water_and_bottom(np.zeros((2**13, 2)), 16, rng)[1]
        # From so high, angles times height are shifts, and angles change no time.
        shift = (1e6 + depth / 1.34) * np.hypot(light.angle_x, light.angle_y)
        delay = light.time_ns - 2e9 / C0 * (1e6 + 1.364 * depth)
        samples.append([np.mean(shift**2), np.mean(delay)])
    ripples = 2 * 2e-12 * (depth * (1 - 1 / 1.34)) ** 2
    expected = [2 * b * tan2 * depth**3 / 3 + ripples, b * detour * depth**2 / speed]
    significance.assert_equal([[one[0]] for one in samples], [expected[0]], error=0.03, bias=0.01)
    significance.assert_equal([[one[1]] for one in samples], [expected[1]], error=0.03, bias=0.01)


def test_shifts_on_the_way_up_change_no_time():
    """Without shifts on the way down, time is that of the beam; half of the mean square of the angles remains."""
    rng = np.random.default_rng(3 + significance.seed_shift)
    column = WaterColumn([0.0], [0.3], [0.25], [1e-4])
    phase = PowerLawTable.from_function(lambda theta: henyey_greenstein(theta, 0.95))
    system = LidarSystem(200.0, np.radians(60), 1.34, 1.34, energy=1.0, aperture_area=1.0)
    model = EchoEstimate(system, column, [phase], FLAT, 8.0, 0.1)
    bottom = model.water_and_bottom(np.zeros((2**14, 2)), 16, rng)[1]
    x, time = bottom.angle_x.ravel(), bottom.time_ns.ravel()
    bent = abs(x) > 1e-12
    # On the slope of the line of sight of the lit point, 2 H sin(theta)/(c cos^2(theta)) a radian, or on none.
    slope = np.polyfit(x[bent], (time - time.min())[bent], 1)[0]
    steepest = 2e9 / C0 * 200.0 * np.sin(np.radians(60)) / np.cos(np.radians(60)) ** 2
    assert 0.3 < slope / steepest < 0.75


def test_tilted_light_meets_more_water_and_the_bottom_the_same():
    """Isotropic backscatter: 1/cos for each way; of a function of the angle, that between both directions."""
    water = WaterColumn(np.zeros(1), np.array([0.3]), np.array([0.2]), np.array([0.1]))
    even = PowerLawTable.from_function(lambda theta: np.full_like(theta, 1 / (4 * np.pi)))
    steep = PowerLawTable.from_function(lambda theta: henyey_greenstein(theta, -0.4))
    down, up = np.array([[0.0, 0.5, 0.5, 0.5j]]), np.array([[0.0, 0.0, -0.5, 0.5]])
    angles = np.pi - np.array([0.0, np.arctan(0.5), 0.0, np.arccos(1 / 1.25)])
    for phase, expected in ((even, 1 / (4 * np.pi)), (steep, henyey_greenstein(angles, -0.4))):
        model = EchoEstimate(SYSTEM, water, [phase], FLAT, 8.0, 0.1)
        found = model._backscatter(np.array([1.0, 2.0, 3.0, 4.0]), down, up)[0]
        np.testing.assert_allclose(found, 0.2 * expected * np.array([1, 1.25**0.5, 1.25, 1.25]), rtol=0.01)
