"""Foam on the sea: cover by wind speed, and where it lies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range
from mitransient_lidar.physics.sea.height_maps import HeightMap, read_height_map

#: Names of the laws for the cover against wind speed.
LAWS = ("monahan_omuircheartaigh_1980", "callaghan_2008", "stramska_petelski_2003")

#: Reflectance over that at short wavelengths, at wavelengths [nm].
_SHAPE = ((500.0, 1.0), (600.0, 0.95), (1000.0, 0.5), (1100.0, 0.45))

#: Distance within which crests rise above their surroundings [m].
SURROUNDINGS = 2.0


def foam_cover(foam: str, wind_speed: float) -> float:
    """Return the share of the sea that foam covers [1].

    Raises UserError if `foam` is none of what it may be.

    `foam`: ``none``, a number from 0 to 1, or the name of a law. `wind_speed`: wind speed U at 10 m [m/s].

    Notes
    -----
    Monahan and O'Muircheartaigh 1980, doi:10.1175/1520-0485(1980)010<2094:OPLDOO>2.0.CO;2: 2.95e-6 U^3.52. Callaghan et
    al. 2008, doi:10.1029/2008GL036165: 3.18e-5 (U - 3.7)^3 from 3.7 m/s, and 4.82e-6 (U + 1.98)^3 from where both are
    equal, 10.2 m/s. Stramska and Petelski 2003, doi:10.1029/2002JC001321: 8.75e-5 (U - 6.33)^3 from 6.33 m/s. At one
    wind speed they differ by a factor of 3, and single measurements by more.
    """
    wind = float(wind_speed)
    if foam == "none":
        return 0.0
    if foam == LAWS[0]:
        return min(2.95e-6 * float(wind**3.52), 1.0)
    if foam == LAWS[1]:
        return min(3.18e-5 * max(wind - 3.7, 0.0) ** 3, 4.82e-6 * (wind + 1.98) ** 3, 1.0)
    if foam == LAWS[2]:
        return min(8.75e-5 * max(wind - 6.33, 0.0) ** 3, 1.0)
    try:
        number = float(foam)
    except ValueError:
        raise UserError(f"foam = {foam!r} must be none, {', '.join(LAWS)} or a number from 0 to 1") from None
    return in_range("foam", number, 0.0, 1.0)


def foam_whiteness(wavelength_nm: float) -> float:
    """Return the foam reflectance at a wavelength [nm] over that at 532 nm [1].

    The shape of Frouin et al. 1996, doi:10.1029/96JC00629, between 400 and 1100 nm: 1 up to 500 nm, 0.5 at 1000 nm.
    """
    nodes, shape = zip(*_SHAPE, strict=True)
    at, green = np.interp([wavelength_nm, 532.0], nodes, shape)
    return float(at / green)


def read_foam_map(path: str, size: float | None, origin: tuple[float, float] | None) -> HeightMap:
    """Return the map of a foam share [1], as `height_maps.read_height_map` reads those of heights.

    Raises UserError if the file is no map, or has values outside 0 to 1.
    """
    cover = read_height_map(path, size, origin)
    low, high = float(cover.heights.min()), float(cover.heights.max())
    if low < 0 or high > 1:
        raise UserError(f"foam_map = {path} has values from {low:g} to {high:g}: shares of foam lie from 0 to 1")
    return cover


def crest_heights(sample: Callable[[FloatArray, FloatArray], FloatArray], x: FloatArray, y: FloatArray) -> FloatArray:
    """Return how far waves rise above their surroundings [m] on grid lines [m], shape (len(y), len(x)).

    The surroundings are the four points at `SURROUNDINGS` along x and y, so that waves from 2 to 10 m count most, as
    long as the patches of whitecaps are wide.
    """
    around = [sample(x + sign * SURROUNDINGS, y) + sample(x, y + sign * SURROUNDINGS) for sign in (-1, 1)]
    return np.asarray(sample(x, y) - 0.25 * (around[0] + around[1]))


def foam_on_crests(crests: FloatArray, all_crests: FloatArray, cover: FloatArray) -> FloatArray:
    """Return the foam share at points [1]: 1 on the highest crests, as many as the cover needs, and 0 elsewhere.

    `crests`: `crest_heights` at the points [m], of any shape. `all_crests`: crest heights at points all over the sea
    [m], shape (n,). Where they are all equal, the cover is the share. `cover`: share of the sea with foam about each
    point [1], in the shape of `crests`.
    """
    if all_crests.min() == all_crests.max():
        return np.asarray(cover, dtype=np.float64)
    rank = np.interp(crests, np.sort(all_crests), np.linspace(0, 1, all_crests.size))
    return np.asarray((rank >= 1 - cover) & (cover > 0), dtype=np.float64)
