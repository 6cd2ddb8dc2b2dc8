"""Echoes against slopes: their correlations."""

import numpy as np
from figure_inputs import shot_statistics

from mitransient_lidar.studies.shots import slope_correlations


def test_correlations_are_those_of_the_panels():
    found = slope_correlations(shot_statistics())
    assert list(found) == ["strength", "separation", "sideways", "depth"]
    np.testing.assert_allclose(list(found.values()), [1, -1, 1, 1])
