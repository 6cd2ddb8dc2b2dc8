"""Parameters of the transmitter, receivers and their film."""

from __future__ import annotations

from mitransient_lidar.core.parameters.fields import AUTO, Parameter, count, file, nested, number, plugin, switch, text

# A parameter a row, which the formatter would spread over five.
# fmt: off

#: Largest coordinate of a place [m], for maps in metres: the loader makes places relative to the lidar's aim.
LARGEST_COORDINATE = 1e7

_HORIZON = "0 to 89.9; under water up to 180, which is straight up"

_ALTITUDE = number(
    "altitude", 200.0, "m", -1000, 1e6, "Height above the mean sea level, 0.1 or more; negative under water"
)
_OFF_NADIR = number("off_nadir_deg", 20.0, "degree", 0, 180, f"Angle of the axis from nadir, towards +x, {_HORIZON}")
_AIM = "where the axis meets the mean sea level; under water the point of the mean sea level above the lidar"

#: A lidar's height, angle and aim.
ANGLES = (
    _ALTITUDE,
    _OFF_NADIR,
    number("aim_x", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, f"x of the point {_AIM}"),
    number("aim_y", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Its y"),
)

POSE = (
    *ANGLES,
    nested("to_world", "transform", "Instead of the four above: any position and direction, as from ``lookat``"),
)


def divergences(default: float | None, **more: bool) -> tuple[Parameter, Parameter, Parameter]:
    """Return the three ways to give a beam's width; the default belongs to the first."""
    more["may_be_empty"] = True
    return (
        number("divergence_mrad", default, "mrad", 1e-3, 2000,
            "Full angle between the points where a Gaussian beam's irradiance has fallen to e^-1/2 of its peak (its "
            "sigma is half of it); for a top-hat beam its full angle", **more),
        number("divergence_fwhm_mrad", None, "mrad", 1e-3, 2000,
            "The same beam by its full width at half maximum; give one of the three. Each is the full angle of a "
            "top-hat beam, whose irradiance falls from its peak to 0 at the edge. An empty text counts as not given",
            **more),
        number("divergence_1e2_mrad", None, "mrad", 1e-3, 2000,
            "The same beam by its full width at e^-2 of the peak. An empty text counts as not given",
            **more),
    )


#: Ways to give a width of a beam, a place and direction, and a point-spread function.
DIVERGENCES = tuple((each.name,) for each in divergences(None))
_PLACE = tuple(each.name for each in ANGLES), ("to_world",)
_BLURS = ("blur_mrad",), ("blur_file", "blur_file_mrad")

LIDAR_TRANSMITTER = plugin(
    "lidar_transmitter",
    *POSE,
    number("pulse_energy_mj", 5.0, "mJ", 1e-9, 1e6, "Energy of the emitted pulse"),
    number("optical_efficiency", 0.9, "1", 0, 1, "Share of that energy which leaves the optics", above=True),
    text("beam_profile", "gaussian", "Shape of the beam", ("gaussian", "top_hat", "image")),
    *divergences(10.0),
    number("divergence_across_mrad", None, "mrad", 1e-3, 2000,
        "Makes the beam elliptic: ``divergence_mrad`` is then the full angle along angle_x, this the one along angle_y",
        otherwise="``divergence_mrad``"),
    number("ellipse_deg", 0.0, "degree", -3600, 3600,
        "Azimuth of the ellipse axis with ``divergence_mrad``, from +angle_x (far) towards +angle_y"),
    file("profile_file",
        "``image``: measured irradiance in any unit, a grey .png, a .npy array or an .exr image about the axis. Row 0 "
        "is the far edge (+angle_x), column 0 the left one (+angle_y)"),
    number("profile_mrad", None, "mrad", 1e-3, 2000,
        "``image``: full angle from the image's left edge to its right one; its cells are squares"),
    number("wavelength_nm", 532.0, "nm", 300, 1100, "Vacuum wavelength; recorded in results"),
    number("pulse_fwhm_ns", 5.0, "ns", 1e-4, 1e6, "Full width at half maximum of a Gaussian pulse"),
    file("pulse_file",
        "Instead: text file with two columns, time [ns] and power (any unit), or in any order and unit of time below a "
        "heading such as ``t [ps], V``"),
    alternatives=(DIVERGENCES, _PLACE, (("pulse_fwhm_ns",), ("pulse_file",))),
)

OPTICS = (
    number("blur_mrad", 0.0, "mrad", 0, 1000,
        "Optical blur: standard deviation along each axis of a Gaussian point-spread function, 0 for a sharp one"),
    file("blur_file",
        "Instead: image file (as for ``pixel_map``) with a measured point-spread function in any unit, not negative, "
        "about the focus of sharp optics. Values are constant in each cell, and normalised"),
    number("blur_file_mrad", None, "mrad", 0, 1000, "Width of that image along angle_y; its cells are squares",
        above=True),
    number("aperture_area", 0.025, "m2", 1e-12, 1000, "Area of the aperture"),
    number("obscuration", 0.0, "1", 0, 0.999, "Share of that area which is blocked, as by a secondary mirror"),
    number("optical_efficiency", 0.9, "1", 0, 1, "Share of light that the optics pass", above=True),
    number("two_way_atmospheric_transmittance", 0.9, "1", 0, 1, "Share of light that the air transmits, both ways",
        above=True),
    number("response_time_ns", 0.0, "ns", 0, 1e6, "Time constant of the exponential response"),
)

_FIELD_OF_VIEW = number(
    *("field_of_view_mrad", 30.0, "mrad", 1e-3, 3000),
    "Full angle of the field of view: diameter, side, or diameter of the circle around the hexagons",
)

MULTIPIXEL_RECEIVER = plugin(
    "multipixel_receiver",
    text("layout", "2x2",
        "``1x1``, ``2x2``, ``1x4`` or ``RxC``: the field of view cut into R rows along range (row 0 is the far edge) "
        "and C columns (column 0 is the left edge). ``1x4`` is the published receiver of four strips across range, the "
        "same as ``4x1``. R times C is at most 2^22. ``hexN``, with N = 1, 7, 19, 37, ... up to 2^20: a hexagon and "
        "complete rings of hexagons around it, in rows along angle_y"),
    number("fill_factor", 1.0, "1", 0.01, 1,
        "Share of each layout cell or hexagon that receives light; the gaps receive none"),
    switch("imager", None, "Result with the shape (row, column, time) instead of (pixel, time)",
        otherwise="true above 16 pixels of ``RxC``"),
    file("pixel_map",
        "Instead of layout: image file (.png, .npy or .exr, one channel) with labels over a square field of view, "
        "integers from 0 to 2^24. Row 0 is the far edge, column 0 the left edge. Each label is a pixel, in "
        "increasing order and named ``label1``, ...; 0 is no pixel"),
    _FIELD_OF_VIEW,
    text("field_of_view_shape", None, "Of ``RxC``", ("circle", "square"),
        otherwise="``circle``, or ``square`` with a focal length"),
    number("focal_length_mm", None, "mm", 1e-3, 1e6,
        "Instead of ``field_of_view_mrad``, for ``RxC``: focal length of the lens. The field of view is then R by C "
        "times pitch over focal length, a rectangle (or, with ``circle`` and R = C, the inscribed circle)"),
    number("pixel_pitch_um", None, "um", 1e-3, 1e6, "With it: spacing of square pixels on the detector"),
    nested("(nested)", "sensor", "``pixel_fov`` sensors instead of layout and field of view"),
    *OPTICS,
    *POSE,
    nested("(nested)", "film", "``time_gated_film``"),
    alternatives=(
        _PLACE,
        _BLURS,
        (("layout", "fill_factor", "field_of_view_shape", "imager"), ("pixel_map",), ("a nested sensor",)),
        (("field_of_view_mrad",), ("focal_length_mm", "pixel_pitch_um"), ("a nested sensor",)),
        (("pixel_map",), ("focal_length_mm", "pixel_pitch_um")),
    ),
)

PIXEL_FOV = plugin(
    "pixel_fov",
    text("shape", "circle", "Angles are full angles or positions in the tangent plane about the axis",
        ("circle", "ring", "sector", "rectangle", "strip", "polygon")),
    number("field_of_view_mrad", 30.0, "mrad", 1e-3, 3000,
        "Full angle of the circle, ring, sector, or of the circle that a strip is cut from"),
    number("inner_mrad", 0.0, "mrad", 0, 3000, "ring, sector: full angle of the hole"),
    number("start_deg", 0.0, "degree", -3600, 3600, "sector: first azimuth, from +angle_x (far) towards +angle_y"),
    number("extent_deg", 360.0, "degree", 1e-3, 360, "sector: its size"),
    number("width_mrad", 15.0, "mrad", 1e-3, 3000, "rectangle: full angle along angle_y"),
    number("height_mrad", 15.0, "mrad", 1e-3, 3000, "rectangle: full angle along angle_x"),
    number("angle_x_min_mrad", None, "mrad", -1e6, 1e6, "strip: the part of the circle from this angle_x",
        otherwise="its edge"),
    number("angle_x_max_mrad", None, "mrad", -1e6, 1e6, "strip: to this one", otherwise="its edge"),
    number("angle_x_mrad", 0.0, "mrad", -3000, 3000, "circle, ring, sector, rectangle: centre along angle_x"),
    number("angle_y_mrad", 0.0, "mrad", -3000, 3000, "circle, ring, sector, rectangle: centre along angle_y"),
    text("vertices_mrad", "",
        "polygon: corners ``angle_x angle_y, angle_x angle_y, ...`` [mrad], at least three; its edges must not cross, "
        "touch or overlap"),
    text("pixel_name", "", "Name in the result", otherwise="``pixel`` (numbered by ``multipixel_receiver``)"),
    *OPTICS,
    *POSE,
    alternatives=(_PLACE, _BLURS),
)

TIME_GATED_FILM = plugin(
    "time_gated_film",
    number("time_start_ns", AUTO, "ns", -1e9, 1e9,
        "Start of the first bin after the pulse's peak leaves the transmitter; ``auto``: before the first light"),
    number("bin_width_ns", 0.5, "ns", 1e-6, 1e6, "Width of a bin"),
    count("bin_count", AUTO, 1, 1_000_000, "Number of bins; ``auto``: until after the last light"),
    count("gate_count", 0, 0, 100_000, "Number of gates, 0 for none"),
    number("gate_start_ns", None, "ns", -1e9, 1e9, "Half height of the first gate's rising edge"),
    number("gate_start_depth", None, "m", -1e5, 1e5,
        "Instead: depth below the mean sea level of the echoes that arrive at that time, on the receiver's axis"),
    number("gate_start_range", None, "m", 0, 1e9,
        "Instead: distance of these from the lidar, along the axis through air and water"),
    number("gate_width_ns", 10.0, "ns", 1e-6, 1e9, "Time between the half heights of a gate's edges"),
    number("gate_step_ns", None, "ns", 1e-6, 1e9, "Time from gate to gate", otherwise="the width"),
    number("gate_rise_ns", 0.0, "ns", 0, 1e9, "10-90 % time of a raised-cosine rising edge, 0 for a sharp one"),
    number("gate_fall_ns", 0.0, "ns", 0, 1e9, "10-90 % time of a raised-cosine falling edge, 0 for a sharp one"),
    file("gate_profile",
        "Instead of width and edges: file with two columns, time [ns] and transmission 0 to 1, or in other units "
        "below a heading that names them"),
    number("gate_jitter_ns", 0.0, "ns", 0, 1e6,
        "Standard deviation of the gate's opening from pulse to pulse; each gate is the mean over a Gaussian"),
    count("pulses", 1, 1, 10**9, "Pulses that each gate accumulates"),
    alternatives=(
        (("gate_start_ns",), ("gate_start_depth",), ("gate_start_range",)),
        (("gate_width_ns", "gate_rise_ns", "gate_fall_ns"), ("gate_profile",)),
    ),
)
