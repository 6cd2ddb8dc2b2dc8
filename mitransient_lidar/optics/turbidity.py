"""Optical properties of water, and the reflectivity of a bottom, from the signal of a lidar's water column.

Coefficients are in 1/m, lengths in m. What a column shows are two numbers, how strong it is and how fast it falls, and
so two properties follow, bb and a (hence Kd). The third, c, needs more: a narrow view, or a guess of bb/b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, in_range, non_negative, positive
from .known_waters import InherentProperties
from .system_attenuation import SPOT_COEFFICIENT
from .water import C0

#: Diameters [m] of the seen spot at which a column falls with Kd, and from which on with a + bb.
SPOT_OF_KD, SPOT_OF_A_PLUS_BB = 6.4, 10.6

#: Diameter [m] below which too much light leaves the view to be told from attenuation.
SMALLEST_SPOT = 6.0

#: How much multiple scattering raises a column's level above bb's own.
MULTIPLE_SCATTERING = 1.13

#: bb/b of natural waters: the usual one, and what most lie between.
BACKSCATTER_RATIO, BACKSCATTER_RATIOS = 0.0183, (0.01, 0.044)


@dataclass(frozen=True)
class WaterEstimate:
    """Water behind a column's signal; arrays of one shape, NaN where no water fits.

    Attributes
    ----------
    absorption, backscattering, kd
        Coefficients a, bb, and Kd of downwelling irradiance with the sun at the zenith [1/m].
    attenuation, attenuation_low, attenuation_high
        Beam attenuation c for the usual bb/b, and for the largest and smallest [1/m].
    """

    absorption: FloatArray
    backscattering: FloatArray
    kd: FloatArray
    attenuation: FloatArray
    attenuation_low: FloatArray
    attenuation_high: FloatArray


def backscatter_of_level(level: npt.ArrayLike, gain: npt.ArrayLike, group_index: float) -> FloatArray:
    """Backscatter at 180 degrees from the level of a column at the surface.

    Parameters
    ----------
    level : array_like
        Power of the column's signal, extrapolated to the surface [W].
    gain : array_like
        Energy received per backscatter and metre there [J sr], above 0: `LidarSystem.water_gain` times the part of the
        beam that the receiver sees.
    group_index : float
        Group index of the water, at least 1.

    Returns
    -------
    ndarray
        b p(pi) = 2 n_g level/(c0 gain) [1/(m sr)], what scatters more than once included.

    Raises
    ------
    ValueError
        If a gain is not positive or the index out of range.
    """
    factor = finite_array("gain", gain)
    if np.any(factor <= 0):
        raise ValueError(f"gain = {factor.min():g} must be greater than 0")
    speed = C0 / (2 * in_range("group_index", group_index, 1, np.inf))
    return np.asarray(np.asarray(level, dtype=np.float64) / (speed * factor))


def water_of_column(
    decay: npt.ArrayLike,
    backscatter: npt.ArrayLike,
    spot_diameter: float,
    *,
    first_path: float = 0.0,
    phase_factor: float = 1.0,
) -> WaterEstimate:
    """Find absorption, backscattering, Kd and bounds of c from a column seen with a wide field of view.

    Parameters
    ----------
    decay : array_like
        Attenuation K along the path of the column's signal, exp(-2 K s) [1/m].
    backscatter : array_like
        Backscatter from its level at the surface, as extrapolated with K [1/(m sr)]; see `backscatter_of_level`.
    spot_diameter : float
        Diameter of the circle on the sea that the receiver sees [m], at least 6.
    first_path : float
        Path at which the fit of the column begins [m], at least 0: from there up the level follows a + bb.
    phase_factor : float
        2 pi p(pi) b/bb of the phase function [1], above 0: 0.92 to 1.06 for those of Fournier and Forand.

    Returns
    -------
    WaterEstimate

    Raises
    ------
    ValueError
        If a number is out of range.

    Notes
    -----
    bb = 2 pi backscatter exp(-2 (K - a - bb) s_1)/(1.13 phase_factor). K is a + bb where the receiver sees all light
    that was scattered forward only (Gordon 1982, doi:10.1364/AO.21.002996, calls this quasi-single scattering), from
    a spot of 10.6 m on, and Kd at 6.4 m; between, linear in the diameter. Kd is that of Lee, Du and Arnone (2005),
    doi:10.1029/2004JC002275. The diameters and the 1.13 are from rendered columns of seven waters (c 0.18 to 1.4), a
    beam of 10 mrad, 200 m up, 2 to 5 m deep: a fit to one geometry and not physics; levels scattered by 8 %. The beam
    must be the narrower one, and the column homogeneous.

    c is ill-posed: forward-scattered light stays in the view, so that the signal hardly depends on it. What is given
    is a + bb/r for r = 0.0183 (Petzold's average particle), 0.044 and 0.01, between which natural waters lie.
    """
    diameter = in_range("spot_diameter", spot_diameter, SMALLEST_SPOT, np.inf)
    start = non_negative("first_path", first_path)
    factor = positive("phase_factor", phase_factor)
    fall, level = np.broadcast_arrays(np.asarray(decay, dtype=np.float64), np.asarray(backscatter, dtype=np.float64))
    share = np.clip((SPOT_OF_A_PLUS_BB - diameter) / (SPOT_OF_A_PLUS_BB - SPOT_OF_KD), 0, 1)
    known = np.isfinite(fall) & np.isfinite(level) & (fall > 0) & (level > 0)
    k = np.where(known, fall, 1.0)
    apparent = 2 * np.pi * np.where(known, level, 0.0) / (MULTIPLE_SCATTERING * factor)
    # Kd - a - bb is a small part of K, so the fixed point is reached at once.
    a, bb = k.copy(), apparent
    for _ in range(60):
        excess = share * (_kd(np.maximum(a, 0), bb) - np.maximum(a, 0) - bb)
        bb = apparent * np.exp(-2 * excess * start)
        a = 0.5 * (a + k - bb - excess)
    known &= a > 0
    kd = _kd(np.maximum(a, 0), bb)
    usual, high, low = (a + bb / ratio for ratio in (BACKSCATTER_RATIO, *BACKSCATTER_RATIOS))
    return WaterEstimate(*(np.where(known, value, np.nan) for value in (a, bb, kd, usual, low, high)))


def _kd(absorption: FloatArray, backscattering: FloatArray) -> FloatArray:
    """Diffuse attenuation [1/m], which of the scattering needs its backward part alone."""
    pairs = zip(absorption.ravel(), backscattering.ravel(), strict=True)
    return np.array([InherentProperties(a, bb, bb).kd for a, bb in pairs]).reshape(absorption.shape)


def attenuation_of_view(decay: npt.ArrayLike, kd: npt.ArrayLike, spot_diameter: float) -> tuple[FloatArray, FloatArray]:
    """Find the beam attenuation c from a column seen, and lit, in a narrow circle.

    Parameters
    ----------
    decay : array_like
        Attenuation K along the path of the column's signal [1/m].
    kd : array_like
        Diffuse attenuation [1/m], at least 0.
    spot_diameter : float
        Diameter of the circle on the sea that beam and receiver share [m], above 0.

    Returns
    -------
    attenuation, largest : ndarray
        c [1/m], which solves K = Kd + (c - Kd) exp(-0.85 c D); NaN where no c does. And the largest c that can be told:
        the right side rises with c up to c = Kd + 1/(0.85 D) only, so that a turbid water looks like a clearer one.

    Raises
    ------
    ValueError
        If a number is out of range.

    Notes
    -----
    Inverse of `system_attenuation.system_attenuation`. With a spot of 6 m, as of 30 mrad from 200 m, only c within
    0.2/m of Kd could be told: such a view does not tell c. A rough sea turns light out of a narrow view, which makes c
    too large, in clear water most; forward peaks of phase functions count as unscattered light and make it too small.
    """
    diameter = positive("spot_diameter", spot_diameter)
    k, diffuse = np.broadcast_arrays(np.asarray(decay, dtype=np.float64), finite_array("kd", kd))
    if np.any(diffuse < 0):
        raise ValueError(f"kd = {diffuse.min():g} must not be negative")
    rate = SPOT_COEFFICIENT * diameter
    largest = diffuse + 1 / rate
    highest = diffuse + np.exp(-rate * largest) / rate
    known = np.isfinite(k) & (k >= diffuse) & (k <= highest)
    low, high = np.array(diffuse, dtype=np.float64), np.array(largest)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = diffuse + (middle - diffuse) * np.exp(-rate * middle) < k
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.where(known, 0.5 * (low + high), np.nan), largest


def bottom_reflectivity(
    energy: npt.ArrayLike,
    column_power: npt.ArrayLike,
    backscatter: npt.ArrayLike,
    cos_vertical: npt.ArrayLike,
    group_index: float,
) -> FloatArray:
    """Reflectivity of a Lambertian bottom from its echo over the column's signal at the same time.

    Parameters
    ----------
    energy : array_like
        Energy of the bottom echo [J].
    column_power : array_like
        Power of the column's signal, extrapolated to the time of the echo [W], above 0 where known.
    backscatter : array_like
        Backscatter b p(pi) that belongs to the column's level [1/(m sr)].
    cos_vertical : array_like
        Cosine of the light's angle from the vertical in the water [1].
    group_index : float
        Group index of the water, at least 1.

    Returns
    -------
    ndarray
        rho = pi (c0/2 n_g) backscatter energy/(power cos(alpha)) [1]; NaN where the column is not known.

    Raises
    ------
    ValueError
        If the index is out of range.

    Notes
    -----
    Column and bottom share all that lies above: energy of the pulse, atmosphere, transmission and slope of the surface,
    its focusing of beam and view, attenuation. Their ratio is free of it, so that it is the sea surface correction of a
    shot. Assumed: the same water for all shots that are compared, homogeneous down to the bottom. An absolute
    reflectivity is as good as the backscatter.
    """
    power = np.asarray(column_power, dtype=np.float64)
    known = power > 0
    speed = C0 / (2 * in_range("group_index", group_index, 1, np.inf))
    scale = np.pi * speed * np.asarray(backscatter, dtype=np.float64) / np.asarray(cos_vertical, dtype=np.float64)
    return np.asarray(
        np.where(known, scale * np.asarray(energy, dtype=np.float64) / np.where(known, power, 1.0), np.nan)
    )


#: Bottom classes by reflectivity at 532 nm, each from its own lower edge on.
BOTTOM_CLASSES = {"dark": 0.0, "medium": 0.1, "bright": 0.2}


def bottom_class(
    reflectivity: npt.ArrayLike, stderr: npt.ArrayLike, classes: dict[str, float] | None = None
) -> tuple[list[str], FloatArray]:
    """Probabilities of bottom classes.

    Parameters
    ----------
    reflectivity, stderr : array_like
        Reflectivity and its standard error [1], at least 0; they broadcast. NaN where unknown.
    classes : dict of str to float, optional
        Names and lower edges, increasing from 0. Without it: dark (mud, vegetation), medium from 0.1 (gravel, rock,
        mixed bottoms), bright from 0.2 (sand, shell). These edges are a convention: bottoms of one kind vary by a
        factor of 2 and one wavelength tells no more.

    Returns
    -------
    names : list of str
        The classes.
    probability : ndarray, shape (..., classes)
        Share of a Gaussian about the reflectivity in each class; what is below 0 counts as the first.

    Raises
    ------
    ValueError
        If classes are out of order or an error is negative.
    """
    from scipy.special import ndtr

    edges = BOTTOM_CLASSES if classes is None else classes
    lower = finite_array("classes", list(edges.values()))
    if lower.size == 0 or lower[0] != 0 or np.any(np.diff(lower) <= 0):
        raise ValueError(f"classes = {edges} must have lower edges that increase from 0")
    value, error = np.broadcast_arrays(np.asarray(reflectivity, dtype=np.float64), np.asarray(stderr, dtype=np.float64))
    if np.any(error < 0):
        raise ValueError(f"stderr = {np.nanmin(error):g} must not be negative")
    distance = lower[1:] - value[..., np.newaxis]
    sharp = np.where(distance > 0, np.inf, -np.inf)
    wide = np.where(error > 0, error, 1.0)[..., np.newaxis]
    below = np.where(np.isnan(distance), np.nan, ndtr(np.where(error[..., np.newaxis] > 0, distance / wide, sharp)))
    ends = np.concatenate([np.zeros_like(value)[..., np.newaxis], below, np.ones_like(value)[..., np.newaxis]], axis=-1)
    return list(edges), np.where(np.isnan(value)[..., np.newaxis], np.nan, np.diff(ends, axis=-1))
