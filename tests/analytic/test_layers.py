"""Water in layers of one kind: the same light as without them."""

import numpy as np
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [pytest.param("lidar_merging", marks=pytest.mark.long), "lidar_volpath"])
def test_layers_of_one_water_are_that_water(lidar_scene, passes, integrator):
    """Same seeds, same light: to the bit where layers are equal, as they are joined.

    Where they differ by 1e-7 flights through the edges are rounded, which moves one contribution in 1e5. A path that
    ends elsewhere may shift the random numbers of all that follow, as in one of 50 passes of 2^14 paths, and of 200 of
    2^12: most of five are compared.
    """

    # Paths, not waves, are compared: a coarse mesh is made in no time.
    sea = {"spectrum": "elfouhaily", "size": 60.0, "cell_size": 0.5}

    def record(layer_tops, attenuation="0.9", scattering=0.7):
        water = {
            "layer_tops": layer_tops,
            "attenuation": attenuation,
            "scattering": scattering,
            "backscattering": 0.014,
        }
        engine = {"type": integrator, "paths_per_pass": 2**12}
        if integrator == "lidar_merging":
            engine["photons_per_pass"] = 2**12
        return passes(lidar_scene(integrator=engine, water=water, sea=sea), 5)

    whole = record("0")
    lit = np.sum(whole > 0, axis=(1, 2))

    def share_of_equal_bins(other):
        equal = np.isclose(whole, other, rtol=1e-5, atol=0) & (whole > 0)
        return np.median(equal.sum(axis=(1, 2)) / lit)

    np.testing.assert_array_equal(record("0, 1.1, 2.3, 5.7"), whole)
    divided = record("0, 1.1, 2.3, 5.7", "0.9, 0.9000001, 0.9, 0.9000001")
    assert share_of_equal_bins(divided) > 0.9
    np.testing.assert_allclose(np.median(divided.sum(axis=2) / whole.sum(axis=2), axis=0), 1, atol=1e-4)
    # Of other water the surface echo alone is the same, in a twentieth of the bins.
    assert share_of_equal_bins(record("0", scattering=0.701)) < 0.1
