"""Figures of waters: without scattering, and their files."""

import numpy as np
import pytest

from mitransient_lidar.physics.water.profiles import Profile
from mitransient_lidar.plots.water import plot_profile

DEPTH = np.array([1.0, 4.0, 6.0, 10.0])
A = np.array([0.1, 0.3, 0.05, 0.05])


@pytest.mark.slow
@pytest.mark.parametrize("b", [[0, 0, 0, 0], [0.1, 0, 0, 0.2]])
def test_water_without_scattering_is_drawn(tmp_path, b):
    profile = Profile(DEPTH, A, b, [0.02 * value for value in b])
    left, right = plot_profile(profile, profile.layers(0.05), "clear", tmp_path / "a.png").axes
    assert 1e-7 < left.get_xlim()[0] < 0.06
    assert len(right.lines) == (1 if any(b) else 0)
    assert [text.get_text() for text in right.texts] == ([] if any(b) else ["no backscattering"])
