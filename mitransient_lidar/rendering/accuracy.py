"""Means and standard errors over independent passes, and the relative errors that end a render."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mitransient_lidar.core.constants import C0
from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.lidar.axis_limits import COLUMN_LEVEL
from mitransient_lidar.physics.lidar.pulse import waveform
from mitransient_lidar.transport.probe import Probe
from mitransient_lidar.transport.scene import LidarScene

_DARK_PIXEL = 1e-2  #: Pixels darker than this fraction of the median are excluded from the radiance errors.

#: Noise in the estimated bias of smoothing over the smoothed image's noise, squared, where pixels share no noise.
_NOISE_OF_BIAS = 1 / 6

_PART = 2**17  #: Values of an array that are added at a time.

#: Most bin blocks, and about as many pixels, over which error correlation is measured.
_BLOCKS, _CORRELATED_PIXELS = 512, 1024

#: Least part of two blocks' errors that meets in pixels with light in both, for a correlation between them.
_SHARED = 1e-9


class PassStatistics:
    """Mean and standard error over one array for each pass (Welford 1962, doi:10.1080/00401706.1962.10490022)."""

    def __init__(self) -> None:
        self.count = 0
        self.mean: FloatArray = np.zeros(())
        self._squares: FloatArray = np.zeros(())

    def add(self, values: FloatArray) -> None:
        """Add one pass."""
        self.add_parts(np.shape(values), lambda part: values[part])

    def add_parts(
        self, shape: tuple[int, ...], part_of: Callable[[Any], FloatArray], rows: range | None = None
    ) -> None:
        """Add one pass in a shape, given a function that returns parts of the first axis.

        Parts fit the processor's cache, and no further arrays of the whole shape exist. With `rows`, of which all
        follow in order, the function returns parts of these.
        """
        if self.count == 0:
            self.mean, self._squares = np.zeros(shape), np.zeros(shape)
        rows = range(shape[0] if shape else 1) if rows is None else rows
        self.count += rows.start == 0
        step = max(_PART // max(int(np.prod(shape[1:])), 1), 1)
        for start in rows[::step]:
            end = min(start + step, rows.stop)
            part, own = (slice(start - low, end - low) if shape else () for low in (0, rows.start))
            values = part_of(own)
            deviation = values - self.mean[part]
            self.mean[part] += deviation / self.count
            self._squares[part] += deviation * (values - self.mean[part])

    @property
    def stderr(self) -> FloatArray:
        """Standard error of the mean; NaN before the second pass."""
        return self.stderr_of(slice(None))

    def pop_stderr(self) -> FloatArray:
        """Return the standard error of the mean in the memory of the statistics, which have none afterwards."""
        found, self._squares = self._squares, np.zeros(())
        if self.count < 2:
            return np.full_like(found, np.nan)
        np.divide(found, self.count - 1, out=found)
        return np.sqrt(np.divide(found, self.count, out=found), out=found)

    def stderr_of(self, part: slice) -> FloatArray:
        """Return the mean's standard error for part of the first axis; NaN before the second pass."""
        if self.count < 2:
            return np.full_like(self._squares[part], np.nan)
        found = self._squares[part] / (self.count - 1)
        return np.asarray(np.sqrt(np.divide(found, self.count, out=np.asarray(found)), out=np.asarray(found)))


def smoothing_bias(change: FloatArray, stderr: FloatArray, light: FloatArray, lit: BoolArray) -> FloatArray:
    """Return smoothed images' bias over their light, rms over lit pixels, NaN without any.

    A second smoothing changes a smooth image as the first one has changed the true image, to first order. Its noise is
    subtracted as if pixels were independent. Structure much finer than the smoothing is not seen.

    `change`, `stderr`: change by a second smoothing of the smoothed part, and the part's standard error, shape (pixels,
    ...). `light`, `lit`: all light, and which pixels count, in the same shape.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        square = np.sum((change**2 - _NOISE_OF_BIAS * stderr**2) / light**2, axis=0, where=lit) / lit.sum(axis=0)
    return np.asarray(np.sqrt(np.maximum(square, 0)))


class LightStatistics:
    """Means and standard errors for light energy [J per bin] and power [W]; bins are the last axis."""

    def __init__(self) -> None:
        self.energy, self.power = PassStatistics(), PassStatistics()

    def add(self, energy: FloatArray, power: FloatArray) -> None:
        """Add the light of one pass."""
        self.energy.add(energy)
        self.power.add(power)

    @property
    def arrays(self) -> tuple[FloatArray, ...]:
        """Mean energy, its standard error, mean power, and its standard error; none before the first pass."""
        if self.energy.count == 0:
            return ()
        return self.energy.mean, self.energy.stderr, self.power.mean, self.power.stderr


def received_power(scene: LidarScene) -> Callable[[FloatArray], FloatArray]:
    """Return the function from energies [J per bin] to powers [W], after the pulse and the receiver's response."""
    width_ns = scene.axis.bin_width_ns
    kernel = scene.transmitter.pulse.kernel(width_ns, scene.receiver.optics.response_time_ns)
    return functools.partial(waveform, bin_width_ns=width_ns, kernel=kernel)


class RatioStatistics:
    """Ratio of two sums over passes, and its standard error.

    Each pass adds, for each pixel, radiance times solid angle and its samples' solid angle. The ratio of the sums is
    the mean radiance. The standard error is first order for a ratio of means (Cochran 1977, Sampling Techniques,
    section 2.11).
    """

    def __init__(self, count: int) -> None:
        self.count = 0
        self._sums = np.zeros((5, count))

    def add(self, found: FloatArray, sampled: FloatArray) -> None:
        """Add one pass, shape (pixels,)."""
        self.count += 1
        self._sums += [found, sampled, found * found, found * sampled, sampled * sampled]

    @property
    def ratio(self) -> FloatArray:
        """Mean ratio; NaN where nothing was sampled."""
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
        """Number of sampled pixels whose mean is not finite."""
        return int(np.count_nonzero((self._sums[1] > 0) & ~np.isfinite(self.ratio)))

    def relative_errors(self) -> FloatArray:
        """Return the pixels' relative standard errors, without dark ones."""
        ratio, stderr = self.ratio, self.stderr
        known = np.isfinite(ratio) & (ratio > 0)
        if not known.any():
            return np.zeros(0)
        lit = known & (np.where(known, ratio, 0) > _DARK_PIXEL * np.median(ratio[known]))
        return np.asarray(stderr[lit] / ratio[lit])


class ErrorCorrelation:
    """Error correlation between bins: errors in a pass are correlated, since they share paths.

    Pixels are taken together, and bins in at most `_BLOCKS` blocks.
    """

    def __init__(self) -> None:
        self._count = 0
        self._mean: FloatArray = np.zeros(())
        self._products: FloatArray = np.zeros(())
        self._squares: FloatArray = np.zeros(())

    def add(self, values: FloatArray) -> None:
        """Add one pass, shape (pixels, time)."""
        values = values[:: max(1, len(values) // _CORRELATED_PIXELS)]
        if self._count == 0:
            self._mean = np.zeros_like(values)
            self._edges = np.arange(0, values.shape[1], -(-values.shape[1] // _BLOCKS))
            self._products, self._squares = np.zeros((self._edges.size,) * 2), np.zeros_like(values)
        self._count += 1
        before = values - self._mean
        self._mean += before / self._count
        after = values - self._mean
        sums = (np.add.reduceat(one, self._edges, axis=1) for one in (before, after))
        self._products += np.matmul(*(one if i else one.T for i, one in enumerate(sums)))
        self._squares += before * after

    def over(self, time_ns: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return the middles of the blocks [ns], and their correlations; None before the second pass.

        Entry (A, B) is the mean correlation between a bin in A and a bin in B. Entry (A, A) is the mean over pairs of
        different bins; for a block with one bin it is 1. Other entries for blocks without light are 0.
        """
        if self._count < 2:
            return None
        deviation = np.sqrt(np.maximum(self._squares, 0))
        sums, parts = (np.add.reduceat(one, self._edges, axis=1) for one in (deviation, self._squares))
        possible, found = sums.T @ sums, self._products.copy()
        of_block = np.diag_indices_from(found)
        possible[of_block] -= parts.sum(axis=0)
        found[of_block] -= parts.sum(axis=0)
        known = possible > _SHARED * np.outer(*2 * [np.sqrt(np.maximum(np.sum(sums**2, axis=0), 0))])
        correlation = np.divide(found, possible, out=np.zeros_like(found), where=known)
        sizes = np.diff(np.append(self._edges, time_ns.size))
        correlation[of_block] = np.where(sizes == 1, 1.0, correlation[of_block])
        return np.add.reduceat(time_ns, self._edges) / sizes, np.clip(correlation, -1, 1)


@dataclass(frozen=True)
class ErrorWindow:
    """Bins whose errors end a render, from the surface echo to the bottom echo's end, and land bins."""

    #: Limits for each pixel [ns], shape (pixels,), or for each shot (shots x pixels,); land limits where a pixel sees
    #: no water.
    start_ns: FloatArray
    end_ns: FloatArray
    time_ns: FloatArray  #: Bin centres [ns], shape (time,).
    land_ns: FloatArray  #: Limits of the land echo beside the water [ns], shape (pixels, 2) likewise; NaN without.

    @classmethod
    def of_probe(cls, probe: Probe) -> ErrorWindow:
        """Return the bins from each pixel's surface echo to its bottom echo's end, with half the pulse width.

        Where the record has no bottom, the window ends with the light from the water, or else with the record. This
        light ends when absorption alone has reduced it to `COLUMN_LEVEL` after the surface echo, in the near infrared
        after nanoseconds.
        """
        scene, echoes, time_ns = probe.scene, probe.echoes, probe.scene.axis.centres_ns
        half_pulse = 0.5 * scene.transmitter.pulse.fwhm_ns
        (start, middle), end = echoes.surface_ns.T, echoes.bottom_ns[:, 1] + half_pulse
        alone = np.isnan(start) & np.isnan(end)
        least = 0.0 if scene.water is None else float(scene.water.column.absorption.min())
        column_ns = -1e9 / C0 * scene.group_index * np.log(COLUMN_LEVEL) / max(least, 1e-9)
        of_water = np.fmin(2 * middle - start + half_pulse + column_ns, time_ns[-1])
        # Without a surface, the window begins with the record.
        start = np.where(np.isnan(start), time_ns[0], start)
        end = np.where(end <= scene.axis.end_ns, end, of_water)
        return cls(start, end, time_ns, np.full((start.size, 2), np.nan)).with_land(scene, echoes.dry_ns, alone)

    def with_land(self, scene: LidarScene, dry_ns: FloatArray, alone: BoolArray) -> ErrorWindow:
        """Return the window for pixels, or shots, that see land, some of them land alone.

        Its echo comes between two times [ns], shape (n, 2), NaN without one.
        """
        half = 0.5 * max(scene.transmitter.pulse.fwhm_ns, scene.axis.bin_width_ns)
        land, copies = dry_ns + np.array([-half, half]), len(dry_ns) // len(self.start_ns)
        alone = alone & np.isfinite(land[:, 0])
        start, end = (
            np.where(alone, own, np.tile(limit, copies))
            for own, limit in zip(land.T, (self.start_ns, self.end_ns), strict=True)
        )
        return ErrorWindow(start, end, self.time_ns, np.where(alone[:, None], np.nan, land))

    def relative_errors(self, waveform: FloatArray, stderr: FloatArray) -> FloatArray:
        """Return a waveform's relative standard errors, infinite where it is 0.

        Waveform and standard error have the shape (pixels, time), or for several shots (shots, pixels, time). Pixels
        with less than a thousandth of the brightest pixel's energy are excluded.
        """
        waveform, stderr = (values.reshape(-1, values.shape[-1]) for values in (waveform, stderr))
        limits = np.column_stack([self.start_ns, self.end_ns, self.land_ns])
        start_ns, end_ns, *land_ns = np.tile(limits, (len(waveform) // len(limits), 1)).T[..., None]
        energy = waveform.sum(axis=1)
        lit = energy > 1e-3 * energy.max(initial=0.0)
        inside = (self.time_ns >= start_ns) & (self.time_ns <= end_ns)
        inside |= (self.time_ns >= land_ns[0]) & (self.time_ns <= land_ns[1])
        chosen = inside & lit[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = stderr[chosen] / waveform[chosen]
        return np.asarray(np.where(waveform[chosen] > 0, relative, np.inf))
