"""The fast integrator against the unbiased one, in every scene that ships."""

import pytest

import mitransient_lidar
from mitransient_lidar import comparison, resources

#: So fine that each pixel has 200 bins between surface echo and end of bottom echo.
BINS = {"bin_width_ns": 0.4, "bin_count": 375}


@pytest.mark.parametrize("name", resources.scene_names())
def test_integrators_agree_in_every_shipped_scene(name):
    merged = mitransient_lidar.render(name, params=BINS, integrator="lidar_merging", passes=32, seed=1)
    reference = mitransient_lidar.render(name, params=BINS, integrator="lidar_volpath", passes=16, seed=2)
    outcome = comparison.compare(reference, merged)
    assert outcome.bin_count >= 200 * merged.sizes["pixel"]
    assert outcome.agrees, (outcome.largest, outcome.limit)
    assert 0.8 < outcome.rms < 1.1
    # Cells blur the first metre of water by 0.5 %, a fifth of which is in the whole.
    assert abs(outcome.energy_ratio - 1) < 0.002 + 4 * outcome.energy_ratio_stderr
    assert outcome.energy_ratio_stderr < 0.003
