"""Gated cameras: digital numbers of frames for the energy that each pixel collects in a gate, as moments and draws.

A frame is the sum of a gate's pulses on the chip. Its light passes, in this order: the optics' blur; events
(photoelectrons or avalanches, Poisson-distributed, with dark events while the gate is open); their multiplication; an
intensifier's blur; the chip with its dark current and full well; the read-out; and the converter. Pixel arrays have the
shape (row, column, gate), or (pixel, gate) for pixels that are no image, which have no blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.options import Option, Plan, positive_option
from mitransient_lidar.core.validation import BoolArray, FloatArray, integer, non_negative_array
from mitransient_lidar.physics.receiver.detectors import multiplied, photons_per_joule
from mitransient_lidar.physics.receiver.electronics import Expected

if TYPE_CHECKING:
    from scipy import sparse

Values = npt.ArrayLike

_TAIL = 1e-6  # left out at the ends of a kernel
_LEAST_SKEWNESS = 1e-3  # of a clipped distribution, against cancellation
_FAR = 12.0  # deviations from a limit beyond which nothing is clipped
_OFFSET = 4.0  # least offset in read-out deviations

#: Parameters that a camera kind lacks.
_GAIN = ("gain", "excess_noise", "frame_dark", "intensifier_mtf")
_CHIP = ("dark_current_hz", "read_noise", "full_well", "electrons_per_dn", "offset_dn", "offset_spread_dn")
_WITHOUT = {
    "intensified": ("pulses_per_exposure",),
    "electron_multiplying": ("pulses_per_exposure", "intensifier_mtf"),
    "counting": (*_GAIN, *_CHIP),
    "direct": ("pulses_per_exposure", *_GAIN),
}


class Record(NamedTuple):
    """Drawn frames, each with the shape (frame, ..., gate)."""

    signal: npt.NDArray[np.unsignedinteger[Any]]  #: Digital numbers, 16 bits, or 32 for a converter with more.
    saturated: BoolArray  #: Whether the full well or the range of the converter was reached.


class Pattern(NamedTuple):
    """Fixed pattern of a camera's pixels, the same in all frames, each with the shape (row, column) or (pixel,)."""

    response: FloatArray  #: Events relative to the mean pixel [1].
    offset: FloatArray  #: Added to the offset [DN].
    dark: FloatArray  #: Dark current relative to most pixels [1].


_ALIKE = Pattern(np.ones(1), np.zeros(1), np.ones(1))


class Noise(NamedTuple):
    """Noise parts: the covariance of pixels is B diag(shared) B + diag(own) + shift shift^T.

    `Camera.spread` gives B.
    """

    shared: FloatArray  #: Variance of a pixel's events that the intensifier spreads over its neighbours [DN^2].
    own: FloatArray  #: Variance of a pixel that others do not share [DN^2].
    shift: FloatArray  #: Change in the mean when a frame's gate opens one jitter deviation later [DN].


@dataclass(frozen=True)
class Camera(Plan):
    """Gated camera.

    Notes
    -----
    Mean and variance are exact below saturation. A limit cuts a Pearson distribution of type III with the charge's
    mean, variance and skewness. The higher limit, full well or converter, is left out. Blur is T. Lindeberg's discrete
    Gaussian, IEEE Trans. PAMI 12, 234 (1990), doi:10.1109/34.49051. Its MTF is exp(-t (1 - cos 2 pi f)) along each axis
    at f cycles per pixel. Images are mirrored at their edges, which keeps the sum. Intensifiers and electron
    bombardment multiply before the chip. An electron-multiplying CCD needs a shutter before it, and multiplies its dark
    current. Phosphor afterglow and the crosstalk and afterpulses of counters are left out.
    """

    kind: Annotated[
        Literal["intensified", "electron_multiplying", "counting", "direct"],
        Option("Place of the gain: before the chip, in its register, in pixels that count, or none"),
    ]
    quantum_efficiency: Annotated[float, Option("Events per photon, with windows and fill factors", 0, 1, above=True)]
    gain: Annotated[float, Option("Mean electrons on the chip per event", 1)] = 1.0
    excess_noise: Annotated[float, Option("Mean square of these electrons over their squared mean", 1)] = 1.0
    open_dark_hz: Annotated[float, Option("Dark events per pixel while the gate is open", 0, unit="1/s")] = 0.0
    frame_dark: Annotated[float, Option("Dark events per pixel and frame before the gain", 0)] = 0.0
    dark_current_hz: Annotated[float, Option("Dark current of a chip pixel", 0, unit="electrons/s")] = 0.0
    frame_time_ms: Annotated[float, Option("Chip exposure per frame", 0, unit="ms")] = 0.0
    leakage: Annotated[float, Option("Share of the daylight recorded during the frame with closed gate", 0, 1)] = 0.0
    pulses_per_exposure: Annotated[int, Option("Pulses in which a pixel counts at most one event", 1, 10**9)] = 1
    read_noise: Annotated[float, Option("Standard deviation of the read-out", 0, unit="electrons")] = 0.0
    full_well: Annotated[float, positive_option("Largest pixel or register charge", "electrons")] = np.inf
    bits: Annotated[int, Option("Converter resolution, or counter size", 1, 24)] = 16
    electrons_per_dn: Annotated[float, positive_option("Charge per digital number", "electrons")] = 1.0
    offset_dn: Annotated[float, Option("Digital number without charge, at least 4 read-out noises", 0, unit="DN")] = 0.0
    response_spread: Annotated[float, Option("Standard deviation of pixel responses over their mean", 0, 1)] = 0.0
    offset_spread_dn: Annotated[float, Option("Standard deviation of pixel offsets", 0, unit="DN")] = 0.0
    hot_pixels: Annotated[float, Option("Share of hot pixels", 0, 1)] = 0.0
    hot_factor: Annotated[float, Option("Dark current or counts in a hot pixel over those in others", 1)] = 1.0
    pattern_seed: Annotated[int, Option("Seed of the fixed pattern: one per camera", 0, 2**53)] = 0
    optics_mtf: Annotated[float, Option("MTF of the optics at half a cycle per pixel", 0, 1, above=True)] = 1.0
    intensifier_mtf: Annotated[float, Option("MTF of the intensifier, after its gain", 0, 1, above=True)] = 1.0
    gate_jitter_ns: Annotated[float, Option("Standard deviation of the gate time within a pulse", 0, unit="ns")] = 0.0
    insertion_delay_ns: Annotated[float, Option("Earliest gate after the pulse", 0, unit="ns")] = 0.0
    shortest_gate_ns: Annotated[float, Option("Shortest gate width", 0, unit="ns")] = 0.0
    wavelength_nm: Annotated[float, positive_option("Vacuum wavelength of the light", "nm")] = 532.0
    source: Annotated[str, Option("Sources of the numbers, and which are assumed", form="a text")] = ""
    name: str = "custom"

    def __post_init__(self) -> None:
        super().__post_init__()
        for one in fields(self):
            if one.name in _WITHOUT[self.kind] and (value := getattr(self, one.name)) != one.default:
                raise UserError(f"{one.name} = {value:g} is no parameter of a camera of kind {self.kind!r}")
        least = _OFFSET * self.read_noise / self.electrons_per_dn
        if self.offset_dn < least * (1 - 1e-9):
            raise UserError(f"offset_dn = {self.offset_dn:g} must be at least {least:g}, 4 deviations of the read-out")
        if self.intensifier_mtf < 1 and self.excess_noise < 1 + 1 / self.gain:
            raise UserError(
                f"excess_noise = {self.excess_noise:g} must be at least 1 + 1/gain = {1 + 1 / self.gain:g} with an "
                "intensifier_mtf, as the electrons of an event are spread at random"
            )

    @property
    def top_dn(self) -> int:
        """Largest digital number."""
        return (1 << self.bits) - 1

    def pattern(self, pixels: tuple[int, ...]) -> Pattern:
        """Return the fixed pattern for pixels in the shape (row, column) or (pixel,)."""
        random = np.random.default_rng(self.pattern_seed)
        response = np.maximum(random.normal(1, self.response_spread, pixels), 0)
        offset = random.normal(0, self.offset_spread_dn, pixels)
        return Pattern(response, offset, np.where(random.random(pixels) < self.hot_pixels, self.hot_factor, 1.0))

    def events(
        self, energy: Values, open_ns: Values, background: Values = 0.0, pulses: int = 1, pattern: Pattern = _ALIKE
    ) -> FloatArray:
        """Return the mean events of each pixel and gate, with dark events.

        `energy`, shape (row, column, gate) or (pixel, gate): energy of the signal in a gate over all pulses [J], not
        negative. `open_ns`: integral of the gate's transmission [ns], not negative: a number, or shape (gate,).
        `background`: daylight power on each pixel [W], not negative: a number, or an array in the shape of the pixels.
        `pulses`: pulses per frame. `pattern`: fixed pattern; by default all pixels are alike.
        """
        light, sky = non_negative_array("energy", energy), non_negative_array("background", background)
        if light.ndim not in (2, 3):
            raise UserError(f"energy of shape {light.shape} must have the axes (row, column, gate) or (pixel, gate)")
        if sky.shape not in ((), light.shape[:-1]):
            raise UserError(f"background of shape {sky.shape} must be a number or have the shape {light.shape[:-1]}")
        opened = 1e-9 * integer("pulses", pulses, 1, 10**9) * non_negative_array("open_ns", open_ns)
        light += (sky[..., np.newaxis] if sky.ndim else sky) * (opened + 1e-3 * self.leakage * self.frame_time_ms)
        hot, dark = pattern.dark[..., np.newaxis], self.open_dark_hz * opened
        found = self._signal_events(light, pattern) + self.frame_dark + (hot if self.kind == "counting" else 1) * dark
        return np.asarray(found + (self._dark(pattern) if self.kind == "electron_multiplying" else 0))

    def expected(
        self,
        energy: Values,
        open_ns: Values,
        background: Values = 0.0,
        pulses: int = 1,
        pattern: Pattern = _ALIKE,
        slope: Values | None = None,
    ) -> Expected:
        """Return a frame's mean [DN], variance [DN^2] and saturation probability in the shape of `energy`.

        Parameters as for `events`; `slope` is the energy's derivative with respect to the gate time [J/ns], in the same
        shape: without it, `gate_jitter_ns` has no effect.
        """
        from scipy.special import bdtrc

        events = self.events(energy, open_ns, background, pulses, pattern)
        mean, variance, third = self._charge(events, pulses, pattern)
        if slope is not None:
            variance = variance + self._shift(slope, events, pulses, pattern) ** 2
        if self.kind == "counting":  # whose codes are counts, without rounding
            most = self._exposures(pulses)
            clipped = _clipped(mean, variance, third, self.top_dn if most > self.top_dn else np.inf, np.inf)
            full = bdtrc(min(self.top_dn, most) - 1, most, -np.expm1(-events / most))
            return Expected(clipped.mean, clipped.variance, np.asarray(full))
        offset, scale, read = self._offset(pattern), self.electrons_per_dn, self.read_noise**2
        top = (self.top_dn - offset) * scale
        is_well = np.broadcast_to(top > self.full_well, mean.shape)  # before the read-out, whose noise stays
        limit = np.where(is_well, self.full_well, top)
        over = np.where(is_well, self.full_well, top + 0.5 * scale)
        clipped = _clipped(mean, np.where(is_well, variance, variance + read), third, limit, over)
        rest = np.where(is_well, read / scale**2 + 1 / 12, (1 - clipped.saturation) / 12)
        return Expected(offset + clipped.mean / scale, clipped.variance / scale**2 + rest, clipped.saturation)

    def noise(
        self,
        energy: Values,
        open_ns: Values,
        background: Values = 0.0,
        pulses: int = 1,
        pattern: Pattern = _ALIKE,
        slope: Values | None = None,
    ) -> Noise:
        """Return the noise parts without saturation; parameters as for `expected`."""
        events = self.events(energy, open_ns, background, pulses, pattern)
        variance = self._charge(events, pulses, pattern)[1] + self.read_noise**2
        shared = np.zeros_like(events)
        if self.intensifier_mtf < 1:
            shared = (self.gain**2 * self.excess_noise - self.gain) * events
            variance = variance - self.spread(shared, 2)
        scale = self.electrons_per_dn
        shift = np.zeros_like(events) if slope is None else self._shift(slope, events, pulses, pattern) / scale
        return Noise(shared / scale**2, variance / scale**2 + (0 if self.kind == "counting" else 1 / 12), shift)

    def _shift(self, slope: Values, events: FloatArray, pulses: int, pattern: Pattern) -> FloatArray:
        """Return how the mean charge changes with a frame's gate time, for one deviation [electrons]."""
        steep = self._signal_events(np.asarray(slope, np.float64), pattern) * self.gate_jitter_ns / np.sqrt(pulses)
        if self.kind == "counting":
            steep = steep * np.exp(-events / self._exposures(pulses))
        return self.gain * self.spread(steep)

    def third_cumulant(
        self,
        weights: FloatArray,
        energy: Values,
        open_ns: Values,
        background: Values = 0.0,
        pulses: int = 1,
        pattern: Pattern = _ALIKE,
    ) -> FloatArray:
        """Return the third cumulant of weighted pixel sums [weights in 1/DN] in each gate, without saturation.

        The weights have the shape of `energy`; other parameters as for `events`.
        """
        events = self.events(energy, open_ns, background, pulses, pattern)
        scaled, pixels = weights / self.electrons_per_dn, tuple(range(events.ndim - 1))
        if self.intensifier_mtf == 1:
            return np.asarray(np.sum(self._charge(events, pulses, pattern)[2] * scaled**3, axis=pixels))
        # The electrons of an event, whose number is gamma-distributed, meet the pixel weights at random.
        once, twice, thrice = (self.spread(scaled**power) for power in (1, 2, 3))
        noise = self.excess_noise - 1 / self.gain
        triples = self.gain**3 * noise * (2 * noise - 1) * once**3 + 3 * self.gain**2 * noise * once * twice
        found = events * (triples + self.gain * thrice) + self._dark(pattern) * scaled**3
        return np.asarray(np.sum(found, axis=pixels))

    def spread(self, values: Values, power: int = 1) -> FloatArray:
        """Return values, shape (row, column, ...), behind the intensifier: a symmetric matrix B of this power."""
        return _blurred(np.asarray(values, np.float64), self.intensifier_mtf, power)

    def sample(
        self,
        energy: Values,
        open_ns: Values,
        frames: int,
        seed: int | Sequence[int],
        background: Values = 0.0,
        pulses: int = 1,
        pattern: Pattern = _ALIKE,
        slope: Values | None = None,
    ) -> Record:
        """Draw frames; parameters as for `expected`. All pixels in a frame share the gate's shift."""
        events = self.events(energy, open_ns, background, pulses, pattern)
        steep = 0.0 if slope is None else self._signal_events(np.asarray(slope, np.float64), pattern)
        shape = (integer("frames", frames, 1, 10**9), *events.shape)
        random = np.random.default_rng(seed)
        signal = np.empty(shape, np.uint16 if self.bits <= 16 else np.uint32)
        saturated = np.empty(shape, np.bool_)
        most = min(self.top_dn, self._exposures(pulses)) - 1 if self.kind == "counting" else self.top_dn
        for frame in range(len(signal)):
            shift = random.normal(0, self.gate_jitter_ns / np.sqrt(pulses), events.shape[-1])
            charge = self._drawn(np.maximum(events + steep * shift, 0), pulses, pattern, random)
            full = charge > self.full_well
            charge = np.minimum(charge, self.full_well) + random.normal(0, self.read_noise, charge.shape)
            codes = np.rint(self._offset(pattern) + charge / self.electrons_per_dn)
            saturated[frame] = full | (codes > most)
            signal[frame] = np.clip(codes, 0, self.top_dn)
        return Record(signal, saturated)

    def _drawn(self, events: FloatArray, pulses: int, pattern: Pattern, random: np.random.Generator) -> FloatArray:
        """Draw the charge of a frame without full well [electrons]."""
        if self.kind == "counting":
            exposures = self._exposures(pulses)
            return random.binomial(exposures, -np.expm1(-events / exposures)).astype(np.float64)
        blurred = self.intensifier_mtf < 1
        spread = self.excess_noise - 1 - (1 / self.gain if blurred else 0)
        charge = multiplied(random.poisson(events), self.gain, spread, random)
        if blurred:
            charge = random.poisson(self.spread(charge)).astype(np.float64)
        if self.kind != "electron_multiplying" and self.dark_current_hz * self.frame_time_ms:
            charge += random.poisson(np.broadcast_to(self._dark(pattern), charge.shape))
        return charge

    def _charge(self, events: FloatArray, pulses: int, pattern: Pattern) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the first three cumulants of a frame's charge without full well [electrons]."""
        if self.kind == "counting":
            exposures = self._exposures(pulses)
            silent, mean = np.exp(-events / exposures), exposures * -np.expm1(-events / exposures)
            return mean, mean * silent, mean * silent * (2 * silent - 1)
        # For gamma-distributed charges, the mean cube is the cubed mean times F (2 F - 1).
        gain, noise = self.gain, self.excess_noise - (1 / self.gain if self.intensifier_mtf < 1 else 0)
        mean, pairs = gain * self.spread(events), gain**2 * noise * self.spread(events, 2)
        triples = gain**3 * noise * (2 * noise - 1) * self.spread(events, 3)
        dark = 0.0 if self.kind == "electron_multiplying" else self._dark(pattern)
        if self.intensifier_mtf < 1:  # a Poisson distribution about each electron number
            return mean + dark, pairs + mean + dark, triples + 3 * pairs + mean + dark
        return mean + dark, pairs + dark, triples + dark

    def _dark(self, pattern: Pattern) -> FloatArray:
        """Return the mean dark charge of the chip in a frame, to broadcast to pixels and gates."""
        return 1e-3 * self.dark_current_hz * self.frame_time_ms * pattern.dark[..., np.newaxis]

    def _signal_events(self, light: FloatArray, pattern: Pattern) -> FloatArray:
        """Return the mean events of energies [J] behind the optics."""
        factor = self.quantum_efficiency * photons_per_joule(self.wavelength_nm)
        return factor * _blurred(light, self.optics_mtf, 1) * pattern.response[..., np.newaxis]

    def _offset(self, pattern: Pattern) -> FloatArray:
        """Return the digital numbers without charge, to broadcast to pixels and gates."""
        return self.offset_dn + pattern.offset[..., np.newaxis]

    def _exposures(self, pulses: int) -> int:
        """Return in how many exposures the pulses are counted."""
        return -(-pulses // self.pulses_per_exposure)


def _blurred(values: FloatArray, mtf: float, power: int) -> FloatArray:
    """Return values, shape (row, column, ...), blurred along rows and columns with a power of the weights."""
    if mtf == 1 or values.ndim < 3:
        return values
    for axis in (0, 1):
        moved = np.moveaxis(values, axis, 0)
        flat = np.ascontiguousarray(moved).reshape(len(moved), -1)
        values = np.moveaxis((_blur_weights(len(moved), mtf).power(power) @ flat).reshape(moved.shape), 0, axis)
    return values


def _blur_weights(size: int, mtf: float) -> sparse.csr_array:
    """Return the discrete Gaussian with this MTF at half a cycle per pixel as a matrix that mirrors at its ends."""
    from scipy import sparse
    from scipy.special import ive

    width = -0.5 * np.log(mtf)
    reach = 4 + int(12 * np.sqrt(width) + 6 * width)
    kernel = ive(np.abs(np.arange(-reach, reach + 1)), width)
    kernel = kernel[kernel > _TAIL]
    reach = kernel.size // 2
    near = np.lib.stride_tricks.sliding_window_view(np.pad(np.arange(size), reach, "symmetric"), kernel.size)
    places = np.repeat(np.arange(size), kernel.size), near.ravel()
    return sparse.csr_array((np.tile(kernel / kernel.sum(), size), places), (size, size))


def _clipped(mean: FloatArray, variance: FloatArray, third: FloatArray, limit: Values, over: Values) -> Expected:
    """Return the moments of min(X, limit) and P(X > over), for a Pearson distribution of type III with these cumulants.

    In deviations from the mean, X is (Y - k)/sqrt(k), or its negative; Y is gamma-distributed with the shape k = 4
    divided by the squared skewness.
    """
    deviation = np.sqrt(variance)
    limit, over = np.broadcast_to(limit, mean.shape), np.broadcast_to(over, mean.shape)
    found = Expected(np.array(mean), np.array(variance), np.asarray(mean > over, np.float64))
    near = mean + _FAR * deviation + third / np.maximum(variance, 1e-300) * _FAR > limit
    found.mean[near & (deviation == 0)] = limit[near & (deviation == 0)]
    near &= deviation > 0
    m, s, x, end = mean[near], deviation[near], limit[near], over[near]
    skewness = third[near] / s**3
    below, first, second = _partial_moments((x - m) / s, skewness)
    step = (x - m) / s
    shift = first + step * (1 - below)
    found.mean[near] = m + s * shift
    found.variance[near] = s**2 * np.maximum(second + step**2 * (1 - below) - shift**2, 0)
    found.saturation[near] = 1 - _partial_moments((end - m) / s, skewness)[0]
    return found


def _partial_moments(x: FloatArray, skewness: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the integrals of 1, z and z^2 up to x over a standardised Pearson distribution of type III."""
    from scipy.special import gammainc, gammaln, xlogy

    sign = np.where(skewness < 0, -1.0, 1.0)
    shape = 4 / np.maximum(np.abs(skewness), _LEAST_SKEWNESS) ** 2
    y = np.maximum(shape + np.sqrt(shape) * sign * x, 0)
    below = gammainc(shape, y)
    density = np.exp(xlogy(shape, y) - y - gammaln(shape + 1))
    second = below + density * (shape - 1 - y)
    # The distribution is mirrored for a negative skewness.
    mirrored = sign < 0
    return np.where(mirrored, 1 - below, below), -np.sqrt(shape) * density, np.where(mirrored, 1 - second, second)
