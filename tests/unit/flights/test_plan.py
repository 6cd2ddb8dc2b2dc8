"""Plans of flights: poses, groups, paths and systems of times."""

import json

import numpy as np
import pytest
from rows import each_row, refuses

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.plan import FlightPlan, flights
from mitransient_lidar.flights.poses.platforms import platform_of
from mitransient_lidar.flights.preparation import input_columns
from mitransient_lidar.flights.renderer import FlightRenderer

LINE = {"kind": "lines", "start": [-20.0, 0.0], "heading_deg": 90.0, "speed": 20.0, "height": 200.0, "duration_s": 2.0}
PALMER = {"kind": "palmer", "nadir_angle_deg": 20.0, "rate_hz": 10.0}
FLIGHT = {"scene": "flight", "platform": LINE, "scanner": PALMER, "pulses": {"rate_hz": 100}}


@pytest.mark.parametrize("name", flights())
def test_shipped_flights_have_poses(name):
    plan = FlightPlan.read(name)
    poses = plan.poses()
    assert 100 <= len(poses.time_s) <= 20_000
    assert np.all(poses.axis[:, 2] < 0)
    assert FlightPlan.from_json(plan.text).text == plan.text


@refuses(
    ({"sence": "flight"}, "'sence' is no key of a flight"),
    ({"receiver": {"gain": "best"}}, "receiver.gain = 'best' must be a number or auto"),
    ({"receiver": {"gain": "auto", "optical_density": "auto"}}, "are alternatives: give one of them"),
    ({"estimator": "best"}, "estimator = 'best' must be one of"),
    ({"parameters": {"altitude": 200}}, "'altitude' follows from the poses"),
)
def test_bad_flights_are_one_sentence(change):
    FlightPlan.of_file({**FLIGHT, **change})


def test_pulses_of_one_group_have_similar_poses():
    scanner = {"kind": "oscillating", "half_angle_deg": 15.0, "rate_hz": 5.3}
    plan = FlightPlan.of_file({**FLIGHT, "scanner": scanner})
    columns = input_columns(plan.poses())
    angle = np.degrees(np.arccos(-columns["axis_z"]))
    assert np.all(np.abs(angle - columns["group_angle_deg"]) <= 1.0)
    assert np.array_equal(np.sort(columns["pulse"]), np.arange(len(angle)))
    assert np.all(np.diff(columns["group"]) >= 0)
    assert 8 <= len(np.unique(columns["group"])) <= 9
    for group in np.unique(columns["group"]):
        assert np.all(np.diff(columns["pulse"][columns["group"] == group]) > 0)


def test_batches_are_of_one_group():
    plan = FlightPlan.of_file({**FLIGHT, "pulses": {**FLIGHT["pulses"], "rate_hz": 10 * FLIGHT["pulses"]["rate_hz"]}})
    columns = input_columns(plan.poses())
    batches = list(FlightRenderer(plan, None, None).batches(columns))
    assert [row for batch in batches for row in batch] == list(range(len(columns["pulse"])))
    for batch in batches:
        assert len(np.unique(columns["group"][batch])) == 1
    assert max(len(batch) for batch in batches) == 256
    ends = columns["group"][[batch[-1] for batch in batches]]
    assert all(len(batch) == 256 for batch, own, other in zip(batches, ends, ends[1:], strict=False) if own == other)


def test_paths_are_those_of_the_folder(tmp_path):
    given = {**FLIGHT, "receiver": {"chain": "own.toml"}, "corrections": "table.nc"}
    plan = FlightPlan.of_file(given, tmp_path)
    assert plan.receiver.chain == str(tmp_path / "own.toml")
    assert plan.corrections == str(tmp_path / "table.nc")
    # Workers read the stored text elsewhere.
    assert json.loads(plan.text)["receiver"]["chain"] == str(tmp_path / "own.toml")


CSV, SBET = {"kind": "csv", "file": "line.txt"}, {"kind": "sbet", "file": "line.txt", "epsg": 32633}
LINES = {"kind": "lines", "start": [0, 0], "speed": 50, "height": 200, "length": 500}


@each_row(
    (LINES, 20.0, "flight"),
    (CSV, 302_410.0, "flight"),
    (SBET, 302_410.0, "gps_week"),
    (SBET, 604_810.0, "gps_week"),
    (CSV, 389_012_346.0, "adjusted_gps"),
    (SBET, 1_389_012_346.0, "gps"),
    ({**CSV, "time": "gps_week"}, 302_410.0, "gps_week"),
    ({**CSV, "time": "gps"}, 1.7e9, "gps"),
)
def test_systems_of_times(platform, last, system):
    assert platform_of(platform).time_system(np.array([last - 10, last])) == system


def test_times_that_are_not_known():
    message = r"the times of line\.txt, up to 1764000000 s, may be Unix times, which are 315964782 s more"
    with pytest.raises(UserError, match=message):
        platform_of(CSV).time_system(np.array([1.764e9 - 10, 1.764e9]))
