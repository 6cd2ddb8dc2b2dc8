"""Sensor plugin ``pixel_fov``: the field of view of one pixel."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.ranges import ranged
from mitransient_lidar.core.validation import finite, finite_array, in_range
from mitransient_lidar.plugins.bases import ReceiverSensor, RecordedProperties, recorded
from mitransient_lidar.transport.sensor.fov_shapes import FovShape, Polygon, Rectangle, Sector, Strip
from mitransient_lidar.transport.sensor.pixels import ShapedPixels


class PixelFov(ReceiverSensor):
    r"""Field of view of one pixel (``pixel_fov``).

    ============================  ======  ==============================================================================
    Parameter                     Type    Meaning (angles are full angles or positions in the tangent plane about the
    ============================  ======  ==============================================================================
                                          axis)
    shape                         string  ``circle``, ``ring``, ``sector``, ``rectangle``, ``strip`` or ``polygon``.
                                          Default: ``circle``
    field_of_view_mrad            float   Full angle of the circle, ring, sector, or of the circle that a strip is cut
                                          from [mrad], 0.001 to 3000. Default: 30
    inner_mrad                    float   ring, sector: full angle of the hole [mrad]. Default: 0
    start_deg,                    float   sector: first azimuth, from +angle_x (far) towards +angle_y [deg], and size
    extent_deg                            [deg], up to 360. Defaults: 0, 360
    width_mrad,                   float   rectangle: full angle along angle_y and along angle_x [mrad], 0.001 to
    height_mrad                           3000. Defaults: 15, 15
    angle_x_min_mrad,             float   strip: the part of the circle between these angle_x [mrad]
    angle_x_max_mrad
    angle_x_mrad, angle_y_mrad    float   circle, ring, sector, rectangle: centre [mrad], -3000 to 3000. Default: 0
    vertices_mrad                 string  polygon: corners ``angle_x angle_y, angle_x angle_y, ...`` [mrad], at least
                                          three; its edges must not cross, touch or overlap
    pixel_name                    string  Name in the result. Default: ``pixel`` (numbered by ``multipixel_receiver``)
    altitude, off_nadir_deg, ...          As for ``lidar_transmitter``, when used alone
    aperture_area, obscuration,           As for ``multipixel_receiver``, when used alone
    blur_mrad, ...
    ============================  ======  ==============================================================================

    Nested in ``multipixel_receiver`` only the shape and the name are used: pose, aperture, losses and blur are the
    receiver's. As the only sensor of a scene it is a receiver with one pixel.

    .. code-block:: xml

        <sensor type="pixel_fov">
            <string name="shape" value="ring"/>
            <float name="field_of_view_mrad" value="30"/>
            <float name="inner_mrad" value="10"/>
            <film type="time_gated_film"/>
        </sensor>

    .. code-block:: python

        {'type': 'pixel_fov', 'shape': 'ring', 'field_of_view_mrad': 30.0, 'inner_mrad': 10.0,
         'film': {'type': 'time_gated_film'}}
    """

    def __init__(self, props: RecordedProperties) -> None:
        self.field = _field(props)
        self.pixel_name = str(props.get("pixel_name", ""))
        level = mi.log_level()
        # Mitsuba gives a sensor without film, as a nested one, its own and warns of its format.
        mi.set_log_level(mi.LogLevel.Error)
        try:
            super().__init__(props, ShapedPixels([self.field], [self.pixel_name or "pixel"]))
        finally:
            mi.set_log_level(level)

    def to_string(self) -> str:
        """Return a description."""
        return f"PixelFov[{self.field}]"


def _field(props: mi.Properties) -> FovShape:
    """Build the shape from the plugin's parameters."""

    def mrad(name: str, default: float) -> float:
        return 1e-3 * ranged(name, props.get(name, default))

    shape = props.get("shape", "circle")
    centre = (mrad("angle_x_mrad", 0.0), mrad("angle_y_mrad", 0.0))
    if shape in ("circle", "ring", "sector"):
        outer = 0.5e-3 * ranged("field_of_view_mrad", props.get("field_of_view_mrad", 30.0))
        if shape == "circle":
            return Sector(outer, centre=centre)
        inner = 0.5e-3 * in_range("inner_mrad", props.get("inner_mrad", 0.0), 0.0, 2e3 * outer * (1 - 1e-6))
        if shape == "ring":
            return Sector(outer, inner, centre=centre)
        start = np.deg2rad(finite("start_deg", props.get("start_deg", 0.0)))
        extent = np.deg2rad(in_range("extent_deg", props.get("extent_deg", 360.0), 1e-3, 360.0))
        return Sector(outer, inner, start, extent, centre)
    if shape == "rectangle":
        width = 0.5e-3 * ranged("width_mrad", props.get("width_mrad", 15.0))
        height = 0.5e-3 * ranged("height_mrad", props.get("height_mrad", 15.0))
        return Rectangle(centre[0] - height, centre[0] + height, centre[1] - width, centre[1] + width)
    if shape == "strip":
        radius = 0.5e-3 * ranged("field_of_view_mrad", props.get("field_of_view_mrad", 30.0))
        edge = 1e3 * radius
        low = in_range("angle_x_min_mrad", props.get("angle_x_min_mrad", -edge), -1e6, edge * (1 - 1e-6))
        least = max(low, -edge) * (1 + 1e-6) + 1e-9
        high = in_range("angle_x_max_mrad", props.get("angle_x_max_mrad", edge), least, 1e6)
        return Strip(radius, 1e-3 * low, 1e-3 * high)
    if shape == "polygon":
        text = str(props.get("vertices_mrad", ""))
        numbers = finite_array("vertices_mrad", text.replace(",", " ").split())
        if numbers.size % 2 or numbers.size < 6:
            raise UserError(f"vertices_mrad = {text!r} must hold pairs 'angle_x angle_y' of at least three corners")
        return Polygon(1e-3 * numbers.reshape(-1, 2))
    raise UserError(f"shape = {shape!r} must be one of circle, ring, sector, rectangle, strip, polygon")


mi.register_sensor("pixel_fov", recorded(PixelFov))
