"""Standard errors of sums over bins of a render, whose passes give correlated errors to different bins."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from mitransient_lidar.core.validation import FloatArray

#: Variable with the correlation of the errors of bins, and its dimensions.
VARIABLE, DIMS = "error_correlation", ("error_time", "other_error_time")

#: Most sums of a length, and smallest sum over the largest one, for the curve.
_SUMS, _FAINT = 256, 1e-6

_CURVE = ("error_inflation_bins", "error_inflation")


@dataclass(frozen=True)
class SumErrors:
    """Correlation of the errors of bins, from the passes of a render.

    Attributes
    ----------
    correlation
        Mean correlation of the errors of the bins of two blocks of bins, shape (blocks, blocks); within one block, of
        different bins. None where only the curve is known, as from an EXR file.
    block
        Block of each bin, shape (time,).
    curve
        Numbers of bins, and the median ratios of the errors of their sums to those of independent bins, shape (2, n);
        empty where nothing is known.
    """

    correlation: FloatArray | None
    block: np.ndarray[Any, np.dtype[np.intp]]
    curve: FloatArray

    @classmethod
    def of(cls, dataset: xr.Dataset) -> SumErrors | None:
        """Return what a result states, None without a statement."""
        curve = _curve(dataset.attrs)
        time = np.asarray(dataset["time"].values, dtype=np.float64)
        if VARIABLE not in dataset:
            return cls(None, np.zeros(time.size, dtype=np.intp), curve) if curve.size else None
        middles = np.asarray(dataset[DIMS[0]].values, dtype=np.float64)
        block = np.abs(time[:, np.newaxis] - middles).argmin(axis=1)
        return cls(np.asarray(dataset[VARIABLE].values, dtype=np.float64), block, curve)

    def of_sum(self, deviation: FloatArray, weights: FloatArray, first: int = 0) -> FloatArray:
        """Return the standard error of a sum of weighted bins.

        Parameters
        ----------
        deviation
            Standard errors of neighbouring bins, shape (..., bins).
        weights
            Their weights, shape (bins,) or that of `deviation`.
        first
            Number of the first of them in the record.
        """
        scaled = deviation * weights
        squares = np.sum(scaled**2, axis=-1)
        if self.correlation is None:
            number = float(np.sum(weights) ** 2 / max(np.sum(weights**2), 1e-300))
            number = max(number, 1.0)
            bound = np.sum(np.abs(scaled), axis=-1)
            return np.asarray(np.minimum(np.sqrt(squares) * self._of_curve(number), bound))
        own = self.block[first : first + scaled.shape[-1]]
        edges = np.flatnonzero(np.diff(own, prepend=-1))
        sums, parts = (np.add.reduceat(values, edges, axis=-1) for values in (scaled, scaled**2))
        shared = self.correlation[np.ix_(own[edges], own[edges])]
        # A bin is fully correlated with itself, whatever its block is.
        diagonal = np.diagonal(shared)
        variance = np.sum((sums @ shared) * sums, axis=-1) + np.sum((1 - diagonal) * parts, axis=-1)
        return np.asarray(np.sqrt(np.maximum(variance, 0)))

    def of_means(self, deviation: FloatArray, run: int) -> FloatArray:
        """Return the ratio of the errors of means over `run` bins about each bin to those of independent bins.

        The ratio is for the mean over pixels of the squares of the errors, shape (pixels, time); it is of the shape
        (time,).
        """
        count = deviation.shape[-1]
        if self.correlation is None:
            return np.full(count, self._of_curve(run))
        typical = np.sqrt(np.mean(deviation**2, axis=0))
        start = np.clip(np.arange(count) - run // 2, 0, max(count - run, 0))
        whole = [self.of_sum(typical[at : at + run], np.ones(min(run, count)), at) for at in start]
        alone = [math.sqrt(float(np.sum(typical[at : at + run] ** 2))) for at in start]
        return np.divide(whole, alone, out=np.ones(count), where=np.array(alone) > 0)

    def matrix(self) -> FloatArray | None:
        """Return the correlations of all bins, shape (time, time), None where only the curve is known."""
        if self.correlation is None:
            return None
        whole = self.correlation[np.ix_(self.block, self.block)]
        np.fill_diagonal(whole, 1.0)
        return whole

    def median_curve(self, mean: FloatArray, stderr: FloatArray) -> tuple[list[int], list[float]]:
        """Return numbers of bins, 1, 2, 4, ..., and the median ratios of the errors of their sums to independent bins.

        Mean and standard error are those of bins, shape (pixels, time). Sums below a millionth of the brightest one,
        and more than `_SUMS` of each number, are left out.
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
        """Return the ratio for a number of bins: linear in its logarithm, with the square root beyond the last one."""
        known, values = self.curve
        return float(np.interp(math.log(number), np.log(known), values)) * math.sqrt(max(number / known[-1], 1))


def with_correlation(dataset: xr.Dataset, middles_ns: FloatArray, correlation: FloatArray) -> xr.Dataset:
    """Return a result of a render with the correlation of the errors of its bins, and the curve of its attributes.

    The arguments are the middles of the blocks [ns], shape (blocks,), and the correlations of `SumErrors`.
    """
    described = {"units": "1", "long_name": "mean correlation of the errors of the waveform's bins in two blocks"}
    middles = {name: (name, middles_ns, {"units": "ns", "long_name": "middle of a block of bins"}) for name in DIMS}
    values = correlation.astype(np.float32)
    dataset = dataset.assign({VARIABLE: (DIMS, values, described)}).assign_coords(middles)
    known = SumErrors.of(dataset)
    assert known is not None
    count = dataset.sizes["time"]
    mean, stderr = (dataset[name].values.reshape(-1, count) for name in ("waveform", "waveform_stderr"))
    bins, inflation = known.median_curve(mean, stderr)
    return dataset.assign_attrs(dict(zip(_CURVE, (bins, inflation), strict=True)))


def _curve(attributes: Mapping[str, Any]) -> FloatArray:
    bins, inflation = (np.atleast_1d(np.asarray(attributes.get(name, []), np.float64)) for name in _CURVE)
    return np.stack([bins, inflation]) if bins.size and bins.shape == inflation.shape else np.zeros((2, 0))
