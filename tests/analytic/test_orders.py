"""Received light by order of scattering and by turns: sums, closed form, and both integrators."""

import numpy as np
import pytest

import mitransient_lidar
from mitransient_lidar.studies.light_classes import scattering
from mitransient_lidar.transport.paths.passes import PathClasses

PARAMS = {"bin_width_ns": 2, "bin_count": 75, "surface_size": 200}
FEW = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}


@pytest.fixture(scope="module")
def parts():
    return scattering("fig09_2x2", PARAMS, orders=3, passes=2, seed=4, integrator=FEW)


@pytest.mark.long
def test_parts_sum_to_the_whole(parts):
    """The classes split the same paths: same seed, same energy in every bin but for rounding of the sums."""
    whole = mitransient_lidar.render("fig09_2x2", params=PARAMS, passes=2, seed=4, integrator=FEW)
    total = parts["impulse_response"].sum(("reversals", "order")).values
    np.testing.assert_allclose(total, whole["impulse_response"].values, rtol=1e-6, atol=1e-6 * total.max())


@pytest.mark.slow
def test_unscattered_light_is_reversed_once(parts):
    direct = parts["impulse_response"].sel(order=0).sum(("pixel", "time"))
    assert direct.sel(reversals="several") < 1e-3 * direct.sel(reversals="one")


VOLPATH = {"type": "lidar_volpath", "paths_per_pass": 2**13}


@pytest.mark.slow
def test_single_scattering_is_that_of_paths_with_one_event(lidar_scene, passes):
    """`lidar_volpath` with max_scatterings stops the paths instead of sorting them."""
    one = {"layout": "1x1"}
    scene = lidar_scene(integrator=VOLPATH, rx=one)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0], classes=PathClasses(3))
    sorted_energy = np.array([renderer.render_pass(seed).histogram.energy() for seed in range(2)]).reshape(2, 2, 4, -1)
    for most in (0, 1, 2):
        limited = passes(lidar_scene(integrator={**VOLPATH, "max_scatterings": most}, rx=one), 2)[:, 0]
        kept = sorted_energy[:, :, : most + 1].sum(axis=(1, 2))
        np.testing.assert_allclose(kept.sum(axis=1), limited.sum(axis=1), rtol=1e-6)
