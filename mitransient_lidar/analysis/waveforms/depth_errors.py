"""Typical errors of depths by scattering, by the light's distribution in the pixels and by waves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.waveforms.echo_detection import BoolArray
from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry, snell, turn_by_slope
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA
from mitransient_lidar.physics.water.phase import petzold_average_particle
from mitransient_lidar.physics.water.seawater import water_scattering
from mitransient_lidar.physics.water.water_types import PETZOLD_BACKSCATTER_RATIO
from mitransient_lidar.results.geometry import Attributes, LinesOfSight, lidar_system, optional_number

# Constants from 40 random level seas (1 to 10 mrad, 100 to 400 m, 0 to 30 degrees off nadir, absorption 0.04 to 0.25,
# scattering 0.02 to 0.6 1/m, 3 to 15 m deep), and of waves from shots at 4, 6 and 9 m/s.
_LEAST = 0.0005  # relative to the depth
# Share of a pixel's echo that arrives with those of the other pixels. A centroid in gates includes more of its tail.
_OF_NEIGHBOURS, _OF_GATED_NEIGHBOURS = 0.12, 0.2
_FARTHEST_NEIGHBOUR = 1.5  # largest deviation of arrivals that counts, in pulses
_OF_SKEW = 0.25  # of a resolved echo, relative to the spread of the arrival over the light of the pixel
_OF_LEVEL_SURFACE, _OF_WAVES, _OF_COLUMN = 0.4, 0.85, 1.0  # of the time of a surface, relative to this spread
_OF_PULSE, _OF_LOST_PULSE = 0.03, 0.15  # of the time of a surface, distinct and not, relative to the pulse
_LEAST_SHARE = 0.05  # of the beam in a pixel whose column counts, relative to the brightest pixel
_SMALLEST_SHARE = 1e-9  # of the beam in a pixel that results store
_TYPICAL_ATTENUATION = 0.14  # of a column that is too short for a fit [1/m]
_TYPICAL_BACKSCATTERING = 0.05  # relative to the attenuation of the column
_ANGLES, _DISTANCES = (1e-3, 1.5, 160), 128  # scattering angles [rad], and distances to the bottom, of the delay
_OF_VIEW = 0.32  # standard deviation of a Gaussian whose integral times r^2 is a disk's, relative to its diameter
_BY_MOLECULES = 0.5 * float(water_scattering(532.0))  # backscattering of sea water without particles [1/m]
TYPICAL_SLOPE_VARIANCE = 0.04  # of a sea without the attribute surface_slope_variance
# Slope of waves averaged over a beam of 2 m, relative to the standard deviation of all slopes; its power of the width.
_MEAN_SLOPE, _OF_WIDTH, _WIDTH = 0.4, -0.25, 2.0
#: Standard deviations from the lowest to the highest point of a sea.
HEIGHTS = 8.0


@dataclass(frozen=True)
class DepthErrors:
    """Method errors of depths measured by Gaussian decomposition."""

    #: Lines of sight with arrays of shape (n,), n waveforms, all pixels of a shot before the next shot.
    lines: LinesOfSight
    shots: int  #: Number of shots.
    beam_width: float  #: Diameter of the beam at e^-1/2 of its peak, or of the view if that is smaller, on the sea [m].
    view_width: float  #: Diameter of the field of view on the sea [m], or of the beam where it is not known.
    pulse_ns: float  #: Full width of an ideal echo at half maximum [ns].
    #: Indices of the water.
    refractive_index: float
    group_index: float
    slope: float  #: Standard deviation of the slopes averaged over a pixel [1], 0 for a level sea with ripples.
    height: float  #: Standard deviation of the sea's height [m].
    slope_variance: float  #: Variance of all slopes [1].
    gain: float  #: Power of the column at the surface per backscattering coefficient [W m], NaN if unknown.
    #: Width of the bins in which light was recorded before pulse and response [ns], 0 if it was not rendered.
    bin_ns: float

    @classmethod
    def of(
        cls, attributes: Attributes, lines: LinesOfSight, shots: int, geometry: LidarGeometry, pulse_ns: float
    ) -> DepthErrors:
        """Read a result's attributes; without sea heights it has waves, without a beam a narrow one."""
        widths = [optional_number(attributes, f"{name}_mrad") for name in ("divergence", "field_of_view")]
        known = [1e-3 * geometry.slant_range * one for one in widths if one is not None] or [0.0]
        width = min(known)
        lowest, highest = attributes.get("surface_heights_m", (math.nan, math.nan))
        slope, variance = mean_slope(attributes, width), _slope_variance(attributes)
        height = (highest - lowest) / HEIGHTS if math.isfinite(highest - lowest) else 0.0
        n, group = geometry.refractive_index, geometry.group_index
        gain = column_gain(attributes)
        bin_ns = rendered_bin_ns(attributes)
        return cls(lines, shots, width, known[-1], pulse_ns, n, group, slope, height, variance, gain, bin_ns)

    def of_surface(self, faint: BoolArray) -> FloatArray:
        """Return the time errors of surface echoes [ns], shape (n,).

        A surface echo's light comes from few places in the pixel, which determine its time. Without a distinct
        (`faint`) echo, it is that of the column's onset. Echo and column overlap by a pulse, which limits the accuracy
        even of a narrow beam. `rounding_ns` is added.
        """
        share = np.where(faint, _OF_COLUMN, _OF_LEVEL_SURFACE if self.slope == 0 else _OF_WAVES)
        overlap = np.where(faint, _OF_LOST_PULSE, _OF_PULSE) * self.pulse_ns
        spread = self.lines.surface_spread
        return np.asarray(np.hypot(np.hypot(share * spread, overlap), rounding_ns(spread, self.bin_ns)))

    def of_land(self) -> FloatArray:
        """Return the time errors of land [ns], shape (n,)."""
        return np.hypot(_OF_PULSE * self.pulse_ns, rounding_ns(self.lines.surface_spread, self.bin_ns))

    def of_echoes(
        self,
        time_ns: FloatArray,
        depth: FloatArray,
        attenuation: FloatArray,
        level: FloatArray,
        *,
        width_ns: npt.ArrayLike = 0.0,
        from_mean: bool,
        gated: bool = False,
    ) -> FloatArray:
        """Return the depth errors [m] without the surface time errors.

        Parameters
        ----------
        time_ns, depth : ndarray, shape (n, ...)
            Arrival times [ns] and depths [m] of the echoes.
        attenuation, level : ndarray, shape (n,)
            Attenuation K of the columns along the path [1/m], and their power at the surface [W]; NaN if unknown.
        width_ns : array_like, shape (n, ...)
            Full widths of the echoes at half maximum [ns]; NaN or 0 if unknown.
        from_mean : bool
            Whether depths are from the mean sea level.
        gated : bool
            Whether times are centroids of energies in gates.

        Notes
        -----
        Root sum square of:

        - the delay of scattered light; see `delays`. The backscattering bb follows from the column level, and is 0.05 K
          where no level is known;
        - undercutting: light that was scattered sideways and meets an extended echo early has been attenuated less, by
          exp(-2 K x) for a path shorter by x each way. An echo of the standard deviation q in depth, without that of
          pulse and pixel, is early by 2 K q^2/cos(theta_w). Where K is unknown, it is bb/0.05;
        - the render's bins, where neither pixel nor delay spreads the light over several; see `rounding_ns`;
        - the longer paths through ripples, v d for the depth d. Slopes turn rays by 1 - 1/n times themselves, and v is
          the variance of these angles in one direction. A narrow view sees light that ripples turn alike on both ways,
          with (q + s^2)/(2 q + s^2) of v, for displacements of the variance q = v d^2, and s^2 as in `delays`;
        - light scattered from other pixels: 0.12 of the arrival's deviation from the beam-weighted mean over pixels, or
          0.2 in gates;
        - the skew of echoes that are longer than the pulse because the pixel is extended;
        - refraction by waves: a slope s turns the ray by s (1 - cos(theta)/(n cos(theta_w))), and the depth changes by
          tan(theta_w) times this angle, to first order;
        - from the mean sea level, the height h of the waves: the depth changes by h (1 - cos(theta_w)/(n_g
          cos(theta))), since light in the water is slower.
        """
        lines = self.lines
        cos_air = np.cos(lines.off_nadir)
        water = snell(lines.off_nadir, self.refractive_index)
        turned = self.slope * np.tan(water) * turn_by_slope(lines.off_nadir, self.refractive_index)
        pulse = self.pulse_ns / FWHM_PER_SIGMA
        resolved = np.hypot(lines.surface_spread, max(pulse, 1e-9))
        skew = _OF_SKEW * lines.surface_spread**2 / resolved
        constant = lines.depth_of_delay(skew)
        if from_mean:
            by_height = self.height * (1 - np.cos(water) / (self.group_index * cos_air))
            constant = np.hypot(constant, by_height)
        shape = (-1, *(1,) * (depth.ndim - 1))
        scattered = self.backscattering(attenuation, level)
        delay = self.delays(depth, scattered.reshape(shape))
        fades = np.where(np.isfinite(attenuation), np.maximum(attenuation, 0), scattered / _TYPICAL_BACKSCATTERING)
        wide = (np.nan_to_num(width_ns) / FWHM_PER_SIGMA) ** 2 - (resolved**2).reshape(shape)
        per_ns = lines.depth_per_ns.reshape(shape)
        early = 2 * per_ns**2 * np.maximum(wide, 0) * (fades / np.cos(water)).reshape(shape)
        rounding = per_ns * rounding_ns(np.hypot(lines.surface_spread.reshape(shape), delay / per_ns), self.bin_ns)
        of_ripples = 0.5 * self.slope_variance * float(turn_by_slope(0, self.refractive_index)) ** 2
        apart, seen = of_ripples * depth**2, self._seen**2
        both = np.divide(apart + seen, 2 * apart + seen, out=np.ones(depth.shape), where=apart > 0)
        later = delay + of_ripples * depth * both
        relative = np.hypot(_LEAST, turned).reshape(shape) * depth
        share = _OF_GATED_NEIGHBOURS if gated else _OF_NEIGHBOURS
        neighbours = lines.depth_of_delay(share * self._from_all_pixels(time_ns))
        of_pixel = np.hypot(np.hypot(later, relative), np.hypot(constant.reshape(shape), np.hypot(early, rounding)))
        return np.asarray(np.hypot(of_pixel, neighbours))

    def delays(self, depth: FloatArray, backscattering: FloatArray) -> FloatArray:
        """Return how much deeper bottoms seem by light that the water has scattered [m], in the shape of the depths.

        Parameters
        ----------
        depth : ndarray
            Depths [m], NaN if unknown.
        backscattering : ndarray
            Backscattering coefficients bb of the water [1/m], in a shape that broadcasts to that of the depths.

        Notes
        -----
        An event by the angle t at the distance u from the bottom, on the way down or up, lengthens the path by x = u
        (1/cos t - 1) and displaces it by r = u tan t. Each scattering counts with three factors: Petzold's
        average-particle phase function, for bb/b of 0.0183 without the molecules' bb; the share exp(-r^2/(2 s^2)) of
        such light in the view, with s^2 = (w/2)^2 + (0.32 v)^2 for the beam and view diameters w and v; and exp(-x^2/(4
        p^2)), by which a fit of a Gaussian with the standard deviation p follows light that is later by x. The sum of b
        x over the events of one way, half of both ways, is the delay D while it is small. Light later than an echo's
        width e hardly moves the echo, which thus has the delay D/(1 + D/e).
        """
        deepest = float(np.nanmax(depth, initial=0.0))
        metres = 0.5e-9 * C0 / self.group_index * self.pulse_ns
        spread = self._seen
        if min(deepest, metres, spread) <= 0:
            return np.zeros(depth.shape)
        angle = np.geomspace(*_ANGLES)
        distance = np.linspace(0, deepest, _DISTANCES)
        longer = distance[:, np.newaxis] * (1 / np.cos(angle) - 1)
        away = distance[:, np.newaxis] * np.tan(angle) / spread
        # Both ways of light that is as late as an echo's depth at half maximum.
        late = longer * FWHM_PER_SIGMA / (2 * metres)
        seen = 2 * np.pi * petzold_average_particle()(angle) * np.sin(angle) * np.exp(-0.5 * away**2 - 0.25 * late**2)
        inner = np.asarray(np.trapezoid(seen * longer, angle, axis=1))
        total = np.append(0.0, np.cumsum(0.5 * (inner[1:] + inner[:-1]))) * (distance[1] - distance[0])
        particles = np.maximum(backscattering - _BY_MOLECULES, 0) / PETZOLD_BACKSCATTER_RATIO
        delay = np.interp(depth, distance, total) * particles
        return np.asarray(delay / (1 + delay / metres))

    @property
    def _seen(self) -> float:
        """Standard deviation of the displacement on the bottom by which light is still seen [m]."""
        return math.hypot(0.5 * self.beam_width, _OF_VIEW * self.view_width)

    def of_scattered_light(self, depth: FloatArray, dark: BoolArray) -> FloatArray:
        """Return the errors of depths [m], shape (n, ...), in pixels without direct light, shape (n,), 0 in others.

        Light that is scattered to such a pixel, at the distance r from the beam's axis, has slant paths to the bottom
        and back. They exceed the depth d by sqrt(d^2 + r^2) - d. The distance is that at which a Gaussian beam has the
        pixel's share of the brightest pixel's light, stored to 9 decimals.
        """
        share = np.nan_to_num(self.lines.beam_share)
        relative = np.maximum(share, _SMALLEST_SHARE) / max(float(share.max(initial=0.0)), _SMALLEST_SHARE)
        away = np.where(dark, self.beam_width * np.sqrt(-0.5 * np.log(relative)), 0.0)
        below = np.maximum(depth, 0)
        return np.asarray(np.hypot(below, away.reshape(-1, *(1,) * (depth.ndim - 1))) - below)

    def backscattering(self, attenuation: FloatArray, level: FloatArray) -> FloatArray:
        """Return the backscattering coefficients of the columns [1/m], shape (n,), one for all pixels of a shot.

        Without a level, those that are typical of the attenuation; parameters are those of `of_echoes`.
        """
        known = np.where(np.isfinite(attenuation), np.maximum(attenuation, 0), _TYPICAL_ATTENUATION)
        share = self.lines.beam_share.reshape(self.shots, -1)
        power = level.reshape(share.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            lit = np.isfinite(power) & (share >= _LEAST_SHARE * share.max(axis=1, keepdims=True))
            measured = np.where(lit, power / (share * self.gain), np.nan)
        # The median, as levels of faint columns may be wrong by orders of magnitude.
        some = np.where(np.isfinite(measured).any(axis=1, keepdims=True), measured, 0)
        median = np.nanmedian(some, axis=1, keepdims=True)
        unknown = ~np.isfinite(measured).any(axis=1, keepdims=True)
        found = np.broadcast_to(np.where(unknown, np.nan, np.maximum(median, 0)), share.shape).ravel()
        return np.asarray(np.where(np.isfinite(found), found, _TYPICAL_BACKSCATTERING * known))

    def _from_all_pixels(self, time_ns: FloatArray) -> FloatArray:
        """Return arrivals minus their beam-weighted mean over a shot's pixels [ns].

        They are limited to 1.5 pulses, beyond which echoes do not overlap.
        """
        time = time_ns.reshape(self.shots, -1, *time_ns.shape[1:])
        share = np.nan_to_num(self.lines.beam_share).reshape(time.shape[:2] + (1,) * (time.ndim - 2))
        weight = np.where(np.isfinite(time), share, 0)
        total = weight.sum(axis=1, keepdims=True)
        mean = np.sum(weight * np.nan_to_num(time), axis=1, keepdims=True) / np.where(total > 0, total, 1.0)
        farthest = _FARTHEST_NEIGHBOUR * self.pulse_ns
        return np.asarray(np.where(total > 0, np.clip(time - mean, -farthest, farthest), 0).reshape(time_ns.shape))


def rendered_bin_ns(attributes: Attributes) -> float:
    """Return the bin width of a result's render [ns], 0 if unknown; record bins may be wider."""
    widths = (optional_number(attributes, name) for name in ("rendered_bin_width_ns", "bin_width_ns"))
    return next((width for width in widths if width is not None), 0.0)


def rounding_ns(spread_ns: npt.ArrayLike, bin_ns: float) -> FloatArray:
    """Return the time error [ns] of light rendered into bins, shaped as its spread.

    Light with a short spread s in one bin of width w has the time of the bin's middle. The error is w/sqrt(12), times
    exp(-2 pi^2 (s/w)^2), as for a binned Gaussian's centroid.
    """
    relative = np.asarray(spread_ns) / max(bin_ns, 1e-9)
    return np.asarray(bin_ns / math.sqrt(12) * np.exp(-2 * (math.pi * relative) ** 2))


def mean_slope(attributes: Attributes, width: float) -> float:
    """Return the standard deviation, in each direction, of the sea's slopes averaged over a beam [1].

    Parameters
    ----------
    attributes
        Attributes of a result. The sea's are ``surface_slope_variance`` [1], by default 0.04, and
        ``surface_heights_m``, two equal numbers for a level sea, whose slopes are 0.
    width
        Beam diameter on the sea [m].
    """
    lowest, highest = attributes.get("surface_heights_m", (math.nan, math.nan))
    if highest - lowest < 1e-6:
        return 0.0
    share = min(_MEAN_SLOPE * (max(width, 1e-3) / _WIDTH) ** _OF_WIDTH, 1.0)
    return float(share * math.sqrt(0.5 * _slope_variance(attributes)))


def _slope_variance(attributes: Attributes) -> float:
    """Return the variance of all sea slopes [1]."""
    variance = optional_number(attributes, "surface_slope_variance")
    return TYPICAL_SLOPE_VARIANCE if variance is None else variance


def column_gain(attributes: Attributes) -> float:
    """Return the power of the column at the surface per backscattering coefficient [W m], NaN if it is unknown.

    The phase function at 180 degrees is taken as bb/(2 pi b).
    """
    try:
        return lidar_system(attributes).column_gain / (2 * math.pi)
    except UserError:
        return math.nan
