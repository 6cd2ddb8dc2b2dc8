"""Hexagons, pixel maps, gaps, nested pixels and lenses: sums over pixels, overlaps and errors."""

import dataclasses
import re

import mitsuba as mi
import numpy as np
import pytest
from rows import each_row

from mitransient_lidar.loading import variants
from mitransient_lidar.transport.rng import unit_points

BRIGHT = {"sea": {"slope_variance": "0.02"}, "film": {"time_start_ns": 1410.0, "bin_width_ns": 20.0, "bin_count": 7}}
BRIGHT |= {"integrator": {"type": "lidar_volpath", "paths_per_pass": 2**14}}


@pytest.fixture
def png(tmp_path):
    def write(values, name="map.png"):
        path = tmp_path / name
        if name.endswith(".npy"):
            np.save(path, values)
        else:
            with variants.several_threads():
                mi.Bitmap(np.ascontiguousarray(values)[..., None]).write(str(path))
        return str(path)

    return write


class OnePixel:
    def __init__(self, pixels):
        self._pixels, self.names, self.grid = pixels, ["single"], None
        self.count, self.area, self.sample = 1, pixels.area, pixels.sample
        self.field_of_view, self.field_of_view_shape = pixels.field_of_view, pixels.field_of_view_shape

    def pixel_at(self, angle_x, angle_y, u):
        return mi.UInt32(0), self._pixels.pixel_at(angle_x, angle_y, u)[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "receiver",
    [{"layout": "hex7", "fill_factor": 0.5}, {"layout": "3x5", "fill_factor": 0.5}, {"pixel_map": "map.png"}],
    ids=["hexagons", "cells", "map"],
)
def test_pixels_share_the_light_of_their_area_without_loss(receiver, lidar_scene, passes, png):
    """The sum over pixels has the same bits as a single pixel of the same paths."""
    if "pixel_map" in receiver:
        receiver = {"pixel_map": png(np.random.default_rng(2).integers(0, 6, (9, 12)).astype(np.uint8))}
    scene = lidar_scene(rx={**receiver, "blur_mrad": 1.0}, **BRIGHT)
    apart = passes(scene, 2)
    sensor = scene.sensors()[0]
    sensor.receiver = dataclasses.replace(sensor.receiver, pixels=OnePixel(sensor.receiver.pixels))
    together = passes(scene, 2)
    assert apart.shape[1] > 1
    assert together.shape[1] == 1
    np.testing.assert_allclose(apart.sum(axis=1), together[:, 0], rtol=1e-12)
    assert np.count_nonzero(together) == together.size


@each_row(
    ("map.png", np.uint8), ("map.png", np.uint16), ("map.npy", np.int64), ("map.npy", np.float64), ("map.exr", "f4")
)
def test_labels_are_read_as_they_are_written(name, kind, png):
    labels = np.array([[0, 1], [200, 7], [7, 1]], dtype=kind)
    pixels = mi.load_dict({"type": "multipixel_receiver", "pixel_map": png(labels, name)}).receiver.pixels
    assert pixels.names == ["label1", "label7", "label200"]
    np.testing.assert_allclose(pixels.centres()[2] * 1e3, [0, 7.5], atol=1e-9)
    assert (pixels.layout, pixels.field_of_view_shape, pixels.grid) == ("map", "square", None)


def refused(plugin):
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "multipixel_receiver", **plugin})
    return str(caught.value)


def test_files_that_are_no_images_are_refused(tmp_path):
    for name in ("bad.png", "bad.npy", "bad.exr"):
        (tmp_path / name).write_text("nothing")
        assert re.search(rf"pixel_map = '.*{name}': .* is damaged, or", refused({"pixel_map": str(tmp_path / name)}))
    # The pixels of an image are refused by their number in its header.
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (10**5).to_bytes(4, "big") * 2
    (tmp_path / "bomb.png").write_bytes(header)
    assert "bomb.png holds arrays of 7.629e+04 MiB, and 256 MiB" in refused({"pixel_map": str(tmp_path / "bomb.png")})
    assert "'none.png': cannot read none.png: No such file" in refused({"pixel_map": "none.png"})
    assert "'map.jpg': cannot read map.jpg: the name of a grey image must end in" in refused({"pixel_map": "map.jpg"})
    mi.Bitmap(np.ones((2, 2, 3), np.uint8)).write(str(tmp_path / "colour.png"))
    assert "one (grey) channel" in refused({"pixel_map": str(tmp_path / "colour.png")})


def test_images_that_are_no_point_spread_functions_are_refused(png):
    for values in (np.zeros((3, 3)), np.array([[1.0, -0.1]])):
        message = refused({"blur_file": png(values, "psf.npy"), "blur_file_mrad": 3.0})
        assert "must hold values that are not negative and not all 0" in message


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
    ({"layout": "hex7"}, "focal_length_mm = 100"),
)
def test_lenses_that_cannot_be(parameters, words):
    with pytest.raises(Exception, match=words):
        receiver(**parameters)
