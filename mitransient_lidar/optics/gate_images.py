"""What images through gates tell: contrast between regions or gates, and the range of the echo in every pixel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, in_range, whole

#: Gates on the shallow side from which the column under an echo is told, and on the deep side.
_COLUMN_GATES, _DEEP_GATES = 4, 2

#: An echo is looked for among the gates that are at least this part as significant as the most significant one.
_SIGNIFICANT = 0.5

#: Pixels worked on at once: a few tens of MB for 64 gates.
_BLOCK = 8192


class Contrast(NamedTuple):
    """Contrast of a against b, NaN where it is not defined, with standard errors."""

    michelson: FloatArray
    michelson_stderr: FloatArray
    weber: FloatArray
    weber_stderr: FloatArray


class RangeImage(NamedTuple):
    """Depth of the echo in every pixel.

    Attributes
    ----------
    depth : ndarray
        Centroid of the echo, in the unit of the gates' middles; NaN where no gate rises above the column.
    sigma : ndarray
        Its standard error from those of the energies, in the same unit.
    confidence : ndarray
        0 to 1: the chance that noise alone would not have risen as high.
    """

    depth: FloatArray
    sigma: FloatArray
    confidence: FloatArray


def contrast(
    a: npt.ArrayLike,
    b: npt.ArrayLike,
    a_stderr: npt.ArrayLike,
    b_stderr: npt.ArrayLike,
    correlation: float = 0.0,
) -> Contrast:
    """Contrast of two regions, of a target against its background, or of two gates.

    Parameters
    ----------
    a, b : array_like
        Mean energies of target and background, in one unit; they broadcast together.
    a_stderr, b_stderr : array_like
        Their standard errors, at least 0.
    correlation : float
        Correlation of the errors of a and b, -1 to 1. Gates that overlap share light: theirs is up to the part of the
        open time that they share.

    Returns
    -------
    Contrast
        Michelson's (a - b) / (a + b) and Weber's (a - b) / b, with errors to first order.

    Raises
    ------
    ValueError
        If a value is not finite, an error negative or the correlation out of range.
    """
    x, y = finite_array("a", a), finite_array("b", b)
    sx, sy = finite_array("a_stderr", a_stderr), finite_array("b_stderr", b_stderr)
    for name, error in (("a_stderr", sx), ("b_stderr", sy)):
        if np.any(error < 0):
            raise ValueError(f"{name} = {error.min():g} must not be negative")
    covariance = in_range("correlation", correlation, -1, 1) * sx * sy
    total = np.where(x + y == 0, np.nan, x + y)
    y_known = np.where(y == 0, np.nan, y)
    # Rounding may leave a variance of fully correlated errors just below 0.
    michelson_variance = np.maximum((y * sx) ** 2 + (x * sy) ** 2 - 2 * x * y * covariance, 0)
    weber_variance = np.maximum(sx**2 + (x / y_known * sy) ** 2 - 2 * x / y_known * covariance, 0)
    return Contrast(
        np.asarray((x - y) / total),
        np.asarray(2 * np.sqrt(michelson_variance) / total**2),
        np.asarray((x - y) / y_known),
        np.asarray(np.sqrt(weber_variance) / np.abs(y_known)),
    )


def range_from_gates(
    energy: npt.ArrayLike, stderr: npt.ArrayLike, gate_mid: npt.ArrayLike, *, reach: int | None = None
) -> RangeImage:
    """Find the echo of every pixel above the light that the water column scatters back.

    Parameters
    ----------
    energy : array_like, shape (..., gate)
        Energy in each gate, at least 3 gates.
    stderr : array_like, shape (..., gate)
        Its standard error, at least 0.
    gate_mid : array_like, shape (gate,)
        Middles of the gates, strictly increasing: depths [m] or times [ns].
    reach : int, optional
        Gates on each side of the strongest one that an echo may fill, 0 to (gates - 3) // 2. Choose at least the number
        of gates that overlap. By default 2, less with fewer than 7 gates.

    Returns
    -------
    RangeImage
        Arrays of shape (...); pixels with energies that are not finite have NaN depth and confidence 0.

    Raises
    ------
    ValueError
        If shapes disagree or a value is out of range.

    Notes
    -----
    Column: the signal of water falls as an exponential. In each gate it is the larger of the exponential continued from
    the (up to) 4 gates before the echo, and of that between these and the 2 gates behind the echo; behind it, where a
    target may have ended the column, it is at most the level of the 2 gates after it. Energies below their error count
    as their error there: the column is never taken for less than the noise.

    Echo: the gate that rises highest above the column, of those at least half as significant as the most significant
    one, which keeps the noise of the bright column near the surface out. The depth is the centroid of what rises above
    the column in the gates within `reach`. Its error holds for gates not wider than the pulse, so that an echo fills
    more than one; wider ones leave the echo's place within the gate unknown. Errors of different gates count as
    independent.

    The confidence is Phi(z)^m for an excess of z standard errors, the highest of m gates.

    The gates before the first `reach` + 2 only tell the column: start the train between surface and target. With the
    surface echo inside the train, the surface is mostly what is found.
    """
    e, s = np.asarray(energy, dtype=np.float64), np.asarray(stderr, dtype=np.float64)
    mid = finite_array("gate_mid", gate_mid)
    if e.ndim == 0 or e.shape != s.shape or mid.shape != e.shape[-1:]:
        raise ValueError(
            f"energy of shape {e.shape} and stderr of shape {s.shape} must be equal, with the {mid.size} gates of "
            "gate_mid last"
        )
    if mid.size < 3:
        raise ValueError(f"energy has {mid.size} gates and must have at least 3: two tell the column")
    if np.any(np.diff(mid) <= 0):
        raise ValueError("gate_mid must increase strictly")
    if np.any(s < 0):
        raise ValueError(f"stderr = {s[s < 0][0]:g} must not be negative")
    largest = (mid.size - 3) // 2
    half = min(2, largest) if reach is None else whole("reach", reach, 0, largest)
    column = _ColumnModel(mid, half)
    flat, flat_error = e.reshape(-1, mid.size), s.reshape(-1, mid.size)
    found = np.empty((3, flat.shape[0]))
    for start in range(0, flat.shape[0], _BLOCK):
        pixels = slice(start, start + _BLOCK)
        found[:, pixels] = _ranges(flat[pixels], flat_error[pixels], column)
    depth, sigma, confidence = found.reshape(3, *e.shape[:-1])
    return RangeImage(depth, sigma, confidence)


class _ColumnModel:
    """Linear maps from the logarithms of a pixel's energies to those of the column under an echo in each gate.

    Attributes
    ----------
    mid : ndarray, shape (gate,)
        Middles of the gates.
    half : int
        Gates on each side that the echo may fill.
    first : int
        First gate in which an echo can be found.
    mean, slope : ndarray, shape (gate, gate)
        Logarithms times column k give mean and slope of the line through the gates before an echo in gate k.
    lever : ndarray, shape (gate,)
        How far gate k lies behind the middle of those gates.
    between : ndarray, shape (gate, gate)
        Logarithms times column k give, in gate k, the line between the gates before and behind the echo.
    deep : ndarray, shape (gate, gate)
        Energies times column k give the mean of the gates behind.
    has_deep : ndarray, shape (gate,)
        Whether there are gates behind.
    """

    def __init__(self, mid: FloatArray, half: int) -> None:
        count = mid.size
        self.mid, self.half, self.first = mid, half, half + 2
        self.lever = np.zeros(count)
        self.mean, self.slope, self.between, self.deep = (np.zeros((count, count)) for _ in range(4))
        self.has_deep = np.arange(count) + half + 1 < count
        for k in range(self.first, count):
            near = np.arange(max(k - half - _COLUMN_GATES, 0), k - half)
            behind = np.arange(k + half + 1, min(k + half + 1 + _DEEP_GATES, count))
            x = mid[near] - mid[near].mean()
            self.lever[k] = mid[k] - mid[near].mean()
            self.mean[near, k] = 1 / near.size
            self.slope[near, k] = x / np.sum(x**2)
            if behind.size:
                last = near[-2:]
                share = (mid[k] - mid[last].mean()) / (mid[behind].mean() - mid[last].mean())
                self.between[last, k] = (1 - share) / last.size
                self.between[behind, k] = share / behind.size
                self.deep[behind, k] = 1 / behind.size


def _ranges(energy: FloatArray, stderr: FloatArray, column: _ColumnModel) -> FloatArray:
    """Return depth, sigma and confidence of pixels, shape (3, pixel), from energies of shape (pixel, gate)."""
    from scipy.special import ndtr

    known = np.asarray(np.isfinite(energy + stderr).all(axis=1))
    e, s = np.where(known[:, None], energy, 0), np.where(known[:, None], stderr, 0)
    # A floor far below every signal keeps logarithms finite where there is neither light nor noise.
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
    significant = z >= _SIGNIFICANT * z.max(axis=1, keepdims=True)
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
        shift = np.sum(np.where(limited | (weight == 0), 0, lever * level), axis=1)
        variance += shift**2 * np.take_along_axis(background_variance, at_peak, 1)[:, 0]
    found = known & (z_peak > 0)
    confidence = ndtr(z_peak) ** (column.mid.size - column.first)
    return np.stack(
        [np.where(found, depth, np.nan), np.where(found, np.sqrt(variance), np.nan), np.where(found, confidence, 0)]
    )
