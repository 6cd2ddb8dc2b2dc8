"""Properties that the estimator must have whatever the scene: sums, reciprocity, strategies that agree, energy."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from rows import each_case
from significance import assert_same, largest_error, largest_z

#: Cells and shortest wave are the same for every beam and view.
WAVY = {"spectrum": "elfouhaily", "slope_variance": "cox_munk", "cell_size": 0.1, "shortest_wave": 1.0}
ROUGH = {"slope_variance": "0.01836"}


def echoes(energy):
    """Sum all pixels in five gates of 20 ns from surface to bottom: shape (passes, gates)."""
    return energy.sum(axis=1)[:, 20:120].reshape(len(energy), 5, 20).sum(axis=-1)


def compare(first, second, largest):
    """Assert that two sets of passes have one mean in every column; the true relative error is at most `largest`."""
    mean = np.array([first.mean(axis=0), second.mean(axis=0)])
    error = np.array([a.std(axis=0, ddof=1) / np.sqrt(len(a)) for a in (first, second)])
    limit = largest_error(min(len(first), len(second)), largest)
    assert np.all(np.hypot(*error) < limit * mean.max(axis=0)), np.hypot(*error) / mean.max(axis=0)
    z = (mean[0] - mean[1]) / np.hypot(*error)
    assert np.all(np.abs(z) < largest_z(min(len(first), len(second)), z.size)), z


def with_total(energy):
    return np.concatenate([energy, energy.sum(axis=1, keepdims=True)], axis=1)


def sampled(scene, emitter):
    """Return a scene whose integrator samples directions towards the emitter, or leaves all to the path's own."""
    integrator = scene.integrator()
    integrator.options = replace(integrator.options, samples_emitter=emitter)
    return scene


@pytest.mark.slow
def test_connections_of_a_bottom_have_one_mean(lidar_scene, passes):
    """Through absorbing water and a rough sea, where both connections find the bottom about as often.

    Weights that do not sum to one change it by a tenth: the walk, by far the noisier, has three times the passes.
    """
    sea, water = {"slope_variance": "0.1"}, {"attenuation": 0.4, "scattering": 0.0, "backscattering": 0.0}
    combined, walk = (
        passes(
            sampled(
                lidar_scene(
                    integrator={"paths_per_pass": 2**15},
                    # Without the surface echo.
                    **{"sea": sea, "water": water, "bottom": 4.0, "film": {"time_start_ns": 1440.0}},
                    rx={"layout": "1x1"},
                ),
                emitter,
            ),
            count,
            first_seed=100 * number,
        ).sum(axis=(1, 2))
        for number, (emitter, count) in enumerate(((True, 16), (False, 64)))
    )
    assert_same(combined, walk, error=0.02)


@each_case(pytest.param(ROUGH, marks=pytest.mark.slow), pytest.param(WAVY, marks=pytest.mark.long))
def test_reciprocity_of_beam_and_field_of_view(sea, lidar_scene, passes):
    """A uniform beam seen by a uniform field of view, and the two exchanged, per solid angle of the field of view.

    A factor that is not symmetric - the n^2 of one crossing only, a one-sided cosine - would show in every bin.
    """
    signals = []
    for beam, view in ((16.0, 8.0), (8.0, 16.0)):
        scene = lidar_scene(
            tx={"beam_profile": "top_hat", "divergence_mrad": beam},
            rx={"field_of_view_mrad": view, "layout": "1x1"},
            sea=sea,
            film={"time_start_ns": 1410.0, "bin_width_ns": 20.0, "bin_count": 5},
            integrator={"paths_per_pass": 2**14},
        )
        signals.append(with_total(passes(scene, 16)[:, 0] / view**2))
    compare(*signals, 0.035)


@pytest.mark.slow
def test_roulette_changes_no_mean(lidar_scene, passes):
    """Without it, and with much of it: survivors that did not carry the share of the dead would lose most light."""
    few = {"paths_per_pass": 2**13}
    reference = echoes(passes(lidar_scene(sea=ROUGH, integrator=few), 16))
    # The more light survivors carry, the noisier it is.
    for threshold, count, error in ((0.0, 16, 0.03), (0.05, 32, 0.1)):
        scene = lidar_scene(sea=ROUGH, integrator={**few, "roulette_threshold": threshold})
        compare(reference, echoes(passes(scene, count, 500)), error)


@pytest.mark.slow
def test_symbolic_and_evaluated_loops_agree(lidar_scene, passes):
    energies = []
    for symbolic in (True, False):
        dr.set_flag(dr.JitFlag.SymbolicLoops, symbolic)
        energies.append(passes(lidar_scene(sea=WAVY, integrator={"paths_per_pass": 2**14}), 1))
    # Fused and separate kernels round differently, which now and then moves a path to the next bin.
    assert energies[0].sum() == pytest.approx(energies[1].sum(), rel=1e-3)
    assert np.mean(np.isclose(*energies, rtol=1e-3, atol=1e-24)) > 0.95


@pytest.mark.slow
def test_nothing_returns_more_than_was_sent(lidar_scene, passes):
    """White bottom, no absorption, and a receiver that would see it all: still less than what a white plate returns."""
    scene = lidar_scene(
        water={"attenuation": 0.5, "scattering": 0.5, "backscattering": 0.02},
        rx={"field_of_view_mrad": 200.0, "layout": "1x1"},
        film={"time_start_ns": 1300.0, "bin_width_ns": 10.0, "bin_count": 300},
        integrator={"paths_per_pass": 2**14},
        rho=1.0,
    )
    # Most of the passes: a rare one holds a path that is brighter than all others.
    energy = np.median(passes(scene, 8).sum(axis=(1, 2)))
    plate = 5e-3 * 0.81 * 0.9 * 0.025 * np.cos(np.radians(20)) / np.pi / (200 / np.cos(np.radians(20))) ** 2
    assert 0.3 * plate < energy < plate


@pytest.mark.slow
def test_pixels_sum_to_the_single_pixel_path_by_path(lidar_scene, passes):
    """Same seed: the same paths, given to other pixels. A pixel counted twice or left out at an edge would show."""
    energies = []
    for name, seed in (("1x1", 0), ("2x2", 0), ("1x4", 0), ("1x1", 1)):
        scene = lidar_scene(rx={"layout": name, "imager": False}, sea=WAVY, integrator={"paths_per_pass": 2**12})
        energies.append(passes(scene, 1, seed).sum(axis=1))
    for parts in energies[1:3]:
        np.testing.assert_allclose(parts, energies[0], rtol=1e-10)
    assert np.mean(energies[0] == energies[3]) < 0.6


@pytest.mark.slow
def test_absorption_multiplies_every_bin_by_its_path_in_the_water(lidar_scene, passes):
    """Absorption alone, without scattering, leaves the surface echo and dims the bottom by exp(-2 da L)."""
    bottoms = []
    for attenuation in (0.1, 0.2):
        water = {"attenuation": attenuation, "scattering": 0.0, "backscattering": 0.0}
        # The record ends before light comes that the bottom has reflected twice.
        film = {"time_start_ns": 1450.0, "bin_count": 60}
        scene = lidar_scene(water=water, film=film, integrator={"paths_per_pass": 2**13})
        bottoms.append(passes(scene, 32).sum(axis=(1, 2)))
    path = 8 / np.cos(np.arcsin(np.sin(np.radians(20)) / 1.34))
    mean = [b.mean() for b in bottoms]
    relative = np.hypot(*(b.std(ddof=1) / np.sqrt(32) / b.mean() for b in bottoms))
    assert relative < 1e-2
    # Rays of the beam within 5 mrad cross 0.1 % more or less water.
    assert abs(mean[1] / mean[0] / np.exp(-0.2 * path) - 1) < largest_z(32) * relative + 1e-3
