"""Optical properties and scene parameters of a water, from its type or a measured quantity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated
from xml.sax.saxutils import quoteattr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, checked
from mitransient_lidar.core.validation import ArrayLike, FloatArray
from mitransient_lidar.physics.water import seawater, water_types
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters, petzold_water
from mitransient_lidar.physics.water.profiles import Profile, read_profile
from mitransient_lidar.physics.water.water_types import water_of

#: Maps angles [rad] to p [1/sr].
PhaseFunction = Callable[[ArrayLike], FloatArray]

REPORTED_KINDS = ("jerlov", "chlorophyll", "kd", "secchi", "petzold", "profile", "pure")

DEFAULT_TOLERANCE = 0.01  #: Default ``profile_tolerance`` of the medium ``layered_water``.

#: Uncertainty of each kind's properties.
_CAUTION = {
    "jerlov": "bb is that of typical particles and uncertain by a third in the ocean, by half at the coast",
    "chlorophyll": "the scattering of individual waters differs by a factor of 2",
    "kd": "Kd determines the scattering within a factor of 2 only",
    "secchi": "the Secchi depth determines the properties within a factor of 2 only",
    "petzold": "measured at 514 to 530 nm; rendered with a Fournier-Forand function of the same bb/b",
    "pure": "natural waters contain particles, which scatter more",
}

#: Figure titles, by kind.
_TITLES = {
    "jerlov": "Jerlov's water type {}",
    "chlorophyll": "chlorophyll {} mg/m³",
    "kd": "Kd {} 1/m",
    "secchi": "Secchi depth {} m",
    "petzold": "Petzold's water {}",
    "pure": "pure sea water",
}


@checked
def describe_water(
    kind: Annotated[str, Option("What is known of the water", form="|".join(REPORTED_KINDS), is_argument=True)],
    value: Annotated[
        str | None,
        Option(
            "Jerlov type, chlorophyll [mg/m^3], Kd [1/m], Secchi depth [m], Petzold's clear, coastal or turbid, or a "
            "profile's file: .csv, .txt, .dat, .tsv or .nc",
            form="VALUE",
            is_argument=True,
        ),
    ] = None,
    wavelength_nm: Annotated[
        float,
        Option("Wavelength; green for Jerlov and Petzold waters, or 700 or more", 400, 1100, "nm", flag="--wavelength"),
    ] = 532.0,
    temperature: Annotated[float, Option("Temperature, for the indices", 0, 30, "degrees Celsius")] = 20.0,
    salinity: Annotated[float, Option("Salinity, for the indices", 0, 40, "per mille")] = 35.0,
    tolerance: Annotated[
        float, Option("Largest relative error of layers that replace a profile", 1e-5, 0.5)
    ] = DEFAULT_TOLERANCE,
) -> list[str]:
    """Return lines with the properties of a water and the parameters to render it.

    Parameters
    ----------
    kind, value, wavelength_nm, temperature, salinity
        As for `water_of`; or the kind ``profile`` and the path of a file for `profiles.read_profile`.

    Raises
    ------
    UserError
        As for `water_of`, or if the file cannot be read.
    """
    index = float(seawater.refractive_index(wavelength_nm, temperature, salinity))
    group = float(seawater.group_index(wavelength_nm, temperature, salinity))
    if kind == "profile":
        return _describe_profile(_given(kind, value), tolerance, index, group)
    found = water_of(kind, value, wavelength_nm, temperature, salinity)
    rows = {
        "absorption a (1/m)": found.absorption,
        "scattering b (1/m)": found.scattering,
        "of it by molecules bw (1/m)": found.water_scattering,
        "backscattering bb (1/m)": found.backscattering,
        "attenuation c (1/m)": found.attenuation,
        "albedo b/c": found.albedo,
        "bb/b": found.backscatter_ratio,
        "bb/b of the particles": found.particle_backscatter_ratio,
        "diffuse attenuation Kd (1/m)": found.kd,
        "refractive index": index,
        "group index": group,
    }
    parameters = {name: getattr(found, name) for name in ("attenuation", "scattering", "backscattering")}
    parameters |= {"refractive_index": index, "group_index": group}
    if wavelength_nm != 532:
        parameters["wavelength_nm"] = wavelength_nm
    if found.water_scattering > 0:
        parameters["water_scattering"] = found.water_scattering
    options = " ".join(f"-D {name}={number:.6g}" for name, number in parameters.items())
    return [
        *(f"{name:<30}{number:.5g}" for name, number in rows.items()),
        f"Note: {_CAUTION[kind]}.",
        f"mitransient-lidar render table1 {options}",
    ]


def phase_function_of(
    kind: str, value: str | None, found: water_types.InherentProperties
) -> tuple[PhaseFunction, str, str]:
    """Return a water's phase function as rendered, or as measured, its label, and a title.

    `found` are the water's properties from `water_of`.
    """
    ratio = f"bb/b = {found.backscatter_ratio:.3g}"
    phase: PhaseFunction
    if kind == "pure":
        phase, label = seawater.water_phase_function, f"pure sea water, {ratio}"
    elif kind == "petzold":
        phase, label = petzold_water(_given(kind, value)), f"measured, {ratio}"
    else:
        phase, label = _particles_and_molecules(found), f"Fournier-Forand and molecules, {ratio}"
    properties = f"a = {found.absorption:.3g}, b = {found.scattering:.3g}, bb = {found.backscattering:.3g} 1/m"
    return phase, label, f"{_TITLES[kind].format(value)}  ·  {properties}"


def fournier_forand_of(backscatter_ratio: float) -> PhaseFunction:
    """Return the Fournier-Forand function of a bb/b, which maps angles [rad] to p [1/sr]; reject an impossible bb/b."""
    n, mu = fournier_forand_parameters(backscatter_ratio)
    return lambda theta: fournier_forand(theta, n, mu)


def _particles_and_molecules(found: water_types.InherentProperties) -> PhaseFunction:
    """Return the phase function of particles with a Fournier-Forand function and of molecules, by their scattering."""
    particles, share = fournier_forand_of(found.particle_backscatter_ratio), found.water_scattering / found.scattering
    return lambda theta: (1 - share) * particles(theta) + share * seawater.water_phase_function(theta)


def profile_of(file: str | None) -> Profile:
    """Read the file of a profile, which must be given; raises as `profiles.read_profile`."""
    return read_profile(_given("profile", file))


def _describe_profile(file: str, tolerance: float, index: float, group: float) -> list[str]:
    profile = read_profile(file)
    layers = profile.layers(tolerance)
    bottom = float(profile.depth[-1])
    rows = {
        "depth (m)": _span(profile.depth),
        "absorption a (1/m)": _span(profile.absorption),
        "scattering b (1/m)": _span(profile.scattering),
        "attenuation c (1/m)": _span(profile.attenuation),
        "bb/b": _ratio_span(profile),
        f"optical depth to {bottom:.5g} m": f"{float(layers.cumulative(bottom)):.5g}",
        f"layers within {100 * tolerance:.3g} %": str(layers.count),
        "refractive index": f"{index:.5g}",
        "group index": f"{group:.5g}",
    }
    # An absolute path, since a scene may be rendered in another folder.
    element = f'<string name="profile" value={quoteattr(str(Path(file).absolute()))}/>'
    if tolerance != DEFAULT_TOLERANCE:
        element += f' <float name="profile_tolerance" value="{tolerance:g}"/>'
    return [
        *(f"{name:<30}{text}" for name, text in rows.items()),
        "Put into the medium of a scene instead of layer_tops, attenuation, scattering and backscattering:",
        element,
    ]


def _span(values: FloatArray) -> str:
    low, high = f"{values.min():.5g}", f"{values.max():.5g}"
    return low if low == high else f"{low} to {high}"


def _ratio_span(profile: Profile) -> str:
    """Return the range of bb/b where there is scattering; its extremes lie at nodes."""
    scatters = profile.scattering > 0
    if not scatters.any():
        return "none, nothing scatters"
    return _span(profile.backscattering[scatters] / profile.scattering[scatters])


def _given(kind: str, value: str | None) -> str:
    if value is None:
        raise UserError(f"value is missing: {kind} needs one")
    return value
