"""Plans of flights: poses, groups, paths and systems of times; numbers of their points."""

import json
import logging

import numpy as np
import pytest
import xarray as xr
from rows import each_row, must_refuse, refuses

from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.flights.plan import FlightPlan, flights
from mitransient_lidar.flights.poses.platforms import platform_of
from mitransient_lidar.flights.preparation import input_columns, warn_of_angles
from mitransient_lidar.flights.products import Quality, _quality, with_channels
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
    must_refuse(message, lambda: platform_of(CSV).time_system(np.array([1.764e9 - 10, 1.764e9])))


def test_pulses_beyond_the_angles_of_corrections_are_counted(caplog):
    """Half a group beside the table is within: its pulses differ from it by less than a degree."""
    table = xr.Dataset(coords={"off_nadir_deg": [14.0, 19.0]})
    with caplog.at_level(logging.WARNING):
        warn_of_angles(np.array([13.5, 16.0, 19.9]), table)
        assert not caplog.records
        warn_of_angles(np.array([1.5, 12.9, 14.0, 20.5]), table)
    assert [record.getMessage().split(" pulses")[0] for record in caplog.records] == ["3 of 4"]
    assert "14 to 19 degrees from nadir" in caplog.text


def test_pixels_become_scanner_channels():
    """Two pulses of eight pixels: two neighbours share a channel, whose four returns count from the highest on."""
    pixels = 8
    shot, pixel, echo = (values.ravel() for values in np.indices((2, pixels, 2)))
    z = np.where(echo == 0, 0.01 * pixel, -5.0 - 0.1 * pixel)
    values = {"shot": shot, "pixel": pixel, "z": z, "return_number": echo + 1, "number_of_returns": np.full(z.size, 2)}
    points = xr.Dataset({name: ("point", value) for name, value in values.items()})
    found = with_channels(points, pixels)
    np.testing.assert_array_equal(found["channel"], pixel // 2)
    np.testing.assert_array_equal(found["number_of_returns"], 4)
    first = found.isel(point=(shot == 1) & (pixel < 2))
    assert first["return_number"].values.tolist() == [2, 3, 1, 4]
    keys = np.stack([shot, found["channel"], found["return_number"]], axis=1)
    assert len(np.unique(keys, axis=0)) == z.size
    # Up to four are told apart as they are; of very many, the last number is of several.
    few = with_channels(points.isel(point=pixel < 4), 4)
    np.testing.assert_array_equal(few["channel"], few["pixel"])
    assert few["return_number"].identical(points.isel(point=pixel < 4)["return_number"])
    many = xr.concat([points.assign(pixel=points["pixel"] + 8 * number) for number in range(8)], "point")
    assert with_channels(many, 64)["return_number"].values.max() == 15


def test_quality_of_points():
    """A surface and a bottom of three pulses: the first surface is saturated, the second bottom and fit are poor."""
    echo, shots = ["surface", "column", "target", "bottom"], 3
    flags = np.zeros((shots, 1, 4), dtype=int)
    flags[0, 0, 0], flags[1, 0, 3], flags[2, 0, 3] = EchoFlag.SATURATED, EchoFlag.POOR_FIT, EchoFlag.SATURATED
    correction, beyond = np.full((shots, 1, 4), np.nan), np.zeros((shots, 1, 4), dtype=bool)
    correction[:, 0, 3], beyond[1, 0] = 0.02, True
    dims = ("shot", "pixel", "echo")
    arrays = {"flags": flags, "depth_correction_m": correction, "beyond_table": beyond}
    echoes = xr.Dataset({name: (dims, values) for name, values in arrays.items()}, {"echo": echo})
    shot, kind = np.repeat(np.arange(shots), 2), np.tile([41, 40], shots)
    values = {"shot": shot, "pixel": np.zeros(6, dtype=int), "kind": kind, "flags": flags[shot, 0, np.tile([0, 3], 3)]}
    values["echo"] = np.tile([0, 2], shots)
    points = xr.Dataset({name: ("point", value) for name, value in values.items()})
    green = np.zeros(shots, dtype=bool)
    found = points.assign(_quality(points, echoes, green))
    saturated, poor, corrected, beyond, *_ = Quality
    assert found["quality"].values.tolist() == [
        *(saturated, saturated | corrected),
        *(0, poor | corrected | beyond),
        *(0, saturated | corrected),
    ]
    assert found["withheld"].values.tolist() == [True, False, False, True, False, True]
    beside = _quality(points, echoes, np.array([False, True, False]))["quality"][1]
    assert (beside - found["quality"].values).tolist() == [0, 0, Quality.INFRARED, Quality.INFRARED, 0, 0]
    without = points.assign(_quality(points, echoes[["flags"]], green))
    assert without["quality"].values.tolist() == [saturated, saturated, 0, poor, 0, saturated]
