"""Light of water and bottoms, against quadratures without scattering and moments of scattered paths."""

import numpy as np
import significance
from oracles.beam_average import column_energy_per_bin
from oracles.lidar_equation import bottom_energy
from oracles.phase import henyey_greenstein

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.echo_estimate import _backscatter, water_and_bottoms
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase_table import PowerLawTable

SYSTEM = LidarSystem(200.0, np.radians(20), 1.34, 1.364, energy=3e-3, aperture_area=0.02)


def of_asymmetry(g):
    return PowerLawTable.from_function(lambda theta: henyey_greenstein(theta, g))


def test_levels_and_times_without_scattering():
    """Water that scatters next to nothing: gain, attenuation, backscatter, cosines."""
    edges, water = 1410 + 4.0 * np.arange(20), WaterColumn([0.0], [0.2], [1e-9], [1e-11])
    expected = column_energy_per_bin(edges, SYSTEM, 1e-7, water, float(henyey_greenstein(np.pi, 0.7)), 8.0)
    found = []
    for number in range(16):
        rng = np.random.default_rng([number, significance.seed_shift])
        light, bottoms = water_and_bottoms(SYSTEM, (0.2, 1e-9), of_asymmetry(0.7), 1e-12, 8.0, (2**8, 80), rng)
        found.append(np.histogram(light.time_ns, edges, weights=np.broadcast_to(light.energy, light.time_ns.shape))[0])
    strong = expected > 0.1 * expected.max()
    significance.assert_equal(np.array(found)[:, strong], expected[strong], error=0.1, bias=3e-3)
    energies = [float(bottom_energy(SYSTEM, water, z, 1.0, SYSTEM.off_nadir)) for z in (0.05, 4.05, 7.95)]
    np.testing.assert_allclose(bottoms.energy.sum(axis=0)[[0, 40, 79]], np.pi * np.array(energies), rtol=1e-6)


def test_scattering_shifts_and_delays_by_its_moments():
    """Straight down, on both ways: mean square of the shift 2 b <tan^2> z^3/3, mean delay b <1/cos - 1> z^2/v."""
    b, a, deepest, steps = 0.2, 0.05, 10.0, 16
    depth = deepest * (1 - 0.5 / steps)
    system = LidarSystem(1e6, 0.0, 1.34, 1.364, energy=1.0, aperture_area=1.0)
    theta = np.linspace(0, np.radians(80), 200_001)
    density = 2 * np.pi * henyey_greenstein(theta, 0.99) * np.sin(theta)
    tan2, detour = (np.trapezoid(density * each, theta) for each in (np.tan(theta) ** 2, 1 / np.cos(theta) - 1))
    speed, samples = 1e-9 * C0 / 1.364, []
    for number in range(16):
        rng = np.random.default_rng([number, significance.seed_shift])
        light = water_and_bottoms(system, (a, b), of_asymmetry(0.99), 2e-12, deepest, (2**13, steps), rng)[1]
        # From so high, angles times height are shifts, and angles change no time.
        shift = (1e6 + depth / 1.34) * np.abs(light.shift[:, -1])
        delay = light.time_ns[:, -1] - 2e9 / C0 * (1e6 + 1.364 * depth)
        samples.append([np.mean(shift**2), np.mean(delay)])
    ripples = 2 * 2e-12 * (depth * (1 - 1 / 1.34)) ** 2
    expected = [2 * b * tan2 * depth**3 / 3 + ripples, b * detour * depth**2 / speed]
    significance.assert_equal([[one[0]] for one in samples], [expected[0]], error=0.03, bias=0.01)
    significance.assert_equal([[one[1]] for one in samples], [expected[1]], error=0.03, bias=0.01)


def test_shifts_on_the_way_up_change_no_time():
    """Without shifts on the way down, time is that of the axis; half of the mean square of the angles remains."""
    rng = np.random.default_rng(3 + significance.seed_shift)
    system = LidarSystem(200.0, np.radians(60), 1.34, 1.34, energy=1.0, aperture_area=1.0)
    bottoms = water_and_bottoms(system, (0.05, 0.25), of_asymmetry(0.95), 2e-12, 8.0, (2**14, 16), rng)[1]
    x, time = bottoms.shift[:, -1].real, bottoms.time_ns[:, -1]
    bent = abs(x) > 1e-12
    # On the slope of the line of sight of the lit point, 2 H sin(theta)/(c cos^2(theta)) a radian, or on none.
    slope = np.polyfit(x[bent], (time - time.min())[bent], 1)[0]
    steepest = 2e9 / C0 * 200.0 * np.sin(np.radians(60)) / np.cos(np.radians(60)) ** 2
    assert 0.3 < slope / steepest < 0.75


def test_tilted_light_meets_more_water_and_the_bottom_the_same():
    """Isotropic backscatter: 1/cos for each way; of a function of the angle, that between both directions."""
    even = PowerLawTable.from_function(lambda theta: np.full_like(theta, 1 / (4 * np.pi)))
    down, up = np.array([[0.0, 0.5, 0.5, 0.5j]]), np.array([[0.0, 0.0, -0.5, 0.5]])
    angles = np.pi - np.array([0.0, np.arctan(0.5), 0.0, np.arccos(1 / 1.25)])
    for phase, expected in ((even, 1 / (4 * np.pi)), (of_asymmetry(-0.4), henyey_greenstein(angles, -0.4))):
        found = _backscatter(0.2, phase, down, up)[0]
        np.testing.assert_allclose(found, 0.2 * expected * np.array([1, 1.25**0.5, 1.25, 1.25]), rtol=0.01)
