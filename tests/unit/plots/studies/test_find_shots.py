"""Figure of found shots: sea, footprints and waveforms."""

import math

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex
from matplotlib.patches import Ellipse

from mitransient_lidar.plots.studies.find_shots import plot_found_shots
from mitransient_lidar.rendering.shots.truth import SeaMap, Shot
from mitransient_lidar.studies.find_shots import RenderedShots

LINES = np.arange(-20, 20, 0.5)


def rendered(waveforms=True):
    """Return two shots over a sea of 40 m with crests along y, and a receiver whose far half is pixel 0."""
    heights = np.broadcast_to(np.sin(2 * np.pi * LINES / 10), (80, 80))
    sea = SeaMap(LINES, LINES, heights, np.zeros((80, 80)), np.zeros((80, 80)))
    shots = (Shot("towards", 1.0, 2.0, 0.1, 0.0), Shot("level", -4.0, 0.0, 0.0, -0.05))
    grid = np.linspace(-2, 2, 41)
    x, y = np.meshgrid(grid, grid)
    pixel_map = np.where(np.hypot(x, y) < 1.5, np.where(x > 0, 0, 1), -1)
    time = 1400.0 + np.arange(60)
    echo = 1e-3 * np.exp(-((np.arange(60) - 20) ** 2) / 8)
    results = [
        xr.Dataset({"waveform": (("pixel", "time"), np.outer([1, 2], factor * echo))}, {"time": time})
        for factor in (1, 3)
    ]
    return RenderedShots("made", shots, results if waveforms else [], sea, 0.5, (1.2, 1.0), grid, pixel_map, 2)


def test_footprints_lie_at_the_shots():
    figure = plot_found_shots(rendered())
    sea = figure.axes[0]
    ellipses = [patch for patch in sea.patches if isinstance(patch, Ellipse)]
    assert [patch.center for patch in ellipses] == [(1.0, 2.0), (-4.0, 0.0)]
    for patch in ellipses:
        assert (patch.width, patch.height, patch.angle) == pytest.approx((2.4, 2.0, math.degrees(0.5)))
    assert [text.get_text() for text in sea.texts] == ["1", "2"]
    # Two pixels a shot: the first on the side of +x of the shot, the second on that of -x.
    contours = sea.collections
    colours = [to_hex(contour.get_edgecolor()[0]) for contour in contours]
    assert colours[:2] == colours[2:]
    assert colours[0] != colours[1]
    middles = [np.concatenate([path.vertices for path in contour.get_paths()]).mean(axis=0) for contour in contours]
    for middle, (x, y) in zip(middles, [(1.0, 2.0), (1.0, 2.0), (-4.0, 0.0), (-4.0, 0.0)], strict=True):
        assert abs(middle[0] - x) < 1.5
        assert middle[1] == pytest.approx(y, abs=0.05)
    assert middles[0][0] > 1.0 > middles[1][0]
    assert figure.get_suptitle() == "made"
    assert (sea.get_xlabel(), sea.get_ylabel()) == ("x (m)", "y (m)")
    assert sea.get_title() == "seen from above; the beam points to 28.6° from +x towards +y"  # 0.5 rad
    assert np.all(np.diff([sea.get_xlim(), sea.get_ylim()]) > 0)


def test_sea_is_periodic_around_the_shots():
    (image,) = plot_found_shots(rendered(waveforms=False)).axes[0].images
    left, right, near, far = image.get_extent()
    # A margin of six standard deviations of the beam, 7.2 m.
    assert (left, right, near, far) == pytest.approx((-11.5, 8.5, -7.5, 9.5))
    x = np.linspace(left, right, image.get_array().shape[1])
    np.testing.assert_allclose(image.get_array()[0], np.sin(2 * np.pi * x / 10), atol=1e-9)


def test_early_echoes_are_not_cut():
    """Waveforms begin where a pixel has 0.5 % of its peak, 6.5 ns before it, if the window is later."""
    made = rendered()
    for result in made.results:
        result.attrs = {"window_start_ns": 1418.0, "window_end_ns": 1440.0, "bin_width_ns": 1.0}
    panels = [ax for ax in plot_found_shots(made).axes if ax.get_ylabel() == "power (mW)"]
    for ax in panels:
        assert ax.get_xlim() == pytest.approx((1414.0, 1440.0 + 0.06 * 22))


def test_waveforms_are_drawn_next_to_the_sea_with_their_slopes():
    figure = plot_found_shots(rendered())
    panels = [ax for ax in figure.axes if ax.get_ylabel() == "power (mW)"]
    assert [ax.get_title() for ax in panels] == ["1 towards (+5.7°, +0.0°)", "2 level (+0.0°, -2.9°)"]
    peaks = [[line.get_ydata().max() for line in ax.lines] for ax in panels]
    np.testing.assert_allclose(peaks, [[1, 2], [3, 6]])  # mW
    assert len(plot_found_shots(rendered(waveforms=False)).axes) == 2  # the sea and its colour bar
