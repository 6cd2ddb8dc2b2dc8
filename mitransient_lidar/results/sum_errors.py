"""Standard errors for sums over a render's bins, whose passes correlate the errors between different bins."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.results.attributes import label

#: Variable with the correlation between bin errors, and its dimensions.
VARIABLE, DIMS = "error_correlation", ("error_time", "other_error_time")

_SUMS, _FAINT = 256, 1e-6  #: Most sums of a length, and smallest sum over the largest one, for the curve.

#: Passes below which correlations are hardly known, smallest ratio of means, and samples in memory at a time for them.
_FEW_PASSES, _LEAST_RATIO, _TOGETHER = 8, 0.1, 2**18

_CURVE = ("error_inflation_bins", "error_inflation")


@dataclass(frozen=True)
class BlockCorrelation:
    """Correlation between bin errors, the same for all bins in two blocks."""

    #: Mean correlation between a bin in one block and a bin in another, shape (blocks, blocks); on the diagonal,
    #: between different bins in a block.
    correlation: FloatArray
    block: np.ndarray[Any, np.dtype[np.intp]]  #: Block of each bin, ascending, shape (time,).
    #: Ratio of given errors to bin errors, shape () or (time,).
    inflation: FloatArray = field(default_factory=lambda: np.ones(()))

    def covariance(self, scaled: FloatArray, first: int = 0) -> FloatArray:
        """Return the covariances between k sums over the same bins, shape (..., k, k).

        `scaled` are neighbouring bins' errors times their weights, shape (..., k, bins), from bin `first` on.
        """
        part = slice(first, first + scaled.shape[-1])
        own, scaled = self.block[part], scaled / np.broadcast_to(self.inflation, self.block.shape)[part]
        edges = np.flatnonzero(np.diff(own, prepend=-1))
        sums = np.add.reduceat(scaled, edges, axis=-1)
        shared = self.correlation[np.ix_(own[edges], own[edges])]
        between = np.tensordot(sums, shared, 1) @ np.swapaxes(sums, -1, -2)
        return np.asarray(between + (scaled * self._alone[own]) @ np.swapaxes(scaled, -1, -2))

    def variances(self, scaled: FloatArray, places: IntArray) -> FloatArray:
        """Return the variances for sums, shape (n,), each over its own bins `places`, shape (n, bins)."""
        own = self.block[places]
        scaled = scaled / np.broadcast_to(self.inflation, self.block.shape)[places]
        local = own - own.min(axis=1, keepdims=True)
        count, width = len(own), int(local.max(initial=0)) + 1
        index = local + width * np.arange(count)[:, np.newaxis]
        sums = np.bincount(index.ravel(), scaled.ravel(), count * width).reshape(count, width)
        blocks = np.minimum(own.min(axis=1, keepdims=True) + np.arange(width), len(self.correlation) - 1)
        variance = np.sum(self._alone[own] * scaled**2, axis=1)
        for lag in range(width):
            one, other = slice(width - lag), slice(lag, None)
            shared = self.correlation[blocks[:, one], blocks[:, other]]
            variance += (2 if lag else 1) * np.sum(sums[:, one] * sums[:, other] * shared, axis=1)
        return np.asarray(variance)

    @property
    def _alone(self) -> FloatArray:
        """Variance part that a bin in each block has on its own: a bin is fully correlated with itself."""
        return np.asarray(1 - np.diagonal(self.correlation))


@dataclass(frozen=True)
class SumErrors:
    """Correlation between bin errors, from a render's passes."""

    shared: BlockCorrelation | None  #: The correlation; None where only the curve is known, as from an EXR file.
    #: Numbers of bins, and the median ratios between their sums' errors and independent bins', shape (2, n); empty
    #: where nothing is known.
    curve: FloatArray

    @classmethod
    def of(cls, dataset: xr.Dataset) -> SumErrors | None:
        """Return a result's statement, None without one.

        Raises `UserError` if the result states another correlation kind.
        """
        bins, inflation = (np.atleast_1d(np.asarray(dataset.attrs.get(name, []), np.float64)) for name in _CURVE)
        curve = np.stack([bins, inflation]) if bins.size and bins.shape == inflation.shape else np.zeros((2, 0))
        if VARIABLE not in dataset:
            return cls(None, curve) if curve.size else None
        _check(dataset)
        time, middles = (np.asarray(dataset[name].values, dtype=np.float64) for name in ("time", DIMS[0]))
        # All blocks but the last one are of one size.
        edges = middles[:-1] + 0.5 * (middles[1:2] - middles[:1])
        # Joined results have one for each: alike scenes have alike correlations.
        several = [name for name in dataset[VARIABLE].dims if name not in DIMS]
        correlation = dataset[VARIABLE].mean(several).transpose(*DIMS).values.astype(np.float64)
        return cls(BlockCorrelation(correlation, np.searchsorted(edges, time)), curve)

    def of_sum(self, deviation: FloatArray, weights: FloatArray, first: int = 0) -> FloatArray:
        """Return the standard error for a weighted sum over neighbouring bins, from the record's bin `first` on.

        Standard errors have the shape (..., bins), weights this one or (bins,).
        """
        scaled = deviation * weights
        if self.shared is None:
            number = float(np.sum(weights) ** 2 / max(np.sum(weights**2), 1e-300))
            alone, bound = np.linalg.norm(scaled, axis=-1), np.sum(np.abs(scaled), axis=-1)
            return np.asarray(np.minimum(alone * self._of_curve(max(number, 1.0)), bound))
        variance = self.shared.covariance(scaled[..., np.newaxis, :], first)[..., 0, 0]
        return np.asarray(np.sqrt(np.maximum(variance, 0)))

    def of_means(self, deviation: FloatArray, run: int, passes: int) -> FloatArray:
        """Return the error ratio to independent bins for means over `run` bins about each bin.

        The ratio is for the squared errors' mean over pixels, shape (pixels, time); it has the shape (time,). A few
        passes may show correlations far below the true ones: the ratio is then at least the median one.
        """
        count = deviation.shape[-1]
        least = max(self._of_curve(run), 1.0) if passes < _FEW_PASSES else _LEAST_RATIO
        if self.shared is None:
            return np.full(count, max(self._of_curve(run), least))
        typical, run = np.sqrt(np.mean(deviation**2, axis=0)), min(run, count)
        ratio, together = np.ones(count), max(_TOGETHER // run, 1)
        for at in range(0, count, together):
            start = np.clip(np.arange(at, min(at + together, count)) - run // 2, 0, count - run)
            places = start[:, np.newaxis] + np.arange(run)
            own = typical[places]
            whole, alone = self.shared.variances(own, places), np.sum(own**2, axis=1)
            known = alone > 0
            ratio[at : at + together][known] = np.sqrt(np.maximum(whole[known], 0) / alone[known])
        return np.maximum(ratio, least)

    def median_curve(self, mean: FloatArray, stderr: FloatArray) -> tuple[list[int], list[float]]:
        """Return numbers of bins, 1, 2, 4, ..., and their sums' median error ratios to independent bins.

        Mean and standard error are bin values, shape (pixels, time). Sums below a millionth of the brightest one, and
        more than `_SUMS` for each number, are left out.
        """
        typical, light = np.sqrt(np.mean(stderr**2, axis=0)), np.mean(mean, axis=0)
        bins, inflation = [1], [1.0]
        while 2 * bins[-1] <= light.size:
            size = 2 * bins[-1]
            starts = np.arange(0, light.size - size + 1, max(size // 2, light.size // _SUMS, 1))
            sums = np.array([light[at : at + size].sum() for at in starts])
            alone = np.array([math.sqrt(float(np.sum(typical[at : at + size] ** 2))) for at in starts])
            lit = (alone > 0) & (sums > _FAINT * np.nanmax(sums, initial=0.0))
            whole = [float(self.of_sum(typical[at : at + size], np.ones(size), int(at))) for at in starts[lit]]
            if not lit.any():
                break
            bins.append(size)
            inflation.append(float(np.median(np.array(whole) / alone[lit])))
        return bins, inflation

    def _of_curve(self, number: float) -> float:
        """Return the ratio for a number of bins: linear in its logarithm, with the square root beyond the last one.

        It is 1 without a curve.
        """
        if not self.curve.size:
            return 1.0
        known, values = self.curve
        return float(np.interp(math.log(number), np.log(known), values)) * math.sqrt(max(number / known[-1], 1))


def with_correlation(dataset: xr.Dataset, middles_ns: FloatArray, correlation: FloatArray) -> xr.Dataset:
    """Return a render's result with the correlation between its bin errors, and the curve in its attributes.

    The arguments are the block middles [ns], shape (blocks,), and the correlations in `SumErrors`.
    """
    middles = {name: (name, middles_ns) for name in DIMS}
    dataset = label(dataset.assign({VARIABLE: (DIMS, correlation.astype(np.float32))}).assign_coords(middles))
    known = SumErrors.of(dataset)
    assert known is not None
    count = dataset.sizes["time"]
    mean, stderr = (dataset[name].values.reshape(-1, count) for name in ("waveform", "waveform_stderr"))
    bins, inflation = known.median_curve(mean, stderr)
    return dataset.assign_attrs(dict(zip(_CURVE, (bins, inflation), strict=True)))


def _check(dataset: xr.Dataset) -> None:
    """Raise `UserError` if a result lacks the correlation between some blocks of bins, or between its bins."""
    sizes = [dataset[VARIABLE].sizes.get(name, 0) for name in DIMS]
    if sizes[0] != sizes[1] or not sizes[0]:
        raise UserError(
            f"the result has {VARIABLE} over {dict(dataset[VARIABLE].sizes)}: it must be square over {DIMS}"
        )
    for name, dims in ((VARIABLE, None), (DIMS[0], DIMS[:1]), ("time", ("time",))):
        values = dataset[name]
        if values.dtype.kind not in "fiu" or (dims and values.dims != dims) or not np.isfinite(values.values).all():
            raise UserError(f"the result has {name} that is not of finite numbers: {VARIABLE} needs them")
