"""Echoes against slopes: their correlations."""

import numpy as np
import pytest
from figure_inputs import shot_statistics

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.studies.shots import plot_shot_statistics
from mitransient_lidar.studies.shot_statistics import slope_correlations


def test_correlations_are_those_of_the_panels():
    found = slope_correlations(shot_statistics())
    assert list(found) == ["strength", "separation", "sideways", "depth"]
    np.testing.assert_allclose(list(found.values()), [1, -1, 1, 1])


def test_other_pixels_are_rejected(tmp_path):
    with pytest.raises(UserError, match="must be the 2x2 of red, green, blue and black"):
        plot_shot_statistics(shot_statistics().assign_coords(pixel=["a", "b", "c", "d"]), tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
