"""Animations of images by daylight."""

import numpy as np
from figure_inputs import frames
from PIL import Image

from mitransient_lidar.plots.gates.images import animate_passive


def test_animation_shows_the_frames_in_their_time(tmp_path):
    radiances = frames()
    animate_passive(radiances, tmp_path / "a.gif")
    animate_passive(radiances.isel(column=slice(None, None, -1)), tmp_path / "turned.gif")
    assert (tmp_path / "turned.gif").read_bytes() == (tmp_path / "a.gif").read_bytes()
    with Image.open(tmp_path / "a.gif") as movie:
        assert (movie.n_frames, movie.info["duration"], movie.info["loop"]) == (3, 250, 0)
        assert movie.size == (400, 320)  # 8 x 8 points a pixel, for a width of at least 384
        shown = []
        for index in range(3):
            movie.seek(index)
            shown.append(np.asarray(movie.convert("L"))[4::8, 4::8])
    assert shown[0][1, 2] == shown[1][3, 4] == 255
    assert np.corrcoef(shown[2].ravel(), radiances["radiance"][2].values.ravel())[0, 1] > 0.99
