"""Figures of campaigns: samples of few runs, of shots, and of none."""

import numpy as np
import pytest
from figure_inputs import campaign

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.campaigns import plot_campaign


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
    with pytest.raises(UserError, match="no run that is done"):
        plot_campaign(made.assign(status=0 * made["status"]))
    with pytest.raises(UserError, match="must end in"):
        plot_campaign(made, tmp_path / "campaign.txt")
