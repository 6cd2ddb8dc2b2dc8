"""Means and standard errors over independent passes, and the error by which a render is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mitransient_lidar.core.validation import FloatArray

#: Pixels darker than this share of the median do not count in the errors of radiance.
_DARK_PIXEL = 1e-2


class PassStatistics:
    """Mean and standard error of arrays that come one a pass (Welford 1962, doi:10.1080/00401706.1962.10490022)."""

    def __init__(self) -> None:
        self.count = 0
        self._mean: FloatArray | None = None
        self._squares: FloatArray | None = None

    def add(self, values: FloatArray) -> None:
        """Add the result of one pass."""
        if self._mean is None or self._squares is None:
            self._mean, self._squares = np.zeros_like(values), np.zeros_like(values)
        self.count += 1
        deviation = values - self._mean
        self._mean += deviation / self.count
        self._squares += deviation * (values - self._mean)

    @property
    def mean(self) -> FloatArray:
        """Mean over the passes."""
        if self._mean is None:
            raise ValueError("passes = 0 must be at least 1 for a mean")
        return self._mean

    @property
    def stderr(self) -> FloatArray:
        """Standard error of the mean; NaN before the second pass."""
        if self._squares is None:
            raise ValueError("passes = 0 must be at least 1 for a standard error")
        if self.count < 2:
            return np.full_like(self._squares, np.nan)
        return np.sqrt(self._squares / (self.count - 1) / self.count)

    def stderr_of(self, part: slice) -> FloatArray:
        """Return the standard error of the mean of part of the first axis."""
        if self._squares is None or self.count < 2:
            raise ValueError(f"passes = {self.count} must be at least 2 for a standard error")
        return np.asarray(np.sqrt(self._squares[part] / (self.count - 1) / self.count))


class RatioStatistics:
    """Ratio of two sums over passes, and its standard error.

    Each pass gives, for each pixel, radiance times solid angle and the solid angle of its samples. The ratio of the
    totals is the mean radiance; a pass without a sample in a pixel does no harm. The standard error is that of the
    ratio of means to first order (Cochran 1977, Sampling Techniques, section 2.11).
    """

    def __init__(self, count: int) -> None:
        self.count = 0
        self._sums = np.zeros((5, count))

    def add(self, found: FloatArray, sampled: FloatArray) -> None:
        """Add the result of one pass, shape (pixels,)."""
        self.count += 1
        self._sums += [found, sampled, found * found, found * sampled, sampled * sampled]

    @property
    def ratio(self) -> FloatArray:
        """Mean of the ratio; NaN where nothing was sampled."""
        found, sampled = self._sums[:2]
        return np.asarray(np.divide(found, sampled, out=np.full_like(found, np.nan), where=sampled > 0))

    @property
    def stderr(self) -> FloatArray:
        """Standard error of the mean, NaN before the second pass."""
        if self.count < 2:
            return np.full(self._sums.shape[1], np.nan)
        _, sampled, found2, product, sampled2 = self._sums
        ratio = self.ratio
        residual = np.maximum(found2 - 2 * ratio * product + ratio**2 * sampled2, 0)
        variance = residual * self.count / (self.count - 1)
        unknown = np.full_like(sampled, np.nan)
        return np.asarray(np.divide(np.sqrt(variance), sampled, out=unknown, where=sampled > 0))

    @property
    def invalid(self) -> int:
        """Number of pixels that were sampled and whose mean is not finite."""
        return int(np.count_nonzero((self._sums[1] > 0) & ~np.isfinite(self.ratio)))

    def relative_errors(self) -> FloatArray:
        """Return the relative standard errors of the pixels that are not dark."""
        ratio, stderr = self.ratio, self.stderr
        known = np.isfinite(ratio) & (ratio > 0)
        if not known.any():
            return np.zeros(0)
        lit = known & (np.where(known, ratio, 0) > _DARK_PIXEL * np.median(ratio[known]))
        return np.asarray(stderr[lit] / ratio[lit])


class ErrorInflation:
    """How errors of sums over neighbouring bins grow beyond those of independent bins.

    Bins of one pass share paths, so that their errors go together. Sums over blocks of 2, 4, 8, ... bins are followed
    from pass to pass.
    """

    def __init__(self) -> None:
        self._blocks: dict[int, PassStatistics] = {}

    def add(self, values: FloatArray) -> None:
        """Add the result of one pass, shape (pixels, time)."""
        size, sums = 2, values
        while sums.shape[1] >= 2:
            sums = sums[:, : sums.shape[1] // 2 * 2].reshape(len(sums), -1, 2).sum(axis=2)
            self._blocks.setdefault(size, PassStatistics()).add(sums)
            size *= 2

    def over(self, mean: FloatArray, stderr: FloatArray) -> tuple[list[int], list[float]]:
        """Return numbers of bins and, for each, the median ratio of a sum's true error to that of independent bins.

        Parameters
        ----------
        mean, stderr
            Mean and standard error of the bins, shape (pixels, time). Blocks that hold less than a millionth of the
            brightest one do not count.
        """
        bins, inflation = [1], [1.0]
        for size, block in self._blocks.items():
            if block.count < 2:
                continue
            used = mean.shape[1] // size * size
            quadrature = np.sqrt((stderr[:, :used] ** 2).reshape(len(stderr), -1, size).sum(axis=2))
            counted = (quadrature > 0) & (block.mean > 1e-6 * np.nanmax(block.mean, initial=0.0))
            if counted.any():
                bins.append(size)
                inflation.append(float(np.median(block.stderr[counted] / quadrature[counted])))
        return bins, inflation


@dataclass(frozen=True)
class ErrorWindow:
    """The bins in which a waveform's error counts: from the surface echo to the end of the bottom echo.

    Parameters
    ----------
    start_ns, end_ns
        Limits for each pixel [ns], shape (pixels,).
    time_ns
        Centres of the bins [ns], shape (time,).
    """

    start_ns: FloatArray
    end_ns: FloatArray
    time_ns: FloatArray

    def bins(self) -> NDArray[np.bool_]:
        """Return which bins count, shape (pixels, time)."""
        return np.asarray((self.time_ns >= self.start_ns[:, None]) & (self.time_ns <= self.end_ns[:, None]))

    def relative_errors(self, waveform: FloatArray, stderr: FloatArray) -> FloatArray:
        """Return the relative standard errors of the bins that count, infinite where nothing was received.

        Pixels that receive less than a thousandth of the brightest one are dark and do not count.

        Parameters
        ----------
        waveform, stderr
            Waveform and its standard error [W], shape (pixels, time).
        """
        energy = waveform.sum(axis=1)
        lit = energy > 1e-3 * energy.max(initial=0.0)
        chosen = self.bins() & lit[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = stderr[chosen] / waveform[chosen]
        return np.asarray(np.where(waveform[chosen] > 0, relative, np.inf))
