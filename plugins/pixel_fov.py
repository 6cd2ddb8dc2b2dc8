"""Sensor plugin ``pixel_fov``: one pixel's field of view."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.lidar import PIXEL_FOV
from mitransient_lidar.core.validation import finite_array, in_range
from mitransient_lidar.plugins.bases import DeclaredProperties, ReceiverSensor, register
from mitransient_lidar.transport.sensor.fov_shapes import FovShape, Polygon, Rectangle, Sector, Strip
from mitransient_lidar.transport.sensor.pixels import ShapedPixels


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
            super().__init__(props, ShapedPixels([self.field], [self.pixel_name or "pixel"]))
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


register("sensor", PIXEL_FOV, PixelFov)
