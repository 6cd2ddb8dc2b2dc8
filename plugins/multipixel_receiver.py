"""Sensor plugin ``multipixel_receiver``: the receiver and all its pixels."""

from __future__ import annotations

import mitsuba as mi

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.lidar import MULTIPIXEL_RECEIVER
from mitransient_lidar.plugins.bases import DeclaredProperties, ReceiverSensor, register
from mitransient_lidar.plugins.pixel_fov import PixelFov
from mitransient_lidar.transport.sensor.hex_pixels import HexPixels
from mitransient_lidar.transport.sensor.pixels import LayoutPixels, MappedPixels, PixelArray, ShapedPixels, parse_layout


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

    Blur distributes light from the direction (angle_x, angle_y) around that point on the detector by the point-spread
    function, which is the same all over the field of view. Light between pixels is lost.

    .. example::

        {'type': 'multipixel_receiver', 'layout': '2x2', 'field_of_view_mrad': 30.0,
         'film': {'type': 'time_gated_film'}}
    """

    def __init__(self, props: DeclaredProperties) -> None:
        nested = [child for _, child in props.objects() if isinstance(child, mi.Sensor)]
        super().__init__(props, _nested_pixels(props, nested) if nested else _own_pixels(props))


#: Lens parameters.
_LENS = ("focal_length_mm", "pixel_pitch_um")


def _nested_pixels(props: mi.Properties, nested: list[mi.Sensor]) -> PixelArray:
    """Build the pixels from nested sensors."""
    if not all(isinstance(pixel, PixelFov) for pixel in nested):
        raise UserError("multipixel_receiver: nested sensors must be pixel_fov")
    names = [pixel.pixel_name or f"pixel{index}" for index, pixel in enumerate(nested)]
    return ShapedPixels([pixel.field for pixel in nested], names)


def _own_pixels(props: DeclaredProperties) -> PixelArray:
    """Build the pixels from a layout or a map."""
    field_of_view = 1e-3 * props.read("field_of_view_mrad")
    if "pixel_map" in props:
        return MappedPixels.from_file(str(props["pixel_map"]), field_of_view)
    layout, fill_factor, imager = str(props.read("layout")), props.read("fill_factor"), props.read("imager")
    if layout.startswith("hex"):
        for name in ("field_of_view_shape", "imager", *_LENS):
            if name in props:
                raise UserError(f"{name} = {props[name]!r} is for layouts of rows x columns: leave it out")
        return HexPixels(layout, field_of_view, fill_factor)
    if any(name in props for name in _LENS):
        shape = props.read("field_of_view_shape", "square")
        return LayoutPixels(layout, _sides_of_lens(props, layout), shape, imager, fill_factor)
    shape = props.read("field_of_view_shape", "circle")
    return LayoutPixels(layout, field_of_view, shape, imager, fill_factor)


def _sides_of_lens(props: DeclaredProperties, layout: str) -> tuple[float, float]:
    """Return the sides (angle_x, angle_y) [rad] of a lens detector's field of view."""
    for name in _LENS:
        if name not in props:
            raise UserError(f"{name} is missing: a lens needs {' and '.join(_LENS)}")
    focal_length, pitch = map(props.read, _LENS)
    rows, columns = parse_layout(layout)
    sides = 1e-3 * pitch / focal_length * rows, 1e-3 * pitch / focal_length * columns
    allowed = MULTIPIXEL_RECEIVER["field_of_view_mrad"]
    if not allowed.low <= 1e3 * min(sides) <= 1e3 * max(sides) <= allowed.high:
        raise UserError(
            f"focal_length_mm = {focal_length:g} and pixel_pitch_um = {pitch:g} give a field of view of "
            f"{1e3 * sides[0]:g} x {1e3 * sides[1]:g} mrad: its sides must lie between 0.001 and 3000"
        )
    return sides


register("sensor", MULTIPIXEL_RECEIVER, MultipixelReceiver)
