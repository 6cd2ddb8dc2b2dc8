"""Absorption, scattering and backscattering of water that is known by name, chlorophyll, Kd or Secchi depth.

All but measurements are rough: waters of the same Kd differ in scattering by a factor of 2, and the column of a lidar
shows it. `pure_seawater` and `chlorophyll` hold from 400 to 700 nm, the others at 532 nm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .checks import in_range, non_negative, positive
from .seawater import WAVELENGTH_RANGE, water_absorption, water_scattering

CHLOROPHYLL_RANGE = (0.01, 30.0)
"""Chlorophyll concentrations [mg/m^3] of the Case 1 model."""

SECCHI_RANGE = (0.5, 25.0)
"""Secchi depths [m] that `from_secchi` takes; from some 30 m its rules leave less absorption than water has."""

PETZOLD_BACKSCATTER_RATIO = 0.0183
"""bb/b of Petzold's average particle (Mobley et al. 1993)."""

GREEN_RANGE = (531.0, 533.0)
"""Wavelengths [nm] that pass for 532 nm."""

_JERLOV_KD = {
    "I": 0.0486,
    "IA": 0.0533,
    "IB": 0.0590,
    "II": 0.0796,
    "III": 0.1171,
    "1C": 0.1272,
    "3C": 0.1972,
    "5C": 0.3072,
    "7C": 0.4816,
    "9C": 0.738,
}
_JERLOV_ABSORPTION_SCATTERING = {
    "IB": (0.0532, 0.124),
    "II": (0.0618, 0.179),
    "III": (0.0812, 0.290),
    "1C": (0.0951, 0.432),
    "3C": (0.128, 0.651),
    "5C": (0.168, 1.21),
    "7C": (0.222, 2.49),
    "9C": (0.407, 3.31),
}

# chi and e of Morel and Maritorena (2001), 400 to 700 nm in steps of 5 nm
_CASE1_WAVELENGTHS = np.arange(400.0, 701.0, 5.0)
# fmt: off
_CASE1_FACTOR = np.array([
    0.11748, 0.12066, 0.12259, 0.12326, 0.12269, 0.12086, 0.11779, 0.11372, 0.10963, 0.10560, 0.10165, 0.09776, 0.09393,
    0.09018, 0.08649, 0.08287, 0.07932, 0.07584, 0.07242, 0.06907, 0.06579, 0.06257, 0.05943, 0.05635, 0.05341, 0.05072,
    0.04829, 0.04611, 0.04419, 0.04253, 0.04111, 0.03996, 0.03900, 0.03750, 0.03600, 0.03400, 0.03300, 0.03280, 0.03250,
    0.03300, 0.03400, 0.03500, 0.03600, 0.03750, 0.03850, 0.04000, 0.04200, 0.04300, 0.04400, 0.04450, 0.04500, 0.04600,
    0.04750, 0.04900, 0.05150, 0.05200, 0.05050, 0.04400, 0.03900, 0.03400, 0.03000,
])
_CASE1_EXPONENT = np.array([
    0.64358, 0.64776, 0.65175, 0.65555, 0.65917, 0.66259, 0.66583, 0.66889, 0.67175, 0.67443, 0.67692, 0.67923, 0.68134,
    0.68327, 0.68501, 0.68657, 0.68794, 0.68903, 0.68955, 0.68947, 0.68880, 0.68753, 0.68567, 0.68320, 0.68015, 0.67649,
    0.67224, 0.66739, 0.66195, 0.65591, 0.64927, 0.64204, 0.64000, 0.63000, 0.62300, 0.61500, 0.61000, 0.61400, 0.61800,
    0.62200, 0.62600, 0.63000, 0.63400, 0.63800, 0.64200, 0.64700, 0.65300, 0.65800, 0.66300, 0.66700, 0.67200, 0.67700,
    0.68200, 0.68700, 0.69500, 0.69700, 0.69300, 0.66500, 0.64000, 0.62000, 0.60000,
])
# fmt: on


@dataclass(frozen=True)
class InherentProperties:
    """What a volume of water does to light of one wavelength.

    Parameters
    ----------
    absorption : float
        Absorption coefficient a [1/m], at least 0.
    scattering : float
        Scattering coefficient b [1/m], at least `backscattering`.
    backscattering : float
        Backscattering coefficient bb [1/m], the part of b into the backward hemisphere, at least 0.

    Raises
    ------
    ValueError
        If a value is negative or not finite, or bb exceeds b.
    """

    absorption: float
    scattering: float
    backscattering: float

    def __post_init__(self) -> None:
        for name in ("absorption", "scattering", "backscattering"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name)))
        if self.backscattering > self.scattering:
            raise ValueError(
                f"backscattering = {self.backscattering:g} must not exceed scattering = {self.scattering:g}"
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
    def kd(self) -> float:
        """Diffuse attenuation coefficient of downwelling irradiance [1/m], with the sun at the zenith.

        a + 4.18 (1 - 0.52 exp(-10.8 a)) bb, the mean down to the depth of a tenth of the surface's irradiance, by Lee,
        Du and Arnone (2005), J. Geophys. Res. 110, C02016, doi:10.1029/2004JC002275.
        """
        return _diffuse_attenuation(self.absorption, self.backscattering)


def pure_seawater(
    wavelength_nm: float = 532.0, temperature: float = 20.0, salinity: float = 35.0
) -> InherentProperties:
    """Sea water without anything in it but salt.

    Parameters
    ----------
    wavelength_nm, temperature, salinity : float
        As in `seawater.water_scattering`: [nm], [degrees C], [per mille].

    Returns
    -------
    InherentProperties
        `seawater.water_absorption`, `seawater.water_scattering` and half of the latter.

    Raises
    ------
    ValueError
        If a value lies outside its range.
    """
    b = float(water_scattering(wavelength_nm, temperature, salinity))
    return InherentProperties(float(water_absorption(wavelength_nm)), b, b / 2)


def jerlov(water_type: str, wavelength_nm: float = 532.0) -> InherentProperties:
    """Water of one of Jerlov's optical types at 532 nm.

    Parameters
    ----------
    water_type : str
        I, IA, IB, II or III of the open ocean, 1C, 3C, 5C, 7C or 9C of the coast.
    wavelength_nm : float
        Wavelength [nm], 531 to 533: the table is held at 532 nm only.

    Returns
    -------
    InherentProperties
        Its `kd` is Jerlov's.

    Raises
    ------
    ValueError
        If there is no such type or the wavelength lies outside its range.

    Notes
    -----
    Kd: Jerlov (1976), Marine Optics, Table XXVII. Absorption and scattering of IB to 5C: measurements compiled by
    Williamson and Hollins (2022), Appl. Opt. 61, 9951; of 7C and 9C: Solonenko and Mobley (2015), Appl. Opt. 54, 5392,
    doi:10.1364/AO.54.005392, who derived them from Kd. Types I and IA are `chlorophyll` of the same Kd. No source gives
    the backscattering: it is what Lee's formula (`InherentProperties.kd`) lacks to Jerlov's Kd, hence a small
    difference that leaves bb/b, 0.016 to 0.038, uncertain by half.
    """
    if water_type not in _JERLOV_KD:
        raise ValueError(f"water_type = {water_type!r} must be one of {', '.join(_JERLOV_KD)}")
    if not GREEN_RANGE[0] <= positive("wavelength_nm", wavelength_nm) <= GREEN_RANGE[1]:
        raise ValueError(
            f"wavelength_nm = {wavelength_nm:g} must lie between {GREEN_RANGE[0]:g} and {GREEN_RANGE[1]:g}, since"
            " Jerlov's types are tabulated at 532 nm only"
        )
    kd = _JERLOV_KD[water_type]
    if water_type not in _JERLOV_ABSORPTION_SCATTERING:
        kw, factor, exponent = _case1_terms(532.0)
        return chlorophyll(((kd - kw) / factor) ** (1 / exponent))
    a, b = _JERLOV_ABSORPTION_SCATTERING[water_type]
    return InherentProperties(a, b, (kd - a) / _backscatter_weight(a))


def chlorophyll(concentration: float, wavelength_nm: float = 532.0) -> InherentProperties:
    """Case 1 water, in which all but the water itself goes with the chlorophyll: the open ocean.

    Parameters
    ----------
    concentration : float
        Chlorophyll concentration C [mg/m^3], 0.01 to 30.
    wavelength_nm : float
        Wavelength [nm], 400 to 700.

    Returns
    -------
    InherentProperties

    Raises
    ------
    ValueError
        If a value lies outside its range.

    Notes
    -----
    Diffuse attenuation: Kd = aw + bw/2 + chi C^e of Morel and Maritorena (2001), J. Geophys. Res. 106, 7163,
    doi:10.1029/2000JC000319. Particles: b_p = 0.416 C^0.766 (wavelength/550)^v of Loisel and Morel (1998), Limnol.
    Oceanogr. 43, 847, doi:10.4319/lo.1998.43.5.0847, with v = (lg C - 0.3)/2 below 2 mg/m^3 and 0 above, and
    bb_p/b_p(550 nm) = 0.002 + 0.01 (0.5 - 0.25 lg C) (wavelength/550)^v of the former paper. Absorption: what makes
    this Kd by Lee's formula (`InherentProperties.kd`), though never less than that of water, which decides below
    0.02 mg/m^3 at most. Water: `pure_seawater` at 20 degrees C. In real waters of one C, b varies by a factor of 2.
    """
    c = in_range("concentration", concentration, *CHLOROPHYLL_RANGE)
    lam = in_range("wavelength_nm", wavelength_nm, *WAVELENGTH_RANGE)
    water = pure_seawater(lam)
    kw, factor, exponent = _case1_terms(lam)

    log_c = np.log10(c)
    colour = (lam / 550) ** (0.5 * (log_c - 0.3) if c < 2 else 0.0)
    b_550 = 0.416 * c**0.766
    b = water.scattering + b_550 * colour
    bb = water.backscattering + b_550 * (0.002 + 0.01 * (0.5 - 0.25 * log_c) * colour)

    a = _absorption_for(kw + factor * c**exponent, lambda _: bb)
    return InherentProperties(max(a, water.absorption), float(b), float(bb))


def from_kd(kd: float, albedo: float | None = None, backscatter_ratio: float | None = None) -> InherentProperties:
    """Water of which little more is known than its diffuse attenuation at 532 nm.

    Parameters
    ----------
    kd : float
        Diffuse attenuation coefficient of downwelling irradiance [1/m], 0.0486 (Jerlov I) to 0.738 (Jerlov 9C).
    albedo : float, optional
        Single-scattering albedo b/c, 0 to 0.98. By default that of the Jerlov types of neighbouring Kd.
    backscatter_ratio : float, optional
        bb/b, 0.001 to 0.1. By default that of the Jerlov types of neighbouring Kd.

    Returns
    -------
    InherentProperties
        Its `kd` is the given one.

    Raises
    ------
    ValueError
        If a value lies outside its range, or together they leave less absorption than pure water has.

    Notes
    -----
    Albedo and bb/b go linearly with ln Kd between those that `jerlov` gives, which makes jerlov("II") of Kd = 0.0796.
    Absorption follows by Lee's formula (`InherentProperties.kd`). Absorption is good to some 15 %, scattering to a
    factor of 2: at Kd = 0.08 the two sources of `jerlov` have 0.18 and 0.38 1/m.
    """
    waters = [jerlov(name) for name in _JERLOV_KD]
    table = list(_JERLOV_KD.values())
    wanted = in_range("kd", kd, table[0], table[-1])

    def typical(values: list[float]) -> float:
        return float(np.interp(np.log(wanted), np.log(table), values))

    omega = typical([w.albedo for w in waters]) if albedo is None else in_range("albedo", albedo, 0, 0.98)
    if backscatter_ratio is None:
        ratio = typical([w.backscatter_ratio for w in waters])
    else:
        ratio = in_range("backscatter_ratio", backscatter_ratio, 0.001, 0.1)

    per_absorption = omega / (1 - omega)
    a = _absorption_for(wanted, lambda x: ratio * per_absorption * x)
    if a < water_absorption(532):
        raise ValueError(
            f"kd = {wanted:g} with albedo = {omega:g} and backscatter_ratio = {ratio:g} must leave at least the"
            f" absorption of pure water, {water_absorption(532):g} 1/m, but leaves {a:g}"
        )
    return InherentProperties(a, a * per_absorption, ratio * per_absorption * a)


def from_secchi(depth: float, backscatter_ratio: float = PETZOLD_BACKSCATTER_RATIO) -> InherentProperties:
    """Water of which little more is known than the depth at which a white disk vanishes.

    Parameters
    ----------
    depth : float
        Secchi depth z [m], 0.5 to 25.
    backscatter_ratio : float
        bb/b, 0.001 to 0.04.

    Returns
    -------
    InherentProperties
        At 532 nm, taken to be the colour that the eye follows down.

    Raises
    ------
    ValueError
        If a value lies outside its range, or together they leave less absorption than pure water has.

    Notes
    -----
    Kd = 1.7/z of Poole and Atkins (1929), J. Mar. Biol. Assoc. 16, 297, and c + Kd = 8.7/z of Tyler (1968), Limnol.
    Oceanogr. 13, 1, doi:10.4319/lo.1968.13.1.0001; absorption then follows by Lee's formula (`InherentProperties.kd`).
    In turbid coastal water Holmes (1970), Limnol. Oceanogr. 15, 688, found 1.44 and 9.42; single waters had 1.2 to 3
    for the first constant. Attenuation is good to some 20 %, Kd and absorption to some 40 %.
    """
    z = in_range("depth", depth, *SECCHI_RANGE)
    ratio = in_range("backscatter_ratio", backscatter_ratio, 0.001, 0.04)
    kd = 1.7 / z
    c = 8.7 / z - kd
    a = _absorption_for(kd, lambda x: ratio * (c - x))
    if a < water_absorption(532):
        raise ValueError(
            f"depth = {z:g} with backscatter_ratio = {ratio:g} must leave at least the absorption of pure water,"
            f" {water_absorption(532):g} 1/m, but leaves {a:g}"
        )
    return InherentProperties(a, c - a, ratio * (c - a))


def _case1_terms(lam: float) -> tuple[float, float, float]:
    """Kw [1/m], chi and e of Kd = Kw + chi C^e."""
    water = pure_seawater(lam)
    factor = float(np.interp(lam, _CASE1_WAVELENGTHS, _CASE1_FACTOR))
    exponent = float(np.interp(lam, _CASE1_WAVELENGTHS, _CASE1_EXPONENT))
    return water.absorption + water.backscattering, factor, exponent


def _backscatter_weight(absorption: float) -> float:
    return float(4.18 * (1 - 0.52 * np.exp(-10.8 * absorption)))


def _diffuse_attenuation(absorption: float, backscattering: float) -> float:
    return absorption + _backscatter_weight(absorption) * backscattering


def _absorption_for(kd: float, backscattering: Callable[[float], float]) -> float:
    """Absorption with which Lee's formula gives `kd`, for a backscattering that may depend on it."""
    from scipy.optimize import brentq

    return float(brentq(lambda a: _diffuse_attenuation(a, backscattering(a)) - kd, 0, kd, xtol=1e-14))
