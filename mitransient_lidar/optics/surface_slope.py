"""Slope of the sea surface from the times at which the pixels of one shot receive its echo.

A plane has, along the ray of tangent-plane angles (gx, gy), the distance rho along the receiver's axis with 1/rho =
A + B gx + C gy, exactly. Slopes are rises over runs, positive `along` the lidar's azimuth for a face turned towards
the lidar, and `across` for a rise to the left of it (+gy). Angles are in rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, in_range, positive
from .water import C0

BoolArray = npt.NDArray[np.bool_]

_NS = 1e-9 * C0 / 2  # metres of range per nanosecond
_CELLS = 256  # of the grid on which the light in a pixel is weighed, per side
_LEAST_ERROR_NS = 0.01  # below it, no reading of an echo's time is to be trusted
_LEAST_LEVER = 1e-4  # rad: pixels whose light lies nearer together have no lever
_ALIKE = 0.4  # correlation of where the facets shine in two pixels side by side
_LIKELY = 0.5  # of an estimated slope is the sea's, the rest being error


@dataclass(frozen=True)
class PixelLight:
    """Where the light of each pixel comes from when the surface shines evenly; shape (pixels,) each.

    Attributes
    ----------
    gx, gy
        Centre of the beam's light inside the pixel [rad].
    spread
        Standard deviation of the light in gx [rad].
    """

    gx: FloatArray
    gy: FloatArray
    spread: FloatArray

    @classmethod
    def of_outlines(cls, outlines: list[list[npt.ArrayLike]], sigma: float) -> PixelLight:
        """Weigh the inside of each pixel with a Gaussian beam.

        Parameters
        ----------
        outlines : list of list of array_like, shape (points, 2)
            Closed lines (gx, gy) of each pixel [rad]; a line inside another is a hole.
        sigma : float
            Standard deviation of the beam's irradiance about the axis [rad], above 0.

        Returns
        -------
        PixelLight

        Raises
        ------
        ValueError
            If `sigma` is not positive, a line has fewer than three points, or the beam misses a pixel.
        """
        width = positive("sigma", sigma)
        found = []
        for number, lines in enumerate(outlines):
            loops = [finite_array("outlines", line) for line in lines]
            if not loops or any(loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3 for loop in loops):
                raise ValueError(f"outlines of pixel {number} must be lines of at least 3 points (gx, gy)")
            points = np.concatenate(loops)
            x, y = np.meshgrid(*(_midpoints(axis.min(), axis.max()) for axis in points.T))
            weight = _inside(loops, x, y) * np.exp(-0.5 * (x**2 + y**2) / width**2)
            total = weight.sum()
            if total <= 0:
                raise ValueError(f"outlines of pixel {number} must hold a part of the beam of sigma = {width:g}")
            centre = np.sum(weight * x) / total
            spread = np.sqrt(np.sum(weight * (x - centre) ** 2) / total)
            found.append((centre, np.sum(weight * y) / total, spread))
        return cls(*np.array(found).T)


def _midpoints(low: float, high: float) -> FloatArray:
    return np.asarray(low + (high - low) * (np.arange(_CELLS) + 0.5) / _CELLS)


def _inside(loops: list[FloatArray], x: FloatArray, y: FloatArray) -> BoolArray:
    """Return which points an odd number of closed lines surround."""
    odd = np.zeros(x.shape, dtype=bool)
    for loop in loops:
        for (x0, y0), (x1, y1) in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            crosses = (y0 > y) != (y1 > y)
            if y0 != y1:
                odd ^= crosses & (x < x0 + (x1 - x0) * (y - y0) / (y1 - y0))
    return odd


@dataclass(frozen=True)
class SurfacePlane:
    """Planes through the surface echoes of shots; shape (n,) each, NaN where the pixels do not tell.

    Attributes
    ----------
    along, across
        Slopes along the lidar's azimuth and to its left [1].
    along_stderr, across_stderr
        Their standard errors [1].
    range_m, range_stderr
        Distance to the plane along the receiver's axis, and its standard error [m].
    misfit_ns
        Root mean square of the echoes' deviations from the plane over the degrees of freedom [ns]; NaN without any.
    pixels
        Number of echoes used.
    """

    along: FloatArray
    across: FloatArray
    along_stderr: FloatArray
    across_stderr: FloatArray
    range_m: FloatArray
    range_stderr: FloatArray
    misfit_ns: FloatArray
    pixels: npt.NDArray[np.intp]


def fit_plane(
    time_ns: npt.ArrayLike, light: PixelLight, off_nadir: float, *, stderr_ns: npt.ArrayLike = 0.0, facets: float = 1.0
) -> SurfacePlane:
    """Fit a plane to the surface echoes of the pixels of each shot.

    Parameters
    ----------
    time_ns : array_like, shape (n, pixels)
        Two-way times of the surface echoes [ns], above 0; NaN where a pixel has none.
    light : PixelLight
        Where the pixels' light comes from.
    off_nadir : float
        Angle of the receiver's axis from the vertical [rad], 0 to below pi/2.
    stderr_ns : array_like, shape () or (n, pixels)
        Standard errors of the times from noise [ns], at least 0.
    facets : float
        Number of facets that most of a pixel's echo comes from, above 0: its centre then errs by spread/sqrt(facets).

    Returns
    -------
    SurfacePlane
        With three echoes that are no line, both slopes; with two apart in gx, the slope along, that across being taken
        as 0; without, neither.

    Raises
    ------
    ValueError
        If shapes disagree or a number is out of range.

    Notes
    -----
    Let t be tan(off_nadir). From H - rho (cos - gx sin) = z0 + along (x) + across (rho gy) for the point at rho follows
    B/A = (along - t)/(1 + along t) and C/A = across/(cos(off_nadir) + along sin(off_nadir)), hence along =
    tan(off_nadir + arctan(B/A)). The fit is least squares in 1/rho with weights from the errors of the times.

    Assumptions: transmitter and receiver at one place; each pixel's echo comes from the centre of the beam's light in
    it; the surface is plane within the footprint. Short waves break the last two: few facets of a footprint of metres
    face the lidar, and they may lie anywhere in their pixel. That, not noise, is the error. A centre that lies d
    farther out is tan(off_nadir - tilt) d farther away, relatively, where tilt is that of the face: taken as half the
    estimate, with what that is uncertain by, since an estimate is as much error as slope. Hence faces turned away are
    known worse. In pixels side by side, which the same crests cross, the centres err alike, with a correlation of 0.4
    that falls with the distance in gx as exp(-dx^2/(2 spread^2)): this raises the error along and lowers that across.
    One facet a pixel and 0.4 are from 600 rendered shots at 6 m/s along the wind, 20 degrees off nadir, views of 15 and
    30 mrad: the pixels' own centres erred by 0.85 to 1.13 of the spread, with correlations of 0.30 to 0.43 side by side
    and -0.24 to 0.18 otherwise. The root mean square of error over stated error is then 1.04 to 1.28 along and 0.78 to
    0.91 across, 0.86 to 1.00 with the sea's slopes as prior; in 120 shots across the wind, 0.81 to 1.24.
    Pixels narrow in gx serve best, since that is what moves the time. Where pixels cut a wide beam their light is
    skewed, and the time that a symmetric echo is fitted with lies inside its mean: a level sea then seems to face the
    lidar by up to 1.5 degrees.
    That times tell the slope is said by Tulldahl (2006), FOI-R-2074-SE, section 3.1, which gives no formula.
    """
    angle = in_range("off_nadir", off_nadir, 0, np.pi / 2 - 1e-3)
    x, y, spread = (finite_array(name, getattr(light, name)) for name in ("gx", "gy", "spread"))
    time = np.asarray(time_ns, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or x.shape != spread.shape or time.ndim != 2 or time.shape[1] != x.size:
        raise ValueError(f"time_ns of shape {time.shape} must be (shots, pixels), the pixels being those of light")
    known = np.isfinite(time)
    if np.any(time[known] <= 0):
        raise ValueError(f"time_ns = {time[known].min():g} must be greater than 0")
    noise = np.broadcast_to(np.asarray(stderr_ns, dtype=np.float64), time.shape)
    if np.any(noise < 0):
        raise ValueError(f"stderr_ns = {np.nanmin(noise):g} must not be negative")
    if np.any(spread < 0):
        raise ValueError(f"spread = {spread.min():g} must not be negative")

    safe = np.where(known, time, 1.0)
    inverse = np.sqrt(1 + x**2 + y**2) / (_NS * safe)
    relative = spread / np.sqrt(positive("facets", facets))
    to_inverse = inverse / safe
    alone = to_inverse * np.hypot(np.nan_to_num(noise), _LEAST_ERROR_NS)
    pixels = _Pixels(x, y, _alike(x, spread))
    level = _planes(inverse, alone, inverse * np.tan(angle) * relative, known, pixels, angle)
    tilt, unsure = (np.nan_to_num(one)[:, np.newaxis] for one in (level.along, level.along_stderr))
    steepness = np.hypot(np.tan(angle - np.arctan(_LIKELY * tilt)), np.sqrt(_LIKELY) * unsure)
    return _planes(inverse, alone, inverse * steepness * relative, known, pixels, angle)


@dataclass(frozen=True)
class _Pixels:
    """Centres of the light (pixels,), and how alike they err (pixels, pixels)."""

    x: FloatArray
    y: FloatArray
    alike: FloatArray


def _alike(x: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the correlation of the errors of the pixels' centres."""
    reach = float(np.mean(spread))
    apart = (x[:, np.newaxis] - x) / (reach if reach > 0 else 1.0)
    return np.asarray((1 - _ALIKE) * np.eye(x.size) + _ALIKE * np.exp(-0.5 * apart**2))


def _planes(
    inverse: FloatArray, alone: FloatArray, shared: FloatArray, known: BoolArray, pixels: _Pixels, angle: float
) -> SurfacePlane:
    """Solve the weighted fits of A, B and C one after the other, so that each may be unknown.

    Errors of 1/rho are those of each pixel `alone`, and those `shared` with pixels that err alike; (n, pixels).
    """
    x, y = pixels.x, pixels.y
    weight = np.where(known, 1 / (alone**2 + shared**2), 0.0)
    weight /= np.where(known.any(axis=1), weight.sum(axis=1), 1.0)[:, np.newaxis]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.sum(weight * values, axis=1))

    def error(shares: FloatArray) -> FloatArray:
        part = shares * shared
        return np.asarray(np.sqrt(np.sum((shares * alone) ** 2 + part * (part @ pixels.alike), axis=1)))

    u, v = x - mean(x)[:, np.newaxis], y - mean(y)[:, np.newaxis]
    uu = mean(u * u)
    has_u = np.asarray(uu > _LEAST_LEVER**2)
    tilt = np.where(has_u, mean(u * v) / np.where(has_u, uu, 1.0), 0.0)
    rest = v - tilt[:, np.newaxis] * u
    vv = mean(rest * rest)
    count = np.asarray(known.sum(axis=1))
    has_v: BoolArray = has_u & (vv > _LEAST_LEVER**2) & (count > 2)
    # Each number is a sum of the pixels' 1/rho with these shares.
    of_c = weight * rest * np.where(has_v, 1 / np.where(has_v, vv, 1.0), 0.0)[:, np.newaxis]
    of_b = weight * u * np.where(has_u, 1 / np.where(has_u, uu, 1.0), 0.0)[:, np.newaxis] - of_c * tilt[:, np.newaxis]
    of_a = weight - of_b * mean(x)[:, np.newaxis] - of_c * mean(y)[:, np.newaxis]
    a, b, c = (np.sum(shares * inverse, axis=1) for shares in (of_a, of_b, of_c))

    some = np.asarray(known.any(axis=1))
    a = np.where(some, a, 1.0)
    along = np.tan(angle + np.arctan(b / a))
    forward = np.cos(angle) + along * np.sin(angle)
    free = np.asarray(count - 1 - has_u - has_v)
    residual = np.where(known, inverse - a[:, np.newaxis] - b[:, np.newaxis] * x - c[:, np.newaxis] * y, 0.0)
    # A deviation in 1/rho is one in time by t rho.
    misfit = np.sqrt(np.sum(residual**2, axis=1) / np.maximum(free, 1)) / (_NS * a**2)

    def keep(values: FloatArray, where: BoolArray) -> FloatArray:
        return np.where(where, values, np.nan)

    return SurfacePlane(
        keep(along, has_u),
        keep(c / a * forward, has_v),
        keep((1 + along**2) / (1 + (b / a) ** 2) * error(of_b) / a, has_u),
        keep(np.abs(forward) * error(of_c) / a, has_v),
        keep(1 / a, some),
        keep(error(of_a) / a**2, some),
        keep(misfit, free > 0),
        count.astype(np.intp),
    )


def with_prior(slope: npt.ArrayLike, stderr: npt.ArrayLike, deviation: float) -> tuple[FloatArray, FloatArray]:
    """Weigh a slope against what slopes of the sea are like.

    Parameters
    ----------
    slope, stderr : array_like
        Slope and its standard error [1]; NaN where unknown.
    deviation : float
        Standard deviation of the sea's slopes averaged over a footprint, their mean being 0 [1], above 0.

    Returns
    -------
    slope, stderr : ndarray
        Mean and standard deviation of the Gaussian of what is likely [1]; the sea's own where the slope is unknown.

    Raises
    ------
    ValueError
        If `deviation` is not positive.
    """
    measured, error = np.asarray(slope, dtype=np.float64), np.asarray(stderr, dtype=np.float64)
    variance = positive("deviation", deviation) ** 2
    known = np.isfinite(measured) & np.isfinite(error)
    weight = np.where(known, variance / (variance + np.where(known, error, 1.0) ** 2), 0.0)
    return np.where(known, measured, 0.0) * weight, np.sqrt(variance * (1 - weight))


def steepest(along: npt.ArrayLike, across: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Angle of a slope from the horizontal, and the direction in which it rises.

    Parameters
    ----------
    along, across : array_like
        Slopes along the lidar's azimuth and to its left [1]; they broadcast.

    Returns
    -------
    angle, direction : ndarray
        Angle [rad], 0 to pi/2, and direction of the rise from the lidar's azimuth to the left [rad], -pi to pi. A
        direction of 0 is a face turned towards the lidar.
    """
    x, y = np.asarray(along, dtype=np.float64), np.asarray(across, dtype=np.float64)
    return np.asarray(np.arctan(np.hypot(x, y))), np.asarray(np.arctan2(y, x))
