"""Received light by order of scattering and by turns: sums, closed form, and both integrators."""

import numpy as np
import pytest

import mitransient_lidar
from mitransient_lidar.studies.scattering_orders import scattering_orders

PARAMS = {"bin_width_ns": 2, "bin_count": 75, "surface_size": 200}
FEW = {"type": "lidar_merging", "paths_per_pass": 2**13, "photons_per_pass": 2**13}


@pytest.fixture(scope="module")
def parts():
    return scattering_orders("fig09_2x2", PARAMS, orders=3, passes=2, seed=4, integrator=FEW)


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
