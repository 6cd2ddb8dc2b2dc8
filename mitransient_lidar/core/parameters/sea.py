"""Sea surface parameters."""

from __future__ import annotations

from mitransient_lidar.core.parameters.fields import AUTO, Parameter, count, file, nested, number, plugin, switch, text
from mitransient_lidar.core.parameters.lidar import DIVERGENCES, LARGEST_COORDINATE, divergences

# A parameter a row, which the formatter would spread over five.
# fmt: off

LARGEST_SIDE = 1e6  #: Longest side of a sea or a bottom [m].


def _angle(name: str, meaning: str) -> Parameter:
    return number(name, 0.0, "degree", -3600, 3600, f"{meaning}, from +x to +y")


def _length(name: str, meaning: str) -> Parameter:
    return number(name, AUTO, "m", 0, LARGEST_SIDE, meaning, above=True)


OCEAN_SURFACE = plugin(
    "ocean_surface",
    text("spectrum", "elfouhaily",
        "Elfouhaily et al. 1997; ``jonswap`` needs ``fetch``, ``height_map`` a ``filename`` of the formats of "
        "``seabed``; ``flat``: no waves, all slopes are ripples",
        ("elfouhaily", "jonswap", "pierson_moskowitz", "height_map", "flat")),
    number("wind_speed", 3.0, "m s-1", 0, 30, "Wind speed at 10 m"),
    _angle("wind_direction_deg", "Direction the wind blows towards"),
    number("fetch", None, "m", 0, float("inf"), "Distance over which the wind has blown over water", above=True),
    number("inverse_wave_age", None, "1", 0.84, 5, "Instead: inverse wave age, 0.84 when fully developed",
        otherwise="``0.84``"),
    number("peak_enhancement", 3.3, "1", 0, float("inf"), "JONSWAP's gamma", above=True),
    number("swell_height", 0.0, "m", 0, float("inf"),
        "Significant height of an added swell, at most a fifteenth of its length; 0 for none"),
    number("swell_wavelength", 60.0, "m", 0, float("inf"), "Its wavelength", above=True),
    _angle("swell_direction_deg", "Direction it travels towards"),
    text("slope_variance", "cox_munk",
        "Total slope variance of waves and ripples: ``cox_munk`` (measured, clean sea, 1954; waves below 1 m are "
        "scaled to it), ``spectrum`` (the spectrum's integral) or a number, the total for an isotropic sea",
        unit="1"),
    text("slope_distribution", "gaussian",
        "``gram_charlier``: skewed and peaked slopes, as measured by Cox and Munk from 1 to 14 m/s, with "
        "``slope_variance`` ``cox_munk``", ("gaussian", "gram_charlier")),
    text("foam", "none",
        "Share of the sea that foam covers: ``none``, a number, or by wind speed ``monahan_omuircheartaigh_1980``, "
        "``callaghan_2008`` or ``stramska_petelski_2003``", unit="1"),
    number("foam_reflectance", 0.22, "1", 0, 1,
        "Lambertian foam reflectance at 532 nm: 0.22 is the mean over whitecaps of all ages (Koepke 1984), 0.4 for "
        "fresh ones; at ``wavelength_nm`` it changes as in Frouin et al. 1996, to half of it at 1064 nm"),
    number("foam_transmittance", 0.0, "1", 0, 1,
        "Share of the light from above that foam transmits diffusely; the rest is absorbed"),
    file("foam_map",
        "Map of more foam: share of each place, 0 to 1, as a mask from a picture, in the formats of a ``seabed``"),
    number("wavelength_nm", 532.0, "nm", 300, 1100, "Wavelength for the foam reflectance"),
    number("surf_foam", 0.0, "1", 0, 1,
        "With ``foam``, the share that foam covers where the depth limits the wave height (``shoaling``); about 0.3 "
        "to 1 in surf, for which no law is published"),
    switch("ripple_focusing", True,
        "Whether echoes from the water are enhanced by the mean focusing of ripples that light crosses twice"),
    count("surface_seed", 1, 0, 2**53, "Wave seed: the same sea at any resolution and position of the patch"),
    number("time", 0.0, "s", -1e9, 1e9, "Time at which the waves are taken"),
    number("water_depth", 1e4, "m", 0, 1e5,
        "Water depth for dispersion and heights of the wind waves (TMA spectrum, Bouws et al. 1985)", above=True,
        otherwise="deep"),
    text("shoaling", "auto",
        "``bottom``: wave heights follow the TMA spectrum for the local depth of the scene's bottom, at most half of "
        "it, 0 at the water line, and ``water_depth`` is for dispersion; ``none``: waves ignore the bottom; "
        "``auto``: ``bottom`` if the significant height would exceed half of the least depth, without ``water_depth``",
        ("auto", "bottom", "none")),
    number("current_speed", 0.0, "m s-1", 0, 10, "Current that carries the waves"),
    _angle("current_direction_deg", "Direction the current flows towards"),
    number("wake_speed", 0.0, "m s-1", 0, 40, "Speed of a ship whose Kelvin wake is added, 0 for none"),
    _angle("wake_bearing_deg", "Heading of the ship"),
    number("wake_length", 20.0, "m", 1, 500, "Length of the ship"),
    number("wake_x", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Centre of the ship"),
    number("wake_y", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Its y"),
    number("slope_x_deg", 0.0, "degree", -15, 15,
        "Mean slope under the lidar: positive where the sea rises towards +x, as on a long wave"),
    number("slope_y_deg", 0.0, "degree", -15, 15, "Mean slope towards +y"),
    _length("refined_size", "Side of the finely resolved patch"),
    _length("cell_size", "Side of its cells"),
    _length("shortest_wave", "Length of the shortest waves in the mesh, at least two cells; shorter waves are ripples"),
    number("centre_x", AUTO, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE,
        "Centre of the patch; ``auto``: where the lidar's axis meets the sea, or the centre of a height map"),
    number("centre_y", AUTO, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Its y"),
    number("size", AUTO, "m", 1e-3, LARGEST_SIDE,
        "Side of the surface; ``auto``: 1000 or more. Cells grow outside the patch"),
    _length("period", "Sea period; ``auto``: three peak wavelengths or more, in steps of 32 m, at most 512 m"),
    _length("map_size", "Side of a height map or foam map that carries no positions"),
    file("filename", "File of a ``height_map``"),
    number("origin_x", None, "m", float("-inf"), float("inf"),
        "Point of these maps, in their coordinates in metres, that lies at x = y = 0",
        otherwise="the ``origin`` of a flight, else the map centre, as for a ``seabed``"),
    number("origin_y", None, "m", float("-inf"), float("inf"), "Its y"),
    number("altitude", None, "m", 0.1, 1e6,
        "Value for the choice by ``auto`` instead of the value in the scene's ``lidar_transmitter`` and receiver",
        by_id=True),
    number("off_nadir_deg", None, "degree", 0, 89.9, "The same", by_id=True),
    number("field_of_view_mrad", None, "mrad", 1e-3, 3000, "The same", by_id=True),
    *divergences(None, by_id=True),
    nested("(nested)", "bsdf", "Any BSDF instead of the ripples"),
    nested("interior", "medium", "The water: ``layered_water``"),
    alternatives=(DIVERGENCES, (("fetch",), ("inverse_wave_age",))),
)
