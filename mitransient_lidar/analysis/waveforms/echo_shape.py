"""Ideal echo shape in a record: the pulse after bins and receiver, and its sum of Gaussians for fits.

All estimators give the same time for an echo with this shape: their bias for it is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA, Pulse

_FINE = 15  # points of a template per bin of light; odd, so that one of them is the centre of the bin
_CLOSE = 0.01  # largest deviation of Gaussians from a template, relative to its peak
_WIDTHS = (0.9, 0.75, 0.6, 0.45, 0.35, 0.25, 0.18, 0.12)  # tried widths of the Gaussians of a sum, over the template's
_APART = 0.8  # distance of the Gaussians of a sum, in their standard deviations
_LEAST_HEIGHT = 1e-4  # of the Gaussians of a sum, relative to the peak
_BLURS, _BEYOND = 24, 4.0  # blurs of a table of pulses, and the reach of a Gaussian in its standard deviations


@dataclass(frozen=True)
class Response:
    """Receiver response to light in one bin: weights of the light bins in a sample, with unit sum."""

    first: int  #: Bins from the light of the first weight to the sample; negative for later light.
    weights: FloatArray
    bin_ns: float  #: Width of the bins of light [ns].


@dataclass(frozen=True)
class Template:
    """Shape of an ideal echo that arrives at 0: times [ns], 15 per bin, height, 1 at the peak, and full width [ns]."""

    time_ns: FloatArray
    power: FloatArray
    fwhm_ns: float

    @classmethod
    def of(
        cls, pulse: Pulse, bin_width_ns: float, response_time_ns: float = 0.0, receiver: Response | None = None
    ) -> Template:
        """Return the shape of a pulse after a response, a single pole, averaged over bins, then after a receiver.

        A receiver has bins of the same width.
        """
        step = bin_width_ns / _FINE
        first, weights = pulse.kernel(step, response_time_ns)
        shares = np.convolve(weights, np.full(_FINE, 1.0))
        start = first - (_FINE - 1) / 2
        if receiver is not None:
            spread = np.zeros((receiver.weights.size - 1) * _FINE + 1)
            spread[::_FINE] = receiver.weights
            shares = np.convolve(shares, spread)
            start += receiver.first * _FINE
        time = np.asarray((start + np.arange(shares.size)) * step, dtype=np.float64)
        power = shares / shares.max()
        above = np.flatnonzero(power >= 0.5)
        left, right = above[0], above[-1]
        rise = np.interp(0.5, power[left - 1 : left + 1], time[left - 1 : left + 1]) if left > 0 else time[0]
        fall = np.interp(-0.5, -power[right : right + 2], time[right : right + 2])
        return cls(time, power, float(fall - rise))

    def kernel(self, bin_width_ns: float) -> tuple[int, FloatArray]:
        """Return an echo's first lag and weights (unit sum) in samples at a distance [ns]."""
        first = int(np.ceil(self.time_ns[0] / bin_width_ns))
        lags = np.arange(first, int(np.floor(self.time_ns[-1] / bin_width_ns)) + 1)
        weights = np.interp(lags * bin_width_ns, self.time_ns, self.power)
        return first, weights / weights.sum()

    @property
    def peak_ns(self) -> float:
        """Peak time [ns], the middle of equal samples."""
        top = np.flatnonzero(self.power >= self.power.max() * (1 - 1e-9))
        return float(0.5 * (self.time_ns[top[0]] + self.time_ns[top[-1]]))

    def share_behind(self, delay_ns: float) -> float:
        """Return the power a delay [ns] behind the peak, relative to the peak."""
        return float(np.interp(self.peak_ns + delay_ns, self.time_ns, self.power, right=0.0) / self.power.max())

    def rise(self, level: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the time [ns] at which the edge crosses a level (0 to 1, of the peak), and its derivative."""
        edge = slice(0, int(np.argmax(self.power)) + 1)
        heights, kept = np.unique(self.power[edge], return_index=True)
        wanted = np.clip(level, 1e-6, 0.999)
        time = np.interp(wanted, heights, self.time_ns[edge][kept])
        ahead = np.interp(np.minimum(wanted * 1.001, 1.0), heights, self.time_ns[edge][kept])
        return time, (ahead - time) / (0.001 * wanted)

    def tail_ns(self, level: float) -> float:
        """Return the time from the peak to where the echo falls below a level (0 to 1, of the peak) for good [ns]."""
        return float(self.time_ns[np.flatnonzero(self.power >= level)[-1]] - self.peak_ns)


@dataclass(frozen=True)
class EchoShape:
    """A template as a sum of equally wide Gaussians, whose blurred form is of the same kind."""

    #: Times of the Gaussians from the arrival [ns], and their heights, shape (terms,); the sum is 1 at the peak.
    delays: FloatArray
    heights: FloatArray
    #: Standard deviation of the Gaussians, full width at half maximum of the sum, and time of its peak [ns].
    sigma: float
    fwhm_ns: float
    peak_ns: float

    @classmethod
    def gaussian(cls, fwhm_ns: float) -> EchoShape:
        """Return a Gaussian that arrives at its peak."""
        return cls(np.zeros(1), np.ones(1), fwhm_ns / FWHM_PER_SIGMA, fwhm_ns, 0.0)

    @classmethod
    def of(cls, template: Template) -> EchoShape:
        """Return a Gaussian as wide as a template, or a sum of narrower ones, to within 1 % of its peak.

        The heights are fitted with least squares and not negative, for the largest width that is close enough.
        """
        from scipy.optimize import nnls

        time, power, peak = template.time_ns, template.power, template.peak_ns
        sigma = template.fwhm_ns / FWHM_PER_SIGMA
        # The middle of the upper half is the peak of a symmetric template that two bins share.
        middle = float(np.average(time, weights=np.where(power >= 0.5, power, 0)))
        if np.max(np.abs(power - np.exp(-0.5 * ((time - middle) / sigma) ** 2))) < _CLOSE:
            return cls(np.array([middle]), np.ones(1), sigma, template.fwhm_ns, middle)
        for share in _WIDTHS:
            width = share * sigma
            centres = np.arange(time[0], time[-1] + width, _APART * width)
            heights, _ = nnls(np.exp(-0.5 * ((time[:, np.newaxis] - centres) / width) ** 2), power)
            kept = heights > _LEAST_HEIGHT
            centres, heights = centres[kept], heights[kept]
            model = np.exp(-0.5 * ((time[:, np.newaxis] - centres) / width) ** 2) @ heights
            if np.max(np.abs(model - power)) < _CLOSE:
                break
        return cls(centres, heights / model.max(), width, template.fwhm_ns, peak)

    @property
    def terms(self) -> list[tuple[float, float, float]]:
        """Delay [ns], height, and area share of each Gaussian."""
        shares = self.heights / self.heights.sum()
        return list(zip(self.delays.tolist(), self.heights.tolist(), shares.tolist(), strict=True))

    @property
    def least_sigma(self) -> float:
        """Smallest standard deviation of its Gaussians in fits [ns]: a sum must not fall apart."""
        return 0.1 * self.sigma if self.delays.size == 1 else 0.9 * self.sigma

    def sigma_of(self, fwhm_ns: float) -> float:
        """Return the Gaussians' standard deviation [ns] for an echo's full width at half maximum [ns]."""
        return float(np.sqrt(max(self._extra(fwhm_ns, self.fwhm_ns) + self.sigma**2, self.least_sigma**2)))

    def width_of(self, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the full width at half maximum [ns] for standard deviations of the Gaussians, and its derivative."""
        square = self.fwhm_ns**2 + FWHM_PER_SIGMA**2 * (sigma**2 - self.sigma**2)
        width = np.sqrt(np.maximum(square, (0.1 * self.fwhm_ns) ** 2))
        return width, FWHM_PER_SIGMA**2 * sigma / width

    def top_of(self, sigma: FloatArray) -> FloatArray:
        """Return the peak height for standard deviations of the Gaussians, shape (n,)."""
        if self.delays.size == 1:
            return np.ones_like(sigma)
        time = np.linspace(self.delays[0], self.delays[-1], max(8 * self.delays.size, 32))
        z = (time[:, np.newaxis] - self.delays) / sigma[:, np.newaxis, np.newaxis]
        return np.asarray((np.exp(-0.5 * z**2) @ self.heights).max(axis=1))

    @staticmethod
    def _extra(fwhm_ns: float, own: float) -> float:
        """Return the variance [ns^2] by which an echo is wider than another one."""
        return (fwhm_ns**2 - own**2) / FWHM_PER_SIGMA**2


@dataclass(frozen=True)
class BlurredPulse:
    """A template that is blurred by Gaussians, and its integral over time, from tables."""

    #: First time of the tables and their step [ns].
    start_ns: float
    step_ns: float
    variances: FloatArray  #: Variances of the Gaussians [ns^2], ascending from 0, denser near it.
    #: Shape with the area of the template, its derivative by time [1/ns] and its integral [ns]; shape (variances, n).
    power: FloatArray
    slope: FloatArray
    integral: FloatArray

    @classmethod
    def of(cls, template: Template, most_ns: float) -> BlurredPulse:
        """Return a template blurred by Gaussians of standard deviations up to one [ns]."""
        from scipy.ndimage import gaussian_filter1d

        step = float(template.time_ns[1] - template.time_ns[0])
        beyond = int(np.ceil(_BEYOND * most_ns / step))
        power = np.pad(template.power, beyond)
        sigmas = most_ns * np.linspace(0, 1, _BLURS)
        wider = [gaussian_filter1d(power, one / step, truncate=_BEYOND) for one in sigmas[1:]]
        blurred, variances = np.stack([power, *wider]), sigmas**2
        start = float(template.time_ns[0]) - beyond * step
        slope = np.gradient(blurred, step, axis=1)
        return cls(start, step, variances, blurred, slope, np.cumsum(blurred, axis=1) * step)

    @property
    def area_ns(self) -> float:
        """Integral of the shape [ns]."""
        return float(self.integral[0, -1])

    def plain(self, time_ns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return shape and integral of the template at times [ns]."""
        place = (time_ns - self.start_ns) / self.step_ns
        return _between(self.power[0], place), _between(self.integral[0], place - 0.5)

    def plain_slope(self, time_ns: FloatArray) -> FloatArray:
        """Return the derivative of the template at times [1/ns]."""
        return _between(self.slope[0], (time_ns - self.start_ns) / self.step_ns)

    def blurred(self, time_ns: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return shape, its derivative by time [1/ns] and by the variance [1/ns^2], at variances, shape (n, 1)."""
        row = np.clip(np.searchsorted(self.variances, variance, side="right") - 1, 0, _BLURS - 2)
        between = (variance - self.variances[row]) / (self.variances[row + 1] - self.variances[row])
        place = (time_ns - self.start_ns) / self.step_ns
        inside = (place >= 0) & (place < self.power.shape[1] - 1)
        left = np.where(inside, place, 0).astype(np.intp)
        right = np.where(inside, place - left, 0.0)
        corner = row * self.power.shape[1] + left
        below = corner + self.power.shape[1]
        near, far = (
            [flat[at] * (1 - right) + flat[at + 1] * right for flat in (self.power.ravel(), self.slope.ravel())]
            for at in (corner, below)
        )
        power, slope = (np.where(inside, a + between * (b - a), 0.0) for a, b in zip(near, far, strict=True))
        by_variance = np.where(inside, (far[0] - near[0]) / (self.variances[row + 1] - self.variances[row]), 0.0)
        return power, slope, by_variance


def _between(values: FloatArray, place: FloatArray) -> FloatArray:
    """Return values, which are constant at their ends, at places in steps, linear between them."""
    place = np.clip(place, 0, values.size - 1.001)
    left = place.astype(np.intp)
    first = values[left]
    return np.asarray(first + (place - left) * (values[left + 1] - first))
