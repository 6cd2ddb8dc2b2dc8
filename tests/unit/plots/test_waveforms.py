"""Figures: what is drawn where."""

import json
import math

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle

from mitransient_lidar import results
from mitransient_lidar.analysis.receiver import detect_waveforms
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.plots import waveforms

ATTRIBUTES = {
    "scene": "fig09",
    "altitude": 200.0,
    "surface_time_ns": 1420.0,
    "window_start_ns": 1412.0,
    "window_end_ns": 1508.0,
    "refractive_index": 1.34,
    "group_index": 1.364,
    "off_nadir_deg": 20.0,
    "layout": "2x2",
    "field_of_view_mrad": 30.0,
    "field_of_view_shape": "circle",
    "error_median": 0.0098,
}
CENTRES = {
    "2x2": [(6.4, 6.4), (6.4, -6.4), (-6.4, 6.4), (-6.4, -6.4)],
    "1x4": [(10.6, 0.0), (3.7, 0.0), (-3.7, 0.0), (-10.6, 0.0)],
}


def make(pixels=4, grid=None, centres=None, attributes=ATTRIBUTES, scale=1.0):
    time = 1405.25 + 0.5 * np.arange(300)
    echo = 2e-5 * np.exp(-((time - 1420) ** 2) / 9) + 1e-6 * np.exp(-((time - 1495) ** 2) / 9)
    waveform = scale * echo * (1 + np.arange(pixels))[:, np.newaxis]
    return results.build(
        0.5e-9 * waveform,
        0.01 * 0.5e-9 * waveform,
        waveform,
        0.01 * waveform,
        time=TimeAxis(1405.0, 0.5, waveform.shape[1]),
        pixel_names=[f"p{i}" for i in range(pixels)],
        pixel_centres_mrad=np.zeros((pixels, 2)) if centres is None else centres,
        grid=grid,
        attributes=attributes,
    )


def side_axes(figure):
    return next(ax for ax in figure.axes if not ax.get_ylabel().startswith("received power"))


def test_two_panels_share_time_and_show_power_in_a_fitting_unit():
    figure = waveforms.plot_waveforms(make(centres=CENTRES["2x2"]))
    linear, log = figure.axes[:2]
    assert (linear.get_yscale(), log.get_yscale()) == ("linear", "log")
    assert linear.get_xlim() == log.get_xlim()
    assert linear.get_ylabel() == "received power (µW)"
    # Pixel 3 peaks at 4 * 2e-5 W = 80 µW.
    assert linear.lines[3].get_ydata().max() == pytest.approx(80.0, rel=0.01)
    assert linear.lines[0].get_xdata()[0] == 1405.25
    start, end = linear.get_xlim()
    assert 1405 <= start < 1412
    assert 1508 < end < 1530


def test_pixels_are_red_green_blue_black_with_bands_of_one_standard_error():
    axes = waveforms.plot_waveforms(make(centres=CENTRES["2x2"]), scale="linear").axes[0]
    channels = [np.argmax(to_rgb(line.get_color())) for line in axes.lines]
    assert channels[:3] == [0, 1, 2]
    assert max(to_rgb(axes.lines[3].get_color())) < 0.1
    band = axes.collections[3].get_paths()[0].vertices[:, 1]
    assert band.max() == pytest.approx(axes.lines[3].get_ydata().max() * 1.01, rel=1e-3)


@pytest.mark.slow
def test_depth_axis():
    figure = waveforms.plot_waveforms(make())
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


@pytest.mark.parametrize(
    ("layout", "cells"),
    [
        # (right, bottom) in (angle_y, angle_x): far (+angle_x) on top, +angle_y to the left.
        ("2x2", [(0, 0), (-15, 0), (0, -15), (-15, -15)]),
        ("1x4", [(-15, 7.5), (-15, 0), (-15, -7.5), (-15, -15)]),
    ],
)
def test_layout_is_drawn_as_the_receiver_sees_it(layout, cells):
    figure = waveforms.plot_waveforms(make(centres=CENTRES[layout], attributes=ATTRIBUTES | {"layout": layout}))
    drawn = [patch for patch in side_axes(figure).patches if isinstance(patch, Rectangle)]
    assert [patch.get_xy() for patch in drawn] == cells
    assert np.argmax(to_rgb(drawn[0].get_facecolor()[:3])) == 0
    left, right = side_axes(figure).get_xlim()
    assert left > 0 > right


def test_pixels_have_the_shapes_of_their_outlines():
    """A triangle, and a square with a hole: angle_y to the left, angle_x up."""
    lines = [[[1, 2, 3, 2, 3, 4]], [[-4, -4, -4, 4, 0, 4, 0, -4], [-3, -1, -1, -1, -1, 1, -3, 1]]]
    made = make(2, attributes=ATTRIBUTES | {"layout": "", "pixel_outlines": json.dumps(lines)})
    side = side_axes(waveforms.plot_waveforms(made))
    triangle, square = (patch.get_path() for patch in side.patches)
    assert triangle.contains_point((2.2, 2.5))
    assert not triangle.contains_point((3.8, 1.5))
    # Each loop of the second pixel goes round once; even-odd, the hole is open.
    (outer, inner) = square.to_polygons(closed_only=True)
    np.testing.assert_array_equal(outer[:-1], [(-4, -4), (4, -4), (4, 0), (-4, 0)])
    np.testing.assert_array_equal(inner[:-1], [(-1, -3), (-1, -1), (1, -1), (1, -3)])
    assert not side.collections  # no dots
    left, right = side.get_xlim()
    assert left > 4 > -4 > right


def test_other_layouts_are_dots_at_the_centres():
    figure = waveforms.plot_waveforms(make(3, centres=[(1, 2), (3, 4), (5, 6)], attributes=ATTRIBUTES | {"layout": ""}))
    (dots,) = side_axes(figure).collections
    np.testing.assert_array_equal(dots.get_offsets(), [(2, 1), (4, 3), (6, 5)])


def test_imager_shows_energy_with_the_far_row_on_top_and_the_summed_waveform():
    centres = [(angle_x, angle_y) for angle_x in (5.0, -5.0) for angle_y in (10.0, 0.0, -10.0)]
    dataset = make(6, (2, 3), centres)
    figure = waveforms.plot_waveforms(dataset, scale="linear")
    assert figure.axes[0].lines[0].get_ydata().max() == pytest.approx(420.0, rel=0.01)  # µW: 21 * 2e-5 W
    (image,) = side_axes(figure).images
    assert image.get_extent() == [15, -15, -10, 10]
    assert image.origin == "upper"
    # Two Gaussian echoes of 2e-5 and 1e-6 W: 2.1e-5 W * 3 sqrt(pi) * 1e-9 s for the first pixel, in fJ.
    assert image.get_array()[0, 0] == pytest.approx(2.1e-5 * 3e-9 * math.sqrt(math.pi) / 1e-15, rel=1e-3)


def test_series_shows_the_mean_and_the_band_of_most_shots():
    scales = np.random.default_rng(2).uniform(0.5, 2.0, 40)
    shots = xr.concat([make(2, scale=scale) for scale in scales], "shot", combine_attrs="override")
    linear = waveforms.plot_waveforms(shots, scale="linear").axes[0]
    shown = shots["waveform"].values[:, 1]
    np.testing.assert_allclose(linear.lines[1].get_ydata(), 1e6 * shown.mean(axis=0))
    corners = linear.collections[1].get_paths()[0].vertices
    limits = [1e6 * np.quantile(shown, share, axis=0).max() for share in (0.05, 0.95)]
    assert corners[:, 1].max() == pytest.approx(limits[1])
    assert np.isclose(corners[:, 1], limits[0]).any()
    assert linear.get_ylim()[1] > limits[1]
    assert "mean and 90 % of 40 shots" in linear.figure.get_suptitle()


@pytest.mark.slow
def test_imagers_and_records_of_a_series_are_drawn():
    shots = xr.concat([make(4, grid=(2, 2), scale=scale) for scale in (1.0, 3.0)], "shot", combine_attrs="override")
    figure = waveforms.plot_waveforms(shots)
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), 1e6 * 20 * make()["waveform"][0])
    image = next(ax for ax in figure.axes if ax.images).images[0].get_array()
    energy = shots["impulse_response"].mean("shot").sum("time")
    np.testing.assert_allclose(image / image.max(), energy / energy.max())
    recorded = detect_waveforms(shots.assign_coords(shot=[0, 1]), "photodiode", 1, 2)
    figure = waveforms.plot_waveforms(recorded)
    assert figure.axes[0].get_ylabel() == "recorded signal (V)"
    np.testing.assert_allclose(
        figure.axes[0].lines[0].get_ydata(), recorded["signal"].mean("shot").sum(("row", "column")), atol=1e-9
    )
    one = waveforms.plot_waveforms(recorded.isel(shot=1))
    assert one.get_suptitle() == "fig09  ·  receiver photodiode  ·  shot 1"
    counts = waveforms.plot_waveforms(detect_waveforms(make(), "spad", 3, 2))
    assert counts.axes[0].get_ylabel() == "recorded signal per bin"


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [1, 40])
def test_missing_attributes_leave_out_what_needs_them(pixels, tmp_path):
    dataset = make(pixels)
    dataset.attrs = {}
    figure = waveforms.plot_waveforms(dataset, tmp_path / "a.png")
    assert not figure.axes[0].child_axes
    assert figure.axes[0].get_xlim() == (1404.75, 1555.25) or figure.axes[0].get_xlim() == (1405.0, 1555.0)


@pytest.mark.slow
@pytest.mark.parametrize("level", [np.nan, -1.0])
def test_signals_without_positive_values_are_drawn(level, tmp_path):
    linear, log = waveforms.plot_waveforms(make(2, scale=level), tmp_path / "a.png").axes[:2]
    # Without a significant value the axes are those of a signal of 1 W.
    assert (linear.get_ylabel(), linear.get_ylim()[1]) == ("received power (W)", pytest.approx(1.08))
    assert log.get_ylim() == pytest.approx((1e-3, 2.0))
    lowest = -2 * 2.1e-5 if level == -1 else 0
    assert linear.get_ylim()[0] == pytest.approx(lowest, rel=0.1)
    np.testing.assert_allclose(linear.lines[1].get_ydata(), 2 * linear.lines[0].get_ydata())


@pytest.mark.slow
def test_odd_names_are_plain_text(tmp_path):
    dataset = make(2).assign_coords(pixel=["$x", "_å\\"])
    dataset.attrs["scene"] = "a$b_{"
    figure = waveforms.plot_waveforms(dataset, tmp_path / "a.png")
    names = [text.get_text() for text in side_axes(figure).get_legend().get_texts()]
    assert names == ["$x", "_å\\"]
    assert figure.get_suptitle() == "a$b_{  ·  median standard error 0.98 %"


@pytest.mark.slow
def test_png_is_complete_or_absent(tmp_path):
    waveforms.plot_waveforms(make(), tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    assert data.rstrip().endswith(b"IEND\xaeB`\x82")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"cannot write .*file/b\.png: Not a directory"):
        waveforms.plot_waveforms(make(), tmp_path / "file" / "b.png")


def test_rejects(tmp_path):
    with pytest.raises(ValueError, match="scale = 'sqrt' must be one of both, linear, log"):
        waveforms.plot_waveforms(make(), scale="sqrt")
    with pytest.raises(UserError, match=r"must end in \.png, \.pdf or \.svg"):
        waveforms.plot_waveforms(make(), tmp_path / "a.txt")
