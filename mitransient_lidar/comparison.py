"""Whether two results agree: differences in standard errors, bin by bin."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.accuracy import FloatArray
from mitransient_lidar.errors import UserError

#: Chance that two results of the same scene are said to differ.
SIGNIFICANCE = 0.01

#: Neighbouring bins over which relative errors are averaged. Over few passes of an estimator with rare large
#: contributions a bin's own error is small where they are missing, just where its value is low: chance would look
#: like a difference.
_NEIGHBOURS = 5

#: Bins known less well than this are left out: the spread of few passes says little about them.
LARGEST_RELATIVE_ERROR = 0.3


@dataclass(frozen=True)
class Comparison:
    """Differences between two results.

    Attributes
    ----------
    z
        Difference of the impulse responses in its standard errors, second minus first, shape (pixel, time); NaN where
        a bin does not count. Differences over few passes are brought to the normal distribution.
    limit
        Largest ``abs(z)`` that chance explains among so many bins (Sidak 1967, doi:10.1080/01621459.1967.10482935).
    energy_ratio, energy_ratio_stderr
        Energy of the bins that count, second over first, and its standard error if bins were independent.
    """

    z: FloatArray
    limit: float
    energy_ratio: float
    energy_ratio_stderr: float

    @property
    def bin_count(self) -> int:
        """Number of bins that count."""
        return int(np.isfinite(self.z).sum())

    @property
    def rms(self) -> float:
        """Root mean square of z, 1 for two results that agree."""
        return float(np.sqrt(np.nanmean(self.z**2)))

    @property
    def largest(self) -> float:
        """Largest ``abs(z)``."""
        return float(np.nanmax(np.abs(self.z)))

    @property
    def agrees(self) -> bool:
        """Whether chance explains the largest difference."""
        return self.largest <= self.limit


def compare(first: xr.Dataset, second: xr.Dataset) -> Comparison:
    """Compare the impulse responses of two results bin by bin.

    Bins count between the surface echo and the end of the bottom echo, where both results know them to 30 %.

    Parameters
    ----------
    first, second
        Results with the same pixels and time bins.

    Raises
    ------
    UserError
        When pixels or bins differ, or no bin counts.
    """
    values = [_by_pixel(result, "impulse_response") for result in (first, second)]
    errors = [_by_pixel(result, "impulse_response_stderr") for result in (first, second)]
    times = [result["time"].values for result in (first, second)]
    if values[0].shape != values[1].shape or not np.allclose(times[0], times[1]):
        shapes = " and ".join(
            f"{len(value)} pixels x {len(time)} bins" for value, time in zip(values, times, strict=True)
        )
        raise UserError(f"the results have {shapes}: they must have the same pixels and time bins")
    variances = [error**2 for error in errors]
    counts = [int(result.attrs.get("passes", 0)) for result in (first, second)]
    if min(counts) < 2:
        raise UserError(f"the results have {counts[0]} and {counts[1]} passes: both must have at least 2")
    known = [error < LARGEST_RELATIVE_ERROR * value for value, error in zip(values, errors, strict=True)]
    inside = np.ones(len(times[0]), dtype=bool)
    for result in (first, second):
        start, end = (result.attrs.get(f"window_{name}_ns") for name in ("start", "end"))
        if start is not None and end is not None:
            inside &= (times[0] >= start) & (times[0] <= end)
    counted = known[0] & known[1] & inside & (variances[0] + variances[1] > 0)
    if not counted.any():
        raise UserError("the results share no bin that both know to 30 %: render more passes")
    difference = np.where(counted, values[1] - values[0], np.nan)
    relative = [pooled_relative_variance(value, variance) for value, variance in zip(values, variances, strict=True)]
    # If the results agree, both have the errors that belong to their common mean.
    weight = np.where(counted, relative[0] + relative[1], np.nan)
    common = (relative[1] * values[0] + relative[0] * values[1]) / weight
    # At least what each has found itself: where one has missed rare paths the common mean is too small.
    parts = [np.maximum(part * common**2, own) for part, own in zip(relative, variances, strict=True)]
    total = parts[0] + parts[1]
    freedom = _NEIGHBOURS * total**2 / sum(part**2 / (count - 1) for part, count in zip(parts, counts, strict=True))
    z = _as_normal(difference / np.sqrt(total), freedom)
    sums = [float(value[counted].sum()) for value in values]
    spread = float(np.sqrt(np.nansum(total))) / sums[0]
    return Comparison(z, sidak_limit(int(counted.sum())), sums[1] / sums[0], spread)


def sidak_limit(count: int, significance: float = SIGNIFICANCE) -> float:
    """Return the ``abs(z)`` that the largest of `count` normal numbers exceeds with chance `significance`."""
    from scipy.special import ndtri

    # log1p and expm1 keep the digits of a chance of 1e-6.
    return float(-ndtri(-0.5 * np.expm1(np.log1p(-significance) / count)))


def plot_comparison(first: xr.Dataset, second: xr.Dataset, path: str | os.PathLike[str]) -> Comparison:
    """Draw two results with bands of two standard errors, and below them their difference in standard errors.

    Parameters
    ----------
    first, second
        Results with the same pixels and time bins.
    path
        File to write, ending in ``.png``, ``.pdf`` or ``.svg``.

    Raises
    ------
    UserError
        As `compare`, or when the file cannot be written.
    """
    from matplotlib.figure import Figure

    from mitransient_lidar.plotting import check_format, colours, time_limits
    from mitransient_lidar.results import replacing

    check_format(Path(path))
    outcome = compare(first, second)
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    time = first["time"].values
    palette = colours(len(outcome.z))
    for result, style in ((first, "-"), (second, "--")):
        label = str(result.attrs.get("integrator", "")) or str(result.attrs.get("scene", ""))
        power, error = _by_pixel(result, "waveform"), _by_pixel(result, "waveform_stderr")
        for index, colour in enumerate(palette):
            low, high = power[index] - 2 * error[index], power[index] + 2 * error[index]
            upper.plot(time, power[index], style, color=colour, linewidth=0.9, label=label if index == 0 else None)
            upper.fill_between(time, np.maximum(low, 1e-30), high, color=colour, alpha=0.25, linewidth=0)
    shown = _by_pixel(first, "waveform")[np.isfinite(outcome.z)]
    upper.set_yscale("log")
    upper.set_ylim(0.5 * shown[shown > 0].min(), 2 * shown.max())
    upper.set_xlim(time_limits(first))
    upper.set_ylabel("received power (W)")
    upper.legend(frameon=False)
    for index, colour in enumerate(palette):
        lower.plot(time, outcome.z[index], ".", color=colour, markersize=3)
    for level in (-outcome.limit, outcome.limit):
        lower.axhline(level, color="0.5", linewidth=0.8, linestyle=":")
    lower.set_ylim(-1.5 * max(outcome.limit, outcome.largest), 1.5 * max(outcome.limit, outcome.largest))
    lower.set_ylabel("difference (standard errors)")
    lower.set_xlabel("time since the pulse left the transmitter (ns)")
    for ax in (upper, lower):
        ax.grid(True, color="0.9", linewidth=0.7)
    figure.suptitle(
        f"{first.attrs.get('scene', '')}: rms {outcome.rms:.2f}, largest {outcome.largest:.1f} of {outcome.limit:.1f} "
        f"standard errors over {outcome.bin_count} bins",
        fontsize="medium",
    )
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=160)
    return outcome


def pooled_relative_variance(values: FloatArray, variances: FloatArray) -> FloatArray:
    """Return the relative variance of each bin [1], shape (pixel, time), or that of a few bins about it if larger.

    Parameters
    ----------
    values, variances
        Means and the variances of the means, shape (pixel, time).
    """
    from scipy.ndimage import convolve1d

    mean, variance = np.nan_to_num(values), np.nan_to_num(variances)
    box = np.full(_NEIGHBOURS, 1 / _NEIGHBOURS)
    around = convolve1d(variance, box, axis=1) / np.maximum(convolve1d(mean, box, axis=1), 1e-150) ** 2
    # At the beginning of an echo a bin may be worse known than those about it.
    return np.asarray(np.maximum(around, variance / np.maximum(mean, 1e-150) ** 2))


def _by_pixel(result: xr.Dataset, name: str) -> FloatArray:
    values = result[name].values
    return np.asarray(values.reshape(-1, values.shape[-1]), dtype=np.float64)


def _as_normal(t: FloatArray, freedom: FloatArray) -> FloatArray:
    """Return the normal numbers as likely as Student's t (Welch 1947, doi:10.1093/biomet/34.1-2.28)."""
    from scipy.special import ndtri, stdtr

    tail: npt.NDArray[np.float64] = stdtr(freedom, -np.abs(t))
    return np.asarray(-np.sign(t) * ndtri(np.maximum(tail, 1e-300)))
