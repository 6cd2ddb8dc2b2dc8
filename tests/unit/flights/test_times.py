"""Systems of the times of trajectories."""

import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.flights.poses.platforms import platform_of

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
