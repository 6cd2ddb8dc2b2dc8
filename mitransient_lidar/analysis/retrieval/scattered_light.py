"""Light that water scatters forwards, in a column's signal and in a bottom's echo.

Column and bottom do not decay alike. Light that forward scattering has turned from its ray meets more water per depth.
It returns by other angles than 180 degrees, and the column gains on the bottom with depth. Light from both leaves the
field of view. `physics.lidar.echo_estimate` gives both signals for a water; this module finds the water whose column
has a measured level and decay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from mitransient_lidar.analysis.retrieval import surface_inputs
from mitransient_lidar.analysis.retrieval.column_retrieval import BACKSCATTER_RATIO
from mitransient_lidar.analysis.waveforms.depth_errors import TYPICAL_SLOPE_VARIANCE
from mitransient_lidar.analysis.waveforms.records import Waveforms
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.echo_estimate import Arrivals, water_and_bottoms
from mitransient_lidar.physics.lidar.level_sea import LidarSystem
from mitransient_lidar.physics.water.phase import fournier_forand_parameters
from mitransient_lidar.physics.water.phase_table import PowerLawTable
from mitransient_lidar.physics.water.seawater import water_phase_function, water_scattering
from mitransient_lidar.results.geometry import optional_number, required_number

_PATHS = (512, 1024, 1024, 4096)  # light paths in the successive estimates of a water
_FIRST_LEVEL = 1.2  # of the column's exponential over bb/(2 pi), before an estimate
_STEPS = 32  # of depth
_BIN, _BEHIND = 0.25, 6.0  # of the column along the path, and its end after the bottom [m]
_BELOW = 3.0  # echo widths of water below a column without a bottom
_LEAST_ABSORPTION = 0.02  # over the column's attenuation
_MOST_BACKSCATTERING = 0.2  # [1/m]
_SHIFTS, _TURNS = 256, 32  # nodes for the share of a beam in view, and directions of shifts
_MODE = 6  # iterations for an echo's time
_ALONG, _ACROSS = 2.0, 1.6  # longest path of light turned twice over its depth, and over the view's radius


@dataclass(frozen=True)
class View:
    """Lidar in an estimate of scattered light."""

    system: LidarSystem  #: The lidar, its energy and aperture without effect.
    radius: float  #: Half angle of the field of view [rad].
    centre: float  #: Angle of its middle from the beam's axis [rad].
    beam: float  #: Beam standard deviation [rad].
    slope_variance: float  #: Total variance of the sea's slopes [1].
    echo_width: float  #: Full width at half maximum of an echo, as a path in the water [m].

    @classmethod
    def of(cls, dataset: xr.Dataset, system: LidarSystem, echo_width: float) -> View:
        """Return the view of all pixels in a result as a circle, with the beam in its attributes."""
        radius, beam = (
            0.5e-3 * required_number(dataset.attrs, name) for name in ("field_of_view_mrad", "divergence_mrad")
        )
        known = optional_number(dataset.attrs, "surface_slope_variance")
        variance, centre = TYPICAL_SLOPE_VARIANCE if known is None else known, 0.0
        if lines := [line for pixel in surface_inputs.outlines(dataset) for line in pixel]:
            corners = np.concatenate(lines)
            low, high = corners.min(axis=0), corners.max(axis=0)
            radius, centre = float(np.mean(0.5 * (high - low))), float(np.hypot(*(0.5 * (high + low))))
        return cls(system, radius, centre, beam, variance, echo_width)

    def share(self, shift: FloatArray) -> FloatArray:
        """Return the beam share in the field of view, shifted in any direction [rad], over the unshifted share."""
        from scipy.special import chndtr

        beam = max(self.beam, 1e-3 * self.radius)
        reach = self.radius + self.centre + 6 * beam
        apart = np.linspace(0, self.centre + reach, 2 * _SHIFTS)
        inside = chndtr((self.radius / beam) ** 2, 2, (apart / beam) ** 2)
        nodes, turn = np.linspace(0, reach, _SHIFTS), np.exp(2j * np.pi * np.arange(_TURNS) / _TURNS)
        mean = np.interp(np.abs(self.centre + nodes[:, np.newaxis] * turn), apart, inside).mean(axis=1)
        return np.asarray(np.interp(shift, nodes, mean / mean[0]))


@dataclass(frozen=True)
class ScatteredLight:
    """Column and bottom in a water, over singly scattered light that absorption alone attenuates."""

    #: Water coefficients [1/m].
    absorption: float
    backscattering: float
    #: Paths [m], and the column's signal there over b p(pi) exp(-2 a s), with a bottom at the last depth.
    path: FloatArray
    column: FloatArray
    #: Bottom echo paths [m], and logarithm of their energy over exp(-2 a s).
    bottom_path: FloatArray
    bottom: FloatArray
    fitted: FloatArray  #: Paths of the bins in the column's exponential [m].
    #: The column's exponential: its level at the surface over b p(pi), its attenuation minus the absorption [1/m], and
    #: its level as a backscatter over bb/(2 pi).
    start: float
    excess: float
    level: float

    def bottom_loss(self, path: FloatArray) -> FloatArray:
        """Return the optical depth of both ways to bottoms at paths [m], minus the column exponential's."""
        inside = np.polyfit(self.bottom_path, self.bottom, 3)
        return np.asarray(-np.polyval(inside, path) - 2 * self.excess * path)

    def column_ratio(self, path: FloatArray) -> FloatArray:
        """Return the signal of the column at paths [m] over its exponential."""
        fitted = self.start * np.exp(-2 * self.excess * self.path)
        return np.asarray(np.interp(path, self.path, self.column / fitted))

    def gain_of_column(self, path: FloatArray) -> FloatArray:
        """Return the logarithm of the column's signal over the bottoms' at paths [m], 0 at the surface."""
        return np.asarray(self.bottom_loss(path) + math.log(self.start))

    def slopes(self, path: float) -> tuple[float, float]:
        """Return the column attenuation above and below a path, minus its exponential's [1/m]."""
        log_ratio = np.log(self.column_ratio(self.fitted))
        parts = (self.fitted < path, self.fitted >= path)
        above, below = (
            -0.5 * float(np.polyfit(self.fitted[part], log_ratio[part], 1)[0]) if part.sum() > 2 else 0.0
            for part in parts
        )
        return above, below


def of_columns(
    waveforms: Waveforms, echoes: xr.Dataset, system: LidarSystem, share: FloatArray, dataset: xr.Dataset
) -> ScatteredLight | None:
    """Return the light in the water that the mean column of waveforms shows; None where no column is known.

    Waveforms are of one pixel, as is their table from `echo_table.extract`. The share of the beam in view has the shape
    () or (shots,). The result has the attributes ``field_of_view_mrad``, ``divergence_mrad`` and, if known, the slope
    variance and the pixel outlines.
    """
    levels = backscatter_of(echoes, system, share)
    decay, backscatter = (mean_of_known(one) for one in (echoes["attenuation"].values, levels))
    if not (decay > 0 and backscatter > 0):
        return None
    records, width = waveforms.records(slice(0, waveforms.count)), waveforms.echo_fwhm_ns
    start, end = (mean_of_known(echoes[f"column_{edge}_ns"].values) for edge in ("start", "end"))
    inside = (records.time_ns >= start) & (records.time_ns <= end)
    path = waveforms.geometry.path_of_time(records.time_ns[inside])
    gain = waveforms.gain(slice(0, waveforms.count)).mean(axis=0)[inside]
    noise = np.broadcast_to(records.noise, records.power.shape).mean(axis=0)[inside]
    view = View.of(dataset, system, width * waveforms.geometry.metres_per_ns)
    bottom = mean_of_known(echoes["time_ns"].sel(echo="bottom").values)
    # Without a bottom, the water goes on below the last bin.
    deepest = float(waveforms.geometry.path_of_time(end + _BELOW * width if math.isnan(bottom) else bottom))
    weights = gain * np.exp(-2 * decay * path) / noise
    return light_of(view, decay, backscatter, path, weights, deepest, BACKSCATTER_RATIO)


def backscatter_of(echoes: xr.Dataset, system: LidarSystem, share: FloatArray) -> FloatArray:
    """Return the levels of columns at the mean sea level as a backscatter [1/(m sr)], shape () or (shots,)."""
    column = echoes.sel(echo="column")
    above = (system.surface_time_ns - echoes["time_ns"].sel(echo="surface").values) * system.metres_per_ns
    level = column["amplitude"].values * np.exp(-2 * echoes["attenuation"].values * above)
    return np.asarray(level / (share * system.column_gain))


def mean_of_known(values: FloatArray) -> float:
    """Return the mean of finite values, NaN without any."""
    return float(values[known].mean()) if (known := np.isfinite(values)).any() else math.nan


def light_of(
    view: View, decay: float, backscatter: float, path: FloatArray, weights: FloatArray, deepest: float, ratio: float
) -> ScatteredLight:
    """Return the light in the water whose column has an exponential.

    `view`: the lidar. `decay`, `backscatter`: attenuation of the exponential along the path [1/m], and its level at the
    surface as a backscatter [1/(m sr)]. `path`, `weights`: paths in the exponential's fitted bins [m], and weights of
    the column's logarithm there, shape (bins,). `deepest`: path of the bottom echo or deepest light [m]. `ratio`:
    particle bb/b.
    """
    bb, a, depth = 2 * np.pi * backscatter / _FIRST_LEVEL, decay, deepest * view.system.cos_water
    for paths in _PATHS:
        bb = float(np.clip(bb, 0.51 * float(water_scattering(532.0)), _MOST_BACKSCATTERING))
        a = max(a, _LEAST_ABSORPTION * decay)
        b, phase = _scattering(bb, ratio)
        at, column, bottom_path, bottom = _curves(view, a, bb, b, phase, depth, paths)
        factor = 2 * np.pi * float(phase.eval_s(1.0)) * b / bb
        seen = np.interp(path, at, np.log(np.maximum(column, 1e-9)))
        slope, start = np.polyfit(path, seen, 1, w=weights)
        start, excess = math.exp(start), -0.5 * float(slope)
        found = ScatteredLight(a, bb, at, column, bottom_path, bottom, path, start, excess, start * factor)
        a, bb = decay - found.excess, 2 * np.pi * backscatter / found.level
        depth *= deepest / bottom_path[-1]
    return found


def _curves(
    view: View, a: float, bb: float, b: float, phase: PowerLawTable, depth: float, paths: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return path and signal of the column, and paths and logarithms of bottoms, for `ScatteredLight`."""
    from scipy.ndimage import gaussian_filter1d

    geometry, rng = view.system, np.random.default_rng(0)
    shape, absorption = (paths, _STEPS), a + b - b
    water, bottoms = water_and_bottoms(geometry, (absorption, b), phase, view.slope_variance, depth, shape, rng)

    def seen(light: Arrivals) -> tuple[FloatArray, FloatArray]:
        share = view.share(np.hypot(light.shift.real, light.shift.imag))
        return geometry.path_of_time(light.time_ns), light.energy * share

    path, energy = seen(water)
    step = depth / _STEPS / geometry.cos_water
    edges = np.arange(0, path.min(axis=0).max() + _BEHIND, _BIN)
    # A step's light lies anywhere in it.
    total, _ = np.histogram(path + step * (rng.random(path.shape) - 0.5), edges, weights=energy)
    middle = 0.5 * (edges[1:] + edges[:-1])
    single = geometry.water_gain(middle * geometry.cos_water, geometry.off_nadir) * b * float(phase.eval_s(1.0)) * _BIN
    sigma = view.echo_width / math.sqrt(8 * math.log(2))
    # Light that large angles turn twice, which the estimate lacks. It travels about level from one to the other, no
    # farther than it can be late, and no farther than the view reaches.
    reach = geometry.slant_range * view.radius
    twice = 1 + bb / (1 / (_ALONG * middle) + 1 / (_ACROSS * reach))
    # The exponential changes its level only when it is smoothed, which the fit of a column contains as well.
    column_signal = gaussian_filter1d(total / single, sigma / _BIN, mode="nearest") * np.exp(2 * a * middle) * twice
    path, energy = seen(bottoms)
    whole = energy.sum(axis=0)
    at = _echo_path(path, energy, sigma)
    depths = depth / _STEPS * (np.arange(_STEPS) + 0.5)
    direct = geometry.water_gain(depths, geometry.off_nadir) * geometry.cos_water
    return middle, column_signal, at, np.log(whole / direct) + 2 * a * at


def _echo_path(path: FloatArray, energy: FloatArray, sigma: float) -> FloatArray:
    """Return the paths at which echoes with a standard deviation [m] have the most light, shape (depths,)."""
    at = np.average(path, axis=0, weights=energy)
    for _ in range(_MODE):
        near = energy * np.exp(-0.25 * ((path - at) / sigma) ** 2)
        at = np.average(path, axis=0, weights=near)
    return np.asarray(at)


def _scattering(bb: float, ratio: float) -> tuple[float, PowerLawTable]:
    """Return scattering [1/m] and phase function of sea water with particles that have a ratio bb/b."""
    molecules = float(water_scattering(532.0))
    particles = (bb - 0.5 * molecules) / ratio
    tables = [
        PowerLawTable.fournier_forand(*fournier_forand_parameters(ratio)),
        PowerLawTable.from_function(water_phase_function),
    ]
    return particles + molecules, PowerLawTable.mixture(tables, [particles, molecules])
