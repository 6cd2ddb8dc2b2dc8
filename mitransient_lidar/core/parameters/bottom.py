"""Parameters of the bottom, of target surfaces, and of daylight."""

from __future__ import annotations

from mitransient_lidar.core.parameters.fields import AUTO, count, file, nested, number, plugin, text
from mitransient_lidar.core.parameters.lidar import LARGEST_COORDINATE

# A parameter a row, which the formatter would spread over five.
# fmt: off

SEABED = plugin(
    "seabed",
    number("depth", None, "m", 0, 1e5, "Depth at x = y = 0, above 0; with a height map from 0, added to its depths",
        otherwise="``8``, or ``0`` with a height map"),
    number("slope_x_deg", 0.0, "degree", -45, 45, "Tilt: positive where the bottom rises towards +x"),
    number("slope_y_deg", 0.0, "degree", -45, 45, "Tilt towards +y"),
    number("curvature", 0.0, "1/m", -1, 1,
        "Curvature of a bowl about the centre, negative for a mound; it ends half of ``refined_size`` from the centre"),
    number("ripple_height", 0.0, "m", 0, float("inf"),
        "Height of sand ripples, trough to crest, at most 0.3 of their length; 0 for none"),
    number("ripple_length", 0.2, "m", 0, float("inf"), "Distance of their crests", above=True),
    number("ripple_bearing_deg", 0.0, "degree", -3600, 3600, "Direction across the crests, from +x to +y"),
    file("filename",
        "Height map above the mean sea level: .npy, .npz, .exr, .nc, an ESRI ASCII grid (.asc), a GeoTIFF (.tif), a "
        "Bathymetric Attributed Grid (.bag), or points (.xyz, .csv, .txt)"),
    number("map_size", None, "m", 0, 1e6, "Side along x of a height map that carries no positions", above=True),
    text("map_values", None, "``heights``, positive up, or ``depths``, positive down", ("heights", "depths"),
        otherwise="what the file states, or ``heights``"),
    text("map_unit", None,
        "Unit of the values where the file does not state it: ``m``, ``cm``, ``km``, ``ft``, ``ftUS`` (US survey foot) "
        "or ``fathom``", otherwise="``m``"),
    number("map_no_data", None, "", float("-inf"), float("inf"),
        "Value of cells without a height where the file does not declare it"),
    text("map_holes", None, "``refuse`` cells without a value, or ``fill`` them from the nearest cell",
        otherwise="``refuse``"),
    number("map_cell", None, "m", 0, float("inf"), "Cell of the grid on which points are interpolated", above=True,
        otherwise="their own grid, or their mean spacing"),
    number("origin_x", None, "m", float("-inf"), float("inf"),
        "Point of the map, in its coordinates in metres, that lies at x = y = 0",
        otherwise="the ``origin`` of a flight, else the map centre, for .asc, .tif, .bag, points; positions in other "
        "files are scene coordinates"),
    number("origin_y", None, "m", float("-inf"), float("inf"), "Its y, given together"),
    number("reflectance", 0.1, "1", 0, 1, "Lambertian reflectance"),
    text("patches", "",
        'Discs of another reflectance, ``"x y radius reflectance; ..."`` in metres and 0 to 1; where they overlap the '
        'last one counts', otherwise="none"),
    number("centre_x", None, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Centre of the finely resolved square",
        otherwise="``0``, or the map's centre; ``0`` if ``refined_size`` of a map in map coordinates is given"),
    number("centre_y", None, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Its y", otherwise="as ``centre_x``"),
    number("refined_size", AUTO, "m", 0, float("inf"),
        "Its side; ``auto``: 20 m, or the map's longer side, or more for the patches", above=True),
    number("cell_size", AUTO, "m", 0, 1e4,
        "Its cell side; ``auto``: an eighth of the ripple length, an eighth of the smallest patch radius, the map's "
        "own or 0.25 m, the smallest of them", above=True),
    number("size", 1000.0, "m", 1e-3, 1e6, "Side of the bottom: cells grow outside the square"),
    nested("(nested)", "bsdf", "Any BSDF instead of the Lambertian one"),
)

SEDIMENT = plugin(
    "sediment",
    text("model", "lambertian", "Law of reflection", ("lambertian", "hapke")),
    text("reflectance", None,
        "Share of light reflected at vertical incidence, or a bottom by name: to 700 nm ``coral_sand``, "
        "``green_algae``, ``brown_algae`` or ``red_algae``; to 1100 nm ``sand``, ``wet_sand``, ``asphalt``, "
        "``concrete``, ``basalt``, ``limestone``, ``grass`` or ``rush`` (from salt marshes)",
        unit="1", low=0, high=1, otherwise="``0.1``"),
    number("wavelength_nm", 532.0, "nm", 300, 1100, "Wavelength for a reflectance by name, 400 or more"),
    number("single_scattering_albedo", None, "1", 0, 1, "hapke: particle albedo, instead of ``reflectance``"),
    number("lobe_asymmetry", 0.0, "1", 0, 0.9,
        "hapke: asymmetry *b* of the lobes in the particles' phase function; 0 for particles that scatter evenly"),
    number("backward_share", 0.5, "1", 0, 1,
        "hapke: share *s* of the lobe towards the source; (1 + c)/2 with Hapke's c"),
    number("opposition_amplitude", 1.0, "1", 0, 3, "hapke: opposition effect :math:`B_0`"),
    number("opposition_width", 0.06, "rad", 1e-3, 1, "hapke: its half width *h*"),
    alternatives=((("reflectance",), ("single_scattering_albedo",)),),
)

RETROREFLECTOR = plugin(
    "retroreflector",
    number("reflectance", 0.5, "1", 0, 1, "Reflected share of the light"),
    # 32-bit directions are accurate to a thousandth of the narrowest lobe.
    number("width_deg", 2.0, "degree", 0.01, 180,
        "Full angle between the directions where the lobe has fallen to e^-1/2 of its peak"),
    number("diffuse_share", 0.0, "1", 0, 1, "Lambertian share of the reflected light"),
)

_REFLECTANCE = number("reflectance", 0.08, "1", 0, 1, "Share of the light that a leaf reflects diffusely", by_id=True)
_TRANSMITTANCE = number("transmittance", 0.1, "1", 0, 1, "Share that it transmits diffusely", by_id=True)

LEAF = plugin(
    "leaf",
    _REFLECTANCE,
    _TRANSMITTANCE,
    number("int_ior", 1.0, "1", 1, 3,
        "Refractive index on its back, over that on its front: that of water for foam on the sea"),
)

CANOPY = plugin(
    "canopy",
    number("leaf_area_index", 2.0, "1", 0, 20, "One-sided leaf area per bottom area", above=True),
    number("height", 0.5, "m", 0, 100, "Plant height above the bottom", above=True, by_id=True),
    text("form", "blades", "``blades`` that stand on the bottom, or ``leaves`` everywhere in the layer",
        ("blades", "leaves"), by_id=True),
    number("leaf_width", 0.01, "m", 0, 10, "Width of a blade, side of a square leaf", above=True),
    number("bending_deg", 25.0, "degree", 0, 80, "Blade angle from the vertical"),
    number("bending_azimuth_deg", None, "degree", -3600, 3600,
        "Azimuth towards which they lean, from +x towards +y", otherwise="any, at random"),
    number("shoot_density", None, "1/m2", 0, 1e6, "Shoots, whose blades stand at one place", above=True,
        otherwise="blades stand alone"),
    number("depth", 8.0, "m", 0, 1e5, "Depth of a level bottom without a nested one"),
    number("centre_x", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Centre of the square with plants",
        by_id=True),
    number("centre_y", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Its y", by_id=True),
    number("size", 10.0, "m", 0, 1e4, "Its side", above=True, by_id=True),
    count("seed", 1, 0, 2**31 - 1, "Seed of their places", by_id=True),
    _REFLECTANCE,
    _TRANSMITTANCE,
    nested("(nested)", "shape, bsdf", "A ``seabed`` on which they stand; any BSDF instead of ``leaf``"),
)

#: Light shares that Mitsuba's BSDFs reflect or transmit.
OF_MITSUBA = tuple(
    number(f"{part}{share}", None, "1", 0, 1, "Share of the light")
    for part in ("", "diffuse_", "specular_") for share in ("reflectance", "transmittance")
)

_INFINITE = float("-inf"), float("inf")

GRAM_CHARLIER_DIELECTRIC = plugin(
    "gram_charlier_dielectric",
    number("variance_u", 0.01, "1", 1e-6, 1, "Slope variance along the texture coordinate u"),
    number("variance_v", 0.01, "1", 1e-6, 1, "Slope variance across it"),
    *(
        number(name, 0.0, "1", *_INFINITE, f"{meaning} of the series; all are 0 for Gaussian slopes")
        for name, meaning in zip(("c21", "c03", "c40", "c22", "c04"), 5 * ("Term",), strict=True)
    ),
    number("int_ior", 1.34, "1", 1, 3, "Refractive index inside"),
    number("ext_ior", 1.0, "1", 1, 3, "Refractive index outside"),
)

_WAVELENGTH = number("wavelength_nm", 532.0, "nm", 300, 1100,
    "Wavelength of the light; the clear-sky irradiance is known from 510 to 540 nm")

_OF_A_CLEAR_SKY = "the clear-sky value at 532 nm (`physics.lidar.clear_sky.clear_sky_irradiance`)"

SUN = plugin(
    "sun",
    number("zenith_deg", 40.0, "degree", 0, 89, "Angle of the sun's centre from the vertical"),
    number("azimuth_deg", 0.0, "degree", -3600, 3600,
        "Its azimuth, from +x (the receiver's viewing direction) towards +y"),
    number("irradiance", None, "W m-2 nm-1", 0, 1e6, "Irradiance at the sea on a plane normal to its rays",
        otherwise=_OF_A_CLEAR_SKY),
    _WAVELENGTH,
    number("angular_radius_deg", 0.2666, "degree", 1e-3, 5, "Radius of its disc"),
)

SKY = plugin(
    "sky",
    text("distribution", "clear",
        "``clear`` (Harrison and Coombes 1988: bright around the sun and at the horizon), ``overcast`` (Moon and "
        "Spencer 1942: three times as bright at the zenith as at the horizon), or ``uniform``",
        ("clear", "overcast", "uniform")),
    number("irradiance", None, "W m-2 nm-1", 0, 1e6, "Irradiance at the sea on a level plane",
        otherwise=f"for ``clear`` {_OF_A_CLEAR_SKY}; required for the others"),
    _WAVELENGTH,
    number("sun_zenith_deg", 40.0, "degree", 0, 89, "``clear``: sun angle from the vertical"),
    number("sun_azimuth_deg", 0.0, "degree", -3600, 3600, "``clear``: sun azimuth, from +x towards +y"),
)
