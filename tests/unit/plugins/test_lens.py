"""Receivers whose field of view is a detector behind a lens."""

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.transport.rng import unit_points

LENS = {"focal_length_mm": 100.0, "pixel_pitch_um": 20.0}


def receiver(**parameters):
    film = {"type": "time_gated_film"}
    return mi.load_dict({"type": "multipixel_receiver", "film": film, **LENS, **parameters}).receiver


def test_field_of_view_is_pixels_times_pitch_over_focal_length():
    """20 um behind 100 mm are 0.2 mrad: 12 rows see 2.4 mrad along angle_x, 40 columns 8 mrad along angle_y."""
    pixels = receiver(layout="12x40").pixels
    assert pixels.sides == pytest.approx((2.4e-3, 8e-3), rel=1e-12)
    assert pixels.field_of_view == pytest.approx(8e-3)
    assert pixels.field_of_view_shape == "rectangle"
    assert pixels.area == pytest.approx(2.4e-3 * 8e-3)
    centres = pixels.centres().reshape(12, 40, 2)
    np.testing.assert_allclose(np.diff(centres[:, 0, 0]), -2e-4, rtol=1e-9)
    np.testing.assert_allclose(np.diff(centres[0, :, 1]), -2e-4, rtol=1e-9)
    # Row 0 is the far edge, column 0 the left one (+angle_y).
    np.testing.assert_allclose(centres[0, 0], [1.1e-3, 3.9e-3], rtol=1e-9)


def test_points_fall_into_the_pixel_that_holds_them():
    pixels = receiver(layout="12x40").pixels
    angle_x, angle_y = pixels.sample(unit_points(4096))
    index, held = (np.array(a) for a in pixels.pixel_at(angle_x, angle_y, mi.Float(0)))
    assert (held == 1).all()
    centres = pixels.centres()[index]
    assert np.abs(np.array(angle_x) - centres[:, 0]).max() <= 1.001e-4
    assert np.abs(np.array(angle_y) - centres[:, 1]).max() <= 1.001e-4
    # Uniform, and more evenly than at random: 8.5 points in each of 480 pixels.
    assert np.bincount(index, minlength=480).std() < np.sqrt(4096 / 480)
    outside = pixels.pixel_at(mi.Float(1.3e-3, 0), mi.Float(0, 4.1e-3), mi.Float(0))[1]
    assert np.array(outside).tolist() == [0, 0]


def test_fill_factor_keeps_the_pitch():
    pixels = receiver(layout="4x8", fill_factor=0.25).pixels
    assert pixels.area == pytest.approx(0.25 * 8e-4 * 1.6e-3)
    inside, gap = pixels.pixel_at(mi.Float(1e-4, 1e-4), mi.Float(1.4e-4, 1.6e-4), mi.Float(0))[1]
    assert (inside, gap) == (1, 0)


@each_row(
    ({"layout": "4x4", "field_of_view_mrad": 3.0}, "field_of_view_mrad = 3"),
    ({"layout": "4x4", "pixel_pitch_um": 0.0}, "pixel_pitch_um = 0"),
    ({"layout": "4x4", "focal_length_mm": -1.0}, "focal_length_mm = -1"),
    ({"layout": "hex7"}, "focal_length_mm = 100"),
)
def test_lenses_that_cannot_be(parameters, words):
    with pytest.raises(Exception, match=words):
        receiver(**parameters)
