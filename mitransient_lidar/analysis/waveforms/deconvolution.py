"""Deconvolution of waveforms by the Richardson-Lucy iteration."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from mitransient_lidar.analysis.waveforms.echo_detection import (
    GAUSSIAN_AREA,
    Echoes,
    EchoFlag,
    IntArray,
    Records,
    has_echo,
    smooth,
)
from mitransient_lidar.analysis.waveforms.echo_estimators import Window, centroid, ideal_echo, summit
from mitransient_lidar.analysis.waveforms.echo_shape import Template
from mitransient_lidar.core.validation import FloatArray, integer
from mitransient_lidar.physics.lidar.pulse import FWHM_PER_SIGMA

Operator = Callable[[FloatArray], FloatArray]

_REACH = 0.75  # half the window of an echo in a deconvolved record, in echo widths


def richardson_lucy(
    y: FloatArray, kernel: tuple[int, FloatArray], *, offset: npt.ArrayLike = 0.0, iterations: int = 50
) -> FloatArray:
    """Deconvolve waveforms by the iteration of Richardson (1972) and Lucy (1974).

    x <- x K^T[(y + o)/(K x + o)]/K^T[1], where y are the samples, K is the convolution with the pulse and o >= 0 an
    offset. The iteration is derived for counting noise. An offset equal to the variance of additional Gaussian noise
    accounts for that (Snyder, Hammoud and White 1993). The result is never negative. Each iteration resolves shorter
    structure, including that of the noise.

    `y`, shape (n, time): samples less the baseline. Negative y + o are replaced by 0. `kernel`: first lag in bins and
    weights of the pulse, of sum 1, as from `Pulse.kernel`. `offset`, shape (), (n, 1) or (n, time): in the unit of the
    samples, not negative. `iterations`: 1 to 10 000.

    Result, shape (n, time): the record for a pulse shorter than a bin, in the unit of the samples and with their sum.

    Richardson 1972, J. Opt. Soc. Am. 62(1), 55-59, doi:10.1364/JOSA.62.000055.
    Lucy 1974, Astron. J. 79(6), 745-754, doi:10.1086/111605.
    Snyder, Hammoud and White 1993, J. Opt. Soc. Am. A 10(5), 1014-1023, doi:10.1364/JOSAA.10.001014.
    """
    iterations = integer("iterations", iterations, 1, 10_000)
    added = np.asarray(offset, dtype=np.float64)
    forward, adjoint = _blur(*kernel, y.shape[1])
    data = np.maximum(y + added, 0)
    least = 1e-12 * np.maximum(data.max(axis=1, keepdims=True), 1e-300)
    seen = np.maximum(adjoint(np.ones((1, y.shape[1]))), 1e-6)
    x = np.broadcast_to(np.maximum(y.mean(axis=1, keepdims=True), least), y.shape)
    for _ in range(iterations):
        # Beyond the kernel the transform has rounding errors of either sign.
        x = np.maximum(x * adjoint(data / np.maximum(forward(x) + added, least)) / seen, 0)
    return np.asarray(x)


def _blur(first: int, weights: FloatArray, size: int) -> tuple[Operator, Operator]:
    """Return the convolution with a kernel along the last axis, with zeros outside the record, and its adjoint."""
    from scipy.fft import irfft, next_fast_len, rfft

    length = next_fast_len(size + weights.size + abs(first), real=True)
    # Weights at negative lags wrap around; the padding is longer than the kernel.
    spread = np.zeros(length)
    np.add.at(spread, (first + np.arange(weights.size)) % length, weights)
    transform = rfft(spread)

    def forward(x: FloatArray) -> FloatArray:
        return np.asarray(irfft(rfft(x, length) * transform, length)[..., :size])

    def adjoint(x: FloatArray) -> FloatArray:
        return np.asarray(irfft(rfft(x, length) * transform.conj(), length)[..., :size])

    return forward, adjoint


def deconvolution_offset(
    template: Template, kernel: tuple[int, FloatArray], bin_ns: float, echo_fwhm_ns: float, iterations: int = 50
) -> float:
    """Return the bias [ns] of `deconvolved_echo`: its time for an ideal echo that arrives at 0.

    It is zero for a symmetric pulse; finite iterations do not fully remove a response's tail.
    """
    records, place = ideal_echo(template, bin_ns, echo_fwhm_ns)
    sharp = richardson_lucy(records.power, kernel, iterations=iterations)
    flags = np.zeros(1, dtype=np.intp)
    return float(deconvolved_echo(records, sharp, place, template, flags, echo_fwhm_ns).time_ns[0])


def deconvolved_echo(
    records: Records, sharp: FloatArray, bins: IntArray, template: Template, flags: IntArray, width: float
) -> Echoes:
    """Measure an echo in records deconvolved by `richardson_lucy`, shape (n, time).

    Time and width are the first two moments of the deconvolved record within three quarters of an echo width about its
    maximum near `bins`. The energy is its integral. Errors are those of a maximum-likelihood fit to one such echo, for
    the given noise. The scatter after few iterations agrees with them within a fifth in time and energy. The scatter of
    the width is smaller, by up to three quarters. The amplitude belongs to an echo with this energy and the pulse
    width; the width excludes the pulse.

    The other arguments are the waveforms, peak bins and `EchoFlag` of the echoes, shape (n,), the ideal echo's shape,
    and the expected echo width in the records [ns].
    """
    exists = has_echo(flags)
    deconvolved = Records(sharp, records.time_ns, records.noise)
    blurred, _ = smooth(deconvolved, 0.3 * template.fwhm_ns)
    near = max(int(0.5 * width / records.bin_ns), 1)
    places = np.clip(bins[:, np.newaxis] + np.arange(-near, near + 1), 0, records.time_ns.size - 1)
    lift = np.argmax(np.take_along_axis(blurred, places, axis=1), axis=1)
    middle = np.take_along_axis(places, lift[:, np.newaxis], axis=1)[:, 0]

    window = Window.around(deconvolved, middle, width)
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

    # Errors of the fit of one Gaussian echo, of the width in the record, to samples with the noise of the record.
    at = Window.around(records, middle, width)
    wide = np.nan_to_num(summit(at, flags).width_ns, nan=width)[:, np.newaxis] / FWHM_PER_SIGMA
    z = (at.u - offset) / wide
    shape = np.where(at.inside, np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * wide), 0)
    height = (total * records.bin_ns)[:, np.newaxis]
    model = height * shape + at.noise
    area_error, time_error, sigma_error = (
        _fit_error(derivative, model, at.noise)
        for derivative in (shape, height * shape * z / wide, height * shape * (z**2 - 1) / wide)
    )
    # The variances of the pulse and of the spread of the echo add up.
    width_error = FWHM_PER_SIGMA * wide[:, 0] * sigma_error / np.maximum(spread, records.bin_ns)
    found = Echoes(
        time,
        energy * to_height,
        energy,
        FWHM_PER_SIGMA * spread,
        time_error,
        area_error * 1e-9 * to_height,
        area_error * 1e-9,
        width_error,
        flags | np.where(exists & ~good, int(EchoFlag.POOR_FIT), 0),
    )
    return found.known_only(good)


def _fit_error(derivative: FloatArray, variance: FloatArray, noise: FloatArray) -> FloatArray:
    """Return a parameter's error, shape (n,), for samples with this noise fitted with weights 1/variance."""
    weight = derivative / variance
    information = np.sum(weight * derivative, axis=1)
    return np.asarray(np.sqrt(np.sum((weight * noise) ** 2, axis=1)) / np.maximum(information, 1e-300))
