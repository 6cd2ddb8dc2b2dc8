"""How fast a lidar's column signal falls with depth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.errors import UserError
from mitransient_lidar.loading import readable_errors
from mitransient_lidar.optics.checks import FloatArray, non_negative, positive
from mitransient_lidar.optics.refraction import snell, solid_angle_per_area, surface_time_ns
from mitransient_lidar.optics.water import C0

#: Fewest bins that a slope is fitted to, and the largest relative standard error of one: logarithms bear no more.
_FEWEST_BINS, _LARGEST_ERROR = 3, 0.5

#: Standard deviations at which the beam ends.
BEAM_EDGE = 3.0


@dataclass(frozen=True)
class LidarGeometry:
    """A lidar over a level sea: what turns times of its record into ways in the water.

    Attributes
    ----------
    height, off_nadir
        Height above the mean sea level [m], angle of the axis from the vertical [rad].
    refractive_index, group_index
        Indices of the water.
    edge
        Angle from the axis beyond which the receiver sees nothing of the beam [rad].
    """

    height: float
    off_nadir: float
    refractive_index: float
    group_index: float
    edge: float

    @property
    def cos_water(self) -> float:
        """Cosine of the axis's angle from the vertical in the water."""
        return float(np.cos(snell(self.off_nadir, self.refractive_index)))

    @property
    def slant_range(self) -> float:
        """Distance to the mean sea level along the axis [m]."""
        return self.height / math.cos(self.off_nadir)

    @property
    def surface_depth(self) -> float:
        """Depth [m] that the axis has reached when the beam's far edge still meets the surface."""
        farthest = self.height / math.cos(min(self.off_nadir + self.edge, 0.5 * math.pi - 1e-3))
        return (farthest - self.slant_range) / self.group_index * self.cos_water

    def path(self, time_ns: npt.ArrayLike) -> FloatArray:
        """Way in the water to where light on the axis turns that comes back at a time [m]."""
        delay = np.asarray(time_ns, dtype=np.float64) - surface_time_ns(self.height, self.off_nadir)
        return np.asarray(1e-9 * C0 / (2 * self.group_index) * delay)

    def time_ns(self, depth: float) -> float:
        """Time at which light from a depth [m] on the axis comes back [ns]."""
        surface = float(surface_time_ns(self.height, self.off_nadir))
        return surface + 2e9 / C0 * self.group_index * depth / self.cos_water


@dataclass(frozen=True)
class ColumnBins:
    """The bins of a record between two depths.

    Attributes
    ----------
    inside
        Numbers of the bins, shape (bins,).
    path
        Way in the water of their centres [m], shape (bins,).
    gain
        What refraction and distance leave of their light [sr/m^2], shape (bins,).
    """

    inside: npt.NDArray[np.intp]
    path: FloatArray
    gain: FloatArray

    @classmethod
    def between(cls, geometry: LidarGeometry, time_ns: FloatArray, from_depth: float, to_depth: float) -> ColumnBins:
        """Find the bins [ns] between two depths [m]; raise UserError where the depths or the record do not serve."""
        with readable_errors():
            top, bottom = non_negative("from_depth", from_depth), positive("to_depth", to_depth)
        if bottom <= top:
            raise UserError(f"to_depth = {bottom:g} m must be greater than from_depth = {top:g} m")
        if top < geometry.surface_depth:
            raise UserError(
                f"from_depth = {top:g} m must be at least {geometry.surface_depth:.3g} m: until then the beam's edge "
                "meets the surface"
            )
        half = 0.5 * float(time_ns[1] - time_ns[0]) if time_ns.size > 1 else 0.0
        start, end = geometry.time_ns(top), geometry.time_ns(bottom)
        if time_ns[0] - half > start or time_ns[-1] + half < end:
            raise UserError(
                f"the record must hold {start:.1f} to {end:.1f} ns, the depths from {top:g} to {bottom:g} m: change "
                "time_start_ns or bin_count"
            )
        inside = np.flatnonzero((time_ns >= start) & (time_ns <= end))
        if inside.size < _FEWEST_BINS:
            raise UserError(
                f"from_depth = {top:g} m and to_depth = {bottom:g} m hold {inside.size} bins and must hold at least "
                f"{_FEWEST_BINS}"
            )
        path = geometry.path(time_ns[inside])
        depth = path * geometry.cos_water
        gain = solid_angle_per_area(geometry.height, depth, geometry.off_nadir, geometry.refractive_index)
        return cls(inside, path, gain)

    def weights(self, energy: FloatArray, stderr: FloatArray) -> tuple[FloatArray, float]:
        """Return what K takes of the logarithm of each bin [1/m], shape (bins,), and its standard error [1/m]."""
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


def effective_attenuation(dataset: xr.Dataset, from_depth: float, to_depth: float) -> tuple[float, float]:
    """Measure the attenuation coefficient with which a result's column signal falls between two depths.

    Parameters
    ----------
    dataset
        A result of `rendering.render`. Pixels are added up.
    from_depth, to_depth
        The depths below the mean sea level, on the axis [m], 0 <= `from_depth` < `to_depth`. No echo of the surface,
        the bottom or a target may come from between them.

    Returns
    -------
    K, stderr : float
        Attenuation coefficient [1/m] and its standard error.

    Raises
    ------
    UserError
        If the depths are out of order, the beam's edge still meets the surface at the first, the record does not hold
        them, or a bin between them has no signal or a relative standard error above 0.5.

    Notes
    -----
    The way in the water at the time t is s = c0 (t - t_surface)/(2 n_g), along the refracted axis, down to the depth
    s cos(phi). The received energy of a bin, without the pulse, is divided by the solid angle in the water that the
    aperture takes up from there (`optics.refraction.solid_angle_per_area`), and its logarithm fitted by A - 2 K s. So K
    is per metre of slant way, as c is, and singly scattered light has K = c exactly. In a wide beam off nadir every bin
    mixes depths, which leaves the slope of an exponential as it is.

    Each bin has the weight 1/e^2, where e is its relative standard error over the passes, smoothed to an exponential of
    the way s: a bin that rare paths have missed has too low a signal and too small an error, and must not weigh more.
    The standard error is the propagated one of the bins, as if they were independent. But bins of one pass share paths:
    the true error has been seen up to 1.7 times as large. `column_views.views` measures it.

    On a rough sea K holds what the sea does as well. Ripples carry light out of a narrow view, and waves that gather
    beam and view alike strengthen what comes from some metres down: single scattering with c = 0.3, wind 3 m/s and 20
    degrees off nadir fell with 0.287 (waves) to 0.304 (ripples alone, a field of 4 mrad).
    """
    attributes = dataset.attrs
    geometry = LidarGeometry(
        float(attributes["altitude"]),
        math.radians(float(attributes["off_nadir_deg"])),
        float(attributes["refractive_index"]),
        float(attributes["group_index"]),
        0.5e-3 * min(BEAM_EDGE * float(attributes["divergence_mrad"]), float(attributes["field_of_view_mrad"])),
    )
    column = ColumnBins.between(geometry, dataset["time"].values, from_depth, to_depth)
    bins = dataset.sizes["time"]
    energy = dataset["impulse_response"].values.reshape(-1, bins).sum(axis=0)[column.inside]
    stderr = np.linalg.norm(dataset["impulse_response_stderr"].values.reshape(-1, bins), axis=0)[column.inside]
    weights, error = column.weights(energy, stderr)
    return float(weights @ np.log(energy / column.gain)), error
