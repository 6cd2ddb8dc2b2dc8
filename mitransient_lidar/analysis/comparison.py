"""Agreement of two results: differences in standard errors, bin by bin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.results.gate_stack import check_stack
from mitransient_lidar.results.sum_errors import SumErrors
from mitransient_lidar.results.waveform_files import placed_in_time

BoolArray = npt.NDArray[np.bool_]

SIGNIFICANCE = 0.01  #: Probability of a difference between two results for the same scene.

#: Neighbouring bins over which relative errors are averaged, since value and error of a bin without rare large
#: contributions are both too small.
_NEIGHBOURS = 5

_ANGLES = ("angle_x", "angle_y")

#: Largest difference between a pixel's angles in two results, relative to the largest angle of all.
_SAME_PLACE = 0.1

#: Largest relative error of a bin; larger ones are estimated poorly by the spread of few passes.
_LARGEST_RELATIVE_ERROR = 0.3


@dataclass(frozen=True)
class Comparison:
    """Differences between two results."""

    #: Difference between the impulse responses in standard errors, second minus first, shape (pixel, time), converted
    #: to the normal distribution for few passes; NaN in excluded bins.
    z: FloatArray
    #: Critical ``abs(z)`` for the largest difference over all bins (Sidak 1967, doi:10.1080/01621459.1967.10482935).
    limit: float
    #: Energy in the included bins, second over first, and its standard error. Where the results state the correlation
    #: between bin errors (`results.sum_errors`), it is the error of the power in these bins; pixels are independent.
    energy_ratio: float
    energy_ratio_stderr: float

    @property
    def bin_count(self) -> int:
        """Number of included bins."""
        return int(np.isfinite(self.z).sum())

    @property
    def rms(self) -> float:
        """Root mean square of z, 1 for results that agree."""
        return float(np.sqrt(np.nanmean(self.z**2)))

    @property
    def largest(self) -> float:
        """Largest ``abs(z)``."""
        return float(np.nanmax(np.abs(self.z)))

    @property
    def agrees(self) -> bool:
        """Whether the largest difference is not significant."""
        return self.largest <= self.limit


def as_bins(first: xr.Dataset, second: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Return two results with time bins; where one has gates alone, both results' gates are bins at their middles.

    Records of shots become their mean signal, with the error by the spread of the shots, which count as passes. Raises
    `UserError` if one has gates or a record alone and the other has none, or a record has a single shot.
    """
    results = first, second
    if all("impulse_response" in one for one in results):
        return results
    if all("signal" in one and "time" in one["signal"].dims for one in results):
        return _of_shots(first), _of_shots(second)
    names = {f"gate_energy{end}": f"impulse_response{end}" for end in ("", "_stderr")}
    found = []
    for stack in map(check_stack, results):
        bins = stack.rename(names).assign_coords(time=stack["gate_start"] + 0.5 * stack["gate_width"])
        power = {f"waveform{end}": bins[f"impulse_response{end}"] for end in ("", "_stderr")}
        found.append(bins.assign(power).swap_dims(gate="time").transpose(..., "time"))
    return found[0], found[1]


def _of_shots(record: xr.Dataset) -> xr.Dataset:
    """Return the mean signal of the shots of a record and its error as power and energy of bins."""
    if record.sizes.get("shot", 1) < 2:
        raise UserError("a record has 1 shot: both must have at least 2, whose spread gives the errors")
    record = placed_in_time(record)
    signal, count = record["signal"], record.sizes["shot"]
    mean, error = signal.mean("shot", skipna=False), signal.std("shot", ddof=1, skipna=False) / np.sqrt(count)
    names = ("waveform", "impulse_response")
    bins = {name + end: one for name in names for end, one in (("", mean), ("_stderr", error))}
    return record.drop_vars([*record.data_vars]).assign(bins).assign_attrs(passes=count)


def compare(first: xr.Dataset, second: xr.Dataset) -> Comparison:
    """Compare the impulse responses of two results with the same pixels and time bins, bin by bin.

    Results with gates alone are compared gate by gate. Errors of a pixel's gates, which may overlap, count in the
    energy error as if they had one sign.

    Bins from the surface echo to the end of the bottom echo with a relative error below 30 % in both are included.
    Raises `UserError` if pixels or bins differ, or no bin is included.
    """
    from scipy.special import ndtri, stdtr

    results = as_bins(first, second)
    times = [result["time"].values for result in results]
    shapes = [_by_pixel(result, "impulse_response").shape for result in results]
    if shapes[0] != shapes[1] or not np.allclose(times[0], times[1]):
        described = " and ".join(f"{pixels} pixels x {bins} bins" for pixels, bins in shapes)
        other = ", at different times" if shapes[0] == shapes[1] else ""
        raise UserError(f"the results have {described}{other}: they must have the same pixels and time bins")
    angles = [
        np.ravel([result[name].values for name in _ANGLES]) for result in results if {*_ANGLES} <= {*result.coords}
    ]
    if len(angles) == 2 and np.max(np.abs(angles[1] - angles[0])) > _SAME_PLACE * np.max(np.abs(angles[0])) + 1e-6:
        raise UserError("the results have pixels at different angles: they must have the same pixels and time bins")
    values, errors = (
        np.stack([_by_pixel(result, name) for result in results])
        for name in ("impulse_response", "impulse_response_stderr")
    )
    variances = errors**2
    counts = [int(result.attrs.get("passes", 0)) for result in results]
    if min(counts) < 2:
        raise UserError(f"the results have {counts[0]} and {counts[1]} passes: both must have at least 2")
    inside = np.ones(len(times[0]), dtype=bool)
    for result in results:
        start, end = (result.attrs.get(f"window_{name}_ns") for name in ("start", "end"))
        if start is not None and end is not None:
            inside &= (times[0] >= start) & (times[0] <= end)
    counted = (errors < _LARGEST_RELATIVE_ERROR * values).all(axis=0) & inside & (variances[0] + variances[1] > 0)
    if not counted.any():
        raise UserError("the results share no bin with a relative error below 30 %: render more passes")
    difference = np.where(counted, values[1] - values[0], np.nan)
    relative = [pooled_relative_variance(value, variance) for value, variance in zip(values, variances, strict=True)]
    # Under the null hypothesis both have the errors of their common mean.
    weight = np.where(counted, relative[0] + relative[1], np.nan)
    common = (relative[1] * values[0] + relative[0] * values[1]) / weight
    # At least the original error, since the common mean is too small where one result lacks rare paths.
    parts = np.maximum(np.stack(relative) * common**2, variances)
    total = parts[0] + parts[1]
    freedom = _NEIGHBOURS * total**2 / sum(part**2 / (count - 1) for part, count in zip(parts, counts, strict=True))
    t = difference / np.sqrt(total)
    # Normal quantiles of Student's t (Welch 1947, doi:10.1093/biomet/34.1-2.28).
    z = -np.sign(t) * ndtri(np.maximum(stdtr(freedom, -np.abs(t)), 1e-300))
    sums = [float(value[counted].sum()) for value in values]
    own = [_error_of_energy(result, counted) for result in results]
    spread = float(np.sqrt(np.nansum(total))) / sums[0]
    if None not in own:
        spread = sums[1] / sums[0] * float(np.linalg.norm(np.array(own, dtype=np.float64)))
    elif "gate" in results[0].coords:
        spread = float(np.linalg.norm(np.nansum(np.sqrt(np.nan_to_num(total) * counted), axis=1))) / sums[0]
    return Comparison(z, sidak_limit(int(counted.sum())), sums[1] / sums[0], spread)


def _error_of_energy(result: xr.Dataset, counted: BoolArray) -> float | None:
    """Return the relative error of the energy in bins, shape (pixels, time), None where correlations are not known."""
    errors = SumErrors.of(result) if "waveform_stderr" in result else None
    if errors is None:
        return None
    power, deviation = (np.nan_to_num(_by_pixel(result, name)) for name in ("waveform", "waveform_stderr"))
    each = [errors.of_sum(own, inside.astype(np.float64)) for own, inside in zip(deviation, counted, strict=True)]
    return float(np.linalg.norm(each) / np.sum(power[counted]))


def sidak_limit(count: int, significance: float = SIGNIFICANCE) -> float:
    """Return the ``abs(z)`` that the largest of `count` normal numbers exceeds with probability `significance`."""
    from scipy.special import ndtri

    # log1p and expm1 keep the digits of a probability such as 1e-6.
    return float(-ndtri(-0.5 * np.expm1(np.log1p(-significance) / count)))


def pooled_relative_variance(values: FloatArray, variances: FloatArray) -> FloatArray:
    """Return the larger relative variance of each bin and its neighbours [1], shape (pixel, time).

    The arguments are means and the variances of the means, shape (pixel, time).
    """
    from scipy.ndimage import convolve1d

    mean, variance = np.nan_to_num(values), np.nan_to_num(variances)
    box = np.full(_NEIGHBOURS, 1 / _NEIGHBOURS)
    around = convolve1d(variance, box, axis=1) / np.maximum(convolve1d(mean, box, axis=1), 1e-150) ** 2
    # At the beginning of an echo, a bin's error may exceed its neighbours'.
    return np.asarray(np.maximum(around, variance / np.maximum(mean, 1e-150) ** 2))


def _by_pixel(result: xr.Dataset, name: str) -> FloatArray:
    values = result[name].values
    return np.asarray(values.reshape(-1, values.shape[-1]), dtype=np.float64)
