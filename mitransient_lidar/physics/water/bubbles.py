"""Bubbles below a windy sea: void fraction and sizes against wind speed, and their effect on light.

The background layer of bubbles that breaking waves leave behind, a mean over time, not the plumes below fresh breakers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mitransient_lidar.core.validation import in_range
from mitransient_lidar.physics.water.phase import fournier_forand, fournier_forand_parameters

STRONGEST_WIND = 20.0  #: Highest wind speed in the model [m/s].

CLEAN_BACKSCATTER = 233.0
"""Volume scattering at 180 degrees over void fraction for clean bubbles of any size [1/(m sr)] (Churnside 2010)."""

#: Bubbles per volume and radius at the reference radius, at 13 m/s [1/m^4], and that wind speed [m/s].
_DENSITY, _REFERENCE_WIND = 1.6e10, 13.0

#: Smallest, reference and largest radius [m]; the exponents of the spectrum below and above the second.
_RADII = 10e-6, 54.4e-6, 1000e-6
_EXPONENTS = 4.0, 4.37

#: Depth of the layer up to a wind speed [m], that speed [m/s], and its rise [s].
_LEAST_DEPTH, _WIND_OF_LEAST_DEPTH, _DEEPENING = 0.4, 7.5, 0.115

#: Range of Fournier-Forand ratios bb/b within which the bubbles' ratio is sought.
_RATIOS = 1e-4, 0.4
_BISECTIONS = 40


@dataclass(frozen=True)
class WindBubbles:
    """Bubbles whose void fraction falls with depth as exp(-z / depth)."""

    void_fraction: float  #: Air volume per water volume at the surface, 0 to 0.001.
    depth: float  #: Depth at which it has fallen to 1/e [m], 0.05 to 20.
    radius: float  #: Effective radius, of the mean cube over the mean square [m].

    @classmethod
    def of_wind(cls, wind_speed: float) -> WindBubbles:
        """Return the bubbles below a wind of a speed at 10 m height [m/s], 0 to 20.

        Raises UserError if the wind speed lies outside its range.

        The Hall-Novarini model: n(a) = 1.6e10 (U / 13)^3 exp(-z / L) G(a) in 1/m^4. G = (a_r / a)^4 from a radius of 10
        um to a_r = 54.4 um and (a_r / a)^4.37 to 1000 um. L = 0.4 m up to 7.5 m/s, 0.4 + 0.115 (U - 7.5) above. Hall
        (1989), J. Acoust. Soc. Am. 86, 1103, doi:10.1121/1.398102; Novarini, Keiffer and Norton (1998), IEEE J. Oceanic
        Eng. 23, 423, doi:10.1109/48.725236. They also change the sizes with depth: a_r by 1.984 um per metre and the
        upper exponent by (z / 2.55 m)^2. These changes are left out: they raise the void fraction by at most 7 % down
        to 3 m, and the scattering by 14 % at 1 m and 28 % at 2 m.
        """
        wind = in_range("wind_speed", wind_speed, 0.0, STRONGEST_WIND)
        volume = 4 / 3 * math.pi * _moment(3)
        fraction = _DENSITY * (wind / _REFERENCE_WIND) ** 3 * volume
        depth = _LEAST_DEPTH + _DEEPENING * max(wind - _WIND_OF_LEAST_DEPTH, 0.0)
        return cls(fraction, depth, _moment(3) / _moment(2))

    @property
    def scattering(self) -> float:
        """Scattering coefficient at the surface [1/m]: bubbles scatter twice the light that meets them."""
        return 1.5 * self.void_fraction / self.radius

    def backscatter_ratio(self, backscatter: float = CLEAN_BACKSCATTER) -> float:
        """Return bb/b of the Fournier-Forand function that scatters at 180 degrees as the bubbles do.

        Raises UserError if the number lies outside its range.

        `backscatter`: volume scattering at 180 degrees over void fraction [1/(m sr)], 100 to 1445. 233 for clean
        bubbles, 1445 for a thick coating: Churnside (2010), Opt. Express 18, 8294, doi:10.1364/OE.18.008294.
        """
        wanted = in_range("backscatter", backscatter, 100.0, 1445.0) * self.radius / 1.5
        low, high = _RATIOS
        for _ in range(_BISECTIONS):
            middle = math.sqrt(low * high)
            found = float(fournier_forand(math.pi, *fournier_forand_parameters(middle)))
            low, high = (middle, high) if found < wanted else (low, middle)
        return high


def _moment(power: int) -> float:
    """Return the integral of G(a) a^power over the radii [m^(power + 1)]."""
    smallest, reference, largest = _RADII
    below, above = (power + 1 - exponent for exponent in _EXPONENTS)
    small = math.log(reference / smallest) if below == 0 else (1 - (smallest / reference) ** below) / below
    return float(reference ** (power + 1) * (small + ((largest / reference) ** above - 1) / above))
