"""Column signal decay with depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, non_negative, positive
from mitransient_lidar.physics.lidar.lidar_geometry import LidarGeometry
from mitransient_lidar.physics.lidar.time_axis import TimeAxis

_FEWEST_BINS = 3  # in a fit
_LARGEST_ERROR = 0.5  # relative standard error of a bin: a noisier one has a biased logarithm

#: Beam edge in standard deviations.
BEAM_EDGE = 3.0


@dataclass(frozen=True)
class ColumnBins:
    """Record bins between two depths, shape (bins,) each.

    Indices, one-way paths in the water to their centres [m], and solid angles of the aperture per area [sr/m^2].

    Notes
    -----
    The one-way path in the water at the time t is s = c0 (t - t_surface)/(2 n_g), along the refracted axis, to the
    depth s cos(phi). The impulse response is divided by the aperture's solid angle in the water
    (`refraction.solid_angle_per_area`), and its logarithm fitted by A - 2 K s. K is per metre of slant path; K = c for
    singly scattered light, even in a wide beam off nadir, since a mean over depths has the exponential's slope.

    K depends on the sea. Ripples scatter light out of a narrow field of view. Waves that focus both beam and view
    increase the signal from some metres below. Single scattering with c = 0.3, wind 3 m/s and 20 degrees off nadir gave
    0.287 (waves) to 0.304 (ripples alone, a field of view of 4 mrad).
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
        depths are out of order, the surface echo at the beam's edge reaches below the first, or the record does not
        include them and at least 3 bins between them.
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
