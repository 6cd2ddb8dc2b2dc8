"""Errors of fitted parameters, for sample errors that neighbours share, the chi-squared of a fit, and jackknife errors.

Jackknife estimates of standard errors: Efron and Stein (1981), doi:10.1214/aos/1176345462.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mitransient_lidar.core.validation import BoolArray, FloatArray
from mitransient_lidar.physics.receiver.electronics import Digitiser


def jackknife_error(values: FloatArray) -> float:
    """Return an estimate's standard error from its values without each of the groups, shape (groups,)."""
    count = len(values)
    return math.sqrt((count - 1) / count * float(np.sum((values - values.mean()) ** 2)))


_DEGENERATE = 0.999  # correlation between two parameters above which only one combination is known
_SMOOTHED = 9  # samples over which variances are smoothed
_TERMS = 20  # in the series for rounding errors
#: Message where errors are too small, because nothing shows the correlation between distant samples.
NO_BATCHES = (
    "stated errors are too small: errors of a render agree over its whole record, and neither the waveforms nor the "
    "model have batches of passes, which show this"
)
#: Chi-squared over its mean above which a fit is refused; for unknown noise, the residuals' share of the squares.
WORST_CHI_SQUARED, WORST_UNEXPLAINED = 5.0, 0.1
_UNLIKELY = 1e-3  # probability of a larger chi-squared below which there is a misfit
_SMALLEST = 1e-14  # eigenvalue of the scaled normal matrix, below which a combination of parameters is unknown


@dataclass(frozen=True)
class Errors:
    """Parameter errors."""

    #: Shape (parameter, parameter); NaN for parameters that are at a bound or without influence, and for the others
    #: with these fixed.
    covariance: FloatArray
    by_model: FloatArray  #: Standard errors by the Monte Carlo of the model alone, shape (parameter,).
    influence: FloatArray  #: Waveform change per unit of each parameter in standard deviations, shape (parameter,).
    held: BoolArray  #: Whether a parameter is at a bound.
    #: Sum of the squared residuals, its mean, and the degrees of freedom of the chi-squared distribution, scaled to
    #: this mean, that has its variance.
    chi_squared: float
    expected: float
    freedom: float
    grown: bool = False  #: Whether the covariance is multiplied by the reduced chi-squared.

    @property
    def stderr(self) -> FloatArray:
        """Standard errors, shape (parameter,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> FloatArray:
        """Correlations, shape (parameter, parameter)."""
        return np.asarray(self.covariance / np.outer(self.stderr, self.stderr))

    @property
    def reduced(self) -> float:
        """Chi-squared over its mean."""
        return self.chi_squared / self.expected if self.expected > 0 else math.nan

    @property
    def probability(self) -> float:
        """Probability of a larger chi-squared."""
        from scipy.stats import chi2

        return float(chi2.sf(self.reduced * self.freedom, self.freedom))

    @property
    def is_misfit(self) -> bool:
        """Whether chi-squared is larger than chance allows."""
        return self.reduced > 1 and self.probability < _UNLIKELY

    def grown_with_misfit(self) -> Errors:
        """Return errors whose covariance is multiplied by the reduced chi-squared if there is a misfit."""
        return replace(self, covariance=self.covariance * self.reduced, grown=True) if self.is_misfit else self

    def refusal(self) -> str:
        """Return why the scene does not explain waveforms of known noise, empty if it does."""
        if not self.reduced > WORST_CHI_SQUARED:
            return ""
        return (
            f"the fit is refused: chi-squared is {self.reduced:.3g} times the expected one, more than "
            f"{WORST_CHI_SQUARED:g}. Start from other values, or check scene, receiver and noise"
        )

    def messages(self, names: Sequence[str], values: FloatArray) -> list[str]:
        """Return sentences on parameters that the waveforms do not determine."""
        found = []
        if self.is_misfit and self.reduced <= WORST_CHI_SQUARED:
            found.append(
                f"chi-squared is {self.reduced:.3g} times the expected one: scene or noise are not those of the "
                f"waveforms, and the stated errors are {'' if self.grown else 'not '}multiplied by its root"
            )
        for name, value, influence, held in zip(names, values, self.influence, self.held, strict=True):
            if held:
                found.append(
                    f"{name} is at its bound {value:g}: its error is unknown, and those of others hold with it fixed"
                )
            elif influence == 0:
                found.append(f"{name} has no influence on the waveforms: it is unknown")
            elif value != 0 and influence * abs(value) < 1:
                found.append(
                    f"{name} has little influence on the waveforms: even with all others known, its standard error "
                    f"would be {1 / influence:.3g}"
                )
        correlation = self.correlation
        for i in range(len(names)):
            for j in range(i):
                if abs(correlation[i, j]) > _DEGENERATE:
                    found.append(
                        f"{names[j]} and {names[i]} cannot be told apart: their correlation is "
                        f"{correlation[i, j]:.5f}, only a combination of them is known"
                    )
        return found


def estimate_errors(
    residuals: FloatArray,
    derivatives: FloatArray,
    noise: tuple[FloatArray, FloatArray],
    model: tuple[FloatArray, FloatArray],
    held: BoolArray,
    scaled: bool,
    known_noise: bool = True,
    batches: Sequence[FloatArray | None] = (None, None),
    borrows: bool = False,
    recorded: FloatArray | None = None,
) -> Errors:
    """Return the errors of a weighted least-squares solution.

    `residuals`: differences in standard deviations, shape (pixel, time), 0 where a sample is not used. `derivatives`:
    model derivatives in standard deviations per unit of each parameter, shape (parameter, pixel, time). `noise`,
    `model`: errors of the waveforms and of the model's Monte Carlo. Standard deviations are relative to the
    difference's, shape (pixel, time), 0 where a sample is not used; correlations are by the distance in samples, shape
    (lags,). `held`: parameters at a bound, which are fixed, shape (parameter,). `scaled`: whether to multiply the
    covariance by the reduced chi-squared. `known_noise`: whether the waveform errors are known. If not, all are the
    same, differences are in the waveforms' unit, `noise` is 1, and the covariance is multiplied by the reduced
    chi-squared in any case. `batches`: deviations of the pass batches of waveforms and model, in standard deviations,
    shape (batch, pixel, time), whose outer products add up to the errors' covariance; None where there are none.
    `borrows`: whether waveforms without batches come from a render, whose errors are correlated over its samples like
    the model's. The model's batches, scaled to the waveform variances, then serve the waveforms, too. `recorded`:
    standard deviations of the render that recorded waveforms come from, relative to the difference's, shape (pixel,
    time): errors beside `noise`, with the model's correlations and batches.

    With the weighted derivatives J and the covariance C of the weighted differences, the parameter covariance is (J^T
    J)^-1 J^T C J (J^T J)^-1. For independent errors this is (J^T J)^-1. With Q = 1 - J (J^T J)^-1 J^T, the chi-squared
    has the mean tr(Q C) and the variance 2 tr(Q C Q C), like a scaled chi-squared distribution (F. E. Satterthwaite,
    Biometrics Bulletin 2, 110 (1946), doi:10.2307/3002019).

    Errors in distant bins are correlated, too, since they share paths, and their standard errors from few passes are
    uncertain. With pass batches D, J^T C J is therefore J^T D^T D J instead. Such an estimate has f degrees of freedom,
    one less than batches. Its mean inverse is too large by f/(f - P - 1) for P parameters (J. Hartlap, P. Simon and P.
    Schneider, Astron. Astrophys. 464, 399 (2007), doi:10.1051/0004-6361:20066170). The covariance is multiplied by
    this, so that the squared distance between estimates and truth has the mean P. Where the share s of the covariance
    comes from batches, f is divided by s^2, as Satterthwaite does. Fewer than P + 3 batches are not used, nor are any
    for the chi-squared.
    """
    own, by_render = batches
    if borrows := borrows and own is None and by_render is not None:
        own = _with_variance(by_render, noise[0] ** 2)
    influence = np.sqrt(np.sum(derivatives**2, axis=(1, 2)))
    known = (influence > 0) & ~held
    count = int(known.sum())
    scaled_derivatives = derivatives[known] / influence[known, None, None]
    flat = scaled_derivatives.reshape(count, -1)
    eigenvalues, vectors = np.linalg.eigh(flat @ flat.T)
    inverse = (vectors / np.maximum(eigenvalues, _SMALLEST)) @ vectors.T
    # Residuals, which give unknown errors, include the model's, too.
    kinds, deviations = [noise, model], [own, by_render]
    if recorded is not None:
        kinds.append((recorded, model[1]))
        deviations.append(None if by_render is None else _with_variance(by_render, recorded**2))
        borrows |= by_render is not None
    parts = [inverse @ _projected(scaled_derivatives, *both) @ inverse for both in zip(kinds, deviations, strict=True)]
    if not known_noise:
        kinds = kinds[:1]
    known_parts = sum(parts[: len(kinds)], np.zeros_like(inverse))
    widening = _widening(known_parts, [*zip(parts, deviations, strict=True)][: len(kinds)], borrows)
    kept = eigenvalues > _SMALLEST * count
    # Rounding decides on the sign of the rest in directions without information.
    known_parts += (vectors[:, ~kept] / _SMALLEST) @ vectors[:, ~kept].T
    # The matrices of an orthonormal derivative basis, for the traces of Q C and of Q C Q C.
    basis = ((vectors[:, kept] / np.sqrt(eigenvalues[kept])).T @ flat).reshape(-1, *residuals.shape)
    image = sum((_correlated(basis, *errors) for errors in kinds), np.zeros_like(basis))
    projected = image.reshape(len(basis), -1) @ basis.reshape(len(basis), -1).T
    expected = sum(float(np.sum(deviation**2)) for deviation, _ in kinds) - float(np.trace(projected))
    variance = 2 * (_trace_of_square(kinds) - 2 * float(np.sum(image**2)) + float(np.sum(projected**2)))
    chi_squared = float(np.sum(residuals**2))
    factor = chi_squared / expected if (scaled or not known_noise) and expected > 0 else 1.0
    place, unit = np.ix_(known, known), np.outer(influence[known], influence[known])
    covariance = np.full((held.size, held.size), np.nan)
    covariance[place] = factor * widening * known_parts / unit
    by_model = np.full(held.size, np.nan)
    by_model[known] = np.sqrt(np.maximum(np.diag(parts[1]), 0)) / influence[known]
    freedom = 2 * expected**2 / variance if variance > 0 else math.nan
    return Errors(covariance, by_model, influence, held, chi_squared, expected, freedom, scaled and expected > 0)


def refusal_of_unknown_noise(unexplained: float) -> str:
    """Return why a scene that leaves a share of the samples' squares does not explain them, empty if it does."""
    if unexplained <= WORST_UNEXPLAINED:
        return ""
    return (
        f"the fit is refused: its residuals, but for their noise, have {100 * unexplained:.3g} % of the squares of the "
        f"samples, more than {100 * WORST_UNEXPLAINED:g} %. Start from other values, or check scene and receiver"
    )


def smoothed_variance(variance: FloatArray) -> FloatArray:
    """Return the geometric mean variance of neighbouring samples, shape (pixel, time); 0 where they are 0."""
    from scipy.ndimage import uniform_filter1d

    positive = variance > 0
    logarithms = np.log(variance, out=np.zeros_like(variance), where=positive)
    sums, counts = (uniform_filter1d(one, _SMOOTHED, mode="constant") for one in (logarithms, positive.astype(float)))
    return np.where(positive, np.exp(sums / np.where(positive, counts, 1.0)), 0.0)


def _with_variance(batches: FloatArray, variance: FloatArray) -> FloatArray:
    """Return deviations of batches, shape (batch, pixel, time), scaled to other variances, shape (pixel, time).

    Both variances are smoothed: bins of few passes whose variance is low by chance would count too little.
    """
    own = smoothed_variance(np.sum(batches**2, axis=0))
    ratio = np.divide(smoothed_variance(variance), own, out=np.zeros_like(own), where=own > 0)
    return np.asarray(batches * np.sqrt(ratio))


def _projected(
    derivatives: FloatArray, errors: tuple[FloatArray, FloatArray], batches: FloatArray | None
) -> FloatArray:
    """Return J^T C J for derivatives, shape (parameter, pixel, time), by pass batches where there are enough."""
    count = len(derivatives)
    flat = derivatives.reshape(count, -1)
    if batches is None or len(batches) < count + 3:
        return np.asarray(_correlated(derivatives, *errors).reshape(count, -1) @ flat.T)
    across = flat @ batches.reshape(len(batches), -1).T
    return np.asarray(across @ across.T)


def _widening(covariance: FloatArray, parts: Sequence[tuple[FloatArray, FloatArray | None]], borrowed: bool) -> float:
    """Return the factor of a covariance whose parts are partly estimated from batches; see `estimate_errors`."""
    count = len(covariance)
    known = [(part, len(own) - 1) for part, own in parts if own is not None and len(own) >= count + 3]
    shares = [(float(np.trace(np.linalg.pinv(covariance) @ part)) / max(count, 1), freedom) for part, freedom in known]
    if borrowed and shares:
        # The same batches: their errors add up.
        shares = [(sum(share for share, _ in shares), shares[0][1])]
    return 1 / (1 - (count + 1) * sum(share**2 / freedom for share, freedom in shares))


def _correlated(vectors: FloatArray, deviation: FloatArray, correlation: FloatArray) -> FloatArray:
    """Return vectors, shape (..., pixel, time), times the covariance of errors."""
    scaled = vectors * deviation
    lags = correlation[: scaled.shape[-1]]
    total = lags[0] * scaled
    for lag in range(1, lags.size):
        total[..., lag:] += lags[lag] * scaled[..., :-lag]
        total[..., :-lag] += lags[lag] * scaled[..., lag:]
    return np.asarray(total * deviation)


def _trace_of_square(kinds: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Return the trace of the squared covariance, all error kinds together."""
    pixels, count = kinds[0][0].shape
    total = 0.0
    for lag in range(min(count, max(correlation.size for _, correlation in kinds))):
        element = np.zeros((pixels, count - lag))
        for deviation, correlation in kinds:
            if lag < correlation.size:
                element += correlation[lag] * deviation[:, lag:] * deviation[:, : count - lag]
        total += (1 if lag == 0 else 2) * float(np.sum(element**2))
    return total


def noise_of_mean(variance: FloatArray, digitiser: Digitiser | None, shots: int) -> FloatArray:
    """Return the variance of the mean over records from one record's variance.

    Rounding has the same error in all records where the preceding noise is less than half a step. Take the mean square
    of this error over voltages within a step q with noise variance s^2. It is q^2 / (2 pi^2) times the sum over k = 1,
    2, ... of exp(-(2 pi k s / q)^2) / k^2 (B. Widrow and I. Kollar, Quantization Noise, Cambridge 2008, ch. 5,
    doi:10.1017/CBO9780511754661), which is q^2/12 without noise.
    """
    if digitiser is None or shots == 1:
        return variance / shots
    step = digitiser.step_v**2
    exponent = 4 * np.pi**2 * np.maximum(variance / step - 1 / 12, 0)
    terms = np.arange(1, _TERMS + 1)
    alike = np.exp(-np.multiply.outer(exponent, terms**2)) @ (1 / terms**2)
    return np.asarray(np.maximum(variance / shots, step / (2 * np.pi**2) * alike))
