"""Removal of the pulse from waveforms by Richardson and Lucy's iteration."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .checks import FloatArray, finite_array, positive, whole
from .echo_readings import Window, centroid, ideal_echo, known_only, summit
from .echoes import GAUSSIAN_AREA, Echoes, EchoFlag, IntArray, Records, Template, smooth

_FWHM = float(np.sqrt(8 * np.log(2)))
_REACH = 0.75  # half the window of an echo's share in a deconvolved record, in echo widths


def richardson_lucy(
    waveforms: npt.ArrayLike,
    kernel: tuple[int, npt.ArrayLike],
    *,
    offset: npt.ArrayLike = 0.0,
    iterations: int = 50,
) -> FloatArray:
    """Deconvolve waveforms by the iteration of Richardson (1972) and Lucy (1974).

    x <- x K^T[(y + o)/(K x + o)]/K^T[1], where y are the samples, K is the convolution with the pulse and o >= 0 an
    offset: with the noise's variance as that it allows for Gaussian noise beside the counting noise, for which the
    iteration is meant (Snyder, Hammoud and White 1993). The result is never negative, and each iteration brings out
    shorter structure, of the noise, too.

    Parameters
    ----------
    waveforms : array_like, shape (n, time)
        Samples less the baseline. Where y + o is negative it counts as 0.
    kernel : (int, array_like)
        First lag in bins and weights of the pulse, of sum 1, as from `Pulse.kernel`.
    offset : array_like, shape (), (n, 1) or (n, time)
        In the unit of the samples, not negative.
    iterations : int
        How often, 1 to 10 000.

    Returns
    -------
    ndarray, shape (n, time)
        What the record would be for a pulse shorter than a bin, in the unit of the samples: its sum is theirs.

    Raises
    ------
    ValueError
        If an argument is out of range.

    References
    ----------
    Richardson 1972, J. Opt. Soc. Am. 62(1), 55-59, doi:10.1364/JOSA.62.000055.
    Lucy 1974, Astron. J. 79(6), 745-754, doi:10.1086/111605.
    Snyder, Hammoud and White 1993, J. Opt. Soc. Am. A 10(5), 1014-1023, doi:10.1364/JOSAA.10.001014.
    """
    y = finite_array("waveforms", waveforms)
    iterations = whole("iterations", iterations, 1, 10_000)
    first, weights = int(kernel[0]), finite_array("kernel", kernel[1])
    if y.ndim != 2 or not y.size:
        raise ValueError(f"waveforms of shape {y.shape} must have the shape (n, time) with at least one of each")
    if weights.ndim != 1 or np.any(weights < 0) or abs(weights.sum() - 1) > 1e-6:
        raise ValueError(f"kernel must be a list of weights of sum 1, not negative, but sums to {weights.sum():g}")
    added = finite_array("offset", offset)
    if np.any(added < 0):
        raise ValueError(f"offset = {added.min():g} must not be negative")

    blur = _Blur(first, weights, y.shape[1])
    data = np.maximum(y + added, 0)
    least = 1e-12 * np.maximum(data.max(axis=1, keepdims=True), 1e-300)
    seen = np.maximum(blur.adjoint(np.ones((1, y.shape[1]))), 1e-6)
    x = np.broadcast_to(np.maximum(y.mean(axis=1, keepdims=True), least), y.shape)
    for _ in range(iterations):
        # The transform leaves rounding errors of either sign where the kernel has ended.
        x = np.maximum(x * blur.adjoint(data / np.maximum(blur.forward(x) + added, least)) / seen, 0)
    return np.asarray(x)


class _Blur:
    """Convolution with a kernel along the last axis, and its adjoint; nothing comes from outside the record."""

    def __init__(self, first: int, weights: FloatArray, size: int) -> None:
        from scipy.fft import next_fast_len, rfft

        self.size = size
        self.length = next_fast_len(size + weights.size + abs(first), real=True)
        # Kernels wrap about the start; the record is padded by more than their length.
        spread = np.zeros(self.length)
        np.add.at(spread, (first + np.arange(weights.size)) % self.length, weights)
        self.transform = rfft(spread)

    def forward(self, x: FloatArray) -> FloatArray:
        """Return sum over m of weights[m] x[i - first - m]."""
        return self._apply(x, self.transform)

    def adjoint(self, x: FloatArray) -> FloatArray:
        """Return sum over m of weights[m] x[i + first + m]."""
        return self._apply(x, self.transform.conj())

    def _apply(self, x: FloatArray, transform: npt.NDArray[np.complex128]) -> FloatArray:
        from scipy.fft import irfft, rfft

        return np.asarray(irfft(rfft(x, self.length) * transform, self.length)[..., : self.size])


def deconvolution_offset(
    template: Template, kernel: tuple[int, npt.ArrayLike], bin_ns: float, echo_fwhm_ns: float, iterations: int = 50
) -> float:
    """Time [ns] that `deconvolved_echo` reads off an ideal echo that arrives at 0: what to subtract from its times.

    The arguments are those of `deconvolved_echo` and `richardson_lucy`. It is zero for a symmetric pulse; of the tail
    that a receiver's response adds, a finite number of iterations leaves a little.
    """
    records, place = ideal_echo(template, bin_ns, echo_fwhm_ns)
    sharp = richardson_lucy(records.power, kernel, iterations=iterations)
    flags = np.zeros(1, dtype=np.intp)
    return float(deconvolved_echo(records, sharp, place, template, flags, echo_fwhm_ns).time_ns[0])


def deconvolved_echo(
    records: Records,
    sharp: FloatArray,
    bins: IntArray,
    template: Template,
    flags: IntArray,
    echo_fwhm_ns: float,
) -> Echoes:
    """Read an echo off deconvolved records.

    Time and width are the first two moments of the deconvolved record within three quarters of an echo width on either
    side of its strongest place near `bins`, the energy is its integral. The errors are those of a maximum-likelihood
    fit of one echo as long as the record's, for the given noise. The iteration, stopped early, follows them within a
    fifth in time and energy, while its width varies less, by up to three quarters.

    Parameters
    ----------
    records : Records
        The waveforms.
    sharp : ndarray, shape (n, time)
        What `richardson_lucy` made of them.
    bins : ndarray of int, shape (n,)
        Bins of the peaks.
    template : Template
        Shape of an ideal echo.
    flags : ndarray of int, shape (n,)
        `EchoFlag` of the echoes; those without an echo are left out.
    echo_fwhm_ns : float
        Expected width of an echo in the records [ns], above 0.

    Returns
    -------
    Echoes
        The amplitude is that of an echo of this energy as long as the pulse; the width is without the pulse.
    """
    width = positive("echo_fwhm_ns", echo_fwhm_ns)
    exists = (flags & int(EchoFlag.NO_ECHO)) == 0
    blurred, _ = smooth(Records(sharp, records.time_ns, records.noise), 0.3 * template.fwhm_ns)
    near = max(int(0.5 * width / records.bin_ns), 1)
    places = np.clip(bins[:, np.newaxis] + np.arange(-near, near + 1), 0, records.time_ns.size - 1)
    lift = np.argmax(np.take_along_axis(blurred, places, axis=1), axis=1)
    middle = np.take_along_axis(places, lift[:, np.newaxis], axis=1)[:, 0]

    window = Window.around(Records(sharp, records.time_ns, records.noise), middle, width)
    time, _ = centroid(window, window.middle, _REACH * width)
    offset = np.nan_to_num(time - window.middle)[:, np.newaxis]
    distance = np.abs(window.u - offset)
    share = np.where(window.inside, np.clip(0.5 + (_REACH * width - distance) / window.bin_ns, 0, 1), 0)
    mass = np.sum(share * window.power, axis=1)
    good = exists & (mass > 0) & np.isfinite(time)
    total = np.where(good, mass, 1.0)
    spread = np.sqrt(np.maximum(np.sum(share * window.power * (window.u - offset) ** 2, axis=1), 0) / total)
    energy = mass * records.bin_ns * 1e-9
    to_height = 1 / (GAUSSIAN_AREA * template.fwhm_ns * 1e-9)

    # The fit of one echo, a Gaussian as long as that in the record, to samples of the record's noise.
    at = Window.around(records, middle, width)
    wide = np.nan_to_num(summit(at, flags).width_ns, nan=width)[:, np.newaxis] / _FWHM
    z = (at.u - offset) / wide
    shape = np.where(at.inside, np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * wide), 0)
    height = (total * records.bin_ns)[:, np.newaxis]
    model = height * shape + at.noise
    area_error, time_error, sigma_error = (
        _fit_error(derivative, model, at.noise)
        for derivative in (shape, height * shape * z / wide, height * shape * (z**2 - 1) / wide)
    )
    # The variances of the pulse and of what widens the echo add up.
    width_error = _FWHM * wide[:, 0] * sigma_error / np.maximum(spread, records.bin_ns)
    found = Echoes(
        time,
        energy * to_height,
        energy,
        _FWHM * spread,
        time_error,
        area_error * 1e-9 * to_height,
        area_error * 1e-9,
        width_error,
        flags | np.where(exists & ~good, int(EchoFlag.POOR_FIT), 0),
    )
    return known_only(found, good)


def _fit_error(derivative: FloatArray, variance: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the error, shape (n,), of a parameter fitted with weights 1/variance to samples of this noise."""
    weight = derivative / variance
    information = np.sum(weight * derivative, axis=1)
    return np.asarray(np.sqrt(np.sum((weight * noise) ** 2, axis=1)) / np.maximum(information, 1e-300))
