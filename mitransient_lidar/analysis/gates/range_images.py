"""Range of the echo in every pixel, from gated images."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.analysis.waveforms.depth_errors import DepthErrors
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import BoolArray, FloatArray, increasing_array, integer
from mitransient_lidar.physics.lidar.level_sea import LidarGeometry
from mitransient_lidar.results.files import Given, dataset_of
from mitransient_lidar.results.gate_stack import as_stack, average_frames, has_frames
from mitransient_lidar.results.geometry import LinesOfSight, lidar_geometry, optional_number

_COLUMN_GATES, _DEEP_GATES = 4, 2  # gates before and behind an echo from which the column under it is estimated
_SIGNIFICANT = 0.5  # least significance of an echo's gate, relative to the most significant gate
_CERTAIN = 4.0  # standard errors that are enough for any gate, and that depths in frames need
_FIRST_ECHOES = 1.0  # percentile of the echoes' times before which all pixels see the column
_BLOCK = 8192  # pixels computed at once


class RangeImage(NamedTuple):
    """Echo depth in every pixel: centroid and standard error, in the unit of the gates' middles.

    They are NaN where no gate exceeds the column. `confidence` is the probability, 0 to 1, that noise alone would not
    exceed the column as much.
    """

    depth: FloatArray
    sigma: FloatArray
    confidence: FloatArray


class DepthImage(NamedTuple):
    """Echo depth in every pixel below the mean sea level [m], with two errors, and confidence.

    `sigma` is the standard error by noise. `method_error` is the typical error by scattering, by the light's
    distribution in the pixel and by waves, from `depth_errors.DepthErrors`; NaN without the lidar geometry. Both are
    NaN where no gate exceeds the column. `confidence` is as in `RangeImage`.
    """

    depth: FloatArray
    sigma: FloatArray
    method_error: FloatArray
    confidence: FloatArray


def range_from_gates(
    energy: npt.ArrayLike,
    stderr: npt.ArrayLike,
    gate_mid: npt.ArrayLike,
    *,
    reach: int | None = None,
    least_excess: float = 0.0,
    saturated: npt.ArrayLike | None = None,
) -> RangeImage:
    """Find every pixel's echo above the water column's backscatter.

    Raises `UserError` if shapes disagree or a value is out of range.

    `energy`, `stderr`, shape (..., gate): energy in each of at least 3 gates, and its standard error, at least 0.
    `gate_mid`, shape (gate,): middles of the gates, strictly increasing: depths [m] or times [ns]. `reach`: largest
    echo extent on each side of its strongest gate [gates], 0 to (gates - 3) // 2, at least the number of overlapping
    gates. By default 2, less with fewer than 7 gates. `least_excess`: least excess over the column of an echo's gate
    [standard errors], at least 0. `saturated`, shape (..., gate): gates whose energy is too small. Pixels that need
    them have no depth: for an echo and its column, or since an echo may be in them. Gates from the first one on are the
    column.

    Result: arrays of shape (...); pixels with non-finite energies have NaN depth and confidence 0.

    Column: the larger of two exponentials. One is extrapolated from up to 4 gates before the echo, the other
    interpolated between these and the 2 gates after it. After the echo it is at most the level of these 2 gates, since
    a target may end the column. Energies below their error are replaced by it.

    Echo: the gate with the largest excess over the column. It must exceed the column by 4 standard errors or be at
    least half as significant as the most significant gate. This excludes the bright column's noise near the surface.
    The depth is the centroid of the excess within `reach`. Its error assumes independent errors and gates not wider
    than the pulse; an echo's position within a wider gate is unknown.

    The confidence is Phi(z)^m for an excess of z standard errors, the largest in m gates.

    The first `reach` + 1 gates are only used to estimate the column, which is constant after a single one. Start the
    train between surface and target, since a surface echo would be found instead of the target.
    """
    e, s = np.asarray(energy, dtype=np.float64), np.asarray(stderr, dtype=np.float64)
    mid = increasing_array("gate_mid", gate_mid)
    if e.ndim == 0 or e.shape != s.shape or mid.shape != e.shape[-1:]:
        raise UserError(
            f"energy of shape {e.shape} and stderr of shape {s.shape} must be equal, with the {mid.size} gates of "
            "gate_mid last"
        )
    if mid.size < 3:
        raise UserError(f"energy has {mid.size} gates and must have at least 3: two define the column")
    if np.any(s < 0):
        raise UserError(f"stderr = {s[s < 0][0]:g} must not be negative")
    largest = (mid.size - 3) // 2
    half = min(2, largest) if reach is None else integer("reach", reach, 0, largest)
    column = _ColumnModel(mid, half)
    limited = np.broadcast_to(False if saturated is None else np.asarray(saturated, dtype=np.bool_), e.shape)
    flat_limited = limited.reshape(-1, mid.size)
    flat, flat_error = e.reshape(-1, mid.size), s.reshape(-1, mid.size)
    found = np.empty((3, flat.shape[0]))
    for start in range(0, flat.shape[0], _BLOCK):
        pixels = slice(start, start + _BLOCK)
        found[:, pixels] = _ranges(flat[pixels], flat_error[pixels], column, least_excess, flat_limited[pixels])
    return RangeImage(*found.reshape(3, *e.shape[:-1]))


def depth_image(stack: Given, *, reach: int | None = None) -> DepthImage:
    """Find the depth of every pixel's strongest echo in a gate stack, along the pixel's line of sight.

    Parameters
    ----------
    stack : xarray.Dataset
        A gate stack with at least 3 gates, whose last dimension is ``gate``; or camera frames. Their mean above the
        dark level counts, with frame noise and render error. In frames, echoes of less than 4 standard errors and
        echoes beside saturated gates have no depth: their errors would not hold.
    reach : int, optional
        As for `range_from_gates`.

    Returns
    -------
    DepthImage
        Arrays with the shape (row, column) or (pixel,).

    Raises
    ------
    UserError
        If the stack has too few gates, gaps between gates in which the pulse of an echo fits, or lacks the lidar
        geometry.

    Notes
    -----
    The echo is located in time, and its depth follows from `geometry.LinesOfSight`; without the geometry attributes,
    from ``gate_depth`` in all pixels. Example: a receiver 20 degrees off nadir at 200 m. A pixel 10 mrad farther from
    nadir receives the same depth 5.2 ns later, 0.55 m on the axis's depth scale.
    """
    stack = dataset_of("stack", stack, "gates", "frames")
    limits: dict[str, Any] = {}
    if has_frames(stack):
        full = stack["saturated"].any("frame").values if "saturated" in stack else None
        limits = {"least_excess": _CERTAIN, "saturated": full}
    stack = _light_of_frames(stack) if limits else average_frames(stack)
    middles = stack["gate_start"].values + 0.5 * stack["gate_width"].values
    energy, stderr = stack["gate_energy"].values, stack["gate_energy_stderr"].values
    pulse = optional_number(stack.attrs, "pulse_fwhm_ns") or 0.0
    gap = float(np.max(np.diff(stack["gate_start"].values) - stack["gate_width"].values[:-1], initial=0.0))
    if pulse and gap > pulse:
        raise UserError(
            f"the gates leave gaps of {gap:.3g} ns, in which echoes of the pulse of {pulse:.3g} ns are lost: "
            "depths need gates that adjoin"
        )
    found = range_from_gates(energy, stderr, middles, reach=reach, **limits)
    try:
        lines = LinesOfSight.from_dataset(stack)
        geometry = lidar_geometry(stack.attrs)
    except UserError:
        if "gate_depth" not in stack.coords:
            raise
        # A stack of other origin has one scale for all pixels.
        per_ns, offset = np.polyfit(middles, stack["gate_depth"].values, 1)
        depth = found.depth * per_ns + offset
        return DepthImage(depth, found.sigma * per_ns, np.full_like(depth, np.nan), found.confidence)
    zero, per_ns = (values.reshape(energy.shape[:-1]) for values in (lines.surface_time, lines.depth_per_ns))
    depth = (found.depth - zero) * per_ns
    errors = DepthErrors.of(stack.attrs, lines, 1, geometry, pulse)
    attenuation, level = _column(stack, found, lines, geometry, pulse)
    method = errors.of_echoes(found.depth.ravel(), depth.ravel(), attenuation, level, from_mean=True, gated=True)
    method = np.where(np.isfinite(depth), method.reshape(depth.shape), np.nan)
    return DepthImage(depth, found.sigma * per_ns, method, found.confidence)


def _light_of_frames(frames: xr.Dataset) -> xr.Dataset:
    """Return the frames' mean as a gate stack, with errors by noise and render [DN].

    A few photoelectrons are not normal: where a gate exceeds its mean, its noise is that of light at this level.
    """
    number = frames.sizes["frame"]
    stack, rendered, mean = as_stack(frames), frames["signal_mean_stderr"], frames["signal_mean"]
    level = mean.mean("frame") if "frame" in mean.dims else mean
    if "frame" in rendered.dims:  # on as many seas
        rendered = (rendered**2).mean("frame") ** 0.5 / math.sqrt(number)
    light, variance = level - frames["dark_level"], number * stack["gate_energy_stderr"] ** 2
    # Photon transfer: the variance grows with the light.
    apart = light - light.mean()
    per_light = max(float((apart * variance).sum() / max(float((apart**2).sum()), 1e-300)), 0.0)
    brighter = np.maximum(stack["gate_energy"] - light, 0)
    square = (variance + per_light * brighter) / number + rendered**2
    return stack.assign(gate_energy_stderr=square**0.5)


def _column(
    stack: xr.Dataset, found: RangeImage, lines: LinesOfSight, geometry: LidarGeometry, pulse_ns: float
) -> tuple[FloatArray, FloatArray]:
    """Return the pixels' column attenuation [1/m] and column power at the surface [W], NaN where unknown.

    Single pixels have too little light: an exponential is fitted to the sum of the pixels, in the gates before the
    first echoes. Columns that begin at other times have the same decay.
    """
    unknown = np.full(lines.beam_share.size, np.nan)
    width, middles = stack["gate_width"].values, stack["gate_start"].values + 0.5 * stack["gate_width"].values
    sure = (found.confidence > 0.5) & np.isfinite(found.depth)
    if not sure.any() or not np.isfinite(lines.beam_share).all():
        return unknown, unknown
    total = stack["gate_energy"].values.reshape(-1, middles.size).sum(axis=0)
    first = np.percentile(found.depth[sure], _FIRST_ECHOES) - 2 * pulse_ns
    used = (middles + 0.5 * width < first) & (total > 0)
    if np.count_nonzero(used) < 3:
        return unknown, unknown
    slope, start = np.polyfit(middles[used], np.log(total[used]), 1)
    if slope >= 0:
        return unknown, unknown
    # The sum of the pixels' columns from their surfaces on has this logarithm at time 0.
    gathered = np.log(np.sum(lines.beam_share * np.exp(-slope * (lines.surface_time - middles[0]))))
    in_joules = stack["gate_energy"].attrs.get("units") != "DN"  # as for frames, whose level is no power
    open_s = 1e-9 * float(width[0]) * float(stack.attrs.get("pulses", 1))
    level = math.exp(start + slope * middles[0] - gathered) / open_s if in_joules else math.nan
    return np.full(unknown.size, -0.5 * slope / geometry.metres_per_ns), lines.beam_share * level


class _ColumnModel:
    """Linear maps from the logarithms of a pixel's energies to the column's in an echo's gate k.

    An echo includes `half` gates on each side of k, which is at least `first`. Columns k of `mean` and `slope` give the
    line through the gates before the echo, with k `lever` after their middle. Column k of `between` gives the line
    between the gates before and after the echo. Column k of `deep`, applied to energies, gives the mean of the gates
    after it, if `has_deep`.
    """

    def __init__(self, mid: FloatArray, half: int) -> None:
        count = mid.size
        self.mid, self.half, self.first = mid, half, half + 1
        self.lever = np.zeros(count)
        self.mean, self.slope, self.between, self.deep = (np.zeros((count, count)) for _ in range(4))
        self.has_deep = np.arange(count) + half + 1 < count
        for k in range(self.first, count):
            near = np.arange(max(k - half - _COLUMN_GATES, 0), k - half)
            behind = np.arange(k + half + 1, min(k + half + 1 + _DEEP_GATES, count))
            x = mid[near] - mid[near].mean()
            self.lever[k] = mid[k] - mid[near].mean()
            self.mean[near, k] = 1 / near.size
            if near.size > 1:
                self.slope[near, k] = x / np.sum(x**2)
            if behind.size:
                last = near[-2:]
                share = (mid[k] - mid[last].mean()) / (mid[behind].mean() - mid[last].mean())
                self.between[last, k] = (1 - share) / last.size
                self.between[behind, k] = share / behind.size
                self.deep[behind, k] = 1 / behind.size


def _ranges(
    energy: FloatArray, stderr: FloatArray, column: _ColumnModel, least_excess: float, saturated: BoolArray
) -> FloatArray:
    """Return the pixels' depth, sigma and confidence, shape (3, pixel), from energies with the shape (pixel, gate)."""
    from scipy.special import ndtr

    known = np.asarray(np.isfinite(energy + stderr).all(axis=1))
    e, s = np.where(known[:, None], energy, 0), np.where(known[:, None], stderr, 0)
    # The floor keeps logarithms finite without light and noise.
    floor = np.maximum(s, np.maximum(1e-15 * e.max(axis=1, initial=0), 1e-300)[:, None])
    clipped = np.maximum(e, floor)
    log, log_variance = np.log(clipped), (s / clipped) ** 2
    slope = np.minimum(log @ column.slope, 0)
    before = log @ column.mean + slope * column.lever
    between = np.where(column.has_deep, log @ column.between, -np.inf)
    background = np.exp(np.maximum(before, between))
    variance_before = log_variance @ (column.mean + column.slope * column.lever) ** 2
    background_variance = np.where(before >= between, variance_before, log_variance @ column.between**2)
    excess = e - background
    error = np.sqrt(s**2 + background**2 * background_variance)

    eligible = slice(column.first, None)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(excess > 0, excess / error, 0)[:, eligible]
    significant = z >= np.minimum(_SIGNIFICANT * z.max(axis=1, keepdims=True), _CERTAIN)
    peak = column.first + np.argmax(np.where(significant, excess[:, eligible], -np.inf), axis=1)
    at_peak = peak[:, None]
    z_peak = np.take_along_axis(z, at_peak - column.first, axis=1)[:, 0]

    window = at_peak + np.arange(-column.half, column.half + 1)
    inside = window < column.mid.size
    window = np.minimum(window, column.mid.size - 1)
    place = column.mid[window]
    away = place - column.mid[at_peak]
    level = np.take_along_axis(background, at_peak, 1) * np.exp(np.take_along_axis(slope, at_peak, 1) * away)
    deep = np.maximum(np.take_along_axis(e @ column.deep, at_peak, 1), 0)
    limited = np.asarray((away > 0) & (level > deep))
    level = np.where(limited, deep, level)
    weight = np.where(inside, np.maximum(np.take_along_axis(e, window, 1) - level, 0), 0)
    total = weight.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.sum(weight * place, axis=1) / total
        lever = np.where(inside, place - depth[:, None], 0) / total[:, None]
        variance = np.sum((lever * np.take_along_axis(s, window, 1)) ** 2, axis=1)
        # The column's error moves all its gates, and its slope error moves gates more that are farther after its gates.
        shift = np.where(limited | (weight == 0), 0, lever * level)
        own, tilt = shift.sum(axis=1, keepdims=True), np.sum(shift * away, axis=1, keepdims=True)
        falls, ends = (np.take_along_axis(one, at_peak, 1) for one in (slope < 0, before < between))
        weights = np.where(ends, column.between.T[peak], column.mean.T[peak])
        turned = np.where(falls, tilt + np.where(ends, 0, own * column.lever[at_peak]), 0)
        variance += np.sum((own * weights + turned * column.slope.T[peak]) ** 2 * log_variance, axis=1)
        behind = np.sum(np.where(limited & (weight > 0) & (deep > 0), lever, 0), axis=1, keepdims=True)
        variance += np.sum((behind * column.deep.T[peak] * s) ** 2, axis=1)
    found = known & (z_peak > 0) & (z_peak >= least_excess)
    gate, apart = np.arange(column.mid.size), column.half + np.array([_COLUMN_GATES, _DEEP_GATES])
    used = (gate >= at_peak - apart[0]) & (gate <= at_peak + apart[1])
    used |= (gate >= column.first) & ~np.logical_and.accumulate(saturated, axis=1)
    found &= ~(saturated & used).any(axis=1)
    confidence = ndtr(z_peak) ** (column.mid.size - column.first)
    return np.stack(
        [np.where(found, depth, np.nan), np.where(found, np.sqrt(variance), np.nan), np.where(found, confidence, 0)]
    )
