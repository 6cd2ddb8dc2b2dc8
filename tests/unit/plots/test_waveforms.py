"""Figures: what is drawn where."""

import pytest
from figure_inputs import result

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import waveforms


@pytest.mark.slow
def test_depth_axis():
    figure = waveforms.plot_waveforms(result())
    axes = figure.axes[0]
    (depth,) = axes.child_axes
    assert depth.get_xlabel() == "depth on the axis (m)"
    figure.draw_without_rendering()  # until then the secondary axis has no limits
    # sin 20 deg / 1.34 is the sine of 14.788 deg: 80 ns are 0.299792458 * 80 / (2 * 1.364) * 0.966877 m = 8.5004 m.
    # Without the cosine it would be 8.79 m, with the refractive index for the group index 8.65 m.
    low, high = depth.get_xlim()
    start, end = axes.get_xlim()
    at_1500 = low + (1500 - start) * (high - low) / (end - start)
    assert at_1500 == pytest.approx(8.5004, abs=2e-4)
    assert low + (1420 - start) * (high - low) / (end - start) == pytest.approx(0.0, abs=1e-9)


def test_rejects(tmp_path):
    with pytest.raises(ValueError, match="scale = 'sqrt' must be one of both, linear, log"):
        waveforms.plot_waveforms(result(), scale="sqrt")
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        waveforms.plot_waveforms(result(), tmp_path / "a.txt")
