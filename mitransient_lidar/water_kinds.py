"""Ways in which people know their water, as optical properties and as parameters of a scene."""

from __future__ import annotations

from mitransient_lidar.errors import UserError
from mitransient_lidar.optics import known_waters, seawater

KINDS = ("jerlov", "chlorophyll", "kd", "secchi", "pure")

#: How well each kind is known to stand for the water's own properties.
_CAUTION = {
    "jerlov": "bb follows from Kd and is uncertain by half",
    "chlorophyll": "single waters scatter twice or half as much",
    "kd": "a Kd leaves the scattering open by a factor of 2",
    "secchi": "a Secchi depth is a rough way in: a factor of 2",
    "pure": "natural waters hold particles, which scatter more",
}


def water_of(
    kind: str, value: str | None, wavelength_nm: float, temperature: float, salinity: float
) -> known_waters.InherentProperties:
    """Return the inherent optical properties of a water.

    Parameters
    ----------
    kind
        ``jerlov``, ``chlorophyll``, ``kd``, ``secchi`` or ``pure``.
    value
        Jerlov's type (``I`` to ``9C``), chlorophyll [mg/m^3], Kd [1/m] or Secchi depth [m]; None for pure sea water.
    wavelength_nm, temperature, salinity
        Wavelength [nm], temperature [deg C] and salinity [per mille].

    Raises
    ------
    UserError
        When the kind is unknown, the value missing or not a number.
    ValueError
        When a value is out of range.
    """
    if kind not in KINDS:
        raise UserError(f"kind = {kind!r} must be one of {', '.join(KINDS)}")
    if kind == "pure":
        if value is not None:
            raise UserError(f"value = {value!r} must be left out for pure sea water")
        return known_waters.pure_seawater(wavelength_nm, temperature, salinity)
    if value is None:
        raise UserError(f"value is missing: {kind} needs one")
    if kind == "jerlov":
        return known_waters.jerlov(value, wavelength_nm)
    try:
        number = float(value)
    except ValueError:
        raise UserError(f"value = {value!r} must be a number for {kind}") from None
    if kind == "chlorophyll":
        return known_waters.chlorophyll(number, wavelength_nm)
    if wavelength_nm != 532.0:
        raise UserError(f"wavelength = {wavelength_nm:g} must be 532 nm for {kind}")
    return known_waters.from_kd(number) if kind == "kd" else known_waters.from_secchi(number)


def describe_water(
    kind: str, value: str | None, wavelength_nm: float, temperature: float, salinity: float
) -> list[str]:
    """Return lines that tell the properties of a water and the scene parameters that make it.

    Parameters and errors are those of `water_of`, with a UserError for a value out of range, too.
    """
    try:
        found = water_of(kind, value, wavelength_nm, temperature, salinity)
        index = float(seawater.refractive_index(wavelength_nm, temperature, salinity))
        group = float(seawater.group_index(wavelength_nm, temperature, salinity))
    except ValueError as error:
        raise UserError(str(error)) from error
    rows = {
        "absorption a (1/m)": found.absorption,
        "scattering b (1/m)": found.scattering,
        "backscattering bb (1/m)": found.backscattering,
        "attenuation c (1/m)": found.attenuation,
        "albedo b/c": found.albedo,
        "bb/b": found.backscatter_ratio,
        "diffuse attenuation Kd (1/m)": found.kd,
        "refractive index": index,
        "group index": group,
    }
    parameters = {
        "attenuation": found.attenuation,
        "scattering": found.scattering,
        "backscattering": found.backscattering,
        "refractive_index": index,
        "group_index": group,
    }
    return [
        *(f"{name:<30}{number:.5g}" for name, number in rows.items()),
        f"Note: {_CAUTION[kind]}.",
        "mitransient-lidar render table1 " + " ".join(f"-D {name}={number:.6g}" for name, number in parameters.items()),
    ]
