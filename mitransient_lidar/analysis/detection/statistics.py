"""Detection of a known echo in noise and clutter by the best weighted sample sum, and alarm rates with their areas."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.constants import ELEMENTARY_CHARGE
from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray
from mitransient_lidar.physics.receiver.chain import ReceiverChain


class Rates(NamedTuple):
    """Fractions of trials, and their confidence limits; arrays with one shape."""

    rate: FloatArray
    low: FloatArray
    high: FloatArray


class Area(NamedTuple):
    """Area under a receiver operating characteristic: its value, standard error and confidence interval."""

    value: float
    stderr: float
    low: float
    high: float


def binomial_rates(successes: npt.ArrayLike, trials: int, confidence: float = 0.95) -> Rates:
    """Return rates with Clopper-Pearson intervals for numbers of successes, 0 to `trials`, in their shape.

    C. J. Clopper and E. S. Pearson, Biometrika 26, 404 (1934), doi:10.1093/biomet/26.4.404: exact and conservative, so
    that `confidence` is the smallest coverage probability. The limits are beta distribution quantiles.
    """
    from scipy.special import betaincinv

    count, tail = np.asarray(successes, dtype=np.float64), (1 - confidence) / 2
    low = np.where(count > 0, betaincinv(np.maximum(count, 1), trials - count + 1, tail), 0.0)
    high = np.where(count < trials, betaincinv(count + 1, np.maximum(trials - count, 1), 1 - tail), 1.0)
    return Rates(count / trials, low, high)


def exceedance(values: npt.ArrayLike, thresholds: npt.ArrayLike, confidence: float = 0.95) -> Rates:
    """Return the share of values, shape (trials,), above thresholds, shaped as `thresholds`.

    For shots without a target these are false alarm probabilities, with a target detection probabilities. Both at one
    threshold are a point on the receiver operating characteristic. The thresholds must not depend on the values;
    otherwise the intervals of `binomial_rates` are too narrow.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    return binomial_rates(ordered.size - np.searchsorted(ordered, thresholds, side="right"), ordered.size, confidence)


def area_under_curve(null: npt.ArrayLike, target: npt.ArrayLike, confidence: float = 0.95) -> Area:
    """Return the area under the receiver operating characteristic of outcomes without and with the target.

    It is the probability that the value with a target is the larger of a pair; equal values count one half. The
    outcomes, shape (trials,), are independent, at least two of each.

    The standard error follows E. R. DeLong, D. M. DeLong and D. L. Clarke-Pearson, Biometrics 44, 837 (1988),
    doi:10.2307/2531595, equation 5 for one curve. The interval is normal in the area's logit and thus below 1. If all
    pairs are separated, the standard error is 0. The lower limit is then the area at which as many pairs of independent
    shots would all be separated with a probability of 1 - confidence.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    without, with_target = np.asarray(null, dtype=np.float64), np.asarray(target, dtype=np.float64)
    n, m, tail = without.size, with_target.size, (1 - confidence) / 2
    ranks = rankdata(np.concatenate([without, with_target]))
    # For each shot, the fraction of the other kind's shots on the correct side of it.
    above = (ranks[n:] - rankdata(with_target)) / n
    below = 1 - (ranks[:n] - rankdata(without)) / m
    value = float(np.mean(above))
    error = float(np.sqrt(np.var(above, ddof=1) / m + np.var(below, ddof=1) / n))
    if value in (0.0, 1.0):
        limit = (2 * tail) ** (1 / min(n, m))
        return Area(value, error, limit if value else 0.0, 1.0 if value else 1 - limit)
    centre, reach = np.log(value / (1 - value)), -ndtri(tail) * error / (value * (1 - value))
    low, high = (1 / (1 + np.exp(-limit)) for limit in (centre - reach, centre + reach))
    return Area(value, error, float(low), float(high))


_SYMMETRIC = 1e-6  # least skewness that counts


class ShotMoments(NamedTuple):
    """Mean, shape (..., sample), and covariance, shape (..., sample, sample), of a shot's samples."""

    mean: FloatArray
    covariance: FloatArray


def sample_moments(
    chain: ReceiverChain, power: npt.ArrayLike, bin_width_ns: float, samples: slice, background: npt.ArrayLike = 0.0
) -> ShotMoments:
    """Return mean and covariance of some samples in a shot in closed form, in `chain.units` and their square.

    Arguments as for `ReceiverChain.expected`, plus the sample indices, without a step.

    Mean and variance come from `ReceiverChain.expected`. Samples are correlated like charge and noise after the
    low-pass, which a logarithm changes little; rounding errors are assumed independent.
    """
    expected = chain.expected(power, bin_width_ns, background)
    chosen = range(*samples.indices(expected.mean.shape[-1]))
    light = np.asarray(power, dtype=np.float64)
    sky = np.broadcast_to(np.asarray(background, dtype=np.float64), light.shape[:-1])
    stride, low_pass = chain.stride(bin_width_ns), chain.low_pass(bin_width_ns)
    # Covariance of the charges in the bin parts on which the samples depend, and their weights in each sample.
    rows = stride * low_pass.parts * (np.array(chosen) - chosen[0])
    reach, begin = int(rows[-1]) + low_pass.weights.size, low_pass.start + stride * low_pass.parts * chosen[0]
    part = bin_width_ns / low_pass.parts
    _, lags = chain.detector.moments(chain.events(light, bin_width_ns, sky), part, reach)
    charge = np.zeros((*light.shape[:-1], reach, reach))
    for lag, one in enumerate(lags[:reach]):
        i = np.arange(reach - lag)
        charge[..., i, i + lag] = charge[..., i + lag, i] = one[..., begin : begin + reach - lag]
    mixing = np.zeros((len(chosen), reach))
    for row, start in enumerate(rows):
        mixing[row, start : start + low_pass.weights.size] = low_pass.weights[::-1]
    covariance = mixing @ charge @ mixing.T
    if chain.amplifier is not None:
        covariance *= (chain.amplifier.transimpedance_ohm * ELEMENTARY_CHARGE / (1e-9 * part)) ** 2
        white, weights = chain.amplifier.noise(bin_width_ns, stride)
        apart = np.abs(np.subtract.outer(np.arange(len(chosen)), np.arange(len(chosen))))
        padded = np.pad(weights, (0, len(chosen)))
        correlation = np.array([weights @ padded[k : k + weights.size] for k in range(len(chosen))])
        covariance += white**2 * correlation[apart]
    deviation = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    rounding = np.zeros_like(deviation)
    if chain.digitiser is not None:
        rounding = chain.digitiser.step_v**2 / 12 * (1 - expected.saturation[..., samples])
    known = np.sqrt(np.maximum(expected.variance[..., samples] - rounding, 0))
    scale = np.divide(known, deviation, out=np.zeros_like(known), where=deviation > 0)
    covariance = covariance * scale[..., :, None] * scale[..., None, :] + rounding[..., None] * np.eye(len(chosen))
    return ShotMoments(expected.mean[..., samples], covariance)


def within_range(
    chain: ReceiverChain, power: npt.ArrayLike, bin_width_ns: float, samples: slice, background: npt.ArrayLike = 0.0
) -> ReceiverChain:
    """Return the chain with the transimpedance reduced, if necessary, for samples in the range of its electronics.

    Arguments as for `sample_moments`, and the range as for `ReceiverChain.fitting_gain`; other samples, such as a
    surface echo, may be clipped.
    """
    gain = chain.fitting_gain(power, bin_width_ns, background, samples)
    return chain if gain == 1 else chain.with_gain(gain)


class Statistic(NamedTuple):
    """A weighted sample sum, and its distribution without and with the target.

    Sample weights, shape (cases, samples), offsets that are subtracted from their sums, shape (cases,), and means,
    standard deviations and skewnesses over shots and cases. The weighted sum has a Pearson distribution of type III
    with these moments, normal without skewness, by the cube root of E. B. Wilson and M. M. Hilferty, Proc. Natl. Acad.
    Sci. 17, 684 (1931), doi:10.1073/pnas.17.12.684.
    """

    weights: FloatArray
    offsets: FloatArray
    null_mean: float
    null_sd: float
    target_mean: float
    target_sd: float
    null_skewness: float = 0.0
    target_skewness: float = 0.0

    @property
    def deflection(self) -> float:
        """Increase by the target, in standard deviations without it."""
        return (self.target_mean - self.null_mean) / self.null_sd

    def threshold(self, false_alarm: npt.ArrayLike) -> FloatArray:
        """Return the threshold for a probability of false alarm, above 0 and below 1."""
        from scipy.special import ndtri

        return np.asarray(self.null_mean + self.null_sd * _skewed(-ndtri(false_alarm), self.null_skewness))

    def quantile(self, false_alarm: npt.ArrayLike) -> FloatArray:
        """Return the normal quantile whose probability is the detection probability."""
        return -_normal((self.threshold(false_alarm) - self.target_mean) / self.target_sd, self.target_skewness)

    def detection(self, false_alarm: npt.ArrayLike) -> FloatArray:
        """Return the detection probability at a false alarm probability, above 0 and below 1."""
        from scipy.special import ndtr

        return np.asarray(ndtr(self.quantile(false_alarm)))

    def area(self) -> float:
        """Return the area under the receiver operating characteristic."""
        from scipy.special import ndtr

        return float(ndtr((self.target_mean - self.null_mean) / np.hypot(self.null_sd, self.target_sd)))


def _skewed(quantile: npt.ArrayLike, skewness: float) -> FloatArray:
    """Return the value, with mean 0 and deviation 1, of a skewed distribution at a normal quantile."""
    if abs(skewness) < _SYMMETRIC:
        return np.asarray(quantile, np.float64)
    share = skewness / 6
    return np.asarray(((share * (np.asarray(quantile) - share) + 1) ** 3 - 1) / (3 * share))


def _normal(value: npt.ArrayLike, skewness: float) -> FloatArray:
    """Return the normal quantile at a value of a skewed distribution; the inverse of `_skewed`."""
    if abs(skewness) < _SYMMETRIC:
        return np.asarray(value, np.float64)
    share = skewness / 6
    return np.asarray((np.cbrt(3 * share * np.asarray(value) + 1) - 1) / share + share)


@dataclass(frozen=True)
class Cases:
    """Moments of the samples without and with a target, for one sea or several.

    `null_mean`, `target_mean`, `null_covariance`, `target_covariance`: mean over each case's shots, shape (cases,
    samples), and covariance of the receiver's noise, shape (cases, samples, samples). `detectors`: number of detectors,
    each with an equal, contiguous part of the samples.
    """

    null_mean: FloatArray
    null_covariance: FloatArray
    target_mean: FloatArray
    target_covariance: FloatArray
    detectors: int = 1

    def combined(self, matrix: FloatArray, detectors: int = 1) -> Cases:
        """Return the cases of new samples, `matrix` (new samples, samples) times the samples."""
        return Cases(
            self.null_mean @ matrix.T,
            matrix @ self.null_covariance @ matrix.T,
            self.target_mean @ matrix.T,
            matrix @ self.target_covariance @ matrix.T,
            detectors,
        )

    def others(self, case: int) -> Cases:
        """Return all cases but one."""
        rest = np.arange(len(self.null_mean)) != case
        kept = {name: values[rest] for name, values in vars(self).items() if name != "detectors"}
        return replace(self, **kept)

    def rise(self) -> FloatArray:
        """Return the increase of the samples by the target, the mean over the cases."""
        return np.asarray((self.target_mean - self.null_mean).mean(axis=0))

    def covariance(self, with_target: bool = False) -> FloatArray:
        """Return the covariance for each detector's independent weights, shape (samples, samples).

        It is the noise covariance, with the target or else the mean without and with it. For several cases it includes,
        for each detector, the strongest principal component of its samples without the target: mostly the backscatter
        level.
        """
        covariance = self.target_covariance.mean(axis=0)
        if not with_target:
            covariance = (self.null_covariance.mean(axis=0) + covariance) / 2
        count = len(self.null_mean)
        if count > 1:
            for own in np.split(np.arange(len(covariance)), self.detectors):
                centred = self.null_mean[:, own] - self.null_mean[:, own].mean(axis=0)
                _, sizes, shapes = np.linalg.svd(centred, full_matrices=False)
                covariance[np.ix_(own, own)] += sizes[0] ** 2 / (count - 1) * np.outer(shapes[0], shapes[0])
        return np.asarray(covariance)

    def weights(self) -> FloatArray:
        """Return the best sample weights, shape (samples,), scaled as by `matched_weights`."""
        rise, covariance = self.rise(), self.covariance()
        if len(self.null_mean) == 1:
            return matched_weights(rise, covariance)
        filters = np.zeros((self.detectors, rise.size))
        for i, own in enumerate(np.split(np.arange(rise.size), self.detectors)):
            filters[i, own] = _solved(covariance[np.ix_(own, own)], rise[own])
        each = self.combined(filters)
        noise = (each.null_covariance.mean(axis=0) + each.target_covariance.mean(axis=0)) / 2
        return np.asarray(matched_weights(each.rise(), noise + clutter_covariance(each.null_mean)) @ filters)

    def statistic(self) -> Statistic:
        """Return the best weighted sum of the samples, and its distribution.

        One case is weighted for its noise alone. Three or more are weighted for noise and clutter, each with weights
        estimated from the others. Few seas do not determine a weight for every sample. Each detector's samples are
        therefore weighted for its noise and the strongest component of its clutter, and then the detectors for noise
        and their common clutter. Raises `UserError` if the target changes no sample.

        With the mean increase s and the covariance C the weights C^-1 s are the matched filter, the Neyman-Pearson test
        for normal noise that is the same without and with the target (H. L. Van Trees, Detection, Estimation, and
        Modulation Theory, part I, 1968, section 4.3). Otherwise, the mean of both covariances gives the largest
        separation among weighted sums (Hotelling's observer: H. H. Barrett and K. J. Myers, Foundations of Image
        Science, 2004, section 13.2.12).
        """
        count = len(self.null_mean)
        training = [self] if count == 1 else [self.others(i) for i in range(count)]
        weights, offsets = np.empty_like(self.null_mean), np.empty(count)
        for i, cases in enumerate(training):
            weights[i] = cases.weights()
            offsets[i] = weights[i] @ cases.null_mean.mean(axis=0)
        null, target = (np.sum(weights * mean, axis=1) - offsets for mean in (self.null_mean, self.target_mean))
        null_variance, target_variance = (
            np.einsum("ni,nij,nj->n", weights, covariance, weights)
            for covariance in (self.null_covariance, self.target_covariance)
        )
        spread = [0.0, 0.0] if count == 1 else [np.var(null, ddof=1), np.var(target, ddof=1)]
        return Statistic(
            weights,
            offsets,
            float(np.mean(null)),
            float(np.sqrt(np.mean(null_variance) + spread[0])),
            float(np.mean(target)),
            float(np.sqrt(np.mean(target_variance) + spread[1])),
        )


def matched_weights(signal: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return C^-1 s / (s C^-1 s), the matched filter weights for a signal s in noise with covariance C.

    Samples without variance have weight 0. Without a signal in the samples with noise, `UserError` is raised.
    """
    filtered = _solved(covariance, signal)
    square = float(signal @ filtered)
    if square <= 0:
        raise UserError("signal must not be 0 in every sample that has noise, and covariance must be positive")
    return filtered / square


def _solved(covariance: FloatArray, signal: FloatArray) -> FloatArray:
    """Return the inverse of the covariance times the signal, 0 without variance."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0))
    noisy = np.flatnonzero(deviation > 0)
    # In standard deviations, which may differ by orders of magnitude.
    correlation = covariance[np.ix_(noisy, noisy)] / np.outer(deviation[noisy], deviation[noisy])
    found = np.zeros_like(signal)
    try:
        found[noisy] = np.linalg.solve(correlation, signal[noisy] / deviation[noisy]) / deviation[noisy]
    except np.linalg.LinAlgError:
        raise UserError("covariance must be positive definite among the samples with a variance") from None
    return found


def clutter_covariance(values: FloatArray) -> FloatArray:
    """Return the covariance of samples (cases, samples) over few cases, with correlations shrunk towards 0.

    J. Schaefer and K. Strimmer, Stat. Appl. Genet. Mol. Biol. 4, 32 (2005), doi:10.2202/1544-6115.1175, table 2, target
    D with unequal variances: the shrinkage is the correlations' estimated variance over their sum of squares. With few
    cases, the sample covariance is singular, and weights would ignore the clutter in its null space.
    """
    n = len(values)
    deviation = values.std(axis=0, ddof=1)
    unit = np.divide(values - values.mean(axis=0), deviation, out=np.zeros_like(values), where=deviation > 0)
    products = unit.T @ unit / n
    correlation = n / (n - 1) * products
    variance = n / (n - 1) ** 3 * ((unit**2).T @ unit**2 - n * products**2)
    off_diagonal = ~np.eye(values.shape[1], dtype=bool)
    total = float(np.sum(correlation[off_diagonal] ** 2))
    share = min(1.0, float(np.sum(variance[off_diagonal])) / total) if total > 0 else 1.0
    correlation[off_diagonal] *= 1 - share
    return np.asarray(correlation * np.outer(deviation, deviation))
