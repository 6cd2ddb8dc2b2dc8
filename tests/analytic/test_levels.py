"""Absolute levels of surface echo, water column and bottom against closed forms, each pixel and their sum.

A wrong n^2 is a factor of 1.8, a wrong pi 3.1, a forgotten cosine 6 % at 20 degrees, one efficiency 10 %.
"""

import numpy as np
import pytest
from oracles.beam_average import bottom_energy_per_bin, column_energy_per_bin, echo_energies
from oracles.lidar_equation import surface_energy
from significance import largest_z

from mitransient_lidar.core.constants import C0
from mitransient_lidar.physics.lidar.lidar_equation import LidarSystem
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import (
    fournier_forand,
    fournier_forand_parameters,
    henyey_greenstein,
    petzold_average_particle,
)

ENERGY = 5e-3 * 0.81 * 0.9
DARK = {"attenuation": 50.0, "scattering": 0.0, "backscattering": 0.0}
HALF = 15e-3


def quadrant(row, column):
    """Return the predicate of one pixel of the 2x2 receiver with a circular field of view."""

    def sees(angle_x, angle_y):
        far, left = angle_x > 0, angle_y > 0
        return (angle_x**2 + angle_y**2 <= HALF**2) & (far == (row == 0)) & (left == (column == 1))

    return sees


FIELDS = [
    quadrant(0, 0),
    quadrant(0, 1),
    quadrant(1, 0),
    quadrant(1, 1),
    lambda angle_x, angle_y: angle_x**2 + angle_y**2 <= HALF**2,
]


def pixels_and_sum(energy):
    """Return energies over the passes of the four pixels and their sum, shape (passes, 5)."""
    total = energy.sum(axis=-1)
    return np.concatenate([total, total.sum(axis=1, keepdims=True)], axis=1)


def system(off_nadir_deg=20.0, height=200.0, index=1.34, energy=ENERGY, area=0.025):
    return LidarSystem(height, np.radians(off_nadir_deg), energy, area, index, index)


def assert_agrees(z_score, samples, expected, error):
    """Compare with a closed form; `error` is the largest relative standard error, of each value or of all."""
    z, relative = z_score(samples, np.asarray(expected))
    assert np.all(relative < error), relative
    assert np.all(np.abs(z) < largest_z(len(samples), z.size)), (z, samples.mean(axis=0) / expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sea", "variance"),
    [
        ({"slope_variance": "0.01836"}, (0.00918, 0.00918)),
        # Cox and Munk at 6 m/s: 3.16e-3 W up- and 0.003 + 1.92e-3 W crosswind; turning the wind swaps the axes.
        ({"slope_variance": "cox_munk", "wind_speed": 6.0}, (0.01896, 0.01452)),
        ({"slope_variance": "cox_munk", "wind_speed": 6.0, "wind_direction_deg": 90.0}, (0.01452, 0.01896)),
    ],
)
def test_surface_echo_of_gaussian_slopes(lidar_scene, passes, z_score, sea, variance):
    energy = passes(lidar_scene(sea=sea, water=DARK, bottom=None), 16)
    water = WaterColumn.from_text(0, 50, 0, 0)
    expected = [echo_energies(system(), 5e-3, water, 0.0, 1.0, 0.1, variance, field).surface for field in FIELDS]
    # The grid of the closed form resolves the circle to 1e-4; the render's own error is smaller still.
    z, relative = z_score(pixels_and_sum(energy), np.array(expected))
    ratio = pixels_and_sum(energy).mean(axis=0) / expected
    assert np.all(relative < 1e-3)
    assert np.all(np.abs(ratio - 1) < largest_z(16, 5) * relative + 5e-4), (ratio, z)


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "index"), [(0.0, 1.34), (10.0, 1.2), (30.0, 1.34)])
def test_surface_echo_with_angle_and_index(lidar_scene, passes, angle, index):
    """Fresnel reflectance ((n-1)/(n+1))^2 and the slope density at the tilt that faces the lidar, pencil beam."""
    pose = {"off_nadir_deg": angle}
    scene = lidar_scene(
        tx={**pose, "divergence_mrad": 0.2},
        rx={**pose, "field_of_view_mrad": 3.0},
        film={"time_start_ns": 1300.0, "bin_count": 300},
        sea={"slope_variance": "0.05"},
        water={**DARK, "refractive_index": index},
        bottom=None,
    )
    expected = float(surface_energy(system(angle, index=index), (0.025, 0.025), np.radians(angle)))
    totals = passes(scene, 16).sum(axis=(1, 2))
    # The echo is evaluated, not sampled: what remains are the beam's width and Smith's masking, below 5e-4 here.
    assert totals.mean() == pytest.approx(expected, rel=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("water", "scatterings", "error"),
    [({"attenuation": 0.15, "scattering": 0.0, "backscattering": 0.0}, -1, 0.0024), ({"attenuation": 0.3}, 0, 0.0057)],
)
def test_unscattered_bottom(lidar_scene, passes, z_score, water, scatterings, error):
    """Water with b = 0, and the unscattered part in water with b > 0, which decays with the full attenuation c."""
    scene = lidar_scene(
        integrator={"max_scatterings": scatterings, "paths_per_pass": 2**17},
        water=water,
        film={"time_start_ns": 1450.0},
    )
    column = WaterColumn.from_text(0, water["attenuation"], 0, 0)
    expected = [echo_energies(system(), 5e-3, column, 0.0, 8.0, 0.1, (1e-4, 1e-4), f).bottom for f in FIELDS]
    # Four pixels, and their sum.
    assert_agrees(z_score, pixels_and_sum(passes(scene, 32)), expected, error * np.array([1, 1, 1, 1, 0.57]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "factor"),
    [
        ({"tx": {"optical_efficiency": 0.45}}, 0.5),
        ({"tx": {"pulse_energy_mj": 10.0}}, 2.0),
        ({"rx": {"optical_efficiency": 0.3}}, 1 / 3),
        ({"rx": {"aperture_area": 0.1}}, 4.0),
        ({"rx": {"two_way_atmospheric_transmittance": 0.45}}, 0.5),
        ({"rho": 0.3}, 3.0),
    ],
)
def test_efficiencies_scale_the_energy(lidar_scene, passes, change, factor):
    """Once, not squared and not twice: the same seed gives the same paths, so the ratio is exact."""
    dark = {"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0}
    common = {"integrator": {"paths_per_pass": 2**12}, "water": dark, "film": {"time_start_ns": 1450.0}}
    reference = passes(lidar_scene(**common), 1).sum()
    # Light reflected twice by the bottom goes as rho^2; none of it is in the echo's first metre of delay here.
    changed = passes(lidar_scene(**common, **change), 1).sum()
    assert changed / reference == pytest.approx(factor, rel=2e-3 if "rho" in change else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("altitude", "angle", "index"), [(20.0, 35.0, 1.34), (1000.0, 35.0, 1.34), (200.0, 0.0, 1.2), (200.0, 20.0, 1.5)]
)
def test_bottom_at_other_altitudes_angles_and_indices(lidar_scene, passes, z_score, altitude, angle, index):
    """Far from the table system the spreading n H/cos + D/cos is another: n^2 and both focal distances count."""
    pose = {"altitude": altitude, "off_nadir_deg": angle}
    start = 2e9 * altitude / np.cos(np.radians(angle)) / C0
    scene = lidar_scene(
        integrator={"paths_per_pass": 2**16},
        tx={**pose, "divergence_mrad": 2.0},
        rx={**pose, "field_of_view_mrad": 60.0, "layout": "1x1"},
        # The record ends before light comes that the bottom has reflected twice.
        film={"time_start_ns": start + 30.0, "bin_count": 80},
        water={"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0, "refractive_index": index},
    )
    column = WaterColumn.from_text(0, 0.1, 0, 0)
    lidar = system(angle, altitude, index)
    expected = echo_energies(lidar, 1e-3, column, 0.0, 8.0, 0.1, (1e-4, 1e-4)).bottom
    assert_agrees(z_score, passes(scene, 24).sum(axis=(1, 2)), expected, 0.0042)


PHASES = {
    "fournier_forand": lambda: float(fournier_forand(np.pi, *fournier_forand_parameters(0.04))),
    "petzold": lambda: float(petzold_average_particle()(np.pi)),
    "hg": lambda: float(henyey_greenstein(np.pi, 0.924)),
}


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_single_scattering_column(lidar_scene, passes, phase):
    """Level and slope in bins of 5 ns: the lidar equation with c both ways and b p(180 deg)."""
    check_column(
        lidar_scene, passes, {"phase_function": phase}, PHASES[phase](), WaterColumn.from_text(0, 0.3, 0.15, 0.006)
    )


@pytest.mark.slow
def test_single_scattering_column_in_layers(lidar_scene, passes):
    """The step at the edge is the ratio of b p(180 deg); below it the upper layer's attenuation still counts."""
    layers = {
        "layer_tops": "0, 3",
        "attenuation": "0.5, 0.3",
        "scattering": "0.2, 0.2",
        "backscattering": "0.004, 0.008",
    }
    backward = [float(fournier_forand(np.pi, *fournier_forand_parameters(ratio))) for ratio in (0.02, 0.04)]
    check_column(lidar_scene, passes, layers, backward, WaterColumn.from_text(*layers.values()))


def check_column(lidar_scene, passes, water, backward, column):
    edges = 1430.0 + 5.0 * np.arange(13)
    scene = lidar_scene(
        integrator={"max_scatterings": 1, "paths_per_pass": 2**17},
        film={"time_start_ns": edges[0], "bin_width_ns": 5.0, "bin_count": 12},
        water=water,
        bottom=None,
    )
    energy = passes(scene, 32)
    # The sum of the pixels as a fifth pixel, and the sum over the bins as a last bin.
    energy = np.concatenate([energy, energy.sum(axis=1, keepdims=True)], axis=1)
    energy = np.concatenate([energy, energy.sum(axis=2, keepdims=True)], axis=2)
    mean, error = energy.mean(axis=0), energy.std(axis=0, ddof=1) / np.sqrt(32)
    expected = np.array(
        [column_energy_per_bin(edges, system(), 5e-3, column, backward, 30.0, field) for field in FIELDS]
    )
    expected = np.concatenate([expected, expected.sum(axis=1, keepdims=True)], axis=1)
    z = (mean - expected) / error
    assert np.all(error < 0.02 * mean)
    assert np.all(error[-1] < 0.01 * mean[-1])
    assert np.all(error[:, -1] < 0.01 * mean[:, -1])
    # The grid of the closed form adds 5e-4.
    assert np.all(np.abs(mean / expected - 1) < largest_z(32, z.size) * error / mean + 5e-4), z


@pytest.mark.slow
def test_bottom_in_bins(lidar_scene, passes):
    """The echo's shape across the beam: earlier in the near pixels, later in the far ones."""
    edges = 1484.0 + 2.0 * np.arange(10)
    scene = lidar_scene(
        integrator={"max_scatterings": 0, "paths_per_pass": 2**17},
        film={"time_start_ns": edges[0], "bin_width_ns": 2.0, "bin_count": 9},
        sea={"slope_variance": "2e-5"},
        water={"attenuation": 0.1, "scattering": 0.0, "backscattering": 0.0},
    )
    energy = passes(scene, 24)
    mean, error = energy.mean(axis=0), energy.std(axis=0, ddof=1) / np.sqrt(24)
    column = WaterColumn.from_text(0, 0.1, 0, 0)
    expected = np.array([bottom_energy_per_bin(edges, system(), 5e-3, column, 8.0, 0.1, f) for f in FIELDS[:4]])
    strong = expected > 0.02 * expected.max()
    # Ripples of variance 2e-5 move light by thousandths of a bin: 0.2 % of the steepest flank.
    assert np.all(np.abs(mean - expected)[strong] < (4.4 * error + 0.002 * expected.max())[strong])
    assert np.all(error[strong] < 0.05 * mean[strong])
