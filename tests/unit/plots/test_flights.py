"""Drawing of axes and angles: where arrows point, by the stated signs."""

import numpy as np
import pytest

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.flights import plot_axes_and_angles


def _heads(ax):
    """Heads of the named arrows of a panel."""
    return {text.get_text(): np.array(text.xy) for text in ax.texts if hasattr(text, "xy") and text.get_text()}


@pytest.mark.slow
def test_arrows_point_where_the_signs_say(tmp_path):
    above, behind, side, scanner = plot_axes_and_angles(tmp_path / "axes.png").axes
    assert (tmp_path / "axes.png").stat().st_size > 10_000
    # Yaw to the east of north, right side down, nose up.
    assert (_heads(above)["forward, y"] > 0).all()
    assert _heads(above)["right, x"][1] < 0 < _heads(above)["right, x"][0]
    assert _heads(behind)["right, x"][1] < 0 < _heads(behind)["right, x"][0]
    assert (_heads(side)["forward, y"] > 0).all()
    # The pulses, the only arrows without a name that go down.
    for panel, sign in ((behind, -1), (side, 1)):
        beam = min((np.array(text.xy) for text in panel.texts if hasattr(text, "xy")), key=lambda head: head[1])
        assert beam[0] * sign > 0
    # Seen along the pulse, that is from above, far goes outward and left is to the left of it.
    far, left = _heads(scanner)["far"], _heads(scanner)["left"]
    assert far[0] > left[0]


def test_format_of_the_drawing(tmp_path):
    with pytest.raises(UserError, match="the file name must end in"):
        plot_axes_and_angles(tmp_path / "axes.bmp")
