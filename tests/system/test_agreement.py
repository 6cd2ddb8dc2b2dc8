"""The fast integrator against the unbiased one, in the shipped scenes."""

import pytest
from significance import FALSE_ALARM, largest_error, largest_z

import mitransient_lidar
from mitransient_lidar.analysis import comparison
from mitransient_lidar.loading import catalogue

pytestmark = pytest.mark.slow

#: Parameters that say what is recorded, not what is there.
RECORD = {"time_start_ns", "bin_width_ns", "bin_count"}

#: So fine that each pixel has 200 bins between surface echo and end of bottom echo; shorter where the bottom is at 5 m.
BINS = {"bin_width_ns": 0.4}
SHORT_BINS = {"bin_width_ns": 0.25}

#: Figure 10 zooms into the record of figure 11.
ZOOMS = {f"fig10_shot{number}": f"fig11_shot{number}" for number in (1, 2, 3)}


#: Layers of turbid water, through which the reference needs more paths.
TURBID = {"fig15_1x1", "fig15_2x2", "thin_layer", "nepheloid_layer", "fresh_water_lens"}


#: Images, compared as four pixels.
IMAGES = {"gated_mine", "gated_waves"}

#: Rendered by an integrator of its own.
PASSIVE = {"passive_sea"}

#: As another scene, but for the layout of the pixels or the place of the shot.
ALIKE = {"fig09_1x1", "fig09_2x2", "fig11_shot2", "fig11_shot3", "fig13_2x2", "fig15_1x1"}

#: Relative standard error of the energy where it is above 0.3 %. At grazing incidence the connection of the reference
#: takes the sea as level, and in thin layers few paths carry much.
ENERGY_ERROR = {
    **{"fig04_mast": 0.02, "thin_layer": 0.0104, "nepheloid_layer": 0.0074, "gated_mine": 0.0067, "ship_wake": 0.0051},
    **{"fresh_water_lens": 0.0046},
}


@pytest.mark.parametrize("name", [name for name in catalogue.scene_names() if name not in {*ZOOMS, *PASSIVE, *ALIKE}])
def test_integrators_agree_in_shipped_scenes(name):
    bins = dict(SHORT_BINS if name in ZOOMS.values() else BINS)
    if name in IMAGES:
        bins["layout"] = "2x2"
    merged = mitransient_lidar.render(name, params=bins, integrator="lidar_merging", passes=12, seed=1)
    count = 16 if name in TURBID else 8
    reference = mitransient_lidar.render(name, params=bins, integrator="lidar_volpath", passes=count, seed=2)
    outcome = comparison.compare(reference, merged)
    # At grazing incidence the reference knows few bins to 30 %: its connection takes the sea as level.
    grazing = name == "fig04_mast"
    assert outcome.bin_count >= (100 if grazing or name in IMAGES else 200) * merged.sizes["pixel"]
    assert outcome.largest < comparison.sidak_limit(outcome.bin_count, FALSE_ALARM), (outcome.largest, outcome.limit)
    assert 0.7 < outcome.rms < 1.1
    # Cells blur the first metre of water by 0.5 %, a fifth of which is in the whole.
    assert abs(outcome.energy_ratio - 1) < 0.002 + largest_z(64) * outcome.energy_ratio_stderr
    assert outcome.energy_ratio_stderr < largest_error(count, ENERGY_ERROR.get(name, 0.003))


@pytest.mark.parametrize(("zoom", "whole"), ZOOMS.items())
def test_zooms_show_the_same_scene(zoom, whole):
    first, second = (catalogue.scene_parameters(catalogue.scene_path(name)) for name in (zoom, whole))
    assert {name for name in first if first[name] != second[name]} <= RECORD
    assert first.keys() == second.keys()
