"""Figures and animations of images by daylight."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex
from PIL import Image

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.plots.passive import animate_passive, plot_passive


@pytest.fixture
def frames():
    """Three frames of 4 x 5 pixels; one pixel in each of the first two is far too bright."""
    radiance = np.random.default_rng(4).uniform(2e-3, 4e-3, (3, 40, 50))
    radiance[0, 1, 2] = radiance[1, 3, 4] = 1.0
    angle_x, angle_y = np.meshgrid(np.linspace(3, -3, 40), np.linspace(4, -4, 50), indexing="ij")
    return xr.Dataset(
        {"radiance": (("frame", "row", "column"), radiance)},
        {
            "angle_x": (("row", "column"), angle_x),
            "angle_y": (("row", "column"), angle_y),
            "time_s": ("frame", [0.0, 0.25, 0.5]),
        },
        {"scene": "sea", "sun_zenith_deg": 40.0, "sky_distribution": "uniform"},
    )


def few():
    error = ("pixel", [1e-4, 1e-4])
    return xr.Dataset({"radiance": ("pixel", [2e-3, 3e-3]), "radiance_stderr": error}, {"pixel": ["a", "b"]})


def test_frames_share_their_grey_levels(frames):
    figures = [plot_passive(frames, frame=index) for index in range(2)]
    drawn = [figure.axes[0].images[0] for figure in figures]
    for index, image in enumerate(drawn):
        np.testing.assert_allclose(image.get_array(), 1e3 * frames["radiance"][index])
        assert image.get_cmap().name == "gray"
    assert drawn[0].get_clim() == drawn[1].get_clim()
    black, white = drawn[0].get_clim()
    # The glint is clipped, and the darkest pixels are not black.
    assert black < 2.0
    assert 3.9 < white < 4.1
    left, right, near, far = drawn[0].get_extent()
    assert (left, right) == pytest.approx((4 + 4 / 49, -4 - 4 / 49))
    assert (near, far) == pytest.approx((-3 - 3 / 39, 3 + 3 / 39))
    assert figures[1].axes[0].get_title() == "sea, sun at 40° from the zenith, uniform sky, 0.25 s"
    assert figures[0].axes[1].get_ylabel() == "radiance (mW m$^{-2}$ sr$^{-1}$ nm$^{-1}$)"


def test_pixels_without_a_grid_are_bars():
    ax = plot_passive(few()).axes[0]
    assert [bar.get_height() for bar in ax.patches] == pytest.approx([2.0, 3.0])
    assert [label.get_text() for label in ax.get_xticklabels()] == ["a", "b"]
    assert len({to_hex(bar.get_facecolor()) for bar in ax.patches}) == 2


def test_animation_shows_the_frames_in_their_time(frames, tmp_path):
    animate_passive(frames, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as movie:
        assert (movie.n_frames, movie.info["duration"], movie.info["loop"]) == (3, 250, 0)
        assert movie.size == (400, 320)  # 8 x 8 points a pixel, for a width of at least 384
        shown = []
        for index in range(3):
            movie.seek(index)
            shown.append(np.asarray(movie.convert("L"))[4::8, 4::8])
    assert shown[0][1, 2] == shown[1][3, 4] == 255
    assert np.corrcoef(shown[2].ravel(), frames["radiance"][2].values.ravel())[0, 1] > 0.99


def test_missing_frames_are_rejected(frames, tmp_path):
    with pytest.raises(UserError, match="needs frames of an imager"):
        animate_passive(few(), tmp_path / "a.gif")
    with pytest.raises(UserError, match=r"must end in \.gif"):
        animate_passive(frames, tmp_path / "a.png")
    with pytest.raises(UserError, match="frame = 3 must lie between 0 and 2"):
        plot_passive(frames, tmp_path / "a.png", frame=3)
    assert not list(tmp_path.iterdir())
