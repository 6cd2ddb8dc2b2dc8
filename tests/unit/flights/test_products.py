"""Points of flights: corrections of depths and the angles of their table."""

import logging

import numpy as np
import xarray as xr

from mitransient_lidar.flights.products import warn_of_angles


def test_pulses_beyond_the_angles_of_corrections_are_counted(caplog):
    """Half a group beside the table is within: its pulses differ from it by less than a degree."""
    table = xr.Dataset(coords={"off_nadir_deg": [14.0, 19.0]})
    with caplog.at_level(logging.WARNING):
        warn_of_angles(np.array([13.5, 16.0, 19.9]), table)
        assert not caplog.records
        warn_of_angles(np.array([1.5, 12.9, 14.0, 20.5]), table)
    assert [record.getMessage().split(" pulses")[0] for record in caplog.records] == ["3 of 4"]
    assert "14 to 19 degrees from nadir" in caplog.text
