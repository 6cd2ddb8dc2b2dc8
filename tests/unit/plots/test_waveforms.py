"""Figures: what is drawn where."""

import numpy as np
import pytest
from figure_inputs import result

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots import waveforms


def side_axes(figure):
    return next(ax for ax in figure.axes if not ax.get_ylabel().startswith("received power"))


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


@pytest.mark.slow
def test_missing_attributes_leave_out_what_needs_them(tmp_path):
    dataset = result()
    dataset.attrs = {}
    figure = waveforms.plot_waveforms(dataset, tmp_path / "a.png")
    assert not figure.axes[0].child_axes
    assert figure.axes[0].get_xlim() == (1404.75, 1555.25) or figure.axes[0].get_xlim() == (1405.0, 1555.0)


@pytest.mark.slow
@pytest.mark.parametrize("level", [np.nan, -1.0])
def test_signals_without_positive_values_are_drawn(level, tmp_path):
    linear, log = waveforms.plot_waveforms(result(2, scale=level), tmp_path / "a.png").axes[:2]
    # Without a significant value the axes are those of a signal of 1 W.
    assert (linear.get_ylabel(), linear.get_ylim()[1]) == ("received power (W)", pytest.approx(1.08))
    assert log.get_ylim() == pytest.approx((1e-3, 2.0))
    lowest = -2 * 2.1e-5 if level == -1 else 0
    assert linear.get_ylim()[0] == pytest.approx(lowest, rel=0.1)
    np.testing.assert_allclose(linear.lines[1].get_ydata(), 2 * linear.lines[0].get_ydata())


@pytest.mark.slow
def test_odd_names_are_plain_text(tmp_path):
    dataset = result(2).assign_coords(pixel=["$x", "_å\\"])
    dataset.attrs["scene"] = "a$b_{"
    figure = waveforms.plot_waveforms(dataset, tmp_path / "a.png")
    names = [text.get_text() for text in side_axes(figure).get_legend().get_texts()]
    assert names == ["$x", "_å\\"]
    assert figure.get_suptitle() == "a$b_{  ·  median standard error 0.98 %"


def test_rejects(tmp_path):
    with pytest.raises(ValueError, match="scale = 'sqrt' must be one of both, linear, log"):
        waveforms.plot_waveforms(result(), scale="sqrt")
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        waveforms.plot_waveforms(result(), tmp_path / "a.txt")
