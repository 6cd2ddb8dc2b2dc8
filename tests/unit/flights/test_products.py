"""Points of flights: corrections of depths and the angles of their table."""

import logging

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.waveforms.echo_detection import EchoFlag
from mitransient_lidar.flights.preparation import warn_of_angles
from mitransient_lidar.flights.products import Quality, _quality, with_channels


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
