"""Absorption, scattering and backscattering of water given by type, chlorophyll, Kd or Secchi depth.

These are rough estimates: waters with the same Kd differ in scattering by a factor of 2, which changes a lidar's column
signal. Scattering is by molecules and by particles with a Fournier-Forand function. `pure_seawater` is valid from 400
to 1100 nm, `chlorophyll` from 400 to 700 nm, the others at 532 nm; `near_infrared` takes them beyond 700 nm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.parameters.water import COEFFICIENTS, LAYERED_WATER, WATER_KINDS
from mitransient_lidar.core.validation import in_range, non_negative, positive
from mitransient_lidar.physics.water import seawater
from mitransient_lidar.physics.water.layers import WaterColumn
from mitransient_lidar.physics.water.phase import PETZOLD_WATERS, petzold_water, read_columns
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.seawater import water_scattering

_CHLOROPHYLL_RANGE = (0.01, 30.0)  # mg/m^3, in the Case 1 model
_SECCHI_RANGE = (0.5, 25.0)  # m; above about 30 m the rules give less absorption than pure water has

PETZOLD_BACKSCATTER_RATIO = 0.0183
"""bb/b of Petzold's average particle (Mobley et al. 1993)."""

GREEN_RANGE = (531.0, 533.0)
"""Wavelengths [nm] accepted as 532 nm."""

#: Wavelengths [nm] at which Petzold's waters are used: from the centre of his filter to the usual laser.
_PETZOLD_RANGE = (514.0, GREEN_RANGE[1])

_DISSOLVED_SLOPE = 0.014  #: Decay of the absorption by dissolved matter with the wavelength [1/nm].
_NODES = 32768  #: Nodes of the table that integrates a measured phase function; 822 lie in the backward hemisphere.

#: b, bb and the scattering by molecules bw [1/m].
Scattered = tuple[float, float, float]

_OCEANIC_BACKSCATTER_RATIO = 0.010  #: bb/b of particles in the open ocean (Westberry et al. 2010).

#: Diffuse attenuation Kd, and scattering where it was measured [1/m], by Jerlov's types.
_JERLOV: dict[str, tuple[float, float | None]] = {
    "I": (0.0486, None),
    "IA": (0.0533, None),
    "IB": (0.0590, 0.124),
    "II": (0.0796, 0.179),
    "III": (0.1171, 0.290),
    "1C": (0.1272, 0.432),
    "3C": (0.1972, 0.651),
    "5C": (0.3072, 1.21),
    "7C": (0.4816, 2.49),
    "9C": (0.738, 3.31),
}


@dataclass(frozen=True)
class InherentProperties:
    """Inherent optical properties of water at one wavelength."""

    absorption: float  #: Absorption coefficient a [1/m], at least 0.
    scattering: float  #: Scattering coefficient b [1/m], at least `backscattering`.
    backscattering: float  #: Backscattering coefficient bb [1/m], the part into the backward hemisphere, at least 0.
    #: Scattering by water molecules [1/m], a part of `scattering`, half of which is backscattering; 0 if not known.
    water_scattering: float = 0.0

    def __post_init__(self) -> None:
        for name in ("absorption", "scattering", "backscattering", "water_scattering"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name)))
        if self.backscattering > self.scattering:
            raise UserError(
                f"backscattering = {self.backscattering:g} must not exceed scattering = {self.scattering:g}"
            )
        # The two differ by rounding in pure water.
        if self.water_scattering > min(self.scattering, 2 * self.backscattering) * (1 + 1e-12):
            raise UserError(
                f"water_scattering = {self.water_scattering:g} must not exceed scattering = {self.scattering:g} and "
                f"twice backscattering = {self.backscattering:g}"
            )

    @property
    def attenuation(self) -> float:
        """Beam attenuation coefficient c = a + b [1/m]."""
        return self.absorption + self.scattering

    @property
    def albedo(self) -> float:
        """Single-scattering albedo b/c; 0 where c is 0."""
        return self.scattering / self.attenuation if self.attenuation > 0 else 0.0

    @property
    def backscatter_ratio(self) -> float:
        """Backscattered fraction bb/b; 0 where b is 0."""
        return self.backscattering / self.scattering if self.scattering > 0 else 0.0

    @property
    def particle_backscatter_ratio(self) -> float:
        """Backscattered fraction of the scattering by particles, (bb - bw/2) / (b - bw); 0 where there are none."""
        particles = self.scattering - self.water_scattering
        return (self.backscattering - self.water_scattering / 2) / particles if particles > 0 else 0.0

    @property
    def kd(self) -> float:
        """Diffuse attenuation coefficient of downwelling irradiance [1/m], with the sun at the zenith and no waves.

        The mean down to the depth of a tenth of the irradiance just below the surface: Kd^2 = a^2 + 4.10 a^0.934
        bb_p^0.849 b_p^0.217 + 1.6 a b_w. The particles p have Fournier-Forand functions, and w are molecules. It fits a
        Monte Carlo (``oracles/diffuse_attenuation.py`` in the tests) with an error of 0.2 % rms and 0.6 % at most. This
        holds for b/a from 0.5 to 16 and bb_p/b_p from 0.003 to 0.05. The formula by Lee, Du and Arnone (2005), J.
        Geophys. Res. 110, C02016, doi:10.1029/2004JC002275, gives 0 to 2 % more in Jerlov's types I to 3C, and 4 to 7 %
        more in 5C to 9C.
        """
        return _diffuse_attenuation(self.absorption, self.scattering, self.backscattering, self.water_scattering)


def pure_seawater(
    wavelength_nm: float = 532.0, temperature: float = 20.0, salinity: float = 35.0
) -> InherentProperties:
    """Sea water without particles and dissolved organic matter; half of its scattering is backscattering.

    `wavelength_nm`, `temperature`, `salinity`: as in `seawater.water_scattering`: [nm], [degrees C], [per mille].
    """
    b = float(water_scattering(wavelength_nm, temperature, salinity))
    return InherentProperties(float(seawater.water_absorption(wavelength_nm)), b, b / 2, b)


def jerlov(water_type: str, wavelength_nm: float = 532.0) -> InherentProperties:
    """Water with one of Jerlov's optical types at 532 nm, with Jerlov's Kd.

    `water_type`: I, IA, IB, II or III in the open ocean, 1C, 3C, 5C, 7C or 9C at the coast. `wavelength_nm`: wavelength
    [nm], 531 to 533: the table is for 532 nm only.

    Raises `UserError` if there is no such type.

    Kd: Jerlov (1976), Marine Optics, Table XXVII. Scattering in IB to 5C: measurements compiled by Williamson and
    Hollins (2022), Appl. Opt. 61, 9951; in 7C and 9C: Solonenko and Mobley (2015), Appl. Opt. 54, 5392,
    doi:10.1364/AO.54.005392, who derived it from Kd. No source gives the backscattering. In types IB to III the
    particles' bb/b is 0.010, as Westberry et al. (2010), Opt. Express 18, 15419, doi:10.1364/OE.18.015419, measured in
    the open ocean, with a scatter of 0.002. At the coast it is 0.0183, as for Petzold's average particle. Absorption
    then follows from Kd (`InherentProperties.kd`). Types I and IA are `chlorophyll` with the same Kd.

    Uncertainties are 20 to 30 % for b and 3 to 15 % for a. For bb they are 30 % in the ocean and 50 % at the coast.
    Williamson and Hollins give less absorption in all types but IB: by 13 % (II), 22 % (III), 3 % (1C), 16 % (3C) and
    26 % (5C). With it, Jerlov's Kd would need particles with bb/b 0.028, 0.041, 0.021, 0.035 and 0.043.
    """
    if water_type not in _JERLOV:
        raise UserError(f"water_type = {water_type!r} must be one of {', '.join(_JERLOV)}")
    low, high = GREEN_RANGE
    if not low <= positive("wavelength_nm", wavelength_nm) <= high:
        raise UserError(
            f"wavelength_nm = {wavelength_nm:g} must lie between {low:g} and {high:g}: Jerlov's types are tabulated at"
            " 532 nm only"
        )
    kd, b = _JERLOV[water_type]
    if b is None:
        kw, factor, exponent = _case1_terms(532.0)
        return chlorophyll(((kd - kw) / factor) ** (1 / exponent))
    ratio = PETZOLD_BACKSCATTER_RATIO if water_type.endswith("C") else _OCEANIC_BACKSCATTER_RATIO
    water = pure_seawater()
    bb = water.backscattering + ratio * (b - water.scattering)
    scattered = b, bb, water.scattering
    return InherentProperties(_absorption_for(kd, lambda _: scattered), *scattered)


def chlorophyll(concentration: float, wavelength_nm: float = 532.0) -> InherentProperties:
    """Case 1 water (open ocean), whose particles and dissolved matter covary with chlorophyll.

    `concentration`: chlorophyll concentration C [mg/m^3], 0.01 to 30. `wavelength_nm`: wavelength [nm], 400 to 700.

    Diffuse attenuation: Kd = aw + bw/2 + chi C^e by Morel and Maritorena (2001), J. Geophys. Res. 106, 7163,
    doi:10.1029/2000JC000319. Particles: b_p = 0.416 C^0.766 (wavelength/550)^v by Loisel and Morel (1998), Limnol.
    Oceanogr. 43, 847, doi:10.4319/lo.1998.43.5.0847, with v = (lg C - 0.3)/2 below 2 mg/m^3 and 0 above, and
    bb_p/b_p(550 nm) = 0.002 + 0.01 (0.5 - 0.25 lg C) (wavelength/550)^v from the former paper. Absorption: from this Kd
    (`InherentProperties.kd`). Water: `pure_seawater` at 20 degrees C. In real waters with one C, b varies by a factor
    of 2.
    """
    c = in_range("concentration", concentration, *_CHLOROPHYLL_RANGE)
    lam = in_range("wavelength_nm", wavelength_nm, *seawater.VISIBLE_RANGE)
    water = pure_seawater(lam)
    kw, factor, exponent = _case1_terms(lam)

    log_c = np.log10(c)
    colour = (lam / 550) ** (0.5 * (log_c - 0.3) if c < 2 else 0.0)
    b_550 = 0.416 * c**0.766
    b = water.scattering + b_550 * colour
    bb = water.backscattering + b_550 * (0.002 + 0.01 * (0.5 - 0.25 * log_c) * colour)

    scattered = float(b), float(bb), water.scattering
    return InherentProperties(_absorption_for(kw + factor * c**exponent, lambda _: scattered), *scattered)


def near_infrared(green: InherentProperties, wavelength_nm: float) -> InherentProperties:
    """Return a 532 nm water at a wavelength in the near infrared.

    `green`: the water at 532 nm. `wavelength_nm`: wavelength [nm], above 700 to 1100.

    The absorption has two parts. `water_absorption` gives at least 0.62 1/m. The excess over pure water at 532 nm
    decreases by exp(-0.014 (wavelength - 532)), as for dissolved matter (Bricaud, Morel and Prieur 1981, Limnol.
    Oceanogr. 26, 43, doi:10.4319/lo.1981.26.1.0043); a ten thousandth is left at 1064 nm. Scattering and backscattering
    by particles are proportional to 1/wavelength (Gordon and Morel 1983); exponents in real waters lie between 0 and 2.
    At 1064 nm this scattering is a hundredth of the attenuation.
    """
    lam = in_range("wavelength_nm", wavelength_nm, seawater.VISIBLE_RANGE[1], seawater.WAVELENGTH_RANGE[1])
    ratio, pure, molecules = 532.0 / lam, pure_seawater(), green.water_scattering
    found = pure_seawater(lam) if molecules > 0 else InherentProperties(float(seawater.water_absorption(lam)), 0.0, 0.0)
    other = max(green.absorption - pure.absorption, 0.0) * np.exp(-_DISSOLVED_SLOPE * (lam - 532.0))
    particles, back = max(green.scattering - molecules, 0.0), max(green.backscattering - molecules / 2, 0.0)
    return InherentProperties(
        found.absorption + float(other),
        found.scattering + ratio * particles,
        found.backscattering + ratio * back,
        found.water_scattering,
    )


def near_infrared_column(green: WaterColumn, wavelength_nm: float) -> WaterColumn:
    """Return the layers of a water of 532 nm at a wavelength in the near infrared [nm]; see `near_infrared`."""
    rows = zip(green.attenuation, green.scattering, green.backscattering, strict=True)
    found = [near_infrared(InherentProperties(c - b, b, bb), wavelength_nm) for c, b, bb in rows]
    return WaterColumn(green.layer_tops, *np.array([[getattr(one, name) for one in found] for name in COEFFICIENTS]))


def default_water(wavelength_nm: float) -> dict[str, float]:
    """Return a medium's defaults at a wavelength [nm] that is not green.

    These are ``refractive_index`` and ``group_index`` of sea water, 400 to 1100 nm. Above 700 nm they include
    ``attenuation``, ``scattering`` and ``backscattering`` [1/m] of the default 532 nm water (`near_infrared`).
    """
    found = {
        "refractive_index": seawater.refractive_index(wavelength_nm),
        "group_index": seawater.group_index(wavelength_nm),
    }
    if wavelength_nm > seawater.VISIBLE_RANGE[1]:
        c, b, bb = (LAYERED_WATER[name].default for name in COEFFICIENTS)
        water = near_infrared(InherentProperties(c - b, b, bb), wavelength_nm)
        found |= {name: getattr(water, name) for name in COEFFICIENTS}
    return {name: float(f"{float(value):.6g}") for name, value in found.items()}


def from_kd(kd: float) -> InherentProperties:
    """Water given by its diffuse attenuation at 532 nm.

    `kd`: diffuse attenuation coefficient of downwelling irradiance [1/m], 0.0486 (Jerlov I) to 0.738 (Jerlov 9C).

    Albedo and bb/b are linear in ln Kd between the `jerlov` values, so that Kd = 0.0796 gives jerlov("II"). Absorption
    follows from `InherentProperties.kd`. It has an error of about 15 %, and scattering a factor of 2: at Kd = 0.08 the
    two sources of `jerlov` have 0.18 and 0.38 1/m.
    """
    waters = [jerlov(name) for name in _JERLOV]
    table = [kd for kd, _ in _JERLOV.values()]
    wanted = in_range("kd", kd, table[0], table[-1])

    def typical(values: list[float]) -> float:
        return float(np.interp(np.log(wanted), np.log(table), values))

    omega, ratio = typical([w.albedo for w in waters]), typical([w.backscatter_ratio for w in waters])
    per_absorption = omega / (1 - omega)
    molecules = pure_seawater().scattering

    def scattered(a: float) -> Scattered:
        return a * per_absorption, ratio * per_absorption * a, molecules

    a = _absorption_for(wanted, scattered)
    return InherentProperties(a, *scattered(a))


def from_secchi(depth: float) -> InherentProperties:
    """Water given by its Secchi depth, at which a white disk disappears, at 532 nm.

    The particles have the bb/b of Petzold's average particle, 0.0183.

    `depth`: Secchi depth z [m], 0.5 to 25.

    Kd = 1.7/z by Poole and Atkins (1929), J. Mar. Biol. Assoc. 16, 297, and c + Kd = 8.7/z by Tyler (1968), Limnol.
    Oceanogr. 13, 1, doi:10.4319/lo.1968.13.1.0001; absorption then follows from `InherentProperties.kd`. In turbid
    coastal water Holmes (1970), Limnol. Oceanogr. 15, 688, found 1.44 and 9.42; the first constant was 1.2 to 3 in
    single waters. The attenuation has an error of about 20 %, Kd and absorption about 40 %. The eye is assumed to see
    deepest at 532 nm.
    """
    z = in_range("depth", depth, *_SECCHI_RANGE)
    kd = 1.7 / z
    c = 8.7 / z - kd
    water = pure_seawater()

    def scattered(a: float) -> Scattered:
        return c - a, water.backscattering + PETZOLD_BACKSCATTER_RATIO * (c - a - water.scattering), water.scattering

    a = _absorption_for(kd, scattered)
    return InherentProperties(a, *scattered(a))


def water_of(
    kind: str, value: str | None, wavelength_nm: float = 532.0, temperature: float = 20.0, salinity: float = 35.0
) -> InherentProperties:
    """Return a water's inherent optical properties.

    Parameters
    ----------
    kind
        ``jerlov``, ``chlorophyll``, ``kd``, ``secchi``, ``petzold`` or ``pure``.
    value
        Jerlov's type (``I`` to ``9C``), chlorophyll [mg/m^3], Kd [1/m], Secchi depth [m] or Petzold's ``clear``,
        ``coastal`` or ``turbid``; None for pure sea water.
    wavelength_nm, temperature, salinity
        Wavelength [nm], temperature [deg C] and salinity [per mille]. Above 700 nm, `near_infrared` takes a water with
        particles there from 532 nm.

    Raises
    ------
    UserError
        If the kind is unknown, or a value is missing, not a number or out of range.
    """
    if kind not in WATER_KINDS:
        raise UserError(f"kind = {kind!r} must be one of {', '.join(WATER_KINDS)}")
    if kind == "pure":
        if value is not None:
            raise UserError(f"value = {value!r} must be left out for pure sea water")
        return pure_seawater(wavelength_nm, temperature, salinity)
    if value is None:
        raise UserError(f"value is missing: {kind} needs one")
    if wavelength_nm > seawater.VISIBLE_RANGE[1]:
        return near_infrared(water_of(kind, value), wavelength_nm)
    text = value
    if kind == "jerlov":
        return jerlov(text, wavelength_nm)
    if kind == "petzold":
        return _petzold(text, wavelength_nm)
    try:
        number = float(text)
    except ValueError:
        raise UserError(f"value = {text!r} must be a number for {kind}") from None
    if kind == "chlorophyll":
        return chlorophyll(number, wavelength_nm)
    if wavelength_nm != 532.0:
        raise UserError(f"wavelength_nm = {wavelength_nm:g} must be 532, or 700 to 1100, for {kind}")
    return from_kd(number) if kind == "kd" else from_secchi(number)


def _petzold(name: str, wavelength_nm: float) -> InherentProperties:
    if name not in PETZOLD_WATERS:
        raise UserError(f"value = {name!r} must be one of {', '.join(PETZOLD_WATERS)} for petzold")
    low, high = _PETZOLD_RANGE
    if not low <= wavelength_nm <= high:
        raise UserError(
            f"wavelength_nm = {wavelength_nm:g} must lie between {low:g} and {high:g}, or above 700, for petzold"
        )
    a, b = PETZOLD_WATERS[name]
    share = PowerLawTable.from_function(petzold_water(name), _NODES).backscatter_ratio
    return InherentProperties(a, b, b * share)


def _case1_terms(lam: float) -> tuple[float, float, float]:
    """Kw [1/m], chi and e of Kd = Kw + chi C^e."""
    water = pure_seawater(lam)
    wavelengths, factors, exponents = read_columns("case1_waters.csv")
    factor, exponent = (float(np.interp(lam, wavelengths, values)) for values in (factors, exponents))
    return water.absorption + water.backscattering, factor, exponent


def _diffuse_attenuation(absorption: float, scattering: float, backscattering: float, water_scattering: float) -> float:
    """Return Kd by the formula in `InherentProperties.kd` [1/m]."""
    b_p, bb_p = max(scattering - water_scattering, 0.0), max(backscattering - water_scattering / 2, 0.0)
    by_particles = 4.10 * absorption**0.934 * bb_p**0.849 * b_p**0.217
    return float(np.sqrt(absorption**2 + by_particles + 1.6 * absorption * water_scattering))


def _absorption_for(kd: float, scattered: Callable[[float], Scattered]) -> float:
    """Return the absorption that gives `kd`, with b, bb and bw as functions of it [1/m]."""
    from scipy.optimize import brentq

    return float(brentq(lambda a: _diffuse_attenuation(a, *scattered(a)) - kd, 0, kd, xtol=1e-14))
