"""Sensor plugins ``pixel_fov`` and ``multipixel_receiver``: one pixel, and a receiver with all its pixels."""

from __future__ import annotations

from dataclasses import fields

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.lidar import MULTIPIXEL_RECEIVER, PIXEL_FOV
from mitransient_lidar.core.validation import finite_array, in_range
from mitransient_lidar.plugins.bases import DeclaredProperties, closed, read_pose, refuse_medium, register
from mitransient_lidar.transport.sensor import pixels as arrays
from mitransient_lidar.transport.sensor import receiver
from mitransient_lidar.transport.sensor.fov_shapes import FovShape, Polygon, Rectangle, Sector, Strip
from mitransient_lidar.transport.sensor.image_sampling import read_image

#: Optical parameters of a receiver, in the order of `ReceiverOptics`.
_OPTICS = tuple(each.name for each in fields(receiver.ReceiverOptics))


@closed
class ReceiverSensor(mi.Sensor):
    """Sensor of some pixels, with pose, optics and blur from its parameters."""

    def __init__(self, props: DeclaredProperties, pixels: arrays.PixelArray) -> None:
        refuse_medium(props)
        super().__init__(props)
        self.receiver = receiver.Receiver(
            read_pose(props), receiver.ReceiverOptics(*map(props.read, _OPTICS)), pixels, _blur(props)
        )
        self.m_needs_sample_2 = True
        self.m_needs_sample_3 = self.receiver.blur is not None

    def sample_ray(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Sample a ray uniformly over the field of view, for Mitsuba's own integrators."""
        return self.receiver.sensor_ray(time, sample2, sample3, active)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return an invalid box: the sensor does not extend the scene."""
        return mi.ScalarBoundingBox3f()


def _blur(props: DeclaredProperties) -> receiver.PointSpread | None:
    """Return a receiver's point-spread function; None for sharp optics."""
    if "blur_file" not in props:
        if "blur_file_mrad" in props:
            raise UserError("blur_file_mrad is the size of blur_file, which is missing")
        width = props.read("blur_mrad")
        return receiver.GaussianPointSpread(1e-3 * width) if width > 0 else None
    if "blur_file_mrad" not in props:
        raise UserError("blur_file_mrad is missing: the angle [mrad] over which the image blur_file reaches")
    path = str(props["blur_file"])
    values = read_image("blur_file", path)
    if values.min() < 0 or values.max() <= 0:
        raise UserError(f"blur_file = {path!r} must hold values that are not negative and not all 0")
    return receiver.MeasuredPointSpread(values, 1e-3 * props.read("blur_file_mrad"))


@register("sensor", PIXEL_FOV)
class PixelFov(ReceiverSensor):
    r"""Field of view of one pixel (``pixel_fov``).

    .. parameters::

    Nested in ``multipixel_receiver`` only the shape and the name are used: pose, aperture, losses and blur are the
    receiver's. As the only sensor of a scene it is a receiver with one pixel.

    .. example::

        {'type': 'pixel_fov', 'shape': 'ring', 'field_of_view_mrad': 30.0, 'inner_mrad': 10.0,
         'film': {'type': 'time_gated_film'}}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        self.field = _field(props)
        self.pixel_name = str(props.read("pixel_name"))
        level = mi.log_level()
        # Mitsuba gives a sensor without film, as a nested one, its own and warns of its format.
        mi.set_log_level(mi.LogLevel.Error)
        try:
            super().__init__(props, arrays.ShapedPixels([self.field], [self.pixel_name or "pixel"]))
        finally:
            mi.set_log_level(level)


def _field(props: DeclaredProperties) -> FovShape:
    """Build the shape from the plugin's parameters."""
    read = props.read
    shape = read("shape")
    centre = 1e-3 * read("angle_x_mrad"), 1e-3 * read("angle_y_mrad")
    if shape == "rectangle":
        width, height = 0.5e-3 * read("width_mrad"), 0.5e-3 * read("height_mrad")
        return Rectangle(centre[0] - height, centre[0] + height, centre[1] - width, centre[1] + width)
    if shape == "polygon":
        text = str(read("vertices_mrad"))
        numbers = finite_array("vertices_mrad", text.replace(",", " ").split())
        if numbers.size % 2 or numbers.size < 6:
            raise UserError(f"vertices_mrad = {text!r} must hold pairs 'angle_x angle_y' of at least three corners")
        return Polygon(1e-3 * numbers.reshape(-1, 2))
    outer = 0.5e-3 * read("field_of_view_mrad")
    if shape == "strip":
        edge = 1e3 * outer
        low = in_range("angle_x_min_mrad", read("angle_x_min_mrad", -edge), -1e6, edge * (1 - 1e-6))
        least = max(low, -edge) * (1 + 1e-6) + 1e-9
        high = in_range("angle_x_max_mrad", read("angle_x_max_mrad", edge), least, 1e6)
        return Strip(outer, 1e-3 * low, 1e-3 * high)
    if shape == "circle":
        return Sector(outer, centre=centre)
    inner = 0.5e-3 * in_range("inner_mrad", read("inner_mrad"), 0.0, 2e3 * outer * (1 - 1e-6))
    if shape == "ring":
        return Sector(outer, inner, centre=centre)
    return Sector(outer, inner, np.deg2rad(read("start_deg")), np.deg2rad(read("extent_deg")), centre)


@register("sensor", MULTIPIXEL_RECEIVER)
class MultipixelReceiver(ReceiverSensor):
    r"""Receiver with any number of pixels up to 2^20 (``multipixel_receiver``).

    .. parameters::

    Angles are tangent-plane coordinates about the optical axis: +angle_x is away from nadir ("far"), +angle_y is left
    of the line of sight, along +y. Rows, columns and image files follow a picture taken from the lidar: row 0 far,
    column 0 left. In a circular field of view, pixels outside the circle exist and stay dark.

    Paths are drawn over the field of view and then assigned to pixels. More pixels take no more time, and a layout's or
    map's pixels sum, path by path, to a single pixel with the same area. Hexagons have 82.7 % of their circle's area.

    With a fill factor, each ``RxC`` cell shrinks about its centre: its sides by the square root of the factor. A
    circular field of view cuts the shrunk cells as a field stop does.

    Blur distributes light from the direction (angle_x, angle_y) around that point on the detector. The point-spread
    function is the same all over the field of view. Light between pixels is lost.

    .. example::

        {'type': 'multipixel_receiver', 'layout': '2x2', 'field_of_view_mrad': 30.0,
         'film': {'type': 'time_gated_film'}}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        nested = [child for _, child in props.objects() if isinstance(child, mi.Sensor)]
        super().__init__(props, _nested_pixels(props, nested) if nested else _own_pixels(props))


_LENS = ("focal_length_mm", "pixel_pitch_um")  #: Lens parameters.


def _nested_pixels(props: mi.Properties, nested: list[mi.Sensor]) -> arrays.PixelArray:
    """Build the pixels from nested sensors."""
    if not all(isinstance(pixel, PixelFov) for pixel in nested):
        raise UserError("multipixel_receiver: nested sensors must be pixel_fov")
    names = [pixel.pixel_name or f"pixel{index}" for index, pixel in enumerate(nested)]
    return arrays.ShapedPixels([pixel.field for pixel in nested], names)


def _own_pixels(props: DeclaredProperties) -> arrays.PixelArray:
    """Build the pixels from a layout or a map."""
    field_of_view = 1e-3 * props.read("field_of_view_mrad")
    if "pixel_map" in props:
        return arrays.MappedPixels.from_file(str(props["pixel_map"]), field_of_view)
    layout, fill_factor, imager = str(props.read("layout")), props.read("fill_factor"), props.read("imager")
    if layout.startswith("hex"):
        for name in ("field_of_view_shape", "imager", *_LENS):
            if name in props:
                raise UserError(f"{name} = {props[name]!r} is for layouts of rows x columns: leave it out")
        return arrays.HexPixels(layout, field_of_view, fill_factor)
    if any(name in props for name in _LENS):
        shape = props.read("field_of_view_shape", "square")
        return arrays.LayoutPixels(layout, _sides_of_lens(props, layout), shape, imager, fill_factor)
    shape = props.read("field_of_view_shape", "circle")
    return arrays.LayoutPixels(layout, field_of_view, shape, imager, fill_factor)


def _sides_of_lens(props: DeclaredProperties, layout: str) -> tuple[float, float]:
    """Return the sides (angle_x, angle_y) [rad] of a lens detector's field of view."""
    for name in _LENS:
        if name not in props:
            raise UserError(f"{name} is missing: a lens needs {' and '.join(_LENS)}")
    focal_length, pitch = map(props.read, _LENS)
    rows, columns = arrays.parse_layout(layout)
    sides = 1e-3 * pitch / focal_length * rows, 1e-3 * pitch / focal_length * columns
    allowed = MULTIPIXEL_RECEIVER["field_of_view_mrad"]
    if not allowed.low <= 1e3 * min(sides) <= 1e3 * max(sides) <= allowed.high:
        raise UserError(
            f"focal_length_mm = {focal_length:g} and pixel_pitch_um = {pitch:g} give a field of view of "
            f"{1e3 * sides[0]:g} x {1e3 * sides[1]:g} mrad: its sides must lie between 0.001 and 3000"
        )
    return sides
