"""Every figure draws what it drew when its reference was looked at: data, signs, units, colours and labels."""

import json

import numpy as np
import pytest
import references
from drawn_figures import described, differences
from figure_inputs import FIGURES, campaign, shot_statistics
from rows import must_refuse

from mitransient_lidar.physics.water.profiles import Profile
from mitransient_lidar.plots.campaigns import plot_campaign
from mitransient_lidar.plots.water import plot_profile
from mitransient_lidar.studies.shots import slope_correlations

EXPECTED = references.read(references.FIGURES)


@pytest.mark.parametrize("name", FIGURES)
def test_figure_is_that_of_the_reference(name):
    assert differences(json.loads(json.dumps(described(FIGURES[name]()))), EXPECTED[name]) == []


def test_every_reference_has_a_figure():
    assert EXPECTED.keys() == FIGURES.keys()


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


def test_codes_near_nothing_are_not_drawn():
    """The code next to 0 of a converter, before the first light and at the end, would look like a signal."""
    made = campaign()
    made["waveform"][..., :5] = made["waveform"][..., 45:] = 1e-4
    made["waveform"][..., 20:45] += 0.1
    ax = plot_campaign(made).axes[0]
    for line in ax.lines:
        drawn = np.isfinite(line.get_ydata())
        assert not drawn[[0, 4, *range(10, 20), 45, 49]].any()
        assert drawn[20:45].all()


def test_nothing_to_draw(tmp_path):
    made = campaign()
    must_refuse("no run that is done", plot_campaign, made.assign(status=0 * made["status"]))
    must_refuse("must end in", plot_campaign, made, tmp_path / "campaign.txt")


def test_correlations_are_those_of_the_panels():
    found = slope_correlations(shot_statistics())
    assert list(found) == ["strength", "separation", "sideways", "depth"]
    np.testing.assert_allclose(list(found.values()), [1, -1, 1, 1])
