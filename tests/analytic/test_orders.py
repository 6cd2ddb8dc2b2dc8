"""Received light by order of scattering and by turns: sums, closed form, and both integrators."""

import numpy as np
import pytest
from significance import largest_z

import mitransient_lidar
from mitransient_lidar.studies.scattering_orders import scattering_orders, shares
from mitransient_lidar.transport.path_classes import PathClasses

pytestmark = pytest.mark.slow

PARAMS = {"bin_width_ns": 2, "bin_count": 75, "surface_size": 200}


@pytest.mark.parametrize("integrator", ["lidar_merging", "lidar_volpath"])
def test_parts_sum_to_the_whole(integrator):
    """The classes split the same paths: same seed, same energy in every bin but for rounding of the sums."""
    parts = scattering_orders("fig09_2x2", PARAMS, orders=3, passes=2, seed=4, integrator=integrator)
    whole = mitransient_lidar.render("fig09_2x2", params=PARAMS, passes=2, seed=4, integrator=integrator)
    total = parts["impulse_response"].sum(("reversals", "order")).values
    np.testing.assert_allclose(total, whole["impulse_response"].values, rtol=1e-6, atol=1e-6 * total.max())


def test_integrators_agree_by_order_and_turns():
    """A scattering event or a turn counted at the wrong end of a path would move light between the classes."""
    results = [
        scattering_orders("fig09_2x2", PARAMS, orders=6, passes=16, seed=seed, integrator=integrator)
        for seed, integrator in enumerate(["lidar_merging", "lidar_volpath"])
    ]
    energy, error = (np.array([result[name].values for result in results]) for name in ("energy", "energy_stderr"))
    # Orders that one of them has met in a few passes only have no normal errors.
    known = np.all(error < 0.2 * energy, axis=0)
    assert known.sum() >= 12
    z = (energy[0] - energy[1])[known] / np.hypot(*error)[known]
    assert np.all(np.abs(z) < largest_z(16, z.size)), z
    # Merging's cells blur the first metre of water, half a per cent of which is in the whole: far below these errors.
    assert np.all(error[:, 0, :5] < 0.03 * energy[:, 0, :5])
    several = shares(results[0])[-1][4]
    assert 0.001 < several < 0.004


def test_unscattered_light_is_reversed_once():
    parts = scattering_orders("fig09_2x2", PARAMS, orders=2, passes=2)
    direct = parts["impulse_response"].sel(order=0).sum(("pixel", "time"))
    assert direct.sel(reversals="several") < 1e-3 * direct.sel(reversals="one")


def test_single_scattering_is_that_of_paths_with_one_event(lidar_scene, passes):
    """`lidar_volpath` with max_scatterings stops the paths instead of sorting them."""
    one = {"layout": "1x1"}
    scene = lidar_scene(integrator={"type": "lidar_volpath"}, rx=one)
    renderer = scene.integrator().prepare(scene, scene.sensors()[0], classes=PathClasses(3))
    sorted_energy = np.array([renderer.render_pass(seed).histogram.energy() for seed in range(2)]).reshape(2, 2, 4, -1)
    for most in (0, 1, 2):
        limited = passes(lidar_scene(integrator={"type": "lidar_volpath", "max_scatterings": most}, rx=one), 2)[:, 0]
        kept = sorted_energy[:, :, : most + 1].sum(axis=(1, 2))
        np.testing.assert_allclose(kept.sum(axis=1), limited.sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize(("name", "value"), [("orders", 0), ("orders", 63), ("passes", 1)])
def test_options_out_of_range(name, value):
    with pytest.raises(ValueError, match=f"{name} = {value} must lie between"):
        scattering_orders("fig09_2x2", **{name: value})
