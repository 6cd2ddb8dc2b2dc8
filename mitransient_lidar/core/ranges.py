"""Physical ranges of the parameters of plugins, by name: wide enough for every instrument and water."""

from __future__ import annotations

from mitransient_lidar.core.validation import finite, in_range, non_negative, positive

#: Largest coordinate of a place [m], for maps in metres: the loader makes places relative to the lidar's aim.
LARGEST_COORDINATE = 1e7

_PLACE = (-LARGEST_COORDINATE, LARGEST_COORDINATE)
_LENGTH = (1e-3, 1e6)
_VIEW_MRAD = (1e-3, 3000.0)  # full angles, short of half the sphere
_BEAM_MRAD = (1e-3, 2000.0)
_TIME_NS = (-1e9, 1e9)
_DURATION_NS = (1e-6, 1e9)
_PER_METRE = (0.0, 1000.0)

#: Lowest and highest value of each parameter, in the unit of its name, else in m, m^2, 1/m or s.
RANGES: dict[str, tuple[float, float]] = {
    "altitude": (-1000.0, 1e6),  # of a lidar; negative under water
    **dict.fromkeys(("aim_x", "aim_y", "centre_x", "centre_y", "plume_x", "plume_y", "wake_x", "wake_y"), _PLACE),
    "pulse_energy_mj": (1e-9, 1e6),
    "pulse_fwhm_ns": (1e-4, 1e6),
    **dict.fromkeys(("divergence_mrad", "divergence_fwhm_mrad", "divergence_1e2_mrad"), _BEAM_MRAD),
    **dict.fromkeys(("divergence_across_mrad", "profile_mrad"), _BEAM_MRAD),
    **dict.fromkeys(("field_of_view_mrad", "width_mrad", "height_mrad"), _VIEW_MRAD),
    **dict.fromkeys(("angle_x_mrad", "angle_y_mrad"), (-3000.0, 3000.0)),
    **dict.fromkeys(("focal_length_mm", "pixel_pitch_um"), (1e-3, 1e6)),
    "aperture_area": (1e-12, 1000.0),
    "response_time_ns": (0.0, 1e6),
    **dict.fromkeys(("time_start_ns", "gate_start_ns"), _TIME_NS),
    "bin_width_ns": (1e-6, 1e6),
    "gate_start_depth": (-1e5, 1e5),
    **dict.fromkeys(("gate_width_ns", "gate_step_ns"), _DURATION_NS),
    **dict.fromkeys(("gate_rise_ns", "gate_fall_ns"), (0.0, 1e9)),
    **dict.fromkeys(("cell_size", "point_spacing"), (0.0, 1e4)),
    **dict.fromkeys(("layer_tops", "depth", "water_depth"), (0.0, 1e5)),
    **dict.fromkeys(("attenuation", "scattering", "backscattering"), _PER_METRE),
    **dict.fromkeys(("water_scattering", "plume_scattering"), _PER_METRE),
    "chi_p": (0.1, 10.0),
    **dict.fromkeys(("size", "refined_size", "map_size", "plume_length", "plume_width"), _LENGTH),
    "irradiance": (0.0, 1e6),
    "time": (-1e9, 1e9),
}

#: Range of other angles, whose names end in _deg.
_ANY_ANGLE_DEG = (-3600.0, 3600.0)


def limits(name: str) -> tuple[float, float] | None:
    """Return lowest and highest value of a parameter, or None if it has no range here."""
    return RANGES.get(name, _ANY_ANGLE_DEG if name.endswith("_deg") else None)


def ranged(name: str, value: object) -> float:
    """Return a parameter of a plugin as a float within its range in `RANGES`; else raise ``UserError``."""
    low, high = RANGES[name]
    check = positive if low > 0 else non_negative if low == 0 else finite
    return in_range(name, check(name, value), low, high)


#: Units of parameters of plugins and scenes by the ends of their names.
_UNIT_OF_END = {
    **{"_ns": "ns", "_mrad": "mrad", "_deg": "degree", "_nm": "nm", "_mj": "mJ", "_mm": "mm", "_um": "um"},
    **{"_reflectance": "1", "_seed": "1", "_count": "1", "_x": "m", "_y": "m", "_depth": "m", "_height": "m"},
    **{"_size": "m", "_length": "m", "_width": "m"},
}

_UNITS = {
    **dict.fromkeys(("altitude", "layer_tops", "depth_left", "depth_middle", "depth_right"), "m"),
    **dict.fromkeys(("depth", "size", "secchi", "surface_shortest_wave", "point_spacing"), "m"),
    **dict.fromkeys(("attenuation", "scattering", "backscattering", "water_scattering"), "1/m"),
    **dict.fromkeys(("plume_scattering", "kd"), "1/m"),
    **dict.fromkeys(("wind_speed", "wake_speed", "bubble_wind_speed"), "m s-1"),
    **dict.fromkeys(("refractive_index", "group_index", "phase_g", "chi_p", "slope_variance"), "1"),
    **dict.fromkeys(("optical_efficiency", "two_way_atmospheric_transmittance", "pulses"), "1"),
    **dict.fromkeys(("lobe_asymmetry", "backward_share", "opposition_amplitude", "bubble_void_fraction"), "1"),
    "opposition_width": "rad",
    "aperture_area": "m2",
    "chlorophyll": "mg m-3",
    **dict.fromkeys(("time", "surface_time"), "s"),
}


def unit_of(name: str) -> str | None:
    """Return the unit of a parameter of a plugin or a shipped scene; None for texts and other names."""
    end = next((unit for end, unit in _UNIT_OF_END.items() if name.endswith(end)), None)
    return _UNITS.get(name, end)
