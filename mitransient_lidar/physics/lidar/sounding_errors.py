"""Errors of soundings by waves, pointing and position, and the orders of hydrographic surveys that they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.validation import FloatArray, IntArray, non_negative
from mitransient_lidar.physics.lidar.refraction import snell, turn_by_slope

#: Standard deviations to the limits of 95 % of a normal error, in one dimension and of a circle in two.
VERTICAL_95, HORIZONTAL_95 = 1.96, 2.45


@dataclass(frozen=True)
class SurveyOrder:
    """Largest uncertainties of an order of hydrographic surveys, at the confidence level of 95 %."""

    name: str
    vertical: tuple[float, float]  #: a [m] and b [1] of TVU = sqrt(a^2 + (b d)^2) at the depth d.
    horizontal: tuple[float, float]  #: Constant [m] and share of the depth [1] of THU, whose sum counts.

    def largest_tvu(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the largest total vertical uncertainty [m] at depths [m]."""
        return np.asarray(np.hypot(self.vertical[0], self.vertical[1] * np.asarray(depth, dtype=np.float64)))

    def largest_thu(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the largest total horizontal uncertainty [m] at depths [m]."""
        return np.asarray(self.horizontal[0] + self.horizontal[1] * np.asarray(depth, dtype=np.float64))


#: Orders from the strictest on: IHO Standards for Hydrographic Surveys, S-44, edition 6.1.0 (2022), table 1. Orders 1a
#: and 1b differ in coverage and in the features to be detected only.
SURVEY_ORDERS = (
    SurveyOrder("exclusive", (0.15, 0.0075), (1.0, 0.0)),
    SurveyOrder("special", (0.25, 0.0075), (2.0, 0.0)),
    SurveyOrder("1a/1b", (0.5, 0.013), (5.0, 0.05)),
    SurveyOrder("2", (1.0, 0.023), (20.0, 0.1)),
)


def order_met(depth: npt.ArrayLike, tvu: npt.ArrayLike, thu: npt.ArrayLike) -> IntArray:
    """Return the strictest order that both uncertainties meet.

    Parameters
    ----------
    depth, tvu, thu : array_like
        Depths, and total vertical and horizontal uncertainties at 95 % [m], of shapes that broadcast.

    Returns
    -------
    ndarray
        Places in `SURVEY_ORDERS`, their number where no order is met, and -1 where an uncertainty is NaN.
    """
    d, vertical, horizontal = np.broadcast_arrays(*(np.asarray(one, dtype=np.float64) for one in (depth, tvu, thu)))
    met = [(vertical <= one.largest_tvu(d)) & (horizontal <= one.largest_thu(d)) for one in SURVEY_ORDERS]
    place = np.argmax([*met, np.ones_like(met[0])], axis=0)
    return np.where(np.isfinite(vertical + horizontal), place, -1)


@dataclass(frozen=True)
class TrajectoryErrors:
    """Standard deviations of the errors of a survey's trajectory, by default those of a good inertial system."""

    pointing_mrad: float = 0.1  #: Of the beam's direction on either axis [mrad]: attitude, boresight and scanner.
    position_m: float = 0.05  #: Of the horizontal position on either axis [m].
    height_m: float = 0.05  #: Of the height of the sea surface [m]: position, range and datum.

    def __post_init__(self) -> None:
        for name in ("pointing_mrad", "position_m", "height_m"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name)))


def shift_by_slope(off_nadir: float, n: float) -> tuple[float, float]:
    """Return the shift of a point on the bottom by a slope of the sea that is taken as level.

    Parameters
    ----------
    off_nadir : float
        Angle of the beam from the vertical [rad].
    n : float
        Refractive index of the water.

    Returns
    -------
    along, across : float
        Horizontal shift per depth and slope [1], in the line of sight and across it, to first order.
    """
    turn, cos_water = float(turn_by_slope(off_nadir, n)), float(np.cos(snell(off_nadir, n)))
    return turn / cos_water**2, turn


def shift_by_pointing(off_nadir: float, height: float, depth: FloatArray, n: float) -> tuple[FloatArray, ...]:
    """Return the shift of a point on the bottom by an error of the beam's direction.

    Parameters
    ----------
    off_nadir : float
        Angle of the beam from the vertical [rad].
    height : float
        Height of the lidar above the sea [m].
    depth : ndarray
        Depths of the bottom [m].
    n : float
        Refractive index of the water.

    Returns
    -------
    along, across, up : ndarray
        Shift [m/rad] in the line of sight, across it and vertically, with the shape of `depth`, to first order: of a
        point at measured ranges, by an error of the angle from nadir (along and up), and of one across it.
    """
    water = float(snell(off_nadir, n))
    cos_air, cos_water = float(np.cos(off_nadir)), float(np.cos(water))
    turned = cos_air / (n * cos_water)  # angle in the water per angle in air
    along = height / cos_air**2 + depth * turned / cos_water**2
    across = height / cos_air + depth / (n * cos_water)
    up = height * np.tan(off_nadir) + depth * turned * np.tan(water)
    return along, across, up
