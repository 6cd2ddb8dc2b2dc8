"""Points of flights: corrections of depths and the angles of their table."""

import logging

import numpy as np
import xarray as xr

from mitransient_lidar.flights.products import warn_of_angles, with_channels


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
