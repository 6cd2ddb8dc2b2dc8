"""Parameters of water and its phase functions."""

from __future__ import annotations

from typing import Any

from mitransient_lidar.core.parameters.fields import Parameter, file, nested, number, numbers, plugin, text
from mitransient_lidar.core.parameters.lidar import LARGEST_COORDINATE

# A parameter a row, which the formatter would spread over five.
# fmt: off


def _of_layers(name: str, default: float | str | None, meaning: str, **more: Any) -> Parameter:
    return numbers(name, default, "1/m", 0, 1000, meaning, **more)


def _water(name: str, meaning: str, unit: str = "") -> Parameter:
    return text(name, None, meaning, may_be_empty=True, unit=unit)


_NOT_GREEN = "outside 510 to 540 nm that at ``wavelength_nm`` (`physics.water.seawater`), 400 to 1100 nm"

#: Coefficients of layers, and waters by name in their place.
COEFFICIENTS = ("attenuation", "scattering", "backscattering")
WATER_KINDS = ("jerlov", "chlorophyll", "kd", "secchi", "petzold", "pure")

LAYERED_WATER = plugin(
    "layered_water",
    numbers("layer_tops", "0", "m", 0, 1e5, "Depth of each layer's upper edge, first 0, increasing: ``0, 3``"),
    _of_layers("attenuation", 0.3, "Beam attenuation c of each layer, or one value for all", of_green=True),
    _of_layers("scattering", 0.15, "Scattering b, at most c", of_green=True),
    _of_layers("backscattering", 0.006, "Backscattering bb, at most b", of_green=True),
    _water("jerlov",
        "Instead of the three coefficients, the water's type: ``I``, ``IA``, ``IB``, ``II``, ``III``, ``1C``, ``3C``, "
        "``5C``, ``7C`` or ``9C``"),
    _water("chlorophyll", "Or its chlorophyll, 0.01 to 30 mg/m^3 (Case 1 water)", "mg m-3"),
    _water("kd", "Or its diffuse attenuation Kd, 0.0486 to 0.738 1/m", "1/m"),
    _water("secchi", "Or its Secchi depth, 0.5 to 25 m", "m"),
    _water("petzold",
        "Or Petzold's ``clear``, ``coastal``, ``turbid``, or a station of the phase function ``petzold``"),
    _water("pure", "Or ``true``: sea water without particles, whose scattering is ``water_scattering``"),
    number("wavelength_nm", None, "nm", 300, 1100,
        "Wavelength of these waters: 532, or 400 to 700 for ``chlorophyll`` and ``pure``, 514 to 533 for "
        "``petzold``, 700 to 1100 for all but a profile; or of the columns in a profile that has several, such as "
        "``a488, a532``",
        otherwise="``532``, or the wavelength of the only columns"),
    number("coefficients_nm", None, "nm", 531, 533,
        "Wavelength of coefficients given as numbers, or of a profile, 532: above 700 nm, water that absorbs like pure "
        "water there is made of them", otherwise="``wavelength_nm``"),
    file("profile",
        "A file instead of the above, with ``depth`` or ``z``, two of ``a``, ``b``, ``c``, ``omega``, and ``bb`` or "
        "``bb_ratio``: a table with units in its heading (.csv, .txt, .dat, .tsv) or .nc (`physics.water.profiles`)",
        may_be_empty=True),
    number("profile_tolerance", 0.01, "1", 1e-5, 0.5,
        "Largest relative error of the layers that approximate the profile"),
    text("phase_function", "fournier_forand", "``fournier_forand``: each layer's from its bb/b",
        ("fournier_forand", "petzold", "hg")),
    number("phase_g", 0.924, "1", -0.999, 0.999, "hg: mean cosine"),
    _of_layers("water_scattering", None, "Scattering by water molecules, a part of b, in each layer or all",
        otherwise="``0``, for phase functions that include it; 0.00196 at 532 nm in a water by ``jerlov``, "
        "``chlorophyll``, ``kd`` or ``secchi`` whose particles have Fournier-Forand functions; all of b in ``pure``"),
    numbers("chi_p", None, "1", 0.1, 10,
        "bb/(2 pi p(180 deg) b) of the particles, in each layer or all: less means a brighter water echo",
        otherwise="the phase function's value, 0.94 to 1.09 for ``fournier_forand``, 0.90 for ``petzold``"),
    nested("(nested)", "phase",
        "Any phase function, used in all layers instead; or one per layer, named ``phase_0``, ``phase_1``, ... from "
        "the top; ``plume_phase`` belongs to the bubbles"),
    numbers("refractive_index", 1.34, "1", 1.0001, 2, "Phase index of each layer or all", may_be_empty=False,
        of_green=True, otherwise=f"``1.34``; {_NOT_GREEN}"),
    numbers("group_index", 1.364, "1", 1, 2, "Group index of each layer or all", may_be_empty=False, of_green=True,
        otherwise=f"``1.364``, for sea water at 532 nm; {_NOT_GREEN}"),
    number("plume_scattering", 0.0, "1/m", 0, 1000,
        "Scattering of bubbles behind a ship, added to b; 0 for no bubbles"),
    number("plume_x", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Start of the bubbles, at the stern"),
    number("plume_y", 0.0, "m", -LARGEST_COORDINATE, LARGEST_COORDINATE, "Its y"),
    number("plume_bearing_deg", 0.0, "degree", -3600, 3600, "Ship heading, from +x to +y"),
    number("plume_length", 200.0, "m", 1e-3, 1e6, "Length of the plume"),
    number("plume_width", 8.0, "m", 1e-3, 1e6, "Width of the plume"),
    number("plume_depth", 2.0, "m", 0.01, 100, "Plume depth below the mean sea level"),
    number("plume_backscatter_ratio", 0.02, "1", 1e-4, 0.4,
        "bb/b of bubbles for a Fournier-Forand function; the default lies between clean bubbles and coated ones "
        "(Zhang, Lewis and Johnson 1998, doi:10.1364/AO.37.006525)"),
    number("bubble_wind_speed", 0.0, "m s-1", 0, 20,
        "Wind speed 10 m above the sea whose bubbles lie below it; 0 for no bubbles"),
    number("bubble_void_fraction", None, "1", 0, 1e-3,
        "Their void fraction at the surface, instead of the one by wind", may_be_empty=True),
    number("bubble_depth", None, "m", 0.05, 20, "Depth at which it has fallen to 1/e, instead of the one by wind",
        may_be_empty=True),
    number("bubble_backscatter", 233.0, "m-1 sr-1", 100, 1445,
        "Volume scattering at 180 degrees over void fraction: 233 for clean bubbles, 1445 for a thick coating "
        "(Churnside 2010, doi:10.1364/OE.18.008294)"),
    alternatives=(
        (COEFFICIENTS, *((each,) for each in WATER_KINDS), ("profile",)),
        (("layer_tops",), ("profile",)),
    ),
)

FOURNIER_FORAND = plugin(
    "fournier_forand",
    number("backscatter_ratio", 0.0183, "1", 3.4e-8, 0.4999, "Backscattered share of the scattering bb/b"),
    number("refractive_index", None, "1", 1.0001, 2,
        "Instead, with ``junge_slope``: index of the particles relative to water"),
    number("junge_slope", None, "1", 3.0001, 4.9999, "With it: slope of the particle size distribution"),
)

MEASURED_PHASE = plugin(
    "measured_phase",
    file("filename",
        "Text file with two columns: scattering angle [deg], increasing, at least 10, the last 170 or more; and "
        "value in any unit, such as a volume scattering function: the values are normalised, with a warning where "
        "their integral is not 1 within 2 %"),
)

PETZOLD = plugin(
    "petzold",
    text("water", "average_particle",
        "Average particle, or one of the measured waters ``clear`` (ocean off the Bahamas, bb/b 0.044), ``coastal`` "
        "(off California, 0.013), ``turbid`` (San Diego harbour, 0.020), ``autec_7`` (0.025), ``autec_9`` (0.038), "
        "``haoce_5`` (0.014), ``nuc_2200`` (0.019) and ``nuc_2240`` (0.018)"),
)

SEA_WATER = plugin(
    "sea_water",
    number("depolarisation", 0.039, "1", 0, 0.2,
        "Depolarisation ratio of light scattered at 90 degrees, 0 for Rayleigh's function; the default is from "
        "Zhang, Hu and He 2009, doi:10.1364/OE.17.005698"),
)

TWO_TERM_HENYEY_GREENSTEIN = plugin(
    "two_term_henyey_greenstein",
    number("weight", 0.98, "1", 0, 1, "Share of the forward lobe"),
    number("g_forward", 0.9, "1", 0, 0.999, "Asymmetry of the forward lobe"),
    number("g_backward", 0.3, "1", 0, 0.999, "Asymmetry of the backward lobe, as a positive number"),
)
