"""Hexagons, pixel maps, gaps and nested pixels: sums over pixels, overlaps and errors."""

import dataclasses
import re

import mitsuba as mi
import numpy as np
import pytest
from significance import assert_same

from mitransient_lidar.transport.sensor.hex_pixels import hexagon_count

BRIGHT = {"sea": {"slope_variance": "0.02"}, "film": {"time_start_ns": 1410.0, "bin_width_ns": 20.0, "bin_count": 7}}
BRIGHT |= {"integrator": {"type": "lidar_volpath", "paths_per_pass": 2**14}}
MERGING = {**BRIGHT, "integrator": {"type": "lidar_merging", "paths_per_pass": 2**14, "photons_per_pass": 2**14}}


def polygon(corners, **more):
    vertices = ", ".join(f"{angle_x:.9g} {angle_y:.9g}" for angle_x, angle_y in corners)
    return {"type": "pixel_fov", "shape": "polygon", "vertices_mrad": vertices, **more}


@pytest.fixture
def png(tmp_path):
    """Function that writes an image and returns its path."""

    def write(values, name="map.png"):
        path = tmp_path / name
        if name.endswith(".npy"):
            np.save(path, values)
        else:
            mi.Bitmap(np.ascontiguousarray(values)[..., None]).write(str(path))
        return str(path)

    return write


class OnePixel:
    """The pixels of an array as a single pixel."""

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


@pytest.mark.long
def test_a_nested_pixel_sees_the_same_alone_and_among_others(lidar_scene, passes):
    """Others overlap it, contain it, or are far away."""
    ring = {"type": "pixel_fov", "shape": "ring", "field_of_view_mrad": 16.0, "inner_mrad": 8.0, "pixel_name": "ring"}
    others = {
        "a": {"type": "pixel_fov", "field_of_view_mrad": 30.0, "pixel_name": "all"},
        "b": {"type": "pixel_fov", "shape": "rectangle", "angle_x_mrad": 5.0, "pixel_name": "box"},
        "d": polygon([(-14, -14), (-10, -14), (-14, -10)], pixel_name="corner"),
    }
    alone = lidar_scene(rx={"c": ring}, **MERGING)
    among = lidar_scene(rx={"c": ring, **others}, **MERGING)
    names = among.sensors()[0].receiver.pixels.names
    assert sorted(names) == ["all", "box", "corner", "ring"]
    assert_same(passes(among, 12)[:, names.index("ring")], passes(alone, 12, 50)[:, 0], error=0.03)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("map.png", np.uint8), ("map.png", np.uint16), ("map.npy", np.int64), ("map.npy", np.float64), ("map.exr", "f4")],
)
def test_labels_are_read_as_they_are_written(png, name, kind):
    labels = np.array([[0, 1], [200, 7], [7, 1]], dtype=kind)
    pixels = mi.load_dict({"type": "multipixel_receiver", "pixel_map": png(labels, name)}).receiver.pixels
    assert pixels.names == ["label1", "label7", "label200"]
    np.testing.assert_allclose(pixels.centres()[2] * 1e3, [0, 7.5], atol=1e-9)
    assert (pixels.layout, pixels.field_of_view_shape, pixels.grid) == ("map", "square", None)


def refused(plugin):
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "multipixel_receiver", **plugin})
    return str(caught.value)


MAPS = [
    (np.zeros((4, 4), np.uint8), "map.png", "must have a label other than 0"),
    (np.array([[0.5, 1]]), "map.npy", "must hold labels that are integers from 0 to 16777216"),
    (np.array([[-1, 1]]), "map.npy", "must hold labels that are integers"),
    (np.array([[1, 2**25]]), "map.npy", "must hold labels that are integers"),
    (np.array([[np.nan, 1]]), "map.npy", "must hold finite numbers"),
    (np.ones((2, 3, 4)), "map.npy", "has the shape (2, 3, 4): it must have rows and columns"),
    (np.ones(3), "map.npy", "has the shape (3,)"),
    (np.array([["a"]]), "map.npy", "must hold real numbers"),
    (np.arange(1, 2**20 + 3).reshape(2, -1), "map.npy", "has 1048578 labels; allowed are at most 1048576"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("values", "name", "message"), MAPS)
def test_images_that_are_no_maps_are_refused(png, values, name, message):
    assert message in refused({"pixel_map": png(values, name)})


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


@pytest.mark.parametrize("rings", range(6))
def test_numbers_of_hexagons(rings):
    assert hexagon_count(f"hex{1 + 3 * rings * (rings + 1)}") == 1 + sum(6 * ring for ring in range(rings + 1))


@pytest.mark.long
def test_the_largest_arrays_load():
    """590 rings; the next one would be above 2^20 pixels."""
    pixels = mi.load_dict({"type": "multipixel_receiver", "layout": "hex1046071"}).receiver.pixels
    assert pixels.count == len(pixels.centres()) == 1046071
    assert "hex1049617" in refused({"layout": "hex1049617"})
