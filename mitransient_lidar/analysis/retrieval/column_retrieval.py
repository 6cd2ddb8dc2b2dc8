"""Decay of the column's signal with depth; from it, water properties and bottom reflectance.

Coefficients are in 1/m, lengths in m. A column's level and decay determine two properties, bb and a (hence Kd). The
third, c, requires a narrow field of view or an assumption about bb/b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, non_negative, positive
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.physics.lidar.time_axis import TimeAxis
from mitransient_lidar.physics.water.seawater import water_scattering
from mitransient_lidar.physics.water.water_types import PETZOLD_BACKSCATTER_RATIO

_FEWEST_BINS = 3  # in a fit
_LARGEST_ERROR = 0.5  # relative standard error of a bin: a noisier one has a biased logarithm
BEAM_EDGE = 3.0  #: Beam edge in standard deviations.


@dataclass(frozen=True)
class ColumnBins:
    """Record bins between two depths, shape (bins,) each.

    Indices, one-way paths in the water to their centres [m], and solid angles of the aperture per area [sr/m^2].

    The one-way path in the water at the time t is s = c0 (t - t_surface)/(2 n_g), along the refracted axis, to the
    depth s cos(phi). The impulse response is divided by the aperture's solid angle in the water
    (`refraction.solid_angle_per_area`), and its logarithm fitted by A - 2 K s. K is per metre of slant path; K = c for
    singly scattered light, even in a wide beam off nadir, since a mean over depths has the exponential's slope.

    K depends on the sea. Ripples scatter light out of narrow fields of view. Waves that focus both beam and view
    increase the signal from some metres below. Single scattering (c = 0.3, 3 m/s, 20 degrees off nadir) gave 0.287 with
    waves, and 0.304 with ripples alone and a 4 mrad field of view.
    """

    inside: npt.NDArray[np.intp]
    path: FloatArray
    gain: FloatArray

    @classmethod
    def between(
        cls, geometry: LidarGeometry, edge: float, time: TimeAxis, min_depth: float, max_depth: float
    ) -> ColumnBins:
        """Return the record bins between two depths [m], 0 <= `min_depth` < `max_depth`.

        `edge` is the largest angle from the axis of light that the receiver detects [rad]. Raises `UserError` if the
        depths are out of order, or the surface echo at the beam's edge reaches below the first. The record must include
        them, with at least 3 bins between them.
        """
        top, bottom = non_negative("min_depth", min_depth), positive("max_depth", max_depth)
        if bottom <= top:
            raise UserError(f"max_depth = {bottom:g} m must be greater than min_depth = {top:g} m")
        surface_depth = geometry.surface_depth(edge)
        if top < surface_depth:
            raise UserError(
                f"min_depth = {top:g} m must be at least {surface_depth:.3g} m: above it, the beam's edge still meets "
                "the surface"
            )
        start, end = (float(geometry.time_of_depth(depth)) for depth in (top, bottom))
        if time.start_ns > start or time.end_ns < end:
            raise UserError(
                f"the record must contain {start:.1f} to {end:.1f} ns, the depths from {top:g} to {bottom:g} m: change "
                "time_start_ns or bin_count"
            )
        centres = time.centres_ns
        inside = np.flatnonzero((centres >= start) & (centres <= end))
        if inside.size < _FEWEST_BINS:
            raise UserError(
                f"min_depth = {top:g} m and max_depth = {bottom:g} m have {inside.size} bins between them and must "
                f"have at least {_FEWEST_BINS}"
            )
        path = geometry.path_of_time(centres[inside])
        return cls(inside, path, geometry.solid_angle_per_area(path))

    def weights(self, energy: FloatArray, stderr: FloatArray) -> tuple[FloatArray, float]:
        """Return the weights of the bins' logarithms in K [1/m], shape (bins,), and its standard error [1/m].

        Weights are 1/e^2, where e is the relative standard error, smoothed to an exponential in s. A bin without rare
        paths has too low a signal and too small an error. The standard error assumes independent bins. Bins in one pass
        share paths: the true error can be up to 1.7 times as large; `fov_sweep` estimates it from the passes. Raises
        `UserError` if a bin has no signal, or a relative standard error above 0.5.
        """
        if np.any(energy <= 0):
            raise UserError(f"the column has no signal in {np.count_nonzero(energy <= 0)} of {energy.size} bins")
        error = np.maximum(stderr / energy, 1e-12)
        if error.max() > _LARGEST_ERROR:
            raise UserError(
                f"the column's relative standard error, {error.max():.2g} in its worst bin, must be at most "
                f"{_LARGEST_ERROR:g}: render more passes or choose less depth"
            )
        precision = np.exp(-2 * np.polyval(np.polyfit(self.path, np.log(error), 1), self.path))
        offset = self.path - np.average(self.path, weights=precision)
        weights = -0.5 * precision * offset / np.sum(precision * offset**2)
        return weights, float(np.linalg.norm(weights * error))


#: Smallest diameter of the field of view on the sea [m]: below it, light that leaves the view is not distinct from
#: attenuation.
SMALLEST_SPOT = 6.0

METHOD_ERROR = 0.1  #: Relative error of bb and Kd by the method.

#: Particle bb/b: the typical value, and a range that includes most natural waters.
BACKSCATTER_RATIO, BACKSCATTER_RATIOS = PETZOLD_BACKSCATTER_RATIO, (0.003, 0.05)


@dataclass(frozen=True)
class WaterEstimate:
    """Water from a column's signal [1/m]; arrays with one shape, NaN where no water fits.

    They are a, bb, and Kd for downwelling irradiance with the sun at the zenith. The beam attenuation c is given for
    the typical particle bb/b, and for the largest and the smallest.
    """

    absorption: FloatArray
    backscattering: FloatArray
    kd: FloatArray
    attenuation: FloatArray
    attenuation_low: FloatArray
    attenuation_high: FloatArray

    def errors(self, decay_error: FloatArray, level_error: FloatArray) -> dict[str, FloatArray]:
        """Return the standard errors of ``absorption``, ``backscattering`` and ``kd`` by noise and method [1/m].

        `decay_error` is the error of the column's attenuation [1/m], `level_error` the relative error of its level. The
        method's errors are 10 % of bb and Kd: in ten rendered waters the largest errors were 10 and 13 %.
        """
        backscattering = self.backscattering * np.hypot(METHOD_ERROR, level_error)
        kd = np.hypot(METHOD_ERROR * self.kd, decay_error)
        per_bb = (self.kd - self.absorption) / np.where(self.backscattering > 0, self.backscattering, np.nan)
        return {"absorption": np.hypot(kd, per_bb * backscattering), "backscattering": backscattering, "kd": kd}


def water_of_column(decay: npt.ArrayLike, backscatter: npt.ArrayLike, excess: float, level: float) -> WaterEstimate:
    """Estimate absorption, backscattering, Kd and bounds of c from a column in a wide view.

    The attenuation K along the path is that in the column's signal, exp(-2 K s) [1/m]. The backscatter b p(pi) [1/(m
    sr)] includes multiple scattering. It is the power at the surface, extrapolated with K, over
    `LidarSystem.column_gain` and the fraction of the beam in view. `excess` is K minus the absorption [1/m], and
    `level` the backscatter over bb/(2 pi), from `scattered_light.ScatteredLight`.

    Kd follows Lee, Du and Arnone (2005), doi:10.1029/2004JC002275. c is ill-posed: the signal hardly depends on forward
    scattering. The estimate is a + bw + (bb - bw/2)/r, with the scattering bw by sea water at 532 nm. It is given for
    particles with r = 0.0183 (Petzold's average particle), 0.05 and 0.003. The waters in `water_types` have 0.0033
    (chlorophyll 30 mg/m^3) to 0.0198 (Petzold's turbid water).
    """
    fall, seen = np.broadcast_arrays(np.asarray(decay, dtype=np.float64), np.asarray(backscatter, dtype=np.float64))
    a, bb = fall - excess, 2 * np.pi * seen / level
    known = np.isfinite(a) & np.isfinite(bb) & (a > 0) & (bb > 0)
    a, bb = (np.where(known, one, 1.0) for one in (a, bb))
    molecules = float(water_scattering(532.0))
    particles = np.maximum(bb - molecules / 2, 0)
    usual, low, high = (
        a + molecules + particles / ratio for ratio in (BACKSCATTER_RATIO, *reversed(BACKSCATTER_RATIOS))
    )
    return WaterEstimate(*(np.where(known, value, np.nan) for value in (a, bb, _kd(a, bb), usual, low, high)))


def _kd(absorption: FloatArray, backscattering: FloatArray) -> FloatArray:
    """Return the diffuse attenuation [1/m] by Lee, Du and Arnone (2005), which depends on the scattering by bb only."""
    return np.asarray(absorption + 4.18 * (1 - 0.52 * np.exp(-10.8 * absorption)) * backscattering)


def bottom_reflectance(
    energy: npt.ArrayLike,
    column_power: npt.ArrayLike,
    backscatter: npt.ArrayLike,
    cos_vertical: npt.ArrayLike,
    group_index: float,
) -> FloatArray:
    """Return a Lambertian bottom's reflectance from its echo over the column's signal at the same time.

    It is rho = pi (c0/2 n_g) backscatter energy/(power cos(alpha)) [1], NaN where the column is unknown. It needs the
    bottom echo's energy [J], the column's power [W], extrapolated to the echo's time, and its backscatter [1/(m sr)].
    The angle alpha is the light's angle from the vertical in the water.

    The ratio is independent of pulse energy, atmosphere, attenuation, and the surface's transmittance, slope and
    focusing, and thus corrects a shot for the sea surface. Assumptions: the same water in all shots, homogeneous down
    to the bottom. An absolute reflectance is as accurate as the backscatter.
    """
    power = np.asarray(column_power, dtype=np.float64)
    known = power > 0
    speed = C0 / (2 * group_index)
    scale = np.pi * speed * np.asarray(backscatter) / np.asarray(cos_vertical)
    return np.asarray(np.where(known, scale * np.asarray(energy) / np.where(known, power, 1.0), np.nan))


#: Bottom classes and their lower edges of reflectance at 532 nm: mud and vegetation are dark; gravel, rock and mixed
#: bottoms medium; sand and shell bright. These edges are a convention: bottoms of one kind vary by a factor of 2, and a
#: single wavelength does not resolve more classes.
BOTTOM_CLASSES = {"dark": 0.0, "medium": 0.1, "bright": 0.2}


def bottom_class(reflectance: npt.ArrayLike, stderr: npt.ArrayLike) -> FloatArray:
    """Return the probabilities of `BOTTOM_CLASSES`, shape (..., classes).

    A probability is the fraction of a Gaussian about the reflectance in the class; values below 0 count as the first.
    Reflectance and standard error [1] broadcast, and are NaN where unknown.
    """
    from scipy.special import ndtr

    lower = np.array(list(BOTTOM_CLASSES.values()))
    value, error = np.broadcast_arrays(np.asarray(reflectance, dtype=np.float64), np.asarray(stderr, dtype=np.float64))
    distance = lower[1:] - value[..., np.newaxis]
    sharp = np.where(distance > 0, np.inf, -np.inf)
    wide = np.where(error > 0, error, 1.0)[..., np.newaxis]
    below = np.where(np.isnan(distance), np.nan, ndtr(np.where(error[..., np.newaxis] > 0, distance / wide, sharp)))
    ends = np.concatenate([np.zeros_like(value)[..., np.newaxis], below, np.ones_like(value)[..., np.newaxis]], axis=-1)
    return np.where(np.isnan(value)[..., np.newaxis], np.nan, np.diff(ends, axis=-1))
