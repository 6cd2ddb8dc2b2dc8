"""The sea surface that a flight's own surface echoes give: its mean level, and planes that follow the long waves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree
from scipy.stats import chi2

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, finite_array, non_negative, positive

#: Speed by which times become distances [m/s], that of waves of 16 m: points from another time are of other waves.
_WAVE_SPEED = 5.0
_MOST_NEIGHBOURS, _ROWS = 24, 20_000  #: Most points of a plane, and rows in memory at a time.
#: Points at which the residual of planes is measured, and the residuals to choose from, relative to the waves' height.
_SAMPLES, _RESIDUALS = 1000, 2.0 ** np.arange(-8, 1)
#: Wave number of the waves that planes do not follow, times the root mean square distance of a plane's points.
_WAVE_NUMBER = 1.5
_CHANCE = 0.16  #: Probability of a smaller variance of heights than that of the points, one standard deviation below.
#: Smallest standard deviations of heights [m] and slopes [1], so that precise points have finite weights.
_LEAST_ERROR, _LEAST_SLOPE = 1e-6, 1e-9


class Facets(NamedTuple):
    """Sea heights and slopes at n places, with standard deviations of their errors."""

    height: FloatArray  #: [m], shape (n,).
    slope: FloatArray  #: Rise towards +x and +y [1], shape (n, 2).
    height_error: FloatArray  #: [m], shape (n,).
    slope_error: FloatArray  #: In each direction [1], shape (n, 2).


@dataclass(frozen=True, eq=False)
class SurfaceModel:
    """Mean level of the sea and, with surface points, local planes through them."""

    level: float = 0.0  #: Mean height [m], with the tide.
    level_error: float = 0.0  #: Its standard error [m].
    height_deviation: float = 0.0  #: Standard deviation of the sea's heights about the level [m].
    #: Standard deviation of the sea's slopes, averaged over a beam, in each direction [1].
    slope_deviation: float = 0.0
    radius: float = 0.0  #: Radius of the planes [m]; 0 for a level sea.
    #: Surface points for planes: x, y, z, standard deviation of z [m], time [s], shape (n, 5).
    points: FloatArray | None = None
    residual: float = 0.0  #: Standard deviation of the points about planes, by waves that are shorter [m].

    @classmethod
    def fit(
        cls,
        points: npt.ArrayLike,
        error: npt.ArrayLike,
        time_s: npt.ArrayLike,
        *,
        slope_deviation: float,
        radius: float = 2.0,
    ) -> SurfaceModel:
        """Fit level and planes to the surface points of a flight.

        Parameters
        ----------
        points
            x, y, z of the points [m], shape (n, 3).
        error
            Standard deviation of their heights [m], at least 0, shape (n,).
        time_s
            Their times [s], shape (n,).
        slope_deviation
            Standard deviation of sea slopes, averaged over a beam, in each direction [1], at least 0.
        radius
            Radius of the planes [m]; 0 for a level sea.

        Raises
        ------
        UserError
            If there is no point, shapes do not agree, or a value is out of range or not finite.

        Notes
        -----
        The level is the mean with weights 1/(error^2 + v), with the wave height variance v. This is the points'
        variance, increased by one standard deviation of its error, minus their errors' variance. A plane h + s . (r_i -
        r) is fitted at a place r. It takes the nearest points within the radius, at most 24. Weights are 1/(error_i^2 +
        residual^2), priors h ~ N(level, v) and s ~ N(0, slope_deviation^2). Where points are few, or their errors
        large, it stays level. Times count as distances of 5 m/s. The residual is the most likely one for heights
        predicted from their neighbours. The sea deviates from a plane by it; its slopes by 1.5 residuals over the plane
        points' rms distance.

        Measured in 72 cases: linear waves at winds of 3, 6 and 9 m/s, averaged over beams of 0.6 and 2 m. The cases
        have 0.5 to 10 points a square metre and errors of 2 to 15 cm. The remaining slopes have 0.24 to 1.02 times all
        slopes' standard deviation (median 0.7). Slope and height errors are 0.4 to 1.7 (median 1.0) times the stated
        ones.
        """
        table = finite_array("points", points)
        sigma, time = finite_array("error", error), finite_array("time_s", time_s)
        if table.ndim != 2 or table.shape[1] != 3 or not sigma.shape == time.shape == table.shape[:1]:
            raise UserError(
                f"points of shape {table.shape} must have the shape (n, 3), and error of shape {sigma.shape} and "
                f"time_s of shape {time.shape} one value for each"
            )
        if not len(table):
            raise UserError("the flight has no surface echo to fit the sea level to: give the level")
        if np.any(sigma < 0):
            raise UserError(f"error = {sigma.min():g} must not be negative")
        sigma, z = np.maximum(sigma, _LEAST_ERROR), table[:, 2]
        # That of few points may be larger by chance.
        freedom = len(z) - 1
        most = np.var(z) * len(z) / chi2.ppf(_CHANCE, freedom) if freedom else 0.0
        waves = max(float(most - np.mean(sigma**2)), 0.0)
        weight = 1 / (sigma**2 + waves)
        level = cls(
            float(np.sum(weight * z) / np.sum(weight)),
            float(1 / np.sqrt(np.sum(weight))),
            float(np.sqrt(waves)),
            non_negative("slope_deviation", slope_deviation),
        )
        if non_negative("radius", radius) == 0 or waves == 0 or slope_deviation == 0:
            return level
        table = np.column_stack([table, sigma, time])
        candidates = [
            replace(level, radius=positive("radius", radius), points=table, residual=float(one))
            for one in _RESIDUALS * level.height_deviation
        ]
        sample = table[:: max(len(table) // _SAMPLES, 1)]
        return max(candidates, key=lambda one: one._log_likelihood(sample))

    def _log_likelihood(self, sample: FloatArray) -> float:
        """Return the log probability of its points' heights, each predicted from its neighbours."""
        x, y, z, error, time = sample.T
        found = self._planes(np.column_stack([x, y]), time, first=1)
        variance = found.height_error**2 + error**2
        return float(-0.5 * np.sum(np.log(variance) + (z - found.height) ** 2 / variance))

    def at(self, places: FloatArray, time_s: FloatArray) -> Facets:
        """Return heights and slopes at places x, y [m], shape (n, 2), and times [s], shape (n,)."""
        if self.points is not None:
            starts = range(0, max(len(places), 1), _ROWS)
            parts = [self._planes(places[i : i + _ROWS], time_s[i : i + _ROWS]) for i in starts]
            return Facets(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        count = len(places)
        return Facets(
            np.full(count, self.level),
            np.zeros((count, 2)),
            np.full(count, np.hypot(self.level_error, self.height_deviation)),
            np.full((count, 2), self.slope_deviation),
        )

    @cached_property
    def _tree(self) -> KDTree:
        """The points by place and time, as distances."""
        assert self.points is not None
        return KDTree(self.points[:, [0, 1, 4]] * [1.0, 1.0, _WAVE_SPEED])

    def _planes(self, places: FloatArray, time_s: FloatArray, first: int = 0) -> Facets:
        """Return planes through the points about places, without the `first` nearest ones."""
        assert self.points is not None
        x, y, z, error, _ = self.points.T
        ranks = np.arange(1 + first, 1 + first + _MOST_NEIGHBOURS)
        place = np.column_stack([places, _WAVE_SPEED * time_s])
        distance, index = self._tree.query(place, k=ranks, distance_upper_bound=self.radius)
        # Absent neighbours have the index n.
        near = index < len(x)
        index = np.where(near, index, 0)
        weight = near / (error[index] ** 2 + max(self.residual, _LEAST_ERROR) ** 2)
        terms = np.stack([np.ones(index.shape), x[index] - places[:, :1], y[index] - places[:, 1:]], axis=-1)
        prior = np.array([self.height_deviation, *2 * [max(self.slope_deviation, _LEAST_SLOPE)]]) ** -2.0
        normal = np.einsum("nk,nki,nkj->nij", weight, terms, terms) + np.diag(prior)
        covariance = np.linalg.inv(normal)
        right = np.einsum("nk,nki->ni", weight * (z[index] - self.level), terms)
        found = np.einsum("nij,nj->ni", covariance, right)
        # The sea deviates from its plane by the waves that the residual is of.
        reach = np.sqrt(np.sum(np.where(near, distance, 0) ** 2, axis=1) / np.maximum(near.sum(axis=1), 1))
        steepness = _WAVE_NUMBER * self.residual / np.where(reach > 0, reach, np.inf)
        short = np.stack([np.full(len(places), self.residual), steepness, steepness], axis=1)
        errors = np.minimum(np.sqrt(np.einsum("nii->ni", covariance) + short**2), prior**-0.5)
        return Facets(found[:, 0] + self.level, found[:, 1:], errors[:, 0], errors[:, 1:])
