"""Measured distribution of sea slopes; and foam on the sea: cover by wind speed, and where it lies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, in_range
from mitransient_lidar.physics.sea.height_maps import HeightMap, read_height_map

MAX_WIND_SPEED = 30.0  #: Largest wind speed in all sea models [m/s].
MEASURED_WIND = 1.0, 14.0  #: Wind speeds at which Cox and Munk measured [m/s].

#: Largest share of slopes, by the Gaussian part, for which a series may have a negative density.
LARGEST_NEGATIVE_SHARE = 0.005


def cox_munk(wind_speed: float) -> tuple[float, float]:
    """Slope variances of a clean sea after Cox and Munk.

    `wind_speed`: wind speed [m/s], 0 to 30. Measured between 1 and 14 m/s, at a height of 12.5 m; extrapolated
    linearly. The difference from the wind at 10 m is below their error.

    Returns `upwind`, `crosswind`: slope variances [1]. At zero wind the regression gives 0.003 crosswind.

    Cox and Munk (1954), J. Opt. Soc. Am. 44, 838, doi:10.1364/JOSA.44.000838: 3.16e-3 W and 0.003 + 1.92e-3 W.
    """
    wind = in_range("wind_speed", wind_speed, 0, MAX_WIND_SPEED)
    return 3.16e-3 * wind, 0.003 + 1.92e-3 * wind


@dataclass(frozen=True)
class GramCharlierSeries:
    """Ratio of a slope density to the Gaussian density with the same variances.

    For slopes over their standard deviations, crosswind x and upwind y, positive where the surface rises towards the
    wind, the ratio is

        1 - c21 (x^2 - 1) y / 2 - c03 (y^3 - 3 y) / 6
          + c40 (x^4 - 6 x^2 + 3) / 24 + c22 (x^2 - 1) (y^2 - 1) / 4 + c04 (y^4 - 6 y^2 + 3) / 24.

    Cox and Munk (1954), J. Opt. Soc. Am. 44, 838, doi:10.1364/JOSA.44.000838, equation for the probability of slopes.
    """

    c21: float  #: Skewness of the upwind slope with the squared crosswind slope, negated.
    c03: float  #: Upwind slope skewness, negated.
    c40: float  #: Crosswind slope excess kurtosis.
    c22: float  #: Excess of the mean product of squared slopes over 1.
    c04: float  #: Upwind slope excess kurtosis.

    @classmethod
    def of_clean_sea(cls, wind_speed: float) -> GramCharlierSeries:
        """Return the series for a clean sea.

        Raises UserError if the wind speed is out of range.

        `wind_speed`: wind speed [m/s], 1 to 14.

        Cox and Munk (1954): 0.01 - 0.0086 W (+- 0.03), 0.04 - 0.033 W (+- 0.12), 0.40 (+- 0.23), 0.12 (+- 0.06) and
        0.23 (+- 0.41), from slopes up to 2.5 standard deviations.
        """
        wind = in_range("wind_speed of a slope_distribution 'gram_charlier'", wind_speed, *MEASURED_WIND)
        return cls(0.01 - 0.0086 * wind, 0.04 - 0.033 * wind, 0.40, 0.12, 0.23)

    def of_part(self, total: tuple[float, float], part: tuple[float, float]) -> GramCharlierSeries:
        """Return the series of one of two independent slope parts, where the other part is Gaussian.

        Third and fourth cumulants come from this part alone; the sum then has exactly this series.

        `total`, `part`: slope variances upwind and crosswind for both parts together and for this part [1], positive.
        In reverse order, the series of the sum follows from the part's.
        """
        y, x = (np.sqrt(both / one) for both, one in zip(total, part, strict=True))
        factors = x**2 * y, y**3, x**4, x**2 * y**2, y**4
        terms = self.c21, self.c03, self.c40, self.c22, self.c04
        return GramCharlierSeries(*(float(c * factor) for c, factor in zip(terms, factors, strict=True)))

    def ratio(self, x: Any, y: Any) -> Any:
        """Return the ratio at crosswind and upwind slopes over their standard deviations, arrays of any library."""
        x2, y2 = x * x, y * y
        odd = -0.5 * self.c21 * (x2 - 1) - self.c03 / 6 * (y2 - 3)
        even = self.c40 / 24 * ((x2 - 6) * x2 + 3) + self.c04 / 24 * ((y2 - 6) * y2 + 3)
        return 1 + odd * y + even + 0.25 * self.c22 * (x2 - 1) * (y2 - 1)

    def along(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return skewness and excess kurtosis of the slope in a direction.

        `x`, `y`: cosines of the direction to crosswind and to upwind, each times the slope's standard deviation in that
        axis over its standard deviation in the direction: the squares sum to 1.
        """
        x2, y2 = x * x, y * y
        skewness = -(self.c03 * y2 + 3 * self.c21 * x2) * y
        return skewness, self.c40 * x2 * x2 + 6 * self.c22 * x2 * y2 + self.c04 * y2 * y2

    @property
    def negative_share(self) -> float:
        """Integral of the density where it is negative, with its sign reversed [1]."""
        nodes = np.linspace(-8, 8, 321)
        x, y = np.meshgrid(nodes, nodes)
        gaussian = np.exp(-0.5 * (x**2 + y**2)) / (2 * np.pi) * (nodes[1] - nodes[0]) ** 2
        return float(np.sum(gaussian * np.maximum(-self.ratio(x, y), 0)))

    def require_positive(self, advice: str) -> None:
        """Refuse a series whose density is negative for more than half a percent of the slopes.

        Raises `UserError` with `advice` at the end.
        """
        share = self.negative_share
        if share > LARGEST_NEGATIVE_SHARE:
            raise UserError(
                f"slope_distribution = 'gram_charlier' has a negative density for {100 * share:.2g} % of the slopes "
                f"of the ripples, of at most {100 * LARGEST_NEGATIVE_SHARE:g} %; {advice}"
            )


#: Names of the laws for the cover against wind speed.
LAWS = ("monahan_omuircheartaigh_1980", "callaghan_2008", "stramska_petelski_2003")

#: Reflectance over that at short wavelengths, at wavelengths [nm].
_SHAPE = ((500.0, 1.0), (600.0, 0.95), (1000.0, 0.5), (1100.0, 0.45))

SURROUNDINGS = 2.0  #: Distance within which crests rise above their surroundings [m].


def foam_cover(foam: str, wind_speed: float) -> float:
    """Return the share of the sea that foam covers [1].

    Raises UserError if `foam` is none of what it may be.

    `foam`: ``none``, a number from 0 to 1, or the name of a law. `wind_speed`: wind speed U at 10 m [m/s].

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

    The surroundings are the four points at `SURROUNDINGS` along x and y. Waves from 2 to 10 m, as long as whitecap
    patches are wide, then count most.
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
