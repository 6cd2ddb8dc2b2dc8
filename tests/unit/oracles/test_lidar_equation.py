"""Closed forms against numbers of an independent double-precision Monte Carlo and its own quadratures."""

import numpy as np
import pytest
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin, echo_energies, surface_energy_per_bin
from oracles.lidar_equation import bottom_energy, column_energy, column_power, surface_energy
from scipy.integrate import trapezoid

from mitransient_lidar.physics.lidar.lidar_geometry import LidarSystem
from mitransient_lidar.physics.lidar.pulse import Pulse, waveform
from mitransient_lidar.physics.water.layers import WaterColumn

THETA = np.radians(20)
SYSTEM = LidarSystem(200, THETA, 1.34, 1.34, energy=3.645e-3, aperture_area=0.025)
WATER = WaterColumn.from_text(0, 0.3, 0.15, 0.006)
P_BACK = 6.613178e-3
SLOPES = (0.01836 / 2, 0.01836 / 2)
SIGMA = 0.005
T_SURFACE = 1419.8860
PER_METRE = 9.24576


def square(angle_x, angle_y):
    return (np.abs(angle_x) < 0.015) & (np.abs(angle_y) < 0.015)


def circle(angle_x, angle_y):
    return np.hypot(angle_x, angle_y) < 0.015


def near_pixel(angle_x, angle_y):
    return square(angle_x, angle_y) & (angle_x < 0) & (angle_y < 0)


def far_pixel(angle_x, angle_y):
    return square(angle_x, angle_y) & (angle_x > 0) & (angle_y > 0)


@pytest.mark.parametrize(("mss", "energy"), [(0.01836, 1.8470e-13), (0.03372, 2.691e-12), (0.0542, 7.387e-12)])
def test_surface_of_a_pencil_beam(mss, energy):
    assert surface_energy(SYSTEM, (mss / 2, mss / 2), THETA) == pytest.approx(energy, rel=3e-4, abs=0)


def test_anisotropic_slopes_follow_the_azimuth():
    along, across = surface_energy(SYSTEM, (0.02, 0.01), THETA, [0, np.pi / 2])
    # p = exp(-tan^2/(2 var)) / (2 pi sx sy): only the exponent differs.
    assert along / across == pytest.approx(np.exp(np.tan(THETA) ** 2 * (1 / 0.02 - 1 / 0.01) / -2))


@pytest.mark.parametrize(("attenuation", "energy"), [("c", 2.1198e-13), ("a+bb", 2.2971e-12)])
def test_bottom_of_a_pencil_beam(attenuation, energy):
    assert bottom_energy(SYSTEM, WATER, 8, 0.1, THETA, attenuation) == pytest.approx(energy, rel=3e-5, abs=0)


@pytest.mark.parametrize(
    ("attenuation", "power"),
    [
        ("c", [1.1573e-4, 6.179e-5, 3.299e-5, 1.761e-5, 9.403e-6, 5.021e-6, 2.681e-6, 1.431e-6]),
        ("a+bb", [1.1573e-4, 8.322e-5, 5.985e-5, 4.304e-5, 3.095e-5, 2.226e-5, 1.601e-5, 1.152e-5]),
    ],
)
def test_column_power_of_a_pencil_beam(attenuation, power):
    got = column_power(SYSTEM, WATER, P_BACK, np.arange(8), THETA, attenuation)
    np.testing.assert_allclose(got, power, rtol=5e-4)


def test_column_energy_is_the_integral_of_the_power():
    layers = WaterColumn.from_text("0 3", "0.9 0.5", "0.45 0.2", 0.006)
    phase = [P_BACK, 2 * P_BACK]
    z = np.linspace(1, 7, 600_001)
    power = column_power(SYSTEM, layers, phase, z, THETA)
    expected = trapezoid(power, z) * PER_METRE * 1e-9
    assert column_energy(SYSTEM, layers, phase, 1, 7, THETA) == pytest.approx(expected, rel=1e-5, abs=0)
    # Across the boundary the power steps by the ratio of backscatter: (0.2 * 2)/0.45.
    step = np.divide(*column_power(SYSTEM, layers, phase, [3 + 1e-9, 3 - 1e-9], THETA))
    assert step == pytest.approx(0.4 / 0.45, rel=1e-6)


def test_column_energy_per_metre():
    got = column_power(SYSTEM, WATER, P_BACK, np.arange(1, 8), THETA) * PER_METRE * 1e-9
    np.testing.assert_allclose(got, [5.71e-13, 3.05e-13, 1.63e-13, 8.69e-14, 4.64e-14, 2.48e-14, 1.32e-14], rtol=4e-3)


@pytest.mark.parametrize(
    ("region", "surface", "column", "bottom"),
    [
        (None, 1.88484e-13, 1.69360e-12, 2.11952e-13),
        (square, 1.87365e-13, 1.68447e-12, 2.10810e-13),
        (circle, 1.86199e-13, 1.67480e-12, 2.09600e-13),
        (near_pixel, 5.48784e-14, 4.22605e-13, 5.31253e-14),
        (far_pixel, 3.88043e-14, 4.19630e-13, 5.22796e-14),
    ],
)
def test_gaussian_beam_without_forward_light(region, surface, column, bottom):
    got = echo_energies(SYSTEM, SIGMA, WATER, P_BACK, 8, 0.1, SLOPES, region)
    np.testing.assert_allclose(got, [surface, column, bottom], rtol=1e-4)


@pytest.mark.parametrize(
    ("region", "column", "bottom"),
    [(None, 3.01306e-12, 2.29686e-12), (square, 2.99682e-12, 2.28448e-12), (far_pixel, 7.46664e-13, 5.67570e-13)],
)
def test_gaussian_beam_with_forward_light(region, column, bottom):
    got = echo_energies(SYSTEM, SIGMA, WATER, P_BACK, 8, 0.1, SLOPES, region, "a+bb")
    np.testing.assert_allclose(got[1:], [column, bottom], rtol=1e-4)


@pytest.fixture(scope="module")
def edges():
    # Bin centres at multiples of 0.05 ns from the axial surface echo
    return T_SURFACE - 30.025 + 0.05 * np.arange(3001)


@pytest.mark.slow
def test_bins_add_up_to_the_echoes(edges):
    total = echo_energies(SYSTEM, SIGMA, WATER, P_BACK, 8, 0.1, SLOPES, square)
    binned = (
        surface_energy_per_bin(edges, SYSTEM, SIGMA, SLOPES, square).sum(),
        column_energy_per_bin(edges, SYSTEM, SIGMA, WATER, P_BACK, 8, square).sum(),
        bottom_energy_per_bin(edges, SYSTEM, SIGMA, WATER, 8, 0.1, square).sum(),
    )
    np.testing.assert_allclose(binned, total, rtol=1e-8)


def test_bins_do_not_depend_on_their_width(edges):
    fine = bottom_energy_per_bin(edges, SYSTEM, SIGMA, WATER, 8, 0.1)
    coarse = bottom_energy_per_bin(edges[::40], SYSTEM, SIGMA, WATER, 8, 0.1)
    np.testing.assert_allclose(coarse, fine.reshape(-1, 40).sum(axis=1), rtol=1e-9, atol=1e-30)


def test_arrival_times_spread_across_the_beam(edges):
    # 0.5168 ns/mrad at the surface times 5 mrad
    energy = bottom_energy_per_bin(edges, SYSTEM, SIGMA, WATER, 0.0, 0.1)
    t = (edges[1:] + edges[:-1]) / 2 - T_SURFACE
    mean = energy @ t / energy.sum()
    assert np.sqrt(energy @ (t - mean) ** 2 / energy.sum()) == pytest.approx(2.58, rel=0.01)


def test_waveform_peaks(edges):
    kernel = Pulse.gaussian(5.0).kernel(0.05)
    t = (edges[1:] + edges[:-1]) / 2 - T_SURFACE
    surface = waveform(surface_energy_per_bin(edges, SYSTEM, SIGMA, SLOPES, square), 0.05, kernel)
    assert surface.max() == pytest.approx(2.251e-5, rel=1e-3)
    assert t[surface.argmax()] == pytest.approx(-0.57, abs=0.06)
    assert np.ptp(t[surface > surface.max() / 2]) == pytest.approx(7.8, abs=0.1)
    for attenuation, peak in (("c", 2.482e-5), ("a+bb", 2.689e-4)):
        energy = bottom_energy_per_bin(edges, SYSTEM, SIGMA, WATER, 8, 0.1, square, attenuation)
        bottom = waveform(energy, 0.05, kernel)
        assert bottom.max() == pytest.approx(peak, rel=1e-3)
        assert t[bottom.argmax()] == pytest.approx(73.92, abs=0.06)
        assert np.ptp(t[bottom > bottom.max() / 2]) == pytest.approx(7.95, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("attenuation", "power"),
    [
        ("c", [6.28e-5, 3.37e-5, 1.80e-5, 9.61e-6, 5.13e-6, 2.74e-6, 1.46e-6]),
        ("a+bb", [8.31e-5, 6.00e-5, 4.32e-5, 3.10e-5, 2.23e-5, 1.61e-5, 1.15e-5]),
    ],
)
def test_waveform_of_the_column(edges, attenuation, power):
    energy = column_energy_per_bin(edges, SYSTEM, SIGMA, WATER, P_BACK, 8, square, attenuation)
    t = (edges[1:] + edges[:-1]) / 2 - T_SURFACE
    got = np.interp(PER_METRE * np.arange(1, 8), t, waveform(energy, 0.05, Pulse.gaussian(5.0).kernel(0.05)))
    np.testing.assert_allclose(got, power, rtol=4e-3)


def test_nadir_beam():
    system = LidarSystem(200, 0, 1.34, 1.34, energy=1, aperture_area=0.025)
    edges = np.linspace(1334, 1420, 173)
    energy = column_energy_per_bin(edges, system, SIGMA, WATER, P_BACK, 8)
    total = echo_energies(system, SIGMA, WATER, P_BACK, 8, 0.1, SLOPES)
    assert energy.sum() == pytest.approx(total.column, rel=1e-9, abs=0)
    assert surface_energy_per_bin(edges, system, SIGMA, SLOPES).sum() == pytest.approx(total.surface, rel=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: surface_energy_per_bin([1, 1], SYSTEM, SIGMA, SLOPES), "edges_ns"),
        (lambda: surface_energy_per_bin([1, 2], SYSTEM, 0.5, SLOPES), "sigma = 0.5"),
    ],
)
def test_bad_parameters_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
