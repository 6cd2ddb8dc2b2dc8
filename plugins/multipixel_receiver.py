"""Sensor plugin ``multipixel_receiver``: the receiver and all its pixels."""

from __future__ import annotations

import mitsuba as mi

from mitransient_lidar.optics.checks import positive
from mitransient_lidar.transport.pixels import LayoutPixels, PixelArray, ShapedPixels
from mitransient_lidar.transport.pose import Pose
from mitransient_lidar.transport.receiving import Receiver, ReceiverOptics


class MultipixelReceiver(mi.Sensor):
    r"""Receiver with one, four or a hundred thousand pixels (``multipixel_receiver``).

    ==================================  =========  ==================================================================
    Parameter                           Type       Meaning
    ==================================  =========  ==================================================================
    layout                              string     ``1x1``, ``2x2``, ``1x4`` or ``RxC``: the field of view cut into
                                                   R rows along range (row 0 is the far edge) and C columns (column 0
                                                   is the -gy edge). ``1x4`` is the published receiver of four strips
                                                   across range, the same as ``4x1``. Default: ``2x2``
    imager                              boolean    Keep rows and columns apart in the result, (row, column, time)
                                                   instead of (pixel, time). Default: true above 16 pixels
    field_of_view_mrad                  float      Full angle of the field of view (diameter or side) [mrad], positive.
                                                   Default: 30
    field_of_view_shape                 string     ``circle`` or ``square``. Default: ``circle``
    (nested)                            sensor     ``pixel_fov`` sensors instead of layout and field of view
    aperture_area                       float      Area of the aperture [m^2], positive. Default: 0.025
    optical_efficiency                  float      Share of light that the optics pass, above 0 to 1. Default: 0.9
    two_way_atmospheric_transmittance   float      Share of light that survives the air, both ways. Default: 0.9
    response_time_ns                    float      Time constant of the exponential response [ns]. Default: 0
    altitude, off_nadir_deg, shot_x,               Pose, as for ``lidar_transmitter``
    shot_y, to_world
    (nested)                            film       ``time_gated_film``
    ==================================  =========  ==================================================================

    Angles are tangent-plane coordinates about the optical axis: +gx is away from nadir ("far"), +gy is +y. Pixels
    of a circular field of view that lie outside the circle exist and stay dark.

    Paths are drawn over the whole field of view and then given to the pixel that they fall into, so more pixels cost
    nothing and the pixels of a layout sum to the single pixel of the same field of view path by path.

    .. code-block:: xml

        <sensor type="multipixel_receiver">
            <string name="layout" value="2x2"/>
            <float name="field_of_view_mrad" value="30"/>
            <film type="time_gated_film"/>
        </sensor>

    .. code-block:: python

        {'type': 'multipixel_receiver', 'layout': '2x2', 'field_of_view_mrad': 30.0,
         'film': {'type': 'time_gated_film'}}
    """

    def __init__(self, props: mi.Properties) -> None:
        nested = [child for _, child in props.objects() if isinstance(child, mi.Sensor)]
        super().__init__(props)
        if nested:
            for name in ("layout", "field_of_view_mrad"):
                if name in props:
                    raise ValueError(f"multipixel_receiver: give nested pixel_fov sensors or {name}, not both")
            if not all(hasattr(pixel, "field") for pixel in nested):
                raise ValueError("multipixel_receiver: nested sensors must be pixel_fov")
            names = [pixel.pixel_name or f"pixel{index}" for index, pixel in enumerate(nested)]
            pixels: PixelArray = ShapedPixels([pixel.field for pixel in nested], names)
        else:
            pixels = LayoutPixels(
                str(props.get("layout", "2x2")),
                1e-3 * positive("field_of_view_mrad", props.get("field_of_view_mrad", 30.0)),
                props.get("field_of_view_shape", "circle"),
                props.get("imager", None),
            )
        self.receiver = Receiver(Pose.from_properties(props), ReceiverOptics.from_properties(props), pixels)
        self.m_needs_sample_2 = True
        self.m_needs_sample_3 = False

    def sample_ray(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Sample a ray uniformly over the field of view, for Mitsuba's own integrators."""
        return self.receiver.sensor_ray(time, sample2, active)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Return an invalid box: the sensor does not extend the scene."""
        return mi.ScalarBoundingBox3f()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose no parameters: a changed receiver is loaded anew."""

    def to_string(self) -> str:
        """Return a description."""
        return (
            f"MultipixelReceiver[origin={self.receiver.pose.origin.tolist()}, layout={self.receiver.pixels.layout}, "
            f"pixels={self.receiver.pixels.count}, field_of_view={1e3 * self.receiver.pixels.field_of_view:g} mrad]"
        )


mi.register_sensor("multipixel_receiver", lambda props: MultipixelReceiver(props))
