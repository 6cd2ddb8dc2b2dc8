import itertools

import numpy as np
import pytest
from rows import refuses

from mitransient_lidar.campaigns.design import Campaign
from mitransient_lidar.campaigns.runs import RunRenderer, source_of
from mitransient_lidar.physics.lidar.time_axis import TimeAxis

FLAT = {"spectrum": "flat", "surface_size": 60, "layout": "1x1"}


def planned(parameters, fixed=FLAT, **design):
    """Return a campaign of a grid, or of a design, and its columns."""
    given = {"scene": "table1", "fixed": fixed, "parameters": parameters, "design": design or {"kind": "grid"}}
    campaign = Campaign.of_file(given)
    return campaign, campaign.table()


def renderer(parameters, fixed=FLAT, **design):
    campaign, columns = planned(parameters, fixed, **design)
    return RunRenderer.of(campaign, columns)


@pytest.mark.slow
def test_record_holds_the_light_of_all_runs():
    runs = renderer({"altitude": [150, 200, 300], "bottom_depth": [15, 3], "attenuation": [0.2, 1.0]})
    # Corners of the ranges, of which none was tried in this combination but one.
    for altitude, depth, attenuation in itertools.product([150, 300], [3, 15], [0.2, 1.0]):
        own = runs.own_axis({"altitude": altitude, "bottom_depth": depth, "attenuation": attenuation})
        assert runs.axis.start_ns <= own.start_ns
        assert runs.axis.end_ns >= own.end_ns
    longest = runs.own_axis({"altitude": 300, "bottom_depth": 15, "attenuation": 0.2})
    assert runs.axis.end_ns < longest.end_ns + 0.1 * (longest.end_ns - runs.axis.start_ns)


def test_fixed_parameters_replace_defaults_before_anything_is_loaded(tmp_path):
    """The file of the default is nowhere; the one of the campaign, and its SHA-256, are in the record."""
    (tmp_path / "own.xml").write_text(
        '<scene version="3.0.0"><default name="map_file" value="nowhere.npy"/>'
        '<shape type="seabed"><string name="filename" value="$map_file"/></shape></scene>'
    )
    np.save(tmp_path / "map.npy", np.full((3, 3), -5.0))
    fixed = {"map_file": str(tmp_path / "map.npy")}
    record = source_of(Campaign.of_file({"scene": "own.xml", "fixed": fixed, "design": {"kind": "grid"}}, tmp_path))
    assert record.parameters == {"map_file": "nowhere.npy"}
    assert [path for path, _ in record.files.values()] == [str(tmp_path / "map.npy")]


@pytest.mark.slow
def test_random_seas_are_of_the_run():
    runs = renderer({"bottom_depth": [3.0, 4.0]})
    seas = [runs.inputs(number, {"bottom_depth": 3.0})["surface_seed"] for number in range(100)]
    assert len(set(seas)) == 100
    assert runs.inputs(7, {"bottom_depth": 5.0}) == {"bottom_depth": 5.0, "surface_seed": seas[7]}
    given = renderer({"surface_seed": [3, 4]})
    assert given.inputs(0, {"surface_seed": 3}) == {"surface_seed": 3}


@pytest.fixture
def asked(monkeypatch):
    """Replace `render_shots`; return the parameters and options of its calls."""
    calls = []
    monkeypatch.setattr(
        "mitransient_lidar.campaigns.runs.render_shots",
        lambda scene, params, **options: calls.append((scene, params, options)),
    )
    return calls


def test_what_is_asked_of_a_run(asked):
    design = {"kind": "random", "count": 5, "shots": 40, "seed": 2}
    given = {"scene": "table1", "light": "maps", "fixed": FLAT, "parameters": {"bottom_depth": [3.0, 4.0]}}
    campaign = Campaign.of_file({**given, "design": design})
    runs = RunRenderer(campaign, source_of(campaign), TimeAxis(1300, 1, 300))
    for number in (3, 4, 3):
        runs.series(number, {"bottom_depth": 4.0})
    (_, params, first), (_, _, other), (_, again, same) = asked
    assert params == {**FLAT, "bottom_depth": 4.0, "surface_seed": params["surface_seed"]}
    assert again == params
    np.testing.assert_array_equal(first["positions"], same["positions"])
    assert first["first_seed"] == same["first_seed"] != other["first_seed"]
    assert not np.array_equal(first["positions"], other["positions"])
    assert first["positions"].shape == (40, 2)
    assert 100 < np.abs(first["positions"]).max() <= 256
    assert (first["target_error"], first["components"], first["move_target"]) == (0.05, False, False)
    assert first["axis"] == TimeAxis(1300, 1, 300)
    assert (first["max_time"], first["light"], first["merge_unsuited"]) == (None, "maps", True)


@pytest.mark.slow
@refuses(
    ({"bottom_dept": [1, 2]}, FLAT, "parameter 'bottom_dept' is not one of scene table1: did you mean bottom_depth"),
    ({"altitude": [1, 2]}, {"windspeed": 3}, "parameter 'windspeed' is not one of scene table1: did you mean wind_"),
    ({"bin_count": [100, 200]}, FLAT, "parameter 'bin_count' must be the same in all runs"),
    ({"bottom_depth": [-3, -4]}, FLAT, "bottom_depth"),
)
def test_campaigns_that_the_scene_refuses(parameters, fixed):
    renderer(parameters, fixed)
