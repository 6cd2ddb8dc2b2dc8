"""Target detection in a gated camera's images, by the best weighted sum over pixels and gates.

Mean images of renders with and without the target are vectors x [DN]. With the covariance D of the camera's noise,
every matched filter is D^-1 times a sum of these vectors. This also holds against clutter between seas. So all filters
follow from scalar products of the vectors, `FilterProducts`. A shadow counts like an echo: its difference is negative,
and so are its weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mitransient_lidar.analysis.detection.statistics import Statistic
from mitransient_lidar.analysis.detection.trials import MOST_GROUPS, Variables, crossing, interval, with_limits
from mitransient_lidar.core.validation import FloatArray, IntArray
from mitransient_lidar.physics.receiver.camera import Camera, Noise
from mitransient_lidar.physics.receiver.electronics import Expected

_TOLERANCE, _MOST_STEPS = 1e-4, 200  # of weights in noise that pixels share; their detection is exact for any weights
_ROUNDING = 1e-9
_SHARES = 0.5, 0.25, 0.1, 0.02, 0.75  # of the covariance with the target that are tried


class GateImages(NamedTuple):
    """A camera's record of one gate; pixels have the shape (row, column) or (pixel,)."""

    #: Means [DN] of the target's difference and of the images without it, shape (*pixels, 4 renders), in the order
    #: (difference or background, render, half).
    vectors: FloatArray
    filters: FloatArray  #: D^-1 times the vectors.
    noises: list[Noise]  #: Without and with the target, each of shape (*pixels, 1).
    thirds: FloatArray  #: Third cumulants of the filtered image [1], without and with the target, shape (2,).
    expected: Expected  #: Moments of the mean light without and with the target, shape (*pixels, 2).


@dataclass(frozen=True)
class FilterProducts:
    """Scalar products of the renders' vectors.

    `products` has the shape (3, gate, vector, vector): x D^-1 y, and x D^-1 C D^-1 y with the covariance C without and
    with the target. `thirds`, shape (2, gate), are the third cumulants without and with the target after the mean
    filter over all renders. Renders belong to different `seas`, whose differences are clutter, or to one.
    """

    seas: bool
    products: FloatArray
    thirds: FloatArray

    @property
    def renders(self) -> int:
        """Number of renders."""
        return int(self.products.shape[-1]) // 4

    def of(self, gate: int) -> FilterProducts:
        """Return the products for a gate alone."""
        return replace(self, products=self.products[:, [gate]], thirds=self.thirds[:, [gate]])

    def skewness(self) -> FloatArray:
        """Return the skewness of one filtered frame by the noise alone, without and with the target, shape (2,)."""
        template = _template(self.renders, range(self.renders))
        variance = template @ self.products[1:].sum(axis=1) @ template
        return _ratio(self.thirds.sum(axis=1), variance**1.5)

    def coefficients(self, frames: int, renders: Sequence[int]) -> FloatArray:
        """Return the filter sum that is best in the clutter of some renders, scaled to their difference.

        It is 0 if the target changes nothing.
        """
        product, first = self.products[0].sum(axis=0), 2 * self.renders
        halves = _halves(renders)
        template = found = _template(self.renders, renders)
        if self.seas:
            clutter = np.zeros((2 * first, len(renders)))
            clutter[first + halves, np.arange(len(renders))[:, None]] = 0.5
            clutter = (clutter - clutter.mean(axis=1, keepdims=True)) / np.sqrt(len(renders) - 1)
            # Woodbury: the inverse of D / frames and the clutter's outer products.
            inner = clutter.T @ product @ clutter + np.eye(len(renders)) / frames
            found = template - clutter @ np.linalg.solve(inner, clutter.T @ product @ template)
        scale = float(template @ product @ found)
        return found / scale if scale > 0 else np.zeros_like(found)

    def statistic(self, frames: int, left_out: Sequence[int] = ()) -> Statistic | None:
        """Return the filter for the mean over some frames, and its distribution; None if the target changes nothing.

        Each render is filtered with the others' weights, without renders that are left out. The clutter is the
        covariance over the seas between the halves of the passes, which is free from render noise.
        """
        renders = np.setdiff1d(np.arange(self.renders), left_out)
        product, *noises = self.products.sum(axis=1)
        weights = np.array([self.coefficients(frames, renders[renders != case]) for case in renders])
        if not weights.any(axis=1).all():
            return None
        answers = (weights @ product).reshape(len(renders), 2, -1, 2)[:, :, renders]
        rise, level = (answers[np.arange(len(renders)), kind, np.arange(len(renders))] for kind in (0, 1))
        others = (answers[:, 1].sum(axis=1) - level) / (len(renders) - 1)
        null = level - others if self.seas else np.zeros_like(rise)
        target = null + rise
        own = np.array([np.einsum("ni,ij,nj->n", weights, noise, weights).mean() / frames for noise in noises])
        clutter = [max(np.cov(one.T)[0, 1], 0.0) if self.seas else 0.0 for one in (null, target)]
        variances = own + clutter
        skewness = self.skewness() / math.sqrt(frames) * (own / variances) ** 1.5
        moments = zip((null.mean(), target.mean()), np.sqrt(variances), strict=True)
        return Statistic(
            weights, others.mean(axis=1), *(float(one) for pair in moments for one in pair), *map(float, skewness)
        )


def _halves(renders: Sequence[int]) -> IntArray:
    """Return the positions of the renders' halves among the difference vectors, shape (renders, 2)."""
    return 2 * np.array(renders)[:, None] + [0, 1]


def _template(count: int, renders: Sequence[int]) -> FloatArray:
    """Return the vector sum that is the mean difference in some of `count` renders."""
    found = np.zeros(4 * count)
    found[_halves(renders)] = 0.5 / len(renders)
    return found


@dataclass(frozen=True)
class ImageTrial:
    """A scene's light in a camera's gates.

    The filters use the camera's fixed pattern, as for a calibrated camera.
    """

    #: Energies [J] with and without the target in two halves of each render's passes, shape (with or without, render,
    #: half, *pixels, gate).
    light: FloatArray
    seas: bool  #: Whether renders belong to different seas.
    camera: Camera
    open_ns: float  #: Integrated gate transmission [ns].
    pulses: int  #: Pulses per frame.
    sky: float  #: Daylight power on each pixel [W].
    #: Derivative of the light with respect to the gate time [J/ns], for the camera's jitter, which all pixels in a
    #: gate's frame share; without it, the jitter has no effect.
    slope: FloatArray | None = None
    #: Share of the noise with the target in the covariance D that the filters are for, 0 to 1.
    target_share: float = 0.5

    def tuned(self, frames: int, pfa: float) -> ImageTrial:
        """Return the trial whose filters are the best ones for a probability of false alarm.

        With noise that differs with the target, the best weighted sums are those for a sum of both covariances (T. W.
        Anderson and R. R. Bahadur, Ann. Math. Stat. 33, 420 (1962), doi:10.1214/aoms/1177704568); the shares are the
        best of a few.
        """
        trials = [replace(self, target_share=share) for share in _SHARES]
        found = [one.products.statistic(frames) for one in trials]
        margins = [-math.inf if one is None else float(one.quantile(pfa)) for one in found]
        return trials[int(np.argmax(margins))]

    def widened(self, count: int, apart: int) -> ImageTrial:
        """Return the trial with gates that are sums of `count` gates, each `apart` steps after the former."""
        last = self.light.shape[-1] - (count - 1) * apart

        def sums(light: FloatArray) -> FloatArray:
            return sum((light[..., number * apart :][..., :last] for number in range(count)), np.zeros(()))

        slope = None if self.slope is None else sums(self.slope)
        return replace(self, light=sums(self.light), slope=slope, open_ns=count * self.open_ns)

    @cached_property
    def _known(self) -> dict[str, Any]:
        """Arguments of the camera's functions besides the light."""
        pattern = self.camera.pattern(self.light.shape[3:-1])
        return {"open_ns": self.open_ns, "background": self.sky, "pulses": self.pulses, "pattern": pattern}

    def images(self) -> Iterator[GateImages]:
        """Return the camera's record of each gate."""
        camera, known = self.camera, self._known
        for gate in range(self.light.shape[-1]):
            energy = _by_render(self.light[..., gate])
            target, null = np.split(camera.expected(energy, **known).mean, 2, axis=-1)
            vectors = np.concatenate([target - null, null], axis=-1)
            mean = _without_and_with(energy)
            slope = None if self.slope is None else _without_and_with(_by_render(self.slope[..., gate]))
            noise, expected = camera.noise(mean, slope=slope, **known), camera.expected(mean, **known)
            # Where pixels do not share noise, saturation reduces it.
            own = noise.own if noise.shared.any() else expected.variance
            parts = noise._replace(own=own)
            noises = [Noise(*(part[..., [which]] for part in parts)) for which in (0, 1)]
            expected = expected._replace(variance=expected.variance + noise.shift**2)
            filters = self._filters(vectors, noises)
            weights = filters @ _template(self.light.shape[1], range(self.light.shape[1]))
            thirds = camera.third_cumulant(np.stack([weights, weights], axis=-1), mean, **known)
            yield GateImages(vectors, filters, noises, thirds, expected)

    def _filters(self, vectors: FloatArray, noises: Sequence[Noise]) -> FloatArray:
        """Return D^-1 times vectors, D being the covariance of both noises by their shares, by conjugate gradients."""
        share = self.target_share
        mean = Noise(*((1 - share) * null + share * target for null, target in zip(*noises, strict=True)))
        diagonal = mean.own + mean.shared
        inverse = _ratio(np.ones_like(diagonal), diagonal)
        found = vectors * inverse
        if not mean.shared.any() and not mean.shift.any():
            return found
        pixels = tuple(range(vectors.ndim - 1))
        rest = vectors - self._correlated(mean, found)
        step = inverse * rest
        size, enough = (np.sum(one * inverse * one, axis=pixels) for one in (rest, _TOLERANCE * vectors))
        for _ in range(_MOST_STEPS):
            if np.all(size <= enough):
                break
            turned = self._correlated(mean, step)
            length = _ratio(size, np.sum(step * turned, axis=pixels))
            found, rest = found + length * step, rest - length * turned
            former, size = size, np.sum(rest * inverse * rest, axis=pixels)
            step = inverse * rest + _ratio(size, former) * step
        return found

    def _correlated(self, noise: Noise, values: FloatArray) -> FloatArray:
        """Return the covariance of a noise times values, shape (*pixels, vectors)."""
        pixels = tuple(range(values.ndim - 1))
        found: FloatArray = noise.own * values + noise.shift * np.sum(noise.shift * values, axis=pixels)
        return found + self.camera.spread(noise.shared * self.camera.spread(values)) if noise.shared.any() else found

    @cached_property
    def products(self) -> FilterProducts:
        """Scalar products for each gate."""
        found, thirds = [], []
        for one in self.images():
            size = one.vectors.shape[-1]
            thirds.append(one.thirds)
            right = [one.vectors, *(self._correlated(noise, one.filters) for noise in one.noises)]
            found.append([values.reshape(-1, size).T @ one.filters.reshape(-1, size) for values in right])
        return FilterProducts(self.seas, np.moveaxis(np.array(found), 0, 1), np.transpose(thirds))

    def maps(self, frames: int) -> dict[str, FloatArray]:
        """Return the camera's maps over pixels and gates, shape (*pixels, gate), for one frame.

        The maps are ``background`` and ``difference`` [DN], ``filter_weight`` [1/DN] of the best filter for a number of
        frames, and ``snr``. ``saturation`` is its probability in the light with the target. Also the target's
        ``contrast`` (NaN without light), and ``contrast_to_noise`` with its standard error over the renders.
        """
        renders = range(self.light.shape[1])
        coefficients, found = self.products.coefficients(frames, renders), []
        nothing = np.zeros((*self.light.shape[3:-1], 1))
        dark = self.camera.expected(nothing, **{**self._known, "background": 0.0}).mean[..., 0]
        for one in self.images():
            values = one.vectors.reshape(*one.vectors.shape[:-1], 2, len(renders), 2).mean(axis=-1)
            difference, background = np.moveaxis(values.mean(axis=-1), -1, 0)
            light, noise = background - dark, np.sqrt(one.expected.variance.mean(axis=-1))
            error = values[..., 0, :].std(axis=-1, ddof=1) / np.sqrt(len(renders))
            gate = {
                "background": background,
                "difference": difference,
                "filter_weight": one.filters @ coefficients,
                "snr": _ratio(light + difference, np.sqrt(one.expected.variance[..., 1])),
                "saturation": one.expected.saturation[..., 1],
                "contrast": np.where(light > 0, _ratio(difference, light), np.nan),
                "contrast_to_noise": _ratio(difference, noise),
                "contrast_to_noise_stderr": _ratio(error, noise),
            }
            found.append(gate)
        return {name: np.stack([gate[name] for gate in found], axis=-1) for name in found[0]}


def _by_render(values: FloatArray) -> FloatArray:
    """Return values of shape (with or without, render, half, *pixels) with all renders on the last axis."""
    return np.moveaxis(values.reshape(-1, *values.shape[3:]), 0, -1).astype(np.float64)


def _without_and_with(values: FloatArray) -> FloatArray:
    """Return the means over renders of `_by_render` without and with the target, shape (*pixels, 2)."""
    return np.stack([part.mean(axis=-1) for part in np.split(values, 2, axis=-1)[::-1]], axis=-1)


def detected(products: FilterProducts, frames: Sequence[int], pfa: float, pd: float) -> Variables:
    """Return the detection probability for numbers of frames, and the number that the required one needs.

    Variables with limits: ``detection`` over ``frames``, and ``frames_needed``, infinite if none of these is enough.
    """
    from scipy.special import ndtr, ndtri

    groups = np.array_split(np.arange(products.renders), min(products.renders, MOST_GROUPS))

    def quantile(count: int, left_out: Sequence[int] = ()) -> float:
        found = products.statistic(count, left_out)
        return float(ndtri(pfa) if found is None else found.quantile(pfa))

    values = [quantile(count) for count in frames]
    changes = [np.array([quantile(count, group.tolist()) for group in groups]) for count in frames]
    table = np.array([interval(value, rest - value) for value, rest in zip(values, changes, strict=True)])
    # In one known sea, the quantile is linear in the root of the number of frames.
    margins = np.concatenate([np.full((1, 3), ndtri(pfa)), table]) - ndtri(pd)
    roots = [crossing(np.sqrt([0, *frames]).tolist(), list(column)) for column in margins.T[[0, 2, 1]]]
    needed = [math.inf if math.isnan(root) else math.ceil(root**2 - _ROUNDING) for root in roots]
    return {
        "frames": ("frames", list(frames)),
        **with_limits("detection", ndtr(table), dims=("frames",)),
        **with_limits("frames_needed", needed, dims=()),
    }


def single_gates(trial: ImageTrial, counts: Sequence[int], apart: int, frames: int, pfa: float) -> Variables:
    """Return the detection with the images of one gate alone, as it is and as wide as several gates that adjoin.

    ``gate_detection`` and ``gate_deflection`` are over ``adjoining`` (`counts`, gates `apart` steps from each other)
    and ``gate``, the first of them; NaN where the train ends before the last.
    """
    table = np.full((2, len(counts), trial.light.shape[-1]), np.nan)
    for row, count in enumerate(counts):
        products = trial.widened(count, apart).products
        for gate in range(products.products.shape[1]):
            found = products.of(gate).statistic(frames)
            table[:, row, gate] = (pfa, 0.0) if found is None else (found.detection(pfa), found.deflection)
    own = {name: (("adjoining", "gate"), table[i]) for i, name in enumerate(("gate_detection", "gate_deflection"))}
    return {"adjoining": ("adjoining", list(counts)), **own}


def _ratio(part: FloatArray, total: FloatArray) -> FloatArray:
    """Return a ratio, 0 where the total is 0."""
    return np.asarray(np.divide(part, total, out=np.zeros_like(part), where=total > 0))
